"""SIFT features of one picture, spread over it, with exact integer descriptors."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.frames import Array

_CONTRAST = 0.01
"""SIFT's contrast threshold: a quarter of the usual, since sediment has little."""
_CELLS = 16
"""Cells along the longer side over which features are spread."""
_MAX_MPX = 1.5
"""Largest picture in which features are looked for (see `detection_scales`)."""
_PIXELS_PER_FEATURE = 100.0
"""Pixels for each feature of a picture of rich texture, with about twice as many features as are
needed."""
_SUPPORT = 1.5
"""Diameters around a feature within which a mask must leave the picture free: three sigmas of the
blur at which it was found."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Features:
    """Keypoints of a picture, the largest of every part of it first."""

    pixels: Array
    """(N, 2) from the outer corner of the first pixel (its centre is 0.5, 0.5)."""
    scale_px: NDArray[np.float32]
    """(N,) diameters."""
    descriptors: NDArray[np.uint8]
    """(N, 128) RootSIFT times 512, as COLMAP keeps them."""


def find_features(
    grey: NDArray[np.uint8], mask: NDArray[np.bool_] | None, *, maximum: int, thrifty: bool = False
) -> Features:
    """Find SIFT features.

    Features are left out where a mask comes so near that its border would be part of them.

    Args:
        grey: (H, W) normalised picture.
        mask: (H, W) where features may be, or None.
        maximum: how many to keep, evenly over the picture.
        thrifty: look where there are enough first, see `detection_scales`.
    """
    height, width = grey.shape
    scales = detection_scales((width, height), maximum)
    if not thrifty:
        scales = scales[-1:]
    # Without the precise upscaling every keypoint lies a quarter pixel towards the origin.
    sift = cv2.SIFT_create(contrastThreshold=_CONTRAST, enable_precise_upscale=True)
    for tried in scales:
        size = (max(1, round(width * tried)), max(1, round(height * tried)))
        small = grey if tried >= 1.0 else cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        keypoints = sift.detect(small, None)
        if len(keypoints) >= maximum:
            break
    steps = np.array([width / small.shape[1], height / small.shape[0]])
    pixels = np.array([k.pt for k in keypoints], dtype=np.float64).reshape(-1, 2)
    pixels = (pixels + 0.5) * steps
    sizes = np.array([k.size for k in keypoints], dtype=np.float64)
    response = np.array([k.response for k in keypoints], dtype=np.float64)
    usable = clear_of_mask(pixels, mask, _SUPPORT * steps.mean() * sizes)
    chosen = usable[
        spread(pixels[usable], sizes[usable], response[usable], (width, height), maximum)
    ]
    picked = [keypoints[i] for i in chosen]
    found = sift.compute(small, picked)[1] if picked else np.zeros((0, 128), np.float32)
    return Features(
        pixels=pixels[chosen],
        scale_px=np.array([k.size for k in picked], dtype=np.float32) * np.float32(steps.mean()),
        descriptors=root_sift(found),
    )


def clear_of_mask(
    pixels: Array, mask: NDArray[np.bool_] | None, apart_px: Array | float
) -> NDArray[np.intp]:
    """Which of (N, 2) pixels are so far inside of where a mask (H, W) lets features be."""
    if mask is None:
        return np.arange(len(pixels))
    free_px = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 3)
    columns, rows = np.clip(pixels.astype(int), 0, np.array(mask.shape[::-1]) - 1).T
    return np.flatnonzero(free_px[rows, columns] > apart_px)


def detection_scales(size: tuple[int, int], maximum: int) -> tuple[float, ...]:
    """Factors by which a picture of some width and height is reduced to look for features.

    SIFT doubles a picture first. Pictures of rich texture have more features than are kept, and the
    largest are kept, so that those of the first octaves cost most of the time and are thrown away;
    what the reduction costs in position, the refinement along the tracks gives back. The second
    scale is for pictures that have too little to show at the first, and for cameras still to
    be calibrated from them: a block of 18 drone pictures bent more with the larger features.
    """
    area = size[0] * size[1]
    largest = min(1.0, float(np.sqrt(1e6 * _MAX_MPX / area)))
    first = min(largest, float(np.sqrt(_PIXELS_PER_FEATURE * maximum / area)))
    return (first, largest) if first < largest else (largest,)


def root_sift(descriptors: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Square roots of L1-normalised SIFT (Arandjelovic & Zisserman 2012), times 512 in bytes."""
    total = np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9)
    root = np.sqrt(np.maximum(descriptors, 0.0) / total)
    return np.asarray(np.minimum(np.rint(512.0 * root), 255).astype(np.uint8))


def spread(
    pixels: Array, sizes: Array, response: Array, size: tuple[int, int], maximum: int
) -> NDArray[np.intp]:
    """Choose features so that every part of the picture keeps its largest.

    Large features lie above the noise of dim pictures: on a real dark sea floor choosing by size
    gave 1.6 times the verified matches of choosing by strength.

    Args:
        pixels: (N, 2).
        sizes: (N,) diameters, by which features are chosen.
        response: (N,) strength, which decides between equals.
        size: width and height of the picture.
        maximum: how many to choose at most.

    Returns:
        Indices; first the largest of every cell, then the second of every cell, and so on.
    """
    if not len(pixels):
        return np.zeros(0, np.intp)
    column, row = (pixels // (max(size) / _CELLS)).astype(np.int64).T
    cells = row * _CELLS + column
    # x and y last: ties must not depend on the order of detection
    order = np.lexsort((pixels[:, 1], pixels[:, 0], -response, -sizes, cells))
    starts = np.flatnonzero(np.r_[True, np.diff(cells[order]) != 0])
    rank = np.arange(len(order)) - np.repeat(starts, np.diff(np.r_[starts, len(order)]))
    turn: NDArray[np.intp] = order[np.lexsort((-sizes[order], rank))]
    return turn[:maximum]


def save_features(path: Path, features: Features) -> None:
    """Write features so that an interrupted run can go on."""
    with atomic_path(path) as temporary:
        np.savez(temporary, **vars(features))


def load_features(path: Path) -> Features:
    """Read what `save_features` wrote."""
    with np.load(path) as data:
        return Features(**data)
