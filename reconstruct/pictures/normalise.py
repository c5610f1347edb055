"""Pictures made even in light before features are looked for; colours stay as they are.

Lamps and strobes light the middle of a picture and water takes the contrast of its rims. Dividing
by the strongly blurred picture removes the first, local histogram equalisation the second. Colour
balance has no place here: it amplifies the noise of the weakest channel and costs matches.
"""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.errors import ImageError
from camera_calib.picture_files import read_pixels

Grey = NDArray[np.uint8]
Deep = NDArray[np.uint8] | NDArray[np.uint16]

_FLOOR = {np.dtype(np.uint8): 4.0, np.dtype(np.uint16): 64.0}
"""Grey levels below which a background counts as dark: noise there is not blown up further. Of 16
bits, those of a camera that fills 12 are meant."""
_BACKGROUND_SHARE = 1 / 24
"""Sigma of the background's blur as a share of the picture's longer side."""
FINE_LEVEL = 4096.0
"""Grey level of `finely` where a picture is as bright as around."""
_CLIP = 3.0
_TILES = 8


def read_deep(path: Path) -> Deep:
    """Read a picture for matching, (H, W) or (H, W, 3) BGR, with the 8 or 16 bits that it has.

    Raises:
        ImageError: it is missing, cannot be decoded, or its levels are not of 8 or 16 bits.
    """
    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
    picture = read_pixels(path, flags)
    if picture is None:
        raise ImageError(f"{path}: missing, or no picture that can be decoded")
    if picture.dtype not in _FLOOR:
        raise ImageError(
            f"{path}: levels of type {picture.dtype}: convert the picture to 8 or 16 bits"
        )
    return picture


def even_light(picture: Deep) -> NDArray[np.float32]:
    """Divide a picture by its blurred background.

    Args:
        picture: (H, W) grey or (H, W, 3) BGR, of 8 or 16 bits.

    Returns:
        (H, W) ratio of the grey level to its surroundings; 1 on average, and near 0 to 1 where the
        surroundings are dark.
    """
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) if picture.ndim == 3 else picture
    floor = np.float32(_FLOOR[picture.dtype])
    grey = grey.astype(np.float32)
    height, width = grey.shape
    sigma = max(width, height) * _BACKGROUND_SHARE
    shrink = max(1.0, sigma / 6.0)  # a blur this wide needs no fine grid
    small = cv2.resize(
        grey,
        (max(1, round(width / shrink)), max(1, round(height / shrink))),
        interpolation=cv2.INTER_AREA,
    )
    small = cv2.GaussianBlur(small, (0, 0), sigma / shrink, borderType=cv2.BORDER_REFLECT)
    background = cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(grey / np.maximum(background, floor))


def finely(ratio: NDArray[np.float32]) -> NDArray[np.uint16]:
    """An evened picture in levels far finer than the noise, as bent by no tone curve.

    Local equalisation helps descriptors, but its tone curves differ from tile to tile: they move
    edges by some thousandths of a pixel, the same in every picture, which bends a model.

    Args:
        ratio: (H, W) of `even_light`.

    Returns:
        (H, W) levels; `FINE_LEVEL` is the surroundings'.
    """
    levels: NDArray[np.uint16] = np.rint(np.clip(ratio * np.float32(FINE_LEVEL), 0, 65535)).astype(
        np.uint16
    )
    return levels


def normalise(picture: Deep) -> Grey:
    """A grey picture of even light and contrast, for matching.

    Args:
        picture: (H, W) grey or (H, W, 3) BGR, of 8 or 16 bits.

    Returns:
        (H, W) grey levels.
    """
    ratio = even_light(picture)
    grey = np.clip(ratio * np.float32(110.0), 0, 255).astype(np.uint8)
    tiles = (_TILES, _TILES)
    return np.asarray(cv2.createCLAHE(clipLimit=_CLIP, tileGridSize=tiles).apply(grey))
