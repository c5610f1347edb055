"""What flying a route costs: energy and time of every leg, stops included."""

import numpy as np

from alice_survey.base.frames import Array
from missions.values.costs import Costs
from missions.values.legs import Route

_FULL = 2 * np.pi


def route_cost(route: Route, costs: Costs) -> tuple[float, float]:
    """Energy, J, and time, s, of a route; descent and ascent are not in it."""
    legs_j, legs_s = leg_costs(route, costs)
    return float(legs_j.sum()), float(legs_s.sum())


def leg_costs(route: Route, costs: Costs) -> tuple[Array, Array]:
    """Energy, J, and time, s, of each leg, both (L,).

    The power on an arc is that of each course it passes through.
    """
    if not route.legs:
        return np.empty(0), np.empty(0)
    rows = np.array(
        [
            (
                leg.heading_rad,
                leg.length_m,
                leg.curvature_per_m,
                leg.line,
                leg.turn_rad,
                leg.side_rad,
            )
            for leg in route.legs
        ]
    )
    course, length, curvature, line, turn, side = rows.T
    spot, sway = turn != 0.0, side != 0.0
    seconds = length / np.where(sway, costs.sway_mps, costs.speed_mps)
    seconds = seconds + np.abs(turn) / costs.turn_rate_rad_s
    end_course = course + curvature * length
    power = np.where(
        line >= 0,
        mean_power(costs.line_w, course, end_course),
        mean_power(costs.way_w, course, end_course),
    )
    power = power + np.where((line < 0) & (curvature != 0.0), costs.arc_extra_w, 0.0)
    power = np.where(sway, mean_power(costs.sway_w, course, course), power)
    power = np.where(spot, costs.spot_w, power)
    settle = np.where(spot | sway, costs.settle_s, 0.0)
    moving = np.zeros_like(seconds)
    np.multiply(seconds, power, out=moving, where=seconds > 0.0)
    return moving + settle * costs.spot_w, seconds + settle


def mean_power(power_w: Array, start_rad: Array, end_rad: Array) -> Array:
    """Mean power over courses, (N,); infinite where one that is passed through is.

    Between its samples power changes evenly with the course, so its integral is a parabola's.

    Args:
        power_w: (K,) from north on, evenly over a full turn.
        start_rad: (N,) first courses, any angle.
        end_rad: (N,) last ones; as far from the first as the course turns.
    """
    low, high = np.minimum(start_rad, end_rad), np.maximum(start_rad, end_rad)
    finite = np.isfinite(power_w)
    known = np.where(finite, power_w, 0.0)
    result = _mean(known, low, high)
    if not finite.all():
        result = np.where(_mean(np.where(finite, 0.0, 1.0), low, high) > 0.0, np.inf, result)
    return result


def _mean(power_w: Array, low_rad: Array, high_rad: Array) -> Array:
    per_rad = len(power_w) / _FULL
    low, high = low_rad * per_rad, high_rad * per_rad
    narrow = high - low < 1e-6
    middle = np.where(narrow, (low + high) / 2, 0.0)
    steps = np.where(narrow, 1.0, high - low)
    passed = (_integral(power_w, high) - _integral(power_w, low)) / steps
    return np.where(narrow, _at(power_w, middle), passed)


def _at(power_w: Array, place: Array) -> Array:
    low = np.floor(place)
    index = low.astype(np.intp) % len(power_w)
    following = power_w[(index + 1) % len(power_w)]
    value: Array = power_w[index] + (place - low) * (following - power_w[index])
    return value


def _integral(power_w: Array, place: Array) -> Array:
    """From north to places, both counted in samples."""
    following = np.roll(power_w, -1)
    whole = np.concatenate([[0.0], np.cumsum((power_w + following) / 2)])
    low = np.floor(place)
    turns, index = np.divmod(low.astype(np.intp), len(power_w))
    share = place - low
    part = share * (power_w[index] + share / 2 * (following[index] - power_w[index]))
    value: Array = turns * whole[-1] + whole[index] + part
    return value
