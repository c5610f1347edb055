from dataclasses import replace

import numpy as np
import pytest
import shapely

from alice_survey.core.config import SurveyConfig
from alice_survey.core.errors import PlanError
from alice_survey.core.executor import SERIAL
from alice_survey.sim.vehicle.floor import level_floor
from camera_calib.rig import design_rig
from missions.fly.monte_carlo import MonteCarlo, monte_carlo
from missions.fly.simulation import flight_settings
from missions.values.plan_file import Plan
from tests.missions.route.routes import route_through
from tests.oracles_coverage import area_of, lawnmower, plan_of

DEPTH_M = 8.0
STILL = SurveyConfig.model_validate(
    {
        "sea": {"current_mps": 0.0, "current_sigma_mps": 0.0, "gust_n": (0.0, 0.0, 0.0)},
        "navigation": {
            "gps_bias_m": 0.0, "gps_noise_m": 1e-4, "compass_bias_deg": 0.0,
            "compass_noise_deg": 1e-3, "dvl_noise_mps": 1e-5, "usbl_noise_m": 1e-3,
        },
    }
)  # fmt: skip
ROUGH = SurveyConfig.model_validate(
    {"sea": {"current_mps": 0.1, "gust_n": (3.0, 3.0, 3.0)}, "navigation": {"gps_bias_m": 0.5}}
)
RIG = design_rig(STILL.camera, STILL.water)


def flyable(spacing_m: float) -> Plan:
    lines = lawnmower(6, 3, spacing_m, 0.46, over_m=0.4)
    area = area_of(shapely.box(0, 0, 6, 3), 4.0)
    plan = plan_of(area, lines, line_spacing_m=spacing_m, seafloor_depth_m=DEPTH_M)
    route = route_through(lines, 0.5, 0.5)
    dive = replace(plan.dives[0], route=route, duration_s=route.length_m / plan.speed_mps)
    return replace(plan, dives=(dive,), length_m=route.length_m, duration_s=dive.duration_s)


def flown(plan: Plan, config: SurveyConfig, flights: int) -> MonteCarlo:
    return monte_carlo(
        plan, flight_settings(config), RIG, level_floor(DEPTH_M),
        seed=config.seed, flights=flights, executor=SERIAL,
    )  # fmt: skip


def test_without_disturbance_flights_see_what_the_plan_sees() -> None:
    """Lines too far apart, so that there are holes to find again where the plan has them."""
    plan = flyable(1.6)

    result = flown(plan, STILL, 2)

    planned = result.planned
    assert result.endings == {"complete": 2}
    assert 0.5 < planned.share_at_overlap < 0.95
    np.testing.assert_allclose(result.share_at_overlap, planned.share_at_overlap, atol=0.03)
    np.testing.assert_allclose(result.covered_share, planned.covered_share, atol=0.03)
    short = planned.inside & ~planned.at_overlap
    assert np.isnan(result.hole_probability[~planned.inside]).all()
    assert result.hole_probability[short].mean() > 0.9
    assert result.hole_probability[planned.inside & ~short].mean() < 0.05
    # The map's mean is the mean share that is not covered.
    missed = np.nanmean(result.hole_probability)
    assert missed == pytest.approx(1 - result.share_at_overlap.mean(), abs=1e-12)


def test_a_rough_sea_leaves_holes_that_move_and_a_seed_gives_them_again() -> None:
    plan = flyable(1.0)
    first = flown(plan, ROUGH, 3)
    again = flown(plan, ROUGH, 3)

    assert first.planned.share_at_overlap == 1.0
    assert first.share_at_overlap.max() < 1.0
    assert len(set(first.share_at_overlap.tolist())) == 3
    assert 0 < np.nanmax(first.hole_probability) <= 1.0
    np.testing.assert_array_equal(first.hole_probability, again.hole_probability)
    figures = first.to_json()
    assert figures == again.to_json()
    assert figures["share_at_overlap"]["least"] == first.share_at_overlap.min()
    assert figures["share_at_overlap"]["p05"] <= figures["share_at_overlap"]["mean"]


def test_no_flight_is_no_answer() -> None:
    with pytest.raises(PlanError, match="0 flights"):
        flown(flyable(1.0), STILL, 0)
