"""Steady motion against the equations of motion."""

import math

import numpy as np
import pytest

from alice_survey.sim.vehicle.propulsion import add_thrust
from alice_survey.sim.vehicle.steady import BALANCED, steady_flight
from alice_survey.sim.vehicle.vehicle import vehicle_from
from tests.alice_survey.sim.vehicle import motions as m

ALICE, SPARUS = vehicle_from("alice"), vehicle_from("sparus2")


def test_the_compiled_dynamics_stay_as_they_are_at_the_steady_thrust() -> None:
    """No acceleration is left in surge, sway, heave and yaw: force, N and N m, below 1e-6.

    In motions of a survey: surge, sway, a little heave, turning.
    """
    low, high = [-0.2, -0.25, -0.05, 0, 0, -0.2], [0.6, 0.25, 0.05, 0, 0, 0.2]
    nu = np.random.default_rng(1).uniform(low, high, (30, 6))
    flight = steady_flight(ALICE, nu)
    assert np.all(np.isfinite(flight.power_w))
    for motion, rps in zip(nu, flight.rps, strict=True):
        rate = m.rates(ALICE, m.state_of(ALICE, motion, rps=rps), command_rps=rps)
        assert np.abs((ALICE.mass @ rate[7:13])[list(BALANCED)]).max() < 1e-6


def test_power_of_a_sound_figure_is_known() -> None:
    """0.2 m/s ahead: 15.23 x 0.04 N of drag, and 0.98 N of buoyancy held down."""
    nu = 0.2 * m.U[None]
    flight = steady_flight(ALICE, nu)
    assert m.drag_power(ALICE.plant.body, nu)[0] == pytest.approx(15.23 * 0.2**3, rel=1e-12)
    made = np.zeros(6)
    add_thrust(ALICE.plant.propulsion, flight.rps[0], nu[0], made)
    assert made[0] == pytest.approx(15.23 * 0.2**2, abs=1e-9)
    assert made[2] == pytest.approx(0.1 * 9.80665, abs=1e-9)
    assert made[1] == pytest.approx(0.0, abs=1e-9)
    assert 1.5 < flight.power_w[0] < 3.0  # 0.12 W of drag through small, lossy propellers
    assert 0.0 < flight.load[0] < 0.1


def test_what_cannot_be_kept_is_nan_and_a_slip_may_be_left() -> None:
    nu = np.array([[0.2, 0.1, 0, 0, 0, 0], [0.2, 0.0, 0, 0, 0, 0], [9.0, 0.0, 0, 0, 0, 0.0]])
    flight = steady_flight(SPARUS, nu)
    assert np.isnan(flight.power_w).tolist() == [True, False, True]
    assert np.isnan(flight.rps).all(axis=1).tolist() == [True, False, True]
    slipping = steady_flight(SPARUS, nu, slips=True)
    assert np.isnan(slipping.power_w).tolist() == [False, False, True]


def test_turning_while_the_water_stands_still_over_ground_takes_its_acceleration() -> None:
    """Turning in place in a current, velocity relative to the water turns in the body: M nu'."""
    nu = np.array([[0.1, 0.05, 0, 0, 0, 0.2]])
    rate = np.array([[0.2 * 0.05, -0.2 * 0.1, 0, 0, 0, 0]])
    flight = steady_flight(ALICE, nu, rate)
    state = m.state_of(ALICE, nu[0], rps=flight.rps[0])
    out = m.rates(ALICE, state, command_rps=flight.rps[0])
    left = ALICE.mass @ (out[7:13] - rate[0])
    assert np.abs(left[list(BALANCED)]).max() < 1e-6


def test_a_share_of_thrust_bounds_the_load() -> None:
    nu = np.linspace(0.01, 0.6, 60)[:, None] * m.V
    whole, part = steady_flight(ALICE, nu), steady_flight(ALICE, nu, share=0.5)
    kept = np.isfinite(part.power_w)
    assert 10 < kept.sum() < np.isfinite(whole.power_w).sum() < 60
    assert np.all(part.load[kept] <= 0.5 + 1e-9)
    assert np.all(whole.load[~kept & np.isfinite(whole.load)] > 0.5 - 1e-9)
    # Speeds squared are thrust but for the drag of the flow: at the bound the share is used up.
    assert part.load[kept].max() > 0.45


def test_one_lateral_thruster_is_made_up_for_by_the_pair_astern() -> None:
    nu = np.array([[0.2, 0.08, 0, 0, 0, 0]])
    sound, lame = steady_flight(ALICE, nu), steady_flight(ALICE.without(["bow"]), nu)
    assert lame.power_w[0] > 2 * sound.power_w[0]
    assert math.isfinite(lame.power_w[0])
