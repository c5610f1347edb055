"""Grey levels between the pixels of a picture, in kernels.

Least-squares matching of patches rests on these: cubic convolution where a patch is compared many
times from scratch, a B-spline with its slopes where a whole picture is (its prefilter is done
once); single pixels that must not be pulled towards whole ones take scipy's quintic spline.
"""

import math
from typing import Any

import numpy as np

from alice_survey.core.compiled import compiled
from reconstruct.views.range_shift import FAST

_SIXTH, _HALF, _TWO_THIRDS = np.float32(1 / 6), np.float32(0.5), np.float32(2 / 3)
_NEXT = np.uint64(1)
_ONE, _THREE_HALVES, _TWO = np.float32(1.0), np.float32(1.5), np.float32(2.0)


@compiled(error_model="numpy", fastmath=FAST)
def _across(picture: Any, left: Any, row: Any, a: float, b: float, c: float, d: float) -> float:
    """Four pixels of a row, weighted."""
    level: float = a * picture[row, left] + b * picture[row, left + _NEXT]
    left += _NEXT + _NEXT
    level += c * picture[row, left] + d * picture[row, left + _NEXT]
    return level


@compiled(error_model="numpy", fastmath=FAST)
def cubic_level(picture: Any, x: float, y: float) -> float:
    """Grey level by cubic convolution (Keys 1981); the first pixel's centre is 0, 0."""
    column, row = math.floor(x), math.floor(y)
    p, q = x - column, y - row
    a = ((-0.5 * p + 1.0) * p - 0.5) * p
    b = (1.5 * p - 2.5) * p * p + 1.0
    c = ((-1.5 * p + 2.0) * p + 0.5) * p
    d = (0.5 * p - 0.5) * p * p
    left, top = np.uint64(column - 1), np.uint64(row - 1)  # unsigned: never counted from the end
    level = (((-0.5 * q + 1.0) * q - 0.5) * q) * _across(picture, left, top, a, b, c, d)
    level += ((1.5 * q - 2.5) * q * q + 1.0) * _across(picture, left, top + _NEXT, a, b, c, d)
    top += _NEXT + _NEXT
    level += (((-1.5 * q + 2.0) * q + 0.5) * q) * _across(picture, left, top, a, b, c, d)
    level += ((0.5 * q - 0.5) * q * q) * _across(picture, left, top + _NEXT, a, b, c, d)
    return level


@compiled
def is_inside(picture: Any, x: float, y: float, margin: float) -> bool:
    """Whether a place lies in a picture, this many pixels from its rim or more."""
    return bool(
        x >= margin
        and y >= margin
        and x < picture.shape[1] - margin - 1
        and y < picture.shape[0] - margin - 1
    )


@compiled(error_model="numpy", fastmath=FAST)
def spline_weights(t: np.float32) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """The four weights of a cubic B-spline at a share t of the way from the second node."""
    s = _ONE - t
    u, v = _HALF * t - _ONE, _HALF * s - _ONE
    return (
        _SIXTH * s * s * s,
        t * t * u + _TWO_THIRDS,
        s * s * v + _TWO_THIRDS,
        _SIXTH * t * t * t,
    )


@compiled(error_model="numpy", fastmath=FAST)
def spline_slopes(t: np.float32) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """How these weights change with t."""
    s = _ONE - t
    return (
        -_HALF * s * s,
        (_THREE_HALVES * t - _TWO) * t,
        (_TWO - _THREE_HALVES * s) * s,
        _HALF * t * t,
    )
