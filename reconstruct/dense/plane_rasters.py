"""What the dense stage makes of confirmed depth: surface, cloud, and rasters over planes."""

import shutil
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.windows import Window

from alice_survey.core.errors import ReconstructionError, warn
from alice_survey.core.executor import Executor
from alice_survey.core.products import LENGTH, rasters_in
from reconstruct.dense.cloud import write_clouds
from reconstruct.dense.dem import (
    FILL_CELLS,
    STRAY_CELLS,
    cells_over,
    fill_gaps,
    slope_deg,
    without_strays,
)
from reconstruct.dense.pose_part import ErrorsOfPoses
from reconstruct.dense.scales import CELL_PIXELS
from reconstruct.dense.surface_tiles import (
    FuseSetup,
    SurfaceTile,
    ViewSummary,
    boxes_on,
    fuse_tasks,
    fuse_tile,
    on_plane,
)
from reconstruct.dense.view_store import ViewStore
from reconstruct.dense.views import ViewTask, lay_out_view
from reconstruct.planes import PLANES, Plane, plane_frame, write_plane
from reconstruct.qgis import write_style
from reconstruct.raster import (
    DemGrid,
    grid_over,
    preview_dem,
    round_cell,
    tiled_raster,
    tiles_reached,
)
from reconstruct.views.model import SparseModel, WorldFrame

_TILE_CELLS = 256
_RIM = FILL_CELLS + STRAY_CELLS


@dataclass(frozen=True, kw_only=True, eq=False)
class Confirmed:
    """Confirmed depth of all views, and what is known of the survey."""

    store: ViewStore
    model: SparseModel
    """Views at the size of their depth, in the world."""
    sigma_factor: float
    """On the standard deviations of refined depths."""
    shared: float
    """Views whose depths rest on the same pair of pictures, in the mean, 1 to 2."""
    poses: ErrorsOfPoses | None
    executor: Executor


@dataclass(frozen=True, kw_only=True)
class Fused:
    """A plane whose rasters are written."""

    plane: Plane
    grid: DemGrid
    pose_sigma: float | None
    """Standard deviation of heights from errors of poses, median."""


def fuse_planes(
    confirmed: Confirmed, folder: Path, planes: Sequence[Plane], cell_m: float | None
) -> list[Fused]:
    """Fuse the surface, and write the cloud and the rasters of planes.

    The first plane on which something is seen has its rasters in the folder itself, the others
    below `planes`.

    Args:
        confirmed: depth of all views.
        folder: of the stage.
        planes: to project on.
        cell_m: side of a cell; None takes it from the pictures' resolution.

    Returns:
        The planes on which something is seen, one or more; a warning names the others.

    Raises:
        ReconstructionError: no depth was confirmed, or nothing is seen on any plane.
    """
    model = confirmed.model
    summaries = _lay_out(confirmed)
    bounds = [summary.bounds for summary in summaries if summary.bounds is not None]
    if not bounds:
        raise no_depth(len(model.views))
    cell = surface_cell(summaries, cell_m, model.frame)
    grid = grid_over(bounds, cell)
    setup = FuseSetup(
        store=confirmed.store,
        stations=np.array([view.station for view in model.views], dtype=np.int64),
        planes=tuple(planes),
        offset_enu=_offset(grid, summaries),
        sigma_factor=confirmed.sigma_factor,
        shared=confirmed.shared,
    )
    tasks = fuse_tasks(grid, model.views, summaries, confirmed.poses)
    tiles = list(confirmed.executor.map(partial(fuse_tile, setup), tasks, label="fuse"))
    if not any(tile.count for tile in tiles):
        raise no_depth(len(model.views))
    write_clouds(
        folder, setup.store, tiles, setup.offset_enu, model.frame, cell, confirmed.executor
    )
    if (folder / PLANES).exists():  # of a run that was interrupted
        shutil.rmtree(folder / PLANES)
    made: list[Fused] = []
    for plane in planes:
        on_it = [tile.bounds[plane.name] for tile in tiles if plane.name in tile.bounds]
        if not on_it:
            warn(
                f"plane {plane.name!r} ({plane.about}): no picture shows a surface that faces its "
                "viewer: it has no DEM and no mosaic"
            )
            continue
        below = folder / PLANES / plane.name if made else folder
        below.mkdir(parents=True, exist_ok=True)
        made.append(
            _project(
                confirmed,
                setup,
                tiles,
                below,
                plane,
                grid_over(on_it, cell),
            )
        )
    if not made:
        raise ReconstructionError(
            'nothing is seen on any of the planes: reconstruct.planes = ["auto"] finds the best'
        )
    return made


def no_depth(pictures: int) -> ReconstructionError:
    """What to say where no depth was confirmed."""
    return ReconstructionError(
        f"no depth was confirmed by a second view in {pictures} pictures; they need more overlap, "
        "sharper texture or better positions"
    )


def surface_cell(summaries: Sequence[ViewSummary], cell: float | None, frame: WorldFrame) -> float:
    """Side of a cell of all planes: as wanted, else as pictures and depths resolve."""
    if cell is not None and not frame.scaled:
        warn("reconstruct.dem_cell_m is taken in model units: the model has no scale")
    footprint = float(np.nanmedian([s.footprint for s in summaries]))
    sigma = float(np.nanmedian([s.sigma for s in summaries]))
    return cell or round_cell(max(CELL_PIXELS * footprint, 1.5 * sigma))


def _lay_out(confirmed: Confirmed) -> list[ViewSummary]:
    tasks = [
        ViewTask(store=confirmed.store, index=n, view=view, others=())
        for n, view in enumerate(confirmed.model.views)
    ]
    lay_out = partial(lay_out_view, confirmed.sigma_factor)
    return list(confirmed.executor.map(lay_out, tasks, label="lay out"))


def _offset(grid: DemGrid, summaries: Sequence[ViewSummary]) -> tuple[float, float, float]:
    """Whole numbers near the middle of the points: east, north, up."""
    up = float(np.nanmedian([s.up for s in summaries]))
    east = float(grid.east_of(grid.columns / 2))
    north = float(grid.north_of(grid.rows / 2))
    return (float(np.round(east)), float(np.round(north)), float(np.round(up)))


@dataclass(frozen=True, kw_only=True, eq=False)
class RasterTile:
    """A tile of the rasters of a plane."""

    window: Window
    bands: Mapping[str, NDArray[Any]]
    """By the names of the rasters of `dense/`."""


def _project(
    confirmed: Confirmed,
    setup: FuseSetup,
    tiles: Sequence[SurfaceTile],
    folder: Path,
    plane: Plane,
    grid: DemGrid,
) -> Fused:
    """Write one plane's rasters."""
    frame = confirmed.model.frame
    tasks = []
    margin = (_RIM + 1) * grid.cell
    for window, over in tiles_reached(grid, _TILE_CELLS, boxes_on(tiles, plane), margin):
        part = grid.window(
            int(window.row_off) - _RIM,
            int(window.col_off) - _RIM,
            int(window.height) + 2 * _RIM,
            int(window.width) + 2 * _RIM,
        )
        tasks.append((window, part, [tiles[n] for n in over]))
    label = "project" if plane.is_level else f"project {plane.name}"
    found = confirmed.executor.map(partial(project_tile, setup, plane), tasks, label=label)
    threads = confirmed.executor.local_cores
    _write_rasters(folder, grid, plane_frame(frame, plane), found, threads)
    write_plane(folder, plane, frame)
    preview_dem(folder / "dem.tif", folder / "dem.png")
    for one in rasters_in("dense"):
        if one.palette:
            unit = frame.unit if one.unit == LENGTH else one.unit
            write_style(folder / one.path.name, one.palette, unit)
    poses = confirmed.poses
    sigma = None if poses is None else float(f"{poses.median_along(plane.normal_world):.3g}")
    return Fused(plane=plane, grid=grid, pose_sigma=sigma)


def project_tile(
    setup: FuseSetup, plane: Plane, task: tuple[Window, DemGrid, Sequence[SurfaceTile]]
) -> RasterTile:
    """Project the surface on a tile of a plane's grid.

    Args:
        setup: of the surface.
        plane: to project on.
        task: the tile, the grid of it with a rim, and tiles of the surface over it.
    """
    window, grid, tiles = task
    up = _middle_up(setup, plane)
    origin = np.array([grid.west, grid.north, up])
    surface = on_plane(setup, tiles, plane, origin)
    cells = cells_over(grid.moved(-grid.west, -grid.north), surface)
    cells = cells.without(~without_strays(cells.height))
    height, sigma = fill_gaps(cells.height, cells.sigma, FILL_CELLS, grid.cell)
    bands = {
        "dem": (height + up).astype(np.float32),
        "sigma": sigma,
        "slope": slope_deg(height, grid.cell),
        "count": cells.count,
        "stations": cells.stations,
        "surfaces": cells.surfaces,
        "lower": (cells.lower + up).astype(np.float32),
    }
    inner = slice(_RIM, -_RIM)
    return RasterTile(
        window=window, bands={name: band[inner, inner] for name, band in bands.items()}
    )


def _middle_up(setup: FuseSetup, plane: Plane) -> float:
    """A whole number near the height of the survey's middle over a plane."""
    east, north, up = setup.offset_enu
    return float(np.round(-plane.plane_from_world.apply(np.array([north, east, -up]))[2]))


def _write_rasters(
    folder: Path, grid: DemGrid, frame: WorldFrame, tiles: Iterable[RasterTile], threads: int
) -> None:
    up = "towards its viewer" if frame.name == "plane" else "up"
    over = f"above {frame.vertical_datum}, {up} ({frame.unit})"
    with ExitStack() as files:
        written = {
            one.name: files.enter_context(
                tiled_raster(
                    folder / one.path.name,
                    grid,
                    frame,
                    one.dtype,
                    float("nan") if one.dtype == "float32" else None,
                    one.band_text(frame.unit, over),
                    frame.unit if one.unit == LENGTH else one.unit,
                    threads,
                )
            )
            for one in rasters_in("dense")
        }
        for tile in tiles:
            for name, raster in written.items():
                raster.write(tile.bands[name], 1, window=tile.window)
