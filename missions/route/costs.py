"""What flying costs, by course: electrical power of the whole vehicle along lines and between."""

from dataclasses import dataclass

import numpy as np

from alice_survey.frames import Array


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
    turn_rate_rad_s: float
    """On the spot."""
    settle_s: float
    """That a stop (turn on the spot, sway step) takes beside its motion."""
    sway_mps: float
    """Speed of a sway step."""

    def line_j(self, length_m: float, course_rad: float) -> float:
        """Energy of a straight line."""
        return length_m / self.speed_mps * _at(self.line_w, course_rad)

    def way_j(self, length_m: float, course_rad: float) -> float:
        """Energy of a straight way between lines."""
        return length_m / self.speed_mps * _at(self.way_w, course_rad)

    def spot_j(self, turn_rad: float) -> float:
        """Energy of a turn on the spot, with its stop."""
        return self.spot_w * (abs(turn_rad) / self.turn_rate_rad_s + self.settle_s)


def time_costs(
    speed_mps: float,
    *,
    turn_rate_rad_s: float = np.deg2rad(15.0),
    settle_s: float = 4.0,
    sway_mps: float = 0.15,
) -> Costs:
    """Costs of 1 W whatever the vehicle does: joules are seconds."""
    return Costs(
        speed_mps=speed_mps,
        line_w=np.ones(4),
        way_w=np.ones(4),
        spot_w=1.0,
        turn_rate_rad_s=turn_rate_rad_s,
        settle_s=settle_s,
        sway_mps=sway_mps,
    )


def _at(power_w: Array, course_rad: float) -> float:
    """Power at a course, between the even samples of a full turn."""
    place = course_rad / (2 * np.pi) * len(power_w) % len(power_w)
    low = int(place) % len(power_w)
    share = place - int(place)
    return float((1 - share) * power_w[low] + share * power_w[(low + 1) % len(power_w)])
