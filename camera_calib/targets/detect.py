"""Find a target in a picture, and its points to a few hundredths of a pixel.

OpenCV finds the board or its markers, on a reduced picture where that suffices (`detect_board`);
then every point is fitted at full resolution (`corners`). Of boards with markers any part may be
seen. A plain chessboard's outer rows and columns must be seen: otherwise it is unknown which part
it is; corners in between may be hidden.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array
from camera_calib.targets.corners import ASTRAY, FITTED, REASONS, Corners, Grey, fit_corners
from camera_calib.targets.grow import board_map, from_neighbours, grown_chessboard, spans_board
from camera_calib.targets.pattern import surroundings
from camera_calib.targets.target import (
    TAG_BITS,
    TAG_BORDER_BITS,
    TAG_FAMILY,
    Rejection,
    Target,
    aruco_dictionary,
)

Picture = NDArray[np.uint8] | NDArray[np.uint16]

_MIN_POINTS, _MIN_AROUND, _MIN_SIDE = 6, 16, 4
_MAX_OFF, _ALWAYS_NEAR, _NEAR_AT_RIM = 0.2, 0.02, 0.1
"""Largest distance of a point from its prediction by its neighbours, in squares; those that are
always allowed, amidst the neighbours and where they are on one side."""
_RIM = 0.3
"""Distance of a point from the mean of its neighbours beyond which these are on one side."""
_MAX_OVER_MIDDLE = 10.0
"""The same over the middle one of the picture: a lens bends all of a board."""
_WEAKEST = 0.1
"""Contrast of a corner over the middle one of those near it: part of a target may be in shade."""
_ALIKE_NEAR = 9
"""Corners whose contrast is compared with, the corner itself among them."""
_WINDOWS = (1.0, 0.5)
"""Factors of the window, in turn, for points that only their neighbours predict."""
SMALL_PX, LARGE_PX = 1000, 2000
"""Longest sides of the reduced pictures given to the detectors."""
_ENLARGED = 2
"""Factor of pictures not larger than `SMALL_PX` before markers are read."""
_CELL_PX, _CELL_MARGIN = 8, 0.3
"""Resolution at which bits of markers are read, and the share of a bit's sides that is ignored: the
bits of small markers are blurred into each other."""
_DARK, _FLAT = 8, 4
"""Grey levels of 255 that the brightest pixels and the range of a usable picture exceed."""
_AGREED = 0.7
"""Share of the markers that must stand where the target has them; half do in a wrong layout."""
_MIN_PX = 32


@dataclass(frozen=True, kw_only=True, eq=False)
class Detection:
    """Points of a target found in one picture."""

    pixels: Array | None
    """(N, 2) from the outer corner of the first pixel, in the order of the target's points, NaN
    where not found; None: not the target."""
    sigma_px: Array | None = None
    """(N,) standard deviation of a coordinate, from the misfit of each corner."""
    refused: str | None = None
    """Why the picture was refused."""
    dropped: Mapping[str, int] = field(default_factory=dict)
    """Number of points seen but not used, by reason."""

    def rejections(self, view: str, camera: str) -> tuple[Rejection, ...]:
        """Points left out, for a calibration's report."""
        if self.refused is not None:
            return (Rejection(view=view, camera=camera, points=0, reason=self.refused),)
        return tuple(
            Rejection(view=view, camera=camera, points=count, reason=reason)
            for reason, count in self.dropped.items()
        )


def detect(target: Target, picture: Picture) -> Detection:
    """Find the points of a target.

    Args:
        target: what to look for.
        picture: (H, W) or (H, W, 3) blue, green, red, as OpenCV reads it; 8 bits (encoded by the
            sRGB curve; a linear encoding shifts no corner) or 16 bits (linear).

    Raises:
        CalibrationError: the picture is of another kind than 8 or 16 bits, grey or colour.
    """
    grey = as_grey(picture)
    poor = unusable(grey)
    if poor is not None:
        return Detection(pixels=None, refused=poor)
    if target.kind == "chessboard":
        near, why = find_chessboard_near(target, grey), ""
    else:
        near, why = find_markers_near(target, grey)
    if near is None:
        return Detection(pixels=None, refused=why or _no_chessboard(target, grey))
    return _refine(target, grey, near)


def as_grey(picture: Picture) -> Grey:
    """8-bit grey values, or linear ones of which the brightest are 1.

    Raises:
        CalibrationError: the picture is of another kind than 8 or 16 bits, grey or colour.
    """
    known = picture.dtype in (np.uint8, np.uint16) and picture.ndim in (2, 3) and picture.size
    channels = picture.shape[2] if picture.ndim == 3 else 1
    if not known or channels not in (1, 3, 4):
        raise CalibrationError(
            f"a picture of shape {picture.shape} and type {picture.dtype} cannot hold a target: "
            "give grey or colour pictures of 8 or 16 bits"
        )
    flat: NDArray[Any] = picture if picture.ndim == 2 else picture[..., 0]
    if channels > 1:
        code = cv2.COLOR_BGR2GRAY if channels == 3 else cv2.COLOR_BGRA2GRAY
        flat = cv2.cvtColor(picture, code)
    if flat.dtype == np.uint8:
        return np.ascontiguousarray(flat, dtype=np.uint8)
    # Cameras of 10 or 12 bits fill a part of the range only.
    brightest = max(float(np.percentile(flat[::4, ::4], 99.9)), 1.0)
    return np.minimum(flat / np.float32(brightest), np.float32(1.0))


def chessboard_size(grey: Grey) -> tuple[int, int] | None:
    """How many inner corners a chessboard has along its longer and its shorter side.

    Of one that is hidden in part, or larger than the picture, those of a part of it; None where
    there is none.
    """
    picture = reduce_picture(grey, SMALL_PX).picture
    least = (_MIN_SIDE, _MIN_SIDE)
    found, _, colours = cv2.findChessboardCornersSBWithMeta(picture, least, cv2.CALIB_CB_LARGER)
    if not found:
        return None
    shorter, longer = sorted(colours.shape)
    return longer, shorter


def _no_chessboard(target: Target, grey: Grey) -> str:
    """What was found in place of the whole chessboard."""
    size = chessboard_size(grey)
    if size is None:
        return f"no chessboard is found, of {target.columns}x{target.rows} inner corners or another"
    return (
        f"a chessboard of {size[0]}x{size[1]} inner corners is seen, or a part of one, not one of "
        f"{target.columns}x{target.rows}: its counts are others, or glare, shadow, a hand or the "
        "picture's border hides too much"
    )


def _refine(target: Target, grey: Grey, near: Array) -> Detection:
    """Fit all points, coarse to fine, number them, and leave out what does not fit."""
    part = reduce_picture(grey, LARGE_PX)
    if (part.scale > 1.2).any():
        coarse = _fit(target, part.picture, near / part.scale).pixels * part.scale
        near = np.where(np.isfinite(coarse), coarse, near)
    corners = _fit(target, grey, near)
    if target.kind == "chessboard":
        order = _numbering(target, near, corners)
        near, corners = near[order], corners.take(order)
    corners = _without_astray(target, corners)
    fitted = -1
    while int((corners.states == FITTED).sum()) > fitted:
        fitted = int((corners.states == FITTED).sum())
        corners = _second_look(target, grey, corners)
    corners = _without_astray(target, _last_look(target, grey, corners))
    used = corners.states == FITTED
    seen = np.isfinite(near).all(axis=1)
    counts = {
        reason: int(np.sum(seen & (corners.states == state))) for state, reason in REASONS.items()
    }
    dropped = {reason: count for reason, count in counts.items() if count}
    board = target.points[used, :2] / target.size_m
    flat = np.linalg.matrix_rank(board - board.mean(axis=0), tol=0.1) if used.any() else 0
    if used.sum() < _MIN_POINTS or flat < 2:
        why = "; ".join(f"{count}: {reason}" for reason, count in dropped.items())
        needed = f"{_MIN_POINTS} on more than one line are needed"
        refused = f"only {int(used.sum())} of {len(used)} points, {needed}"
        return Detection(pixels=None, refused=f"{refused} ({why})" if why else refused)
    if target.kind == "chessboard" and not spans_board(used.reshape(target.shape)):
        rows, columns = (int(np.ptp(at)) + 1 for at in np.nonzero(used.reshape(target.shape)))
        why = (
            f"{int(used.sum())} of {len(used)} inner corners are found, in {columns}x{rows}; half "
            "of all and a quarter of each outer row and column are needed"
        )
        return Detection(pixels=None, refused=why)
    return Detection(pixels=corners.pixels, sigma_px=corners.sigma_px, dropped=dropped)


def _fit(target: Target, grey: Grey, near: Array, shrink: float = 1.0) -> Corners:
    """Fit the points that have a start; the others stay NaN."""
    board, known = target.points[:, :2] / target.size_m, np.isfinite(near).all(axis=1)
    steps = np.full((len(near), 2, 2), np.nan)
    steps[known] = from_neighbours(board[known], near[known], board[known])[1]
    return _fit_with(target, grey, near, steps, shrink)


def _fit_with(
    target: Target,
    grey: Grey,
    near: Array,
    steps: Array,
    shrink: float = 1.0,
    bends: Array | None = None,
) -> Corners:
    reach, arm = 1.0, 1.0
    if target.marker_m is not None:
        arm = 0.5 * (1.0 - target.marker_m / target.size_m)
    if target.spacing is not None:
        reach, arm = target.spacing, min(target.spacing, TAG_BORDER_BITS / TAG_BITS)
    around = surroundings(target)
    return fit_corners(grey, near, steps, shrink * reach, arm, bends=bends, around=around)


def _second_look(target: Target, grey: Grey, corners: Corners) -> Corners:
    """Fit points that were not fitted where their neighbours predict them.

    So the target is found beyond the markers that were read; in smaller windows next to what hides
    a part of it.
    """
    board = target.points[:, :2] / target.size_m
    pitch = max(1.0, float(target.spacing or 0.0))
    for shrink in _WINDOWS:
        used = corners.states == FITTED
        if used.all() or used.sum() < 4:
            break
        near, steps = from_neighbours(board[used], corners.pixels[used], board)
        adjacent = cKDTree(board[used]).query(board)[0] < 1.1 * pitch
        near[used | ~adjacent] = np.nan
        again = _fit_with(target, grey, near, steps, shrink)
        corners = _without_astray(target, corners.with_fitted(again))
    return corners


def _last_look(target: Target, grey: Grey, corners: Corners) -> Corners:
    """Fit again, with edges as curved as the lens has them around each corner."""
    used = corners.states == FITTED
    if used.sum() < _MIN_AROUND:
        return corners
    steps, bends = (np.full((len(used), 2, count), np.nan) for count in (2, 3))
    board = target.points[:, :2] / target.size_m
    steps[used], bends[used] = board_map(board[used], corners.pixels[used])
    near = np.where(used[:, None], corners.pixels, np.nan)
    return corners.with_fitted(_fit_with(target, grey, near, steps, bends=bends))


def _without_astray(target: Target, corners: Corners) -> Corners:
    """Leave out corners far from their prediction, of the wrong colours or too faint."""
    fitted = corners.states == FITTED
    if fitted.sum() < 5:
        return corners
    board, pixels = target.points[fitted, :2] / target.size_m, corners.pixels[fitted]
    expected, steps = from_neighbours(board, pixels, board, others=True)
    off = np.linalg.norm(np.linalg.solve(steps, (pixels - expected)[..., None])[..., 0], axis=1)
    contrast = np.where(target.top_left_black[fitted], 1.0, -1.0) * corners.contrast[fitted]
    if target.is_ambiguous:  # of such chessboards the first square may be white
        contrast *= np.sign(np.median(contrast))
    astray = np.zeros(len(fitted), dtype=np.bool_)
    nearest = cKDTree(board).query(board, k=min(_ALIKE_NEAR, len(board)))[1]
    faint = contrast < _WEAKEST * np.maximum(np.median(contrast[nearest], axis=1), 0.0)
    at_rim = np.linalg.norm(board[nearest].mean(axis=1) - board, axis=1) > _RIM
    always = np.where(at_rim, _NEAR_AT_RIM, _ALWAYS_NEAR)
    usual = np.maximum(always, _MAX_OVER_MIDDLE * float(np.median(off)))
    astray[fitted] = (off > np.minimum(_MAX_OFF, usual)) | faint
    return corners.without(astray, ASTRAY)


def _numbering(target: Target, near: Array, corners: Corners) -> NDArray[np.intp]:
    """Which of the corners found is which point: the first square black, then nearest to upright.

    A chessboard whose first square cannot be identified is read as it hangs: two cameras that are
    turned against each other by more than a quarter turn would disagree.
    """
    rows, columns = target.shape
    grid = np.arange(rows * columns).reshape(rows, columns)
    sign = np.where(target.top_left_black, 1.0, -1.0)
    best, best_score = grid.ravel(), -np.inf
    for turn in range(4) if rows == columns else (0, 2):
        order = np.rot90(grid, turn).ravel()
        # A quarter turn swaps the two steps of a corner, and so the sense of its colours.
        contrast = corners.contrast[order] * (1.0 if turn % 2 == 0 else -1.0)
        colours = float(np.sign(np.nansum(np.sign(sign * contrast))))
        seen = near[order].reshape(rows, columns, 2)
        along = np.nanmean(np.diff(seen, axis=1), axis=(0, 1))
        down = np.nanmean(np.diff(seen, axis=0), axis=(0, 1))
        upright = along[0] / np.hypot(*along) + down[1] / np.hypot(*down)
        score = 10.0 * colours + float(upright)
        if score > best_score:
            best, best_score = order, score
    return best


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


def reduce_picture(grey: Grey, max_px: int) -> Reduced:
    """The picture, made so small that its longer side is at most this."""
    return resize_picture(grey, min(max_px, max(grey.shape)))


def resize_picture(grey: Grey, max_px: int) -> Reduced:
    """The picture, made so small or large that its longer side is this."""
    height, width = grey.shape
    scale = max_px / max(height, width)
    size = (max(round(width * scale), 1), max(round(height * scale), 1))
    small: NDArray[Any] = grey
    if scale != 1.0:
        way = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC
        small = cv2.resize(grey, size, interpolation=way)
    if small.dtype != np.uint8:
        # Detectors need the middle tones that the eye needs.
        small = np.rint(255.0 * np.sqrt(np.clip(small, 0.0, 1.0))).astype(np.uint8)
    return Reduced(picture=small, scale=np.array([width / size[0], height / size[1]]))


def unusable(grey: Grey) -> str | None:
    """Reason why a picture is unusable, if it is."""
    if min(grey.shape) < _MIN_PX:
        return f"only {grey.shape[1]} x {grey.shape[0]} px"
    low, high = np.percentile(reduce_picture(grey, SMALL_PX).picture, [0.1, 99.9])
    if high < _DARK:
        return f"too dark: 99.9 % of its pixels are at most {high:.0f} of 255"
    if high - low < _FLAT:
        return f"no contrast: nearly all its pixels are {low:.0f} to {high:.0f} of 255"
    return None


def find_chessboard_near(target: Target, grey: Grey) -> Array | None:
    """(N, 2) corners to about a pixel, in any numbering that is not mirrored, or None.

    Corners that OpenCV's detectors cannot find, in glare or behind a hand, are NaN rows.
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
    """Boards grown from what detectors find, the fast one first, then more thorough ones."""
    size = (target.columns, target.rows)
    small, large = reduce_picture(grey, SMALL_PX), reduce_picture(grey, LARGE_PX)

    def grow(part: Reduced, found: bool = True, corners: Any = None) -> Array | None:
        if not found:
            return None
        near = None if corners is None else np.float64(corners).reshape(*target.shape, 2) + 0.5
        board = grown_chessboard(part.picture, target.shape, near)
        return None if board is None else board * part.scale

    yield grow(small, *cv2.findChessboardCornersSB(small.picture, size, flags=0))
    for part in (small, large) if large.picture.size > small.picture.size else (small,):
        yield grow(part)
    yield grow(large, *cv2.findChessboardCornersSB(large.picture, size, cv2.CALIB_CB_EXHAUSTIVE))
    # The classic detector takes minutes on large pictures that hold no board.
    classic = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    yield grow(small, *cv2.findChessboardCorners(small.picture, size, flags=classic))
    if max(grey.shape) > 1.2 * LARGE_PX:
        whole = reduce_picture(grey, max(grey.shape))
        yield grow(whole, *cv2.findChessboardCornersSB(whole.picture, size, flags=0))


def find_markers_near(target: Target, grey: Grey) -> tuple[Array | None, str]:
    """(N, 2) points of the board next to the markers that were read, to about a pixel.

    Returns:
        The points, NaN rows where no marker is near; or None and the reason.
    """
    side = max(grey.shape)
    board, pixels, why = np.empty((0, 2)), np.empty((0, 2)), ""
    sizes = {min(LARGE_PX, side), side} if side > SMALL_PX else {_ENLARGED * side}
    for longest in sorted(sizes):
        found = _read_markers(target, resize_picture(grey, longest))
        if len(found[0]) >= len(board):
            board, pixels, why = found
        if len(board) == 4 * len(target.marker_places):
            break
    if len(board) < 8:
        return None, why
    points = target.points[:, :2] / target.size_m
    near, _ = from_neighbours(board, pixels, points)
    # A ChArUco board's corner lies half a gap from its marker's, a grid's point is a tag's corner.
    adjacent = cKDTree(board).query(points)[0] < 1.0
    inside = ((near >= 0.0) & (near < [grey.shape[1], grey.shape[0]])).all(axis=1)
    near[~(inside & adjacent)] = np.nan
    return near, ""


def _read_markers(target: Target, part: Reduced) -> tuple[Array, Array, str]:
    """Corners of markers on the board (M, 2), in squares, and in the whole picture (M, 2).

    Markers read twice or out of place are left out; the text says what was read.
    """
    tags = target.kind == "apriltag"
    parameters = cv2.aruco.DetectorParameters()
    parameters.minMarkerPerimeterRate = 0.01
    parameters.markerBorderBits = TAG_BORDER_BITS if tags else 1
    parameters.perspectiveRemovePixelPerCell = _CELL_PX
    parameters.perspectiveRemoveIgnoredMarginPerCell = _CELL_MARGIN
    dictionary = aruco_dictionary(TAG_FAMILY if tags else str(target.dictionary))
    detector = cv2.aruco.ArucoDetector(dictionary, parameters)
    quads, numbers, _ = detector.detectMarkers(part.picture)
    ids = np.empty(0, dtype=np.intp) if numbers is None else numbers.ravel()
    places = target.marker_places / target.size_m
    once = [i for i in range(len(ids)) if ids[i] < len(places) and np.sum(ids == ids[i]) == 1]
    family = "36h11" if tags else target.dictionary
    none, expected = np.empty((0, 2)), f"of the {len(places)} markers of {family}"
    if len(once) < 2:
        return none, none, f"{len(once)} {expected} read, 2 are needed"
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
        why = f"{len(once)} {expected} read, but not where the target has them: check its counts"
        return none, none, why + (" and layout (legacy?)" if target.kind == "charuco" else "")
    return board[np.repeat(whole, 4)], pixels[np.repeat(whole, 4)], ""
