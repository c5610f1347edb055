"""Every level of a raster against the obvious mean, and every tile against its level."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray

from alice_survey.app.report.rasters import MAP_RASTERS, TILE_PX, Pyramid
from alice_survey.app.studio.files import Workspace
from alice_survey.app.studio.layers import Layers
from alice_survey.core.artefacts import StaleError
from tests.alice_survey.app.report.tiny import tiny_workspace, write_raster

ROWS, COLUMNS = 1302, 1110
"""No multiples of a tile or of a pixel of the third level."""
RASTERS = {one.name: one for one in MAP_RASTERS}
Array = NDArray[Any]


def written(path: Path, bands: Array, **more: Any) -> Path:
    tiles = {"tiled": True, "blockxsize": 256, "blockysize": 256, "compress": "deflate"}
    return write_raster(path, bands, 0.01, (-3.0, 7.0), **tiles, **more)


def pyramid_of(path: Path, name: str) -> Pyramid:
    return Pyramid(path, RASTERS[name], "m")


def heights() -> Array:
    rows, columns = np.mgrid[:ROWS, :COLUMNS].astype(np.float32)
    found = -12 + 0.4 * np.sin(columns / 60) + 0.3 * np.cos(rows / 45) + 1e-4 * rows
    found += np.random.default_rng(1).normal(0, 0.003, found.shape)
    found[rows + columns < 500] = np.nan
    found[(rows - 900) ** 2 + (columns - 700) ** 2 < 90**2] = np.nan
    return found.astype(np.float32)


def painting() -> Array:
    rows, columns = np.mgrid[:ROWS, :COLUMNS]
    bands = np.stack([rows % 256, columns % 256, (rows + columns) % 256, 255 + 0 * rows])
    bands[3, rows * 0.7 + columns < 400] = 0
    return bands.astype(np.uint8)


def mean_of_known(values: Array, weight: Array, side: int) -> tuple[Array, Array]:
    """Over squares, in double precision; beyond the border nothing weighs anything."""
    high, wide = (-(-length // side) for length in weight.shape)
    padding = ((0, high * side - weight.shape[0]), (0, wide * side - weight.shape[1]))
    squares = (high, side, wide, side)
    shares = np.pad(weight.astype(float), padding).reshape(squares)
    total = (np.pad(values.astype(float), padding).reshape(squares) * shares).sum(axis=(1, 3))
    sums = shares.sum(axis=(1, 3))
    return total / np.where(sums > 0, sums, np.nan), sums / side**2


def test_levels_are_means_of_what_is_known(tmp_path: Path) -> None:
    values = heights()
    path = written(tmp_path / "a.tif", values[None], nodata=np.nan)
    pyramid = pyramid_of(path, "dem")
    assert [(s.columns, s.rows) for s in pyramid.levels] == [(1110, 1302), (555, 651), (278, 326)]
    for size in pyramid.levels:  # each covers the whole raster
        assert (size.columns * size.east, size.rows * size.north) == pytest.approx((11.10, 13.02))
    known = np.isfinite(values)
    for level, size in enumerate(pyramid.levels[:2]):
        found = pyramid.values(size, 0, 0, size.columns, size.rows)
        mean, cover = mean_of_known(np.where(known, values, 0), known.astype(float), 2**level)
        np.testing.assert_array_equal(np.isfinite(found), cover > 0)
        np.testing.assert_allclose(found[cover > 0], mean[cover > 0], atol=4e-6)
        inner = pyramid.values(size, 31, 17, size.columns, 203)
        np.testing.assert_allclose(inner, found[17:203, 31:], atol=2e-6)
    third = pyramid.values(pyramid.levels[2], 0, 0, 278, 326)
    mean, cover = mean_of_known(np.where(known, values, 0), known.astype(float), 4)
    whole = cover == 1  # pixels are 3.99 cells wide and high here
    assert np.abs(third - mean)[whole].max() < 0.03


def test_counts_of_zero_are_unknown(tmp_path: Path) -> None:
    counts = np.zeros((1, 600, 600), np.uint8)
    counts[0, :, 300:] = 4
    tile = pyramid_of(written(tmp_path / "a.tif", counts), "stations").tile(1, 0, 0)
    assert (tile[:, 150:, 3] == 255).all()
    assert not tile[:, :150, 3].any()


def test_a_mosaics_own_levels_are_shown_as_they_are(tmp_path: Path) -> None:
    plain = written(tmp_path / "plain.tif", painting(), photometric="RGB", alpha="YES")
    cog = tmp_path / "cog.tif"
    with rasterio.open(plain) as raster:
        from rasterio.shutil import copy

        copy(raster, cog, driver="COG", blocksize=512, overview_resampling="average")
    pyramid = pyramid_of(cog, "mosaic")
    for number in (1, 2):
        with rasterio.open(cog, overview_level=number - 1) as raster:
            own = raster.read()
        size = pyramid.levels[number]
        assert (size.rows, size.columns) == own.shape[1:]
        tile = pyramid.tile(number, 0, 0)
        np.testing.assert_array_equal(tile[..., :3], np.moveaxis(own[:3, :512, :512], 0, -1))


def test_a_mosaic_without_levels_is_averaged_without_what_is_clear(tmp_path: Path) -> None:
    bands = painting()
    path = written(tmp_path / "a.tif", bands, photometric="RGB", alpha="YES")
    tile = pyramid_of(path, "mosaic").tile(1, 0, 0)
    for band in range(3):
        mean, cover = mean_of_known(bands[band].astype(float), bands[3] / 255.0, 2)
        seen = cover[:512, :512] > 0.5
        assert (tile[..., 3][seen] == 255).all()
        assert np.abs(tile[..., band] - mean[:512, :512])[seen].max() <= 1


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A workspace whose rasters take several tiles."""
    workspace = tiny_workspace(tmp_path_factory.mktemp("layers"))
    values = heights()
    seen = np.where(np.isfinite(values), 3, 0).astype(np.uint8)
    seen[:, 600:] += (seen[:, 600:] > 0).astype(np.uint8)
    for name, bands in {
        "dense/dem": values, "dense/sigma": 1e-3 * np.abs(values), "dense/slope": -values,
        "evaluation/error": 1e-3 * (values + 12), "dense/stations": seen,
    }.items():  # fmt: skip
        nodata = np.nan if bands.dtype == np.float32 else None
        written(workspace / f"{name}.tif", bands[None], nodata=nodata)
    written(workspace / "mosaic" / "mosaic.tif", painting(), photometric="RGB", alpha="YES")
    return workspace


@pytest.mark.parametrize("name", ["mosaic", "dem", "error", "stations"])
def test_tiles_make_the_whole_level(folder: Path, name: str) -> None:
    """Pixel by pixel before compression, shade included: no seams, no shift, one colour scale."""
    shown = {layer.name: layer for layer in Layers(Workspace(folder)).picture_layers()}[name]
    pyramid = pyramid_of(folder / RASTERS[name].file, name)
    for level, size in enumerate(pyramid.levels):
        assert shown.size(shown.levels - 1 - level) == (
            size.columns, size.rows, size.east, size.north,
        )  # fmt: skip
        sheet = np.zeros((size.rows, size.columns, 4), np.uint8)
        columns, rows = size.tiles
        for x in range(columns):
            for y in range(rows):
                tile = pyramid.tile(level, x, y)
                top, left = y * TILE_PX, x * TILE_PX
                sheet[top : top + tile.shape[0], left : left + tile.shape[1]] = tile
        if name == "mosaic":
            whole = pyramid._paint(size, 0, 0, size.columns, size.rows)
        else:
            assert shown.scale is not None and pyramid.limits is not None
            assert pyramid.limits == (shown.scale.low, shown.scale.high)
            values = pyramid.values(size, 0, 0, size.columns, size.rows)
            whole = pyramid.colour(values, size.east)
        # Means may differ in the last bits, and then a colour by one or two.
        assert np.abs(sheet.astype(int) - whole).max() <= 2
        assert (sheet == whole).mean() > 0.999


def test_encoded_tiles_show_the_rasters_own_pixels(folder: Path) -> None:
    layers = Layers(Workspace(folder))
    content, token = layers.tile("mosaic", 2, 1, 2, None)
    tile = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert tile.shape[:2] == (ROWS - 2 * TILE_PX, TILE_PX)
    for row, column in ((40, 300), (170, 90), (250, 400)):
        red, green = tile[row, column, 2], tile[row, column, 1]
        assert abs(int(red) - (2 * TILE_PX + row) % 256) < 12
        assert abs(int(green) - (TILE_PX + column) % 256) < 12
    assert layers.tile("mosaic", 2, 1, 2, token) == (content, token)
    with pytest.raises(StaleError):
        layers.tile("mosaic", 2, 1, 2, "another")
    for missing in ((3, 0, 0), (2, 3, 0), (2, 0, 3), (-1, 0, 0)):
        with pytest.raises(FileNotFoundError):
            layers.tile("mosaic", *missing, None)


def test_limits_of_a_large_raster_are_close_to_those_of_all_its_values(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    values = np.kron(rng.normal(0, 1, (40, 40)), np.ones((60, 60))).astype(np.float32)
    values += rng.normal(0, 0.1, values.shape).astype(np.float32)
    values[:1200, :900] = np.nan
    limits = pyramid_of(written(tmp_path / "a.tif", values[None], nodata=np.nan), "dem").limits
    expected = np.nanpercentile(values, [1, 99])
    assert limits == pytest.approx(tuple(expected), abs=0.15)


def test_a_raster_of_one_row_and_one_without_a_value(tmp_path: Path) -> None:
    workspace = tiny_workspace(tmp_path)
    written(workspace / "dense" / "dem.tif", np.full((1, 1, 700), -3, np.float32), nodata=np.nan)
    written(workspace / "dense" / "sigma.tif", np.full((1, 9, 7), np.nan, np.float32))
    dense = workspace / "dense"
    assert pyramid_of(dense / "dem.tif", "dem").tile(1, 0, 0).shape == (1, 350, 4)
    assert not pyramid_of(dense / "sigma.tif", "sigma").tile(0, 0, 0)[..., 3].any()
    layers = Layers(Workspace(workspace)).picture_layers()
    scale = {layer.name: layer.scale for layer in layers}["sigma"]
    assert scale is not None and (scale.low, scale.high) == (0.0, 1.0)
