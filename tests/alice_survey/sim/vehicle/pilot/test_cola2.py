"""COLA2's law by itself: where it heads, its steady offset, its circle, its captain's time."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from alice_survey.core.config import VehicleConfig
from alice_survey.sim.vehicle.pilot import mission as pilot
from alice_survey.sim.vehicle.pilot.gains import gains_for
from missions.route.energy import planned_vehicle

FAR = 1000.0


@given(
    course=st.floats(-math.pi, math.pi),
    along=st.floats(10.0, 900.0),
    cross=st.floats(-1.9, 1.9),
    delta=st.floats(2.0, 8.0),
)
def test_the_point_aimed_at_is_on_the_section_at_the_look_ahead(
    course: float, along: float, cross: float, delta: float
) -> None:
    c, s = math.cos(course), math.sin(course)
    north, east = along * c - cross * s, along * s + cross * c
    heading = pilot.aim(north, east, 0.0, 0.0, FAR * c, FAR * s, delta)
    # Fossen 2011, equation 10.72: the point is delta away from the vehicle, and on the straight.
    point = np.array([north + delta * math.cos(heading), east + delta * math.sin(heading)])
    assert abs(point @ [-s, c]) < 1e-6
    assert point @ [c, s] > along


@pytest.mark.parametrize(
    ("place", "bearing"),
    [
        ((-5.0, 1.0), math.atan2(-1.0, 5.0)),  # long before it: to its start
        ((11.0, 1.0), math.atan2(-1.0, -1.0)),  # past its end: back to it
        ((9.0, 1.0), math.atan2(-1.0, 1.0)),  # within the look-ahead of its end: to the end
        ((5.0, 3.0), -math.pi / 2),  # farther off than the look-ahead: straight towards it
    ],
)
def test_the_ends_of_a_section(place: tuple[float, float], bearing: float) -> None:
    assert pilot.aim(*place, 0.0, 0.0, 10.0, 0.0, 2.0) == pytest.approx(bearing, abs=1e-9)


@pytest.mark.parametrize("current", [0.02, 0.05, 0.1, -0.1, 0.2, 0.3])
def test_a_current_across_holds_it_off_by_the_look_ahead_times_the_sine_of_the_drift(
    current: float,
) -> None:
    """A vehicle that heads where it is wanted to and is carried along by the water."""
    delta, speed, north, east = 3.0, 0.2, 0.0, 0.0
    for _ in range(12000):
        heading = pilot.aim(north, east, 0.0, 0.0, FAR, 0.0, delta)
        sway = current * math.cos(heading)
        north += 0.05 * (speed * math.cos(heading) - sway * math.sin(heading))
        east += 0.05 * (speed * math.sin(heading) + sway * math.cos(heading))
    wanted = math.copysign(delta * pilot.steady_drift(current, speed), current)
    assert east == pytest.approx(wanted, rel=1e-3)
    assert 0.0 < abs(wanted) < delta


@pytest.mark.parametrize(
    ("name", "minimum", "maximum"), [("alice", 0.34, 0.44), ("sparus2", 0.55, 0.72)]
)
def test_the_circle_is_that_of_a_simulated_vehicle(
    name: str, minimum: float, maximum: float
) -> None:
    """Bounds: 10 % about what `test_mission_flight` measures."""
    vehicle = planned_vehicle(VehicleConfig(name=name))
    circle = pilot.circling_m(gains_for(vehicle, 0.2), 0.2)
    assert minimum < circle < maximum
    assert pilot.circling_m(gains_for(vehicle, 0.4), 0.4) > circle


def test_the_captain_waits_twice_the_way_and_half_a_minute() -> None:
    row = np.zeros(pilot.COLUMNS)
    settings = pilot.Cola2Settings()
    for asked, way_m, rise_m, seconds in (
        ((0.2, 1.0, 0.0), 10.0, 1.0, math.sqrt(2) * 10 / 0.2),
        ((0.2, 1.0, 0.0), 1.0, -12.0, 12 / 0.3),
        ((0.2, 0.0, 1.0), 10.0, 1.0, 200 / 0.3),  # by altitude: as if through a DVL's range
        ((3.0, 0.0, 1.0), 900.0, 1.0, math.sqrt(2) * 900 / 0.5),  # the pilot's greatest speed
    ):
        row[[pilot.SPEED, pilot.BY_DEPTH, pilot.BY_ALTITUDE]] = asked
        assert pilot.timeout_s(row, way_m, rise_m, settings) == pytest.approx(30 + 2 * seconds)
