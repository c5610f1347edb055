import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from missions.exposure.footprints import pixel_on_floor_m
from missions.exposure.settings import blur_rates, exposure_for_rate
from tests.missions.exposure.surveys import survey
from tests.oracles_imaging import moved_pixel


def test_one_pixel_of_blur_at_the_papers_speeds() -> None:
    """1 px needs 0.88 ms at 0.5 m/s and 2.2 ms at 0.2 m/s (0.444 mm pixels)."""
    pixel_m = 2.0 / 1.33 / (12.5 / 3.69e-3)
    assert exposure_for_rate(1.0, 0.2 / pixel_m) == pytest.approx(2.2e-3, abs=2e-5)
    assert exposure_for_rate(1.0, 0.5 / pixel_m) == pytest.approx(0.88e-3, abs=1e-5)


def test_speed_alone_blurs_by_speed_over_pixel_at_the_centre() -> None:
    rig, config = survey(plan={"yaw_rate_deg_s": 0, "roll_pitch_rate_deg_s": 0})
    rates = blur_rates(rig, config.plan, 2.0)
    assert rates.speed == pytest.approx(0.2 / pixel_on_floor_m(rig.cameras["left"], 2.0), rel=1e-6)
    assert rates.yaw == rates.roll_pitch == 0.0
    assert rates.combined == rates.speed_worst == pytest.approx(rates.worst, rel=1e-12)
    # The port magnifies towards the corners.
    assert 1.1 < rates.speed_worst / rates.speed < 1.4


def test_yaw_blurs_the_corner_by_its_radius_and_the_cameras_arm() -> None:
    rig, config = survey(plan={"roll_pitch_rate_deg_s": 0, "yaw_rate_deg_s": 2.0})
    rates = blur_rates(rig, config.plan, 2.0)
    radius_px = np.hypot(3384, 2710) / 2
    about_axis = np.deg2rad(2.0) * radius_px
    x, y = config.camera.position_body_m[:2]
    arm = np.deg2rad(2.0) * np.hypot(x, y) / pixel_on_floor_m(rig.cameras["left"], 2.0)
    assert about_axis < rates.yaw < about_axis + 1.3 * arm


def test_roll_and_pitch_blur_the_centre_through_the_waters_index() -> None:
    rig, config = survey(ideal_port=True, plan={"roll_pitch_rate_deg_s": 2.0})
    rates = blur_rates(rig, config.plan, 2.0)
    # A turn by one radian moves the floor by f n px behind an ideal port, and by the arm.
    once = np.deg2rad(2.0) * 12.5e3 / 3.69 * 1.34 * (2.0 + config.camera.position_body_m[2]) / 2.0
    assert rates.roll_pitch == pytest.approx(np.sqrt(2) * once, rel=0.01)


@settings(max_examples=25, deadline=None)
@given(
    speed=st.floats(0.05, 1.0), yaw=st.floats(0, 10), roll=st.floats(0, 10), height=st.floats(1, 5)
)
def test_motion_agrees_with_pixels_before_and_after(
    speed: float, yaw: float, roll: float, height: float
) -> None:
    rig, config = survey(
        plan={"speed_mps": speed, "yaw_rate_deg_s": yaw, "roll_pitch_rate_deg_s": roll}
    )
    rates = blur_rates(rig, config.plan, height)
    camera = rig.cameras["left"]
    pixels = np.array([[0.0, 0.0], [3384.0, 2710.0], [0.0, 2710.0], [1692.0, 1355.0]])
    spots = camera.at_depth(pixels, camera.front_cam[2] + height)
    turn = np.deg2rad([roll, roll, yaw])
    short = 1e-4
    signs = [(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]
    moves = [
        np.linalg.norm(
            moved_pixel(rig, spot, np.array([speed, 0, 0]), turn * sign, short)
            - moved_pixel(rig, spot, np.array([speed, 0, 0]), turn * sign, -short)
        )
        / (2 * short)
        for spot in rig.body_from_cam("left").apply(spots)
        for sign in signs
    ]
    assert max(moves) <= rates.worst * (1 + 1e-3)
    assert max(moves) >= rates.worst * 0.97
    assert rates.speed_worst <= rates.combined <= rates.worst * (1 + 1e-12)


@given(allowed=st.floats(0.2, 5), rate=st.floats(10, 5000))
def test_the_exposure_is_the_longest_that_blurs_no_more(allowed: float, rate: float) -> None:
    exposure_s = exposure_for_rate(allowed, rate)
    assert exposure_s * rate <= allowed + 1e-6 * 1e-5 * rate + 1e-9 * rate
    assert (exposure_s + 1.01e-5) * rate >= allowed
