"""Lines and dives of an area, part by part where the vehicle cannot pass between its parts.

Within one part lines are laid and divided into dives as a whole; neighbouring dives share a line.
Parts that are out of reach of each other have dives of their own, each launched and recovered in
its part: between them the vehicle is carried, or goes at the surface.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import shapely
import shapely.ops
from shapely.geometry import MultiPolygon, Point

from alice_survey.core.config import PlanConfig
from alice_survey.core.errors import warn
from missions.lines.lay import check_size, lay_lines
from missions.lines.sweep import Sweep, best_heading
from missions.route.dives import split_dives
from missions.route.fence import TOUCH_M
from missions.route.ways import Ways
from missions.values.area import Area, multipolygon
from missions.values.costs import Costs, power_at
from missions.values.legs import Route
from missions.values.line import Line
from missions.values.pattern import Pattern
from missions.values.plan_file import Dive

Place = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class PlannedDives:
    """Lines in the order of flight, and the dives along them."""

    lines: tuple[Line, ...]
    dives: tuple[Dive, ...]
    sweep: Sweep | None
    """How the heading of the first part was found; None where it is set."""


def plan_parts(
    area: Area,
    wanted: PlanConfig,
    pattern: Pattern,
    costs: Costs,
    home_ne: Place,
    *,
    usable_wh: float,
    depth_m: float,
) -> PlannedDives:
    """Lay the lines of all parts and divide them into dives.

    Args:
        area: what must be seen, and where lines may be.
        wanted: heading, turns and limits of a dive.
        pattern: what lines see.
        costs: what to keep low.
        home_ne: where dives begin and end in its part; in others at the place nearest to the home
            of the part before.
        usable_wh: of the battery.
        depth_m: that the vehicle goes down to.

    Raises:
        PlanError: a part cannot be planned.
    """
    check_size(area, pattern)
    parts = parts_of(area, home_ne)
    whole, tied = PlannedDives(lines=(), dives=(), sweep=None), True
    for number, (part, home) in enumerate(parts):
        more = _plan_part(part, wanted, pattern, costs, home, usable_wh, depth_m)
        dives = (_from_line(dive, len(whole.lines)) for dive in more.dives)
        tied = tied and all(
            after.first_line == before.last_line + 1 and more.lines[after.first_line].kind == "tie"
            for before, after in pairwise(more.dives)
        )
        whole = PlannedDives(
            lines=(*whole.lines, *more.lines),
            dives=(*whole.dives, *dives),
            sweep=more.sweep if number == 0 else whole.sweep,
        )
    if len(parts) > 1:
        warn(
            f"{len(parts)} parts are surveyed by {len(whole.dives)} dives, each launched and "
            "recovered in its part: fly them one by one (vehicle.dive). "
            + transit_text(whole.dives, costs, usable_wh)
        )
    if len(whole.dives) > len(parts) and not (tied or wanted.cross_lines):
        warn(
            f"{len(whole.dives)} dives are tied by the overlap of neighbouring lines "
            "alone: plan.cross_lines = 1 crosses the lines of all of them"
        )
    return whole


def transit_text(dives: Sequence[Dive], costs: Costs, usable_wh: float) -> str:
    """What it takes to go from dive to dive at the surface, and how many charges all then need.

    Each charge holds as many dives, one after the other, as fit with the ways between them; by the
    power of ways between lines. Ascent and descent are in the dives.

    Args:
        dives: in order; where one begins elsewhere than the one before there is a way.
        costs: of the vehicle.
        usable_wh: of the battery.
    """
    ways_m, ways_wh = [], []
    for before, after in pairwise(dives):
        (north, east), (north_2, east_2) = before.home_ne_m, after.home_ne_m
        way_m = math.hypot(north_2 - north, east_2 - east)
        power_w = power_at(costs.way_w, math.atan2(east_2 - east, north_2 - north))
        ways_m.append(way_m)
        ways_wh.append(way_m / costs.speed_mps * power_w / 3600.0)
    charges, spent_wh = 1, dives[0].energy_wh
    for dive, way_wh in zip(dives[1:], ways_wh, strict=True):
        spent_wh += way_wh + dive.energy_wh
        if spent_wh > usable_wh:
            charges, spent_wh = charges + 1, dive.energy_wh
    total_m = sum(ways_m)
    text = (
        f"At the surface the {total_m:.0f} m between them take "
        f"{total_m / costs.speed_mps / 60:.0f} min and {sum(ways_wh):.1f} Wh"
    )
    if charges == len(dives):
        return f"{text}, but no charge holds two dives and the way between: carry the vehicle"
    held = "one charge holds" if charges == 1 else f"{charges} charges hold"
    return f"{text}: {held} all dives without recovery between them"


def parts_of(area: Area, home_ne: Place) -> list[tuple[Area, Place]]:
    """The parts of an area that the vehicle cannot pass between, and where dives begin in each.

    The part of home comes first, then always the nearest to the home before. What is to be seen
    where the vehicle may not be counts to the part nearest to it.
    """
    grown = multipolygon(area.allowed.buffer(TOUCH_M / 2))
    groups = [
        MultiPolygon([piece for piece in area.allowed.geoms if piece.intersects(group)])
        for group in grown.geoms
    ]
    groups = [group for group in groups if group.intersects(area.survey)]
    if len(groups) < 2:
        return [(area, home_ne)]
    wanted = [[multipolygon(area.survey.intersection(group))] for group in groups]
    for piece in multipolygon(area.survey.difference(area.allowed)).geoms:
        nearest = min(range(len(groups)), key=lambda i: groups[i].distance(piece))
        wanted[nearest].append(MultiPolygon([piece]))
    waiting = [
        replace(area, survey=multipolygon(shapely.union_all(pieces)), allowed=group)
        for group, pieces in zip(groups, wanted, strict=True)
        if any(not piece.is_empty for piece in pieces)
    ]
    ordered, place = [], home_ne
    while waiting:
        part = min(waiting, key=lambda one: one.allowed.distance(Point(place)))
        waiting.remove(part)
        if part.allowed.distance(Point(place)) > TOUCH_M:
            entry, _ = shapely.ops.nearest_points(part.allowed, Point(place))
            place = (round(float(entry.x), 9), round(float(entry.y), 9))
        ordered.append((part, place))
    return ordered


def _plan_part(
    area: Area,
    wanted: PlanConfig,
    pattern: Pattern,
    costs: Costs,
    home_ne: Place,
    usable_wh: float,
    depth_m: float,
) -> PlannedDives:
    """Lines and dives of one part; arguments as of `plan_parts`."""
    ways, sweep = Ways(area.allowed), None
    cross_lines, closing_line = wanted.cross_lines, wanted.closing_line
    if wanted.line_heading_deg is None:
        sweep = best_heading(
            area, pattern, ways, costs, home_ne, cross_lines=cross_lines, closing_line=closing_line
        )
        heading = sweep.heading_rad
    else:
        heading = math.radians(wanted.line_heading_deg)
    lines = lay_lines(
        area,
        heading,
        pattern,
        ways,
        costs,
        home_ne,
        cross_lines=cross_lines,
        closing_line=closing_line,
    )
    dives = split_dives(
        lines,
        ways=ways,
        costs=costs,
        home_ne=home_ne,
        turn_radius_m=wanted.arc_radius_m,
        run_in_m=wanted.run_in_m,
        turns=wanted.turns,
        usable_wh=usable_wh,
        max_s=math.inf if wanted.dive_s is None else wanted.dive_s,
        depth_m=depth_m,
        split=True,
        tied=True,
    )
    return with_ties(PlannedDives(lines=tuple(lines), dives=dives, sweep=sweep))


def with_ties(planned: PlannedDives) -> PlannedDives:
    """The same with lines that a dive flies again as lines of their own, of kind tie."""
    lines: list[Line] = []
    dives: list[Dive] = []
    for dive in planned.dives:
        own = list(planned.lines[dive.first_line : dive.last_line + 1])
        if dives and dive.first_line <= planned.dives[len(dives) - 1].last_line:
            own[0] = replace(own[0], kind="tie")
        dives.append(_from_line(dive, len(lines) - dive.first_line))
        lines += own
    return replace(planned, lines=tuple(lines), dives=tuple(dives))


def _from_line(dive: Dive, count: int) -> Dive:
    """A dive whose lines are counted from another one on."""
    if count == 0:
        return dive
    legs = [
        replace(leg, line=leg.line + count) if leg.line >= 0 else leg for leg in dive.route.legs
    ]
    return replace(
        dive,
        first_line=dive.first_line + count,
        last_line=dive.last_line + count,
        route=Route(legs=tuple(legs)),
    )
