"""Whether a survey can be planned up to where its lines lie, as set or with a way out taken."""

import math
from collections.abc import Sequence
from functools import partial

from alice_survey.core.config import PlanConfig, SurveyConfig, with_settings
from alice_survey.core.errors import PlanError, collected_by, warn
from alice_survey.sim.vehicle.vehicle import Vehicle
from camera_calib.rig import Rig, design_rig
from missions.exposure.settings import ImagingSettings, ImagingSetup, imaging_settings
from missions.exposure.ways_out import (
    ConflictError,
    Settings,
    Way,
    conflict,
    with_ways_that_work,
)
from missions.plan.strength import arcs_fit, turn_rate_deg_s
from missions.route.energy import flight_conditions, vehicle_costs
from missions.route.flyable import as_flown
from missions.values.footprint import Swath, common_swath
from missions.values.plan_file import Dive


def with_tried_ways(found: ConflictError, config: SurveyConfig, rig: Rig) -> ConflictError:
    """A conflict of a survey with those ways out that work.

    Args:
        found: the conflict.
        config: of the survey.
        rig: its cameras in water.
    """
    return with_ways_that_work(found, partial(check_ready, config, rig))


def check_ready(config: SurveyConfig, rig: Rig, settings: Settings) -> None:
    """Check that a survey can be planned with settings changed: all but where its lines lie.

    Args:
        config: the survey.
        rig: its cameras in water; as designed where settings of cameras change.
        settings: the changes.

    Raises:
        AliceError: it cannot, or its lines would leave gaps in stereo.
    """
    changed = as_flown(with_settings(config, settings, "way out"))
    wanted = changed.plan
    if changed.camera != config.camera:
        rig = design_rig(changed.camera, changed.water)
    with collected_by(lambda _, __: None):
        imaging = imaging_settings(rig, ImagingSetup.of(changed), quiet=True)
        check_turns(wanted)
    stereo = common_swath(rig, wanted.altitude_m, imaging.station_spacing_m)
    if gap_m(imaging, stereo) > 0:
        fits_m = math.floor(2000 * stereo.half_across_m) / 1000
        raise conflict(
            f"lines {imaging.line_spacing_m:g} m apart leave gaps in stereo",
            ("line_spacing_m", "the footprint"),
            [
                Way(
                    change=f"line_spacing_m {fits_m:g} instead of {imaging.line_spacing_m:g}",
                    price=f"{imaging.line_spacing_m / fits_m:.2f} times the lines",
                    cost=imaging.line_spacing_m / fits_m - 1.0,
                    settings={"plan.line_spacing_m": fits_m},
                )
            ],
        )
    vehicle_costs(flight_conditions(changed), refused=PlanError)
    if changed.area.bathymetry_file is None:
        check_depth(wanted.altitude_m, changed.area.seafloor_depth_m)


def gap_m(imaging: ImagingSettings, stereo: Swath) -> float:
    """What neighbouring lines do not see in stereo between them; at most 0 where they see all."""
    return imaging.line_spacing_m - 2 * stereo.half_across_m


def check_turns(plan: PlanConfig) -> None:
    """Refuse arcs that are too quick; warn where they are wider than set.

    Raises:
        PlanError: the plan wants arcs of a radius that its rate of turn does not allow.
    """
    if not arcs_fit(plan):
        raise PlanError(
            f"turns of {plan.turn_radius_m:g} m radius at {plan.speed_mps:g} m/s need "
            f"{turn_rate_deg_s(plan):.0f} deg/s; turn_rate_limit_deg_s is "
            f"{plan.turn_rate_limit_deg_s:g}: raise turn_radius_m, lower speed_mps or set "
            "turns = 'auto'"
        )
    if plan.arc_radius_m > plan.turn_radius_m:
        warn(
            f"turn_radius_m {plan.turn_radius_m:g} at {plan.speed_mps:g} m/s is beyond "
            f"turn_rate_limit_deg_s {plan.turn_rate_limit_deg_s:g}: arcs are planned with "
            f"{plan.arc_radius_m:g} m"
        )


def check_no_stops(craft: Vehicle, plan: PlanConfig, dives: Sequence[Dive]) -> None:
    """Refuse a route with stops, which a vehicle that fins steer cannot make.

    Raises:
        PlanError: there is no room for its arcs.
    """
    legs = [leg for dive in dives for leg in dive.route.legs]
    stops = sum(leg.turn_rad != 0.0 or leg.side_rad != 0.0 for leg in legs)
    if stops:
        raise PlanError(
            f"turns of {plan.turn_radius_m:g} m radius have no room inside the allowed area (the "
            f"way has {stops} stops), and {craft.name}, which fins steer, cannot stop: widen "
            "area.turn_margin_m or the allowed area, set plan.home_ne_m farther from its edges, or "
            "survey it with a vehicle that can stop"
        )


def check_depth(altitude_m: float, depth_m: float) -> None:
    """Refuse an altitude at or above the surface.

    Raises:
        PlanError: with the numbers.
    """
    if altitude_m >= depth_m:
        raise PlanError(
            f"altitude_m {altitude_m:g} is not below the surface over a sea floor at "
            f"{depth_m:g} m: lower plan.altitude_m or check area.seafloor_depth_m"
        )
