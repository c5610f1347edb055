"""Fly a plan in simulation: true track, triggers, navigation log, vehicle log, bag and plots."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from alice_survey.core.artefacts import write_csv
from alice_survey.core.config import SurveyConfig
from alice_survey.core.errors import VehicleError, warn
from alice_survey.core.executor import Executor, progress
from alice_survey.core.records import FlightRecord
from alice_survey.core.trajectory import write_track
from alice_survey.sim.seafloor.terrain import survey_terrain
from alice_survey.sim.vehicle.log import write_vehicle_log
from alice_survey.sim.vehicle.sea import FloorGrid
from camera_calib.rig import design_rig
from missions.fly.flight_plots import draw_flight, draw_vehicle
from missions.fly.flight_records import bag_record, believed_log, flight_summary, true_log
from missions.fly.flight_route import one_dive, stations_of_dives
from missions.fly.mission_flight import mission_of_settings, mission_summary, simulate_mission
from missions.fly.simulation import flight_settings, floor_grid, simulate_plan
from missions.logs.bag import write_bag
from missions.values.flight import Flight, rms
from missions.values.navigation import write_navigation
from missions.values.plan_file import Plan, read_plan

_SEED_STREAM = 20
MAX_HEADING_DEG = 10.0
"""A picture of 4 by 3 turned by so much covers a strip narrower by a tenth."""
TRIGGER_COLUMNS = ("station", "time_s", "line")


def run_fly(workspace: Path, folder: Path, executor: Executor, *, survey: SurveyConfig) -> None:
    """Write triggers, navigation, vehicle logs, a bag, the truth and plots.

    Raises:
        VehicleError: the vehicle took no picture at all; the message says why.
    """
    for _ in progress(_steps(folder, workspace / "plan" / "plan.json", survey), "flight files", 5):
        pass


def _steps(folder: Path, plan_path: Path, survey: SurveyConfig) -> Iterator[str]:
    """Write the files of a flight, and say after each step what is done."""
    plan = one_dive(read_plan(plan_path), survey.vehicle.dive)
    floor = true_floor(plan, survey)
    yield "sea floor"
    settings = flight_settings(survey)
    fly = simulate_plan if survey.vehicle.mission_file is None else simulate_mission
    flight = fly(plan, settings, floor, flight_noise(survey.seed))
    _check_pictures(
        flight, stations_of_dives(flight.plan), "swell" if survey.sea.swell_m > 0.0 else "current"
    )
    yield "flight"
    write_track(folder / "truth" / "track.csv", flight.truth)
    write_vehicle_log(folder / "truth" / "vehicle.csv", true_log(flight))
    yield "truth"
    _write_triggers(folder / "triggers.csv", flight)
    write_navigation(folder / "navigation.csv", flight.log, plan.datum)
    write_vehicle_log(folder / "vehicle.csv", believed_log(flight))
    write_bag(folder / "bag", bag_record(flight))
    yield "logs"
    rig = design_rig(survey.camera, survey.water)
    summary = flight_summary(flight, survey.vehicle, rig)
    if survey.vehicle.mission_file is not None:
        summary["mission"] = mission_summary(mission_of_settings(plan, settings), flight, rig)
    FlightRecord.save(folder / "flight.json", summary)
    draw_flight(folder / "track.png", flight)
    draw_vehicle(folder / "vehicle.png", flight)
    yield "plots"


def true_floor(plan: Plan, survey: SurveyConfig) -> FloorGrid:
    """The simulated sea floor below a plan."""
    return floor_grid(
        survey_terrain(
            survey.seafloor,
            plan.area.allowed_corners_ne,
            margin_m=survey.plan.altitude_m,
            depth_m=survey.area.seafloor_depth_m,
            seed=survey.seed,
        )
    )


def flight_noise(seed: int) -> np.random.Generator:
    """Source of all noise of a survey's flight."""
    return np.random.default_rng([seed, _SEED_STREAM])


def _check_pictures(flight: Flight, planned: int, sea: str) -> None:
    """Warn of stations that were missed or lie off their lines.

    Args:
        flight: to judge.
        planned: stations.
        sea: what may have carried the vehicle off.

    Raises:
        VehicleError: no picture was taken.
    """
    if not len(flight.trigger_s):
        raise VehicleError(
            f"{flight.vehicle.name} reached no line of the plan ({flight.ending} after "
            f"{flight.truth.time_s[-1]:.0f} s): change the {sea}, the thrusters or the plan"
        )
    for one in flight.flown.found:
        what = "turned, but gave no thrust" if one.turns else "did not turn as commanded"
        warn(
            f"{one.thruster} {what}, found after {one.time_s:.0f} s: from there "
            f"on {flight.vehicle.name} counted on {one.left:.0%} of its thrust"
        )
    _warn_of_heading(flight)
    if len(flight.trigger_s) < planned:
        warn(
            f"{len(flight.trigger_s)} of {planned} stations were reached: the mission "
            f"was {flight.ending}"
        )
    if flight.stations_off_line:
        warn(
            f"{flight.stations_off_line} of {len(flight.trigger_s)} pictures were taken more than "
            f"{flight.allowed_cross_track_m:.2f} m off their lines, where neighbouring lines may "
            "leave gaps: choose more side_overlap, less current or another controller"
        )


def _warn_of_heading(flight: Flight) -> None:
    """Warn where pictures are turned so far that they leave the strip of their line."""
    heading = np.rad2deg(flight.line_errors[1])
    if np.isfinite(heading).any() and rms(heading) > MAX_HEADING_DEG:
        warn(
            f"on lines the heading was off by {rms(heading):.0f} deg rms, "
            f"{np.nanmax(np.abs(heading)):.0f} at most: pictures do not lie square to their lines"
        )


def _write_triggers(path: Path, flight: Flight) -> None:
    rows = zip(flight.trigger_s.tolist(), flight.trigger_line, strict=True)
    write_csv(
        path,
        TRIGGER_COLUMNS,
        ([station, f"{time_s:.6f}", line] for station, (time_s, line) in enumerate(rows)),
    )
