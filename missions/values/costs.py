"""What flying costs, by course: electrical power of the whole vehicle along lines and between."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from alice_survey.base.errors import PlanError
from alice_survey.base.frames import Array
from alice_survey.vehicle.limits import SPOT_RAD_S, STEP_MPS

SETTLE_S = 6.5
"""That a stop takes beside its motion: braking, getting steady, under way again. Measured in the
simulator with exact navigation: ALICE turns by 90 degrees at 15 deg/s in 7.3 s and by 180 in
13.3 s, and braking before and gathering way after cost 6 s more."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Costs:
    """Electrical power by course, and what turns take. Compiled code takes the arrays as they are.

    Along a line the heading is held and a current from the side is met by sway; on the way between
    lines the vehicle may crab.
    """

    speed_mps: float
    """Over ground, on lines and between."""
    line_w: Array
    """(K,) of the whole vehicle (hotel load, lights, thrusters) on a line, at K courses spread
    evenly over a full turn from north; in between it is interpolated."""
    way_w: Array
    """(K,) likewise between lines."""
    spot_w: float
    """While it turns or waits on the spot."""
    arc_extra_w: float
    """What an arc takes beyond `way_w`: the hull behind the glass swings, and the yaw is damped."""
    turn_rate_rad_s: float
    """On the spot."""
    settle_s: float
    """That a stop (turn on the spot, sway step) takes beside its motion."""
    sway_mps: float
    """Speed of a sway step."""
    sway_w: Array
    """(K,) likewise of a sway step, by its course; infinite of a vehicle that cannot sway."""
    heave_mps: float
    """Of descent and ascent, on the spot."""
    heave_w: float
    """Mean of both."""
    refused: Callable[[str], PlanError] | None = field(default=None, compare=False, repr=False)
    """The error that says, of a leg in words, that the current forbids it, with the ways out."""

    def line_j(self, length_m: float, course_rad: float) -> float:
        """Energy of a straight line."""
        return length_m / self.speed_mps * power_at(self.line_w, course_rad)

    def way_j(self, length_m: float, course_rad: float) -> float:
        """Energy of a straight way between lines."""
        return length_m / self.speed_mps * power_at(self.way_w, course_rad)

    def spot_j(self, turn_rad: float) -> float:
        """Energy of a turn on the spot, with its stop."""
        return self.spot_w * (abs(turn_rad) / self.turn_rate_rad_s + self.settle_s)

    def sway_j(self, length_m: float, course_rad: float) -> float:
        """Energy of a sway step, with its stop."""
        moving = length_m / self.sway_mps * power_at(self.sway_w, course_rad)
        return moving + self.spot_w * self.settle_s

    def dive_j(self, depth_m: float) -> float:
        """Energy of going down to a depth and up again."""
        return self.dive_s(depth_m) * self.heave_w

    def dive_s(self, depth_m: float) -> float:
        """Time of going down to a depth and up again."""
        return 2.0 * depth_m / self.heave_mps


def time_costs(
    speed_mps: float,
    *,
    turn_rate_rad_s: float = SPOT_RAD_S,
    settle_s: float = SETTLE_S,
    sway_mps: float = STEP_MPS,
    heave_mps: float = 0.15,
) -> Costs:
    """Costs of 1 W whatever the vehicle does: joules are seconds."""
    return Costs(
        speed_mps=speed_mps,
        line_w=np.ones(4),
        way_w=np.ones(4),
        spot_w=1.0,
        arc_extra_w=0.0,
        turn_rate_rad_s=turn_rate_rad_s,
        settle_s=settle_s,
        sway_mps=sway_mps,
        sway_w=np.ones(4),
        heave_mps=heave_mps,
        heave_w=1.0,
    )


def power_at(power_w: Array, course_rad: float) -> float:
    """Power at a course, between the even samples of a full turn; infinite beside an infinite one.

    Args:
        power_w: (K,) from north on.
        course_rad: any angle.
    """
    place = course_rad / (2 * np.pi) * len(power_w) % len(power_w)
    low = int(place) % len(power_w)
    share = place - int(place)
    if share == 0.0:  # nothing of the next one, though it may be infinite
        return float(power_w[low])
    return float((1 - share) * power_w[low] + share * power_w[(low + 1) % len(power_w)])
