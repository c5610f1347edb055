import json
import math
import re

import pytest

from alice_survey.base.config import SurveyConfig, parse_config
from alice_survey.base.errors import ConfigError, PlanError
from camera_calib.rig import design_rig
from missions.exposure.settings import imaging_settings
from missions.exposure.solve import (
    area_for_dive,
    lenses_for_resolution,
    solve_report,
    speeds_for_rate,
    turn_s,
)
from missions.plan.planner import plan_survey
from missions.plan.strength import endurance_s
from missions.values.costs import SETTLE_S
from missions.values.footprint import footprint_size_m
from tests.missions.exposure.surveys import survey

DEPTH_M = SurveyConfig().area.seafloor_depth_m


def test_a_resolution_gives_the_altitude_whose_pixel_it_is() -> None:
    _, config = survey(plan={"side_overlap": 0.45})
    best, other = lenses_for_resolution(config, DEPTH_M, 0.448, (25.0, 12.5))
    assert best.lens_mm == 12.5
    assert best.fits
    assert best.altitude_m == pytest.approx(2.0, abs=0.005)
    rig, planned = survey(plan={"side_overlap": 0.45, "altitude_m": best.altitude_m})
    settings = imaging_settings(rig, planned)
    assert settings.pixel_m * 1e3 <= 0.448
    assert best.spacing_m == pytest.approx(settings.line_spacing_m)
    assert best.exposure_ms == pytest.approx(settings.exposure_s * 1e3)
    # The longer lens flies twice as high and is in the dark.
    assert other.altitude_m == pytest.approx(4.03, abs=0.05)
    assert not other.fits


def test_a_dive_at_a_resolution_is_solved_at_its_altitude() -> None:
    _, config = survey()
    data = solve_report(config, DEPTH_M, resolution_mm=0.33, dive_s=1800.0)[1]
    best = data["lenses"][0]
    assert data["dive"]["line_spacing_m"] == pytest.approx(best["spacing_m"])
    _, lower = survey(
        plan={"altitude_m": best["altitude_m"]},
        camera={"focal_mm": best["lens_mm"], "f_number": best["f_number"]},
    )
    assert data["dive"]["area_m2"] == pytest.approx(area_for_dive(lower, DEPTH_M, 1800.0).area_m2)
    assert data["dive"]["area_m2"] < 0.9 * area_for_dive(config, DEPTH_M, 1800.0).area_m2


def test_ways_out_of_a_resolution_that_is_too_fine_work() -> None:
    _, config = survey()
    with pytest.raises(PlanError) as fault:
        lenses_for_resolution(config, DEPTH_M, 0.22, (12.5, 25.0))
    text = str(fault.value)
    assert 2 <= len(text.splitlines()) <= 4
    finer = float(re.search(r"resolution ([\d.]+) mm with the 12.5", text)[1])
    assert lenses_for_resolution(config, DEPTH_M, finer + 5e-4, (12.5,))[0].fits
    blur = float(re.search(r"allowed_blur_px ([\d.]+)", text)[1])
    _, blurred = survey(plan={"allowed_blur_px": blur})
    assert lenses_for_resolution(blurred, DEPTH_M, 0.22, (25.0,))[0].snr == pytest.approx(
        5.0, abs=0.05
    )


@pytest.mark.parametrize("resolution_mm", [0.001, 0.05, 5.0])
def test_resolutions_beyond_all_lenses_are_refused(resolution_mm: float) -> None:
    """Pixels of 0.001 mm put the altitude behind the glass: no lens has a negative length."""
    _, config = survey()
    with pytest.raises(PlanError) as fault:
        lenses_for_resolution(config, DEPTH_M, resolution_mm, (12.5, 25.0))
    text = str(fault.value)
    assert bool(re.search(r"- a lens .* mm", text)) == (resolution_mm > 0.001)
    assert len(text.splitlines()) <= 4


@pytest.mark.parametrize("dive_s", [600.0, 3600.0, 20_000.0])
def test_the_area_of_a_dive_takes_the_dive(dive_s: float) -> None:
    _, config = survey(plan={"side_overlap": 0.45})
    area = area_for_dive(config, DEPTH_M, dive_s)
    assert area.area_m2 == pytest.approx(area.side_m**2)
    assert area.lines == math.ceil(area.side_m / area.line_spacing_m)
    lines = area.lines + area.cross_lines
    flown = (lines + 1) * area.side_m / 0.2 + (lines - 1) * area.turn_s + 2 * 13.0 / 0.15
    assert flown <= dive_s + 1e-6
    # A line more does not fit: the next area that is longer than the dive is near.
    assert flown + area.side_m / 0.2 + area.turn_s > dive_s - 1.0


def test_turns_are_half_circles_where_lines_are_wide_apart() -> None:
    _, config = survey(plan={"turns": "arcs"})
    assert turn_s(config.plan, 1.0) == pytest.approx((math.pi * 0.5 + 0.5) / 0.2)
    # Dubins' three arcs join half circles where lines are two radii apart, and 7/3 pi R at none.
    assert turn_s(config.plan, 1.0 - 1e-9) == pytest.approx(turn_s(config.plan, 1.0), abs=1e-3)
    assert turn_s(config.plan, 0.0) == pytest.approx((7 / 3 * math.pi * 0.5 + 0.5) / 0.2)
    _, spot = survey(plan={"turns": "spot"})
    # Two right angles at 15 deg/s, and the time of each stop.
    assert turn_s(spot.plan, 1.0) == pytest.approx(2 * (6.0 + SETTLE_S) + 1.0 / 0.2 + 0.5 / 0.2)
    _, auto = survey()
    assert turn_s(auto.plan, 1.0) == min(turn_s(config.plan, 1.0), turn_s(spot.plan, 1.0))


def test_a_dive_that_is_too_short_is_refused() -> None:
    with pytest.raises(PlanError, match="173 s"):
        area_for_dive(survey()[1], DEPTH_M, 150.0)


def test_a_fixed_rate_gives_the_speed_that_overlaps_as_requested() -> None:
    rig, config = survey()
    option = speeds_for_rate(config, 0.25, (12.5,))[0]
    along_m = footprint_size_m(rig.cameras["left"], 2.0)[1]
    assert option.speed_mps == pytest.approx(0.25 * along_m * 0.4, abs=1e-4)
    # At the paper's 0.2 m/s its 0.25 Hz overlap by 31 to 32 %.
    assert option.forward_overlap == pytest.approx(1 - 0.8 / along_m)
    moved = survey(plan={"speed_mps": option.speed_mps})
    assert imaging_settings(*moved).interval_s == pytest.approx(4.0, abs=0.005)


def test_a_rate_beyond_the_trigger_is_refused() -> None:
    with pytest.raises(PlanError, match=r"camera\.shortest_interval_s"):
        speeds_for_rate(survey()[1], 14.0, (12.5,))


def test_the_planner_takes_about_as_long_for_the_area_of_a_dive() -> None:
    config = survey(plan={"side_overlap": 0.45})[1]
    side_m = area_for_dive(config, DEPTH_M, 3600.0).side_m
    square = SurveyConfig.model_validate(
        {
            "plan": {"side_overlap": 0.45, "closing_line": False},
            "area": {"length_m": side_m, "width_m": side_m},
        }
    )
    rig = design_rig(square.camera, square.water)
    assert plan_survey(square, rig).plan.duration_s == pytest.approx(3600.0, rel=0.05)


def test_the_report_has_a_part_for_each_question() -> None:
    _, config = survey(plan={"side_overlap": 0.45})
    data = solve_report(config, DEPTH_M, resolution_mm=0.5, dive_s=3600, rate_hz=0.25)[1]
    assert set(data) == {"lenses", "dive", "rates"}
    json.dumps(data, allow_nan=False)
    with pytest.raises(ConfigError):
        solve_report(config, DEPTH_M)


def test_no_dive_is_longer_than_the_battery_lasts() -> None:
    _, config = survey()
    short = solve_report(config, DEPTH_M, dive_s=1800.0)[1]["dive"]
    text, data = solve_report(config, DEPTH_M, dive_s=1e5, battery_s=1800.0)
    assert data["dive"] == short
    assert "the battery lasts 1800 s of the 100000 s" in text
    ample = solve_report(config, DEPTH_M, dive_s=1800.0, battery_s=1e5)
    assert ample[1]["dive"] == short and "battery" not in ample[0]


def test_a_battery_lasts_as_its_power_says() -> None:
    """1,400 Wh of which a fifth is kept, at 60 W and what the thrusters take in still water."""
    still = {"sea": {"current_mps": 0.0}}
    lasts_s = endurance_s(parse_config(still, "test"))
    assert 0.5 * 1120 / 60 < lasts_s / 3600 < 1120 / 60
    double = endurance_s(parse_config({**still, "vehicle": {"battery_wh": 2800.0}}, "test"))
    assert double == pytest.approx(2.0 * lasts_s)
