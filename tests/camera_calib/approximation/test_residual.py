"""The price of approximations: the design study's table, COLMAP's own projection, invariants."""

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from alice_survey.core.errors import CalibrationError, ConfigError
from camera_calib.approximation.residual import (
    COLMAP_PARAMETERS,
    Residual,
    approximations,
    colmap_pixels,
    residual,
)
from camera_calib.camera import Camera
from tests.camera_calib.approximation.ports import CAMERA, STUDY, behind_port
from tests.cameras import changed


@lru_cache
def study(camera: Camera, *, turned: bool = True) -> dict[str, Residual]:
    found = approximations(
        camera, 1.5, 2.5, distances_m=(1.5, 2.0, 2.5), working_range_m=2.0, turned=turned
    )
    return {one.stand_in.name.removesuffix(", fitted"): one for one in found}


@pytest.mark.parametrize(("port", "glass", "at_pupil", "best", "shift_mm", "tilted"), STUDY)
def test_warped_pinholes_cost_what_the_design_study_says(
    port: float, glass: float, at_pupil: float, best: float, shift_mm: float, tilted: float
) -> None:
    square = study(behind_port(port, glass))
    leaning = study(behind_port(port, glass, tilt_deg=2.0))

    pupil = square["pinhole at the pupil, warped"]
    chosen = square["pinhole at the best point, warped"]
    assert pupil.rms_px == pytest.approx(at_pupil, rel=0.1 if port == 5 else 0.03)
    assert chosen.rms_px == pytest.approx(best, rel=0.04)
    assert -chosen.stand_in.centre_m[2] * 1e3 == pytest.approx(shift_mm, rel=0.05)
    assert leaning["pinhole at the best point, warped"].rms_px == pytest.approx(tilted, rel=0.04)
    assert pupil.stand_in.warped_at_m == chosen.stand_in.warped_at_m == 2.0
    np.testing.assert_allclose(chosen.rms_by_distance_px[1], 0.0, atol=1e-9)


@pytest.mark.parametrize(("port", "glass"), [(row[0], row[1]) for row in STUDY])
def test_a_fitted_camera_is_near_the_best_pinhole_behind_a_square_port(
    port: float, glass: float
) -> None:
    found = study(behind_port(port, glass))
    best = found["pinhole at the best point, warped"].rms_px

    # More freedom fits better; no camera of one centre can do much better than the best centre.
    assert found["SIMPLE_RADIAL"].rms_px > found["OPENCV"].rms_px >= found["FULL_OPENCV"].rms_px
    assert 0.9 * best < found["FULL_OPENCV"].rms_px < 1.2 * best
    assert best < found["OPENCV"].rms_px < 1.1 * best + 0.02
    assert 0.4 < found["SIMPLE_RADIAL"].rms_px < 0.9
    for model in ("OPENCV", "FULL_OPENCV"):
        one = found[model].stand_in
        assert np.rad2deg(one.approx_from_cam.magnitude()) < 1e-3
        assert one.params[0] == pytest.approx(1.34 * 3388.0, rel=5e-3)
        assert one.params[2:4] == pytest.approx((1692.0, 1355.0), abs=0.05)
        # The shifts of the best pinhole and of the fit are those of the same caustic.
        pinhole = found["pinhole at the best point, warped"].stand_in
        assert one.centre_m[2] == pytest.approx(pinhole.centre_m[2], rel=0.05)


@pytest.mark.parametrize(("port", "glass"), [(row[0], row[1]) for row in STUDY])
def test_a_tilted_port_left_in_opencv_costs_a_pixel(port: float, glass: float) -> None:
    """The design study's 1.1 px lies between the frame's area and a coarse grid with its border."""
    camera = behind_port(port, glass, tilt_deg=2.0)
    held = study(camera, turned=False)["OPENCV"]
    coarse = residual(camera, held.stand_in, np.array([1.5, 2.0, 2.5]), grid=9)

    assert held.rms_px == pytest.approx(0.9, abs=0.05)
    assert np.sqrt(np.mean(coarse.sizes_px**2)) == pytest.approx(1.2, abs=0.06)
    # Bundle adjustment turns the camera and saves a part.
    free = study(camera)
    assert 0.6 < free["OPENCV"].rms_px < 0.85 * held.rms_px
    assert free["FULL_OPENCV"].rms_px < free["OPENCV"].rms_px
    # All of it many times what the warp to a pinhole costs.
    best = free["pinhole at the best point, warped"].rms_px
    assert free["OPENCV"].rms_px > 1.9 * best
    turn = free["OPENCV"].stand_in.approx_from_cam.as_rotvec(degrees=True)
    assert 0.1 < abs(turn[1]) < 1.0
    assert np.abs(turn[[0, 2]]).max() < 1e-3


@pytest.mark.parametrize("model", list(COLMAP_PARAMETERS))
def test_projection_is_colmaps(model: str) -> None:
    values = {
        "f": 4500.0, "fx": 4500.0, "fy": 4510.0, "cx": 1690.0, "cy": 1350.0,
        "k1": 0.21, "k2": -0.13, "p1": 2e-3, "p2": -1e-3, "k3": 0.05, "k4": 0.02, "k5": -0.04,
        "k6": 0.01,
    }  # fmt: skip
    params = [values[name] for name in COLMAP_PARAMETERS[model]]
    camera = pycolmap.Camera(model=model, width=3384, height=2710, params=params)
    assert camera.params_info.replace(" ", "").lower().split(",") == [
        "k" if name == "k1" and model == "SIMPLE_RADIAL" else name
        for name in COLMAP_PARAMETERS[model]
    ]
    points = np.random.default_rng(0).uniform([-0.8, -0.6, 1.5], [0.8, 0.6, 2.5], (200, 3))

    np.testing.assert_allclose(
        colmap_pixels(model, params, points), camera.img_from_cam(points), atol=1e-9
    )


@pytest.mark.parametrize("tilt_deg", [0.0, 2.0])
def test_colmap_itself_finds_the_same_residual(tilt_deg: float) -> None:
    camera = behind_port(20, 10, tilt_deg)
    for one in approximations(camera, 1.5, 2.5)[2:]:
        stand_in = one.stand_in
        colmap = pycolmap.Camera(
            model=stand_in.model, width=3384, height=2710, params=list(stand_in.params)
        )
        for z, misses in zip(one.distances_m, one.errors_px, strict=True):
            points = camera.at_depth(one.pixels.reshape(-1, 2), float(z))
            seen = stand_in.approx_from_cam.apply(points - np.array(stand_in.centre_m))
            miss = colmap.img_from_cam(seen) - one.pixels.reshape(-1, 2)
            np.testing.assert_allclose(miss, misses.reshape(-1, 2), atol=1e-8)


def test_a_camera_in_air_is_fitted_without_a_rest() -> None:
    """Without refraction its own lens is the answer."""
    camera = changed(CAMERA, n_water=1.0, k1=-0.12, k2=0.07, p1=5e-4, p2=-3e-4, k3=-0.01)
    simple = changed(camera, k3=0.0)
    found = {one.stand_in.model: one for one in approximations(simple, 0.5, 3.0)}
    assert found["OPENCV"].max_px < 1e-2
    np.testing.assert_allclose(
        found["OPENCV"].stand_in.params,
        [3388, 3388, 1692, 1355, -0.12, 0.07, 5e-4, -3e-4],
        rtol=1e-3,
    )
    full = {one.stand_in.model: one for one in approximations(camera, 0.5, 3.0)}
    assert full["FULL_OPENCV"].max_px < 1e-2
    assert full["OPENCV"].max_px > found["OPENCV"].max_px


@pytest.mark.parametrize(
    ("near_m", "far_m"), [(2.5, 1.5), (2.0, 2.0), (0.02, 2.0), (-1.0, 2.0), (1.0, math.inf)]
)
def test_an_impossible_interval_is_refused(near_m: float, far_m: float) -> None:
    with pytest.raises(ConfigError, match=r"0\.03\d* m"):
        approximations(behind_port(20, 10), near_m, far_m)


def test_a_lens_that_does_not_reach_the_corners_is_refused() -> None:
    with pytest.raises(CalibrationError):
        approximations(changed(behind_port(20, 10), k1=-2.0), 1.5, 2.5)


def test_no_neighbour_of_a_fit_is_better() -> None:
    camera = changed(behind_port(50, 15, 1.0), k1=-0.15, k2=0.06, p1=4e-4)
    for one in approximations(camera, 1.0, 3.0)[2:4]:
        fit = one.stand_in
        for i in range(len(fit.params)):
            for sign in (-1, 1):
                params = list(fit.params)
                params[i] += sign * (0.5 if params[i] > 10 else 1e-3)
                other = residual(camera, replace(fit, params=tuple(params)), one.distances_m)
                assert other.rms_px > one.rms_px
        for axis in range(3):
            turn = Rotation.from_rotvec(1e-4 * np.eye(3)[axis]) * fit.approx_from_cam
            other = residual(camera, replace(fit, approx_from_cam=turn), one.distances_m)
            assert other.rms_px > one.rms_px
        for factor in (0.9, 1.1):
            x, y, z = (factor * c for c in fit.centre_m)
            other = residual(camera, replace(fit, centre_m=(x, y, z)), one.distances_m)
            assert other.rms_px > one.rms_px
