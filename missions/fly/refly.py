"""A plan that flies the holes of a dive again."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import shapely
from shapely.geometry import MultiPolygon

from alice_survey.base.config import PlanConfig
from alice_survey.base.errors import PlanError
from camera_calib.rig import Rig
from missions.coverage.certificate import Certificate, certificate
from missions.coverage.holes import Hole
from missions.coverage.stations import stations_of_plan
from missions.lines.fill import lines_over
from missions.lines.lay import ordered
from missions.route.dives import split_dives
from missions.route.ways import Ways
from missions.values.area import Area, multipolygon
from missions.values.costs import Costs
from missions.values.plan_file import Plan


def refly_plan(
    plan: Plan,
    rig: Rig,
    flown: Certificate,
    holes: Sequence[Hole],
    *,
    costs: Costs,
    settings: PlanConfig,
    usable_wh: float,
) -> Plan:
    """Plan short lines over the holes, at the overlap of the plan itself.

    The new plan is whole: `fly`, exports and `plan check` take it as any other. Its survey area is
    the holes, its allowed area the plan's.

    Args:
        plan: what was flown.
        rig: the cameras.
        flown: the certificate of what was flown.
        holes: its holes.
        costs: what flying takes.
        settings: how the vehicle turns and how long a dive may be.
        usable_wh: what a dive may take of a battery.

    Raises:
        PlanError: there are none, or lines over them leave the allowed area.
    """
    if not holes:
        raise PlanError("no hole to fly again")
    area = replace(plan.area, survey=to_see(plan.area, flown, holes))
    lines = lines_over(area.survey, area, flown.pattern)
    if not lines:
        raise PlanError(f"no line inside the allowed area sees any of the {len(holes)} holes")
    ways = Ways(area.allowed)
    lines = ordered(lines, ways, costs, plan.home_ne_m)
    dives = split_dives(
        lines,
        ways=ways,
        costs=costs,
        home_ne=plan.home_ne_m,
        turn_radius_m=plan.turn_radius_m,
        run_in_m=plan.run_in_m,
        turns=settings.turns,
        usable_wh=usable_wh,
        longest_s=settings.dive_s,
        depth_m=plan.seafloor_depth_m - plan.altitude_m,
        split=settings.split_dives,
    )
    again = replace(
        plan,
        name=f"{plan.name} holes",
        area=area,
        lines=tuple(lines),
        dives=dives,
        length_m=sum(dive.route.length_m for dive in dives),
        duration_s=sum(dive.duration_s for dive in dives),
        energy_wh=sum(dive.energy_wh for dive in dives),
        line_depths_m=(),
        details={"refly_of": plan.name, "holes": len(holes), "area_m2": area.survey.area},
    )
    seen = certificate(area, rig, stations_of_plan(again), flown.pattern)
    return replace(again, coverage=seen.share_at_overlap)


def to_see(area: Area, flown: Certificate, holes: Sequence[Hole]) -> MultiPolygon:
    """The holes, and half a cell's diagonal round them, inside of the survey area.

    Where a hole ends between two middles of cells is not known: the whole step counts as missed.
    """
    grown = shapely.union_all([hole.outline for hole in holes]).buffer(
        flown.grid.cell_m / np.sqrt(2.0), join_style="mitre"
    )
    return multipolygon(grown.intersection(area.survey))
