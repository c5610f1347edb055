"""Find a chessboard that is partly hidden or in glare, by growing it from four of its corners.

OpenCV's detectors want every inner corner. Here saddles of the grey values are gathered; four that
stand as a square's corners do, with colours in turn, are a start, and corners that fit next to the
known ones are added until none does. A board whose outer rows and columns are seen, and count as
many corners as they must, is known whole, whatever is hidden in between.
"""

from collections import Counter
from collections.abc import Iterator

import cv2
import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from alice_survey.core.frames import Array
from camera_calib.targets.corners import fit_corners

Place = tuple[int, int]
Places = dict[Place, Array]
"""Column and row on the board: pixel, and once fitted the contrast, turned so that it agrees."""

_BLUR_PX = 1.5
_APART_PX = 7
_FAINTEST = 0.02
"""Weakest saddle over the strongest."""
_MAX_SADDLES = 600
_MAX_STARTS = 25
"""Saddles that squares are built from."""
_MAX_SQUARES = 4
"""Squares built from one of them."""
_MAX_ROUNDS = 40
_MAX_TRIES = 3
_NEAR = 40
_ALIKE = 0.15
"""Least strength of a saddle over that of the stronger one next to which it stands in a start."""
_OFF = 0.15
"""Largest distance of a grown corner from its prediction by its neighbours, in squares."""
_WEAKEST = 0.1
"""Contrast of a grown corner over the middle one of those near it; a shadow may lie between."""
_ALIKE_NEAR = 6
"""Known corners whose contrast is compared with."""
_MIN_CORNERS = 9
_MIN_SHARE = 0.5
"""Share of the corners that must be fitted."""
_MIN_OUTER_SHARE = 0.25
"""The same of each of the outer rows and columns, which show where the board ends."""
_MAX_NEIGHBOURS = 24
_NEIGHBOUR_WIDTH = 1.5
"""Standard deviation of a neighbour's weight, in squares."""
_MAX_DEGREE = 6
"""Of the polynomial that describes what a lens makes of a board."""
_STIFFNESS = 0.1
"""Weight of 'no change of slope', nor of bends, against that of a neighbour one square away."""


def grown_chessboard(
    picture: NDArray[np.uint8], shape: tuple[int, int], near: Array | None = None
) -> Array | None:
    """Find a chessboard of which corners may be hidden.

    Args:
        picture: (H, W) grey values of 8 bits.
        shape: rows and columns of inner corners.
        near: (rows, columns, 2) pixels to grow from, of which some may be wrong; None to search.

    Returns:
        (rows * columns, 2) pixels from the outer corner of the first pixel, in any numbering; NaN
        rows were not found. None when the board was not found.
    """
    taken = np.empty((0, 2))
    given = {} if near is None else {(x, y): near[y, x] for y, x in np.ndindex(near.shape[:2])}
    for start in _starts(picture) if near is None else [given]:
        apart = np.linalg.norm(taken[:, None] - np.array(list(start.values())), axis=-1)
        if np.any(apart < _APART_PX):
            continue
        known = _grow(picture, start, max(shape))
        if len(known) < _MIN_CORNERS:
            continue
        taken = np.concatenate([taken, np.array(list(known.values()))[:, :2]])
        grid = _spread(known)
        grid = grid if grid.shape[:2] == shape else np.swapaxes(grid, 0, 1)
        if grid.shape[:2] == shape and spans_board(np.isfinite(grid[..., 0])):
            return grid.reshape(-1, 2)
    return None


def spans_board(seen: NDArray[np.bool_]) -> bool:
    """Whether the corners seen, (rows, columns), determine where the board ends."""
    sides = (seen[0], seen[-1], seen[:, 0], seen[:, -1])
    outer = min(float(side.mean()) for side in sides)
    return bool(seen.mean() >= _MIN_SHARE and outer >= _MIN_OUTER_SHARE)


def _spread(known: Places) -> Array:
    """(rows, columns, 2) the known corners on their grid, NaN where none is known."""
    places = np.array(list(known))
    low = places.min(axis=0)
    columns, rows = np.ptp(places, axis=0) + 1
    grid = np.full((rows, columns, 2), np.nan)
    for (x, y), corner in known.items():
        grid[y - low[1], x - low[0]] = corner[:2]
    return grid


def _starts(picture: NDArray[np.uint8]) -> Iterator[Places]:
    """Four saddles each that stand like the corners of a square, strongest first.

    Seen at a slant, the corners of a square may lie farther apart than those of other
    parallelograms of the same board: several are tried from one saddle.
    """
    saddles, angles, strengths = _saddles(picture)
    if len(saddles) < 4:
        return
    tree = cKDTree(saddles)
    near = np.asarray(tree.query(saddles, k=min(_NEAR, len(saddles)))[1])
    count = 0
    for c, others in enumerate(near.tolist()):
        alike = [i for i in others[1:] if strengths[i] > _ALIKE * strengths[c]]
        turned = [i for i in alike if np.cos(2.0 * (angles[i] - angles[c])) < -0.4]
        if len(turned) < 2:
            continue
        a, along = turned[0], saddles[turned[0]] - saddles[c]
        squares = 0
        for b in turned[1:]:
            down = saddles[b] - saddles[c]
            cross = along[0] * down[1] - along[1] * down[0]
            lengths = np.hypot(*along), np.hypot(*down)
            if abs(cross) < 0.5 * lengths[0] * lengths[1] or max(lengths) > 2.5 * min(lengths):
                continue
            off, d = tree.query(saddles[a] + down)
            if off < 0.25 * min(lengths) and np.cos(2.0 * (angles[d] - angles[c])) > 0.4:
                right, below = (a, b) if cross > 0 else (b, a)
                corners = {(0, 0): c, (1, 0): right, (0, 1): below, (1, 1): d}
                yield {place: saddles[i] for place, i in corners.items()}
                squares += 1
            if squares == _MAX_SQUARES:
                break
        count += squares > 0
        if count == _MAX_STARTS:
            return


def _saddles(picture: NDArray[np.uint8]) -> tuple[Array, Array, Array]:
    """(M, 2) pixels of saddles, strongest first, (M,) directions of greatest curvature, strengths.

    The strength goes with the square of the contrast.
    """
    grey = cv2.GaussianBlur(picture.astype(np.float32), (0, 0), _BLUR_PX)
    xx, yy, xy = (cv2.Sobel(grey, cv2.CV_32F, *order) for order in ((2, 0), (0, 2), (1, 1)))
    strength = xy**2 - xx * yy
    peak = cv2.dilate(strength, np.ones((_APART_PX, _APART_PX), dtype=np.uint8))
    floor = max(_FAINTEST * float(strength.max()), 1e-3)
    y, x = np.nonzero((strength >= peak) & (strength > floor))
    order = np.argsort(-strength[y, x], kind="stable")[:_MAX_SADDLES]
    y, x = y[order], x[order]
    angles: Array = 0.5 * np.arctan2(2.0 * xy[y, x], xx[y, x] - yy[y, x]).astype(np.float64)
    return np.column_stack([x + 0.5, y + 0.5]), angles, strength[y, x].astype(np.float64)


def _grow(picture: NDArray[np.uint8], start: Places, longest: int) -> Places:
    """Add corners to some, of which a few may be wrong, until none fits or there are too many."""
    board, pixels = np.array(list(start), dtype=np.float64), np.array(list(start.values()))
    expected, steps = from_neighbours(board, pixels, board, others=True)
    fits = fit_corners(picture, pixels, steps)
    contrast = _alternating(board) * fits.contrast
    found = np.column_stack([fits.pixels, contrast])
    known = _knit(_near(board, found, (expected, steps), np.nansum(contrast) / len(board)), (-1, 1))
    if not known:
        return {}
    tries: Counter[Place] = Counter()
    for _ in range(_MAX_ROUNDS):
        fresh = _next_to(picture, known, tries)
        grown = _knit(known | fresh)
        if grown.keys() <= known.keys() or not grown:
            break
        known = grown
        if (np.ptp(np.array(list(known)), axis=0) >= longest).any():
            break
    return known


def _knit(known: Places, near: tuple[int, ...] = (-2, -1, 1, 2)) -> Places:
    """Only corners with known ones along both ways: one that fits by chance off the board has none.

    A known corner may lie one further, for a shadow's edge or a glare hides whole rows.
    """
    while True:
        kept = {
            (x, y): corner
            for (x, y), corner in known.items()
            if any((x + a, y) in known for a in near) and any((x, y + a) in known for a in near)
        }
        if len(kept) == len(known):
            return known
        known = kept


def _alternating(places: Array) -> Array:
    """1 and -1 in turn, as the colours of a chessboard's corners."""
    return np.asarray(1.0 - 2.0 * (places.sum(axis=1) % 2))


def _next_to(picture: NDArray[np.uint8], known: Places, tries: Counter[Place]) -> Places:
    """Corners that fit next to known ones, or beyond one that is hidden.

    Their contrast must alternate as that of the known ones near them. A place is tried a limited
    number of times, counted in `tries`.
    """
    far = 2 if len(known) >= _MIN_CORNERS else 1
    moves = [(a, b) for a in range(-far, far + 1) for b in range(-far, far + 1)]
    moves = [(a, b) for a, b in moves if abs(a) + abs(b) <= far]
    around = {(x + a, y + b) for x, y in known for a, b in moves} - set(known)
    worth = sorted(place for place in around if tries[place] < _MAX_TRIES)
    if not worth:
        return {}
    tries.update(worth)
    tried = np.array(worth, dtype=np.float64)
    board, corners = np.array(list(known), dtype=np.float64), np.array(list(known.values()))
    pixels = np.ascontiguousarray(corners[:, :2])
    expected, steps = from_neighbours(board, pixels, tried)
    fits = fit_corners(picture, expected, steps)
    nearest = cKDTree(board).query(tried, k=min(_ALIKE_NEAR, len(board)))[1]
    contrast = _alternating(tried) * fits.contrast
    found = np.column_stack([fits.pixels, contrast])
    return _near(tried, found, (expected, steps), np.median(corners[nearest, 2], axis=1))


def _near(places: Array, found: Array, at: tuple[Array, Array], usual: Array | float) -> Places:
    """Corners that lie where the places and steps of `at` have them, with the usual contrast."""
    off = np.linalg.norm(np.linalg.solve(at[1], (found[:, :2] - at[0])[..., None])[..., 0], axis=1)
    good = (found[:, 2] / usual > _WEAKEST) & (off < _OFF)
    return {
        (int(x), int(y)): corner for (x, y), corner in zip(places[good], found[good], strict=True)
    }


def from_neighbours(
    board: Array, pixels: Array, places: Array, others: bool = False
) -> tuple[Array, Array]:
    """Predict positions of the board's points in the picture, and the size of a square there.

    A homography through all known points, plus a quadratic of its residuals near each point: so a
    lens may bend the board.

    Args:
        board: (M, 2) known points, in squares.
        pixels: (M, 2) their pixels.
        places: (K, 2) points to predict, in squares.
        others: ignore a known point at exactly the place of a predicted one.

    Returns:
        (K, 2) pixels, and (K, 2, 2) pixels per square along x (first column) and y (second); NaN
        where fewer than 4 points are known, or all on a line.
    """
    homography = _homography(board, pixels)
    if homography is None:
        return np.full((len(places), 2), np.nan), np.full((len(places), 2, 2), np.nan)
    predicted, slopes, _ = through(homography, places)
    residuals = pixels - through(homography, board)[0]
    distance, index = cKDTree(board).query(places, k=min(_MAX_NEIGHBOURS, len(board)))
    weight = np.exp(-0.5 * (distance / _NEIGHBOUR_WIDTH) ** 2)
    if others:
        weight = np.where(distance < 1e-6, 0.0, weight)
    x, y = (board[index] - places[:, None]).transpose(2, 0, 1)
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=2)
    weighted = (terms * weight[..., None]).transpose(0, 2, 1)
    normal = weighted @ terms + np.diag([1e-3, *[_STIFFNESS] * 5])
    change = np.linalg.solve(normal, weighted @ residuals[index])
    return predicted + change[:, 0], slopes + change[:, 1:3].transpose(0, 2, 1)


def board_map(board: Array, pixels: Array) -> tuple[Array, Array]:
    """Steps and bends of a board's picture at each of its points, from all of them.

    A homography and a polynomial of its residuals, of a degree such that two points or more serve
    each of its terms, and two lines of points each power of x or y.

    Args:
        board: (M, 2) points, in squares; 4 or more that are not on a line.
        pixels: (M, 2) their pixels.

    Returns:
        (M, 2, 2) pixels per square along x (first column) and y (second), and (M, 2, 3) pixels by
        x^2, x y and y^2 from the point.
    """
    homography = _homography(board, pixels)
    if homography is None:
        return np.full((len(board), 2, 2), np.nan), np.full((len(board), 2, 3), np.nan)
    places, slopes, bends = through(homography, board)
    middle, half = (board.max(axis=0) + board.min(axis=0)) / 2.0, np.ptp(board, axis=0) / 2.0
    x, y = ((board - middle) / half).T
    degree = max(d for d in range(_MAX_DEGREE + 1) if (d + 1) * (d + 2) <= len(board))
    max_x, max_y = (len(np.unique(np.round(line, 6))) // 2 for line in (x, y))
    powers = [
        (i, j) for i in range(min(degree, max_x) + 1) for j in range(min(degree - i, max_y) + 1)
    ]

    def by(along_x: int, along_y: int) -> Array:
        """(M, T) derivatives of the polynomial's terms."""
        sides = []
        for z, times, one in ((x, along_x, half[0]), (y, along_y, half[1])):
            series = legendre.legder(np.eye(degree + 1), times) / one**times
            sides.append(legendre.legval(z, series).reshape(degree + 1, -1))
        return np.stack([sides[0][i] * sides[1][j] for i, j in powers], axis=1)

    terms = np.linalg.lstsq(by(0, 0), pixels - places, rcond=1e-9)[0]
    changes = {of: by(*of) @ terms for of in ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2))}
    slopes = slopes + np.stack([changes[1, 0], changes[0, 1]], axis=-1)
    bends = bends + np.stack([changes[2, 0] / 2, changes[1, 1], changes[0, 2] / 2], axis=-1)
    return slopes, bends


def _homography(board: Array, pixels: Array) -> Array | None:
    """The best one, or None with fewer than 4 points, or all on a line."""
    if len(board) < 4 or np.linalg.matrix_rank(board - board.mean(axis=0), tol=0.1) < 2:
        return None
    found: Array | None = cv2.findHomography(board, pixels, 0)[0]
    return found


def through(homography: Array, points: Array) -> tuple[Array, Array, Array]:
    """(K, 2) points mapped by a homography, and the map's slopes and bends as of `board_map`."""
    mapped = np.column_stack([points, np.ones(len(points))]) @ homography.T
    scale = mapped[:, 2:]
    pixels = mapped[:, :2] / scale
    slopes = homography[None, :2, :2] - pixels[:, :, None] * homography[None, 2:, :2]
    slopes = slopes / scale[:, :, None]
    x, y = homography[2, :2]
    by_x, by_y = slopes.transpose(2, 0, 1)
    bends = np.stack([by_x * x, by_x * y + by_y * x, by_y * y], axis=-1) / -scale[:, :, None]
    return pixels, slopes, bends
