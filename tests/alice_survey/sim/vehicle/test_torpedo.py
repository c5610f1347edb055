"""The torpedo that fins steer: its numbers derived again, its trim, its turns and its loops.

The derivations are those of T. Prestero's thesis (MIT and WHOI, 2001), chapter 4, from the Myring
shape of the hull.
"""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from alice_survey.core.errors import VehicleError
from alice_survey.sim.vehicle.files import vehicle_from
from alice_survey.sim.vehicle.identification.report import IdentifyOptions, identify_report
from alice_survey.sim.vehicle.pilot import gains as g
from alice_survey.sim.vehicle.pilot.gains import (
    gains_for,
)
from alice_survey.sim.vehicle.pilot.settings import UnderWay, circle_course
from alice_survey.sim.vehicle.steady import (
    MAX_DRIFT_RAD,
    balance_fins,
    fin_flight,
    min_radius_m,
    min_speed_mps,
)
from tests import oracles_dynamics as oracle
from tests.alice_survey.sim.vehicle.motions import STILL

Array = NDArray[np.float64]
REMUS = vehicle_from("remus100")
SHARE = g.STEADY_SHARE
RHO, FIN_M2, FIN_X = 1030.0, 0.00665, -0.638
SPEEDS = (0.7, 1.0, 1.5)


def test_fins_lift_as_their_shape_has_it() -> None:
    """Span 0.0857 m, mirrored by the hull: aspect ratio 2.21, slope 3.12; rho a S = 21.3 kg/m."""
    for fin in REMUS.fins:
        assert fin.aspect_ratio == pytest.approx(2 * 0.0857**2 / FIN_M2, rel=0.01)
        assert fin.slope == pytest.approx(3.12, abs=0.01)
        assert RHO * fin.slope * fin.area_m2 == pytest.approx(21.3, abs=0.1)


@pytest.mark.parametrize("speed", SPEEDS)
@pytest.mark.parametrize("turn", [0.0, 0.1, -0.1])
def test_steady_flight_is_one_by_the_equations_of_the_textbook(speed: float, turn: float) -> None:
    """Nothing changes but roll, which is left to the low weight: heave, pitch, sway and yaw."""
    flight = balance_fins(REMUS, speed, turn)
    assert flight is not None
    attitude = np.array([0.0, flight.pitch_rad, 0.4])
    load = np.array([flight.force_x_n, 0.0, 0.0, 0.0, 0.0, 0.0])
    actuators = np.array([0.0, *flight.angles_rad])
    eta = np.array([0.0, 0.0, 5.0, *attitude])
    rates, accelerations, _ = oracle.derivative(
        0.0, eta, flight.nu, actuators, actuators, load, REMUS, STILL
    )
    np.testing.assert_allclose(accelerations[[0, 4]], 0.0, atol=2e-6)
    # Sway, heave and yaw share their inertia with roll, which is not balanced.
    assert abs(rates[2]) < 1e-9
    if turn == 0.0:
        np.testing.assert_allclose(accelerations, 0.0, atol=2e-6)
        assert flight.pitch_rad < 0.0  # it is light, and has to fly downwards


def test_the_lowest_speed_is_that_at_which_lift_carries_the_buoyancy() -> None:
    minimum = min_speed_mps(REMUS, SHARE)
    assert 0.3 < minimum < 0.6
    assert fin_flight(REMUS, 1.01 * minimum, 0.0, SHARE) is not None
    assert fin_flight(REMUS, 0.97 * minimum, 0.0, SHARE) is None
    # Lift grows with the square of the speed: four times as light, twice as fast, where nothing
    # rights the hull.
    body = replace(REMUS.rigid_body, cg_body_m=(0.0, 0.0, 0.0))
    light = body.buoyancy_kg - body.dry_kg
    speeds = [
        min_speed_mps(
            replace(REMUS, rigid_body=replace(body, buoyancy_kg=body.dry_kg + share * light)), SHARE
        )
        for share in (1.0, 4.0, -1.0)
    ]
    assert speeds[1] == pytest.approx(2.0 * speeds[0], rel=1e-3)
    assert speeds[2] == pytest.approx(speeds[0], rel=0.3)  # heavy, it flies nose up
    with pytest.raises(VehicleError, match=r"from 0\.\d\d m/s through the water on, not at 0\.20"):
        gains_for(REMUS, 0.2)


def test_the_tightest_turn_is_one_that_fins_hold() -> None:
    radius = min_radius_m(REMUS, 1.0, SHARE)
    assert 5.0 < radius < 8.0
    flight = fin_flight(REMUS, 1.0, 1.0 / (1.01 * radius), SHARE)
    assert flight is not None
    assert flight.load <= SHARE and flight.drift_rad <= MAX_DRIFT_RAD
    assert fin_flight(REMUS, 1.0, 1.0 / (0.98 * radius), SHARE) is None


def test_what_cannot_be_flown_by_fins_is_said() -> None:
    up = replace(
        REMUS.thrusters[0], name="vertical", direction_body=(0.0, 0.0, 1.0),
        position_body_m=(0.0, 0.0, 0.0),
    )  # fmt: skip
    with pytest.raises(VehicleError, match="not controlled together"):
        gains_for(replace(REMUS, thrusters=(*REMUS.thrusters, up)), 1.0)
    with pytest.raises(VehicleError, match="cannot control surge"):
        gains_for(replace(REMUS, thrusters=()), 1.0)
    with pytest.raises(VehicleError, match="at no speed"):
        min_speed_mps(replace(REMUS, fins=REMUS.fins[1:]), SHARE)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_circle_leads_through_its_goal_with_its_heading(side: float) -> None:
    """A point that goes where the course points, from anywhere, ends up on the circle."""
    way = UnderWay(circle_m=8.0, side=side, dive_ahead_m=2.0, level_rad=0.0)
    course, bend = circle_course(3.0, 4.0, 0.7, 2.0, way, np.array([3.0, 4.0, 0, 0, 0, 0]))
    assert math.remainder(course - 0.7, 2 * math.pi) == pytest.approx(0.0, abs=1e-12)
    assert bend == pytest.approx(side / 8.0)
    rng = np.random.default_rng(2)
    centre = np.array([3.0 - side * 8.0 * math.sin(0.7), 4.0 + side * 8.0 * math.cos(0.7)])
    for start in rng.uniform(-40, 40, (5, 2)):
        point = np.array([*start, 0.0, 0.0, 0.0, 0.0])
        for _ in range(4000):
            course, _ = circle_course(3.0, 4.0, 0.7, 2.0, way, point)
            point[:2] += 0.05 * np.array([math.cos(course), math.sin(course)])
        off = point[:2] - centre
        assert np.hypot(*off) == pytest.approx(8.0, abs=0.05)
        ahead = np.array([math.cos(course), math.sin(course)])
        assert np.sign(off[0] * ahead[1] - off[1] * ahead[0]) == side


def test_logs_of_it_are_not_identified_as_if_it_had_no_fins(tmp_path: Path) -> None:
    with pytest.raises(VehicleError, match="steered by fins"):
        identify_report([], tmp_path, IdentifyOptions(vehicle="remus100"))
