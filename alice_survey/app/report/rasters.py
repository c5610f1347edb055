"""Rasters of a survey as pyramids of small pictures, for the map of a page.

Each is read once, shrunk to what a page can carry; what is larger is for `alice-survey view`.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import rasterio
from rasterio.transform import Affine

from alice_survey.app.report.colours import (
    TILE_PX,
    Numbers,
    Rgba,
    colour_tile,
    encode_webp,
    limits_of,
    number_rasters,
    read_shrunk,
    scale_of,
)
from alice_survey.app.report.held import Held
from alice_survey.core.products import MOSAIC
from alice_survey.kit.document import PictureLayer, Scale
from reconstruct.measure.surface import is_of_surface

_MAX_PAINTED_PX = 24_000_000
"""Pixels of the mosaic in a page: about 5 MB."""
_MAX_COLOURED_PX = 2_000_000
"""Pixels of a layer that shows numbers."""


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
    with rasterio.open(path) as raster:
        full = raster.transform.a
    bands, opacity, transform = read_shrunk(path, [1, 2, 3], max_px)
    picture = np.dstack([*np.ma.getdata(bands), np.where(opacity > 0, 255, 0)]).astype(np.uint8)
    shrunk = "" if transform.a == full else f" Shrunk {transform.a / full:.1f} times."
    return _layer(
        picture, transform, name=MOSAIC.name, title=MOSAIC.title,
        about=f"{MOSAIC.about}{shrunk}",
        shown=True,
    )  # fmt: skip


def _number_layer(path: Path, numbers: Numbers, *, shown: bool) -> PictureLayer:
    with rasterio.open(path) as opened:
        limits = limits_of(opened, numbers)
    (values,), _, transform = read_shrunk(path, [1], _MAX_COLOURED_PX)
    raster = numbers.raster
    level = numbers.levels(values.astype(np.float64).filled(np.nan))
    return _layer(
        colour_tile(level, numbers, limits, transform.a), transform,
        name=raster.name, title=raster.title, about=raster.about, shown=shown,
        scale=scale_of(numbers, limits),
    )  # fmt: skip


def _layer(
    picture: Rgba,
    transform: Affine,
    *,
    name: str,
    title: str,
    about: str,
    shown: bool,
    scale: Scale | None = None,
) -> PictureLayer:
    """Cut an RGBA picture into tiles of all levels."""
    height, width = picture.shape[:2]
    levels = 1
    while max(height, width) > TILE_PX * 2 ** (levels - 1):
        levels += 1
    tiles: dict[str, bytes] = {}
    for level in reversed(range(levels)):
        for y in range(0, picture.shape[0], TILE_PX):
            for x in range(0, picture.shape[1], TILE_PX):
                tile = picture[y : y + TILE_PX, x : x + TILE_PX]
                if tile[..., 3].any():
                    tiles[f"{level}/{x // TILE_PX}/{y // TILE_PX}"] = encode_webp(tile)
        picture = _halve(picture)
    return PictureLayer(
        name=name, title=title, about=about,
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
