"""Figures of the surface inside of a polygon: areas, volume, slope, roughness."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import shapely
from rasterio.features import rasterize
from rasterio.transform import Affine
from shapely.geometry.base import BaseGeometry

from alice_survey.base.errors import ReconstructionError
from alice_survey.base.frames import Array
from reconstruct.measure.cells import (
    known_squares,
    lifted,
    mean_of_corners,
    own_variance,
    plan_slopes,
    sigma_of_means,
    spread_to_cells,
    surface_area,
)
from reconstruct.measure.errors import REACH_CELLS, FigureSlopes
from reconstruct.measure.figures import Measured, as_places, figure, of_points, plan_area, polyline
from reconstruct.measure.surface import MeasuredSurface, Samples

_BLOCK_CELLS = 512
_RIM = REACH_CELLS + 1
"""Cells around a block whose squares count for own errors in it."""
_MOST_CELLS = 10_000_000
_MOST_RIM_SAMPLES = 4000
_LEAST_SHARE = 0.5
"""Share of a rim, and of a quadrat, that must be there."""
_MOST_QUADRATS = 400

Base = float | Literal["rim"]
"""Plane of a volume: level at a height, or fitted to the heights along the polygon's rim."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _GridPart:
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


@dataclass(frozen=True, kw_only=True)
class Quadrat:
    """A square of the sea floor and its figures."""

    vertices: tuple[tuple[float, float], ...]
    figures: tuple[Measured, ...]


class _PolygonOnGrid:
    """A polygon on a surface."""

    def __init__(self, surface: MeasuredSurface, polygon: Any) -> None:
        self.surface, self.polygon = surface, polygon
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
        if cells > _MOST_CELLS:
            raise ReconstructionError(
                f"a polygon over {cells:,} cells: at most {_MOST_CELLS:,} are measured at once; "
                "measure it in parts"
            )

    @staticmethod
    def _cut(first: float, last: float, count: int) -> tuple[int, int]:
        return max(0, math.floor(first) - 1), min(count, math.ceil(last) + 2)

    def blocks(self) -> Iterator[_GridPart]:
        """Parts of the grid that cover it, each cell in the core of one."""
        for top in range(*self._rows, _BLOCK_CELLS):
            for left in range(*self._columns, _BLOCK_CELLS):
                rows = min(_BLOCK_CELLS, self._rows[1] - top)
                columns = min(_BLOCK_CELLS, self._columns[1] - left)
                yield self._block(top, left, rows, columns)

    def _block(self, top: int, left: int, rows: int, columns: int) -> _GridPart:
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
        return _GridPart(
            height=height, own=own, weight=inner, all_weight=weight,
            x=east - self.middle[0], y=north - self.middle[1], core=core,
        )  # fmt: skip

    def _shares(self, row: int, column: int, shape: tuple[int, int]) -> Array:
        """Share of each square between the middles of four cells that is within the polygon."""
        grid = self.surface.grid
        west, north = float(grid.east_of(column + 0.5)), float(grid.north_of(row + 0.5))
        cell = grid.cell
        fit = {"out_shape": shape, "transform": Affine(cell, 0, west, 0, -cell, north)}
        share = rasterize([(self.polygon, 1)], dtype="uint8", **fit).astype(np.float64)
        rim = rasterize([(self.polygon.boundary, 1)], all_touched=True, dtype="uint8", **fit)
        r, c = np.nonzero(rim)
        boxes = shapely.box(
            west + c * cell, north - (r + 1) * cell, west + (c + 1) * cell, north - r * cell
        )
        share[r, c] = shapely.area(shapely.intersection(boxes, self.polygon)) / cell**2
        found: Array = share
        return found

    def add(self, slopes: FigureSlopes, block: _GridPart, by_motion: Array) -> None:
        """Add a block's derivatives (rows, columns, 3)."""
        own = own_variance(by_motion[..., 2], block.own, block.core)
        east, north = (
            side + part for side, part in zip((block.x[0], block.y[:, 0]), self.middle, strict=True)
        )
        slopes.add_grid(east[block.core[1]], north[block.core[0]], by_motion[block.core], own)


@dataclass(frozen=True, kw_only=True, eq=False)
class _PolygonMoments:
    """Sums over the known squares of a polygon, about its middle."""

    share: float
    """Known, of the polygon's area."""
    area: float
    first: Array
    """(3,) sum of area times 1, x and y."""
    second: Array
    """(3, 3) sum over cells of weights times the products of 1, x and y."""
    heights: Array
    """(3,) the same of heights."""

    @property
    def fit(self) -> Array:
        """(3,) height in the middle, and slopes to the right and up, of the plane that fits."""
        return np.asarray(np.linalg.solve(self.second, self.heights), dtype=np.float64)


def _upright(block: _GridPart) -> Array:
    """(rows, columns, 3) 1, x and y of cells."""
    return np.stack([np.ones_like(block.x), block.x, block.y], axis=-1)


def _moments(region: _PolygonOnGrid) -> _PolygonMoments:
    cell = region.surface.grid.cell
    first, second, heights = np.zeros(3), np.zeros((3, 3)), np.zeros(3)
    for block in region.blocks():
        upright = _upright(block)
        middles = np.stack([mean_of_corners(upright[..., k]) for k in range(3)], axis=-1)
        first += cell**2 * (block.weight[..., None] * middles).sum(axis=(0, 1))
        weight = spread_to_cells(block.weight)
        used = weight > 0
        second += (weight[used, None] * upright[used]).T @ upright[used]
        heights += (weight[used] * block.height[used]) @ upright[used]
    return _PolygonMoments(
        share=first[0] / region.polygon.area, area=first[0], first=first, second=second,
        heights=heights,
    )  # fmt: skip


def measure_polygon(
    surface: MeasuredSurface, vertices: Sequence[Sequence[float]], base: Base | None = "rim"
) -> tuple[tuple[Measured, ...], tuple[str, ...]]:
    """Figures of the surface within a polygon.

    Args:
        surface: that it is on.
        vertices: three or more places, right (east) and up (north).
        base: plane of the volume; None for no volume.

    Returns:
        Figures, and what a reader must know of them.

    Raises:
        ReconstructionError: it crosses itself, is too large, or no surface is known in it.
    """
    places = as_places(vertices)
    region, moments = _known_part(surface, polygon_of(places))
    notes = []
    if moments.share < 0.999:
        notes.append(
            f"{moments.share:.1%} of the polygon is known: area of the surface, volume, slope and "
            "rugosity are of that part"
        )
    ring = _ring(surface, places)
    rim = None if base is None else _VolumePlane.of(surface, region, base)
    sums = _PolygonSums(region, moments, rim)
    figures = [
        of_points(surface, ring, "plan_area", "Area in plan", plan_area, 2),
        *sums.roughness,
        *sums.slope,
        figure(surface, "mean_height", "Mean height", sums.mean, sums.by_mean, 1),
        of_points(surface, ring, "perimeter", "Perimeter in plan", _outline, 1),
        *sums.volumes,
    ]
    if sums.noise > 0.1:
        notes.append(
            f"noise adds {sums.noise:.0%} to the area of the surface, which is taken away but for "
            "about as large a share of that: it is large for such small cells"
        )
    return tuple(figures), tuple(notes)


def roughness(surface: MeasuredSurface, polygon: BaseGeometry) -> tuple[Measured, Measured]:
    """Area of the surface within a polygon that may have holes, and its rugosity.

    Raises:
        ReconstructionError: it is too large, or no surface is known in it.
    """
    region, moments = _known_part(surface, polygon)
    return _PolygonSums(region, moments, None).roughness


def _known_part(surface: MeasuredSurface, polygon: Any) -> tuple[_PolygonOnGrid, _PolygonMoments]:
    region = _PolygonOnGrid(surface, polygon)
    moments = _moments(region)
    if not moments.area > 0:
        raise ReconstructionError("no surface is known within the polygon: draw it on the surface")
    return region, moments


def _outline(points: Array) -> float:
    return polyline(points[:, :2])


def _ring(surface: MeasuredSurface, places: Array) -> Samples:
    """Corners and the first again; own errors count where heights are known."""
    found = surface.picked(np.concatenate([places, places[:1]]))
    known = np.isfinite(found.height)
    height, own = np.where(known, found.height, 0.0), np.where(known[:, None], found.own, 0.0)
    return replace(found, height=height, own=own)


def polygon_of(places: Array) -> Any:
    """A polygon of three or more places.

    Raises:
        ReconstructionError: it has no area, or crosses itself.
    """
    if len(places) < 3:
        raise ReconstructionError("a polygon needs three places that differ")
    polygon = shapely.Polygon(places)
    if not polygon.is_valid or not polygon.area > 0:
        raise ReconstructionError(
            "the polygon crosses itself or has no area: draw its corners in order"
        )
    return polygon


class _VolumePlane:
    """The plane of a volume."""

    def __init__(self, plane: Array, samples: Samples | None, by_height: Array) -> None:
        self.plane = plane
        """(3,) height in the middle, and slopes."""
        self._samples, self._by_height = samples, by_height

    @classmethod
    def of(cls, surface: MeasuredSurface, region: _PolygonOnGrid, base: Base) -> "_VolumePlane":
        """At a height, or fitted to the rim."""
        if base != "rim":
            return cls(np.array([float(base), 0.0, 0.0]), None, np.zeros((3, 0)))
        ring = region.polygon.exterior
        step = max(surface.grid.cell, ring.length / _MOST_RIM_SAMPLES)
        count = max(3, math.ceil(ring.length / step))
        places = shapely.get_coordinates(
            shapely.line_interpolate_point(ring, np.arange(count) / count, normalized=True)
        )
        known = np.isfinite(surface.at(places).height)
        if known.mean() < _LEAST_SHARE or known.sum() < 3:
            raise ReconstructionError(
                f"only {known.mean():.0%} of the polygon's rim has a height, too little to fit the "
                "plane of the volume to it: give the plane's height, or draw the rim on the surface"
            )
        samples = surface.at(places[known])
        x, y = (samples.places - region.middle).T
        by_height = np.linalg.pinv(np.column_stack([np.ones(len(x)), x, y]))
        return cls(by_height @ samples.height, samples, by_height)

    def moves(self, slopes: FigureSlopes, by_plane: Array) -> None:
        """Add to a figure what moves the plane, from derivatives (3,) by its parameters."""
        if self._samples is None:
            return
        up = by_plane @ self._by_height
        motion = np.column_stack([np.zeros((len(up), 2)), up])
        slopes.add(self._samples.places, motion, self._samples.own_variance(motion))


class _PolygonSums:
    """All sums over a polygon, in one pass."""

    def __init__(
        self, region: _PolygonOnGrid, moments: _PolygonMoments, rim: _VolumePlane | None
    ) -> None:
        surface = self._surface = region.surface
        errors, cell = surface.errors, surface.grid.cell
        self._moments, self._rim = moments, rim
        self.by_surface, self.by_area, self.by_mean = (FigureSlopes(errors) for _ in range(3))
        self._by_slopes = [FigureSlopes(errors) for _ in range(2)]
        self._by_volume = {name: FigureSlopes(errors) for name in ("volume", "above", "below")}
        self._volume = dict.fromkeys(self._by_volume, 0.0)
        by_plane = {name: np.zeros(3) for name in self._by_volume}
        lift = added = scatter = self.surface = 0.0
        fit = moments.fit
        inverse = np.linalg.inv(moments.second)
        steep = float(np.hypot(fit[1], fit[2]))
        # steepness in degrees and the way down, by the slopes to the right and up
        turn = np.array([[fit[1], fit[2]], [-fit[2], fit[1]]]) / max(steep, 1e-300)
        turn[0] /= 1.0 + steep**2
        turn[1] /= -max(steep, 1e-300)
        turn = np.rad2deg(turn)
        for block in region.blocks():
            found = surface_area(block.height, block.own, block.all_weight, cell)
            self.surface += float(np.nansum(block.weight * np.nan_to_num(found.area)))
            added += float(np.nansum(block.weight * np.nan_to_num(found.added)))
            region.add(self.by_surface, block, found.slopes)
            scatter += found.scatter(block.weight)
            region.add(self.by_area, block, plan_slopes(block.all_weight, cell))
            upright = _upright(block)
            weight = spread_to_cells(block.all_weight)
            by_fit = weight[..., None] * upright @ inverse
            region.add(self.by_mean, block, _by_height(by_fit[..., 0]))
            for slopes, way in zip(self._by_slopes, turn, strict=True):
                region.add(slopes, block, _by_height(by_fit[..., 1:] @ way))
            if rim is not None:
                over = np.nan_to_num(mean_of_corners(block.height - upright @ rim.plane))
                lift += float(
                    (block.weight * lifted(over, np.nan_to_num(sigma_of_means(block.own)))).sum()
                )
                parts = (np.ones_like(over), 1.0 * (over > 0), -1.0 * (over < 0))
                for name, part in zip(self._by_volume, parts, strict=True):
                    self._volume[name] += cell**2 * float((block.weight * part * over).sum())
                    moved = _by_height(cell**2 * spread_to_cells(block.all_weight * part))
                    wider = plan_slopes(block.all_weight * part * over, cell)
                    region.add(self._by_volume[name], block, moved + wider)
                    middles = np.stack([mean_of_corners(upright[..., k]) for k in range(3)], -1)
                    share = (block.weight * part)[..., None] * middles
                    by_plane[name] -= cell**2 * share.sum(axis=(0, 1))
        self.by_surface.count_once(scatter)
        if rim is not None:
            for name, slopes in self._by_volume.items():
                rim.moves(slopes, by_plane[name])
        self._lift, self._fit, self._steep = cell**2 * lift, fit, steep
        self.mean = float(moments.heights[0] / moments.second[0, 0])
        self.noise = added / moments.area

    @property
    def roughness(self) -> tuple[Measured, Measured]:
        """Area of the surface, and that over the area in plan."""
        surface, plan = self._surface, self._moments.area
        ratio, both = self.surface / plan, FigureSlopes(surface.errors)
        both.add_times(1.0 / plan, self.by_surface)
        both.add_times(-ratio / plan, self.by_area)
        return (
            figure(surface, "surface_area", "Area of the surface", self.surface,
                   self.by_surface, 2),
            figure(surface, "rugosity", "Rugosity, surface over plan", ratio, both, 0),
        )  # fmt: skip

    @property
    def slope(self) -> tuple[Measured, Measured]:
        """Steepness of the plane that fits best, and the direction down it."""
        down = math.degrees(math.atan2(-self._fit[1], -self._fit[2])) % 360.0
        steep = math.degrees(math.atan(self._steep))
        names = (("slope", "Slope of the plane that fits", steep),
                 ("aspect", "Aspect, the way down from north or up", down))  # fmt: skip
        first, second = (
            figure(self._surface, name, title, value, slopes, 0, "°")
            for (name, title, value), slopes in zip(names, self._by_slopes, strict=True)
        )
        return first, second

    @property
    def volumes(self) -> tuple[Measured, ...]:
        """Volume over the plane, and its parts above and below, which noise near it lifts."""
        if self._rim is None:
            return ()
        titles = {"volume": "Volume above minus below the plane",
                  "above": "Volume above the plane", "below": "Volume below the plane"}  # fmt: skip
        found = []
        for name, title in titles.items():
            one = figure(self._surface, name, title, self._volume[name], self._by_volume[name], 3)
            if name != "volume":
                one = Measured(**{**vars(one), "own": math.hypot(one.own, self._lift)})
            found.append(one)
        return tuple(found)


def _by_height(slopes: Array) -> Array:
    """Derivatives by motions, of a figure that heights alone move."""
    found = np.zeros((*slopes.shape, 3))
    found[..., 2] = slopes
    return found


def quadrats(
    surface: MeasuredSurface, vertices: Sequence[Sequence[float]], side: float
) -> tuple[Quadrat, ...]:
    """Areas and rugosity of the squares that at least half lie within a polygon.

    Args:
        surface: that it is on.
        vertices: of the polygon.
        side: of a quadrat.

    Raises:
        ReconstructionError: there are too many, or none lies within the polygon.
    """
    if not side >= 2 * surface.grid.cell:
        raise ReconstructionError(
            f"quadrats of {side:g} {surface.unit} on cells of {surface.grid.cell:g}: make them at "
            "least two cells wide"
        )
    polygon = polygon_of(as_places(vertices))
    west, south, east, north = polygon.bounds
    columns, rows = (max(1, math.ceil(w / side - 1e-9)) for w in (east - west, north - south))
    if rows * columns > _MOST_QUADRATS:
        raise ReconstructionError(
            f"{rows * columns:,} quadrats of {side:g} {surface.unit}: at most {_MOST_QUADRATS} are "
            "measured; make them larger"
        )
    found = []
    for row in range(rows):
        for column in range(columns):
            box = shapely.box(
                west + column * side, south + row * side,
                west + (column + 1) * side, south + (row + 1) * side,
            )  # fmt: skip
            if box.intersection(polygon).area < _LEAST_SHARE * box.area:
                continue
            corners = tuple((float(x), float(y)) for x, y in box.exterior.coords[:4])
            try:
                figures, _ = measure_polygon(surface, corners, None)
            except ReconstructionError:
                continue  # nothing is known there
            named = {one.name: one for one in figures}
            kept = ("plan_area", "surface_area", "rugosity")
            found.append(Quadrat(vertices=corners, figures=tuple(named[name] for name in kept)))
    if not found:
        raise ReconstructionError(
            f"no quadrat of {side:g} {surface.unit} lies within the polygon: make it larger, or "
            "the side smaller"
        )
    return tuple(found)
