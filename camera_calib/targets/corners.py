"""Corners of checkered patterns to a fiftieth of a pixel: the crossing of two soft edges is fitted.

OpenCV's `cornerSubPix` is good to about a tenth of a pixel on pictures with noise, which a stereo
rig of 0.1 m baseline notices at the sea floor. Here the grey values around each corner are fitted
by the product of two blurred edges, in linear light. The window follows the board: it is cut to the
shape of its squares, and to a cross along the edges where markers or bits stand between them.
"""

import math
from dataclasses import dataclass, replace
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.block_solver import solve_symmetric
from alice_survey.core.compiled import compiled
from alice_survey.core.frames import Array
from camera_calib.targets.pattern import CROSSING, Surroundings

Grey = NDArray[np.uint8] | NDArray[np.float32] | NDArray[np.float64]

FITTED, AT_BORDER, NOT_SETTLED, UNLIKE_A_CORNER, ASTRAY, UNSEEN = range(6)
"""Status of a corner."""
REASONS = {
    AT_BORDER: "too near to the border of the picture",
    NOT_SETTLED: "the fit of its edges did not settle",
    UNLIKE_A_CORNER: "it looks unlike a corner: hidden, in glare or out of focus",
    ASTRAY: "not where its neighbours say it must be, or of the wrong colours",
}
_BLUR_PX = 0.8
_WHITE_NOISE = 4.0 * math.pi * _BLUR_PX**2
"""Variance of white noise over its variance after the blur."""
_STEPS = 30
_MAX_PX, _MAX_SHIFT = 1.5, 0.1
"""Largest distance of a corner from its start: the greater of this and of these squares."""
_NARROWEST_PX, _WIDEST_PX = 0.2, 8.0
_HALF_PX = 12
_REACH = 0.45
"""Half the window in squares; it must not reach the neighbouring edges."""
_CLEAR_PX, _CLEAR = 2.0, 0.25
"""Distance kept from other edges, whose places are less well known: the lesser of this and of this
share of the distance to them."""
_MAX_BENT_PX = 0.1
"""Largest bend of an edge in the window; bends are known to a tenth or so."""
_MIN_PX = 1.0
_MIN_PIXELS = 25
_WORST_MISFIT, _WORST_NOISY_MISFIT = 0.2, 0.35
"""Largest rms of what a fit leaves over the contrast: where noise does not explain it, and where it
does."""
_NOISES = 2.0
"""What a fit leaves is noise up to this many standard deviations of the picture's."""
_MIN_CONTRAST = 0.001
_MAX_SIGMA_PX = 0.5
"""Largest standard deviation: two edges that cross outside of the window fit whatever is in it."""
_MAX_LINE_PX = _HALF_PX + 2.0
"""Distance from a corner at which a line still shows in its window."""
_SHARP = 4.0
"""Distance from an edge over its blur beyond which it is black or white."""
_TWO_OVER_ROOT_PI = 2.0 / math.sqrt(math.pi)


@dataclass(frozen=True, kw_only=True, eq=False)
class Corners:
    """Fitted corners."""

    fits: Array
    """(N, 4) pixel from the outer corner of the first one, standard deviation of a coordinate from
    the residuals of the fit, contrast; NaN rows were not fitted."""
    states: NDArray[np.intp]
    """(N,) FITTED, a key of REASONS, or UNSEEN where there was nothing to start from."""

    @property
    def pixels(self) -> Array:
        """(N, 2)."""
        return self.fits[:, :2]

    @property
    def sigma_px(self) -> Array:
        """(N,) standard deviations of a coordinate."""
        return self.fits[:, 2]

    @property
    def contrast(self) -> Array:
        """(N,) half the difference of black and white in linear light.

        Above 0 where the square between the ways back along both steps is black, below 0 where it
        is white.
        """
        return self.fits[:, 3]

    def take(self, order: NDArray[np.intp]) -> Self:
        """These corners in another order."""
        return replace(self, fits=self.fits[order], states=self.states[order])

    def with_fitted(self, again: Self) -> Self:
        """These corners, and of other fits of them those that succeeded."""
        found = again.states == FITTED
        fits = np.where(found[:, None], again.fits, self.fits)
        return replace(self, fits=fits, states=np.where(found, again.states, self.states))

    def without(self, which: NDArray[np.bool_], state: int) -> Self:
        """These corners, but some of them unfitted for a reason."""
        fits = np.where(which[:, None], np.nan, self.fits)
        return replace(self, fits=fits, states=np.where(which, state, self.states))


def linear_light(picture: NDArray[np.uint8]) -> Array:
    """Undo the sRGB curve (IEC 61966-2-1): 8-bit grey values to 0 to 1, linear."""
    encoded = np.arange(256) / 255.0
    table = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    return table[picture]


def _light(picture: Grey) -> Array:
    if picture.dtype == np.uint8:
        return linear_light(picture.astype(np.uint8))
    return picture.astype(np.float64)


def fit_corners(
    picture: Grey,
    near: Array,
    pixels_per_square: Array,
    reach: float = 1.0,
    arm: float = 1.0,
    *,
    bends: Array | None = None,
    around: Surroundings = CROSSING,
) -> Corners:
    """Fit the crossing of two soft edges around each corner.

    Args:
        picture: (H, W) grey values: of 8 bits, encoded by the sRGB curve, or linear, 0 to 1.
        near: (N, 2) places within a pixel of the corners, from the outer corner of the first pixel.
        pixels_per_square: (N, 2, 2) at each corner, the steps in pixels along one edge (first
            column) and along the other (second column) by one square.
        reach: distance to the next edges that cross these two, in squares.
        arm: distance to the next edges next to these two, in squares; in between, farther than that
            from both edges, there may be anything.
        bends: (N, 2, 3) how edges are curved by the lens: pixels by u^2, u v and v^2, with u and v
            the squares along both edges from the corner.
        around: other edges, whose blur reaches into the window, of each corner or of all.
    """
    fits = np.full((len(near), 4), np.nan)
    states = np.full(len(near), UNSEEN, dtype=np.intp)
    height, width = picture.shape
    inside = np.isfinite(near).all(axis=1) & np.isfinite(pixels_per_square).all(axis=(1, 2))
    inside &= (near >= 0).all(axis=1) & (near < [width, height]).all(axis=1)
    if inside.any():
        seen = near[inside]
        room = _HALF_PX + 4
        low = np.maximum(np.floor(seen.min(axis=0)).astype(int) - room, 0)
        high = np.ceil(seen.max(axis=0)).astype(int) + room
        part = picture[low[1] : high[1], low[0] : high[0]]
        light = _light(part)
        noise = _NOISES**2 * _noise_variance(light) / _WHITE_NOISE
        light = cv2.GaussianBlur(light, (0, 0), _BLUR_PX)
        which = np.flatnonzero(inside)
        bent = np.zeros((len(which), 2, 3)) if bends is None else bends[inside]
        steps = np.ascontiguousarray(pixels_per_square[inside])
        which = which if len(around.lines) > 1 else 0 * which
        fits[inside], states[inside] = _fit_corners(
            light, seen - low, steps, np.ascontiguousarray(bent), _windows(steps, bent, reach, arm),
            around.lines, around.shades, which, _lines_in_window(steps, around.lines[which]), noise,
        )  # fmt: skip
        fits[inside, :2] += low
    return Corners(fits=fits, states=states)


def _windows(steps: Array, bends: Array, reach: float, arm: float) -> Array:
    """(N, 2, 4) squares along both edges by pixel, then half the window and half its arms.

    The latter in squares; all NaN where the edges are one.
    """
    area = np.linalg.det(steps)
    swapped = np.stack([steps[:, ::-1, 1], -steps[:, ::-1, 0]], axis=1) * [1.0, -1.0]
    by_pixel = swapped / np.where(np.abs(area) < 1.0, np.nan, area)[:, None, None]
    per_px = np.hypot(by_pixel[..., 0], by_pixel[..., 1])
    bend_px = np.maximum(np.abs(bends).max(axis=(1, 2)), 1e-9)[:, None]
    straight = np.maximum(
        np.sqrt(_MAX_BENT_PX / bend_px), 4.0 * np.sqrt(per_px.prod(axis=1))[:, None]
    )
    half, arms = (
        np.maximum(to - np.minimum(_CLEAR_PX * per_px, _CLEAR * to), _MIN_PX * per_px)
        for to in (reach, arm)
    )
    half = np.minimum(np.minimum(_REACH, half), straight)
    return np.concatenate([by_pixel, half[..., None], arms[..., None]], axis=2)


def _lines_in_window(steps: Array, lines: Array) -> Array:
    """(N, 2, 3) pixels per square across the lines, and which of them show: first, last but one."""
    lengths = np.hypot(steps[:, 0], steps[:, 1])[:, ::-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        per_square = np.linalg.det(steps)[:, None] / lengths
        at = lines * per_square[..., None]
    first, last = (at < -_MAX_LINE_PX).sum(axis=2), (at < _MAX_LINE_PX).sum(axis=2)
    return np.stack([per_square, first, last], axis=2)


def _noise_variance(light: Array) -> float:
    """Variance of white noise in a picture, from what no edge or slope has (Immerkaer 1996)."""
    mask = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]])
    rough = np.abs(cv2.filter2D(light, cv2.CV_64F, mask))
    return float(np.median(rough) / (0.6745 * 6.0)) ** 2


@compiled
def _fit_corners(
    picture: Array,
    near: Array,
    steps: Array,
    bends: Array,
    windows: Array,
    lines: Array,
    shades: Array,
    which: NDArray[np.intp],
    shown: Array,
    noise: float,
) -> tuple[Array, NDArray[np.intp]]:
    out, states = np.full((near.shape[0], 4), np.nan), np.zeros(near.shape[0], np.intp)
    side = 2 * _HALF_PX + 1
    window, used = np.empty((side, side)), np.empty((side, side), np.bool_)
    places, first_two = np.empty((side, side, 2)), np.zeros((9, 2))
    first_two[0, 0] = first_two[1, 1] = 1.0
    for i in range(near.shape[0]):
        column, row = int(near[i, 0]), int(near[i, 1])
        states[i] = _cut(picture, near[i], bends[i], windows[i], window, used, places)
        if states[i] != FITTED:
            continue
        left, right = int(shown[i, 0, 1]), int(shown[i, 0, 2])
        top, bottom = int(shown[i, 1, 1]), int(shown[i, 1, 2])
        edges = (
            lines[which[i], 1, top:bottom] * shown[i, 1, 0],
            lines[which[i], 0, left:right] * shown[i, 0, 0],
        )
        shade = shades[which[i], top : bottom + 1, left : right + 1]
        x, y = near[i, 0] - column, near[i, 1] - row
        best, variance, normal = _descend(window, used, places, edges, shade, x, y, steps[i])
        area = abs(steps[i, 0, 0] * steps[i, 1, 1] - steps[i, 0, 1] * steps[i, 1, 0])
        farthest = max(_MAX_PX, _MAX_SHIFT * math.sqrt(area))
        settled = math.hypot(best[0] - x, best[1] - y) < farthest
        if not settled or not _NARROWEST_PX < best[4] < _WIDEST_PX:
            states[i] = NOT_SETTLED
            continue
        contrast2 = best[5] * best[5]
        allowed = min(_WORST_MISFIT**2 * contrast2 + noise, _WORST_NOISY_MISFIT**2 * contrast2)
        if abs(best[5]) < _MIN_CONTRAST or variance > allowed:
            states[i] = UNLIKE_A_CORNER
            continue
        for k in range(9):
            normal[k, k] += 1e-12
        inverse = solve_symmetric(normal, first_two)
        sigma = math.sqrt(0.5 * (inverse[0, 0] + inverse[1, 1]) * variance * _WHITE_NOISE)
        if not sigma <= _MAX_SIGMA_PX:
            states[i] = UNLIKE_A_CORNER
            continue
        out[i, 0], out[i, 1] = column + best[0], row + best[1]
        out[i, 2], out[i, 3] = sigma, best[5]
    return out, states


@compiled
def _cut(
    picture: Array,
    centre: Array,
    bends: Array,
    size: Array,
    window: Array,
    used: NDArray[np.bool_],
    places: Array,
) -> int:
    """Fill the window with the pixels around a corner; report which of them show its edges only.

    `size` is of `_windows`; `places` are those of the pixels in a picture in which the lens curves
    no edge near the corner.
    """
    rows, columns = picture.shape
    column, row = int(centre[0]), int(centre[1])
    used[:] = False
    if np.isnan(size[0, 0]):
        return NOT_SETTLED
    (ux, uy, u_reach, u_arm), (vx, vy, v_reach, v_arm) = size[0], size[1]
    count = 0
    for j in range(-_HALF_PX, _HALF_PX + 1):
        for i in range(-_HALF_PX, _HALF_PX + 1):
            x, y = column + i + 0.5 - centre[0], row + j + 0.5 - centre[1]
            u, v = ux * x + uy * y, vx * x + vy * y
            for axis in range(2):
                b = bends[axis]
                straight = (x, y)[axis] - b[0] * u * u - b[1] * u * v - b[2] * v * v
                origin = (column, row)[axis]
                places[j + _HALF_PX, i + _HALF_PX, axis] = centre[axis] - origin + straight
            u, v = abs(u), abs(v)
            if u > u_reach or v > v_reach or (u > u_arm and v > v_arm):
                continue
            if not (0 <= row + j < rows and 0 <= column + i < columns):
                return AT_BORDER
            window[j + _HALF_PX, i + _HALF_PX] = picture[row + j, column + i]
            used[j + _HALF_PX, i + _HALF_PX] = True
            count += 1
    return FITTED if count >= _MIN_PIXELS else NOT_SETTLED


@compiled
def _descend(
    window: Array,
    used: NDArray[np.bool_],
    places: Array,
    edges: tuple[Array, Array],
    shades: Array,
    x: float,
    y: float,
    steps: Array,
) -> tuple[Array, float, Array]:
    """Levenberg-Marquardt from a start; returns what fits, its variance and the normal matrix.

    What fits are the centre, normals of both edges, blur, contrast, level and its two slopes.
    """
    low, high, total, count = np.inf, -np.inf, 0.0, 0
    for j in range(window.shape[0]):
        for i in range(window.shape[1]):
            if used[j, i]:
                low, high = min(low, window[j, i]), max(high, window[j, i])
                total += window[j, i]
                count += 1
    one, two = math.atan2(steps[0, 0], -steps[1, 0]), math.atan2(-steps[0, 1], steps[1, 1])
    q, damped = np.zeros(9), np.empty((9, 9))
    q[0], q[1], q[2], q[3] = x, y, one, two
    q[4], q[5], q[6] = 1.5, 0.5 * (high - low), total / count
    damping = 1e-3
    cost = _equations(window, used, places, edges, shades, q)[0]
    q[5] = -q[5]
    if _equations(window, used, places, edges, shades, q)[0] > cost:
        q[5] = -q[5]
    cost, normal, right = _equations(window, used, places, edges, shades, q)
    for _ in range(_STEPS):
        for a in range(9):
            for b in range(a + 1):
                damped[a, b] = normal[a, b]
            damped[a, a] += damping * normal[a, a] + 1e-12
        step = solve_symmetric(damped, right)
        tried = np.empty(9)
        for a in range(9):
            tried[a] = q[a] - step[a, 0]
        new_cost, new_normal, new_right = _equations(window, used, places, edges, shades, tried)
        if new_cost < cost:
            small = abs(step[0, 0]) + abs(step[1, 0]) < 1e-6
            q, cost, normal, right = tried, new_cost, new_normal, new_right
            damping *= 0.2
            if small:
                break
        else:
            damping *= 5.0
            if damping > 1e8:
                break
    return q, cost / (count - 9), normal


@compiled
def _between(distance: float, blur: float, edges: Array, shares: Array, slopes: Array) -> None:
    """Shares of the areas between soft edges at a distance, and the slopes of the edges' steps.

    Args:
        distance: of a pixel from the first edge, px.
        blur: of the edges, px.
        edges: (L,) their distances.
        shares: (L + 1,) to fill in; they sum to 1.
        slopes: (L, 2) to fill in: half the slope of a step by the distance and by the blur, times
            the blur.
    """
    last = 1.0
    for k in range(edges.shape[0]):
        at = (distance - edges[k]) / blur
        step, slope = 1.0 if at > 0.0 else -1.0, 0.0
        if -_SHARP < at < _SHARP:
            step, slope = math.erf(at), 0.5 * _TWO_OVER_ROOT_PI * math.exp(-at * at)
            slopes[k, 1] = -slope * at
        else:
            slopes[k, 1] = 0.0
        slopes[k, 0] = slope
        shares[k] = 0.5 * (last - step)
        last = step
    shares[edges.shape[0]] = 0.5 * (last + 1.0)


@compiled
def _equations(
    window: Array,
    used: NDArray[np.bool_],
    places: Array,
    edges: tuple[Array, Array],
    shades: Array,
    q: Array,
) -> tuple[float, Array, Array]:
    """Sum of squared residuals, and the normal equations."""
    cost, normal, right = 0.0, np.zeros((9, 9)), np.zeros((9, 1))
    slope = np.empty(9)
    down_edges, along_edges = edges
    high, wide = len(down_edges), len(along_edges)
    rows, columns = np.empty(high + 1), np.empty(wide + 1)
    by_rows, by_columns = np.empty((high, 2)), np.empty((wide, 2))
    of_row, of_column = np.empty(high + 1), np.empty(wide + 1)
    c1, s1, c2, s2 = math.cos(q[2]), math.sin(q[2]), math.cos(q[3]), math.sin(q[3])
    blur = q[4] if abs(q[4]) > 1e-3 else 1e-3
    scale = q[5] / blur
    for j in range(window.shape[0]):
        for i in range(window.shape[1]):
            if not used[j, i]:
                continue
            # The window's first pixel is _HALF_PX before the pixel that holds the start.
            across, down = float(i - _HALF_PX), float(j - _HALF_PX)
            x, y = places[j, i, 0] - q[0], places[j, i, 1] - q[1]
            _between(x * c1 + y * s1, blur, down_edges, rows, by_rows)
            _between(x * c2 + y * s2, blur, along_edges, columns, by_columns)
            value = 0.0
            of_column[:] = 0.0
            for a in range(high + 1):
                of_row[a] = 0.0
                for b in range(wide + 1):
                    of_row[a] += shades[a, b] * columns[b]
                    of_column[b] += shades[a, b] * rows[a]
                value += rows[a] * of_row[a]
            one, two, by_blur = 0.0, 0.0, 0.0
            for k in range(high):
                step = of_row[k + 1] - of_row[k]
                one += step * by_rows[k, 0]
                by_blur += step * by_rows[k, 1]
            for k in range(wide):
                step = of_column[k + 1] - of_column[k]
                two += step * by_columns[k, 0]
                by_blur += step * by_columns[k, 1]
            slope[0] = -(one * c1 + two * c2) * scale
            slope[1] = -(one * s1 + two * s2) * scale
            slope[2] = one * (y * c1 - x * s1) * scale
            slope[3] = two * (y * c2 - x * s2) * scale
            slope[4] = by_blur * scale
            slope[5] = value
            slope[6], slope[7], slope[8] = 1.0, across, down
            miss = q[6] + q[7] * across + q[8] * down + q[5] * value - window[j, i]
            cost += miss * miss
            for a in range(9):
                right[a, 0] += slope[a] * miss
                for b in range(a, 9):
                    normal[a, b] += slope[a] * slope[b]
    for a in range(9):
        for b in range(a):
            normal[a, b] = normal[b, a]
    return cost, normal, right
