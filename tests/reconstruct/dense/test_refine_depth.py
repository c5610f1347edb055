from functools import cache

import cv2
import numpy as np
from scipy import ndimage

from reconstruct.dense import refine_depth
from reconstruct.dense.refine_depth import (
    ALL,
    ComparedView,
    RefinedDepth,
    compare,
    pixel_lines,
    prepare,
    refine,
)
from reconstruct.dense.stereo_pairs import in_frame
from tests.oracles_dense import Scene, hits, pixels_of, render, speckle, stereo_views

SCENE = Scene(
    depth_of=lambda n, e: 12.0 + 0.06 * np.sin(6 * n) * np.cos(5 * e) + 0.1 * n, paint=speckle()
)
VIEWS = stereo_views(np.array([0.1, 0.45]), np.array([0.3, 0.4]))
FAR_VIEWS = stereo_views(np.array([0.1, 0.9]), np.array([0.3, 0.4]))


@cache
def looks(*, far: bool = False) -> list[ComparedView]:
    found = []
    for view in FAR_VIEWS if far else VIEWS:
        grey = cv2.cvtColor(render(view, SCENE), cv2.COLOR_BGR2GRAY)
        contrast, spline, valid = prepare(grey, np.ones(grey.shape, bool))
        found.append(ComparedView(view=view, contrast=contrast, spline=spline, valid=valid))
    return found


def refined(start: np.ndarray, others: list[ComparedView] | None = None) -> RefinedDepth:
    """Depth from a start of 4 mm, by the others that see it."""
    others = looks()[1:] if others is None else others
    return refine(looks()[0], start, np.full_like(start, 0.004), others)


def true_depth() -> np.ndarray:
    one = VIEWS[0]
    points = one.world_from_cam.inv().apply(hits(one, SCENE).reshape(-1, 3))
    return points[:, 2].reshape(one.pinhole.size_px[::-1])


def test_compare_equals_its_slow_twin():
    one, other = looks()[0], looks()[1]
    depth = true_depth()
    move = other.view.world_from_cam.inv() * one.view.world_from_cam
    rest, slope, speed = (np.empty(depth.shape, np.float32) for _ in range(3))
    compare(
        ALL,
        (1 / depth).astype(np.float32),
        one.contrast,
        pixel_lines(one.view.kernel_lens, *depth.shape),
        other.spline,
        other.valid,
        other.view.kernel_lens,
        np.ascontiguousarray(move.as_matrix()[:3]),
        rest,
        slope,
        speed,
    )
    rows, columns = np.nonzero(np.isfinite(rest))
    assert len(rows) > 0.5 * rest.size
    chosen = slice(None, None, 997)
    rows, columns = rows[chosen], columns[chosen]
    pixels = np.column_stack([columns, rows]).astype(float) + 0.5

    def warped(inverse: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        at = other.view.project(one.view.at_depth(pixels, 1 / inverse)) - 0.5
        value = ndimage.map_coordinates(
            other.spline.astype(np.float64), at.T[::-1], order=3, prefilter=False
        )
        return value, at

    inverse = 1 / depth[rows, columns]
    value, at = warped(inverse)
    after, moved = warped(inverse + 1e-6)
    expected = one.contrast[rows, columns] - value
    np.testing.assert_allclose(rest[rows, columns], expected, atol=2e-4)
    np.testing.assert_allclose(slope[rows, columns], (after - value) / 1e-6, rtol=0.02, atol=0.3)
    fast = np.linalg.norm(moved - at, axis=1) / 1e-6
    np.testing.assert_allclose(speed[rows, columns], fast, rtol=1e-3)


def test_refinement_finds_the_surface_from_a_blurred_start_and_says_how_well():
    true = true_depth()
    rng = np.random.default_rng(0)
    wrong = 0.006 * ndimage.gaussian_filter(rng.normal(size=true.shape), 4) * 12
    start = (true + wrong).astype(np.float32)
    found = refined(start)
    known = np.isfinite(found.depth)
    assert known.mean() > 0.85
    error = (found.depth - true)[known]
    before, after = (np.sqrt(np.mean(one**2)) for one in (wrong, error))
    assert before > 0.004
    assert 1e-4 < after < 0.4 * before  # 1.5 mm, rims that one neighbour sees included
    assert 0.3 < 1.4826 * np.median(np.abs(error / found.sigma[known])) < 3.0


def test_bands_of_rows_are_refined_as_the_whole_picture_is(monkeypatch):
    """But for the noise, which is measured in each band: the seams must not show."""
    true = true_depth()
    start = (true + 0.006 * np.sin(np.arange(true.shape[1]) / 9)).astype(np.float32)
    whole = refined(start)
    monkeypatch.setattr(refine_depth, "_BAND_PIXELS", start.size // 5)
    bands = refined(start)
    assert (np.isfinite(whole.depth) != np.isfinite(bands.depth)).mean() < 1e-3
    apart = np.abs(bands.depth - whole.depth) / whole.sigma
    assert 0.0 < np.nanpercentile(apart, 99.9) < 0.3
    ends = np.linspace(0, start.shape[0], 6).astype(int)[1:-1]
    at_seams = np.concatenate([np.arange(end - 3, end + 3) for end in ends])
    assert np.nanmean(apart[at_seams]) < 1.5 * np.nanmean(apart)


def test_windows_across_a_step_keep_what_they_had():
    true = true_depth().astype(np.float32)
    start, sigma = true.copy(), np.full_like(true, 0.004)
    start[100:120, 100:120] -= np.float32(0.3)  # 36 px of disparity at a baseline of 0.36 m
    found = refined(start)
    rim = np.zeros(true.shape, bool)
    rim[98:122, 98:122] = True
    rim[102:118, 102:118] = False
    kept = rim & np.isfinite(found.depth)
    # but for some that only the near partner sees, along whose line the step is small
    assert (found.depth[kept] == start[kept]).mean() > 0.98
    assert (found.sigma[kept] == sigma[kept]).mean() > 0.98
    far = ndimage.binary_dilation(rim, iterations=8) | ndimage.binary_fill_holes(rim)
    assert (found.depth != start)[~far & np.isfinite(found.depth)].mean() > 0.99


def test_unknown_depth_stays_unknown():
    start = true_depth().astype(np.float32)
    start[100:108, 100:108] = np.nan
    found = refined(start)
    assert np.isnan(found.depth[100:108, 100:108]).all()
    assert np.isfinite(found.depth[110:, 110:300]).mean() > 0.85


def test_a_view_without_neighbours_keeps_no_depth():
    depth = true_depth().astype(np.float32)
    found = refined(depth, [])
    assert not np.isfinite(found.depth).any()
    assert (found.seen == 0).all()


def test_what_no_other_station_sees_rests_on_the_pair_with_a_larger_sigma():
    true = true_depth().astype(np.float32)
    start = true + np.float32(0.004) * np.sin(np.arange(true.shape[1]) / 40).astype(np.float32)
    sigma = np.full_like(start, 0.01)
    one, ahead, pair, ahead_right = looks(far=True)
    apart = [ahead, ahead_right]
    points = one.view.at_depth(pixels_of(one.view), true.ravel().astype(np.float64))
    there = [in_frame(other.view, points).reshape(true.shape) for other in (pair, *apart)]
    alone = ndimage.binary_erosion(there[0] & ~there[1] & ~there[2], iterations=6)
    assert alone.mean() > 0.1

    without = refine(one, start, sigma, apart)
    found = refine(one, start, sigma, apart, [pair])

    assert not np.isfinite(without.depth[alone]).any()
    assert np.isfinite(found.depth[alone]).mean() > 0.98
    error = (found.depth - true)[alone & np.isfinite(found.depth)]
    over = error / found.sigma[alone & np.isfinite(found.depth)]
    assert 2e-4 < np.sqrt(np.mean(error**2)) < 0.003
    assert 0.3 < 1.4826 * np.median(np.abs(over)) < 2.0
    seen = np.isfinite(without.depth)
    np.testing.assert_array_equal(found.depth[seen], without.depth[seen])
    assert np.nanmedian(found.sigma[alone]) > 2.0 * np.nanmedian(found.sigma[seen])
