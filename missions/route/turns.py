"""The way through a plan: from home along its lines in order, and home again.

Between two lines the vehicle flies arcs (straight on after the line, a turn of bounded curvature,
straight on before the next), or stops and turns on the spot, or stops and steps sideways: whichever
costs least and stays inside the allowed area. Where none of them does, it stops and goes from
corner to corner of the shortest way inside.

The hull stays clear of no-go zones on the way: if need be the vehicle goes astern along its line to
where it may turn freely, from there to such a place on the next line, and astern to its start.

Arcs are the shortest turns of bounded curvature: between two places with headings one of six kinds
(L. E. Dubins 1957); closed forms after A. M. Shkel and V. Lumelsky 2001. Where water is forbidden,
the shortest of the six that stays out of it is taken.
"""

import math
from collections.abc import Sequence
from dataclasses import astuple
from itertools import chain, groupby
from typing import Literal, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from alice_survey.core.errors import PlanError, warn
from alice_survey.core.frames import Array
from missions.route.terrain import Reach
from missions.route.ways import OPEN_WATER, TOUCH_M, Ways
from missions.values.area import Area, multipolygon
from missions.values.costs import Costs, leg_row_costs, power_at
from missions.values.legs import Leg, Route
from missions.values.line import Line
from missions.values.plan_file import Dive

Turns = Literal["auto", "arcs", "spot", "sway"]

MAX_SWAY_M = 5.0
"""Longest sway step. Chosen: some line spacings; farther the vehicle had better go ahead, since its
lateral thrusters and its side's drag are made for correction, not for transit."""
COLUMNS = 8
"""Columns of a leg: north, east, course, length, curvature, line, turn, side."""
_NONE, _AHEAD, _ARCS, _IN_PLACE, _SWAY = range(5)
"""How two lines are joined; round corners, and straight on."""
_REQUESTED = {"auto": _NONE, "arcs": _ARCS, "spot": _IN_PLACE, "sway": _SWAY}
_SENSES = np.array([[1, 0, 1], [1, -1, 1], [1, 0, -1], [-1, 0, -1], [-1, 1, -1], [-1, 0, 1]])
"""The six kinds of turns: to starboard, straight, to port."""
_FULL = 2 * math.pi
_TINY = 1e-9
_SAME_M = 1e-6
_SWEEP_RAD = math.radians(4.0)
"""Between headings of a hull that turns: its corners leave the straights between them by 1 mm."""
_BACK_STEP_M = 0.05
_MITRE_LIMIT = 1.1
"""Room to turn has few corners, where the vehicle stops, and is hardly larger than needed."""
_DEAR_J = 1e15
"""More than any battery holds: stands for an infinite cost, so that of two such the shorter is
chosen."""


class Zones:
    """No-go zones, and where a hull may turn freely."""

    def __init__(self, area: Area, reach: Reach) -> None:
        """Prepare the zones of an area for a hull that reaches so far from the glass."""
        self._no_go = area.no_go.buffer(-TOUCH_M, join_style="mitre")
        shapely.prepare(self._no_go)
        ends = np.array([reach.ahead_m, -reach.astern_m])
        self._corners = np.concatenate([ends + 1j * reach.aside_m, ends - 1j * reach.aside_m])
        self.reach_m = float(np.abs(self._corners).max())
        self.hull_m = reach.ahead_m + reach.astern_m
        near = area.no_go.buffer(self.reach_m, join_style="mitre", mitre_limit=_MITRE_LIMIT)
        self.ways = Ways(multipolygon(area.allowed.difference(near)))
        """Of the glass, with room for the hull at any heading."""

    def clear(self, hops: Sequence[Array] | Array) -> NDArray[np.bool_]:
        """Whether the hull keeps out on ways, (N,), of some legs (L, 8) each."""
        legs = np.concatenate([np.empty((0, COLUMNS)), *hops])
        hop = np.repeat(np.arange(len(hops)), [len(legs) for legs in hops])
        moves = (legs[:, 3] > 0.0) | (np.abs(legs[:, 6]) > 0.0)  # NaN does not
        turned = np.abs(legs[moves, 6] + legs[moves, 4] * legs[moves, 3])
        pieces = np.maximum(np.ceil(turned / _SWEEP_RAD), 1.0).astype(np.int64)
        of = np.repeat(np.flatnonzero(moves), pieces)
        number = np.arange(len(of)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
        share = (number[:, None] + np.arange(2)) / np.repeat(pieces, pieces)[:, None]
        both = legs[np.repeat(of, 2)]
        poses = ends_of(both[:, :3], both[:, 4], share.ravel() * both[:, 3])
        turn = np.exp(1j * (poses[:, 2] + share.ravel() * both[:, 6] + both[:, 7]))
        hull = (poses[:, 0] + 1j * poses[:, 1] + turn * self._corners[:, None]).T
        corners = np.stack([hull.real, hull.imag], axis=2).reshape(-1, 8, 2)
        swept = shapely.convex_hull(shapely.multipoints(corners))
        touching = hop[of[shapely.intersects(self._no_go, swept)]]
        return ~np.isin(np.arange(len(hops)), touching)

    def touching(self, dives: Sequence[Dive]) -> tuple[int, int]:
        """On how many ways between lines the hull touches a zone, and of how many.

        What continues a line, ahead or astern, passes as the line does.
        """
        hops = []
        for dive in dives:
            for on_line, group in groupby(dive.route.legs, lambda leg: leg.line >= 0):
                legs = np.array([(*place, *rest) for place, *rest in map(astuple, group)])
                turns = np.flatnonzero(legs[:, 6] + legs[:, 4])
                if len(turns) and not on_line:
                    hops.append(legs[turns[0] : turns[-1] + 1])
        return int((~self.clear(hops)).sum()), len(hops)


class Manoeuvre(NamedTuple):
    """How a vehicle gets from line to line."""

    costs: Costs
    """What to keep low."""
    radius_m: float
    """Of every arc."""
    run_in_m: float
    """Straight before each line, and after it where arcs follow; after a stop it is left out where
    it is not inside the allowed area."""
    turns: Turns = "auto"
    """How to turn wherever that is possible; auto: the cheapest way."""
    ways: Ways = OPEN_WATER
    """Inside the allowed area."""
    zones: Zones | None = None
    """That the hull keeps out of between lines."""


def line_table(lines: Sequence[Line]) -> Array:
    """North and east of the start and the end of each line, and its heading, (N, 5)."""
    return np.array([(*x.start_ne_m, *x.end_ne_m, x.heading_rad) for x in lines])


def route_of(legs: Array) -> Route:
    """The route of legs (L, 8), columns as of `COLUMNS`."""
    return Route(
        legs=tuple(
            Leg(
                start_ne_m=(north, east),
                heading_rad=course,
                length_m=length,
                curvature_per_m=curvature,
                line=int(line),
                turn_rad=turn,
                side_rad=side,
            )
            for north, east, course, length, curvature, line, turn, side in legs.tolist()
        )
    )


def legs_through(
    table: Array, how: Manoeuvre, *, home_ne: tuple[float, float] | None = None, first_line: int = 0
) -> Array:
    """The legs of the route along all lines in order.

    Args:
        table: the lines in the order of flight, as `line_table` has them.
        how: turns, what they cost, and where they are allowed.
        home_ne: where the route begins and ends; None: at the first line's run-in, and run-out
            behind the last.
        first_line: index of the first of these lines in the plan.

    Returns:
        (L, 8), columns as of `COLUMNS`; `route_of` makes the route of them.

    Raises:
        PlanError: there is no line, a line has no length or leaves the allowed area, or two places
            are in parts of it that are not connected.
    """
    if not len(table):
        raise PlanError("there is no line to fly")
    _check_lines(table, how.ways, first_line)
    starts, ends = table[:, [0, 1, 4]], table[:, 2:]
    begin, finish = np.empty((0, COLUMNS)), np.empty((0, COLUMNS))
    if home_ne is None:
        hops, kinds = _hops(ends[:-1], starts[1:], how)
        begin = _straight(_run_in_starts(starts[:1], how), starts[:1])
        leaving = ends[-1:] + how.run_in_m * _ahead(ends[-1:], flat=True)
        if how.ways.free_many(ends[-1:, :2], leaving[:, :2])[0]:
            finish = _straight(ends[-1:, :2], np.append(leaving[:, :2], ends[-1:, 2:], axis=1))
    else:
        home = np.array([[*home_ne, np.nan]])
        (begin, *hops, finish), kinds = _hops(
            np.concatenate([home, ends]), np.concatenate([starts, home]), how
        )
        kinds = kinds[1:-1]
    _warn_of_others(kinds, how.turns)
    lines = _line_legs(table, first_line)
    between = chain.from_iterable(zip(hops, lines[1:], strict=True))
    return np.concatenate([begin, lines[0], *between, finish])


def legs_alone(
    table: Array, how: Manoeuvre, home_ne: tuple[float, float]
) -> tuple[Array, NDArray[np.int64]]:
    """The ways from home along each line by itself and home again; all lines can be flown.

    Returns:
        (L, 8) legs, columns as of `COLUMNS`; and (2N + 1,) the rows at which ways out and back
        begin by turns: a line's own leg is the last of its way out.
    """
    home = np.full((len(table), 3), [*home_ne, np.nan])
    out, _ = _hops(home, table[:, [0, 1, 4]], how)
    back, _ = _hops(table[:, 2:], home, how)
    lines = _line_legs(table, 0)
    pieces = []
    for there, line, home_again in zip(out, lines, back, strict=True):
        pieces += [np.concatenate([there, line]), home_again]
    return np.concatenate(pieces), np.cumsum([0, *map(len, pieces)])


def turns_inside(ways: Ways, starts: Array, goals: Array, radius_m: float) -> tuple[Array, Array]:
    """The shortest turns of the six kinds that stay inside.

    Args:
        ways: of the allowed area.
        starts: (N, 3) north, east, heading.
        goals: (N, 3) the same way.
        radius_m: of every arc.

    Returns:
        (N, 3) curvature and (N, 3) length of their pieces; lengths are inf if no kind stays inside.
    """
    words = _words(starts, goals, radius_m)
    total = words.sum(axis=2)
    order = np.argsort(np.round(total, 9), axis=1, kind="stable")
    curvature, length = np.full((len(starts), 3), np.inf), np.full((len(starts), 3), np.inf)
    for kinds in order.T:
        rows = np.flatnonzero(np.isinf(length[:, 0]) & np.isfinite(total[range(len(kinds)), kinds]))
        bends = _SENSES[kinds[rows]] / radius_m
        pieces = words[rows, kinds[rows]] * radius_m
        place, inside = starts[rows], np.ones(len(rows), dtype=np.bool_)
        for k in range(3):
            inside &= (pieces[:, k] <= _TINY) | ways.arcs_free(place, bends[:, k], pieces[:, k])
            place = ends_of(place, bends[:, k], pieces[:, k])
        # A closed form outside of its domain does not arrive.
        off = np.hypot(*(place - goals[rows])[:, :2].T)
        inside &= off <= _SAME_M * (1.0 + pieces.sum(axis=1))
        curvature[rows[inside]], length[rows[inside]] = bends[inside], pieces[inside]
    return curvature, length


def ends_of(starts: Array, curvature_per_m: Array, length_m: Array) -> Array:
    """Places and headings, (N, 3), at the ends of straights or arcs."""
    half = 0.5 * curvature_per_m * length_m
    chord = (length_m * np.sinc(half / math.pi))[:, None]
    course = starts[:, 2] + half
    places = starts[:, :2] + chord * np.stack([np.cos(course), np.sin(course)], axis=1)
    return np.append(places, (starts[:, 2] + 2 * half)[:, None], axis=1)


def _words(starts: Array, goals: Array, radius_m: float) -> Array:
    """(N, 6, 3) lengths of the pieces of `_SENSES`, in radii; inf of kinds that do not exist."""
    north, east = (goals - starts)[:, :2].T / radius_m
    distance, bearing = np.hypot(north, east), np.arctan2(east, north)
    words = np.full((len(starts), 6, 3), np.inf)
    with np.errstate(invalid="ignore"):
        for row, side in ((0, 1.0), (3, -1.0)):  # port is the mirror image of starboard
            a = side * ((starts[:, 2] - bearing) % _FULL)
            b = side * ((goals[:, 2] - bearing) % _FULL)
            sa, ca, sb, cb = np.sin(a), np.cos(a), np.sin(b), np.cos(b)
            cab = np.cos(a - b)
            across = np.arctan2(cb - ca, distance + sa - sb)
            straight = _root(2 + distance**2 - 2 * cab + 2 * distance * (sa - sb))
            words[:, row] = np.stack([_wrap(across - a), straight, _wrap(b - across)], axis=1)
            middle = _FULL - np.arccos((6 - distance**2 + 2 * cab - 2 * distance * (sa - sb)) / 8)
            first = _wrap(across - a + middle / 2)
            words[:, row + 1] = np.stack([first, middle, _wrap(b - a - first + middle)], axis=1)
            straight = _root(distance**2 - 2 + 2 * cab + 2 * distance * (sa + sb))
            across = np.arctan2(-ca - cb, distance + sa + sb) - np.arctan2(-2.0, straight)
            words[:, row + 2] = np.stack([_wrap(across - a), straight, _wrap(across - b)], axis=1)
    words[np.isnan(words).any(axis=2)] = np.inf
    return words


def _root(square: Array) -> Array:
    """The square root; NaN of what is negative by more than rounding."""
    root: Array = np.sqrt(np.where(square >= -_TINY, np.maximum(square, 0.0), np.nan))
    return root


def _wrap(angle: Array) -> Array:
    """Angles in [0, 2 pi), with 0 for what is a full turn but for rounding."""
    wrapped = angle % _FULL
    return np.where(_FULL - wrapped < _TINY, 0.0, wrapped)


def _hops(ends: Array, goals: Array, how: Manoeuvre) -> tuple[list[Array], NDArray[np.int64]]:
    """As `_cheapest`; where the hull would touch a zone, by places with room to turn."""
    hops, kinds = _cheapest(ends, goals, how)
    if how.zones is None:
        return hops, kinds
    rows = np.flatnonzero(~how.zones.clear(hops) & (kinds != _AHEAD))
    leave, enter = _retreats(ends[rows], -1.0, how), _retreats(goals[rows], 1.0, how)
    found = np.isfinite(leave[:, 0] + enter[:, 0])
    found[found] = np.isfinite(how.zones.ways.lengths_m(leave[found, :2], enter[found, :2]))
    rows, leave, enter = rows[found], leave[found], enter[found]
    there = how._replace(ways=how.zones.ways, zones=None)
    between, kinds[rows] = _cheapest(leave, enter, there)
    away, back = _along(ends[rows], leave), _along(enter, goals[rows])
    for i, *legs in zip(rows.tolist(), away, between, back, strict=True):
        hops[i] = np.concatenate(legs)
    return hops, kinds


def _retreats(places: Array, astern: float, how: Manoeuvre) -> Array:
    """The nearest places in line with places, (N, 3), where the hull may turn freely; else NaN.

    They are no farther than the hull is long: all that it passes over on the way is under it at one
    of both ends. To one side, `astern`, the vehicle goes or comes astern, if it can.
    """
    hull_m, ways = (0.0, how.ways) if how.zones is None else (how.zones.hull_m, how.zones.ways)
    steps = _BACK_STEP_M * np.arange(hull_m / _BACK_STEP_M)
    away_m = np.stack([astern * steps, -astern * steps], axis=1).ravel()
    reached = places[:, None] + away_m[:, None] * _ahead(places, flat=True)[:, None]
    possible = ways.inside(reached[..., :2].reshape(-1, 2)).reshape(reached.shape[:2])
    cannot = np.isinf(power_at(how.costs.sway_w, np.nan_to_num(places[:, 2]) + math.pi))
    possible[np.outer(cannot, astern * away_m > 0.0)] = False
    nearest: Array = reached[np.arange(len(places)), np.argmax(possible, axis=1)]
    some = possible.any(axis=1) & how.ways.free_many(places[:, :2], nearest[:, :2])
    nearest[~some] = np.nan
    return nearest


def _along(starts: Array, ends: Array) -> list[Array]:
    """Straights ahead, or steps astern, (1, 8) each; (0, 8) from a place to itself."""
    moves = (ends - starts)[:, :2]
    side = np.where((moves * _ahead(starts)).sum(axis=1) < 0.0, -math.pi, 0.0)
    legs = _leg(starts, starts[:, 2] - side, np.hypot(*moves.T))
    legs[:, 7] = side
    return [leg[leg[:, 3] > 0.0] for leg in legs[:, None]]


def _cheapest(ends: Array, goals: Array, how: Manoeuvre) -> tuple[list[Array], NDArray[np.int64]]:
    """The cheapest ways from ends of lines to starts of others, clear of zones where one is.

    Args:
        ends: (N, 3) north, east, heading at the end of a line; a heading of NaN is free (home).
        goals: (N, 3) the same at the start of the next.
        how: turns, what they cost, and where they are allowed.

    Returns:
        Legs, (L, 8), of each; and (N,) how they go.
    """
    how = how._replace(costs=how.costs.compilable())
    requested = _REQUESTED[how.turns]
    on = _goes_on(ends, goals) & how.ways.free_many(ends[:, :2], goals[:, :2])
    gap = np.hypot(*(goals - ends)[:, :2].T)
    choices = [_leg(ends, ends[:, 2], gap)[:, None], _by_arcs(ends, goals, how),
               _turn_in_place(ends, goals, how), _sideways(ends, goals, how)]  # fmt: skip
    joules = np.stack([prices_j(how.costs, legs) for legs in choices])
    if how.zones is not None:
        joules += [_DEAR_J * ~how.zones.clear(legs) for legs in choices]
    joules[0] = np.where(on, -np.inf, np.inf)
    blocked = np.isinf(joules[2])
    if requested != _NONE:
        as_requested = np.isfinite(joules[requested - 1])
        if requested == _IN_PLACE:
            as_requested = np.ones(len(ends), dtype=np.bool_)
        others = np.arange(1, 4) != requested - 1
        joules[1:][np.outer(others, as_requested & ~on)] = np.inf
    kinds = np.where(np.isinf(joules.min(axis=0)) & ~on, _NONE, 1 + np.argmin(joules, axis=0))
    # Round corners is compared where the straight is blocked and nothing else was requested.
    detours = blocked & ~on & ((kinds != requested) | (requested == _NONE))
    width = max(legs.shape[1] for legs in choices)
    padded = np.zeros((4, len(ends), width, COLUMNS))
    for number, legs in enumerate(choices):
        padded[number, :, : legs.shape[1]] = legs
    taken = padded[np.maximum(kinds - 1, 0), np.arange(len(ends))]
    taken[kinds == _NONE] = 0.0
    flown = (taken[..., 3] > 0.0) | (taken[..., 6] != 0.0)
    hops = np.split(taken[flown], np.cumsum(flown.sum(axis=1)))[: len(ends)]
    for i in np.flatnonzero(detours).tolist():
        way = _round_corners(how, ends[i], goals[i])
        direct_j, way_j = prices_j(how.costs, hops[i][None]), prices_j(how.costs, way[None])
        if kinds[i] == _NONE or direct_j[0] > way_j[0]:
            hops[i], kinds[i] = way, _NONE
    return hops, kinds


def _by_arcs(ends: Array, goals: Array, how: Manoeuvre) -> Array:
    """Run-out, the shortest turn, run-in, (N, 5, 8); NaN if it leaves the allowed area."""
    # Home is left and reached on the course straight to or from the other end.
    starts = ends + how.run_in_m * _ahead(ends, flat=True)
    arrivals = goals - how.run_in_m * _ahead(goals, flat=True)
    bearing = np.arctan2(*(arrivals - starts)[:, 1::-1].T)
    inside = np.ones(len(ends), dtype=np.bool_)
    for known, place in ((ends, starts), (goals, arrivals)):
        free = np.isnan(known[:, 2])
        place[:, 2] = np.where(free, bearing, known[:, 2])
        inside &= free | how.ways.free_many(known[:, :2], place[:, :2])
    legs = np.full((len(ends), 5, COLUMNS), np.nan)
    rows = np.flatnonzero(inside)
    curvature, length = turns_inside(how.ways, starts[rows], arrivals[rows], how.radius_m)
    rows = rows[np.isfinite(length[:, 0])]
    curvature, length = (x[np.isfinite(length[:, 0])] for x in (curvature, length))
    place = starts[rows]
    run_in = np.full(len(rows), how.run_in_m)
    legs[rows, 0] = _leg(ends[rows], ends[rows, 2], run_in)
    for k in range(3):
        legs[rows, k + 1] = _leg(place, place[:, 2], length[:, k], curvature[:, k])
        place = ends_of(place, curvature[:, k], length[:, k])
    legs[rows, 4] = _leg(arrivals[rows], goals[rows, 2], run_in)
    return legs


def _turn_in_place(ends: Array, goals: Array, how: Manoeuvre) -> Array:
    """Turn, straight, turn, run-in, (N, 4, 8); NaN if it leaves the allowed area."""
    arrivals = _run_in_starts(goals, how)
    course = np.arctan2(*(arrivals - ends[:, :2])[:, ::-1].T)
    length = np.hypot(*(arrivals - ends[:, :2]).T)
    course = np.where(length > _TINY, course, ends[:, 2])
    legs = np.stack(
        [
            _turn(ends, ends[:, 2], course),
            _leg(ends, course, length),
            _turn(arrivals, course, goals[:, 2]),
            _leg(arrivals, goals[:, 2], np.hypot(*(goals[:, :2] - arrivals).T)),
        ],
        axis=1,
    )
    legs[~how.ways.free_many(ends[:, :2], arrivals)] = np.nan
    return legs


def _sideways(ends: Array, goals: Array, how: Manoeuvre) -> Array:
    """Ahead, a step sideways, a turn if the headings differ, ahead to the line, (N, 4, 8).

    NaN if it leaves the allowed area, the step is too long or cannot be flown, the vehicle would
    have to go astern, or from and to home.
    """
    forward = _ahead(ends)
    along = (_ahead(goals) * forward).sum(axis=1)
    arrivals = _run_in_starts(goals, how)
    last = np.hypot(*(goals[:, :2] - arrivals).T)
    first = ((arrivals - ends[:, :2]) * forward).sum(axis=1)
    # Else step at the line's end, and compensate for it by another length of run-in.
    early = first < 0.0
    last = np.where(early, last + first / np.where(np.abs(along) < _TINY, np.nan, along), last)
    first = np.maximum(first, 0.0)
    arrivals = np.where(early[:, None], goals[:, :2] - last[:, None] * _ahead(goals), arrivals)
    corners = ends[:, :2] + first[:, None] * forward
    away = arrivals - corners
    step = forward[:, 0] * away[:, 1] - forward[:, 1] * away[:, 0]
    side = np.where(step > 0, -math.pi / 2, math.pi / 2)
    possible = np.isfinite(ends[:, 2] + goals[:, 2]) & np.isfinite(last) & (last >= 0.0)
    possible &= (np.abs(step) <= MAX_SWAY_M) & (np.abs(step) >= _SAME_M)
    legs = np.full((len(ends), 4, COLUMNS), np.nan)
    rows = np.flatnonzero(possible)
    rows = rows[np.isfinite(power_at(how.costs.sway_w, (ends[:, 2] - side)[rows]))]
    track = np.stack([ends[:, :2], corners, arrivals, goals[:, :2]], axis=1)[rows]
    free = how.ways.free_many(track[:, :-1].reshape(-1, 2), track[:, 1:].reshape(-1, 2))
    rows = rows[free.reshape(-1, 3).all(axis=1)]
    end, goal, corner, arrival = ends[rows], goals[rows], corners[rows], arrivals[rows]
    legs[rows, 0] = _leg(end, end[:, 2], first[rows])
    legs[rows, 1] = _leg(corner, end[:, 2] - side[rows], np.abs(step[rows]))
    legs[rows, 1, 7] = side[rows]
    legs[rows, 2] = _turn(arrival, end[:, 2], goal[:, 2])
    legs[rows, 3] = _leg(arrival, goal[:, 2], last[rows])
    return legs


def _round_corners(how: Manoeuvre, end: Array, goal: Array) -> Array:
    """Legs from a line's end to the next, round the corners of the allowed area, (L, 8)."""
    arrival = _run_in_starts(goal[None], how)
    path = how.ways.path_ne((float(end[0]), float(end[1])), tuple(arrival[0].tolist()))
    moves = np.diff(path, axis=0)
    courses, lengths = np.arctan2(moves[:, 1], moves[:, 0]), np.hypot(*moves.T)
    here, courses, lengths = (x[lengths > _TINY] for x in (path[:-1], courses, lengths))
    turns = _turn(
        np.concatenate([here, arrival]), np.append(end[2], courses), np.append(courses, goal[2])
    )
    legs = np.empty((2 * len(here) + 1, COLUMNS))
    legs[::2], legs[1::2] = turns, _leg(here, courses, lengths)
    legs = np.concatenate([legs, _straight(arrival, goal[None])])
    flown: Array = legs[(legs[:, 3] > 0.0) | (legs[:, 6] != 0.0)]
    return flown


def _run_in_starts(goals: Array, how: Manoeuvre) -> Array:
    """Where run-ins to lines begin, (N, 2): at the line itself where there is no room for it."""
    starts = goals[:, :2] - how.run_in_m * np.nan_to_num(_ahead(goals))
    has_room = how.ways.free_many(starts, goals[:, :2])
    return np.where(has_room[:, None], starts, goals[:, :2])


def _ahead(places: Array, *, flat: bool = False) -> Array:
    """Directions of the headings of places (N, 3): (N, 2), NaN where they are free.

    Flat: (N, 3), to move places, and 0 of the free.
    """
    ahead = np.stack([np.cos(places[:, 2]), np.sin(places[:, 2])], axis=1)
    return np.append(np.nan_to_num(ahead), np.zeros((len(ahead), 1)), axis=1) if flat else ahead


def _goes_on(ends: Array, goals: Array) -> NDArray[np.bool_]:
    """Whether lines lie straight ahead of others; never of a free heading."""
    away, ahead = (goals - ends)[:, :2], _ahead(ends)
    aside = ahead[:, 0] * away[:, 1] - ahead[:, 1] * away[:, 0]
    return np.asarray(
        (np.cos(ends[:, 2] - goals[:, 2]) > 1 - 1e-12)
        & ((away * ahead).sum(axis=1) >= 0)
        & (np.abs(aside) < _SAME_M)
    )


def _leg(places: Array, course: Array, length: Array, curvature: Array | float = 0.0) -> Array:
    """Straights or arcs, (N, 8); zeros where they have no length or their course is free."""
    legs = np.zeros((len(places), COLUMNS))
    legs[:, :2], legs[:, 2], legs[:, 3], legs[:, 4] = places[:, :2], course, length, curvature
    legs[:, 5] = -1.0
    legs[(legs[:, 3] <= _TINY) | np.isnan(legs[:, 2])] = 0.0
    return legs


def _turn(places: Array, heading: Array, goal: Array) -> Array:
    """Turns on the spot, (N, 8); zeros where the headings are the same or one is free."""
    turn = goal - heading
    turn = np.clip(turn - _FULL * np.floor((turn + math.pi) / _FULL), -math.pi, math.pi)
    legs = np.zeros((len(places), COLUMNS))
    legs[:, :2], legs[:, 2], legs[:, 5], legs[:, 6] = places[:, :2], heading, -1.0, turn
    legs[~(np.abs(turn) >= _TINY)] = 0.0
    return legs


def _straight(starts_ne: Array, ends: Array) -> Array:
    """The legs between places that are ahead of one another; none if they are one."""
    legs = _leg(starts_ne, ends[:, 2], np.hypot(*(ends[:, :2] - starts_ne).T))
    return legs[legs[:, 3] > 0.0]


def _line_legs(table: Array, first_line: int) -> Array:
    """The lines' own legs, (N, 1, 8)."""
    legs = _leg(table, table[:, 4], np.hypot(*(table[:, 2:4] - table[:, :2]).T))
    legs[:, 5] = first_line + np.arange(len(table))
    return legs[:, None]


def prices_j(costs: Costs, legs: Array) -> Array:
    """Energy, (N,), of legs between lines, (N, L, 8): very high where it would be infinite.

    Infinite of legs that are NaN: these do not exist.
    """
    absent = np.asarray(np.isnan(legs[:, :, 0]).any(axis=1))
    rows = np.where(absent[:, None, None], 0.0, legs)[..., 2:].reshape(-1, COLUMNS - 2)
    rows[:, 3] = -1.0
    joules, seconds = leg_row_costs(rows, costs)
    joules = np.where(np.isinf(joules), _DEAR_J * (1.0 + seconds), joules)
    total: Array = joules.reshape(legs.shape[:2]).sum(axis=1)
    return np.where(absent, np.inf, total)


def _check_lines(table: Array, ways: Ways, first_line: int) -> None:
    short = np.flatnonzero(np.hypot(*(table[:, 2:4] - table[:, :2]).T) <= TOUCH_M)
    if len(short):
        raise PlanError(f"line {first_line + short[0]} begins where it ends: give it two places")
    outside = np.flatnonzero(~ways.free_many(table[:, :2], table[:, 2:4]))
    if len(outside):
        n_0, e_0, n_1, e_1, _ = table[outside[0]]
        raise PlanError(
            f"{len(outside)} of {len(table)} lines leave the allowed area, first line "
            f"{first_line + outside[0]} from {n_0:.2f} m north, {e_0:.2f} m east to {n_1:.2f}, "
            f"{e_1:.2f}: give it more room: area.turn_margin_m, or a wider allowed area"
        )


def _warn_of_others(kinds: NDArray[np.int64], turns: Turns) -> None:
    """Warn of turns that are not as requested."""
    if turns == "auto":
        return
    turned = kinds[kinds != _AHEAD]
    # On the spot is also round corners, and on the spot at each.
    fine = (turned == _REQUESTED[turns]) | ((turned == _NONE) & (turns == "spot"))
    others = int((~fine).sum())
    if others:
        warn(
            f"{others} of {len(turned)} turns have no room for turns = {turns!r} inside the "
            "allowed area or are too far for it: the cheapest other way is taken there; widen "
            "area.turn_margin_m or set plan.turns = 'auto'"
        )
