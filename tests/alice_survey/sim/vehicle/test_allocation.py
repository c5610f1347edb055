import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alice_survey.sim.vehicle import allocation
from alice_survey.sim.vehicle.propulsion import add_thrust, speeds_for, thrust_limits
from alice_survey.sim.vehicle.vehicle import Vehicle, vehicle_from
from tests import oracles_propulsion as oracles
from tests.oracles_propulsion import Array

ALICE, SPARUS = vehicle_from("alice"), vehicle_from("sparus2")
SURGE, SWAY, HEAVE, YAW = 0, 1, 2, 5

REST = np.zeros(6)
REACH = np.array([120.0, 80.0, 60.0, 0.0, 0.0, 60.0])
"""Wrenches some way beyond what the thrusters can give together."""


def limits_of(craft: Vehicle, failed: int | None = None) -> tuple[Array, Array]:
    count = len(craft.thrusters)
    health, lower, upper = np.ones(count), np.zeros(count), np.zeros(count)
    if failed is not None:
        health[failed] = 0.0
    thrust_limits(craft.plant.propulsion, health, REST, lower, upper)
    return lower, upper


def solve(
    matrix: Array,
    wanted: Array,
    lower: Array,
    upper: Array,
    weights: Array | None = None,
    axes: Array = allocation.AXIS_WEIGHTS,
    solver: object = allocation.allocate_exact,
) -> Array:
    count = matrix.shape[1]
    thrust = np.full(count, np.nan)
    chosen = np.ones(count) if weights is None else weights
    assert callable(solver)
    posed = allocation.Allocation(
        True, ALICE.plant.propulsion, ALICE.plant.fins, matrix, axes, np.ones(count), lower, upper,
        chosen, thrust, thrust, REST, allocation.allocation_scratch(count),
    )  # fmt: skip
    solved = solver(wanted, posed)
    assert solved > 0
    assert np.all((thrust >= lower) & (thrust <= upper))
    return thrust


def miss_n(matrix: Array, thrust: Array, wanted: Array) -> float:
    """Weighted, over the axes that are requested."""
    return float(np.linalg.norm(allocation.AXIS_WEIGHTS * (matrix @ thrust - wanted)))


@pytest.mark.parametrize("craft", [ALICE, SPARUS], ids=lambda craft: craft.name)
@pytest.mark.parametrize("solver", [allocation.allocate_exact, allocation.allocate_rpi])
def test_a_wrench_turns_the_vehicle_the_way_it_says(craft: Vehicle, solver: object) -> None:
    """A positive yaw turns the bow to starboard; the other axes are alike."""
    lower, upper = limits_of(craft)
    axes = [SURGE, HEAVE, YAW] if craft is SPARUS else [SURGE, SWAY, HEAVE, YAW]
    asked = np.where(np.isin(range(6), axes), allocation.AXIS_WEIGHTS, 0.0)
    for wanted in (*np.eye(6)[axes], *-np.eye(6)[axes]):
        thrust = solve(craft.configuration_matrix, wanted, lower, upper, axes=asked, solver=solver)
        rps, force = np.zeros(len(thrust)), np.zeros(6)
        speeds_for(craft.plant.propulsion, thrust, REST, rps)
        add_thrust(craft.plant.propulsion, rps, REST, force)
        # Reverse torque is not quite that of the matrix: a few per cent on the other axes.
        np.testing.assert_allclose(force[axes], wanted[axes], atol=0.02)


@pytest.mark.parametrize("craft", [ALICE, SPARUS], ids=lambda craft: craft.name)
def test_what_cannot_be_had_is_missed_as_little_as_by_bvls(craft: Vehicle) -> None:
    rng = np.random.default_rng(12)
    matrix, count = craft.configuration_matrix, len(craft.thrusters)
    asked, beyond = allocation.AXIS_WEIGHTS > 0, 0
    for trial in range(2000 if craft is ALICE else 300):
        failed = int(rng.integers(count)) if trial % 3 == 0 else None
        lower, upper = limits_of(craft, failed)
        wanted = rng.normal(size=6) * REACH
        weights = np.exp(rng.uniform(0, 4, count))
        thrust = solve(matrix, wanted, lower, upper, weights)
        best = oracles.min_miss(matrix, wanted, lower, upper, allocation.AXIS_WEIGHTS)
        np.testing.assert_allclose(
            (allocation.AXIS_WEIGHTS * (matrix @ thrust))[asked], best, atol=1e-6, rtol=0
        )
        beyond += miss_n(matrix, thrust, wanted) > 1e-3
    assert beyond > 200


@st.composite
def problems(draw: st.DrawFn) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Any matrix, with ranks that fall short, bounds that meet, axes that are not requested."""
    seed = draw(st.integers(0, 2**32 - 1))
    count, rank = draw(st.integers(1, 8)), draw(st.integers(1, 6))
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(6, rank)) @ rng.normal(size=(rank, count))
    lower, upper = -rng.uniform(0, 5, count), rng.uniform(0, 5, count)
    shut = rng.random(count) < draw(st.sampled_from([0.0, 0.3, 1.0]))
    lower, upper = np.where(shut, 0.0, lower), np.where(shut, 0.0, upper)
    lower += draw(st.sampled_from([0.0, 2.0]))
    upper += 2.0
    upper[shut] = lower[shut]
    axes = np.exp(rng.uniform(-1, 2, 6)) * (rng.random(6) < 0.8)
    weights = np.exp(rng.uniform(-2, 4, count))
    wanted = rng.normal(size=6) * draw(st.sampled_from([0.0, 1.0, 30.0]))
    return matrix, wanted, lower, upper, axes, weights


@settings(max_examples=300, deadline=None)
@given(problem=problems())
def test_miss_and_then_thrust_are_least_by_karush_kuhn_and_tucker(
    problem: tuple[Array, Array, Array, Array, Array, Array],
) -> None:
    matrix, wanted, lower, upper, axes, weights = problem
    thrust = solve(matrix, wanted, lower, upper, weights, axes)
    a, scale = axes[:, None] * matrix, np.sqrt(weights)
    slope = a.T @ (axes * (wanted - matrix @ thrust))
    size = 1e-8 * (1 + np.linalg.norm(axes * wanted)) * (1 + np.abs(a).max())
    # More of a thruster would help only where it gives all it can.
    inside = (thrust > lower + 1e-9) & (thrust < upper - 1e-9)
    assert np.all(np.abs(slope[inside]) < size)
    assert np.all(slope[(thrust <= lower + 1e-9) & (upper > lower)] < size)
    assert np.all(slope[(thrust >= upper - 1e-9) & (upper > lower)] > -size)

    # No step that keeps the wrench, and the bounds, makes the thrust smaller.
    cost = float(weights @ thrust**2)
    _, values, basis = np.linalg.svd(a / scale)
    kept = int(np.sum(values > 1e-9 * max(values.max(initial=0.0), 1e-300)))
    rng = np.random.default_rng(0)
    for along in basis[kept:]:
        for _ in range(4):
            mixed = along + basis[kept:].T @ rng.normal(size=len(basis) - kept)
            for sign in (1.0, -1.0):
                moved = thrust + sign * 1e-4 * mixed / scale
                if np.all((moved >= lower) & (moved <= upper)):
                    assert float(weights @ moved**2) > cost - 1e-12 * (1 + cost)


@pytest.mark.parametrize("failed", range(5))
def test_a_failed_thruster_is_left_alone_and_the_rest_does_what_it_can(failed: int) -> None:
    lower, upper = limits_of(ALICE, failed)
    matrix, rng = ALICE.configuration_matrix, np.random.default_rng(17)
    without = ALICE.without([ALICE.thrusters[failed].name])
    low, high = np.delete(lower, failed), np.delete(upper, failed)
    for _ in range(50):
        wanted = rng.normal(size=6) * REACH
        thrust = solve(matrix, wanted, lower, upper)
        assert thrust[failed] == 0.0
        alone = solve(without.configuration_matrix, wanted, low, high)
        np.testing.assert_allclose(np.delete(thrust, failed), alone, atol=1e-9)


def test_the_pseudo_inverse_is_its_numpy_twin() -> None:
    rng = np.random.default_rng(19)
    for trial in range(400):
        craft = ALICE if trial % 2 else SPARUS
        matrix, count = craft.configuration_matrix, len(craft.thrusters)
        lower, upper = limits_of(craft, int(rng.integers(count)) if trial % 3 == 0 else None)
        wanted = rng.normal(size=6) * REACH * rng.choice([0.05, 1.0])
        weights = np.exp(rng.uniform(0, 3, count))
        got = solve(matrix, wanted, lower, upper, weights, solver=allocation.allocate_rpi)
        slow = oracles.redistributed(matrix, wanted, lower, upper, allocation.AXIS_WEIGHTS, weights)
        np.testing.assert_allclose(got, slow, rtol=1e-5, atol=1e-5)


def test_yaw_is_made_by_the_laterals_pushing_apart() -> None:
    lower, upper = limits_of(ALICE)
    starboard, port, vertical, bow, stern = solve(
        ALICE.configuration_matrix, np.array([0, 0, 0, 0, 0, 4.0]), lower, upper
    )
    assert bow > 2.0 and stern == pytest.approx(-bow)
    assert port > 0 > starboard and port == pytest.approx(-starboard)
    assert vertical == pytest.approx(0.0, abs=1e-9)


def test_of_all_thrusts_that_do_it_is_the_least() -> None:
    """Against every set of thrusters at their bounds, tried one by one."""
    rng = np.random.default_rng(13)
    matrix = ALICE.configuration_matrix
    for trial in range(150):
        lower, upper = limits_of(ALICE, int(rng.integers(5)) if trial % 4 == 0 else None)
        weights = np.exp(rng.uniform(0, 5, 5))
        inside = matrix @ rng.uniform(lower, upper)
        wanted = inside if trial % 2 else rng.normal(size=6) * REACH
        thrust = solve(matrix, wanted, lower, upper, weights)
        best = oracles.best_thrust(matrix, wanted, lower, upper, allocation.AXIS_WEIGHTS, weights)
        np.testing.assert_allclose(thrust, best, atol=1e-6)


def test_heave_comes_before_yaw_before_sway_before_surge() -> None:
    """Where one must be given up for the other, it is the lesser one, nearly whole."""
    axes = np.eye(6)
    for more, less in ((HEAVE, YAW), (YAW, SWAY), (SWAY, SURGE)):
        matrix, wanted = (axes[more] - axes[less])[:, None], axes[more] + axes[less]
        thrust = solve(matrix, wanted, np.array([-9.0]), np.array([9.0]))[0]
        # They pull opposite ways with weights a and b: (a^2 - b^2) / (a^2 + b^2).
        a, b = allocation.AXIS_WEIGHTS[more] ** 2, allocation.AXIS_WEIGHTS[less] ** 2
        assert thrust == pytest.approx((a - b) / (a + b))
        assert 0.75 < thrust < 0.9


def test_the_pseudo_inverses_shortfall() -> None:
    """It never does better; beyond reach every fifth wrench is missed more, some three times."""
    rng = np.random.default_rng(29)
    matrix = ALICE.configuration_matrix
    lower, upper = limits_of(ALICE)
    misses = np.zeros((2000, 2))
    for row in misses:
        wanted = rng.normal(size=6) * REACH
        for i, solver in enumerate((allocation.allocate_exact, allocation.allocate_rpi)):
            thrust = solve(matrix, wanted, lower, upper, solver=solver)
            row[i] = miss_n(matrix, thrust, wanted)
    exact, rpi = misses[misses[:, 0] > 1e-3].T
    assert len(exact) > 1500
    assert np.all(misses[:, 1] > misses[:, 0] - 1e-6)
    assert 1.01 < np.mean(rpi / exact) < 1.10
    assert 0.10 < np.mean(rpi > 1.01 * exact) < 0.35
    assert 2.0 < np.max(rpi / exact) < 6.0


def test_laterals_turn_the_vehicle_on_a_line_and_the_pair_at_speed() -> None:
    lower, upper = limits_of(ALICE)
    matrix, weights = ALICE.configuration_matrix, np.zeros(5)
    shares = []
    for u in np.linspace(0.0, 2.0, 41):
        allocation.preference_weights(ALICE.plant.propulsion, float(u), weights)
        assert np.all(weights[:2] == 1.0) and np.all(weights[2:] >= 1.0)
        thrust = solve(matrix, np.array([0, 0, 0, 0, 0, 2.0]), lower, upper, weights)
        shares.append(matrix[YAW, :2] @ thrust[:2] / 2.0)
    assert np.all(np.diff(shares) >= 0)
    assert shares[0] < 0.05 and shares[4] < 0.05
    assert shares[20] < 0.5 < shares[32] and shares[40] > 0.9


def test_preference_is_the_square_of_what_the_jet_loses() -> None:
    """At the jet of 3 % of full thrust, the law of deflection by hand; alike astern; bounded."""
    bow = ALICE.thrusters[3]
    ahead, astern = np.zeros(5), np.zeros(5)
    allocation.preference_weights(ALICE.plant.propulsion, 0.6, ahead)
    allocation.preference_weights(ALICE.plant.propulsion, -0.6, astern)
    np.testing.assert_array_equal(ahead, astern)
    thrust = 0.03 * 1025.0 * bow.diameter_m**4 * bow.kt_forward * bow.most_rps**2
    ratio = 0.6 / oracles.jet_speed_mps(bow, 1025.0, thrust)
    assert ahead[3] == pytest.approx(np.exp(bow.jet_loss * ratio**2) ** 2)
    allocation.preference_weights(ALICE.plant.propulsion, 30.0, ahead)
    assert ahead[3] == pytest.approx(np.exp(9.0))
