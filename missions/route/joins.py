"""From one line to the next: arcs, a turn on the spot, or a step sideways, whichever costs least.

Compiled, for plans of many thousand lines. All that is tried here is direct: a way round corners of
the allowed area is for the caller (`turns.legs_through`).
"""

import math

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.compiled import compiled_ieee
from alice_survey.core.frames import Array
from missions.route.dubins import min_turn, moved
from missions.route.fence import Fence, straight_inside
from missions.values.costs import Costs, power_at

NONE, AHEAD, ARCS, SPOT, SWAY = 0, 1, 2, 3, 4
"""How two lines are joined; nothing direct, and straight on."""

MAX_SWAY_M = 5.0
"""Longest sway step. Chosen: some line spacings; farther the vehicle had better go ahead, since its
lateral thrusters and its side's drag are made for correction, not for transit."""

COLUMNS = 8
"""Columns of a leg: north, east, course, length, curvature, line, turn, side."""
_MAX_LEGS = 8
_TINY = 1e-9
_SAME_M = 1e-6
_DEAR_J = 1e15
"""More than any battery holds: stands for an infinite cost, so that of two such the shorter is
chosen."""


@compiled_ieee
def joined_lines(
    fence: Fence, costs: Costs, lines: Array, radius: float, run_in: float, wanted: int
) -> tuple[Array, NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """The legs along all lines and between them.

    Args:
        fence: of the allowed area.
        costs: what to keep low.
        lines: (N, 5) north and east of start and end, heading.
        radius: of arcs.
        run_in: straight before and, for arcs, after each line.
        wanted: `ARCS`, `SPOT` or `SWAY`, taken wherever they are possible; `NONE` for the cheapest.

    Returns:
        (L, 8) legs; (N,) the row of each line's own leg; (N - 1,) how lines are joined, `NONE`
        where nothing direct stays inside (then there are no legs between the two); (N - 1,) whether
        a way round corners should be compared.
    """
    count = lines.shape[0]
    legs = np.empty((count * (_MAX_LEGS + 1), COLUMNS))
    rows = np.empty(count, dtype=np.int64)
    kinds = np.zeros(max(count - 1, 0), dtype=np.int64)
    detours = np.zeros(max(count - 1, 0), dtype=np.bool_)
    end, goal = np.empty(3), np.empty(3)
    used = 0
    for i in range(count):
        rows[i] = used
        length = math.hypot(lines[i, 2] - lines[i, 0], lines[i, 3] - lines[i, 1])
        used = _add(legs, used, lines[i, 0], lines[i, 1], lines[i, 4], length, 0.0)
        legs[rows[i], 5] = i
        if i + 1 < count:
            end[:] = lines[i, 2:]
            goal[:2], goal[2] = lines[i + 1, :2], lines[i + 1, 4]
            kinds[i], made, detours[i] = join(fence, costs, end, goal, radius, run_in, wanted)
            legs[used : used + len(made)] = made
            used += len(made)
    return legs[:used], rows, kinds, detours


@compiled_ieee
def lines_alone(
    fence: Fence,
    costs: Costs,
    lines: Array,
    home: Array,
    radius: float,
    run_in: float,
    wanted: int,
) -> tuple[Array, NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """The legs from home along each line by itself and home again, one line after the other.

    Args:
        fence: of the allowed area.
        costs: what to keep low.
        lines: (N, 5) north and east of start and end, heading.
        home: (3,) north, east, and a heading of NaN.
        radius: of arcs.
        run_in: straight before and, for arcs, after each line.
        wanted: as of `joined_lines`.

    Returns:
        (L, 8) legs; (2N + 1,) the rows at which ways begin, out and back by turns: a line's own leg
        is the last of the way out; (2N,) how the ways go, and (2N,) whether a way round corners
        should be compared, as of `join`.
    """
    count = lines.shape[0]
    legs = np.empty((count * (2 * _MAX_LEGS + 1), COLUMNS))
    begins = np.zeros(2 * count + 1, dtype=np.int64)
    kinds = np.zeros(2 * count, dtype=np.int64)
    detours = np.zeros(2 * count, dtype=np.bool_)
    start = np.empty(3)
    used = 0
    for i in range(count):
        start[:2], start[2] = lines[i, :2], lines[i, 4]
        kinds[2 * i], made, detours[2 * i] = join(fence, costs, home, start, radius, run_in, wanted)
        legs[used : used + len(made)] = made
        used += len(made)
        length = math.hypot(lines[i, 2] - lines[i, 0], lines[i, 3] - lines[i, 1])
        used = _add(legs, used, lines[i, 0], lines[i, 1], lines[i, 4], length, 0.0)
        legs[used - 1, 5] = i
        begins[2 * i + 1] = used
        kinds[2 * i + 1], made, detours[2 * i + 1] = join(
            fence, costs, lines[i, 2:], home, radius, run_in, wanted
        )
        legs[used : used + len(made)] = made
        used += len(made)
        begins[2 * i + 2] = used
    return legs[:used], begins, kinds, detours


@compiled_ieee
def join(
    fence: Fence,
    costs: Costs,
    end: Array,
    goal: Array,
    radius: float,
    run_in: float,
    wanted: int,
) -> tuple[int, Array, bool]:
    """The cheapest direct way from the end of a line to the start of the next.

    Args:
        fence: of the allowed area.
        costs: what to keep low.
        end: (3,) north, east, heading at the end of the line; a heading of NaN is free (home).
        goal: (3,) the same at the start of the next.
        radius: of arcs.
        run_in: straight after the line if arcs follow, and before the next line; after a stop only
            where it is inside.
        wanted: as of `joined_lines`.

    Returns:
        How; (L, 8) legs; whether a way round corners should be compared, since the straight is
        blocked and nothing else was requested.
    """
    if _goes_on(end, goal) and straight_inside(fence, end[0], end[1], goal[0], goal[1]):
        ahead = np.empty((1, COLUMNS))
        gap = math.hypot(goal[0] - end[0], goal[1] - end[1])
        return AHEAD, ahead[: _add(ahead, 0, end[0], end[1], end[2], gap, 0.0)], False
    arcs_j, arcs = _by_arcs(fence, costs, end, goal, radius, run_in)
    if wanted == ARCS and arcs_j < np.inf:
        return ARCS, arcs, False
    stop_j, spot = _on_the_spot(fence, costs, end, goal, run_in)
    sway_j, sway = _sideways(fence, costs, end, goal, run_in)
    blocked = stop_j == np.inf
    if wanted == SPOT:
        return (NONE if blocked else SPOT), spot, blocked
    if wanted == SWAY and sway_j < np.inf:
        return SWAY, sway, False
    if arcs_j < np.inf and arcs_j <= min(stop_j, sway_j):
        return ARCS, arcs, blocked
    if not blocked and stop_j <= sway_j:
        return SPOT, spot, False
    if sway_j < np.inf:
        return SWAY, sway, blocked
    return NONE, spot, True


@compiled_ieee
def _by_arcs(
    fence: Fence,
    costs: Costs,
    end: Array,
    goal: Array,
    radius: float,
    run_in: float,
) -> tuple[float, Array]:
    """Run-out, the shortest turn, run-in; infinite if it leaves the fence."""
    legs = np.empty((5, COLUMNS))
    # Home is left and reached on the course straight to or from the other end.
    start, arrival = end.copy(), goal.copy()
    if not math.isnan(end[2]):
        start[0] += run_in * math.cos(end[2])
        start[1] += run_in * math.sin(end[2])
    if not math.isnan(goal[2]):
        arrival[0] -= run_in * math.cos(goal[2])
        arrival[1] -= run_in * math.sin(goal[2])
    bearing = math.atan2(arrival[1] - start[1], arrival[0] - start[0])
    for known, place in ((end, start), (goal, arrival)):
        if math.isnan(known[2]):
            place[2] = bearing
        elif not straight_inside(fence, known[0], known[1], place[0], place[1]):
            return np.inf, legs[:0]
    pieces = min_turn(fence, start, arrival, radius)
    if pieces[0, 1] == np.inf:
        return np.inf, legs[:0]
    used = 0
    if not math.isnan(end[2]):
        used = _add(legs, used, end[0], end[1], end[2], run_in, 0.0)
    north, east, heading = start[0], start[1], start[2]
    for k in range(3):
        curvature, length = pieces[k, 0], pieces[k, 1]
        used = _add(legs, used, north, east, heading, length, curvature)
        north, east, heading = moved(north, east, heading, curvature, length)
    if not math.isnan(goal[2]):
        used = _add(legs, used, arrival[0], arrival[1], arrival[2], run_in, 0.0)
    return price(costs, legs[:used]), legs[:used]


@compiled_ieee
def _on_the_spot(
    fence: Fence, costs: Costs, end: Array, goal: Array, run_in: float
) -> tuple[float, Array]:
    """Turn, straight, turn, run-in; infinite if it leaves the fence."""
    legs = np.empty((4, COLUMNS))
    north, east = run_in_start(fence, goal, run_in)
    if not straight_inside(fence, end[0], end[1], north, east):
        return np.inf, legs[:0]
    used = add_straight(legs, 0, end[0], end[1], end[2], north, east)
    heading = end[2] if used == 0 else legs[used - 1, 2]
    used = add_spot(legs, used, north, east, heading, goal[2])
    if not math.isnan(goal[2]):
        back = math.hypot(goal[0] - north, goal[1] - east)
        used = _add(legs, used, north, east, goal[2], back, 0.0)
    return price(costs, legs[:used]), legs[:used]


@compiled_ieee
def _sideways(
    fence: Fence, costs: Costs, end: Array, goal: Array, run_in: float
) -> tuple[float, Array]:
    """Ahead, a step sideways, a turn if the headings differ, ahead to the line.

    Infinite if it leaves the fence, the step is too long, or the vehicle would have to go astern.
    """
    legs = np.empty((4, COLUMNS))
    if math.isnan(end[2]) or math.isnan(goal[2]):
        return np.inf, legs[:0]
    cos, sin = math.cos(end[2]), math.sin(end[2])
    along = math.cos(goal[2]) * cos + math.sin(goal[2]) * sin
    north, east = run_in_start(fence, goal, run_in)
    last = math.hypot(goal[0] - north, goal[1] - east)
    first = (north - end[0]) * cos + (east - end[1]) * sin
    if first < 0.0:
        # Step at the line's end, and compensate for it by another length of run-in.
        if abs(along) < _TINY:
            return np.inf, legs[:0]
        last += first / along
        if last < 0.0:
            return np.inf, legs[:0]
        first = 0.0
        north = goal[0] - last * math.cos(goal[2])
        east = goal[1] - last * math.sin(goal[2])
    corner_n, corner_e = end[0] + first * cos, end[1] + first * sin
    step = (east - corner_e) * cos - (north - corner_n) * sin
    if abs(step) > MAX_SWAY_M or abs(step) < _SAME_M:
        return np.inf, legs[:0]
    track = ((end[0], end[1]), (corner_n, corner_e), (north, east), (goal[0], goal[1]))
    for i in range(3):
        one, two = track[i], track[i + 1]
        if not straight_inside(fence, one[0], one[1], two[0], two[1]):
            return np.inf, legs[:0]
    used = _add(legs, 0, end[0], end[1], end[2], first, 0.0)
    side = -0.5 * math.pi if step > 0 else 0.5 * math.pi
    _add(legs, used, corner_n, corner_e, end[2] - side, abs(step), 0.0)
    legs[used, 7] = side
    used = add_spot(legs, used + 1, north, east, end[2], goal[2])
    used = _add(legs, used, north, east, goal[2], last, 0.0)
    sway_j = power_at(costs.sway_w, end[2] - side)
    if sway_j == np.inf:
        return np.inf, legs[:0]
    return price(costs, legs[:used]), legs[:used]


@compiled_ieee
def run_in_start(fence: Fence, goal: Array, run_in: float) -> tuple[float, float]:
    """Where the run-in to a line begins: at the line itself where there is no room for it."""
    if math.isnan(goal[2]):
        return goal[0], goal[1]
    north, east = goal[0] - run_in * math.cos(goal[2]), goal[1] - run_in * math.sin(goal[2])
    if straight_inside(fence, north, east, goal[0], goal[1]):
        return north, east
    return goal[0], goal[1]


@compiled_ieee
def add_straight(
    legs: Array, used: int, a_n: float, a_e: float, heading: float, b_n: float, b_e: float
) -> int:
    """Turn on the spot towards a place and go there; returns the count of legs."""
    length = math.hypot(b_n - a_n, b_e - a_e)
    if length <= _TINY:
        return used
    course = math.atan2(b_e - a_e, b_n - a_n)
    used = add_spot(legs, used, a_n, a_e, heading, course)
    return int(_add(legs, used, a_n, a_e, course, length, 0.0))


@compiled_ieee
def add_spot(
    legs: Array, used: int, north: float, east: float, heading: float, goal_heading: float
) -> int:
    """Turn on the spot, if the headings differ and neither is free; returns the count of legs."""
    turn = goal_heading - heading
    turn -= 2.0 * math.pi * math.floor((turn + math.pi) / (2.0 * math.pi))
    if math.isnan(turn) or abs(turn) < _TINY:
        return used
    turn = min(max(turn, -math.pi), math.pi)  # but for rounding it is
    legs[used] = (north, east, heading, 0.0, 0.0, -1.0, turn, 0.0)
    return used + 1


@compiled_ieee
def _add(
    legs: Array,
    used: int,
    north: float,
    east: float,
    course: float,
    length: float,
    curvature: float,
) -> int:
    """Add a straight or an arc, unless it is of no length; returns the count of legs."""
    if length <= _TINY:
        return used
    legs[used] = (north, east, course, length, curvature, -1.0, 0.0, 0.0)
    return used + 1


@compiled_ieee
def _goes_on(end: Array, goal: Array) -> bool:
    """Whether a line lies straight ahead of another; never of a free heading."""
    if not math.cos(end[2] - goal[2]) > 1 - 1e-12:
        return False
    north, east = goal[0] - end[0], goal[1] - end[1]
    cos, sin = math.cos(end[2]), math.sin(end[2])
    return bool(cos * north + sin * east >= 0 and abs(cos * east - sin * north) < _SAME_M)


@compiled_ieee
def price(costs: Costs, legs: Array) -> float:
    """Energy of legs between lines; never infinite, but very high where it would be."""
    total = 0.0
    for i in range(legs.shape[0]):
        course, length, curvature = legs[i, 2], legs[i, 3], legs[i, 4]
        if legs[i, 6] != 0.0:
            total += costs.stop_w * (abs(legs[i, 6]) / costs.turn_rate_rad_s + costs.settle_s)
        elif legs[i, 7] != 0.0:
            total += length / costs.sway_mps * power_at(costs.sway_w, course)
            total += costs.stop_w * costs.settle_s
        else:
            mean = _mean_power(costs.way_w, course, course + curvature * length)
            if curvature != 0.0:
                mean += costs.arc_extra_w
            seconds = length / costs.speed_mps
            total += seconds * mean if mean < np.inf else _DEAR_J * (1.0 + seconds)
    return total


@compiled_ieee
def _mean_power(power_w: Array, start: float, end: float) -> float:
    """Mean power from a course to another, over the samples passed through."""
    count = power_w.shape[0]
    per_rad = count / (2.0 * math.pi)
    low, high = min(start, end) * per_rad, max(start, end) * per_rad
    if high - low < 1e-6:
        return float(power_at(power_w, 0.5 * (start + end)))
    total, place = 0.0, low
    while place < high:
        following = min(high, math.floor(place) + 1.0)
        if following - place > 1e-12:
            total += (following - place) * power_at(power_w, 0.5 * (place + following) / per_rad)
        place = following
    mean: float = total / (high - low)
    return mean
