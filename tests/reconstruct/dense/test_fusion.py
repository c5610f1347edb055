from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform

from reconstruct.dense.depth import count_witnesses, merge_depths
from reconstruct.dense.stereo_pairs import in_frame
from reconstruct.dense.view_store import decoded, stored
from reconstruct.views.range_shift import KernelLens, no_shift, slopes_of
from tests.oracles_dense import merged, plane_depth, port_view

LENS = (np.array([50.0, 50.0, 10.0, 8.0]), no_shift(20, 16).field, 0.0)
NOWHERE = np.full((16, 20), np.nan, np.float32)


def test_merge_depths_equals_its_slow_twin():
    rng = np.random.default_rng(2)
    depths = (2 + rng.normal(0, 0.01, (4, 20, 30))).astype(np.float32)
    depths[rng.random(depths.shape) < 0.2] += np.float32(0.2)
    depths[rng.random(depths.shape) < 0.3] = np.nan
    sigmas = rng.uniform(0.003, 0.02, depths.shape).astype(np.float32)

    depth, sigma, agreeing = merge_depths(depths, sigmas, 3.0)

    for row in range(20):
        for column in range(30):
            z, s, n = merged(depths[:, row, column], sigmas[:, row, column], 3.0)
            np.testing.assert_allclose(depth[row, column], z, rtol=1e-5)
            np.testing.assert_allclose(sigma[row, column], s, rtol=1e-4)
            assert agreeing[row, column] == n
    assert 0 < (agreeing == 0).sum() < agreeing.size


@given(
    true=st.floats(0.5, 10),
    wrong=st.floats(0.5, 10),
    sigma=st.floats(0.001, 0.02),
)
def test_majority_wins_over_one_wrong_match(true: float, wrong: float, sigma: float):
    depths = np.array([true, wrong, true + sigma], np.float32).reshape(3, 1, 1)
    sigmas = np.full((3, 1, 1), sigma, np.float32)
    depth, _, agreeing = merge_depths(depths, sigmas, 3.0)
    assert abs(depth[0, 0] - true) <= 6 * sigma
    assert agreeing[0, 0] >= 2


def witness(shift_m: float) -> tuple[np.ndarray, np.ndarray]:
    """The reference sees a plane 2 m away; the other, next to it, sees one `shift_m` farther."""
    depth = np.full((16, 20), 2.0, np.float32)
    sigma = np.full_like(depth, 0.005)
    other_from_ref = RigidTransform.from_translation([-0.1, 0.0, 0.0]).as_matrix()[:3]
    there = np.full_like(depth, 2.0 + shift_m)
    return count_witnesses(
        depth, sigma, slopes_of(depth, LENS), np.ascontiguousarray(other_from_ref),
        stored(there, sigma), 1.0, LENS, 3.0,
    )  # fmt: skip


def test_the_same_plane_is_confirmed_where_the_other_sees_it():
    confirmed, refuted = witness(0.0)
    # 0.1 m at 2 m and 50 px of focal length moves the picture by 2.5 px
    assert confirmed[:, 3:].all()
    assert not confirmed[:, :2].any()
    assert not refuted.any()


def test_a_plane_behind_refutes_and_one_before_says_nothing():
    confirmed, refuted = witness(0.1)
    assert refuted[:, 3:].all()
    assert not confirmed.any()
    confirmed, refuted = witness(-0.1)
    assert not refuted.any()
    assert not confirmed.any()


def test_witnesses_through_a_tilted_port_equal_their_slow_twin():
    """Depth of the other is so noisy that the pixel chosen there decides the answer."""
    one, other = port_view([0, 0, 0], [1.0, -2.0, 30.0]), port_view([0.2, 0.1, 0], [-1, 1, 28])
    depth = plane_depth(one, 1.2)
    rng = np.random.default_rng(8)
    there = plane_depth(other, 1.2)
    there += rng.normal(0, 0.05, there.shape).astype(np.float32)
    sigma = np.full(depth.shape, 0.01, np.float32)
    factor, other_depth = 2.0, stored(there, 0.5 * sigma)
    there, there_sigma = decoded(other_depth)
    move = other.world_from_cam.inv() * one.world_from_cam
    rows, columns = np.mgrid[: one.pinhole.height_px, : one.pinhole.width_px]
    pixels = np.column_stack([columns.ravel(), rows.ravel()]) + 0.5
    points = one.at_depth(pixels, depth.ravel().astype(float))
    seen = in_frame(other, points).reshape(depth.shape)
    at = np.floor(other.project(points)).astype(int).reshape(*depth.shape, 2)
    z = other.world_from_cam.inv().apply(points)[:, 2].reshape(depth.shape)
    apart = there[at[seen][:, 1], at[seen][:, 0]] - z[seen]
    reach = 3 * np.hypot(0.01, factor * there_sigma[at[seen][:, 1], at[seen][:, 0]])

    def right(first: KernelLens, second: KernelLens) -> float:
        confirmed, refuted = count_witnesses(
            depth, sigma, slopes_of(depth, first), np.ascontiguousarray(move.as_matrix()[:3]),
            other_depth, factor, second, 3.0,
        )  # fmt: skip
        assert not (confirmed & refuted).any()
        agree = (confirmed[seen] == (np.abs(apart) <= reach)) & (refuted[seen] == (apart > reach))
        return float(agree.mean())

    assert seen.mean() > 0.4
    assert right(one.kernel_lens, other.kernel_lens) > 0.999
    bare = [replace(v, shift=no_shift(*v.pinhole.size_px)).kernel_lens for v in (one, other)]
    assert right(*bare) < 0.95
