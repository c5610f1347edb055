"""Exact allocation: bounded weighted least squares, then least thrust, by two small active sets.

First the least |W_tau (B f - tau)| within the bounds, by the method of C. L. Lawson and R. J.
Hanson, Solving Least Squares Problems, 1974, chapter 23, extended to two bounds (P. B. Stark and
R. L. Parker, Computational Statistics 10, 1995). B has rank 4 and five thrusters: the steps are
those of least norm, so that a rank-deficient set of free thrusters does no harm. The best
wrench is unique, the thrust that makes it is not: of all thrusts that reach it, the second stage
finds the one of least |W_f f|, by the primal active-set method for a strictly convex quadratic
programme (J. Nocedal and S. J. Wright, Numerical Optimization, 2006, section 16.5). Both work with
x = W_f f.
"""

import math

import numpy as np
from numpy.typing import NDArray

from alice_survey.base.frames import Array
from alice_survey.vehicle.allocation.scratch import AllocationScratch
from alice_survey.vehicle.compiled import kernel

_FREE, _HELD, _FIXED = 0, 1, 2
"""Between its bounds; at one of them for now; at one for good."""
_RANK = 1e-11
"""Columns shorter than this part of the longest, once the others are taken off, depend on them."""
_SLOPE = 1e-12
"""Gradients below this share of their terms are rounding."""


@kernel
def allocate_exact(
    matrix: Array,
    wrench: Array,
    lower: Array,
    upper: Array,
    axes: Array,
    weights: Array,
    thrust: Array,
    scratch: AllocationScratch,
) -> int:
    """Allocate a wrench with the least miss and, of all ways to it, the least thrust.

    Args:
        matrix: (6, n) B, wrench per thrust.
        wrench: (6,) wanted, N and N m.
        lower: (n,) least thrust, N.
        upper: (n,) greatest thrust, N; the same as `lower` of a thruster that has failed.
        axes: (6,) weights of the axes' misses; 0 of an axis that is not requested.
        weights: (n,) positive; the cost is the sum of weight times thrust squared.
        thrust: (n,) is written, N.
        scratch: work arrays.

    Returns:
        Number of least-squares problems solved; negative if that many were not enough, with
        `thrust` within the bounds but perhaps not the best.
    """
    n, m = matrix.shape[1], 0
    a, x, b = scratch.matrices[0], scratch.vectors[0], scratch.vectors[1]
    low, high, step = scratch.vectors[2], scratch.vectors[3], scratch.vectors[4]
    scale, state = scratch.vectors[5], scratch.states
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
    limit = 10 * n + 10
    solved = _least_miss(a, m, n, b, x, low, high, step, state, scratch, limit)
    if solved > 1:
        solved = _least_norm(a, m, n, b, x, low, high, step, state, scratch, solved, limit)
    for i in range(n):
        thrust[i] = min(max(x[i] * scale[i], lower[i]), upper[i])
    return solved


@kernel
def _least_miss(
    a: Array,
    m: int,
    n: int,
    b: Array,
    x: Array,
    low: Array,
    high: Array,
    step: Array,
    state: NDArray[np.int64],
    scratch: AllocationScratch,
    limit: int,
) -> int:
    """Bring x, (n,), to a least |a x - b| within the bounds; return the number of problems.

    It is 1 if x is of least norm too, as when no bound is in the way. Afterwards thrusters are
    fixed whose bound is in the way of a smaller miss, and the others are free.
    """
    rest, gradient = scratch.vectors[6], scratch.vectors[7]
    for solved in range(1, limit + 1):
        for k in range(m):
            rest[k] = b[k]
            for i in range(n):
                # The first step is from nothing, so that it ends at the least norm.
                if solved > 1 or state[i] == _FIXED:
                    rest[k] -= a[k, i] * x[i]
        _pseudo_solve(a, m, n, rest, step, state, scratch)
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
        if _advance(n, x, step, low, high, state):
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
def _least_norm(
    a: Array,
    m: int,
    n: int,
    b: Array,
    x: Array,
    low: Array,
    high: Array,
    step: Array,
    state: NDArray[np.int64],
    scratch: AllocationScratch,
    solved: int,
    limit: int,
) -> int:
    """Bring x, (n,), to the least |x| with the same a x within the bounds.

    Returns:
        Number of problems solved, with those before; negative if they were too many.
    """
    made, price = scratch.vectors[6], scratch.vectors[7]
    for total in range(solved + 1, solved + limit + 1):
        for k in range(m):
            made[k] = 0.0
            for i in range(n):
                if state[i] == _FREE:
                    made[k] += a[k, i] * x[i]
        rank = _pseudo_solve(a, m, n, made, step, state, scratch)
        free = 0
        for i in range(n):
            if state[i] == _FREE:
                step[i] -= x[i]
                free += 1
        if rank < free and _advance(n, x, step, low, high, state):
            continue
        # At the least norm x = a^T y on the free ones; a held one is let go if it would shrink.
        _price(m, n, rank, x, price, scratch)
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
def _advance(
    n: int, x: Array, step: Array, low: Array, high: Array, state: NDArray[np.int64]
) -> bool:
    """Take a step of the free ones as far as the bounds allow; return whether one limited it."""
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
def _factor(a: Array, m: int, n: int, state: NDArray[np.int64], scratch: AllocationScratch) -> int:
    """Factor the free columns, a = Q^T L V, by Gram and Schmidt; the rank.

    Q (rank, m) spans the columns, V (rank, n) the rows, both of orthonormal rows; L is lower
    triangular. They are left in the scratch.
    """
    q, v, el, work = (
        scratch.matrices[1],
        scratch.matrices[2],
        scratch.matrices[3],
        scratch.matrices[4],
    )
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
    return rank


@kernel
def _pseudo_solve(
    a: Array,
    m: int,
    n: int,
    right: Array,
    out: Array,
    state: NDArray[np.int64],
    scratch: AllocationScratch,
) -> int:
    """Write the least-norm least-squares solution of the free columns, 0 elsewhere; the rank."""
    rank = _factor(a, m, n, state, scratch)
    q, v, el, y = scratch.matrices[1], scratch.matrices[2], scratch.matrices[3], scratch.vectors[8]
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
def _price(m: int, n: int, rank: int, x: Array, out: Array, scratch: AllocationScratch) -> None:
    """Write the least y, (m,), with a^T y = x on the free columns, as they were factored last."""
    q, v, el, y = scratch.matrices[1], scratch.matrices[2], scratch.matrices[3], scratch.vectors[8]
    for r in range(rank):
        y[r] = 0.0
        for i in range(n):
            y[r] += v[r, i] * x[i]
    for r in range(rank - 1, -1, -1):
        for s in range(r + 1, rank):
            y[r] -= el[s, r] * y[s]
        y[r] /= el[r, r]
    for k in range(m):
        out[k] = 0.0
        for r in range(rank):
            out[k] += q[r, k] * y[r]
