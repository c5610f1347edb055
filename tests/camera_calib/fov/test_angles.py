import math

import numpy as np
import pytest

from alice_survey.core.config import CameraConfig
from alice_survey.core.errors import ConfigError
from alice_survey.core.seawater import n_water as n_of
from camera_calib.fov.angles import ANGLES_DEG, angle_table

PORT = CameraConfig()
NO_PORT = CameraConfig(port_distance_m=0.0, glass_thickness_m=0.0)


def test_without_a_port_distance_the_camera_is_a_pinhole_with_known_distortion() -> None:
    for row in angle_table(NO_PORT, 1.33):
        half = math.radians(row.fov_air_deg / 2)
        in_water = math.asin(math.sin(half) / 1.33)
        assert row.fov_water_deg == pytest.approx(2 * math.degrees(in_water))
        swell = math.tan(half) / (1.33 * math.tan(in_water))
        assert row.displacement_percent == pytest.approx(100 * (swell - 1))
        radius_px = math.hypot(3384, 2710) / 2
        assert row.displacement_px == pytest.approx(radius_px * (1 - 1 / swell))
        assert row.viewpoint_shift_mm == pytest.approx(0.0, abs=1e-9)
        assert row.residual_max_px < 1e-6


def test_the_corner_s_colours_part_as_the_sines_say() -> None:
    row = angle_table(NO_PORT, float(n_of(20.0, 35.0, 0.0)), angles_deg=[70.0])[0]
    half = math.radians(35.0)
    radius_px = math.hypot(3384, 2710) / 2
    spot = math.tan(math.asin(math.sin(half) / float(n_of(20.0, 35.0, 0.0))))

    def radius(wavelength_nm: float) -> float:
        n = float(n_of(20.0, 35.0, 0.0, wavelength_nm))
        angle = math.asin(n * math.sin(math.atan(spot)))
        return radius_px * math.tan(angle) / math.tan(half)

    assert row.chromatic_px == pytest.approx(radius(460.0) - radius(600.0), rel=1e-9)
    assert angle_table(NO_PORT, 1.0, angles_deg=[70.0])[0].chromatic_px == 0.0


def test_corner_rays_leave_the_common_centre_behind_a_port() -> None:
    """By the sines: where a corner's ray, straight on from the water, crosses the axis."""
    n_glass, n_water, d, g = 1.52, 1.34, 0.02, 0.01
    for row in angle_table(PORT, n_water):
        sine = math.sin(math.radians(row.fov_air_deg / 2))
        glass, water = math.asin(sine / n_glass), math.asin(sine / n_water)
        out = d * math.tan(math.asin(sine)) + g * math.tan(glass)
        corner = d + g - out / math.tan(water)
        centre = d + g - n_water * (d + g / n_glass)
        assert row.viewpoint_shift_mm == pytest.approx((corner - centre) * 1e3, rel=1e-9)


def test_all_grows_smoothly_through_70_degrees() -> None:
    rows = angle_table(PORT, 1.34)
    assert tuple(row.fov_air_deg for row in rows) == ANGLES_DEG
    for name in ("displacement_px", "residual_rms_px", "residual_max_px", "chromatic_px"):
        values = np.array([getattr(row, name) for row in rows])
        growth = values[1:] / values[:-1]
        assert np.all(growth > 1.0)
        assert np.all(growth < 2.0)
    at_70 = next(row for row in rows if row.fov_air_deg == 70.0)
    assert at_70.residual_rms_px == pytest.approx(0.061, abs=0.003)
    assert at_70.displacement_percent == pytest.approx(10.2, abs=0.1)


def test_a_port_farther_off_leaves_more() -> None:
    near = angle_table(PORT, 1.34, angles_deg=[70.0])[0]
    far = angle_table(
        PORT.model_copy(update={"port_distance_m": 0.1, "glass_thickness_m": 0.02}),
        1.34,
        angles_deg=[70.0],
    )[0]
    assert far.residual_rms_px > 3 * near.residual_rms_px


def test_ten_percent_of_distortion_comes_at_70_degrees() -> None:
    (row,) = angle_table(NO_PORT, 1.33, angles_deg=[69.6])
    assert row.displacement_percent == pytest.approx(10.0, abs=0.02)


def test_impossible_angles_are_refused() -> None:
    with pytest.raises(ConfigError, match="angle 180"):
        angle_table(PORT, 1.34, angles_deg=[180.0])
