"""Alignment recovers what was applied, and no scale where none is requested."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from reconstruct.placing.alignment import align_rigid, align_similarity


@given(seed=st.integers(0, 2**32 - 1), scale=st.floats(0.1, 10.0))
def test_a_similarity_is_recovered(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(12, 3))
    turn, shift = Rotation.random(rng=rng), rng.normal(size=3)

    found = align_similarity(source, scale * turn.apply(source) + shift)

    assert found.scale == pytest.approx(scale, rel=1e-9)
    assert (found.rotation * turn.inv()).magnitude() < 1e-7
    np.testing.assert_allclose(found.apply(source), scale * turn.apply(source) + shift, atol=1e-8)


def test_a_mirrored_flat_set_is_turned_not_mirrored() -> None:
    rng = np.random.default_rng(1)
    flat = np.column_stack([rng.normal(size=(20, 2)), 1e-3 * rng.normal(size=20)])

    found = align_rigid(flat, flat * [1, 1, -1])

    assert np.linalg.det(found.rotation.as_matrix()) == pytest.approx(1.0)
    assert found.rotation.magnitude() < 1e-2
