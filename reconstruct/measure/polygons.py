"""Figures of the surface inside of a polygon: areas, volume, slope, roughness."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import shapely

from alice_survey.core.errors import ReconstructionError
from alice_survey.core.frames import Array
from reconstruct.measure.areas import (
    NOTHING_KNOWN,
    AreaSums,
    GridPart,
    PolygonOnGrid,
    mean_of_corners,
    noise_lift,
    plan_slopes,
    sigma_of_means,
    spread_to_cells,
)
from reconstruct.measure.errors import FigureSlopes
from reconstruct.measure.figures import Measured, as_places, figure, of_points, plan_area, polyline
from reconstruct.measure.surface import MeasuredSurface, Samples

_MAX_RIM_SAMPLES = 4000
_MIN_SHARE = 0.5
"""Share of a rim, and of a quadrat, that must be there."""
_MAX_QUADRATS = 400

Base = float | Literal["rim"]
"""Plane of a volume: level at a height, or fitted to the heights along the polygon's rim."""


@dataclass(frozen=True, kw_only=True)
class Quadrat:
    """A square of the sea floor and its figures."""

    vertices: tuple[tuple[float, float], ...]
    figures: tuple[Measured, ...]


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


def _upright(block: GridPart) -> Array:
    """(rows, columns, 3) 1, x and y of cells."""
    return np.stack([np.ones_like(block.x), block.x, block.y], axis=-1)


def _moments(region: PolygonOnGrid) -> _PolygonMoments:
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
    region = PolygonOnGrid(surface, polygon_of(places))
    moments = _moments(region)
    if not moments.area > 0:
        raise ReconstructionError(NOTHING_KNOWN)
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
        *sums.areas.figures(surface),
        *sums.slope,
        figure(surface, "mean_height", "Mean height", sums.mean, sums.by_mean.packed, 1),
        of_points(surface, ring, "perimeter", "Perimeter in plan", _outline, 1),
        *sums.volumes,
    ]
    if sums.areas.noise > 0.1:
        notes.append(
            f"noise adds {sums.areas.noise:.0%} to the area of the surface, which is taken away "
            "but for about as large a share of that: it is large for such small cells"
        )
    return tuple(figures), tuple(notes)


def _outline(points: Array) -> float:
    return polyline(points[:, :2])


def _ring(surface: MeasuredSurface, places: Array) -> Samples:
    """Corners and the first again; own errors count where heights are known."""
    found = surface.at_picks(np.concatenate([places, places[:1]]))
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
    def of(cls, surface: MeasuredSurface, region: PolygonOnGrid, base: Base) -> "_VolumePlane":
        """At a height, or fitted to the rim."""
        if base != "rim":
            return cls(np.array([float(base), 0.0, 0.0]), None, np.zeros((3, 0)))
        ring = region.polygon.exterior
        step = max(surface.grid.cell, ring.length / _MAX_RIM_SAMPLES)
        count = max(3, math.ceil(ring.length / step))
        places = shapely.get_coordinates(
            shapely.line_interpolate_point(ring, np.arange(count) / count, normalized=True)
        )
        known = np.isfinite(surface.at(places).height)
        if known.mean() < _MIN_SHARE or known.sum() < 3:
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
        self, region: PolygonOnGrid, moments: _PolygonMoments, rim: _VolumePlane | None
    ) -> None:
        surface = self._surface = region.surface
        errors, cell = surface.errors, surface.grid.cell
        self._rim = rim
        gathered, self.by_mean = AreaSums(region), FigureSlopes(errors)
        self._by_slopes = [FigureSlopes(errors) for _ in range(2)]
        self._by_volume = {name: FigureSlopes(errors) for name in ("volume", "above", "below")}
        self._volume = dict.fromkeys(self._by_volume, 0.0)
        by_plane = {name: np.zeros(3) for name in self._by_volume}
        lift = 0.0
        fit = moments.fit
        inverse = np.linalg.inv(moments.second)
        steep = float(np.hypot(fit[1], fit[2]))
        # steepness in degrees and the way down, by the slopes to the right and up
        turn = np.array([[fit[1], fit[2]], [-fit[2], fit[1]]]) / max(steep, 1e-300)
        turn[0] /= 1.0 + steep**2
        turn[1] /= -max(steep, 1e-300)
        turn = np.rad2deg(turn)
        for block in region.blocks():
            gathered.add(block)
            upright = _upright(block)
            weight = spread_to_cells(block.all_weight)
            by_fit = weight[..., None] * upright @ inverse
            region.add(self.by_mean, block, _by_height(by_fit[..., 0]))
            for slopes, way in zip(self._by_slopes, turn, strict=True):
                region.add(slopes, block, _by_height(by_fit[..., 1:] @ way))
            if rim is not None:
                over = np.nan_to_num(mean_of_corners(block.height - upright @ rim.plane))
                lift += float(
                    (
                        block.weight * noise_lift(over, np.nan_to_num(sigma_of_means(block.own)))
                    ).sum()
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
        self.areas = gathered.total()
        if rim is not None:
            for name, slopes in self._by_volume.items():
                rim.moves(slopes, by_plane[name])
        self._lift, self._fit, self._steep = cell**2 * lift, fit, steep
        self.mean = float(moments.heights[0] / moments.second[0, 0])

    @property
    def slope(self) -> tuple[Measured, Measured]:
        """Steepness of the plane that fits best, and the direction down it."""
        down = math.degrees(math.atan2(-self._fit[1], -self._fit[2])) % 360.0
        steep = math.degrees(math.atan(self._steep))
        names = (("slope", "Slope of the plane that fits", steep),
                 ("aspect", "Aspect, the way down from north or up", down))  # fmt: skip
        first, second = (
            figure(self._surface, name, title, value, slopes.packed, 0, "°")
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
            by_volume = self._by_volume[name].packed
            one = figure(self._surface, name, title, self._volume[name], by_volume, 3)
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
    if rows * columns > _MAX_QUADRATS:
        raise ReconstructionError(
            f"{rows * columns:,} quadrats of {side:g} {surface.unit}: at most {_MAX_QUADRATS} are "
            "measured; make them larger"
        )
    found = []
    for row in range(rows):
        for column in range(columns):
            box = shapely.box(
                west + column * side, south + row * side,
                west + (column + 1) * side, south + (row + 1) * side,
            )  # fmt: skip
            if box.intersection(polygon).area < _MIN_SHARE * box.area:
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
