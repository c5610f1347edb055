"""The digital elevation model: a surface projected on a grid, heights up, with their sigmas."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.compiled import compiled
from alice_survey.core.frames import Array
from reconstruct.dense.points import EDGE_ON
from reconstruct.dense.surface_points import sorted_ranks
from reconstruct.raster import DemGrid

Float32 = NDArray[np.float32]

FILL_CELLS = 3
"""Cells that lie no farther than this from known ones on opposite sides are filled."""
_STEP = 1.0
"""Slope from which two cells have a step between them, unless the surface is as steep around."""
_MAX_GAIN = math.tan(math.acos(EDGE_ON))
"""Slope of the steepest surface that counts."""
STRAY_CELLS = 8
"""Reach of the square around a cell in which others must be known."""
_MIN_COMPANY = 0.22
"""Share of that square that must be known: what is more isolated is a rim of a wall, mostly."""
_MIN_WEIGHT = 1e-3
_BEYOND_RIM = 1.0 / math.sqrt(24.0 * math.pi)
"""Chance that the middle of a cell at a rim is beyond it: a rim that is anywhere between two
middles is known to a cell, that is with a sigma of 1 / sqrt(12) of one."""
_MIN_SHARE = 0.25
"""Sum of the shares of points from which a cell's height is more than a guess at its rim."""
_APART_SIGMAS = 5.0
_DIAGONAL = math.sqrt(2.0)
_MIN_STATIONS = 2


@dataclass(frozen=True, eq=False)
class FusedCells:
    """What a surface shows in the cells of a grid, (rows, columns) each."""

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
        bands = vars(self).values()
        nothing = [band.dtype.type(np.nan if band.dtype.kind == "f" else 0) for band in bands]
        pairs = zip(nothing, bands, strict=True)
        return FusedCells(*(np.where(cells, empty, band) for empty, band in pairs))


def cells_over(grid: DemGrid, surface: NDArray[Any]) -> FusedCells:
    """Project a surface onto a grid.

    A point's tangent plane gives the height in the middle of a cell; of points around it each
    counts with the share of a bilinear interpolation. Surfaces that the grid's viewer sees from
    behind do not count. Where one stands that is seen edge-on, heights are as unsure as at a rim;
    where it rises above all that is known around, what is seen from above is not known.

    Args:
        grid: cells, in the coordinates of the points.
        surface: records of `SURFACE_POINT`, in any order.
    """
    column = (surface["enu"][:, 0].astype(np.float64) - grid.west) / grid.cell - 0.5
    row = (grid.north - surface["enu"][:, 1].astype(np.float64)) / grid.cell - 0.5
    facing = surface["normal"][:, 2] >= EDGE_ON
    foot, top = np.full((2, grid.rows, grid.columns), np.nan, np.float32)
    r, c = np.rint(row).astype(np.int64), np.rint(column).astype(np.int64)
    upright = np.abs(surface["normal"][:, 2]) < EDGE_ON
    upright &= (r >= 0) & (r < grid.rows) & (c >= 0) & (c < grid.columns)
    for extreme, ends in ((np.fmin, foot), (np.fmax, top)):
        extreme.at(ends, (r[upright], c[upright]), surface["enu"][upright, 2])
    surface, row, column = surface[facing], row[facing], column[facing]
    owner, point, weight = [], [], []
    for down in (0, 1):
        for right in (0, 1):
            r, c = np.floor(row) + down, np.floor(column) + right
            w = (1.0 - np.abs(row - r)) * (1.0 - np.abs(column - c))
            taken = (w > _MIN_WEIGHT) & (r >= 0) & (r < grid.rows) & (c >= 0) & (c < grid.columns)
            owner.append((r * grid.columns + c)[taken].astype(np.int64))
            point.append(np.flatnonzero(taken))
            weight.append(w[taken])
    cells, points, weights = (np.concatenate(parts) for parts in (owner, point, weight))
    order = np.argsort(cells, kind="stable")
    starts = np.searchsorted(cells[order], np.arange(grid.rows * grid.columns + 1))
    found: tuple[Any, ...] = project_cells(
        starts, points[order], weights[order], surface["enu"], surface["normal"],
        surface["sigma"], surface["shared"], surface["views"], surface["stations"],
        grid.west, grid.north, grid.cell, grid.columns,
    )  # fmt: skip
    cells_found = FusedCells(*(band.reshape(grid.rows, grid.columns) for band in found))
    around = cv2.dilate(np.nan_to_num(cells_found.height, nan=-np.inf), np.ones((3, 3), np.uint8))
    hidden = top - around > grid.cell  # by what the wall ends in, which is not known
    return _widen(cells_found, cells_found.height - foot).without(hidden)


@compiled
def project_cells(
    starts: NDArray[np.int64],
    points: NDArray[np.int64],
    weights: Array,
    enu: Float32,
    normals: Float32,
    sigmas: Float32,
    shared: Float32,
    views: NDArray[np.uint16],
    stations: NDArray[np.uint8],
    west: float,
    north: float,
    cell: float,
    columns: int,
) -> tuple[Float32, Float32, NDArray[np.uint16], NDArray[np.uint8], NDArray[np.uint8], Float32]:
    """Height of each cell's uppermost surface, and of its lowest where it has several.

    Heights of one surface differ by no more than noise and slope explain: five standard deviations
    and what the steeper of two neighbours gains over a cell's diagonal, and a cell's side. What one
    station sees is no surface beside those that more see: it may be one wrong match.

    Args:
        starts: (C + 1,) where the entries of each cell start.
        points: (E,) point numbers.
        weights: (E,) of the points in the cells.
        enu: (N, 3) points.
        normals: (N, 3) unit vectors with a positive third part.
        sigmas: (N,) along the normals.
        shared: (N,) what all points around share of their errors.
        views: (N,) views that a point rests on.
        stations: (N,) stations that a point rests on.
        west: of the grid.
        north: of the grid.
        cell: side of a cell.
        columns: of the grid.

    Returns:
        (C,) height and standard deviation, NaN in empty cells; views and stations that the point
        of most weight rests on; number of surfaces, and height of the lowest, NaN where there is
        one.
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
        size = last - first
        if size == 0:
            continue
        east = west + (n % columns + 0.5) * cell
        northing = north - (n // columns + 0.5) * cell
        heights, spreads, steep = np.empty(size), np.empty(size), np.empty(size)
        for k in range(size):
            i = points[first + k]
            up = normals[i, 2]
            lift = (enu[i, 0] - east) * normals[i, 0] + (enu[i, 1] - northing) * normals[i, 1]
            heights[k] = enu[i, 2] + lift / up
            spreads[k] = sigmas[i] / up
            steep[k] = math.sqrt(max(1.0 - up * up, 0.0)) / up
        ranks = sorted_ranks(heights)[::-1]
        maximum = 0
        for k in range(size):
            maximum = max(maximum, stations[points[first + k]])
        start, found = 0, 0
        while start < size:
            end = start + 1
            while end < size:
                a, b = ranks[end - 1], ranks[end]
                gap = _APART_SIGMAS * math.hypot(spreads[a], spreads[b])
                gap += cell * (1.0 + _DIAGONAL * max(steep[a], steep[b]))
                if heights[a] - heights[b] > gap:
                    break
                end += 1
            total, mean, square, noise, common = 0.0, 0.0, 0.0, 0.0, 0.0
            heaviest, seen, share = ranks[start], 0, 0.0
            for k in range(start, end):
                member = ranks[k]
                i = points[first + member]
                # the nearer a point's normal to the vertical the better its height is known
                w = weights[first + member] / (spreads[member] * spreads[member])
                total += w
                mean += w * heights[member]
                square += w * heights[member] ** 2
                noise += w * spreads[member]
                common += w * shared[i] / normals[i, 2]
                seen = max(seen, stations[i])
                share += weights[first + member]
                if weights[first + member] > weights[first + heaviest]:
                    heaviest = member
            start = end
            if share < _MIN_SHARE or seen < min(maximum, _MIN_STATIONS):
                continue
            mean /= total
            if found == 0:
                scatter = max(square / total - mean * mean, 0.0)
                height[n] = mean
                sigma[n] = math.sqrt((noise / total) ** 2 + scatter + (common / total) ** 2)
                count[n] = views[points[first + heaviest]]
                met[n] = stations[points[first + heaviest]]
            else:
                lowest[n] = mean
            found += 1
        surfaces[n] = min(found, 255)
    return height, sigma, count, met, surfaces, lowest


def widen_at_rims(cells: FusedCells, cell: float) -> FusedCells:
    """Add to sigmas at rims what the other surface would do to heights.

    Between a cell and the next one known in any direction is a rim where heights differ by more
    than noise and a continuous surface explain: a slope of 45 degrees, and what the surfaces on
    both sides gain; also where a cell has several surfaces and one next to it has none. The rim is
    known to a cell, so that the middles of cells at it lie beyond it with a known probability.
    """
    bands, known = (cells.height, cells.sigma), np.isfinite(cells.height).astype(np.uint8)
    ends = cv2.erode(known, np.ones((3, 3), np.uint8)) < known
    reach = np.where(ends, np.nan_to_num(cells.height - cells.lower), 0.0)
    for way in _WAYS:
        gains = [np.abs(cells.height - _next_known((cells.height,), w, 1)[0]) for w in (way, -way)]
        there, spread, gain, steps = _next_known((*bands, gains[0]), way, FILL_CELLS + 1)
        apart = np.abs(cells.height - there)
        length = cell * float(np.hypot(*way))
        gain = np.fmin(np.nan_to_num(np.fmax(gain, gains[1])), _MAX_GAIN * length)
        explained = steps * (length + gain)
        explained += _APART_SIGMAS * np.hypot(cells.sigma, spread)
        reach = np.fmax(reach, np.where(apart > explained, apart, 0.0))
    return _widen(cells, reach)


def _widen(cells: FusedCells, reach: Array | Float32) -> FusedCells:
    """Cells with another surface so far above or below; none where `reach` is NaN or 0."""
    rim = np.isfinite(cells.height) & (reach > 0)
    wide = np.sqrt(np.square(cells.sigma) + _BEYOND_RIM * np.square(reach))
    return replace(
        cells,
        sigma=np.where(rim, wide, cells.sigma).astype(np.float32),
        surfaces=np.where(rim, np.maximum(cells.surfaces, 2), cells.surfaces),
    )


def fill_gaps(
    height: Float32, sigma: Float32, reach: int, cell: float, *, over_steps: bool
) -> tuple[Float32, Float32]:
    """Bridge small gaps between what lies on either side.

    A gap's cell is filled where, along at least two of the four lines through it (rows, columns
    and both diagonals), known cells lie within `reach` on both sides: in straight lines along those
    that are no steps. Where fewer than two are none, what is not seen lies behind the step, at the
    lowest of the ends. The standard deviation is the largest of the ends' plus twice the scatter of
    the lines, or plus half the range of heights where one is a step.

    Args:
        height: (H, W), NaN where unknown.
        sigma: (H, W) of the heights.
        reach: in cells.
        cell: side of a cell.
        over_steps: whether cells that have fewer than two lines without a step are filled too.

    Returns:
        Copies of both with small gaps filled.
    """
    found = np.array([_next_known((height, sigma), way, reach) for way in _WAYS])
    ends = found.reshape(2, 4, 3, *height.shape)
    ends = np.where(np.isfinite(ends).all(axis=(0, 2), keepdims=True), ends, np.nan)
    (first, _, a), (second, _, b) = ends.swapaxes(1, 2)
    known = np.isfinite(first)
    step = np.abs(first - second) > _STEP * (a + b) * cell
    smooth = known & ~step
    enough = smooth.sum(axis=0) >= 2
    gap = np.isnan(height) & (enough | (over_steps & (known.sum(axis=0) >= 2)))
    weight, between = np.where(smooth, 1.0 / (a + b), 0.0), (first * b + second * a) / (a + b)
    between = np.nan_to_num(between)
    with np.errstate(invalid="ignore"):
        filled = (weight * between).sum(axis=0) / weight.sum(axis=0)
        square = (weight * np.square(between - filled)).sum(axis=0) / weight.sum(axis=0)
    low, high = (f.reduce(ends[:, :, 0], axis=(0, 1)) for f in (np.fmin, np.fmax))
    wide = np.fmax.reduce(ends[:, :, 1], axis=(0, 1))
    wide += np.where(step.any(axis=0), 0.5 * (high - low), 2.0 * np.sqrt(square))
    filled = np.where(gap, np.where(enough, filled, low), height)
    return filled.astype(np.float32), np.where(gap, wide, sigma).astype(np.float32)


_WAYS = np.array([(0, 1), (1, 0), (1, 1), (1, -1), (0, -1), (-1, 0), (-1, -1), (-1, 1)])
"""To the eight neighbours of a cell, down and right; the last four are against the first."""


def _next_known(bands: Sequence[Float32 | Array], way: NDArray[Any], reach: int) -> Array:
    """Values at the next cell one way in which the first band is known, and steps to it.

    Args:
        bands: (H, W) each.
        way: (2,) one step down and right.
        reach: in steps.

    Returns:
        (bands + 1, H, W); NaN where there is none within reach.
    """
    padded = np.pad(bands, ((0, 0), (reach, reach), (reach, reach)), constant_values=np.nan)
    rows, columns = bands[0].shape
    found = np.full((len(bands) + 1, rows, columns), np.nan)
    for steps in range(reach, 0, -1):  # the nearest last
        top, left = reach + steps * way
        there = padded[:, top : top + rows, left : left + columns]
        known = np.isfinite(there[0])
        for values, source in zip(found, (*there, steps), strict=True):
            np.copyto(values, source, where=known)
    return found


def slope_deg(height: Float32, cell: float) -> Float32:
    """Steepest slope of every cell (H, W), degrees; NaN where a cell or one of eight is unknown.

    Horn's (1981) third-order differences over the eight neighbours.
    """
    padded = np.pad(height.astype(np.float64), 1, constant_values=np.nan)
    right, down = (cv2.Sobel(padded, cv2.CV_64F, *way)[1:-1, 1:-1] for way in ((1, 0), (0, 1)))
    steep = np.rad2deg(np.arctan(np.hypot(right, down) / (8 * cell)))
    return np.where(np.isfinite(height), steep, np.nan).astype(np.float32)


def without_strays(height: Float32) -> NDArray[np.bool_]:
    """Which cells are not isolated: enough cells are known in the square around them.

    Beyond the edge of the array a cell counts as unknown.
    """
    known = np.isfinite(height)
    side = 2 * STRAY_CELLS + 1
    share = cv2.boxFilter(
        known.astype(np.float32), -1, (side, side), borderType=cv2.BORDER_CONSTANT
    )
    return np.asarray(known & (share >= _MIN_COMPANY))
