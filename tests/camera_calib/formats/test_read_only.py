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
from tests.strategies_formats import DATA

K = np.array([[530.0, 0.0, 311.5], [0.0, 531.0, 244.25], [0.0, 0.0, 1.0]])
FLAT, FOUR, FIVE = "530., 0., 311.5, 0., 531., 244.25, 0., 0., 1.", (-0.1, 0.02, 1e-3, -2e-3), 0.01
TURN, SHIFT = Rotation.from_rotvec([0.01, -0.02, 0.03]), np.array([-0.12, 0.004, 0.002])
MATRIX = "!!opencv-matrix\n   rows: {}\n   cols: {}\n   dt: d\n   data: [ {} ]\n"
GRID = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.4, 0.4, 7), [1.0]), -1)
POINTS = 2.0 * GRID.reshape(-1, 3)
"""Over the frame of 640 x 480 px."""
Project = Callable[[Array], Array]


def pose(inverse: bool = False) -> str:
    """The second camera's pose in the first, or its inverse, row by row."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = TURN.as_matrix(), SHIFT
    return ", ".join(map(str, (np.linalg.inv(matrix) if inverse else matrix).ravel()))


def pinhole(k: Any = (*FOUR, FIVE)) -> Project:
    return lambda p: cv2.projectPoints(p, np.zeros(3), np.zeros(3), K, np.array(k))[0][:, 0]


def equidistant(k: Any = FOUR) -> Project:
    """Kalibr's and OpenCV's: the radius is a polynomial of the angle."""

    def project(p: Array) -> Array:
        r = np.hypot(p[:, 0], p[:, 1])
        a = np.arctan2(r, p[:, 2])
        d = a * (1 + k[0] * a**2 + k[1] * a**4 + k[2] * a**6 + k[3] * a**8)
        return np.diag(K)[:2] * (d / np.maximum(r, 1e-12))[:, None] * p[:, :2] + K[:2, 2]

    return project


def double_sphere(p: Array, xi: float, alpha: float) -> Array:
    """Usenko et al. 2018, equations 40 to 42."""
    d1 = np.linalg.norm(p, axis=1)
    d2 = np.hypot(np.hypot(p[:, 0], p[:, 1]), xi * d1 + p[:, 2])
    depth = alpha * d2 + (1 - alpha) * (xi * d1 + p[:, 2])
    return np.diag(K)[:2] * p[:, :2] / depth[:, None] + K[:2, 2]


def omni(p: Array, xi: float, k: Any) -> Array:
    """Mei's: onto a sphere, from there onto a plane, which radtan distorts."""
    sphere = p / np.linalg.norm(p, axis=1, keepdims=True) + [0.0, 0.0, xi]
    return pinhole(k)(sphere)


def enhanced(p: Array, alpha: float, beta: float) -> Array:
    d = np.sqrt(beta * (p[:, 0] ** 2 + p[:, 1] ** 2) + p[:, 2] ** 2)
    return np.diag(K)[:2] * p[:, :2] / (alpha * d + (1 - alpha) * p[:, 2])[:, None] + K[:2, 2]


def kalibr(model: str, own: str, distortion: str, k: Any, rest: str = "", size: str = "640, 480"):
    return (
        f"  camera_model: {model}\n  intrinsics: [{own}530., 531., 311.5, 244.25]\n"
        f"  distortion_model: {distortion}\n  distortion_coeffs: {list(k)}\n"
        f"  resolution: [{size}]\n{rest}"
    )


def body(name: str, numbers: str) -> str:
    rows = np.reshape(numbers.split(", "), (4, 4))
    return f"  {name}:\n" + "".join(f"  - [{', '.join(row)}]\n" for row in rows)


EYE = ", ".join(map(str, np.eye(4).ravel()))
OPENVINS = (
    "%YAML:1.0\n\ncam0:\n" + kalibr("pinhole", "", "equidistant", FOUR, body("T_imu_cam", EYE))
    + "cam1:\n" + kalibr("pinhole", "", "radtan", FOUR, body("T_imu_cam", pose(inverse=True)))
)  # fmt: skip
SENSOR = (
    "sensor_type: camera\ncomment: a\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{}]\nrate_hz: 20\n"
    "resolution: [640, 480]\ncamera_model: pinhole\nintrinsics: [530., 531., 311.5, 244.25]\n"
    f"distortion_model: radial-tangential\ndistortion_coefficients: {list(FOUR)}\n"
)
ECHO = (
    "header:\n  stamp:\n    sec: {}\n    nanosec: 5\n  frame_id: {}\nheight: 480\nwidth: 640\n"
    f"distortion_model: plumb_bob\nd: {[*FOUR, FIVE]}\nk: [{FLAT}]\n"
    "r: {}\np: {}\nbinning_x: 0\nbinning_y: 0\nroi:\n  x_offset: 0\n  do_rectify: false\n---\n"
)
MATISSE = (
    "%YAML:1.0\n---\ncamera_name: Otus 2\nfull_sensor_width: 640\nfull_sensor_height: 480\n"
    f"K: {MATRIX.format(3, 3, FLAT)}distortion_model: {{}}\ndistortion_coeff: "
)
ORB = "Camera.width: 640\nCamera.height: 480\nCamera.fps: 20\nViewer.PointSize: 2\n"
NAMES = ("k1", "k2", "p1", "p2", "k3")


def lens(start: str, names: tuple[str, ...] = NAMES, sign: str = ": ") -> str:
    values = {"fx": 530.0, "fy": 531.0, "cx": 311.5, "cy": 244.25}
    values |= dict(zip(names, (*FOUR, FIVE), strict=False))
    return "".join(f"{start}{name}{sign}{value}\n" for name, value in values.items())


def orb(kind: str, cameras: str) -> str:
    return f'%YAML:1.0\n---\nCamera.type: "{kind}"\n{cameras}{ORB}'


DISTO = lens("", sign="=")
MM = "Baseline={}\nTY={}\nTZ={}\nRX_VGA={}\nCV_VGA={}\nRZ_VGA={}\nCV_HD=0\nRX_HD=0\nRZ_HD=0\n"
TURNED = TURN.as_rotvec()
ZED = (
    f"[LEFT_CAM_VGA]\n{DISTO}\n[RIGHT_CAM_VGA]\n{DISTO}\n[LEFT_CAM_HD]\nfx=1\n[STEREO]\n"
    + MM.format(*SHIFT * [-1e3, 1e3, 1e3], *TURNED)
)
TWO = [pinhole(), pinhole()]
READ: list[tuple[str, str, str, list[Project]]] = [
    ("kalibr", "c.yaml", OPENVINS, [equidistant(), pinhole(FOUR)]),
    ("euroc", "sensor.yaml", SENSOR.format(EYE), [pinhole(FOUR)]),
    ("ros", "echo.yaml", ECHO.format(1, "cam", "[]", "[]").replace("r: []\np: []\n", "")
     + ECHO.format(2, "cam", "[]", "[]").replace("r: []\np: []\n", ""), [pinhole()]),
    ("matisse", "a.yaml", MATISSE.format(1) + MATRIX.format(1, 3, "-0.1, 0.02, 0.01"),
     [pinhole((-0.1, 0.02, 0.0, 0.0, 0.01))]),
    ("matisse", "b.yaml", MATISSE.format(2) + MATRIX.format(1, 5, str([*FOUR, FIVE])[1:-1]),
     [pinhole()]),
    ("matisse", "c.yaml", MATISSE.format(3) + MATRIX.format(1, 5, str([*FOUR, 0.0])[1:-1]),
     [equidistant()]),
    ("orbslam", "mono.yaml", orb("PinHole", lens("Camera.")), [pinhole()]),
    ("orbslam", "fisheye.yaml", orb("KannalaBrandt8", lens("Camera1.", ("k1", "k2", "k3", "k4"))),
     [equidistant()]),
    ("orbslam", "stereo.yaml", orb("PinHole", lens("Camera1.") + lens("Camera2."))
     + f"Stereo.T_c1_c2: {MATRIX.format(4, 4, pose(inverse=True))}", TWO),
    ("zed", "SN1.conf", ZED, TWO),
]  # fmt: skip


def read(tmp_path: Path, name: str, text: str, **options: Any) -> Rig:
    path = tmp_path / name
    path.write_text(text)
    return detect(path).read(path, ReadOptions(**options))


@pytest.mark.parametrize(("kind", "name", "text", "project"), READ, ids=range(len(READ)))
def test_points_are_seen_where_the_tool_sees_them(
    kind: str, name: str, text: str, project: list[Project], tmp_path: Path
) -> None:
    rig = read(tmp_path, name, text, image_size=(672, 376) if kind == "zed" else None)
    assert detect(tmp_path / name).name == kind
    assert len(rig.cameras) == len(project)
    for i, (camera, theirs) in enumerate(zip(rig.cameras.values(), project, strict=True)):
        assert camera.width_px == (672 if kind == "zed" else 640)
        pose_here = list(rig.cam_from_rig.values())[i]
        seen = TURN.apply(POINTS) + SHIFT if i else POINTS
        np.testing.assert_allclose(camera.project(pose_here.apply(POINTS)) - 0.5, theirs(seen),
                                   atol=1e-6, rtol=0)  # fmt: skip


def test_pairs_of_folders_and_of_messages_keep_their_poses(tmp_path: Path) -> None:
    """EuRoC's `mav0`, two cameras of ROS in one file, a rectified pair of ORB-SLAM."""
    for cam, numbers in (("cam0", EYE), ("cam1", pose(inverse=True)), ("imu0", EYE)):
        (tmp_path / "mav0" / cam).mkdir(parents=True)
        text = SENSOR.format(numbers) if cam != "imu0" else "sensor_type: imu\n"
        (tmp_path / "mav0" / cam / "sensor.yaml").write_text(text)
    assert detect(tmp_path / "mav0").name == "euroc"
    rig = FORMATS["euroc"].read(tmp_path / "mav0", ReadOptions())
    assert list(rig.cameras) == ["cam0", "cam1"]
    found = rig.cam_from_rig["cam1"]
    np.testing.assert_allclose(found.translation, SHIFT, atol=1e-12)
    np.testing.assert_allclose(found.rotation.as_rotvec(), TURNED, atol=1e-9)
    r1, r2, p1, p2, *_ = cv2.stereoRectify(
        K, np.zeros(5), K, np.zeros(5), (640, 480), TURN.as_matrix(), SHIFT[:, None]
    )
    left, right = (
        ECHO.format(1, name, r.ravel().tolist(), p.ravel().tolist())
        for name, r, p in (("l", r1, p1), ("r", r2, p2))
    )
    rig = read(tmp_path, "both.yaml", right + left)
    assert list(rig.cameras) == ["l", "r"]
    np.testing.assert_allclose(rig.cam_from_rig["r"].translation, SHIFT, atol=1e-7)
    rig = read(tmp_path, "o.yaml", orb("Rectified", lens("Camera1.", ())) + "Stereo.b: 0.12\n")
    np.testing.assert_array_equal(rig.cam_from_rig["right"].translation, [-0.12, 0.0, 0.0])


FITS: list[tuple[str, str, Project, float]] = [
    ("ds.yaml", kalibr("ds", "-0.2, 0.6, ", "none", []), lambda p: double_sphere(p, -0.2, 0.6),
     1e-3),
    ("eucm.yaml", kalibr("eucm", "0.6, 1.1, ", "none", []), lambda p: enhanced(p, 0.6, 1.1), 1e-3),
    ("omni.yaml", kalibr("omni", "0.9, ", "radtan", FOUR), lambda p: omni(p, 0.9, FOUR), 3.0),
]  # fmt: skip
PHOTOSCAN = (
    (DATA / "metashape.xml").read_text(),
    "<calibration><projection>{}</projection><width>5472</width><height>3648</height>"
    "<f>3658.5</f><cx>12.5</cx><cy>-7.25</cy><b1>1.5</b1><k1>-0.01</k1><k2>0.02</k2>"
    "<k3>-0.003</k3><p1>0.0005</p1><p2>-0.0007</p2>{}</calibration>",
)
for kind, more, worst in (
    ("frame", "<k4>0.01</k4>", 0.05), ("frame", "<b2>-2.5</b2>", 2.0), ("frame", "<p3>3</p3>", 7.0),
    ("fisheye", "<k4>0.001</k4>", 9.0),
):  # fmt: skip
    xml = PHOTOSCAN[1].format(kind, more)
    FITS.append(
        (f"{kind}.xml", xml, partial(lambda xml, p: manual_pixels(xml, p) - 0.5, xml), worst)
    )


@pytest.mark.parametrize(("name", "text", "project", "worst"), FITS, ids=range(len(FITS)))
def test_the_nearest_lens_misses_by_what_is_stated(
    name: str, text: str, project: Project, worst: float, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """Over the frame to its corners, at places between those of the fit."""
    text = text if name.endswith("xml") else "cam0:\n" + text
    (camera,) = read(tmp_path, name, text).cameras.values()
    rms_px, max_px = map(float, re.findall(r"([\d.e-]+) px", capsys.readouterr().err))
    grid = camera.frame_grid(40, 30)
    rays = camera.unproject(grid)[1].reshape(-1, 3)
    misses = np.linalg.norm(project(rays) + 0.5 - grid.reshape(-1, 2), axis=1)
    assert misses.max() == pytest.approx(max_px, rel=0.1)
    assert np.sqrt(np.mean(misses**2)) == pytest.approx(rms_px, rel=0.15)
    assert 0.0 < rms_px < max_px < worst


def test_photoscan_of_2015_counts_from_the_corner_and_has_opencvs_tangential_terms(
    tmp_path: Path,
) -> None:
    k = "".join(f"<{n}>{v}</{n}>" for n, v in zip(NAMES, (*FOUR, FIVE), strict=True))
    rig = read(
        tmp_path, "old.xml", "<calibration><projection>frame</projection><width>640</width>"
        f"<height>480</height><fx>530</fx><fy>531</fy><cx>312</cx><cy>244.75</cy>{k}</calibration>",
    )  # fmt: skip
    (camera,) = rig.cameras.values()
    np.testing.assert_allclose(camera.project(POINTS) - 0.5, pinhole()(POINTS), atol=1e-6, rtol=0)


WIDE: list[tuple[str, str, str]] = [
    *((kind, name, text) for kind, name, text, _ in READ if kind != "zed"),
    ("zed", "a.conf", ZED.replace("[LEFT_CAM_HD]\nfx=1\n", "")),
    ("ros", "r.yaml", (DATA / "camera_info.yaml").read_text()),
    ("metashape", "m.xml", PHOTOSCAN[0]),
    ("opencv", "o.yml", f"%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\nM1: "
     f"{MATRIX.format(3, 3, FLAT)}M2: {MATRIX.format(3, 3, FLAT)}R: "
     f"{MATRIX.format(3, 3, ', '.join(map(str, np.eye(3).ravel())))}T: [ -1., 0., 0. ]\n"),
    ("opencv", "python.yaml", f"camera_matrix: [[{FLAT}]]\ndist_coeff: [[0.1, 0, 0, 0, 0]]\n"
     "image_width: 640\nimage_height: 480\n"),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "name", "text"), WIDE, ids=range(len(WIDE)))
def test_what_a_file_holds_is_read_or_named(
    kind: str, name: str, text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    read(tmp_path, name, text)
    assert detect(tmp_path / name).name == kind
    assert "surprise" not in capsys.readouterr().err
    more = {".xml": text.replace("</calibration>", "<surprise>1</surprise></calibration>"),
            ".conf": text + "surprise=1\n"}  # fmt: skip
    if kind == "kalibr":
        more[".yaml"] = text.replace("  camera_model", "  surprise: 1\n  camera_model")
    elif name == "echo.yaml":
        more[".yaml"] = text.replace("height:", "surprise: 1\nheight:")
    read(tmp_path, name, more.get(Path(name).suffix, text + "surprise: 1\n"))
    assert "surprise" in capsys.readouterr().err


def test_a_missing_size_is_asked_for_once(tmp_path: Path) -> None:
    small = orb("PinHole", lens("Camera.")).replace("Camera.width: 640\n", "")
    for name, text, size in (
        ("m.yaml", MATISSE.format(1).replace("full_sensor_width: 640\n", "") + "[]\n", (640, 480)),
        ("o.yaml", small, (640, 480)), ("SN1.conf", ZED, (672, 376)),
    ):  # fmt: skip
        with pytest.raises(CalibrationError, match="--image-size"):
            read(tmp_path, name, text)
        rig = read(tmp_path, name, text, image_size=size)
        assert {(c.width_px, c.height_px) for c in rig.cameras.values()} == {size}


def test_what_only_is_read_is_not_written(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(READ[3][2])
    for kind in ("matisse", "zed", "orbslam", "euroc"):
        with pytest.raises(CalibrationError, match="--to"):
            convert(
                Conversion(source=tmp_path / "a.yaml", target=tmp_path / "b", target_format=kind)
            )
        assert not (tmp_path / "b").exists()
