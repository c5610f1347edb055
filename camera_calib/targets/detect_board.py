"""Find where a chessboard or a board of markers is in a picture, to about a pixel."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from alice_survey.base.frames import Array
from camera_calib.targets.corners import Grey
from camera_calib.targets.grow import grown_chessboard
from camera_calib.targets.neighbours import from_neighbours
from camera_calib.targets.target import TAG_BORDER_BITS, TAG_FAMILY, Target, aruco_dictionary

SMALL_PX, LARGE_PX = 1000, 2000
"""Longest sides of the reduced pictures that detectors look at."""
_DARK, _FLAT = 8, 4
"""Grey levels of 255 that the brightest pixels and the range of a usable picture exceed."""


_AGREED = 0.7
"""Share of the markers that must stand where the target has them; half do in a wrong layout."""
_LEAST_PX = 32


@dataclass(frozen=True, kw_only=True, eq=False)
class Reduced:
    """A picture of 8 bits for OpenCV's detectors, and how to come back from its pixels."""

    picture: NDArray[np.uint8]
    scale: Array
    """(2,) pixels of the whole picture per pixel of this one, in x and y."""

    def whole(self, opencv_pixels: Any) -> Array:
        """Pixels of the whole picture from OpenCV's, which count from a pixel's centre."""
        pixels: Array = np.asarray(opencv_pixels, dtype=np.float64) + 0.5
        return pixels * self.scale


def reduced(grey: Grey, longest_px: int) -> Reduced:
    """The picture, made so small that its longer side is at most this."""
    height, width = grey.shape
    scale = min(longest_px / max(height, width), 1.0)
    size = (max(round(width * scale), 1), max(round(height * scale), 1))
    small: NDArray[Any] = grey
    if scale < 1.0:
        small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    if small.dtype != np.uint8:
        # Detectors want the middle tones that the eye wants.
        small = np.rint(255.0 * np.sqrt(small)).astype(np.uint8)
    return Reduced(picture=small, scale=np.array([width / size[0], height / size[1]]))


def unusable(grey: Grey) -> str | None:
    """Why nobody could find anything in a picture, if so."""
    if min(grey.shape) < _LEAST_PX:
        return f"only {grey.shape[1]} x {grey.shape[0]} px"
    low, high = np.percentile(reduced(grey, SMALL_PX).picture, [0.1, 99.9])
    if high < _DARK:
        return f"too dark: 99.9 % of its pixels are at most {high:.0f} of 255"
    if high - low < _FLAT:
        return f"no contrast: nearly all its pixels are {low:.0f} to {high:.0f} of 255"
    return None


def find_chessboard_near(target: Target, grey: Grey) -> Array | None:
    """(N, 2) corners to about a pixel, in any numbering that is not mirrored, or None.

    Corners that OpenCV's detectors cannot tell, in glare or behind a hand, are NaN rows.
    """
    for corners in _chessboard_tries(target, grey):
        if corners is not None:
            grid = corners.reshape(target.rows, target.columns, 2)
            along = np.nanmean(np.diff(grid, axis=1), axis=(0, 1))
            down = np.nanmean(np.diff(grid, axis=0), axis=(0, 1))
            mirrored = along[0] * down[1] - along[1] * down[0] < 0.0
            return np.ascontiguousarray(grid[:, ::-1] if mirrored else grid).reshape(-1, 2)
    return None


def _chessboard_tries(target: Target, grey: Grey) -> Iterator[Array | None]:
    """Detectors, from the quick one to those that see what it misses."""
    size = (target.columns, target.rows)
    small, large = reduced(grey, SMALL_PX), reduced(grey, LARGE_PX)
    found, corners = cv2.findChessboardCornersSB(small.picture, size, flags=0)
    yield small.whole(corners) if found else None
    for part in (small, large) if large.picture.size > small.picture.size else (small,):
        grown = grown_chessboard(part.picture, target.shape)
        yield None if grown is None else grown * part.scale
    found, corners = cv2.findChessboardCornersSB(large.picture, size, flags=cv2.CALIB_CB_EXHAUSTIVE)
    yield large.whole(corners) if found else None
    # The classic detector takes minutes on large pictures that hold no board.
    classic = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    found, corners = cv2.findChessboardCorners(small.picture, size, flags=classic)
    yield small.whole(corners) if found else None
    if max(grey.shape) > 1.2 * LARGE_PX:
        whole = reduced(grey, max(grey.shape))
        found, corners = cv2.findChessboardCornersSB(whole.picture, size, flags=0)
        yield whole.whole(corners) if found else None


def find_markers_near(target: Target, grey: Grey) -> tuple[Array | None, str]:
    """(N, 2) points of the board beside the markers that were read, to about a pixel.

    Returns:
        The points, NaN rows where no marker is near; or None and the reason.
    """
    side = max(grey.shape)
    board, pixels, why = np.empty((0, 2)), np.empty((0, 2)), ""
    for longest in sorted({min(LARGE_PX, side), side}):
        found = _read_markers(target, reduced(grey, longest))
        if len(found[0]) >= len(board):
            board, pixels, why = found
        if len(board) == 4 * len(target.marker_places):
            break
    if len(board) < 8:
        return None, why
    points = target.points[:, :2] / target.size_m
    near, _ = from_neighbours(board, pixels, points)
    # A ChArUco board's corner lies half a gap from its marker's, a grid's point is a tag's corner.
    beside = cKDTree(board).query(points)[0] < 1.0
    inside = ((near >= 0.0) & (near < [grey.shape[1], grey.shape[0]])).all(axis=1)
    near[~(inside & beside)] = np.nan
    return near, ""


def _read_markers(target: Target, part: Reduced) -> tuple[Array, Array, str]:
    """Corners of markers on the board (M, 2), in squares, and in the whole picture (M, 2).

    Markers read twice or out of place are left out; the text says what was read.
    """
    tags = target.kind == "apriltag"
    parameters = cv2.aruco.DetectorParameters()
    parameters.minMarkerPerimeterRate = 0.01
    parameters.markerBorderBits = TAG_BORDER_BITS if tags else 1
    dictionary = aruco_dictionary(TAG_FAMILY if tags else str(target.dictionary))
    detector = cv2.aruco.ArucoDetector(dictionary, parameters)
    quads, numbers, _ = detector.detectMarkers(part.picture)
    ids = np.empty(0, dtype=np.intp) if numbers is None else numbers.ravel()
    places = target.marker_places / target.size_m
    once = [i for i in range(len(ids)) if ids[i] < len(places) and np.sum(ids == ids[i]) == 1]
    family = "36h11" if tags else target.dictionary
    none, wanted = np.empty((0, 2)), f"of the {len(places)} markers of {family}"
    if len(once) < 2:
        return none, none, f"{len(once)} {wanted} read, 2 are needed"
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    # Kalibr's tags stand upside down against OpenCV's.
    square = np.roll(square, 2, axis=0) if tags else square * float(target.marker_m or 0.0)
    square = square if tags else square / target.size_m
    board = np.concatenate([places[ids[i]] + square for i in once])
    pixels = part.whole(np.concatenate([quads[i].reshape(4, 2) for i in once]))
    # A marker misread stands a square or more from its place; a lens bends by less.
    side_px = float(np.median([np.sqrt(cv2.contourArea(quads[i])) for i in once]))
    _, agree = cv2.findHomography(board, pixels, cv2.RANSAC, side_px * float(part.scale[0]))
    whole = np.zeros(len(once), dtype=np.bool_)
    if agree is not None:
        whole = agree.reshape(-1, 4).all(axis=1)
    if whole.sum() < max(2.0, _AGREED * len(once)):
        why = f"{len(once)} {wanted} read, but not where the target has them: check its counts"
        return none, none, why + (" and layout (legacy?)" if target.kind == "charuco" else "")
    return board[np.repeat(whole, 4)], pixels[np.repeat(whole, 4)], ""
