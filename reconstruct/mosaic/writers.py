"""Files of the mosaic: cloud-optimised colours, source pictures, coverage, a small picture.

Blocks of a raster in which nothing is seen are left out, so that a strip across a large box takes
the room of the strip.
"""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import rasterio
import rasterio.shutil
from numpy.typing import NDArray
from rasterio.windows import Window

from alice_survey.core.run import progress
from reconstruct.mosaic.grid import CELL_PX, coarse
from reconstruct.mosaic.paint import Labels, Painted
from reconstruct.raster import (
    BLOCK,
    DemGrid,
    crs_of,
    frame_tags,
    opened_raster,
    transform_of,
    write_png,
)
from reconstruct.views.model import WorldFrame

_THUMBNAIL_PX = 1600
_MAX_UINT16 = 65_535


def write_tiles(
    rough: Path,
    source: Path,
    grid: DemGrid,
    frame: WorldFrame,
    groups: Iterator[list[Painted]],
    names: list[str],
    threads: int,
) -> float:
    """Write colours and sources as they come; return the share of pixels that have colour."""
    shared = _profile(grid, frame, threads)
    numbers = "uint16" if len(names) <= _MAX_UINT16 else "uint32"
    painted = 0
    with (
        rasterio.open(
            rough, "w", count=4, dtype="uint8", photometric="RGB", alpha="yes", **shared
        ) as colours,
        rasterio.open(source, "w", count=1, dtype=numbers, **shared) as sources,
    ):
        colours.update_tags(**frame_tags(frame))
        sources.update_tags(**frame_tags(frame), PICTURES=json.dumps(names))
        sources.set_band_description(1, "picture that painted the pixel, from 1; 0 is none")
        for group in groups:
            for tile in group:
                seen = int(np.count_nonzero(tile.rgba[3]))
                if seen:
                    colours.write(tile.rgba, window=tile.window)
                    sources.write(tile.source.astype(numbers), 1, window=tile.window)
                    painted += seen
    return painted / (grid.rows * grid.columns)


def write_labels(
    cells_of: tuple[Path, Path],
    coverage: Path,
    grid: DemGrid,
    frame: WorldFrame,
    blocks: Iterator[Labels],
    threads: int,
) -> None:
    """Write view and tones of each cell, and a raster of how many pictures and stations see it."""
    shared = _profile(coarse(grid), frame, threads)
    with (
        rasterio.open(cells_of[0], "w", count=1, dtype="int32", **shared) as labels,
        rasterio.open(
            cells_of[1], "w", count=3, dtype="float32", **shared | {"compress": None}
        ) as tones,
        rasterio.open(coverage, "w", count=2, dtype="uint16", predictor=2, **shared) as raster,
    ):
        raster.update_tags(**frame_tags(frame))
        raster.set_band_description(1, "pictures that see the cell")
        raster.set_band_description(2, "stations that see the cell")
        for block in blocks:
            top, left = block.block.core.row_off // CELL_PX, block.block.core.col_off // CELL_PX
            high, wide = block.label.shape
            window = Window(left, top, wide, high)
            labels.write(block.label, 1, window=window)
            tones.write(block.tones, window=window)
            raster.write(np.stack([block.pictures, block.stations]), window=window)


def _profile(grid: DemGrid, frame: WorldFrame, threads: int) -> dict[str, object]:
    return {
        "driver": "GTiff",
        "width": grid.columns,
        "height": grid.rows,
        "crs": crs_of(frame),
        "transform": transform_of(grid),
        "tiled": True,
        "blockxsize": BLOCK,
        "blockysize": BLOCK,
        "compress": "deflate",
        "zlevel": 1,
        "bigtiff": "if_safer",
        "sparse_ok": True,
        "num_threads": threads,
    }


@progress.step("write the mosaic with overviews")
def cloud_optimised(rough: Path, final: Path, threads: int) -> None:
    """Copy a GeoTIFF with overviews in the layout of a COG.

    GDAL works through what is empty too, for overviews mostly.
    """
    rasterio.shutil.copy(
        rough,
        final,
        driver="COG",
        compress="DEFLATE",
        level=3,
        predictor="YES",
        overview_resampling="AVERAGE",
        blocksize=512,
        bigtiff="IF_SAFER",
        sparse_ok="YES",
        num_threads=str(threads),
    )


@progress.step("draw the mosaic")
def thumbnail(mosaic: Path, picture: Path) -> None:
    """Write a small copy, unknown pixels transparent."""
    with opened_raster(mosaic) as raster:
        shrink = max(1.0, max(raster.width, raster.height) / _THUMBNAIL_PX)
        shape = (4, max(1, int(raster.height / shrink)), max(1, int(raster.width / shrink)))
        small: NDArray[np.uint8] = raster.read(
            out_shape=shape, resampling=rasterio.enums.Resampling.average
        )
    write_png(picture, np.ascontiguousarray(small[[2, 1, 0, 3]].transpose(1, 2, 0)))
