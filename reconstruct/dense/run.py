"""The dense surface: depth of every view, fused into a DEM and a coloured point cloud.

Steps, each over independent views or tiles and through files, so that memory stays bounded:
prepare pictures, find each view's depth with a few partners, let neighbours confirm it, and, for
each plane, fuse tiles.
"""

import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.windows import Window

from alice_survey.core.config import ReconstructConfig, parse_planes
from alice_survey.core.errors import ReconstructionError, warn
from alice_survey.core.executor import Executor
from alice_survey.core.products import LENGTH, rasters_in
from alice_survey.core.records import SurfaceRecord
from reconstruct.dense.cloud import write_clouds
from reconstruct.dense.dem import (
    FILL_CELLS,
    STRAY_CELLS,
    cells_over,
    fill_gaps,
    slope_deg,
    widen_at_rims,
    without_strays,
)
from reconstruct.dense.matching_trial import (
    CELL_PIXELS,
    Scales,
    choose_probes,
    find_scales,
    matching_scale,
    pixels_of,
    scale_for_cell,
)
from reconstruct.dense.moving import COMPARED, clear_moving, keep_look, mask_moving, show_moving
from reconstruct.dense.stereo_pairs import (
    PointsInSight,
    choose_partners,
    depths_per_pair,
    neighbours,
)
from reconstruct.dense.surface_tiles import (
    ErrorsOfPoses,
    FuseSetup,
    SurfaceTile,
    ViewSummary,
    boxes_on,
    find_errors_of_poses,
    fuse_tasks,
    fuse_tile,
    on_plane,
    reach_tiles,
)
from reconstruct.dense.view_store import FACTORS, ViewStore
from reconstruct.dense.views import (
    ViewTask,
    check_view,
    find_match_sigma,
    find_sigma_factor,
    light_parts,
    match_view,
    pairs_once,
    prepare_view,
    refine_view,
)
from reconstruct.light.solve import solve_light, write_light
from reconstruct.mosaic.grid import mean_pixel
from reconstruct.planes import PLANES, Plane, chosen_planes, plane_frame, write_plane
from reconstruct.raster import (
    DemGrid,
    grid_over,
    preview_dem,
    round_cell,
    tiled_raster,
    tiles_reached,
    write_style,
)
from reconstruct.views.model import SparseModel, WorldFrame, read_model, scaled_view

_TILE_CELLS = 256
_RIM = FILL_CELLS + STRAY_CELLS + 3
"""Beyond gaps: cells next to those that a rim is seen from, and next to walls."""


def fuse_planes(
    setup: FuseSetup, model: SparseModel, summaries: Sequence[ViewSummary],
    poses: ErrorsOfPoses | None, folder: Path, cell_m: float | None, executor: Executor,
) -> list[tuple[Plane, DemGrid]]:  # fmt: skip
    """Fuse the surface, and write the cloud and the rasters of planes.

    The first plane on which something is seen has its rasters in the folder itself, the others
    below `planes`.

    Args:
        setup: confirmed depth of all views, and the planes.
        model: views at the size of their depth, in the world.
        summaries: where the points of every view lie.
        poses: what their errors do to points.
        folder: of the stage.
        cell_m: side of a cell; None takes it from the pictures' resolution.
        executor: runs the tiles.

    Returns:
        The planes on which something is seen, one or more; a warning names the others.

    Raises:
        ReconstructionError: no depth was confirmed, or nothing is seen on any plane.
    """
    bounds = [summary.bounds for summary in summaries if summary.bounds is not None]
    tiles: list[SurfaceTile] = []
    if bounds:
        cell = _surface_cell(summaries, cell_m, model.frame)
        grid = grid_over(bounds, cell)
        setup = replace(setup, offset_enu=_offset(grid, summaries))
        reached = reach_tiles(grid, summaries)
        tasks, fuse = fuse_tasks(grid, reached, model.views, poses), partial(fuse_tile, setup)
        tiles = list(executor.map(fuse, tasks, label="fuse", total=len(reached)))
    if not any(tile.count for tile in tiles):
        raise ReconstructionError(
            f"no depth was confirmed by a second view in {len(summaries)} pictures; they need "
            "more overlap, sharper texture or better positions"
        )
    write_clouds(folder, setup.store, tiles, setup.offset_enu, model.frame, cell, executor)
    shutil.rmtree(folder / PLANES, ignore_errors=True)  # of a run that was interrupted
    made: list[tuple[Plane, DemGrid]] = []
    for plane in setup.planes:
        on_it = [tile.bounds[plane.name] for tile in tiles if plane.name in tile.bounds]
        if not on_it:
            warn(
                f"plane {plane.name!r} ({plane.about}): no picture shows a surface that faces its "
                "viewer: it has no DEM and no mosaic"
            )
            continue
        below = folder / PLANES / plane.name if made else folder
        below.mkdir(parents=True, exist_ok=True)
        grid = grid_over(on_it, cell)
        _project(setup, tiles, below, plane, grid, model.frame, executor)
        made.append((plane, grid))
    if not made:
        raise ReconstructionError(
            'nothing is seen on any of the planes: reconstruct.planes = ["auto"] finds the best'
        )
    return made


def _surface_cell(summaries: Sequence[ViewSummary], cell: float | None, frame: WorldFrame) -> float:
    """Side of a cell of all planes: as requested, else as pictures and depths resolve."""
    if cell is not None and not frame.scaled:
        warn("reconstruct.dem_cell_m is taken in model units: the model has no scale")
    footprint = float(np.nanmedian([s.footprint for s in summaries]))
    sigma = float(np.nanmedian([s.sigma for s in summaries]))
    return cell or round_cell(max(CELL_PIXELS * footprint, 1.5 * sigma))


def _offset(grid: DemGrid, summaries: Sequence[ViewSummary]) -> tuple[float, float, float]:
    """Whole numbers near the middle of the points: east, north, up."""
    up = float(np.nanmedian([s.up for s in summaries]))
    east = float(grid.east_of(grid.columns / 2))
    north = float(grid.north_of(grid.rows / 2))
    return (float(np.round(east)), float(np.round(north)), float(np.round(up)))


def _project(
    setup: FuseSetup, tiles: Sequence[SurfaceTile], folder: Path, plane: Plane, grid: DemGrid,
    frame: WorldFrame, executor: Executor,
) -> None:  # fmt: skip
    """Write one plane's rasters."""
    tasks = []
    margin = (_RIM + 1) * grid.cell
    for window, over in tiles_reached(grid, _TILE_CELLS, boxes_on(tiles, plane), margin):
        row, column, rows, columns = (
            int(v) for v in (window.row_off, window.col_off, window.height, window.width)
        )
        part = grid.window(row - _RIM, column - _RIM, rows + 2 * _RIM, columns + 2 * _RIM)
        tasks.append((window, part, [tiles[n] for n in over]))
    label = "project" if plane.is_level else f"project {plane.name}"
    found = executor.map(partial(project_tile, setup, plane), tasks, label=label)
    _write_rasters(folder, grid, plane_frame(frame, plane), found, executor.local_cores)
    write_plane(folder, plane, frame)
    preview_dem(folder / "dem.tif", folder / "dem.png")
    for one in rasters_in("dense"):
        if one.palette:
            unit = frame.unit if one.unit == LENGTH else one.unit
            write_style(folder / one.path.name, one.palette, unit)


def project_tile(
    setup: FuseSetup, plane: Plane, task: tuple[Window, DemGrid, Sequence[SurfaceTile]]
) -> tuple[Window, dict[str, NDArray[Any]]]:
    """Project the surface on a tile of a plane's grid.

    Args:
        setup: of the surface.
        plane: to project on.
        task: the tile, the grid of it with a rim, and tiles of the surface over it.

    Returns:
        The tile, and its bands by the names of the rasters of `dense/`.
    """
    window, grid, tiles = task
    east, north, up = setup.offset_enu  # a whole number near the survey's height over the plane
    up = float(np.round(-plane.plane_from_world.apply(np.array([north, east, -up]))[2]))
    surface = on_plane(setup, tiles, plane, np.array([grid.west, grid.north, up]))
    cells = cells_over(grid.translate(-grid.west, -grid.north), surface)
    cells = cells.without(~without_strays(cells.height))
    height, bridged = fill_gaps(cells.height, cells.sigma, FILL_CELLS, grid.cell, over_steps=False)
    cells = widen_at_rims(cells, grid.cell)
    sigma = np.where(np.isfinite(cells.height), cells.sigma, bridged)
    bands: dict[str, NDArray[Any]] = {
        "dem": (height + up).astype(np.float32),
        "sigma": sigma,
        "slope": slope_deg(height, grid.cell),
        "count": cells.count,
        "stations": cells.stations,
        "surfaces": cells.surfaces,
        "lower": (cells.lower + up).astype(np.float32),
    }
    inner = slice(_RIM, -_RIM)
    return window, {name: band[inner, inner] for name, band in bands.items()}


def _write_rasters(
    folder: Path, grid: DemGrid, frame: WorldFrame,
    tiles: Iterable[tuple[Window, Mapping[str, NDArray[Any]]]], threads: int,
) -> None:  # fmt: skip
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
                    one.band.format(unit=frame.unit, over=over),
                    frame.unit if one.unit == LENGTH else one.unit,
                    threads,
                )
            )
            for one in rasters_in("dense")
        }
        for window, bands in tiles:
            for name, raster in written.items():
                raster.write(bands[name], 1, window=window)


_PARTNERS = 4
"""Pictures that each is matched with."""
_CHECKING = 8
"""Neighbouring views that a view's depth is checked against."""


def run_dense(
    workspace: Path, folder: Path, executor: Executor, *, reconstruct: ReconstructConfig
) -> None:
    """Find the surface of a placed model.

    Raises:
        ReconstructionError: the views do not overlap, or no depth was found.
        WorkspaceError: the model is damaged.
    """
    model = read_model(workspace / "sparse")
    planes = chosen_planes(parse_planes(reconstruct.planes), model)
    store = ViewStore(folder / "scratch")
    store.folder.mkdir(parents=True, exist_ok=True)
    partners = choose_partners(model, _PARTNERS)
    points = PointsInSight(model)
    scales = _scales(workspace, model, partners, points, reconstruct, executor)
    views = [scaled_view(view, scales.depth) for view in model.views]
    matching = scales.matching / scales.depth

    def tasks(others: Sequence[Sequence[int]]) -> list[ViewTask]:
        return [
            ViewTask(store=store, index=n, view=view, others=tuple((m, views[m]) for m in chosen))
            for n, (view, chosen) in enumerate(zip(views, others, strict=True))
        ]

    prepare = partial(prepare_view, workspace)
    _drain(executor.map(prepare, tasks([()] * len(views)), label="even out pictures"))
    order = sorted(range(len(views)), key=lambda n: views[n].station)  # neighbours stay prepared
    once, looks = tasks(pairs_once(partners)), tasks(partners)
    match, matched = partial(match_view, matching), ((once[n], points.of(n)) for n in order)
    _drain(executor.map(match, matched, label="match", total=len(views)))
    probes = [looks[n] for n in choose_probes(partners)]
    match_sigma_px = find_match_sigma(matching, probes, executor)
    refine = partial(refine_view, matching, match_sigma_px, on_gpu=executor.uses_gpu)
    _drain(executor.map(refine, [looks[n] for n in order], label="refine"))
    checks = tasks(neighbours(model, _CHECKING))
    sigma_factor = find_sigma_factor(checks, executor)
    check = partial(check_view, sigma_factor)
    nodes, samples, summaries = zip(*executor.map(check, checks, label="cross-check"), strict=True)
    images, cameras = [view.image for view in views], [view.camera for view in views]
    light = solve_light(light_parts(store, samples, executor), np.stack(nodes), images, cameras)
    write_light(folder / "light.json", light)
    store.save(0, FACTORS, np.stack([light.factors(view.camera, view.image) for view in views]))
    moving = []
    clear_moving(folder)
    if reconstruct.mask_moving:
        _drain(executor.map(keep_look, tasks([()] * len(views)), label="even out light"))
        mask = partial(mask_moving, workspace, folder)
        others = tasks(neighbours(model, COMPARED))
        moving = list(executor.map(mask, others, label="mask what moves"))
        show_moving(workspace, folder, moving)
    stations = np.array([view.station for view in views], dtype=np.int64)
    apart = [[m for m in chosen if stations[m] != stations[n]] for n, chosen in enumerate(partners)]
    setup = FuseSetup(
        store=store,
        stations=stations,
        planes=tuple(planes),
        sigma_factor=sigma_factor,
        shared=depths_per_pair(apart),
    )
    poses = find_errors_of_poses(workspace, model)
    placed = replace(model, views=tuple(views))
    made = fuse_planes(setup, placed, summaries, poses, folder, reconstruct.dem_cell_m, executor)
    (plane, grid), *_ = made
    pose_sigma = None if poses is None else poses.median_along(plane.normal_world)
    SurfaceRecord.save(
        folder / "surface.json",
        {
            "format": "alice-survey surface",
            "version": 1,
            "matching_scale": scales.matching,
            "match_sigma_px": match_sigma_px,
            "sigma_factor": round(sigma_factor, 3),
            "pose_sigma": None if pose_sigma is None else float(f"{pose_sigma:.3g}"),
            "cell": grid.cell,
            "unit": model.frame.unit,
            "vertical_datum": model.frame.vertical_datum,
            "planes": [one.name for one, _ in made],
            "moving": {
                "pictures": len(moving),
                "masked": sum(one.masked > 0 for one in moving),
                "masked_share": float(np.mean([one.masked for one in moving] or [0.0])),
            },
            "notes": list(model.frame.notes),
        },
    )
    shutil.rmtree(store.folder)


def _scales(
    workspace: Path, model: SparseModel, partners: Sequence[Sequence[int]], points: PointsInSight,
    reconstruct: ReconstructConfig, executor: Executor,
) -> Scales:  # fmt: skip
    """As settings want them; what they leave open is tried out."""
    if reconstruct.dense_scale is not None:
        requested = reconstruct.dense_scale
        smallest = min(matching_scale(pixels_of(view), requested) for view in model.views)
        return Scales(depth=requested, matching=smallest)
    finest = scale_for_cell(reconstruct.dem_cell_m, mean_pixel(model))
    return find_scales(workspace, model.views, partners, points.of, finest, executor)


def _drain(results: Iterator[None]) -> None:
    for _ in results:
        pass
