"""Rays that meet a stored DEM, by windows, against all of it and against a plane."""

from pathlib import Path

import numpy as np
import pytest
import rasterio

from reconstruct import elevation
from reconstruct.elevation import StoredElevation
from reconstruct.raster import read_cells

CELL, ROWS, COLUMNS = 0.02, 500, 400


def stored(folder: Path, height: np.ndarray) -> StoredElevation:
    for name, cells in (("dem.tif", height), ("sigma.tif", np.full_like(height, 0.003))):
        with rasterio.open(
            folder / name, "w", driver="GTiff", width=COLUMNS, height=ROWS, count=1,
            dtype="float32", nodata=np.nan, transform=rasterio.Affine(CELL, 0, -4, 0, -CELL, 5),
        ) as raster:  # fmt: skip
            raster.write(cells.astype(np.float32), 1)
    return StoredElevation.of(folder)


def middles() -> tuple[np.ndarray, np.ndarray]:
    rows, columns = np.mgrid[:ROWS, :COLUMNS]
    return -4 + (columns + 0.5) * CELL, 5 - (rows + 0.5) * CELL


def rays(count: int, spread: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    starts = np.column_stack([rng.uniform(-2, 2, (count, 2)), rng.uniform(6.5, 7.5, count)])
    ways = np.column_stack([rng.normal(0, spread, (count, 2)), np.ones(count)])
    return starts, ways / np.linalg.norm(ways, axis=1, keepdims=True)


def test_rays_meet_a_plane_where_they_must(tmp_path: Path) -> None:
    east, north = middles()
    dem = stored(tmp_path, -9.0 + 0.2 * north - 0.1 * east)
    starts, ways = rays(200, 0.3)
    part, met = dem.met_by(starts, ways)
    normal = np.array([0.2, -0.1, 1.0])  # depth + height is 0
    reach = (9.0 - starts @ normal) / (ways @ normal)
    np.testing.assert_allclose(met, starts + reach[:, None] * ways, atol=1e-5)
    np.testing.assert_allclose(part.at(part.sigma, met[:, [1, 0]]), 0.003, rtol=1e-6)
    up = dem.met_by(starts[:1], ways[:1] * [1.0, 1.0, -1.0])[1]
    beyond = dem.met_by(starts[:1] + np.array([50.0, 0.0, 0.0]), ways[:1])[1]
    assert np.isnan(up).all() and np.isnan(beyond).all()


def test_parts_say_what_the_whole_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    east, north = middles()
    height = -9.0 + 0.3 * np.sin(3 * east) * np.cos(2 * north)
    height[:, :20] = np.nan
    height[-1, -1] = -30.0  # a fault far away widens what rays may reach
    dem = stored(tmp_path, height)
    starts, ways = rays(300, 0.2)
    expected = dem.whole.met_by(starts, ways)
    assert np.isfinite(expected).all(axis=1).sum() > 290
    one_by_one = [dem.met_by(s[None], w[None]) for s, w in zip(starts, ways, strict=True)]
    np.testing.assert_allclose([met[0] for _, met in one_by_one], expected, atol=2e-3)
    monkeypatch.setattr(elevation, "_MAX_CELLS", 90_000)
    bounded = [dem.met_by(s[None], w[None]) for s, w in zip(starts, ways, strict=True)]
    assert max(part.height.size for part, _ in bounded) <= 100_000
    np.testing.assert_allclose([met[0] for _, met in bounded], expected, atol=2e-2)


def test_a_wall_hides_what_is_behind_it(tmp_path: Path) -> None:
    _, north = middles()
    dem = stored(tmp_path, np.where(np.abs(north - 1.0) < 0.1, -8.0, -9.0))
    points = np.array([[0.0, 0.0, 9.0]] * 4)
    eyes = np.array([[0, 0, 7.0], [2, 0, 7.5], [2, 0, 6.5], [-2, 0, 7.5]])
    hidden = dem.whole.hides(points, np.full(4, 0.05), eyes)
    assert hidden.tolist() == [False, True, False, False]


@pytest.mark.parametrize("window", [(0, 0, 10, 12), (-3, -4, 9, 11), (495, 390, 12, 20)])
def test_cells_beyond_a_raster_are_unknown(
    tmp_path: Path, window: tuple[int, int, int, int]
) -> None:
    values = np.arange(ROWS * COLUMNS, dtype=np.float64).reshape(ROWS, COLUMNS)
    stored(tmp_path, values)
    row, column, rows, columns = window
    wide = np.pad(values, 30, constant_values=np.nan)
    expected = wide[row + 30 : row + 30 + rows, column + 30 : column + 30 + columns]
    np.testing.assert_array_equal(read_cells(tmp_path / "dem.tif", *window), expected)
    coarse = read_cells(tmp_path / "dem.tif", *window, every=3)
    assert coarse.shape == (rows // 3, columns // 3)
    blocks = expected[: rows // 3 * 3, : columns // 3 * 3].reshape(rows // 3, 3, columns // 3, 3)
    np.testing.assert_array_equal(coarse, np.where(np.isnan(blocks).any((1, 3)), np.nan,
                                                   blocks[:, 1, :, 1]))  # fmt: skip
