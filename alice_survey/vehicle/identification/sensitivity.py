"""The motion over a window of a log, and its derivatives by start and parameters.

With x' = f(x, parameters), the sensitivities S = dx/d(columns) follow
S' = (df/dx) S + df/d(columns) (forward sensitivities; e.g. Hairer, Norsett & Wanner, Solving
Ordinary Differential Equations I, I.14). Both are carried through the same Runge-Kutta steps, so
that S is the derivative of the numerical solution itself. Columns are the parameters, then the
start: three small turns about the body's axes and the six of nu.

A constant current moves the water that nu is relative to: it enters the measured velocity over
ground only.
"""

import math
from typing import NamedTuple

import numpy as np

from alice_survey.base.frames import Array
from alice_survey.vehicle.compiled import kernel
from alice_survey.vehicle.identification.slopes import (
    BIAS,
    CURRENT,
    STATES,
    Physics,
    SlopeScratch,
    Terms,
    rate_of,
    slope_by_parameters,
    slope_by_state,
)
from alice_survey.vehicle.rotations import matrix_rows

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
    rate_of(physics, state, scratch.rps, scratch.load, scratch.acceleration, scratch.force[0], rate)
    slope_by_state(physics, state, scratch.rps, scratch.load, scratch)
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
    hold: bool,
    state: Array,
    sensitivity: Array,
    scratch: SlopeScratch,
) -> None:
    """Advance a state and its sensitivities by one classical Runge-Kutta step.

    Between two rows a wrench is linear, and a thruster's speed as a first-order lag with its
    time constant does under a constant command: straight if slow, and exact for a thruster that is
    commanded with each row. Held inputs stay at the first row's.
    """
    span = record.time_s[row + 1] - record.time_s[row]
    total, trial = scratch.stage[1], scratch.stage[2]
    totals, trials = scratch.stages[1], scratch.stages[2]
    columns, lags = sensitivity.shape[1], physics.lag_s
    for j in range(6):
        scratch.acceleration[j] = record.acceleration[row, j]
    for k in range(4):
        at = begin + step_s * (0.0 if k == 0 else (1.0 if k == 3 else 0.5))
        share = 0.0 if hold else at / span
        for j in range(scratch.rps.shape[0]):
            lag, part = lags[j], share
            if not hold and lag > 0.0:
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
def observe(
    physics: Physics,
    terms: Terms,
    state: Array,
    sensitivity: Array,
    attitude: Array,
    out: Array,
    slopes: Array,
) -> None:
    """Write the predicted sensor readings, (9,), and their slopes, (9, C).

    Velocity over ground and rates in the body frame with their biases, and twice the vector part of
    the turn from the measured attitude to the state's: for small turns the angles about the axes.
    """
    x, y, z, s = state[0], state[1], state[2], state[3]
    cn, ce = physics.current_ne[0], physics.current_ne[1]
    columns, parameters = sensitivity.shape[1], terms.kind.shape[0]
    (r00, r01, r02), (r10, r11, r12), _ = matrix_rows(x, y, z, s)
    out[0] = state[4] + r00 * cn + r10 * ce
    out[1] = state[5] + r01 * cn + r11 * ce
    out[2] = state[6] + r02 * cn + r12 * ce
    for i in range(3):
        out[3 + i] = state[7 + i]
    for i in range(6):
        out[i] += physics.bias[i]
    mx, my, mz, ms = attitude[0], attitude[1], attitude[2], attitude[3]
    turn = 2.0 if mx * x + my * y + mz * z + ms * s >= 0.0 else -2.0
    out[6] = turn * (ms * x - mx * s - my * z + mz * y)
    out[7] = turn * (ms * y - my * s - mz * x + mx * z)
    out[8] = turn * (ms * z - mz * s - mx * y + my * x)
    for c in range(columns):
        dx, dy, dz, ds = (
            sensitivity[0, c], sensitivity[1, c], sensitivity[2, c], sensitivity[3, c],
        )  # fmt: skip
        slopes[0, c] = (
            sensitivity[4, c]
            - 4 * cn * (y * dy + z * dz)
            + 2 * ce * (y * dx + x * dy + s * dz + z * ds)
        )
        slopes[1, c] = (
            sensitivity[5, c]
            + 2 * cn * (y * dx + x * dy - s * dz - z * ds)
            - 4 * ce * (x * dx + z * dz)
        )
        slopes[2, c] = (
            sensitivity[6, c]
            + 2 * cn * (z * dx + s * dy + x * dz + y * ds)
            + 2 * ce * (-s * dx + z * dy + y * dz - x * ds)
        )
        for i in range(3):
            slopes[3 + i, c] = sensitivity[7 + i, c]
        slopes[6, c] = turn * (ms * dx - mx * ds - my * dz + mz * dy)
        slopes[7, c] = turn * (ms * dy - my * ds - mz * dx + mx * dz)
        slopes[8, c] = turn * (ms * dz - mz * ds - mx * dy + my * dx)
    for k in range(parameters):
        if terms.kind[k] == CURRENT and terms.row[k] == 0:
            slopes[0, k] += r00
            slopes[1, k] += r01
            slopes[2, k] += r02
        elif terms.kind[k] == CURRENT:
            slopes[0, k] += r10
            slopes[1, k] += r11
            slopes[2, k] += r12
        elif terms.kind[k] == BIAS:
            slopes[terms.row[k], k] += 1.0


@kernel
def simulate(
    physics: Physics,
    terms: Terms,
    record: Record,
    start: Array,
    longest_step_s: float,
    hold: bool,
    scratch: SlopeScratch,
    sensitivity: Array,
    states: Array,
    observed: Array,
    slopes: Array,
) -> None:
    """Simulate a window.

    Args:
        physics: the vehicle, with values of the parameters.
        terms: P parameters.
        record: T rows.
        start: (10,) state at the first row.
        longest_step_s: rows farther apart are crossed in equal steps no longer than this.
        hold: the input stays what it was in a row until the next.
        scratch: for C = P + 9 columns; or for none, with no terms.
        sensitivity: (10, C) room.
        states: (T, 10) is written.
        observed: (T, 9) is written, see `observe`.
        slopes: (T, 9, C) is written.
    """
    columns, parameters = sensitivity.shape[1], terms.kind.shape[0]
    sensitivity[:, :] = 0.0
    scratch.by_column[:, :] = 0.0
    for i in range(STATES):
        states[0, i] = start[i]
    if columns > parameters:
        # A small turn d about the body's axes changes q by q * (d, 0) / 2.
        x, y, z, s = start[0], start[1], start[2], start[3]
        c = parameters
        sensitivity[0, c], sensitivity[0, c + 1], sensitivity[0, c + 2] = 0.5 * s, -0.5 * z, 0.5 * y
        sensitivity[1, c], sensitivity[1, c + 1], sensitivity[1, c + 2] = 0.5 * z, 0.5 * s, -0.5 * x
        sensitivity[2, c], sensitivity[2, c + 1], sensitivity[2, c + 2] = -0.5 * y, 0.5 * x, 0.5 * s
        sensitivity[3, c], sensitivity[3, c + 1], sensitivity[3, c + 2] = (
            -0.5 * x, -0.5 * y, -0.5 * z,
        )  # fmt: skip
        for i in range(6):
            sensitivity[4 + i, c + 3 + i] = 1.0 - physics.given[i]
    for row in range(record.time_s.shape[0]):
        observe(
            physics, terms, states[row], sensitivity, record.attitude[row], observed[row],
            slopes[row],
        )  # fmt: skip
        if row + 1 == record.time_s.shape[0]:
            break
        for i in range(STATES):
            states[row + 1, i] = states[row, i]
        span = record.time_s[row + 1] - record.time_s[row]
        # Slightly over a step is still one step: times are written with rounding.
        count = max(int(np.ceil(span / longest_step_s - 1e-6)), 1)
        for i in range(count):
            _step(
                physics, terms, record, row, i * span / count, span / count, hold, states[row + 1],
                sensitivity, scratch,
            )  # fmt: skip
