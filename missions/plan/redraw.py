"""`alice-survey plan map`: the map of a finished plan anew, in the format asked for."""

from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.base.config import SurveyConfig
from camera_calib.rig import design_rig
from missions.areas.bathymetry import read_bathymetry
from missions.coverage.certificate import certificate
from missions.coverage.stations import plan_pattern, stations_of_plan
from missions.plan.map import draw_plan
from missions.values.plan_file import read_plan


def map_report(plan_path: Path, config: SurveyConfig, out: Path) -> tuple[str, dict[str, Any]]:
    """Draw the map of a plan as PNG, PDF or SVG, whichever the suffix says.

    Args:
        plan_path: `plan.json`.
        config: the survey, for its cameras, bathymetry and current.
        out: file to write.

    Raises:
        PlanError: it is no plan, or the suffix is not known.
    """
    plan = read_plan(plan_path)
    rig = design_rig(config.camera, config.water)
    bathymetry, floor_m = None, None
    if config.area.bathymetry_file is not None:
        bathymetry = read_bathymetry(
            config.area.bathymetry_file,
            plan.datum,
            bounds_ne=plan.area.allowed.buffer(4.0 * plan.altitude_m).bounds,
            sense=config.area.bathymetry_values,
            crs=config.area.bathymetry_crs,
        )
        floor_m = bathymetry.depth_at(np.vstack([line.stations_ne for line in plan.lines]))
    stations = stations_of_plan(plan, floor_m)
    seen = certificate(plan.area, rig, stations, plan_pattern(plan, rig))
    out.parent.mkdir(parents=True, exist_ok=True)
    draw_plan(out, plan, rig, seen, bathymetry, config.sea)
    return f"map of {plan.name} in {out}", {"plan": plan.name, "file": str(out)}
