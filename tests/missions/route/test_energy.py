"""What flying takes by course: the vehicle's own equations against the current."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from alice_survey.core.config import SurveyConfig
from alice_survey.core.errors import PlanError
from alice_survey.sim.vehicle.steady import steady_flight
from alice_survey.sim.vehicle.vehicle import vehicle_from
from missions.exposure.conflict import ConflictError
from missions.plan.strength import current_error, held_current_mps, survey_costs
from missions.route import energy
from missions.route.dives import split_dives
from missions.route.turns import Manoeuvre
from missions.values.costs import power_at
from missions.values.line import Line
from tests.alice_survey.sim.vehicle.motions import drag_power
from tests.small_survey import with_settings


def _config(current: float = 0.1, towards: float = 90.0, **sections: Any) -> SurveyConfig:
    sea = {"current_mps": current, "current_towards_deg": towards, **sections.pop("sea", {})}
    return SurveyConfig.model_validate({"sea": sea, **sections})


def conditions(config: SurveyConfig) -> energy.FlightConditions:
    depth_m = config.area.seafloor_depth_m - config.plan.altitude_m
    glass_body_m = config.camera.position_body_m
    return energy.flight_conditions(config.plan, config.vehicle, config.sea, depth_m, glass_body_m)


def test_drag_along_and_across_a_current() -> None:
    """0.2 m/s over ground in 0.1 m/s, calibrated coefficients: the figures that are known.

    Drag by X_uu 15.23 and Y_vv 321.6 alone: mean of 0.1 and 0.3 m/s; 0.2 ahead and 0.1 across; and
    the hypotenuse, with the heading 26.6 deg into the current.
    """
    flown = conditions(_config())
    towards = math.atan2(*flown.current_ne_mps[::-1])
    body = flown.vehicle.plant.body
    bare = body._replace(lift=np.zeros(4))

    def drag_w(off: float, manner: energy.Manner) -> tuple[float, float, float]:
        courses = towards + off + np.array([0.0, math.pi])
        moved = energy.motion(courses, 0.2, flown.current_ne_mps, manner)
        drag = float(drag_power(bare, moved.nu).mean())
        crab = math.degrees(float(np.abs(moved.crab_rad).mean()))
        return drag, float(drag_power(body, moved.nu).mean()) - drag, crab

    along, sway, crab = drag_w(0, "held"), drag_w(math.pi / 2, "held"), drag_w(math.pi / 2, "crab")
    assert along[0] == pytest.approx(15.23 * (0.3**3 + 0.1**3) / 2, rel=1e-9)
    assert sway[0] == pytest.approx(15.23 * 0.2**3 + 321.597 * 0.1**3, rel=1e-9)
    assert crab[0] == pytest.approx(15.23 * math.hypot(0.2, 0.1) ** 3, rel=1e-9)
    assert round(crab[2]) == 27
    # Body lift takes more of a hull that goes askew, and of none that does not.
    assert sway[1] == pytest.approx(35.428 * 0.2 * 0.1**2, rel=1e-9)
    assert along[1] == crab[1] == pytest.approx(0.0, abs=1e-12)


def test_motion_keeps_its_course_over_ground() -> None:
    courses = np.linspace(0, 2 * np.pi, 19)
    current = np.array([0.07, -0.05])
    for manner in ("held", "crab"):
        moved = energy.motion(courses, 0.2, current, manner)
        heading = courses + moved.crab_rad
        north = moved.nu[:, 0] * np.cos(heading) - moved.nu[:, 1] * np.sin(heading) + current[0]
        east = moved.nu[:, 0] * np.sin(heading) + moved.nu[:, 1] * np.cos(heading) + current[1]
        np.testing.assert_allclose(north, 0.2 * np.cos(courses), atol=1e-12)
        np.testing.assert_allclose(east, 0.2 * np.sin(courses), atol=1e-12)
        if manner == "crab":
            assert np.abs(moved.nu[:, 1:]).max() == 0.0
        else:
            assert np.abs(moved.crab_rad).max() == 0.0


def test_costs_turn_with_the_current() -> None:
    """Costs do not depend on north: turning the current by 40 deg turns the costs by 8 samples."""
    one, other = survey_costs(_config(towards=90.0)), survey_costs(_config(towards=130.0))
    for name in ("line_w", "way_w", "sway_w"):
        np.testing.assert_allclose(
            getattr(other, name), np.roll(getattr(one, name), 8), rtol=1e-6, err_msg=name
        )
    assert other.heave_w == pytest.approx(one.heave_w)
    assert other.stop_w == pytest.approx(one.stop_w, rel=1e-2)


def test_without_a_current_all_courses_are_alike_and_ways_are_as_lines() -> None:
    costs = survey_costs(_config(0.0))
    np.testing.assert_allclose(costs.line_w, costs.line_w[0], rtol=1e-12)
    np.testing.assert_allclose(costs.way_w, costs.line_w, rtol=1e-12)
    nu = np.zeros((1, 6))
    nu[0, 0] = 0.2
    ahead = steady_flight(vehicle_from("alice"), nu).power_w[0]
    assert costs.line_w[0] == pytest.approx(60.0 + ahead)


def test_power_between_samples_is_near_that_of_its_own_course() -> None:
    config = _config()
    costs, craft = survey_costs(config), energy.planned_vehicle(config.vehicle)
    courses = np.random.default_rng(1).uniform(0, 2 * np.pi, 50)
    exact = (
        energy.course_power(craft, courses, 0.2, conditions(config).current_ne_mps, "held") + 60.0
    )
    near = [power_at(costs.line_w, course) for course in courses]
    np.testing.assert_allclose(near, exact, rtol=3e-3)


def test_power_next_to_a_course_that_cannot_be_kept_is_infinite() -> None:
    power = np.array([1.0, 2.0, np.inf, 4.0])
    assert power_at(power, math.pi / 4) == pytest.approx(1.5)
    assert power_at(power, math.pi / 2) == 2.0  # on the sample itself
    assert power_at(power, 0.6 * math.pi) == math.inf
    assert power_at(power, -math.pi / 4) == pytest.approx(2.5)


def test_sparus_crabs_its_lines_and_cannot_step() -> None:
    config = _config(vehicle={"name": "sparus2"})
    costs = survey_costs(config)
    assert conditions(config).manner == "crab"
    np.testing.assert_allclose(costs.line_w, costs.way_w)
    assert np.all(np.isinf(costs.sway_w))
    assert math.isfinite(costs.stop_w)
    assert conditions(_config(vehicle={"controller": "los"})).manner == "crab"
    assert conditions(_config()).manner == "held"


def test_where_it_cannot_crab_a_vehicle_with_sway_still_goes() -> None:
    """With 0.3 m/s from behind it would have to turn its back."""
    costs = survey_costs(_config(0.3, 0.0))
    assert np.all(np.isfinite(costs.way_w))
    np.testing.assert_allclose(costs.way_w[0], costs.line_w[0])
    crabbing = survey_costs(_config(0.3, 0.0, vehicle={"name": "sparus2"}))
    ahead = np.cos(np.arange(72) * 2 * np.pi / 72) * 0.3 < 0.2
    np.testing.assert_array_equal(np.isfinite(crabbing.way_w), ahead)
    # Lines across are flown both ways, lines along are not.
    assert math.isfinite(crabbing.line_w[18]) and math.isinf(crabbing.line_w[0])


def test_turning_on_the_spot_costs_more_in_a_current_and_about_the_glass() -> None:
    still, moved = survey_costs(_config(0.0)), survey_costs(_config(0.15))
    about_itself = survey_costs(_config(0.0, camera={"position_body_m": (0.0, 0.0, 0.08)}))
    assert 60.0 < about_itself.stop_w < still.stop_w < moved.stop_w
    assert still.turn_rate_rad_s == pytest.approx(math.radians(15.0))
    lame = survey_costs(_config(0.1, vehicle={"failures": ["bow"]}))
    assert 0.0 < lame.turn_rate_rad_s < still.turn_rate_rad_s


def test_an_arc_costs_the_swing_of_the_hull_about_the_glass() -> None:
    """0.2 m/s on 0.5 m is 0.4 rad/s: the hull's middle sways by 0.55 m of that, 0.22 m/s."""
    tight = survey_costs(_config(0.0))
    wide = survey_costs(_config(0.0, plan={"turn_radius_m": 2.0}))
    nu = np.zeros((2, 6))
    nu[:, 5] = 0.4, -0.4
    nu[:, 0] = 0.2 + nu[:, 5] * -0.05
    nu[:, 1] = -nu[:, 5] * 0.55
    extra_w = steady_flight(vehicle_from("alice"), nu).power_w.mean() + 60.0 - tight.way_w[0]
    assert tight.arc_extra_w == pytest.approx(extra_w, rel=1e-9)
    # Much more than a straight, whose thrusters take 2 W; and little of that on a wide arc.
    assert tight.arc_extra_w > 50.0
    assert 0.5 < wide.arc_extra_w < 0.1 * tight.arc_extra_w
    assert survey_costs(_config(0.1)).arc_extra_w > tight.arc_extra_w


def test_a_descent_is_as_fast_as_three_quarters_of_the_thrust_allow() -> None:
    """Going up is the vertical thruster's weaker way; buoyancy helps with 1 N."""
    costs = survey_costs(_config(0.0))
    rates = np.linspace(0.1, 0.4, 3001)
    rps, thruster = math.sqrt(0.75) * 50.0, vehicle_from("alice").thrusters[2]
    thrust = 1025.0 * 0.08**3 * rps * (0.278 * 0.08 * rps - thruster.advance_slope * rates)
    maximum = rates[thrust + 0.1 * 9.80665 > 326.169 * rates**2].max()
    assert maximum - 0.0101 <= costs.heave_mps <= maximum
    assert costs.dive_s(13.0) == pytest.approx(26.0 / costs.heave_mps)
    assert costs.dive_j(13.0) == pytest.approx(costs.dive_s(13.0) * costs.heave_w)


@pytest.mark.parametrize(
    "config",
    [
        _config(2.0), _config(0.5), _config(0.3, 20.0, vehicle={"name": "sparus2"}),
        _config(0.3, 0.0, vehicle={"name": "sparus2"}, plan={"line_heading_deg": 10.0}),
        _config(0.3, vehicle={"controller": "los"}),
    ],
)  # fmt: skip
def test_a_current_above_the_vehicles_strength_is_refused_with_what_it_holds(
    config: SurveyConfig,
) -> None:
    if config.plan.line_heading_deg is None and config.sea.current_mps == 2.0:  # on no heading
        with pytest.raises(ConflictError, match="the current conflicts with"):
            survey_costs(config)
    found = current_error(conditions(config), "")
    assert isinstance(found, ConflictError)
    assert found.suggestion is not None
    name, held_mps = found.suggestion
    assert name == "sea.current_mps"
    assert f"{held_mps:.2f} m/s" in found.limits[1]
    held = with_settings(config, {name: held_mps})
    assert energy.flies_everywhere(conditions(held))
    assert math.isfinite(survey_costs(held).stop_w)


def test_what_is_held_is_the_most_that_flies() -> None:
    """A vehicle that crabs holds less than its speed: going downstream it would turn its back."""

    def flown(current: float, name: str = "alice") -> energy.FlightConditions:
        return conditions(_config(current, math.degrees(0.3), vehicle={"name": name}))

    assert held_current_mps(flown(0.9, "sparus2")) == pytest.approx(0.2, abs=0.0101)
    assert held_current_mps(flown(0.1, "sparus2")) == pytest.approx(0.1)
    held = held_current_mps(flown(1.0))
    assert energy.flies_everywhere(flown(held))
    assert not energy.flies_everywhere(flown(held + 0.02))


def test_a_heading_that_cannot_be_flown_is_refused_with_the_nearest_that_can() -> None:
    def config(heading: float) -> SurveyConfig:
        return _config(0.3, 0.0, vehicle={"name": "sparus2"}, plan={"line_heading_deg": heading})

    with pytest.raises(PlanError, match=r"10 deg .* 50 deg"):
        survey_costs(config(10.0))  # 0.3 cos(48.2 deg) = 0.2
    assert math.isfinite(survey_costs(config(50.0)).stop_w)


def test_a_way_between_lines_that_cannot_be_flown_is_refused_with_the_current() -> None:
    costs = survey_costs(_config(0.3, 0.0, vehicle={"name": "sparus2"}))
    line = Line(kind="survey", start_ne_m=(0.0, 0.0), end_ne_m=(0.0, 5.0), stations=5)
    with pytest.raises(PlanError, match=r"0\.30 m/s .* 0\.19 m/s"):
        how: dict[str, Any] = {"usable_wh": 1000.0, "max_s": None, "depth_m": 10.0}
        split_dives([line], Manoeuvre(costs, 0.5, 0.5), home_ne=(-5.0, 0.0), **how)


def test_known_failures_count_and_unknown_ones_do_not() -> None:
    health = {"failures": ["bow"]}
    sound, lame = survey_costs(_config()), survey_costs(_config(vehicle=health))
    unknown = survey_costs(_config(vehicle={"failures": ["bow@0"]}))
    assert lame.line_w[0] > sound.line_w[0] + 5.0
    np.testing.assert_array_equal(unknown.line_w, sound.line_w)


def test_a_measured_current_counts_by_its_mean_at_depth(tmp_path: Path) -> None:
    rows = ["time_s,depth_m,north_mps,east_mps"]
    for second, north in ((0, 0.0), (60, 0.2)):
        rows += [f"{second},5,{north + 0.4},0.02", f"{second},15,{north},0.06"]
    path = tmp_path / "current.csv"
    path.write_text("\n".join(rows) + "\n")
    config = _config(sea={"current_file": str(path)}, area={"seafloor_depth_m": 12.0})
    # At 10 m, half way: mean of 0.3 and 0.1 + ... north, 0.04 east.
    np.testing.assert_allclose(conditions(config).current_ne_mps, [0.3, 0.04], atol=1e-12)
