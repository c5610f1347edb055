"""ROS's camera_info: keys of camera_calibration_parsers, poses from the rectified pair."""

import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import assume, given, settings
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.errors import CalibrationError
from camera_calib.formats.convert import detect
from camera_calib.formats.rigs import ReadOptions
from camera_calib.formats.yaml_files import read_ros, write_ros
from camera_calib.rig import Rig
from tests.cameras import changed, flat_port_camera
from tests.strategies_formats import (
    BOTH_LENSES,
    POINTS_RIG,
    RATIONAL,
    assert_same_geometry,
    fault_of,
    opencv_pixels,
    rigs,
)

SAMPLE = """\
image_width: 2448
image_height: 2050
camera_name: prosilica
camera_matrix:
  rows: 3
  cols: 3
  data: [4827.94, 0, 1223.5, 0, 4835.62, 1024.5, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.41527, 0.31874, -0.00197, 7.1e-04, 0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [4827.94, 0, 1223.5, 0, 0, 4835.62, 1024.5, 0, 0, 0, 1, 0]
"""
AIR = flat_port_camera(
    width_px=640, height_px=480, fx_px=530.0, fy_px=531.0, cx_px=320.25, cy_px=241.0, n_water=1.0
)
PAIR = Rig(
    cameras={"left": AIR, "right": changed(AIR, k1=-0.1)},
    cam_from_rig={
        "left": RigidTransform.identity(),
        "right": RigidTransform.from_translation([-0.1, 0.0, 0.0]),
    },
    body_from_rig=RigidTransform.identity(),
    source="a test",
)


fault = partial(fault_of, read_ros)


@settings(max_examples=25, deadline=None)
@given(rig=rigs(RATIONAL, lenses=BOTH_LENSES, one_size=True))
def test_rectified_by_opencv_a_pair_is_where_the_file_says(rig: Rig) -> None:
    """As image_geometry does: a ray goes through R and P to the rectified picture.

    There both cameras see a point on one row (or column), and the last column of P says how far
    apart; in the raw picture OpenCV projects points with the file's K and D to where we do.
    """
    assume(len(rig.cameras) == 2)
    with tempfile.TemporaryDirectory() as folder:
        files = write_ros(Path(folder) / "pair", rig)
        assert [file.name for file in files] == ["left.yaml", "right.yaml"]
        documents = [yaml.safe_load(file.read_text()) for file in files]

    rectified = []
    for (name, camera), document in zip(rig.cameras.items(), documents, strict=True):
        assert document["camera_name"] == name
        k, d, r, p = (
            np.array(document[key]["data"]).reshape(document[key]["rows"], document[key]["cols"])
            for key in (
                "camera_matrix", "distortion_coefficients", "rectification_matrix",
                "projection_matrix",
            )
        )  # fmt: skip
        model = {4: "equidistant", 5: "plumb_bob", 8: "rational_polynomial"}[d.size]
        assert document["distortion_model"] == model
        points = rig.cam_from_rig[name].apply(POINTS_RIG)
        seen = opencv_pixels(points, np.zeros(3), np.zeros(3), k, d)
        ours = camera.project(points)
        known = np.isfinite(ours[:, 0])
        assert known.any()
        np.testing.assert_allclose(seen[known] + 0.5, ours[known], atol=1e-8, rtol=0)
        # Of the camera's own frame a point goes through R; of the first camera's rectified frame,
        # through the last column of P. Tangents, since OpenCV may choose any focal length.
        first = POINTS_RIG @ np.array(documents[0]["rectification_matrix"]["data"]).reshape(3, 3).T
        own = points @ r.T @ p[:, :3].T
        assert (name == "right") == bool(np.any(p[:, 3]))
        np.testing.assert_allclose(tangents(own, p), tangents(first @ p[:, :3].T + p[:, 3], p),
                                   atol=1e-11)  # fmt: skip
        rectified.append(tangents(own, p))
    across = np.abs(rectified[0] - rectified[1]).max(axis=0)
    assert across.min() < 1e-11  # one row, or one column
    assert across.max() > 1e-3


def tangents(homogeneous: np.ndarray, projection: np.ndarray) -> np.ndarray:
    """What a projection matrix without its focal length and principal point would give."""
    pixels = homogeneous[:, :2] / homogeneous[:, 2:]
    return (pixels - projection[:2, 2]) / projection[[0, 1], [0, 1]]


@pytest.mark.parametrize("small", [0.0, 1e-12, 1e-9, 1e-7, 1e-5, 1e-3])
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_pair_that_is_nearly_rectified_comes_back_exactly(
    tmp_path: Path, small: float, sign: int, axis: int
) -> None:
    """Where `cv2.stereoRectify` takes small turns for none."""
    shift = np.full(3, small)
    shift[axis] = sign * 0.1
    pose = RigidTransform.from_components(shift, Rotation.from_rotvec([small, -small, 2 * small]))
    rig = replace(PAIR, cam_from_rig={"left": RigidTransform.identity(), "right": pose})
    write_ros(tmp_path / "pair", rig)
    after = read_ros(tmp_path / "pair", ReadOptions()).cam_from_rig["right"]
    np.testing.assert_allclose(after.as_matrix(), pose.as_matrix(), atol=1e-15)


def test_the_rotations_are_those_of_opencv(tmp_path: Path) -> None:
    turn = Rotation.from_rotvec([0.05, -0.1, 0.15])
    pose = RigidTransform.from_components([-0.1, 0.02, 0.01], turn)
    rig = replace(PAIR, cam_from_rig={"left": RigidTransform.identity(), "right": pose})
    files = write_ros(tmp_path / "pair", rig)
    k, none = np.diag([500.0, 500.0, 1.0]), np.zeros(5)
    r1, r2, *_ = cv2.stereoRectify(
        k, none, k, none, (640, 480), turn.as_matrix(), pose.translation[:, None]
    )
    for file, theirs in zip(files, (r1, r2), strict=True):
        ours = yaml.safe_load(file.read_text())["rectification_matrix"]["data"]
        np.testing.assert_allclose(np.reshape(ours, (3, 3)), theirs, atol=1e-12)


def test_the_sample_of_the_wiki_is_read(tmp_path: Path) -> None:
    path = tmp_path / "prosilica.yaml"
    path.write_text(SAMPLE)
    assert detect(path).name == "ros"
    rig = read_ros(path, ReadOptions())
    camera = rig.cameras["prosilica"]
    assert (camera.width_px, camera.height_px) == (2448, 2050)
    assert (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px) == (
        4827.94, 4835.62, 1224.0, 1025.0,
    )  # fmt: skip
    found = [camera.parameter(name) for name in ("k1", "k2", "p1", "p2")]
    assert found == [-0.41527, 0.31874, -0.00197, 7.1e-04]


def test_the_reference_is_the_camera_without_baseline(tmp_path: Path) -> None:
    """Whatever the order of the files' names."""
    folder = tmp_path / "pair"
    write_ros(folder, PAIR)
    (folder / "left.yaml").rename(folder / "z.yaml")
    rig = read_ros(folder, ReadOptions())
    assert rig.reference == "left"
    assert_same_geometry(rig, PAIR)


def test_half_a_pair_says_that_the_other_half_is_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_ros(tmp_path / "pair", PAIR)
    rig = read_ros(tmp_path / "pair" / "right.yaml", ReadOptions())
    assert rig.cameras["right"].parameter("k1") == -0.1
    assert "baseline" in capsys.readouterr().err


def test_what_ros_has_no_files_for_is_refused(tmp_path: Path) -> None:
    def refused(rig: Rig, path: Path) -> str:
        with pytest.raises(CalibrationError) as error:
            write_ros(path, rig)
        return str(error.value)

    identity = RigidTransform.identity()
    sizes = replace(PAIR, cameras={"left": AIR, "right": replace(AIR, width_px=641)})
    same = replace(PAIR, cam_from_rig={"left": identity, "right": identity})
    refused(sizes, tmp_path / "a")
    refused(same, tmp_path / "a")
    assert "a.yaml" in refused(PAIR, tmp_path / "a.yaml")
    assert list(tmp_path.iterdir()) == []


def test_faults_name_file_and_key(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    for old, new, named in (
        ("plumb_bob", "fov", "distortion_model"),
        ("plumb_bob", "equidistant", "distortion_coefficients"),
        ("plumb_bob", "rational_polynomial", "distortion_coefficients"),
        ("image_width", "width", "image_width"),
        ("0, 0, 1]\nd", "0, 0]\nd", "camera_matrix"),
        ("4827.94, 0,", "4827.94, 1,", "camera_matrix"),
        ("prosilica", "a b", "a b"),
        ("cols: 4", "cols: 3", "projection_matrix"),
    ):
        assert named in fault(path, SAMPLE.replace(old, new, 1))
    folder = tmp_path / "pair"
    folder.mkdir()
    assert ".yaml" in fault(folder)
    for name in ("a.yaml", "b.yaml"):
        (folder / name).write_text(SAMPLE)
    fault(folder)
    moved = SAMPLE.replace("1223.5, 0, 0, 4835.62", "1223.5, -99.0, 0, 4835.62")
    (folder / "b.yaml").write_text(moved)
    fault(folder)
    (folder / "b.yaml").write_text(
        moved.replace("prosilica", "other").replace("[1, 0, 0, 0, 1", "[1, 0, 0, 0, 3")
    )
    with pytest.raises(CalibrationError, match=r"b\.yaml: rectification_matrix"):
        read_ros(folder, ReadOptions())
