"""Fusing the points of all views into the surface, tile by tile of the ground.

What stands in free space is no surface. Next to the outline of a body matching carries its depth on
over what is behind or nothing, the same way in all views from about there, which confirm each
other. Views from other sides see the body itself beyond such a point.

Errors of poses are the share of the surface's error that fusing views leaves. Depths of one place
from many views share errors, since they rest on the same poses. How much is known at every sparse
point: its covariance from the adjustment (`sparse/covariance.npz`), which holds poses and pixels
together, minus what its own observations leave with poses held. The rest is what the poses around
it do to a surface there.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.windows import Window
from scipy.spatial import cKDTree

from alice_survey.core.compiled import compiled
from alice_survey.core.errors import warn
from alice_survey.core.frames import Array
from alice_survey.core.run import progress
from reconstruct.dense.points import EDGE_ON, Points, join_points, part_in_box, points_in_box
from reconstruct.dense.surface_points import PART_REACH_CELLS, SURFACE_POINT, fuse_surface, settle
from reconstruct.dense.view_store import CHECKED, FACTORS, StoredDepth, ViewStore
from reconstruct.planes import Plane
from reconstruct.raster import DemGrid, tiles_reached
from reconstruct.views.model import SparseModel, View

_COMPANY = 16
"""Sparse points around a spot of which the median counts: a single one may be a wrong match."""
_CHUNK = 50_000


@dataclass(frozen=True, kw_only=True, eq=False)
class ErrorsOfPoses:
    """What errors of poses do to sparse points."""

    points_world: Array
    """(P, 3)."""
    covariances: Array
    """(P, 3, 3)."""

    def median_along(self, normal_world: Array) -> float:
        """Standard deviation along a direction at half of the points or less."""
        return float(np.sqrt(np.median(_along(self.covariances, normal_world))))

    def around(self, low: Array, high: Array) -> "ErrorsOfPoses":
        """Those of the points around a box, of south and west (2,) to north and east (2,)."""
        margin = float(np.max(high - low))
        while True:
            reach = margin + float(np.max(high - low))
            near = np.array(self._level_tree.query_ball_point(low, reach, p=np.inf), np.int64)
            place = self.points_world[near, :2]
            near = near[((place > low - margin) & (place < high + margin)).all(axis=1)]
            if len(near) >= min(_COMPANY, len(self.points_world)):
                near.sort()
                return ErrorsOfPoses(
                    points_world=self.points_world[near], covariances=self.covariances[near]
                )
            margin *= 2.0

    def at(self, points_world: Array, normals_world: Array, block: float) -> Array:
        """Standard deviations (N,) of a surface's points along its normals.

        Args:
            points_world: (N, 3).
            normals_world: (N, 3) unit vectors.
            block: side of cubes whose points share the sparse points around.
        """
        cubes, of_point = np.unique(np.floor(points_world / block), axis=0, return_inverse=True)
        count = min(_COMPANY, len(self.points_world))
        near = np.asarray(self._tree.query((cubes + 0.5) * block, k=count)[1])
        near = near.reshape(len(cubes), count)[of_point.reshape(-1)]
        found = np.empty(len(points_world))
        for start in range(0, len(found), _CHUNK):
            part = slice(start, start + _CHUNK)
            covariances = self.covariances[near[part]]
            found[part] = np.median(_along(covariances, normals_world[part, None]), axis=1)
        return np.sqrt(found)

    @cached_property
    def _level_tree(self) -> cKDTree:
        return cKDTree(self.points_world[:, :2])

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.points_world)


def _along(covariances: Array, directions: Array) -> Array:
    """Variances (...,) along directions (..., 3) of covariances (..., 3, 3)."""
    found = np.einsum("...i,...ij,...j->...", directions, covariances, directions)
    return np.asarray(np.maximum(found, 0.0))


@progress.step("find what poses add to errors")
def find_errors_of_poses(workspace: Path, model: SparseModel) -> ErrorsOfPoses | None:
    """What poses do to points; None, with a warning, where it is not known."""
    path = workspace / "sparse" / "covariance.npz"
    if not path.is_file():
        warn("no sparse/covariance.npz: sigma.tif leaves out what errors of poses do to heights")
        return None
    from reconstruct.adjustment.uncertainty import read_uncertainty

    known = read_uncertainty(path)
    if len(known.point_ids) != len(model.points_world):
        warn("sparse/covariance.npz is not of this model: sigma.tif leaves out errors of poses")
        return None
    own = known.point_cov - known.point_noise
    seen = np.isfinite(own).all(axis=(1, 2))
    if not seen.any():
        warn("sparse/covariance.npz knows no point: sigma.tif leaves out errors of poses")
        return None
    return ErrorsOfPoses(points_world=model.points_world[seen], covariances=own[seen])


Float32 = NDArray[np.float32]

_GATE = 3.0
"""Depths that differ by no more than this many standard deviations of their difference agree."""
_MIN_KNOWN = 5
"""Of the nine pixels around a spot, for a view to see through it."""
_HERE, _THROUGH = 1, 2


def look_at_points(
    points_world: Array, sigmas: Float32, view: View, depth: StoredDepth, factor: float, cell: float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which points a view finds at their place, and which it sees through.

    A view finds a point where any of the nine pixels around shows the point's depth, and sees
    through it where all that are known show something beyond.

    Args:
        points_world: (N, 3).
        sigmas: (N,) of the points.
        view: that looks.
        depth: (H, W) of the view.
        factor: on its standard deviations.
        cell: distance between neighbouring points of the surface.

    Returns:
        (N,) whether the view finds the point, and (N,) whether it sees through it.
    """
    z = view.world_from_cam.inv().apply(points_world)[:, 2].copy()
    pixels = np.nan_to_num(view.project(points_world), nan=-1.0)
    codes = look_around(z, pixels, np.array(sigmas), depth, factor, cell)
    return codes == _HERE, codes == _THROUGH


@compiled(error_model="numpy")
def look_around(
    z: Array, pixels: Array, sigmas: Float32, depth: StoredDepth, factor: float, cell: float
) -> NDArray[np.int8]:
    """See `look_at_points`, of points (N,) at depths and pixels (N, 2) of a view."""
    levels, shares, depth_of, share_of = depth
    found = np.zeros(z.size, np.int8)
    for i in range(z.size):
        column, row = math.floor(pixels[i, 0]), math.floor(pixels[i, 1])
        if not (1 <= column < levels.shape[1] - 1 and 1 <= row < levels.shape[0] - 1):
            continue
        known, beyond = 0, 0
        for k in range(9):
            at = row - 1 + k // 3, column - 1 + k % 3
            if levels[at] == 0:
                continue
            there = depth_of[levels[at]]
            reach = cell + _GATE * math.hypot(sigmas[i], factor * there * share_of[shares[at]])
            known += 1
            beyond += there > z[i]
            if abs(there - z[i]) <= reach:
                found[i] = _HERE
                break
        if found[i] == 0 and known >= _MIN_KNOWN and beyond == known:
            found[i] = _THROUGH
    return found


_TILE_CELLS = 256
_WORST_CELLS = 4.0
"""Depths less certain than this many cells are left out: rig stereo from afar, mostly."""
_RIM_CELLS = int(PART_REACH_CELLS) + 1
_NAME = "surface"


@dataclass(frozen=True, kw_only=True)
class ViewSummary:
    """Where the points of a view lie."""

    bounds: tuple[float, float, float, float] | None
    """South, west, north, east; None where no depth was found."""
    up: float
    """Median height of its points."""
    footprint: float
    """Side of a pixel on the ground."""
    sigma: float
    """Median standard deviation of its depth."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FuseSetup:
    """What all tiles share."""

    store: ViewStore
    """With the depth of every view, and the factors of its light."""
    stations: NDArray[np.int64]
    """(V,) station of every view."""
    planes: tuple[Plane, ...]
    offset_enu: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Origin near the points."""
    sigma_factor: float
    """On the standard deviations of refined depths."""
    shared: float
    """Views whose depths rest on the same pair of pictures, in the mean, 1 to 2."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FuseTask:
    """One tile of the ground to fuse."""

    number: int
    grid: DemGrid
    views: tuple[tuple[int, View], ...]
    """Those whose points may fall in it and in its rim."""
    poses: ErrorsOfPoses | None
    """Around the tile."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceTile:
    """A tile of the surface that is in the store."""

    number: int
    count: int
    corners_enu: Array
    """(8, 3) of the box around its points."""
    bounds: Mapping[str, tuple[float, float, float, float]]
    """South, west, north, east, in planes by name, of what faces their viewers."""

    def points(self, store: ViewStore) -> NDArray[Any]:
        """(count,) records of `SURFACE_POINT`, from the offset of all tiles."""
        return np.asarray(store.load(self.number, _NAME))


def reach_tiles(grid: DemGrid, summaries: Sequence[ViewSummary]) -> list[tuple[Window, list[int]]]:
    """Tiles of a grid, in rows, and the views whose points may fall in each."""
    boxes = np.array([summary.bounds or (np.nan,) * 4 for summary in summaries])[:, [1, 0, 3, 2]]
    return tiles_reached(grid, _TILE_CELLS, boxes, _RIM_CELLS * grid.cell)


def fuse_tasks(
    grid: DemGrid,
    reached: Sequence[tuple[Window, Sequence[int]]],
    views: Sequence[View],
    poses: ErrorsOfPoses | None,
) -> Iterator[FuseTask]:
    """Tasks of `reach_tiles`, each made when it is asked for: what is around a tile is a copy."""
    for number, (window, seeing) in enumerate(reached):
        row, column = int(window.row_off), int(window.col_off)
        tile = grid.window(row, column, int(window.height), int(window.width))
        low, high = _corners(tile)
        near = None if poses is None else poses.around(low[::-1], high[::-1])
        pairs = tuple((index, views[index]) for index in seeing)
        yield FuseTask(number=number, grid=tile, views=pairs, poses=near)


def _corners(grid: DemGrid) -> tuple[Array, Array]:
    """West and south, and east and north, of a grid."""
    south, east = float(grid.north_of(grid.rows)), float(grid.east_of(grid.columns))
    return np.array([grid.west, south]), np.array([east, grid.north])


def fuse_tile(setup: FuseSetup, task: FuseTask) -> SurfaceTile:
    """Fuse the points of all views in a tile, and keep them in the store."""
    offset = np.array(setup.offset_enu)
    grid = task.grid.translate(-offset[0], -offset[1])
    low, high = _corners(grid)
    rim = _RIM_CELLS * grid.cell
    points = _points_over(setup, task, offset, (low - rim, high + rim))
    origin = np.array([grid.west, grid.north, 0.0])
    surface = fuse_surface(points, setup.stations, grid.cell, origin, setup.shared)
    surface = surface[~_seen_through(setup, task, offset, surface)]
    surface = settle(surface, grid.cell, low - rim, high + rim)
    place = surface["enu"][:, :2].astype(np.float64)
    surface = surface[((place >= low) & (place < high)).all(axis=1)]
    enu = surface["enu"] + offset
    ned, normals = (_swap_axes(one) for one in (enu, surface["normal"].astype(np.float64)))
    if task.poses is not None and len(surface):
        surface["shared"] = task.poses.at(ned, normals, _RIM_CELLS * grid.cell)
    setup.store.save(task.number, _NAME, surface)
    bounds = {}
    for plane in setup.planes:
        facing = normals @ plane.normal_world >= EDGE_ON
        if facing.any():
            on_plane = plane.plane_from_world.apply(ned[facing])[:, :2]
            minimum, maximum = on_plane.min(axis=0), on_plane.max(axis=0)
            bounds[plane.name] = (*minimum.tolist(), *maximum.tolist())
    box = np.array([enu.min(axis=0), enu.max(axis=0)]) if len(enu) else np.full((2, 3), np.nan)
    corners = np.stack(np.meshgrid(*box.T, indexing="ij"), axis=-1).reshape(-1, 3)
    return SurfaceTile(number=task.number, count=len(surface), corners_enu=corners, bounds=bounds)


def _swap_axes(enu: Array) -> Array:
    """North, east, down of east, north, up, or the other way round."""
    return enu[:, [1, 0, 2]] * [1.0, 1.0, -1.0]


def on_plane(
    setup: FuseSetup, tiles: Sequence[SurfaceTile], plane: Plane, origin: Array
) -> NDArray[Any]:
    """Points of tiles in the coordinates of a plane: right, up, out, from an origin (3,) in it."""
    surface = np.concatenate(
        [np.empty(0, SURFACE_POINT), *(tile.points(setup.store) for tile in tiles)]
    )
    ned = _swap_axes(surface["enu"] + np.array(setup.offset_enu))
    turned = plane.plane_from_world.rotation.apply(_swap_axes(surface["normal"].astype(np.float64)))
    surface["enu"] = _swap_axes(plane.plane_from_world.apply(ned)) - origin
    surface["normal"] = _swap_axes(turned)
    return surface


def boxes_on(tiles: Sequence[SurfaceTile], plane: Plane) -> Array:
    """(T, 4) least and most right and up in a plane of the points of tiles; NaN of none."""
    corners = np.concatenate([tile.corners_enu for tile in tiles])
    places = _swap_axes(plane.plane_from_world.apply(_swap_axes(corners)))[:, :2].reshape(-1, 8, 2)
    return np.concatenate([places.min(axis=1), places.max(axis=1)], axis=1)


def _seen_through(
    setup: FuseSetup, task: FuseTask, offset: Array, surface: NDArray[Any]
) -> NDArray[np.bool_]:
    """Which points of a tile more views see through than find."""
    found, through = (np.zeros(len(surface), np.int64) for _ in range(2))
    points = _swap_axes(surface["enu"] + offset)
    for index, view in task.views:
        depth, cell = setup.store.stored_depth(index, "fine"), task.grid.cell
        at, beyond = look_at_points(points, surface["sigma"], view, depth, setup.sigma_factor, cell)
        found += at
        through += beyond
    return through > found


def _points_over(
    setup: FuseSetup, task: FuseTask, offset: Array, box: tuple[Array, Array]
) -> Points:
    """The confirmed points of all views in a box (west and south, east and north)."""
    store, (low, high) = setup.store, box
    sides = (low[0], high[0], low[1], high[1])
    found, factors = [], store.load(0, FACTORS)
    for index, view in task.views:
        blocks = np.asarray(store.load(index, CHECKED)["blocks"])
        part = part_in_box(view, offset, sides, blocks)
        if part is None:
            continue
        depth, sigma = store.load_depth(index, "fine", part)
        sigma *= np.float32(setup.sigma_factor)
        with np.errstate(invalid="ignore"):
            sure = sigma <= _WORST_CELLS * task.grid.cell
        kept = store.load_mask(index, CHECKED, "inside", view.pinhole.width_px, part) & sure
        maps = depth, sigma, kept, store.load_colour(index, part), np.array(factors[index])
        found.append(points_in_box(view, index, *maps, offset, sides, blocks, part))
    return join_points(found)
