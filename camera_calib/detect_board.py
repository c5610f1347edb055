"""Find where a chessboard or a board of markers is in a picture, to about a pixel."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from alice_survey.frames import Array
from camera_calib.corners import Grey, fit_corners
from camera_calib.neighbours import from_neighbours
from camera_calib.target import TAG_BORDER_BITS, TAG_FAMILY, Target, aruco_dictionary

SMALL_PX, LARGE_PX = 1000, 2000
"""Longest sides of the reduced pictures that detectors look at."""
_DARK, _FLAT = 8, 4
"""Grey levels of 255 that the brightest pixels and the range of a usable picture exceed."""
_MOST_ROUNDS = 40
_WEAKEST = 0.2
"""Contrast of a grown corner over the middle one of those it grows from."""
_OFF = 0.15
"""Farthest a grown corner may be from where its neighbours say it is, in squares."""
_LEAST_SHARE = 0.6
"""Of a chessboard's corners that must be fitted where OpenCV did not find it whole."""
_LEAST_OUTER_SHARE = 0.5
"""The same of each of its outer rows and columns, which tell where it ends."""


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
    """OpenCV's detectors, from the quick ones to those that see what the quick ones miss."""
    size = (target.columns, target.rows)
    small, large = reduced(grey, SMALL_PX), reduced(grey, LARGE_PX)
    for part, flags in ((small, 0), (large, cv2.CALIB_CB_EXHAUSTIVE)):
        found, corners = cv2.findChessboardCornersSB(part.picture, size, flags=flags)
        yield part.whole(corners) if found else None
    for part in (small, large):
        grown = _grown(target, part.picture)
        yield None if grown is None else grown * part.scale
    # The classic detector takes minutes on large pictures that hold no board.
    classic = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    found, corners = cv2.findChessboardCorners(small.picture, size, flags=classic)
    yield small.whole(corners) if found else None
    if max(grey.shape) > 1.2 * LARGE_PX:
        whole = reduced(grey, max(grey.shape))
        found, corners = cv2.findChessboardCornersSB(whole.picture, size, flags=0)
        yield whole.whole(corners) if found else None


def chessboard_size(picture: NDArray[np.uint8]) -> tuple[int, int] | None:
    """How many inner corners, along the longer and the shorter side, a chessboard has.

    Args:
        picture: (H, W) grey values of 8 bits.

    Returns:
        The size of a chessboard of any size in the picture, or of a part; None where there is none.
    """
    part = _part_of_chessboard(reduced(picture, SMALL_PX).picture)
    if part is None:
        return None
    shorter, longer = sorted(part.shape[:2])
    return longer, shorter


def _part_of_chessboard(picture: NDArray[np.uint8]) -> Array | None:
    """(rows, columns, 2) corners of a chessboard, or of a part, in OpenCV's pixels."""
    found, corners, squares = cv2.findChessboardCornersSBWithMeta(
        picture, (3, 3), flags=cv2.CALIB_CB_LARGER
    )
    if not found:
        return None
    rows, columns = squares.shape[:2]
    grid: Array = corners.reshape(rows, columns, 2).astype(np.float64)
    return grid


def _grown(target: Target, picture: NDArray[np.uint8]) -> Array | None:
    """(N, 2) corners of a chessboard of which OpenCV finds a part only.

    The part grows by corners that fit next to it. Where it ends is known when its outer rows and
    columns are seen and just as many as the board has; then so is its numbering.
    """
    part = _part_of_chessboard(picture)
    if part is None:
        return None
    rows, columns = part.shape[:2]
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
    pixels = part.reshape(-1, 2) + 0.5
    steps = from_neighbours(grid.astype(np.float64), pixels, grid.astype(np.float64))[1]
    fits = fit_corners(picture, pixels, steps)
    contrast = _alternating(grid) * fits.contrast
    middle = float(np.nanmedian(contrast)) if np.isfinite(contrast).any() else 0.0
    good = contrast > _WEAKEST * middle if middle > 0 else contrast < _WEAKEST * middle
    known = dict(zip(map(tuple, grid[good].tolist()), fits.pixels[good], strict=True))
    longest = max(target.columns, target.rows)
    for _ in range(_MOST_ROUNDS):
        if len(known) < 4 or (np.ptp(np.array(list(known)), axis=0) >= longest).any():
            break
        fresh = _next_to(picture, known, middle)
        if not fresh:
            break
        known |= fresh
    return _whole_board(target, known)


def _alternating(places: NDArray[np.int_]) -> Array:
    """1 and -1 in turn, as the colours of a chessboard's corners."""
    signs: Array = 1.0 - 2.0 * (places.sum(axis=1) % 2)
    return signs


def _next_to(
    picture: NDArray[np.uint8], known: dict[tuple[int, ...], Array], middle: float
) -> dict[tuple[int, ...], Array]:
    """Corners that fit up to two squares from known ones: one that is hidden may lie between.

    Their contrast must alternate as the known ones', of which `middle` is the middle one.
    """
    near = [(a, b) for a in range(-2, 3) for b in range(-2, 3) if abs(a) + abs(b) <= 2]
    asked = np.array(sorted({(x + a, y + b) for x, y in known for a, b in near} - set(known)))
    board = np.array(list(known), dtype=np.float64)
    pixels = np.array(list(known.values()))
    expected, steps = from_neighbours(board, pixels, asked.astype(np.float64))
    fits = fit_corners(picture, expected, steps)
    good = _alternating(asked) * fits.contrast / middle > _WEAKEST
    miss = (fits.pixels[good] - expected[good])[..., None]
    off = np.linalg.norm(np.linalg.solve(steps[good], miss)[..., 0], axis=1)
    good[good] = off < _OFF
    keys = [(int(x), int(y)) for x, y in asked[good]]
    return dict(zip(keys, fits.pixels[good], strict=True))


def _whole_board(target: Target, known: dict[tuple[int, ...], Array]) -> Array | None:
    """The known corners as the target's, where they span it whole; NaN rows are not known."""
    places = np.array(list(known))
    if len(places) < 4:
        return None
    low, span = places.min(axis=0), np.ptp(places, axis=0) + 1
    grid = np.full((span[1], span[0], 2), np.nan)
    for place, pixel in known.items():
        grid[place[1] - low[1], place[0] - low[0]] = pixel
    if grid.shape[:2] != target.shape:
        grid = np.swapaxes(grid, 0, 1)
    if grid.shape[:2] != target.shape:
        return None
    seen = np.isfinite(grid[..., 0])
    sides = (seen[0], seen[-1], seen[:, 0], seen[:, -1])
    if seen.mean() < _LEAST_SHARE or min(side.mean() for side in sides) < _LEAST_OUTER_SHARE:
        return None
    return grid.reshape(-1, 2)


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
    if whole.sum() < max(2.0, 0.5 * len(once)):
        why = f"{len(once)} {wanted} read, but not where the target has them: check its counts"
        return none, none, why + (" and layout (legacy?)" if target.kind == "charuco" else "")
    return board[np.repeat(whole, 4)], pixels[np.repeat(whole, 4)], ""
