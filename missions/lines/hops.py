"""What lines and the hops between them cost when their order is chosen.

A hop goes from the end of a line to the start of the next by the shortest way inside the allowed
area. It is priced as a turn on the spot towards the next start, the way, and a turn onto the next
line; or, where it is short and direct, as a step sideways and one turn; whichever is less. The
course of a way round corners counts as that of its straight. The route itself, with arcs where they
are cheaper, is made later by `missions.route.turns`: this price only orders lines.
"""

import math

import numpy as np

from alice_survey.core.compiled import compiled
from alice_survey.core.frames import Array
from missions.route.joins import MAX_SWAY_M
from missions.values.costs import Costs, power_at

NOWHERE_J = 1e15
"""More than any battery holds: stands for what cannot be flown, so that the rest can still be
compared."""
_SAME_M = 1e-6
_SAME_RAD = 1e-6


def comparable(costs: Costs) -> Costs:
    """Costs of which nothing is infinite, so that totals with impossible hops compare."""
    return costs.compilable(NOWHERE_J)


@compiled
def line_j(costs: Costs, length_m: float, course_rad: float) -> float:
    """Energy of a straight line, J."""
    energy: float = length_m / costs.speed_mps * power_at(costs.line_w, course_rad)
    return energy


@compiled
def _spot_j(costs: Costs, turn_rad: float) -> float:
    """Energy of a turn on the spot, with its stop; 0 without a turn."""
    turn = abs((turn_rad + math.pi) % (2 * math.pi) - math.pi)
    if turn < _SAME_RAD:
        return 0.0
    energy: float = costs.stop_w * (turn / costs.turn_rate_rad_s + costs.settle_s)
    return energy


@compiled
def hop_j(costs: Costs, leave: Array, enter: Array, way_m: float) -> float:
    """Energy of a hop, J.

    Args:
        costs: of the vehicle.
        leave: (3,) north, east and course at the end of the line before; the course is NaN at home,
            where any will do.
        enter: (3,) the same at the start of the line after.
        way_m: length of the shortest way inside the allowed area; inf where there is none.
    """
    if way_m == np.inf:
        return NOWHERE_J
    straight_m = math.hypot(enter[0] - leave[0], enter[1] - leave[1])
    between = math.isfinite(leave[2]) and math.isfinite(enter[2])
    if straight_m < _SAME_M:
        return _spot_j(costs, enter[2] - leave[2]) if between else 0.0
    bearing = math.atan2(enter[1] - leave[1], enter[0] - leave[0])
    energy = way_m / costs.speed_mps * power_at(costs.way_w, bearing)
    if math.isfinite(leave[2]):
        energy += _spot_j(costs, bearing - leave[2])
    if math.isfinite(enter[2]):
        energy += _spot_j(costs, enter[2] - bearing)
    if between and straight_m <= MAX_SWAY_M and way_m < straight_m + _SAME_M:
        aside = straight_m / costs.sway_mps * power_at(costs.sway_w, bearing)
        aside += costs.stop_w * costs.settle_s + _spot_j(costs, enter[2] - leave[2])
        energy = min(energy, aside)
    total: float = energy
    return total


@compiled
def hops_j(costs: Costs, leave: Array, enter: Array, ways_m: Array) -> Array:
    """Energies of all hops from some ends to some starts.

    Args:
        costs: of the vehicle.
        leave: (N, 3) north, east, course at the ends of lines; NaN at home.
        enter: (M, 3) the same at the starts.
        ways_m: (N, M) lengths of the ways.

    Returns:
        (N, M) joules.
    """
    energies = np.empty((leave.shape[0], enter.shape[0]))
    for i in range(leave.shape[0]):
        for j in range(enter.shape[0]):
            energies[i, j] = hop_j(costs, leave[i], enter[j], ways_m[i, j])
    return energies


@compiled
def chain_j(costs: Costs, leave: Array, enter: Array, ways_m: Array) -> Array:
    """Energies of single hops, (N,) joules; arguments (N, 3), (N, 3) and (N,), as of `hops_j`."""
    energies = np.empty(leave.shape[0])
    for i in range(leave.shape[0]):
        energies[i] = hop_j(costs, leave[i], enter[i], ways_m[i])
    return energies


@compiled
def flight_j(costs: Costs, leave: Array, enter: Array, ways_m: Array) -> float:
    """Energy of flying lines in order, from home and home again, J.

    Args:
        costs: of the vehicle.
        leave: (L + 1, 3) north, east and course at home and at the end of each line.
        enter: (L + 1, 3) the same at the start of each line and at home.
        ways_m: (L + 1,) lengths of the ways before, between and after them.
    """
    lines = hops = 0.0
    for i in range(ways_m.size):
        hops += hop_j(costs, leave[i], enter[i], ways_m[i])
        if i > 0:
            north, east = enter[i - 1, 0], enter[i - 1, 1]
            length_m = math.hypot(leave[i, 0] - north, leave[i, 1] - east)
            lines += line_j(costs, length_m, leave[i, 2])
    return lines + hops
