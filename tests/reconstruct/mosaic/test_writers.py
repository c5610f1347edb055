"""Files of a mosaic over a large box of which a strip along its diagonal is seen."""

import multiprocessing
import re
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.windows import Window

from reconstruct.mosaic.grid import Footprints, blocks_of, neighbours
from reconstruct.mosaic.paint import Painted
from reconstruct.mosaic.run import cloud_optimised, thumbnail, write_tiles
from reconstruct.raster import DemGrid, small_cache, transform_of
from tests.oracles_dense import FRAME

TILE_PX = 1024
PICTURES = 70_000
"""More than 16 bits count."""


def grid_of(side_px: int) -> DemGrid:
    return DemGrid(west=-40.0, north=25.0, cell=0.001, rows=side_px, columns=side_px)


def strip(grid: DemGrid) -> Iterator[list[Painted]]:
    """Tiles on the diagonal: red counts them, and so does the number of the picture."""
    side_m, count = TILE_PX * grid.cell, grid.rows // TILE_PX
    west = grid.west + side_m * (np.arange(count) + 0.25)
    north = grid.north - side_m * (np.arange(count) + 0.25)
    boxes = np.stack([west, west + side_m / 2, north - side_m / 2, north], axis=1)
    seen = Footprints(boxes=boxes, reach=np.zeros(count))
    blocks = blocks_of(grid, seen, TILE_PX, 0)
    assert [block.views for block in blocks] == [(n,) for n in range(count)]
    for group in neighbours(blocks, 2 * TILE_PX):
        tiles = []
        for block in group:
            rgba = np.full((4, TILE_PX, TILE_PX), 255, np.uint8)
            rgba[0] = 1 + block.views[0] % 200
            source = np.full((TILE_PX, TILE_PX), PICTURES - block.views[0], np.int32)
            tiles.append(Painted(window=block.core, rgba=rgba, source=source))
        yield tiles


@small_cache(48)
def written(folder: Path, side_px: int) -> tuple[float, float]:
    """Write the mosaic; return the share that is painted, and the process' largest memory, MiB."""
    grid = grid_of(side_px)
    names = [f"{n}.png" for n in range(PICTURES)]
    rough = folder / "rough.tif"
    share = write_tiles(rough, folder / "source.tif", grid, FRAME, strip(grid), names, 1)
    cloud_optimised(rough, folder / "mosaic.tif", 1)
    thumbnail(folder / "mosaic.tif", folder / "mosaic.png")
    status = Path("/proc/self/status").read_text()  # `getrusage` counts the parent's memory too
    return share, int(re.findall(r"VmHWM:\s+(\d+) kB", status)[0]) / 1024


@pytest.mark.slow
@pytest.mark.parametrize("side_px", [8 * TILE_PX, 17 * TILE_PX])
def test_a_strip_across_a_large_box_takes_little(side_px: int, tmp_path: Path):
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        share, peak_mib = pool.submit(partial(written, tmp_path, side_px)).result()
    grid, count = grid_of(side_px), side_px // TILE_PX
    assert share == pytest.approx(1 / count)
    assert 50 < peak_mib < 600
    for name in ("mosaic.tif", "source.tif"):
        size = (tmp_path / name).stat().st_size
        assert 100 * count < size < 60_000 * count + 5e6  # the list of names is 1 MB
    with (
        rasterio.open(tmp_path / "mosaic.tif") as mosaic,
        rasterio.open(tmp_path / "source.tif") as source,
    ):
        assert mosaic.shape == source.shape == (side_px, side_px)
        assert mosaic.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert mosaic.colorinterp[3] == rasterio.enums.ColorInterp.alpha
        assert mosaic.tags()["VERTICAL_DATUM"] == "sea surface"
        assert mosaic.transform == source.transform == transform_of(grid)
        assert all("Azimuthal_Equidistant" in one.crs.to_wkt() for one in (mosaic, source))
        assert mosaic.overviews(1)[-1] >= side_px / 1024
        for n in (0, count // 2, count - 1):
            at = grid.cell * TILE_PX * (n + 0.5)
            row, column = mosaic.index(grid.west + at, grid.north - at)
            assert row == column == pytest.approx(TILE_PX * (n + 0.5), abs=1)
            pixel = Window(column, row, 1, 1)
            assert mosaic.read(window=pixel).ravel().tolist() == [1 + n % 200, 255, 255, 255]
            assert source.read(1, window=pixel).item() == PICTURES - n
        assert not mosaic.read(window=Window(side_px - 600, 100, 500, 500)).any()
        small = mosaic.read(out_shape=(4, count, count))  # from overviews
        np.testing.assert_array_equal(small[3] == 255, np.eye(count, dtype=bool))
        np.testing.assert_array_equal(np.diag(small[0]), 1 + np.arange(count) % 200)


def test_threads_make_the_same_bytes(tmp_path: Path):
    grid = grid_of(8 * TILE_PX)
    names = [f"{n}.png" for n in range(PICTURES)]
    files = []
    for threads in (1, 4):
        rough, source = (tmp_path / f"{name}_{threads}.tif" for name in ("rough", "source"))
        write_tiles(rough, source, grid, FRAME, strip(grid), names, threads)
        files.append((rough.read_bytes(), source.read_bytes()))
    assert files[0] == files[1]
