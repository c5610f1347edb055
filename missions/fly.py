"""Fly a plan in simulation: the true track, the triggers and the navigation log."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from alice_survey.artefacts import Stage, need_stage, run_stage, write_csv
from alice_survey.config import SurveyConfig
from alice_survey.executor import progress
from alice_survey.seafloor.terrain import survey_terrain
from alice_survey.trajectory import write_track
from missions.flight_plots import draw_flight
from missions.navigation import navigate, write_navigation
from missions.plan_file import read_plan
from missions.track import Flight, fly_plan

_SEED_STREAM = 20
TRIGGER_COLUMNS = ("station", "time_s", "line")


def run_fly(workspace: Path, config: SurveyConfig, threads: int) -> bool:
    """Stage `flight`: write triggers.csv, navigation.csv, truth/track.csv and track.png.

    Returns:
        True when work was done, False when the flight was up to date.

    Raises:
        WorkspaceError: there is no plan.
    """
    plan_path = need_stage(workspace, "plan", "plan") / "plan.json"
    stage = Stage(
        name="flight",
        version=1,
        settings={
            "seed": config.seed,
            "flight": config.flight.model_dump(mode="json"),
            "seafloor": config.seafloor.model_dump(mode="json"),
            "seafloor_depth_m": config.area.seafloor_depth_m,
            "plan": config.plan.model_dump(mode="json"),
            "position_body_m": list(config.camera.position_body_m),
            "dvl_position_body_m": list(config.camera.dvl_position_body_m),
        },
        inputs=[plan_path],
    )

    def work(folder: Path) -> None:
        for _ in progress(_steps(folder, plan_path, config), "flight", 4):
            pass

    return run_stage(workspace, stage, work)


def _steps(folder: Path, plan_path: Path, config: SurveyConfig) -> Iterator[str]:
    """Write the files of a flight, and say after each step what is done."""
    plan = read_plan(plan_path)
    floor = survey_terrain(config, plan.area_ne_m)
    yield "sea floor"
    rng = np.random.default_rng([config.seed, _SEED_STREAM])
    flight = fly_plan(plan, config.flight, floor, config.camera.position_body_m, rng)
    write_track(folder / "truth" / "track.csv", flight.truth)
    _write_triggers(folder / "triggers.csv", flight)
    yield "track"
    log = navigate(flight.truth, config.flight, floor, config.camera, rng)
    write_navigation(folder / "navigation.csv", log, plan.datum)
    yield "navigation"
    draw_flight(folder / "track.png", plan, flight, log)
    yield "plot"


def _write_triggers(path: Path, flight: Flight) -> None:
    rows = zip(flight.trigger_s.tolist(), flight.trigger_line, strict=True)
    write_csv(
        path,
        TRIGGER_COLUMNS,
        ([station, f"{time_s:.6f}", line] for station, (time_s, line) in enumerate(rows)),
    )
