"""Microseconds that the equations of motion take, next to numpy, and the error of a step.

Ours runs from compiled code, as in the simulator. Two twins of the same equations stand next to it,
held against it to rounding: a plain one in numpy, such as a careful script has it (matrices made
once, thrusters as arrays), and the slow textbook twin of the tests. All go round robin, and the
best run of each counts.
"""

import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from alice_survey.core.compiled import kernel
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle import propulsion
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
    current_at,
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
    """One way to the rates of a state, or to the state a step later."""

    what: str
    case: str
    us: float
    ratio: float | None = None
    """Of this time to ours in the same case."""
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


class NumpyTwin:
    """The same equations as a numpy script has them."""

    def __init__(self, vehicle: Vehicle, current: Current) -> None:
        self.body, self.current = vehicle.plant.body, current
        table = vehicle.plant.propulsion.table
        self.table = table
        self.matrix = table[:, propulsion.AXIS : propulsion.FORWARD].T
        self.axes = table[:, propulsion.AXIS : propulsion.ARM].T
        self.water = np.zeros(6)
        self.cg_cross = _cross(self.body.cg)

    def thrust(self, rps: Array, nu: Array) -> Array:
        """(6,) wrench of all thrusters."""
        t = self.table
        column = propulsion
        size, along = np.abs(rps), nu @ self.matrix
        ahead = rps > 0
        gain = np.where(ahead, t[:, column.FORWARD], t[:, column.REVERSE])
        twist = np.where(ahead, t[:, column.TORQUE_FORWARD], t[:, column.TORQUE_REVERSE])
        whole = size * (gain * rps - t[:, column.ADVANCE] * along)
        torque = -t[:, column.HAND] * size * (twist * rps - t[:, column.TORQUE_ADVANCE] * along)
        strength = np.maximum(np.abs(whole), 1e-300)
        u = nu[0]
        thrust = whole * np.exp(-t[:, column.JET_LOSS] * u * u / strength)
        ratio = abs(u) * np.sqrt(t[:, column.JET_AREA] / strength)
        a, b, c, d = t[:, column.DRAG : column.DRAG + 4].T
        force = self.matrix @ (thrust * t[:, column.KEPT])
        force[3:] += self.axes @ torque
        force[0] -= np.sum(a * np.exp(-b * ratio) + c * np.exp(-d * ratio)) * u * abs(u)
        return np.asarray(force)

    def rates(self, time_s: float, state: Array, command_rps: Array, load: Array) -> Array:
        """(13 + n,) rate of change of a state."""
        body, t = self.body, self.table
        nu, rps = state[7:STATE], state[STATE:]
        x, y, z, s = state[3:7]
        rotation = np.array([
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * s), 2 * (x * z + y * s)],
            [2 * (x * y + z * s), 1 - 2 * (x * x + z * z), 2 * (y * z - x * s)],
            [2 * (x * z - y * s), 2 * (y * z + x * s), 1 - 2 * (x * x + y * y)],
        ])  # fmt: skip
        current_at(self.current, time_s, state[2], self.water)
        out = np.empty_like(state)
        out[:3] = rotation @ nu[:3]
        out[:2] += self.water[:2]
        spin = np.array([[s, -z, y], [z, s, -x], [-y, x, s], [-x, -y, -z]])
        out[3:7] = 0.5 * spin @ nu[3:]
        momentum = body.mass @ nu
        coriolis = np.empty(6)
        coriolis[:3] = _cross(nu[3:]) @ momentum[:3]
        coriolis[3:] = _cross(nu[:3]) @ momentum[:3] + _cross(nu[3:]) @ momentum[3:]
        force = load + self.thrust(rps, nu) - coriolis
        quadratic = np.where(nu > 0.0, body.quadratic, body.quadratic_back)
        force += (body.linear + quadratic * np.abs(nu)) @ nu
        u, v, w = nu[:3]
        force[[1, 2, 4, 5]] += body.lift * [abs(u) * v, abs(u) * w, u * w, u * v]
        force[:3] += (body.weight_n - body.buoyancy_n) * rotation[2]
        force[3:] += body.weight_n * (self.cg_cross @ rotation[2])
        along = rotation[:2].T @ (self.water[4:] * out[2])
        force -= body.in_current @ np.concatenate([along, rotation[:2].T @ self.water[2:4]])
        out[7:STATE] = body.mass_inverse @ force
        asked = np.where(np.abs(command_rps) < t[:, propulsion.DEAD_BAND], 0.0, command_rps)
        maximum = t[:, propulsion.MAX_RPS]
        out[STATE:] = (np.clip(asked, -maximum, maximum) - rps) * t[:, propulsion.RATE]
        return out

    def step(self, time_s: float, state: Array, command_rps: Array, load: Array) -> Array:
        """The state 10 ms later, by the classical Runge-Kutta method."""
        h = 0.01
        k1 = self.rates(time_s, state, command_rps, load)
        k2 = self.rates(time_s + h / 2, state + h / 2 * k1, command_rps, load)
        k3 = self.rates(time_s + h / 2, state + h / 2 * k2, command_rps, load)
        k4 = self.rates(time_s + h, state + h * k3, command_rps, load)
        later = state + h / 6 * (k1 + 2 * (k2 + k3) + k4)
        later[3:7] /= np.linalg.norm(later[3:7])
        return later


def _cross(a: Array) -> Array:
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


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
    twin, out = NumpyTwin(vehicle, current), np.zeros_like(start)
    few = max(count // 200, 10)

    def textbook() -> Array:
        eta = np.array([*start[:3], *_ATTITUDE])
        rotation = oracle.ned_from_body(_ATTITUDE)
        water = oracle.water(current, 0.0, start[2])[0]
        ground = start[7:STATE] + np.array([*(rotation.T @ water), 0.0, 0.0, 0.0])
        rates = oracle.derivative(
            0.0, eta, ground, start[STATE:], command, load, vehicle, current, all_laws
        )
        return np.concatenate(rates)

    def ours(loop: Callable[..., None], times: int) -> Array:
        state = start.copy()
        loop(times, state, command, load, plant, current, scratch, out)
        return state

    # The same answers first.
    derivative(0.0, start, command, load, plant, current, scratch, out)
    _same("numpy's rates", twin.rates(0.0, start, command, load), out)
    _same("numpy's step", twin.step(0.0, start, command, load), ours(_steps, 1))
    # Its velocity is over ground; in a steady current the rates differ by the turning of the axes.
    book, turning = textbook(), np.zeros(6)
    turning[:3] = np.cross(_NU[3:], oracle.ned_from_body(_ATTITUDE).T @ [*twin.water[:2], 0.0])
    if not twin.water[2:].any():
        _same("the textbook's rates", book[6:12] + turning, out[7:STATE])

    def numpy_rates() -> None:
        for _ in range(few):
            twin.rates(0.0, start, command, load)

    def numpy_steps() -> None:
        for _ in range(few // 4):
            twin.step(0.0, start, command, load)

    def textbook_rates() -> None:
        for _ in range(few // 4):
            textbook()

    works: dict[str, tuple[Callable[[], object], int]] = {
        "derivative": (lambda: ours(_derivatives, count), count),
        "derivative in numpy": (numpy_rates, few),
        "Runge-Kutta step": (lambda: ours(_steps, count // 4), count // 4),
        "Runge-Kutta step in numpy": (numpy_steps, few // 4),
    }
    if len(current.time_s) == 1:  # it looks a series up by the slowest way
        works["derivative by the textbook, of the tests"] = (textbook_rates, few // 4)
    best = dict.fromkeys(works, math.inf)
    for _ in range(runs):
        for what, (work, times) in works.items():
            started = time.perf_counter()
            work()
            best[what] = min(best[what], (time.perf_counter() - started) / times * 1e6)
    rows = []
    for what, us in best.items():
        own = "Runge-Kutta step" if what.startswith("Runge") else "derivative"
        rows.append(
            Row(
                what=what,
                case=case,
                us=us,
                ratio=None if what == own else us / best[own],
                goal_us=2.0 if what == "derivative" else None,
            )
        )
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


def _same(what: str, found: Array, expected: Array) -> None:
    worst = float(np.abs(found - expected).max())
    if not worst < 1e-9:
        sys.exit(f"{what} differ from ours by {worst:.3g}")


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
    """Ours alone, then next to each twin."""
    own = {(row.what, row.case): row for row in rows if row.ratio is None}
    alone = [
        Figure(
            name=f"{row.what}: {row.case}", value=row.us, unit="us",
            goal=None if row.goal_us is None else Goal(maximum=row.goal_us),
        )
        for row in own.values()
    ]  # fmt: skip
    compared = [
        Figure(name=f"{what}: {case}", value=ours.us, unit="us", peer=row.what, peer_value=row.us)
        for row in rows
        for (what, case), ours in own.items()
        if row.ratio is not None and row.case == case and row.what.startswith(what)
    ]
    return [*alone, *compared]


def table(rows: list[Row]) -> str:
    """The rows in Markdown."""
    lines = ["| what | case | us | per second | of ours | goal, us |", "|---|---|---|---|---|---|"]
    for row in rows:
        ratio = "-" if row.ratio is None else f"{row.ratio:.0f} x"
        goal = "-" if row.goal_us is None else f"{row.goal_us:g}"
        lines.append(
            f"| {row.what} | {row.case} | {row.us:.3g} | {1e6 / row.us:,.0f} | {ratio} | {goal} |"
        )
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
