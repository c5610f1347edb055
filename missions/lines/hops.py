"""What lines and the hops between them cost when their order is chosen.

A hop goes from the end of a line to the start of the next by the shortest way inside the allowed
area. It is priced as a turn on the spot towards the next start, the way, and a turn onto the next
line; or, where it is short and direct, as a step sideways and one turn; whichever is less. The
course of a way round corners counts as that of its straight. The route itself, with arcs where they
are cheaper, is made later by `missions.route.turns`: this price only orders lines.
"""

import math

import numpy as np

from alice_survey.core.frames import Array
from missions.route.turns import MAX_SWAY_M
from missions.values.costs import Costs, power_at

NOWHERE_J = 1e15
"""More than any battery holds: stands for what cannot be flown, so that the rest can still be
compared."""
_SAME_M = 1e-6
_SAME_RAD = 1e-6


def comparable(costs: Costs) -> Costs:
    """Costs of which nothing is infinite, so that totals with impossible hops compare."""
    return costs.compilable(NOWHERE_J)


def line_j(costs: Costs, length_m: Array | float, course_rad: Array | float) -> Array:
    """Energy of straight lines, J."""
    return length_m / costs.speed_mps * power_at(costs.line_w, course_rad)


def _stop_j(costs: Costs, turn_rad: Array) -> Array:
    """Energy of turns on the spot, with their stop; 0 without a turn or where a course is free."""
    turn = np.abs(turn_rad - 2 * math.pi * np.round(turn_rad / (2 * math.pi)))
    joules = costs.stop_w * (turn / costs.turn_rate_rad_s + costs.settle_s)
    return np.where(turn >= _SAME_RAD, joules, 0.0)


def hop_j(costs: Costs, leave: Array, enter: Array, ways_m: Array) -> Array:
    """Energy of hops, J.

    Args:
        costs: of the vehicle.
        leave: (..., 3) north, east and course at the end of the line before; the course is NaN at
            home, where any will do.
        enter: (..., 3) the same at the start of the line after.
        ways_m: (...) length of the shortest way inside the allowed area; inf where there is none.
    """
    north, east = enter[..., 0] - leave[..., 0], enter[..., 1] - leave[..., 1]
    straight_m, bearing = np.hypot(north, east), np.arctan2(east, north)
    turn_j = _stop_j(costs, enter[..., 2] - leave[..., 2])
    energy = ways_m / costs.speed_mps * power_at(costs.way_w, bearing)
    energy += _stop_j(costs, bearing - leave[..., 2])
    energy += _stop_j(costs, enter[..., 2] - bearing)
    near = np.isfinite(leave[..., 2] + enter[..., 2])
    near &= (straight_m <= MAX_SWAY_M) & (ways_m < straight_m + _SAME_M)
    aside = straight_m[near] / costs.sway_mps * power_at(costs.sway_w, bearing[near])
    aside = aside + costs.stop_w * costs.settle_s + turn_j[near]
    energy[near] = np.minimum(energy[near], aside)
    energy = np.where(straight_m < _SAME_M, turn_j, energy)
    return np.where(np.isinf(ways_m), NOWHERE_J, energy)


def flight_j(costs: Costs, leave: Array, enter: Array, ways_m: Array) -> float:
    """Energy of flying lines in order, from home and home again, J.

    Args:
        costs: of the vehicle.
        leave: (L + 1, 3) north, east and course at home and at the end of each line.
        enter: (L + 1, 3) the same at the start of each line and at home.
        ways_m: (L + 1,) lengths of the ways before, between and after them.
    """
    lengths_m = np.hypot(*(leave[1:] - enter[:-1])[:, :2].T)
    lines = line_j(costs, lengths_m, leave[1:, 2]).sum()
    return float(lines + hop_j(costs, leave, enter, ways_m).sum())
