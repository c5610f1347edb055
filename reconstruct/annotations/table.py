"""Areas of annotations with their sigmas, and what a label covers: of all, or by quadrats.

A vertex that a person sets errs by itself; what errors of the pose and of the surface do to all
vertices of an annotation is carried along together, so that a shift leaves its area as it is.
Areas are those of the plan, as the mosaic shows them.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from rasterio.enums import Resampling
from rasterio.transform import Affine
from shapely.geometry.base import BaseGeometry

from alice_survey.base.artefacts import write_csv
from alice_survey.base.errors import ConfigError, ReconstructionError, WorkspaceError
from alice_survey.base.frames import Array
from reconstruct.annotations.projection import PIXEL_SIGMA_PX, OnPlane, Projector
from reconstruct.annotations.store import read_annotations
from reconstruct.annotations.transfer import frame_of
from reconstruct.annotations.values import Annotation, AnnotationSet, DrawnShape, Label, area_only
from reconstruct.raster import opened_raster

_LONGEST_PX = 2000
_MOST_QUADRATS = 100_000
_OPAQUE = 128
INSTANCE = "instance"
"""Attribute that parts of one thing share; they count once."""
HEADER = (
    "quadrat", "west", "south", "side", "known", "label", "aphia_id", "count", "area", "sigma",
    "cover", "cover_sigma", "unit",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class MeasuredMark:
    """An annotation on the mosaic."""

    annotation: Annotation
    shape: DrawnShape
    area: float
    """Of its plan, in squares of the unit; NaN of points and lines."""
    sigma: float
    length: float
    """Of a line; NaN of others."""

    @cached_property
    def geometry(self) -> BaseGeometry:
        """As shapely has it."""
        return self.shape.geometry


@dataclass(frozen=True, kw_only=True)
class Row:
    """What one label has in one place."""

    label: Label
    count: int
    area: float
    sigma: float
    cover: float
    """Share of the known ground that it covers; overlaps of one label count once."""
    cover_sigma: float


@dataclass(frozen=True, kw_only=True)
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
        shrink = max(1.0, max(raster.width, raster.height) / _LONGEST_PX)
        shape = max(1, round(raster.height / shrink)), max(1, round(raster.width / shrink))
        mask = raster.dataset_mask(out_shape=shape, resampling=Resampling.average)
        t, wide, high = raster.transform, raster.width / shape[1], raster.height / shape[0]
        return KnownGround(
            known=mask >= _OPAQUE, transform=Affine(t.a * wide, 0.0, t.c, 0.0, t.e * high, t.f),
            pixel=float(raster.transform.a),
        )  # fmt: skip


def measured(
    annotations: Sequence[Annotation],
    pixel: float,
    projector: Callable[[], Projector],
    sigma_px: float = PIXEL_SIGMA_PX,
) -> tuple[list[MeasuredMark], list[str]]:
    """Annotations on the mosaic with their areas, and why others are not.

    Args:
        annotations: on the mosaic and in pictures.
        pixel: side of a pixel of the mosaic.
        projector: of the workspace; used where annotations are in pictures.
        sigma_px: with which vertices were set, in pixels of the mosaic or of the picture.
    """
    found, lost = [], []
    for one in annotations:
        shape, rings = one.shape, []
        if one.image is None:
            rings = [OnPlane.drawn(ring, sigma_px * pixel) for ring in shape.rings]
        else:
            try:
                shape, rings = projector().on_plane(one, sigma_px)
            except ReconstructionError as error:
                lost.append(str(error))
                continue
        area, sigma, length = math.nan, math.nan, math.nan
        if shape.is_area:
            area, sigma = shape.area, sigma_of_area(one.shape, rings)
        elif shape.kind == "polyline":
            length = float(shape.geometry.length)
        found.append(
            MeasuredMark(annotation=one, shape=shape, area=area, sigma=sigma, length=length)
        )
    return found, lost


def sigma_of_area(drawn: DrawnShape, rings: Sequence[OnPlane]) -> float:
    """Standard deviation of the area of a shape.

    Args:
        drawn: as it was drawn: a circle by its middle and radius, a rectangle by two corners.
        rings: its vertices on the plane, outer ring first.
    """
    own, shared = 0.0, np.zeros(rings[0].shared.shape[2])
    for ring in rings:  # holes turn the other way round, so that signed areas add up
        slopes = _slopes(ring.places)
        own += float(np.einsum("ni,nij,nj->", slopes, ring.own, slopes))
        shared = shared + np.einsum("ni,nik->k", slopes, ring.shared)
    if drawn.kind == "circle":  # of one radius: all vertices move outwards by the same
        outer = rings[0]
        out = _slopes(outer.places)
        along = np.linalg.norm(out, axis=1)
        sigma = math.sqrt(float(np.trace(outer.own.mean(axis=0)))) * float(along.sum())
        own = sigma**2
    elif drawn.kind == "rectangle":  # of two corners, which set four
        own *= 2.0
    return math.sqrt(own + float(shared @ shared))


def _slopes(ring: Array) -> Array:
    """Derivatives (N, 2) of a ring's signed area by its vertices."""
    chord = np.roll(ring, -1, axis=0) - np.roll(ring, 1, axis=0)
    return 0.5 * np.column_stack([chord[:, 1], -chord[:, 0]])


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
    if not side > 0 or (east - west) * (north - south) / side**2 > _MOST_QUADRATS:
        raise ConfigError(
            f"quadrats of {side:g}: over {east - west:.1f} x {north - south:.1f} these are more "
            f"than {_MOST_QUADRATS}: give a larger side"
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
        parts, variance = [], 0.0
        for mark in mine:
            if not mark.shape.is_area or mark.area <= 0:
                continue
            part = mark.geometry if box is None else area_only(mark.geometry.intersection(box))
            if part.area > 0:
                parts.append(part)
                # the share of the outline within the square sets the share of the variance
                variance += mark.sigma**2 * min(1.0, part.area / mark.area)
        if not names and not parts:
            continue
        covered = shapely.union_all(parts).area if parts else 0.0
        sigma = math.sqrt(variance)
        share = max(known, 1e-300)
        rows.append(
            Row(
                label=label, count=len(names), area=math.fsum(part.area for part in parts),
                sigma=sigma, cover=covered / share, cover_sigma=sigma / share,
            )
        )  # fmt: skip
    return tuple(rows)


def _is_in(middle: shapely.Point, box: BaseGeometry) -> bool:
    """Whether a middle is in a square, of whose edges the west and south belong to it."""
    west, south, east, north = box.bounds
    return bool(west <= middle.x < east and south <= middle.y < north)


def table(
    workspace: Path,
    *,
    side: float | None = None,
    sigma_px: float = PIXEL_SIGMA_PX,
    csv_file: Path | None = None,
) -> tuple[str, dict[str, Any]]:
    """What each label has and covers in a workspace.

    Args:
        workspace: with annotations, a surface and a mosaic.
        side: of quadrats; None for all of the mosaic.
        sigma_px: with which vertices were set.
        csv_file: to write rows to, in the columns of `HEADER`.

    Returns:
        A table as text, and the rows as JSON values.

    Raises:
        WorkspaceError: there are no annotations, or no mosaic.
    """
    frame = frame_of(workspace)
    values = read_annotations(workspace, frame)
    if not values.annotations:
        raise WorkspaceError(
            f"{workspace} has no annotations: draw some in the studio, or 'annotations import'"
        )
    ground = ground_of(workspace)
    unit = "m" if frame is None else frame.unit
    opened = cache(lambda: Projector(workspace))
    marks, lost = measured(values.annotations, ground.pixel, opened, sigma_px)
    found = quadrats(values, marks, ground, side)
    rows = [cells(one, row, unit) for one in found for row in one.rows]
    if csv_file is not None:
        write_csv(csv_file, HEADER, rows)
    lines = [_line(row) for row in rows]
    lines += [f"not counted: {line}" for line in lost]
    data = {
        "rows": [dict(zip(HEADER, row, strict=True)) for row in rows],
        "not_counted": lost,
        "sigma_px": sigma_px,
    }
    return "\n".join(lines), data


def cells(quadrat: LabelledQuadrat, row: Row, unit: str) -> tuple[Any, ...]:
    """A row of the table, in the columns of `HEADER`."""
    return (
        quadrat.name, round(quadrat.west, 6), round(quadrat.south, 6), quadrat.side,
        round(quadrat.known, 6), row.label.id, row.label.aphia_id, row.count, round(row.area, 9),
        round(row.sigma, 9), round(row.cover, 9), round(row.cover_sigma, 9), unit,
    )  # fmt: skip


def _line(row: tuple[Any, ...]) -> str:
    values = dict(zip(HEADER, row, strict=True))
    unit = "m2" if values["unit"] == "m" else "units2"
    place = "" if values["side"] is None else f"quadrat {values['quadrat']}: "
    return (
        f"{place}{values['label']}: {values['count']}, {values['area']:.6f} +/- "
        f"{values['sigma']:.6f} {unit}, {values['cover']:.3%} of the known ground"
    )
