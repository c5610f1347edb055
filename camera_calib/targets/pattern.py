"""What a target looks like: its black areas, to print it or to picture it."""

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.base.frames import Array
from camera_calib.targets.target import (
    TAG_BORDER_BITS,
    TAG_FAMILY,
    Target,
    aruco_dictionary,
)

Bits = NDArray[np.bool_]


def black_rectangles(target: Target) -> Array:
    """The black areas of a target; they touch, but do not overlap.

    Returns:
        (M, 4) least x, least y, greatest x, greatest y in the target's frame, metres.
    """
    if target.kind == "apriltag":
        return _apriltag(target)
    return _chessboard(target)


def _chessboard(target: Target) -> Array:
    """The black squares, and the markers in the white ones."""
    rows, columns = (count + 1 for count in target.shape)
    y, x = np.mgrid[-1 : rows - 1, -1 : columns - 1]
    black = (x + y + target.first_square_white) % 2 == 0
    corners = np.column_stack([x[black], y[black]]) * target.size_m
    parts = [np.column_stack([corners, corners + target.size_m])]
    if target.marker_m is not None:
        for number, place in enumerate(target.marker_places):
            bits = marker_bits(str(target.dictionary), number, 1)
            parts.append(_bit_rectangles(bits, place, target.marker_m))
    return np.concatenate(parts)


def _apriltag(target: Target) -> Array:
    """The tags as Kalibr prints them, and the small squares between their corners."""
    parts = []
    for number, place in enumerate(target.marker_places):
        # Kalibr's tags stand upside down against OpenCV's.
        bits = np.rot90(marker_bits(TAG_FAMILY, number, TAG_BORDER_BITS), 2)
        parts.append(_bit_rectangles(bits, place, target.size_m))
    gap = target.size_m * float(target.spacing or 0.0)
    places = target.points[:, :2].reshape(*target.shape, 2)
    x = np.concatenate([[-gap], places[0, 1::2, 0]])
    y = np.concatenate([[-gap], places[1::2, 0, 1]])
    corners = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    parts.append(np.column_stack([corners, corners + gap]))
    return np.concatenate(parts)


def marker_bits(dictionary: str, number: int, border: int) -> Bits:
    """Which bits of a marker are black, with its border, as OpenCV draws it upright."""
    known = aruco_dictionary(dictionary)
    side = known.markerSize + 2 * border
    picture = cv2.aruco.generateImageMarker(known, number, side, borderBits=border)
    black: Bits = picture == 0
    return black


def _bit_rectangles(black: Bits, place: Array, side_m: float) -> Array:
    """Rectangles of runs of black bits along the rows."""
    bit = side_m / black.shape[1]
    rows = []
    for j, row in enumerate(black):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], row.astype(int), [0]])))
        rows += [(a, j, b, j + 1) for a, b in edges.reshape(-1, 2)]
    rectangles: Array = np.array(rows, dtype=np.float64).reshape(-1, 4) * bit + np.tile(place, 2)
    return rectangles
