"""The last steps of a pixel of the mosaic, in one pass over a part of a tile."""

import math

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.compiled import compiled
from reconstruct.light.water import MIN_LEFT
from reconstruct.mosaic.picture_measures import encoded

Float32 = NDArray[np.float32]

MIN_RANGE, MAX_RANGE = np.float32(0.2), np.float32(5.0)
"""Factors by which light is changed at least and at most for its distance."""
_ROOT_STEPS = np.float32(2048)
_BRIGHTEST_ROOT = 2.0


def curve_by_root() -> Float32:
    """Levels of light at even steps of its root, up to four times white: for `finish_colours`.

    The sRGB curve is nearly straight over the root of light, so that lines between the steps are
    within 0.01 levels of it.
    """
    root = np.arange(int(_BRIGHTEST_ROOT * _ROOT_STEPS) + 2) / float(_ROOT_STEPS)
    return encoded((root**2).astype(np.float32))


@compiled
def finish_colours(
    light: Float32,
    places: tuple[Float32, Float32],
    ranges: Float32,
    nodes: Float32,
    law: Float32,
    size: tuple[int, int],
    factor: Float32,
    first_factor: tuple[float, float],
    factors_per_pixel: float,
    curve: Float32,
) -> None:
    """Turn the light that a picture shows into levels of the mosaic, in place.

    What `ColourModel.corrected` and `encoded` do to whole pictures, and the factors by which broad
    tones are made to meet, in one go.

    Args:
        light: (h, w, 3) BGR.
        places: (h, w) each: x and y in OpenCV's pixels of the picture; negative where not seen
            (nothing is done there).
        ranges: (h, w); NaN counts as the middle one.
        nodes: (rows, columns, 6) factors, and light to take away first, BGR each, at nodes spread
            evenly over the picture.
        law: (14,) by how much the logarithm of BGR falls for each unit of range, the middle range,
            light that is black, BGR, factors of the rest, BGR, coefficients with which the light
            taken away grows with range, BGR, and the power of range by which light spreads.
        size: width and height of the picture as taken, px.
        factor: (H, W, 3) at the middles of cells.
        first_factor: row and column of the first pixel's centre in `factor`.
        factors_per_pixel: side of a pixel over side of a cell.
        curve: levels at even steps of the root of light, from 0; `curve_by_root`.
    """
    rows, columns = ranges.shape
    x, y = places
    high, wide = nodes.shape[0] - 2, nodes.shape[1] - 2
    f_high, f_wide = factor.shape[0] - 1, factor.shape[1] - 1
    weakened = law[0] != 0.0 or law[1] != 0.0 or law[2] != 0.0
    growing = law[10] != 0.0 or law[11] != 0.0 or law[12] != 0.0
    whole = np.ones(3, np.float32)
    if growing:
        for c in range(3):
            whole[c] = math.expm1(-law[10 + c] * law[3])
    node_x, node_y = np.float32((wide + 1) / size[0]), np.float32((high + 1) / size[1])
    half = np.float32(0.5)
    top_root = np.float32(len(curve) - 1) / _ROOT_STEPS
    for row in range(rows):
        v = min(max(first_factor[0] + row * factors_per_pixel, 0.0), f_high)
        f_row = min(int(v), max(f_high - 1, 0))
        f_below = min(f_row + 1, f_high)
        f_q = np.float32(v - f_row)
        for column in range(columns):
            if x[row, column] < 0.0:
                continue
            u = min(max((x[row, column] + half) * node_x, np.float32(0.0)), np.float32(wide + 1))
            w = min(max((y[row, column] + half) * node_y, np.float32(0.0)), np.float32(high + 1))
            left, top = min(int(u), wide), min(int(w), high)
            p, q = u - np.float32(left), w - np.float32(top)
            u2 = min(max(first_factor[1] + column * factors_per_pixel, 0.0), f_wide)
            f_left = min(int(u2), max(f_wide - 1, 0))
            f_right = min(f_left + 1, f_wide)
            f_p = np.float32(u2 - f_left)
            distance = ranges[row, column]
            if math.isnan(distance):
                distance = law[3]
            spread = np.float32(1.0)
            if law[13] != 0.0:
                spread = np.float32((distance / law[3]) ** law[13])
            for c in range(3):
                above = nodes[top, left, c] * (1 - p) + nodes[top, left + 1, c] * p
                below = nodes[top + 1, left, c] * (1 - p) + nodes[top + 1, left + 1, c] * p
                lift = above * (1 - q) + below * q
                above = nodes[top, left, c + 3] * (1 - p) + nodes[top, left + 1, c + 3] * p
                below = nodes[top + 1, left, c + 3] * (1 - p) + nodes[top + 1, left + 1, c + 3] * p
                added = above * (1 - q) + below * q
                above = factor[f_row, f_left, c] * (1 - f_p) + factor[f_row, f_right, c] * f_p
                below = factor[f_below, f_left, c] * (1 - f_p) + factor[f_below, f_right, c] * f_p
                shown = light[row, column, c]
                if growing:
                    added *= np.float32(math.expm1(-law[10 + c] * distance)) / whole[c]
                shown = max(shown - added, MIN_LEFT * shown)
                shown *= lift * (above * (1 - f_q) + below * f_q)
                if weakened:
                    farther = np.float32(math.exp(law[c] * (distance - law[3]))) * spread
                    if farther < MIN_RANGE:
                        farther = MIN_RANGE
                    if farther > MAX_RANGE:
                        farther = MAX_RANGE
                    shown *= farther
                shown = (shown - law[4 + c]) * law[7 + c]
                root = np.float32(0.0)
                if shown > 0.0:
                    root = np.float32(math.sqrt(shown))
                if root > top_root:
                    root = top_root
                root *= _ROOT_STEPS
                at = min(int(root), len(curve) - 2)
                part = root - np.float32(at)
                light[row, column, c] = curve[at] * (1 - part) + curve[at + 1] * part
