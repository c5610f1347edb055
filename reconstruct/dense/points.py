"""Depth maps as points with normals and colours, in local east, north, up."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.compiled import compiled
from alice_survey.core.frames import Array
from reconstruct.pictures.undistorted import WHOLE, Part
from reconstruct.views.model import View, enu_from_cam
from reconstruct.views.range_shift import FAST, KernelLens, line_of, slopes_of

Float32 = NDArray[np.float32]

_BLOCK = 16
"""Side of a block of pixels whose points are looked at together, pixels."""
_ROUNDING = 1e-6
"""Relative rounding of coordinates as float32; kernels and arrays differ by less."""
EDGE_ON = math.cos(math.radians(80.0))
"""Least cosine between a surface's normal and the way to a plane's viewer for it to be seen."""
_GRAZING = math.cos(math.radians(72.0))
"""The same of a ray: depths that lie more on edge are mostly of no surface, but of the step
between a foreground and what is behind it."""
_REACH = 2
"""Normals are spanned by the points this many pixels to either side."""


class Points(NamedTuple):
    """Points of one or more views; arrays of N rows."""

    enu: Float32
    """(N, 3) east, north, up from an offset that the caller knows."""
    normals: Float32
    """(N, 3) unit vectors towards the camera; NaN next to unknown depth, and edge-on."""
    colours: NDArray[np.uint8]
    """(N, 3) RGB."""
    sigmas: Float32
    """(N,) standard deviations along the normal, of the depth where that is unknown."""
    views: NDArray[np.int32]
    """(N,) number of the view, in ascending order."""


def part_in_box(
    view: View, offset_enu: Array, box: tuple[float, float, float, float], blocks: Float32
) -> Part | None:
    """The part of a view whose points may be in a box, and what their normals need around it.

    Args:
        view: the view.
        offset_enu: origin of the box.
        box: see `points_in_box`.
        blocks: where the view's points lie, see `block_bounds`.

    Returns:
        Rows and columns; None where no point is in the box.
    """
    meeting = _meeting(blocks, offset_enu, box)
    if not meeting.any():
        return None
    sides = []
    for axis, size in ((1, view.pinhole.height_px), (0, view.pinhole.width_px)):
        found = np.flatnonzero(meeting.any(axis=axis))
        first, last = int(found[0]) * _BLOCK - _REACH, (int(found[-1]) + 1) * _BLOCK + _REACH
        sides.append(slice(max(first, 0), min(last, size)))
    return sides[0], sides[1]


def points_in_box(
    view: View, number: int, depth: Float32, sigma: Float32, kept: NDArray[np.bool_],
    colour: NDArray[np.uint8], factors: Float32, offset_enu: Array,
    box: tuple[float, float, float, float], blocks: Float32, part: Part = WHOLE,
) -> Points:  # fmt: skip
    """The kept points of a depth map inside of a box.

    Args:
        view: that the depth belongs to.
        number: of the view.
        depth: (H, W) along the axis, of the part of the view.
        sigma: (H, W) of it.
        kept: (H, W) which pixels to take.
        colour: (H, W, 3) BGR.
        factors: (rows, columns, 3) at nodes spread over the picture, by which colours are taken.
        offset_enu: (3,) origin of the points.
        box: west, east, south, north from that origin; a point on the west or north edge is inside.
        blocks: where the view's points lie, see `block_bounds`.
        part: of the view, which `part_in_box` gives.
    """
    transform = enu_from_cam(view, offset_enu)
    frame = (part[0].start or 0, part[1].start or 0, *view.pinhole.size_px[::-1])
    found = gather(
        depth, sigma, kept, colour, factors, view.kernel_lens, transform, np.array(box),
        _meeting(blocks, offset_enu, box), frame,
    )  # fmt: skip
    return Points(*found, views=np.full(len(found[0]), number, np.int32))


def points_of_pixels(view: View, depth: Float32, chosen: NDArray[np.bool_]) -> Array:
    """World points (N, 3) that a view shows at chosen pixels (H, W) of its depth, row by row."""
    transform = np.ascontiguousarray(view.world_from_cam.as_matrix()[:3])
    found = np.empty((np.count_nonzero(chosen), 3))
    _place(depth, chosen, view.kernel_lens, transform, found)
    return found


@compiled(error_model="numpy", fastmath=FAST)
def _place(
    depth: Float32, chosen: NDArray[np.bool_], lens: KernelLens, transform: Array, found: Array
) -> None:
    pinhole, field, inverse_working = lens
    count = 0
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            if chosen[row, column]:
                line = line_of(pinhole, field, inverse_working, column + 0.5, row + 0.5)
                z = np.float64(depth[row, column])
                x, y = z * line[0] + line[2], z * line[1] + line[3]
                for k in range(3):
                    found[count, k] = (
                        transform[k, 0] * x + transform[k, 1] * y + transform[k, 2] * z
                    ) + transform[k, 3]
                count += 1


def block_bounds(chosen: NDArray[np.bool_], world: Array) -> Float32:
    """Between which coordinates the points of each block of pixels lie.

    Args:
        chosen: (H, W) pixels of a picture.
        world: (N, 3) their points, row by row: north, east, down.

    Returns:
        (h, w, 4) west, east, south, north, a little wide; NaN of an empty block.
    """
    height, width = (-(-size // _BLOCK) for size in chosen.shape)
    bounds = []
    margin = _ROUNDING * float(np.abs(world[:, :2]).max(initial=1.0))
    for axis in (1, 0):
        values = np.full((height * _BLOCK, width * _BLOCK), np.nan)
        values[: chosen.shape[0], : chosen.shape[1]][chosen] = world[:, axis]
        blocks = values.reshape(height, _BLOCK, width, _BLOCK)
        bounds.append(np.fmin.reduce(blocks, axis=(1, 3)) - margin)
        bounds.append(np.fmax.reduce(blocks, axis=(1, 3)) + margin)
    return np.stack(bounds, axis=-1).astype(np.float32)


def _meeting(
    blocks: Float32, offset_enu: Array, box: tuple[float, float, float, float]
) -> NDArray[np.bool_]:
    """Which blocks may hold points of a box."""
    west, east = blocks[..., 0] - offset_enu[0], blocks[..., 1] - offset_enu[0]
    south, north = blocks[..., 2] - offset_enu[1], blocks[..., 3] - offset_enu[1]
    meeting: NDArray[np.bool_] = (
        (west <= box[1]) & (east >= box[0]) & (south <= box[3]) & (north >= box[2])
    )
    return meeting


def join_points(parts: list[Points]) -> Points:
    """Points of several views as one."""
    row, rows = np.empty(0, np.float32), np.empty((0, 3), np.float32)
    none = Points(rows, rows, rows.astype(np.uint8), row, row.astype(np.int32))
    return Points(*map(np.concatenate, zip(none, *parts, strict=True)))


@compiled(error_model="numpy", fastmath=FAST)
def gather(
    depth: Float32, sigma: Float32, kept: NDArray[np.bool_], colour: NDArray[np.uint8],
    factors: Float32, lens: KernelLens, enu_from_cam: Array, box: Array, meeting: NDArray[np.bool_],
    frame: tuple[int, int, int, int],
) -> tuple[Float32, Float32, NDArray[np.uint8], Float32]:  # fmt: skip
    """Points, normals, colours (RGB) and standard deviations of pixels whose point is in a box.

    Errors of the depth move a point along its ray; along the normal they count with the cosine
    between the two.

    Args:
        depth: (H, W) along the axis, of a part of the picture, NaN where unknown.
        sigma: (H, W) of it.
        kept: (H, W) which pixels to take.
        colour: (H, W, 3) BGR.
        factors: (rows, columns, 3) at nodes spread over the picture, BGR.
        lens: of the view.
        enu_from_cam: (3, 4) transform.
        box: (4,) west, east, south, north.
        meeting: (h, w) blocks of pixels of which any may be in the box.
        frame: row and column of the picture that the part starts with, and the picture's height and
            width.

    Returns:
        (N, 3), (N, 3), (N, 3), (N,), row by row; a normal is NaN next to unknown depth, and where
        the surface is seen edge-on.
    """
    height, width = depth.shape
    top, left, whole_height, whole_width = frame
    t = enu_from_cam
    slopes = slopes_of(depth, lens, top, left)
    enu = np.empty((height * width, 3), np.float32)
    pixels = np.empty((height * width, 2), np.int32)
    count = 0
    for row in range(height):
        for column in range(width):
            block = meeting[(top + row) // _BLOCK, (left + column) // _BLOCK]
            if not (block and kept[row, column]):
                continue
            z = depth[row, column]
            x, y = slopes[row, column, 0], slopes[row, column, 1]
            east = z * (t[0, 0] * x + t[0, 1] * y + t[0, 2]) + t[0, 3]
            north = z * (t[1, 0] * x + t[1, 1] * y + t[1, 2]) + t[1, 3]
            if east < box[0] or east >= box[1] or north <= box[2] or north > box[3]:
                continue
            enu[count, 0] = east
            enu[count, 1] = north
            enu[count, 2] = z * (t[2, 0] * x + t[2, 1] * y + t[2, 2]) + t[2, 3]
            pixels[count, 0] = row
            pixels[count, 1] = column
            count += 1
    normals = np.full((count, 3), np.nan, np.float32)
    colours = np.empty((count, 3), np.uint8)
    sigmas = np.empty(count, np.float32)
    for i in range(count):
        row, column = int(pixels[i, 0]), int(pixels[i, 1])
        sigmas[i] = sigma[row, column]
        place = (top + row + 0.5) / whole_height * (factors.shape[0] - 1)
        node_row = min(int(place), factors.shape[0] - 2)
        p = place - node_row
        place = (left + column + 0.5) / whole_width * (factors.shape[1] - 1)
        node = min(int(place), factors.shape[1] - 2)
        q = place - node
        for k in range(3):
            above = factors[node_row, node, k] * (1 - q) + factors[node_row, node + 1, k] * q
            below = (
                factors[node_row + 1, node, k] * (1 - q) + factors[node_row + 1, node + 1, k] * q
            )
            level = colour[row, column, k] * (above * (1 - p) + below * p)
            colours[i, 2 - k] = min(255, int(level + 0.5))
        n0, n1, n2, length = _normal(depth, slopes, row, column)
        if length > 0.0:
            x, y = slopes[row, column, 0], slopes[row, column, 1]
            along = abs(x * n0 + y * n1 + n2) / length
            if along < _GRAZING * math.sqrt(x * x + y * y + 1.0):
                continue
            sigmas[i] *= along
            for k in range(3):
                normals[i, k] = (t[k, 0] * n0 + t[k, 1] * n1 + t[k, 2] * n2) / length
    return enu[:count].copy(), normals, colours, sigmas


@compiled(error_model="numpy", fastmath=FAST)
def _normal(
    depth: Float32, slopes: Float32, row: int, column: int
) -> tuple[float, float, float, float]:
    """The normal of a pixel, in the camera, and its length: 0 or NaN where it is not known."""
    up, down = row - _REACH, row + _REACH
    left, right = column - _REACH, column + _REACH
    if up < 0 or left < 0 or down >= depth.shape[0] or right >= depth.shape[1]:
        return 0.0, 0.0, 0.0, 0.0
    west, east = depth[row, left], depth[row, right]
    north, south = depth[up, column], depth[down, column]
    a2, b2 = np.float64(east) - np.float64(west), np.float64(south) - np.float64(north)
    a0 = np.float64(slopes[row, right, 0] * east) - np.float64(slopes[row, left, 0] * west)
    a1 = np.float64(slopes[row, right, 1] * east) - np.float64(slopes[row, left, 1] * west)
    b0 = np.float64(slopes[down, column, 0] * south) - np.float64(slopes[up, column, 0] * north)
    b1 = np.float64(slopes[down, column, 1] * south) - np.float64(slopes[up, column, 1] * north)
    n0, n1, n2 = b1 * a2 - b2 * a1, b2 * a0 - b0 * a2, b0 * a1 - b1 * a0
    return n0, n1, n2, math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
