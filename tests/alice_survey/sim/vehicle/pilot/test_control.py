"""Inner loops: forces by matrices, limits, integrals that do not wind up."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.pilot import gains as g
from alice_survey.sim.vehicle.pilot import memory as slot
from alice_survey.sim.vehicle.pilot import steering
from alice_survey.sim.vehicle.pilot.memory import new_pilot
from tests import oracles_guidance as oracle
from tests.alice_survey.sim.vehicle.pilot.pilot_runs import gains_of

DEMANDS = arrays(np.float64, 8, elements=st.floats(-0.6, 0.6))


@pytest.mark.parametrize("name", ["alice", "sparus2"])
@given(demand=DEMANDS)
@settings(deadline=None)
def test_wrench_is_that_of_the_matrices(name: str, demand: Array) -> None:
    gains, pilot, wrench = gains_of(name), new_pilot(), np.full(6, 9.0)
    pilot.demand[:8] = demand
    steering.write_wrench(np.zeros(14), 0.05, gains, pilot, wrench)
    np.testing.assert_allclose(wrench, oracle.wrench(gains, demand), atol=1e-9)
    # Roll and pitch are not requested, nor sway where nothing gives it.
    assert wrench[3] == wrench[4] == 0.0
    assert name == "alice" or wrench[1] == 0.0


@given(demand=DEMANDS)
@settings(deadline=None)
def test_saturated_axes_are_flagged(demand: Array) -> None:
    gains, pilot, wrench = gains_of("alice"), new_pilot(), np.zeros(6)
    pilot.demand[:8] = demand * np.array([1, 1, 1, 1, 5, 5, 5, 20])
    steering.write_wrench(np.zeros(14), 0.05, gains, pilot, wrench)
    for axis, degree in enumerate(g.DEGREES):
        full = pilot.demand[slot.FULL_SURGE + axis]
        ends = gains.axes[axis, [g.MIN_FORCE, g.MAX_FORCE]]
        if full == 0.0:
            assert ends[0] <= wrench[degree] <= ends[1]
        else:
            assert wrench[degree] == ends[int(full > 0)]


@settings(deadline=None)
@given(error=st.floats(-2, 2), speed=st.floats(-1, 1), feed=st.floats(-1, 1))
@pytest.mark.parametrize("axis", [g.SWAY, g.HEAVE, g.YAW])
def test_place_loop_near_the_place_is_the_placed_one(
    axis: int, error: float, speed: float, feed: float
) -> None:
    gains = gains_of("alice")
    row = gains.axes[axis]
    maximum = 100.0
    steady, acceleration = steering.place_demand(gains, axis, error, speed, feed, 0.0, maximum)
    # Whatever the share of the inner loop: rate on the speed, place on the place.
    expected = row[g.RATE] * (feed - speed) + row[g.PLACE] * error
    assert acceleration == pytest.approx(expected, abs=1e-12)
    cut, _ = steering.place_demand(gains, axis, error, speed, feed, 0.0, 0.05)
    assert abs(cut - feed) <= 0.05 + 1e-12
    assert steady - feed == pytest.approx(row[g.PLACE] / row[g.INNER] * error)


def _hold(gains: g.Gains, push: float, seconds: float, maximum: float) -> tuple[Array, Array]:
    """Sway of a bare mass with lag, pushed by a force; offsets and the integral over time."""
    row, dt_s = gains.axes[g.SWAY], 0.05
    place = speed = force = total = 0.0
    places, totals, full = [], [], 0.0
    for _ in range(round(seconds / dt_s)):
        _, acceleration = steering.place_demand(gains, g.SWAY, -place, speed, 0.0, total, 1.0)
        total += steering.place_sum_step(gains, g.SWAY, -place, full, dt_s)
        asked = row[g.MASS] * acceleration
        full = 1.0 if asked > maximum else (-1.0 if asked < -maximum else 0.0)
        asked = min(max(asked, -maximum), maximum)
        for _ in range(50):
            force += (asked - force) * dt_s / 50 / row[g.LAG]
            speed += (force + push) / row[g.MASS] * dt_s / 50
            place += speed * dt_s / 50
        places.append(place)
        totals.append(total)
    return np.array(places), np.array(totals)


def test_integral_takes_away_what_a_steady_force_leaves() -> None:
    gains = gains_of("alice")
    row = gains.axes[g.SWAY]
    places, totals = _hold(gains, 4.0, 60.0, 80.0)
    # At first the force over the stiffness, in the end nothing, and the integral holds the force.
    assert 0.5 * 4.0 / (row[g.MASS] * row[g.PLACE]) < places.max()
    assert places.max() < 1.2 * 4.0 / (row[g.MASS] * row[g.PLACE])
    assert abs(places[-1]) < 1e-4
    assert totals[-1] * row[g.INNER] * row[g.MASS] == pytest.approx(-4.0, rel=1e-3)
