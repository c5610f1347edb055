"""Lines and dives of an area, part by part where the vehicle cannot pass between its parts.

Within one part lines are laid and divided into dives as a whole; neighbouring dives share a line.
Parts that are out of reach of each other have dives of their own, each launched and recovered in
its part: between them the vehicle is carried, or goes at the surface.
"""

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import shapely
import shapely.ops
from shapely.geometry import MultiPolygon, Point

from alice_survey.core.config import PlanConfig
from alice_survey.core.errors import warn
from missions.lines.lay import LineTask, check_size, lay_lines
from missions.lines.sweep import Sweep, best_heading
from missions.route.dives import split_dives
from missions.route.turns import Manoeuvre, Zones
from missions.route.ways import TOUCH_M, Ways
from missions.values.area import Area, multipolygon
from missions.values.costs import Costs
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
    settings: PlanConfig,
    pattern: Pattern,
    costs: Costs,
    home_ne: Place,
    *,
    usable_wh: float,
    depth_m: float,
    zones: Zones | None = None,
) -> PlannedDives:
    """Lay the lines of all parts and divide them into dives.

    Args:
        area: what must be seen, and where lines may be.
        settings: heading, turns and limits of a dive.
        pattern: what lines see.
        costs: what to keep low.
        home_ne: where dives begin and end in its part; in others at the place nearest to the home
            of the part before.
        usable_wh: of the battery.
        depth_m: that the vehicle goes down to.
        zones: that the hull keeps out of between lines.

    Raises:
        PlanError: a part cannot be planned.
    """
    check_size(area, pattern)
    parts = parts_of(area, home_ne)
    whole, tied = PlannedDives(lines=(), dives=(), sweep=None), True
    for number, (part, home) in enumerate(parts):
        more = _plan_part(part, settings, pattern, costs, home, usable_wh, depth_m, zones)
        dives = (dive.shift_lines(len(whole.lines)) for dive in more.dives)
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
            f"{len(parts)} parts that the vehicle cannot pass between are surveyed by "
            f"{len(whole.dives)} dives, each launched and recovered in its part: fly them one by "
            "one (vehicle.dive), or join the parts (area.turn_margin_m, or an allowed shape)"
        )
    if len(whole.dives) > len(parts) and not (tied or settings.cross_lines):
        warn(
            f"{len(whole.dives)} dives are tied by the overlap of neighbouring lines "
            "alone: plan.cross_lines = 1 crosses the lines of all of them"
        )
    return whole


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
    surveys = [[multipolygon(area.survey.intersection(group))] for group in groups]
    for piece in multipolygon(area.survey.difference(area.allowed)).geoms:
        nearest = min(range(len(groups)), key=lambda i: groups[i].distance(piece))
        surveys[nearest].append(MultiPolygon([piece]))
    waiting = [
        replace(area, survey=multipolygon(shapely.union_all(pieces)), allowed=group)
        for group, pieces in zip(groups, surveys, strict=True)
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
    settings: PlanConfig,
    pattern: Pattern,
    costs: Costs,
    home_ne: Place,
    usable_wh: float,
    depth_m: float,
    zones: Zones | None,
) -> PlannedDives:
    """Lines and dives of one part; arguments as of `plan_parts`."""
    ways, sweep = Ways(area.allowed), None
    task = LineTask(
        area=area,
        pattern=pattern,
        ways=ways,
        costs=costs,
        home_ne=home_ne,
        cross_lines=settings.cross_lines,
        closing_line=settings.closing_line,
    )
    if settings.line_heading_deg is None:
        sweep = best_heading(task)
    heading = math.radians(settings.line_heading_deg or 0.0) if sweep is None else sweep.heading_rad
    lines = lay_lines(task, heading)
    dives = split_dives(
        lines,
        Manoeuvre(costs, settings.arc_radius_m, settings.run_in_m, settings.turns, ways, zones),
        home_ne=home_ne,
        usable_wh=usable_wh,
        max_s=math.inf if settings.dive_s is None else settings.dive_s,
        depth_m=depth_m,
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
        dives.append(dive.shift_lines(len(lines) - dive.first_line))
        lines += own
    return replace(planned, lines=tuple(lines), dives=tuple(dives))
