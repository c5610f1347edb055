"""Pictures made even in light before features are looked for; colours stay as they are.

Lamps and strobes light the middle of a picture and water takes the contrast of its rims. Dividing
by the strongly blurred picture removes the first, local histogram equalisation the second. Colour
balance has no place here: it amplifies the noise of the weakest channel and costs matches.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

Grey = NDArray[np.uint8]

_FLOOR = 4.0
"""Grey levels below which a background counts as dark: noise there is not blown up further."""
_BACKGROUND_SHARE = 1 / 24
"""Sigma of the background's blur as a share of the picture's longer side."""
_CLIP = 3.0
_TILES = 8


def even_light(picture: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Divide a picture by its blurred background.

    Args:
        picture: (H, W) grey or (H, W, 3) BGR.

    Returns:
        (H, W) ratio of the grey level to its surroundings; 1 on average, and near 0 to 1 where the
        surroundings are dark.
    """
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) if picture.ndim == 3 else picture
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
    ratio: NDArray[np.float32] = grey / np.maximum(background, np.float32(_FLOOR))
    return ratio


def normalise(picture: NDArray[np.uint8]) -> Grey:
    """A grey picture of even light and contrast, for matching.

    Args:
        picture: (H, W) grey or (H, W, 3) BGR.

    Returns:
        (H, W) grey levels.
    """
    ratio = even_light(picture)
    grey = np.clip(ratio * np.float32(110.0), 0, 255).astype(np.uint8)
    tiles = (_TILES, _TILES)
    equalised: Grey = cv2.createCLAHE(clipLimit=_CLIP, tileGridSize=tiles).apply(grey)
    return equalised
