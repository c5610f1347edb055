"""Rendered pictures of tag grids, as EuRoC and TUM-VI have them, calibrate as well as they can.

Burri et al. 2016, "The EuRoC micro aerial vehicle datasets"; Schubert et al. 2018, "The TUM VI
benchmark for evaluating visual-inertial odometry": sizes, lenses and baselines of their stereo
cameras, and the grid that both were calibrated with.
"""

import csv
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.executor import SERIAL
from alice_survey.core.frames import Array
from benchmarks.camera_calibration import cramer_rao
from camera_calib.calibrate.from_pictures import calibrate_pictures
from camera_calib.calibrate.options import CalibrateOptions
from camera_calib.camera import Camera
from camera_calib.freedom import Freedom, intrinsics, of_cameras, pose_names
from camera_calib.rig import Rig, read_rig
from camera_calib.target_shape import usual_shape
from camera_calib.targets.target import parse_target
from tests.camera_calib.calibration_scenes import differences
from tests.oracles_targets import picture_light, to_srgb
from tests.strategies_formats import DATA

TARGET = parse_target("apriltag 6x6 88mm 0.3")
OF_BOUND = 1.15
NOISE = 0.03
"""Of a pixel, as a share of full light; white is 0.7."""
VIEWS, TRIALS = 16, 3
BORDER_PX = 5.0


@dataclass(frozen=True)
class Stereo:
    """Two cameras, and how far from them and from their axes the grid is held."""

    rig: Rig
    model: str
    ranges_m: tuple[float, float]
    off_axis_deg: float


RIGS = {
    name: Stereo(read_rig(DATA / f"{name}.json"), *how)
    for name, how in {
        "euroc": ("opencv4", (0.5, 1.3), 25.0), "tum-vi": ("fisheye", (0.28, 0.55), 40.0),
    }.items()
}  # fmt: skip


def seen(rig: Rig, name: str, pose: RigidTransform) -> Array:
    """(144, 2) true pixels; NaN outside of the picture."""
    camera, points = rig.cameras[name], (rig.cam_from_rig[name] * pose).apply(TARGET.points)
    pixels = camera.project(points)
    size = np.array([camera.width_px, camera.height_px])
    with np.errstate(invalid="ignore"):
        within = (pixels > BORDER_PX) & (pixels < size - BORDER_PX) & (points[:, 2:] > 0.02)
    return np.where(within.all(axis=1, keepdims=True), pixels, np.nan)


def poses_before(stereo: Stereo, rng: np.random.Generator) -> list[RigidTransform]:
    """Poses of the grid, tilted, anywhere in the frame; both cameras see half of it or more."""
    poses: list[RigidTransform] = []
    middle = 0.5 * (TARGET.points.max(axis=0) + TARGET.points.min(axis=0))
    while len(poses) < VIEWS:
        tilt = Rotation.from_euler("xyz", rng.uniform([-40, -40, -80], [40, 40, 80]), degrees=True)
        angle, way = np.deg2rad(stereo.off_axis_deg) * np.sqrt(rng.uniform()), rng.uniform(0, 7)
        aim = Rotation.from_rotvec(angle * np.array([-np.sin(way), np.cos(way), 0.0]))
        turn, place = aim * tilt, aim.apply([0.0, 0.0, rng.uniform(*stereo.ranges_m)])
        pose = RigidTransform.from_components(place - turn.apply(middle), turn)
        shares = [np.isfinite(seen(stereo.rig, n, pose)[:, 0]).mean() for n in stereo.rig.cameras]
        if min(shares) >= 0.5:
            poses.append(pose)
    return poses


def light_of(camera: Camera, cam_from_target: RigidTransform) -> Array:
    """(H, W) of the grid, seen through a lens."""
    matrix = cam_from_target.as_matrix()[:3, [0, 1, 3]]

    def tangents(pixels: Array) -> Array:
        rays = camera.unproject(pixels)[1]
        ahead = np.where(rays[:, 2:] > 0.0, rays[:, 2:], np.nan)
        return rays[:, :2] / ahead

    size = (camera.width_px, camera.height_px)
    return picture_light(TARGET, matrix, size, warp=tangents)


@pytest.mark.slow
@pytest.mark.parametrize("name", RIGS)
def test_tag_pictures_calibrate_to_their_bound(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Errors of all parameters, whitened by their least covariance at the noise of the corners."""

    def without_plots(folder: Path, *_: object) -> None:
        (folder / "report.json").write_text('{"verdicts": []}')

    monkeypatch.setattr("camera_calib.calibrate.results.write_report", without_plots)
    monkeypatch.setattr("camera_calib.calibrate.results.hold_out", lambda *_: None)
    stereo, rng = RIGS[name], np.random.default_rng(1)
    truth, poses = stereo.rig, poses_before(stereo, rng)
    light = [
        {n: light_of(c, truth.cam_from_rig[n] * pose) for n, c in truth.cameras.items()}
        for pose in poses
    ]
    freedom = Freedom(free=(*of_cameras(truth, intrinsics(stereo.model)), *pose_names(truth)))
    whitened = []
    for trial in range(TRIALS):
        for v, by_camera in enumerate(light):
            for side, one in by_camera.items():
                (tmp_path / side).mkdir(exist_ok=True)
                picture = to_srgb(one + rng.normal(0.0, NOISE, one.shape))
                cv2.imwrite(str(tmp_path / side / f"{v:02d}.png"), picture)
        options = CalibrateOptions(
            cameras=(f"left={tmp_path / 'left'}", f"right={tmp_path / 'right'}"),
            target=TARGET.description, lens=stereo.model, output=tmp_path / f"out{trial}",
        )  # fmt: skip
        calibrate_pictures(options, executor=SERIAL)
        folder = tmp_path / f"out{trial}"
        found = read_rig(folder / "rig.json")
        off = corner_errors(folder / "corners.csv", truth, poses)
        used = np.all(np.isfinite(off), axis=-1)
        noise_px = float(np.sqrt(np.nanmean(off**2)))
        bound = cramer_rao(
            truth, TARGET.points, RigidTransform.concatenate(poses), used, freedom, noise_px,
            usual_shape(TARGET.points),
        )  # fmt: skip
        errors = differences(found, truth)
        off_by = np.array([errors[key] for key in bound.parameters])
        whitened.append(np.linalg.solve(np.linalg.cholesky(bound.matrix), off_by))
        assert used.sum() > 0.7 * np.isfinite(true_pixels(truth, poses)[..., 0]).sum()
        assert 0.01 < noise_px < 0.05
    ratio = float(np.sqrt(np.mean(np.square(whitened))))
    assert 0.8 < ratio < OF_BOUND


def true_pixels(truth: Rig, poses: list[RigidTransform]) -> Array:
    """(V, 2, 144, 2)."""
    return np.array([[seen(truth, side, pose) for side in truth.cameras] for pose in poses])


def corner_errors(path: Path, truth: Rig, poses: list[RigidTransform]) -> Array:
    """(V, 2, 144, 2) measured minus true pixels of the corners that the calibration used."""
    true = true_pixels(truth, poses)
    off = np.full(true.shape, np.nan)
    for row in csv.DictReader(path.read_text().splitlines()):
        if float(row["weight"]) > 0.0:
            at = int(row["view"]), list(truth.cameras).index(row["camera"]), int(row["point"])
            off[at] = np.array([float(row["x_px"]), float(row["y_px"])]) - true[at]
    return off
