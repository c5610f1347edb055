"""Microseconds an allocation takes, the exact one, the paper's and those of peers, in the same run.

All solve ALICE's 6 x 5 matrix with four axes requested, for the same wrenches: small ones, as on a
survey line (no thruster at its bound), ones drawn as B f with f anywhere within the bounds, and
ones beyond reach. The peer is called from Python, as its users do; ours from compiled code, as the
simulator does. BVLS must find the same wrench, the pseudo-inverse the same thrust where nothing
saturates.

quadprog, a compiled peer, is GPL and stays out.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import lsq_linear

from alice_survey.core.compiled import kernel
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.allocation import (
    AXIS_WEIGHTS,
    AllocationScratch,
    allocate_exact,
    allocate_rpi,
    allocation_scratch,
)
from alice_survey.sim.vehicle.files import vehicle_from
from alice_survey.sim.vehicle.propulsion import thrust_limits
from benchmarks.figures import Figure, Goal

_COUNT = 500
"""Wrenches of each kind."""
_BEYOND = np.array([120.0, 80.0, 60.0, 0.0, 0.0, 60.0])


@dataclass(frozen=True, kw_only=True)
class Row:
    """One solver on one kind of wrench."""

    solver: str
    wrenches: str
    us: float
    residual: float
    """Mean weighted residual of the wrench, N and N m times `AXIS_WEIGHTS`."""
    goal_us: float | None = None
    """The most that is requested."""


class Case(NamedTuple):
    """What all solvers are given."""

    matrix: Array
    requested: Array
    """(K, 6) wrenches."""
    lower: Array
    upper: Array
    axes: Array
    weights: Array
    scratch: AllocationScratch


@kernel
def _exact(case: Case, thrust: Array) -> None:
    for k in range(thrust.shape[0]):
        allocate_exact(
            case.matrix, case.requested[k], case.lower, case.upper, case.axes, case.weights,
            thrust[k], case.scratch,
        )  # fmt: skip


@kernel
def _rpi(case: Case, thrust: Array) -> None:
    for k in range(thrust.shape[0]):
        allocate_rpi(
            case.matrix, case.requested[k], case.lower, case.upper, case.axes, case.weights,
            thrust[k], case.scratch,
        )  # fmt: skip


def _bvls(case: Case, thrust: Array) -> None:
    a = (case.axes[:, None] * case.matrix)[case.axes > 0]
    for wrench, row in zip(case.requested, thrust, strict=True):
        b = (case.axes * wrench)[case.axes > 0]
        row[:] = lsq_linear(a, b, (case.lower, case.upper), method="bvls", tol=1e-14).x


_SOLVERS: dict[str, Callable[[Case, Array], None]] = {
    "exact": _exact,
    "pseudo-inverse": _rpi,
    "scipy's lsq_linear, BVLS": _bvls,
}


def measure(runs: int) -> list[Row]:
    """All rows; each solver does all wrenches repeatedly, in turns, and its best run counts."""
    alice = vehicle_from("alice")
    matrix, count = alice.configuration_matrix, len(alice.thrusters)
    lower, upper = np.zeros(count), np.zeros(count)
    thrust_limits(alice.plant.propulsion, np.ones(count), np.zeros(6), lower, upper)
    rng = np.random.default_rng(1)
    kinds = {
        "on a line": 0.1 * rng.uniform(lower, upper, (_COUNT, count)) @ matrix.T,
        "within reach": rng.uniform(lower, upper, (_COUNT, count)) @ matrix.T,
        "beyond reach": rng.normal(size=(_COUNT, 6)) * _BEYOND,
    }
    rows = []
    for kind, requested in kinds.items():
        case = Case(
            matrix, requested, lower, upper, AXIS_WEIGHTS, np.ones(count), allocation_scratch(count)
        )
        thrusts = {name: np.zeros((_COUNT, count)) for name in _SOLVERS}
        seconds = dict.fromkeys(_SOLVERS, np.inf)
        for run in range(runs + 1):
            for name, solve in _SOLVERS.items():
                started = time.perf_counter()
                solve(case, thrusts[name])
                if run:
                    seconds[name] = min(seconds[name], time.perf_counter() - started)
        made = {name: AXIS_WEIGHTS * (t @ matrix.T) for name, t in thrusts.items()}
        _same("BVLS finds another wrench", made["scipy's lsq_linear, BVLS"], made["exact"], 1e-6)
        if kind == "on a line":
            _same("another thrust", thrusts["pseudo-inverse"], thrusts["exact"], 1e-4)
        rows += [
            Row(
                solver=name,
                wrenches=kind,
                us=seconds[name] / _COUNT * 1e6,
                residual=float(
                    np.linalg.norm(made[name] - AXIS_WEIGHTS * requested, axis=1).mean()
                ),
                goal_us=5.0 if name == "exact" else None,
            )
            for name in _SOLVERS
        ]
    return rows


def _same(what: str, found: Array, expected: Array, limit: float) -> None:
    if not np.abs(found - expected).max() <= limit:
        sys.exit(f"{what} than the exact allocation does")


def figures(rows: list[Row]) -> list[Figure]:
    """The exact allocation alone, next to each of the others, and what each leaves."""
    own = {row.wrenches: row for row in rows if row.solver == "exact"}
    alone = [
        Figure(
            name=f"exact allocation, {kind}", value=row.us, unit="us",
            goal=None if row.goal_us is None else Goal(maximum=row.goal_us),
        )
        for kind, row in own.items()
    ]  # fmt: skip
    compared = [
        Figure(
            name=f"exact allocation, {row.wrenches}", value=own[row.wrenches].us, unit="us",
            peer=row.solver, peer_value=row.us,
        )
        for row in rows
        if row.solver != "exact"
    ]  # fmt: skip
    residuals = [
        Figure(
            name=f"{row.solver}, {row.wrenches}: mean residual",
            value=row.residual,
            unit="N, weighted",
        )
        for row in rows
    ]
    return [*alone, *compared, *residuals]


def table(rows: list[Row]) -> str:
    """The rows in Markdown."""
    lines = [
        "| solver | wrenches | us a solve | mean residual | goal, us |",
        "|---|---|---|---|---|",
    ]
    for row in rows:
        goal = "-" if row.goal_us is None else f"{row.goal_us:g}"
        residual = "-" if row.residual < 1e-3 else f"{row.residual:.4g}"
        lines.append(f"| {row.solver} | {row.wrenches} | {row.us:.3g} | {residual} | {goal} |")
    return "\n".join(lines)


if __name__ == "__main__":
    print(table(measure(5)))
