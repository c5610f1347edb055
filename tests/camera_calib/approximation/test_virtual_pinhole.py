from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from camera_calib.approximation.virtual_pinhole import (
    VirtualPinhole,
    best_pinhole,
    residual_px,
)
from camera_calib.camera import Camera
from tests.camera_calib.approximation.ports import STUDY, behind_port

DEPTHS_M = np.linspace(1.5, 2.5, 5)


def rms(camera: Camera, pinhole: VirtualPinhole) -> float:
    return float(np.sqrt(np.mean(residual_px(camera, pinhole, DEPTHS_M) ** 2)))


@pytest.mark.parametrize(("port", "glass", "at_pupil", "best", "shift_mm", "tilted"), STUDY)
def test_residuals_are_those_of_the_design_study(
    port: float, glass: float, at_pupil: float, best: float, shift_mm: float, tilted: float
) -> None:
    camera = behind_port(port, glass)
    pinhole = best_pinhole(camera, 1.5, 2.5)

    assert rms(camera, pinhole) == pytest.approx(best, rel=0.08)
    assert -pinhole.centre_z_m * 1e3 == pytest.approx(shift_mm, rel=0.06)
    assert rms(camera, replace(pinhole, centre_z_m=0.0)) == pytest.approx(at_pupil, rel=0.2)

    leaning = behind_port(port, glass, tilt_deg=2.0)
    assert rms(leaning, best_pinhole(leaning, 1.5, 2.5)) == pytest.approx(tilted, rel=0.08)


def test_no_other_point_of_the_normal_is_better() -> None:
    camera = behind_port(20, 10, tilt_deg=2.0)
    best = best_pinhole(camera, 1.5, 2.5)
    depths = 1 / np.linspace(1 / 2.5, 1 / 1.5, 7)
    least = np.mean(residual_px(camera, best, depths) ** 2)

    for factor in (0.9, 0.99, 1.01, 1.1):
        other = replace(
            best, centre_x_m=best.centre_x_m * factor, centre_z_m=best.centre_z_m * factor
        )
        assert np.mean(residual_px(camera, other, depths) ** 2) > least


def test_the_warp_is_exact_at_the_working_range() -> None:
    camera = behind_port(50, 15, tilt_deg=1.0)
    pinhole = best_pinhole(camera, 1.5, 2.5)

    assert pinhole.working_range_m == pytest.approx(1.875)
    assert residual_px(camera, pinhole, np.array([1.875])).max() < 1e-9


def test_a_port_of_no_thickness_on_the_pupil_moves_only_by_refraction() -> None:
    camera = behind_port(0, 0)
    pinhole = best_pinhole(camera, 1.5, 2.5)

    # All rays meet in the pupil: any range fits without parallax.
    assert abs(pinhole.centre_z_m) < 1e-6
    assert residual_px(camera, pinhole, DEPTHS_M).max() < 0.01


@given(
    x=st.floats(0, 3384),
    y=st.floats(0, 2710),
    depth_m=st.floats(0.5, 10),
    centre=st.tuples(*[st.floats(-0.05, 0.05)] * 3),
)
def test_at_depth_and_project_are_inverse(
    x: float, y: float, depth_m: float, centre: tuple[float, float, float]
) -> None:
    pinhole = VirtualPinhole(
        width_px=3384,
        height_px=2710,
        focal_px=4540.0,
        cx_px=1690.0,
        cy_px=1357.0,
        centre_x_m=centre[0],
        centre_y_m=centre[1],
        centre_z_m=centre[2],
        working_range_m=2.0,
    )
    point = pinhole.at_depth(np.array([x, y]), depth_m)

    assert point[2] == depth_m
    np.testing.assert_allclose(pinhole.project(point), [x, y], atol=1e-8)
    inside = pinhole.virtual_from_cam.apply(point)
    np.testing.assert_allclose(
        4540.0 * inside[:2] / inside[2] + [1690.0, 1357.0], [x, y], atol=1e-8
    )
