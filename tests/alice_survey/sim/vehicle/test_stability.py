"""Speeds at which pitch diverges: against the full equations of motion."""

import math

import numpy as np
import pytest

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.pilot.gains import pitch_divergence_speed_mps
from alice_survey.sim.vehicle.vehicle import SETS, Vehicle, vehicle_from
from tests.alice_survey.sim.vehicle import motions as m
from tests.oracles_navigation import jacobian


def growth(craft: Vehicle, speed_mps: float) -> float:
    """Fastest growth of heave, pitch rate and pitch, by differences of the equations of motion.

    Surge is held: its acceleration is cancelled by a force.
    """

    def slopes(motion: Array) -> Array:
        heave, turn, pitch = motion
        nu = np.array([speed_mps, 0.0, heave, 0.0, turn, 0.0])
        state = m.state_of(craft, nu, (0.0, pitch, 0.0))
        free, pushed = (m.rates(craft, state, push * m.U)[7:13] for push in (0.0, 1.0))
        slope = pushed - free
        return np.append((free - slope * free[0] / slope[0])[[2, 4]], turn)

    return float(np.linalg.eigvals(jacobian(slopes, 3, 1e-6)).real.max())


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
