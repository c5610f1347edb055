"""Rigs of many cameras, of other sizes, lenses and directions: from corners, and from pictures."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.base.errors import CalibrationError
from alice_survey.base.executor import SERIAL
from camera_calib.calibrate.by_options import calibrated, port_kinds
from camera_calib.calibrate.detect_views import Detections
from camera_calib.calibrate.from_pictures import calibrate_pictures
from camera_calib.calibrate.options import CalibrateOptions, check_settings
from camera_calib.calibrate.solve import calibrate_in_air
from camera_calib.calibration import TargetView
from camera_calib.camera import Camera
from camera_calib.lenses.fisheye import FisheyeLens
from camera_calib.lenses.opencv import OpenCVLens
from camera_calib.ports.dome import DomePort
from camera_calib.ports.flat import FlatPort
from camera_calib.rig import Rig, read_rig
from camera_calib.targets.target import Target, parse_target
from tests.camera_calib.calibration_scenes import differences
from tests.cameras import changed, rig_of
from tests.oracles_targets import picture_light, to_srgb

TARGET = parse_target("chessboard 9x6 40mm")
NOISE_PX = 0.1


def camera(width: int, height: int, focal: float, k1: float) -> Camera:
    lens = OpenCVLens(
        fx_px=focal, fy_px=1.002 * focal, cx_px=0.51 * width, cy_px=0.49 * height, k1=k1
    )
    return Camera(width_px=width, height_px=height, lens=lens)


def four_cameras() -> Rig:
    """A stereo pair that looks down, one that looks 30 degrees ahead and one 35 degrees aside."""
    cameras = {
        "left": camera(640, 480, 620.0, -0.08),
        "right": camera(800, 600, 700.0, -0.05),
        "bow": camera(480, 640, 560.0, 0.04),
        "side": camera(720, 540, 540.0, -0.12),
    }
    turns = {
        "left": [0, 0, 0], "right": [1.0, -2.0, 0.5], "bow": [30, 2, 88], "side": [-3, 35, -4],
    }  # fmt: skip
    places = {
        "left": [0, 0, 0], "right": [0.18, 0.01, 0.0], "bow": [0.05, -0.35, 0.03],
        "side": [-0.4, 0.02, 0.05],
    }  # fmt: skip
    return rig_of(cameras, turns, places, RigidTransform.identity())


def poses_before(rig: Rig, target: Target, count: int, rng: np.random.Generator) -> RigidTransform:
    """Poses `rig_from_target` that two cameras or more see whole."""
    poses: list[RigidTransform] = []
    middle = target.points.mean(axis=0)
    while len(poses) < count:
        turn = Rotation.from_euler("xyz", rng.uniform(-40, 40, 3), degrees=True)
        place = rng.uniform([-0.6, -1.0, 0.7], [0.8, 0.4, 1.4])
        pose = RigidTransform.from_components(place - turn.apply(middle), turn)
        if sum(is_whole(rig, name, pose, target) for name in rig.cameras) >= 2:
            poses.append(pose)
    return RigidTransform.concatenate(poses)


def pixels_of(rig: Rig, name: str, pose: RigidTransform, target: Target) -> np.ndarray:
    return rig.cameras[name].project((rig.cam_from_rig[name] * pose).apply(target.points))


def is_whole(rig: Rig, name: str, pose: RigidTransform, target: Target) -> bool:
    pixels = pixels_of(rig, name, pose, target)
    size = rig.cameras[name].width_px, rig.cameras[name].height_px
    with np.errstate(invalid="ignore"):
        return bool(np.all((pixels > 25) & (pixels < np.array(size) - 25)))


def matrix_of(rig: Rig, name: str, pose: RigidTransform) -> np.ndarray:
    """(3, 3) `pixels_from_board` of a camera without distortion."""
    one, cam_from_target = rig.cameras[name], (rig.cam_from_rig[name] * pose).as_matrix()
    inner = np.array([[one.fx_px, 0, one.cx_px], [0, one.fy_px, one.cy_px], [0, 0, 1.0]])
    return inner @ cam_from_target[:3, [0, 1, 3]]


def seen_by(truth: Rig, poses: RigidTransform, rng: np.random.Generator) -> Detections:
    """Corners of the target in cameras that see it whole."""
    views = []
    for v in range(len(poses)):
        pixels = {}
        for name in truth.cameras:
            if is_whole(truth, name, poses[v], TARGET):
                seen = pixels_of(truth, name, poses[v], TARGET)
                pixels[name] = seen + rng.normal(0.0, NOISE_PX, seen.shape)
        views.append(TargetView(name=f"{v:02d}", pixels=pixels))
    sizes = {name: (c.width_px, c.height_px) for name, c in truth.cameras.items()}
    return Detections(sizes=sizes, views=tuple(views), rejections=())


def test_four_oblique_cameras_are_found_within_their_sigmas() -> None:
    """From nothing but corners; no view is seen by all of them."""
    truth, rng = four_cameras(), np.random.default_rng(5)
    poses = poses_before(truth, TARGET, 40, rng)
    found_corners = seen_by(truth, poses, rng)
    views, sizes = found_corners.views, found_corners.sizes
    assert {len(view.pixels) for view in views} >= {2, 3}

    found = calibrate_in_air(views, TARGET.points, sizes, "k2")

    assert list(found.rig.cameras) == list(truth.cameras)
    assert len(found.views) == 40 and not found.rejections
    top_of_picture = found.rig.body_from_rig.rotation.apply([0.0, -1.0, 0.0])
    np.testing.assert_allclose(top_of_picture, [1.0, 0.0, 0.0], atol=1e-12)  # towards the bow
    assert found.noise_px == pytest.approx(NOISE_PX, rel=0.05)
    errors, sigmas = differences(found.rig, truth), found.rig.sigmas
    over = np.array([errors[key] / sigmas[key] for key in errors])
    assert len(over) == 4 * 6 + 3 * 6
    assert np.abs(over).max() < 4.0
    assert 0.6 < np.sqrt(np.mean(over**2)) < 1.4
    for name in ("right", "bow", "side"):
        assert sigmas[f"{name}.x_m"] < 2e-3
        assert sigmas[f"{name}.rx_rad"] < 1e-3


def test_four_lenses_behind_four_ports_are_found_in_air_and_then_in_water() -> None:
    rig, rng = four_cameras(), np.random.default_rng(8)
    fisheye = FisheyeLens(fx_px=420.0, fy_px=421.0, cx_px=365.0, cy_px=268.0, k1=-0.02, k2=0.004)
    dome = DomePort(outer_radius_m=0.07, glass_thickness_m=0.005, dome_x_m=0.001, dome_z_m=0.006)
    ports = {
        "left": FlatPort(port_distance_m=0.03, glass_thickness_m=0.005, n_glass=1.49),
        "right": FlatPort(port_distance_m=0.015, glass_thickness_m=0.008, n_glass=1.52),
        "bow": dome,
        "side": replace(dome, dome_x_m=0.0, dome_z_m=-0.003, outer_radius_m=0.055),
    }
    lenses = {name: one.lens for name, one in rig.cameras.items()} | {"side": fisheye}
    dry = replace(rig, cameras={n: replace(c, lens=lenses[n]) for n, c in rig.cameras.items()})
    wet = replace(dry, cameras={n: replace(c, port=ports[n]) for n, c in dry.cameras.items()})
    terms = "k2,side=fisheye"
    in_air = calibrated(
        CalibrateOptions(lens=terms),
        seen_by(dry, poses_before(dry, TARGET, 30, rng), rng), TARGET, None,
    ).rig  # fmt: skip
    under_water = CalibrateOptions(
        lens=terms, water=True, port="flat,bow=dome,side=dome", dome_radius_mm="70,side=55",
        glass_mm="5,right=8", n_glass="1.52,left=1.49",
    )  # fmt: skip
    views = seen_by(wet, poses_before(wet, TARGET, 30, rng), rng)

    found = calibrated(under_water, views, TARGET, in_air)

    errors, sigmas = differences(found.rig, wet), found.rig.sigmas
    over = np.array([errors[key] / sigmas[key] for key in sigmas])
    assert {f"{n}.dome_z_m" for n in ("bow", "side")} <= set(sigmas)
    assert np.abs(over).max() < 4.5
    assert 0.6 < np.sqrt(np.mean(over**2)) < 1.4
    assert 0.9 * NOISE_PX < found.noise_px < 1.1 * NOISE_PX
    again = calibrated(replace(under_water, port=None, lens=None), views, TARGET, found.rig)
    assert [c.port.shape for c in again.rig.cameras.values()] == ["flat", "flat", "dome", "dome"]


@pytest.mark.parametrize(
    ("text", "fault"),
    [("flat,stern=dome", "no camera is called stern"), ("bow=dome", "there is none for left"),
     ("cube", "'cube' for left; choose none, flat, dome, auto"), ("flat,dome", "two are for all"),
     ("auto,bow=dome", "auto is for all")],
)  # fmt: skip
def test_a_wrong_port_is_named(text: str, fault: str) -> None:
    with pytest.raises(CalibrationError, match=fault):
        port_kinds(CalibrateOptions(port=text, water=True), list(four_cameras().cameras), None)


@pytest.mark.parametrize(
    ("given", "fault"),
    [({"glass_mm": "5,bow=thick"}, "'thick' for bow is not a number from 0 to 500"),
     ({"dome_radius_mm": "80,bow=2"}, "--dome-radius 80,bow=2: '2' for bow is not a number from 5"),
     ({"n_glass": "stern=1.5"}, "--n-glass stern=1.5: no camera is called stern"),
     ({"port_distance_mm": "nan"}, "'nan' for left is not a number"),
     ({"glass_mm": "left=5,right=5,bow=5"}, "--glass, the thickness of the port of side"),
     ({"port": "flat,bow=dome", "glass_mm": "5"}, "--dome-radius, of the outer surface of bow")],
)  # fmt: skip
def test_a_wrong_number_of_a_port_is_named(given: dict[str, str], fault: str) -> None:
    cameras = tuple(f"{name}=folder" for name in four_cameras().cameras)
    with pytest.raises(CalibrationError, match=fault):
        check_settings(CalibrateOptions(cameras=cameras, water=True, **given), None)  # type: ignore[arg-type]


@pytest.mark.slow
def test_four_cameras_from_folders(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Rendered pictures; those in which a camera sees no whole board are not in its folder."""
    rig, rng = four_cameras(), np.random.default_rng(3)
    straight = {name: changed(c, k1=0.0) for name, c in rig.cameras.items()}
    truth = replace(rig, cameras=straight)
    poses = poses_before(truth, TARGET, 30, rng)
    for v in range(len(poses)):
        for name, one in truth.cameras.items():
            (tmp_path / name).mkdir(exist_ok=True)
            if not is_whole(truth, name, poses[v], TARGET):
                continue
            matrix = matrix_of(truth, name, poses[v])
            light = picture_light(TARGET, matrix, (one.width_px, one.height_px), fine=3)
            light += rng.normal(0, 0.004, light.shape)
            cv2.imwrite(str(tmp_path / name / f"{name}_{v:03d}.png"), to_srgb(light))
    options = CalibrateOptions(
        cameras=tuple(f"{name}={tmp_path / name}" for name in truth.cameras),
        target=TARGET.description, lens="pinhole", output=tmp_path / "out",
    )  # fmt: skip

    text, found = calibrate_pictures(options, executor=SERIAL)

    assert found["views"] >= 28
    rig = read_rig(tmp_path / "out" / "rig.json")
    assert list(rig.cameras) == list(truth.cameras)
    for name, one in truth.cameras.items():
        assert rig.cameras[name].fx_px == pytest.approx(one.fx_px, rel=2e-3)
    errors = differences(rig, truth)
    over = np.array([errors[key] / sigma for key, sigma in rig.sigmas.items()])
    assert np.sqrt(np.mean(over**2)) < 2.0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert set(report["cameras"]) == set(truth.cameras)
    assert set(report["baselines_m"]) == {"right", "bow", "side"}
    page = (tmp_path / "out" / "report.html").read_text()
    for name in ("right", "bow", "side"):
        assert f"baseline from left to {name}" in text
        assert f"baseline to {name}" in page
    assert "--camera left=FOLDER --camera right=FOLDER" in text
