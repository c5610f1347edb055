import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from alice_survey.config import CameraConfig, PlanConfig, WaterConfig
from alice_survey.errors import PlanError
from camera_calib.flat_port import FlatPortCamera
from camera_calib.rig import design_rig
from missions.footprint import footprint_size_m
from missions.imaging.settings import exposure_for_blur, imaging_settings, paper_rule, raw_bytes


def camera(n_water: float = 1.34, port: bool = True) -> FlatPortCamera:
    config = CameraConfig() if port else CameraConfig(port_distance_m=0, glass_thickness_m=0)
    return design_rig(config, WaterConfig(n_water=n_water)).cameras["left"]


def test_one_pixel_of_blur_at_the_papers_speeds() -> None:
    """1 px needs 0.88 ms at 0.5 m/s and 2.2 ms at 0.2 m/s (0.444 mm pixels)."""
    pixel_m = 2.0 / 1.33 / (12.5 / 3.69e-3)
    assert exposure_for_blur(1.0, 0.2, pixel_m) == pytest.approx(2.2e-3, abs=2e-5)
    assert exposure_for_blur(1.0, 0.5, pixel_m) == pytest.approx(0.88e-3, abs=1e-5)
    # The paper's 3 ms blurs 3.4 px at 0.5 m/s, not none.
    assert 0.5 * 3e-3 / pixel_m == pytest.approx(3.4, abs=0.05)


def test_the_papers_rule_gives_31_percent_not_60() -> None:
    along_m = footprint_size_m(camera(1.33, port=False), 2.0)[1]
    rule = paper_rule(0.2, 2.0, 0.6, footprint_along_m=along_m)

    assert rule.rate_hz == pytest.approx(0.25)
    assert rule.wanted_forward_overlap == 0.6
    assert rule.forward_overlap == pytest.approx(0.31, abs=0.005)


def test_settings_of_the_papers_mission() -> None:
    settings = imaging_settings(camera(), CameraConfig(), PlanConfig())

    assert settings.footprint_across_m == pytest.approx(1.441, abs=1e-3)
    assert settings.footprint_along_m == pytest.approx(1.175, abs=1e-3)
    assert settings.pixel_m == pytest.approx(0.448e-3, abs=1e-6)
    assert settings.exposure_s == pytest.approx(2.24e-3)
    assert 1 / settings.interval_s == pytest.approx(0.43, abs=0.005)
    assert settings.forward_overlap == pytest.approx(0.6, abs=1e-3)
    assert settings.strobe_pulse_s == pytest.approx(2.24e-3 + 2 * 0.2e-3)
    assert settings.paper_rule.forward_overlap == pytest.approx(0.319, abs=1e-3)


@given(
    altitude_m=st.floats(0.5, 8),
    speed_mps=st.floats(0.05, 1.0),
    forward=st.floats(0, 0.9),
    blur_px=st.floats(0.2, 5),
)
def test_what_was_asked_for_is_reached(
    altitude_m: float, speed_mps: float, forward: float, blur_px: float
) -> None:
    plan = PlanConfig(
        altitude_m=altitude_m,
        speed_mps=speed_mps,
        forward_overlap=forward,
        allowed_blur_px=blur_px,
    )
    settings = imaging_settings(camera(), CameraConfig(shortest_interval_s=0.01), plan)

    # Rounding down to a millisecond of interval costs at most that much overlap.
    finest = speed_mps * 1e-3 / settings.footprint_along_m
    assert -1e-8 <= settings.forward_overlap - forward <= finest + 1e-8
    assert settings.station_spacing_m == pytest.approx(settings.interval_s * speed_mps, abs=1e-8)
    assert settings.blur_px <= blur_px + 1e-6
    assert settings.blur_px >= blur_px - speed_mps * 1e-5 / settings.pixel_m - 1e-6
    assert 0 < settings.strobe_duty < 1


def test_a_camera_that_is_too_slow_is_told_with_the_numbers() -> None:
    with pytest.raises(PlanError) as fault:
        imaging_settings(camera(), CameraConfig(), PlanConfig(forward_overlap=0.95, speed_mps=1.0))
    text = str(fault.value)
    assert "95% forward overlap at 1 m/s" in text
    assert "0.058 s" in text
    assert "0.1 s" in text
    assert "\n" not in text


def test_a_strobe_pulse_that_does_not_fit_is_told() -> None:
    plan = PlanConfig(speed_mps=1.0, forward_overlap=0.9, strobe_lead_s=0.1)
    with pytest.raises(PlanError, match=r"strobe pulse of 0\.2004 s"):
        imaging_settings(camera(), CameraConfig(), plan)


def test_storage_counts_every_pixel() -> None:
    assert raw_bytes(camera(), 2, 603) == 3384 * 2710 * 2 * 603


def test_blur_falls_with_altitude() -> None:
    low = imaging_settings(camera(), CameraConfig(), PlanConfig(altitude_m=1.0))
    high = imaging_settings(camera(), CameraConfig(), PlanConfig(altitude_m=3.0))
    assert high.exposure_s > low.exposure_s
    assert math.isclose(low.blur_px, 1.0, abs_tol=0.02)
