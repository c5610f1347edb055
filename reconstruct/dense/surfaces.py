"""Several surfaces in one cell: an overhang above the floor, a ladder before a wall."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.compiled import compiled

Float32 = NDArray[np.float32]

_APART_SIGMAS = 5.0
"""Noise in a gap between heights, in standard deviations of the points on its two sides."""
_DIAGONAL = math.sqrt(2.0)
_MIN_POINTS = 3
_MIN_STATIONS = 2
"""A surface is seen from as many; what fewer see may be one wrong match."""


@compiled
def sorted_ranks(values: NDArray[Any]) -> NDArray[np.int64]:
    """Indices that sort values upwards (Shell's sort, which numba compiles in no time).

    The order of equal values depends on the values alone, not on the machine.
    """
    count = values.size
    ranks = np.arange(count)
    gap = 1
    while gap < count:
        gap = 3 * gap + 1
    while gap > 1:
        gap //= 3
        for i in range(gap, count):
            moved = ranks[i]
            j = i
            while j >= gap and values[ranks[j - gap]] > values[moved]:
                ranks[j] = ranks[j - gap]
                j -= gap
            ranks[j] = moved
    return ranks


@compiled
def surfaces_of(
    heights: Float32,
    sigmas: Float32,
    places: NDArray[np.int64],
    steepness: Float32,
    cell: float,
) -> tuple[int, NDArray[np.int64]]:
    """Which surface each point of a cell lies on.

    Sorted heights fall apart where a gap is wider than noise and a continuous surface explain: five
    standard deviations, and a cell's side, or the height that the surface's own slope gains over a
    cell's diagonal. A surface is what three points from two stations or more show. Where fewer than
    two are shown, all points are of one.

    Args:
        heights: (N,).
        sigmas: (N,) of the heights.
        places: (N,) stations.
        steepness: (N,) tangent of the angle between normal and vertical; NaN where unknown.
        cell: side of the cell.

    Returns:
        How many surfaces there are, and (N,) the surface of each point, 0 the uppermost; -1 of
        points between several surfaces and on none of them.
    """
    count = heights.size
    surface = np.zeros(count, np.int64)
    if heights.max() - heights.min() <= cell:
        return 1, surface
    ranks = sorted_ranks(heights)
    starts = np.empty(count + 1, np.int64)  # of parts, in the order of heights
    starts[0], parts = 0, 1
    for i in range(1, count):
        below, above = ranks[i - 1], ranks[i]
        noise = _APART_SIGMAS * math.hypot(sigmas[below], sigmas[above])
        if heights[above] - heights[below] > cell + noise:
            starts[parts] = i
            parts += 1
    starts[parts] = count
    if parts == 1:
        return 1, surface
    slopes = np.empty(parts)
    for part in range(parts):
        slopes[part] = _median_known(steepness, ranks[starts[part] : starts[part + 1]])
    kept = 1  # parts after those that a slope joins, whose starts move to the front
    for part in range(1, parts):
        below, above = ranks[starts[part] - 1], ranks[starts[part]]
        noise = _APART_SIGMAS * math.hypot(sigmas[below], sigmas[above])
        steep = np.nan
        for side in (slopes[part - 1], slopes[part]):
            if math.isnan(steep) or side > steep:
                steep = side
        # where no normal is known nothing tells a step from a steep slope
        if heights[above] - heights[below] > noise + _DIAGONAL * cell * steep:
            starts[kept] = starts[part]
            kept += 1
    starts[kept] = count
    found = 0
    surface[:] = -1
    for part in range(kept - 1, -1, -1):
        members = ranks[starts[part] : starts[part + 1]]
        if members.size < _MIN_POINTS or _different(places, members) < _MIN_STATIONS:
            continue
        for member in members:
            surface[member] = found
        found += 1
    if found < 2:
        surface[:] = 0
        return 1, surface
    return found, surface


@compiled
def _median_known(values: Float32, members: NDArray[np.int64]) -> float:
    """Median of those of some values that are known, the upper one of two; NaN of none."""
    known = np.empty(members.size, np.float32)
    count = 0
    for member in members:
        if not math.isnan(values[member]):
            known[count] = values[member]
            count += 1
    if count == 0:
        return np.nan
    ranks = sorted_ranks(known[:count])
    return float(known[ranks[count // 2]])


@compiled
def _different(values: NDArray[np.int64], members: NDArray[np.int64]) -> int:
    """How many different values some members have, counted up to those needed."""
    first = values[members[0]]
    for member in members:
        if values[member] != first:
            return _MIN_STATIONS
    return 1
