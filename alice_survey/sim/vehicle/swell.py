"""Swell: motion of the water by surface waves.

Linear waves over a level sea floor (R. G. Dean and R. A. Dalrymple, Water Wave Mechanics, 1991,
section 3.4): omega^2 = g k tanh(k h), and horizontally
u(z, t) = (pi H / T) cosh(k (h - z)) / sinh(k h) cos(omega t). The vehicle is much shorter than the
waves and stays where it is compared with them, so that all of it meets one phase. The vertical
motion, small near the floor, is left out.
"""

import math

import numpy as np

from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.dynamics import GRAVITY
from alice_survey.sim.vehicle.sea import Current, checked_current

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
    before = _resampled(current, time_s, layers)
    speed = orbital_speed_mps(height_m, period_s, depth_m, np.clip(layers, 0.0, depth_m))
    phase = np.cos(2.0 * math.pi / period_s * time_s)
    towards = math.radians(towards_deg)
    way = np.array([math.cos(towards), math.sin(towards)])
    waves = phase[:, None, None] * speed[None, :, None] * way
    velocity: Array = np.ascontiguousarray(before + waves)
    return checked_current(Current(time_s, layers, velocity))


def _resampled(current: Current, time_s: Array, depth_m: Array) -> Array:
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
