import cv2
import numpy as np
import pytest

from reconstruct.dense.depth import match, match_pair, pair_depth, without_mixed
from reconstruct.pictures.normalise import normalise
from tests import oracles_dense

EVERYWHERE = np.ones((oracles_dense.HEIGHT, oracles_dense.WIDTH), bool)


def shifted(shift_px: float, height: int = 120, width: int = 260) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(8)
    noise = cv2.GaussianBlur(rng.normal(size=(height, width)).astype(np.float32), (0, 0), 1.2)
    left = np.clip(128 + 120 * noise, 0, 255)
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    right = cv2.remap(left, x + np.float32(shift_px), y, cv2.INTER_CUBIC)
    return np.rint(left).astype(np.uint8), np.clip(np.rint(right), 0, 255).astype(np.uint8)


def test_match_is_unbiased_over_all_fractions_and_finds_each():
    errors = []
    for shift_px in 7.0 + np.arange(16) / 16:
        found = match(*shifted(float(shift_px)), 16)[10:-10, 40:-20]
        assert np.isfinite(found).mean() > 0.9
        assert abs(np.nanmedian(found) - shift_px) < (0.15 if 4 * shift_px % 1 else 0.1)
        errors.append(np.nanmean(found) - shift_px)
    assert abs(np.mean(errors)) < 0.012  # rounding left alone gives 0.031
    assert np.std(errors) > 1e-4  # sub-pixel offsets do differ from the truth


def test_an_even_area_gets_no_disparity():
    left, right = shifted(7.0)
    left[:, 100:180], right[:, 93:173] = 128, 128
    found = match(left, right, 16)
    assert not np.isfinite(found[15:-15, 112:168]).any()
    assert np.isfinite(found[15:-15, 200:240]).mean() > 0.9


@pytest.mark.parametrize("shift_px", [0.4, 15.3])
def test_a_match_at_the_end_of_the_search_is_left_out(shift_px: float):
    left, right = shifted(shift_px)
    found = match(left, right, 16)[10:-10, 40:-20]
    assert np.isfinite(found).mean() < 0.05


def test_mixed_pixels_go_on_both_sides_of_a_step_and_slopes_stay():
    disparity = np.full((9, 12), 20.0, np.float32)
    disparity[:, 6:] = 25.0
    kept = np.isfinite(without_mixed(disparity))
    assert not kept[:, 5:7].any()
    assert kept[:, :5].all()
    assert kept[:, 7:].all()
    slope = np.tile(np.arange(12, dtype=np.float32) * 0.9, (9, 1))
    assert np.isfinite(without_mixed(slope)).all()


@pytest.mark.parametrize("heading_deg", [0.0, 130.0])
def test_depth_of_a_slope_with_a_step(heading_deg: float):
    scene = oracles_dense.Scene(
        depth_of=oracles_dense.sloped_with_step, paint=oracles_dense.speckle()
    )
    views = oracles_dense.stereo_views(np.array([0.1, 0.45]), np.array([0.3, 0.4]), heading_deg)
    one, other = views[0], views[1]
    here, there = ((normalise(oracles_dense.render(v, scene)), EVERYWHERE) for v in (one, other))
    rng = np.random.default_rng(1)
    place = rng.uniform(-0.3, 0.9, (200, 2))
    points = np.column_stack([place, oracles_dense.sloped_with_step(*place.T)])

    found = pair_depth((one, other), (here, there), points)
    depth, sigma = found.depth, found.sigma(0.3)

    true = one.world_from_cam.inv().apply(oracles_dense.hits(one, scene).reshape(-1, 3))[:, 2]
    error = depth - true.reshape(depth.shape)
    known = np.isfinite(depth)
    assert known.mean() > 0.5
    assert 0.0005 < np.sqrt(np.nanmean(error**2)) < 0.015
    assert np.nanmedian(np.abs(error)) < np.nanmedian(sigma)
    assert abs(np.nanmedian(error)) < 0.0015


def test_a_match_gives_the_depth_of_its_partner_as_well_as_one_the_other_way_round():
    scene = oracles_dense.Scene(
        depth_of=oracles_dense.sloped_with_step, paint=oracles_dense.speckle()
    )
    one, other = oracles_dense.stereo_views(np.array([0.1, 0.45]), np.array([0.3, 0.4]), 130.0)[:2]
    here, there = ((normalise(oracles_dense.render(v, scene)), EVERYWHERE) for v in (one, other))
    place = np.random.default_rng(1).uniform(-0.3, 0.9, (200, 2))
    points = np.column_stack([place, oracles_dense.sloped_with_step(*place.T)])
    true = other.world_from_cam.inv().apply(oracles_dense.hits(other, scene).reshape(-1, 3))[:, 2]
    errors = [
        depth.depth - true.reshape(depth.depth.shape)
        for depth in (
            pair_depth((other, one), (there, here), points),
            match_pair((one, other), (here, there), points).swap().depth(other, one),
        )
    ]
    own, swapped = (error[np.isfinite(error)] for error in errors)
    assert 0.97 * own.size < swapped.size < 1.01 * own.size
    assert abs(np.median(swapped)) < 3e-4
    assert np.median(np.abs(swapped)) < 1.1 * np.median(np.abs(own))
    assert np.sqrt(np.mean(swapped**2)) < 0.012


def test_masked_pixels_get_no_depth():
    scene = oracles_dense.Scene(depth_of=oracles_dense.flat, paint=oracles_dense.speckle())
    one, other, *_ = oracles_dense.stereo_views(np.array([0.0, 0.35]), np.array([0.0, 0.0]), 0.0)
    left, right = (normalise(oracles_dense.render(v, scene)) for v in (one, other))
    masked = EVERYWHERE.copy()
    masked[:, :200] = False
    points = np.array(
        [[0.1, 0.1, oracles_dense.DEPTH_M + 0.05], [0.0, 0.2, oracles_dense.DEPTH_M - 0.05]] * 3
    )
    here, there, free = (
        pair_depth((one, other), ((left, seen), (right, matched)), points).depth
        for seen, matched in ((masked, EVERYWHERE), (EVERYWHERE, masked), (EVERYWHERE, EVERYWHERE))
    )
    assert np.isfinite(free[:, :200]).any()
    assert not np.isfinite(here[:, :200]).any()
    assert np.isfinite(here[:, 210:]).any()
    assert np.isfinite(there).sum() < 0.7 * np.isfinite(free).sum()
