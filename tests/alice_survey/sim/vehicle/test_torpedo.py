"""The torpedo that fins steer: its numbers derived again, its trim, its turns and its loops.

The derivations are those of T. Prestero's thesis (MIT and WHOI, 2001), chapter 4, from the Myring
shape of the hull.
"""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle import steady
from alice_survey.sim.vehicle.identification.report import IdentifyOptions, identify_report
from alice_survey.sim.vehicle.pilot import gains as g
from alice_survey.sim.vehicle.pilot.settings import UnderWay, circle_course, dive_loop
from alice_survey.sim.vehicle.vehicle import vehicle_from
from tests import oracles_dynamics as oracle
from tests.alice_survey.sim.vehicle.motions import STILL
from tests.oracles_shape import alpha_0

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
    flight = steady.balance_fins(REMUS, speed, turn)
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
    minimum = steady.min_speed_mps(REMUS, SHARE)
    assert 0.3 < minimum < 0.6
    assert steady.fin_flight(REMUS, 1.01 * minimum, 0.0, SHARE) is not None
    assert steady.fin_flight(REMUS, 0.97 * minimum, 0.0, SHARE) is None
    # Lift grows with the square of the speed: four times as light, twice as fast, where nothing
    # rights the hull.
    body = replace(REMUS.rigid_body, cg_body_m=(0.0, 0.0, 0.0))
    light = body.buoyancy_kg - body.dry_kg
    speeds = [
        steady.min_speed_mps(
            replace(REMUS, rigid_body=replace(body, buoyancy_kg=body.dry_kg + share * light)), SHARE
        )
        for share in (1.0, 4.0, -1.0)
    ]
    assert speeds[1] == pytest.approx(2.0 * speeds[0], rel=1e-3)
    assert speeds[2] == pytest.approx(speeds[0], rel=0.3)  # heavy, it flies nose up
    with pytest.raises(VehicleError, match=r"from 0\.\d\d m/s through the water on, not at 0\.20"):
        g.gains_for(REMUS, 0.2)


def test_the_tightest_turn_is_one_that_fins_hold() -> None:
    radius = steady.min_radius_m(REMUS, 1.0, SHARE)
    assert 5.0 < radius < 8.0
    flight = steady.fin_flight(REMUS, 1.0, 1.0 / (1.01 * radius), SHARE)
    assert flight is not None
    assert flight.load <= SHARE and flight.drift_rad <= steady.MAX_DRIFT_RAD
    assert steady.fin_flight(REMUS, 1.0, 1.0 / (0.98 * radius), SHARE) is None


def test_what_cannot_be_done_by_fins_is_said(tmp_path: Path) -> None:
    up = replace(
        REMUS.thrusters[0], name="vertical", direction_body=(0.0, 0.0, 1.0),
        position_body_m=(0.0, 0.0, 0.0),
    )  # fmt: skip
    with pytest.raises(VehicleError, match="not controlled together"):
        g.gains_for(replace(REMUS, thrusters=(*REMUS.thrusters, up)), 1.0)
    with pytest.raises(VehicleError, match="cannot control surge"):
        g.gains_for(replace(REMUS, thrusters=()), 1.0)
    with pytest.raises(VehicleError, match="at no speed"):
        steady.min_speed_mps(replace(REMUS, fins=REMUS.fins[1:]), SHARE)
    with pytest.raises(VehicleError, match="steered by fins"):
        identify_report([], tmp_path, IdentifyOptions(vehicle="remus100"))


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


@cache
def myring() -> tuple[Array, Array]:
    """(K,) x from the centre of buoyancy, forward, and radius: nose 0.191, middle 0.654, tail 0.541
    m with an angle of 0.436 rad, of which 0.0165 and 0.0368 m are cut off; 0.191 m across."""
    a, b, c, angle, d = 0.191, 0.654, 0.541, 0.436, 0.191
    aft = np.linspace(0.0, a + b + c - 0.0165 - 0.0368, 20001)
    t = np.maximum(aft + 0.0165 - (a + b), 0.0)
    nose = d / 2 * np.sqrt(np.clip(1 - ((aft + 0.0165 - a) / a) ** 2, 0.0, 1.0))
    tail = d / 2 - (1.5 * d / c**2 - math.tan(angle) / c) * t**2
    tail += (d / c**3 - math.tan(angle) / c**2) * t**3
    radius = np.where(aft + 0.0165 < a, nose, tail)
    volume = np.trapezoid(math.pi * radius**2, aft)
    return np.trapezoid(math.pi * radius**2 * aft, aft) / volume - aft, radius


def along(values: Array) -> float:
    """Integral along the hull."""
    return float(np.trapezoid(values, -myring()[0]))


def test_the_hull_displaces_what_the_vehicle_weighs_and_some_water_inside() -> None:
    x, radius = myring()
    assert x[0] == pytest.approx(REMUS.hull.nose_m, abs=0.01)
    assert -x[-1] == pytest.approx(REMUS.hull.tail_m, abs=0.01)
    displaced = along(RHO * math.pi * radius**2)
    assert 1.0 < displaced / REMUS.rigid_body.buoyancy_kg < 1.1
    # Its mass spread as its volume.
    spread = along(math.pi * radius**2 * x**2) / along(math.pi * radius**2)
    pitch = REMUS.rigid_body.dry_kg * (spread + 0.191**2 / 16)
    assert REMUS.rigid_body.inertia_kg_m2[1] == pytest.approx(pitch, rel=0.03)
    assert REMUS.rigid_body.inertia_kg_m2[0] == pytest.approx(30.49 * 0.191**2 / 8, rel=0.25)


def test_added_masses_are_those_of_its_sections() -> None:
    """Circles, and circles with four fins (Blevins), strip by strip; an ellipsoid ahead."""
    x, radius = myring()
    reach = 0.151
    finned = np.abs(x - FIN_X) < 0.0747 / 2
    section = np.where(finned, reach**2 - radius**2 + radius**4 / reach**2, radius**2)
    strip = RHO * math.pi * section
    named = REMUS.coefficients.values
    assert named["Y_vdot"] == pytest.approx(-along(strip), rel=0.06)
    assert named["N_rdot"] == pytest.approx(-along(strip * x**2), rel=0.12)
    assert 0.0 < named["Y_rdot"] < 1.1 * -along(strip * x) * 1.0 + 1.0
    alpha = alpha_0(1.33, 0.191)
    surge = alpha / (2 - alpha) * 4 / 3 * math.pi * RHO * 0.665 * 0.0955**2
    assert named["X_udot"] == pytest.approx(-surge, rel=0.03)
    assert named["X_uu"] == pytest.approx(-0.5 * RHO * 0.2 * 0.0285, rel=0.01)


def test_the_tables_have_ten_times_the_drag_across_that_their_equations_give() -> None:
    """C_D 1.1 of strips and 0.558 of fins: what the file says of the thesis holds."""
    x, radius = myring()
    strip, fins = 0.5 * RHO * 1.1 * 2 * radius, RHO * FIN_M2 * 0.558
    named = REMUS.coefficients.values
    derived = along(strip) + fins
    assert derived == pytest.approx(132.0, abs=2.0)
    assert -named["Y_vv"] / derived == pytest.approx(10.0, rel=0.02)
    turning = along(strip * np.abs(x) ** 3) + fins * abs(FIN_X) ** 3
    assert turning == pytest.approx(8.5, abs=0.3)
    assert -named["N_rr"] / turning == pytest.approx(11.0, abs=0.6)
    assert -named["M_qq"] / turning == pytest.approx(22.0, abs=1.2)


@pytest.mark.parametrize("speed", SPEEDS)
def test_loops_are_damped_and_within_the_strength_of_the_fins(speed: float) -> None:
    gains = g.gains_for(REMUS, speed)
    assert gains.dives_by_pitch and not gains.holds_level
    assert not gains.axes[[g.SWAY, g.HEAVE, g.ROLL]].any()
    for axis, plane in ((g.YAW, g.LATERAL), (g.PITCH, g.VERTICAL)):
        row = gains.axes[axis]
        loop = g.heading_loop(gains.body, speed, row, gains.fins, plane)
        assert g.MIN_HEADING_DAMPING < g.damping_ratio(loop) < 1.0
        poles = np.linalg.eigvals(loop)
        assert poles.real.max() < -0.02
        # An error of 10 deg takes about the moment that there is.
        assert 0.3 < row[g.MASS] * row[g.PLACE] * g.KEPT_RAD / row[g.MAX_FORCE] < 1.5
    depth = np.linalg.eigvals(dive_loop(gains, speed, 2.5))
    assert depth.real.max() < -0.005


def test_four_fins_that_turn_apart_hold_roll_too() -> None:
    planes, rudders = REMUS.fins
    apart = tuple(
        replace(fin, name=f"{fin.name} {i}", positions_body_m=(place,))
        for fin in (planes, rudders)
        for i, place in enumerate(fin.positions_body_m)
    )
    gains = g.gains_for(replace(REMUS, fins=apart), 1.0)
    assert gains.holds_level and gains.dives_by_pitch
    assert gains.axes[g.ROLL, g.MAX_FORCE] > 0.5


def test_power_is_that_of_drag_and_turns() -> None:
    """At 1.5 m/s, nearly level: the propeller gives X_uu u^2 / (1 - t), by its open-water curve."""
    nu = np.zeros((4, 6))
    nu[:, 0], nu[1, 5], nu[2, 0], nu[3, 1] = 1.5, 0.2, 0.2, 0.1
    flight = steady.steady_flight(REMUS, nu, share=SHARE)
    assert np.isnan(flight.power_w).tolist() == [False, False, True, True]
    level = steady.balance_fins(REMUS, 1.5)
    assert level is not None
    assert level.force_x_n == pytest.approx(2.94 * 1.5**2, rel=0.05)
    n = flight.rps[0, 0]
    thrust = RHO * 0.14**4 * 0.4566 * n**2 - RHO * 0.14**3 * 0.4174 * n * 0.944 * 1.5
    assert 0.9 * thrust == pytest.approx(level.force_x_n, rel=1e-6)
    assert flight.power_w[1] > flight.power_w[0]
