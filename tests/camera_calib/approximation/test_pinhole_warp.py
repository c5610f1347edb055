from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares

from camera_calib.approximation.pinhole_warp import PinholeWarp, best_warp, residual_px
from camera_calib.camera import Camera
from camera_calib.lenses.fisheye import FisheyeLens
from tests.camera_calib.approximation.ports import STUDY, behind_port

LEANING = best_warp(behind_port(50, 15, tilt_deg=2.0), 1.5, 2.5)
DEPTHS_M = np.linspace(1.5, 2.5, 5)


def rms(warp: PinholeWarp) -> float:
    return float(np.sqrt(np.mean(residual_px(warp, DEPTHS_M) ** 2)))


@pytest.mark.parametrize(("port", "glass", "at_pupil", "best", "shift_mm", "tilted"), STUDY)
def test_residuals_are_those_of_the_design_study(
    port: float, glass: float, at_pupil: float, best: float, shift_mm: float, tilted: float
) -> None:
    warp = best_warp(behind_port(port, glass), 1.5, 2.5)

    assert rms(warp) == pytest.approx(best, rel=0.08)
    assert -warp.centre_m[2] * 1e3 == pytest.approx(shift_mm, rel=0.06)
    assert rms(replace(warp, centre_m=(0.0, 0.0, 0.0))) == pytest.approx(at_pupil, rel=0.2)

    leaning = best_warp(behind_port(port, glass, tilt_deg=2.0), 1.5, 2.5)
    assert rms(leaning) == pytest.approx(tilted, rel=0.08)
    assert leaning.working_range_m == pytest.approx(1.875)  # where the warp is exact
    assert residual_px(leaning, np.array([1.875])).max() < 1e-9


@pytest.mark.parametrize(("port", "tilt_deg"), [(20, 0.0), (20, 2.0), (100, 2.0)])
def test_the_closed_form_finds_the_centre_that_a_search_finds(port: float, tilt_deg: float) -> None:
    """The offsets' least squares against a search over the residual in pixels at all depths."""
    warp = best_warp(behind_port(port, 10, tilt_deg=tilt_deg), 1.5, 2.5)
    depths = 1 / np.linspace(1 / 2.5, 1 / 1.5, 7)

    def residuals(centre: np.ndarray) -> np.ndarray:
        return residual_px(replace(warp, centre_m=tuple(centre)), depths).ravel()

    found = least_squares(residuals, np.zeros(3), x_scale=1e-3, xtol=1e-12, ftol=1e-12)
    np.testing.assert_allclose(warp.centre_m, found.x, atol=2e-3 * port * 1e-3)
    assert (residuals(np.array(warp.centre_m)) ** 2).sum() < 1.0001 * (found.fun**2).sum()


def test_a_camera_of_one_centre_is_its_own_pinhole() -> None:
    camera = behind_port(0, 0).in_air()
    warp = best_warp(camera, 1.5, 2.5)

    assert warp.centre_m == (0.0, 0.0, 0.0)
    assert warp.pinhole.size_px == warp.size_px
    assert residual_px(warp, DEPTHS_M).max() == 0.0
    assert warp.cut_share == 0.0

    # Through a port without thickness on the pupil all rays meet in it, and any range fits.
    thin = best_warp(behind_port(0, 0), 1.5, 2.5)
    np.testing.assert_allclose(thin.centre_m, 0.0, atol=1e-9)
    assert residual_px(thin, DEPTHS_M).max() < 0.01


def test_the_pinhole_keeps_the_ground_resolution_on_the_axis_and_all_of_the_frame() -> None:
    camera = behind_port(20, 10)
    warp = best_warp(camera, 1.5, 2.5)
    axis = np.array([camera.cx_px, camera.cy_px])
    step = warp.to_pinhole(axis + np.eye(2)) - warp.to_pinhole(axis)

    np.testing.assert_allclose(step, np.eye(2), atol=0.02)
    seen = warp.to_pinhole(camera.border())
    np.testing.assert_allclose(seen.min(axis=0), 0.0, atol=1e-6)
    assert np.all(np.array(warp.pinhole.size_px) - seen.max(axis=0) < 1.0)
    assert warp.cut_share == 0.0


def test_a_wide_lens_is_cut_at_the_largest_growth() -> None:
    """An equidistant fisheye of 120 degrees: tan(60) is 1.65 times 60 degrees."""
    focal = 500.0 / np.deg2rad(60)
    lens = FisheyeLens(fx_px=focal, fy_px=focal, cx_px=500.0, cy_px=300.0)
    camera = Camera(width_px=1000, height_px=600, lens=lens)
    warp = best_warp(camera, 1.5, 2.5)

    assert warp.pinhole.width_px == 1500
    assert 600 < warp.pinhole.height_px <= 900
    assert warp.pinhole.fx_px == pytest.approx(focal)
    assert 0.03 < warp.cut_share < 0.3


@given(x=st.floats(0, 3384), y=st.floats(0, 2710), depth_m=st.floats(0.5, 10))
def test_the_pinhole_sees_what_the_camera_sees(x: float, y: float, depth_m: float) -> None:
    """Against the point itself, traced through the port and projected by the pinhole."""
    warp = LEANING
    taken = np.array([x, y])
    point = warp.camera.at_depth(taken, depth_m)
    seen = warp.to_pinhole(taken, depth_m)

    np.testing.assert_allclose(
        warp.pinhole.project(warp.pinhole_from_cam.apply(point)), seen, atol=1e-8
    )
    np.testing.assert_allclose(warp.from_pinhole(warp.to_pinhole(taken)), taken, atol=1e-7)
    slope, offset = warp.lines(taken)
    z = depth_m - warp.centre_m[2]
    np.testing.assert_allclose(
        np.append(offset + slope * z, z), point - np.array(warp.centre_m), atol=1e-12
    )
