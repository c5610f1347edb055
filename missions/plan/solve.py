"""The plan solved the other way: for a resolution, the length of a dive or a frame rate."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from alice_survey.core.artefacts import json_values
from alice_survey.core.config import PlanConfig, SurveyConfig
from alice_survey.core.errors import ConfigError, PlanError
from alice_survey.sim.vehicle.pilot.settings import turn_in_place_rate_rad_s
from missions.exposure.settings import ImagingSetup, imaging_settings
from missions.exposure.solve import (
    lens_text,
    lenses_for_resolution,
    rate_text,
    speeds_for_rate,
    with_lens,
)
from missions.exposure.ways_out import ConflictError
from missions.plan.ready import with_tried_ways
from missions.plan.strength import survey_costs
from missions.plan.trade import both_ways_w
from missions.route.energy import craft_of, usable_wh
from missions.route.flyable import as_flown, without_stops
from missions.values.costs import time_costs


@dataclass(frozen=True, kw_only=True)
class DiveArea:
    """The area that a dive covers."""

    dive_s: float
    """Time that it takes; less than what is given where the battery ends it."""
    energy_wh: float
    usable_wh: float
    """What a dive may take of the battery."""
    area_m2: float
    side_m: float
    """Side of a square of that area."""
    lines: int
    line_spacing_m: float
    speed_mps: float
    turn_s: float
    cross_lines: int


def solve_report(
    config: SurveyConfig,
    *,
    resolution_mm: float | None = None,
    dive_s: float | None = None,
    rate_hz: float | None = None,
    lenses: Sequence[float] = (12.5, 25.0),
) -> tuple[str, dict[str, Any]]:
    """Settings for what is given, as text and as JSON values; each that is given has its part.

    Args:
        config: all else of the survey.
        resolution_mm: size of a pixel on the sea floor at the mean altitude: find altitude and
            lens.
        dive_s: time of a dive: find the area that fits; with a resolution, at its altitude and
            lens.
        rate_hz: pictures a second: find the speed.
        lenses: available focal lengths, mm.

    Raises:
        ConfigError: nothing is given.
        PlanError: no lens fits; the message names what conflicts and the ways out.
    """
    parts: list[str] = []
    data: dict[str, Any] = {}
    setup, dived = ImagingSetup.of(config), config
    if resolution_mm is not None:
        options = lenses_for_resolution(setup, config.area.seafloor_depth_m, resolution_mm, lenses)
        parts.append(lens_text(options, resolution_mm))
        data["lenses"] = json_values(options)
        taken = with_lens(setup, options[0])
        dived = config.model_copy(update={"camera": taken.camera, "plan": taken.plan})
    if dive_s is not None:
        area = area_for_dive(dived, dive_s)
        parts.append(_area_text(area, dived, dive_s))
        data["dive"] = asdict(area)
    if rate_hz is not None:
        rates = speeds_for_rate(setup, rate_hz, lenses)
        parts.append(rate_text(rates, rate_hz, setup.plan.speed_mps))
        data["rates"] = json_values(rates)
    if not parts:
        raise ConfigError("say what is given: a resolution (mm), a dive (s) or a rate (Hz)")
    return "\n\n".join(parts), data


def area_for_dive(config: SurveyConfig, dive_s: float) -> DiveArea:
    """The largest square that a dive holds, with its turns, cross lines, descent and ascent.

    Lines of length a lie s apart: `n = ceil(a / s)` of them and `n - 1` turns, the cross lines and
    the way home at the survey's speed. Energy is the mean of there and back on the best heading,
    and in turns the most that turning takes. A real area takes longer the more it is cut up: then
    `alice-survey plan` gives time and energy.

    Args:
        config: the survey.
        dive_s: time of the dive; the battery may end it before.

    Raises:
        PlanError: the dive or the battery is too short for one line of one picture's length.
    """
    config = as_flown(config)
    setup, plan = ImagingSetup.of(config), without_stops(config.plan, craft_of(config.vehicle))
    try:
        settings = imaging_settings(setup.rig, setup, quiet=True)
    except ConflictError as found:
        raise with_tried_ways(found, config, setup.rig) from None
    flying = survey_costs(config, imaging_w=settings.imaging_w)
    depth_m, spacing = config.area.seafloor_depth_m - plan.altitude_m, settings.line_spacing_m
    dive_down_s, turn = time_costs(plan.speed_mps).dive_s(depth_m), turn_s(plan, spacing)
    line_w = float(np.min(both_ways_w(flying.line_w)))
    way_w = float(np.max(flying.way_w[np.isfinite(flying.way_w)]))
    turn_w = way_w + flying.arc_extra_w
    if plan.turns != "arcs":
        turn_w = max(turn_w, flying.spot_w)
    usable_j = usable_wh(config.vehicle) * 3600.0

    def needs(side_m: float) -> tuple[float, float]:
        """Time and energy."""
        lines = max(1, math.ceil(side_m / spacing - 1e-9))
        along_s = side_m / plan.speed_mps
        turns_s = (lines - 1 + plan.cross_lines) * turn
        lines_s = (lines + plan.cross_lines) * along_s
        energy_j = flying.dive_j(depth_m) + lines_s * line_w + turns_s * turn_w + along_s * way_w
        return dive_down_s + lines_s + turns_s + along_s, energy_j

    def holds(side_m: float) -> bool:
        time_s, energy_j = needs(side_m)
        return time_s <= dive_s and energy_j <= usable_j

    smallest = settings.footprint_along_m
    min_s, min_j = needs(smallest)
    if min_s > dive_s:
        raise PlanError(
            f"a dive of {dive_s:g} s is too short: {dive_down_s:.0f} s go down and up, and one "
            f"picture's length takes {min_s:.0f} s in all: give a longer dive"
        )
    if min_j > usable_j:
        raise PlanError(
            f"one picture's length takes {min_j / 3600:.3g} Wh with the way down and up, the "
            f"battery has {usable_j / 3600:.3g} above its reserve: raise vehicle.battery_wh"
        )
    low, high = smallest, 2.0 * math.sqrt(dive_s * plan.speed_mps * spacing) + smallest
    while high - low > 1e-3:
        middle = (low + high) / 2
        low, high = (middle, high) if holds(middle) else (low, middle)
    time_s, energy_j = needs(low)
    ended = needs(low + 2e-3)[1] > usable_j
    return DiveArea(
        dive_s=time_s if ended else dive_s,
        energy_wh=energy_j / 3600.0,
        usable_wh=usable_j / 3600.0,
        area_m2=low * low,
        side_m=low,
        lines=max(1, math.ceil(low / spacing - 1e-9)),
        line_spacing_m=spacing,
        speed_mps=plan.speed_mps,
        turn_s=turn,
        cross_lines=plan.cross_lines,
    )


def turn_s(plan: PlanConfig, spacing_m: float) -> float:
    """Time from the end of a line to the start of the next, with its run-in.

    Arcs of radius R: a half circle and a straight where lines are 2 R apart or more, else Dubins'
    three arcs `R (pi + 4 acos((2 R + s) / (4 R)))`; on the spot: two right angles and the way
    between. `turns = "auto"` takes the quicker.
    """
    rate_rad_s = turn_in_place_rate_rad_s(plan.turn_rate_limit_deg_s)
    costs, radius = time_costs(plan.speed_mps, turn_rate_rad_s=rate_rad_s), plan.arc_radius_m
    if spacing_m >= 2 * radius:
        arcs = math.pi * radius + spacing_m - 2 * radius
    else:
        arcs = radius * (math.pi + 4 * math.acos((2 * radius + spacing_m) / (4 * radius)))
    run_in = plan.run_in_m / plan.speed_mps
    by_arcs = arcs / plan.speed_mps + run_in
    by_spot = 2 * costs.spot_j(math.pi / 2) + spacing_m / plan.speed_mps + run_in
    return {"arcs": by_arcs, "spot": by_spot}.get(plan.turns, min(by_arcs, by_spot))


def _area_text(area: DiveArea, config: SurveyConfig, asked_s: float) -> str:
    dive = f"a dive of {area.dive_s:.6g} s"
    if area.dive_s < asked_s:
        dive = f"the battery ends a dive after {area.dive_s:.0f} of {asked_s:g} s, which"
    return (
        f"{dive} holds {area.area_m2:.0f} m2, such as {area.side_m:.1f} x "
        f"{area.side_m:.1f} m: {area.lines} lines {area.line_spacing_m:.3g} m apart at "
        f"{area.speed_mps:g} m/s, {area.cross_lines} across, turns of {area.turn_s:.0f} s, descent "
        f"and ascent; {area.energy_wh:.0f} of {area.usable_wh:.0f} Wh; "
        f"{config.camera.focal_mm:g} mm lens at {config.plan.altitude_m:.2f} m"
    )
