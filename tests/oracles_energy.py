"""Slow and obvious twins of missions.route.{dives,terrain} and missions.areas.bathymetry."""

import math
from collections.abc import Callable, Sequence
from itertools import combinations, pairwise

import numpy as np

from alice_survey.core.frames import Array

Cost = Callable[[int, int], tuple[float, float]]


def envelope(along_m: Array, wanted_m: Array, slope: float) -> Array:
    """Every place against every other."""
    return np.array(
        [
            min(w + slope * abs(s - t) for t, w in zip(along_m, wanted_m, strict=True))
            for s in along_m
        ]
    )


def best_parting(
    count: int, cost: Cost, energy_j: float, time_s: float
) -> tuple[int, float] | None:
    """Fewest dives and their least energy, by trying all ways to divide the lines."""
    for dives in range(1, count + 1):
        best = math.inf
        for cuts in combinations(range(1, count), dives - 1):
            ends = [0, *cuts, count]
            each = [cost(a, b - 1) for a, b in pairwise(ends)]
            if all(energy <= energy_j and time <= time_s for energy, time in each):
                best = min(best, sum(energy for energy, _ in each))
        if best < math.inf:
            return dives, best
    return None


def bilinear(values: Array, column: float, row: float) -> float:
    """A raster's value at a place counted in cells from its first centre; NaN beyond."""
    rows, columns = values.shape
    if not (0 <= row <= rows - 1 and 0 <= column <= columns - 1):
        return math.nan
    total = 0.0
    for r in (math.floor(row), math.floor(row) + 1):
        for c in (math.floor(column), math.floor(column) + 1):
            weight = (1 - abs(r - row)) * (1 - abs(c - column))
            if weight > 0:
                total += weight * float(values[r, c])
    return total


def highest_within(
    depth_at: Callable[[Array], Array],
    place_ne: Sequence[float],
    heading_rad: float,
    ahead_m: float,
    astern_m: float,
    across_m: float,
    step_m: float,
) -> float:
    """The least depth on a fine grid about a place, turned with the vehicle."""
    minimum = math.inf
    for ahead in np.arange(-astern_m, ahead_m + step_m / 2, step_m):
        for across in np.arange(-across_m, across_m + step_m / 2, step_m):
            north = place_ne[0] + ahead * math.cos(heading_rad) - across * math.sin(heading_rad)
            east = place_ne[1] + ahead * math.sin(heading_rad) + across * math.cos(heading_rad)
            minimum = min(minimum, float(depth_at(np.array([[north, east]]))[0]))
    return minimum
