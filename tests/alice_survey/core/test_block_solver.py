"""The block solver against dense algebra, a plain minimiser and the ends it must not accept."""

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares

from alice_survey.core.block_solver import (
    BlockStep,
    Equations,
    Minimum,
    inverse_of,
    minimise,
    solve_symmetric,
)
from alice_survey.core.errors import AliceError
from alice_survey.core.frames import Array
from tests.oracles_refraction import dense_of


def equations(
    rng: np.random.Generator, poses: int, wide: int, shared: int, reach: float
) -> Equations:
    """Of poses in a square that meet those within reach; a few of their unknowns are held."""
    place = rng.uniform(0, 1, (poses, 2))
    meets = np.linalg.norm(place[:, None] - place, axis=-1) <= reach
    size = poses * wide + shared
    jacobian = rng.normal(size=(4 * size, size + 1))
    whole = (jacobian.T @ jacobian) / (4 * size)
    dense = whole[: poses * wide, : poses * wide].reshape(poses, wide, poses, wide)
    rows, columns = np.nonzero(meets)
    blocks = dense[rows, :, columns].copy()
    blocks[rows == columns] += 2.0 * np.eye(wide)
    corner = whole[poses * wide :, poses * wide :].copy()
    corner[-1, -1] = -0.5
    free = rng.uniform(size=(poses, wide)) > 0.1
    free[poses // 2] = False
    return Equations(
        pointers=np.searchsorted(rows, np.arange(poses + 1)),
        columns=columns,
        blocks=blocks,
        border=0.3 * whole[: poses * wide, poses * wide :].reshape(poses, wide, shared + 1),
        shared=corner,
        free=free,
    )


def dense_free(found: Equations) -> tuple[Array, Array, NDArray[np.intp]]:
    """Matrix and gradient of all unknowns that are free, and which those are."""
    kept = np.flatnonzero(np.append(found.free.ravel(), np.ones(len(found.shared) - 1, bool)))
    slope = np.concatenate([found.border[..., -1].ravel(), found.shared[:-1, -1]])
    return dense_of(found)[np.ix_(kept, kept)], slope[kept], kept


@pytest.mark.parametrize(
    ("poses", "wide", "shared", "reach"),
    [(30, 6, 3, 0.3), (12, 6, 4, 0.0), (25, 3, 0, 0.4), (2, 6, 1, 2.0), (9, 6, 2, 2.0)],
)
def test_step_and_covariances_are_those_of_the_dense_matrix(
    poses: int, wide: int, shared: int, reach: float
) -> None:
    found = equations(np.random.default_rng(poses), poses, wide, shared, reach)
    matrix, slope, kept = dense_free(found)
    inverse = np.zeros((poses * wide + shared,) * 2)
    inverse[np.ix_(kept, kept)] = np.linalg.inv(matrix)

    step = found.step()

    together = np.concatenate([step.poses.ravel(), step.shared])
    expected = np.zeros_like(together)
    expected[kept] = -np.linalg.solve(matrix, slope)
    np.testing.assert_allclose(together, expected, atol=1e-10)
    assert step.gain == pytest.approx(-expected[kept] @ slope + 0.5, rel=1e-9)
    of_shared = inverse[poses * wide :, poses * wide :]
    if shared:
        np.testing.assert_allclose(inverse_of(found.information), of_shared, atol=1e-10)
        length = step.shared @ np.linalg.solve(of_shared, step.shared)
        assert step.length**2 == pytest.approx(length, rel=1e-8)
    of_poses = inverse[: poses * wide, : poses * wide].reshape(poses, wide, poses, wide)
    np.testing.assert_allclose(
        found.covariance_blocks(), of_poses[found.rows, :, found.columns], atol=1e-10
    )
    right = np.random.default_rng(1).normal(size=(poses, wide, 2))
    np.testing.assert_allclose(
        found.covariance_times(right), np.einsum("aibj,bjr->air", of_poses, right), atol=1e-9
    )


@dataclass(frozen=True)
class Curves:
    """Heights of curves of one shape: a exp(-b t) with a of each, b of all; nothing below `edge`.

    A guess is the curves' a, then b. Huber's loss, of sigma 1 per unit of noise.
    """

    time: Array
    heights: Array
    """(F, N)."""
    low: float = 0.0
    edge: float = -np.inf

    def misses(self, guess: Array) -> Array:
        return guess[:-1, None] * np.exp(-guess[-1] * self.time) - self.heights

    def noise(self, guess: Array) -> Array:
        return np.array([1.0])

    def cost(self, guess: Array, noise: Array) -> float:
        size = np.abs(self.misses(guess))
        inside = np.all(self.misses(guess) + self.heights > self.edge)
        loss = np.where(size <= 1, 0.5 * size**2, size - 0.5)
        return float(loss.sum()) if inside else np.inf

    def linearise(self, guess: Array, noise: Array) -> Equations:
        misses, fall = self.misses(guess), np.exp(-guess[-1] * self.time)
        weight = 1.0 / np.maximum(np.abs(misses), 1.0)
        by_shared = -guess[:-1, None] * self.time * fall
        rest = np.stack([by_shared, misses], axis=-1)
        shared = np.einsum("fna,fnb,fn->ab", rest, rest, weight)
        shared[-1, -1] = 0.0
        return Equations.apart(
            blocks=(weight * fall**2).sum(axis=1)[:, None, None],
            border=np.einsum("fn,fna->fa", weight * fall, rest)[:, None],
            shared=shared,
        )

    def move(self, guess: Array, equations: Equations, step: BlockStep) -> Array:
        rate = max(guess[-1] + step.shared[0], self.low)
        if rate > 50.0:
            raise AliceError("too fast")
        return np.append(guess[:-1] + step.poses[:, 0], rate)

    def at_bound(self, guess: Array) -> np.ndarray:
        return np.array([guess[-1] <= self.low])


def curves(rate: float, seed: int = 0) -> Curves:
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 2, 15)
    heights = rng.uniform(5, 20, (8, 1)) * np.exp(-rate * time) + rng.normal(0, 0.3, (8, 15))
    heights[2, 3] += 30.0
    return Curves(time, heights)


def solved(problem: Curves, start: Array, **options: float) -> Minimum[Array, Equations]:
    return minimise(problem, start, settled=1e-7, max_steps=200, damping=1e-3, **options)


@pytest.mark.parametrize("rate", [0.1, 3.0])
def test_it_ends_where_a_plain_minimiser_does(rate: float) -> None:
    problem, far = curves(1.2), np.append(np.full(8, 1.0), rate)
    found = solved(problem, far)

    def misses(x: Array) -> Array:
        return problem.misses(x).ravel()

    plain = least_squares(
        misses, far, loss="huber", f_scale=1.0, x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    assert found.is_settled
    assert not found.is_stuck
    np.testing.assert_allclose(found.guess, plain.x, rtol=1e-5)
    assert found.length < 1e-7


def test_a_parameter_that_would_leave_its_range_stays_at_its_bound() -> None:
    problem = Curves(curves(1.2).time, curves(1.2).heights, low=2.0)
    found = solved(problem, np.append(np.full(8, 10.0), 2.5))
    assert found.is_settled
    assert found.guess[-1] == 2.0

    def misses(x: Array) -> Array:
        return problem.misses(np.append(x, 2.0)).ravel()

    free = least_squares(misses, found.guess[:-1], loss="huber")
    np.testing.assert_allclose(found.guess[:-1], free.x, rtol=1e-4)


def test_an_end_at_which_observations_would_be_lost_is_not_settled() -> None:
    """The minimum lies where the last heights are too low to be seen."""
    plain = curves(1.2)
    problem = Curves(plain.time, plain.heights, edge=2.0)
    start = np.append(np.full(8, 20.0), 0.1)
    found = solved(problem, start)
    assert np.isfinite(problem.cost(found.guess, found.noise))
    assert problem.cost(found.guess, found.noise) < problem.cost(start, found.noise)
    assert found.is_stuck
    assert not found.is_settled
    assert found.length > 1.0


def test_too_few_steps_are_not_settled() -> None:
    found = minimise(curves(1.2), np.append(np.ones(8), 3.0), settled=1e-7, max_steps=2)
    assert not found.is_settled
    assert not found.is_stuck


@pytest.mark.parametrize("size", [1, 9, 40])
def test_a_small_system_is_solved_as_by_numpy_and_unknown_without_a_solution(size: int) -> None:
    rng = np.random.default_rng(size)
    slopes, right = rng.normal(size=(2 * size, size)), rng.normal(size=(size, 2))
    matrix = slopes.T @ slopes
    found = solve_symmetric(np.tril(matrix), right)
    np.testing.assert_allclose(found, np.linalg.solve(matrix, right), rtol=1e-9, atol=1e-12)
    assert np.isnan(solve_symmetric(-matrix, right)).all()
