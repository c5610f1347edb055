"""Lines that close the holes of a dive before the vehicle comes up, within the time it has left.

Holes near one another are seen by the same lines and make a group. Groups are taken in the order of
the area that they give for a second of flight, as long as the route through all that are taken -
from where the last planned line ends, inside the allowed area, with its turns, and home - takes no
more time and energy than there is. Of a group that does not fit as a whole those of its lines are
taken that do, and of one more line the part that does. What the lines give is counted, not guessed:
by the certificate of all pictures so far, those that are still planned, and theirs.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import shapely
from shapely.geometry import MultiPolygon

from alice_survey.core.config import PlanConfig
from alice_survey.core.errors import PlanError
from missions.coverage.certificate import Certificate
from missions.coverage.holes import Hole
from missions.coverage.stations import Stations, stations_of_lines
from missions.fly.refly import again_over, to_see
from missions.lines.fill import LEFT_SHARE, lines_over
from missions.lines.lay import ordered
from missions.route.turns import legs_through, line_table, route_of
from missions.route.ways import Ways
from missions.values.area import multipolygon
from missions.values.costs import Costs, leg_costs
from missions.values.legs import Route
from missions.values.line import Line
from missions.values.plan_file import Dive, Plan

_MAX_GROUPS = 40
"""So many groups of holes, the largest, are looked at."""
_J_PER_WH = 3600.0


@dataclass(frozen=True, kw_only=True)
class Budget:
    """What the lines may take beyond the rest of the plan."""

    time_s: float
    """May be infinite."""
    energy_wh: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Proposal:
    """Lines over holes, as a plan to fly when the planned lines are flown."""

    plan: Plan
    """It begins where the last planned line ends, and ends at home."""
    extra_s: float
    """Time that it takes beyond the way home from there, at the vehicle's pace."""
    extra_wh: float
    holes_m2: float
    """Area of all holes now."""
    gain_m2: float
    """The part of it that its pictures bring to the overlap requested."""
    groups: int
    """How many groups of holes it flies over, of all."""
    of_groups: int
    expected: Certificate
    """Coverage once it is flown after all that is planned."""

    def to_json(self) -> dict[str, Any]:
        """Its figures and lines."""
        return {
            "lines": [
                {"start_ne": list(line.start_ne_m), "end_ne": list(line.end_ne_m)}
                for line in self.plan.lines
            ],
            "route_ne": _drawn(self.plan.dives[0].route),
            "stations": self.plan.stations,
            "extra_s": self.extra_s,
            "extra_wh": self.extra_wh,
            "holes_m2": self.holes_m2,
            "gain_m2": self.gain_m2,
            "groups": self.groups,
            "of_groups": self.of_groups,
            "share_at_overlap": self.expected.share_at_overlap,
        }


@dataclass(frozen=True, kw_only=True, eq=False)
class Flying:
    """How the vehicle may fly a proposal."""

    plan: Plan
    costs: Costs
    settings: PlanConfig
    start_ne: tuple[float, float]
    """Where it begins."""
    home_s: float
    """Planned time of the way home from there, which it takes the place of."""
    home_j: float
    pace: float
    """True time over planned time."""

    @property
    def ways(self) -> Ways:
        """Ways inside the allowed area."""
        return _ways(self.plan.area.allowed)


@lru_cache(maxsize=4)
def _ways(allowed: MultiPolygon) -> Ways:
    return Ways(allowed)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Group:
    pieces: MultiPolygon
    area_m2: float
    lines: tuple[Line, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class _OrderedLines:
    """Lines in the order of flight, and what they take beyond the way home."""

    lines: tuple[Line, ...]
    route: Route
    time_s: float
    energy_wh: float

    def within(self, budget: Budget) -> bool:
        return self.time_s <= budget.time_s and self.energy_wh <= budget.energy_wh


def propose(
    flying: Flying,
    expected: Certificate,
    holes: Sequence[Hole],
    with_more: Callable[[Stations], Certificate],
    budget: Budget,
) -> Proposal | None:
    """The lines that close most of the holes within a budget.

    Args:
        flying: how.
        expected: coverage when all that is planned is flown.
        holes: of it.
        with_more: the same with more stations, level and at the plan's altitude.
        budget: what they may take.

    Returns:
        The proposal; None where there are no holes, none can be seen from the allowed area, or
        nothing fits the budget.
    """
    groups = _groups(flying.plan, expected, holes)
    alone = [_flown(flying, group.lines) for group in groups]
    worth = [
        0.0 if flown is None else group.area_m2 / max(flown.time_s, 1e-3)
        for group, flown in zip(groups, alone, strict=True)
    ]
    minimum = 1 + expected.pattern.pictures  # fewer give no place the overlap requested
    best: _OrderedLines | None = None
    taken: list[_Group] = []
    for index in np.argsort(worth, kind="stable")[::-1].tolist():
        if worth[index] > 0.0:
            more = _with_group(flying, best, groups[index], budget, minimum)
            if more is not None:
                best = more
                taken.append(groups[index])
    if best is None:
        return None
    return _proposal(flying, expected, holes, with_more, best, taken, len(groups))


def _groups(plan: Plan, expected: Certificate, holes: Sequence[Hole]) -> list[_Group]:
    """Holes near one another with the lines that see them, the largest groups first."""
    pattern = expected.pattern
    near_m = 2 * max(pattern.half_across_m, pattern.half_along_m)
    found = []
    outlines = [hole.outline for hole in holes]
    if not outlines:
        return []
    joint = shapely.union_all(outlines).buffer(near_m / 2)
    for zone in multipolygon(joint).geoms:
        inside = [hole for hole in holes if zone.intersects(hole.outline)]
        area_m2 = sum(hole.area_m2 for hole in inside)
        if area_m2 >= LEFT_SHARE * plan.area.survey.area:
            found.append((area_m2, to_see(plan.area, expected, inside)))
    found = sorted(found, key=lambda pair: -pair[0])[:_MAX_GROUPS]
    groups = []
    for area_m2, pieces in found:
        lines = lines_over(pieces, replace(plan.area, survey=pieces), pattern)
        if lines:
            groups.append(_Group(pieces=pieces, area_m2=area_m2, lines=tuple(lines)))
    return groups


def _with_group(
    flying: Flying, before: _OrderedLines | None, group: _Group, budget: Budget, minimum: int
) -> _OrderedLines | None:
    """What is flown already and a group, or what of its lines fits; None: nothing of it.

    Args:
        flying: how.
        before: what is flown already.
        group: to add.
        budget: of all.
        minimum: pictures of a line that is cut short.
    """
    kept = () if before is None else before.lines
    best = _fitting(flying, (*kept, *group.lines), budget)
    if best is not None:
        return best
    # More lines, and longer ones, take longer: the most that fit are found by halving.
    count, best = _maximum(
        len(group.lines), lambda n: _fitting(flying, (*kept, *group.lines[:n]), budget)
    )
    kept = (*kept, *group.lines[:count])
    cut, longest = group.lines[count], 0
    for line in (cut, cut.reversed()):

        def part(stations: int, line: Line = line) -> _OrderedLines | None:
            return _fitting(flying, (*kept, _shortened(line, stations)), budget)

        stations, flown = _maximum(line.stations, part, minimum=minimum)
        if flown is not None and stations > longest:
            longest, best = stations, flown
    return best


def _maximum(
    count: int, tried: Callable[[int], _OrderedLines | None], minimum: int = 1
) -> tuple[int, _OrderedLines | None]:
    """The most, under `count`, of something that fits, and what is flown then; 0 of none."""
    low, high, best = minimum - 1, count, None
    while high - low > 1:
        middle = (low + high) // 2
        flown = tried(middle)
        low, high = (low, middle) if flown is None else (middle, high)
        best = best if flown is None else flown
    return (low if best is not None else 0), best


def _shortened(line: Line, stations: int) -> Line:
    """The first pictures of a line."""
    end = line.stations_ne[stations - 1]
    return replace(line, end_ne_m=(float(end[0]), float(end[1])), stations=stations)


def _fitting(flying: Flying, lines: tuple[Line, ...], budget: Budget) -> _OrderedLines | None:
    flown = _flown(flying, lines)
    return flown if flown is not None and flown.within(budget) else None


def _flown(flying: Flying, lines: tuple[Line, ...]) -> _OrderedLines | None:
    """The best order of lines; None where they cannot be reached or flown."""
    plan, costs = flying.plan, flying.costs
    try:
        order = ordered(lines, flying.ways, costs, flying.start_ne)
        legs = legs_through(
            line_table(order), plan.turn_radius_m, plan.run_in_m, ways=flying.ways, costs=costs,
            turns=flying.settings.turns, home_ne=plan.home_ne_m, start_ne=flying.start_ne,
        )  # fmt: skip
        route = route_of(legs)
    except PlanError:
        return None
    energy_j, time_s = (float(np.sum(part)) for part in leg_costs(route, costs))
    extra_j, extra_s = energy_j - flying.home_j, time_s - flying.home_s
    if not np.isfinite(extra_j):
        return None
    return _OrderedLines(
        lines=tuple(order),
        route=route,
        time_s=flying.pace * extra_s,
        energy_wh=flying.pace * extra_j / _J_PER_WH,
    )


def _proposal(
    flying: Flying,
    expected: Certificate,
    holes: Sequence[Hole],
    with_more: Callable[[Stations], Certificate],
    flown: _OrderedLines,
    taken: Sequence[_Group],
    groups: int,
) -> Proposal:
    plan, costs = flying.plan, flying.costs
    seen = multipolygon(shapely.union_all([group.pieces for group in taken]))
    energy_j, time_s = (float(np.sum(part)) for part in leg_costs(flown.route, costs))
    depth_m = plan.seafloor_depth_m - plan.altitude_m
    dive = Dive(
        first_line=0,
        last_line=len(flown.lines) - 1,
        route=flown.route,
        duration_s=time_s + costs.dive_s(depth_m) / 2,
        energy_wh=(energy_j + costs.dive_j(depth_m) / 2) / _J_PER_WH,
    )
    again = again_over(plan, seen, flown.lines, (dive,), f"{plan.name} holes")
    after = with_more(stations_of_lines(flown.lines, plan.altitude_m))
    cell_m2 = expected.grid.cell_m**2
    closed = expected.inside & ~expected.at_overlap & after.at_overlap
    short = sum(hole.area_m2 for hole in holes)
    gain_m2 = float(np.count_nonzero(closed)) * cell_m2
    return Proposal(
        plan=replace(again, coverage=after.share_at_overlap),
        extra_s=flown.time_s,
        extra_wh=flown.energy_wh,
        holes_m2=short,
        gain_m2=gain_m2,
        groups=len(taken),
        of_groups=groups,
        expected=after,
    )


def _drawn(route: Route) -> list[list[float]]:
    along = np.linspace(0.0, route.length_m, max(2, round(route.length_m / 0.25)))
    places: list[list[float]] = np.round(route.places(along), 3).tolist()
    return places
