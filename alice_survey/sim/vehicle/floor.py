"""The sea floor as compiled code sees it: a grid of depths, bilinear between its nodes."""

import math
from typing import NamedTuple

import numpy as np

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.compiled import kernel


class FloorGrid(NamedTuple):
    """Depths at the nodes of a regular grid; beyond its edges the floor continues level."""

    north_m: float
    """North of the first row."""
    east_m: float
    """East of the first column."""
    spacing_m: float
    depth_m: Array
    """(N, E)."""


def level_floor(depth_m: float) -> FloorGrid:
    """A level sea floor of infinite extent."""
    return FloorGrid(0.0, 0.0, 1.0, np.full((2, 2), depth_m))


@kernel
def floor_depth(floor: FloorGrid, north_m: float, east_m: float) -> float:
    """Depth of the sea floor at a place, metres."""
    rows, columns = floor.depth_m.shape
    y = min(max((north_m - floor.north_m) / floor.spacing_m, 0.0), rows - 1.0)
    x = min(max((east_m - floor.east_m) / floor.spacing_m, 0.0), columns - 1.0)
    i, j = min(int(y), rows - 2), min(int(x), columns - 2)
    b, a = y - i, x - j
    grid = floor.depth_m
    north_side = grid[i, j] + a * (grid[i, j + 1] - grid[i, j])
    south_side = grid[i + 1, j] + a * (grid[i + 1, j + 1] - grid[i + 1, j])
    return float(north_side + b * (south_side - north_side))


@kernel
def floor_range(
    floor: FloorGrid,
    north_m: float,
    east_m: float,
    depth_m: float,
    beam_n: float,
    beam_e: float,
    beam_d: float,
    reach_m: float,
) -> float:
    """Range along a unit beam from a place in the water to the sea floor.

    The beam is walked in steps of the grid's spacing until it is below the floor, and the crossing
    is then found by bisection, so that the first of several crossings is returned.

    Returns:
        Metres, or NaN when the beam does not reach the floor within `reach_m` or begins below it.
    """
    if depth_m >= floor_depth(floor, north_m, east_m):
        return math.nan
    step = max(floor.spacing_m, reach_m / 200.0)
    near = 0.0
    while near < reach_m:
        far = min(near + step, reach_m)
        if depth_m + far * beam_d >= floor_depth(
            floor, north_m + far * beam_n, east_m + far * beam_e
        ):
            for _ in range(20):
                middle = 0.5 * (near + far)
                if depth_m + middle * beam_d >= floor_depth(
                    floor, north_m + middle * beam_n, east_m + middle * beam_e
                ):
                    far = middle
                else:
                    near = middle
            return 0.5 * (near + far)
        near = far
    return math.nan
