"""Pixels of warped pictures and points before the camera, exact through a flat port, in kernels.

A view's lens is what `lens_of` makes of it: four numbers of the pinhole, and the field with which
the port shifts pixels as the depth departs from that of the warp (zeros without a port).
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from alice_survey.frames import Array
from reconstruct.lenses.range_shift import field_at, ideal_pixel
from reconstruct.model import View

KernelLens = tuple[Array, tuple[NDArray[np.float64], float, float, float]]
"""(4,) fx, fy, cx, cy in pixels, and a view's `shift_arguments`."""


_ROUNDS = 2
"""Of the fixed-point iteration to a warped pixel. Each divides the miss by 10 at a quarter of the
working depth and by 100 near it, so that of a shift of a pixel 0.01 and 0.0001 px remain."""


def lens_of(view: View) -> KernelLens:
    """What the kernels below take of a view."""
    return pinhole_of(view), view.shift_arguments


def pinhole_of(view: View) -> Array:
    """(4,) fx, fy, cx, cy of a view, px."""
    return np.array([view.fx_px, view.fy_px, view.cx_px, view.cy_px])


@njit(cache=True)  # type: ignore[untyped-decorator]
def slope_at(lens: KernelLens, x: float, y: float, inverse_depth: float) -> tuple[float, float]:
    """Slopes x/z, y/z of the spot at an inverse depth that the warped picture shows at (x, y)."""
    pinhole, shift = lens
    u, v = ideal_pixel(shift[0], shift[1], shift[2], shift[3], x, y, inverse_depth)
    return (u - pinhole[2]) / pinhole[0], (v - pinhole[3]) / pinhole[1]


@njit(cache=True)  # type: ignore[untyped-decorator]
def pixel_at(lens: KernelLens, x: float, y: float, z: float) -> tuple[float, float]:
    """The warped picture's pixel of a point before the camera (z > 0)."""
    pinhole, shift = lens
    u = pinhole[0] * x / z + pinhole[2]
    v = pinhole[1] * y / z + pinhole[3]
    if shift[3] == 0.0:
        return u, v
    step = 1.0 / z - shift[3]
    at_x, at_y = u, v
    for _ in range(_ROUNDS):
        a, b = field_at(shift[0], shift[1], shift[2], at_x, at_y)
        at_x, at_y = u - a * step, v - b * step
    return at_x, at_y
