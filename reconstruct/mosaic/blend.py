"""Views joined along seams in bands, fine detail sharply and broad tones softly.

Multi-band blending (Burt & Adelson 1983, "A multiresolution spline with application to image
mosaics") with pyramids that know where a view shows nothing: levels are means over what is valid.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from reconstruct.mosaic.grid import ALIGNED_PX

Float32 = NDArray[np.float32]

LEVELS = 4
"""Halvings: the broadest band is blended over some 2^LEVELS pixels, which are `ALIGNED_PX`."""
_NOTHING = np.float32(1e-6)
SUPPORT_PX = 4 * ALIGNED_PX
"""How far a pixel's colour reaches."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewPart:
    """What one view contributes."""

    row: int
    """Row of its first pixel in the tile; a multiple of `ALIGNED_PX`."""
    column: int
    colour: Float32
    """(h, w, 3); any value where not valid. h and w are multiples of `ALIGNED_PX`."""
    valid: NDArray[np.bool_]
    """(h, w) where the view shows something."""
    taken: NDArray[np.bool_]
    """(h, w) where the tile takes this view; a subset of `valid`."""


class Blend:
    """A tile as parts are added to it."""

    def __init__(self, rows: int, columns: int) -> None:
        """Sizes in pixels, multiples of `ALIGNED_PX`."""
        sizes = [(rows >> k, columns >> k) for k in range(LEVELS + 1)]
        self._bands = [np.zeros((*size, 3), np.float32) for size in sizes]
        self._weights = [np.zeros(size, np.float32) for size in sizes]

    def add(self, part: ViewPart) -> None:
        """Add a view."""
        weight = part.taken.astype(np.float32)
        share = part.valid.astype(np.float32)
        total = part.colour * share[..., None]
        for level in range(LEVELS + 1):
            height, width = weight.shape
            row, column = part.row >> level, part.column >> level
            at = slice(row, row + height), slice(column, column + width)
            mean = total / np.maximum(share, _NOTHING)[..., None]
            if level < LEVELS:
                share_next, total_next = cv2.pyrDown(share), cv2.pyrDown(total)
                band = mean - _expanded(total_next, share_next, (width, height))
                share, total = share_next, total_next
            else:
                band = mean
            self._bands[level][at] += weight[..., None] * band
            self._weights[level][at] += weight
            weight = cv2.pyrDown(weight) if level < LEVELS else weight

    def result(self) -> Float32:
        """(rows, columns, 3); 0 where no view is taken near."""
        colour: Float32 = self._bands[-1]
        known: Any = self._weights[-1]
        for level in reversed(range(LEVELS)):
            weight = self._weights[level]
            height, width = weight.shape
            broad = _expanded(colour, known, (width, height))
            known = (weight > _NOTHING).astype(np.float32)
            mean = self._bands[level] / np.maximum(weight, _NOTHING)[..., None]
            colour = ((mean + broad) * known[..., None]).astype(np.float32)
        return colour


def _expanded(total: Float32, share: Float32, size: tuple[int, int]) -> Float32:
    """Means total / share at twice the size, of what is known alone."""
    known = (share > _NOTHING).astype(np.float32)
    mean = total / np.maximum(share, _NOTHING)[..., None] * known[..., None]
    spread = cv2.pyrUp(known, dstsize=size)
    broad = cv2.pyrUp(mean, dstsize=size) / np.maximum(spread, _NOTHING)[..., None]
    found: Float32 = broad.astype(np.float32)
    return found
