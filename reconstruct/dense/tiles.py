"""Fusing the points of all views, tile by tile, into cells of the DEM and points of the cloud."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.windows import Window

from alice_survey.base.frames import Array
from reconstruct.dense.cloud import thinned_points
from reconstruct.dense.dem import (
    FILL_CELLS,
    STRAY_CELLS,
    fill_gaps,
    fuse_points,
    slope_deg,
    without_strays,
)
from reconstruct.dense.points import joined, points_in_box
from reconstruct.dense.pose_part import PosePart, spread_over
from reconstruct.dense.view_store import ViewStore
from reconstruct.light.solve import LightModel, LightSamples
from reconstruct.raster import DemGrid, tiles_of
from reconstruct.views.model import View

_TILE_CELLS = 256
_WORST_CELLS = 1.0
"""Depths less certain than this many cells are left out: rig stereo from afar, mostly."""
_RIM = FILL_CELLS + STRAY_CELLS


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
    light: LightSamples
    """What it and its neighbours show of the same spots."""
    nodes: Array
    """What it shows at the nodes of the light model; see `light.at_nodes`."""


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
    vertices: NDArray[Any]


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


def fuse_tile(
    store: ViewStore,
    light: LightModel,
    stations: NDArray[np.int64],
    offset_enu: tuple[float, float, float],
    edge: float,
    sigma_factor: float,
    task: FuseTask,
) -> Tile:
    """Fuse the points of all views in a tile into cells and cloud points.

    Args:
        store: with the depth of every view.
        light: of the survey.
        stations: (V,) station of every view.
        offset_enu: origin of the cloud.
        edge: of the cubes to which the cloud is thinned.
        sigma_factor: on the standard deviations of refined depths.
        task: the tile.
    """
    offset = np.array(offset_enu)
    grid = task.grid.moved(-offset[0], -offset[1])
    box = (
        grid.west,
        float(grid.east_of(grid.columns)),
        float(grid.north_of(grid.rows)),
        grid.north,
    )
    parts = []
    for index, view in task.views:
        depth, sigma = store.load_depth(index, "fine")
        sigma *= np.float32(sigma_factor)
        with np.errstate(invalid="ignore"):
            sure = sigma <= _WORST_CELLS * grid.cell
        parts.append(
            points_in_box(
                view,
                index,
                depth,
                sigma,
                store.load_mask(index, "kept", view.pinhole.width_px) & sure,
                store.load_colour(index),
                light.factors(view.camera, view.image),
                offset,
                box,
                np.asarray(store.load(index, "blocks")),
            )
        )
    points = joined(parts)
    height, sigma, count, met = fuse_points(grid, points, stations)
    stray = ~without_strays(height)
    height[stray], sigma[stray], count[stray], met[stray] = np.nan, np.nan, 0, 0
    height, sigma = fill_gaps(height, sigma, FILL_CELLS)
    if task.pose_sigmas is not None:  # once, however many views: they share it
        shared = spread_over(task.pose_sigmas, grid.rows, grid.columns)
        sigma = np.hypot(sigma, shared.astype(np.float32))
    top, bottom, left, right = task.rim
    inner = (slice(top, grid.rows - bottom), slice(left, grid.columns - right))
    own = grid.window(top, left, grid.rows - top - bottom, grid.columns - left - right)
    columns = DemGrid(
        west=own.west,
        north=own.north,
        cell=edge,
        rows=math.ceil(own.rows * own.cell / edge - 1e-9),
        columns=math.ceil(own.columns * own.cell / edge - 1e-9),
    )
    return Tile(
        window=task.window,
        height=(height[inner] + offset[2]).astype(np.float32),
        sigma=sigma[inner],
        slope=slope_deg(height, grid.cell)[inner],
        count=count[inner],
        stations=met[inner],
        vertices=thinned_points(columns, points),
    )
