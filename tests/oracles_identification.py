"""Identification a second time: slow, obvious, and by another road."""

import numpy as np
from scipy.integrate import solve_ivp

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.dynamics import STATE, derivative, scratch_for
from alice_survey.sim.vehicle.vehicle import Vehicle
from tests.alice_survey.sim.vehicle.motions import STILL


def integrated(vehicle: Vehicle, start: Array, rps: Array, at_s: Array, load: Array) -> Array:
    """States (T, 10), quaternion and nu, by an adaptive solver of the simulator's own equations.

    Thrusters keep their speeds rps (n,); a force and moment (6,) acts besides.
    """
    count = len(vehicle.thrusters)
    scratch, water = scratch_for(count), STILL

    def rate(time_s: float, state: Array) -> Array:
        out = np.zeros(STATE + count)
        derivative(time_s, state, rps, load, vehicle.plant, water, scratch, out)
        return out

    state = np.concatenate([np.zeros(3), start, rps])
    solved = solve_ivp(rate, (at_s[0], at_s[-1]), state, t_eval=at_s, rtol=1e-11, atol=1e-12)
    return solved.y.T[:, 3:13]
