"""Area of the surface within polygons, over that of its plan, and what moves both."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from alice_survey.core.errors import ReconstructionError
from alice_survey.core.frames import Array
from reconstruct.measure.cells import known_squares, own_variance, plan_slopes, surface_area
from reconstruct.measure.errors import REACH_CELLS, FigureSlopes, PackedSlopes, summed
from reconstruct.measure.figures import Measured, figure
from reconstruct.measure.surface import MeasuredSurface

_BLOCK_CELLS = 512
_RIM = REACH_CELLS + 1
"""Cells around a block whose squares count for own errors in it."""
_MAX_CELLS = 10_000_000
_SHARE_DIGITS = 12
"""Decimals of shares of squares: less is rounding."""
NOTHING_KNOWN = "no surface is known within the polygon: draw it on the surface"


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
    corner: tuple[int, int]
    """Row and column of its first cell in the grid."""


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
            corner=(row, column),
        )  # fmt: skip

    def _shares(self, row: int, column: int, shape: tuple[int, int]) -> Array:
        """Share of each square between the middles of four cells that is within the polygon."""
        grid = self.surface.grid
        corner = np.array([grid.east_of(column + 0.5), grid.north_of(row + 0.5)])
        places = (shapely.get_coordinates(ring) for ring in self._rings)
        return covered([(ring - corner) * [1.0, -1.0] / grid.cell for ring in places], shape)

    def add(self, slopes: FigureSlopes, block: GridPart, by_motion: Array) -> None:
        """Add a block's derivatives (rows, columns, 3)."""
        up = by_motion[..., 2]
        own = own_variance(up, block.own, block.core) if up.any() else 0.0
        east, north = (
            side + part for side, part in zip((block.x[0], block.y[:, 0]), self.middle, strict=True)
        )
        slopes.add_grid(east[block.core[1]], north[block.core[0]], by_motion[block.core], own)


def covered(rings: Sequence[Array], shape: tuple[int, int]) -> Array:
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

    def figures(self, surface: MeasuredSurface) -> tuple[Measured, Measured]:
        """Area of the surface, and that over the area in plan."""
        return figures_of_all(surface, [self])


def figures_of_all(
    surface: MeasuredSurface, parts: Sequence[SurfaceAreas]
) -> tuple[Measured, Measured]:
    """Area of the surface within all of some polygons, and that over their area in plan.

    What poses and calibration do to them goes together; own errors do not.
    """
    area, plan = math.fsum(p.surface for p in parts), math.fsum(p.plan for p in parts)
    ratio = area / plan
    by_area = summed([(1.0, part.by_surface) for part in parts])
    by_plan = summed([(1.0, part.by_plan) for part in parts])
    by_ratio = summed([(1.0 / plan, by_area), (-ratio / plan, by_plan)])
    return (
        figure(surface, "surface_area", "Area of the surface", area, by_area, 2),
        figure(surface, "rugosity", "Rugosity, surface over plan", ratio, by_ratio, 0),
    )


class AreaSums:
    """The areas within a polygon, gathered block by block."""

    def __init__(self, region: PolygonOnGrid, places: Array | None = None) -> None:
        """Begin.

        Args:
            region: the polygon.
            places: (M, 2) where the slant of the surface is asked for.
        """
        self._region = region
        self._surface = self._plan = self._added = self._scatter = 0.0
        self._by_surface, self._by_plan = (FigureSlopes(region.surface.errors) for _ in range(2))
        grid, at = region.surface.grid, np.zeros((0, 2)) if places is None else places
        column = np.floor((at[:, 0] - grid.west) / grid.cell - 0.5)
        row = np.floor((grid.north - at[:, 1]) / grid.cell - 0.5)
        self._squares = np.column_stack([row, column]).astype(np.int64)
        self.slant = np.zeros(len(at))
        """(M,) area of the surface over that of its plan; 0 where it is not known."""

    def add(self, block: GridPart) -> None:
        """Add the squares that begin in the core of a block."""
        region, cell = self._region, self._region.surface.grid.cell
        found = surface_area(block.height, block.own, block.all_weight, cell)
        area = np.nan_to_num(found.area)
        self._surface += float((block.weight * area).sum())
        self._plan += cell**2 * float(block.weight.sum())
        self._added += float((block.weight * np.nan_to_num(found.added)).sum())
        self._scatter += found.scatter(block.weight)
        region.add(self._by_surface, block, found.slopes)
        region.add(self._by_plan, block, plan_slopes(block.all_weight, cell))
        here = self._squares - block.corner
        rows, columns = block.core
        inside = (here >= [rows.start, columns.start]) & (here < [rows.stop, columns.stop])
        used = np.flatnonzero(inside.all(axis=1))
        self.slant[used] = area[tuple(here[used].T)] / cell**2

    def total(self) -> SurfaceAreas:
        """What was gathered, once all blocks are in.

        Raises:
            ReconstructionError: no surface is known in it.
        """
        if not self._plan > 0:
            raise ReconstructionError(NOTHING_KNOWN)
        self._by_surface.count_once(self._scatter)
        return SurfaceAreas(
            surface=self._surface, plan=self._plan, share=self._plan / self._region.polygon.area,
            noise=self._added / self._plan, by_surface=self._by_surface.packed,
            by_plan=self._by_plan.packed,
        )  # fmt: skip


def surface_within(
    surface: MeasuredSurface, polygon: BaseGeometry, places: Array | None = None
) -> tuple[SurfaceAreas, Array]:
    """Areas of the surface within a polygon that may have holes, and of its plan.

    Args:
        surface: that it is on.
        polygon: or several.
        places: (M, 2) next to it.

    Returns:
        The areas, and (M,) area of the surface over that of its plan at each place, 0 where it is
        not known and at places that are farther off than the polygon's bounds.

    Raises:
        ReconstructionError: it is too large, or no surface is known in it.
    """
    region = PolygonOnGrid(surface, polygon)
    sums = AreaSums(region, places)
    for block in region.blocks():
        sums.add(block)
    return sums.total(), sums.slant
