"""Tables of annotations, and of what labels cover: of all, or by quadrats."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from rasterio.enums import Resampling
from rasterio.transform import Affine
from shapely.geometry.base import BaseGeometry

from alice_survey.core.artefacts import write_csv
from alice_survey.core.errors import ConfigError, WorkspaceError
from alice_survey.core.run import progress
from reconstruct.annotations.marks import MarkMeasures, MeasuredMark
from reconstruct.annotations.projection import PIXEL_SIGMA_PX, Projector
from reconstruct.annotations.store import read_annotations
from reconstruct.annotations.surfaces import MarkPart, MarkSurfaces, SurfaceFigures
from reconstruct.annotations.transfer import frame_of
from reconstruct.annotations.values import AnnotationSet, Label, area_only
from reconstruct.measure.surface import MeasuredSurface
from reconstruct.raster import opened_raster

_MAX_PX = 2000
_MAX_QUADRATS = 100_000
_OPAQUE = 128
_WHOLE = 0.999
"""Share of a known surface from which on it counts as all."""
INSTANCE = "instance"
"""Attribute that parts of one thing share; they count once."""
_SURFACE = ("surface", "surface_sigma", "rugosity", "rugosity_sigma", "surface_known")
HEADER = (
    "quadrat", "west", "south", "side", "known", "label", "aphia_id", "count", "area", "sigma",
    "cover", "cover_sigma", *_SURFACE, "unit",
)  # fmt: skip
"""Columns of what labels cover."""
EACH = (
    "id", "label", "aphia_id", "image", "kind", "east", "north", "length", "area", "sigma",
    *_SURFACE, "unit",
)  # fmt: skip
"""Columns of single annotations."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Row:
    """What one label has in one place."""

    label: Label
    count: int
    area: float
    sigma: float
    cover: float
    """Share of the known ground that it covers; overlaps of one label count once."""
    cover_sigma: float
    parts: tuple[MarkPart, ...]
    """What its area is of."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LabelledQuadrat:
    """A square, or all of the mosaic, and what is in it."""

    name: str
    west: float
    south: float
    side: float | None
    """None of all of the mosaic."""
    known: float
    """Area of known ground."""
    rows: tuple[Row, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class KnownGround:
    """Which of the mosaic is known, at most some thousand pixels a side."""

    known: NDArray[np.bool_]
    transform: Affine
    pixel: float
    """Side of a pixel of the mosaic itself."""

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """West, south, east, north."""
        t, (rows, columns) = self.transform, self.known.shape
        return t.c, t.f + rows * t.e, t.c + columns * t.a, t.f

    @property
    def area(self) -> float:
        """Of what is known."""
        t = self.transform
        return float(self.known.sum()) * abs(float(t.a * t.e))

    def in_squares(self, side: float) -> dict[tuple[int, int], float]:
        """Known area by column and row of squares at whole multiples of a side."""
        rows, columns = np.nonzero(self.known)
        t = self.transform
        column = np.floor((t.c + (columns + 0.5) * t.a) / side).astype(np.int64)
        row = np.floor((t.f + (rows + 0.5) * t.e) / side).astype(np.int64)
        squares, counts = np.unique(np.stack([column, row]), axis=1, return_counts=True)
        cell = abs(t.a * t.e)
        return {
            (int(c), int(r)): float(n) * cell for (c, r), n in zip(squares.T, counts, strict=True)
        }


def ground_of(workspace: Path) -> KnownGround:
    """The known ground of a workspace, by its mosaic.

    Raises:
        WorkspaceError: there is no mosaic.
    """
    with opened_raster(workspace / "mosaic" / "mosaic.tif") as raster:
        shrink = max(1.0, max(raster.width, raster.height) / _MAX_PX)
        shape = max(1, round(raster.height / shrink)), max(1, round(raster.width / shrink))
        mask = raster.dataset_mask(out_shape=shape, resampling=Resampling.average)
        t, wide, high = raster.transform, raster.width / shape[1], raster.height / shape[0]
        return KnownGround(
            known=mask >= _OPAQUE, transform=Affine(t.a * wide, 0.0, t.c, 0.0, t.e * high, t.f),
            pixel=float(raster.transform.a),
        )  # fmt: skip


def quadrats(
    values: AnnotationSet,
    marks: Sequence[MeasuredMark],
    ground: KnownGround,
    side: float | None = None,
) -> list[LabelledQuadrat]:
    """What each label has on the mosaic, or in each square of known ground.

    Squares lie at whole multiples of their side, so that those of two surveys of a site are the
    same.

    Args:
        values: all labels.
        marks: annotations on the mosaic.
        ground: which of it is known.
        side: of the squares; None for all at once.

    Raises:
        ConfigError: there would be too many squares.
    """
    if side is None:
        west, south, _, _ = ground.bounds
        rows = _rows(values, marks, None, ground.area)
        return [
            LabelledQuadrat(
                name="all", west=west, south=south, side=None, known=ground.area, rows=rows
            )
        ]
    west, south, east, north = ground.bounds
    if not side > 0 or (east - west) * (north - south) / side**2 > _MAX_QUADRATS:
        raise ConfigError(
            f"quadrats of {side:g}: over {east - west:.1f} x {north - south:.1f} these are more "
            f"than {_MAX_QUADRATS}: give a larger side"
        )
    found = []
    tree = shapely.STRtree([mark.geometry for mark in marks])
    for (column, row), known in sorted(ground.in_squares(side).items()):
        box = shapely.box(column * side, row * side, (column + 1) * side, (row + 1) * side)
        near = [marks[n] for n in sorted(tree.query(box).tolist())] if marks else []
        found.append(
            LabelledQuadrat(
                name=f"{column},{row}", west=column * side, south=row * side, side=side,
                known=known, rows=_rows(values, near, box, known),
            )
        )  # fmt: skip
    return found


def _rows(
    values: AnnotationSet, marks: Sequence[MeasuredMark], box: BaseGeometry | None, known: float
) -> tuple[Row, ...]:
    rows = []
    for label in values.labels:
        mine = [mark for mark in marks if mark.annotation.label == label.id]
        counted = [mark for mark in mine if box is None or _is_in(mark.geometry.centroid, box)]
        names = {m.annotation.attributes.get(INSTANCE) or m.annotation.id for m in counted}
        parts = [part for mark in mine if (part := part_in(mark, box)) is not None]
        if not names and not parts:
            continue
        shapes = [part.geometry for part in parts]
        covered = shapely.union_all(shapes).area if parts else 0.0
        sigma = math.sqrt(math.fsum(part.mark.sigma**2 * part.share for part in parts))
        share = max(known, 1e-300)
        rows.append(
            Row(
                label=label, count=len(names), area=math.fsum(shape.area for shape in shapes),
                sigma=sigma, cover=covered / share, cover_sigma=sigma / share, parts=tuple(parts),
            )
        )  # fmt: skip
    return tuple(rows)


def part_in(mark: MeasuredMark, box: BaseGeometry | None = None) -> MarkPart | None:
    """The part of an annotation in a square, or all of it; None where it has no area there."""
    if not mark.shape.is_area or mark.area <= 0:
        return None
    if box is None or box.covers(mark.geometry):
        return MarkPart(mark=mark, geometry=mark.geometry)
    shape = area_only(mark.geometry.intersection(box))
    if not shape.area > 0:
        return None
    west, south, east, north = box.bounds
    return MarkPart(mark=mark, geometry=shape, square=(west, south, east, north))


def _is_in(middle: shapely.Point, box: BaseGeometry) -> bool:
    """Whether a middle is in a square, of whose edges the west and south belong to it."""
    west, south, east, north = box.bounds
    return bool(west <= middle.x < east and south <= middle.y < north)


@dataclass(frozen=True, kw_only=True, eq=False)
class AnnotationTable:
    """All that the tables of a workspace's annotations are made of."""

    values: AnnotationSet
    marks: Sequence[MeasuredMark]
    lost: Sequence[str]
    """Why others are not on the mosaic."""
    ground: KnownGround
    quadrats: Sequence[LabelledQuadrat]
    unit: str

    @property
    def parts(self) -> list[MarkPart]:
        """All of which a surface can be measured: annotations, and what squares cut off them."""
        cut = (part for one in self.quadrats for row in one.rows for part in row.parts)
        every = itertools.chain(filter(None, map(part_in, self.marks)), cut)
        return list({part.key: part for part in every}.values())

    def rows(self, surfaces: MarkSurfaces | None) -> list[tuple[Any, ...]]:
        """What labels cover, in the columns of `HEADER`.

        Args:
            surfaces: where all parts are measured; None where no surface is to be given.
        """
        return [
            (
                one.name, round(one.west, 6), round(one.south, 6), one.side, round(one.known, 6),
                row.label.id, row.label.aphia_id, row.count, round(row.area, 9),
                round(row.sigma, 9), round(row.cover, 9), round(row.cover_sigma, 9),
                *_surface_cells(None if surfaces is None else surfaces.figures(row.parts)),
                self.unit,
            )
            for one in self.quadrats
            for row in one.rows
        ]  # fmt: skip

    def each(self, surfaces: MarkSurfaces | None) -> list[tuple[Any, ...]]:
        """Single annotations, in the columns of `EACH`; see `rows`."""
        found, of = [], self.values.by_label
        for mark in self.marks:
            one, label, part = mark.annotation, of[mark.annotation.label], part_in(mark)
            figures = None if surfaces is None or part is None else surfaces.figures([part])
            middle = mark.geometry.centroid
            found.append((
                one.id, label.id, label.aphia_id, one.image, one.shape.kind, round(middle.x, 6),
                round(middle.y, 6), _rounded(mark.length), _rounded(mark.area),
                _rounded(mark.sigma), *_surface_cells(figures), self.unit,
            ))  # fmt: skip
        return found

    def not_measured(self, surfaces: MarkSurfaces) -> list[str]:
        """Why surfaces within annotations are not."""
        found = []
        for mark in self.marks:
            part = part_in(mark)
            fault = None if part is None else surfaces.fault(part)
            if fault is not None:
                found.append(f"annotation {mark.annotation.id}: {fault}")
        return found


def _rounded(value: float) -> float | None:
    return None if math.isnan(value) else round(value, 9)


def _surface_cells(figures: SurfaceFigures | None) -> tuple[float | None, ...]:
    if figures is None:
        return (None,) * len(_SURFACE)
    return (
        round(figures.area, 9), round(figures.area_sigma, 9), round(figures.rugosity, 6),
        round(figures.rugosity_sigma, 6), round(figures.known, 6),
    )  # fmt: skip


def annotation_table(
    workspace: Path, measures: MarkMeasures, ground: KnownGround, side: float | None = None
) -> AnnotationTable:
    """The annotations of a workspace on its mosaic, and what labels cover.

    Args:
        workspace: with a mosaic.
        measures: of its annotations.
        ground: of its mosaic.
        side: of quadrats; None for all of the mosaic.
    """
    frame = frame_of(workspace)
    values = read_annotations(workspace, frame)
    marks, lost = measures.of(values.annotations)
    return AnnotationTable(
        values=values, marks=marks, lost=lost, ground=ground,
        quadrats=quadrats(values, marks, ground, side), unit="m" if frame is None else frame.unit,
    )  # fmt: skip


def surfaces_of(workspace: Path) -> MarkSurfaces | None:
    """The surface of a workspace to measure annotations on; None where there is none."""
    if not (workspace / "dense" / "dem.tif").is_file():
        return None
    return MarkSurfaces(MeasuredSurface.of(workspace))


def table(
    workspace: Path,
    *,
    side: float | None = None,
    sigma_px: float = PIXEL_SIGMA_PX,
    each: bool = False,
    csv_file: Path | None = None,
) -> tuple[str, dict[str, Any]]:
    """What each label has and covers in a workspace, or its annotations one by one.

    Args:
        workspace: with annotations, a surface and a mosaic.
        side: of quadrats; None for all of the mosaic.
        sigma_px: with which vertices were set.
        each: whether to list annotations instead of labels.
        csv_file: to write rows to, in the columns of `HEADER` or `EACH`.

    Returns:
        A table as text, and the rows as JSON values.

    Raises:
        ConfigError: both quadrats and single annotations are wanted.
        WorkspaceError: there are no annotations, or no mosaic.
    """
    if each and side is not None:
        raise ConfigError("annotations are listed one by one or summed by quadrats: choose one")
    ground = ground_of(workspace)
    opened = cache(lambda: Projector(workspace))
    measures = MarkMeasures(ground.pixel, opened, sigma_px)
    found = annotation_table(workspace, measures, ground, side)
    if not found.values.annotations:
        raise WorkspaceError(
            f"{workspace} has no annotations: draw some in the studio, or 'annotations import'"
        )
    surfaces, missed = surfaces_of(workspace), ["there is no elevation model"]
    if surfaces is not None:
        parts = found.parts
        with progress.step("measure surfaces", len(parts)) as step:
            for part in parts:
                surfaces.measure(part)
                step.advance()
        missed = found.not_measured(surfaces)
    header = EACH if each else HEADER
    rows = found.each(surfaces) if each else found.rows(surfaces)
    if csv_file is not None:
        write_csv(csv_file, header, rows)
    named = [dict(zip(header, row, strict=True)) for row in rows]
    lines = [_line(row) for row in named]
    lines += [f"not counted: {line}" for line in found.lost]
    lines += [f"without a surface: {line}" for line in missed]
    data = {
        "rows": named, "not_counted": list(found.lost), "without_surface": missed,
        "sigma_px": sigma_px,
    }  # fmt: skip
    return "\n".join(lines), data


def _line(row: dict[str, Any]) -> str:
    unit = "m2" if row["unit"] == "m" else "units2"
    what, size = row["label"], []
    if "id" in row:
        what = f"{row['label']} {row['id']} ({row['image'] or 'mosaic'})"
        if row["length"] is not None:
            size.append(f"{row['length']:.6f} {row['unit']}")
    else:
        what = row["label"] if row["side"] is None else f"quadrat {row['quadrat']}: {row['label']}"
        size.append(f"{row['count']}")
    if row["area"] is not None:
        size.append(f"{row['area']:.6f} +/- {row['sigma']:.6f} {unit}")
    if "cover" in row:
        size.append(f"{row['cover']:.3%} of the known ground")
    if row["surface"] is not None:
        part = "" if row["surface_known"] > _WHOLE else f" of {row['surface_known']:.1%} of it"
        size.append(f"surface {row['surface']:.6f} +/- {row['surface_sigma']:.6f} {unit}{part}")
        size.append(f"rugosity {row['rugosity']:.4f} +/- {row['rugosity_sigma']:.4f}")
    return f"{what}: {', '.join(size) or 'a point'}"
