"""Microseconds that the equations of motion take, and the error of a step.

Both run from compiled code, as in the simulator; the best run of each counts. The errors are
against the slow textbook twin of the tests by an adaptive method.
"""

import math
import time
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from alice_survey.core.compiled import kernel
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.dynamics import (
    STATE,
    Plant,
    Scratch,
    derivative,
    initial_state,
    rk4_step,
    scratch_for,
)
from alice_survey.sim.vehicle.files import vehicle_from
from alice_survey.sim.vehicle.sea import (
    Current,
    constant_current,
    sheared_current,
    varying_current,
)
from alice_survey.sim.vehicle.vehicle import Vehicle
from benchmarks.figures import Figure, Goal
from tests import oracles_dynamics as oracle
from tests.oracles_propulsion import wrench

_SHEAR = sheared_current(np.linspace(0.0, 30.0, 10), np.linspace([0.3, 20.0], [0.1, 60.0], 10))
_NU = np.array([0.3, -0.05, 0.04, 0.05, -0.03, 0.1])
_ATTITUDE = np.array([0.1, -0.05, 0.7])


@dataclass(frozen=True, kw_only=True)
class Row:
    """The rates of a state, or the state a step later."""

    what: str
    case: str
    us: float
    goal_us: float | None = None


@dataclass(frozen=True, kw_only=True)
class Accuracy:
    """Largest errors over a motion, against an adaptive method of order 8."""

    step_ms: float
    position_m: float
    attitude_rad: float
    velocity: float
    """m/s and rad/s."""

    def figures(self) -> list[Figure]:
        """All three."""
        errors = (
            ("position", self.position_m, "m"),
            ("attitude", self.attitude_rad, "rad"),
            ("velocity", self.velocity, "m/s, rad/s"),
        )
        return [
            Figure(name=f"steps of {self.step_ms:g} ms: largest error of {what}", value=value,
                   unit=unit)
            for what, value, unit in errors
        ]  # fmt: skip


@kernel
def _derivatives(
    count: int,
    state: Array,
    command_rps: Array,
    load: Array,
    plant: Plant,
    current: Current,
    scratch: Scratch,
    out: Array,
) -> None:
    for i in range(count):
        derivative(1e-3 * i, state, command_rps, load, plant, current, scratch, out)
        state[2] += 1e-9 * out[2]  # each needs the one before


@kernel
def _steps(
    count: int,
    state: Array,
    command_rps: Array,
    load: Array,
    plant: Plant,
    current: Current,
    scratch: Scratch,
    out: Array,
) -> None:
    for i in range(count):
        rk4_step(0.01 * i, 0.01, state, command_rps, load, plant, current, scratch)


def measure(count: int, runs: int) -> list[Row]:
    """All rows.

    Args:
        count: derivatives, and steps, that one run of ours takes.
        runs: how many runs of each; the best counts.
    """
    mixed = varying_current(_SHEAR, 0.03, 60.0, 3600.0, np.random.default_rng(1))
    cases = {
        "ALICE, steady current": (vehicle_from("alice"), constant_current(0.1, 90.0)),
        "ALICE, current by depth and time": (vehicle_from("alice"), mixed),
        "SPARUS II, steady current": (vehicle_from("sparus2"), constant_current(0.1, 90.0)),
    }
    rows: list[Row] = []
    for case, (vehicle, current) in cases.items():
        rows += _measure_case(case, vehicle, current, count, runs)
    return rows


def _measure_case(
    case: str, vehicle: Vehicle, current: Current, count: int, runs: int
) -> list[Row]:
    n = len(vehicle.thrusters)
    plant, scratch, load = vehicle.plant, scratch_for(n), np.array([1.0, 0, 0, 0, 0, 0.1])
    command = np.array([30.0, 28.0, 12.0, -20.0, 25.0])[:n]
    start = initial_state(np.array([3.0, -2.0, 7.0]), _ATTITUDE, n, _NU)
    start[STATE:] = 0.8 * command
    rows = []
    for what, loop, times, goal_us in (
        ("derivative", _derivatives, count, 2.0),
        ("Runge-Kutta step", _steps, count // 4, None),
    ):
        best = math.inf
        for _ in range(runs):
            state, out = start.copy(), np.zeros_like(start)
            started = time.perf_counter()
            loop(times, state, command, load, plant, current, scratch, out)
            best = min(best, (time.perf_counter() - started) / times * 1e6)
        rows.append(Row(what=what, case=case, us=best, goal_us=goal_us))
    return rows


def first_step() -> None:
    """Compile, or load, the equations of motion."""
    vehicle = vehicle_from("alice")
    state = initial_state(np.zeros(3), np.zeros(3), 5)
    still = constant_current(0.0, 0.0)
    rk4_step(0.0, 0.01, state, np.zeros(5), np.zeros(6), vehicle.plant, still, scratch_for(5))


def all_laws(vehicle: Vehicle, rps: Array, nu: Array) -> Array:
    """The wrench of thrusters by the tests' twin."""
    body = vehicle.rigid_body
    displaced_kg = body.buoyancy_kg + body.entrained_kg
    return wrench(vehicle.thrusters, vehicle.density_kg_m3, displaced_kg, rps, nu)


def accuracy(seconds: int) -> list[Accuracy]:
    """Errors of steps of 5, 10 and 20 ms.

    Args:
        seconds: a motion with thrusters changed at will every 4 s, pushes besides, in a current
            that changes with depth and time.
    """
    vehicle = vehicle_from("alice")
    current = Current(
        np.array([-10.0, 100.0]),
        np.array([-50.0, 100.0]),
        np.array([[[0.1, -0.05], [-0.2, 0.15]], [[-0.1, 0.1], [0.25, 0.05]]]),
    )
    rng = np.random.default_rng(3)
    times = np.arange(0.0, seconds + 1.0, 4.0)
    commands = rng.uniform(-0.7, 0.9, (len(times) - 1, 5)) * np.array([40, 40, 30, 40, 40])
    loads = rng.uniform(-1, 1, (len(times) - 1, 6)) * np.array([3, 3, 3, 0.5, 0.5, 0.5])
    eta, velocity, _ = oracle.integrate(
        vehicle, current, np.array([0.0, 0.0, 5.0, *_ATTITUDE]), _NU, np.zeros(5), times, commands,
        loads, all_laws,
    )  # fmt: skip
    truth = Rotation.from_matrix([oracle.ned_from_body(row[3:]) for row in eta])
    scratch = scratch_for(5)
    found = []
    for step_ms in (5, 10, 20):
        state = initial_state(np.array([0.0, 0.0, 5.0]), _ATTITUDE, 5, _NU)
        rows = [state.copy()]
        for time_s, command, load in zip(times, commands, loads, strict=False):
            for i in range(4000 // step_ms):
                rk4_step(
                    time_s + i * step_ms / 1e3, step_ms / 1e3, state, command, load, vehicle.plant,
                    current, scratch,
                )  # fmt: skip
            rows.append(state.copy())
        states = np.array(rows)
        turned = Rotation.from_quat(states[:, 3:7]).inv() * truth
        found.append(
            Accuracy(
                step_ms=step_ms,
                position_m=float(np.abs(states[:, :3] - eta[:, :3]).max()),
                attitude_rad=float(turned.magnitude().max()),
                velocity=float(np.abs(states[:, 7:STATE] - velocity).max()),
            )
        )
    return found


def figures(rows: list[Row]) -> list[Figure]:
    """The times and their goals."""
    return [
        Figure(
            name=f"{row.what}: {row.case}", value=row.us, unit="us",
            goal=None if row.goal_us is None else Goal(maximum=row.goal_us),
        )
        for row in rows
    ]  # fmt: skip


def table(rows: list[Row]) -> str:
    """The rows in Markdown."""
    lines = ["| what | case | us | per second | goal, us |", "|---|---|---|---|---|"]
    for row in rows:
        goal = "-" if row.goal_us is None else f"{row.goal_us:g}"
        lines.append(f"| {row.what} | {row.case} | {row.us:.3g} | {1e6 / row.us:,.0f} | {goal} |")
    return "\n".join(lines)


def accuracy_table(rows: list[Accuracy]) -> str:
    """The errors in Markdown."""
    lines = ["| step, ms | position, m | attitude, rad | velocity, m/s and rad/s |"]
    lines.append("|---|---|---|---|")
    lines += [
        f"| {row.step_ms:g} | {row.position_m:.2g} | {row.attitude_rad:.2g} | {row.velocity:.2g} |"
        for row in rows
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    print(table(measure(20_000, 3)))
    print(accuracy_table(accuracy(20)))
