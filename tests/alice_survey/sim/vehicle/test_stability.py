"""Speeds at which pitch diverges: against the full equations of motion."""

import math

import numpy as np
import pytest

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.dynamics import derivative, initial_state, scratch_for
from alice_survey.sim.vehicle.pilot.gains import pitch_divergence_speed_mps
from alice_survey.sim.vehicle.sea import constant_current
from alice_survey.sim.vehicle.vehicle import SETS, Vehicle, vehicle_from


def growth(craft: Vehicle, speed_mps: float) -> float:
    """Fastest growth of heave, pitch rate and pitch, by differences of the equations of motion.

    Surge is held: its acceleration is cancelled by a force.
    """
    count = len(craft.thrusters)
    loop = np.zeros((3, 3))
    step = 1e-6

    def rates(heave: float, turn: float, pitch: float) -> Array:
        nu = np.array([speed_mps, 0.0, heave, 0.0, turn, 0.0])
        state = initial_state(np.zeros(3), np.array([0.0, pitch, 0.0]), count, nu)
        out, scratch = np.zeros(13 + count), scratch_for(count)
        water = constant_current(0.0, 0.0)

        def accelerations(ahead_n: float) -> Array:
            load = np.array([ahead_n, 0.0, 0.0, 0.0, 0.0, 0.0])
            derivative(0.0, state, np.zeros(count), load, craft.plant, water, scratch, out)
            return out[7:13].copy()

        free = accelerations(0.0)
        slope = accelerations(1.0) - free
        return (free - slope * free[0] / slope[0])[[2, 4]]

    for column in range(3):
        ahead, behind = np.eye(3)[column] * step, -np.eye(3)[column] * step
        loop[:2, column] = (rates(*ahead) - rates(*behind)) / (2 * step)
    loop[2, 1] = 1.0
    return float(np.linalg.eigvals(loop).real.max())


@pytest.mark.parametrize("name", ["alice", "sparus2"])
@pytest.mark.parametrize("coefficients", SETS)
def test_pitch_grows_above_that_speed_and_fades_below(name: str, coefficients: str) -> None:
    craft = vehicle_from(name, coefficients)
    speed_mps = pitch_divergence_speed_mps(craft)
    if coefficients == "calibrated":
        assert speed_mps == math.inf
        assert growth(craft, 1.0) < 0.0
        assert growth(craft, 3.0) < 0.0
        return
    assert growth(craft, 0.97 * speed_mps) < 0.0 < growth(craft, 1.03 * speed_mps)


def test_speeds_of_alice_are_the_documented_ones() -> None:
    speeds = [pitch_divergence_speed_mps(vehicle_from("alice", each)) for each in SETS]
    assert speeds == pytest.approx([0.316, 0.248, math.inf, 0.259], abs=0.0006)
