"""The way through a plan: from home along its lines in order, and home again.

Between two lines the vehicle flies arcs (straight on after the line, a turn of bounded curvature,
straight on before the next), or stops and turns on the spot, or stops and steps sideways: whichever
costs least and stays inside the allowed area. Where none of them does, it stops and goes from
corner to corner of the shortest way inside.
"""

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.errors import PlanError, warn
from alice_survey.core.frames import Array
from missions.route import joins
from missions.route.fence import OPEN_WATER, TOUCH_M, Fence, straight_inside
from missions.route.ways import Ways
from missions.values.costs import Costs, time_costs
from missions.values.legs import Leg, Route
from missions.values.line import Line

Turns = Literal["auto", "arcs", "spot", "sway"]

PAPER_SPEED_MPS = 0.2
"""Gutnik et al. 2021, section VII.A."""
_WANTED = {"auto": joins.NONE, "arcs": joins.ARCS, "spot": joins.SPOT, "sway": joins.SWAY}
_FREE = math.nan


def line_table(lines: Sequence[Line]) -> Array:
    """North and east of the start and the end of each line, and its heading, (N, 5)."""
    return np.array([(*x.start_ne_m, *x.end_ne_m, x.heading_rad) for x in lines])


def route_of(legs: Array) -> Route:
    """The route of legs (L, 8), columns as of `joins.COLUMNS`."""
    return Route(legs=_legs(legs))


def legs_through(
    table: Array,
    turn_radius_m: float,
    run_in_m: float,
    *,
    ways: Ways | None = None,
    costs: Costs | None = None,
    turns: Turns = "auto",
    home_ne: tuple[float, float] | None = None,
    start_ne: tuple[float, float] | None = None,
    first_line: int = 0,
) -> Array:
    """The legs of the route along all lines in order.

    Args:
        table: the lines in the order of flight, as `line_table` has them.
        turn_radius_m: of every arc.
        run_in_m: straight before each line, and after it where arcs follow; after a stop it is left
            out where it is not inside the allowed area.
        ways: inside the allowed area; None: nothing is forbidden.
        costs: what to keep low; None: time, at the paper's speed.
        turns: how to turn wherever that is possible; auto: the cheapest way.
        home_ne: where the route begins and ends; None: at the first line's run-in, and run-out
            behind the last.
        start_ne: where it begins, if that is not home.
        first_line: index of the first of these lines in the plan.

    Returns:
        (L, 8), columns as of `joins.COLUMNS`; `route_of` makes the route of them.

    Raises:
        PlanError: there is no line, a line has no length or leaves the allowed area, or two places
            are in parts of it that are not connected.
    """
    if not len(table):
        raise PlanError("there is no line to fly")
    fence = OPEN_WATER if ways is None else ways.fence
    _check_lines(table, ways, first_line)
    costs = (time_costs(PAPER_SPEED_MPS) if costs is None else costs).compilable()
    wanted = _WANTED[turns]
    legs, rows, kinds, detours = joins.joined_lines(
        fence, costs, table, turn_radius_m, run_in_m, wanted
    )
    legs[rows, 5] += first_line
    start, end = table[0, [0, 1, 4]], table[-1, 2:]
    if home_ne is None:
        first, last = _run_in(fence, start, run_in_m), _run_out(fence, end, run_in_m)
    else:
        home = np.array([*home_ne, _FREE])
        begin = home if start_ne is None else np.array([*start_ne, _FREE])
        first, last = (
            _single(ways, costs, a, b, turn_radius_m, run_in_m, wanted)
            for a, b in ((begin, start), (end, home))
        )
    pieces = [first]
    done = 0
    for i in np.flatnonzero(detours).tolist():
        if ways is None:
            continue  # in open water nothing is blocked
        after = rows[i] + 1
        pieces.append(legs[done:after])
        done = rows[i + 1]
        way = _round_corners(ways, table[i, 2:], table[i + 1, [0, 1, 4]], run_in_m)
        way, kinds[i] = _cheaper(kinds[i], legs[after:done], way, costs)
        pieces.append(way)
    pieces += [legs[done:], last]
    _warn_of_others(kinds, turns)
    return np.concatenate(pieces)


def legs_alone(
    table: Array,
    turn_radius_m: float,
    run_in_m: float,
    *,
    ways: Ways | None,
    costs: Costs,
    turns: Turns,
    home_ne: tuple[float, float],
) -> tuple[Array, NDArray[np.int64]]:
    """The ways from home along each line by itself and home again; all lines can be flown.

    Args:
        table: the lines, as `line_table` has them.
        turn_radius_m: of every arc.
        run_in_m: as of `legs_through`, as is all else.
        ways: inside the allowed area.
        costs: what to keep low.
        turns: how to turn.
        home_ne: where each way begins and ends.

    Returns:
        (L, 8) legs, columns as of `joins.COLUMNS`; and (2N + 1,) the rows at which ways out and
        back begin by turns: a line's own leg is the last of its way out.
    """
    fence = OPEN_WATER if ways is None else ways.fence
    costs, home = costs.compilable(), np.array([*home_ne, _FREE])
    legs, begins, kinds, detours = joins.lines_alone(
        fence, costs, table, home, turn_radius_m, run_in_m, _WANTED[turns]
    )
    if ways is None or not detours.any():
        return legs, begins
    pieces = np.split(legs, begins[1:-1])
    for i in np.flatnonzero(detours).tolist():
        line, own = table[i // 2], pieces[i][-1:] if i % 2 == 0 else legs[:0]
        end, goal = (line[2:], home) if i % 2 else (home, line[[0, 1, 4]])
        way = _round_corners(ways, end, goal, run_in_m)
        direct = pieces[i][: len(pieces[i]) - len(own)]
        pieces[i] = np.concatenate([_cheaper(kinds[i], direct, way, costs)[0], own])
    begins[1:] = np.cumsum([len(piece) for piece in pieces])
    return np.concatenate(pieces), begins


def _check_lines(table: Array, ways: Ways | None, first_line: int) -> None:
    short = np.flatnonzero(np.hypot(*(table[:, 2:4] - table[:, :2]).T) <= TOUCH_M)
    if len(short):
        raise PlanError(f"line {first_line + short[0]} begins where it ends: give it two places")
    if ways is None:
        return
    outside = np.flatnonzero(~ways.free_many(table[:, :2], table[:, 2:4]))
    if len(outside):
        n_0, e_0, n_1, e_1, _ = table[outside[0]]
        raise PlanError(
            f"{len(outside)} of {len(table)} lines leave the allowed area, first line "
            f"{first_line + outside[0]} from {n_0:.2f} m north, {e_0:.2f} m east to {n_1:.2f}, "
            f"{e_1:.2f}: give it more room: area.turn_margin_m, or a wider allowed area"
        )


def _run_in(fence: Fence, start: Array, run_in_m: float) -> Array:
    """The leg before the first line, where there is room for it."""
    arrival = np.array(joins.run_in_start(fence, start, run_in_m))
    return _straight(arrival, start[:2], start[2])


def _run_out(fence: Fence, end: Array, run_out_m: float) -> Array:
    """The leg after the last line, where there is room for it."""
    leaving = end[:2] + run_out_m * np.array([math.cos(end[2]), math.sin(end[2])])
    leg = _straight(end[:2], leaving, end[2])
    return leg if straight_inside(fence, end[0], end[1], leaving[0], leaving[1]) else leg[:0]


def _single(
    ways: Ways | None,
    costs: Costs,
    end: Array,
    goal: Array,
    turn_radius_m: float,
    run_in_m: float,
    wanted: int,
) -> Array:
    """The way from home or to it, (L, 8)."""
    fence = OPEN_WATER if ways is None else ways.fence
    kind, way, detour = joins.join(fence, costs, end, goal, turn_radius_m, run_in_m, wanted)
    if detour and ways is not None:
        way, _ = _cheaper(kind, way, _round_corners(ways, end, goal, run_in_m), costs)
    result: Array = way
    return result


def _cheaper(kind: int, direct: Array, round_corners: Array, costs: Costs) -> tuple[Array, int]:
    """The direct way, if there is one, or that round corners; and which."""
    if kind != joins.NONE and joins.price(costs, direct) <= joins.price(costs, round_corners):
        return direct, kind
    return round_corners, joins.NONE


def _round_corners(ways: Ways, end: Array, goal: Array, run_in_m: float) -> Array:
    """Legs from a line's end to the next, round the corners of the allowed area, (L, 8)."""
    arrival = np.array(joins.run_in_start(ways.fence, goal, run_in_m))
    path = ways.path_ne((float(end[0]), float(end[1])), (float(arrival[0]), float(arrival[1])))
    legs = np.empty((2 * len(path) + 2, joins.COLUMNS))
    used, heading = 0, float(end[2])
    for here, there in zip(path[:-1].tolist(), path[1:].tolist(), strict=True):
        before = used
        used = joins.add_straight(legs, used, here[0], here[1], heading, there[0], there[1])
        if used > before:
            heading = float(legs[used - 1, 2])
    north, east = arrival.tolist()
    used = joins.add_spot(legs, used, north, east, heading, float(goal[2]))
    return np.concatenate([legs[:used], _straight(arrival, goal[:2], goal[2])])


def _straight(start_ne: Array, end_ne: Array, heading: float) -> Array:
    """The leg between two places that are ahead of one another, (1, 8); none if they are one."""
    length = math.dist(start_ne, end_ne)
    leg = np.array([[*start_ne, heading, length, 0.0, -1.0, 0.0, 0.0]])
    return leg if length > 1e-9 else leg[:0]


def _legs(table: Array) -> tuple[Leg, ...]:
    return tuple(
        Leg(
            start_ne_m=(north, east),
            heading_rad=course,
            length_m=length,
            curvature_per_m=curvature,
            line=int(line),
            turn_rad=turn,
            side_rad=side,
        )
        for north, east, course, length, curvature, line, turn, side in table.tolist()
    )


def _warn_of_others(kinds: NDArray[np.intp], turns: Turns) -> None:
    """Warn of turns that are not as requested."""
    if turns == "auto":
        return
    asked = kinds[kinds != joins.AHEAD]
    as_wanted = asked == _WANTED[turns]
    if turns == "spot":
        as_wanted |= asked == joins.NONE  # round corners, and on the spot at each
    others = int((~as_wanted).sum())
    if others:
        warn(
            f"{others} of {len(asked)} turns have no room for turns = {turns!r} inside the allowed "
            "area or are too far for it: the cheapest other way is taken there; widen "
            "area.turn_margin_m or set plan.turns = 'auto'"
        )
