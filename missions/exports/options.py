"""What a vehicle needs to know besides the plan."""

from dataclasses import dataclass

from alice_survey.core.config import CameraConfig, PlanConfig, SeaConfig, VehicleConfig
from alice_survey.core.errors import PlanError
from alice_survey.sim.vehicle.pilot.settings import TURN_IN_PLACE_RAD_S, turn_in_place_rate_rad_s
from camera_calib.rig import Rig
from missions.exports.follower import Follower, follower_of
from missions.values.footprint import common_swath
from missions.values.plan_file import Plan

MIN_TOLERANCE_M = 0.12
"""The cross-track error that the paper's vehicle holds with its improved controller: a vehicle set
to pass a place more closely turns back for it."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """What a vehicle needs to know besides the plan."""

    altimeter_body_m: tuple[float, float, float] = CameraConfig().dvl_position_body_m
    """The sensor whose altitude the vehicle holds, from its reference point."""
    camera_on: str = "camera_trigger/enable"
    """COLA2: the service (without arguments) that starts pictures."""
    camera_off: str = "camera_trigger/disable"
    turn_rate_rad_s: float = TURN_IN_PLACE_RAD_S
    """Rate of turns on the spot, which way-points wait for."""
    follower: Follower | None = None
    """The vehicle and its sea; None where they are not known."""

    def __post_init__(self) -> None:
        if not self.camera_on or not self.camera_off:
            raise PlanError("name the services that switch pictures on and off")


def options_of(
    camera: CameraConfig,
    plan: PlanConfig,
    vehicle: VehicleConfig | None = None,
    sea: SeaConfig | None = None,
) -> Options:
    """The options that a survey's settings give; without vehicle and sea there is no follower."""
    follower = None if vehicle is None or sea is None else follower_of(vehicle, sea, plan.speed_mps)
    return Options(
        altimeter_body_m=camera.dvl_position_body_m,
        turn_rate_rad_s=turn_in_place_rate_rad_s(plan.turn_rate_limit_deg_s),
        follower=follower,
    )


def line_tolerance_m(plan: Plan, rig: Rig) -> float:
    """How far off a line's ends the vehicle may be with the survey still complete.

    Half a step along the line, so that its last picture is taken; across it, half of what
    neighbouring stereo swaths see more often than the plan needs, so that two lines off track leave
    no gap. Not less than what a vehicle can hold.
    """
    stereo = common_swath(rig, plan.altitude_m, plan.station_spacing_m)
    passes = max(1, int(2 * stereo.half_across_m / plan.line_spacing_m + 1e-9))
    spare_m = (2 * stereo.half_across_m - passes * plan.line_spacing_m) / 2
    return max(MIN_TOLERANCE_M, min(plan.station_spacing_m / 2, spare_m))
