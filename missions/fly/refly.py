"""A plan that flies parts of a survey again, as a workspace of its own."""

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely.geometry import MultiPolygon

from alice_survey.core.artefacts import Stage, run_stage, write_json
from alice_survey.core.config import CameraConfig, PlanConfig, SurveyConfig, WaterConfig
from alice_survey.core.errors import PlanError
from camera_calib.rig import Rig
from missions.coverage.certificate import Certificate, certificate
from missions.coverage.holes import Hole
from missions.coverage.stations import stations_of_plan
from missions.exports.options import options_of
from missions.exports.write import count_text, write_exports
from missions.lines.fill import lines_over
from missions.lines.lay import order_lines
from missions.route.dives import split_dives
from missions.route.energy import planned_vehicle, usable_wh
from missions.route.flyable import without_stops
from missions.route.turns import Manoeuvre
from missions.route.ways import Ways
from missions.values.area import Area, multipolygon
from missions.values.costs import Costs
from missions.values.line import Line
from missions.values.pattern import Pattern
from missions.values.plan_file import Dive, Plan


def refly_plan(
    plan: Plan,
    rig: Rig,
    pieces: MultiPolygon,
    pattern: Pattern,
    *,
    name: str,
    costs: Costs,
    settings: PlanConfig,
    usable_wh: float,
    ties: Sequence[Line] = (),
    overrun_m: float = 0.0,
) -> Plan:
    """Plan short lines over parts of a survey, at the overlap of its plan.

    The new plan is whole: `fly`, exports and `plan check` take it as any other. Its survey area is
    the parts (what the ties show, where there are none), its allowed area the plan's.

    Args:
        plan: what was flown.
        rig: the cameras.
        pieces: what to see again; x = north, y = east, metres.
        pattern: what lines see, and how often a place must be seen.
        name: of the new plan.
        costs: what flying takes.
        settings: how the vehicle turns and how long a dive may be.
        usable_wh: what a dive may take of a battery.
        ties: lines to fly as they are.
        overrun_m: how far lines over the pieces go on at both ends, where they may.

    Raises:
        PlanError: there is nothing to see, or lines over it leave the allowed area.
    """
    lines = lines_over(pieces, replace(plan.area, survey=pieces), pattern) if pieces.area else []
    lines = [*(_longer(line, overrun_m, plan) for line in lines), *ties]
    if not lines:
        raise PlanError(f"no line inside the allowed area sees any of the {pieces.area:.3g} m2")
    swaths = [
        shapely.LineString([line.start_ne_m, line.end_ne_m]).buffer(pattern.half_across_m)
        for line in ties
    ]
    seen = pieces if pieces.area else shapely.union_all(swaths).intersection(plan.area.survey)
    ways = Ways(plan.area.allowed)
    lines = order_lines(lines, ways, costs, plan.home_ne_m)
    dives = split_dives(
        lines,
        Manoeuvre(costs, plan.turn_radius_m, plan.run_in_m, settings.turns, ways),
        home_ne=plan.home_ne_m,
        usable_wh=usable_wh,
        max_s=settings.dive_s,
        depth_m=plan.seafloor_depth_m - plan.altitude_m,
    )
    again = again_over(plan, multipolygon(seen), lines, dives, name)
    seen_alone = certificate(again.area, rig, stations_of_plan(again), pattern)
    return replace(again, coverage=seen_alone.share_at_overlap)


def holes_plan(
    plan: Plan,
    rig: Rig,
    seen: Certificate,
    holes: Sequence[Hole],
    config: SurveyConfig,
    costs: Costs,
) -> Plan:
    """Plan the holes of a dive again.

    Args:
        plan: what was flown.
        rig: the cameras.
        seen: what the dive saw, or will have seen.
        holes: of it.
        config: the survey.
        costs: what flying takes.

    Raises:
        PlanError: as `refly_plan`.
    """
    return refly_plan(
        plan,
        rig,
        to_see(plan.area, seen, holes),
        seen.pattern,
        name=f"{plan.name} holes",
        costs=costs,
        settings=without_stops(config.plan, planned_vehicle(config.vehicle)),
        usable_wh=usable_wh(config.vehicle),
    )


def again_over(
    plan: Plan, seen: MultiPolygon, lines: Sequence[Line], dives: tuple[Dive, ...], name: str
) -> Plan:
    """A plan of other lines over a part of the survey area, with all else as it was.

    Args:
        plan: what was flown.
        seen: the part, the new survey area.
        lines: in the order of flight.
        dives: along them.
        name: of the new plan.
    """
    return replace(
        plan,
        name=name,
        area=replace(plan.area, survey=seen),
        lines=tuple(lines),
        dives=dives,
        length_m=sum(dive.route.length_m for dive in dives),
        duration_s=sum(dive.duration_s for dive in dives),
        energy_wh=sum(dive.energy_wh for dive in dives),
        line_depths_m=(),
        details={"refly_of": plan.name, "area_m2": seen.area},
    )


def _longer(line: Line, overrun_m: float, plan: Plan) -> Line:
    """A line with more pictures at each end, as far as that is allowed."""
    steps = math.ceil(overrun_m / plan.station_spacing_m)
    ahead = plan.station_spacing_m * np.array(
        [math.cos(line.heading_rad), math.sin(line.heading_rad)]
    )
    for _ in range(steps):
        start, end = line.start_ne_m - ahead, line.end_ne_m + ahead
        if not plan.area.allowed.covers(shapely.LineString([start, end])):
            break
        line = replace(
            line,
            start_ne_m=(float(start[0]), float(start[1])),
            end_ne_m=(float(end[0]), float(end[1])),
            stations=line.stations + 2,
        )
    return line


def to_see(area: Area, flown: Certificate, holes: Sequence[Hole]) -> MultiPolygon:
    """The holes, and half a cell's diagonal round them, inside of the survey area.

    Where a hole ends between two middles of cells is not known: the whole step counts as missed.
    """
    grown = shapely.union_all([hole.outline for hole in holes]).buffer(
        flown.grid.cell_m / np.sqrt(2.0), join_style="mitre"
    )
    return multipolygon(grown.intersection(area.survey))


def write_refly(
    folder: Path,
    plan: Plan,
    rig: Rig,
    camera: CameraConfig,
    water: WaterConfig,
    settings: PlanConfig,
) -> tuple[str, dict[str, Any]]:
    """Write a plan that flies something again as a workspace to fly in.

    Returns:
        What it takes, in words and as JSON values.
    """  # fmt: skip
    values = plan.to_json()
    text = json.dumps(values, sort_keys=True)
    stage = Stage(
        name="plan",
        version=1,
        settings={
            "camera": camera.model_dump(mode="json"),
            "water": water.model_dump(mode="json"),
            "plan": settings.model_dump(mode="json"),
            "refly_of": plan.details["refly_of"],
            "digest": hashlib.blake2b(text.encode(), digest_size=16).hexdigest(),
        },
    )

    def work(part: Path) -> None:
        write_json(part / "plan.json", values)
        write_exports(part / "exports", plan, rig, options=options_of(camera, settings))

    run_stage(folder, stage, work)
    words = (
        f"{count_text(len(plan.lines), 'line')}, {count_text(plan.stations, 'station')}, "
        f"{plan.length_m:.0f} m, {plan.duration_s / 60:.0f} min in "
        f"{count_text(len(plan.dives), 'dive')}"
    )
    return words, {
        "folder": str(folder),
        "lines": len(plan.lines),
        "stations": plan.stations,
        "dives": len(plan.dives),
        "length_m": plan.length_m,
        "duration_s": plan.duration_s,
        "energy_wh": plan.energy_wh,
        "coverage": plan.coverage,
        "area_m2": plan.area.survey.area,
    }
