"""The black and white areas of a target, all of it and around each of its points."""

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.frames import Array
from camera_calib.targets.target import TAG_BORDER_BITS, TAG_FAMILY, Target, aruco_dictionary

Bits = NDArray[np.bool_]

_AROUND = 0.6
"""Distance from a point up to which bits of markers are known, in squares."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Surroundings:
    """Lines around points at which black and white may meet, and the areas between them.

    The area above and left of a point is black; where it is white, all are inverted.
    """

    lines: Array
    """(N, 2, L) places of the lines that x crosses, then y, ascending, in squares from the point;
    infinite where there are fewer."""
    shades: Array
    """(N, L + 1, L + 1) of the areas, by rows: -1 black, 1 white."""


CROSSING = Surroundings(lines=np.zeros((1, 2, 1)), shades=np.array([[[-1.0, 1.0], [1.0, -1.0]]]))
"""Two edges alone."""


@cache
def surroundings(target: Target) -> Surroundings:
    """Surroundings of every point of a target."""
    if not len(target.marker_places):
        return CROSSING
    rectangles = black_rectangles(target) / target.size_m
    around = [
        _around(rectangles - np.tile(point, 2)) for point in target.points[:, :2] / target.size_m
    ]
    maximum = max(len(line) for lines, _ in around for line in lines)
    lines = np.full((len(around), 2, maximum), np.inf)
    shades = np.ones((len(around), maximum + 1, maximum + 1))
    for n, (places, shade) in enumerate(around):
        for axis, line in enumerate(places):
            lines[n, axis, : len(line)] = line
        shades[n, : shade.shape[0], : shade.shape[1]] = shade
    return Surroundings(lines=lines, shades=shades)


def _around(rectangles: Array) -> tuple[tuple[Array, Array], Array]:
    """Lines that x and that y cross near the origin, and the shades between them."""
    near = rectangles[
        (rectangles[:, :2] < _AROUND).all(axis=1) & (rectangles[:, 2:] > -_AROUND).all(axis=1)
    ]
    lines = []
    for axis in range(2):
        places = np.unique(np.round(near[:, axis::2].ravel(), 9))
        lines.append(places[np.abs(places) < _AROUND])
    x, y = (
        np.concatenate([line[:1] - 0.01, 0.5 * (line[1:] + line[:-1]), line[-1:] + 0.01])
        for line in lines
    )
    within = [
        (low < at) & (at < high)
        for at, low, high in (
            (x[:, None], near[:, 0], near[:, 2]),
            (y[:, None], near[:, 1], near[:, 3]),
        )
    ]
    black = np.einsum("jr,ir->ji", within[1], within[0])
    shades = np.where(black, -1.0, 1.0)
    first = shades[np.searchsorted(lines[1], -1e-6), np.searchsorted(lines[0], -1e-6)]
    return (lines[0], lines[1]), -first * shades


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
    return np.asarray(picture == 0)


def _bit_rectangles(black: Bits, place: Array, side_m: float) -> Array:
    """Rectangles of runs of black bits along the rows."""
    bit = side_m / black.shape[1]
    rows = []
    for j, row in enumerate(black):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], row.astype(int), [0]])))
        rows += [(a, j, b, j + 1) for a, b in edges.reshape(-1, 2)]
    return np.asarray(np.array(rows, dtype=np.float64).reshape(-1, 4) * bit + np.tile(place, 2))
