"""Profiles and lengths along a line on a surface."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from alice_survey.core.errors import ReconstructionError
from alice_survey.core.frames import Array
from reconstruct.measure.areas import not_more
from reconstruct.measure.errors import FigureSlopes
from reconstruct.measure.figures import (
    Measured,
    as_places,
    figure,
    of_points,
    polyline,
)
from reconstruct.measure.surface import MeasuredSurface, Samples

_MAX_SAMPLES = 20_000


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceProfile:
    """Heights along a line."""

    samples: Samples
    along: Array
    """(N,) distance from the start in plan."""
    corners: tuple[int, ...]
    """Samples that are the line's vertices."""


def profile(surface: MeasuredSurface, vertices: Sequence[Sequence[float]]) -> SurfaceProfile:
    """Heights along a line, a cell apart or less.

    Args:
        surface: to follow.
        vertices: two or more places, right (east) and up (north).

    Raises:
        ReconstructionError: it is too short or too long.
    """
    corners = as_places(vertices)
    if len(corners) < 2:
        raise ReconstructionError("a line needs two places that differ")
    sides = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    steps = np.ceil(sides / surface.grid.cell - 1e-9).astype(np.int64)
    if steps.sum() > _MAX_SAMPLES:
        raise ReconstructionError(
            f"a line over {steps.sum():,} cells: at most {_MAX_SAMPLES:,} are followed; "
            "measure it in parts"
        )
    parts = [
        start + (np.arange(count) / count)[:, None] * (end - start)
        for start, end, count in zip(corners[:-1], corners[1:], steps, strict=True)
    ]
    places = np.concatenate([*parts, corners[-1:]])
    along = np.concatenate([[0.0], np.cumsum(np.repeat(sides / steps, steps))])
    return SurfaceProfile(
        samples=surface.at(places),
        along=along,
        corners=(0, *np.cumsum(steps).tolist()),
    )


def measure_line(
    surface: MeasuredSurface, vertices: Sequence[Sequence[float]]
) -> tuple[Measured, ...]:
    """Figures of a line through places of a surface.

    Args:
        surface: that it is on.
        vertices: two or more places, right (east) and up (north).

    Raises:
        ReconstructionError: a vertex has no height, or the line is too short or too long.
    """
    found = profile(surface, vertices)
    ends = surface.known_at(as_places(vertices))
    figures = _of_ends(surface, ends)
    figures.insert(-3, surface_length(surface, found))
    return tuple(figures)


def measure_points(
    surface: MeasuredSurface, points: Sequence[Sequence[float]]
) -> tuple[tuple[Measured, ...], tuple[str, ...]]:
    """Figures of a line through points in space, such as of the mesh of a surface.

    Args:
        surface: whose errors the points share; a point has the own error of the surface there.
        points: two or more: right (east), up (north) and out (height).

    Returns:
        Figures, and what a reader must know of them.

    Raises:
        ReconstructionError: fewer than two points.
    """
    given = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    if len(given) < 2:
        raise ReconstructionError("a line needs two points")
    # the mesh is painted by other pictures than the mosaic, from about as far aside
    there = surface.at_picks(given[:, :2])
    apart = np.abs(there.height - given[:, 2]) > surface.grid.cell + 3.0 * there.sigma
    unlike = int((apart | ~np.isfinite(there.height)).sum())
    notes = () if not unlike else (
        f"{unlike} of {len(given)} points are not on the elevation model (a wall, an overhang, a "
        "filled gap): their own errors are not known, and not counted",
    )  # fmt: skip
    own = np.where(np.isfinite(there.own), there.own, 0.0)
    ends = replace(there, height=given[:, 2], own=own)
    return tuple(_of_ends(surface, ends)), notes


def _of_ends(surface: MeasuredSurface, ends: Samples) -> list[Measured]:
    figures = [
        of_points(surface, ends, "length", "Length, from vertex to vertex", polyline, 1),
        of_points(surface, ends, "plan_length", "Length in plan", _plan_length, 1),
        of_points(
            surface, ends, "height_difference", "Height difference, end minus start", _rise, 1
        ),
        of_points(surface, ends, "slope", "Slope from start to end", _slope_deg, 0, "°"),
    ]
    if len(ends.places) > 2:
        direct = of_points(surface, ends, "straight", "Straight from start to end", _straight, 1)
        figures.insert(1, direct)
    return figures


def surface_length(surface: MeasuredSurface, line: SurfaceProfile) -> Measured:
    """Length along the surface; NaN where a part of it is unknown.

    A step of length t in plan and a rise r is L = √(t² + r²) long. Noise of variance v in the rise
    makes it longer by v/2 d²L/dr² = v t² / (2 L³) in the mean, which is taken away.
    """
    samples = line.samples
    steps = np.diff(samples.points, axis=0)
    plan = np.linalg.norm(steps[:, :2], axis=1)
    lengths = np.linalg.norm(steps, axis=1)
    own, next_to = samples.own_covariances(0), samples.own_covariances(1)
    noise = np.maximum(own[:-1] + own[1:] - 2.0 * next_to, 0.0)
    noise *= not_more((steps[:, 2],), noise)
    added = noise * plan**2 / (2.0 * lengths**3)
    value = float((lengths - added).sum())
    slopes = np.zeros_like(samples.points)
    along = steps / lengths[:, None]
    slopes[:-1] -= along
    slopes[1:] += along
    name, title = "surface_length", "Length along the surface"
    if not math.isfinite(value):
        return Measured(
            name=name, title=title, value=math.nan, own=math.nan, shared=math.nan,
            unit=surface.unit,
        )  # fmt: skip
    gathered = FigureSlopes(surface.errors)
    gathered.add(samples.places, slopes, samples.own_variance(slopes))
    gathered.count_once(2.0 * float((added**2).sum()))
    return figure(surface, name, title, value, gathered.packed, 1)


def _plan_length(points: Array) -> float:
    return polyline(points[:, :2])


def _straight(points: Array) -> float:
    return float(np.linalg.norm(points[-1] - points[0]))


def _rise(points: Array) -> float:
    return float(points[-1, 2] - points[0, 2])


def _slope_deg(points: Array) -> float:
    """Steepness from the first to the last point; upwards is positive."""
    away = points[-1] - points[0]
    return math.degrees(math.atan2(away[2], math.hypot(away[0], away[1])))
