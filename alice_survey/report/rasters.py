"""Rasters of a survey as pyramids of small pictures, for the map of a page.

Each is read once, shrunk to what a page can carry; what is larger is for `alice-survey view`.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.enums import Resampling

from alice_survey import progress
from alice_survey.frames import Array
from alice_survey.report.document import PictureLayer, Scale
from alice_survey.report.held import Held
from reconstruct.raster import hillshade

Rgba = NDArray[np.uint8]

_TILE_PX = 512
_MOST_PAINTED_PX = 24_000_000
"""Of the mosaic in a page: about 5 MB."""
_MOST_COLOURED_PX = 2_000_000
"""Of a layer that shows numbers."""
_COLOURS = 9
"""Of a scale in a legend."""
_QUALITY = 82


@dataclass(frozen=True, kw_only=True)
class _Numbers:
    """A raster of numbers and how to colour it."""

    file: str
    name: str
    title: str
    about: str
    palette: str
    """Of matplotlib: safe for the colour-blind."""
    limits: Callable[[Array], tuple[float, float]]
    """Of the colours, from the known values."""
    factor: float = 1.0
    """From the raster's unit to the legend's."""
    label: str = ""
    shaded: bool = False


@progress.step("draw the maps")
def picture_layers(held: Held) -> Iterator[PictureLayer]:
    """The mosaic and all rasters of numbers that a workspace holds."""
    mosaic = held.file("mosaic/mosaic.tif")
    if mosaic is not None:
        yield mosaic_layer(mosaic)
    first = mosaic is None
    for numbers in _rasters(held.unit):
        file = held.file(numbers.file)
        if file is not None:
            yield _number_layer(file, numbers, shown=first)
            first = False


def mosaic_layer(path: Path, most_px: int = _MOST_PAINTED_PX) -> PictureLayer:
    """The mosaic; what no picture saw is clear."""
    with rasterio.open(path) as raster:
        height, width = _shrunk(raster.height, raster.width, most_px)
        bands = raster.read([1, 2, 3], out_shape=(3, height, width), resampling=Resampling.average)
        clear = raster.dataset_mask(out_shape=(height, width))
        west, north = raster.transform.c, raster.transform.f
        pixel = raster.transform.a * raster.width / width
        full = raster.transform.a
    picture = np.dstack([*bands, np.where(clear > 0, 255, 0)]).astype(np.uint8)
    shrunk = "" if width == raster.width else f" Shrunk {pixel / full:.1f} times."
    return _layer(
        picture, name="mosaic", title="Mosaic", west=west, north=north, pixel=pixel,
        about=f"What the cameras saw, each spot from the picture that sees it best.{shrunk}",
        shown=True,
    )  # fmt: skip


def _rasters(unit: str) -> tuple[_Numbers, ...]:
    small, label = (1e3, "mm") if unit == "m" else (1.0, unit)
    return (
        _Numbers(
            file="dense/dem.tif", name="height", title="Height", palette="viridis",
            about="Height of the sea floor, shaded from the north-west.",
            limits=_middle, label=f"height, {unit}", shaded=True,
        ),
        _Numbers(
            file="dense/sigma.tif", name="sigma", title="Sigma of height", palette="cividis",
            about="How far off a height may be within the survey, one sigma.",
            limits=_from_zero, factor=small, label=f"sigma, {label}",
        ),
        _Numbers(
            file="evaluation/error.tif", name="error", title="Error of height", palette="PuOr",
            about="Height less the true height, after a rigid alignment of the cameras.",
            limits=_around_zero, factor=small, label=f"error, {label}",
        ),
        _Numbers(
            file="dense/slope.tif", name="slope", title="Slope", palette="magma",
            about="Steepness of the sea floor.", limits=_from_zero, label="slope, degrees",
        ),
        _Numbers(
            file="dense/stations.tif", name="stations", title="Stations", palette="cividis",
            about="Stations that see a spot: from 3 on, heights check one another.",
            limits=_whole, label="stations",
        ),
    )  # fmt: skip


def _middle(values: Array) -> tuple[float, float]:
    low, high = np.percentile(values, [1, 99])
    return float(low), float(max(high, low + 1e-9))


def _from_zero(values: Array) -> tuple[float, float]:
    return 0.0, float(max(np.percentile(values, 98), 1e-9))


def _around_zero(values: Array) -> tuple[float, float]:
    most = float(max(np.percentile(np.abs(values), 97), 1e-9))
    return -most, most


def _whole(values: Array) -> tuple[float, float]:
    return 0.0, float(max(np.ceil(np.percentile(values, 99)), 1.0))


def _number_layer(path: Path, numbers: _Numbers, *, shown: bool) -> PictureLayer:
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    with rasterio.open(path) as raster:
        height, width = _shrunk(raster.height, raster.width, _MOST_COLOURED_PX)
        values = raster.read(
            1, out_shape=(height, width), resampling=Resampling.average, masked=True
        )
        west, north = raster.transform.c, raster.transform.f
        pixel = raster.transform.a * raster.width / width
    level = numbers.factor * values.filled(np.nan).astype(np.float64)
    if not raster_is_float(path):
        level = np.where(level > 0, level, np.nan)  # counts: what nothing sees is clear
    known = np.isfinite(level)
    low, high = numbers.limits(level[known]) if known.any() else (0.0, 1.0)
    palette = colormaps[numbers.palette]
    picture = (255 * palette(np.clip((level - low) / (high - low), 0, 1))).astype(np.uint8)
    if numbers.shaded:
        shade = np.nan_to_num(hillshade(level, pixel), nan=float(np.sqrt(0.5)))
        tinted = picture[..., :3] * (0.25 + 1.05 * shade[..., None])
        picture[..., :3] = np.clip(tinted, 0, 255)
    picture[..., 3] = np.where(known, 255, 0)
    return _layer(
        picture, name=numbers.name, title=numbers.title, about=numbers.about, west=west,
        north=north, pixel=pixel, shown=shown,
        scale=Scale(
            label=numbers.label, low=low, high=high,
            colours=[to_hex(palette(i / (_COLOURS - 1))) for i in range(_COLOURS)],
        ),
    )  # fmt: skip


def raster_is_float(path: Path) -> bool:
    """Whether its numbers are measured, not counted."""
    with rasterio.open(path) as raster:
        return str(raster.dtypes[0]).startswith("float")


def _shrunk(height: int, width: int, most_px: int) -> tuple[int, int]:
    shrink = max(1.0, float(np.sqrt(height * width / most_px)))
    return max(1, round(height / shrink)), max(1, round(width / shrink))


def _layer(
    picture: Rgba,
    *,
    name: str,
    title: str,
    about: str,
    west: float,
    north: float,
    pixel: float,
    shown: bool,
    scale: Scale | None = None,
) -> PictureLayer:
    """Cut an RGBA picture into tiles of all levels."""
    height, width = picture.shape[:2]
    levels = 1
    while max(height, width) > _TILE_PX * 2 ** (levels - 1):
        levels += 1
    tiles: dict[str, bytes] = {}
    for level in reversed(range(levels)):
        for y in range(0, picture.shape[0], _TILE_PX):
            for x in range(0, picture.shape[1], _TILE_PX):
                tile = picture[y : y + _TILE_PX, x : x + _TILE_PX]
                if tile[..., 3].any():
                    tiles[f"{level}/{x // _TILE_PX}/{y // _TILE_PX}"] = _encoded(tile)
        picture = _halved(picture)
    return PictureLayer(
        name=name, title=title, about=about, west_m=west, north_m=north, pixel_m=pixel,
        width_px=width, height_px=height, tile_px=_TILE_PX, levels=levels, tiles=tiles,
        scale=scale, shown=shown,
    )  # fmt: skip


def _halved(picture: Rgba) -> Rgba:
    """Half the size, rounded up; clear pixels lend no colour to their neighbours."""
    height, width = picture.shape[:2]
    padded = np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0))).astype(np.uint32)
    blocks = padded.reshape(padded.shape[0] // 2, 2, padded.shape[1] // 2, 2, 4)
    cover = blocks[..., 3].sum(axis=(1, 3))
    colour = (blocks[..., :3] * blocks[..., 3:]).sum(axis=(1, 3))
    half = np.zeros((*cover.shape, 4), np.uint8)
    half[..., :3] = colour // np.maximum(cover, 1)[..., None]
    half[..., 3] = np.where(cover >= 510, 255, 0)
    return half


def _encoded(tile: Rgba) -> bytes:
    bgra = cv2.cvtColor(tile, cv2.COLOR_RGBA2BGRA)
    encoded: bytes = cv2.imencode(".webp", bgra, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])[1].tobytes()
    return encoded
