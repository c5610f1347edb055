"""Fusing the points of all views into the surface, tile by tile of the ground."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.windows import Window

from alice_survey.core.frames import Array
from reconstruct.dense.free_space import look_at_points
from reconstruct.dense.points import EDGE_ON, Points, joined, part_in_box, points_in_box
from reconstruct.dense.pose_part import ErrorsOfPoses
from reconstruct.dense.surface_points import PART_REACH_CELLS, SURFACE_POINT, fuse_surface, settled
from reconstruct.dense.view_store import ViewStore
from reconstruct.planes import Plane
from reconstruct.raster import DemGrid, tiles_reached
from reconstruct.views.model import View, enu_from_cam

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
    offset_enu: tuple[float, float, float]
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


@dataclass(frozen=True, kw_only=True, eq=False)
class FuseTasks:
    """Tasks of all tiles, each made when it is asked for: what is around a tile is a copy."""

    grid: DemGrid
    reached: Sequence[tuple[Window, Sequence[int]]]
    """Tiles, and the numbers of the views whose points may fall in each."""
    views: Sequence[View]
    poses: ErrorsOfPoses | None

    def __len__(self) -> int:
        return len(self.reached)

    def __iter__(self) -> Iterator[FuseTask]:
        for number, (window, seeing) in enumerate(self.reached):
            row, column = int(window.row_off), int(window.col_off)
            tile = self.grid.window(row, column, int(window.height), int(window.width))
            low, high = _corners(tile)
            near = None if self.poses is None else self.poses.around(low[::-1], high[::-1])
            pairs = tuple((index, self.views[index]) for index in seeing)
            yield FuseTask(number=number, grid=tile, views=pairs, poses=near)


def fuse_tasks(
    grid: DemGrid,
    views: Sequence[View],
    summaries: Sequence[ViewSummary],
    poses: ErrorsOfPoses | None,
) -> FuseTasks:
    """Tiles of a grid that points of views may fall in, in rows."""
    boxes = np.array([summary.bounds or (np.nan,) * 4 for summary in summaries])[:, [1, 0, 3, 2]]
    reached = tiles_reached(grid, _TILE_CELLS, boxes, _RIM_CELLS * grid.cell)
    return FuseTasks(grid=grid, reached=reached, views=views, poses=poses)


def _corners(grid: DemGrid) -> tuple[Array, Array]:
    """West and south, and east and north, of a grid."""
    south, east = float(grid.north_of(grid.rows)), float(grid.east_of(grid.columns))
    return np.array([grid.west, south]), np.array([east, grid.north])


def fuse_tile(setup: FuseSetup, task: FuseTask) -> SurfaceTile:
    """Fuse the points of all views in a tile, and keep them in the store."""
    offset = np.array(setup.offset_enu)
    grid = task.grid.moved(-offset[0], -offset[1])
    low, high = _corners(grid)
    rim = _RIM_CELLS * grid.cell
    points = _points_over(setup, task, offset, (low - rim, high + rim))
    origin = np.array([grid.west, grid.north, 0.0])
    surface = fuse_surface(points, setup.stations, grid.cell, origin, setup.shared)
    surface = surface[~_seen_through(setup, task, offset, surface)]
    surface = settled(surface, grid.cell, low - rim, high + rim)
    place = surface["enu"][:, :2].astype(np.float64)
    surface = surface[((place >= low) & (place < high)).all(axis=1)]
    enu = surface["enu"] + offset
    ned, normals = (_swapped(one) for one in (enu, surface["normal"].astype(np.float64)))
    if task.poses is not None and len(surface):
        surface["shared"] = task.poses.at(ned, normals, _RIM_CELLS * grid.cell)
    setup.store.save(task.number, _NAME, surface)
    bounds = {}
    for plane in setup.planes:
        facing = normals @ plane.normal_world >= EDGE_ON
        if facing.any():
            on_plane = plane.plane_from_world.apply(ned[facing])[:, :2]
            minimum, maximum = on_plane.min(axis=0), on_plane.max(axis=0)
            bounds[plane.name] = (
                float(minimum[0]), float(minimum[1]), float(maximum[0]), float(maximum[1])
            )  # fmt: skip
    box = np.array([enu.min(axis=0), enu.max(axis=0)]) if len(enu) else np.full((2, 3), np.nan)
    corners = np.stack(np.meshgrid(*box.T, indexing="ij"), axis=-1).reshape(-1, 3)
    return SurfaceTile(number=task.number, count=len(surface), corners_enu=corners, bounds=bounds)


def _swapped(enu: Array) -> Array:
    """North, east, down of east, north, up, or the other way round."""
    swapped: Array = enu[:, [1, 0, 2]] * [1.0, 1.0, -1.0]
    return swapped


def on_plane(
    setup: FuseSetup, tiles: Sequence[SurfaceTile], plane: Plane, origin: Array
) -> NDArray[Any]:
    """Points of tiles in the coordinates of a plane: right, up, out, from an origin (3,) in it."""
    surface = np.concatenate(
        [np.empty(0, SURFACE_POINT), *(tile.points(setup.store) for tile in tiles)]
    )
    ned = _swapped(surface["enu"] + np.array(setup.offset_enu))
    turned = plane.plane_from_world.rotation.apply(_swapped(surface["normal"].astype(np.float64)))
    surface["enu"] = _swapped(plane.plane_from_world.apply(ned)) - origin
    surface["normal"] = _swapped(turned)
    return surface


def boxes_on(tiles: Sequence[SurfaceTile], plane: Plane) -> Array:
    """(T, 4) least and most right and up in a plane of the points of tiles; NaN of none."""
    corners = np.concatenate([tile.corners_enu for tile in tiles])
    places = _swapped(plane.plane_from_world.apply(_swapped(corners)))[:, :2].reshape(-1, 8, 2)
    return np.concatenate([places.min(axis=1), places.max(axis=1)], axis=1)


def _seen_through(
    setup: FuseSetup, task: FuseTask, offset: Array, surface: NDArray[Any]
) -> NDArray[np.bool_]:
    """Which points of a tile more views see through than find."""
    found, through = (np.zeros(len(surface), np.int64) for _ in range(2))
    points, sigmas = (np.ascontiguousarray(surface[name]) for name in ("enu", "sigma"))
    for index, view in task.views:
        depth = setup.store.stored_depth(index, "fine")
        to_enu = np.vstack([enu_from_cam(view, offset), [0.0, 0.0, 0.0, 1.0]])
        to_cam = np.ascontiguousarray(np.linalg.inv(to_enu)[:3])
        at, beyond = look_at_points(
            points, sigmas, to_cam, depth, setup.sigma_factor, view.kernel_lens, task.grid.cell
        )
        found += at
        through += beyond
    return through > found


def _points_over(
    setup: FuseSetup, task: FuseTask, offset: Array, box: tuple[Array, Array]
) -> Points:
    """The confirmed points of all views in a box (west and south, east and north)."""
    store, (low, high) = setup.store, box
    sides = (low[0], high[0], low[1], high[1])
    found = []
    for index, view in task.views:
        blocks = np.asarray(store.load(index, "blocks"))
        part = part_in_box(view, offset, sides, blocks)
        if part is None:
            continue
        depth, sigma = store.load_depth(index, "fine", part)
        sigma *= np.float32(setup.sigma_factor)
        with np.errstate(invalid="ignore"):
            sure = sigma <= _WORST_CELLS * task.grid.cell
        found.append(
            points_in_box(
                view,
                index,
                depth,
                sigma,
                store.load_mask(index, "inside", view.pinhole.width_px, part) & sure,
                store.load_colour(index, part),
                store.load_factors(index),
                offset,
                sides,
                blocks,
                part,
            )
        )
    return joined(found)
