import math
from dataclasses import replace

import numpy as np
import pytest

from alice_survey.core.config import CameraConfig
from alice_survey.core.errors import ConfigError
from alice_survey.core.seawater import n_water as n_of
from camera_calib.fov.paper import (
    ANGLES_DEG,
    PaperCheck,
    PaperValidation,
    angle_table,
    validate_paper,
)
from camera_calib.fov.table import fov_table

PORT = CameraConfig()
NO_PORT = CameraConfig(port_distance_m=0.0, glass_thickness_m=0.0)


@pytest.fixture(scope="module")
def validation() -> PaperValidation:
    return validate_paper()


def test_all_six_values_of_the_papers_table_pass(validation: PaperValidation) -> None:
    computed = {(c.lens_mm, c.quantity): c.computed for c in validation.table}
    assert computed == pytest.approx(
        {
            (12.5, "horizontal"): 1.4268,
            (12.5, "vertical"): 1.1632,
            (12.5, "pixel"): 0.4439,
            (25.0, "horizontal"): 0.7411,
            (25.0, "vertical"): 0.5963,
            (25.0, "pixel"): 0.2220,
        },
        abs=5e-5,
    )
    assert [c.paper for c in validation.table] == ["1.4", "1.16", "0.45", "0.75", "0.6", "0.22"]
    assert all(c.passed for c in validation.table) and validation.passed


@pytest.mark.parametrize(
    ("printed", "tolerance", "passed"),
    [("1.2", 0.1, True), ("1.16", 0.01, True), ("1.18", 0.01, False), ("3", 1.0, False)],
)
def test_a_value_passes_within_one_unit_of_the_last_digit(
    printed: str, tolerance: float, passed: bool, validation: PaperValidation
) -> None:
    check = PaperCheck(lens_mm=12.5, quantity="vertical", unit="m", computed=1.1632, paper=printed)
    assert check.tolerance == pytest.approx(tolerance)
    assert check.difference == pytest.approx(1.1632 - float(printed))
    assert check.passed is passed
    assert replace(validation, table=(check,)).passed is passed


def test_claims_depend_on_water_and_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """A limit of 60 degrees, a focus behind thick water and exact matching do not hold."""
    monkeypatch.setattr("camera_calib.fov.paper.TRUSTED_FOV_DEG", 60.0)
    monkeypatch.setattr("camera_calib.fov.paper._N_PAPER", 1.10)
    monkeypatch.setattr("camera_calib.fov.paper.MATCH_SIGMA_PX", 0.01)
    found = validate_paper()
    assert not found.passed
    failed = {c.claim for c in found.claims if not c.passed}
    assert failed == {
        "lenses of up to 60 deg: the 12.5 mm lens",
        "a flat port up to 60 deg avoids distortion",
        "focused at 2 m in water, 1.5 m in air",
        "F/4 gives a depth of field of 2 m at 2 m",
    }


def test_numbers_of_the_claims(validation: PaperValidation) -> None:
    computed = [claim.computed for claim in validation.claims]
    expected = [65.23, 35.48, 0.061, 1.504, 1.519, 1.95, 2.02]
    assert computed == pytest.approx(expected, abs=0.006)


def test_the_circle_of_confusion_that_gives_2_m() -> None:
    """10.86 um, the diagonal/1474, by the classical formula of the depth of field too."""
    coc_px = 10.86 / 3.69
    row = fov_table([12.5], [2.0], 1.33, NO_PORT, coc_px)[0]
    assert row.depth_of_field_m == pytest.approx(2.0, abs=0.003)
    sharp = fov_table([12.5], [2.0], 1.33, NO_PORT)[0]  # one pixel gives a quarter
    assert sharp.depth_of_field_m == pytest.approx(0.57, abs=0.005)

    f, s, c = 12.5e-3, 2.0 / 1.33, 10.86e-6
    hyperfocal = f * f / (4.0 * c) + f
    near = s * (hyperfocal - f) / (hyperfocal + s - 2 * f)
    far = s * (hyperfocal - f) / (hyperfocal - s)
    assert row.depth_of_field_m == pytest.approx(1.33 * (far - near), abs=1e-6)


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
    reach = math.tan(math.asin(math.sin(half) / float(n_of(20.0, 35.0, 0.0))))

    def radius(wavelength_nm: float) -> float:
        n = float(n_of(20.0, 35.0, 0.0, wavelength_nm))
        angle = math.asin(n * math.sin(math.atan(reach)))
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


def test_impossible_angles_are_refused() -> None:
    with pytest.raises(ConfigError, match="angle 180"):
        angle_table(PORT, 1.34, angles_deg=[180.0])
