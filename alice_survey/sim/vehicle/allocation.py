"""Thrust allocation: which thrusters make a wrench.

Both solvers take the requested wrench (6,) and an `Allocation`: the matrix B (6, n), the bounds of
thrust (n,), the weights of axes (6,) and of thrusters (n,); they write its thrust (n,):

- `allocate_exact`: the least weighted residual within the bounds and, of all ways to it, the least
  weighted thrust;
- `allocate_rpi`: the redistributed pseudo-inverse of the paper.

An axis of weight 0 is not requested: gravity handles roll and pitch, unless thrusters can. The
others decide what is given up when not all is attainable, by the square of their weights times the
squared residual.
A failed thruster has the bounds 0 and 0. A wrench that is not a number gives NaN thrusts.

The exact solver: bounded weighted least squares, then least thrust, by two small active sets.
First the least |W_tau (B f - tau)| within the bounds, by the method of C. L. Lawson and R. J.
Hanson, Solving Least Squares Problems, 1974, chapter 23, extended to two bounds (P. B. Stark and
R. L. Parker, Computational Statistics 10, 1995). B has rank 4 and five thrusters: the steps are
those of least norm, so that a rank-deficient set of free thrusters does no harm. The best
wrench is unique, the thrust that makes it is not: of all thrusts that reach it, the second stage
finds the one of least |W_f f|, by the primal active-set method for a strictly convex quadratic
programme (J. Nocedal and S. J. Wright, Numerical Optimization, 2006, section 16.5). Both work with
x = W_f f.

The redistributed pseudo-inverse:
f = -c + W^-1 B^T (B W^-1 B^T + eps I)^-1 (tau + B_0 c): the columns of B of thrusters that are
saturated are zero, and c holds minus their thrust. Here eps goes to 0: the least-norm solution that
the exact solver takes its steps by (the paper prints I_3 next to a 6 x 5 matrix).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.compiled import kernel
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.fins import MAX_RAD, Fins, write_fin_matrix
from alice_survey.sim.vehicle.propulsion import DISTRUST, Propulsion, speeds_for, thrust_limits
from alice_survey.sim.vehicle.vehicle import Vehicle


class AllocationScratch(NamedTuple):
    """Work arrays of both solvers; their contents between calls have no meaning."""

    matrices: Array
    """(5, N, N), N the greater of 6 and the number of thrusters."""
    vectors: Array
    """(9, N)"""
    states: NDArray[np.int64]
    """(N,) state of each thruster."""


def allocation_scratch(thrusters: int) -> AllocationScratch:
    """Work arrays for a number of thrusters."""
    size = max(6, thrusters)
    return AllocationScratch(
        np.zeros((5, size, size)), np.zeros((9, size)), np.zeros(size, dtype=np.int64)
    )


class Allocation(NamedTuple):
    """Settings of the allocation from wrench to n thrusts and m angles of fins."""

    exact: bool
    propulsion: Propulsion
    """Propulsion as the allocation assumes it."""
    fins: Fins
    matrix: Array
    """B, (6, n + m): of the thrusters; and of the fins, per angle, at the speed of the tick."""
    axes: Array
    """(6,) weight of each axis; 0 of one that is not requested."""
    health: Array
    """(n,) 1 of an intact thruster, 0 of a failed one, see `weakened`."""
    lower: Array
    upper: Array
    """(n + m,) N, and rad; the same of a thruster that has failed."""
    weights: Array
    """(n + m,) positive; the cost is the sum of weight times thrust squared."""
    thrust: Array
    """(n + m,) thrusts, and angles of fins."""
    command: Array
    """(n + m,) speeds, and angles of fins."""
    known: Array
    """(6,) velocity that thrusters are believed to meet."""
    scratch: AllocationScratch


AXIS_WEIGHTS: Array = np.array([1.0, 3.0, 30.0, 0.0, 0.0, 10.0])
"""Priorities when not all is attainable. Heave keeps the vehicle off the sea floor; yaw keeps
the pictures square and the thrusters pointing where the controller thinks they point; sway keeps to
the line; surge only costs time. Each counts about ten times the next by the square of its residual,
a newton metre of yaw, on arms near a metre, as a newton."""
AXIS_WEIGHTS.setflags(write=False)
LEVEL_WEIGHTS: Array = np.array([1.0, 3.0, 30.0, 30.0, 30.0, 10.0])
"""The same where thrusters hold roll and pitch: a vehicle that tips over steers no more."""
LEVEL_WEIGHTS.setflags(write=False)

_MAX_EXPONENT = 9.0


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
        weights[i] = math.exp(min(t[i, DISTRUST] * u * u, _MAX_EXPONENT))


_X, _B, _LOW, _HIGH, _STEP, _SCALE, _REST, _PRICE, _Y = range(9)
"""Vectors of the exact solver in the scratch, whose first matrix is a: x is brought to the least
|a x - b| between low and high by steps; then what is left of b, prices, intermediate results."""
_FREE, _HELD, _FIXED = 0, 1, 2
"""Between its bounds; at one of them for now; at one for good."""
_RANK = 1e-11
"""Columns shorter than this part of the longest, once the others are taken off, depend on them."""
_SLOPE = 1e-12
"""Gradients below this share of their terms are rounding."""


@kernel
def allocate_exact(wrench: Array, allocation: Allocation) -> int:
    """Allocate a wrench with the least residual and, of all ways to it, the least thrust.

    Args:
        wrench: (6,) requested, N and N m.
        allocation: its matrix, bounds and weights; its thrust is written.

    Returns:
        Number of least-squares problems solved; negative if that many were not enough, with
        `thrust` within the bounds but perhaps not the best.
    """
    n, scratch = allocation.matrix.shape[1], allocation.scratch
    m = _pose(wrench, allocation)
    limit = 10 * n + 10
    solved = _min_residual(m, n, scratch, limit)
    if solved > 1:
        solved = _min_norm(m, n, scratch, solved, limit)
    _write_thrust(allocation)
    return solved


@kernel
def _pose(wrench: Array, allocation: Allocation) -> int:
    """Write the problem for x = W_f f, with x as near to 0 as the bounds allow; return its rows."""
    matrix, axes, scratch = allocation.matrix, allocation.axes, allocation.scratch
    lower, upper, weights = allocation.lower, allocation.upper, allocation.weights
    n, m = matrix.shape[1], 0
    a, state, v = scratch.matrices[0], scratch.states, scratch.vectors
    x, b, low, high, scale = v[_X], v[_B], v[_LOW], v[_HIGH], v[_SCALE]
    for i in range(n):
        scale[i] = 1.0 / math.sqrt(weights[i])
        low[i], high[i] = lower[i] / scale[i], upper[i] / scale[i]
        state[i] = _FIXED if high[i] <= low[i] else _FREE
        x[i] = low[i] if state[i] == _FIXED else min(max(0.0, low[i]), high[i])
    for axis in range(6):
        if axes[axis] > 0.0:
            b[m] = axes[axis] * wrench[axis]
            for i in range(n):
                a[m, i] = axes[axis] * matrix[axis, i] * scale[i]
            m += 1
    return m


@kernel
def _write_thrust(allocation: Allocation) -> None:
    """Write the thrusts, (n,), that x stands for."""
    lower, upper, thrust = allocation.lower, allocation.upper, allocation.thrust
    x, scale = allocation.scratch.vectors[_X], allocation.scratch.vectors[_SCALE]
    for i in range(thrust.shape[0]):
        thrust[i] = min(max(x[i] * scale[i], lower[i]), upper[i])


@kernel
def _min_residual(m: int, n: int, scratch: AllocationScratch, limit: int) -> int:
    """Bring x, (n,), to a least |a x - b| within the bounds; return the number of problems solved.

    It is 1 if x is of least norm too, as when no bound is in the way. Afterwards thrusters are
    fixed whose bound is in the way of a smaller residual, and the others are free.
    """
    a, state, v = scratch.matrices[0], scratch.states, scratch.vectors
    x, b, low, high, step = v[_X], v[_B], v[_LOW], v[_HIGH], v[_STEP]
    rest, gradient = v[_REST], v[_PRICE]
    for solved in range(1, limit + 1):
        for k in range(m):
            rest[k] = b[k]
            for i in range(n):
                # The first step is from nothing, so that it ends at the least norm.
                if solved > 1 or state[i] == _FIXED:
                    rest[k] -= a[k, i] * x[i]
        _pseudo_solve(m, n, rest, step, scratch)
        if solved == 1:
            inside = True
            for i in range(n):
                inside = inside and (state[i] == _FIXED or low[i] <= step[i] <= high[i])
            for i in range(n):
                if state[i] != _FIXED:
                    if not inside and not low[i] < step[i] < high[i]:
                        state[i] = _HELD
                    x[i] = min(max(step[i], low[i]), high[i])
            if inside:
                return 1
            continue
        if _advance(n, scratch):
            continue
        # The free ones are done: let go the one whose bound is most in the way.
        size = 0.0
        for k in range(m):
            terms = abs(b[k])
            rest[k] = b[k]
            for i in range(n):
                terms += abs(a[k, i] * x[i])
                rest[k] -= a[k, i] * x[i]
            size += terms * terms
        worst, chosen = 0.0, -1
        for i in range(n):
            gradient[i] = 0.0
            length = 0.0
            for k in range(m):
                gradient[i] += a[k, i] * rest[k]
                length += a[k, i] * a[k, i]
            if abs(gradient[i]) <= _SLOPE * math.sqrt(size * length):
                gradient[i] = 0.0
            if state[i] == _HELD:
                gain = gradient[i] if x[i] <= low[i] else -gradient[i]
                if length > 0.0 and gain / math.sqrt(length) > worst:
                    worst, chosen = gain / math.sqrt(length), i
        if chosen >= 0:
            state[chosen] = _FREE
            continue
        for i in range(n):
            if state[i] == _HELD:
                state[i] = _FIXED if gradient[i] != 0.0 else _FREE
        return solved
    return -limit


@kernel
def _min_norm(m: int, n: int, scratch: AllocationScratch, solved: int, limit: int) -> int:
    """Bring x, (n,), to the least |x| with the same a x within the bounds.

    Returns:
        Number of problems solved, with those before; negative if they were too many.
    """
    a, state, vectors = scratch.matrices[0], scratch.states, scratch.vectors
    x, low, step = vectors[_X], vectors[_LOW], vectors[_STEP]
    made, price, y = vectors[_REST], vectors[_PRICE], vectors[_Y]
    for total in range(solved + 1, solved + limit + 1):
        for k in range(m):
            made[k] = 0.0
            for i in range(n):
                if state[i] == _FREE:
                    made[k] += a[k, i] * x[i]
        rank = _pseudo_solve(m, n, made, step, scratch)
        free = 0
        for i in range(n):
            if state[i] == _FREE:
                step[i] -= x[i]
                free += 1
        if rank < free and _advance(n, scratch):
            continue
        # At the least norm x = a^T y on the free ones, as they were factored last; a held one is
        # let go if it would shrink.
        q, v, el = scratch.matrices[1], scratch.matrices[2], scratch.matrices[3]
        for r in range(rank):
            y[r] = 0.0
            for i in range(n):
                y[r] += v[r, i] * x[i]
        for r in range(rank - 1, -1, -1):
            for s in range(r + 1, rank):
                y[r] -= el[s, r] * y[s]
            y[r] /= el[r, r]
        for k in range(m):
            price[k] = 0.0
            for r in range(rank):
                price[k] += q[r, k] * y[r]
        worst, chosen = 0.0, -1
        for i in range(n):
            if state[i] == _HELD:
                slope, size = x[i], abs(x[i])
                for k in range(m):
                    slope -= a[k, i] * price[k]
                    size += abs(a[k, i] * price[k])
                gain = -slope if x[i] <= low[i] else slope
                if gain > worst and gain > _SLOPE * size:
                    worst, chosen = gain, i
        if chosen < 0:
            return total
        state[chosen] = _FREE
    return -solved - limit


@kernel
def _advance(n: int, scratch: AllocationScratch) -> bool:
    """Take a step of the free ones as far as the bounds allow; return whether one limited it."""
    state, v = scratch.states, scratch.vectors
    x, low, high, step = v[_X], v[_LOW], v[_HIGH], v[_STEP]
    share, blocking = 1.0, -1
    for i in range(n):
        if state[i] != _FREE:
            continue
        if x[i] + step[i] > high[i]:
            part = max(high[i] - x[i], 0.0) / step[i]
        elif x[i] + step[i] < low[i]:
            part = min(low[i] - x[i], 0.0) / step[i]
        else:
            continue
        if part < share or blocking < 0:
            share, blocking = min(part, share), i
    for i in range(n):
        if state[i] == _FREE:
            x[i] = min(max(x[i] + share * step[i], low[i]), high[i])
    if blocking < 0:
        return False
    x[blocking] = high[blocking] if step[blocking] > 0.0 else low[blocking]
    state[blocking] = _HELD
    return True


@kernel
def _pseudo_solve(m: int, n: int, right: Array, out: Array, scratch: AllocationScratch) -> int:
    """Write the least-norm least-squares solution of the free columns, 0 elsewhere; the rank.

    The free columns are factored, a = Q^T L V, by Gram and Schmidt: Q (rank, m) spans the columns,
    V (rank, n) the rows, both of orthonormal rows; L is lower triangular.
    """
    a, q, v, el, work = (
        scratch.matrices[0], scratch.matrices[1], scratch.matrices[2], scratch.matrices[3],
        scratch.matrices[4],
    )  # fmt: skip
    state, y = scratch.states, scratch.vectors[_Y]
    for i in range(n):
        if state[i] == _FREE:
            for k in range(m):
                work[i, k] = a[k, i]
    rank, first = 0, 0.0
    while rank < m:
        longest, pivot = 0.0, -1
        for i in range(n):
            if state[i] == _FREE:
                square = 0.0
                for k in range(m):
                    square += work[i, k] * work[i, k]
                if square > longest:
                    longest, pivot = square, i
        if rank == 0:
            first = longest
        if pivot < 0 or longest <= _RANK * _RANK * first:
            break
        size = 1.0 / math.sqrt(longest)
        for k in range(m):
            q[rank, k] = work[pivot, k] * size
        for i in range(n):
            if state[i] == _FREE:
                dot = 0.0
                for k in range(m):
                    dot += q[rank, k] * work[i, k]
                for k in range(m):
                    work[i, k] -= dot * q[rank, k]
        rank += 1
    for r in range(rank):
        for i in range(n):
            v[r, i] = 0.0
            if state[i] == _FREE:
                for k in range(m):
                    v[r, i] += q[r, k] * a[k, i]
        for s in range(r):
            dot = 0.0
            for i in range(n):
                dot += v[r, i] * v[s, i]
            el[r, s] = dot
            for i in range(n):
                v[r, i] -= dot * v[s, i]
        square = 0.0
        for i in range(n):
            square += v[r, i] * v[r, i]
        el[r, r] = math.sqrt(square)
        for i in range(n):
            v[r, i] /= el[r, r]
    for i in range(n):
        out[i] = 0.0
    for r in range(rank):
        y[r] = 0.0
        for k in range(m):
            y[r] += q[r, k] * right[k]
        for s in range(r):
            y[r] -= el[r, s] * y[s]
        y[r] /= el[r, r]
        for i in range(n):
            out[i] += v[r, i] * y[r]
    return rank


@kernel
def allocate_rpi(wrench: Array, allocation: Allocation) -> int:
    """Allocate a wrench by the redistributed pseudo-inverse.

    Each round solves for the thrusters that are not saturated, holds those that came out beyond
    their bounds at the bound, and takes what they give off the wrench. A thruster once held is
    never released: when the wrench is not attainable this falls short of the optimum. The paper
    weighs thrusters alone; here rows are scaled by the axes' weights too, without which it falls
    shorter still (all weights 1 is the paper's).

    Arguments as of `allocate_exact`.

    Returns:
        Number of solutions computed.
    """
    n, rounds, again = allocation.matrix.shape[1], 0, True
    m, scratch = _pose(wrench, allocation), allocation.scratch
    a, state, v = scratch.matrices[0], scratch.states, scratch.vectors
    x, b, low, high, step, rest = v[_X], v[_B], v[_LOW], v[_HIGH], v[_STEP], v[_REST]
    while again:
        rounds, again = rounds + 1, False
        for k in range(m):
            rest[k] = b[k]
            for i in range(n):
                if state[i] == _FIXED:
                    rest[k] -= a[k, i] * x[i]
        _pseudo_solve(m, n, rest, step, scratch)
        for i in range(n):
            if state[i] == _FREE:
                x[i] = min(max(step[i], low[i]), high[i])
                if x[i] != step[i]:
                    state[i], again = _FIXED, True
    _write_thrust(allocation)
    return rounds


def new_allocation(vehicle: Vehicle, health: Array, *, exact: bool, axes: Array) -> Allocation:
    """An allocation to the thrusters and fins of a vehicle.

    Args:
        vehicle: as the allocation assumes it.
        health: (n,) share of its greatest thrust that each thruster has left.
        exact: by `allocate_exact`; else by `allocate_rpi`.
        axes: (6,) weight of each axis.
    """
    n, thrusters, fins = vehicle.actuators, len(vehicle.thrusters), vehicle.plant.fins
    matrix, upper = np.zeros((6, n)), np.zeros(n)
    matrix[:, :thrusters] = vehicle.configuration_matrix
    upper[thrusters:] = fins.drives[:, MAX_RAD]
    return Allocation(
        exact, vehicle.plant.propulsion, fins, matrix, axes.copy(), health,
        lower=-upper, upper=upper, weights=np.ones(n), thrust=np.zeros(n),
        command=np.zeros(n), known=np.zeros(6), scratch=allocation_scratch(n),
    )  # fmt: skip


@kernel
def allocate(wrench: Array, nu: Array, allocation: Allocation) -> None:
    """Write the thrusts and the thruster speeds, and angles of fins, that make a wrench.

    Args:
        wrench: (6,) requested, N and N m.
        nu: (6 or more,) velocity, of which the first six count; rest where it is not a number.
        allocation: is written.
    """
    # The flow past the hull is not measured: the velocity over ground stands for it.
    known = allocation.known
    for i in range(6):
        known[i] = nu[i] if math.isfinite(nu[i]) else 0.0
    thrust_limits(
        allocation.propulsion, allocation.health, known, allocation.lower, allocation.upper
    )
    preference_weights(allocation.propulsion, known[0], allocation.weights)
    thrusters = allocation.propulsion.table.shape[0]
    write_fin_matrix(allocation.fins, known, allocation.matrix, thrusters)
    if allocation.exact:
        allocate_exact(wrench, allocation)
    else:
        allocate_rpi(wrench, allocation)
    speeds_for(allocation.propulsion, allocation.thrust, known, allocation.command)
    for i in range(thrusters, allocation.thrust.shape[0]):
        allocation.command[i] = allocation.thrust[i]
