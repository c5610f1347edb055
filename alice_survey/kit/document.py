"""The content of a report, without its layout: the HTML page and the PDF show the same values."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

Level = Literal["good", "look", "bad"]
LEVELS: tuple[Level, ...] = ("bad", "look", "good")
"""Worst first."""


EAST_NORTH = ("east", "north")
OWN_AXES = ("y", "x")
"""Axes of the map of a model without a place: seen from above, its first axis is up."""


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """One judgement with its numbers."""

    level: Level
    text: str
    action: str = ""
    """Advice, as a sentence; empty where nothing has to be done."""


def worst_first(verdicts: Sequence[Verdict]) -> list[Verdict]:
    """Verdicts in the order in which a report shows them."""
    return sorted(verdicts, key=lambda verdict: LEVELS.index(verdict.level))


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A plot with its explanation in plain words."""

    title: str
    alt: str
    """Text alternative for readers who cannot see it."""
    shows: str
    png: bytes = b""
    """Image for the page; a figure of the print alone has none."""
    good: str = ""
    """How it looks when the result is good."""
    otherwise: str = ""
    """What to do when it does not."""
    svg: bytes = b""
    """Vector image for print; empty where there are only pixels."""


@dataclass(frozen=True, kw_only=True)
class Table:
    """Rows of text under a header; columns of numbers are aligned to the right."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True, kw_only=True)
class Section:
    """A part of the report."""

    title: str
    name: str = ""
    """Plain word for its anchor; from the title where empty."""
    text: Sequence[str] = ()
    figures: Sequence[Figure] = ()
    tables: Sequence[Table] = ()
    scene: Literal["map", "mesh"] | None = None
    """The interactive part of the page that belongs here; print shows its stills."""


@dataclass(frozen=True, kw_only=True)
class Scale:
    """Legend of a layer's colours."""

    label: str
    """Quantity with its unit."""
    low: float
    high: float
    colours: Sequence[str]
    """Evenly spaced from low to high, #rrggbb."""


@dataclass(frozen=True, kw_only=True)
class PictureLayer:
    """A raster on the map, with its pyramid."""

    name: str
    title: str
    about: str
    west_m: float
    """Position of its upper left corner, on the map's axes (east, north)."""
    north_m: float
    pixel_m: float
    width_px: int
    height_px: int
    tile_px: int
    levels: int
    """Level 0 is the coarsest; the last is full: tile x, y at level k covers
    `tile_px * 2**(levels - 1 - k)` full pixels a side."""
    tiles: Mapping[str, bytes]
    """WebP by "k/x/y"; a tile at the border may be smaller; empty where a server gives them."""
    address: str | None = None
    """URL of a tile on the server of the page, with "{}" in place of "k/x/y"."""
    sizes: Sequence[tuple[int, int, float, float]]
    """Columns, rows and a pixel's width and height, metres, of each level, full resolution
    first."""
    scale: Scale | None = None
    shown: bool = False
    """Whether it is shown at first; only one base layer can be."""
    base: bool = True
    """Base layers exclude one another; others lie over them."""

    def size(self, level: int) -> tuple[int, int, float, float]:
        """Columns, rows and a pixel's width and height, metres, of a level."""
        return self.sizes[self.levels - 1 - level]


@dataclass(frozen=True, kw_only=True)
class ShapeLayer:
    """Lines, outlines or points on the map."""

    name: str
    title: str
    about: str
    kind: Literal["line", "polygon", "point"]
    shapes: Sequence[Sequence[tuple[float, float]]]
    """Each a list of (east_m, north_m); a point is a list of one."""
    texts: Sequence[str] = ()
    """Shown when a shape is chosen; one for each, or none."""
    colour: str = "#0072b2"
    dashed: bool = False
    shown: bool = True


@dataclass(frozen=True, kw_only=True)
class SurveyMap:
    """The interactive map."""

    layers: Sequence[PictureLayer | ShapeLayer]
    unit: str
    """Unit of its axes: m, or unit where the model has no scale."""
    origin: str
    """Where (0, 0) is, in words."""
    axes: tuple[str, str] = EAST_NORTH
    """What its axes are called, across and up."""
    stills: Sequence[Figure] = ()
    """The map for print and for browsers without scripts: all of them in print, the first on the
    page; where there are none, the interactive map itself is printed."""


@dataclass(frozen=True, kw_only=True)
class Mesh:
    """The interactive mesh."""

    glb: Path
    """Binary glTF, small enough for a page."""
    about: str
    """Triangles and size of what the page shows, in words."""
    still: Figure
    """Image for print and for browsers without WebGL."""


@dataclass(frozen=True, kw_only=True)
class Report:
    """All of the report."""

    title: str
    subtitle: str
    summary: Mapping[str, str] = field(default_factory=dict)
    """Three sentences: "What was mapped", "How well", "What to do next"."""
    facts: Sequence[tuple[str, str]] = ()
    """Labels and values of the first row."""
    verdicts: Sequence[Verdict] = ()
    """Worst first."""
    sections: Sequence[Section] = ()
    map: SurveyMap | None = None
    mesh: Mesh | None = None
    citation: Sequence[tuple[str, str]] = ()
    """Labels and values of the title block in print: date, software and its version."""
