"""A measured figure with its sigma, and the figures of a few points."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from alice_survey.core.frames import Array
from reconstruct.measure.errors import FigureSlopes, PackedSlopes
from reconstruct.measure.surface import MeasuredSurface, Samples


@dataclass(frozen=True, kw_only=True)
class Measured:
    """A figure and how well it is known."""

    name: str
    title: str
    value: float
    own: float
    """Standard deviation by own errors of cells."""
    shared: float
    """Standard deviation by what poses, calibration and scale do to all."""
    unit: str
    """Empty of a ratio."""

    @property
    def sigma(self) -> float:
        """Standard deviation."""
        return math.hypot(self.own, self.shared)

    def to_json(self) -> dict[str, Any]:
        """The figure with its sigma, as JSON holds them."""
        return {**vars(self), "sigma": self.sigma}


def figure(
    surface: MeasuredSurface, name: str, title: str, value: float, slopes: PackedSlopes, power: int,
    unit: str | None = None,
) -> Measured:  # fmt: skip
    """A figure of a surface.

    Args:
        surface: that it is of.
        name: plain word.
        title: for readers.
        value: of the figure.
        slopes: its derivatives by the surface's motions.
        power: of a length that it is: it grows so with the scale.
        unit: where it is no power of a length.
    """
    found = slopes.variance
    scale = power * value * surface.errors.scale_sigma
    lengths = surface.unit + ("", "", "²", "³")[power] if power else ""
    return Measured(
        name=name, title=title, value=value, own=math.sqrt(found.own),
        shared=math.hypot(math.sqrt(found.shared), scale),
        unit=lengths if unit is None else unit,
    )  # fmt: skip


def slopes_of(value: Callable[[Array], float], points: Array) -> Array:
    """Derivatives (N, 3) of a figure of points (N, 3), by central differences."""
    slope = np.zeros_like(points)
    step = 1e-6 * max(1.0, float(np.abs(points).max()))
    for n, axis in np.ndindex(*points.shape):
        ends = []
        for sign in (1.0, -1.0):
            moved = points.copy()
            moved[n, axis] += sign * step
            ends.append(value(moved))
        slope[n, axis] = (ends[0] - ends[1]) / (2 * step)
    return slope


def of_points(
    surface: MeasuredSurface, samples: Samples, name: str, title: str,
    value: Callable[[Array], float], power: int, unit: str | None = None,
) -> Measured:  # fmt: skip
    """A figure of points of a surface, which is a function of their coordinates."""
    centred = samples.points - samples.points.mean(axis=0)
    slopes, gathered = slopes_of(value, centred), FigureSlopes(surface.errors)
    gathered.add(samples.places, slopes, samples.own_variance(slopes))
    return figure(surface, name, title, value(centred), gathered.packed, power, unit)


def polyline(points: Array) -> float:
    """Length of the line through points (N, D)."""
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def polygon_area(points: Array) -> float:
    """Area of the closed polygon through points (N, 3): the length of its vector area."""
    local = points - points.mean(axis=0)
    return 0.5 * float(np.linalg.norm(np.cross(local, np.roll(local, -1, axis=0)).sum(axis=0)))


def plan_area(points: Array) -> float:
    """Area (not negative) of the polygon through points (N, 2 or 3), seen along the third axis."""
    x, y = (points[:, axis] - points[:, axis].mean() for axis in range(2))
    return 0.5 * abs(float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum()))


def as_places(vertices: Sequence[Sequence[float]]) -> Array:
    """Places (N, 2) without repeated ones."""
    places = np.asarray(vertices, dtype=np.float64).reshape(-1, 2)
    kept = np.ones(len(places), np.bool_)
    kept[1:] = np.any(np.diff(places, axis=0) != 0.0, axis=1)
    return places[kept]
