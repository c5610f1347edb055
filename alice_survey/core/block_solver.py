"""Nonlinear least squares of many small blocks and of a few parameters that all share.

An adjustment of pictures has poses, each of which meets its own pixels, perhaps neighbours through
points that both see, and what all share: lenses, ports, the rig. Its normal equations are a
block-sparse matrix of the poses with a border. Poses are eliminated (Schur complement; Triggs et
al. 2000, "Bundle adjustment: a modern synthesis", section 6): one by one where none meets another,
by a sparse factor where they do. What a caller has eliminated before, such as points, shows only in
what it promises. Steps follow Levenberg and Marquardt (J. J. More 1978, "The Levenberg-Marquardt
algorithm: implementation and theory").
"""

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Generic, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import bsr_matrix, csc_matrix
from scipy.sparse.linalg import splu

from alice_survey.core.compiled import compiled_ieee
from alice_survey.core.errors import AliceError
from alice_survey.core.frames import Array

MAD_TO_SIGMA = 1.4826
"""Standard deviation of normal values over their median absolute deviation."""
RAYLEIGH_MEDIAN = 1.1774100225154747
"""Median length of a plane vector whose components are normal with unit sigma, sqrt(2 ln 2)."""
CAUCHY_TUNING = 2.385
"""Scale of Cauchy's weights in sigmas, for 95 % efficiency where errors are normal (Rey 1983,
"Introduction to robust and quasi-robust statistical methods")."""


Flags = NDArray[np.bool_]
Indices = NDArray[np.int64]
Guess = TypeVar("Guess")
Normal = TypeVar("Normal", bound="Equations")

_MIN_DAMPING = 1e-14
"""Shared parameters can be so similar that more damping than ten times this hides it."""
_ROUNDING = 1e-15


@dataclass(frozen=True, kw_only=True, eq=False)
class BlockStep:
    """A step of all unknowns against the gradient."""

    poses: Array
    """(F, K)."""
    shared: Array
    """(G,)."""
    gain: float
    """Twice the drop it promises: where it is not damped, its squared length in sigmas."""
    length: float
    """Its length in sigmas along what is shared, all else following (of all, if nothing is): no
    shared parameter, and no sum of some, moves by more of its sigmas."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Equations:
    """Normal equations of poses and of what is shared."""

    pointers: Indices
    """(F + 1,) and (B,): the blocks of every pose's row, and their columns, sorted."""
    columns: Indices
    blocks: Array
    """(B, K, K) between poses; those of a pose and itself are all there."""
    border: Array
    """(F, K, G + 1) between poses and what is shared, then the gradient by the poses."""
    shared: Array
    """(G + 1, G + 1) of what is shared, then the gradient by it; last, minus twice the drop that
    unknowns promise that were eliminated before."""
    free: Flags
    """(F, K) which unknowns of the poses may move: a gauge holds some."""

    @classmethod
    def apart(cls, blocks: Array, border: Array, shared: Array) -> "Equations":
        """Equations of poses that do not meet, all free, with one block (F, K, K) each."""
        count, free = np.arange(len(blocks) + 1), np.ones(blocks.shape[:2], dtype=np.bool_)
        return cls(
            pointers=count, columns=count[:-1], blocks=blocks, border=border, shared=shared,
            free=free,
        )  # fmt: skip

    @cached_property
    def rows(self) -> Indices:
        """(B,) the pose whose row each block is in."""
        counts: Indices = np.diff(self.pointers)
        return np.repeat(np.arange(len(counts)), counts)

    @cached_property
    def own(self) -> Indices:
        """(F,) which blocks are of a pose and itself."""
        return np.flatnonzero(self.rows == self.columns)

    def knowing(self, poses: Array) -> Self:
        """The same with further information (F, K, K) on each pose."""
        blocks = self.blocks.copy()
        blocks[self.own] += poses
        return replace(self, blocks=blocks)

    def factor(self, damping: float = 0.0) -> "PoseFactor":
        """The poses' matrix, factorised; what is held is on its own.

        Args:
            damping: share of its diagonal to add.
        """
        blocks = self.blocks * (self.free[self.rows, :, None] & self.free[self.columns, None, :])
        ridge = damping * np.einsum("fii->fi", self.blocks[self.own])
        blocks[self.own] += np.where(self.free, ridge, 1.0)[:, :, None] * np.eye(blocks.shape[1])
        return PoseFactor(self, blocks)

    def step(self, damping: float = 0.0, pinned: Flags | None = None) -> BlockStep:
        """The step of all unknowns but those of what is shared that are pinned."""
        shared = np.zeros(len(self.shared) - 1)
        moving = np.flatnonzero(np.ones_like(shared) if pinned is None else ~pinned)
        kept = np.append(moving, len(shared))
        border = self.border[..., kept]
        solved = self.factor(damping).solve(border)
        reduced = self.shared[np.ix_(kept, kept)] - product_of(border, solved)
        diagonal = np.diag(self.shared)[moving]
        scale = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
        schur, slope = reduced[:-1, :-1] * np.outer(scale, scale), reduced[:-1, -1] * scale
        schur[np.diag_indices_from(schur)] += damping + _ROUNDING
        if moving.size:
            try:
                step = -cho_solve(cho_factor(schur), slope)
            except np.linalg.LinAlgError:  # rounding left it indefinite
                step = -np.linalg.lstsq(schur, slope, rcond=1e-13)[0]
            shared[moving] = scale * step
        along = -float(shared[moving] @ reduced[:-1, -1])
        gain = along - float(reduced[-1, -1])
        return BlockStep(
            poses=-solved[..., -1] - solved[..., :-1] @ shared[moving],
            shared=shared,
            gain=gain,
            length=math.sqrt(max(along if moving.size else gain, 0.0)),
        )

    @cached_property
    def undamped(self) -> "PoseFactor":
        """The factor without damping."""
        return self.factor()

    @cached_property
    def response(self) -> Array:
        """(F, K, G) how poses follow a change of what is shared."""
        return -self.undamped.solve(self.border[..., :-1])

    @property
    def information(self) -> Array:
        """(G, G) information on what is shared, the poses marginalised."""
        reduced = product_of(self.border[..., :-1], self.response)
        return self.shared[:-1, :-1] + 0.5 * (reduced + reduced.T)

    def covariance_times(self, right: Array) -> Array:
        """The covariance of the poses, what is shared marginalised, times (F, K, R)."""
        inner = inverse_of(self.information) @ product_of(self.response, right)
        return self.undamped.solve(right) + self.response @ inner

    def covariance_blocks(self) -> Array:
        """(B, K, K) covariances of those poses between which there are blocks."""
        across = inverse_of(self.information) @ self.response[self.columns].swapaxes(1, 2)
        return self.undamped.inverse_blocks() + self.response[self.rows] @ across


class PoseFactor:
    """Factor of the matrix of the poses."""

    def __init__(self, equations: Equations, blocks: Array) -> None:
        """Take `blocks` in the pattern of `equations`."""
        self.equations, self.blocks = equations, blocks

    def solve(self, right: Array) -> Array:
        """Solve for (F, K, R) right-hand sides; what is held stays 0."""
        right = right * self.equations.free[..., None]
        if len(self.blocks) == len(right):  # no pose meets another
            return np.asarray(np.linalg.solve(self.blocks, right))
        order, factor = self._sparse
        solved = np.empty_like(right)
        flat = right[order].reshape(self.equations.free.size, right.shape[2])
        solved[order] = factor.solve(flat).reshape(right.shape)
        return solved

    @cached_property
    def _sparse(self) -> tuple[Indices, Any]:
        """The order in which poses are eliminated, and the factor of them in that order."""
        rows, columns, count = self.equations.rows, self.equations.columns, len(self.equations.free)
        whole, size = np.ones(len(rows)), self.equations.free.size
        whole[self.equations.own] = 2.0 * count
        place = _factor(csc_matrix((whole, (rows, columns))), "MMD_AT_PLUS_A").perm_c
        order: Indices = np.argsort(place)
        at = np.lexsort((place[columns], place[rows]))
        pointers = np.concatenate([[0], np.cumsum(np.diff(self.equations.pointers)[order])])
        ordered = (self.blocks[at], place[columns[at]], pointers)
        return order, _factor(csc_matrix(bsr_matrix(ordered, shape=(size, size))), "NATURAL")

    def inverse_blocks(self) -> Array:
        """(B, K, K) blocks of the inverse, where the matrix has blocks; 0 of what is held.

        Backwards through the elimination: a pose of its own covariance C that follows those
        eliminated later by G has G Z with them and C + G Z G^T with itself, Z being theirs. What a
        pose meets is met by the next one of it too, so that Z is known there (K. Takahashi, J.
        Fagan & M.-S. Chin 1973, "Formation of a sparse bus impedance matrix").
        """
        count, wide = self.equations.free.shape
        order, factor = self._sparse
        place = np.argsort(order)
        rows, columns = self.equations.rows, self.equations.columns
        meets = _fill(place[rows], place[columns], count)
        waiting = np.bincount([met[1] for met in meets if len(met) > 1], minlength=count)
        upper: Any = bsr_matrix(factor.U.tocsr(), blocksize=(wide, wide))
        keys, found = rows * count + columns, np.zeros_like(self.blocks)
        known: dict[int, Array] = {}
        for j in range(count - 1, -1, -1):
            met = meets[j]
            stored = slice(upper.indptr[j], upper.indptr[j + 1])
            row = np.zeros((wide, len(met), wide))
            row[:, np.searchsorted(met, upper.indices[stored])] = upper.data[stored].swapaxes(0, 1)
            back = np.linalg.inv(row[:, 0])
            follow = -(back @ row[:, 1:].reshape(wide, -1))
            inverse = np.empty((len(met), wide, len(met), wide))
            if len(met) > 1:
                parent = int(met[1])
                at = np.searchsorted(meets[parent], met[1:])
                inverse[1:, :, 1:] = known[parent][at][:, :, at]
                waiting[parent] -= 1
                if not waiting[parent]:
                    del known[parent]
            across = follow @ inverse[1:, :, 1:].reshape(follow.shape[1], follow.shape[1])
            inverse[0, :, 0] = (back * np.diag(row[:, 0])) @ back.T + across @ follow.T
            inverse[0, :, 1:] = across.reshape(wide, -1, wide)
            inverse[1:, :, 0] = inverse[0, :, 1:].transpose(1, 2, 0)
            if waiting[j]:
                known[j] = inverse
            own, others = order[j], order[met]
            for key, block in (
                (own * count + others, inverse[0].swapaxes(0, 1)),
                (others * count + own, inverse[:, :, 0]),
            ):
                to = np.minimum(np.searchsorted(keys, key), len(keys) - 1)
                asked = keys[to] == key
                found[to[asked]] = block[asked]
        free = self.equations.free
        found *= free[rows, :, None] & free[columns, None, :]
        return found


def product_of(first: Array, second: Array) -> Array:
    """Sum over all poses, (A, B), of (F, K, A) transposed times (F, K, B)."""
    return np.tensordot(first, second, axes=([0, 1], [0, 1]))


def inverse_of(matrix: Array) -> Array:
    """Inverse of a symmetric positive matrix whose unknowns have many units."""
    scale = 1.0 / np.sqrt(np.diag(matrix))
    weight = np.outer(scale, scale)
    inverse: Array = np.linalg.inv(matrix * weight) * weight
    return 0.5 * (inverse + inverse.T)


@compiled_ieee
def solve_symmetric(matrix: Array, right: Array) -> Array:
    """Solve a positive definite system (N, N) for right sides (N, M) by Cholesky's factors.

    Only the lower triangle is read; what has no solution is NaN. numpy's solvers start threads that
    wait for each other: on a busy machine these small systems then take a hundred times as long,
    and their last digits depend on the number of threads.
    """
    count, sides = matrix.shape[0], right.shape[1]
    upper, found = matrix.T.copy(), right.copy()  # rows, along which a processor works on several
    for i in range(count):
        for k in range(0, i - 3, 4):  # four rows at a time: one is written a quarter as often
            a, b, c, d = upper[k, i], upper[k + 1, i], upper[k + 2, i], upper[k + 3, i]
            for j in range(i, count):
                upper[i, j] = (
                    upper[i, j] - a * upper[k, j] - b * upper[k + 1, j]
                    - c * upper[k + 2, j] - d * upper[k + 3, j]
                )  # fmt: skip
        for k in range(i):
            share = upper[k, i]
            for j in range(i, count if k >= i - i % 4 else i):
                upper[i, j] -= share * upper[k, j]
            for m in range(sides):
                found[i, m] -= share * found[k, m]
        upper[i, i] = math.sqrt(upper[i, i])
        for j in range(i + 1, count):
            upper[i, j] /= upper[i, i]
        for m in range(sides):
            found[i, m] /= upper[i, i]
    for i in range(count - 1, -1, -1):
        for k in range(i + 1, count):
            for m in range(sides):
                found[i, m] -= upper[i, k] * found[k, m]
        for m in range(sides):
            found[i, m] /= upper[i, i]
    return found


def _factor(matrix: csc_matrix, order: str) -> Any:
    """Factor of a symmetric matrix without pivoting, in one of SuperLU's orders."""
    factor: Any = splu
    return factor(matrix, permc_spec=order, diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def _fill(rows: Indices, columns: Indices, count: int) -> list[Indices]:
    """Each unknown, and what meets it later when those before it are eliminated in order; sorted.

    Args:
        rows: (B,) of the blocks of a symmetric matrix.
        columns: (B,) of them.
        count: how many rows there are.
    """
    met: list[set[int]] = [set() for _ in range(count)]
    for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
        if column >= row:
            met[row].add(column)
    for row, own in enumerate(met):
        later = own - {row}
        if later:
            met[min(later)] |= later
    return [np.array(sorted(own), dtype=np.int64) for own in met]


class Problem(Protocol[Guess, Normal]):
    """What is adjusted: guesses of all unknowns, and how well they explain what was measured."""

    def noise(self, guess: Guess) -> Array:
        """(N,) scales of the loss that the residuals of a guess show."""

    def cost(self, guess: Guess, noise: Array) -> float:
        """Half the robust sum of squares, in sigmas; inf where a guess loses an observation."""

    def linearise(self, guess: Guess, noise: Array) -> Normal:
        """Normal equations at a guess, weights and priors included."""

    def move(self, guess: Guess, equations: Normal, step: BlockStep) -> Guess:
        """The guess after a step that its equations gave; an `AliceError` beyond what can be."""

    def at_bound(self, guess: Guess) -> Flags:
        """(G,) which shared parameters may not become less."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Minimum(Generic[Guess, Normal]):
    """Where an adjustment ended."""

    guess: Guess
    equations: Normal
    """From which the last step was taken."""
    noise: Array
    """(N,) scales of the loss there."""
    length: float
    """Of the last step, in sigmas, as if it were not damped."""
    is_settled: bool
    """Whether that is as short as requested, and the noise is steady."""
    is_stuck: bool
    """Whether it is not, though only short steps improve: longer ones lose observations."""


def minimise(
    problem: Problem[Guess, Normal],
    start: Guess,
    *,
    settled: float,
    max_steps: int,
    damping: float = 0.0,
    min_damping: float = _MIN_DAMPING,
) -> Minimum[Guess, Normal]:
    """Minimise a robust sum of squares from a guess near its minimum.

    Args:
        problem: what is adjusted.
        start: where it starts; it must not lose an observation.
        settled: length of a step and relative change of the noise at which it ends.
        max_steps: it ends, not settled, after so many.
        damping: of the first step, as a share of the diagonal; less where steps are good.
        min_damping: with which it may settle.
    """
    guess, noise = start, problem.noise(start)
    for _ in range(max_steps):
        equations, cost = problem.linearise(guess, noise), problem.cost(guess, noise)
        pinned = problem.at_bound(guess) & (equations.shared[:-1, -1] > 0)
        while True:
            step = equations.step(damping, pinned)
            short = step.length < settled
            tried, drop = guess, -math.inf
            with suppress(AliceError):
                tried = problem.move(guess, equations, step)
                drop = cost - problem.cost(tried, noise)
            if drop >= 0 or short:
                break
            damping = max(10.0 * damping, 1e-9)
        guess = tried if drop >= 0 else guess
        before, noise = noise, problem.noise(guess)
        steady = bool(np.all(np.abs(noise / before - 1.0) < settled))
        if short and steady and (damping <= min_damping or drop < 0):
            break
        good = short or drop > 0.25 * step.gain
        damping = max(damping * (0.01 if good else 0.5), _MIN_DAMPING)
    if damping > min_damping or drop < 0:  # damping shortens any step
        step = equations.step(min_damping, pinned)
    is_short = step.length < settled
    return Minimum(
        guess=guess, equations=equations, noise=noise, length=step.length,
        is_settled=is_short and steady, is_stuck=short and not is_short,
    )  # fmt: skip
