"""A plan that flies parts of a survey again, as a workspace of its own."""

import hashlib
import itertools
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely.geometry import MultiPolygon

from alice_survey.core.artefacts import EXPORTS, Stage, run_stage, write_json
from alice_survey.core.config import CameraConfig, PlanConfig, VehicleConfig, WaterConfig
from alice_survey.core.errors import PlanError
from alice_survey.kit.words import count
from camera_calib.rig import Rig
from missions.coverage.certificate import Certificate, certificate
from missions.coverage.holes import Hole
from missions.coverage.stations import stations_of_plan
from missions.exports.format import options_of
from missions.exports.write import write_exports
from missions.lines.fill import lines_over
from missions.lines.lay import order_lines
from missions.route.dives import split_dives
from missions.route.energy import planned_vehicle, usable_wh, without_stops
from missions.route.turns import Manoeuvre, Turns
from missions.route.ways import Ways
from missions.values.area import multipolygon
from missions.values.costs import Costs
from missions.values.line import Line
from missions.values.pattern import Pattern
from missions.values.plan_file import Plan


@dataclass(frozen=True, kw_only=True)
class DiveMeans:
    """What a dive takes, and what it may take."""

    costs: Costs
    """What flying takes."""
    turns: Turns
    """How the vehicle turns: as of `Manoeuvre`."""
    dive_s: float | None
    """How long a dive may be; None: as long as the battery lasts."""
    usable_wh: float
    """What a dive may take of a battery."""


def dive_means(plan: PlanConfig, vehicle: VehicleConfig, costs: Costs) -> DiveMeans:
    """The means of a survey's settings."""
    flown = without_stops(plan, planned_vehicle(vehicle))
    return DiveMeans(
        costs=costs, turns=flown.turns, dive_s=flown.dive_s, usable_wh=usable_wh(vehicle)
    )


def refly_plan(
    plan: Plan,
    rig: Rig,
    outlines: Sequence[MultiPolygon],
    cell_m: float,
    pattern: Pattern,
    means: DiveMeans,
    name: str,
    *,
    ties: Sequence[Line] = (),
    overrun_m: float = 0.0,
) -> Plan:
    """Plan short lines over parts of a survey, at the overlap of its plan.

    The new plan is whole: `fly`, exports and `plan check` take it as any other. Its survey area is
    the parts (what the ties show, where there are none), its allowed area the plan's. It keeps the
    altitude; by depth, that above the shallowest place of a bathymetry. Where a part
    ends between two middles of cells is not known: the whole step counts as missed.

    Args:
        plan: what was flown.
        rig: the cameras.
        outlines: of the parts to see again; x = north, y = east, metres.
        cell_m: side of the cells of which they consist.
        pattern: what lines see, and how often a place must be seen.
        means: of the dives.
        name: what the new plan is, after the name of the old one.
        ties: lines to fly as they are.
        overrun_m: how far lines over the parts go on at both ends, where they may.

    Raises:
        PlanError: there is nothing to see, or lines over it leave the allowed area.
    """
    grown = shapely.union_all(outlines).buffer(cell_m / math.sqrt(2.0), join_style="mitre")
    pieces = multipolygon(grown.intersection(plan.area.survey))
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
    lines = order_lines(lines, ways, means.costs, plan.home_ne_m)
    dives = split_dives(
        lines,
        Manoeuvre(means.costs, plan.turn_radius_m, plan.run_in_m, means.turns, ways),
        home_ne=plan.home_ne_m,
        usable_wh=means.usable_wh,
        max_s=means.dive_s,
        depth_m=plan.seafloor_depth_m - plan.altitude_m,
    )
    again = replace(
        plan,
        name=f"{plan.name} {name}",
        area=replace(plan.area, survey=multipolygon(seen)),
        lines=tuple(lines),
        dives=dives,
        length_m=sum(dive.route.length_m for dive in dives),
        duration_s=sum(dive.duration_s for dive in dives),
        energy_wh=sum(dive.energy_wh for dive in dives),
        seafloor_depth_m=min(itertools.chain(*plan.line_floors_m), default=plan.seafloor_depth_m),
        line_depths_m=(),
        line_floors_m=(),
        way_depths_m=(),
        details={"refly_of": plan.name, "area_m2": multipolygon(seen).area},
    )
    seen_alone = certificate(again.area, rig, stations_of_plan(again), pattern)
    return replace(again, coverage=seen_alone.share_at_overlap)


def holes_plan(
    plan: Plan, rig: Rig, seen: Certificate, holes: Sequence[Hole], means: DiveMeans
) -> Plan:
    """Plan the holes of a dive again, by what it saw or will have seen; as `refly_plan`."""
    outlines = [hole.outline for hole in holes]
    return refly_plan(plan, rig, outlines, seen.grid.cell_m, seen.pattern, means, "holes")


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
        write_exports(part / EXPORTS, plan, rig, options=options_of(camera, settings))

    run_stage(folder, stage, work)
    words = (
        f"{count(len(plan.lines), 'line')}, {count(plan.stations, 'station')}, "
        f"{plan.length_m:.0f} m, {plan.duration_s / 60:.0f} min in "
        f"{count(len(plan.dives), 'dive')}"
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
