"""A raster at every resolution, read part by part so that its size does not matter.

Level 0 is the finest here: a pixel of level h covers 2**h by 2**h pixels of the raster, unless the
file itself holds that level. A file's own levels (those of a cloud-optimised GeoTIFF) are taken as
they are, with their own size. Other levels are means of what is known of the next finer level at
hand; those that the whole file would have to be read for, again and again, are made once from one
pass and kept.
"""

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import rasterio
from rasterio.windows import Window

from alice_survey.base.frames import Array
from alice_survey.report.colours import TILE_PX, known_values

_KEPT_PX = 2_000_000
"""Most pixels of the level that is kept in memory."""
_WINDOW_PX = 1024
"""Least side of a window that is read at once."""
_GDAL = {"GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR", "GDAL_CACHEMAX": 32 << 20}
"""GDAL options: no sidecar file of a raster is read, and the cache is small."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """A part of a level."""

    values: Array
    """(B, H, W) float32 means of the known values."""
    weight: Array
    """(H, W) share of the raster's pixels that is known, 0 to 1."""


@dataclass(frozen=True, kw_only=True)
class LevelSize:
    """Size of a level."""

    columns: int
    rows: int
    east: float
    """Width of a pixel, in the raster's unit."""
    north: float
    """Height of a pixel."""
    own: int | None
    """Which of the file's own levels it is: 0 the full one, 1 the first overview; None: made."""


Reader = Callable[[Any, Window], Part]
"""Reads a part of an opened raster at its own resolution."""


def read_numbers(raster: Any, window: Window) -> Part:
    """The first band; unknown values have zero weight."""
    values = known_values(raster, window)
    known = np.isfinite(values)
    values[~known] = 0
    return Part(values=values[None], weight=known.astype(np.float32))


def read_counts(raster: Any, window: Window) -> Part:
    """The first band, whose zeros are unknown."""
    part = read_numbers(raster, window)
    return Part(values=part.values, weight=part.weight * (part.values[0] > 0))


def read_painted(raster: Any, window: Window) -> Part:
    """The first three bands; transparent pixels have zero weight."""
    bands = raster.read([1, 2, 3], window=window).astype(np.float32)
    mask = raster.read(4, window=window) if raster.count > 3 else raster.dataset_mask(window=window)
    return Part(values=bands, weight=mask.astype(np.float32) / 255)


class StoppedError(Exception):
    """The request was abandoned."""


class Pyramid:
    """All levels of one raster; threads may share it."""

    def __init__(
        self,
        path: str,
        read: Reader,
        *,
        stop: threading.Event | None = None,
        most_kept_px: int = _KEPT_PX,
    ) -> None:
        """Open a raster.

        Args:
            path: as GDAL opens it, as long as this lives.
            read: how its parts are read.
            stop: ends the reading soon after it is set.
            most_kept_px: most pixels of the level that is kept.

        Raises:
            rasterio.errors.RasterioError: it cannot be read.
        """
        self._path, self._read = path, read
        self._stop = stop or threading.Event()
        self._lock = threading.Lock()
        self._kept: Part | None = None
        with self.opened() as raster:
            self.width, self.height = raster.width, raster.height
            self.west, self.north = raster.transform.c, raster.transform.f
            self.pixel = raster.transform.a
            factors = raster.overviews(1)
        self.levels = self._sizes(factors)
        small = [h for h, s in enumerate(self.levels) if s.columns * s.rows <= most_kept_px]
        self._keeps = small[0] if small else len(self.levels) - 1
        if any(size.own is not None for size in self.levels[self._keeps :]):
            self._keeps = len(self.levels)  # the file holds a level that is quick to read

    @contextmanager
    def opened(self, own: int = 0) -> Iterator[Any]:
        """The raster at one of its file's own levels."""
        options = {} if own == 0 else {"overview_level": own - 1}
        with (
            rasterio.Env(**_GDAL),
            rasterio.open(self._path, driver="GTiff", sharing=False, **options) as raster,
        ):
            yield raster

    def _sizes(self, factors: list[int]) -> list[LevelSize]:
        own = {1: 0} | {factor: n for n, factor in enumerate(factors, 1)}
        sizes: list[LevelSize] = []
        while not sizes or max(sizes[-1].columns, sizes[-1].rows) > TILE_PX:
            number = own.get(2 ** len(sizes))
            if number is None:
                finer = sizes[-1]
                sizes.append(
                    LevelSize(
                        columns=-(-finer.columns // 2), rows=-(-finer.rows // 2),
                        east=2 * finer.east, north=2 * finer.north, own=None,
                    )
                )  # fmt: skip
                continue
            with self.opened(number) as raster:
                sizes.append(
                    LevelSize(
                        columns=raster.width, rows=raster.height, own=number,
                        east=self.pixel * self.width / raster.width,
                        north=self.pixel * self.height / raster.height,
                    )
                )  # fmt: skip
        return sizes

    def part(self, level: int, left: int, top: int, right: int, bottom: int) -> Part:
        """Pixels of a level, from left and top up to right and bottom.

        Raises:
            rasterio.errors.RasterioError: the file is damaged.
            StoppedError: it was stopped meanwhile.
        """
        if level >= self._keeps:
            return _reduced(self._keep(), 2 ** (level - self._keeps), left, top, right, bottom)
        return self._from_file(level, left, top, right, bottom)

    def _keep(self) -> Part:
        """The finest level that is kept, made on first use."""
        with self._lock:
            if self._kept is None:
                size = self.levels[self._keeps]
                self._kept = self._from_file(self._keeps, 0, 0, size.columns, size.rows)
            return self._kept

    def _from_file(self, level: int, left: int, top: int, right: int, bottom: int) -> Part:
        """Read window by window from the next finer level that the file holds."""
        finer = next(h for h in range(level, -1, -1) if self.levels[h].own is not None)
        factor = 2 ** (level - finer)
        source = self.levels[finer]
        step = max(1, _WINDOW_PX // factor)
        values: Array | None = None
        weight: Array = np.zeros((bottom - top, right - left), np.float32)
        with self.opened(source.own or 0) as raster:
            for y in range(top, bottom, step):
                for x in range(left, right, step):
                    if self._stop.is_set():
                        raise StoppedError
                    x_end, y_end = min(x + step, right), min(y + step, bottom)
                    window = Window.from_slices(
                        (y * factor, min(y_end * factor, source.rows)),
                        (x * factor, min(x_end * factor, source.columns)),
                    )
                    read = self._read(raster, window)
                    if values is None:
                        values = np.zeros((len(read.values), *weight.shape), np.float32)
                    if not read.weight.any():
                        continue
                    part = _reduced(read, factor, 0, 0, x_end - x, y_end - y)
                    place = (slice(y - top, y_end - top), slice(x - left, x_end - left))
                    values[:, *place], weight[place] = part.values, part.weight
        if values is None:
            raise ValueError(f"an empty part, {left} to {right} and {top} to {bottom}")
        return Part(values=values, weight=weight)


def _reduced(part: Part, factor: int, left: int, top: int, right: int, bottom: int) -> Part:
    """Means over squares of `factor` pixels a side; unknown beyond the border.

    Args:
        part: finer.
        factor: pixels a side.
        left: first column of the wanted part, in coarser pixels, like the other three.
        top: first row.
        right: after the last column.
        bottom: after the last row.
    """
    rows, columns = slice(top * factor, bottom * factor), slice(left * factor, right * factor)
    values, weight = part.values[:, rows, columns], part.weight[rows, columns]
    if factor == 1:
        return Part(values=values, weight=weight)
    wide, high = right - left, bottom - top
    below, beside = high * factor - weight.shape[0], wide * factor - weight.shape[1]
    padding = ((0, below), (0, beside))
    cover = _means(np.pad(weight, padding), wide, high)
    means = [_means(np.pad(band * weight, padding), wide, high) for band in values]
    known = np.where(cover > 0, cover, 1)
    return Part(values=np.stack([band / known for band in means]), weight=cover)


def _means(values: Array, wide: int, high: int) -> Array:
    """Exact where the size is a whole multiple, which it is."""
    means: Array = cv2.resize(
        np.ascontiguousarray(values, np.float32), (wide, high), interpolation=cv2.INTER_AREA
    )
    return means


def tiles_of_level(size: LevelSize) -> tuple[int, int]:
    """Columns and rows of tiles."""
    return math.ceil(size.columns / TILE_PX), math.ceil(size.rows / TILE_PX)
