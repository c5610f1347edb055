"""Area of the surface within polygons, over that of its plan, and what moves both.

Between the middles of four cells the surface is the mean of the two ways to cut that square into
triangles. Arrays of heights are (rows, columns) of cells, rows from north to south; those of
squares have one row and one column less.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.ndimage import convolve, uniform_filter
from scipy.special import ndtr
from shapely.geometry.base import BaseGeometry

from alice_survey.core.errors import ReconstructionError
from alice_survey.core.frames import Array
from reconstruct.measure.errors import (
    REACH_CELLS,
    FigureSlopes,
    PackedSlopes,
    own_correlation,
    sum_slopes,
)
from reconstruct.measure.figures import Measured, figure
from reconstruct.measure.surface import MeasuredSurface

_CORNERS = ((np.s_[:-1, :-1], -1, 1), (np.s_[:-1, 1:], 1, 1), (np.s_[1:, :-1], -1, -1),
            (np.s_[1:, 1:], 1, -1))  # fmt: skip
"""Corners of squares in an array of cells: north-west, north-east, south-west, south-east, and on
which side of the square each is, to the right and up."""
_TOO_SMOOTH = 0.5
"""Share of the stated noise that less scatter of slopes contradicts."""
_AROUND, _ALONG = 9, 41
"""Squares along a side, and steps of a line, over which the scatter of slopes is taken."""
_FAR = 9.0
"""Sigmas from which on noise lifts nothing."""
_NEXT, _ACROSS = (float(own_correlation(np.array(cells))) for cells in (1.0, np.sqrt(2.0)))


def corners_of(cells: Array) -> tuple[Array, ...]:
    """Values at the corners of squares."""
    return tuple(cells[corner] for corner, _, _ in _CORNERS)


def mean_of_corners(cells: Array) -> Array:
    """Mean value of each square's corners."""
    return np.asarray(sum(corners_of(cells)) / 4.0)


def spread_to_cells(squares: Array) -> Array:
    """Sum at each cell of a quarter of the values of the squares around it."""
    found = np.zeros((squares.shape[0] + 1, squares.shape[1] + 1))
    for corner, _, _ in _CORNERS:
        found[corner] += squares / 4.0
    return found


def own_variance(slopes: Array, sigma: Array, core: tuple[slice, slice]) -> float:
    """Variance by own errors of a figure with derivatives by heights, of the cells of a core.

    NaN where it hangs on a cell whose sigma is not stated.
    """
    if np.isnan(sigma[core][slopes[core] != 0.0]).any():
        return np.nan
    steps = np.arange(-REACH_CELLS, REACH_CELLS + 1)
    kernel = own_correlation(np.hypot(*np.meshgrid(steps, steps)))
    kicks = np.nan_to_num(slopes * sigma)
    return float((kicks * convolve(kicks, kernel, mode="constant"))[core].sum())


def _scatter() -> float:
    """Variance of what noise adds to a level floor, by the square of its mean in each square.

    A square adds half the sum of the squares of its sides' rises; the variance of a sum of squares
    of Gaussian numbers is twice the sum of their squared covariances.
    """
    steps = np.arange(-4, 5)
    x, y = np.meshgrid(steps, steps)

    def fading(right: int, up: int) -> Array:
        return own_correlation(np.hypot(x + right, y + up))

    alike = 2 * fading(0, 0) - fading(1, 0) - fading(-1, 0)
    other = fading(0, 1) + fading(-1, 0) - fading(0, 0) - fading(-1, 1)
    return float((alike**2 + other**2).sum() / (2 * (1 - _NEXT)) ** 2)


_SCATTER = _scatter()


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceArea:
    """Area of the surface over squares."""

    area: Array
    """(rows - 1, columns - 1) without what noise adds."""
    added: Array
    """Of it, what noise added in the mean and was taken away."""
    slopes: Array
    """(rows, columns, 3) derivatives of the weighted sum by the motions of the cells."""

    def scatter(self, weight: Array) -> float:
        """Variance of the weighted sum by how much noise adds, which differs from draw to draw."""
        return _SCATTER * float(np.nansum((weight * self.added) ** 2))


def surface_area(height: Array, own: Array, weight: Array, cell: float) -> SurfaceArea:
    """Area of the surface over squares, and what moves their weighted sum.

    A triangle with slopes p and q has the area of its plan times J = √(1 + p² + q²). Noise in the
    slopes of covariance V adds ½ tr(H V) in the mean, with the Hessian of J, H = (I - g gᵀ/J²)/J of
    g = (p, q), to second order: of a level surface whose slopes have a noise of 0.3, a tenth of it
    is left.

    Args:
        height: (rows, columns); NaN where unknown.
        own: (rows, columns) sigmas of own errors.
        weight: (rows - 1, columns - 1) of the squares.
        cell: side of a square.
    """
    own = np.nan_to_num(own)
    area, added, slopes = (
        np.zeros(weight.shape),
        np.zeros(weight.shape),
        np.zeros((*height.shape, 3)),
    )
    weight = np.where(known_squares(height), weight, 0.0)
    here, aside, below = np.s_[:-1, :-1], np.s_[:-1, 1:], np.s_[1:, :-1]
    # the half of each square at one of its corners, from which sides go to the right and up
    for right, up in ((-1, -1), (-1, 1), (1, 1), (1, -1)):
        flip = np.s_[::-up, ::right]
        h, s = height[flip], own[flip]
        a, b = ((h[end] - h[here]) / cell for end in (aside, below))
        root = np.sqrt(1.0 + a**2 + b**2)
        var_a, var_b = (
            s[here] ** 2 + s[end] ** 2 - 2 * _NEXT * s[here] * s[end] for end in (aside, below)
        )
        cov = s[here] ** 2 - _NEXT * s[here] * (s[aside] + s[below])
        cov += _ACROSS * s[aside] * s[below]
        area[flip] += cell**2 * root / 4.0
        added[flip] += ((1 + b**2) * var_a + (1 + a**2) * var_b - 2 * a * b * cov) / root**3 / 8.0
        # A triangle's area ½ |A × B| moves with its sides A = c (right, 0, a), B = c (0, up, b).
        share = weight[flip] * cell / 4.0 / root
        by_a = np.stack([right * (1 + b**2), -up * a * b, a], axis=-1) * share[..., None]
        by_b = np.stack([-right * a * b, up * (1 + a**2), b], axis=-1) * share[..., None]
        by_a, by_b = np.nan_to_num(by_a), np.nan_to_num(by_b)
        moved = slopes[flip]
        moved[aside] += by_a
        moved[below] += by_b
        moved[here] -= by_a + by_b
    added *= not_more((a, b), (var_a + var_b) / cell**2)  # one corner of each stands for all
    return SurfaceArea(area=area - added, added=added, slopes=slopes)


def not_more(slopes: Sequence[Array], noise: Array) -> Array:
    """Share of the stated noise that there can be, where the surface is smoother than that.

    Sigmas of cells at ledges and of bridged ones are of what is there, not of differences between
    neighbours: noise is not larger than the scatter of slopes that is measured around.

    Args:
        slopes: (H, W) or (N,) of each direction; NaN where unknown.
        noise: sum of the variances of the slopes, as stated.
    """
    known = np.isfinite(sum(slopes) + noise)
    size = _AROUND if noise.ndim > 1 else _ALONG

    def around(part: Array) -> Array:
        return np.asarray(uniform_filter(np.where(known, part, 0.0), size, mode="constant"))

    here = np.maximum(around(np.ones_like(noise)), 1e-12)
    scatter = sum(around(one**2) / here - (around(one) / here) ** 2 for one in slopes)
    stated = around(noise) / here
    share = np.where(stated > 0, scatter / np.where(stated > 0, stated, 1.0), 1.0)
    # Half of it or more is what a small sample may show of noise as stated.
    return np.asarray(np.where(share < _TOO_SMOOTH, np.maximum(share, 0.0), 1.0))


def plan_slopes(weight: Array, cell: float) -> Array:
    """Derivatives (rows, columns, 3) of the weighted sum of the squares' plan areas."""
    slopes = np.zeros((weight.shape[0] + 1, weight.shape[1] + 1, 3))
    for corner, to_right, to_up in _CORNERS:
        slopes[corner][..., 0] += to_right * weight * cell / 2.0
        slopes[corner][..., 1] += to_up * weight * cell / 2.0
    return slopes


def noise_lift(distance: Array, sigma: Array) -> Array:
    """How much noise lifts the mean of max(distance, 0), at a true distance."""
    t = np.abs(distance) / np.maximum(sigma, 1e-300)
    t = np.minimum(t, _FAR)
    return np.asarray(sigma * (np.exp(-(t**2) / 2) / np.sqrt(2 * np.pi) - t * ndtr(-t)))


def sigma_of_means(own: Array) -> Array:
    """Sigma of the mean of each square's corners."""
    mean = mean_of_corners(own)
    return np.asarray(mean * np.sqrt((4 + 8 * _NEXT + 4 * _ACROSS) / 16.0))


def known_squares(cells: Array) -> NDArray[np.bool_]:
    """Squares of which all corners are known."""
    return np.asarray(np.isfinite(sum(corners_of(cells))))


_BLOCK_CELLS = 512
_RIM = REACH_CELLS + 1
"""Cells around a block whose squares count for own errors in it."""
_MAX_CELLS = 10_000_000
_SHARE_DIGITS = 12
"""Decimals of shares of squares: less is rounding."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GridPart:
    """A part of the grid, with cells around it."""

    height: Array
    own: Array
    weight: Array
    """Shares of its squares within the polygon; 0 of those that no core cell begins."""
    all_weight: Array
    """The same of those around it as well."""
    x: Array
    y: Array
    """(rows, columns) places of its cells, from the polygon's middle."""
    core: tuple[slice, slice]


class PolygonOnGrid:
    """A polygon on a surface."""

    def __init__(self, surface: MeasuredSurface, polygon: Any) -> None:
        self.surface, self.polygon = surface, polygon
        turned = shapely.orient_polygons(polygon)
        self._rings = [
            ring for part in shapely.get_parts(turned) for ring in shapely.get_rings(part)
        ]
        centre = polygon.centroid
        self.middle = np.array([centre.x, centre.y])
        west, south, east, north = polygon.bounds
        grid = surface.grid
        self._rows = self._cut(
            (grid.north - north) / grid.cell, (grid.north - south) / grid.cell, grid.rows
        )
        self._columns = self._cut(
            (west - grid.west) / grid.cell, (east - grid.west) / grid.cell, grid.columns
        )
        cells = max(0, np.ptp(self._rows)) * max(0, np.ptp(self._columns))
        if cells > _MAX_CELLS:
            raise ReconstructionError(
                f"a polygon over {cells:,} cells: at most {_MAX_CELLS:,} are measured at once; "
                "measure it in parts"
            )

    @staticmethod
    def _cut(first: float, last: float, count: int) -> tuple[int, int]:
        return max(0, math.floor(first) - 1), min(count, math.ceil(last) + 2)

    def blocks(self) -> Iterator[GridPart]:
        """Parts of the grid that cover it, each cell in the core of one."""
        for top in range(*self._rows, _BLOCK_CELLS):
            for left in range(*self._columns, _BLOCK_CELLS):
                rows = min(_BLOCK_CELLS, self._rows[1] - top)
                columns = min(_BLOCK_CELLS, self._columns[1] - left)
                yield self._block(top, left, rows, columns)

    def _block(self, top: int, left: int, rows: int, columns: int) -> GridPart:
        grid = self.surface.grid
        row, column = top - _RIM, left - _RIM
        shape = (rows + 2 * _RIM, columns + 2 * _RIM)
        height, own = self.surface.window(row, column, *shape)
        weight = self._shares(row, column, (shape[0] - 1, shape[1] - 1))
        weight = np.where(known_squares(height), weight, 0.0)
        inner = np.zeros_like(weight)
        core = (slice(_RIM, _RIM + rows), slice(_RIM, _RIM + columns))
        inner[core] = weight[core]
        y, x = np.mgrid[: shape[0], : shape[1]]
        east, north = grid.east_of(x + column + 0.5), grid.north_of(y + row + 0.5)
        return GridPart(
            height=height, own=own, weight=inner, all_weight=weight,
            x=east - self.middle[0], y=north - self.middle[1], core=core,
        )  # fmt: skip

    def _shares(self, row: int, column: int, shape: tuple[int, int]) -> Array:
        """Share of each square between the middles of four cells that is within the polygon."""
        grid = self.surface.grid
        corner = np.array([grid.east_of(column + 0.5), grid.north_of(row + 0.5)])
        places = (shapely.get_coordinates(ring) for ring in self._rings)
        return covered_shares([(ring - corner) * [1.0, -1.0] / grid.cell for ring in places], shape)

    def add(self, slopes: FigureSlopes, block: GridPart, by_motion: Array) -> None:
        """Add a block's derivatives (rows, columns, 3)."""
        up = by_motion[..., 2]
        own = own_variance(up, block.own, block.core) if up.any() else 0.0
        east, north = (
            side + part for side, part in zip((block.x[0], block.y[:, 0]), self.middle, strict=True)
        )
        slopes.add_grid(east[block.core[1]], north[block.core[0]], by_motion[block.core], own)


def covered_shares(rings: Sequence[Array], shape: tuple[int, int]) -> Array:
    """Shares (rows, columns) of unit squares that polygons cover.

    Edges are cut where they cross sides of squares. A piece that goes down by dv covers, seen to
    the right, the part of its square that is right of its middle, and all squares farther right.

    Args:
        rings: (N, 2) closed, x to the right and y down from the corner of the first square; outer
            ones turn so that what is within is to the right of edges that go up, holes the other
            way.
        shape: rows and columns.
    """
    start = np.concatenate([ring[:-1] for ring in rings])
    way = np.concatenate([np.diff(ring, axis=0) for ring in rings])
    edges, cuts = [np.arange(len(start))] * 2, [np.zeros(len(start)), np.ones(len(start))]
    for axis, maximum in ((0, shape[1]), (1, shape[0])):
        ends = np.clip(np.stack([start[:, axis], start[:, axis] + way[:, axis]]), -1, maximum + 1)
        first = np.ceil(ends.min(axis=0)).astype(np.int64)
        counts = np.maximum(np.floor(ends.max(axis=0)).astype(np.int64) - first + 1, 0)
        counts[way[:, axis] == 0.0] = 0
        edge = np.repeat(np.arange(len(start)), counts)
        nth = np.arange(len(edge)) - np.repeat(np.cumsum(counts) - counts, counts)
        edges.append(edge)
        cuts.append(np.clip((first[edge] + nth - start[edge, axis]) / way[edge, axis], 0.0, 1.0))
    edge, cut = np.concatenate(edges), np.concatenate(cuts)
    order = np.lexsort([cut, edge])
    edge, cut = edge[order], cut[order]
    same = edge[1:] == edge[:-1]
    edge, length = edge[:-1][same], np.diff(cut)[same]
    middle = start[edge] + ((cut[:-1] + cut[1:])[same] / 2)[:, None] * way[edge]
    down = length * way[edge, 1]
    row, column = np.floor(middle[:, 1]), np.floor(middle[:, 0])
    kept = (row >= 0) & (row < shape[0]) & (column < shape[1])
    row, column, x, down = (v[kept] for v in (row, column, middle[:, 0], down))
    right = np.where(column < 0, 0.0, x - column)
    column = np.maximum(column, 0.0)
    begun = np.zeros((shape[0], shape[1] + 1))
    at = (row.astype(np.int64), column.astype(np.int64))
    np.add.at(begun, at, down * (1.0 - right))
    np.add.at(begun, (at[0], at[1] + 1), down * right)
    return np.clip(np.round(np.cumsum(begun[:, :-1], axis=1), _SHARE_DIGITS), 0.0, 1.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceAreas:
    """Areas of the known surface within a polygon and of its plan."""

    surface: float
    plan: float
    share: float
    """Known, of the polygon's area."""
    noise: float
    """What noise added to the area of the surface and was taken away, over the area of the plan."""
    by_surface: PackedSlopes
    """What moves the area of the surface."""
    by_plan: PackedSlopes
    """What moves that of its plan."""


def figures_of_all(
    surface: MeasuredSurface, parts: Sequence[SurfaceAreas]
) -> tuple[Measured, Measured]:
    """Area of the surface within all of some polygons, and that over their area in plan.

    What poses and calibration do to them goes together; own errors do not.
    """
    area, plan = math.fsum(p.surface for p in parts), math.fsum(p.plan for p in parts)
    ratio = area / plan
    by_area = sum_slopes([(1.0, part.by_surface) for part in parts])
    by_plan = sum_slopes([(1.0, part.by_plan) for part in parts])
    by_ratio = sum_slopes([(1.0 / plan, by_area), (-ratio / plan, by_plan)])
    return (
        figure(surface, "surface_area", "Area of the surface", area, by_area, 2),
        figure(surface, "rugosity", "Rugosity, surface over plan", ratio, by_ratio, 0),
    )


def surface_within(surface: MeasuredSurface, polygon: BaseGeometry) -> SurfaceAreas:
    """Areas of the surface within a polygon that may have holes, and of its plan.

    Raises:
        ReconstructionError: it is too large, or no surface is known in it.
    """
    region, cell = PolygonOnGrid(surface, polygon), surface.grid.cell
    area = plan = added = scatter = 0.0
    by_surface, by_plan = (FigureSlopes(surface.errors) for _ in range(2))
    for block in region.blocks():
        found = surface_area(block.height, block.own, block.all_weight, cell)
        area += float((block.weight * np.nan_to_num(found.area)).sum())
        plan += cell**2 * float(block.weight.sum())
        added += float((block.weight * np.nan_to_num(found.added)).sum())
        scatter += found.scatter(block.weight)
        region.add(by_surface, block, found.slopes)
        region.add(by_plan, block, plan_slopes(block.all_weight, cell))
    if not plan > 0:
        raise ReconstructionError("no surface is known within the polygon: draw it on the surface")
    by_surface.count_once(scatter)
    return SurfaceAreas(
        surface=area, plan=plan, share=plan / region.polygon.area, noise=added / plan,
        by_surface=by_surface.packed, by_plan=by_plan.packed,
    )  # fmt: skip
