"""What a warp to one pinhole leaves of the refraction, exact at every distance, in kernels.

The ray of a pixel misses the pinhole's centre by an offset s and runs straight through the water
(see `camera_calib.approximation.pinhole_warp`). A picture that is warped to be right at the working
depth z0 therefore shows the spot at depth z that the pinhole sees at

    ideal = warped + A(warped) (1/z - 1/z0),   A = f s,

without any approximation: one field of vectors over the picture, in pixel metres, describes it. The
map can be inverted as long as the field changes slowly: `RangeShift.contraction` below 1.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.compiled import compiled
from alice_survey.core.frames import Array
from camera_calib.approximation.pinhole_warp import PinholeWarp

FAST = {"contract", "reassoc", "nsz", "arcp"}
"""What the compiler may do to sums and quotients in kernels; NaN and infinity keep their sense."""

_COLUMNS = 129
"""Nodes along the picture's width; fewer along its height."""
_MAX_STEPS, _STILL_PX = 6, 0.1
"""Newton's steps to a warped pixel: the error after one is the square of its length times half the
field's curvature, below 1e-4 px after one that is shorter than this."""

Nodes = tuple[NDArray[np.float64], float, float]
"""(rows, columns, 2) values at nodes spread evenly over a picture, the first and last on its outer
edges, and nodes per pixel along x and y."""
KernelLens = tuple[Array, Nodes, float]
"""(4,) fx, fy, cx, cy in pixels; the field of a view's `RangeShift`; and 1/z0, zero where nothing
shifts."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RangeShift:
    """The field A of one camera, and the depth at which its pictures are exact."""

    nodes: NDArray[np.float64]
    """(rows, columns, 2) pixels times unit of length, at nodes spread evenly over the warped
    picture, the first and last on its outer edges."""
    width_px: float
    height_px: float
    inverse_working: float
    """1/z0, per unit of length; depths count from the pinhole's centre along its axis."""

    def ideal(self, warped: Array, depth: Array | float) -> Array:
        """Pixels (N, 2) where the pinhole sees what the warped picture shows at pixels (N, 2).

        Args:
            warped: pixels of the warped picture.
            depth: (N,) of the spot before the pinhole's centre; NaN or infinite as known.
        """
        return self._move_all(warped, depth, inverse=False)

    def warp(self, ideal: Array, depth: Array | float) -> Array:
        """The inverse of `ideal`."""
        return self._move_all(ideal, depth, inverse=True)

    def contraction(self, depth: Array) -> Array:
        """How much the shift of a pixel changes with the pixel at depths, (N,); largest of all.

        Below 1 no two pixels show one spot, so that `warped` exists; a fixed-point iteration
        through the port gains this factor in each round.
        """
        rows, columns = self.nodes.shape[:2]
        by_y, by_x = np.gradient(
            self.nodes, self.height_px / (rows - 1), self.width_px / (columns - 1), axis=(0, 1)
        )
        steepest = np.linalg.norm(np.stack([by_x, by_y], axis=-1), ord=2, axis=(2, 3)).max()
        return np.asarray(steepest * np.abs(1.0 / depth - self.inverse_working))

    def scale(self, sx: float, sy: float) -> "RangeShift":
        """The same field for a picture that is made smaller by a factor along x and y.

        Views that share a field share the smaller one, in memory and in what goes to processes.
        """
        return _scale(self, sx, sy)

    @property
    def field(self) -> Nodes:
        """The field as kernels take it."""
        return as_nodes(self.nodes, self.width_px, self.height_px)

    def _move_all(self, pixels: Array, depth: Array | float, *, inverse: bool) -> Array:
        pixels = np.ascontiguousarray(pixels, dtype=np.float64)
        per_depth = 1.0 / np.broadcast_to(np.asarray(depth, dtype=np.float64), len(pixels))
        return _move(self.field, self.inverse_working, pixels, per_depth, inverse)


@lru_cache(maxsize=16)
def _scale(shift: RangeShift, sx: float, sy: float) -> RangeShift:
    return replace(
        shift,
        nodes=shift.nodes * [sx, sy],
        width_px=shift.width_px * sx,
        height_px=shift.height_px * sy,
    )


def as_nodes(values: NDArray[np.float64], width_px: float, height_px: float) -> Nodes:
    """Values (rows, columns, 2) over a picture as kernels take them."""
    rows, columns = values.shape[:2]
    return values, (columns - 1) / width_px, (rows - 1) / height_px


def range_shift(warp: PinholeWarp) -> RangeShift:
    """The field of a warp, lengths in metres."""
    width, height = warp.pinhole.size_px
    if warp.largest_offset_m == 0.0:
        return no_shift(width, height)
    rows = max(2, round((_COLUMNS - 1) * height / width) + 1)
    x, y = np.linspace(0.0, width, _COLUMNS), np.linspace(0.0, height, rows)
    _, offset = warp.lines(warp.from_pinhole(np.stack(np.meshgrid(x, y), axis=-1)))
    return RangeShift(
        nodes=fill_holes(offset * warp.pinhole.numbers[:2]),
        width_px=float(width),
        height_px=float(height),
        inverse_working=1.0 / warp.working_depth_m,
    )


def no_shift(width_px: int, height_px: int) -> RangeShift:
    """The field of a camera of one centre, or of a model whose lengths are not known."""
    return RangeShift(
        nodes=np.zeros((2, 2, 2)),
        width_px=float(width_px),
        height_px=float(height_px),
        inverse_working=0.0,
    )


def fill_holes(field: Array) -> Array:
    """A field (H, W) or (H, W, 2) whose unknown nodes have the value of the nearest known one."""
    from scipy.ndimage import distance_transform_edt

    unknown = ~np.isfinite(field).reshape(*field.shape[:2], -1).all(axis=2)
    find: Any = distance_transform_edt
    return np.asarray(field[tuple(find(unknown, return_distances=False, return_indices=True))])


@compiled(error_model="numpy", fastmath=FAST)
def between_nodes(
    values: Nodes, x: float, y: float
) -> tuple[float, float, float, float, float, float]:
    """Two values at a pixel, bilinear between nodes, then their slopes along x and y.

    Beyond the picture the values are those of its nearest edge, and constant.
    """
    nodes, across, down = values
    rows, columns = nodes.shape[0], nodes.shape[1]
    u, v = x * across, y * down
    column = min(max(0, int(u)), columns - 2)
    row = min(max(0, int(v)), rows - 2)
    p, q = min(max(0.0, u - column), 1.0), min(max(0.0, v - row), 1.0)
    if p != u - column:
        across = 0.0
    if q != v - row:
        down = 0.0
    a, b = nodes[row, column, 0], nodes[row, column, 1]
    a_x, b_x = nodes[row, column + 1, 0] - a, nodes[row, column + 1, 1] - b
    a_y, b_y = nodes[row + 1, column, 0] - a, nodes[row + 1, column, 1] - b
    a_xy = nodes[row + 1, column + 1, 0] - nodes[row + 1, column, 0] - a_x
    b_xy = nodes[row + 1, column + 1, 1] - nodes[row + 1, column, 1] - b_x
    a_x, b_x = a_x + q * a_xy, b_x + q * b_xy
    return (
        a + p * a_x + q * a_y, b + p * b_x + q * b_y,
        a_x * across, (a_y + p * a_xy) * down,
        b_x * across, (b_y + p * b_xy) * down,
    )  # fmt: skip


@compiled(error_model="numpy", fastmath=FAST)
def warped_at(
    field: Nodes, inverse_working: float, u: float, v: float, inverse_depth: float
) -> tuple[float, float]:
    """The warped picture's pixel of what the pinhole sees at pixel (u, v), by Newton's method."""
    x, y = u, v
    step = inverse_depth - inverse_working
    for _ in range(0 if inverse_working == 0.0 else _MAX_STEPS):
        a, b, a_x, a_y, b_x, b_y = between_nodes(field, x, y)
        miss_x, miss_y = x + a * step - u, y + b * step - v
        a_x, b_y = 1.0 + a_x * step, 1.0 + b_y * step
        a_y, b_x = a_y * step, b_x * step
        scale = 1.0 / (a_x * b_y - a_y * b_x)
        move_x = (b_y * miss_x - a_y * miss_y) * scale
        move_y = (a_x * miss_y - b_x * miss_x) * scale
        x, y = x - move_x, y - move_y
        if not abs(move_x) + abs(move_y) > _STILL_PX:
            return x, y
    return x, y


@compiled(error_model="numpy", fastmath=FAST)
def line_of(
    pinhole: Array, field: Nodes, inverse_working: float, x: float, y: float
) -> tuple[float, float, float, float]:
    """The line of spots that a warped picture shows at a pixel, by a `KernelLens`.

    Slopes x/z and y/z at an inverse depth of zero, and how they change with it.
    """
    a, b, _, _, _, _ = between_nodes(field, x, y)
    return (
        (x - a * inverse_working - pinhole[2]) / pinhole[0],
        (y - b * inverse_working - pinhole[3]) / pinhole[1],
        a / pinhole[0],
        b / pinhole[1],
    )


@compiled(error_model="numpy", fastmath=FAST)
def carry(
    pixels: Array, depth: Array, lens: KernelLens, other_from_here: Array, other_lens: KernelLens
) -> Array:
    """Where another view shows spots, and its depth of them, (N, 3); NaN behind its camera.

    Args:
        pixels: (N, 2) that show the spots here.
        depth: (N,) of the spots here.
        lens: of this view.
        other_from_here: (3, 4) transform of points.
        other_lens: of the other view.
    """
    found, t = np.full((depth.size, 3), np.nan), other_from_here
    pinhole, field, inverse_working = other_lens
    for i in range(depth.size):
        line = line_of(lens[0], lens[1], lens[2], pixels[i, 0], pixels[i, 1])
        z = depth[i]
        x, y = z * line[0] + line[2], z * line[1] + line[3]
        c = t[2, 0] * x + t[2, 1] * y + t[2, 2] * z + t[2, 3]
        if c > 0.0:
            u = (t[0, 0] * x + t[0, 1] * y + t[0, 2] * z + t[0, 3]) / c * pinhole[0] + pinhole[2]
            v = (t[1, 0] * x + t[1, 1] * y + t[1, 2] * z + t[1, 3]) / c * pinhole[1] + pinhole[3]
            found[i, 0], found[i, 1] = warped_at(field, inverse_working, u, v, 1.0 / c)
            found[i, 2] = c
    return found


@compiled(error_model="numpy", fastmath=FAST)
def slopes_of(
    depth: NDArray[np.float32], lens: KernelLens, top: int, left: int
) -> NDArray[np.float32]:
    """Slopes x/z, y/z (H, W, 2) of the spots that a warped picture shows; NaN without depth.

    Args:
        depth: (H, W) of the view, or of a part of it.
        lens: of the view.
        top: row of the view that the part starts with.
        left: column.
    """
    pinhole, field, inverse_working = lens
    slopes = np.empty((*depth.shape, 2), np.float32)
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            x, y, by_x, by_y = line_of(
                pinhole, field, inverse_working, left + column + 0.5, top + row + 0.5
            )
            inverse = 1.0 / depth[row, column]
            slopes[row, column, 0] = x + by_x * inverse
            slopes[row, column, 1] = y + by_y * inverse
    return slopes


@compiled(error_model="numpy", fastmath=FAST)
def _move(
    field: Nodes, inverse_working: float, pixels: Array, inverse_depth: Array, inverse: bool
) -> Array:
    found = np.empty_like(pixels)
    for i in range(pixels.shape[0]):
        x, y = pixels[i, 0], pixels[i, 1]
        if inverse:
            found[i, 0], found[i, 1] = warped_at(field, inverse_working, x, y, inverse_depth[i])
        else:
            a, b, _, _, _, _ = between_nodes(field, x, y)
            step = inverse_depth[i] - inverse_working
            found[i, 0], found[i, 1] = x + a * step, y + b * step
    return found
