"""When a flight is no success, and when the pilot gives up after a failure."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from alice_survey.core.config import SeafloorConfig, SurveyConfig
from alice_survey.core.errors import VehicleError
from alice_survey.sim.seafloor.terrain import survey_terrain
from missions.fly.run import flight_summary
from missions.fly.simulation import flight_settings, path_of, piloting_of
from missions.stages import FLY
from missions.values.flight import Flight
from tests.missions.areas.sites import floor_of
from tests.missions.exports.plans import RIG
from tests.missions.exports.test_write import plan_over
from tests.missions.flown_plans import flown, planned, survey

SMALL = {"length_m": 5.0, "width_m": 2.0, "heading_deg": 0.0, "seafloor_depth_m": 6.0}


@pytest.fixture(scope="module")
def flight() -> Flight:
    config = survey(area=SMALL)
    return flown(planned(config), config)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, ""), ({"ending": "aborted: no progress"}, "early"),
        ({"outside_allowed": {"share_of_time": 0.1, "worst_m": 0.21}}, "left"),
        ({"outside_allowed": {"share_of_time": 0.1, "worst_m": 0.15}}, ""),
        ({"outside_allowed": {"share_of_time": 0.1, "worst_m": 0.6, "allowed_m": 0.7}}, ""),
        ({"outside_allowed": {"share_of_time": 0.1, "worst_m": 0.8, "allowed_m": 0.7}}, "left"),
        ({"stations": 96, "stations_planned": 100, "stations_off_line": 0}, ""),
        ({"stations": 96, "stations_planned": 100, "stations_off_line": 2}, "missed"),
    ],
)  # fmt: skip
def test_a_flight_that_is_not_good_enough_says_why(
    flight: Flight, tmp_path: Path, changes: dict[str, Any], words: str
) -> None:
    found = flight_summary(flight, SurveyConfig().vehicle, RIG)
    allowed_m = pytest.approx(flight.plan.allowed_offset_m)  # nothing but what a picture may be off
    kept = {"share_of_time": 0.0, "worst_m": 0.0, "allowed_m": allowed_m}
    assert found["outside_allowed"] == kept
    assert 1.0 < found["min_clearance_m"] < 2.0
    (tmp_path / "flight.json").write_text(
        json.dumps(found | {"allowed_cross_track_m": 0.2} | changes)
    )
    said = FLY.shortfall(tmp_path)
    assert words in said if words else said == ""


def test_how_far_a_flight_leaves_its_area(flight: Flight) -> None:
    low, _, _, _ = flight.plan.area.allowed.bounds
    moved = flight.glass_ned.copy()
    moved[100, 0] = low - 0.7
    assert replace(flight, glass_ned=moved).outside_m.max() == pytest.approx(0.7, abs=1e-9)


@pytest.mark.parametrize(("mps", "flies"), [(0.1, True), (0.2, False)])
def test_a_failed_thruster_is_judged_by_the_current_that_is_known(mps: float, flies: bool) -> None:
    """As `plan` does: without its stern thruster alice holds 0.13 m/s along its lines."""
    config = survey(area=SMALL)
    without = piloting_of(planned(config), flight_settings(config), 1000.0).without
    assert without is not None
    if flies:
        without({"stern": 0.0}, np.array([mps, 0.0]))
    else:
        with pytest.raises(VehicleError):
            without({"stern": 0.0}, np.array([mps, 0.0]))


def test_the_pilot_is_never_deeper_than_planned_over_a_wall() -> None:
    plan = plan_over(6.0)
    path = path_of(plan, 0.08, math.radians(30.0))
    at_m, deepest_m = path.profile_at_m, path.profile_m
    slopes = np.abs(np.diff(deepest_m) / np.diff(at_m))
    assert slopes.max() <= math.tan(math.radians(30.0)) + 1e-9
    lines = [(leg.line, leg.length_m) for dive in plan.dives for leg in dive.route.legs]
    begins = np.cumsum([0.0, *(length for _, length in lines)])
    for (line, length_m), begin in zip(lines, begins[:-1], strict=True):
        if line >= 0:
            planned_m = np.array(plan.line_depths_m[line]) - 0.08
            place = begin + np.linspace(0.0, length_m, len(planned_m))
            assert np.all(np.interp(place, at_m, deepest_m) <= planned_m + 1e-9)
    assert deepest_m.min() < 8.5 and deepest_m.max() > 12.0


def test_the_simulated_sea_floor_lies_on_the_bathymetry() -> None:
    """Sand and rocks of the same seed on a wall; where depths are not known, as the nearest."""
    east = (np.arange(160) + 0.5) * 0.25 - 20.0
    depth = np.broadcast_to(16.0 - 6.0 * (east > 2.0), (160, 160)).copy()
    depth[:, :60] = np.nan
    base = floor_of(depth, 0.25).depth_everywhere
    seafloor = SeafloorConfig(grid_m=0.05, amphora=False)
    level, raised = (
        survey_terrain(seafloor, [(-8, -8), (8, 8)], margin_m=0.0, depth_m=16.0, seed=3, base=one)
        for one in (None, base)
    )
    places = np.random.default_rng(1).uniform(-7.5, 7.5, (500, 2))
    wall = 6.0 * (places[:, 1] > 2.0)
    away = np.abs(places[:, 1] - 2.0) > 0.5
    risen = level.depth_at(places) - raised.depth_at(places)
    np.testing.assert_allclose(risen[away], wall[away], atol=1e-4)
