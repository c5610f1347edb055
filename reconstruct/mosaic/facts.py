"""What the mosaic must know of a picture before it is painted: small copies, sharpness, dark light.

Levels are linear light from here on: water adds and lamps multiply light, not grey values. Pictures
are taken to be encoded by the sRGB curve (IEC 61966-2-1), as cameras write them.
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.artefacts import atomic_path
from alice_survey.frames import Array
from reconstruct.mosaic.light import GRID, at_places
from reconstruct.pictures.undistorted import Pictures

Float32 = NDArray[np.float32]

_SMALL_PX = 432
"""Width of the copies in which views are compared."""
DARKEST, BRIGHTEST = 0.001, 0.95
"""Linear light beyond which a broad level tells nothing."""
_DARK_PERCENT = 0.5
_DARK_STEP = 2
"""Every so manieth pixel along rows and columns is looked at for dark ones."""
_BROAD_STEP = 4
"""Pixels of a small copy to one of its broad light, which is blurred by as much."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PictureFacts:
    """Of one picture."""

    sharpness: float
    """Mean size of its finest detail over its mean level; NaN where it is black."""
    grey: bool
    """Whether its channels are equal."""
    nodes: Array
    """(rows, columns, 3) logarithm of its broad light at nodes, BGR; NaN where it tells nothing."""
    dark: Array
    """(rows, columns, 3) light of the darkest pixels around nodes, BGR; NaN where masked."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SmallCopy:
    """A picture made small."""

    levels: NDArray[np.uint8]
    """(h, w, 4) BGR by the sRGB curve, and the share of each pixel that may be used, of 255."""
    broad: Float32
    """(h', w', 3) linear light, smaller and blurred, what is masked left out."""

    @property
    def detail(self) -> Float32:
        """(h, w, 3) BGR, linear light."""
        light: Float32 = linear_table()[self.levels[..., :3]]
        return light

    @property
    def valid(self) -> Float32:
        """(h, w) share of each pixel that may be used."""
        share: Float32 = self.levels[..., 3].astype(np.float32) / np.float32(255)
        return share

    @property
    def whole(self) -> bool:
        """Whether all of it may be used."""
        return bool((self.levels[..., 3] == 255).all())


def linear_table() -> Float32:
    """(256,) linear light, 0 to 1, of the levels of the sRGB curve."""
    level = np.arange(256) / 255.0
    linear = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
    table: Float32 = linear.astype(np.float32)
    return table


def encoded(light: Float32) -> Float32:
    """Levels, 0 to 255 where light is 0 to 1, by the sRGB curve; brighter light goes on beyond."""
    light = np.maximum(light, np.float32(0.0))
    curve = np.float32(1.055) * light ** np.float32(1 / 2.4) - np.float32(0.055)
    levels: Float32 = np.float32(255.0) * np.where(
        light <= np.float32(0.0031308), np.float32(12.92) * light, curve
    )
    return levels


def measure_picture(task: tuple[Path, Path, str]) -> PictureFacts:
    """Measure a picture of a workspace and write its small copy.

    Args:
        task: workspace, the folder for small copies, and the picture's name.
    """
    workspace, folder, image = task
    pictures = _pictures(workspace)
    taken, usable = pictures.taken(image), pictures.usable(image)
    height, width = taken.shape[:2]
    table = linear_table()
    shrink = max(1, round(width / _SMALL_PX))
    size = (max(8, width // shrink), max(8, height // shrink))
    weight = np.ones((height, width), np.float32) if usable is None else usable.astype(np.float32)
    small = np.empty((size[1], size[0], 4), np.float32)
    small[..., 3] = cv2.resize(weight, size, interpolation=cv2.INTER_AREA)
    for channel in range(3):
        light = table[taken[..., channel]] * weight
        total = cv2.resize(light, size, interpolation=cv2.INTER_AREA)
        small[..., channel] = total / np.maximum(small[..., 3], 1e-3)
    levels = np.rint(np.minimum(encoded(small[..., :3]), 255)).astype(np.uint8)
    content = np.dstack([levels, np.rint(255 * small[..., 3]).astype(np.uint8)])
    path = small_path(folder, image)
    with atomic_path(path) as temporary:
        temporary.write_bytes(cv2.imencode(".png", content, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1])
    grey = taken[..., 1].astype(np.float32)
    fine = np.abs(cv2.Laplacian(grey, cv2.CV_32F, ksize=1))
    mean = float((grey * weight).sum())
    return PictureFacts(
        sharpness=float((fine * weight).sum()) / mean if mean > 0 else float("nan"),
        grey=bool(
            (taken[..., 0] == taken[..., 1]).all() and (taken[..., 2] == taken[..., 1]).all()
        ),
        nodes=_broad_nodes(_small_copy(content)),
        dark=_dark(taken, usable, table),
    )


def _broad_nodes(copy: SmallCopy) -> Array:
    x, y = np.meshgrid(np.linspace(0.01, 0.99, GRID[1]), np.linspace(0.01, 0.99, GRID[0]))
    places = np.column_stack([x.ravel(), y.ravel()]).astype(np.float32)
    level = at_places(copy.broad, places).reshape(*GRID, 3).astype(np.float64)
    valid = at_places(copy.valid[..., None], places, 1).reshape(*GRID, 1)
    usable = telling(level)[..., None] & (valid > 0.5)
    return np.where(usable, np.log(np.maximum(level, DARKEST)), np.nan)


def telling(light: NDArray[np.floating[Any]]) -> NDArray[np.bool_]:
    """Whether all channels (..., 3) are neither black nor burnt out."""
    return np.asarray(((light > DARKEST) & (light < BRIGHTEST)).all(axis=-1))


def _dark(taken: NDArray[np.uint8], usable: NDArray[np.bool_] | None, table: Float32) -> Array:
    """Darkest light in the cells around nodes."""
    part = taken[::_DARK_STEP, ::_DARK_STEP]
    mask = None if usable is None else usable[::_DARK_STEP, ::_DARK_STEP]
    height, width = part.shape[:2]
    rows, columns = GRID
    dark = np.full((rows, columns, 3), np.nan)
    y = np.clip(np.rint((np.arange(rows + 1) - 0.5) / (rows - 1) * height), 0, height).astype(int)
    x = np.clip(np.rint((np.arange(columns + 1) - 0.5) / (columns - 1) * width), 0, width)
    x = x.astype(int)
    for row in range(rows):
        for column in range(columns):
            at = slice(y[row], y[row + 1]), slice(x[column], x[column + 1])
            cell = part[at].reshape(-1, 3) if mask is None else part[at][mask[at]]
            if len(cell) >= 100:
                level = np.percentile(cell, _DARK_PERCENT, axis=0)
                dark[row, column] = np.interp(level, np.arange(256), table)
    return dark


def small_path(folder: Path, image: str) -> Path:
    """The file of a picture's small copy."""
    return folder / f"{image}.small.png"


class SmallCopies:
    """Small copies as they are asked for; the last few stay in memory."""

    def __init__(self, folder: Path, kept: int = 128) -> None:
        self._load = lru_cache(maxsize=kept)(lambda image: _read_small(folder, image))

    def load(self, image: str) -> SmallCopy:
        """The copy of a picture."""
        return self._load(image)


def _read_small(folder: Path, image: str) -> SmallCopy:
    return _small_copy(cv2.imread(str(small_path(folder, image)), cv2.IMREAD_UNCHANGED))


def _small_copy(content: NDArray[np.uint8]) -> SmallCopy:
    copy = SmallCopy(levels=content, broad=np.empty((0, 0, 3), np.float32))
    size = (max(8, content.shape[1] // _BROAD_STEP), max(8, content.shape[0] // _BROAD_STEP))
    valid = copy.valid
    parts = (copy.detail * valid[..., None], valid)
    total, weight = (
        cv2.GaussianBlur(cv2.resize(part, size, interpolation=cv2.INTER_AREA), (0, 0), 1.0)
        for part in parts
    )
    broad: Float32 = total / np.maximum(weight, np.float32(1e-3))[..., None]
    return SmallCopy(levels=content, broad=broad)


def forget_pictures() -> None:
    """Let go of the lenses that an earlier run in this process read."""
    _pictures.cache_clear()


@lru_cache(maxsize=1)
def _pictures(workspace: Path) -> Pictures:
    return Pictures.open(workspace)
