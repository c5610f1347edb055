"""A raster at every resolution, read part by part so that its size does not matter.

Level 0 is the finest here: each further one has half the columns and rows, rounded up, or those of
the overview in the file, as of a cloud-optimised GeoTIFF. Where there is none, GDAL averages what
is known below a pixel.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from rasterio.enums import Resampling
from rasterio.windows import Window

from alice_survey.base.frames import Array
from alice_survey.report.colours import TILE_PX, Numbers, Rgba, coloured, limits_of

_GDAL = {"GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR", "GDAL_CACHEMAX": 32 << 20}
"""GDAL options: no sidecar file of a raster is read, and the cache is small."""
_OPAQUE = 128
"""Mean opacity, of 255, from which a pixel is shown."""


@dataclass(frozen=True, kw_only=True)
class Level:
    """Size of a level, which covers the whole raster."""

    columns: int
    rows: int
    east: float
    """Width of a pixel, in the raster's unit."""
    north: float
    """Height of a pixel."""

    @property
    def tiles(self) -> tuple[int, int]:
        """Columns and rows of tiles."""
        return math.ceil(self.columns / TILE_PX), math.ceil(self.rows / TILE_PX)


class Pyramid:
    """All levels of one raster in its colours."""

    def __init__(self, path: Path, numbers: Numbers | None) -> None:
        """Open a raster.

        Args:
            path: path of the file.
            numbers: its colouring; None for a mosaic, which has its own colours.

        Raises:
            rasterio.errors.RasterioError: it cannot be read.
        """
        self._path, self.numbers = path, numbers
        with self._opened() as raster:
            self.west, self.north = raster.transform.c, raster.transform.f
            self.pixel = raster.transform.a
            self.limits = None if numbers is None else limits_of(raster, numbers)
            sizes, factors = [(raster.width, raster.height)], raster.overviews(1)
        while max(sizes[-1]) > TILE_PX:
            if 2 ** len(sizes) in factors:
                with self._opened(overview_level=factors.index(2 ** len(sizes))) as raster:
                    sizes.append((raster.width, raster.height))
            else:
                sizes.append((-(-sizes[-1][0] // 2), -(-sizes[-1][1] // 2)))
        wide, high = (side * self.pixel for side in sizes[0])
        self.levels = [
            Level(columns=columns, rows=rows, east=wide / columns, north=high / rows)
            for columns, rows in sizes
        ]

    @contextmanager
    def _opened(self, **options: int) -> Iterator[Any]:
        with (
            rasterio.Env(**_GDAL),
            rasterio.open(self._path, driver="GTiff", sharing=False, **options) as raster,
        ):
            yield raster

    def tile(self, level: int, x: int, y: int) -> Rgba:
        """Pixels of a tile of a level.

        Raises:
            FileNotFoundError: there is no such tile.
            rasterio.errors.RasterioError: the file is damaged.
        """
        if not 0 <= level < len(self.levels):
            raise FileNotFoundError(f"level {level}")
        size = self.levels[level]
        columns, rows = size.tiles
        if not (0 <= x < columns and 0 <= y < rows):
            raise FileNotFoundError(f"tile {x}, {y}")
        left, top = x * TILE_PX, y * TILE_PX
        right, bottom = min(left + TILE_PX, size.columns), min(top + TILE_PX, size.rows)
        if self.numbers is None or self.limits is None:
            return self._painted(size, left, top, right, bottom)
        # One pixel more on each side, so that the shade has no seams.
        west, north = min(left, 1), min(top, 1)
        east, south = min(size.columns - right, 1), min(size.rows - bottom, 1)
        values = self.values(size, left - west, top - north, right + east, bottom + south)
        whole = coloured(self.numbers.levels(values), self.numbers, self.limits, size.east)
        return whole[north : whole.shape[0] - south, west : whole.shape[1] - east]

    def values(self, size: Level, left: int, top: int, right: int, bottom: int) -> Array:
        """Means of known numbers of a part of a level; NaN where none is known."""
        window, shape = _window(self.levels[0], size, left, top, right, bottom)
        with self._opened() as raster:
            read = raster.read(
                1, window=window, out_shape=shape, out_dtype="float32", masked=True,
                resampling=Resampling.average,
            )  # fmt: skip
        values: Array = read.filled(np.nan)
        return values

    def _painted(self, size: Level, left: int, top: int, right: int, bottom: int) -> Rgba:
        window, shape = _window(self.levels[0], size, left, top, right, bottom)
        options = {"window": window, "resampling": Resampling.average}
        with self._opened() as raster:
            bands = raster.read([1, 2, 3], out_shape=(3, *shape), **options)
            opacity = raster.dataset_mask(out_shape=shape, **options)
        picture: Rgba = np.dstack([*bands, np.where(opacity < _OPAQUE, 0, 255)]).astype(np.uint8)
        return picture


def _window(
    full: Level, size: Level, left: int, top: int, right: int, bottom: int
) -> tuple[Window, tuple[int, int]]:
    """Part of the full raster, and the shape it is read in."""
    wide, high = full.columns / size.columns, full.rows / size.rows
    window = Window(left * wide, top * high, (right - left) * wide, (bottom - top) * high)
    return window, (bottom - top, right - left)
