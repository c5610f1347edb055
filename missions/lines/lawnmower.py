"""Survey lines: a lawnmower over any polygon, and cross lines that tie it together.

In the frame of the lines, u runs along them and v to the right of them. Each line looks after a
strip of v; it runs as far in u as the area reaches within that strip, so that slanted edges are
covered too. Where the area has parts, so has the line.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
import shapely
from shapely.geometry import Polygon

from alice_survey.errors import PlanError
from alice_survey.frames import Array
from missions.areas.shapes import polygon_corners
from missions.footprint import Swath
from missions.lines.line import Line

MOST_STATIONS = 100_000
_TINY_M = 1e-9


@dataclass(frozen=True, kw_only=True)
class LineSpacing:
    """How lines are laid over the width of an area."""

    spacing_m: float
    count: int
    first_m: float
    """From the area's side to the first line."""


def longer_side_heading(polygon: Polygon) -> float:
    """Direction of the longer side of the smallest rectangle round a polygon, radians in [0, pi).

    Of two sides of one length, the one along the area's first side.
    """
    box = polygon.minimum_rotated_rectangle
    if not isinstance(box, Polygon):
        raise PlanError("area: its corners lie on one line")
    sides = np.diff(polygon_corners(box)[:3], axis=0)
    lengths = np.linalg.norm(sides, axis=1)
    if abs(lengths[0] - lengths[1]) < 1e-6:
        first = np.diff(polygon_corners(polygon)[:2], axis=0)[0]
        side = sides[int(np.argmax(np.abs(sides @ first)))]
    else:
        side = sides[int(np.argmax(lengths))]
    heading = math.atan2(side[1], side[0]) % math.pi
    return 0.0 if math.pi - heading < 1e-12 else heading


def space_lines(
    width_m: float, swath: Swath, *, largest_m: float, exact_m: float | None
) -> LineSpacing:
    """Lay lines over a width so that the outermost see its sides.

    Args:
        width_m: of the area across the lines.
        swath: what a line sees; the worse side counts, since headings alternate.
        largest_m: spacing that the overlap asks for; lines are laid as evenly as they fit.
        exact_m: a spacing to keep instead; lines are centred.
    """
    spare_m = width_m - 2 * swath.half_across_m
    wanted_m = largest_m if exact_m is None else exact_m
    if spare_m <= 0:
        return LineSpacing(spacing_m=wanted_m, count=1, first_m=width_m / 2)
    steps = math.ceil(spare_m / wanted_m - 1e-9)
    spacing_m = spare_m / steps if exact_m is None else exact_m
    return LineSpacing(
        spacing_m=spacing_m, count=steps + 1, first_m=(width_m - steps * spacing_m) / 2
    )


def survey_lines(
    polygon: Polygon, heading_rad: float, spacing: LineSpacing, step_m: float
) -> list[Line]:
    """Lay parallel lines over a polygon, to and fro.

    Args:
        polygon: what must be seen, x = north, y = east.
        heading_rad: of the first line.
        spacing: from `space_lines` for the polygon's width across the heading.
        step_m: from station to station.

    Returns:
        Lines in the order of flight. The first is on the side nearer to the polygon's first corner.

    Raises:
        PlanError: the area needs more than `MOST_STATIONS` stations.
    """
    low, high = across_range(polygon, heading_rad)
    offsets = low + spacing.first_m + spacing.spacing_m * np.arange(spacing.count)
    _check_size(polygon, spacing, step_m)
    first_across = _to_uv(polygon_corners(polygon)[:1], heading_rad)[0, 1]
    if abs(first_across - high) < abs(first_across - low):
        offsets = offsets[::-1]
    uv = _rotated(polygon, heading_rad)
    lines: list[Line] = []
    forward = True
    for offset in offsets:
        half = spacing.spacing_m / 2
        strip = (
            low - 1.0 if math.isclose(offset, offsets.min()) else offset - half,
            high + 1.0 if math.isclose(offset, offsets.max()) else offset + half,
        )
        row = _row(uv, float(offset), strip, heading_rad, step_m, "survey")
        if not row:
            continue
        lines += row if forward else [line.reversed() for line in row[::-1]]
        forward = not forward
    return lines


def cross_lines(
    polygon: Polygon,
    survey_heading_rad: float,
    count: int,
    step_m: float,
    from_ne: tuple[float, float],
) -> list[Line]:
    """Lay lines across the survey lines, evenly over the area's length, nearest end first.

    Args:
        polygon: the area.
        survey_heading_rad: of the survey lines.
        count: how many.
        step_m: from station to station.
        from_ne: where the vehicle is before them.
    """
    heading_rad = survey_heading_rad + math.pi / 2
    low, high = across_range(polygon, heading_rad)
    uv = _rotated(polygon, heading_rad)
    rows = []
    for offset in low + (high - low) * np.arange(1, count + 1) / (count + 1):
        strip = (float(offset) - step_m / 2, float(offset) + step_m / 2)
        rows.append(_row(uv, float(offset), strip, heading_rad, step_m, "cross"))
    rows = [row for row in rows if row]
    if rows and _ends_distance(rows[-1], from_ne) < _ends_distance(rows[0], from_ne):
        rows = rows[::-1]
    lines: list[Line] = []
    for row in rows:
        backward = [line.reversed() for line in row[::-1]]
        to_start = math.dist(from_ne, row[0].start_ne_m)
        chosen = backward if math.dist(from_ne, backward[0].start_ne_m) < to_start else row
        lines += chosen
        from_ne = chosen[-1].end_ne_m
    return lines


def across_range(polygon: Polygon, heading_rad: float) -> tuple[float, float]:
    """The least and greatest v of a polygon for lines of a heading."""
    across = _to_uv(polygon_corners(polygon), heading_rad)[:, 1]
    return float(across.min()), float(across.max())


def _row(
    uv: Polygon,
    offset: float,
    strip: tuple[float, float],
    heading_rad: float,
    step_m: float,
    kind: Literal["survey", "cross"],
) -> list[Line]:
    """The lines at one offset, forward."""
    u_min, _, u_max, _ = uv.bounds
    inside = shapely.intersection(uv, shapely.box(u_min - 1, strip[0], u_max + 1, strip[1]))
    parts = [part for part in shapely.get_parts(inside) if isinstance(part, Polygon)]
    reaches = sorted((part.bounds[0], part.bounds[2]) for part in parts if part.area > 0)
    lines = []
    for start, end in _merged([_lengthened(reach, step_m) for reach in reaches], step_m):
        steps = round((end - start) / step_m)
        ends = np.round(_from_uv(np.array([[start, offset], [end, offset]]), heading_rad), 9) + 0.0
        lines.append(
            Line(
                kind=kind,
                start_ne_m=(float(ends[0, 0]), float(ends[0, 1])),
                end_ne_m=(float(ends[1, 0]), float(ends[1, 1])),
                stations=steps + 1,
            )
        )
    return lines


def _lengthened(reach: tuple[float, float], step_m: float) -> tuple[float, float]:
    """Lengthen a reach at both ends alike to a whole number of steps."""
    steps = max(1, math.ceil((reach[1] - reach[0]) / step_m - _TINY_M))
    middle, half = (reach[0] + reach[1]) / 2, steps * step_m / 2
    return middle - half, middle + half


def _merged(reaches: Sequence[tuple[float, float]], step_m: float) -> list[tuple[float, float]]:
    """Join reaches that touch or leave a gap of less than two steps."""
    if not reaches:
        return []
    joined = [reaches[0]]
    for start, end in reaches[1:]:
        if start - joined[-1][1] < 2 * step_m:
            longest = (joined[-1][0], max(joined[-1][1], end))
            joined[-1] = _lengthened(longest, step_m)
        else:
            joined.append((start, end))
    if len(joined) < len(reaches) and any(b[0] - a[1] < 0 for a, b in pairwise(joined)):
        return _merged(joined, step_m)
    return joined


def _check_size(polygon: Polygon, spacing: LineSpacing, step_m: float) -> None:
    stations = polygon.area / (spacing.spacing_m * step_m) + spacing.count
    if stations > MOST_STATIONS:
        raise PlanError(
            f"an area of {polygon.area:.0f} m2 with lines {spacing.spacing_m:.3g} m apart and a "
            f"picture every {step_m:.3g} m needs about {stations:.2g} stations, more than "
            f"{MOST_STATIONS}: split the area, fly higher or lower the overlaps"
        )


def _ends_distance(row: Sequence[Line], from_ne: tuple[float, float]) -> float:
    return min(math.dist(from_ne, row[0].start_ne_m), math.dist(from_ne, row[-1].end_ne_m))


def _to_uv(points_ne: Array, heading_rad: float) -> Array:
    c, s = math.cos(heading_rad), math.sin(heading_rad)
    uv: Array = points_ne @ np.array([[c, -s], [s, c]])
    return uv


def _from_uv(points_uv: Array, heading_rad: float) -> Array:
    c, s = math.cos(heading_rad), math.sin(heading_rad)
    ne: Array = points_uv @ np.array([[c, s], [-s, c]])
    return ne


def _rotated(polygon: Polygon, heading_rad: float) -> Polygon:
    return Polygon(_to_uv(polygon_corners(polygon), heading_rad))
