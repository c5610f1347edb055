"""Surveys of a vehicle that fins steer: planned with its turns, flown, aborted."""

from dataclasses import replace

import numpy as np
import pytest
from shapely.geometry import MultiPolygon, Polygon

from alice_survey.core.config import SurveyConfig, parse_config
from alice_survey.core.errors import PlanError
from alice_survey.sim.vehicle.pilot.gains import STEADY_SHARE
from alice_survey.sim.vehicle.pilot.memory import ABORT, PHASE
from alice_survey.sim.vehicle.steady import min_radius_m, min_speed_mps
from missions.exposure.conflict import ConflictError
from missions.fly.run import true_log
from missions.fly.simulation import path_of, roomier_side
from missions.route.energy import planned_vehicle
from missions.values.flight import rms
from tests.missions.flown_plans import flown, planned


def survey(
    plan: dict[str, object] | None = None,
    area: dict[str, object] | None = None,
    **sections: dict[str, object],
) -> SurveyConfig:
    return parse_config(
        {
            "area": {"length_m": 14.0, "width_m": 2.5, "seafloor_depth_m": 6.0, **(area or {})},
            "plan": {"speed_mps": 1.0, "cross_lines": 0, "line_heading_deg": 0.0, **(plan or {})},
            "sea": {"current_mps": 0.1, "current_towards_deg": 90.0},
            "camera": {"position_body_m": [0.3, -0.05, 0.1], "dvl_position_body_m": [-0.1, 0, 0.1]},
            "vehicle": {"name": "remus100", "controller": "los"},
            **sections,
        },
        "test",
    )


def test_a_survey_is_planned_with_turns_that_it_holds_and_flown_on_its_lines() -> None:
    config = survey()
    plan = planned(config)
    craft = planned_vehicle(config.vehicle)
    legs = [leg for dive in plan.dives for leg in dive.route.legs]
    min_m = min_radius_m(craft, 1.0, STEADY_SHARE)
    curved = [abs(leg.curvature_per_m) for leg in legs if leg.curvature_per_m != 0.0]
    assert curved and max(curved) <= 1.0 / min_m
    assert 1.0 < plan.turn_radius_m / min_m < 1.5
    assert not any(leg.turn_rad or leg.side_rad for leg in legs)
    assert plan.coverage > 0.999

    flight = flown(plan, config)
    assert flight.ending == "complete"
    cross, _ = flight.line_errors
    on = flight.line >= 0
    assert 0.01 < rms(cross) < 0.2
    assert 0.01 < rms(flight.believed_cross_track) < 0.15
    assert 0.001 < np.std(flight.altitude_m[on]) < 0.03
    assert np.mean(flight.altitude_m[on]) == pytest.approx(2.0, abs=0.02)
    assert flight.altitude_m.min() > 1.4
    # It never stops, and its lines are flown nose down, being light.
    u = flight.flown.state[:, 7]
    assert u[flight.flown.time_s > 20.0].min() > 0.7
    assert -4.0 < np.rad2deg(flight.attitude_rad[on, 1]).mean() < -0.5
    angles = true_log(flight).others
    assert list(angles) == ["fin_stern_planes_deg", "fin_rudders_deg"]
    for angle in angles.values():
        assert 3.0 < np.abs(angle).max() <= 13.6 + 1e-9
    # The plan's energy is that of the flight: thrusters, and the hotel load.
    hours = flight.flown.time_s[-1] / 3600.0
    spent_wh = float(flight.flown.energy_j.sum()) / 3600.0 + 30.0 * hours
    assert spent_wh == pytest.approx(plan.energy_wh, rel=0.25)
    assert plan.duration_s == pytest.approx(flight.flown.time_s[-1], rel=0.2)


def test_an_aborted_flight_comes_up_in_a_circle() -> None:
    config = survey(navigation={"dvl_dropouts_s": [[80.0, 300.0]]})
    flight = flown(planned(config), config)
    assert flight.ending.startswith("aborted: the DVL did not hear the bottom")
    down = flight.truth.ned_from_body.translation
    assert down[-1, 2] < 0.35
    rises = flight.flown.report[:, PHASE] == ABORT
    assert np.ptp(down[rises, :2], axis=0).max() < 25.0
    pitch = np.rad2deg(flight.attitude_rad[rises, 1])
    assert 5.0 < pitch.max() < 30.0


def test_a_dead_propeller_ends_the_mission_at_the_surface() -> None:
    """Without a propeller nothing steers; the light vehicle floats up by itself."""
    config = survey(vehicle={
        "name": "remus100", "controller": "los", "failures": ["propeller@60"],
    })  # fmt: skip
    flight = flown(planned(config), config)
    assert flight.ending.startswith("aborted: a thruster failed")
    assert flight.truth.ned_from_body.translation[-1, 2] < 0.35


def test_turns_that_are_too_tight_or_have_no_room_are_refused() -> None:
    with pytest.raises(PlanError, match=r"turn_radius_m 3 is tighter than the 6\.\d+ m"):
        planned(survey({"turn_radius_m": 3.0, "turns": "arcs"}))
    assert planned(survey({"turn_radius_m": 3.0})).turn_radius_m > 6.0
    with pytest.raises(PlanError, match=r"turns of 8 m radius have no room .*area.turn_margin_m"):
        planned(survey(area={"turn_margin_m": 3.0}))


def test_a_speed_below_the_lowest_is_refused_with_one_that_does() -> None:
    config = survey({"speed_mps": 0.2})
    with pytest.raises(ConflictError, match=r"held level by its fins from 0\.4\d m/s") as found:
        planned(config)
    assert found.value.suggestion is not None
    name, speed_mps = found.value.suggestion
    assert name == "plan.speed_mps"
    assert speed_mps > min_speed_mps(planned_vehicle(config.vehicle), STEADY_SHARE)
    assert planned(survey({"speed_mps": speed_mps})).coverage > 0.999


def test_the_circle_is_flown_on_the_roomier_side() -> None:
    """A circle of 8 m radius beside a way, in areas that reach so far to port and starboard."""
    plan = planned(survey())
    path = path_of(plan)
    heading = float(path.heading_rad[0])
    turned = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
    start = np.array([path.start_n[0], path.start_e[0]])
    for port, starboard, side, share in (
        (20.0, 4.0, -1.0, 0.0),
        (4.0, 20.0, 1.0, 0.0),
        (8.0, 9.0, 1.0, 0.42),
    ):
        corners = np.array([[-40, -port], [40, -port], [40, starboard], [-40, starboard]])
        corners = corners @ turned + start
        area = replace(plan.area, allowed=MultiPolygon([Polygon(corners)]))
        found, outside = roomier_side(replace(plan, area=area), path, 5.0, 8.0)
        assert found == side
        assert outside == pytest.approx(share, abs=0.01)
