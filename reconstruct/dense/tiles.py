"""Fusing the points of all views, tile by tile, into cells of the DEM and points of the cloud."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.windows import Window

from alice_survey.base.frames import Array
from alice_survey.base.plane_settings import LEVEL
from reconstruct.dense.cloud import VERTEX, thinned_points
from reconstruct.dense.dem import (
    FILL_CELLS,
    STRAY_CELLS,
    fill_gaps,
    fuse_points,
    slope_deg,
    without_strays,
)
from reconstruct.dense.points import Points, joined, points_in_box
from reconstruct.dense.pose_part import PosePart, spread_over
from reconstruct.dense.view_store import ViewStore
from reconstruct.light.solve import LightModel
from reconstruct.raster import DemGrid, tiles_of
from reconstruct.views.model import View

_TILE_CELLS = 256
_WORST_CELLS = 1.0
"""Depths less certain than this many cells are left out: rig stereo from afar, mostly."""
_RIM = FILL_CELLS + STRAY_CELLS
_NO_VERTICES = np.empty(0, VERTEX)


@dataclass(frozen=True, kw_only=True)
class ViewSummary:
    """Where the points of a view lie over a plane."""

    bounds: tuple[float, float, float, float] | None
    """South, west, north, east; None where no depth was found."""
    up: float
    """Median height of its points."""
    footprint: float
    """Side of a pixel on the ground."""
    sigma: float
    """Median standard deviation of its depth."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FuseTask:
    """One tile of the grid to fuse."""

    window: Window
    grid: DemGrid
    """Grid of the tile with its rim."""
    rim: tuple[int, int, int, int]
    """Cells around the tile, top, bottom, left, right, that only serve to judge and fill."""
    views: tuple[tuple[int, View], ...]
    pose_sigmas: Array | None
    """(m, n) sigmas of heights from errors of poses, on a lattice over the grid."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Tile:
    """A fused tile."""

    window: Window
    height: NDArray[np.float32]
    sigma: NDArray[np.float32]
    slope: NDArray[np.float32]
    """Slope, degrees."""
    count: NDArray[np.uint16]
    stations: NDArray[np.uint8]
    surfaces: NDArray[np.uint8]
    lower: NDArray[np.float32]
    vertices: NDArray[Any]
    """Points of the cloud; none of another plane than the level one."""


def tile_tasks(
    grid: DemGrid,
    views: Sequence[View],
    summaries: Sequence[ViewSummary],
    pose_part: PosePart | None,
) -> list[FuseTask]:
    """Tiles in the order of the file's rows, each with the views whose points may fall in it."""
    tasks = []
    nowhere = (np.inf, np.inf, -np.inf, -np.inf)
    bounds = np.array([summary.bounds or nowhere for summary in summaries])
    for window in tiles_of(grid, _TILE_CELLS):
        row, column = int(window.row_off), int(window.col_off)
        rows, columns = int(window.height), int(window.width)
        rim = (
            min(_RIM, row),
            min(_RIM, grid.rows - row - rows),
            min(_RIM, column),
            min(_RIM, grid.columns - column - columns),
        )
        part = grid.window(
            row - rim[0], column - rim[2], rows + rim[0] + rim[1], columns + rim[2] + rim[3]
        )
        south, east = float(part.north_of(part.rows)), float(part.east_of(part.columns))
        away = (bounds[:, 0] >= part.north) | (bounds[:, 2] <= south)
        away |= (bounds[:, 1] >= east) | (bounds[:, 3] <= part.west)
        seeing = [(index, views[index]) for index in np.flatnonzero(~away).tolist()]
        poses = None
        if pose_part is not None:
            poses = pose_part.at_nodes(part.north, part.west, part.cell, part.rows, part.columns)
        tasks.append(
            FuseTask(window=window, grid=part, rim=rim, views=tuple(seeing), pose_sigmas=poses)
        )
    return tasks


@dataclass(frozen=True, kw_only=True, eq=False)
class FuseSetup:
    """What all tiles of a plane share."""

    store: ViewStore
    """With the depth of every view."""
    plane: str
    """Name of the plane."""
    light: LightModel
    stations: NDArray[np.int64]
    """(V,) station of every view."""
    offset_enu: tuple[float, float, float]
    """Origin near the points, in the frame of the plane; also the cloud's."""
    edge: float
    """Of the cubes to which the cloud is thinned."""
    sigma_factor: float
    """On the standard deviations of refined depths."""


def fuse_tile(setup: FuseSetup, task: FuseTask) -> Tile:
    """Fuse the points of all views in a tile into cells, and, of the level plane, cloud points."""
    offset = np.array(setup.offset_enu)
    grid = task.grid.moved(-offset[0], -offset[1])
    points = _points_over(setup, task, grid, offset)
    cells = fuse_points(grid, points, setup.stations)
    cells = cells.without(~without_strays(cells.height))
    height, sigma = fill_gaps(cells.height, cells.sigma, FILL_CELLS)
    if task.pose_sigmas is not None:  # once, however many views: they share it
        shared = spread_over(task.pose_sigmas, grid.rows, grid.columns)
        sigma = np.hypot(sigma, shared.astype(np.float32))
    top, bottom, left, right = task.rim
    inner = (slice(top, grid.rows - bottom), slice(left, grid.columns - right))
    own = grid.window(top, left, grid.rows - top - bottom, grid.columns - left - right)
    return Tile(
        window=task.window,
        height=(height[inner] + offset[2]).astype(np.float32),
        sigma=sigma[inner],
        slope=slope_deg(height, grid.cell)[inner],
        count=cells.count[inner],
        stations=cells.stations[inner],
        surfaces=cells.surfaces[inner],
        lower=(cells.lower[inner] + offset[2]).astype(np.float32),
        vertices=_vertices(own, points, setup.edge) if setup.plane == LEVEL else _NO_VERTICES,
    )


def _points_over(setup: FuseSetup, task: FuseTask, grid: DemGrid, offset: Array) -> Points:
    """The kept points of all views over a grid."""
    store = setup.store
    box = (
        grid.west,
        float(grid.east_of(grid.columns)),
        float(grid.north_of(grid.rows)),
        grid.north,
    )
    parts = []
    for index, view in task.views:
        depth, sigma = store.load_depth(index, "fine")
        sigma *= np.float32(setup.sigma_factor)
        with np.errstate(invalid="ignore"):
            sure = sigma <= _WORST_CELLS * grid.cell
        parts.append(
            points_in_box(
                view,
                index,
                depth,
                sigma,
                store.load_mask(index, f"kept.{setup.plane}", view.pinhole.width_px) & sure,
                store.load_colour(index),
                setup.light.factors(view.camera, view.image),
                offset,
                box,
                np.asarray(store.load(index, f"blocks.{setup.plane}")),
            )
        )
    return joined(parts)


def _vertices(grid: DemGrid, points: Points, edge: float) -> NDArray[Any]:
    """Cloud points over a grid."""
    columns = DemGrid(
        west=grid.west,
        north=grid.north,
        cell=edge,
        rows=math.ceil(grid.rows * grid.cell / edge - 1e-9),
        columns=math.ceil(grid.columns * grid.cell / edge - 1e-9),
    )
    return thinned_points(columns, points)
