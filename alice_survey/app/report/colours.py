"""Appearance of rasters on a map: labels, palettes and limits, the same wherever shown."""

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

from alice_survey.core.frames import Array
from alice_survey.core.products import RASTERS, Raster
from alice_survey.kit.document import Scale
from alice_survey.kit.figure import even_limit, palette_colours, palette_steps
from reconstruct.raster import hillshade

Rgba = NDArray[np.uint8]

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


def _middle(values: Array) -> tuple[float, float]:
    low, high = np.percentile(values, [1, 99])
    return float(low), float(max(high, low + 1e-9))


def _from_zero(values: Array) -> tuple[float, float]:
    return 0.0, float(max(np.percentile(values, 98), 1e-9))


def _around_zero(values: Array) -> tuple[float, float]:
    maximum = even_limit(values)
    return -maximum, maximum


def _whole(values: Array) -> tuple[float, float]:
    return 0.0, float(max(np.ceil(np.percentile(values, 99)), 1.0))


_LIMITS: Mapping[str, Callable[[Array], tuple[float, float]]] = {
    "middle": _middle, "from zero": _from_zero, "around zero": _around_zero, "counts": _whole,
}  # fmt: skip
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
    return _LIMITS[numbers.raster.limits](np.concatenate(kept)) if count else (0.0, 1.0)


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
