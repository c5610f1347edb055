"""The water the vehicle moves through: currents that vary with depth and time, and disturbances."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array
from alice_survey.core.trajectory import read_columns
from alice_survey.sim.vehicle.compiled import kernel

_COLUMNS = ("time_s", "depth_m", "north_mps", "east_mps")


class Current(NamedTuple):
    """A horizontal current on a grid of times and depths, linear between, constant beyond."""

    time_s: Array
    """(T,) increasing."""
    depth_m: Array
    """(Z,) increasing."""
    velocity_ne_mps: Array
    """(T, Z, 2) towards north and east."""


def constant_current(speed_mps: float, towards_deg: float) -> Current:
    """The same current everywhere, always; the direction is the one it flows towards."""
    return sheared_current(np.zeros(1), np.array([[speed_mps, towards_deg]]))


def sheared_current(depth_m: Array, speed_mps_towards_deg: Array) -> Current:
    """A steady current that varies with depth.

    Args:
        depth_m: (Z,) increasing.
        speed_mps_towards_deg: (Z, 2) speed and direction it flows towards.
    """
    speed, towards = speed_mps_towards_deg[:, 0], np.deg2rad(speed_mps_towards_deg[:, 1])
    velocity: Array = np.stack([speed * np.cos(towards), speed * np.sin(towards)], axis=1)
    return checked_current(Current(np.zeros(1), np.asarray(depth_m, np.float64), velocity[None]))


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
    draws = rng.standard_normal((len(time_s), 2))
    process = np.empty_like(draws)
    process[0] = draws[0]
    for i in range(1, len(time_s)):
        process[i] = decay * process[i - 1] + math.sqrt(1 - decay**2) * draws[i]
    velocity = mean.velocity_ne_mps + sigma_mps * process[:, None, :]
    return checked_current(Current(time_s, mean.depth_m, np.array(velocity, dtype=np.float64)))


def read_current(path: Path) -> Current:
    """Read a measured current: CSV with `time_s, depth_m, north_mps, east_mps`, in any order.

    Each depth must be there at each time (an ADCP's bins); one depth, or one time, is enough.

    Raises:
        NavigationError: the file is missing, lacks a column or holds a value that is not a number.
        VehicleError: a depth is missing at a time, or is there twice.
    """
    columns = read_columns(path, _COLUMNS)
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
    return checked_current(Current(times, depths, grid))


def checked_current(current: Current) -> Current:
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
def _bracket(axis: Array, value: float) -> tuple[int, float]:
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
    i, a = _bracket(current.time_s, time_s)
    j, b = _bracket(current.depth_m, depth_m)
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
