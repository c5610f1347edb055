"""The dense surface: depth of every view, fused into a DEM and a coloured point cloud.

Steps, each over independent views or tiles and through files, so that memory stays bounded:
prepare pictures, find each view's depth with a few partners, let neighbours confirm it, fuse tiles.
"""

import shutil
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alice_survey.base.config import ReconstructConfig
from alice_survey.base.errors import ReconstructionError, warn
from alice_survey.base.executor import Executor
from alice_survey.base.records import SurfaceRecord
from reconstruct.dense.cloud import laz_writer, voxel_edge, write_cloud, write_cloud_json
from reconstruct.dense.dem import FILL_CELLS
from reconstruct.dense.matching_trial import find_conditions
from reconstruct.dense.pose_part import find_pose_part
from reconstruct.dense.stereo_pairs import choose_partners, neighbours, points_in_sight
from reconstruct.dense.tiles import Tile, ViewSummary, fuse_tile, tile_tasks
from reconstruct.dense.view_store import ViewStore
from reconstruct.dense.views import (
    LOOKS,
    ViewTask,
    check_view,
    find_sigma_factor,
    looked_at,
    prepare_view,
    refine_view,
    view_depth,
)
from reconstruct.light.solve import joined_samples, solve_light, write_light
from reconstruct.raster import DemGrid, grid_over, preview_dem, round_cell, tiled_raster
from reconstruct.views.model import WorldFrame, read_model, scaled_view

CELL_PIXELS = 2.5
"""Side of a DEM cell in mean ground pixels of the pictures as matched, unless depth is coarser."""
_WITNESSES = 8
"""Neighbouring views that a view's depth is checked against."""
_MOST_CELLS = 4_000_000_000
_MOST_POINTS = 40_000_000


def run_dense(
    workspace: Path, folder: Path, executor: Executor, *, reconstruct: ReconstructConfig
) -> None:
    """Find the surface of a placed model.

    Raises:
        ReconstructionError: the views do not overlap, or no depth was found.
        WorkspaceError: the model is damaged.
    """
    model = read_model(workspace / "sparse")
    store = ViewStore(folder / "scratch")
    store.folder.mkdir(parents=True, exist_ok=True)
    partners = choose_partners(model, reconstruct.dense_partners)
    points = points_in_sight(model)
    conditions = find_conditions(
        workspace, model.views, partners, points, reconstruct.dense_scale, executor
    )
    views = [scaled_view(view, conditions.scale) for view in model.views]

    def tasks(others: Sequence[Sequence[int]]) -> list[ViewTask]:
        return [
            ViewTask(store=store, index=n, view=view, others=tuple((m, views[m]) for m in chosen))
            for n, (view, chosen) in enumerate(zip(views, others, strict=True))
        ]

    prepare = partial(prepare_view, workspace)
    _drain(executor.map(prepare, tasks([()] * len(views)), label="even out pictures"))
    match = partial(view_depth, conditions.match_sigma_px)
    matched = list(zip(tasks(partners), points, strict=True))
    _drain(executor.map(match, matched, label="match"))
    looks = [looked_at(views, n, chosen) for n, chosen in enumerate(partners)]
    _drain(executor.map(refine_view, tasks(looks), label="refine"))
    checks = tasks(neighbours(model, _WITNESSES))
    sigma_factor = find_sigma_factor(checks, executor)
    check = partial(check_view, sigma_factor)
    summaries = list(executor.map(check, checks, label="cross-check"))
    grid = surface_grid(summaries, reconstruct.dem_cell_m, model.frame)
    offset = _offset(grid, summaries)
    edge = voxel_edge(grid.cell, grid.rows * grid.columns, _MOST_POINTS)
    light = solve_light(
        joined_samples([summary.light for summary in summaries]),
        np.stack([summary.nodes for summary in summaries]),
        [view.image for view in views],
        [view.camera for view in views],
    )
    write_light(folder / "light.json", light)
    pose_part = find_pose_part(workspace, model)
    stations = np.array([view.station for view in views], dtype=np.int64)
    fuse = partial(fuse_tile, store, light, stations, offset, edge, sigma_factor)
    tiles = executor.map(fuse, tile_tasks(grid, views, summaries, pose_part), label="fuse")
    parts = _write_rasters(folder, grid, model.frame, tiles)
    with laz_writer(folder / "cloud.laz", offset, model.frame) as write_laz:
        count = write_cloud(folder / "cloud.ply", write_laz(parts), offset, model.frame)
    if count == 0:
        raise _no_depth(len(views))
    write_cloud_json(folder / "cloud.json", count, offset, edge, model.frame)
    SurfaceRecord.save(
        folder / "surface.json",
        {
            "format": "alice-survey surface",
            "version": 1,
            "matching_scale": conditions.scale,
            "match_sigma_px": conditions.match_sigma_px,
            "refined_with": LOOKS,
            "sigma_factor": round(sigma_factor, 3),
            "pose_sigma": None if pose_part is None else float(f"{pose_part.median:.3g}"),
            "cell": grid.cell,
            "unit": model.frame.unit,
            "rows": grid.rows,
            "columns": grid.columns,
            "frame": model.frame.name,
            "vertical_datum": model.frame.vertical_datum,
            "pairs": sum(len(chosen) for chosen in partners),
            "gaps_bridged_cells": FILL_CELLS,
            "notes": list(model.frame.notes),
        },
    )
    preview_dem(folder / "dem.tif", folder / "dem.png")
    shutil.rmtree(store.folder)


def surface_grid(
    summaries: Sequence[ViewSummary], cell: float | None, frame: WorldFrame
) -> DemGrid:
    """The grid over all points.

    Raises:
        ReconstructionError: no view has depth, or the grid would be too large.
    """
    bounds = [s.bounds for s in summaries if s.bounds is not None]
    if not bounds:
        raise _no_depth(len(summaries))
    if cell is not None and not frame.scaled:
        warn("reconstruct.dem_cell_m is taken in model units: the model has no scale")
    footprint = float(np.nanmedian([s.footprint for s in summaries]))
    sigma = float(np.nanmedian([s.sigma for s in summaries]))
    size = cell or round_cell(max(CELL_PIXELS * footprint, 1.5 * sigma))
    grid = grid_over(bounds, size)
    if grid.rows * grid.columns > _MOST_CELLS:
        raise ReconstructionError(
            f"cells of {size} {frame.unit} would make a grid of {grid.rows} x {grid.columns}; "
            "raise reconstruct.dem_cell_m"
        )
    return grid


def _no_depth(pictures: int) -> ReconstructionError:
    return ReconstructionError(
        f"no depth was confirmed by a second view in {pictures} pictures; they need more overlap, "
        "sharper texture or better positions"
    )


def _offset(grid: DemGrid, summaries: Sequence[ViewSummary]) -> tuple[float, float, float]:
    """Whole numbers near the middle of the cloud: east, north, up."""
    up = float(np.nanmedian([s.up for s in summaries]))
    east = float(grid.east_of(grid.columns / 2))
    north = float(grid.north_of(grid.rows / 2))
    return (float(np.round(east)), float(np.round(north)), float(np.round(up)))


def _write_rasters(
    folder: Path, grid: DemGrid, frame: WorldFrame, tiles: Iterator[Tile]
) -> Iterator[NDArray[Any]]:
    """Write the tiles' rasters and hand their cloud points on."""
    unit, nan = frame.unit, float("nan")
    bands = {
        "height": ("dem", "float32", nan, f"height above {frame.vertical_datum}, up ({unit})"),
        "sigma": ("sigma", "float32", nan, f"standard deviation of the height ({unit})"),
        "slope": ("slope", "float32", nan, "steepest slope (degrees)"),
        "count": (
            "count", "uint16", None,
            "views that the height rests on; 0 where a small gap was bridged",
        ),
        "stations": (
            "stations", "uint8", None,
            "stations that the height rests on (255: or more); 0 where a small gap was bridged",
        ),
    }  # fmt: skip
    with ExitStack() as files:
        rasters = {
            name: files.enter_context(
                tiled_raster(folder / f"{file}.tif", grid, frame, dtype, nodata, text)
            )
            for name, (file, dtype, nodata, text) in bands.items()
        }
        for tile in tiles:
            for name, raster in rasters.items():
                raster.write(getattr(tile, name), 1, window=tile.window)
            yield tile.vertices


def _drain(results: Iterator[None]) -> None:
    for _ in results:
        pass
