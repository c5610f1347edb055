from itertools import product

import numpy as np
import pytest

from reconstruct.matching.features import detection_scales, find_features, spread


def blobs(
    centres: np.ndarray, size: tuple[int, int] = (160, 120), sigma: float = 4.0
) -> np.ndarray:
    """Bright spots whose centres are in pixels from the outer corner of the first pixel."""
    x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    picture = np.full(x.shape, 60.0)
    for cx, cy in centres:
        picture += 150.0 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * sigma**2))
    return np.rint(picture).clip(0, 255).astype(np.uint8)


def nearest(pixels: np.ndarray, centre: np.ndarray) -> np.ndarray:
    return pixels[np.argmin(np.linalg.norm(pixels - centre, axis=1))]


def test_keypoints_lie_on_blobs_half_pixel_included() -> None:
    centres = np.array([[50.2, 40.75], [110.5, 80.0], [100.9, 30.3]])
    found = find_features(blobs(centres), None, maximum=100)
    for centre in centres:
        np.testing.assert_allclose(nearest(found.pixels, centre), centre, atol=0.06)


def test_mirrored_picture_has_mirrored_keypoints() -> None:
    rng = np.random.default_rng(3)
    picture = blobs(rng.uniform(15, 105, (8, 2)), sigma=3.0)
    left = find_features(picture, None, maximum=100).pixels
    right = find_features(np.ascontiguousarray(picture[:, ::-1]), None, maximum=100).pixels
    mirrored = np.stack([picture.shape[1] - right[:, 0], right[:, 1]], axis=1)
    offset = np.array([nearest(mirrored, p) - p for p in left])
    offset = offset[np.linalg.norm(offset, axis=1) < 1]
    assert len(offset) >= 8
    # a shift of a quarter pixel, as of SIFT without precise upscaling, would show here twice
    assert np.abs(offset.mean(axis=0)).max() < 0.05


def test_features_keep_away_from_the_border_of_a_mask() -> None:
    """The mask's own edge, such as that of a gripper, must not become part of a feature."""
    sigma = 4.0
    centres = np.array([[40.0, 60.0], [40.0 + 2 * sigma, 20.0]])
    mask = np.ones((120, 160), bool)
    mask[:, 52:] = False
    found = find_features(blobs(centres, sigma=sigma), mask, maximum=100)
    whole = find_features(blobs(centres, sigma=sigma), None, maximum=100)
    assert np.linalg.norm(nearest(whole.pixels, centres[1]) - centres[1]) < 0.1
    reach = 52.0 - found.pixels[:, 0]
    assert np.all(reach > 1.4 * found.scale_px)
    assert 0 < len(found.pixels) < len(whole.pixels)


def test_pictures_are_reduced_to_what_their_features_need() -> None:
    """To 100 pixels for each, and to 1.5 megapixels in any case."""
    for size, maximum in product([(846, 677), (1360, 1024), (3384, 2710)], [3000, 8000, 50_000]):
        first, largest = (min(1.0, np.sqrt(px / np.prod(size))) for px in (100 * maximum, 1.5e6))
        expected = (first, largest) if first < largest else (largest,)
        assert detection_scales(size, maximum) == pytest.approx(expected, rel=1e-12)


def test_a_picture_with_little_to_show_is_searched_at_full_scale() -> None:
    rng = np.random.default_rng(1)
    few = blobs(rng.uniform(20, 380, (40, 2)), (400, 400), sigma=1.2)
    found = find_features(few, None, maximum=900, thrifty=True)
    whole = find_features(few, None, maximum=900)
    np.testing.assert_array_equal(found.pixels, whole.pixels)
    rich = blobs(rng.uniform(0, 400, (900, 2)), (400, 400), sigma=2.5)
    plain = find_features(rich, None, maximum=100)
    quick = find_features(rich, None, maximum=100, thrifty=True)
    assert len(plain.pixels) == len(quick.pixels) == 100
    assert not np.array_equal(plain.pixels, quick.pixels)


def test_spread_takes_the_largest_of_every_cell_first() -> None:
    rng = np.random.default_rng(4)
    crowd = np.column_stack([rng.uniform(0, 20, 500), rng.uniform(0, 20, 500)])
    lonely = np.array([[300.0, 10.0], [10.0, 200.0]])
    pixels = np.concatenate([crowd, lonely])
    sizes = np.concatenate([rng.uniform(10, 20, 500), [2.0, 1.0]])
    chosen = spread(pixels, sizes, np.ones(502), (320, 240), 12)
    assert len(chosen) == len(set(chosen)) == 12
    assert {500, 501} <= set(chosen)
    in_first_cell = [i for i in chosen if np.all(pixels[i] < 20)]
    assert int(np.argmax(sizes[:500])) in in_first_cell
