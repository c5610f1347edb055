"""Pixels of warped pictures and points before the camera, exact through a flat port, in kernels.

A view's lens is what `lens_of` returns: four numbers of the pinhole, and the field with which
the port shifts pixels as the depth departs from that of the warp (zeros without a port).
"""

import numpy as np
from numpy.typing import NDArray

from alice_survey.base.compiled import compiled
from alice_survey.base.frames import Array
from reconstruct.views.model import View

FAST = {"contract", "reassoc", "nsz", "arcp"}
"""What the compiler may do to sums and quotients in kernels; NaN and infinity keep their sense."""

KernelLens = tuple[Array, tuple[NDArray[np.float64], float, float, float]]
"""(4,) fx, fy, cx, cy in pixels, and a view's `shift_arguments`."""


_ROUNDS = 2
"""Rounds of the fixed-point iteration to a warped pixel. Each divides the miss by 10 at a quarter
of the working depth and by 100 near it, so that of a shift of a pixel 0.01 and 0.0001 px remain."""


def lens_of(view: View) -> KernelLens:
    """A view's arguments for the kernels below."""
    return pinhole_of(view), view.shift_arguments


def pinhole_of(view: View) -> Array:
    """(4,) fx, fy, cx, cy of a view, px."""
    return np.array([view.fx_px, view.fy_px, view.cx_px, view.cy_px])


@compiled(error_model="numpy", fastmath=FAST)
def field_of(lens: KernelLens, x: float, y: float) -> tuple[float, float]:
    """`range_shift.field_at` of a lens, compiled so that loops over pixels share its quotients."""
    nodes, width_px, height_px, _ = lens[1]
    rows, columns = nodes.shape[0], nodes.shape[1]
    u = min(max(x * ((columns - 1) / width_px), 0.0), columns - 1.0)
    v = min(max(y * ((rows - 1) / height_px), 0.0), rows - 1.0)
    column, row = min(int(u), columns - 2), min(int(v), rows - 2)
    p, q = u - column, v - row
    a, b, c, d = (1 - p) * (1 - q), p * (1 - q), (1 - p) * q, p * q
    return (
        a * nodes[row, column, 0] + b * nodes[row, column + 1, 0]
        + c * nodes[row + 1, column, 0] + d * nodes[row + 1, column + 1, 0],
        a * nodes[row, column, 1] + b * nodes[row, column + 1, 1]
        + c * nodes[row + 1, column, 1] + d * nodes[row + 1, column + 1, 1],
    )  # fmt: skip


@compiled(error_model="numpy", fastmath=FAST)
def slopes_of(depth: NDArray[np.float32], lens: KernelLens) -> NDArray[np.float32]:
    """Slopes x/z, y/z (H, W, 2) of the spots that a warped picture shows; NaN without depth.

    Nodes are blended once a row, so that a pixel takes only one step along it.

    Args:
        depth: (H, W) of the view.
        lens: of the view.
    """
    pinhole, (nodes, width_px, height_px, inverse_working) = lens
    height, width = depth.shape
    rows, columns = nodes.shape[0], nodes.shape[1]
    slopes = np.empty((height, width, 2), np.float32)
    line = np.empty((columns, 2))
    for row in range(height):
        v = (row + 0.5) * ((rows - 1) / height_px)
        above = min(int(v), rows - 2)
        q = v - above
        for node in range(columns):
            for k in range(2):
                line[node, k] = (1 - q) * nodes[above, node, k] + q * nodes[above + 1, node, k]
        for column in range(width):
            u = (column + 0.5) * ((columns - 1) / width_px)
            left = min(int(u), columns - 2)
            p = u - left
            step = 1.0 / depth[row, column] - inverse_working
            x = column + 0.5 + step * ((1 - p) * line[left, 0] + p * line[left + 1, 0])
            y = row + 0.5 + step * ((1 - p) * line[left, 1] + p * line[left + 1, 1])
            slopes[row, column, 0] = (x - pinhole[2]) / pinhole[0]
            slopes[row, column, 1] = (y - pinhole[3]) / pinhole[1]
    return slopes


@compiled(error_model="numpy", fastmath=FAST)
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
        a, b = field_of(lens, at_x, at_y)
        at_x, at_y = u - a * step, v - b * step
    return at_x, at_y
