"""What flying costs, by course: electrical power of the whole vehicle along lines and between."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from alice_survey.core.errors import PlanError
from alice_survey.core.frames import Array
from missions.values.legs import Route

SETTLE_S = 6.5
"""Time that a stop takes besides its motion: braking, steadying, getting under way again. Measured
in the simulator with exact navigation: ALICE turns by 90 degrees at 15 deg/s in 7.3 s and by 180 in
13.3 s, and braking before and gathering way after cost 6 s more."""


class Costs(NamedTuple):
    """Electrical power by course, and what turns take.

    Along a line the heading is held and a current from the side is met by sway; on the way between
    lines the vehicle may crab.
    """

    speed_mps: float
    """Speed over ground, on lines and between."""
    line_w: Array
    """(K,) power of the whole vehicle (hotel load, lights, thrusters) on a line, at K courses
    spread evenly over a full turn from north; in between it is interpolated."""
    way_w: Array
    """(K,) the same power between lines."""
    stop_w: float
    """Power while it turns or waits on the spot."""
    arc_extra_w: float
    """What an arc takes beyond `way_w`: the hull behind the glass swings, and the yaw is damped."""
    turn_rate_rad_s: float
    """Rate of turns on the spot."""
    settle_s: float
    """Time that a stop (turn on the spot, sway step) takes besides its motion."""
    sway_mps: float
    """Speed of a sway step."""
    sway_w: Array
    """(K,) the same power of a sway step, by its course; infinite of a vehicle that cannot sway."""
    heave_mps: float
    """Speed of descent and ascent, on the spot."""
    heave_w: float
    """Mean power of both."""
    refused: Callable[[str], PlanError] | None = None
    """The error that says, of a leg in words, that the current forbids it, with the ways out."""

    def compilable(self, max_w: float = math.inf) -> "Costs":
        """The costs with bounded powers.

        Args:
            max_w: powers by course are no higher; finite where totals have to be compared.
        """
        bounded = {
            name: np.minimum(getattr(self, name), max_w) for name in ("line_w", "way_w", "sway_w")
        }
        return self._replace(**bounded, refused=None)

    def dive_j(self, depth_m: float) -> float:
        """Energy of going down to a depth and up again."""
        return self.dive_s(depth_m) * self.heave_w

    def dive_s(self, depth_m: float) -> float:
        """Time of going down to a depth and up again."""
        return 2.0 * depth_m / self.heave_mps


def power_at(power_w: Array, course_rad: Array | float) -> Array:
    """Power at courses, between the even samples of a full turn.

    Args:
        power_w: (K,) from north on.
        course_rad: any angles.

    Returns:
        As many powers; infinite next to an infinite one.
    """
    place = np.asarray(course_rad) / (2.0 * math.pi) * len(power_w)
    finite = np.isfinite(power_w)
    if finite.all():
        return _at(power_w, place)
    # On a sample nothing of the next one counts, though it may be infinite.
    power = _at(np.where(finite, power_w, 0.0), place)
    return np.where(_at(np.where(finite, 0.0, 1.0), place) > 0.0, np.inf, power)


def leg_costs(route: Route, costs: Costs) -> tuple[Array, Array]:
    """Energy, J, and time, s, of each leg, both (L,).

    The power on an arc is that of each course it passes through.
    """
    names = ("heading_rad", "length_m", "curvature_per_m", "line", "turn_rad", "side_rad")
    rows = [[getattr(leg, name) for name in names] for leg in route.legs]
    return leg_row_costs(np.array(rows, dtype=np.float64).reshape(-1, 6), costs)


def leg_row_costs(rows: Array, costs: Costs) -> tuple[Array, Array]:
    """The same of (L, 6) course, length, curvature, line or -1, turn and side of each leg."""
    if not len(rows):
        return np.empty(0), np.empty(0)
    course, length, curvature, line, turn, side = rows.T
    stands, sways = turn != 0.0, side != 0.0
    seconds = length / np.where(sways, costs.sway_mps, costs.speed_mps)
    seconds = seconds + np.abs(turn) / costs.turn_rate_rad_s
    end_course = course + curvature * length
    power = np.where(
        line >= 0,
        mean_power(costs.line_w, course, end_course),
        mean_power(costs.way_w, course, end_course),
    )
    power = power + np.where((line < 0) & (curvature != 0.0), costs.arc_extra_w, 0.0)
    power = np.where(sways, mean_power(costs.sway_w, course, course), power)
    power = np.where(stands, costs.stop_w, power)
    settle = np.where(stands | sways, costs.settle_s, 0.0)
    moving = np.zeros_like(seconds)
    np.multiply(seconds, power, out=moving, where=seconds > 0.0)
    return moving + settle * costs.stop_w, seconds + settle


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
    per_rad = len(power_w) / (2 * np.pi)
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
    return power_w[index] + (place - low) * (following - power_w[index])


def _integral(power_w: Array, place: Array) -> Array:
    """Integral from north to places, both counted in samples."""
    following = np.roll(power_w, -1)
    whole = np.concatenate([[0.0], np.cumsum((power_w + following) / 2)])
    low = np.floor(place)
    turns, index = np.divmod(low.astype(np.intp), len(power_w))
    share = place - low
    part = share * (power_w[index] + share / 2 * (following[index] - power_w[index]))
    return np.asarray(turns * whole[-1] + whole[index] + part)
