import itertools
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.executor import SERIAL, local_executor
from alice_survey.sim.seafloor.as_built import true_rig
from camera_calib.approximation.pinhole_warp import best_warp
from camera_calib.camera import Camera
from reconstruct.matching.refinement import (
    align_coarser,
    align_patches,
    refine_tracks,
    track_references,
)
from tests.oracles_matching import align_slowly, track_references_slowly

SIZE = (150, 120)


class Texture:
    """A smooth random picture that is known between its pixels too."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.waves = rng.normal(0, 0.35, (60, 2))
        self.phases = rng.uniform(0, 2 * np.pi, 60)

    def picture(
        self, affine: np.ndarray, shift: np.ndarray, gain: float = 1.0, noise: float = 0.0
    ) -> np.ndarray:
        """What a camera sees that shows the texture's p at pixel `affine @ p + shift`."""
        x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
        points = (np.stack([x, y], axis=-1) - shift) @ np.linalg.inv(affine).T
        return self.shown(points, gain, noise)

    def shown(self, points: np.ndarray, gain: float = 1.0, noise: float = 0.0) -> np.ndarray:
        """A picture whose pixels show these points (H, W, 2)."""
        levels = 120 + 6 * np.cos(points @ self.waves.T + self.phases).sum(axis=-1)
        levels = gain * levels + 8 + np.random.default_rng(1).normal(0, noise, levels.shape)
        return np.rint(levels).clip(0, 255).astype(np.uint8)


AFFINE = np.array([[0.95, 0.21], [-0.17, 1.08]])
SHIFT = np.array([7.3, 12.6])
STRAIGHT = np.zeros((60, 2, 3))


def spots(count: int) -> np.ndarray:
    return np.random.default_rng(2).uniform([30, 35], [115, 85], (count, 2))


def two_views(seed: int, count: int, gain: float, noise: float) -> tuple[np.ndarray, ...]:
    """Two pictures of a texture, spots in the first, and where the second shows them."""
    texture, reference = Texture(seed), spots(count)
    first = texture.picture(np.eye(2), np.zeros(2), noise=noise)
    second = texture.picture(AFFINE, SHIFT, gain=gain, noise=noise)
    return first, second, reference, reference @ AFFINE.T + SHIFT


def test_patches_are_aligned_to_hundredths_of_a_pixel() -> None:
    first, second, reference, truth = two_views(0, 60, 0.7, 2.0)
    guess = truth + np.random.default_rng(3).normal(0, 0.5, truth.shape)
    start = AFFINE @ [[1.04, -0.05], [0.04, 0.97]]
    found = align_patches(first, second, reference, guess, np.tile(start, (60, 1, 1)), STRAIGHT)
    kept = np.isfinite(found[:, 0])
    assert kept.mean() > 0.95
    miss = np.sqrt(((found - truth)[kept] ** 2).mean())
    assert 1e-4 < miss < 0.04  # the noise leaves something


def test_alignment_equals_a_general_solver() -> None:
    first, second, reference, truth = two_views(4, 6, 0.8, 1.0)
    guess = truth + np.array([0.4, -0.3])
    quick, slow = [], []
    for bend in (0.0, 0.002):
        bent = bend * np.random.default_rng(8).normal(size=(6, 2, 3))
        affine = np.tile(AFFINE, (6, 1, 1))
        quick.append(align_patches(first, second, reference, guess, affine, bent))
        places = zip(reference, guess, bent, strict=True)
        slow.append([
            align_slowly(first, second, at, guessed, AFFINE, own, radius=7, sigma=5.0)
            for at, guessed, own in places
        ])  # fmt: skip
    # the two interpolate differently
    np.testing.assert_allclose(quick[0], slow[0], atol=0.03)
    by_bend = np.diff(slow, axis=0)
    assert np.abs(by_bend).max() > 0.04
    np.testing.assert_allclose(np.diff(quick, axis=0), by_bend, atol=0.03)


CAMERA = true_rig(CameraConfig(), WaterConfig(), scale=16, seed=1).cameras["left"]
FISHEYE = true_rig(
    CameraConfig(focal_mm=7.64, lens="fisheye", port="dome", dome_radius_m=0.08),
    WaterConfig(), scale=16, seed=1,
).cameras["left"]  # fmt: skip


@pytest.mark.parametrize(("camera", "at_least"), [(CAMERA, 0.015), (FISHEYE, 0.06)])
def test_lens_and_port_draw_no_tracks_outwards(
    tmp_path: Path, camera: Camera, at_least: float
) -> None:
    """Three cameras above a textured plane: what an affine warp alone leaves, and bends take."""
    x, y = np.meshgrid(np.arange(camera.width_px) + 0.5, np.arange(camera.height_px) + 0.5)
    starts, rays = camera.unproject(np.stack([x, y], axis=-1))
    depth = 2.0
    floor = (starts + rays * ((depth - starts[..., 2:]) / rays[..., 2:]))[..., :2]
    points = np.random.default_rng(2).uniform(floor.min((0, 1)), floor.max((0, 1)), (600, 2))
    pixel = np.linalg.norm(np.diff(floor, axis=1), axis=-1).min()
    greys, truth = [tmp_path / f"{k}.npy" for k in range(3)], []
    for k, path in enumerate(greys):
        place = np.array([0.3 * (k - 1), 0.1 * k])
        np.save(path, Texture(5).shown((floor + place) / pixel))
        truth.append(camera.project(np.insert(points - place, 2, depth, axis=1)))
    same = np.repeat(np.arange(600, dtype=np.uint32)[:, None], 2, axis=1)
    pairs, slopes = [(0, 1, same), (1, 2, same)], []
    warp = best_warp(camera, 0.9 * depth, 1.1 * depth)
    for warps in ([], [warp] * 3):
        found = refine_tracks(truth, greys, pairs, warps, executor=SERIAL)
        arm, reference = truth[2] - [camera.width_px / 2, camera.height_px / 2], truth[1]
        miss = found[2] - truth[2]
        moved = (miss != 0).any(axis=1) & (np.abs(miss).max(axis=1) < 0.3)
        assert moved.sum() > 100
        by = (arm - (reference - reference.mean(axis=0)))[moved]
        slopes.append(float((by * miss[moved]).sum() / (by**2).sum()) * camera.width_px / 2)
    assert abs(slopes[0]) > at_least
    assert abs(slopes[1]) < 0.2 * abs(slopes[0])


def test_what_does_not_resemble_stays() -> None:
    reference = spots(20)
    first, other = (Texture(seed).picture(np.eye(2), np.zeros(2)) for seed in (0, 9))
    blank = np.full_like(first, 90)
    same, straight = np.tile(np.eye(2), (20, 1, 1)), STRAIGHT[:20]
    assert (
        np.isnan(align_patches(first, other, reference, reference, same, straight))
        .all(axis=1)
        .sum()
        >= 19
    )
    assert np.isnan(align_patches(first, blank, reference, reference, same, straight)).all()
    assert np.isnan(align_patches(blank, first, reference, reference, same, straight)).all()
    border = np.array([[4.0, 60.0], [60.0, 117.0]])
    assert np.isnan(align_patches(first, first, border, border, same[:2], straight[:2])).all()
    # 6 px off: the right place is beyond what a position may move
    guess = reference + np.array([6.0, 0.0])
    far = align_patches(first, first, reference, guess, same, straight)
    moved = np.linalg.norm(far - guess, axis=1)
    assert moved[np.isfinite(moved)].max(initial=0.0) <= 3.0


@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 10_000), matches=st.integers(0, 12))
def test_references_equal_those_of_the_slow_twin(seed: int, matches: int) -> None:
    rng = np.random.default_rng(seed)
    sizes = rng.integers(0, 8, 4)
    starts = np.concatenate([[0], np.cumsum(sizes)])
    pairs = []
    for i, j in itertools.combinations(range(4), 2):
        count = min(matches, sizes[i], sizes[j])
        chosen = [rng.permutation(sizes[k])[:count] for k in (i, j)]
        pairs.append((i, j, np.stack(chosen, axis=1).astype(np.uint32)))
    np.testing.assert_array_equal(
        track_references(pairs, starts), track_references_slowly(pairs, starts)
    )


@pytest.mark.parametrize("threads", [1, 2])
def test_tracks_mean_one_spot_in_all_pictures(tmp_path: Path, threads: int) -> None:
    """Three pictures whose features are off by 0.4 px, the third matched with the second only."""
    texture, points = Texture(5), spots(50)
    views = [
        (np.eye(2), np.zeros(2)), (AFFINE, SHIFT), (np.diag([1.1, 0.9]), np.array([-8.0, 6.0]))
    ]  # fmt: skip
    rng = np.random.default_rng(6)
    greys, first_guess = [tmp_path / f"{k}.npy" for k in range(3)], []
    for path, (affine, shift) in zip(greys, views, strict=True):
        guess = points @ affine.T + shift + rng.normal(0, 0.4, points.shape)
        first_guess.append(np.concatenate([guess, [[70.0, 60.0]]]))
        np.save(path, texture.picture(affine, shift, noise=1.0))
    same = np.repeat(np.arange(50, dtype=np.uint32)[:, None], 2, axis=1)
    found = refine_tracks(
        first_guess, greys, [(0, 1, same), (1, 2, same)], [], executor=local_executor(threads)
    )
    assert sum((a != b).any(axis=1).sum() for a, b in zip(found, first_guess, strict=True)) >= 95
    spot = [
        (pixels[:50] - shift) @ np.linalg.inv(affine).T
        for pixels, (affine, shift) in zip(found, views, strict=True)
    ]
    np.testing.assert_array_equal(found[1], first_guess[1])  # the reference of all
    for k in (0, 2):
        gap = np.linalg.norm(spot[k] - spot[1], axis=1)
        assert np.median(gap) < 0.05
        np.testing.assert_array_equal(found[k][50], [70.0, 60.0])


def test_what_noise_hides_is_aligned_on_smaller_pictures() -> None:
    first, second, reference, truth = two_views(0, 40, 1.0, 0.0)
    rng = np.random.default_rng(7)
    first, second = (rng.normal(p, 30.0).clip(0, 255).astype(np.uint8) for p in (first, second))
    guess = truth + np.random.default_rng(3).normal(0, 0.6, truth.shape)
    affine = np.tile(AFFINE, (40, 1, 1))
    whole = align_patches(first, second, reference, guess, affine, STRAIGHT[:40])
    found = align_coarser(first, second, reference, guess, affine, STRAIGHT[:40])
    kept = np.isfinite(found[:, 0])
    assert np.isfinite(whole[:, 0]).mean() < 0.3
    assert kept.mean() > 0.8
    assert 0.02 < np.sqrt(((found - truth)[kept] ** 2).mean()) < 0.35
