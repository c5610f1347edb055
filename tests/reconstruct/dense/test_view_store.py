from pathlib import Path

import numpy as np

from reconstruct.dense.view_store import ViewStore, pack_mask


def test_depth_comes_back_within_a_fiftieth_of_a_millimetre(tmp_path: Path):
    rng = np.random.default_rng(4)
    depth = rng.uniform(1.3, 3.1, (40, 50)).astype(np.float32)
    sigma = (10 ** rng.uniform(-5, -1, depth.shape)).astype(np.float32)
    depth[3, 4], sigma[5, 6] = np.nan, np.nan
    store = ViewStore(tmp_path)

    store.save_depth(7, "fine", depth, sigma)
    z, s = store.load_depth(7, "fine")

    unknown = np.zeros(depth.shape, bool)
    unknown[3, 4] = unknown[5, 6] = True
    np.testing.assert_array_equal(np.isnan(z), unknown)
    np.testing.assert_array_equal(np.isnan(s), unknown)
    assert 1e-6 < np.nanmax(np.abs(z - depth)) < 3.2e-5
    np.testing.assert_allclose(s[~unknown], sigma[~unknown], rtol=0.026)
    sizes = [path.stat().st_size for path in tmp_path.iterdir()]
    assert sum(sizes) < 3 * depth.size + 500


def test_no_depth_of_a_view_along_the_floor_is_lost(tmp_path: Path):
    depth = np.geomspace(0.2, 12.0, 4000, dtype=np.float32).reshape(50, 80)
    depth[:40] = np.linspace(0.9, 1.1, 40 * 80).reshape(40, 80)  # most of it is near
    wrong = np.array([-2.0, 0.0, 1e-3, 1e4], np.float32)
    depth[0, :4] = wrong
    store = ViewStore(tmp_path)

    store.save_depth(0, "fine", depth, 0.01 * depth)
    z, s = store.load_depth(0, "fine")

    np.testing.assert_array_equal(np.isnan(z), np.isnan(s))
    assert np.isnan(z[0, :4]).all()
    np.testing.assert_allclose(z.ravel()[4:], depth.ravel()[4:], rtol=4e-5)


def test_colours_keep_brightness_and_masks_every_bit(tmp_path: Path):
    rng = np.random.default_rng(4)
    rows, columns = np.mgrid[:41, :53]
    smooth = 120 + 60 * np.sin(np.stack([rows, columns, rows + columns], -1) / 15)
    colour = np.clip(smooth + rng.normal(0, 20, (41, 53, 1)), 0, 255).astype(np.uint8)
    mask = rng.random((41, 53)) < 0.5
    store = ViewStore(tmp_path)

    store.save_colour(1, colour, valid=pack_mask(mask))
    assert store.has(1, "picture") and not store.has(2, "picture")

    error = store.load_colour(1).astype(float) - colour
    assert 0.1 < np.sqrt(np.mean(error**2)) < 4.0
    np.testing.assert_array_equal(store.load_mask(1, "picture", "valid", 53), mask)
    sizes = sum(path.stat().st_size for path in tmp_path.iterdir())
    assert sizes < 1.7 * mask.size + 600
    content = store.path(1, "picture").read_bytes()
    for lost in (b"", content[:900], content[:900] + bytes(len(content) - 900)):  # by a power cut
        store.path(1, "picture").write_bytes(lost)
        assert not store.has(1, "picture")
