"""Normal equations of the light that lamps, pictures and ranges add, summed sample by sample.

A sample touches the four nodes around each of its two places, two pictures and the range, so that
its share of the normal equations is a few numbers. Pictures, of which there may be thousands, are
eliminated first (their block is sparse: a picture meets its neighbours alone), which leaves a small
dense system for the patterns and the fall-off: the Schur complement, as in bundle adjustment.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from alice_survey.base.compiled import compiled
from alice_survey.base.frames import Array

_DENSE_PICTURES = 400
"""More are solved for with sparse matrices."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LightEquations:
    """Samples as equations: nodes @ x + gain of view 0 - gain of view 1 = target, N rows."""

    nodes: NDArray[np.int64]
    """(N, 8) numbers of the nodes of both sides among all cameras'."""
    weights: Array
    """(N, 8) weights of those nodes, negative for the second side."""
    farther: Array
    """(N,) how much farther off the first view is."""
    views: NDArray[np.int64]
    """(N, 2) numbers of the two views."""
    pair: NDArray[np.int64]
    """(N,) row of `pairs`."""
    pairs: NDArray[np.int64]
    """(M, 2) views that share spots."""
    patterns: int
    """Number of nodes."""
    pictures: int
    """Number of views."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LightPrior:
    """What is known before the pictures."""

    patterns: Array
    """(P + 1, P + 1) normal matrix of nodes and fall-off."""
    right: Array
    """(P + 1,) right side of the normal equations."""
    gain: Array
    """(V,) inverse variance of each picture's gain."""
    gain_right: Array
    """(V,) inverse variance times the gain expected."""


def solve_robustly(
    equations: LightEquations,
    target: Array,
    prior: LightPrior,
    misfit: float,
    per_fact: float,
    rounds: int,
) -> tuple[Array, Array, float]:
    """Nodes and fall-off (P + 1,), gains (V,), and the variance of the fall-off.

    Errors above `misfit` count by their size instead of its square (Huber's weights are 1 below and
    fall as its inverse above).

    Args:
        equations: of the samples.
        target: (N,) differences of logarithms.
        prior: what holds without them.
        misfit: where an error becomes large; also the expected size of one.
        per_fact: samples that together count as much as one independent one.
        rounds: of reweighting.
    """
    e = equations
    x, gains, variance = np.zeros(e.patterns + 1), np.zeros(e.pictures), np.inf
    for _ in range(rounds):
        dense, mixed, own, shared, right, right_gains = normal_equations(
            e.nodes, e.weights, e.farther, e.views, e.pair, len(e.pairs), target, x, gains,
            misfit, per_fact,
        )  # fmt: skip
        dense = dense + np.triu(dense, 1).T + prior.patterns
        right, right_gains = right + prior.right, right_gains + prior.gain_right
        block = _gains_block(e, own + prior.gain, shared)
        wanted = np.column_stack([mixed.T, right_gains])
        if e.pictures <= _DENSE_PICTURES:
            solved = solve_symmetric(block.toarray(), wanted)
        else:
            solved = splu(block).solve(wanted)
        taken = _product(mixed, np.ascontiguousarray(solved))
        last = np.zeros(e.patterns + 1)
        last[-1] = 1.0
        both = solve_symmetric(dense - taken[:, :-1], np.column_stack([right - taken[:, -1], last]))
        x, variance = both[:, 0], float(both[-1, 1])
        gains = solved[:, -1] - (solved[:, :-1] * x).sum(axis=1)
    return x, gains, variance


# numpy's products and solvers start threads that wait for each other: on a busy machine these small
# systems then take a hundred times as long, and their last digits depend on the number of threads


@compiled
def _product(a: Array, b: Array) -> Array:
    """The product of a matrix with many zeros (P, V) and another (V, Q)."""
    found = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            value = a[i, k]
            if value != 0.0:
                for j in range(b.shape[1]):
                    found[i, j] += value * b[k, j]
    return found


@compiled
def solve_symmetric(matrix: Array, right: Array) -> Array:
    """Solve a positive definite system (N, N) for right sides (N, M) by Cholesky's factors."""
    count = len(matrix)
    lower = np.zeros_like(matrix)
    found = right.copy()
    for i in range(count):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            lower[i, j] = np.sqrt(total) if i == j else total / lower[j, j]
    for m in range(right.shape[1]):
        for i in range(count):
            total = found[i, m]
            for k in range(i):
                total -= lower[i, k] * found[k, m]
            found[i, m] = total / lower[i, i]
        for i in range(count - 1, -1, -1):
            total = found[i, m]
            for k in range(i + 1, count):
                total -= lower[k, i] * found[k, m]
            found[i, m] = total / lower[i, i]
    return found


def _gains_block(e: LightEquations, own: Array, shared: Array) -> csc_array:
    a, b = e.pairs[:, 0], e.pairs[:, 1]
    every = np.arange(e.pictures)
    values = np.concatenate([own, -shared, -shared])
    rows, columns = np.concatenate([every, a, b]), np.concatenate([every, b, a])
    return csc_array((values, (rows, columns)), shape=(e.pictures, e.pictures))


@compiled
def normal_equations(
    nodes: NDArray[np.int64], weights: Array, farther: Array, views: NDArray[np.int64],
    pair: NDArray[np.int64], pairs: int, target: Array, x: Array, gains: Array, misfit: float,
    per_fact: float,
) -> tuple[Array, Array, Array, Array, Array, Array]:  # fmt: skip
    """Sums over samples, reweighted at a solution.

    Args:
        nodes: see `LightEquations`, as all up to `pair`.
        weights: as above.
        farther: as above.
        views: as above.
        pair: as above.
        pairs: how many there are.
        target: (N,).
        x: (P + 1,) solution so far.
        gains: (V,).
        misfit: see `solve_robustly`.
        per_fact: see above.

    Returns:
        Upper triangle of the patterns' normal matrix (P + 1, P + 1), the part they share with
        gains (P + 1, V), the gains' diagonal (V,), minus their other entries by pair, and the
        right sides (P + 1,) and (V,).
    """
    unknowns, pictures = len(x), len(gains)
    dense, mixed = np.zeros((unknowns, unknowns)), np.zeros((unknowns, pictures))
    own, shared = np.zeros(pictures), np.zeros(pairs)
    right, right_gains = np.zeros(unknowns), np.zeros(pictures)
    at, slope = np.empty(9, np.int64), np.empty(9)
    for n in range(len(target)):
        first, second = views[n, 0], views[n, 1]
        at[:8], slope[:8] = nodes[n], weights[n]
        at[8], slope[8] = unknowns - 1, -farther[n]
        rest = target[n] - gains[first] + gains[second]
        for i in range(9):
            rest -= slope[i] * x[at[i]]
        weight = 1.0 / (max(abs(rest), misfit) * misfit * per_fact)
        for i in range(9):
            value = weight * slope[i]
            right[at[i]] += value * target[n]
            mixed[at[i], first] += value
            mixed[at[i], second] -= value
            for j in range(9):
                if at[j] >= at[i]:
                    dense[at[i], at[j]] += value * slope[j]
        own[first] += weight
        own[second] += weight
        shared[pair[n]] += weight
        right_gains[first] += weight * target[n]
        right_gains[second] -= weight * target[n]
    return dense, mixed, own, shared, right, right_gains
