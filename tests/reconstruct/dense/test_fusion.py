from dataclasses import replace

import numpy as np

from reconstruct.dense.depth import count_confirming, merge_depths
from reconstruct.dense.stereo_pairs import in_frame
from reconstruct.dense.view_store import ViewStore, decode_depth
from reconstruct.views.range_shift import KernelLens, no_shift, slopes_of
from tests.oracles_dense import merged, pixels_of, plane_depth, port_view


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


def test_witnesses_through_a_tilted_port_equal_their_slow_twin(tmp_path):
    """Depth of the other is so noisy that the pixel chosen there decides the answer."""
    one, other = port_view([0, 0, 0], [1.0, -2.0, 30.0]), port_view([0.2, 0.1, 0], [-1, 1, 28])
    depth = plane_depth(one, 1.2)
    rng = np.random.default_rng(8)
    there = plane_depth(other, 1.2)
    there += rng.normal(0, 0.05, there.shape).astype(np.float32)
    sigma = np.full(depth.shape, 0.01, np.float32)
    factor, store = 2.0, ViewStore(tmp_path)
    store.save_depth(1, "fine", there, 0.5 * sigma)
    other_depth = store.stored_depth(1, "fine")
    there, there_sigma = decode_depth(other_depth)
    move = other.world_from_cam.inv() * one.world_from_cam
    points = one.at_depth(pixels_of(one), depth.ravel().astype(float))
    seen = in_frame(other, points).reshape(depth.shape)
    at = np.floor(other.project(points)).astype(int).reshape(*depth.shape, 2)
    z = other.world_from_cam.inv().apply(points)[:, 2].reshape(depth.shape)
    apart = there[at[seen][:, 1], at[seen][:, 0]] - z[seen]
    reach = 3 * np.hypot(0.01, factor * there_sigma[at[seen][:, 1], at[seen][:, 0]])

    def right(first: KernelLens, second: KernelLens) -> float:
        confirmed, refuted = count_confirming(
            depth, sigma, slopes_of(depth, first, 0, 0), np.ascontiguousarray(move.as_matrix()[:3]),
            other_depth, factor, second, 3.0,
        )  # fmt: skip
        assert not (confirmed & refuted).any()
        agree = (confirmed[seen] == (np.abs(apart) <= reach)) & (refuted[seen] == (apart > reach))
        return float(agree.mean())

    assert seen.mean() > 0.4
    assert right(one.kernel_lens, other.kernel_lens) > 0.999
    bare = [replace(v, shift=no_shift(*v.pinhole.size_px)).kernel_lens for v in (one, other)]
    assert right(*bare) < 0.95
