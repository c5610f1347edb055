"""The rasters of a workspace as layers of a map, at every resolution: their legends, their tiles.

Level 0 of a pyramid is the finest: each further one has half the columns and rows, rounded up, or
those of the overview in the file, as of a cloud-optimised GeoTIFF. Where there is none, GDAL
averages what is known below a pixel.
"""

import math
import os
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from rasterio.enums import Resampling
from rasterio.errors import RasterioError
from rasterio.windows import Window

from alice_survey.app.report.held import Held
from alice_survey.app.report.rasters import (
    TILE_PX,
    Numbers,
    Rgba,
    colour_tile,
    encode_webp,
    limits_of,
    number_rasters,
    scale_of,
)
from alice_survey.app.studio.files import Workspace, stale_page, token_of
from alice_survey.core.contents import one_line
from alice_survey.core.errors import WorkspaceError
from alice_survey.core.frames import Array
from alice_survey.core.products import MOSAIC, RASTERS
from alice_survey.kit.document import PictureLayer
from reconstruct.measure.surface import is_of_surface

_KEPT_TILES = 1000
_KEPT_PYRAMIDS = 12
_MAX_RENDERERS = 4
_ENDING_S = 3.0
"""Time to wait at the end for tiles in work."""
_DAMAGES = (RasterioError, IndexError, MemoryError)
"""Errors on reading a damaged raster, or one with too few bands."""
_LAYERS = {one.name: one for one in (MOSAIC, *(one for one in RASTERS if one.palette))}
"""In the order in which a page shows them."""
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
        with self._open() as raster:
            self.west, self.north = raster.transform.c, raster.transform.f
            self.pixel = raster.transform.a
            self.limits = None if numbers is None else limits_of(raster, numbers)
            sizes = [(raster.width, raster.height)]
            factors = raster.overviews(1)
        while max(sizes[-1]) > TILE_PX:
            if 2 ** len(sizes) in factors:
                with self._open(overview_level=factors.index(2 ** len(sizes))) as raster:
                    sizes.append((raster.width, raster.height))
            else:
                sizes.append((-(-sizes[-1][0] // 2), -(-sizes[-1][1] // 2)))
        wide, high = (side * self.pixel for side in sizes[0])
        self.levels = [
            Level(columns=columns, rows=rows, east=wide / columns, north=high / rows)
            for columns, rows in sizes
        ]

    @contextmanager
    def _open(self, **options: int) -> Iterator[Any]:
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
            return self._paint(size, left, top, right, bottom)
        # One pixel more on each side, so that the shade has no seams.
        west, north = min(left, 1), min(top, 1)
        east, south = min(size.columns - right, 1), min(size.rows - bottom, 1)
        values = self.values(size, left - west, top - north, right + east, bottom + south)
        whole = colour_tile(self.numbers.levels(values), self.numbers, self.limits, size.east)
        return whole[north : whole.shape[0] - south, west : whole.shape[1] - east]

    def values(self, size: Level, left: int, top: int, right: int, bottom: int) -> Array:
        """Means of known numbers of a part of a level; NaN where none is known."""
        window, shape = _window(self.levels[0], size, left, top, right, bottom)
        with self._open() as raster:
            read = raster.read(
                1, window=window, out_shape=shape, out_dtype="float32", masked=True,
                resampling=Resampling.average,
            )  # fmt: skip
        values: Array = read.filled(np.nan)
        return values

    def _paint(self, size: Level, left: int, top: int, right: int, bottom: int) -> Rgba:
        window, shape = _window(self.levels[0], size, left, top, right, bottom)
        options = {"window": window, "resampling": Resampling.average}
        with self._open() as raster:
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


class Layers:
    """Layers of a map of a workspace; threads may share it."""

    def __init__(self, workspace: Workspace) -> None:
        """Take a workspace, whose rasters are shown."""
        self._workspace = workspace
        self._max_renderers = min(_MAX_RENDERERS, os.cpu_count() or 1)
        self._renderers = threading.BoundedSemaphore(self._max_renderers)
        # By the token of the file, so that a changed raster is read again.
        self._pyramid = lru_cache(_KEPT_PYRAMIDS)(self._read_pyramid)
        self._tile = lru_cache(_KEPT_TILES)(self._read_tile)

    def picture_layers(self) -> Sequence[PictureLayer]:
        """The layers that are there, for a page that requests their tiles."""
        found: list[PictureLayer] = []
        for name, raster in _LAYERS.items():
            try:
                layer = self._picture_layer(name, shown=not found)
                if is_of_surface(self._workspace.folder, raster):
                    found.append(layer)
            except FileNotFoundError:
                continue
        return found

    def _path(self, name: str) -> Path:
        """File of a layer.

        Raises:
            FileNotFoundError: there is none.
        """
        if name not in _LAYERS:
            raise FileNotFoundError(name)
        return self._workspace.file(_LAYERS[name].path.parts)

    def _picture_layer(self, name: str, *, shown: bool) -> PictureLayer:
        with self._check_unchanged(name, None) as token:
            pyramid = self._pyramid(name, token)
        numbers, limits, full = pyramid.numbers, pyramid.limits, pyramid.levels[0]
        return PictureLayer(
            name=name,
            title=_LAYERS[name].title,
            about=_LAYERS[name].about,
            base=True,
            west_m=pyramid.west, north_m=pyramid.north, pixel_m=pyramid.pixel,
            width_px=full.columns, height_px=full.rows, tile_px=TILE_PX,
            levels=len(pyramid.levels), tiles={}, shown=shown,
            scale=None if numbers is None or limits is None else scale_of(numbers, limits),
            sizes=[(s.columns, s.rows, s.east, s.north) for s in pyramid.levels],
            address=f"/tiles/{name}/{{}}.webp?v={token}",
        )  # fmt: skip

    def tile(self, name: str, level: int, x: int, y: int, token: str | None) -> tuple[bytes, str]:
        """A tile as WebP, and the token of the raster that it is of.

        Args:
            name: name of the layer.
            level: 0 is the coarsest, as on the report's page.
            x: column of the tile.
            y: row of the tile.
            token: token of the raster that the page has; None for the current one.

        Raises:
            FileNotFoundError: there is no such layer or no such tile.
            StaleError: there is another raster by now, or it is being written to.
            WorkspaceError: it is damaged.
        """
        with self._check_unchanged(name, token) as now:
            return self._tile(name, now, level, x, y), now

    def close(self) -> None:
        """Wait briefly for the tiles in work."""
        for _ in range(self._max_renderers):
            self._renderers.acquire(timeout=_ENDING_S / self._max_renderers)

    @contextmanager
    def _check_unchanged(self, name: str, token: str | None) -> Iterator[str]:
        """The token of a layer's file, which is read within this block."""
        now = token_of(self._path(name).stat())
        if token not in (None, now):
            raise stale_page()
        try:
            yield now
        except _DAMAGES as error:
            path = self._path(name)
            if token_of(path.stat()) != now:
                raise stale_page() from None
            raise WorkspaceError(
                f"{path}: is damaged ({one_line(error)}): delete it and run again"
            ) from error
        if token_of(self._path(name).stat()) != now:
            raise stale_page()

    def _read_pyramid(self, name: str, token: str) -> Pyramid:
        unit = Held.of(self._workspace.folder).unit
        numbers = next((one for one in number_rasters(unit) if one.raster.name == name), None)
        return Pyramid(self._path(name), numbers)

    def _read_tile(self, name: str, token: str, level: int, x: int, y: int) -> bytes:
        with self._renderers:
            pyramid = self._pyramid(name, token)
            return encode_webp(pyramid.tile(len(pyramid.levels) - 1 - level, x, y))
