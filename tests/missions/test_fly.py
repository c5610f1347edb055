import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from alice_survey.app.pipeline import run
from alice_survey.app.stages import spec
from alice_survey.core.config import SurveyConfig
from alice_survey.core.errors import PlanError
from alice_survey.core.executor import SERIAL
from alice_survey.core.frames import interpolate_poses
from alice_survey.core.trajectory import read_columns, read_track
from alice_survey.sim.vehicle.log import read_vehicle_log
from missions.values.plan_file import read_plan
from tests.missions import flown_plans
from tests.missions.flown_plans import terrain_of
from tests.refusals import refused

FILES = (
    "triggers.csv", "navigation.csv", "vehicle.csv", "flight.json", "truth/track.csv",
    "truth/vehicle.csv", "track.png", "bag/bag.mcap",
)  # fmt: skip


def survey(**changes: Any) -> SurveyConfig:
    sections = {"name": "small", "seafloor": {"grid_m": 0.05}, "sea": {}, **changes}
    return flown_plans.survey(**sections)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("survey")
    spec("plan").make(folder, survey(), SERIAL)
    assert spec("fly").make(folder, survey(), SERIAL)
    return folder


@pytest.mark.slow
def test_a_flight_is_the_same_bytes_each_time_and_another_with_another_seed(
    workspace: Path, tmp_path: Path
) -> None:
    # It is skipped while nothing that it needs changes.
    assert not spec("fly").make(workspace, survey(), SERIAL)
    assert not spec("fly").make(workspace, survey(imaging={"scale": 4}), SERIAL)
    spec("plan").make(tmp_path, survey(), SERIAL)
    for seed, is_same in ((1, True), (2, False)):
        assert spec("fly").make(tmp_path, survey(seed=seed), SERIAL)
        for name in FILES:
            one, two = workspace / "flight" / name, tmp_path / "flight" / name
            assert (one.read_bytes() == two.read_bytes()) == is_same, name


def test_stations_are_near_their_plan_and_navigation_is_of_the_body(workspace: Path) -> None:
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
    assert 0.005 < np.sqrt((off**2).sum(axis=1).mean()) < 0.2
    floor = terrain_of(config, plan)
    altitude = floor.depth_at(glass[:, :2]) - glass[:, 2]
    assert 1.6 < altitude.min() < altitude.max() < 2.4
    assert abs(altitude.mean() - 2.0) < 0.1

    log = read_columns(
        workspace / "flight" / "navigation.csv",
        ("time_s", "latitude_deg", "longitude_deg", "depth_m", "sigma_horizontal_m"),
    )
    ned = plan.datum.ned_from_geodetic(
        np.column_stack([log["latitude_deg"], log["longitude_deg"], log["depth_m"]])
    )

    np.testing.assert_allclose(log["time_s"], track.time_s, atol=1e-6)
    np.testing.assert_allclose(np.diff(log["time_s"]), 0.05, atol=1e-5)
    off = np.abs(ned - track.ned_from_body.translation)[:, :2]
    assert 0.1 < (off / log["sigma_horizontal_m"][:, None]).max() < 5.0


def test_logs_of_the_vehicle_and_the_bag_read_back_and_agree(workspace: Path) -> None:
    flight = workspace / "flight"
    believed = read_vehicle_log(flight / "vehicle.csv")
    true = read_vehicle_log(flight / "truth" / "vehicle.csv")

    assert set(believed.rpm) == {"starboard", "port", "vertical", "bow", "stern"}
    for name, rpm in believed.rpm.items():
        np.testing.assert_array_equal(rpm, true.rpm[name])
        assert np.abs(rpm).max() <= 3400.0
    speed_off = believed.velocity_body - true.velocity_body
    assert 1e-4 < np.sqrt(np.mean(speed_off**2)) < 0.02

    depths = []
    with AnyReader([flight / "bag"]) as reader:
        wanted = [c for c in reader.connections if c.topic.endswith("navigation/odometry")]
        assert len(wanted) == 1
        for connection, _, raw in reader.messages(connections=wanted):
            message: Any = reader.deserialize(raw, connection.msgtype)
            depths.append(-message.pose.pose.position.z)
    log = read_columns(flight / "navigation.csv", ("depth_m",))["depth_m"]
    np.testing.assert_allclose(depths, log[::2], atol=1e-4)


def test_the_summary_holds_the_figures_of_the_flight(workspace: Path) -> None:
    found = json.loads((workspace / "flight" / "flight.json").read_text())
    assert found["ending"] == "complete"
    assert found["stations"] == found["stations_planned"]
    assert 0.001 < found["on_lines"]["cross_track_rms_m"] < 0.12
    assert 0.1 < found["on_lines"]["heading_rms_deg"] < 3.0
    assert 0.18 < found["on_lines"]["speed_mean_mps"] < 0.22
    assert 0.5 < sum(found["energy_wh"].values()) < 20.0


def test_a_vehicle_that_reaches_no_line_says_why(tmp_path: Path) -> None:
    # The plan is for a calm sea: for this one there would be none.
    spec("plan").make(tmp_path, survey(), SERIAL)
    strong = survey(sea={"current_mps": 2.5})
    spec("fly").make(tmp_path, strong, SERIAL)
    assert json.loads((tmp_path / "flight" / "flight.json").read_text())["stations"] == 0
    assert "early" in spec("fly").shortfall(tmp_path / "flight")
    assert (tmp_path / "flight" / "track.png").exists()


def test_a_stale_plan_is_flown_with_a_warning_and_options_are_said_to_be_for_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small = (
        "[area]\nlength_m = 2.0\nwidth_m = 1.5\nseafloor_depth_m = 5.0\n[seafloor]\ngrid_m = 0.05\n"
    )
    (tmp_path / "survey.toml").write_text(small)
    run(["plan"], tmp_path, None)
    (tmp_path / "survey.toml").write_text(small + "[plan]\nspeed_mps = 0.25\n")
    run(["fly"], tmp_path, None, changes={"sea": {"current_mps": 0.1, "current_towards_deg": 90.0}})
    warned = capsys.readouterr().err
    assert "stale" in warned
    assert "survey.toml" in warned


@pytest.mark.slow
def test_an_exported_mission_is_flown_next_to_its_certificate(
    workspace: Path, tmp_path: Path
) -> None:
    spec("plan").make(tmp_path, survey(), SERIAL)
    (tmp_path / "survey.toml").write_text(
        "[area]\nlength_m = 3.0\nwidth_m = 2.5\nseafloor_depth_m = 6.0\n[seafloor]\ngrid_m = 0.05\n"
    )
    file = tmp_path / "plan" / "exports" / "mission_dive1.plan"
    text, data = run(["fly"], tmp_path, None, changes={"vehicle": {"mission_file": file}})
    found = data["fly"]
    mission = json.loads((tmp_path / "flight" / "flight.json").read_text())["mission"]
    plan = read_plan(tmp_path / "plan" / "plan.json")

    assert "mission_dive1.plan as ardusub flies it" in text
    assert mission == found["mission"]
    assert mission["planned"]["share_at_overlap"] == pytest.approx(plan.coverage)
    assert mission["line_ends"] == len(plan.lines)
    assert 0.9 < found["coverage"]["share_at_overlap"] <= 1.0
    assert {path.name for path in (tmp_path / "flight").iterdir()} >= {"triggers.csv", "bag"}
    # Another file is another flight; one that holds no mission is refused in a line.
    (tmp_path / "notes.txt").write_text("nothing")
    with refused(PlanError, "no mission"):
        run(["fly"], tmp_path, None, changes={"vehicle": {"mission_file": tmp_path / "notes.txt"}})
