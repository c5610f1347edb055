"""The area that a dive of some length or energy holds."""

import math
from dataclasses import dataclass

import numpy as np

from alice_survey.base.config import SurveyConfig
from alice_survey.base.errors import PlanError
from alice_survey.vehicle.limits import spot_rate_rad_s
from camera_calib.rig import design_rig
from missions.exposure.settings import imaging_settings


@dataclass(frozen=True, kw_only=True)
class DiveArea:
    """What area a dive holds."""

    dive_s: float
    area_m2: float
    side_m: float
    """Of a square of it."""
    lines: int
    line_spacing_m: float
    speed_mps: float
    turn_s: float
    cross_lines: int


def area_for_dive(config: SurveyConfig, dive_s: float) -> DiveArea:
    """The largest square that a dive holds, with its turns, cross lines, descent and ascent.

    Lines of length a lie s apart: `n = ceil(a / s)` of them and `n - 1` turns, the cross lines and
    the way home at the survey's speed. A real area takes longer the more it is cut up: then
    `alice-survey plan` tells.

    Raises:
        PlanError: the dive is too short for one line of one picture's length.
    """
    from missions.values.costs import time_costs

    rig = design_rig(config.camera, config.water)
    settings, plan = imaging_settings(rig, config, quiet=True), config.plan
    costs = time_costs(plan.speed_mps)
    dive_down_s = costs.dive_s(config.area.seafloor_depth_m - plan.altitude_m)
    spacing = settings.line_spacing_m
    turn = turn_s(config, spacing)

    def needed_s(side_m: float) -> float:
        lines = max(1, math.ceil(side_m / spacing - 1e-9))
        crossing = plan.cross_lines * (side_m / plan.speed_mps + turn)
        home = side_m / plan.speed_mps
        flown = lines * side_m / plan.speed_mps + (lines - 1) * turn
        return dive_down_s + flown + crossing + home

    smallest = settings.footprint_along_m
    if needed_s(smallest) > dive_s:
        raise PlanError(
            f"a dive of {dive_s:g} s is too short: {dive_down_s:.0f} s go down and up, and one "
            f"picture's length takes {needed_s(smallest):.0f} s in all: give a longer dive"
        )
    low, high = smallest, 2.0 * math.sqrt(dive_s * plan.speed_mps * spacing) + smallest
    while high - low > 1e-3:
        middle = (low + high) / 2
        low, high = (middle, high) if needed_s(middle) <= dive_s else (low, middle)
    return DiveArea(
        dive_s=dive_s,
        area_m2=low * low,
        side_m=low,
        lines=max(1, math.ceil(low / spacing - 1e-9)),
        line_spacing_m=spacing,
        speed_mps=plan.speed_mps,
        turn_s=turn,
        cross_lines=plan.cross_lines,
    )


def dive_of_energy_s(config: SurveyConfig, dive_wh: float) -> tuple[float, float]:
    """How long an energy lasts, and the power: of the vehicle on lines, over all its courses."""
    from missions.route.energy import vehicle_costs

    rig = design_rig(config.camera, config.water)
    costs = vehicle_costs(config, imaging_w=imaging_settings(rig, config, quiet=True).imaging_w)
    watts = float(np.mean(costs.line_w[np.isfinite(costs.line_w)]))
    return dive_wh * 3600.0 / watts, watts


def turn_s(config: SurveyConfig, spacing_m: float) -> float:
    """Time from the end of a line to the start of the next, with its run-in.

    Arcs of radius R: a half circle and a straight where lines are 2 R apart or more, else Dubins'
    three arcs `R (pi + 4 acos((2 R + s) / (4 R)))`; on the spot: two right angles and the way
    between. `turns = "auto"` takes the quicker.
    """
    from missions.values.costs import time_costs

    plan = config.plan
    rate_rad_s = spot_rate_rad_s(plan.turn_rate_limit_deg_s)
    costs, radius = time_costs(plan.speed_mps, turn_rate_rad_s=rate_rad_s), plan.turn_radius_m
    if spacing_m >= 2 * radius:
        arcs = math.pi * radius + spacing_m - 2 * radius
    else:
        arcs = radius * (math.pi + 4 * math.acos((2 * radius + spacing_m) / (4 * radius)))
    run_in = plan.run_in_m / plan.speed_mps
    by_arcs = arcs / plan.speed_mps + run_in
    by_spot = 2 * costs.spot_j(math.pi / 2) + spacing_m / plan.speed_mps + run_in
    return {"arcs": by_arcs, "spot": by_spot}.get(plan.turns, min(by_arcs, by_spot))
