"""The digital elevation model: one robust height per cell, positive up, with sigma and count."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.base.compiled import compiled
from alice_survey.base.robust import MAD_TO_SIGMA
from reconstruct.dense.points import Points
from reconstruct.dense.surfaces import sorted_ranks, surfaces_of
from reconstruct.raster import DemGrid

Float32 = NDArray[np.float32]

_GATE = 3.0
_STEEPEST = np.float32(1e-3)
"""Third part of a unit normal below which a surface counts as upright."""
FILL_CELLS = 3
"""Cells that lie no farther than this from known ones on opposite sides are filled."""
STRAY_CELLS = 8
"""Reach of the square around a cell in which others must be known."""
_LEAST_COMPANY = 0.22
"""Share of that square that must be known; what is more isolated is mostly wrong."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FusedCells:
    """What points show of the cells of a grid, (rows, columns) each."""

    height: Float32
    """Height of the uppermost surface; NaN in empty cells."""
    sigma: Float32
    count: NDArray[np.uint16]
    """How many views the height rests on."""
    stations: NDArray[np.uint8]
    """How many stations; 255 stands for more."""
    surfaces: NDArray[np.uint8]
    """How many surfaces lie over each other; 0 in empty cells."""
    lower: Float32
    """Height of the lowest of several surfaces; NaN where there is one."""

    def without(self, cells: NDArray[np.bool_]) -> "FusedCells":
        """The same with some cells emptied."""
        nan, none = np.float32(np.nan), np.uint8(0)
        return FusedCells(
            height=np.where(cells, nan, self.height),
            sigma=np.where(cells, nan, self.sigma),
            count=np.where(cells, np.uint16(0), self.count),
            stations=np.where(cells, none, self.stations),
            surfaces=np.where(cells, none, self.surfaces),
            lower=np.where(cells, nan, self.lower),
        )


def fuse_points(grid: DemGrid, points: Points, stations: NDArray[np.int64]) -> FusedCells:
    """Give each cell of a grid one height from the points that fall in it, and what lies below.

    Points whose normal is known to look down do not count.

    Args:
        grid: cells, of which points outside are ignored, in the coordinates of the points.
        points: of all views that see the grid.
        stations: (V,) of every view, by its number.
    """
    facing = points.part(~(points.normals[:, 2] < 0.0))  # NaN compares as False
    starts, order = bin_points(
        facing.enu, grid.north, grid.west, grid.cell, grid.rows, grid.columns
    )
    up = np.maximum(facing.normals[order, 2], _STEEPEST)
    steepness = np.sqrt(np.maximum(1.0 - up * up, 0.0)) / up
    height, sigma, count, met, surfaces, lower = fuse_cells(
        starts, facing.enu[order, 2], facing.sigmas[order], facing.views[order], stations,
        steepness, grid.cell, _GATE,
    )  # fmt: skip
    shape = (grid.rows, grid.columns)
    return FusedCells(
        height=height.reshape(shape),
        sigma=sigma.reshape(shape),
        count=count.reshape(shape),
        stations=met.reshape(shape),
        surfaces=surfaces.reshape(shape),
        lower=lower.reshape(shape),
    )


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
def fuse_cells(
    starts: NDArray[np.int64],
    heights: Float32,
    sigmas: Float32,
    views: NDArray[np.int32],
    stations: NDArray[np.int64],
    steepness: Float32,
    cell: float,
    gate: float,
) -> tuple[Float32, Float32, NDArray[np.uint16], NDArray[np.uint8], NDArray[np.uint8], Float32]:
    """Robust height of each cell's uppermost surface, and of its lowest where it has several.

    Args:
        starts: (C + 1,) where the points of each cell start.
        heights: (N,) sorted by cell, then by view.
        sigmas: (N,) of the heights.
        views: (N,) of the heights.
        stations: (V,) of every view, by its number.
        steepness: (N,) tangent of the angle between normal and vertical; NaN where unknown.
        cell: side of a cell.
        gate: in standard deviations.

    Returns:
        (C,) height and sigma, NaN in empty cells; number of views and of stations used (255 stands
        for more); number of surfaces, and height of the lowest, NaN where there is one surface.
    """
    cells = starts.size - 1
    height = np.full(cells, np.nan, np.float32)
    sigma = np.full(cells, np.nan, np.float32)
    count = np.zeros(cells, np.uint16)
    met = np.zeros(cells, np.uint8)
    surfaces = np.zeros(cells, np.uint8)
    lowest = np.full(cells, np.nan, np.float32)
    for n in range(cells):
        first, last = starts[n], starts[n + 1]
        if first == last:
            continue
        values, spreads, seen_by = heights[first:last], sigmas[first:last], views[first:last]
        found, of_point = surfaces_of(
            values, spreads, stations[seen_by], steepness[first:last], cell
        )
        surfaces[n] = min(found, 255)
        if found > 1:
            floor = of_point == found - 1
            lowest[n] = robust_height(
                values[floor], spreads[floor], seen_by[floor], stations, gate
            )[0]
            top = of_point == 0
            values, spreads, seen_by = values[top], spreads[top], seen_by[top]
        height[n], sigma[n], count[n], met[n] = robust_height(
            values, spreads, seen_by, stations, gate
        )
    return height, sigma, count, met, surfaces, lowest


@compiled
def robust_height(
    heights: Float32,
    sigmas: Float32,
    views: NDArray[np.int32],
    stations: NDArray[np.int64],
    gate: float,
) -> tuple[float, float, int, int]:
    """Robust height of some points: the weighted mean of what lies near the median.

    The gate around the median is `gate` times the larger of the scatter (from the MAD) and the
    median's own sigma. The standard deviation adds the formal one of independent views to the
    scatter over the square root of the number of views: pixels of one view share their errors.

    Args:
        heights: (N,) sorted by view, one or more.
        sigmas: (N,) of the heights.
        views: (N,) of the heights.
        stations: (V,) of every view, by its number.
        gate: in standard deviations.

    Returns:
        Height and sigma, and number of views and of stations used (255 stands for more).
    """
    order = sorted_ranks(heights)
    half = 0.0
    for i in range(heights.size):
        half += 0.5 / sigmas[i] ** 2
    median_at, below = order[-1], 0.0
    for i in order:
        below += 1.0 / sigmas[i] ** 2
        if below >= half:
            median_at = i
            break
    median = heights[median_at]
    misses = np.empty(heights.size, np.float32)
    for i in range(heights.size):
        misses[i] = abs(heights[i] - median)
    ranks = sorted_ranks(misses)
    middle = heights.size // 2
    scatter = MAD_TO_SIGMA * misses[ranks[middle]]
    if heights.size % 2 == 0:
        scatter = 0.5 * (scatter + MAD_TO_SIGMA * misses[ranks[middle - 1]])
    reach = gate * max(scatter, sigmas[median_at])
    total, weights, squares = 0.0, 0.0, 0.0
    formal, in_view, view_weight, seen, last_view = 0.0, 0, 0.0, 0, -1
    places, companions = np.empty(heights.size, np.int64), 0
    for i in range(heights.size):
        if abs(heights[i] - median) > reach:
            continue
        w = 1.0 / sigmas[i] ** 2
        total += w * (heights[i] - median)
        squares += w * (heights[i] - median) ** 2
        weights += w
        if views[i] != last_view:
            if in_view > 0:
                formal += view_weight / in_view
            last_view, in_view, view_weight = views[i], 0, 0.0
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
    return median + mean, math.sqrt(1.0 / formal + variance / seen), seen, min(companions, 255)


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
