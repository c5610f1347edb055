"""Where a view shows each point of a surface, how well, and what it shows there: kernels."""

import math

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.compiled import compiled
from alice_survey.core.frames import Array
from reconstruct.views.range_shift import FAST, KernelLens, Nodes, between_nodes, warped_at

Float32 = NDArray[np.float32]

_TAPS = 8
_FRACTIONS = 1024


@compiled(error_model="numpy", fastmath=FAST)
def visible_cells(
    height: Float32,
    camera_enu: Array,
    west: float,
    north: float,
    cell: float,
    tolerance: float,
    part: tuple[int, int, int, int],
) -> NDArray[np.bool_]:
    """Which cells of a DEM a camera sees over the DEM itself.

    From each cell's centre the line to the camera is followed, cell by cell, until it is above
    all of the DEM; the DEM hides the cell where it rises above the line by more than a tolerance.

    Args:
        height: (H, W) up, NaN where unknown (there nothing hides).
        camera_enu: (3,) the camera's centre, in the coordinates of the DEM.
        west: east coordinate of the first column's outer edge.
        north: north coordinate of the first row's outer edge.
        cell: side of a cell.
        tolerance: in the unit of height.
        part: first row, last row and one, first column, last column and one of the cells to ask
            for; all of the DEM may hide them.

    Returns:
        (H, W); False where the height is unknown and beyond the part.
    """
    rows, columns = height.shape
    visible = np.zeros((rows, columns), np.bool_)
    top = -np.inf
    for row in range(rows):
        for column in range(columns):
            if height[row, column] > top:
                top = height[row, column]
    camera_column = (camera_enu[0] - west) / cell - 0.5
    camera_row = (north - camera_enu[1]) / cell - 0.5
    for row in range(part[0], part[1]):
        for column in range(part[2], part[3]):
            h = height[row, column]
            if math.isnan(h) or h >= camera_enu[2]:
                continue
            right, down = camera_column - column, camera_row - row
            steps = max(abs(right), abs(down))
            hidden = False
            if steps >= 1.0:
                rise = (camera_enu[2] - h) / steps
                right, down = right / steps, down / steps
                last = min(steps, (top - h) / rise)
                for n in range(1, math.floor(last) + 1):
                    r = math.floor(row + down * n + 0.5)
                    c = math.floor(column + right * n + 0.5)
                    if r < 0 or c < 0 or r >= rows or c >= columns:
                        break
                    if height[r, c] > h + rise * n + tolerance:
                        hidden = True
                        break
            visible[row, column] = not hidden
    return visible


@compiled(error_model="numpy", fastmath=FAST)
def look_up(
    height: Float32,
    requested: tuple[NDArray[np.bool_], int],
    visible: NDArray[np.bool_],
    first_cell: tuple[float, float],
    cells_per_pixel: float,
    cam_from_enu: Array,
    lens: KernelLens,
    warped_size: tuple[int, int],
    taken: Nodes,
    size: tuple[int, int],
    first_enu: tuple[float, float],
    pixel: float,
    rim: float,
) -> tuple[Float32, Float32, Float32, Float32]:
    """Where the picture as taken shows each pixel of a tile, and how well.

    A point goes through the port to the warped picture and from there to the picture as taken, so
    that colours are resampled once. The quality is the distance from the rim of the picture (1 in
    the middle, 0 at the rim) times the cosine of the angle to the vertical over the distance
    squared, so that the middle of near, steep views wins.

    Args:
        height: (H, W) up at the pixels' centres, NaN where unknown.
        requested: (h, w) whether to look at squares of pixels, and their side; beyond the last
            square the last one sees.
        visible: cells of the DEM that the view sees.
        first_cell: row and column of the first pixel's centre in `visible` (cell centres whole).
        cells_per_pixel: side of a pixel over side of a cell.
        cam_from_enu: (3, 4) transform to the camera.
        lens: of the view, or of a channel of it.
        warped_size: width and height of the warped picture, px.
        taken: pixels as taken at nodes spread evenly over the warped picture; NaN where there are
            none.
        size: width and height of the picture as taken, px.
        first_enu: east and north of the first pixel's centre.
        pixel: side of a pixel.
        rim: pixels of the picture at its edges that are not used.

    Returns:
        (H, W) x and y in OpenCV's pixels (-1 where not seen), the quality (0 where not seen) and
        the distance from the pinhole's centre (NaN where not seen).
    """
    rows, columns = height.shape
    x = np.full((rows, columns), -1.0, np.float32)
    y = np.full((rows, columns), -1.0, np.float32)
    quality = np.zeros((rows, columns), np.float32)
    ranges = np.full((rows, columns), np.nan, np.float32)
    t = cam_from_enu
    half = 0.5 * min(size[0], size[1])
    squares, side = requested
    pinhole, field, inverse_working = lens  # out of the loop: taking it apart costs time
    for row in range(rows):
        north = first_enu[1] - row * pixel
        cell_row = math.floor(first_cell[0] + row * cells_per_pixel + 0.5)
        if cell_row < 0 or cell_row >= visible.shape[0]:
            continue
        square_row = min(row // side, squares.shape[0] - 1)
        for column in range(columns):
            if not squares[square_row, min(column // side, squares.shape[1] - 1)]:
                continue
            up = height[row, column]
            if math.isnan(up):
                continue
            cell_column = math.floor(first_cell[1] + column * cells_per_pixel + 0.5)
            if cell_column < 0 or cell_column >= visible.shape[1]:
                continue
            if not visible[cell_row, cell_column]:
                continue
            east = first_enu[0] + column * pixel
            c = t[2, 0] * east + t[2, 1] * north + t[2, 2] * up + t[2, 3]
            if c <= 0.0:
                continue
            a = t[0, 0] * east + t[0, 1] * north + t[0, 2] * up + t[0, 3]
            b = t[1, 0] * east + t[1, 1] * north + t[1, 2] * up + t[1, 3]
            inverse = 1.0 / c
            u = pinhole[0] * a * inverse + pinhole[2]
            v = pinhole[1] * b * inverse + pinhole[3]
            u, v = warped_at(field, inverse_working, u, v, inverse)
            if u < 0.0 or v < 0.0 or u > warped_size[0] or v > warped_size[1]:
                continue
            u, v, _, _, _, _ = between_nodes(taken, u, v)
            inset = min(min(u, size[0] - u), min(v, size[1] - v)) - rim
            if not inset > 0.0:  # NaN as well
                continue
            distance = math.sqrt(a * a + b * b + c * c)
            # the camera's height over the point, along the third row of enu_from_cam
            cosine = -(t[0, 2] * a + t[1, 2] * b + t[2, 2] * c) / distance
            if cosine <= 0.05:
                continue
            x[row, column] = u - 0.5
            y[row, column] = v - 0.5
            quality[row, column] = inset / half * cosine / (distance * distance)
            ranges[row, column] = distance
    return x, y, quality, ranges


def lanczos_weights() -> Float32:
    """(fractions, taps) of Lanczos' kernel of 4 lobes, each row with the sum 1.

    Row n is for a place n / fractions beyond the fourth of the eight samples.
    """
    fraction = np.arange(_FRACTIONS + 1) / _FRACTIONS
    offset = fraction[:, None] - (np.arange(_TAPS) - (_TAPS // 2 - 1))
    weights = np.sinc(offset) * np.sinc(offset / (_TAPS // 2))
    rows: Float32 = (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)
    return rows


@compiled
def sample_lanczos(
    picture: NDArray[np.uint8], table: Float32, weights: Float32, x: Float32, y: Float32,
    first: int, last: int, out: Float32,
) -> None:  # fmt: skip
    """Values of a picture at places, linear light, by Lanczos' kernel; edges are repeated.

    `cv2.remap` rounds places to 1/32 px; this one to 1/1024.

    Args:
        picture: (H, W, 3).
        table: (256,) light of each level.
        weights: `lanczos_weights`.
        x: (h, w) columns, the first pixel's centre is 0; negative where nothing is wanted.
        y: (h, w) rows.
        first: channel to start with.
        last: channel before which to stop.
        out: (h, w, 3), changed in place in those channels where something is wanted.
    """
    rows, columns = x.shape
    high, wide = picture.shape[0] - 1, picture.shape[1] - 1
    steps = weights.shape[0] - 1
    for row in range(rows):
        for column in range(columns):
            px, py = x[row, column], y[row, column]
            if px < 0.0:
                continue
            left, top = int(px), int(py)
            across = weights[int((px - left) * steps + np.float32(0.5))]
            down = weights[int((py - top) * steps + np.float32(0.5))]
            left -= _TAPS // 2 - 1
            top -= _TAPS // 2 - 1
            inside = left >= 0 and top >= 0 and left + _TAPS <= wide + 1 and top + _TAPS <= high + 1
            if inside and last - first == 3:
                blue, green, red = np.float32(0.0), np.float32(0.0), np.float32(0.0)
                for j in range(_TAPS):
                    line = picture[top + j]
                    b, g, r = np.float32(0.0), np.float32(0.0), np.float32(0.0)
                    for i in range(_TAPS):
                        b += across[i] * table[line[left + i, 0]]
                        g += across[i] * table[line[left + i, 1]]
                        r += across[i] * table[line[left + i, 2]]
                    blue += down[j] * b
                    green += down[j] * g
                    red += down[j] * r
                out[row, column, 0] = max(blue, np.float32(0.0))
                out[row, column, 1] = max(green, np.float32(0.0))
                out[row, column, 2] = max(red, np.float32(0.0))
                continue
            for channel in range(first, last):
                total = np.float32(0.0)
                for j in range(_TAPS):
                    one = np.float32(0.0)
                    n = min(max(top + j, 0), high)
                    for i in range(_TAPS):
                        at = min(max(left + i, 0), wide)
                        one += across[i] * table[picture[n, at, channel]]
                    total += down[j] * one
                out[row, column, channel] = max(total, np.float32(0.0))
