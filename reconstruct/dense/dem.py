"""The digital elevation model: one robust height per cell, positive up, with sigma and count."""

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.base.compiled import compiled
from alice_survey.base.robust import MAD_TO_SIGMA
from reconstruct.dense.points import Points
from reconstruct.raster import DemGrid

Float32 = NDArray[np.float32]

_GATE = 3.0
FILL_CELLS = 3
"""Cells that lie no farther than this from known ones on opposite sides are filled."""
STRAY_CELLS = 8
"""Reach of the square around a cell in which others must be known."""
_LEAST_COMPANY = 0.22
"""Share of that square that must be known; what is more isolated is mostly wrong."""


def fuse_points(
    grid: DemGrid, points: Points, stations: NDArray[np.int64]
) -> tuple[Float32, Float32, NDArray[np.uint16], NDArray[np.uint8]]:
    """Give each cell of a grid one height from the points that fall in it.

    Args:
        grid: cells, of which points outside are ignored, in the coordinates of the points.
        points: of all views that see the grid.
        stations: (V,) of every view, by its number.

    Returns:
        Height and standard deviation, NaN in empty cells, how many views the height rests on, and
        how many stations (255 stands for more); (rows, columns) each.
    """
    starts, order = bin_points(
        points.enu, grid.north, grid.west, grid.cell, grid.rows, grid.columns
    )
    height, sigma, count, met = fuse_cells(
        starts, points.enu[order, 2], points.sigmas[order], points.views[order], stations, _GATE
    )
    shape = (grid.rows, grid.columns)
    return height.reshape(shape), sigma.reshape(shape), count.reshape(shape), met.reshape(shape)


@compiled
def bin_points(
    points_enu: Float32, north: float, west: float, cell: float, rows: int, columns: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Sort points by the cell they fall in, keeping their order within each.

    Args:
        points_enu: (N, 3), of which those outside of the grid are left out.
        north: north coordinate of the outer edge of the first row.
        west: east coordinate of the outer edge of the first column.
        cell: side of a cell.
        rows: of the grid.
        columns: of the grid.

    Returns:
        (rows * columns + 1,) where the points of each cell start, and point numbers in that order.
    """
    starts = np.zeros(rows * columns + 1, np.int64)
    for i in range(len(points_enu)):
        row = math.floor((north - points_enu[i, 1]) / cell)
        column = math.floor((points_enu[i, 0] - west) / cell)
        if 0 <= row < rows and 0 <= column < columns:
            starts[row * columns + column + 1] += 1
    for k in range(rows * columns):
        starts[k + 1] += starts[k]
    order = np.empty(starts[-1], np.int64)
    place = starts[:-1].copy()
    for i in range(len(points_enu)):
        row = math.floor((north - points_enu[i, 1]) / cell)
        column = math.floor((points_enu[i, 0] - west) / cell)
        if 0 <= row < rows and 0 <= column < columns:
            order[place[row * columns + column]] = i
            place[row * columns + column] += 1
    return starts, order


@compiled
def sorted_ranks(values: NDArray[Any]) -> NDArray[np.int64]:
    """Indices that sort values upwards (Shell's sort, which numba compiles in no time).

    The order of equal values depends on the values alone, not on the machine.
    """
    count = values.size
    ranks = np.arange(count)
    gap = 1
    while gap < count:
        gap = 3 * gap + 1
    while gap > 1:
        gap //= 3
        for i in range(gap, count):
            moved = ranks[i]
            j = i
            while j >= gap and values[ranks[j - gap]] > values[moved]:
                ranks[j] = ranks[j - gap]
                j -= gap
            ranks[j] = moved
    return ranks


@compiled
def fuse_cells(
    starts: NDArray[np.int64],
    heights: Float32,
    sigmas: Float32,
    views: NDArray[np.int32],
    stations: NDArray[np.int64],
    gate: float,
) -> tuple[Float32, Float32, NDArray[np.uint16], NDArray[np.uint8]]:
    """Robust height of each cell: the weighted mean of what lies near the median.

    The gate around the median is `gate` times the larger of the scatter (from the MAD) and the
    median's own sigma. The standard deviation adds the formal one of independent views to the
    scatter over the square root of the number of views: pixels of one view share their errors.

    Args:
        starts: (C + 1,) where the points of each cell start.
        heights: (N,) sorted by cell, then by view.
        sigmas: (N,) of the heights.
        views: (N,) of the heights.
        stations: (V,) of every view, by its number.
        gate: in standard deviations.

    Returns:
        (C,) height and sigma, NaN in empty cells, and number of views and of stations used (255
        stands for more).
    """
    cells = starts.size - 1
    height = np.full(cells, np.nan, np.float32)
    sigma = np.full(cells, np.nan, np.float32)
    count = np.zeros(cells, np.uint16)
    met = np.zeros(cells, np.uint8)
    for cell in range(cells):
        first, last = starts[cell], starts[cell + 1]
        if first == last:
            continue
        values = heights[first:last]
        order = sorted_ranks(values)
        half = 0.0
        for i in range(values.size):
            half += 0.5 / sigmas[first + i] ** 2
        median_at, below = order[-1], 0.0
        for i in order:
            below += 1.0 / sigmas[first + i] ** 2
            if below >= half:
                median_at = i
                break
        median = values[median_at]
        misses = np.empty(values.size, np.float32)
        for i in range(values.size):
            misses[i] = abs(values[i] - median)
        ranks = sorted_ranks(misses)
        middle = values.size // 2
        scatter = MAD_TO_SIGMA * misses[ranks[middle]]
        if values.size % 2 == 0:
            scatter = 0.5 * (scatter + MAD_TO_SIGMA * misses[ranks[middle - 1]])
        reach = gate * max(scatter, sigmas[first + median_at])
        total, weights, squares = 0.0, 0.0, 0.0
        formal, in_view, view_weight, seen, last_view = 0.0, 0, 0.0, 0, -1
        places, companions = np.empty(values.size, np.int64), 0
        for i in range(values.size):
            if abs(values[i] - median) > reach:
                continue
            w = 1.0 / sigmas[first + i] ** 2
            total += w * (values[i] - median)
            squares += w * (values[i] - median) ** 2
            weights += w
            if views[first + i] != last_view:
                if in_view > 0:
                    formal += view_weight / in_view
                last_view, in_view, view_weight = views[first + i], 0, 0.0
                seen += 1
                place, known = stations[last_view], False
                for k in range(companions):
                    known = known or places[k] == place
                if not known:
                    places[companions] = place
                    companions += 1
            in_view += 1
            view_weight += w
        formal += view_weight / in_view
        mean = total / weights
        variance = max(squares / weights - mean * mean, 0.0)
        height[cell] = median + mean
        sigma[cell] = math.sqrt(1.0 / formal + variance / seen)
        count[cell] = seen
        met[cell] = min(companions, 255)
    return height, sigma, count, met


@compiled
def fill_gaps(height: Float32, sigma: Float32, reach: int) -> tuple[Float32, Float32]:
    """Bridge small gaps in straight lines between what lies on either side.

    A gap's cell is filled where, along at least two of the four lines through it (rows, columns
    and both diagonals), known cells lie within `reach` on both sides. Its standard deviation is
    the larger of the ends' plus half their difference.

    Args:
        height: (H, W), NaN where unknown.
        sigma: (H, W) of the heights.
        reach: in cells.

    Returns:
        Copies of both with small gaps filled.
    """
    rows, columns = height.shape
    filled, filled_sigma = height.copy(), sigma.copy()
    steps = ((0, 1), (1, 0), (1, 1), (1, -1))
    for row in range(rows):
        for column in range(columns):
            if not math.isnan(height[row, column]):
                continue
            lines, total, weights, widest = 0, 0.0, 0.0, 0.0
            for down, right in steps:
                spread = 0.0
                first, second, a, b = 0.0, 0.0, 0, 0
                for n in range(1, reach + 1):
                    r, c = row + n * down, column + n * right
                    if 0 <= r < rows and 0 <= c < columns and not math.isnan(height[r, c]):
                        first, a = height[r, c], n
                        spread = sigma[r, c]
                        break
                for n in range(1, reach + 1):
                    r, c = row - n * down, column - n * right
                    if 0 <= r < rows and 0 <= c < columns and not math.isnan(height[r, c]):
                        second, b = height[r, c], n
                        spread = max(spread, sigma[r, c])
                        break
                if a == 0 or b == 0:
                    continue
                w = 1.0 / (a + b)
                lines += 1
                total += w * (first * b + second * a) / (a + b)
                weights += w
                widest = max(widest, spread + 0.5 * abs(first - second))
            if lines >= 2:
                filled[row, column] = total / weights
                filled_sigma[row, column] = widest
    return filled, filled_sigma


def slope_deg(height: Float32, cell: float) -> Float32:
    """Steepest slope of every cell (H, W), degrees; NaN where a cell or one of eight is unknown.

    Horn's (1981) third-order differences over the eight neighbours.
    """
    rise = height.astype(np.float64)
    padded = np.pad(rise, 1, constant_values=np.nan)
    above, level, below = padded[:-2], padded[1:-1], padded[2:]
    right = above[:, 2:] + 2 * level[:, 2:] + below[:, 2:]
    left = above[:, :-2] + 2 * level[:, :-2] + below[:, :-2]
    down = below[:, :-2] + 2 * below[:, 1:-1] + below[:, 2:]
    up = above[:, :-2] + 2 * above[:, 1:-1] + above[:, 2:]
    steep = np.rad2deg(np.arctan(np.hypot(right - left, down - up) / (8 * cell)))
    slope: Float32 = np.where(np.isfinite(rise), steep, np.nan).astype(np.float32)
    return slope


def without_strays(height: Float32) -> NDArray[np.bool_]:
    """Which cells are not isolated: enough cells are known in the square around them.

    Beyond the edge of the array a cell counts as unknown.
    """
    known = np.isfinite(height)
    side = 2 * STRAY_CELLS + 1
    share = cv2.boxFilter(
        known.astype(np.float32), -1, (side, side), borderType=cv2.BORDER_CONSTANT
    )
    return np.asarray(known & (share >= _LEAST_COMPANY))
