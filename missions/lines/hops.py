"""What lines and the hops between them cost when their order is chosen.

A hop goes from the end of a line to the start of the next by the shortest way inside the allowed
area. It is priced as a turn on the spot towards the next start, the way, and a turn onto the next
line; or, where it is short and direct, as a step sideways and one turn; whichever is less. The
course of a way round corners counts as that of its straight. The route itself, with arcs where they
are cheaper, is made later by `missions.route.turns`: this price only orders lines.
"""

import math

import numpy as np

from alice_survey.base.compiled import compiled
from alice_survey.base.frames import Array
from missions.route.joins import LONGEST_SWAY_M
from missions.values.costs import Costs, Prices, prices

NOWHERE_J = 1e15
"""More than any battery holds: stands for what cannot be flown, so that the rest can still be
compared."""
_SAME_M = 1e-6
_SAME_RAD = 1e-6


def comparable_prices(costs: Costs) -> Prices:
    """Prices of which nothing is infinite, so that totals with impossible hops compare."""
    return prices(costs, NOWHERE_J)


@compiled
def power_at(power_w: Array, course_rad: float) -> float:
    """Power at a course, between the even samples of a full turn from north."""
    count = power_w.size
    place = course_rad / (2 * math.pi) * count
    low = math.floor(place)
    first = int(low) % count
    share = place - low
    power: float = (1 - share) * power_w[first] + share * power_w[(first + 1) % count]
    return power


@compiled
def line_j(prices: Prices, length_m: float, course_rad: float) -> float:
    """Energy of a straight line, J."""
    energy: float = length_m / prices.speed_mps * power_at(prices.line_w, course_rad)
    return energy


@compiled
def _spot_j(prices: Prices, turn_rad: float) -> float:
    """Energy of a turn on the spot, with its stop; 0 without a turn."""
    turn = abs((turn_rad + math.pi) % (2 * math.pi) - math.pi)
    if turn < _SAME_RAD:
        return 0.0
    energy: float = prices.spot_w * (turn / prices.turn_rate_rad_s + prices.settle_s)
    return energy


@compiled
def hop_j(
    prices: Prices,
    north_0: float,
    east_0: float,
    course_0: float,
    north_1: float,
    east_1: float,
    course_1: float,
    way_m: float,
) -> float:
    """Energy of a hop, J.

    Args:
        prices: of the vehicle.
        north_0: where it begins.
        east_0: where it begins.
        course_0: of the line before; NaN at home, where any will do.
        north_1: where it ends.
        east_1: where it ends.
        course_1: of the line after; NaN at home.
        way_m: length of the shortest way inside the allowed area; inf where there is none.
    """
    if way_m == np.inf:
        return NOWHERE_J
    straight_m = math.hypot(north_1 - north_0, east_1 - east_0)
    between = math.isfinite(course_0) and math.isfinite(course_1)
    if straight_m < _SAME_M:
        return _spot_j(prices, course_1 - course_0) if between else 0.0
    bearing = math.atan2(east_1 - east_0, north_1 - north_0)
    energy = way_m / prices.speed_mps * power_at(prices.way_w, bearing)
    if math.isfinite(course_0):
        energy += _spot_j(prices, bearing - course_0)
    if math.isfinite(course_1):
        energy += _spot_j(prices, course_1 - bearing)
    if between and straight_m <= LONGEST_SWAY_M and way_m < straight_m + _SAME_M:
        aside = straight_m / prices.sway_mps * power_at(prices.sway_w, bearing)
        aside += prices.spot_w * prices.settle_s + _spot_j(prices, course_1 - course_0)
        energy = min(energy, aside)
    total: float = energy
    return total


@compiled
def hops_j(prices: Prices, leave: Array, enter: Array, ways_m: Array) -> Array:
    """Energies of all hops from some ends to some starts.

    Args:
        prices: of the vehicle.
        leave: (N, 3) north, east, course at the ends of lines; NaN at home.
        enter: (M, 3) the same at the starts.
        ways_m: (N, M) lengths of the ways.

    Returns:
        (N, M) joules.
    """
    energies = np.empty((leave.shape[0], enter.shape[0]))
    for i in range(leave.shape[0]):
        for j in range(enter.shape[0]):
            energies[i, j] = hop_j(
                prices,
                leave[i, 0],
                leave[i, 1],
                leave[i, 2],
                enter[j, 0],
                enter[j, 1],
                enter[j, 2],
                ways_m[i, j],
            )
    return energies


@compiled
def chain_j(prices: Prices, leave: Array, enter: Array, ways_m: Array) -> Array:
    """Energies of single hops, (N,) joules; arguments (N, 3), (N, 3) and (N,), as of `hops_j`."""
    energies = np.empty(leave.shape[0])
    for i in range(leave.shape[0]):
        energies[i] = hop_j(
            prices,
            leave[i, 0],
            leave[i, 1],
            leave[i, 2],
            enter[i, 0],
            enter[i, 1],
            enter[i, 2],
            ways_m[i],
        )
    return energies


@compiled
def flight_parts_j(prices: Prices, home: Array, lines: Array, ways_m: Array) -> Array:
    """Energy of flying lines in order, from home and home again.

    Args:
        prices: of the vehicle.
        home: (2,) north and east.
        lines: (L, 5) north and east of start and end, course.
        ways_m: (L + 1,) lengths of the ways before, between and after them.

    Returns:
        (2,) joules of all lines, and of all hops.
    """
    energies = np.zeros(2)
    count = lines.shape[0]
    for i in range(count + 1):
        north_0, east_0, course_0 = home[0], home[1], np.nan
        if i > 0:
            north_0, east_0, course_0 = lines[i - 1, 2], lines[i - 1, 3], lines[i - 1, 4]
        north_1, east_1, course_1 = home[0], home[1], np.nan
        if i < count:
            north_1, east_1, course_1 = lines[i, 0], lines[i, 1], lines[i, 4]
            length_m = math.hypot(lines[i, 2] - lines[i, 0], lines[i, 3] - lines[i, 1])
            energies[0] += line_j(prices, length_m, lines[i, 4])
        energies[1] += hop_j(
            prices, north_0, east_0, course_0, north_1, east_1, course_1, ways_m[i]
        )
    return energies
