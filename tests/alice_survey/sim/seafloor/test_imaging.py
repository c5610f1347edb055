import csv
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from shapely.geometry import MultiPolygon, box

from alice_survey.app.stages import spec
from alice_survey.core.artefacts import Stage, run_stage, write_csv, write_json
from alice_survey.core.config import SurveyConfig
from alice_survey.core.errors import NavigationError
from alice_survey.core.executor import SERIAL, local_executor
from alice_survey.core.frames import interpolate_poses, rotation_from_attitude
from alice_survey.core.manifest import read_manifest
from alice_survey.core.trajectory import Trajectory, read_track, write_track
from camera_calib.rig import read_rig
from tests.missions.flown_plans import plan_of, walk

TIMES_S = (2.0, 4.25, 6.5)
SETTINGS = SurveyConfig.model_validate(
    {"seed": 5, "seafloor": {"grid_m": 0.02}, "imaging": {"scale": 16, "pool_views": 8}}
)
NAVIGATION_COLUMNS = (
    "time_s", "latitude_deg", "longitude_deg", "depth_m", "roll_deg", "pitch_deg", "heading_deg",
    "altitude_m", "sigma_horizontal_m", "sigma_depth_m", "sigma_attitude_deg", "sigma_heading_deg",
    "sigma_altitude_m",
)  # fmt: skip


def fly(workspace: Path, until_s: float = 9.0) -> None:
    """A plan and a flight northward at 0.2 m/s, in the files that missions write."""

    def plan(folder: Path) -> None:
        planned = plan_of([walk((0.0, 0.0), 0.0, [("line", 1.0, 0)])])
        area = replace(planned.area, allowed=MultiPolygon([box(0.0, 0.0, 1.0, 0.5)]))
        write_json(folder / "plan.json", replace(planned, area=area, exposure_s=0.002).to_json())

    def flight(folder: Path) -> None:
        time_s = np.arange(0.0, until_s, 0.1)
        zero = 0 * time_s
        places = np.column_stack([0.2 * time_s - 1.0, 0.2 + zero, 12.9 + zero])
        angles = np.deg2rad([1.0 + 0.5 * np.sin(time_s), -1.0 + zero, 0.5 * np.cos(3 * time_s)])
        track = Trajectory(
            time_s=time_s,
            ned_from_body=RigidTransform.from_components(places, rotation_from_attitude(*angles)),
        )
        (folder / "truth").mkdir()
        write_track(folder / "truth" / "track.csv", track)
        write_csv(
            folder / "triggers.csv",
            ("station", "time_s", "line"),
            [(i, t, 0) for i, t in enumerate(TIMES_S)],
        )
        heading = np.where(time_s < 4.25, 359.0, 2.0)
        rows = np.column_stack([
            time_s, 32.8 + 1e-6 * time_s, 34.9 + zero, 12.8 + zero, 2 + zero, -1 + zero, heading,
            2.1 + zero, 0.3 + zero, 0.01 + zero, 0.3 + zero, 1 + zero, 0.02 + zero,
        ])  # fmt: skip
        write_csv(folder / "navigation.csv", NAVIGATION_COLUMNS, rows.tolist())

    for name, work in (("plan", plan), ("flight", flight)):
        run_stage(workspace, Stage(name=name, version=1, settings={}), work)


def pose_of(row: dict[str, str]) -> RigidTransform:
    """`ned_from_cam` of a row of poses.csv."""
    return RigidTransform.from_components(
        [float(row[k]) for k in ("north_m", "east_m", "depth_m")],
        Rotation.from_quat([float(row[k]) for k in ("qx", "qy", "qz", "qw")]),
    )


def content(folder: Path) -> dict[str, bytes]:
    """All files but the record of the stage, which holds times."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != "stage.json"
    }


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    workspace = tmp_path_factory.mktemp("survey")
    fly(workspace)
    assert spec("image").make(workspace, SETTINGS, SERIAL)
    return workspace


def test_there_is_a_stereo_pair_for_each_trigger(survey: Path) -> None:
    records = read_manifest(survey / "images" / "manifest.csv")
    assert [(r.image, r.camera, r.station) for r in records] == [
        (f"{camera}/{station:06d}.png", camera, station)
        for station in range(3)
        for camera in ("left", "right")
    ]
    for record in records:
        picture = cv2.imread(str(survey / "images" / record.image))
        assert picture.shape == (169, 211, 3)
        assert 60 < np.median(picture) < 180
        assert picture.std() > 8
    facts = json.loads((survey / "images" / "survey.json").read_text())
    assert facts["source"] == "simulated"
    assert facts["datum"] == {"latitude_deg": 32.8, "longitude_deg": 34.9, "height_m": 0.0}


def test_the_manifest_says_what_navigation_believes_not_the_truth(survey: Path) -> None:
    records = read_manifest(survey / "images" / "manifest.csv")
    for record, time_s in zip(records[::2], TIMES_S, strict=True):
        assert record.time_s == time_s
        assert record.latitude_deg == pytest.approx(32.8 + 1e-6 * time_s, abs=1e-10)
        assert record.depth_m == 12.8  # the truth is 12.9
        assert record.altitude_m == 2.1
        assert (record.sigma_horizontal_m, record.sigma_heading_deg) == (0.3, 1.0)
    # 4.25 s is half-way from 359 degrees to 2: north, not south.
    assert [r.heading_deg for r in records[::2]] == pytest.approx([359.0, 0.5, 2.0], abs=1e-9)


def test_truth_holds_the_poses_that_were_flown(survey: Path) -> None:
    truth = survey / "images" / "truth"
    rig, track = read_rig(truth / "rig.json"), read_track(survey / "flight/truth/track.csv")
    with (truth / "poses.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 6
    for row, time_s, camera in zip(rows, np.repeat(TIMES_S, 2), ["left", "right"] * 3, strict=True):
        body = interpolate_poses(track.time_s, track.ned_from_body, np.array([time_s]))[0]
        expected = body * rig.body_from_cam(camera)
        np.testing.assert_allclose(pose_of(row).as_matrix(), expected.as_matrix(), atol=1e-10)
    assert rig.cameras["left"].width_px == 211
    assert rig.cameras["left"] != rig.cameras["right"]


@pytest.mark.slow
def test_two_processes_give_the_same_bytes_as_one(survey: Path, tmp_path: Path) -> None:
    fly(tmp_path)
    assert spec("image").make(tmp_path, SETTINGS, local_executor(2))
    assert content(tmp_path / "images") == content(survey / "images")


def test_a_flight_that_ends_before_its_triggers_is_refused(tmp_path: Path) -> None:
    fly(tmp_path, until_s=5.0)
    with pytest.raises(NavigationError, match=r"4\.90 s.* 6\.50"):
        spec("image").make(tmp_path, SETTINGS, SERIAL)
