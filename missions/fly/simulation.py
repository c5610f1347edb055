"""A plan, or the mission file written from one, flown by the simulated vehicle over a sea floor.

The part of a plan that is flown: all its dives in one go, or one of them.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation
from shapely.geometry import Point

from alice_survey.core.config import (
    AreaConfig,
    CameraConfig,
    Config,
    NavigationConfig,
    PlanConfig,
    SeaConfig,
    SeafloorConfig,
    SurveyConfig,
    VehicleConfig,
    parse_failures,
)
from alice_survey.core.errors import PlanError, VehicleError, warn
from alice_survey.core.frames import Array, rotation_from_attitude
from alice_survey.core.trajectory import Trajectory
from alice_survey.sim.seafloor.terrain import Terrain, survey_terrain
from alice_survey.sim.vehicle.navigation.sensors import (
    CompassSpec,
    DvlSpec,
    GpsSpec,
    SensorSuite,
    UsblSpec,
)
from alice_survey.sim.vehicle.navigation.tick import LOG_COLUMNS
from alice_survey.sim.vehicle.pilot import mission as pilot
from alice_survey.sim.vehicle.pilot.command import Failure, Piloting
from alice_survey.sim.vehicle.pilot.gains import Gains, gains_for, pitch_divergence_speed_mps
from alice_survey.sim.vehicle.pilot.memory import (
    ALONG,
    DONE,
    FOLLOW,
    LEG,
    LINE,
    NONE,
    PHASE,
    REASON,
    REASONS,
    SafetyLimits,
)
from alice_survey.sim.vehicle.pilot.mission import MIN_SPEED_MPS, NO_LAW, NO_MISSION, PilotMission
from alice_survey.sim.vehicle.pilot.path import Path as PilotPath
from alice_survey.sim.vehicle.pilot.path import path_from_legs
from alice_survey.sim.vehicle.pilot.settings import (
    Guidance,
    pilot_guidance,
    turn_in_place_rate_rad_s,
)
from alice_survey.sim.vehicle.sea import (
    Current,
    Disturbance,
    FloorGrid,
    floor_depth,
    read_current,
    sheared_current,
    varying_current,
    with_swell,
)
from alice_survey.sim.vehicle.simulator import TICK_S, Flown, Setup, simulate
from alice_survey.sim.vehicle.vehicle import Vehicle
from camera_calib.rig import Rig
from missions.coverage.certificate import certificate
from missions.coverage.stations import MAX_ALTITUDES, Stations, plan_pattern, stations_of_plan
from missions.exports.follower import cola2_delta_m, cola2_settings, expected_m, follower_of, sways
from missions.exports.geometry import CameraMount
from missions.exports.registry import read_mission
from missions.exports.waypoints import room_m
from missions.plan.planner import area_bathymetry
from missions.route.energy import (
    flies_everywhere,
    flight_conditions,
    has_sway,
    plan_as_flown,
    sound_vehicle,
)
from missions.route.terrain import envelope, with_depths_between
from missions.values.flight import Flight, trigger_times
from missions.values.legs import Leg, Route
from missions.values.mission import Mission
from missions.values.navigation import BelievedNavigation
from missions.values.plan_file import Plan

_SEED_STREAM = 20
_FLOOR_SPACING_M = 0.1
"""Spacing of the grid that the DVL sees: finer than the spot of a beam."""
_BLIND_ALTITUDES = 1.5
"""A dive without bottom lock stops this many altitudes above the planned sea floor: half an
altitude is left for a floor that is shallower."""
_CLIMB_MPS = 0.1
"""Slowest dive and ascent that a mission waits for."""
_PATIENCE = 3.0
"""A mission is aborted after this many times the time its plan takes."""
_PITCH_MARGIN = 0.8
"""Share of the speed at which pitch diverges that a plan may have without a warning (inferred)."""
_OUTSIDE = 0.01
"""Share of a circle that may lie outside of the allowed area without a warning."""
_USBL_HZ = 0.5
"""A fix every other second: the turn-around of a modem at short range."""


_Section = TypeVar("_Section", bound=Config)


@dataclass(frozen=True, kw_only=True)
class FlightSettings:
    """The settings of a survey that decide how its plan is flown."""

    seed: int
    vehicle: VehicleConfig
    sea: SeaConfig
    navigation: NavigationConfig
    camera: CameraConfig
    """Placement of the left port and the DVL."""
    seafloor: SeafloorConfig
    area: AreaConfig
    """Depth of the sea floor."""
    plan: PlanConfig
    """Limit of turns, and the altitude."""

    def __post_init__(self) -> None:
        if not has_sway(sound_vehicle(self.vehicle)):
            los = self.vehicle.model_copy(update={"controller": "los"})
            object.__setattr__(self, "vehicle", los)


def flight_settings(config: SurveyConfig) -> FlightSettings:
    """The settings of a survey's flight."""
    return FlightSettings(
        **{each.name: getattr(config, each.name) for each in fields(FlightSettings)}
    )


def flight_noise(seed: int) -> np.random.Generator:
    """Source of all noise of a survey's flight."""
    return np.random.default_rng([seed, _SEED_STREAM])


def true_floor(plan: Plan, settings: FlightSettings) -> FloorGrid:
    """The simulated sea floor below a plan."""
    altitude_m, seed = settings.plan.altitude_m, settings.seed
    return floor_grid(true_terrain(plan, settings.area, settings.seafloor, altitude_m, seed))


def true_terrain(
    plan: Plan, area: AreaConfig, seafloor: SeafloorConfig, altitude_m: float, seed: int
) -> Terrain:
    """The simulated sea floor of a survey: on its bathymetry, where it has one."""
    bathymetry = area_bathymetry(area, plan.area, altitude_m)
    return survey_terrain(
        seafloor,
        plan.area.allowed_corners_ne,
        margin_m=altitude_m,
        depth_m=area.seafloor_depth_m,
        seed=seed,
        base=None if bathymetry is None else bathymetry.depth_everywhere,
    )


def with_values(section: _Section, **values: Any) -> _Section:
    """A section of settings with some values replaced and checked."""
    return type(section).model_validate({**section.model_dump(exclude_unset=True), **values})


def simulate_plan(
    plan: Plan,
    settings: FlightSettings,
    floor: FloorGrid,
    rng: np.random.Generator,
    label: str = "flight",
    mission: PilotMission = NO_MISSION,
    pictures: "PictureTimes" = trigger_times,
) -> Flight:
    """Fly a plan.

    Args:
        plan: what to fly.
        settings: vehicle, sea and sensors.
        floor: the true sea floor.
        rng: source of all noise.
        label: what the progress bar says; there is none if it is empty.
        mission: flown in place of the plan's route.
        pictures: when they are taken.

    Raises:
        VehicleError: a setting does not fit the vehicle, or it cannot fly the plan's sway steps.
        NavigationError: the file of the current cannot be read.
    """
    max_s = max_mission_s(plan)
    setup = mission_setup(plan, settings, floor, max_s, rng, mission)
    ascent_s = plan.seafloor_depth_m / _CLIMB_MPS
    flown = simulate(setup, rng, max_s=max_s + ascent_s, label=label, expected_s=plan.duration_s)
    return flight_of(plan, settings.camera.position_body_m, setup, flown, pictures)


def max_mission_s(plan: Plan) -> float:
    """After how long a mission is aborted."""
    return _PATIENCE * plan.duration_s + 2.0 * max_ascent_s(plan)


def max_ascent_s(plan: Plan) -> float:
    """After how long a vehicle that pushes itself up is at the surface, whatever hinders it."""
    return _PATIENCE * plan.seafloor_depth_m / _CLIMB_MPS


def piloting_of(
    plan: Plan, settings: FlightSettings, max_s: float, mission: PilotMission = NO_MISSION
) -> Piloting:
    """Vehicle, path, gains and guidance of a survey.

    Args:
        plan: what to fly.
        settings: vehicle and cameras.
        max_s: after which the vehicle gives up.
        mission: of way-points of the vehicle's reference point, flown instead of the plan's route.

    Raises:
        VehicleError: a setting does not fit the vehicle, or it cannot fly the plan's sway steps.
    """
    vehicle = sound_vehicle(settings.vehicle)
    diverging_mps = math.inf if vehicle.fins else pitch_divergence_speed_mps(vehicle)
    if plan.speed_mps > _PITCH_MARGIN * diverging_mps:
        warn(
            f"the pitch of {vehicle.name} with {vehicle.coefficients.name!r} coefficients diverges "
            f"above {diverging_mps:.2f} m/s and is badly damped at the plan's {plan.speed_mps:g} "
            "m/s: lower the speed"
        )
    # A vehicle that hovers climbs upright at the ends of its lines, which keep to the slope anyway.
    steepest_rad = math.radians(settings.plan.steepest_deg if vehicle.fins else 89.9)
    path = path_of(plan, settings.camera.position_body_m[2], steepest_rad)
    turns = int(np.count_nonzero(path.turn_rad))
    if turns and mission.law == NO_LAW and settings.vehicle.controller == "los":
        warn(
            f"{vehicle.name} cannot push itself sideways under the controller los: in each of the "
            f"{turns} turns on the spot it swings off its place and drifts with the current; "
            "plan.turns = 'arcs' suits it better"
        )
    floors_m = [floor for line in plan.line_floors_m for floor in line] or [plan.seafloor_depth_m]
    # A floor is followed down to two altitudes below the planned one.
    deepest_m = max(floors_m) + plan.altitude_m
    reference = (0.0, 0.0, 0.0)
    followed_body_m = settings.camera.position_body_m if mission.law == NO_LAW else reference

    def pilot_with(left: Mapping[str, float]) -> tuple[Gains, Guidance]:
        gains = gains_for(vehicle.weaken(left), plan.speed_mps)
        guidance = pilot_guidance(
            gains,
            path,
            settings.vehicle.controller,
            max_depth_m=deepest_m,
            point_body_m=followed_body_m,
            turn_in_place_rad_s=turn_in_place_rate_rad_s(settings.plan.turn_rate_limit_deg_s),
            limits=SafetyLimits(
                0.5 * plan.altitude_m,
                deepest_m,
                max_s=max_s,
                blind_sigma_m=settings.navigation.blind_sigma_m,
                blind_depth_m=max(min(floors_m) - _BLIND_ALTITUDES * plan.altitude_m, 0.0),
            ),
        )
        way_in_m = min(guidance.way_in_m, room_behind_m(plan, path, guidance.way_in_m))
        guidance = guidance._replace(way_in_m=way_in_m)
        radius_m = guidance.under_way.circle_m
        if radius_m == 0.0:
            return gains, guidance
        side, outside = roomier_side(plan, path, way_in_m, radius_m)
        if outside > _OUTSIDE:
            warn(
                f"{outside:.0%} of the circle of {radius_m:.1f} m on which {vehicle.name} dives "
                "lies outside of the allowed area or in zones: widen area.turn_margin_m, or move "
                "plan.home_ne_m"
            )
        return gains, guidance._replace(under_way=guidance.under_way._replace(side=side))

    depth_m = plan.seafloor_depth_m - plan.altitude_m
    requested = plan_as_flown(settings.plan, vehicle), settings.vehicle, settings.sea, depth_m
    expected = flight_conditions(*requested, settings.camera.position_body_m)

    def pilot_without(
        left: Mapping[str, float], current_ne_mps: Array | None
    ) -> tuple[Gains, Guidance]:
        known_ne = expected.current_ne_mps if current_ne_mps is None else current_ne_mps
        weak = vehicle.weaken(left)
        left_to_fly = replace(expected, vehicle=weak, current_ne_mps=known_ne)
        if not weak.thrusters or not flies_everywhere(left_to_fly):
            raise VehicleError(f"{vehicle.name} cannot fly the plan with the thrust it has left")
        return pilot_with(left)

    # The pilot flies as well as the thrusters allow that he knows to be sound.
    known = settings.vehicle.impaired
    gains, guidance = pilot_with(known)
    return Piloting(
        vehicle=vehicle,
        path=path,
        gains=gains,
        guidance=guidance,
        mission=mission,
        exact_allocation=settings.vehicle.allocation == "exact",
        known_health=known,
        without=pilot_without if settings.vehicle.finds_failures else None,
    )


def mission_setup(
    plan: Plan,
    settings: FlightSettings,
    floor: FloorGrid,
    max_s: float,
    rng: np.random.Generator,
    mission: PilotMission = NO_MISSION,
) -> Setup:
    """Vehicle, path, pilot, instruments and sea of a survey.

    Args:
        plan: what to fly.
        settings: vehicle, sea and sensors.
        floor: the true sea floor.
        max_s: after which the vehicle gives up.
        rng: for what is drawn once a mission.
        mission: of way-points of the vehicle's reference point, flown instead of the plan's route.
    """
    flies = piloting_of(plan, settings, max_s, mission)
    vehicle, path = flies.vehicle, flies.path
    gust, heading_rad = settings.sea.gust_n, float(path.heading_rad[0] + path.side_rad[0])
    # The vehicle is let go where its left port is above the start of the route.
    glass_ned = rotation_from_attitude(0.0, 0.0, heading_rad).apply(settings.camera.position_body_m)
    start_ne = np.array([path.start_n[0], path.start_e[0]]) - glass_ned[:2]
    return Setup(
        **vars(flies),
        sensors=sensors_of(settings.navigation, settings.camera).pack(vehicle.hull),
        floor=floor,
        current=current_of(settings.sea, plan.seafloor_depth_m, max_s, rng),
        disturbance=Disturbance(
            sigma=(*gust, 0.0, 0.0, 0.0), correlation_s=settings.sea.gust_correlation_s
        ),
        health=settings.vehicle.impaired,
        start_ne_m=(float(start_ne[0]), float(start_ne[1])),
        start_heading_rad=heading_rad,
        failures=_failures(vehicle, settings.vehicle),
    )


def _failures(vehicle: Vehicle, settings: VehicleConfig) -> tuple[Failure, ...]:
    """Thrusters that fail on the way.

    Raises:
        VehicleError: one is not the vehicle's.
    """
    found = parse_failures(settings.failures)
    kinds = ((found.later, False), (found.propellers, True))
    for failures, _ in kinds:
        vehicle.health_of({name: share for name, _, share in failures})
    return tuple(
        Failure(thruster=name, time_s=time_s, left=share, turns=turns)
        for failures, turns in kinds
        for name, time_s, share in failures
    )


def current_of(
    sea: SeaConfig, seafloor_depth_m: float, duration_s: float, rng: np.random.Generator
) -> Current:
    """The current of a survey: measured, or as its settings have it; with its swell."""
    if sea.current_file is not None:
        current = read_current(sea.current_file)
    else:
        surface = sea.current_mps if sea.surface_current_mps is None else sea.surface_current_mps
        current = sheared_current(
            np.array([0.0, seafloor_depth_m]),
            np.array([[speed, sea.current_towards_deg] for speed in (surface, sea.current_mps)]),
        )
        sigma, lasting_s = sea.current_sigma_mps, sea.current_correlation_s
        if sigma > 0.0:
            current = varying_current(current, sigma, lasting_s, duration_s, rng)
    waves = sea.swell_m, sea.swell_period_s, sea.swell_towards_deg
    if sea.swell_m > 0.0:
        current = with_swell(current, *waves, seafloor_depth_m, duration_s)
    return current


def sensors_of(navigation: NavigationConfig, camera: CameraConfig) -> SensorSuite:
    """The instruments of a survey."""
    return SensorSuite(
        gps=GpsSpec(bias_sigma_m=navigation.gps_bias_m, noise_m=navigation.gps_noise_m),
        compass=CompassSpec(
            bias_sigma_rad=math.radians(navigation.compass_bias_deg),
            noise_rad=math.radians(navigation.compass_noise_deg),
        ),
        dvl=DvlSpec(
            position_body_m=camera.dvl_position_body_m, beam_noise_mps=navigation.dvl_noise_mps
        ),
        usbl=UsblSpec(
            rate_hz=_USBL_HZ if navigation.usbl_noise_m else 0.0,
            noise_m=navigation.usbl_noise_m or UsblSpec().noise_m,
        ),
        dvl_dropouts_s=navigation.dvl_dropouts_s,
        bottom_dropouts_s=navigation.bottom_dropouts_s,
        followed_body_m=camera.position_body_m,
    )


def floor_grid(floor: Terrain) -> FloorGrid:
    """A sea floor on a grid for compiled code."""
    south, north, west, east = floor.bounds_ne_m
    inset = 1e-6
    rows = np.arange(south + inset, north - inset, _FLOOR_SPACING_M)
    columns = np.arange(west + inset, east - inset, _FLOOR_SPACING_M)
    points = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1)
    depth = np.ascontiguousarray(floor.depth_at(points))
    return FloorGrid(float(rows[0]), float(columns[0]), _FLOOR_SPACING_M, depth)


PictureTimes = Callable[[Plan, Array, Array, Array], tuple[Array, tuple[int, ...]]]
"""From plan, times, lines and believed places of the glass to times and lines of pictures."""


def flight_of(
    plan: Plan,
    glass_body_m: tuple[float, float, float],
    setup: Setup,
    flown: Flown,
    pictures: PictureTimes = trigger_times,
) -> Flight:
    """What a mission's rows mean for its plan.

    Args:
        plan: that was flown.
        glass_body_m: where the left port's glass sits on the vehicle.
        setup: of the mission.
        flown: its rows.
        pictures: when they are taken.
    """
    glass_body = np.array(glass_body_m)
    truth = Trajectory(
        time_s=flown.time_s,
        ned_from_body=RigidTransform.from_components(
            flown.truth[:, :3], Rotation.from_quat(flown.truth[:, 3:7])
        ),
    )
    log = navigation_log(flown)
    believed = log.position_ned + rotation_from_attitude(*log.attitude_rad.T).apply(glass_body)
    following = flown.report[:, PHASE] == FOLLOW
    line = np.where(following, flown.report[:, LINE], -1.0)
    trigger_s, trigger_line = pictures(plan, flown.time_s, line, believed[:, :2])
    reason = int(flown.report[-1, REASON])
    if reason != NONE:
        ending = f"aborted: {REASONS[reason]}"
    elif flown.report[-1, PHASE] == DONE:
        ending = "complete"
    else:
        ending = f"broken off after {flown.time_s[-1]:.0f} s"
    return Flight(
        plan=plan,
        vehicle=setup.vehicle,
        truth=truth,
        glass_ned=truth.ned_from_body.apply(glass_body),
        altitude_m=_altitude(setup.floor, truth.ned_from_body.apply(glass_body)),
        clearance_m=_clearance_m(setup, truth.ned_from_body),
        believed_glass_ned=believed,
        line=line,
        trigger_s=trigger_s,
        trigger_line=trigger_line,
        log=log,
        flown=flown,
        ending=ending,
    )


def _altitude(floor: FloorGrid, points_ned: Array) -> Array:
    """Height, (T,), of places above the sea floor below them."""
    depths = [floor_depth(floor, float(n), float(e)) for n, e in points_ned[:, :2]]
    return np.asarray(np.array(depths) - points_ned[:, 2])


def _clearance_m(setup: Setup, ned_from_body: RigidTransform) -> float:
    """Least height of hull, port and DVL above the sea floor, of every second and at the end."""
    some = np.append(np.arange(0, len(ned_from_body), round(1.0 / TICK_S)), -1)
    low, each = setup.sensors.low, ned_from_body[some]
    points = np.vstack([each.apply(point) for point in low])
    return float(_altitude(setup.floor, points).min())


def navigation_log(flown: Flown) -> BelievedNavigation:
    """The navigation's estimate, tick by tick."""
    columns = dict(zip(LOG_COLUMNS, flown.navigation.T, strict=True))

    def table(*names: str) -> Array:
        return np.stack([columns[name] for name in names], axis=1)

    def rms(*names: str) -> Array:
        return np.asarray(np.sqrt(np.mean(table(*names) ** 2, axis=1)))

    return BelievedNavigation(
        time_s=flown.time_s,
        position_ned=table("north_m", "east_m", "depth_m"),
        attitude_rad=table("roll_rad", "pitch_rad", "heading_rad"),
        altitude_m=columns["altitude_m"],
        sigma_horizontal_m=rms("sigma_north_m", "sigma_east_m"),
        sigma_depth_m=columns["sigma_depth_m"],
        sigma_attitude_rad=rms("sigma_roll_rad", "sigma_pitch_rad"),
        sigma_heading_rad=columns["sigma_heading_rad"],
        sigma_altitude_m=columns["sigma_altitude_m"],
    )


PASSED_M = 0.02
"""An end passed by more is overshot: a tick's way and the noise of navigation are less."""
_SAME_COURSE_RAD = math.radians(10.0)
_KINDS = {
    "goto": pilot.GOTO, "section": pilot.SECTION, "keep": pilot.KEEP, "anchor": pilot.ANCHOR,
}  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class MissionOfPlan:
    """A mission that was written from a plan."""

    path: Path
    mission: Mission
    plan: Plan
    """The plan, with the dive alone that the mission is of."""
    line: tuple[int, ...]
    """Line of the plan on which each step takes pictures, or -1."""


def mission_of_plan(path: Path, plan: Plan, mount: CameraMount) -> MissionOfPlan:
    """Read a mission and find the lines of the plan that it is to fly.

    Args:
        path: of the mission.
        plan: that it was written from.
        mount: of the camera on the vehicle.

    Raises:
        PlanError: the file holds no mission, or one of another plan.
    """
    mission = read_mission(path)
    ends_ne = mission.ends_ne(plan.datum)
    line, begins = [], None
    for i, step in enumerate(mission.steps):
        if begins is None:
            line.append(-1)
        else:
            line.append(_line_between(path, plan, mount, i, ends_ne[begins], ends_ne[i]))
        if step.camera is not None:
            begins = i if step.camera == "on" else None
    flown = {index for index in line if index >= 0}
    if not flown:
        raise PlanError(f"{path}: switches no pictures on: it flies no line of {plan.name}")
    for number, dive in enumerate(plan.dives, start=1):
        if all(dive.first_line <= index <= dive.last_line for index in flown):
            plan = one_dive(plan, number)
            break
    return MissionOfPlan(path=path, mission=mission, plan=plan, line=tuple(line))


def _line_between(
    path: Path, plan: Plan, mount: CameraMount, number: int, start_ne: Array, end_ne: Array
) -> int:
    """The line of a plan along which the glass goes while the vehicle goes along a straight."""
    course = math.atan2(*(end_ne - start_ne)[::-1])
    arm_ne = -mount.vehicle_ne(np.zeros((1, 2)), np.array([course]))[0]
    glass_ne = start_ne + arm_ne
    away_m = [
        math.dist(glass_ne, line.start_ne_m)
        if abs(math.remainder(line.heading_rad - course, 2 * math.pi)) < _SAME_COURSE_RAD
        else math.inf
        for line in plan.lines
    ]
    nearest = int(np.argmin(away_m))
    if away_m[nearest] > plan.line_spacing_m / 2:
        starts = [math.dist(glass_ne, line.start_ne_m) for line in plan.lines]
        raise PlanError(
            f"{path}: step {number + 1} takes pictures along no line of the plan {plan.name!r}, "
            f"{min(starts):.1f} m from the start of the nearest: it is a mission of another plan, "
            "camera position or datum"
        )
    return nearest


def simulate_mission(
    plan: Plan,
    settings: FlightSettings,
    floor: FloorGrid,
    rng: np.random.Generator,
    label: str = "flight",
) -> Flight:
    """Fly the mission that the settings name. Arguments as of `simulate_plan`.

    Raises:
        PlanError: the file holds no mission of this plan.
        VehicleError: the autopilot cannot fly this vehicle, or is not the one of the file.
    """
    known, vehicle = mission_of_settings(plan, settings), settings.vehicle
    flown_by = pilot_mission(known, vehicle, _mount(settings.camera))
    # Our own pilot holds places by sway where a vehicle has it, which the laws may ask for.
    has_sway = sways(gains_for(sound_vehicle(vehicle), plan.speed_mps))
    own = vehicle.model_copy(update={"controller": "sway" if has_sway else "los"})
    own_settings, pictures = replace(settings, vehicle=own), partial(picture_times, known)
    flight = simulate_plan(known.plan, own_settings, floor, rng, label, flown_by, pictures)
    if known.mission.autopilot != "cola2":
        return flight
    follower = follower_of(vehicle, settings.sea, plan.speed_mps)
    lever_m = settings.camera.position_body_m[0]
    return replace(flight, expected_m=expected_m(follower, known.plan, lever_m, known.mission))


def mission_of_settings(plan: Plan, settings: FlightSettings) -> MissionOfPlan:
    """The mission that the settings name.

    Raises:
        PlanError: the file holds no mission of this plan.
        VehicleError: they name none.
    """
    if settings.vehicle.mission_file is None:
        raise VehicleError("no mission is given: set vehicle.mission_file")
    return mission_of_plan(settings.vehicle.mission_file, plan, _mount(settings.camera))


def _mount(camera: CameraConfig) -> CameraMount:
    return CameraMount(
        glass_body_m=camera.position_body_m, altimeter_body_m=camera.dvl_position_body_m
    )


def pilot_mission(
    known: MissionOfPlan, vehicle: VehicleConfig, mount: CameraMount
) -> pilot.PilotMission:
    """A mission for the simulator's pilot.

    Args:
        known: the mission.
        vehicle: flies it.
        mount: of the camera on it.

    Raises:
        VehicleError: the autopilot is not the one of the file, or needs sway that the vehicle
            lacks.
    """
    mission, plan = known.mission, known.plan
    gains = gains_for(sound_vehicle(vehicle), plan.speed_mps)
    steps = _rows(known, mount)
    if mission.autopilot == "ardusub":
        if not sways(gains):
            raise VehicleError(
                f"ArduSub holds on to its track sideways; {vehicle.name} has no thrusters for it: "
                "fly a mission for COLA2, or another vehicle"
            )
        return PilotMission(pilot.ARDUSUB, steps)
    delta_m = cola2_delta_m(gains, plan.speed_mps)
    if not math.isfinite(delta_m):
        raise VehicleError(
            f"no look-ahead keeps {vehicle.name} from weaving under COLA2: lower the speed"
        )
    return PilotMission(pilot.COLA2, steps, cola2_settings(delta_m, plan.speed_mps))


def _rows(known: MissionOfPlan, mount: CameraMount) -> Array:
    """Steps as the pilot takes them, (M, COLUMNS).

    Altitudes are of the glass, which the navigation gives.
    """
    mission, datum = known.mission, known.plan.datum
    lift_m = mount.glass_body_m[2] - mount.altimeter_body_m[2]
    rows = np.full((len(mission.steps), pilot.COLUMNS), np.nan)
    rows[:, [pilot.END_N, pilot.END_E]] = mission.ends_ne(datum)
    rows[:, [pilot.START_N, pilot.START_E]] = mission.starts_ne(datum)
    rows[:, pilot.LINE] = known.line
    for row, step in zip(rows, mission.steps, strict=True):
        by_track = mission.autopilot == "ardusub"
        row[pilot.KIND] = pilot.FROM_END if by_track else _KINDS[step.manoeuvre]
        row[pilot.HEADING] = step.heading_rad
        row[pilot.BY_DEPTH] = step.heave != "altitude"
        row[pilot.BY_ALTITUDE] = step.heave != "depth"
        row[pilot.DEPTH] = step.depth_m
        row[pilot.ALTITUDE] = step.altitude_m - lift_m
        row[pilot.SPEED] = max(step.speed_mps, MIN_SPEED_MPS) if by_track else step.speed_mps
        row[pilot.TOLERANCE] = step.tolerance_m
        row[pilot.HOLD_S] = step.hold_s
    return rows


def picture_times(
    known: MissionOfPlan, plan: Plan, time_s: Array, line: Array, glass_ne: Array
) -> tuple[Array, tuple[int, ...]]:
    """When pictures are taken while they are switched on.

    The first at once, then by the distance that the mission states, or where it leaves that to the
    trigger controller, at the plan's interval.

    Args:
        known: the mission.
        plan: its interval counts.
        time_s: (T,)
        line: (T,) line on which pictures are on, -1 where they are off.
        glass_ne: (T, 2) where the vehicle believes the glass to be.

    Returns:
        (S,) seconds, and the line of each.
    """
    steps_m = {
        index: step.picture_step_m
        for step, index in zip(known.mission.steps, (*known.line[1:], -1), strict=True)
        if step.camera == "on"
    }
    times: list[Array] = []
    lines: list[int] = []
    for index in sorted(set(known.line) - {-1}):
        rows = np.flatnonzero(line == index)
        if not len(rows):
            continue
        step_m = steps_m.get(index, math.nan)
        if math.isfinite(step_m):
            taken = time_s[rows[_every(glass_ne[rows], step_m)]]
        else:
            taken = np.arange(time_s[rows[0]], time_s[rows[-1]] + 1e-9, plan.interval_s)
        times.append(taken)
        lines += [index] * len(taken)
    return np.concatenate([np.empty(0), *times]), tuple(lines)


def _every(places_ne: Array, step_m: float) -> list[int]:
    """Rows at which a place is a step or more from that of the row before, from the first on."""
    taken = [0]
    for i, place in enumerate(places_ne):
        if math.dist(place, places_ne[taken[-1]]) >= step_m:
            taken.append(i)
    return taken


def overshoot_m(known: MissionOfPlan, flight: Flight) -> list[float]:
    """How far past the end of its way the vehicle went on each line, by its own estimate, m.

    Zero where the step was done before its end was passed. ArduSub comes to rest at an end, about
    which it may swing within its radius: only what is beyond counts.
    """
    report, mission, datum = flight.flown.report, known.mission, known.plan.datum
    ends, starts = mission.ends_ne(datum), mission.starts_ne(datum)
    beyond = []
    for i, index in enumerate(known.line):
        if index < 0 or (i + 1 < len(known.line) and known.line[i + 1] == index):
            continue
        rows = report[:, LEG] == i
        start = starts[i] if np.isfinite(starts[i]).all() else ends[i - 1]
        swing_m = mission.steps[i].tolerance_m if mission.autopilot == "ardusub" else 0.0
        along = report[rows, ALONG] - math.dist(start, ends[i]) - swing_m
        beyond.append(max(0.0, float(along.max(initial=-math.inf))))
    return beyond


def mission_summary(known: MissionOfPlan, flight: Flight, rig: Rig) -> dict[str, Any]:
    """The figures of a flown mission next to the plan's certificate; `mission` of `flight.json`.

    Args:
        known: the mission.
        flight: of it.
        rig: the cameras in the survey's water.
    """
    plan = known.plan
    promised = planned_stations(plan)
    beyond_m = overshoot_m(known, flight)
    return {
        "file": known.path.name,
        "follower": known.mission.autopilot,
        "steps": len(known.mission.steps),
        "steps_begun": int(flight.flown.report[-1, LEG]) + 1,
        "line_ends": len(beyond_m),
        "line_ends_overshot": sum(beyond > PASSED_M for beyond in beyond_m),
        "planned": covered_shares(plan, rig, promised),
    }


def covered_shares(plan: Plan, rig: Rig, stations: Stations) -> dict[str, float]:
    """What the pictures of some stations see of the whole area; `plan check` shows more.

    Those from too high do not count, as in the plan's certificate.
    """
    near = stations.some(stations.altitude_m <= MAX_ALTITUDES * plan.altitude_m)
    seen = certificate(plan.area, rig, near, plan_pattern(plan, rig))
    names = ("covered_share", "every_camera_share", "share_at_overlap")
    return {name: getattr(seen, name) for name in names}


_SAME_RAD = 1e-6
_SAME_HOME_M = 0.01


def one_dive(plan: Plan, dive: int | None) -> Plan:
    """The plan with one of its dives alone; all lines keep their index.

    Args:
        plan: a survey.
        dive: which, from 1 on; None leaves all of them.

    Raises:
        PlanError: the plan lacks that dive.
    """
    if dive is None:
        return plan
    count = len(plan.dives)
    if not 1 <= dive <= count:
        held = "1 dive" if count == 1 else f"dives 1 to {count}"
        raise PlanError(f"dive {dive} was requested; the plan has {held}: choose one of these")
    chosen = plan.dives[dive - 1]
    return replace(
        plan,
        dives=(chosen,),
        length_m=chosen.route.length_m,
        duration_s=chosen.duration_s,
        energy_wh=chosen.energy_wh,
    )


def stations_of_dives(plan: Plan) -> int:
    """How many times all cameras take a picture on the plan's dives."""
    return len(planned_stations(plan))


def planned_stations(plan: Plan) -> Stations:
    """The stations of the plan's dives, flown exactly."""
    floors_m = np.concatenate(plan.line_floors_m) if plan.line_floors_m else None
    stations = stations_of_plan(plan, floors_m)
    first, last = np.transpose([(dive.first_line, dive.last_line) for dive in plan.dives])
    line = stations.line[:, None]
    return stations.some(np.any((first <= line) & (line <= last), axis=1))


def whole_route(plan: Plan) -> Route:
    """The routes of all dives, one after the other: at home the vehicle turns for the next.

    Raises:
        PlanError: a dive begins elsewhere than the one before has ended.
    """
    legs: list[Leg] = []
    for dive in plan.dives:
        first = dive.route.legs[0]
        if legs:
            last = legs[-1]
            away_m = math.dist(last.end_ne_m, first.start_ne_m)
            if away_m > _SAME_HOME_M:
                raise PlanError(
                    f"a dive begins {away_m:.1f} m from where the one before ends, in another part "
                    f"of the area: fly them one by one: vehicle.dive = 1 to {len(plan.dives)}"
                )
            heading = last.end_heading_rad + last.side_rad
            turn = math.remainder(first.heading_rad + first.side_rad - heading, 2 * math.pi)
            if abs(turn) > _SAME_RAD:
                legs.append(
                    Leg(start_ne_m=last.end_ne_m, heading_rad=heading, length_m=0.0,
                        curvature_per_m=0.0, line=-1, turn_rad=turn)
                )  # fmt: skip
        legs += dive.route.legs
    return Route(legs=tuple(legs))


def path_of(plan: Plan, glass_down_m: float = 0.0, steepest_rad: float = 0.0) -> PilotPath:
    """The route of a plan for the pilot.

    Args:
        plan: its depths over a bathymetry are the deepest of the path.
        glass_down_m: how far the glass is below the origin.
        steepest_rad: slope that the vehicle climbs.
    """
    legs = whole_route(plan).legs
    return path_from_legs(
        [leg.start_ne_m for leg in legs],
        [leg.heading_rad for leg in legs],
        [leg.length_m for leg in legs],
        [leg.curvature_per_m for leg in legs],
        [leg.line for leg in legs],
        plan.altitude_m,
        plan.speed_mps,
        turn_rad=[leg.turn_rad for leg in legs],
        side_rad=[leg.side_rad for leg in legs],
        profile=_profile(plan, legs, glass_down_m, steepest_rad) if plan.line_depths_m else None,
    )


def _profile(
    plan: Plan, legs: Sequence[Leg], glass_down_m: float, steepest_rad: float
) -> tuple[Array, Array]:
    """Distances along legs, and how deep the origin may be there: between lines as on the higher.

    The vehicle climbs ahead of what is higher, at its slope.
    """
    allowed_m = {
        id(leg): depth
        for dive, depths in zip(plan.dives, plan.way_depths_m, strict=True)
        for leg, depth in zip(dive.route.legs, depths, strict=True)
    }
    at_m, depth_m, limit_m, begins_m = list[Array](), list[Array](), list[Array](), 0.0
    for leg in legs:
        on_line = leg.line >= 0
        rows = np.array(plan.line_depths_m[leg.line] if on_line else (math.nan, math.nan))
        at_m.append(begins_m + np.linspace(0.0, leg.length_m, len(rows)))
        depth_m.append(rows)
        limit_m.append(
            np.full(len(rows), math.inf if on_line else allowed_m.get(id(leg), math.inf))
        )
        begins_m += leg.length_m
    along, depth = np.concatenate(at_m), np.concatenate(depth_m)
    deepest = np.fmin(with_depths_between(depth), np.concatenate(limit_m))  # not known: as between
    profile = envelope(along, deepest, math.tan(steepest_rad))
    along, first = np.unique(along, return_index=True)
    return along, profile[first] - glass_down_m


def room_behind_m(plan: Plan, path: PilotPath, max_m: float) -> float:
    """How far the vehicle may go back from the path's start, to come in straight.

    Args:
        plan: whose allowed area counts.
        path: its first leg's course.
        max_m: the most that is of use.
    """
    course = float(path.heading_rad[0])
    ahead = np.array([math.cos(course), math.sin(course)])
    return room_m(plan, np.array([path.start_n[0], path.start_e[0]]), -max_m * ahead)


def roomier_side(
    plan: Plan, path: PilotPath, way_in_m: float, radius_m: float
) -> tuple[float, float]:
    """On which side of the way in a circle lies more inside the allowed area, +1 to starboard.

    Args:
        plan: whose allowed area counts.
        path: its first leg's course.
        way_in_m: length of the way in, at whose start the circle touches it.
        radius_m: of the circle.

    Returns:
        The side, and the share of the circle that lies outside.
    """
    course = float(path.heading_rad[0])
    ahead = np.array([math.cos(course), math.sin(course)])
    touches = np.array([path.start_n[0], path.start_e[0]]) - way_in_m * ahead
    starboard = np.array([-ahead[1], ahead[0]])
    outside = []
    for side in (1.0, -1.0):
        circle = Point(touches + side * radius_m * starboard).buffer(radius_m)
        outside.append(float(circle.difference(plan.area.allowed).area / circle.area))
    return (1.0 if outside[0] <= outside[1] else -1.0), min(outside)
