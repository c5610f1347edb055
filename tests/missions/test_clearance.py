"""Missions over sea floors that rise, fall, step, and fall silent: the true clearance is kept."""

import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from alice_survey.core.config import SurveyConfig
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.pilot.memory import REASONS, TOO_LOW
from alice_survey.sim.vehicle.sea import FloorGrid, floor_depth
from alice_survey.sim.vehicle.vehicle import vehicle_from
from missions.values.flight import Flight
from missions.values.plan_file import Plan
from tests.missions import flown_plans
from tests.missions.flown_plans import flown, planned

MIN_M = 1.0
"""Half the altitude of 2 m."""
DEPTH_M = 12.0
HULL = vehicle_from("alice").hull
AT_M = np.arange(-15.0, 15.05, 0.1)


def survey(*silent_s: tuple[float, float]) -> SurveyConfig:
    area = {"length_m": 6.0, "width_m": 1.0, "heading_deg": 0.0, "seafloor_depth_m": DEPTH_M}
    silent = {"dvl_dropouts_s": [list(span) for span in silent_s]}
    return flown_plans.survey(area=area, sea={}, navigation=silent)


@lru_cache
def plan_of() -> Plan:
    return planned(survey())


def ground(depth_at: Callable[[Array], Array]) -> FloorGrid:
    """Depth by north alone; the lines run to the north and back."""
    depth = np.repeat(depth_at(AT_M)[:, None], len(AT_M), axis=1)
    return FloorGrid(AT_M[0], AT_M[0], 0.1, np.ascontiguousarray(depth))


def slope(angle_deg: float) -> FloorGrid:
    return ground(lambda north: DEPTH_M - math.tan(math.radians(angle_deg)) * north)


def fly(floor: FloorGrid, *silent_s: tuple[float, float]) -> Flight:
    return flown(plan_of(), survey(*silent_s), floor)


def true_clearance_m(flight: Flight, floor: FloorGrid) -> float:
    """Least height of a point of the hull, the port or the DVL above the floor below it."""
    turn = Rotation.from_quat(flight.flown.truth[::4, 3:7])
    minimum = math.inf
    for place in (*HULL.profile_body_m, (0.55, -0.05, 0.08), (-0.4145, 0.0, 0.11)):
        points = flight.flown.truth[::4, :3] + turn.apply(place)
        minimum = min(minimum, *(floor_depth(floor, n, e) - d for n, e, d in points))
    return float(minimum)


@pytest.mark.parametrize("angle_deg", [20.0, 30.0])
def test_slopes_are_flown_up_and_down_at_the_planned_altitude(angle_deg: float) -> None:
    floor = slope(angle_deg)
    flight = fly(floor)
    assert flight.ending == "complete"
    assert true_clearance_m(flight, floor) > 0.8 * MIN_M
    columns = flight.flown.navigation
    believed, sigma = columns[:, 12], columns[:, 19]
    true = np.array([floor_depth(floor, n, e) - d for n, e, d in flight.glass_ned])
    on_line = flight.line >= 0
    off = (believed - true)[on_line]
    assert np.sqrt(np.mean(off**2)) < 0.1
    assert 0.5 < np.sqrt(np.mean((off / sigma[on_line]) ** 2)) < 1.5
    assert columns[on_line, -1].min() > 0.8 * MIN_M


@pytest.mark.parametrize("start_s", [75.0, 90.0])
def test_a_silence_on_the_way_up_a_slope_stops_the_vehicle(start_s: float) -> None:
    floor = slope(20.0)
    flight = fly(floor, (start_s, start_s + 15.0))
    assert true_clearance_m(flight, floor) > 0.8 * MIN_M
    assert flight.ending == "complete"


def test_a_silent_dive_stops_above_the_planned_floor_whatever_lies_elsewhere() -> None:
    floor = ground(lambda north: np.where(north < -12.0, DEPTH_M + 6.0, DEPTH_M))
    flight = fly(floor, (-1.0, 80.0))
    silent = flight.flown.time_s < 80.0
    assert DEPTH_M - 3.5 < flight.flown.truth[silent, 2].max() < DEPTH_M - 2.7
    assert true_clearance_m(flight, floor) > MIN_M
    assert flight.ending == "complete"


@pytest.mark.parametrize("step_m", [0.7, 1.4])
def test_a_step_is_climbed_or_given_up_in_time(step_m: float) -> None:
    floor = ground(lambda north: np.where(north > 3.0, DEPTH_M - step_m, DEPTH_M))
    flight = fly(floor)
    assert true_clearance_m(flight, floor) > 0.25 * MIN_M
    if step_m < MIN_M:
        assert flight.ending == "complete"
    else:
        assert flight.ending in ("complete", f"aborted: {REASONS[TOO_LOW]}")


def test_the_hull_on_the_sea_floor_ends_the_mission_and_says_so() -> None:
    # A wall before the bow: no beam meets it.
    floor = ground(lambda north: np.where(north > 3.0, DEPTH_M - 6.0, DEPTH_M))
    flight = fly(floor)
    assert flight.ending == "aborted: the hull touched the sea floor"
    bow = flight.flown.truth[:, :3]
    bow = bow + Rotation.from_quat(flight.flown.truth[:, 3:7]).apply(HULL.profile_body_m[0])
    above = np.array([floor_depth(floor, n, e) - d for n, e, d in bow])
    assert above[-1] <= 0.0
    assert flight.clearance_m <= 0.0
    assert above[:-1].min() > 0.0
