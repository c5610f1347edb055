"""The motion over a window of a log, and its derivatives by start and parameters.

With x' = f(x, parameters), the sensitivities S = dx/d(columns) follow
S' = (df/dx) S + df/d(columns) (forward sensitivities; e.g. Hairer, Norsett & Wanner, Solving
Ordinary Differential Equations I, I.14). Both are carried through the same Runge-Kutta steps, so
that S is the derivative of the numerical solution itself. Columns are the parameters, then the
start: three small turns about the body's axes and the six of nu. df/dx is by central differences of
the forces, which are of second order in nu and in the quaternion but for the thrust, so that these
differences are exact to rounding.

A constant current moves the water that nu is relative to: it enters the measured velocity over
ground only.

The state x is the attitude quaternion ned_from_body, xyzw (4), and nu relative to the water (6);
position does not act back on either. The equations are those of
`alice_survey.sim.vehicle.dynamics`.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.compiled import kernel
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.dynamics import Body, add_coriolis, add_damping, add_weight
from alice_survey.sim.vehicle.propulsion import Propulsion, add_thrust
from alice_survey.sim.vehicle.rotations import matrix_rows

(
    LINEAR, QUADRATIC, LIFT, ADDED_MASS, CURRENT, BUOYANCY, TRIM, BIAS, GAIN, QUADRATIC_POS,
    QUADRATIC_NEG,
) = range(11)  # fmt: skip
"""Kinds of parameters."""
STATES = 10
"""Length of the state."""
_TILT = 1e-5
"""Step, m/s, rad/s or of the quaternion, of the slope of the force by the state."""


class Terms(NamedTuple):
    """Kind of each parameter, (P,), and its places in the matrices."""

    kind: NDArray[np.int64]
    row: NDArray[np.int64]
    column: NDArray[np.int64]


class Physics(NamedTuple):
    """A vehicle with given values of the parameters."""

    body: Body
    propulsion: Propulsion
    lag_s: Array
    """(n,) time constants of the thrusters."""
    current_ne: Array
    """(2,) current, m/s."""
    bias: Array
    """(6,) biases added to the velocity and rate readings."""
    gain: Array
    """(6,) by which a given wrench is multiplied."""
    given: Array
    """(6,) 1 of a motion of nu that follows the log, 0 of one that follows the forces."""


class SlopeScratch(NamedTuple):
    """Work arrays for intermediate results."""

    force: Array
    """(3, 6): of the rate, and of a parameter."""
    ends: Array
    """(2, 10) rates at both ends of a difference."""
    tilted: Array
    """(10,) a state a step away."""
    by_state: Array
    """(10, 10) slope of the state's rate."""
    by_column: Array
    """(10, C) slope of the state's rate by the columns."""
    stage: Array
    """(3, 10): rate, sum of rates, trial state."""
    stages: Array
    """(3, 10, C): the same of the sensitivities."""
    rps: Array
    """(n,)"""
    load: Array
    """(6,)"""
    acceleration: Array
    """(6,)"""


def scratch_for(columns: int, thrusters: int) -> SlopeScratch:
    """Work arrays for a number of columns and thrusters."""
    return SlopeScratch(
        np.zeros((3, 6)), np.zeros((2, STATES)), np.zeros(STATES), np.zeros((STATES, STATES)),
        np.zeros((STATES, columns)),
        np.zeros((3, STATES)), np.zeros((3, STATES, columns)), np.zeros(thrusters), np.zeros(6),
        np.zeros(6),
    )  # fmt: skip


def with_given(physics: Physics, given: Sequence[int]) -> Physics:
    """The same with motions of nu, by their places, that follow the log."""
    flags = np.zeros(6)
    flags[list(given)] = 1.0
    free = np.flatnonzero(flags == 0.0)
    inverse = np.zeros((6, 6))
    inverse[np.ix_(free, free)] = np.linalg.inv(physics.body.mass[np.ix_(free, free)])
    return physics._replace(body=physics.body._replace(mass_inverse=inverse), given=flags)


@kernel
def _write_rate(physics: Physics, state: Array, scratch: SlopeScratch, rate: Array) -> None:
    """Write the rate, (10,), of a state under the speeds and the load of the scratch.

    Given motions have the acceleration (6,) that they are given; the others feel it through the
    inertia that couples them, and answer with the rest of the mass matrix alone.
    """
    body, nu, force = physics.body, state[4:10], scratch.force[0]
    x, y, z, s = state[0], state[1], state[2], state[3]
    p, q, r = state[7], state[8], state[9]
    rate[0] = 0.5 * (s * p + y * r - z * q)
    rate[1] = 0.5 * (s * q + z * p - x * r)
    rate[2] = 0.5 * (s * r + x * q - y * p)
    rate[3] = -0.5 * (x * p + y * q + z * r)
    r20, r21, r22 = matrix_rows(x, y, z, s)[2]
    for i in range(6):
        force[i] = physics.gain[i] * scratch.load[i]
    add_thrust(physics.propulsion, scratch.rps, nu, force)
    add_damping(body, nu, force)
    add_coriolis(body, nu, force)
    add_weight(body, r20, r21, r22, force)
    for j in range(6):
        if physics.given[j] != 0.0:
            for i in range(6):
                force[i] -= body.mass[i, j] * scratch.acceleration[j]
    for i in range(6):
        total = physics.given[i] * scratch.acceleration[i]
        for j in range(6):
            total += body.mass_inverse[i, j] * force[j]
        rate[4 + i] = total


@kernel
def slope_by_state(physics: Physics, state: Array, scratch: SlopeScratch) -> None:
    """Write df/dx into `by_state`."""
    tilted, ends = scratch.tilted, scratch.ends
    for j in range(STATES):
        tilted[j] = state[j]
    for j in range(STATES):
        for end in range(2):
            tilted[j] = state[j] + (_TILT if end else -_TILT)
            _write_rate(physics, tilted, scratch, ends[end])
        tilted[j] = state[j]
        for i in range(STATES):
            scratch.by_state[i, j] = (ends[1, i] - ends[0, i]) / (2.0 * _TILT)


@kernel
def slope_by_parameters(
    physics: Physics, terms: Terms, state: Array, rates: Array, scratch: SlopeScratch
) -> None:
    """Write df/d(parameters) into `by_column`; `rates` is nu' (6,)."""
    body, nu, force, out = physics.body, state[4:10], scratch.force[2], scratch.by_column
    momentum = scratch.force[1]
    x, y, z, s = state[0], state[1], state[2], state[3]
    r20, r21, r22 = matrix_rows(x, y, z, s)[2]
    u, v, w, p, q, r = nu[0], nu[1], nu[2], nu[3], nu[4], nu[5]
    weight = body.weight_n
    for k in range(terms.kind.shape[0]):
        kind, i, j = terms.kind[k], terms.row[k], terms.column[k]
        if kind in (CURRENT, BIAS):
            continue
        force[:] = 0.0
        if kind == LINEAR:
            force[i] = nu[j]
        elif kind == QUADRATIC:
            force[i] = nu[j] * abs(nu[j])
        elif kind == QUADRATIC_POS:
            force[i] = max(nu[j], 0.0) * abs(nu[j])
        elif kind == QUADRATIC_NEG:
            force[i] = min(nu[j], 0.0) * abs(nu[j])
        elif kind == LIFT:
            if i == 1:
                force[1] = abs(u) * v
            elif i == 2:
                force[2] = abs(u) * w
            elif i == 4:
                force[4] = u * w
            else:
                force[5] = u * v
        elif kind == ADDED_MASS:
            # The inertia loses the coefficient in (i, j) and (j, i): momentum d, and -dM nu'.
            momentum[:] = 0.0
            force[i], momentum[i] = rates[j], -nu[j]
            if i != j:
                force[j], momentum[j] = rates[i], -nu[i]
            a, b = momentum[:3], momentum[3:]
            force[0] -= q * a[2] - r * a[1]
            force[1] -= r * a[0] - p * a[2]
            force[2] -= p * a[1] - q * a[0]
            force[3] -= v * a[2] - w * a[1] + q * b[2] - r * b[1]
            force[4] -= w * a[0] - u * a[2] + r * b[0] - p * b[2]
            force[5] -= u * a[1] - v * a[0] + p * b[1] - q * b[0]
        elif kind == GAIN:
            force[i] = scratch.load[i]
        elif kind == BUOYANCY:
            force[0], force[1], force[2] = -r20, -r21, -r22
        elif i == 0:
            force[4], force[5] = -weight * r22, weight * r21
        elif i == 1:
            force[3], force[5] = weight * r22, -weight * r20
        else:
            force[3], force[4] = -weight * r21, weight * r20
        for a in range(6):
            total = 0.0
            for b in range(6):
                total += body.mass_inverse[a, b] * force[b]
            out[4 + a, k] = total


CHANNELS, START = 9, 9
"""Lengths of an observation (velocity over ground, rates, attitude error) and of the free start."""


class Record(NamedTuple):
    """A window of a log."""

    time_s: Array
    """(T,)"""
    rps: Array
    """(T, n) speeds of the thrusters; n is 0 where the wrench is given."""
    wrench: Array
    """(T, 6) given wrench, besides that of the thrusters."""
    attitude: Array
    """(T, 4) measured quaternions, NaN where there is none."""
    acceleration: Array
    """(T, 6) accelerations of given motions, from each row to the next."""


@kernel
def _stage(
    physics: Physics, terms: Terms, state: Array, sensitivity: Array, scratch: SlopeScratch
) -> None:
    """Write the rates of a state and of its sensitivities into the first of the stages."""
    rate, slopes = scratch.stage[0], scratch.stages[0]
    _write_rate(physics, state, scratch, rate)
    slope_by_state(physics, state, scratch)
    slope_by_parameters(physics, terms, state, rate[4:10], scratch)
    a, b = scratch.by_state, scratch.by_column
    columns = sensitivity.shape[1]
    for i in range(STATES):
        for c in range(columns):
            slopes[i, c] = b[i, c]
        for k in range(STATES):
            factor = a[i, k]
            if factor != 0.0:
                for c in range(columns):
                    slopes[i, c] += factor * sensitivity[k, c]


@kernel
def _step(
    physics: Physics,
    terms: Terms,
    record: Record,
    row: int,
    begin: float,
    step_s: float,
    state: Array,
    sensitivity: Array,
    scratch: SlopeScratch,
) -> None:
    """Advance a state and its sensitivities by one classical Runge-Kutta step.

    Between two rows a wrench is linear, and a thruster's speed as a first-order lag with its
    time constant does under a constant command: straight if slow, and exact for a thruster that is
    commanded with each row.
    """
    span = record.time_s[row + 1] - record.time_s[row]
    total, trial = scratch.stage[1], scratch.stage[2]
    totals, trials = scratch.stages[1], scratch.stages[2]
    columns, lags = sensitivity.shape[1], physics.lag_s
    for j in range(6):
        scratch.acceleration[j] = record.acceleration[row, j]
    for k in range(4):
        at = begin + step_s * (0.0 if k == 0 else (1.0 if k == 3 else 0.5))
        share = at / span
        for j in range(scratch.rps.shape[0]):
            lag, part = lags[j], share
            if lag > 0.0:
                part = math.expm1(-at / lag) / math.expm1(-span / lag)
            scratch.rps[j] = (1 - part) * record.rps[row, j] + part * record.rps[row + 1, j]
        for j in range(6):
            scratch.load[j] = (1 - share) * record.wrench[row, j] + share * record.wrench[
                row + 1, j
            ]
        if k == 0:
            _stage(physics, terms, state, sensitivity, scratch)
        else:
            _stage(physics, terms, trial, trials, scratch)
        weight = step_s / 6.0 if k == 0 or k == 3 else step_s / 3.0
        ahead = step_s if k == 2 else 0.5 * step_s
        rate, slopes = scratch.stage[0], scratch.stages[0]
        for i in range(STATES):
            total[i] = (total[i] if k else 0.0) + weight * rate[i]
            trial[i] = state[i] + ahead * rate[i]
            for c in range(columns):
                totals[i, c] = (totals[i, c] if k else 0.0) + weight * slopes[i, c]
                trials[i, c] = sensitivity[i, c] + ahead * slopes[i, c]
    for i in range(STATES):
        state[i] += total[i]
        for c in range(columns):
            sensitivity[i, c] += totals[i, c]


@kernel
def _simulate(
    physics: Physics,
    terms: Terms,
    record: Record,
    max_step_s: float,
    scratch: SlopeScratch,
    states: Array,
    sensitivities: Array,
) -> None:
    """Simulate a window from its first state (10,) and sensitivities (10, C) on."""
    columns = sensitivities.shape[2]
    for row in range(record.time_s.shape[0] - 1):
        for i in range(STATES):
            states[row + 1, i] = states[row, i]
            for c in range(columns):
                sensitivities[row + 1, i, c] = sensitivities[row, i, c]
        span = record.time_s[row + 1] - record.time_s[row]
        # Slightly over a step is still one step: times are written with rounding.
        count = max(int(np.ceil(span / max_step_s - 1e-6)), 1)
        for i in range(count):
            _step(
                physics, terms, record, row, i * span / count, span / count, states[row + 1],
                sensitivities[row + 1], scratch,
            )  # fmt: skip


def simulate(
    physics: Physics, terms: Terms | None, record: Record, start: Array, max_step_s: float
) -> tuple[Array, Array, Array]:
    """Simulate a window.

    Args:
        physics: the vehicle, with values of the parameters.
        terms: P parameters; None for no derivatives.
        record: T rows.
        start: (10,) state at the first row.
        max_step_s: rows farther apart are crossed in equal steps no longer than this.

    Returns:
        States, (T, 10); predicted sensor readings, (T, 9), see `observe`; and their slopes,
        (T, 9, C) by the C = P + 9 columns, or none.
    """
    free = terms is not None
    known = terms or Terms(*[np.zeros(0, np.int64)] * 3)
    rows, parameters = len(record.time_s), len(known.kind)
    columns = parameters + START if free else 0
    states, sensitivities = np.zeros((rows, STATES)), np.zeros((rows, STATES, columns))
    states[0] = start
    if free:
        # A small turn d about the body's axes changes q by q * (d, 0) / 2.
        x, y, z, s = start[:4]
        turned = 0.5 * np.array([[s, -z, y], [z, s, -x], [-y, x, s], [-x, -y, -z]])
        sensitivities[0, :4, parameters : parameters + 3] = turned
        sensitivities[0, 4:, parameters + 3 :] = np.diag(1.0 - physics.given)
    scratch = scratch_for(columns, record.rps.shape[1])
    _simulate(physics, known, record, max_step_s, scratch, states, sensitivities)
    return states, *observe(physics, known, states, sensitivities, record.attitude)


def observe(
    physics: Physics, terms: Terms, states: Array, sensitivities: Array, attitude: Array
) -> tuple[Array, Array]:
    """Predicted sensor readings, (T, 9), and their slopes, (T, 9, C).

    Velocity over ground and rates in the body frame with their biases, and twice the vector part of
    the turn from the measured attitude to the state's: for small turns the angles about the axes.
    """
    x, y, z, s = quaternion = states[:, :4].T
    mx, my, mz, ms = attitude.T
    cn, ce = physics.current_ne
    # Rows of what turns the current into the body, and its slopes by the quaternion.
    north = np.array([1 - 2 * (y * y + z * z), 2 * (x * y - z * s), 2 * (x * z + y * s)])
    east = np.array([2 * (x * y + z * s), 1 - 2 * (x * x + z * z), 2 * (y * z - x * s)])
    by_turn = 2.0 * np.array([
        [ce * y, ce * x - 2 * cn * y, ce * s - 2 * cn * z, ce * z],
        [cn * y - 2 * ce * x, cn * x, -cn * s - 2 * ce * z, -cn * z],
        [cn * z - ce * s, cn * s + ce * z, cn * x + ce * y, cn * y - ce * x],
    ])  # fmt: skip
    sign = np.where(mx * x + my * y + mz * z + ms * s >= 0.0, 2.0, -2.0)
    away = sign * np.array([
        [ms, mz, -my, -mx], [-mz, ms, mx, -my], [my, -mx, ms, -mz],
    ])  # fmt: skip
    observed = np.empty((len(states), CHANNELS))
    observed[:, :6] = states[:, 4:] + physics.bias
    observed[:, :3] += (cn * north + ce * east).T
    observed[:, 6:] = np.einsum("ijt,jt->ti", away, quaternion)
    slopes = np.empty((len(states), CHANNELS, sensitivities.shape[2]))
    slopes[:, :6] = sensitivities[:, 4:]
    slopes[:, :3] += np.einsum("ijt,tjc->tic", by_turn, sensitivities[:, :4])
    slopes[:, 6:] = np.einsum("ijt,tjc->tic", away, sensitivities[:, :4])
    for k, (kind, row) in enumerate(zip(terms.kind, terms.row, strict=True)):
        if kind == CURRENT:
            slopes[:, :3, k] += (north if row == 0 else east).T
        elif kind == BIAS:
            slopes[:, row, k] += 1.0
    return observed, slopes
