"""Nonlinear least squares of many small blocks and of a few parameters that all share.

An adjustment of pictures has poses, each of which meets its own pixels, perhaps neighbours through
points that both see, and what all share: lenses, ports, the rig. Its normal equations are a
block-sparse matrix of the poses with a border. Poses are eliminated (Schur complement; Triggs et
al. 2000, "Bundle adjustment: a modern synthesis", section 6): one by one where none meets another,
by a sparse factor (`alice_survey.base.block_factor`) where they do. What a caller has eliminated
before, such as points, shows only in what it promises. Steps follow Levenberg and Marquardt (J. J.
More 1978, "The Levenberg-Marquardt algorithm: implementation and theory").
"""

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Generic, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from alice_survey.base.block_factor import BlockFactor
from alice_survey.base.errors import AliceError
from alice_survey.base.frames import Array

Flags = NDArray[np.bool_]
Indices = NDArray[np.int64]
Guess = TypeVar("Guess")
Normal = TypeVar("Normal", bound="Equations")

_LEAST_DAMPING = 1e-14
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
        information: Array = self.shared[:-1, :-1] + 0.5 * (reduced + reduced.T)
        return information

    def covariance_times(self, right: Array) -> Array:
        """The covariance of the poses, what is shared marginalised, times (F, K, R)."""
        inner = inverse_of(self.information) @ product_of(self.response, right)
        product: Array = self.undamped.solve(right) + self.response @ inner
        return product

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
        return self._sparse.solve(right)

    @cached_property
    def _sparse(self) -> BlockFactor:
        return BlockFactor(self.equations.pointers, self.equations.columns, self.blocks)

    def inverse_blocks(self) -> Array:
        """(B, K, K) blocks of the inverse, where the matrix has blocks; 0 of what is held."""
        rows, columns, free = self.equations.rows, self.equations.columns, self.equations.free
        found = self._sparse.inverse_blocks(len(self.blocks))
        found *= free[rows, :, None] & free[columns, None, :]
        return found


def product_of(first: Array, second: Array) -> Array:
    """Sum over all poses, (A, B), of (F, K, A) transposed times (F, K, B)."""
    product: Array = np.tensordot(first, second, axes=([0, 1], [0, 1]))
    return product


def inverse_of(matrix: Array) -> Array:
    """Inverse of a symmetric positive matrix whose unknowns have many units."""
    scale = 1.0 / np.sqrt(np.diag(matrix))
    weight = np.outer(scale, scale)
    inverse: Array = np.linalg.inv(matrix * weight) * weight
    return 0.5 * (inverse + inverse.T)


class Problem(Protocol[Guess, Normal]):
    """What is adjusted: guesses of all unknowns, and how well they explain what was measured."""

    def noise(self, guess: Guess) -> Array:
        """(N,) scales of the loss that the residuals of a guess show."""

    def cost(self, guess: Guess, noise: Array) -> float:
        """Half the robust sum of squares, in sigmas; inf where a guess loses an observation."""

    def linearised(self, guess: Guess, noise: Array) -> Normal:
        """Normal equations at a guess, weights and priors included."""

    def moved(self, guess: Guess, equations: Normal, step: BlockStep) -> Guess:
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
    most_steps: int,
    damping: float = 0.0,
    least_damping: float = _LEAST_DAMPING,
) -> Minimum[Guess, Normal]:
    """Minimise a robust sum of squares from a guess near its minimum.

    Args:
        problem: what is adjusted.
        start: where it starts; it must not lose an observation.
        settled: length of a step and relative change of the noise at which it ends.
        most_steps: it ends, not settled, after so many.
        damping: of the first step, as a share of the diagonal; less where steps are good.
        least_damping: with which it may settle.
    """
    guess, noise = start, problem.noise(start)
    for _ in range(most_steps):
        equations, cost = problem.linearised(guess, noise), problem.cost(guess, noise)
        pinned = problem.at_bound(guess) & (equations.shared[:-1, -1] > 0)
        while True:
            step = equations.step(damping, pinned)
            short = step.length < settled
            tried, drop = guess, -math.inf
            with suppress(AliceError):
                tried = problem.moved(guess, equations, step)
                drop = cost - problem.cost(tried, noise)
            if drop >= 0 or short:
                break
            damping = max(10.0 * damping, 1e-9)
        guess = tried if drop >= 0 else guess
        before, noise = noise, problem.noise(guess)
        steady = bool(np.all(np.abs(noise / before - 1.0) < settled))
        if short and steady and (damping <= least_damping or drop < 0):
            break
        good = short or drop > 0.25 * step.gain
        damping = max(damping * (0.01 if good else 0.5), _LEAST_DAMPING)
    if damping > least_damping or drop < 0:  # damping shortens any step
        step = equations.step(least_damping, pinned)
    is_short = step.length < settled
    return Minimum(
        guess=guess, equations=equations, noise=noise, length=step.length,
        is_settled=is_short and steady, is_stuck=short and not is_short,
    )  # fmt: skip
