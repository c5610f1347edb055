import json
import math
import re
from typing import Any

import pytest

from alice_survey.core.config import SurveyConfig, parse_config
from alice_survey.core.errors import ConfigError, PlanError
from camera_calib.rig import design_rig
from missions.exposure.settings import ImagingSetup
from missions.plan.planner import plan_survey
from missions.plan.solve import (
    area_for_dive,
    lenses_for_resolution,
    overlap_at_rate,
    solve_report,
    speeds_for_rate,
    turn_s,
)
from missions.values.costs import SETTLE_S
from missions.values.footprint import footprint_size_m

DEPTH_M = SurveyConfig().area.seafloor_depth_m


def survey(**sections: Any) -> SurveyConfig:
    return parse_config(sections, "survey")


def test_a_dive_at_a_resolution_is_solved_at_its_altitude() -> None:
    config = survey()
    data = solve_report(config, resolution_mm=0.33, dive_s=1800.0)[1]
    best = data["lenses"][0]
    assert data["dive"]["line_spacing_m"] == pytest.approx(best["spacing_m"])
    lower = survey(
        plan={"altitude_m": best["altitude_m"]},
        camera={"focal_mm": best["lens_mm"], "f_number": best["f_number"]},
    )
    assert data["dive"]["area_m2"] == pytest.approx(area_for_dive(lower, 1800.0).area_m2)
    assert data["dive"]["area_m2"] < 0.9 * area_for_dive(config, 1800.0).area_m2


@pytest.mark.parametrize("dive_s", [600.0, 3600.0, 20_000.0])
def test_the_area_of_a_dive_takes_the_dive(dive_s: float) -> None:
    config = survey(plan={"side_overlap": 0.45})
    area = area_for_dive(config, dive_s)
    assert area.area_m2 == pytest.approx(area.side_m**2)
    assert area.lines == math.ceil(area.side_m / area.line_spacing_m)
    lines = area.lines + area.cross_lines
    flown = (lines + 1) * area.side_m / 0.2 + (lines - 1) * area.turn_s + 2 * 13.0 / 0.15
    assert flown <= dive_s + 1e-6
    # A line more does not fit: the next area that is longer than the dive is near.
    assert flown + area.side_m / 0.2 + area.turn_s > dive_s - 1.0


def test_turns_are_half_circles_where_lines_are_wide_apart() -> None:
    config = survey(plan={"turns": "arcs"})
    assert turn_s(config.plan, 1.0) == pytest.approx((math.pi * 0.5 + 0.5) / 0.2)
    # Dubins' three arcs join half circles where lines are two radii apart, and 7/3 pi R at none.
    assert turn_s(config.plan, 1.0 - 1e-9) == pytest.approx(turn_s(config.plan, 1.0), abs=1e-3)
    assert turn_s(config.plan, 0.0) == pytest.approx((7 / 3 * math.pi * 0.5 + 0.5) / 0.2)
    spot = survey(plan={"turns": "spot"})
    # Two right angles at 15 deg/s, and the time of each stop.
    assert turn_s(spot.plan, 1.0) == pytest.approx(2 * (6.0 + SETTLE_S) + 1.0 / 0.2 + 0.5 / 0.2)
    auto = survey()
    assert turn_s(auto.plan, 1.0) == min(turn_s(config.plan, 1.0), turn_s(spot.plan, 1.0))


def test_a_dive_that_is_too_short_is_refused() -> None:
    with pytest.raises(PlanError, match="173 s"):
        area_for_dive(survey(), 150.0)


def test_the_report_has_a_part_for_each_question() -> None:
    config = survey(plan={"side_overlap": 0.45})
    data = solve_report(config, resolution_mm=0.5, dive_s=3600, rate_hz=0.25)[1]
    assert set(data) == {"lenses", "dive", "rates"}
    json.dumps(data, allow_nan=False)
    with pytest.raises(ConfigError):
        solve_report(config)


@pytest.mark.parametrize("battery_wh", [60.0, 140.0])
def test_the_battery_ends_a_dive_as_it_does_for_the_planner(battery_wh: float) -> None:
    config = survey(plan={"side_overlap": 0.45}, vehicle={"battery_wh": battery_wh})
    area = area_for_dive(config, 100_000.0)
    square = survey(
        plan={"side_overlap": 0.45, "closing_line": False},
        area={"length_m": area.side_m, "width_m": area.side_m},
    )

    plan = plan_survey(square, design_rig(square.camera, square.water)).plan

    assert area.usable_wh == pytest.approx(0.8 * battery_wh)
    assert plan.energy_wh == pytest.approx(area.energy_wh, rel=0.1)
    assert plan.duration_s == pytest.approx(area.dive_s, rel=0.1)
    assert area.energy_wh == pytest.approx(area.usable_wh, rel=0.05)


def test_what_ends_a_dive_is_said() -> None:
    text, data = solve_report(survey(), dive_s=1e6)
    assert text.startswith(f"the battery ends a dive after {data['dive']['dive_s']:.0f} of 1e+06 s")
    assert solve_report(survey(), dive_s=3600.0)[0].startswith("a dive of 3600 s holds")
    with pytest.raises(PlanError, match=r"raise vehicle\.battery_wh"):
        area_for_dive(survey(vehicle={"battery_wh": 1.0}), 3600.0)


def test_a_resolution_gives_the_altitude_whose_pixel_it_is() -> None:
    setup = ImagingSetup.of(survey(plan={"side_overlap": 0.45}))
    best, other = lenses_for_resolution(setup, DEPTH_M, 0.448, (25.0, 12.5))
    assert best.values["lens_mm"] == 12.5
    assert best.is_possible
    assert best.values["altitude_m"] == pytest.approx(2.0, abs=0.005)
    assert best.values["pixel_mm"] <= 0.448
    # The longer lens flies twice as high and is in the dark.
    assert other.values["altitude_m"] == pytest.approx(4.03, abs=0.05)
    assert not other.is_possible


@pytest.mark.parametrize("resolution_mm", [0.001, 0.05, 0.22, 2.0, 5.0])
def test_a_resolution_beyond_all_lenses_is_refused_with_the_nearest_that_fits(
    resolution_mm: float,
) -> None:
    setup = ImagingSetup.of(survey())
    with pytest.raises(PlanError) as fault:
        lenses_for_resolution(setup, DEPTH_M, resolution_mm, (12.5, 25.0))
    (text,) = str(fault.value).splitlines()
    fits_mm, lens_mm = map(
        float, re.search(r"; ([\d.]+) mm fits, with the ([\d.]+) mm", text).groups()
    )
    assert lenses_for_resolution(setup, DEPTH_M, fits_mm, (lens_mm,))[0].is_possible


def test_a_fixed_rate_gives_the_speed_that_overlaps_as_requested() -> None:
    setup = ImagingSetup.of(survey())
    option = speeds_for_rate(setup, 0.25, (12.5,))[0]
    along_m = footprint_size_m(setup.rig.cameras["left"], 2.0)[1]
    assert option.values["speed_mps"] == pytest.approx(0.25 * along_m * 0.4, abs=1e-4)
    # At the paper's 0.2 m/s its 0.25 Hz overlap by 31 to 32 %.
    assert overlap_at_rate(option, 0.2, 0.25) == pytest.approx(1 - 0.8 / along_m)
    assert option.values["interval_s"] == pytest.approx(4.0, abs=0.005)


def test_a_rate_beyond_the_trigger_is_refused_with_the_most_that_it_takes() -> None:
    setup = ImagingSetup.of(survey())
    with pytest.raises(PlanError, match="more than the 10 that"):
        speeds_for_rate(setup, 14.0, (12.5,))
    assert math.isfinite(speeds_for_rate(setup, 10.0, (12.5,))[0].values["exposure_ms"])
