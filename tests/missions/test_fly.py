from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from alice_survey.config import SurveyConfig, parse_config
from alice_survey.errors import WorkspaceError
from alice_survey.frames import interpolate_poses
from alice_survey.seafloor.terrain import survey_terrain
from alice_survey.trajectory import read_columns, read_track
from missions.flight_plots import line_errors
from missions.fly import run_fly
from missions.plan import read_plan, run_plan
from missions.track import Flight


def survey(**changes: object) -> SurveyConfig:
    return parse_config(
        {
            "name": "small",
            "area": {"length_m": 3.0, "width_m": 2.5},
            "seafloor": {"grid_m": 0.05},
            **changes,
        },
        "test",
    )


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("survey")
    run_plan(folder, survey(), 1)
    assert run_fly(folder, survey(), 1)
    return folder


def test_a_flight_needs_a_plan(tmp_path: Path) -> None:
    with pytest.raises(WorkspaceError, match="alice-survey plan"):
        run_fly(tmp_path, survey(), 1)


def test_it_is_skipped_while_nothing_it_needs_changes(workspace: Path) -> None:
    assert not run_fly(workspace, survey(), 1)
    assert not run_fly(workspace, survey(imaging={"scale": 4}), 1)


def test_a_flight_is_the_same_bytes_each_time_and_another_with_another_seed(
    workspace: Path, tmp_path: Path
) -> None:
    files = ("triggers.csv", "navigation.csv", "truth/track.csv", "track.png")
    run_plan(tmp_path, survey(), 1)
    assert run_fly(tmp_path, survey(), 1)
    for name in files:
        one, two = workspace / "flight" / name, tmp_path / "flight" / name
        assert one.read_bytes() == two.read_bytes()

    assert run_fly(tmp_path, survey(seed=2), 1)
    same = [
        (workspace / "flight" / name).read_bytes() == (tmp_path / "flight" / name).read_bytes()
        for name in files
    ]
    assert same == [True, False, False, False]


def test_each_station_is_within_the_log_and_near_its_plan(workspace: Path) -> None:
    config = survey()
    plan = read_plan(workspace / "plan" / "plan.json")
    track = read_track(workspace / "flight" / "truth" / "track.csv")
    columns = read_columns(workspace / "flight" / "triggers.csv", ("station", "time_s", "line"))
    times = columns["time_s"]

    assert columns["station"].tolist() == list(range(plan.stations))
    assert columns["line"].tolist() == [
        i for i, line in enumerate(plan.lines) for _ in range(line.stations)
    ]
    poses = interpolate_poses(track.time_s, track.ned_from_body, times)
    glass = poses.apply(np.array(config.camera.position_body_m))
    off = glass[:, :2] - np.vstack([line.stations_ne for line in plan.lines])
    assert 0.01 < np.sqrt((off**2).sum(axis=1).mean()) < 0.15
    floor = survey_terrain(config, plan.area_ne_m)
    altitude = floor.depth_at(glass[:, :2]) - glass[:, 2]
    assert 1.6 < altitude.min() < altitude.max() < 2.4
    assert abs(altitude.mean() - 2.0) < 0.1


def test_navigation_is_of_the_body_at_the_flights_rate(workspace: Path) -> None:
    plan = read_plan(workspace / "plan" / "plan.json")
    track = read_track(workspace / "flight" / "truth" / "track.csv")
    log = read_columns(
        workspace / "flight" / "navigation.csv",
        ("time_s", "latitude_deg", "longitude_deg", "depth_m", "sigma_horizontal_m", "altitude_m"),
    )
    ned = plan.datum.ned_from_geodetic(
        np.column_stack([log["latitude_deg"], log["longitude_deg"], log["depth_m"]])
    )

    np.testing.assert_allclose(log["time_s"], track.time_s, atol=1e-6)
    np.testing.assert_allclose(np.diff(log["time_s"]), 0.05, atol=1e-5)
    off = ned - track.ned_from_body.translation
    assert np.abs(off[:, :2]).max() < 5 * log["sigma_horizontal_m"].max()
    # One bias over the flight, so that a short log cannot average it away.
    assert off[:, :2].std(axis=0).max() < 0.3 * log["sigma_horizontal_m"][0]
    assert np.abs(log["altitude_m"] - 2.0).max() < 0.5


def test_errors_on_lines_are_what_the_plot_says(workspace: Path) -> None:
    plan = read_plan(workspace / "plan" / "plan.json")
    track = read_track(workspace / "flight" / "truth" / "track.csv")
    columns = read_columns(workspace / "flight" / "triggers.csv", ("time_s", "line"))
    flight = Flight(
        truth=track,
        glass_ned=track.ned_from_body.apply(np.array(survey().camera.position_body_m)),
        trigger_s=columns["time_s"],
        trigger_line=tuple(columns["line"].astype(int).tolist()),
    )
    cross, heading = line_errors(plan, flight)

    between = np.isnan(cross)
    assert 0.2 < between.mean() < 0.8
    assert 0.005 < np.sqrt(np.nanmean(cross**2)) < 0.15
    assert 0.2 < np.rad2deg(np.sqrt(np.nanmean(heading**2))) < 5.0
    assert np.array_equal(between, np.isnan(heading))


def test_the_plot_is_a_picture_with_ink(workspace: Path) -> None:
    with Image.open(workspace / "flight" / "track.png") as picture:
        pixels = np.asarray(picture.convert("L"))
        assert "Software" not in picture.info
    assert min(pixels.shape) > 800
    assert 0.03 < (pixels < 230).mean() < 0.9
