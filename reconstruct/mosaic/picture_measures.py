"""What the mosaic must know of a picture before it is painted: small copies, sharpness, dark light.

Levels are linear light from here on: water adds and lamps multiply light, not grey values. Pictures
are taken to be encoded by the sRGB curve (IEC 61966-2-1), as cameras write them.

`colour_reference.csv` names patches of known reflectance in pictures. A row is a circle on a grey
card or on a patch of a chart: `image`, `x`, `y` of its middle (pixels of the picture as taken, from
0 at the middle of the first pixel, as viewers show them), `radius_px`, and its reflectance in
linear light, 0 to 1, `red`, `green`, `blue`. A patch may have rows in several pictures.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.artefacts import atomic_path, read_csv
from alice_survey.core.errors import WorkspaceError
from alice_survey.core.frames import Array
from reconstruct.light.solve import GRID, at_nodes, blur_valid
from reconstruct.mosaic.exports import PictureFootprint, picture_footprint
from reconstruct.mosaic.grid import Float32, footprints
from reconstruct.mosaic.visibility import store_visible
from reconstruct.pictures.undistorted import Pictures
from reconstruct.raster import DemGrid, grid_of, read_cells, small_cache
from reconstruct.stages import COLOUR_FILE
from reconstruct.views.model import View, enu_from_cam

_MAX_CELLS = 16_000_000
"""Most cells of the DEM for one view; views that see more, to the horizon, are looked at block by
block."""
_SMALL_PX = 432
"""Width of the copies in which views are compared, at most."""
_MIN_SHRINK = 4
"""Half a cell of the mosaic, whose pixels are about as large as those of pictures."""
DARKEST, BRIGHTEST = 0.001, 0.95
"""Linear light beyond which a broad level is not used."""
_DARK_PERCENT = 0.5
_DARK_STEP = 2
"""Step along rows and columns between pixels that are looked at for dark ones."""
_BROAD_STEP = 4
"""Pixels of a small copy to one of its broad light, which is blurred by as much."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PictureMeasures:
    """Measures of one picture."""

    image: str
    camera: str
    sharpness: float
    """Mean size of its Laplacian over its mean level; NaN where it is black."""
    grey: bool
    """Whether its channels are equal."""
    nodes: Array
    """(rows, columns, 3) logarithm of its broad light at nodes, BGR; NaN where unusable."""
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
        return linear_table()[self.levels[..., :3]]

    @property
    def valid(self) -> Float32:
        """(h, w) share of each pixel that may be used."""
        return self.levels[..., 3].astype(np.float32) / np.float32(255)

    @property
    def whole(self) -> bool:
        """Whether all of it may be used."""
        return bool((self.levels[..., 3] == 255).all())


def linear_table() -> Float32:
    """(256,) linear light, 0 to 1, of the levels of the sRGB curve."""
    level = np.arange(256) / 255.0
    linear = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
    return linear.astype(np.float32)


def encode_srgb(light: Float32) -> Float32:
    """Levels, 0 to 255 where light is 0 to 1, by the sRGB curve; brighter light goes on beyond."""
    light = np.maximum(light, np.float32(0.0))
    curve = np.float32(1.055) * light ** np.float32(1 / 2.4) - np.float32(0.055)
    return np.float32(255.0) * np.where(
        light <= np.float32(0.0031308), np.float32(12.92) * light, curve
    )


@small_cache()
def measure_picture(workspace: Path, folder: Path, view: View) -> PictureMeasures:
    """Measure a picture of a workspace and write its small copy to a folder."""
    pictures = Pictures.still(workspace)
    taken, usable = pictures.as_taken(view.image), pictures.usable(view.image)
    height, width = taken.shape[:2]
    table = linear_table()
    shrink = max(_MIN_SHRINK, round(width / _SMALL_PX))
    size = (max(8, width // shrink), max(8, height // shrink))
    small = np.ones((size[1], size[0], 4), np.float32)
    if usable is not None:
        small[..., 3] = cv2.resize(usable.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    for channel in range(3):
        light = cv2.LUT(taken[..., channel], table)
        light = light if usable is None else light * usable
        total = cv2.resize(light, size, interpolation=cv2.INTER_AREA)
        small[..., channel] = total / np.maximum(small[..., 3], 1e-3)
    levels = np.rint(np.minimum(encode_srgb(small[..., :3]), 255)).astype(np.uint8)
    content = np.dstack([levels, np.rint(255 * small[..., 3]).astype(np.uint8)])
    copy = _small_copy(content)
    path = _small_path(folder, view.image)
    with atomic_path(path, lasting=False) as temporary, temporary.open("wb") as file:
        np.save(file, copy.levels)
        np.save(file, copy.broad)
    green = taken[..., 1]
    fine, mean = sharp_and_mean(green, np.ones((1, 1), np.bool_) if usable is None else usable)
    return PictureMeasures(
        image=view.image,
        camera=view.camera,
        sharpness=fine / mean if mean > 0 else float("nan"),
        grey=bool((taken[..., 0] == green).all() and (taken[..., 2] == green).all()),
        nodes=at_nodes(copy.broad, (DARKEST, BRIGHTEST), copy.valid),
        dark=_dark(taken, usable, table),
    )


def sharp_and_mean(grey: NDArray[np.uint8], usable: NDArray[np.bool_]) -> tuple[float, float]:
    """Mean size of the Laplacian, and mean level, of the inner pixels that may be used.

    Args:
        grey: (H, W).
        usable: (H, W), or (1, 1) for all.
    """
    inner = np.s_[1:-1, 1:-1]
    chosen = np.broadcast_to(usable, grey.shape)[inner]
    fine = np.abs(cv2.Laplacian(grey, cv2.CV_16S)[inner][chosen])
    count = max(len(fine), 1)
    return int(fine.sum(dtype=np.int64)) / count, int(grey[inner][chosen].sum()) / count


def well_exposed(light: NDArray[np.floating[Any]]) -> NDArray[np.bool_]:
    """Whether all channels (..., 3) are neither black nor burnt out."""
    return np.asarray(((light > DARKEST) & (light < BRIGHTEST)).all(axis=-1))


def _dark(taken: NDArray[np.uint8], usable: NDArray[np.bool_] | None, table: Float32) -> Array:
    """Darkest light in the cells around nodes."""
    part = taken[::_DARK_STEP, ::_DARK_STEP]
    mask = np.ones((1, 1), np.bool_) if usable is None else usable[::_DARK_STEP, ::_DARK_STEP]
    height, width = part.shape[:2]
    rows, columns = GRID
    y = np.clip(np.rint((np.arange(rows + 1) - 0.5) / (rows - 1) * height), 0, height)
    x = np.clip(np.rint((np.arange(columns + 1) - 0.5) / (columns - 1) * width), 0, width)
    levels = low_levels(part, mask, y.astype(np.int64), x.astype(np.int64), _DARK_PERCENT)
    return np.where(np.isfinite(levels), np.interp(levels, np.arange(256), table), np.nan)


def low_levels(
    picture: NDArray[np.uint8],
    usable: NDArray[np.bool_],
    y: NDArray[np.int64],
    x: NDArray[np.int64],
    percent: float,
) -> Array:
    """A percentile of the levels in boxes of a picture, (rows, columns, 3).

    Args:
        picture: (H, W, 3).
        usable: (H, W), or (1, 1) for all.
        y: (rows + 1,) edges of the boxes.
        x: (columns + 1,).
        percent: of the pixels that are darker.

    Returns:
        The level below which that share of pixels lies, as a step; NaN where fewer than 100 are
        usable.
    """
    found = np.full((len(y) - 1, len(x) - 1, 3), np.nan)
    usable = np.broadcast_to(usable, picture.shape[:2])
    for row, column in np.ndindex(*found.shape[:2]):
        box = np.s_[y[row] : y[row + 1], x[column] : x[column + 1]]
        shown = picture[box][usable[box]]
        if len(shown) >= 100:
            rank = int(percent / 100.0 * (len(shown) - 1))
            found[row, column] = np.partition(shown, rank, axis=0)[rank]
    return found


def _small_path(folder: Path, image: str) -> Path:
    """The file of a picture's small copy."""
    return folder / f"{image}.small"


def read_small(folder: Path, image: str) -> SmallCopy:
    """The small copy of a picture that `measure_picture` wrote."""
    with _small_path(folder, image).open("rb") as file:
        return SmallCopy(levels=np.load(file), broad=np.load(file))


def _small_copy(content: NDArray[np.uint8]) -> SmallCopy:
    copy = SmallCopy(levels=content, broad=np.empty((0, 0, 3), np.float32))
    size = (max(8, content.shape[1] // _BROAD_STEP), max(8, content.shape[0] // _BROAD_STEP))
    return replace(copy, broad=blur_valid(copy.detail, copy.valid, size))


@small_cache()
def outline_view(
    dem_tif: Path, sights: Path, heights: tuple[float, float], view: View
) -> PictureFootprint:
    """Find what a view sees of a DEM; write it for the tiles.

    Args:
        dem_tif: the DEM.
        sights: folder for what tiles need later.
        heights: lowest and highest cell of the DEM.
        view: in the DEM's frame.
    """
    dem, grid, whole = _part_seen(dem_tif, heights, view)
    if whole:
        store_visible(sights, view, dem, grid)
    return picture_footprint(view, dem, grid)


def _part_seen(
    dem_tif: Path, heights: tuple[float, float], view: View
) -> tuple[Float32, DemGrid, bool]:
    """The DEM below a view and all that it may see, coarser where that is a lot; whether it is."""
    west, east, south, north = footprints((view,), heights).boxes[0]
    place, whole = enu_from_cam(view, np.zeros(3))[:, 3], grid_of(dem_tif)
    columns = np.array([min(west, place[0]), max(east, place[0])]) - whole.west
    rows = whole.north - np.array([max(north, place[1]), min(south, place[1])])
    left, right = np.clip(columns / whole.cell + [-3, 4], 0, whole.columns).astype(int).tolist()
    top, bottom = np.clip(rows / whole.cell + [-3, 4], 0, whole.rows).astype(int).tolist()
    every = max(1, int(np.ceil(np.sqrt((right - left) * (bottom - top) / _MAX_CELLS))))
    dem = read_cells(dem_tif, top, left, bottom - top, right - left, every).astype(np.float32)
    part = whole.window(top, left, *dem.shape)
    return dem, replace(part, cell=every * whole.cell), every == 1


_NUMBERS = ("x", "y", "radius_px", "red", "green", "blue")
_MIN_PIXELS = 9
_MAX_BURNT = 0.01
"""Share of a patch's pixels that may be burnt out."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ReferencePatch:
    """What a picture shows of a patch of known reflectance."""

    image: str
    place: NDArray[np.float32]
    """(2,) x and y of its middle over the picture's width and height."""
    light: Array
    """(3,) mean linear light, BGR."""
    reflectance: Array
    """(3,) BGR."""


def read_references(workspace: Path, images: Sequence[str]) -> tuple[ReferencePatch, ...]:
    """Measure the patches that `colour_reference.csv` names; none without that file.

    Args:
        workspace: with finished pictures and model.
        images: pictures of the model.

    Raises:
        WorkspaceError: a row is wrong, or its patch cannot be used; the message names the line.
        ImageError: a picture cannot be read.
    """
    path = workspace / COLOUR_FILE
    if not path.is_file():
        return ()
    known, pictures = set(images), Pictures.still(workspace)
    found = []
    for line, row in read_csv(path, ("image", *_NUMBERS), fault=WorkspaceError)[1]:
        try:
            if row["image"] not in known:
                raise ValueError(f"the model has no picture {row['image']!r}")
            found.append(_measure_patch(row, pictures))
        except ValueError as error:
            raise WorkspaceError(f"{path} line {line}: {error}") from None
    if not found:
        raise WorkspaceError(f"{path}: has no patch; fill it or take it away")
    return tuple(found)


def _measure_patch(row: dict[str, str], pictures: Pictures) -> ReferencePatch:
    """The patch of a row; a `ValueError` says why it cannot be used."""
    try:
        x, y, radius, *rgb = (float(row[name]) for name in _NUMBERS)
    except ValueError:
        raise ValueError(f"{', '.join(_NUMBERS)} must be numbers") from None
    if not all(0.0 < value <= 1.0 for value in rgb):
        raise ValueError("red, green, blue must be reflectances above 0, at most 1")
    taken, usable = pictures.as_taken(row["image"]), pictures.usable(row["image"])
    height, width = taken.shape[:2]
    if not 0 < radius <= min(x + 0.5, width - x - 0.5, y + 0.5, height - y - 0.5):
        raise ValueError(f"the circle is not within the picture of {width} x {height} px")
    rows, columns = np.mgrid[:height, :width]
    inside = np.hypot(columns - x, rows - y) <= radius
    inside &= True if usable is None else usable
    if inside.sum() < _MIN_PIXELS:
        raise ValueError(f"{inside.sum()} unmasked pixels in the circle: {_MIN_PIXELS} are needed")
    light = linear_table()[taken[inside]].astype(np.float64)
    burnt, mean = float((light > BRIGHTEST).any(axis=1).mean()), light.mean(axis=0)
    if burnt > _MAX_BURNT or (mean < DARKEST).any():
        state = f"{burnt:.0%} of the patch is burnt out" if burnt > _MAX_BURNT else "it is black"
        raise ValueError(f"{state}: take another patch or picture")
    return ReferencePatch(
        image=row["image"],
        place=np.array([(x + 0.5) / width, (y + 0.5) / height], np.float32),
        light=mean,
        reflectance=np.array(rgb[::-1]),
    )
