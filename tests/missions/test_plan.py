import json
import math
import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from alice_survey.app.stages import spec
from alice_survey.core.artefacts import read_stage
from alice_survey.core.config import SurveyConfig, VehicleConfig, parse_config
from alice_survey.core.errors import PlanError, keep_warnings
from alice_survey.core.executor import SERIAL
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.dynamics import add_damping
from alice_survey.sim.vehicle.pilot.gains import INTEGRAL, LAG, PLACE, RATE, SWAY, gains_for
from camera_calib.rig import design_rig
from missions.coverage.certificate import certificate
from missions.coverage.stations import stations_of_plan
from missions.exports.geometry import footprint_outline, footprints_ne
from missions.fly.simulation import flight_settings
from missions.plan.planner import plan_survey
from missions.plan.strength import swell_offset_m
from missions.route.energy import planned_vehicle
from missions.values.footprint import common_swath
from missions.values.pattern import pattern
from missions.values.plan_file import Plan, read_plan
from tests.missions import flown_plans
from tests.refusals import refused


def survey(**sections: Any) -> SurveyConfig:
    return parse_config(sections, "test")


def planned(**sections: Any) -> Plan:
    return flown_plans.planned(survey(**sections))


SMALL = {"area": {"length_m": 4.6, "width_m": 4.0, "heading_deg": 20.0}}


@pytest.mark.parametrize(("depth_m", "breaks"), [(2.19, True), (2.20, False)])
def test_a_hull_that_breaks_the_surface_is_warned_of(depth_m: float, breaks: bool) -> None:
    """The glass is 0.08 m below the body's centre, and the hull 0.115 m high above it."""
    with keep_warnings() as warnings:
        planned(area={**SMALL["area"], "seafloor_depth_m": depth_m})
    assert any("0.20 m above the glass" in text for text in warnings) == breaks


def test_the_papers_mission() -> None:
    """15 x 17 m, lines 1 m apart, 2 m altitude, 0.2 m/s, 12.5 mm lens."""
    with keep_warnings() as warnings:
        plan = planned(plan={"line_spacing_m": 1.0})

    assert warnings == []
    assert plan.footprint_m == pytest.approx((1.3976, 1.1193), abs=1e-4)
    assert plan.line_spacing_m == 1.0
    assert plan.reached_side_overlap == pytest.approx(0.2845, abs=1e-3)
    assert plan.reached_forward_overlap == pytest.approx(0.600, abs=1e-3)
    assert plan.interval_s == pytest.approx(2.238)
    kinds = Counter(line.kind for line in plan.lines)
    assert kinds == {"survey": 15, "cross": 1, "closing": 1}
    assert plan.stations == sum(line.stations for line in plan.lines)
    # Lines of 17 m with a picture every 0.45 m, one across them, and half of one again.
    assert 15 * 38 + 33 + 18 <= plan.stations <= 15 * 40 + 36 + 21
    assert plan.coverage == pytest.approx(1.0, abs=1e-12)
    # 15 lines of 17 m and 14 half circles of 0.5 m radius take 24 minutes; with the cross line,
    # the closing line, run-ins, ways from home and back, descent and ascent about half an hour.
    assert 27 * 60 < plan.duration_s < 32 * 60
    assert 20 < plan.energy_wh < 60
    rule = next(r for r in plan.details["imaging"]["rows"] if r["name"] == "the paper's rule")
    assert rule["value"] == pytest.approx(0.25) and "29% overlap" in rule["note"]


def test_an_ideal_port_gives_the_known_overlap_of_27_percent() -> None:
    plan = planned(
        camera={"port_distance_m": 0.0, "glass_thickness_m": 0.0}, plan={"line_spacing_m": 1.0}
    )
    assert plan.reached_side_overlap == pytest.approx(0.271, abs=5e-4)


def test_the_length_of_a_plan_in_closed_form() -> None:
    plan = planned(
        area={"length_m": 10.0, "width_m": 3.0},
        plan={
            "line_spacing_m": 1.0, "cross_lines": 0, "closing_line": False, "turns": "arcs",
            "line_heading_deg": 0.0,
        },
    )  # fmt: skip
    count = len(plan.lines)
    line_m = plan.lines[0].length_m
    legs = plan.dives[0].route.legs
    first, last = (next(i for i, leg in enumerate(legs) if leg.line == n) for n in (0, count - 1))

    assert count == 3
    assert all(line.length_m == pytest.approx(line_m) for line in plan.lines)
    # Half circles of 0.5 m radius between lines 1 m apart, half a metre of run at each end.
    expected = count * line_m + (count - 1) * (math.pi * 0.5 + 2 * 0.5)
    assert sum(leg.length_m for leg in legs[first : last + 1]) == pytest.approx(expected, abs=1e-6)
    assert plan.length_m == pytest.approx(sum(leg.length_m for leg in legs))
    # At the surface are home and the ends of the dive: descent and ascent take time on top.
    assert plan.duration_s > plan.length_m / 0.2


@pytest.mark.parametrize("wanted", [0.1, 0.29, 0.45, 0.6])
def test_a_requested_overlap_is_reached_on_real_footprints(wanted: float) -> None:
    config = survey(area={"length_m": 12.0, "width_m": 8.0}, plan={"side_overlap": wanted})
    rig = design_rig(config.camera, config.water)
    plan = plan_survey(config, rig).plan
    first, second = plan.lines[:2]
    outline = footprint_outline(plan, rig)
    one = footprints_ne(first, outline)[3]
    two = footprints_ne(second, outline)[-4]

    # The rectangles between the corners of both pictures: how much of one is seen twice?
    across = np.array([-math.sin(first.heading_rad), math.cos(first.heading_rad)])
    one_m, two_m = (shape[:: len(shape) // 4][:4] @ across for shape in (one, two))
    shared = min(one_m.max(), two_m.max()) - max(one_m.min(), two_m.min())
    measured = shared / (one_m.max() - one_m.min())

    assert plan.reached_side_overlap == pytest.approx(measured, abs=1e-6)
    # 10 % of one camera's pictures would leave gaps in stereo.
    assert plan.reached_side_overlap == pytest.approx(max(wanted, 0.117), abs=2e-4)


def test_a_line_spacing_that_is_too_wide_is_kept_and_warned_of() -> None:
    with keep_warnings() as warnings:
        plan = planned(area=SMALL["area"], plan={"line_spacing_m": 1.3, "side_overlap": 0.45})

    assert plan.line_spacing_m == 1.3
    both = next(text for text in warnings if "side_overlap" in text)
    assert "7.0%" in both and "0.769 m" in both
    assert plan.coverage < 0.999


def test_a_margin_widens_what_is_covered() -> None:
    wide, narrow = (
        planned(area=SMALL["area"], plan={"margin_m": margin_m}) for margin_m in (0.5, 0.0)
    )
    assert wide.area.survey.area == pytest.approx((4.6 + 1.0) * (4.0 + 1.0))
    assert narrow.area.survey.area == pytest.approx(4.6 * 4.0)
    assert wide.coverage > 0.999
    config = survey()
    rig = design_rig(config.camera, config.water)
    step_m = narrow.station_spacing_m
    wanted = pattern(common_swath(rig, 2.0, step_m), 1.0, step_m)
    assert certificate(wide.area, rig, stations_of_plan(narrow), wanted).share_at_overlap < 0.999


@pytest.mark.parametrize("heading_deg", [0.0, 33.0, 200.0])
def test_lines_take_the_heading_they_are_given(heading_deg: float) -> None:
    plan = planned(area=SMALL["area"], plan={"line_heading_deg": heading_deg})

    # They are flown to and fro: the first from whichever end costs less.
    turned = math.degrees(plan.lines[0].heading_rad) - heading_deg
    assert math.remainder(turned, 180.0) == pytest.approx(0.0, abs=1e-6)
    assert plan.coverage == pytest.approx(1.0, abs=1e-9)


def test_the_first_line_starts_at_home_the_corner_nearest_the_datum() -> None:
    for corners in (
        [[0, 0], [20, 0], [20, 10], [0, 10]],
        [[20, 10], [0, 10], [0, 0], [20, 0]],
        [[20, 2], [20, 10], [1, 10], [1, 2]],
    ):
        plan = planned(area={"polygon_ne_m": corners})
        assert plan.home_ne_m == tuple(min(corners))
        starts = [math.dist(plan.lines[0].start_ne_m, corner) for corner in corners]
        assert corners[int(np.argmin(starts))] == min(corners)


def test_without_forward_overlap_pictures_just_meet_also_at_their_corners() -> None:
    plan = planned(area=SMALL["area"], plan={"forward_overlap": 0.0, "cross_lines": 0})
    assert plan.coverage == pytest.approx(1.0, abs=1e-9)
    assert plan.station_spacing_m == pytest.approx(plan.footprint_m[1], abs=2e-4)


def test_the_certificate_shows_the_gaps_of_lines_too_far_apart(
    capsys: pytest.CaptureFixture[str],
) -> None:
    plan = planned(area=SMALL["area"], plan={"line_spacing_m": 1.6, "cross_lines": 0})
    assert 0.8 < plan.coverage < 0.995
    assert f"{1 - plan.coverage:.2%}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("sections", "named"),
    [
        ({"area": {"length_m": 0.3, "width_m": 0.2}}, "1.40 x 1.12 m"),
        ({"area": {"length_m": 9000, "width_m": 9000}}, "area"),
        ({"plan": {"altitude_m": 9.0}, "area": {"seafloor_depth_m": 5.0}}, "altitude_m 9"),
        ({"plan": {"home_ne_m": [50.0, 0.0]}}, "home_ne_m"),
        ({"plan": {"speed_mps": 0.4, "turn_radius_m": 0.5, "turns": "arcs"}}, "46 deg/s"),
    ],
)
def test_errors_of_planning_take_a_line(sections: dict[str, Any], named: str) -> None:
    with refused(PlanError, named):
        planned(**sections)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("survey")
    assert spec("plan").make(folder, survey(name="small", **SMALL), SERIAL)
    return folder


def test_a_plan_file_gives_back_the_plan(workspace: Path) -> None:
    plan = read_plan(workspace / "plan" / "plan.json")

    assert plan == planned(name="small", **SMALL)
    data = json.loads((workspace / "plan" / "plan.json").read_text())
    assert data["stations"] == plan.stations == sum(line["stations"] for line in data["lines"])
    assert data["strobe"]["pulse_s"] > data["exposure_s"]


def test_a_stage_is_skipped_until_a_setting_that_matters_changes(workspace: Path) -> None:
    config = survey(name="small", **SMALL)
    assert not spec("plan").make(workspace, config, SERIAL)
    assert not spec("plan").make(workspace, config.model_copy(update={"seed": 9}), SERIAL)
    before = read_stage(workspace / "plan")
    assert before is not None
    assert "seed" not in before.settings


def test_a_plan_is_the_same_bytes_each_time(workspace: Path, tmp_path: Path) -> None:
    spec("plan").make(tmp_path, survey(name="small", **SMALL), SERIAL)
    files = [path for path in (workspace / "plan").rglob("*") if path.is_file()]
    names = {str(path.relative_to(workspace / "plan")) for path in files} - {"stage.json"}
    assert {"plan.json", "map.png", "settings.txt", "triggers.csv"} < names
    for name in names:
        assert (workspace / "plan" / name).read_bytes() == (tmp_path / "plan" / name).read_bytes()


def test_a_broken_plan_file_is_an_error_in_one_line(workspace: Path, tmp_path: Path) -> None:
    good = json.loads((workspace / "plan" / "plan.json").read_text())
    path = tmp_path / "plan.json"
    for change, named in (
        ({"version": 7}, "version"),
        ({"lines": [{**good["lines"][0], "kind": "zigzag"}]}, "zigzag"),
        ({"speed_mps": "fast"}, "fast"),
        ({"datum": {"latitude": 1}}, "latitude"),
    ):
        path.write_text(json.dumps({**good, **change}))
        with refused(PlanError, named):
            read_plan(path)
    path.write_text(json.dumps({k: v for k, v in good.items() if k != "interval_s"}))
    with refused(PlanError, "interval_s"):
        read_plan(path)


@pytest.mark.parametrize(("vehicle", "speed_mps"), [("alice", 0.2), ("bluerov2_heavy", 0.2)])
@pytest.mark.parametrize(("swell_mps", "period_s"), [(0.17, 8.0), (0.33, 8.0), (0.2, 12.0)])
def test_swell_moves_a_vehicle_as_its_sway_loop_lets_it(
    vehicle: str, speed_mps: float, swell_mps: float, period_s: float
) -> None:
    gains = gains_for(planned_vehicle(VehicleConfig(name=vehicle)), speed_mps)
    row, body = gains.axes[SWAY], gains.body

    def rate(time_s: float, state: Array) -> list[float]:
        """Integral of the place, place, speed over ground, force per mass."""
        total, place, speed, push = state
        phase = 2 * math.pi * time_s / period_s
        water, change = swell_mps * math.cos(phase), -2 * math.pi / period_s * swell_mps
        nu, drag = np.array([speed_mps, speed - water, 0.0, 0.0, 0.0, 0.0]), np.zeros(6)
        add_damping(body, nu, drag)
        asked = -row[INTEGRAL] * total - row[PLACE] * place - row[RATE] * speed
        slowed = change * math.sin(phase) + drag[1] / body.mass[1, 1] + push
        return [place, speed, slowed, (asked - push) / row[LAG]]

    swung = solve_ivp(rate, (0.0, 12 * period_s), np.zeros(4), max_step=0.05)
    last = swung.y[1, swung.t > 10 * period_s]
    found = swell_offset_m(gains, speed_mps, swell_mps, period_s)
    assert found == pytest.approx(float(np.ptp(last)) / 2, rel=0.05)


def test_swell_carries_a_vehicle_without_sway_as_far_as_the_water_goes() -> None:
    gains = gains_for(planned_vehicle(VehicleConfig(name="sparus2")), 0.5)
    found = swell_offset_m(gains, 0.5, 0.3, 8.0)
    assert found == pytest.approx(0.3 * 8.0 / (2 * math.pi), rel=1e-6)


def test_plan_warns_of_swell_across_its_lines(capsys: pytest.CaptureFixture[str]) -> None:
    found = []
    for height_m, towards_deg in ((0.5, 0.0), (1.2, 0.0), (1.2, 90.0), (2.5, 0.0)):
        sea = {"swell_m": height_m, "swell_period_s": 8.0, "swell_towards_deg": towards_deg}
        planned(area=SMALL["area"], sea=sea, plan={"line_heading_deg": 90.0, "cross_lines": 0})
        off = re.search(r"some (\d+) of (\d+) pictures", capsys.readouterr().err)
        found.append(int(off[1]) / int(off[2]) if off else 0.0)
    assert found[0] == found[2] == 0.0
    # Of a sine of amplitude A the share 2 / pi arccos(a / A) is beyond a.
    assert 0.1 < found[1] < 0.4 < found[3] < 1.0


def test_a_vehicle_without_sway_is_steered_by_los_unasked() -> None:
    for name, controller in (("alice", "sway"), ("sparus2", "los"), ("remus100", "los")):
        config = SurveyConfig(vehicle=VehicleConfig(name=name))
        assert flight_settings(config).vehicle.controller == controller
