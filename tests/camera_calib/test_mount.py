"""How a rig is mounted: words, files, and what is not known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from typer.testing import CliRunner

from alice_survey.app.cli.main import app
from alice_survey.core.config import SurveyConfig
from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import BODY_FROM_NADIR_CAM, Array
from camera_calib.mount import mount_line, mount_rotation, with_mount
from camera_calib.rig import Rig, design_rig, read_rig, write_rig

RIGHT, BOTTOM, AHEAD = np.eye(3)
FORWARD, STARBOARD, DOWN = np.eye(3)


@pytest.fixture(name="rig")
def _rig() -> Rig:
    config = SurveyConfig()
    return replace(design_rig(config.camera, config.water), body_from_rig=None)


@pytest.mark.parametrize(
    ("words", "bow"),
    [
        ("nadir", -BOTTOM),
        ("nadir-bow-up", -BOTTOM),
        ("nadir-bow-right", RIGHT),
        ("nadir-bow-down", BOTTOM),
        ("nadir-bow-left", -RIGHT),
    ],
)
def test_the_bow_is_where_the_words_say(words: str, bow: Array) -> None:
    turn = mount_rotation(words)
    np.testing.assert_allclose(turn.apply(AHEAD), DOWN, atol=1e-15)
    np.testing.assert_allclose(turn.apply(bow), FORWARD, atol=1e-15)
    assert np.linalg.det(turn.as_matrix()) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("name", "way"),
    [("forward", FORWARD), ("aft", -FORWARD), ("starboard", STARBOARD), ("port", -STARBOARD)],
)
@pytest.mark.parametrize("tilt_deg", [0, 30, 80])
def test_cameras_that_look_ahead_have_level_rows_and_sink_as_said(
    name: str, way: Array, tilt_deg: int
) -> None:
    turn = mount_rotation(f"{name}+{tilt_deg}" if tilt_deg else name)
    looks, right, bottom = (turn.apply(axis) for axis in (AHEAD, RIGHT, BOTTOM))
    assert np.rad2deg(np.arcsin(looks[2])) == pytest.approx(tilt_deg, abs=1e-6)
    assert right[2] == pytest.approx(0.0, abs=1e-15)
    assert looks @ way == pytest.approx(np.cos(np.deg2rad(tilt_deg)), abs=1e-12)
    assert bottom[2] == pytest.approx(np.cos(np.deg2rad(tilt_deg)), abs=1e-12)


def test_nadir_is_the_mount_of_the_design() -> None:
    np.testing.assert_allclose(
        mount_rotation("nadir-bow-up").as_matrix(), BODY_FROM_NADIR_CAM.as_matrix()
    )
    config = SurveyConfig()
    rig = design_rig(config.camera, config.water)
    found = with_mount(rig, "nadir-bow-up", config.camera.position_body_m)
    np.testing.assert_allclose(
        found.body_from_rig.as_matrix(), rig.body_from_rig.as_matrix(), atol=1e-12
    )


@pytest.mark.parametrize("words", ["", "up", "nadir-bow", "nadir-bow-aft", "forward+", "port+91"])
def test_words_that_name_no_mount_are_refused(words: str) -> None:
    with pytest.raises(CalibrationError, match="nadir-bow-up"):
        mount_rotation(words)


def test_an_unknown_mount_stays_unknown_through_a_file_and_says_what_to_do(
    rig: Rig, tmp_path: Path
) -> None:
    write_rig(tmp_path / "rig.json", rig)
    read = read_rig(tmp_path / "rig.json")
    assert read.body_from_rig is None
    assert "unknown" in mount_line(read)
    with pytest.raises(CalibrationError, match="--mount"):
        read.body_from_cam("left")


def test_a_mount_is_stated_shown_and_taken_from_another_rig(rig: Rig, tmp_path: Path) -> None:
    path, lever = tmp_path / "rig.json", (0.4, 0.1, 0.2)
    write_rig(tmp_path / "bare.json", rig)
    options = ["--mount", "forward+30", "--lever", *map(str, lever)]
    arguments = ["camera", "convert", str(tmp_path / "bare.json"), str(path), *options]
    done = CliRunner().invoke(app, arguments)
    assert "0.0 deg from forward+30" in done.output
    found = read_rig(path)
    np.testing.assert_allclose(
        found.body_from_cam("left").apply(found.cameras["left"].front_cam), lever, atol=1e-12
    )
    other = with_mount(rig, str(path), None)
    np.testing.assert_allclose(other.body_from_rig.as_matrix(), found.body_from_rig.as_matrix())
    assert found.body_from_rig is not None
    turned = replace(
        found,
        body_from_rig=RigidTransform.from_rotation(Rotation.from_rotvec([0, 0, 0.02]))
        * found.body_from_rig,
    )
    assert "1.1 deg from forward+30" in mount_line(turned)
    assert "exists" in str(CliRunner().invoke(app, arguments).exception)
