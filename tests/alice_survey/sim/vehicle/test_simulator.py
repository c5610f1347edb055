"""The closed loop as a whole: what it records must be one motion, and the same each time."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from alice_survey.sim.vehicle.dynamics import rk4_step, scratch_for
from alice_survey.sim.vehicle.navigation.sensors import SensorSuite
from alice_survey.sim.vehicle.pilot.memory import APPROACH, ASCEND, DIVE, DONE, FOLLOW, PHASE
from alice_survey.sim.vehicle.pilot.settings import pilot_guidance
from alice_survey.sim.vehicle.sea import Disturbance, level_floor
from alice_survey.sim.vehicle.simulator import STEPS, TICK_S, Flown, Setup, simulate
from alice_survey.sim.vehicle.vehicle import vehicle_from
from tests.alice_survey.sim.vehicle import motions
from tests.alice_survey.sim.vehicle.pilot.pilot_runs import gains_of, straight

CURRENT = motions.constant_current(0.1, 60.0)
STILL = Disturbance()
GUSTS = Disturbance(sigma=(3.0, 3.0, 3.0, 0.0, 0.0, 0.0))


def flown(disturbance: Disturbance = STILL, seed: int = 1, max_s: float = 300.0) -> Flown:
    """A line of 6 m, 2 m above a floor at 5 m."""
    path, gains = straight(6.0, 0.3), gains_of("alice")
    setup = Setup(
        vehicle=vehicle_from("alice"),
        path=path,
        guidance=pilot_guidance(gains, path, "sway", max_depth_m=5.0),
        gains=gains,
        sensors=SensorSuite().pack(),
        floor=level_floor(5.0),
        current=CURRENT,
        disturbance=disturbance,
        start_heading_rad=0.3,
    )
    return simulate(setup, np.random.default_rng(seed), max_s=max_s, label="test")


@pytest.fixture(scope="module")
def calm() -> Flown:
    return flown()


def test_a_mission_passes_through_its_phases_in_order(calm: Flown) -> None:
    phases = calm.report[:, PHASE]
    seen = phases[np.concatenate([[True], np.diff(phases) != 0])]
    order = [DIVE, APPROACH, FOLLOW, ASCEND, DONE]
    assert seen.tolist() == order
    assert 60.0 < calm.time_s[-1] < 200.0
    np.testing.assert_allclose(np.diff(calm.time_s), TICK_S, rtol=1e-9)


def test_the_recorded_velocity_is_that_of_the_recorded_positions(calm: Flown) -> None:
    way = np.diff(calm.truth[:, :3], axis=0)
    mean = 0.5 * (calm.truth[1:, 7:10] + calm.truth[:-1, 7:10])
    # The trapezium rule's error is the change of acceleration within a tick.
    assert np.abs(way / TICK_S - mean).max() < 2e-3
    attitude = Rotation.from_quat(calm.truth[:, 3:7])
    turned = attitude[:-1].inv() * attitude[1:]
    rates = 0.5 * (calm.truth[1:, 10:13] + calm.truth[:-1, 10:13])
    assert np.abs(turned.as_rotvec() / TICK_S - rates).max() < 5e-3


def test_commands_replayed_give_the_same_motion(calm: Flown) -> None:
    plant, state = vehicle_from("alice").plant, calm.state[0].copy()
    scratch, load = scratch_for(5), np.zeros(6)
    for k in range(len(calm.time_s) - 1):
        for i in range(STEPS):
            time_s = calm.time_s[k] + i * TICK_S / STEPS
            rk4_step(
                time_s, TICK_S / STEPS, state, calm.command_rps[k].copy(), load, plant, CURRENT,
                scratch,
            )  # fmt: skip
    np.testing.assert_array_equal(state, calm.state[-1])


def test_the_same_seed_flies_the_same_way_and_another_does_not() -> None:
    gusty, again, other = (flown(GUSTS, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(again.state, gusty.state)
    np.testing.assert_array_equal(again.navigation, gusty.navigation)
    rows = min(len(other.state), len(gusty.state))
    assert np.abs(other.state[:rows, :3] - gusty.state[:rows, :3]).max() > 1e-3


def test_velocity_over_ground_is_that_through_water_and_the_current(calm: Flown) -> None:
    to_ned = Rotation.from_quat(calm.state[:, 3:7])
    water = calm.truth[:, 7:10] - to_ned.apply(calm.state[:, 7:10])
    expected = [0.1 * math.cos(math.radians(60)), 0.1 * math.sin(math.radians(60)), 0.0]
    np.testing.assert_allclose(water, np.tile(expected, (len(water), 1)), atol=1e-12)


def test_a_mission_that_takes_too_long_is_broken_off_where_it_is() -> None:
    short = flown(max_s=10.0)
    assert len(short.time_s) == 200
    assert short.report[-1, PHASE] == DIVE
