"""The paper's calibration: damping from velocities and added mass from accelerations, in turn.

After the bollard pull has settled the thrust, surge, heave and turns are taken one after the other
(paper, the section on model calibration). Measured velocities go into the equations of motion,
averaged over a second so that the rates are those of straight lines through the velocities. Rows
with little acceleration give the damping of a motion, those with much its added mass. The paper
adjusted one coefficient after the other by hand until the curves met; here each is a least-squares
regression, and all are repeated until they agree.

It needs no simulation and no start, but it takes measured velocities as true, so noise biases the
coefficients towards zero, and it cannot find a current. The joint fit has neither limit.

Thrust coefficients from a bollard pull: speeds, and the force of the moored vehicle.

The CSV has the columns `thruster`, `rpm` and `force_n`. Force and speed have one sign: positive
pushes the vehicle along the thruster's direction. Thrusters that pulled together at one speed are
joined by `+`, as in `port+starboard`, and share their coefficients.

The force is net of what the vehicle's model takes off at rest, such as thrust deduction.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, model_validator
from scipy.signal import fftconvolve, savgol_filter
from scipy.spatial.transform import Rotation

from alice_survey.core.artefacts import read_csv
from alice_survey.core.config import Config
from alice_survey.core.contents import is_unknown
from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array
from alice_survey.core.run.progress import step as named_step
from alice_survey.sim.vehicle.dynamics import forces_over_time
from alice_survey.sim.vehicle.identification import sensitivity as term
from alice_survey.sim.vehicle.identification.output_error import (
    in_stretches,
    jackknife_covariance,
    stretch_numbers,
)
from alice_survey.sim.vehicle.identification.problem import OTHERS, Mask, Parameters, Window
from alice_survey.sim.vehicle.vehicle import Vehicle, parse_table


class Pull(Config):
    """One reading."""

    thruster: Annotated[
        tuple[Annotated[str, Field(min_length=1)], ...],
        BeforeValidator(lambda text: [name.strip() for name in text.split("+")]),
    ]
    rpm: float
    force_n: float

    @model_validator(mode="after")
    def _check_signs(self) -> Self:
        if is_unknown(self.rpm) or is_unknown(self.force_n):
            raise ValueError(f"{self.rpm:g} rpm, {self.force_n:g} N: one stands for unknown")
        if self.rpm == 0 or self.rpm * self.force_n < 0:
            raise ValueError(
                f"{self.force_n:g} N at {self.rpm:g} rpm: force and speed must have one sign"
            )
        return self


@dataclass(frozen=True, kw_only=True)
class ThrustCoefficient:
    """k_t of one way of one or several thrusters."""

    thrusters: tuple[str, ...]
    way: str
    """`forward` or `reverse`."""
    model: float
    """k_t before the calibration."""
    identified: float
    sigma: float
    """Standard deviation; NaN for a single reading."""
    readings: int

    @property
    def factor(self) -> float:
        """Ratio of identified to model value."""
        return self.identified / self.model


def read_pulls(path: Path) -> list[Pull]:
    """Read a bollard pull.

    Raises:
        VehicleError: the file cannot be read, lacks a column, has no rows, or holds a value that is
            not a number, or a force against its speed.
    """
    own = Pull.model_fields
    _, rows = read_csv(path, own, known=own, fault=VehicleError)
    pulls = [
        parse_table(f"{path} line {line}", Pull, {name: row[name] for name in own})
        for line, row in rows
    ]
    if not pulls:
        raise VehicleError(f"{path}: has no rows")
    return pulls


def fit_pulls(pulls: Sequence[Pull], vehicle: Vehicle) -> list[ThrustCoefficient]:
    """k_t by least squares, forward and reverse, of every thruster that pulled.

    Raises:
        VehicleError: the vehicle has no such thruster, or one pulled alone and with others, or not
            at all.
    """
    by_name = {thruster.name: thruster for thruster in vehicle.thrusters}
    groups = sorted({pull.thruster for pull in pulls})
    seen: set[str] = set()
    found = []
    for group in groups:
        for name in group:
            if name not in by_name:
                raise VehicleError(f"{vehicle.name} has no thruster {name!r} that could pull")
            if name in seen:
                raise VehicleError(f"{name} pulled alone and with others: keep one kind of reading")
            seen.add(name)
        for way, sign in (("forward", 1.0), ("reverse", -1.0)):
            rows = [pull for pull in pulls if pull.thruster == group and sign * pull.rpm > 0]
            if not rows:
                continue
            unit = np.array([_unit_force(vehicle, group, pull.rpm / 60.0) for pull in rows])
            force = np.array([pull.force_n for pull in rows])
            square = float(unit @ unit)
            value = float(unit @ force) / square
            if value == 0:
                raise VehicleError(f"{'+'.join(group)}: all {way} readings are 0 N: leave them out")
            rest = force - value * unit
            free = len(rows) - 1
            sigma = float(np.sqrt(rest @ rest / free / square)) if free else float("nan")
            models = [getattr(by_name[name], f"kt_{way}") for name in group]
            found.append(
                ThrustCoefficient(
                    thrusters=group,
                    way=way,
                    model=float(np.mean(models)),
                    identified=value,
                    sigma=sigma,
                    readings=len(rows),
                )
            )
    return found


def with_thrust(vehicle: Vehicle, found: Sequence[ThrustCoefficient]) -> Vehicle:
    """The vehicle with other k_t; k_q follows k_t^1.5, the figure of merit stays."""
    changed = []
    for thruster in vehicle.thrusters:
        values: dict[str, Any] = {}
        for one in found:
            if thruster.name in one.thrusters:
                ratio = one.identified / float(getattr(thruster, f"kt_{one.way}"))
                values[f"kt_{one.way}"] = one.identified
                values[f"kq_{one.way}"] = float(getattr(thruster, f"kq_{one.way}")) * ratio**1.5
        changed.append(replace(thruster, **values))
    return replace(vehicle, thrusters=tuple(changed))


def _unit_force(vehicle: Vehicle, group: tuple[str, ...], rps: float) -> float:
    """Force along their directions, N, of thrusters with k_t = 1 at rest in the water."""
    return sum(
        (1.0 - t.thrust_deduction) * vehicle.density_kg_m3 * t.diameter_m**4 * rps * abs(rps)
        for t in vehicle.thrusters
        if t.name in group
    )


STEPS = (("surge", "X"), ("heave", "ZM"), ("turns", "NYK"))
"""Coefficients calibrated in turn, and the equations that determine them."""
_SMOOTH_S = 1.0
"""Time over which the equations are averaged."""
_PASSES, _AGREED = 60, 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class TwoStep:
    """Coefficients by the paper's calibration."""

    parameters: Parameters
    values: Array
    """(P,)"""
    sigma: Array
    """(P,) sigmas of the regressions."""
    step: tuple[str, ...]
    """(P,) step in which each was calibrated."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Rows:
    """Motion at equal steps, rows of all windows."""

    states: Array
    """(T, 10) as measured."""
    accelerations: Array
    """(T, 6) slopes of straight lines over `_SMOOTH_S`."""
    inner: Mask
    """(T,) rows at least half of `_SMOOTH_S` from either end of their window."""
    weights: tuple[Array, ...]
    """By window: the slope of a straight line is the mean of the derivative with these weights."""
    rps: Array
    wrench: Array
    runs: tuple[int, ...]
    """Number of rows of each window."""
    stretches: tuple[NDArray[np.intp], ...]
    """By window: the number of the stretch of each row, which sigmas leave out in turn."""


@named_step("fit in two steps")
def calibrate(windows: Sequence[Window], parameters: Parameters) -> TwoStep:
    """Calibrate coefficients in turn.

    Args:
        windows: windows of manoeuvres, with velocities and rates.
        parameters: coefficients to free.

    Raises:
        VehicleError: a free parameter is not a coefficient, or the rows do not determine one.
    """
    strange = [name for name in parameters.names if name in OTHERS]
    if strange:
        raise VehicleError(
            f"the two-step calibration knows coefficients only, not {', '.join(strange)}: use "
            "--method joint"
        )
    rows = _smooth(windows, parameters)
    values, sigma = parameters.start.copy(), np.full(len(parameters.names), np.nan)
    steps = [""] * len(parameters.names)
    for _ in range(_PASSES):
        before = values.copy()
        for step, forces in STEPS:
            for force in forces:
                places = [k for k, name in enumerate(parameters.names) if name[0] == force]
                for k in places:
                    steps[k] = step
                inertial = [k for k in places if parameters.terms.kind[k] == term.ADDED_MASS]
                damping = [k for k in places if k not in inertial]
                for group, much in ((damping, False), (inertial, True)):
                    if group:
                        _regress(rows, parameters, values, sigma, group, much)
        scale = np.maximum(np.abs(values), 1e-12)
        if np.max(np.abs(values - before) / scale) < _AGREED:
            break
    else:
        raise VehicleError(
            f"added mass and damping do not agree after {_PASSES} passes: free fewer of them, or "
            "add manoeuvres"
        )
    return TwoStep(parameters=parameters, values=values, sigma=sigma, step=tuple(steps))


def _regress(
    rows: _Rows, parameters: Parameters, values: Array, sigma: Array, group: list[int], much: bool
) -> None:
    """Write the coefficients of a group, all of one force, from rows of much or little change."""
    terms = parameters.terms
    force = int(terms.row[group[0]])
    now = values.copy()
    if not much:
        now[group] = 0.0
    physics = parameters.physics(now)
    down = Rotation.from_quat(rows.states[:, :4]).inv().apply([0.0, 0.0, 1.0])
    nu = np.ascontiguousarray(rows.states[:, 4:])
    hull, thrust = forces_over_time(physics.body, physics.propulsion, nu, down, rows.rps)
    forces = hull + thrust.sum(axis=1) + physics.gain * rows.wrench
    known = physics.body.mass[force] @ rows.accelerations.T
    known -= _average(rows, forces[:, force : force + 1])[:, 0]
    if much:
        # Inertia was kept for the Coriolis forces; its part of this row is the unknown.
        for k in group:
            known += values[k] * rows.accelerations[:, terms.column[k]]
    regressors = [_regressor(rows, int(terms.kind[k]), force, int(terms.column[k])) for k in group]
    table = np.stack(regressors, axis=1)
    if not much:
        table = _average(rows, table)
    change = np.abs(rows.accelerations[:, force])
    usual = float(np.median(change[rows.inner]))
    chosen = rows.inner & ((change > usual) if much else (change <= usual))
    x, y = table[chosen], known[chosen]
    information = x.T @ x
    names = [parameters.names[k] for k in group]
    scale = np.sqrt(np.diag(information))
    if np.any(scale == 0) or np.linalg.cond(information / np.outer(scale, scale)) > 1e10:
        raise VehicleError(f"the logs do not determine {', '.join(names)}: do not free all of them")
    values[group] = np.linalg.solve(information, x.T @ y)
    residual = y - x @ values[group]
    white = float(residual @ residual) / max(len(y) - len(group), 1)
    stretches = in_stretches(residual, x, np.concatenate(rows.stretches)[chosen])
    spread = jackknife_covariance(stretches, np.zeros_like(information))
    covariance = white * np.linalg.inv(information) if spread is None else spread
    sigma[group] = np.sqrt(np.diag(covariance))


def _average(rows: _Rows, table: Array) -> Array:
    """Weighted means, (T, K), over sliding stretches of columns (T, K)."""
    cuts = np.cumsum(rows.runs)[:-1]
    runs = zip(np.split(table, cuts), rows.weights, strict=True)
    return np.concatenate([
        fftconvolve(run, weights[:, None], mode="same", axes=0) for run, weights in runs
    ])  # fmt: skip


def _regressor(rows: _Rows, kind: int, force: int, motion: int) -> Array:
    """Factor of a coefficient, (T,): its force moved to the side of the inertia."""
    nu = rows.states[:, 4:]
    if kind == term.ADDED_MASS:
        return rows.accelerations[:, motion]
    if kind == term.LINEAR:
        return nu[:, motion]
    if kind == term.LIFT:
        first = np.abs(nu[:, 0]) if force < 3 else nu[:, 0]
        return first * nu[:, motion]
    return nu[:, motion] * np.abs(nu[:, motion])


def _smooth(windows: Sequence[Window], parameters: Parameters) -> _Rows:
    """Motion relative to the water and its rates, by sliding straight lines."""
    physics = parameters.physics(parameters.start)
    pieces = []
    for window in windows:
        time_s = window.record.time_s
        step = float(np.median(np.diff(time_s)))
        length = max(2 * round(0.5 * _SMOOTH_S / step) + 1, 5)
        if len(time_s) < length:
            continue
        even = np.arange(time_s[0], time_s[-1] + 0.5 * step, step)
        motion = np.empty((len(even), 6))
        attitude = _attitude(window, even)
        for k in range(6):
            known = np.isfinite(window.measured[:, k])
            if known.sum() < 2:
                raise VehicleError(
                    f"{window.source}: the two-step calibration needs u, v, w, p, q and r; "
                    f"{'uvwpqr'[k]} was not measured"
                )
            motion[:, k] = np.interp(even, time_s[known], window.measured[known, k])
        motion -= physics.bias
        motion[:, :3] -= attitude.inv().apply([*physics.current_ne, 0.0])
        rates = savgol_filter(motion, length, 1, deriv=1, delta=step, axis=0)
        state = np.empty((len(even), term.STATES))
        state[:, :4], state[:, 4:] = attitude.as_quat(), motion
        inputs = [
            np.stack([np.interp(even, time_s, column) for column in table.T], axis=1)
            if table.shape[1]
            else np.zeros((len(even), 0))
            for table in (window.record.rps, window.record.wrench)
        ]
        away = np.arange(length) - length // 2
        # Summed by parts, the slope sum(t u) / sum(t^2) weighs the derivative by a parabola.
        parabola = (length // 2 + 1.0) ** 2 - away**2
        place = np.arange(len(even))
        inner = (place >= length // 2) & (place < len(even) - length // 2)
        pieces.append((state, rates, *inputs, inner, even, parabola / parabola.sum()))
    if not pieces:
        raise VehicleError(f"no stretch of the logs is {_SMOOTH_S:g} s long")
    *tables, times, weights = zip(*pieces, strict=True)
    states, accelerations, rps, wrench, inside = (np.concatenate(table) for table in tables)
    return _Rows(
        states=states, accelerations=accelerations, inner=inside, weights=weights, rps=rps,
        wrench=wrench, runs=tuple(len(state) for state in tables[0]),
        stretches=tuple(stretch_numbers([*times])),
    )  # fmt: skip


def _attitude(window: Window, at_s: Array) -> Rotation:
    """Attitudes at times, interpolated between the measured ones; the nearest before and after."""
    from scipy.spatial.transform import Slerp

    known = np.all(np.isfinite(window.record.attitude), axis=1)
    time_s = window.record.time_s[known]
    rotations = Rotation.from_quat(window.record.attitude[known])
    if len(time_s) == 1:
        return Rotation.from_quat(np.tile(window.record.attitude[known], (len(at_s), 1)))
    return Slerp(time_s, rotations)(np.clip(at_s, time_s[0], time_s[-1]))
