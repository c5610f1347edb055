"""Rasters of a survey on a map: their colours and pyramids, the same in the report and the studio.

Level 0 of a pyramid is the finest: each further one has half the columns and rows, rounded up, or
those of the overview in the file, as of a cloud-optimised GeoTIFF. Where there is none, GDAL
averages what is known below a pixel. A report holds all tiles, of a finest level that is shrunk to
what a page can carry.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.enums import Resampling
from rasterio.transform import Affine
from rasterio.windows import Window

from alice_survey.app.report.held import Held
from alice_survey.core.frames import Array
from alice_survey.core.products import MOSAIC, RASTERS, Raster
from alice_survey.kit.document import PictureLayer, Scale
from alice_survey.kit.map import even_limit
from reconstruct.measure.surface import is_of_surface
from reconstruct.raster import hillshade

Rgba = NDArray[np.uint8]

_MAX_PAINTED_PX = 24_000_000
"""Pixels of the mosaic in a page: about 5 MB."""
_MAX_COLOURED_PX = 2_000_000
"""Pixels of a layer that shows numbers."""
TILE_PX = 512
_SAMPLED = 2_000_000
"""Number of values of a raster that its limits are taken from; all of a smaller one."""
_THINNED = 4
"""Step between the rows and columns of a block that a larger raster's limits are taken from."""
_WINDOW_PX = 256
MAP_RASTERS = (MOSAIC, *(one for one in RASTERS if one.palette))
"""In the order in which a page shows them."""
_GDAL = {"GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR", "GDAL_CACHEMAX": 32 << 20}
"""GDAL options: no sidecar file of a raster is read, and the cache is small."""
_OPAQUE = 128
"""Mean opacity, of 255, from which a pixel is shown."""
_COLOURS = 9
"""Colours of a scale in a legend."""
_QUALITY = 82


_LIMITS: Mapping[str, Callable[[Array], tuple[float, float]]] = {
    "middle": lambda v: (
        np.percentile(v, 1),
        max(np.percentile(v, 99), np.percentile(v, 1) + 1e-9),
    ),
    "from zero": lambda v: (0.0, max(np.percentile(v, 98), 1e-9)),
    "around zero": lambda v: (-even_limit(v), even_limit(v)),
    "counts": lambda v: (0.0, max(np.ceil(np.percentile(v, 99)), 1.0)),
}
"""Limits of colours from the known values, as `Raster.limits` names them."""


def _sample(raster: Any) -> Iterator[Array]:
    step = 1 if raster.width * raster.height <= _SAMPLED else _THINNED
    columns = -(-raster.width // _WINDOW_PX)
    blocks = columns * -(-raster.height // _WINDOW_PX)
    for block in np.random.default_rng(0).permutation(blocks):
        row, column = divmod(int(block), columns)
        left, top = column * _WINDOW_PX, row * _WINDOW_PX
        wide, high = min(_WINDOW_PX, raster.width - left), min(_WINDOW_PX, raster.height - top)
        yield known_values(raster, Window(left, top, wide, high))[::step, ::step]


def known_values(raster: Any, window: Window) -> Array:
    """Values of the first band, float32; NaN where the raster marks them as unknown."""
    values: Array = raster.read(1, window=window).astype(np.float32, copy=False)
    if raster.nodata is not None and np.isfinite(raster.nodata):
        values[values == np.float32(raster.nodata)] = np.nan
    return values


def read_shrunk(
    path: Path, bands: list[int], max_px: float, resampling: Resampling = Resampling.average
) -> tuple[Array, Affine]:
    """A raster, shrunk to about so many pixels at most.

    Args:
        path: its file.
        bands: their numbers.
        max_px: most pixels of one band.
        resampling: how pixels are merged.

    Returns:
        (B, H, W) masked values, and the transform of a pixel.
    """
    with rasterio.open(path) as raster:
        shrink = max(1.0, float(np.sqrt(raster.height * raster.width / max_px)))
        shape = _shrink(raster.height, shrink), _shrink(raster.width, shrink)
        values: Array = raster.read(
            bands, out_shape=(len(bands), *shape), resampling=resampling, masked=True
        )
        full = raster.transform
        # Exactly its own transform where nothing is shrunk.
        wide, high = raster.width / shape[1], raster.height / shape[0]
        return values, Affine(full.a * wide, 0.0, full.c, 0.0, full.e * high, full.f)


def encode_webp(tile: Rgba) -> bytes:
    """A tile as WebP."""
    bgra = cv2.cvtColor(tile, cv2.COLOR_RGBA2BGRA)
    data: bytes = cv2.imencode(".webp", bgra, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])[1].tobytes()
    return data


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

    def __init__(self, path: Path, raster: Raster, unit: str, max_px: float = math.inf) -> None:
        """Open a raster.

        Args:
            path: path of the file.
            raster: what it is.
            unit: unit of a workspace's lengths.
            max_px: about the most pixels of the finest level.

        Raises:
            rasterio.errors.RasterioError: it cannot be read.
        """
        self._path, self.raster = path, raster
        self._factor, self._unit = raster.shown_unit(unit)
        with self._open() as file:
            self.west, self.north = file.transform.c, file.transform.f
            self._full = file.width, file.height
            wide, high = (side * file.transform.a for side in self._full)
            self.limits = self._limits_of(file) if raster.palette else None
            shrink = max(1.0, math.sqrt(file.width * file.height / max_px))
            sizes = [(_shrink(file.width, shrink), _shrink(file.height, shrink))]
            factors = file.overviews(1) if sizes == [self._full] else []
        while max(sizes[-1]) > TILE_PX:
            if 2 ** len(sizes) in factors:
                with self._open(overview_level=factors.index(2 ** len(sizes))) as file:
                    sizes.append((file.width, file.height))
            else:
                sizes.append((-(-sizes[-1][0] // 2), -(-sizes[-1][1] // 2)))
        self.levels = [
            Level(columns=columns, rows=rows, east=wide / columns, north=high / rows)
            for columns, rows in sizes
        ]

    @contextmanager
    def _open(self, **options: int) -> Iterator[Any]:
        with (
            rasterio.Env(**_GDAL),
            rasterio.open(self._path, driver="GTiff", sharing=False, **options) as file,
        ):
            yield file

    def _levels(self, values: Array) -> Array:
        """Values in the legend's unit; NaN where nothing is known."""
        level = self._factor * values.astype(np.float64)
        return np.where(level > 0, level, np.nan) if self.raster.limits == "counts" else level

    def _limits_of(self, file: Any) -> tuple[float, float]:
        """Limits of the colours, in the legend's unit; 0 to 1 where no value is known.

        A large raster is sampled in blocks all over it, in an order without a pattern, until there
        are enough values: memory does not grow with the raster.
        """
        kept, count = list[Array](), 0
        for values in _sample(file):
            level = self._levels(values)
            kept.append(level[np.isfinite(level)])
            count += len(kept[-1])
            if count >= _SAMPLED:
                break
        low, high = _LIMITS[self.raster.limits](np.concatenate(kept)) if count else (0.0, 1.0)
        return float(low), float(high)

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
        if self.limits is None:
            return self._paint(size, left, top, right, bottom)
        # One pixel more on each side, so that the shade has no seams.
        west, north = min(left, 1), min(top, 1)
        east, south = min(size.columns - right, 1), min(size.rows - bottom, 1)
        values = self.values(size, left - west, top - north, right + east, bottom + south)
        whole = self.colour(values, size.east)
        return whole[north : whole.shape[0] - south, west : whole.shape[1] - east]

    def colour(self, values: Array, pixel: float) -> Rgba:
        """Values of a raster of numbers as colours; unknown ones are transparent.

        Args:
            values: (H, W), NaN where unknown.
            pixel: side of a pixel in the unit of lengths, for the shade.
        """
        from alice_survey.kit.figure import palette_colours

        level, (low, high) = self._levels(values), self.limits or (0.0, 1.0)
        shares = np.clip((level - low) / (high - low), 0, 1)
        picture: Rgba = palette_colours(self.raster.palette, shares)
        if self.raster.shaded:
            flat = np.sqrt(0.5)
            shade = hillshade(level, pixel) if min(level.shape) > 1 else np.full(level.shape, flat)
            tinted = picture[..., :3] * (0.25 + 1.05 * np.nan_to_num(shade, nan=flat)[..., None])
            picture[..., :3] = np.clip(tinted, 0, 255)
        picture[..., 3] = np.where(np.isfinite(level), 255, 0)
        return picture

    @property
    def scale(self) -> Scale | None:
        """The legend; None of the mosaic, which has its own colours."""
        if self.limits is None:
            return None
        from alice_survey.kit.figure import palette_steps

        title, (low, high) = self.raster.title.lower(), self.limits
        label = f"{title}, {self._unit}" if self._unit else title
        colours = palette_steps(self.raster.palette, _COLOURS)
        return Scale(label=label, low=low, high=high, colours=colours)

    def values(self, size: Level, left: int, top: int, right: int, bottom: int) -> Array:
        """Means of known numbers of a part of a level; NaN where none is known."""
        window, shape = self._window(size, left, top, right, bottom)
        with self._open() as file:
            read = file.read(
                1, window=window, out_shape=shape, out_dtype="float32", masked=True,
                resampling=Resampling.average,
            )  # fmt: skip
        return np.asarray(read.filled(np.nan))

    def _paint(self, size: Level, left: int, top: int, right: int, bottom: int) -> Rgba:
        window, shape = self._window(size, left, top, right, bottom)
        options = {"window": window, "resampling": Resampling.average}
        with self._open() as file:
            bands = file.read([1, 2, 3], out_shape=(3, *shape), **options)
            opacity = file.dataset_mask(out_shape=shape, **options)
        return np.dstack([*bands, np.where(opacity < _OPAQUE, 0, 255)]).astype(np.uint8)

    def _window(
        self, size: Level, left: int, top: int, right: int, bottom: int
    ) -> tuple[Window, tuple[int, int]]:
        """Part of the full raster, and the shape it is read in."""
        wide, high = self._full[0] / size.columns, self._full[1] / size.rows
        window = Window(left * wide, top * high, (right - left) * wide, (bottom - top) * high)
        return window, (bottom - top, right - left)

    def layer(self, *, shown: bool, **tiles: Any) -> PictureLayer:
        """The layer of a map.

        Args:
            shown: whether it is shown at first.
            tiles: its `tiles`, or the `address` that they are requested from.
        """
        full, raster = self.levels[0], self.raster
        return PictureLayer(
            name=raster.name, title=raster.title, about=raster.about,
            west_m=self.west, north_m=self.north, pixel_m=full.east,
            width_px=full.columns, height_px=full.rows, tile_px=TILE_PX,
            levels=len(self.levels), shown=shown, scale=self.scale,
            sizes=[(s.columns, s.rows, s.east, s.north) for s in self.levels],
            **{"tiles": {}, **tiles},
        )  # fmt: skip

    def all_tiles(self) -> dict[str, bytes]:
        """Tiles that show anything, as WebP by "k/x/y"; k = 0 is the coarsest."""
        found: dict[str, bytes] = {}
        for level, size in enumerate(reversed(self.levels)):
            for x, y in np.ndindex(size.tiles):
                tile = self.tile(len(self.levels) - 1 - level, x, y)
                if tile[..., 3].any():
                    found[f"{level}/{x}/{y}"] = encode_webp(tile)
        return found


def _shrink(side: int, factor: float) -> int:
    return max(1, round(side / factor))


def picture_layers(held: Held) -> Iterator[PictureLayer]:
    """The mosaic and all rasters of numbers that a workspace holds."""
    shown = True
    for raster in MAP_RASTERS:
        file = held.file(raster.file)
        if file is not None and is_of_surface(held.workspace, raster):
            yield page_layer(file, raster, held.unit, shown=shown)
            shown = False


def page_layer(
    path: Path, raster: Raster, unit: str, *, shown: bool, max_px: float | None = None
) -> PictureLayer:
    """A raster with all its tiles.

    Args:
        path: its file.
        raster: what it is.
        unit: unit of a workspace's lengths.
        shown: whether it is shown at first.
        max_px: about the most pixels; what a page can carry if not given.
    """
    carried_px = _MAX_COLOURED_PX if raster.palette else _MAX_PAINTED_PX
    pyramid = Pyramid(path, raster, unit, max_px or carried_px)
    return pyramid.layer(shown=shown, tiles=pyramid.all_tiles())
