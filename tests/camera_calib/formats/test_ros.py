"""ROS's camera_info: keys of camera_calibration_parsers, poses from pairs rectified by OpenCV."""

import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform

from camera_calib.formats.convert import detect
from camera_calib.formats.rigs import ReadOptions, only
from camera_calib.formats.robots import read_ros, write_ros
from camera_calib.rig import Rig
from tests.cameras import changed, flat_port_camera, pair_of
from tests.strategies_formats import (
    BOTH_LENSES,
    DATA,
    POINTS_RIG,
    RATIONAL,
    assert_same_geometry,
    assert_same_pixels,
    fault_of,
    opencv_pixels,
    rigs,
)

SAMPLE = (DATA / "camera_info.yaml").read_text()
AIR = flat_port_camera(
    width_px=640, height_px=480, fx_px=530.0, fy_px=531.0, cx_px=320.25, cy_px=241.0, n_water=1.0
)
PAIR = pair_of(AIR, changed(AIR, k1=-0.1), RigidTransform.from_translation([-0.1, 0.0, 0.0]))


fault = partial(fault_of, read_ros)


def write_pair(folder: Path, rig: Rig) -> list[Path]:
    """The files of a stereo pair, rectified by OpenCV."""
    folder.mkdir()
    files = [write_ros(folder / f"{name}.yaml", only(rig, name))[0] for name in rig.cameras]
    documents = [yaml.safe_load(file.read_text()) for file in files]
    k1, k2 = (np.reshape(one["camera_matrix"]["data"], (3, 3)) for one in documents)
    first, second = (rig.cam_from_rig[name] for name in rig.cameras)
    between = second * first.inv()
    r1, r2, p1, p2, *_ = cv2.stereoRectify(
        k1, np.zeros(5), k2, np.zeros(5), (640, 480), between.rotation.as_matrix(),
        between.translation[:, None],
    )  # fmt: skip
    for file, document, r, p in zip(files, documents, (r1, r2), (p1, p2), strict=True):
        document["rectification_matrix"]["data"] = r.ravel().tolist()
        document["projection_matrix"]["data"] = p.ravel().tolist()
        file.write_text(yaml.safe_dump(document))
    return files


@settings(max_examples=25, deadline=None)
@given(rig=rigs(RATIONAL, lenses=BOTH_LENSES))
def test_opencv_projects_as_we_do_from_the_file(rig: Rig) -> None:
    for name, camera in rig.cameras.items():
        with tempfile.TemporaryDirectory() as folder:
            (file,) = write_ros(Path(folder) / "a.yaml", only(rig, name))
            document = yaml.safe_load(file.read_text())
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
        seen = opencv_pixels(POINTS_RIG, np.zeros(3), np.zeros(3), k, d)
        ours = camera.project(POINTS_RIG)
        assert_same_pixels(ours, seen + 0.5)
        np.testing.assert_array_equal(r, np.eye(3))
        np.testing.assert_array_equal(p, np.column_stack([k, np.zeros(3)]))


@settings(max_examples=25, deadline=None)
@given(rig=rigs(RATIONAL, lenses=BOTH_LENSES), upright=st.booleans(), swapped=st.booleans())
def test_a_pair_rectified_by_opencv_is_where_it_was(rig: Rig, upright: bool, swapped: bool) -> None:
    """Next to each other or one above the other, either way round."""
    assume(len(rig.cameras) == 2)
    pose = rig.cam_from_rig["right"]
    assume(not 0.0 < pose.rotation.magnitude() < 1e-4)  # which OpenCV takes for none
    shift = pose.translation[[1, 0, 2]] if upright else pose.translation
    pose = RigidTransform.from_components(-shift if swapped else shift, pose.rotation)
    rig = replace(rig, cam_from_rig={**rig.cam_from_rig, "right": pose})
    with tempfile.TemporaryDirectory() as folder:
        write_pair(Path(folder) / "pair", rig)
        after = read_ros(Path(folder) / "pair", ReadOptions())
        assert_same_geometry(after, rig, pixels=1e-5)  # OpenCV keeps 1e-7 or so


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
    write_pair(folder, PAIR)
    (folder / "left.yaml").rename(folder / "z.yaml")
    rig = read_ros(folder, ReadOptions())
    assert rig.reference == "left"
    assert_same_geometry(rig, PAIR)


def test_half_a_pair_says_that_the_other_half_is_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_pair(tmp_path / "pair", PAIR)
    rig = read_ros(tmp_path / "pair" / "right.yaml", ReadOptions())
    assert rig.cameras["right"].parameter("k1") == -0.1
    assert "baseline" in capsys.readouterr().err


def test_faults_name_file_and_key(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    for old, new, named in (
        ("plumb_bob", "fov", "distortion_model"),
        ("7.1e-04, 0]", "7.1e-04, 0, 1]", "distortion_coefficients"),
        ("image_width: 2448\n", "", "--image-size"),
        ("0, 0, 1]\nd", "0, 0]\nd", "camera_matrix"),
        ("4827.94, 0,", "4827.94, 1,", "camera_matrix"),
        ("data:", "0:", "camera_matrix"),  # a number among the names
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
    assert list(read_ros(folder, ReadOptions()).cameras) == ["cam0", "cam1"]
    (folder / "b.yaml").write_text(
        moved.replace("prosilica", "other").replace("[1, 0, 0, 0, 1", "[1, 0, 0, 0, 3")
    )
    assert "b.yaml: rectification_matrix" in fault(folder)
