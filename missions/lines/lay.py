"""Lay the lines of a survey in order of flight.

Survey lines lie on one grid of offsets over the whole area; cross lines tie them together; a
closing line goes back over the start of the first, so that the end of the track is tied to its
beginning; fill lines see what the pattern cannot because a no-go zone cuts it. Cells of survey
lines and cross lines are one tour, from home and home again.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from alice_survey.core.errors import PlanError
from alice_survey.core.frames import Array
from alice_survey.core.run import progress
from missions.lines import cells, cross, hops, rows, tour
from missions.lines.fill import fill_table
from missions.lines.rows import Site
from missions.route.ways import Ways
from missions.values.area import Area
from missions.values.costs import Costs
from missions.values.line import Line, LineKind
from missions.values.pattern import Pattern

MAX_STATIONS = 2_000_000
"""Most stations of a plan. Chosen: days of flight, and terabytes of pictures."""
KINDS: tuple[LineKind, ...] = ("survey", "cross", "closing", "fill")
SURVEY, CROSS, CLOSING, FILL = range(len(KINDS))


@dataclass(frozen=True, kw_only=True, eq=False)
class Laid:
    """Lines in order of flight as arrays, and what flying them costs."""

    table: Array
    """(L, 5) north and east of start and end, course."""
    steps: NDArray[np.int64]
    """(L,) number of steps from picture to picture."""
    kinds: NDArray[np.int64]
    """(L,) indices of `KINDS`."""
    energy_j: float
    """Energy of the whole flight, from home and home again."""

    def lines(self) -> list[Line]:
        """The lines as values."""
        # Rounded far below all rounding of positions, so that level places read level.
        places = (np.round(self.table[:, :4], 12) + 0.0).tolist()
        return [
            Line(kind=KINDS[kind], start_ne_m=(p[0], p[1]), end_ne_m=(p[2], p[3]), stations=n + 1)
            for p, n, kind in zip(places, self.steps.tolist(), self.kinds.tolist(), strict=True)
        ]


@dataclass(frozen=True, kw_only=True, eq=False)
class LineTask:
    """What lines are laid for, and what keeps their order cheap."""

    area: Area
    """What must be seen, and where lines may be."""
    pattern: Pattern
    """How far apart lines and pictures are, and what they see."""
    ways: Ways
    """Ways inside the allowed area."""
    costs: Costs
    """What the order of the lines keeps low."""
    home_ne: tuple[float, float]
    """Place where the flight begins and ends."""
    cross_lines: int
    """How many across the survey lines, over every block of them; more where some would stay
    uncrossed (`missions.lines.cross`); 0: none."""
    closing_line: bool
    """Whether the start of the first line is flown again at the end."""
    max_stations: int = MAX_STATIONS
    """Most stations that a plan may have."""

    @cached_property
    def site(self) -> Site:
        """The area as compiled code takes it."""
        return Site.of(self.area)

    @cached_property
    def bounded(self) -> Costs:
        """The costs without infinite ones."""
        return hops.comparable(self.costs)


@progress.step("lay the lines")
def lay_lines(task: LineTask, heading_rad: float) -> list[Line]:
    """Lay all lines of a survey.

    Args:
        task: what for.
        heading_rad: of the survey lines; they are flown to and fro, from the better end.

    Returns:
        Lines in the order of flight. No line leaves the allowed area.

    Raises:
        PlanError: there are too many stations, no line can be flown, or there is no way inside the
            allowed area between two lines.
    """
    check_size(task.area, task.pattern, task.max_stations)
    result = lay_pattern(task, heading_rad)
    stations = int(result.steps.sum()) + len(result.steps)
    if stations > task.max_stations:
        raise _too_many(task.area, task.pattern, stations, task.max_stations)
    return result.lines()


def order_lines(
    lines: Sequence[Line], ways: Ways, costs: Costs, home_ne: tuple[float, float]
) -> list[Line]:
    """Any lines in the order, and each in the direction, that costs least.

    Raises:
        PlanError: there is no way inside the allowed area between two of them.
    """
    if not lines:
        return []
    costs, home = hops.comparable(costs), np.array(home_ne, dtype=np.float64)
    corners, inner = np.zeros((len(lines), cells.CORNERS, 3)), np.full((len(lines), 4), np.inf)
    for i, line in enumerate(lines):
        corners[i] = [[*line.start_ne_m, line.heading_rad]] * cells.CORNERS
        corners[i, 1] = [*line.end_ne_m, line.heading_rad + math.pi]
        inner[i, :2] = hops.line_j(costs, line.length_m, corners[i, :2, 2])
    exits = np.tile([1, 0, 1, 0], (len(lines), 1))
    order = _tour(corners, exits, inner, ways, costs, home, None, len(lines))
    flown = [lines[k // 4].reverse() if k % 4 == 1 else lines[k // 4] for k in order.tolist()]
    table = np.array([(*x.start_ne_m, *x.end_ne_m, x.heading_rad) for x in flown])
    _connected_m(*stops(table, home), ways)
    return flown


def check_size(area: Area, pattern: Pattern, max_stations: int = MAX_STATIONS) -> None:
    """Refuse an area that is much too large before lines are laid.

    Raises:
        PlanError: it needs more than twice as many stations.
    """
    stations = area.survey.area / (pattern.spacing_m * pattern.step_m)
    if stations > 2 * max_stations:
        raise _too_many(area, pattern, stations, max_stations)


def lay_pattern(task: LineTask, heading_rad: float, *, quick: bool = False) -> Laid:
    """As `lay_lines`, as arrays and with the cost.

    Quick is without fill lines, and with an order of many cells that is improved, but not shaken.
    """
    site, pattern, costs = task.site, task.pattern, task.bounded
    ways = task.ways.sketch if quick else task.ways.coarse
    pieces, offsets, cuts = survey_pieces(site, heading_rad, pattern)
    if len(pieces) == 0:
        raise PlanError(
            f"no line of heading {math.degrees(heading_rad):.1f} deg can be flown: the allowed "
            "area lets none come near the area to survey: widen it, or area.turn_margin_m"
        )
    ends = _ends_ne(pieces, offsets, heading_rad)
    follower = cells.followers(pieces)
    follower, links_m = _link(ends, follower, ways, pattern.spacing_m)
    begins, listed = cells.chains(follower)
    corners, exits = cells.cell_corners(begins, listed, ends, heading_rad)
    inner = cells.cell_costs(costs, begins, listed, ends, heading_rad, links_m)
    steps = pieces[:, 3].astype(np.int64)
    survey_count, survey_cells = len(pieces), len(inner)
    if task.cross_lines:
        across, cross_steps = _cross(task, heading_rad, pieces, offsets)
        alone = np.arange(len(across) + 1)
        course = heading_rad + math.pi / 2
        more, leaving = cells.cell_corners(alone, alone[:-1], across, course)
        unlinked = np.zeros((len(across), 2))
        singly = cells.cell_costs(costs, alone, alone[:-1], across, course, unlinked)
        corners, exits = np.concatenate([corners, more]), np.concatenate([exits, leaving])
        inner = np.concatenate([inner, singly])
        begins = np.concatenate([begins, begins[-1] + alone[1:]])
        listed = np.concatenate([listed, survey_count + alone[:-1]])
        ends, steps = np.concatenate([ends, across]), np.concatenate([steps, cross_steps])
    home = np.array(task.home_ne, dtype=np.float64)
    piece = _piece_at(begins, listed).ravel()
    closing, closing_steps = _closings(corners, steps[piece], ends, piece)
    closes = task.closing_line and survey_count > 1
    order = _tour(
        corners, exits, inner, ways, costs, home, closing if closes else None, survey_cells, quick
    )
    flown = cells.flight_order(order, begins, listed)
    table = _table(ends, flown, heading_rad, survey_count)
    steps = steps[flown[:, 0]]
    kinds = np.where(flown[:, 0] < survey_count, SURVEY, CROSS).astype(np.int64)
    if closes:
        table = np.concatenate([table, closing[order[:1]]])
        steps = np.concatenate([steps, closing_steps[order[:1]]])
        kinds = np.append(kinds, CLOSING)
    fills = cuts[:0] if quick else fill_table(site, heading_rad, pattern, pieces, offsets, cuts)
    if len(fills):
        table, steps, kinds = _insert(fills, table, steps, kinds, home, ways, costs)
    leave, enter = stops(table, home)
    energy_j = hops.flight_j(costs, leave, enter, _connected_m(leave, enter, ways))
    return Laid(table=table, steps=steps, kinds=kinds, energy_j=energy_j)


def survey_pieces(site: Site, heading_rad: float, pattern: Pattern) -> tuple[Array, Array, Array]:
    """Pieces of the rows over the survey area, offsets of the rows, and cuts; `rows.lay_rows`."""
    survey = rows.to_uv(site.survey, heading_rad)
    allowed = rows.to_uv(site.allowed, heading_rad)
    low, high = float(survey[:, 1].min()), float(survey[:, 1].max())
    offsets = rows.row_offsets(low, high, pattern.spacing_m, pattern.edge_m, pattern.passes)
    # A point needs its `passes` nearest lines, and the last of them is this far at most.
    half_m = pattern.passes * pattern.spacing_m / 2
    pieces, cuts = rows.lay_rows(
        survey, allowed, offsets, half_m, pattern.overhang_m, pattern.step_m, pattern.min_steps
    )
    return pieces, offsets, cuts


def stops(table: Array, home: Array) -> tuple[Array, Array]:
    """Where hops begin and end, (L + 1, 3) each: home and lines' ends; lines' starts and home."""
    at_home = np.array([[*home, np.nan]])
    leave = np.concatenate([at_home, table[:, 2:5]])
    return leave, np.concatenate([table[:, [0, 1, 4]], at_home])


def _connected_m(leave: Array, enter: Array, ways: Ways) -> Array:
    """Lengths, (N,), of the ways of hops.

    Raises:
        PlanError: there is no way for one.
    """
    ways_m = ways.lengths_m(leave[:, :2], enter[:, :2])
    lost = np.flatnonzero(np.isinf(ways_m))
    if len(lost):
        (north_0, east_0, _), (north_1, east_1, _) = leave[lost[0]], enter[lost[0]]
        raise PlanError(
            f"no way inside the allowed area from {north_0:.2f} m north, {east_0:.2f} m east to "
            f"{north_1:.2f}, {east_1:.2f}: its parts are not connected; widen area.turn_margin_m "
            "or survey the parts one by one"
        )
    return ways_m


def _ends_ne(pieces: Array, offsets: Array, heading_rad: float) -> Array:
    """North and east of begin and end of every piece, (P, 4)."""
    across = offsets[pieces[:, 0].astype(np.intp)]
    ends = np.stack([pieces[:, 1], across, pieces[:, 2], across], axis=1)
    turned: Array = rows.to_uv(ends, -heading_rad)
    return turned


def _link(
    ends: Array, follower: NDArray[np.int64], ways: Ways, spacing_m: float
) -> tuple[NDArray[np.int64], Array]:
    """Ways between pieces and their followers; cells are cut where they go far round.

    Returns:
        (P,) followers that are left, and (P, 2) ways from begin to begin and from end to end.
    """
    links_m = np.zeros((len(ends), 2))
    linked = np.flatnonzero(follower >= 0)
    if len(linked) == 0:
        return follower, links_m
    starts = ends[linked].reshape(-1, 2)
    goals = ends[follower[linked]].reshape(-1, 2)
    links_m[linked] = ways.lengths_m(starts, goals).reshape(-1, 2)
    straight = np.hypot(*(goals - starts).T).reshape(-1, 2)
    # Two spacings of detour are worth a choice of the tour.
    far = linked[(links_m[linked] > straight + 2 * spacing_m).any(axis=1)]
    follower = follower.copy()
    follower[far] = -1
    return follower, links_m


def _cross(
    task: LineTask, heading_rad: float, pieces: Array, offsets: Array
) -> tuple[Array, NDArray[np.int64]]:
    """Lines across the survey lines, so that each of these is crossed.

    Returns:
        (N, 4) north and east of begin and end, (N,) steps.
    """
    allowed = rows.to_uv(task.site.allowed, heading_rad)
    found = cross.cross_table(pieces, offsets, allowed, task.pattern, task.cross_lines)
    ends = rows.to_uv(np.ascontiguousarray(found[:, [0, 1, 0, 2]]), -heading_rad)
    return ends, found[:, 3].astype(np.int64)


def _piece_at(begins: NDArray[np.int64], listed: NDArray[np.int64]) -> NDArray[np.int64]:
    """The piece at each corner of each cell, (C, 4)."""
    first, last = listed[begins[:-1]], listed[begins[1:] - 1]
    return np.stack([first, first, last, last], axis=1)


def _closings(
    corners: Array, steps: NDArray[np.int64], ends: Array, piece: NDArray[np.int64]
) -> tuple[Array, NDArray[np.int64]]:
    """Lines from the middle of the line that is flown first back to its start.

    Returns:
        For the flights that begin at each corner (4C, 5) north and east of start and end, course;
        and (4C,) steps.
    """
    flat = corners.reshape(-1, 3)
    half = (steps + 1) // 2
    length = np.hypot(ends[piece, 2] - ends[piece, 0], ends[piece, 3] - ends[piece, 1])
    along = length * half / steps
    middle = flat[:, :2] + along[:, None] * np.stack(
        [np.cos(flat[:, 2]), np.sin(flat[:, 2])], axis=1
    )
    back = flat[:, 2] + math.pi
    return np.concatenate([middle, flat[:, :2], back[:, None]], axis=1), half


def _tour(
    corners: Array,
    exits: NDArray[np.int64],
    inner: Array,
    ways: Ways,
    costs: Costs,
    home: Array,
    closing: Array | None,
    survey_cells: int,
    quick: bool = False,
) -> NDArray[np.int64]:
    """The order of cells: corners of entry, counted through."""

    def improve(first: NDArray[np.int64], problem: tour.Cells, fixed: int) -> NDArray[np.int64]:
        better = tour.improved_tour if quick else tour.good_tour
        order: NDArray[np.int64] = better(first, problem, fixed)
        return order

    size = len(inner)
    enter = corners.reshape(-1, 3)
    leave = enter + np.array([0.0, 0.0, math.pi])
    exits = (exits + cells.CORNERS * np.arange(size)[:, None]).ravel()
    inner = inner.ravel()
    at_home = np.array([[*home, np.nan]])
    places = enter[:, :2]
    all_m = ways.between_m(np.concatenate([home[None], places]))
    home_m, between_m = np.ascontiguousarray(all_m[:1, 1:]), np.ascontiguousarray(all_m[1:, 1:])
    useless = np.isinf(inner)  # the second line of a cell of one
    between_m[useless] = between_m[:, useless] = np.inf
    start = hops.hop_j(costs, at_home, enter, home_m[0])
    over = hops.hop_j(costs, leave[:, None], enter, between_m)
    plain = hops.hop_j(costs, leave, at_home, home_m[0])
    problem = tour.Cells(hops=over, exits=exits, inner=inner, start=start, finish=plain)
    if closing is None:
        if size <= tour.EXACT:
            return np.asarray(tour.exact_tour(problem, plain[None], False)[1])
        return improve(tour.nearest_tour(problem), problem, 0)
    start[cells.CORNERS * survey_cells :] = np.inf

    def finishes(first: NDArray[np.int64]) -> Array:
        """Cost after the last cell, (F, 4C), of flights that begin at corners (F,)."""
        line = closing[first]
        to_m = ways.distances_m(places, line[:, :2])
        to = hops.hop_j(costs, leave[:, None], line[:, [0, 1, 4]], to_m)
        on = hops.hop_j(costs, line[:, 2:5], at_home, home_m[0, first])
        own = hops.line_j(costs, np.hypot(*(line[:, 2:4] - line[:, :2]).T), line[:, 4])
        return np.ascontiguousarray(to.T + (own + on)[:, None])

    if size <= tour.EXACT:
        finish = np.zeros((len(enter), len(enter)))
        able = np.flatnonzero(np.isfinite(start) & np.isfinite(inner))
        finish[able] = finishes(able)
        return np.asarray(tour.exact_tour(problem, finish, True)[1])
    order = tour.improved_tour(tour.nearest_tour(problem), problem, 0)
    # Now that it is known where the flight begins, so is where it ends.
    return improve(order, problem._replace(finish=finishes(order[:1])[0]), 1)


def _table(ends: Array, flown: NDArray[np.int64], heading_rad: float, survey_count: int) -> Array:
    """Lines in order of flight, (L, 5) north and east of start and end, course."""
    piece, back = flown[:, 0], flown[:, 1] == 1
    places = ends[piece]
    places = np.where(back[:, None], places[:, [2, 3, 0, 1]], places)
    course = heading_rad + np.where(piece < survey_count, 0.0, math.pi / 2)
    return np.concatenate([places, (course + np.where(back, math.pi, 0.0))[:, None]], axis=1)


def _insert(
    fills: Array,
    table: Array,
    steps: NDArray[np.int64],
    kinds: NDArray[np.int64],
    home: Array,
    ways: Ways,
    costs: Costs,
) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
    """Fly fill lines, (F, 6) a table and steps, each where its detour costs least."""
    leave, enter = stops(table, home)
    ways_m = ways.lengths_m(leave[:, :2], enter[:, :2])
    for fill in fills:
        leave, enter = stops(table, home)
        over_j = hops.hop_j(costs, leave, enter, ways_m)
        both = np.array([fill[:5], [*fill[2:4], *fill[:2], fill[4] + math.pi]])
        begins, ends = both[:, [0, 1, 4]], both[:, 2:5]
        # No detour is less than one by straight ways, so the search ends early.
        min_j = hops.hop_j(costs, leave[:, None], begins, cdist(leave[:, :2], begins[:, :2]))
        min_j += hops.hop_j(costs, ends, enter[:, None], cdist(enter[:, :2], ends[:, :2]))
        min_j -= over_j[:, None]
        best_j, best, place, best_m = np.inf, both[0], 0, np.zeros(2)
        for index in np.argsort(min_j, axis=None, kind="stable").tolist():
            i, turned = divmod(index, 2)
            if min_j[i, turned] >= best_j:
                break
            there, then = np.stack([leave[i], ends[turned]]), np.stack([begins[turned], enter[i]])
            detour_m = ways.lengths_m(there[:, :2], then[:, :2])
            detour_j = hops.hop_j(costs, there, then, detour_m).sum() - over_j[i]
            if detour_j < best_j:
                best_j, best, place, best_m = detour_j, both[turned], i, detour_m
        table = np.insert(table, place, best, axis=0)
        steps = np.insert(steps, place, int(fill[5]))
        kinds = np.insert(kinds, place, FILL)
        ways_m = np.concatenate([ways_m[:place], best_m, ways_m[place + 1 :]])
    return table, steps, kinds


def _too_many(area: Area, pattern: Pattern, stations: float, maximum: int) -> PlanError:
    return PlanError(
        f"an area of {area.survey.area:.0f} m2 with lines {pattern.spacing_m:.3g} m apart and a "
        f"picture every {pattern.step_m:.3g} m needs about {stations:.2g} stations, more than "
        f"{maximum}: split the area, fly higher or lower the overlaps"
    )
