"""The redistributed pseudo-inverse of the paper.

f = -c + W^-1 B^T (B W^-1 B^T + eps I)^-1 (tau + B_0 c): the columns of B of thrusters that are
saturated are zero, and c holds minus their thrust. The identity has as many rows as there are axes
requested (the paper prints I_3 next to a 6 x 5 matrix).
"""

import math

from alice_survey.base.frames import Array
from alice_survey.vehicle.allocation.scratch import AllocationScratch
from alice_survey.vehicle.compiled import kernel

_EPSILON = 1e-9
"""Regularisation, as a share of the mean diagonal of B W^-1 B^T."""


@kernel
def allocate_rpi(
    matrix: Array,
    wrench: Array,
    lower: Array,
    upper: Array,
    axes: Array,
    weights: Array,
    thrust: Array,
    scratch: AllocationScratch,
) -> int:
    """Allocate a wrench by the redistributed pseudo-inverse.

    Each round solves for the thrusters that are not saturated, holds those that came out beyond
    their bounds at the bound, and takes what they give off the wrench. A thruster once held is
    never released: when the wrench is not attainable this falls short of the optimum. The paper
    weighs thrusters alone; here rows are scaled by the axes' weights too, without which it falls
    shorter still (all weights 1 is the paper's).

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
        Number of solutions computed.
    """
    n = matrix.shape[1]
    gram, solution, held = scratch.matrices[0], scratch.vectors[0], scratch.states
    for i in range(n):
        held[i] = 1 if upper[i] <= lower[i] else 0
        thrust[i] = min(max(0.0, lower[i]), upper[i])
    rounds, again = 0, True
    while again:
        rounds, again, m = rounds + 1, False, 0
        for a in range(6):
            if axes[a] <= 0.0:
                continue
            rest = wrench[a]
            for i in range(n):
                if held[i]:
                    rest -= matrix[a, i] * thrust[i]
            solution[m] = axes[a] * rest
            k = 0
            for b in range(a + 1):
                if axes[b] <= 0.0:
                    continue
                total = 0.0
                for i in range(n):
                    if not held[i]:
                        total += matrix[a, i] * matrix[b, i] / weights[i]
                gram[m, k] = axes[a] * axes[b] * total
                k += 1
            m += 1
        trace = 0.0
        for a in range(m):
            trace += gram[a, a]
        if trace == 0.0:
            break
        for a in range(m):
            gram[a, a] += _EPSILON * trace / m
        _solve(gram, solution, m)
        for i in range(n):
            if held[i]:
                continue
            total, k = 0.0, 0
            for a in range(6):
                if axes[a] > 0.0:
                    total += axes[a] * matrix[a, i] * solution[k]
                    k += 1
            thrust[i] = total / weights[i]
        for i in range(n):
            if not held[i] and not lower[i] <= thrust[i] <= upper[i]:
                thrust[i] = min(max(thrust[i], lower[i]), upper[i])
                held[i] = 1
                again = True
    return rounds


@kernel
def _solve(matrix: Array, vector: Array, size: int) -> None:
    """Solve a symmetric positive definite system, of which the lower half is given, in place."""
    for i in range(size):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = math.sqrt(total) if i == j else total / matrix[j, j]
        for k in range(i):
            vector[i] -= matrix[i, k] * vector[k]
        vector[i] /= matrix[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            vector[i] -= matrix[k, i] * vector[k]
        vector[i] /= matrix[i, i]
