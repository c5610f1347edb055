"""Cameras without port that stand in for those behind ports: the study's, COLMAP's, invariants."""

import math
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.errors import CalibrationError, ConfigError
from camera_calib.approximation.pinhole_warp import best_warp, residual_px
from camera_calib.camera import Camera
from camera_calib.formats.camera_files import record_of
from camera_calib.formats.convert import fit_in_water
from camera_calib.formats.opencv_model import StandIn
from camera_calib.lenses.fisheye import FisheyeLens
from tests.camera_calib.approximation.ports import CAMERA, STUDY, behind_port
from tests.cameras import changed

GRID = CAMERA.frame_grid(15, 15)
DISTANCES_M = np.linspace(1.5, 2.5, 9)


def misses(camera: Camera, fit: StandIn, near_m: float = 1.5, far_m: float = 2.5) -> np.ndarray:
    """(9, 15, 15, 2) pixel of the stand-in minus that of the exact camera."""
    points = [camera.at_depth(GRID, z) for z in np.linspace(near_m, far_m, 9)]
    seen = [fit.approx_from_cam.apply(p.reshape(-1, 3)).reshape(p.shape) for p in points]
    return fit.camera.project(np.stack(seen)) - GRID


def rms_px(sizes: np.ndarray) -> float:
    """Root mean square over the frame's area: its border counts half."""
    side = np.r_[0.5, np.ones(13), 0.5] / 14
    return float(np.sqrt((sizes**2 * np.outer(side, side)).sum(axis=(1, 2)).mean()))


@pytest.mark.parametrize(("port", "glass"), [(row[0], row[1]) for row in STUDY])
def test_a_fitted_camera_is_near_the_best_pinhole_behind_a_square_port_and_not_a_tilted_one(
    port: float, glass: float
) -> None:
    camera = behind_port(port, glass)
    warp = best_warp(camera, 1.5, 2.5, 2.0)
    best = rms_px(residual_px(warp, DISTANCES_M))
    one = fit_in_water(camera, 1.5, 2.5)

    # No camera of one centre can do much better than the best centre.
    assert best < one.rms_px < 1.1 * best + 0.02
    assert np.rad2deg(one.approx_from_cam.rotation.magnitude()) < 1e-3
    assert one.camera.fx_px == pytest.approx(1.34 * 3388.0, rel=5e-3)
    assert (one.camera.cx_px, one.camera.cy_px) == pytest.approx((1692.0, 1355.0), abs=0.05)
    # The shifts of the best pinhole and of the fit are those of the same caustic.
    assert -one.approx_from_cam.translation[2] == pytest.approx(warp.centre_m[2], rel=0.05)

    # Tilted and held upright it would cost 0.9 px; bundle adjustment turns the camera and saves
    # a part. All of it is many times what the warp to a pinhole costs.
    tilted = behind_port(port, glass, tilt_deg=2.0)
    opencv = fit_in_water(tilted, 1.5, 2.5)
    assert 0.6 < opencv.rms_px < 0.85 * 0.9
    best = rms_px(residual_px(best_warp(tilted, 1.5, 2.5, 2.0), DISTANCES_M))
    assert opencv.rms_px > 1.9 * best
    turn = opencv.approx_from_cam.rotation.as_rotvec(degrees=True)
    assert 0.1 < abs(turn[1]) < 1.0
    assert np.abs(turn[[0, 2]]).max() < 1e-3


@pytest.mark.parametrize("tilt_deg", [0.0, 2.0])
@pytest.mark.parametrize("fisheye", [False, True])
def test_the_stated_errors_are_those_of_the_camera_and_of_colmap(
    fisheye: bool, tilt_deg: float
) -> None:
    camera = behind_port(20, 10, tilt_deg)
    if fisheye:
        lens = FisheyeLens(fx_px=3388.0, fy_px=3388.0, cx_px=1692.0, cy_px=1355.0, k1=0.02)
        camera = replace(camera, lens=lens)
    fit = fit_in_water(camera, 1.5, 2.5)
    assert fit.model == ("OPENCV_FISHEYE" if fisheye else "OPENCV")
    found = misses(camera, fit)
    sizes = np.linalg.norm(found, axis=-1)
    assert fit.rms_px == pytest.approx(rms_px(sizes), rel=1e-6)
    assert fit.max_px == pytest.approx(sizes.max(), rel=1e-6)

    record = record_of(1, fit.camera, port=False)
    colmap = pycolmap.Camera(
        model=record.model, width=3384, height=2710, params=list(record.params)
    )
    for z, expected in zip(DISTANCES_M, found, strict=True):
        seen = fit.approx_from_cam.apply(camera.at_depth(GRID.reshape(-1, 2), float(z)))
        off = colmap.img_from_cam(seen) - GRID.reshape(-1, 2)
        np.testing.assert_allclose(off, expected.reshape(-1, 2), atol=1e-8)


def test_a_camera_in_air_is_fitted_without_a_rest() -> None:
    """Without refraction its own lens is the answer."""
    camera = changed(CAMERA, n_water=1.0, k1=-0.12, k2=0.07, p1=5e-4, p2=-3e-4, k3=-0.01)
    simple = fit_in_water(changed(camera, k3=0.0), 0.5, 3.0)
    assert simple.max_px < 1e-2
    np.testing.assert_allclose(
        record_of(1, simple.camera, port=False).params,
        [3388, 3388, 1692, 1355, -0.12, 0.07, 5e-4, -3e-4],
        rtol=1e-3,
    )
    assert fit_in_water(camera, 0.5, 3.0).max_px > simple.max_px


def test_impossible_intervals_and_lenses_short_of_the_corners_are_refused() -> None:
    for interval in ((2.5, 1.5), (2.0, 2.0), (0.02, 2.0), (-1.0, 2.0), (1.0, math.inf)):
        with pytest.raises(ConfigError, match=r"0\.03\d* m"):
            fit_in_water(behind_port(20, 10), *interval)
    with pytest.raises(CalibrationError):
        fit_in_water(changed(behind_port(20, 10), k1=-2.0), 1.5, 2.5)


def test_no_neighbour_of_a_fit_is_better() -> None:
    camera = changed(behind_port(50, 15, 1.0), k1=-0.15, k2=0.06, p1=4e-4)
    fit = fit_in_water(camera, 1.0, 3.0)
    names = [n for n in fit.camera.parameters if fit.camera.parameter(n) != 0.0]
    others = [
        replace(fit, camera=fit.camera.with_parameters({name: fit.camera.parameter(name) + step}))
        for name in names
        for step in ((-0.5, 0.5) if name.endswith("_px") else (-1e-3, 1e-3))
    ]
    pose = fit.approx_from_cam
    for axis in np.eye(3):
        turn = RigidTransform.from_rotation(Rotation.from_rotvec(1e-4 * axis))
        others.append(replace(fit, approx_from_cam=turn * pose))
    for factor in (0.9, 1.1):
        moved = RigidTransform.from_components(factor * pose.translation, pose.rotation)
        others.append(replace(fit, approx_from_cam=moved))
    for other in others:
        found = np.linalg.norm(misses(camera, other, 1.0, 3.0), axis=-1)
        assert rms_px(found) > fit.rms_px
