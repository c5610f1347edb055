"""Rasters of a survey on a map: their colours, the same wherever shown, and pyramids for a page.

In a page each is read once, shrunk to what the page can carry.
"""

from collections.abc import Callable, Iterator, Mapping
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
from alice_survey.kit.figure import even_limit, palette_colours, palette_steps
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
_COLOURS = 9
"""Colours of a scale in a legend."""
_QUALITY = 82


@dataclass(frozen=True, kw_only=True)
class Numbers:
    """A raster of numbers in the unit that people read."""

    raster: Raster
    factor: float
    """Factor from the raster's unit to the legend's."""
    unit: str
    """Of the legend; none of counts."""

    def levels(self, values: Array) -> Array:
        """Values of the raster in the legend's unit; NaN where nothing is known."""
        level = self.factor * values.astype(np.float64)
        return np.where(level > 0, level, np.nan) if self.raster.limits == "counts" else level


def number_rasters(unit: str) -> tuple[Numbers, ...]:
    """The rasters of numbers that are layers of a map.

    Args:
        unit: unit of a workspace's lengths.
    """
    layers = [(one, *one.shown_unit(unit)) for one in RASTERS if one.palette]
    return tuple(Numbers(raster=one, factor=factor, unit=unit) for one, factor, unit in layers)


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


def limits_of(raster: Any, numbers: Numbers) -> tuple[float, float]:
    """Limits of a raster's colours, in the legend's unit; 0 to 1 where no value is known.

    A large raster is sampled in blocks all over it, in an order without a pattern, until there
    are enough values: memory does not grow with the raster.
    """
    kept, count = list[Array](), 0
    for values in _sample(raster):
        level = numbers.levels(values)
        kept.append(level[np.isfinite(level)])
        count += len(kept[-1])
        if count >= _SAMPLED:
            break
    low, high = _LIMITS[numbers.raster.limits](np.concatenate(kept)) if count else (0.0, 1.0)
    return float(low), float(high)


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
) -> tuple[Array, Array, Affine]:
    """A raster, shrunk to about so many pixels at most.

    Args:
        path: its file.
        bands: their numbers.
        max_px: most pixels of one band.
        resampling: how pixels are merged.

    Returns:
        (B, H, W) masked values, (H, W) opacity from 0 to 255, and the transform of a pixel.
    """
    with rasterio.open(path) as raster:
        shrink = max(1.0, float(np.sqrt(raster.height * raster.width / max_px)))
        shape = max(1, round(raster.height / shrink)), max(1, round(raster.width / shrink))
        values: Array = raster.read(
            bands, out_shape=(len(bands), *shape), resampling=resampling, masked=True
        )
        opacity: Array = raster.dataset_mask(out_shape=shape)
        full = raster.transform
        # Exactly its own transform where nothing is shrunk.
        wide, high = raster.width / shape[1], raster.height / shape[0]
        return values, opacity, Affine(full.a * wide, 0.0, full.c, 0.0, full.e * high, full.f)


def colour_tile(level: Array, numbers: Numbers, limits: tuple[float, float], pixel: float) -> Rgba:
    """Numbers as colours; unknown values are transparent.

    Args:
        level: (H, W) in the legend's unit, NaN where unknown.
        numbers: how to colour them.
        limits: as `limits_of` gives them.
        pixel: side of a pixel in the unit of lengths, for the shade.
    """
    low, high = limits
    known = np.isfinite(level)
    shares = np.clip((level - low) / (high - low), 0, 1)
    picture: Rgba = palette_colours(numbers.raster.palette, shares)
    if numbers.raster.shaded:
        flat = np.sqrt(0.5)
        shade = hillshade(level, pixel) if min(level.shape) > 1 else np.full(level.shape, flat)
        tinted = picture[..., :3] * (0.25 + 1.05 * np.nan_to_num(shade, nan=flat)[..., None])
        picture[..., :3] = np.clip(tinted, 0, 255)
    picture[..., 3] = np.where(known, 255, 0)
    return picture


def scale_of(numbers: Numbers, limits: tuple[float, float]) -> Scale:
    """The legend."""
    title = numbers.raster.title.lower()
    return Scale(
        label=f"{title}, {numbers.unit}" if numbers.unit else title,
        low=limits[0],
        high=limits[1],
        colours=palette_steps(numbers.raster.palette, _COLOURS),
    )


def encode_webp(tile: Rgba) -> bytes:
    """A tile as WebP."""
    bgra = cv2.cvtColor(tile, cv2.COLOR_RGBA2BGRA)
    data: bytes = cv2.imencode(".webp", bgra, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])[1].tobytes()
    return data


def picture_layers(held: Held) -> Iterator[PictureLayer]:
    """The mosaic and all rasters of numbers that a workspace holds."""
    mosaic = held.file(MOSAIC.file)
    if mosaic is not None:
        yield mosaic_layer(mosaic)
    first = mosaic is None
    for numbers in number_rasters(held.unit):
        file = held.file(numbers.raster.file)
        if file is not None and is_of_surface(held.workspace, numbers.raster):
            yield _number_layer(file, numbers, shown=first)
            first = False


def mosaic_layer(path: Path, max_px: int = _MAX_PAINTED_PX) -> PictureLayer:
    """The mosaic; what no picture saw is transparent."""
    bands, opacity, transform = read_shrunk(path, [1, 2, 3], max_px)
    picture = np.dstack([*np.ma.getdata(bands), np.where(opacity > 0, 255, 0)]).astype(np.uint8)
    return _layer(picture, transform, MOSAIC, shown=True)


def _number_layer(path: Path, numbers: Numbers, *, shown: bool) -> PictureLayer:
    with rasterio.open(path) as opened:
        limits = limits_of(opened, numbers)
    (values,), _, transform = read_shrunk(path, [1], _MAX_COLOURED_PX)
    level = numbers.levels(values.astype(np.float64).filled(np.nan))
    picture = colour_tile(level, numbers, limits, transform.a)
    scale = scale_of(numbers, limits)
    return _layer(picture, transform, numbers.raster, shown=shown, scale=scale)


def _layer(
    picture: Rgba, transform: Affine, raster: Raster, *, shown: bool, scale: Scale | None = None
) -> PictureLayer:
    """Cut an RGBA picture into tiles of all levels."""
    height, width = picture.shape[:2]
    levels = 1 + (-(-max(height, width) // TILE_PX) - 1).bit_length()
    tiles: dict[str, bytes] = {}
    for level in reversed(range(levels)):
        for y in range(0, picture.shape[0], TILE_PX):
            for x in range(0, picture.shape[1], TILE_PX):
                tile = picture[y : y + TILE_PX, x : x + TILE_PX]
                if tile[..., 3].any():
                    tiles[f"{level}/{x // TILE_PX}/{y // TILE_PX}"] = encode_webp(tile)
        picture = _halve(picture)
    return PictureLayer(
        name=raster.name, title=raster.title, about=raster.about,
        west_m=transform.c, north_m=transform.f, pixel_m=transform.a,
        width_px=width, height_px=height, tile_px=TILE_PX, levels=levels, tiles=tiles,
        scale=scale, shown=shown,
    )  # fmt: skip


def _halve(picture: Rgba) -> Rgba:
    """Half the size, rounded up; transparent pixels add no colour to their neighbours."""
    height, width = picture.shape[:2]
    padded = np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0))).astype(np.uint32)
    blocks = padded.reshape(padded.shape[0] // 2, 2, padded.shape[1] // 2, 2, 4)
    cover = blocks[..., 3].sum(axis=(1, 3))
    colour = (blocks[..., :3] * blocks[..., 3:]).sum(axis=(1, 3))
    half = np.zeros((*cover.shape, 4), np.uint8)
    half[..., :3] = colour // np.maximum(cover, 1)[..., None]
    half[..., 3] = np.where(cover >= 510, 255, 0)
    return half
