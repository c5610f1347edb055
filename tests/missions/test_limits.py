"""One hull and one rate of turning: in the plan, in its exports, and as flown."""

import math

import pytest

from alice_survey.core.config import SurveyConfig
from camera_calib.rig import design_rig
from missions.exports.format import Export, options_of
from missions.values.costs import SETTLE_S
from missions.values.plan_file import Plan
from tests.missions.flown_plans import flown, planned, survey

AREA = {"length_m": 9.0, "width_m": 3.0}


def _survey(limit_deg_s: float) -> SurveyConfig:
    plan = {"turns": "spot", "turn_rate_limit_deg_s": limit_deg_s}
    sea = {"current_mps": 0.05, "current_sigma_mps": 0.0, "gust_n": [0.0, 0.0, 0.0]}
    return survey(area=AREA, plan=plan, sea=sea)


def _turned_rad(plan: Plan) -> float:
    """By all turns on the spot."""
    legs = [leg for dive in plan.dives for leg in dive.route.legs]
    return sum(abs(leg.turn_rad) for leg in legs if leg.length_m == 0.0)


def test_a_slow_turn_is_planned_as_it_is_flown() -> None:
    config = _survey(5.0)
    plan = planned(config)
    assert _turned_rad(plan) / math.radians(5.0) > 0.2 * plan.duration_s
    flight = flown(plan, config)
    assert flight.ending == "complete"
    assert 0.9 < plan.duration_s / flight.flown.time_s[-1] < 1.1


@pytest.mark.parametrize("limit_deg_s", [5.0, 15.0, 40.0])
def test_way_points_wait_for_turns_at_the_rate_that_is_flown(limit_deg_s: float) -> None:
    config = _survey(limit_deg_s)
    rig, plan = design_rig(config.camera, config.water), planned(config)
    options = options_of(config.camera, config.plan)
    rate = options.turn_rate_rad_s
    assert rate == pytest.approx(math.radians(min(limit_deg_s, 15.0)))
    holds = [
        point.hold_s - SETTLE_S
        for points in Export(plan=plan, rig=rig, options=options).dives
        for point in points
        if point.kind == "turn"
    ]
    assert sum(holds) * rate == pytest.approx(_turned_rad(plan), rel=1e-9)


@pytest.mark.parametrize(("name", "reach_m"), [("alice", 1.476), ("sparus2", 1.313)])
def test_no_go_zones_are_compared_with_the_vehicles_own_hull(
    name: str, reach_m: float, capsys: pytest.CaptureFixture[str]
) -> None:
    square = [[4.0, 1.0], [5.0, 1.0], [5.0, 2.0], [4.0, 2.0]]

    def warned(clearance_m: float) -> bool:
        area = {**AREA, "no_go_ne_m": [square], "no_go_clearance_m": clearance_m}
        capsys.readouterr()
        planned(survey(area=area, sea={}, vehicle={"name": name, "controller": "los"}))
        return "no_go_clearance_m" in capsys.readouterr().err

    assert warned(reach_m - 0.01)
    assert not warned(reach_m + 0.01)
