"""The factor of a sparse matrix of blocks against dense algebra and against SuperLU's fill."""

import numpy as np
import pytest
from scipy.sparse import csr_matrix, identity, kron

from alice_survey.base import block_factor
from alice_survey.base.block_factor import BlockFactor, fronts_of
from alice_survey.base.frames import Array


def graph(place: Array, reach: float) -> csr_matrix:
    """Which of some places are within reach of each other."""
    meets = np.linalg.norm(place[:, None] - place, axis=-1) <= reach
    return csr_matrix(meets.astype(np.float64))


def blocks_of(meets: csr_matrix, wide: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Blocks (B, K, K) in a pattern and the dense matrix, symmetric, with units far apart."""
    count = meets.shape[0]
    dense = kron(meets, np.ones((wide, wide))).toarray() * rng.normal(size=(count * wide,) * 2)
    dense = dense + dense.T + 40.0 * np.eye(count * wide)
    units = np.tile(np.geomspace(1e-4, 1e3, wide), count)
    dense = dense * np.outer(units, units)
    rows = np.repeat(np.arange(count), np.diff(meets.indptr))
    return dense.reshape(count, wide, count, wide)[rows, :, meets.indices], dense


SQUARE = np.stack(np.meshgrid(np.arange(9.0), np.arange(14.0)), axis=-1).reshape(-1, 2)
TWO = np.concatenate([SQUARE, SQUARE + np.array([40.0, 0.0])])
STAR = np.array([[np.cos(a), np.sin(a)] for a in np.linspace(0, 6, 40)] + [[0.0, 0.0]])


@pytest.mark.parametrize("wide", [1, 3])
@pytest.mark.parametrize(
    ("place", "reach"), [(SQUARE, 1.5), (SQUARE, 3.1), (TWO, 1.0), (STAR, 1.0), (SQUARE, 99.0)]
)
def test_it_solves_and_inverts_as_dense_algebra_does(
    place: Array, reach: float, wide: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(block_factor, "_LEAF", 5)
    rng = np.random.default_rng(len(place))
    meets = graph(place, reach)
    blocks, dense = blocks_of(meets, wide, rng)
    count = len(place)

    factor = BlockFactor(meets.indptr.astype(np.int64), meets.indices.astype(np.int64), blocks)

    right = rng.normal(size=(count, wide, 2))
    inverse = np.linalg.inv(dense)
    unit = np.sqrt(np.abs(np.diag(inverse))).reshape(count, wide)
    wanted = np.linalg.solve(dense, right.reshape(-1, 2)).reshape(right.shape)
    size = np.abs(wanted).max(axis=(0, 2))[None, :, None]
    np.testing.assert_allclose(factor.solve(right) / size, wanted / size, atol=1e-9)
    rows = np.repeat(np.arange(count), np.diff(meets.indptr))
    found = factor.inverse_blocks(len(blocks)) / (
        unit[rows][:, :, None] * unit[meets.indices][:, None, :]
    )
    wanted = inverse.reshape(count, wide, count, wide)[rows, :, meets.indices] / (
        unit[rows][:, :, None] * unit[meets.indices][:, None, :]
    )
    np.testing.assert_allclose(found, wanted, atol=1e-9)


def test_every_row_is_eliminated_once_and_a_lawnmower_fills_little() -> None:
    place = np.stack(np.meshgrid(np.arange(90.0), np.arange(30.0)), axis=-1).reshape(-1, 2)
    meets = graph(place, 2.1) + identity(len(place), format="csr")
    fronts = fronts_of(meets.indptr.astype(np.int64), meets.indices.astype(np.int64))

    np.testing.assert_array_equal(
        np.sort(np.concatenate([front.own for front in fronts])), np.arange(len(place))
    )
    kept = sum(len(front.own) * (len(front.own) + len(front.later)) for front in fronts)
    filled = kept / len(place)
    assert 30 < filled < 130  # a band would take 2 x 30 x 2 in its own order, all rows 2700
