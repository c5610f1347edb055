"""The water and the sea floor: currents, swell, disturbances, and a grid of depths.

Swell are linear waves over a level sea floor (R. G. Dean and R. A. Dalrymple, Water Wave Mechanics,
1991, section 3.4): omega^2 = g k tanh(k h), and horizontally
u(z, t) = (pi H / T) cosh(k (h - z)) / sinh(k h) cos(omega t). The vehicle is much shorter than the
waves and stays where it is compared with them, so that all of it meets one phase. The vertical
motion, small near the floor, is left out.
"""

import itertools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from alice_survey.core.compiled import kernel
from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array
from alice_survey.core.trajectory import read_columns

GRAVITY = 9.80665
"""m/s^2."""
_COLUMNS = ("time_s", "depth_m", "north_mps", "east_mps")


class Current(NamedTuple):
    """A horizontal current on a grid of times and depths, linear between, constant beyond."""

    time_s: Array
    """(T,) increasing."""
    depth_m: Array
    """(Z,) increasing."""
    velocity_ne_mps: Array
    """(T, Z, 2) towards north and east."""


def sheared_current(depth_m: Array, speed_mps_towards_deg: Array) -> Current:
    """A steady current that varies with depth.

    Args:
        depth_m: (Z,) increasing.
        speed_mps_towards_deg: (Z, 2) speed and direction it flows towards.
    """
    speed, towards = speed_mps_towards_deg[:, 0], np.deg2rad(speed_mps_towards_deg[:, 1])
    velocity: Array = np.stack([speed * np.cos(towards), speed * np.sin(towards)], axis=1)
    return check_current(Current(np.zeros(1), np.asarray(depth_m, np.float64), velocity[None]))


def varying_current(
    mean: Current,
    sigma_mps: float,
    correlation_s: float,
    duration_s: float,
    rng: np.random.Generator,
) -> Current:
    """A steady current to which a slow Gauss-Markov process, the same at all depths, is added.

    Args:
        mean: with one time.
        sigma_mps: standard deviation of north and of east.
        correlation_s: lag at which the correlation has fallen to 1 / e.
        duration_s: duration.
        rng: source of the process.
    """
    step_s = correlation_s / 10.0
    time_s: Array = step_s * np.arange(math.ceil(duration_s / step_s) + 2, dtype=np.float64)
    decay = math.exp(-step_s / correlation_s)
    process = rng.standard_normal((len(time_s), 2))
    process[1:] *= math.sqrt(1 - decay**2)
    for before, now in itertools.pairwise(process):  # a few hundred; scipy.signal loads for longer
        now += decay * before
    velocity = mean.velocity_ne_mps + sigma_mps * process[:, None, :]
    return check_current(Current(time_s, mean.depth_m, np.array(velocity, dtype=np.float64)))


def read_current(path: Path) -> Current:
    """Read a measured current: CSV with `time_s, depth_m, north_mps, east_mps`, in any order.

    Each depth must be there at each time (an ADCP's bins); one depth, or one time, is enough.

    Raises:
        NavigationError: the file is missing, lacks a column or holds a value that is not a number.
        VehicleError: a depth is missing at a time, or is there twice.
    """
    columns = read_columns(path, _COLUMNS, known=_COLUMNS)
    if not len(columns["time_s"]):
        raise VehicleError(f"{path}: has no rows")
    times, row = np.unique(columns["time_s"], return_inverse=True)
    depths, column = np.unique(columns["depth_m"], return_inverse=True)
    grid = np.full((len(times), len(depths), 2), np.nan)
    grid[row, column] = np.column_stack([columns["north_mps"], columns["east_mps"]])
    if len(row) != len(times) * len(depths) or np.isnan(grid).any():
        raise VehicleError(
            f"{path}: {len(row)} rows for {len(times)} times and {len(depths)} depths; give each "
            "depth once at each time"
        )
    return check_current(Current(times, depths, grid))


def check_current(current: Current) -> Current:
    """The current, if it is valid.

    Raises:
        VehicleError: times or depths do not increase, or a value is not finite, or there are
            not as many values as times and depths.
    """
    for name, axis in (("times", current.time_s), ("depths", current.depth_m)):
        if not len(axis) or not np.all(np.isfinite(axis)) or np.any(np.diff(axis) <= 0):
            raise VehicleError(f"the {name} of a current must increase")
    shape = (len(current.time_s), len(current.depth_m), 2)
    if current.velocity_ne_mps.shape != shape:
        raise VehicleError(
            f"a current has values of shape {current.velocity_ne_mps.shape}; its times and depths "
            f"ask for {shape}"
        )
    if not np.all(np.isfinite(current.velocity_ne_mps)):
        raise VehicleError("a current holds a value that is not a finite number")
    return current


@dataclass(frozen=True, kw_only=True)
class Disturbance:
    """Random forces and moments on the body: first-order Gauss-Markov processes."""

    sigma: tuple[float, float, float, float, float, float] = (0.0,) * 6
    """Sigmas of X, Y, Z in N and of K, M, N in N m."""
    correlation_s: float = 2.0


@kernel
def bracket(axis: Array, value: float) -> tuple[int, float]:
    """The cell of an axis that holds a value, and how far into it; (0, 0) on a single point."""
    last = axis.shape[0] - 1
    if last == 0 or value <= axis[0]:
        return 0, 0.0
    if value >= axis[last]:
        return last - 1, 1.0
    low, high = 0, last
    while high - low > 1:
        middle = (low + high) // 2
        if axis[middle] <= value:
            low = middle
        else:
            high = middle
    return low, (value - axis[low]) / (axis[low + 1] - axis[low])


@kernel
def current_at(current: Current, time_s: float, depth_m: float, out: Array) -> None:
    """The current and its slopes.

    Args:
        current: the field.
        time_s: time.
        depth_m: depth.
        out: (6,) north and east velocity, their rates by time, and their slopes by depth.
    """
    i, a = bracket(current.time_s, time_s)
    j, b = bracket(current.depth_m, depth_m)
    grid = current.velocity_ne_mps
    i1, j1 = min(i + 1, grid.shape[0] - 1), min(j + 1, grid.shape[1] - 1)
    # No slope beyond the ends, where the current is constant.
    within_t = i1 > i and current.time_s[i] <= time_s < current.time_s[i1]
    within_z = j1 > j and current.depth_m[j] <= depth_m < current.depth_m[j1]
    for axis in range(2):
        v00, v01 = grid[i, j, axis], grid[i, j1, axis]
        v10, v11 = grid[i1, j, axis], grid[i1, j1, axis]
        early, late = v00 + b * (v01 - v00), v10 + b * (v11 - v10)
        out[axis] = early + a * (late - early)
        out[2 + axis] = (
            (late - early) / (current.time_s[i1] - current.time_s[i]) if within_t else 0.0
        )
        shallow, deep = v00 + a * (v10 - v00), v01 + a * (v11 - v01)
        out[4 + axis] = (
            (deep - shallow) / (current.depth_m[j1] - current.depth_m[j]) if within_z else 0.0
        )


_PER_PERIOD = 24
"""Samples per period: linear pieces between are within 1 % of the wave."""
_LAYERS = 16


def wave_number(period_s: float, depth_m: float) -> float:
    """Wave number of waves of a period over a depth, rad/m."""
    from scipy.optimize import brentq

    # In deep water k h is this number; in shallow water its root: the root lies between.
    deep = (2.0 * math.pi / period_s) ** 2 * depth_m / GRAVITY
    low, high = 0.5 * min(deep, math.sqrt(deep)), 2.0 * max(deep, math.sqrt(deep))
    return float(brentq(lambda kh: kh * math.tanh(kh) - deep, low, high, xtol=1e-14)) / depth_m


def orbital_speed_mps(
    height_m: float, period_s: float, depth_m: float, below_m: Array | float
) -> Array:
    """Amplitude of the horizontal speed at depths (...) below the surface.

    Args:
        height_m: height of the waves, trough to crest.
        period_s: period of the waves.
        depth_m: depth of the sea floor.
        below_m: (...) depths of the points.
    """
    k = wave_number(period_s, depth_m)
    share = np.cosh(k * (depth_m - np.asarray(below_m))) / math.sinh(k * depth_m)
    return np.asarray(math.pi * height_m / period_s * share)


def with_swell(
    current: Current,
    height_m: float,
    period_s: float,
    towards_deg: float,
    depth_m: float,
    duration_s: float,
) -> Current:
    """A current to which regular waves are added.

    Args:
        current: without waves.
        height_m: trough to crest.
        period_s: period of the waves.
        towards_deg: where they travel.
        depth_m: depth of the sea floor.
        duration_s: how long the waves last.

    Raises:
        VehicleError: a number is invalid.
    """
    if not (height_m >= 0 and period_s > 0 and depth_m > 0):
        raise VehicleError(
            f"swell of {height_m:g} m and {period_s:g} s over {depth_m:g} m: give a height of 0 or "
            "more, and a period and a depth above 0"
        )
    step_s = period_s / _PER_PERIOD
    time_s = np.union1d(
        step_s * np.arange(math.ceil(duration_s / step_s) + 1, dtype=np.float64), current.time_s
    )
    layers = np.union1d(np.linspace(0.0, depth_m, _LAYERS), current.depth_m)
    before = _resample(current, time_s, layers)
    speed = orbital_speed_mps(height_m, period_s, depth_m, np.clip(layers, 0.0, depth_m))
    phase = np.cos(2.0 * math.pi / period_s * time_s)
    towards = math.radians(towards_deg)
    way = np.array([math.cos(towards), math.sin(towards)])
    waves = phase[:, None, None] * speed[None, :, None] * way
    velocity: Array = np.ascontiguousarray(before + waves)
    return check_current(Current(time_s, layers, velocity))


def _resample(current: Current, time_s: Array, depth_m: Array) -> Array:
    """(T, Z, 2) the current at other times and depths; constant beyond its own."""
    at_depths = np.stack(
        [
            [np.interp(depth_m, current.depth_m, row[:, axis]) for row in current.velocity_ne_mps]
            for axis in (0, 1)
        ],
        axis=-1,
    )
    flat = at_depths.reshape(len(current.time_s), -1)
    columns = [np.interp(time_s, current.time_s, column) for column in flat.T]
    return np.stack(columns, axis=1).reshape(len(time_s), len(depth_m), 2)


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
