"""A mission file, flown in simulation by the law of the autopilot that it is for."""

import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.config import CameraConfig, VehicleConfig
from alice_survey.core.errors import PlanError, VehicleError
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.pilot import mission as pilot
from alice_survey.sim.vehicle.pilot.gains import gains_for
from alice_survey.sim.vehicle.pilot.memory import ALONG, LEG
from alice_survey.sim.vehicle.pilot.mission import MIN_SPEED_MPS, ArduSubSettings
from alice_survey.sim.vehicle.sea import FloorGrid
from alice_survey.sim.vehicle.simulator import simulate
from camera_calib.rig import Rig
from missions.coverage.certificate import certificate
from missions.coverage.stations import plan_pattern, stations_of_lines
from missions.exports.advice import cola2_settings
from missions.exports.follower import cola2_delta_m, sways
from missions.exports.geometry import CameraMount
from missions.exports.registry import read_mission
from missions.fly.flight_route import one_dive
from missions.fly.simulation import (
    FlightSettings,
    ascent_s,
    flight_of,
    max_mission_s,
    mission_setup,
)
from missions.route.energy import sound_vehicle
from missions.values.flight import Flight
from missions.values.mission import Mission
from missions.values.plan_file import Plan

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
    known, camera = mission_of_settings(plan, settings), settings.camera
    flown_by = pilot_mission(known, settings.vehicle, _mount(camera))
    # Our own pilot holds places by sway where a vehicle has it, which the laws may ask for.
    own = settings.vehicle.model_copy(
        update={"controller": "sway" if _sways(settings.vehicle, plan.speed_mps) else "los"}
    )
    max_s = max_mission_s(known.plan)
    setup = mission_setup(
        known.plan, replace(settings, vehicle=own), floor, max_s, rng, mission=flown_by
    )
    flown = simulate(
        setup,
        rng,
        max_s=max_s + ascent_s(plan),
        label=label,
        expected_s=known.plan.duration_s,
    )
    pictures = partial(picture_times, known)
    return flight_of(known.plan, camera.position_body_m, setup, flown, pictures)


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


def _sways(vehicle: VehicleConfig, speed_mps: float) -> bool:
    return sways(gains_for(sound_vehicle(vehicle), speed_mps))


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
        return pilot.mission_of(pilot.ARDUSUB, steps, ArduSubSettings())
    delta_m = cola2_delta_m(gains, plan.speed_mps)
    if not math.isfinite(delta_m):
        raise VehicleError(
            f"no look-ahead keeps {vehicle.name} from weaving under COLA2: lower the speed"
        )
    return pilot.mission_of(pilot.COLA2, steps, cola2_settings(delta_m, plan.speed_mps))


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
    report = flight.flown.report
    ends, starts = (
        known.mission.ends_ne(known.plan.datum),
        known.mission.starts_ne(known.plan.datum),
    )
    beyond = []
    for i, index in enumerate(known.line):
        if index < 0 or (i + 1 < len(known.line) and known.line[i + 1] == index):
            continue
        rows = report[:, LEG] == i
        start = starts[i] if np.isfinite(starts[i]).all() else ends[i - 1]
        swing_m = (
            known.mission.steps[i].tolerance_m if known.mission.autopilot == "ardusub" else 0.0
        )
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
    lines = [
        line for dive in plan.dives for line in plan.lines[dive.first_line : dive.last_line + 1]
    ]
    promised = certificate(
        plan.area, rig, stations_of_lines(lines, plan.altitude_m), plan_pattern(plan, rig)
    )
    beyond_m = overshoot_m(known, flight)
    return {
        "file": known.path.name,
        "follower": known.mission.autopilot,
        "steps": len(known.mission.steps),
        "steps_begun": int(flight.flown.report[-1, LEG]) + 1,
        "line_ends": len(beyond_m),
        "line_ends_overshot": sum(beyond > PASSED_M for beyond in beyond_m),
        "overshot_worst_m": max(beyond_m, default=0.0),
        "planned": {
            "covered_share": promised.covered_share,
            "every_camera_share": promised.every_camera_share,
            "share_at_overlap": promised.share_at_overlap,
        },
    }
