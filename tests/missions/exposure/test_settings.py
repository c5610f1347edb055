import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alice_survey.core.errors import PlanError
from missions.exposure.footprints import pixel_on_floor_m
from missions.exposure.settings import blur_rates, exposure_for_rate, imaging_settings
from missions.values.footprint import footprint_size_m
from tests.missions.exposure.surveys import conflict_of, survey
from tests.oracles_imaging import moved_pixel


def test_settings_of_the_papers_mission() -> None:
    planned = imaging_settings(*survey(plan={"line_spacing_m": 1.0}))

    assert planned.footprint_across_m == pytest.approx(1.398, abs=1e-3)
    assert planned.footprint_along_m == pytest.approx(1.119, abs=1e-3)
    assert planned.pixel_m == pytest.approx(0.448e-3, abs=1e-6)
    assert planned.line_spacing_m == 1.0
    assert planned.spacing.mean_overlap == pytest.approx(0.2845, abs=1e-3)
    assert 1 / planned.interval_s == pytest.approx(0.447, abs=0.003)
    assert planned.forward_overlap == pytest.approx(0.6, abs=1e-3)
    assert planned.strobe_pulse_s == pytest.approx(planned.exposure_s + 2 * 0.2e-3)
    assert planned.focus.focus_mean_air_m == pytest.approx(1.52, abs=0.005)
    # Speed alone allows 2.24 ms at the centre; the corners and the attitude rates take their share.
    assert 1.5e-3 < planned.exposure_s < 2.24e-3
    still = survey(plan={"yaw_rate_deg_s": 0, "roll_pitch_rate_deg_s": 0})
    by_speed = imaging_settings(*still)
    assert planned.exposure_s < by_speed.exposure_s < 2.24e-3


@settings(max_examples=60, deadline=None)
@given(plan=st.fixed_dictionaries({
    "altitude_m": st.floats(1.0, 8), "speed_mps": st.floats(0.05, 1.0),
    "forward_overlap": st.floats(0, 0.9), "allowed_blur_px": st.floats(0.2, 5),
}))  # fmt: skip
def test_what_was_requested_is_reached(plan: dict[str, float]) -> None:
    rig, config = survey(camera={"shortest_interval_s": 0.01}, plan={"relief_m": 0.1, **plan})
    planned = imaging_settings(rig, config)
    speed_mps, blur_px = plan["speed_mps"], plan["allowed_blur_px"]

    # Rounding down to a millisecond of interval costs at most that much overlap.
    finest = speed_mps * 1e-3 / planned.footprint_along_m
    assert -1e-8 <= planned.forward_overlap - plan["forward_overlap"] <= finest + 1e-8
    assert planned.station_spacing_m == pytest.approx(planned.interval_s * speed_mps, abs=1e-8)
    assert planned.blur_px <= blur_px + 1e-6
    assert planned.blur_px >= blur_px - planned.blur.combined * 1e-5 - 1e-6
    assert 0 < planned.strobe_duty < 1
    assert planned.imaging_w == pytest.approx(planned.strobe.frame_j / planned.interval_s)


def test_an_exposure_too_short_is_refused() -> None:
    with pytest.raises(PlanError, match=r"allowed_blur_px 0\.001"):
        imaging_settings(*survey(plan={"allowed_blur_px": 0.001}))


@pytest.mark.parametrize(
    ("sections", "named"),
    [
        ({"plan": {"altitude_m": 1.2}}, "camera.f_number"),
        ({"plan": {"altitude_m": 1.2}}, "0.85 m"),
        ({"water": {"jerlov": "9C"}}, "allowed_blur_px"),
        ({"plan": {"line_spacing_m": 1.4}}, "0.24 m"),
        ({"plan": {"forward_overlap": 0.0}}, "0.19 m"),
        ({"plan": {"forward_overlap": 0.9, "speed_mps": 1.0}}, "cable"),
    ],
)
def test_what_will_be_poor_is_warned_of(
    sections: dict[str, Any], named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    imaging_settings(*survey(**sections), quiet=True)
    imaging_settings(*survey(plan={"line_spacing_m": 1.0}))  # the paper's mission
    assert capsys.readouterr().err == ""
    imaging_settings(*survey(**sections))
    assert named in capsys.readouterr().err


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
    short, velocity = 1e-4, np.array([speed, 0, 0])
    moves = []
    for spot in rig.body_from_cam("left").apply(spots):
        for sign in itertools.product((-1, 1), repeat=3):
            two = (moved_pixel(rig, spot, velocity, turn * sign, t) for t in (short, -short))
            moves.append(np.linalg.norm(np.subtract(*two)) / (2 * short))
    assert max(moves) <= rates.worst * (1 + 1e-3)
    assert max(moves) >= rates.worst * 0.97
    assert rates.speed_worst <= rates.combined <= rates.worst * (1 + 1e-12)


@given(allowed=st.floats(0.2, 5), rate=st.floats(10, 5000))
def test_the_exposure_is_the_longest_that_blurs_no_more(allowed: float, rate: float) -> None:
    exposure_s = exposure_for_rate(allowed, rate)
    assert exposure_s * rate <= allowed + 1e-6 * 1e-5 * rate + 1e-9 * rate
    assert (exposure_s + 1.01e-5) * rate >= allowed


def test_a_camera_that_is_too_slow_suggests_the_speed_that_just_fits() -> None:
    rig, config = survey(plan={"forward_overlap": 0.92, "speed_mps": 1.32})
    error = conflict_of(imaging_settings, rig, config)
    along_m = footprint_size_m(rig.cameras["left"], 2.0)[1]
    assert f"{1.32 / (0.08 * along_m):.3g} " in str(error)  # 14 fps
    name, speed_mps = error.suggestion
    assert name == "plan.speed_mps"
    slower = survey(plan={"forward_overlap": 0.92, "speed_mps": speed_mps})
    # The tenth of a second is used up.
    assert 0.1 <= imaging_settings(*slower).interval_s <= 0.1015
