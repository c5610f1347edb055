"""Stability of a vehicle by itself, without its pilot."""

import math

import numpy as np

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.pilot.linear import (
    linear_coriolis,
    linear_damping,
)
from alice_survey.sim.vehicle.vehicle import Vehicle

_VERTICAL = [2, 4]
_MAX_MPS = 5.0
_STEP_MPS = 0.02
_GROWS_PER_S = 1e-6
"""Growth beyond rounding errors."""


def pitch_matrix(vehicle: Vehicle, speed_mps: float) -> Array:
    """State matrix of heave w, pitch rate q and pitch about level flight at a held surge.

    The Munk moment of the added masses grows with the square of the speed and turns a hull that
    pitches further; the low centre of gravity turns it back (Fossen 2011, sections 6.3 and 7.5).

    Args:
        vehicle: level when at rest, with all thrusters steady.
        speed_mps: surge.

    Returns:
        (3, 3)
    """
    body = vehicle.plant.body
    nu = np.array([speed_mps, 0.0, 0.0, 0.0, 0.0, 0.0])
    pair = np.ix_(_VERTICAL, _VERTICAL)
    inverse = np.linalg.inv(body.mass[pair])
    matrix = np.zeros((3, 3))
    matrix[:2, :2] = -inverse @ (linear_damping(body, nu) + linear_coriolis(body, nu))[pair]
    matrix[:2, 2] = -inverse[:, 1] * body.weight_n * body.cg[2]
    matrix[2, 1] = 1.0
    return matrix


def pitch_divergence_speed_mps(vehicle: Vehicle) -> float:
    """The lowest speed above which a pitch grows, by bisection; infinite if none up to 5 m/s.

    Args:
        vehicle: as in `pitch_matrix`.
    """

    def grows(speed_mps: float) -> bool:
        growth = np.linalg.eigvals(pitch_matrix(vehicle, speed_mps)).real.max()
        return bool(growth > _GROWS_PER_S)

    high = _STEP_MPS
    while not grows(high):
        high += _STEP_MPS
        if high > _MAX_MPS:
            return math.inf
    low = high - _STEP_MPS
    while high - low > 1e-6:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if grows(middle) else (middle, high)
    return high
