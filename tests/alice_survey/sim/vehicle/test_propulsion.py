import math
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from alice_survey.core.errors import VehicleError
from alice_survey.sim.vehicle import propulsion as kernels
from alice_survey.sim.vehicle.propulsion import Thruster, pack, with_health
from alice_survey.sim.vehicle.vehicle import vehicle_from
from tests import oracles_propulsion as oracles
from tests.oracles_propulsion import Array

DENSITY, DISPLACED = 1025.0, 75.0
ALICE = vehicle_from("alice")
STARBOARD, PORT, VERTICAL, BOW, STERN = ALICE.thrusters
EVERY = ALICE.thrusters
PACKED = pack(EVERY, DENSITY, DISPLACED)
REST, AHEAD = np.zeros(6), np.eye(6)[0]

velocities = st.tuples(*[st.floats(-2.0, 2.0)] * 3, *[st.floats(-0.5, 0.5)] * 3).map(
    lambda nu: np.round(nu, 9)
)
speeds = st.tuples(*[st.floats(-50.0, 50.0)] * 5).map(lambda n: np.round(n, 6))


def wrench_of(thrusters: tuple[Thruster, ...], rps: list[float], nu: Array = REST) -> Array:
    force = np.zeros(6)
    kernels.add_thrust(pack(thrusters, DENSITY, DISPLACED), np.array(rps), nu, force)
    return force


def thrust_of(thruster: Thruster, n: float, nu: Array = REST) -> float:
    """Along the axis, without what the jet drags."""
    alone = replace(thruster, jet_drag=(0.0, 0.0, 0.0, 0.0))
    return float(wrench_of((alone,), [n], nu)[:3] @ np.array(thruster.direction_body))


@settings(deadline=None)
@given(rps=speeds, nu=velocities)
def test_the_wrench_is_that_of_the_textbook(rps: Array, nu: Array) -> None:
    before = np.arange(6.0)
    force = before.copy()
    kernels.add_thrust(PACKED, rps, nu, force)
    np.testing.assert_allclose(
        force - before, oracles.wrench(EVERY, DENSITY, DISPLACED, rps, nu), rtol=1e-9, atol=1e-9
    )


@pytest.mark.parametrize(
    ("thruster", "signs"),
    [
        # Which way each pushes, and which way it turns the vehicle, by hand: the starboard
        # propeller alone turns the bow to port; it turns left-handed, so that the hull rolls right.
        (STARBOARD, [1, 0, 0, 1, 0, -1]),
        (PORT, [1, 0, 0, -1, 0, 1]),
        # Right-handed about down: the hull is turned to port.
        (VERTICAL, [0, 0, 1, 0, 0, -1]),
        # Ahead of the centre: the bow goes to starboard; behind it: to port. Their propellers turn
        # right-handed about starboard, bow up: the hull is pitched down.
        (BOW, [0, 1, 0, 0, -1, 1]),
        (STERN, [0, 1, 0, 0, -1, -1]),
    ],
    ids=lambda value: value.name if isinstance(value, Thruster) else "",
)
def test_signs_at_rest(thruster: Thruster, signs: list[int]) -> None:
    np.testing.assert_array_equal(np.sign(wrench_of((thruster,), [10.0])), signs)
    np.testing.assert_array_equal(np.sign(wrench_of((thruster,), [-10.0])), -np.array(signs))


def test_bollard_thrust_is_the_published() -> None:
    """Of the T200 at 16 V and 3387 rpm, and of SPARUS II at 50 rev/s before the hull takes its."""
    assert thrust_of(BOW, 3387 / 60) == pytest.approx(51.4, rel=0.01)
    whole = replace(STARBOARD, thrust_deduction=0.0)
    assert thrust_of(whole, 50.0) == pytest.approx(71.5, rel=0.03)
    assert thrust_of(whole, -50.0) == pytest.approx(-30.0, rel=0.03)
    assert thrust_of(VERTICAL, 50.0) == pytest.approx(55.0, rel=0.03)
    assert thrust_of(VERTICAL, -50.0) == pytest.approx(-28.5, rel=0.03)


def test_the_jet_loss_is_c_at_the_jets_own_speed() -> None:
    whole = thrust_of(BOW, 20.0)
    jet = oracles.jet_speed_mps(BOW, DENSITY, whole)
    for u, kept in ((jet, math.exp(-BOW.jet_loss)), (-jet, math.exp(-BOW.jet_loss)), (1e-9, 1.0)):
        assert thrust_of(BOW, 20.0, u * AHEAD) == pytest.approx(whole * kept, rel=1e-12)


def drag_of(n: float, u: float) -> float:
    return -float(wrench_of((BOW,), [n], u * AHEAD)[0])


@settings(max_examples=200, deadline=None)
@given(nu=velocities, share=st.tuples(*[st.floats(-1.0, 1.0)] * 5).map(np.array))
def test_speeds_give_the_thrust_they_were_found_for(nu: Array, share: Array) -> None:
    lower, upper, rps = np.zeros(5), np.zeros(5), np.zeros(5)
    kernels.thrust_limits(PACKED, np.ones(5), nu, lower, upper)
    assert np.all(lower <= 0) and np.all(upper >= 0)
    wanted = np.where(share > 0, share * upper, -share * lower)
    kernels.speeds_for(PACKED, wanted, nu, rps)
    got = [oracles.net_thrust_n(t, DENSITY, n, nu) for t, n in zip(EVERY, rps, strict=True)]
    np.testing.assert_allclose(got, wanted, rtol=1e-9, atol=1e-11)
    asked = np.abs(wanted) > 1e-9
    np.testing.assert_array_equal(np.sign(rps)[asked], np.sign(wanted)[asked])
    assert np.all(np.abs(rps) <= PACKED.table[:, kernels.MAX_RPS] * (1 + 1e-9))


def test_power_is_the_shafts_over_the_efficiency_and_never_given_back() -> None:
    power, idling = np.zeros(5), tuple(replace(t, idle_w=2.0) for t in EVERY)
    packed = pack(idling, DENSITY, DISPLACED)
    kernels.electrical_power(packed, np.array([20.0, -20.0, 0.0, 15.0, -15.0]), REST, power)
    torque = DENSITY * 0.08**5 * 400.0 * np.array([STARBOARD.kq_forward, PORT.kq_reverse])
    shaft = 2 * math.pi * 20.0 * torque
    np.testing.assert_allclose(power[:2], 2.0 + shaft / STARBOARD.efficiency, rtol=1e-12)
    assert power[2] == 2.0
    # Towed fast, the water drives the propeller.
    kernels.electrical_power(packed, np.full(5, 5.0), 3.0 * AHEAD, power)
    assert power[0] == 2.0


def power_of(thruster: Thruster, n: float) -> float:
    power = np.zeros(1)
    kernels.electrical_power(pack((thruster,), DENSITY, DISPLACED), np.array([n]), REST, power)
    return float(power[0])


def test_a_t200_takes_what_its_maker_says() -> None:
    assert power_of(BOW, 56.55) == pytest.approx(390.0, rel=0.02)


@pytest.mark.parametrize(
    "change",
    [
        {"direction_body": (1.0, 1.0, 0.0)}, {"diameter_m": 0.0}, {"kt_forward": -0.1},
        {"kt_reverse": 0.0}, {"kq_reverse": -0.01}, {"dead_band_rps": 50.0},
        {"most_rps": math.nan}, {"time_constant_s": 0.0}, {"wake_fraction": 1.0},
        {"thrust_deduction": 1.0}, {"advance_slope": -0.1}, {"torque_slope": -0.1},
        {"jet_loss": -0.1}, {"jet_drag": (0.1, -1.0, 0.0, 0.0)}, {"efficiency": 1.2},
        {"idle_w": -1.0}, {"handedness": 0}, {"position_body_m": (math.nan, 0.0, 0.0)},
        # Less power than the jet carries away; a jet's loss in open water.
        {"kq_forward": 0.01}, {"kq_reverse": 0.01}, {"jet_loss": 0.1},
    ],
)  # fmt: skip
def test_thrusters_that_make_no_sense_are_refused(change: dict[str, object]) -> None:
    with pytest.raises((VehicleError, ValidationError)) as caught:
        replace(STARBOARD, **change)  # type: ignore[arg-type]
    (field,) = change
    words = {"direction_body": "direction", "kq_forward": "k_q", "kq_reverse": "k_q|kq_reverse"}
    assert re.search(words.get(field, field), str(caught.value))


def test_the_pair_rolls_the_vehicle_only_when_its_propellers_work_against_each_other() -> None:
    together = wrench_of((STARBOARD, PORT), [20.0, 20.0])
    against = wrench_of((STARBOARD, PORT), [20.0, -20.0])
    torque = DENSITY * 0.08**5 * 400.0
    np.testing.assert_allclose(together[3:], 0.0, atol=1e-12)
    assert against[3] == pytest.approx(torque * (STARBOARD.kq_forward + PORT.kq_reverse))
    # Astern is weaker: the paper's unexplained surge in turns.
    kept = 1 - STARBOARD.thrust_deduction
    assert against[0] == pytest.approx(kept * DENSITY * 0.08**4 * 400.0 * (0.698 - 0.293))
    assert against[5] < 0


@pytest.mark.parametrize(("n", "u"), [(20.0, 1.0), (20.0, -1.0), (-20.0, 1.0), (-20.0, -1.0)])
def test_water_along_the_axis_takes_the_same_off_whichever_way_it_turns(n: float, u: float) -> None:
    still, moving = thrust_of(PORT, n), thrust_of(PORT, n, u * AHEAD)
    kept, inflow = 1 - PORT.thrust_deduction, (1 - PORT.wake_fraction) * u
    loss = kept * DENSITY * 0.08**3 * PORT.advance_slope * 20.0 * inflow
    assert moving == pytest.approx(still - loss, rel=1e-12)


def test_a_jet_drags_against_the_way_and_not_at_all_when_the_thruster_stops() -> None:
    assert drag_of(20.0, 0.5) == -drag_of(20.0, -0.5) > 0
    assert drag_of(-20.0, 0.5) > 0
    assert drag_of(0.0, 0.5) == 0.0
    assert drag_of(20.0, 0.0) == 0.0
    falling = [drag_of(n, 0.5) for n in (50.0, 20.0, 5.0, 1.0, 0.1)]
    assert falling == sorted(falling, reverse=True)
    # No step where it starts: all slopes vanish.
    assert drag_of(0.05, 0.5) < 1e-6 * drag_of(20.0, 0.5)


def test_jet_drag_is_that_of_delphin2() -> None:
    """Its file at u = 0.5 m/s and jets of 0.883 m/s, by hand: C_d = 0.0416 of 0.1857 m^2."""
    n = math.sqrt(0.883**2 * math.pi / 4 / (BOW.diameter_m**2 * BOW.kt_forward))
    force = np.zeros(6)
    kernels.add_thrust(pack((BOW,), 1000.0, 80.0), np.array([n]), 0.5 * AHEAD, force)
    ratio = 0.5 / 0.883
    by_hand = 0.565994 * math.exp(-7.608907 * ratio) + 0.056536 * math.exp(-0.896792 * ratio)
    assert by_hand == pytest.approx(0.0416, abs=1e-4)
    assert force[0] == pytest.approx(-0.5 * 1000 * 0.08 ** (2 / 3) * by_hand * 0.25, rel=1e-5)


def test_more_thrust_takes_more_speed_and_limits_are_those_of_full_speed() -> None:
    nu = np.array([0.8, 0.2, -0.1, 0.1, 0.05, 0.2])
    lower, upper = np.zeros(5), np.zeros(5)
    kernels.thrust_limits(PACKED, np.ones(5), nu, lower, upper)
    grid = np.linspace(lower, upper, 201)
    rps = np.zeros_like(grid)
    for thrust, row in zip(grid, rps, strict=True):
        kernels.speeds_for(PACKED, thrust, nu, row)
    assert np.all(np.diff(rps, axis=0) > 0)
    maximum = PACKED.table[:, kernels.MAX_RPS]
    np.testing.assert_allclose(rps[[0, -1]], [-maximum, maximum], rtol=1e-9)


def test_health_is_the_share_of_bollard_thrust_that_is_left() -> None:
    health = np.array([1.0, 0.25, 0.0, 0.5, 1.0])
    full, weak = np.zeros((2, 5)), np.zeros((2, 5))
    kernels.thrust_limits(PACKED, np.ones(5), REST, full[0], full[1])
    kernels.thrust_limits(PACKED, health, REST, weak[0], weak[1])
    np.testing.assert_allclose(weak, health * full, rtol=1e-12)
    kernels.thrust_limits(with_health(PACKED, health), np.ones(5), REST, full[0], full[1])
    np.testing.assert_allclose(full, weak, rtol=1e-12)


def test_a_failed_thruster_runs_down_whatever_is_asked() -> None:
    rates = np.zeros(5)
    failed = with_health(PACKED, np.array([1.0, 0.0, 1.0, 1.0, 1.0]))
    kernels.add_speed_rates(failed, np.full(5, 10.0), np.full(5, 40.0), rates)
    assert rates[1] == pytest.approx(-10.0 / PORT.time_constant_s)
    assert np.all(np.delete(rates, 1) > 0)
    with pytest.raises(VehicleError):
        with_health(PACKED, np.array([1.0, 2.0, 1.0, 1.0, 1.0]))


def test_speeds_follow_what_is_asked_with_a_first_order_lag() -> None:
    rps, asked, rates = np.zeros(5), np.array([10.0, -10.0, 1.9, 99.0, 4.0]), np.zeros(5)
    step = 1e-4
    for _ in range(8000):
        kernels.add_speed_rates(PACKED, rps, asked, rates)
        rps += step * rates
    # The third and fifth lie in their dead bands; the fourth is beyond what it can.
    ends = np.array([10.0, -10.0, 0.0, BOW.most_rps, 0.0])
    lags = np.array([t.time_constant_s for t in EVERY])
    np.testing.assert_allclose(rps, ends * (1 - np.exp(-0.8 / lags)), atol=2e-3)


def test_power_at_any_speed_is_that_of_the_textbooks_torque() -> None:
    rng = np.random.default_rng(5)
    power = np.zeros(5)
    for _ in range(50):
        rps, nu = rng.uniform(-50, 50, 5), rng.uniform(-1, 1, 6)
        kernels.electrical_power(PACKED, rps, nu, power)
        slow = [
            max(0.0, 2 * math.pi * n * oracles.torque_nm(t, DENSITY, n, nu)) / t.efficiency
            for t, n in zip(EVERY, rps, strict=True)
        ]
        np.testing.assert_allclose(power, slow, rtol=1e-9)


@pytest.mark.parametrize("thruster", ALICE.thrusters, ids=lambda t: t.name)
@pytest.mark.parametrize("n", [10.0, -10.0])
def test_no_thruster_beats_momentum_theory_nor_is_hopeless(thruster: Thruster, n: float) -> None:
    """At bollard the jet of a duct of full area carries T^1.5 / (2 sqrt(rho A))."""
    thrust = abs(thrust_of(replace(thruster, thrust_deduction=0.0), n))
    area = math.pi * thruster.diameter_m**2 / 4
    jet = thrust**1.5 / (2 * math.sqrt(DENSITY * area))
    assert jet < power_of(thruster, n) * thruster.efficiency < 4 * jet
