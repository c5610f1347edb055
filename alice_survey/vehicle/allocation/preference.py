"""Priorities when a wrench is not attainable, and preferences among thrusters."""

import math

import numpy as np

from alice_survey.base.frames import Array
from alice_survey.vehicle.compiled import kernel
from alice_survey.vehicle.propulsion import DISTRUST, Propulsion

AXIS_WEIGHTS: Array = np.array([1.0, 3.0, 30.0, 0.0, 0.0, 10.0])
"""Priorities when not all is attainable. Heave keeps the vehicle off the sea floor; yaw keeps
the pictures square and the thrusters pointing where the controller thinks they point; sway keeps to
the line; surge only costs time. Each counts about ten times the next by the square of its miss, a
newton metre of yaw, on arms near a metre, as a newton."""
AXIS_WEIGHTS.setflags(write=False)

_MOST_EXPONENT = 9.0


@kernel
def preference_weights(propulsion: Propulsion, u: float, weights: Array) -> None:
    """Write the weights of thrusters, (n,), at a surge speed: the cost is sum of weight thrust^2.

    An open thruster weighs 1, a tunnel thruster exp(2 C (u / u_ref)^2): the square of the thrust it
    must make for what is left after the jet's loss exp(-C (u / u_j)^2), at the jet speed u_ref of
    3 % of its greatest thrust, as on a survey line. ALICE's laterals thus do 96 % of the yaw at
    survey speed, by their arms alone (and the horizontal pair, whose torques roll the vehicle when
    they push apart, 4 %), and hand it over to the pair between 1 and 2 m/s. The growth stops at
    e^9, so that the equations keep their precision.
    """
    t = propulsion.table
    for i in range(t.shape[0]):
        weights[i] = math.exp(min(t[i, DISTRUST] * u * u, _MOST_EXPONENT))
