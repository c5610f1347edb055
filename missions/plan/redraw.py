"""`alice-survey plan map`: the map of a finished plan drawn again, in another format."""

from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.base.config import SurveyConfig
from camera_calib.rig import design_rig
from missions.coverage.certificate import certificate
from missions.coverage.stations import plan_pattern, stations_of_plan
from missions.plan.map import draw_plan
from missions.plan.planner import area_bathymetry
from missions.values.plan_file import read_plan


def map_report(plan_path: Path, config: SurveyConfig, out: Path) -> tuple[str, dict[str, Any]]:
    """Draw the map of a plan as PNG, PDF or SVG, whichever the suffix says.

    Args:
        plan_path: `plan.json`.
        config: the survey, for its cameras, bathymetry and current.
        out: file to write.

    Raises:
        PlanError: the file is not a plan, or the suffix is not known.
    """
    plan = read_plan(plan_path)
    rig = design_rig(config.camera, config.water)
    bathymetry = area_bathymetry(config.area, plan.area, plan.altitude_m)
    floor_m = None
    if bathymetry is not None:
        floor_m = bathymetry.depth_at(np.vstack([line.stations_ne for line in plan.lines]))
    stations = stations_of_plan(plan, floor_m)
    seen = certificate(plan.area, rig, stations, plan_pattern(plan, rig))
    out.parent.mkdir(parents=True, exist_ok=True)
    draw_plan(out, plan, rig, seen, bathymetry, config.sea)
    return f"map of {plan.name} in {out}", {"plan": plan.name, "file": str(out)}
