"""Calibrations of further tools, against projections written here from their own documents."""

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array
from camera_calib.formats.convert import FORMATS, Conversion, convert, detect
from camera_calib.formats.rigs import ReadOptions
from camera_calib.rig import Rig
from tests.camera_calib.formats.test_metashape import manual_pixels
from tests.strategies_formats import DATA, fault_of

K = np.array([[530.0, 0.0, 311.5], [0.0, 531.0, 244.25], [0.0, 0.0, 1.0]])
FOUR = (-0.1, 0.02, 1e-3, -2e-3)
FIVE = (*FOUR, 0.01)
TURN, SHIFT = Rotation.from_rotvec([0.01, -0.02, 0.03]), np.array([-0.12, 0.004, 0.002])
"""Pose of second cameras: points of the first to the second."""
GRID = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.4, 0.4, 7), [1.0]), -1)
POINTS = 2.0 * GRID.reshape(-1, 3)
"""Over the frame of 640 x 480 px."""
Project = Callable[[Array], Array]


def read(path: Path, **options: Any) -> Rig:
    return detect(path).read(path, ReadOptions(**options))


def pinhole(k: Any, p: Array) -> Array:
    return cv2.projectPoints(p, np.zeros(3), np.zeros(3), K, np.array(k))[0][:, 0]


def equidistant(k: Any, p: Array) -> Array:
    """Kalibr's and OpenCV's: the radius is a polynomial of the angle."""
    r = np.hypot(p[:, 0], p[:, 1])
    a = np.arctan2(r, p[:, 2])
    d = a * (1 + k[0] * a**2 + k[1] * a**4 + k[2] * a**6 + k[3] * a**8)
    return np.diag(K)[:2] * (d / np.maximum(r, 1e-12))[:, None] * p[:, :2] + K[:2, 2]


def double_sphere(xi: float, alpha: float, p: Array) -> Array:
    """Usenko et al. 2018, equations 40 to 42."""
    d1 = np.linalg.norm(p, axis=1)
    d2 = np.hypot(np.hypot(p[:, 0], p[:, 1]), xi * d1 + p[:, 2])
    depth = alpha * d2 + (1 - alpha) * (xi * d1 + p[:, 2])
    return np.diag(K)[:2] * p[:, :2] / depth[:, None] + K[:2, 2]


def omni(xi: float, k: Any, p: Array) -> Array:
    """Mei's: onto a sphere, from there onto a plane, which radtan distorts."""
    return pinhole(k, p / np.linalg.norm(p, axis=1, keepdims=True) + [0.0, 0.0, xi])


def extended_unified(alpha: float, beta: float, p: Array) -> Array:
    d = np.sqrt(beta * (p[:, 0] ** 2 + p[:, 1] ** 2) + p[:, 2] ** 2)
    return np.diag(K)[:2] * p[:, :2] / (alpha * d + (1 - alpha) * p[:, 2])[:, None] + K[:2, 2]


BROWN, ANGLES = partial(pinhole, FIVE), partial(equidistant, FOUR)
READ: list[tuple[str, str, list[Project]]] = [
    ("kalibr", "openvins.yaml", [ANGLES, partial(pinhole, FOUR)]),
    ("euroc", "euroc_sensor.yaml", [partial(pinhole, FOUR)]),
    ("ros", "ros2_echo.yaml", [BROWN]),
    ("ros", "ros2_pair.yaml", [BROWN, BROWN]),
    ("matisse", "matisse_radial.yaml", [partial(pinhole, (-0.1, 0.02, 0.0, 0.0, 0.01))]),
    ("matisse", "matisse_brown.yaml", [BROWN]),
    ("matisse", "matisse_fisheye.yaml", [ANGLES]),
    ("orbslam", "orbslam_mono.yaml", [BROWN]),
    ("orbslam", "orbslam_fisheye.yaml", [ANGLES]),
    ("orbslam", "orbslam_stereo.yaml", [BROWN, BROWN]),
    ("zed", "SN1.conf", [BROWN, BROWN]),
    ("metashape", "photoscan_2015.xml", [BROWN]),
    ("opencv", "python.json", [BROWN]),
    ("opencv", "python.yaml", [partial(pinhole, (0.1, 0.0, 0.0, 0.0, 0.0))]),
]


@pytest.mark.parametrize(("kind", "name", "project"), READ)
def test_points_are_seen_where_the_tool_sees_them(
    kind: str, name: str, project: list[Project], capsys: pytest.CaptureFixture[str]
) -> None:
    """And a key of the file that nothing reads is named."""
    rig = read(DATA / name, image_size=(672, 376) if kind == "zed" else None)
    assert "surprise" in capsys.readouterr().err
    assert detect(DATA / name).name == kind
    places = zip(rig.cameras.values(), rig.cam_from_rig.values(), project, strict=True)
    for i, (camera, cam_from_rig, theirs) in enumerate(places):
        assert camera.width_px == (672 if kind == "zed" else 640)
        seen = theirs(TURN.apply(POINTS) + SHIFT if i else POINTS)
        ours = camera.project(cam_from_rig.apply(POINTS)) - 0.5
        np.testing.assert_allclose(ours, seen, atol=1e-4 if "pair" in name else 1e-6, rtol=0)


def test_folders_of_euroc_and_rectified_pairs_of_orbslam_keep_their_poses(tmp_path: Path) -> None:
    pose = np.eye(4)
    for cam in ("cam0", "cam1", "imu0"):
        (tmp_path / "mav0" / cam).mkdir(parents=True)
        text = (DATA / "euroc_sensor.yaml").read_text() if cam != "imu0" else "sensor_type: imu\n"
        text = re.sub(r"data: \[.*\]", f"data: {np.linalg.inv(pose).ravel().tolist()}", text)
        (tmp_path / "mav0" / cam / "sensor.yaml").write_text(text)
        pose[:3, :3], pose[:3, 3] = TURN.as_matrix(), SHIFT
    assert detect(tmp_path / "mav0").name == "euroc"
    rig = read(tmp_path / "mav0")
    assert list(rig.cameras) == ["cam0", "cam1"]
    np.testing.assert_allclose(rig.cam_from_rig["cam1"].as_matrix(), pose, atol=1e-12)
    rig = read(DATA / "orbslam_rectified.yaml")
    np.testing.assert_array_equal(rig.cam_from_rig["right"].translation, [-0.12, 0.0, 0.0])


def metashape(kind: str, more: str) -> str:
    """An ordinary calibration with one more term."""
    text = (DATA / "metashape.xml").read_text().replace("frame", kind)
    return text.replace("<date>", f"{more}<date>")


def manual(text: str, p: Array) -> Array:
    return manual_pixels(text, p) - 0.5


FITS: list[tuple[str, Project | None, float]] = [
    ("ds", partial(double_sphere, -0.2, 0.6), 1e-3),
    ("eucm", partial(extended_unified, 0.6, 1.1), 1e-3),
    ("omni", partial(omni, 0.9, FOUR), 3.0),
    (metashape("frame", "<k4>0.01</k4>"), None, 0.05),
    (metashape("frame", "<b2>-2.5</b2>"), None, 2.0),
    (metashape("frame", "<p3>3</p3>"), None, 7.0),
    (metashape("fisheye", "<k4>0.001</k4>"), None, 9.0),
]


@pytest.mark.parametrize(("text", "project", "worst_px"), FITS, ids=range(len(FITS)))
def test_the_nearest_lens_misses_by_what_is_stated(
    text: str, project: Project | None, worst_px: float, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """Over the frame to its corners, at places between those of the fit."""
    path = DATA / f"kalibr_{text}.yaml" if project else tmp_path / "a.xml"
    if project is None:
        path.write_text(text)
    (camera,) = read(path).cameras.values()
    rms_px, max_px = map(float, re.findall(r"([\d.e-]+) px", capsys.readouterr().err))
    grid = camera.frame_grid(40, 30)
    seen = (project or partial(manual, text))(camera.unproject(grid)[1].reshape(-1, 3))
    misses = np.linalg.norm(seen + 0.5 - grid.reshape(-1, 2), axis=1)
    assert misses.max() == pytest.approx(max_px, rel=0.1)
    assert np.sqrt(np.mean(misses**2)) == pytest.approx(rms_px, rel=0.15)
    assert 0.0 < rms_px < max_px < worst_px


@pytest.mark.parametrize(
    ("name", "size", "key"),
    [("matisse_brown.yaml", (640, 480), "full_sensor_width"), ("SN1.conf", (672, 376), "-"),
     ("orbslam_mono.yaml", (640, 480), "Camera.width"), ("python.yaml", (9, 9), "image_width")],
)  # fmt: skip
def test_a_missing_size_is_asked_for(
    name: str, size: tuple[int, int], key: str, tmp_path: Path
) -> None:
    path = tmp_path / name
    path.write_text(re.sub(f"{key}: .*\n", "", (DATA / name).read_text()))
    with pytest.raises(CalibrationError, match="--image-size"):
        read(path)
    cameras = read(path, image_size=size).cameras.values()
    assert {(camera.width_px, camera.height_px) for camera in cameras} == {size}


@pytest.mark.parametrize(
    ("name", "old", "new", "named"),
    [("SN1.conf", "TY=4.0", "TY=x", "ty"), ("SN1.conf", "Baseline=120.0", "", "baseline"),
     ("orbslam_mono.yaml", "Camera.cx: 311.5", "", "cx"), ("kalibr_ds.yaml", "-0.2, ", "", "5; 6")],
)  # fmt: skip
def test_faults_name_file_and_key(
    name: str, old: str, new: str, named: str, tmp_path: Path
) -> None:
    path = tmp_path / name
    path.write_text((DATA / name).read_text().replace(old, new))
    assert named in fault_of(read_vga, path)


def read_vga(path: Path, _: ReadOptions) -> Rig:
    return read(path, image_size=(672, 376))


def test_further_keys_of_pairs_and_of_other_files_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    xml = metashape("frame", "<surprise>1</surprise>")
    for name, text in (
        ("a.xml", xml),
        ("b.yml", (DATA / "opencv_pair.yml").read_text()),
        ("c.yaml", (DATA / "camera_info.yaml").read_text() + "surprise: 1\n"),
        ("d.yaml", (DATA / "camchain.yaml").read_text() + "surprise: 1\n"),
    ):
        (tmp_path / name).write_text(text)
        read(tmp_path / name)
        assert "surprise" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["matisse", "zed", "orbslam", "euroc"])
def test_what_is_only_read_is_not_written(kind: str, tmp_path: Path) -> None:
    assert kind in FORMATS
    task = Conversion(source=DATA / "python.yaml", target=tmp_path / "b", target_format=kind)
    with pytest.raises(CalibrationError, match="--to"):
        convert(task)
    assert not (tmp_path / "b").exists()
