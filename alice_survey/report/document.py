"""What a report says, before anyone decides how it looks: the page and the PDF show the same."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

Level = Literal["good", "look", "bad"]


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A plot with the plain words that go with it."""

    png: bytes
    title: str
    alt: str
    """What somebody who cannot see it must know."""
    shows: str
    good: str = ""
    """How it looks when all is well."""
    otherwise: str = ""
    """What to do when it does not."""


@dataclass(frozen=True, kw_only=True)
class Table:
    """Rows of text under a header; numbers stand to the right."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True, kw_only=True)
class Link:
    """A way to a file or a page on the same server."""

    text: str
    address: str
    about: str = ""


@dataclass(frozen=True, kw_only=True)
class Section:
    """A part of the report."""

    name: str
    """Plain word that its anchor is made of."""
    title: str
    text: Sequence[str] = ()
    figures: Sequence[Figure] = ()
    tables: Sequence[Table] = ()
    links: Sequence[Link] = ()
    """Of a served page; print and the report have none."""
    scene: Literal["map", "mesh"] | None = None
    """What the page shows here that moves; print shows a still of it."""


@dataclass(frozen=True, kw_only=True)
class Scale:
    """What the colours of a layer mean."""

    label: str
    """With its unit."""
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
    """Of its upper left corner, on the map's axes (east, north)."""
    north_m: float
    pixel_m: float
    width_px: int
    height_px: int
    tile_px: int
    levels: int
    """Level 0 is the coarsest; the last is full: tile x, y at level k covers
    `tile_px * 2**(levels - 1 - k)` full pixels a side."""
    tiles: Mapping[str, bytes]
    """WebP by "k/x/y"; a tile at the border may be smaller. None where a server gives them."""
    address: str | None = None
    """Of a tile on the server that gives the page, with "{}" in place of "k/x/y"."""
    sizes: Sequence[tuple[int, int, float, float]] | None = None
    """Columns, rows and a pixel's width and height, metres, of each level, full resolution first;
    halves, rounded up, where not given."""
    scale: Scale | None = None
    shown: bool = False
    """From the start; of base layers only one can be."""
    base: bool = True
    """Base layers exclude one another; others lie over them."""

    def size(self, level: int) -> tuple[int, int, float, float]:
        """Columns, rows and a pixel's width and height, metres, of a level."""
        halvings = self.levels - 1 - level
        if self.sizes is not None:
            return self.sizes[halvings]
        side = 2**halvings
        pixel = self.pixel_m * side
        return -(-self.width_px // side), -(-self.height_px // side), pixel, pixel


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
    """The map that pans and zooms."""

    layers: Sequence[PictureLayer | ShapeLayer]
    unit: str
    """Of its axes: m, or unit where the model has no scale."""
    origin: str
    """Where (0, 0) is, in words."""


@dataclass(frozen=True, kw_only=True)
class Mesh:
    """The mesh that turns."""

    glb: Path
    """Small enough for a page."""
    about: str
    """Triangles and size, in words."""
    still: bytes
    """PNG for print and for browsers without WebGL."""
    alt: str
    address: str | None = None
    """On the server that gives the page, which then does not carry the mesh."""


@dataclass(frozen=True, kw_only=True)
class Report:
    """All of it."""

    title: str
    subtitle: str
    summary: Mapping[str, str]
    """Three sentences: "What was mapped", "How well", "What to do next"."""
    facts: Sequence[tuple[str, str]]
    """Labels and values of the first row."""
    verdicts: Sequence[tuple[Level, str]]
    """Worst first."""
    sections: Sequence[Section]
    map: SurveyMap | None = None
    mesh: Mesh | None = None
    data: Mapping[str, Any] | None = None
    """The same numbers for programs: `report.json`."""
