"""The dense surface: depth of every view, fused into a DEM and a coloured point cloud.

Steps, each over independent views or tiles and through files, so that memory stays bounded:
prepare pictures, find each view's depth with a few partners, let neighbours confirm it, fuse tiles.
"""

import shutil
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alice_survey.artefacts import Stage, need_stage, run_stage, write_json
from alice_survey.config import ReconstructConfig, SurveyConfig
from alice_survey.errors import ReconstructionError, warn
from alice_survey.executor import parallel_map
from alice_survey.frames import Array
from reconstruct.dense.cloud import laz_writer, voxel_edge, write_cloud_json, write_ply
from reconstruct.dense.dem import FILL_CELLS, DemGrid, grid_over, round_cell
from reconstruct.dense.depth import pair_depth
from reconstruct.dense.fusion import GATE_SIGMAS, count_witnesses, merge_depths
from reconstruct.dense.probe import find_conditions, open_pictures, shrunk
from reconstruct.dense.rectify import scaled_view
from reconstruct.dense.refine import Look, prepared, refine
from reconstruct.dense.sight import lens_of
from reconstruct.dense.stereo_pairs import StereoPair, choose_pairs, in_frame, points_of_views
from reconstruct.dense.tiles import Tile, ViewSummary, fuse_tile, tile_tasks
from reconstruct.dense.view_store import ViewStore
from reconstruct.model import SparseModel, View, WorldFrame, read_model
from reconstruct.mosaic.light import (
    LightSamples,
    at_nodes,
    compare_light,
    joined_samples,
    low_pass,
    solve_light,
    write_light,
)
from reconstruct.pictures.normalise import normalise
from reconstruct.raster import preview_dem, tiled_raster

CELL_PIXELS = 2.5
"""Side of a DEM cell in mean ground pixels of the pictures as matched, unless depth is coarser."""
_WITNESSES = 8
"""Neighbouring views that a view's depth is held against."""
_MOST_CELLS = 4_000_000_000
_MOST_POINTS = 40_000_000
_BOUND_PERCENT = 0.1
"""Share of a view's points left out on each of its four sides, so that none strays far off."""
_LIGHT_LATTICE = 28
"""Pixels along a picture's width at which the light of views is compared."""
_LOOKS = 6
"""Neighbours by which depth is refined."""
_DOUBTERS = 12
_DOUBT_STEP = 7
"""Views, and pixels between the pixels of each, by which the doubt is told."""
_LEAST_PIXELS = 100
"""A view with fewer pixels of confirmed depth is left out."""


@dataclass(frozen=True, kw_only=True)
class PrepareTask:
    """One picture to undistort, shrink and even out."""

    workspace: Path
    store: ViewStore
    index: int
    image: str
    size_px: tuple[int, int]


@dataclass(frozen=True, kw_only=True, eq=False)
class DepthTask:
    """One view to find depth for."""

    store: ViewStore
    index: int
    view: View
    partners: tuple[tuple[int, View], ...]
    points_world: Array
    match_sigma_px: float


@dataclass(frozen=True, kw_only=True)
class RefineTask:
    """One view whose depth is to be made exact."""

    store: ViewStore
    index: int
    view: View
    others: tuple[tuple[int, View], ...]


@dataclass(frozen=True, kw_only=True)
class CheckTask:
    """One view whose depth the neighbours are asked about."""

    store: ViewStore
    index: int
    view: View
    neighbours: tuple[tuple[int, View], ...]
    doubt: float
    """By which the standard deviations of refined depths are taken."""


def run_dense(workspace: Path, config: SurveyConfig, threads: int) -> bool:
    """Find the surface of a finished sparse model and write `dense/`.

    Returns:
        True when done, False when nothing had changed.

    Raises:
        ReconstructionError: the views do not overlap, or no depth was found.
        WorkspaceError: a stage is missing.
    """
    need_stage(workspace, "images", "image")
    sparse = need_stage(workspace, "sparse", "reconstruct")
    model = read_model(sparse)
    settings = config.reconstruct.model_dump(
        mode="json", include={"dense_scale", "dense_partners", "dem_cell_m"}
    )
    stage = Stage(
        name="dense",
        version=2,
        settings=settings,
        inputs=[sparse, *picture_files(workspace, sparse, model)],
        resumes=True,
    )

    def work(folder: Path) -> None:
        build_surface(workspace, model, folder, config.reconstruct, threads)

    return run_stage(workspace, stage, work)


def picture_files(workspace: Path, sparse: Path, model: SparseModel) -> list[Path]:
    """The registered pictures and their masks."""
    from alice_survey.artefacts import read_json

    images = workspace / "images"
    about = read_json(sparse / "cameras.json")["images"]
    names = [view.image for view in model.views]
    masks = [about[name]["mask"] for name in names if about[name].get("mask")]
    return [images / name for name in [*names, *masks]]


def build_surface(
    workspace: Path,
    model: SparseModel,
    folder: Path,
    settings: ReconstructConfig,
    threads: int,
) -> None:
    """Do the work of the stage in a folder; see `run_dense`."""
    store = ViewStore(folder / "scratch")
    store.folder.mkdir(parents=True, exist_ok=True)
    partners = choose_pairs(model, settings.dense_partners)
    points = list(_points_in_sight(model))
    conditions = find_conditions(
        workspace, model.views, partners, points, settings.dense_scale, threads
    )
    views = [scaled_view(view, conditions.scale) for view in model.views]
    prepare = [
        PrepareTask(
            workspace=workspace,
            store=store,
            index=index,
            image=view.image,
            size_px=(view.width_px, view.height_px),
        )
        for index, view in enumerate(views)
    ]
    _drain(parallel_map(prepare_view, prepare, threads=threads, label="even out pictures"))
    depths = [
        DepthTask(
            store=store,
            index=index,
            view=views[index],
            partners=tuple((pair.partner, views[pair.partner]) for pair in pairs),
            points_world=points[index],
            match_sigma_px=conditions.match_sigma_px,
        )
        for index, pairs in enumerate(partners)
    ]
    _drain(parallel_map(view_depth, depths, threads=threads, label="match"))
    neighbours = _neighbours(model)
    refine_tasks = [
        RefineTask(
            store=store,
            index=index,
            view=views[index],
            others=tuple((n, views[n]) for n in _looked_at(partners[index], neighbours[index])),
        )
        for index in range(len(views))
    ]
    _drain(parallel_map(refine_view, refine_tasks, threads=threads, label="refine"))
    checks = [
        CheckTask(
            store=store,
            index=index,
            view=views[index],
            neighbours=tuple((n, views[n]) for n in neighbours[index]),
            doubt=1.0,
        )
        for index in range(len(views))
    ]
    doubt = find_doubt(checks, threads)
    checks = [replace(check, doubt=doubt) for check in checks]
    summaries = list(parallel_map(check_view, checks, threads=threads, label="cross-check"))
    grid = surface_grid(summaries, settings.dem_cell_m, model.frame)
    offset = _offset(grid, summaries)
    edge = voxel_edge(grid.cell, grid.rows * grid.columns, _MOST_POINTS)
    light = solve_light(
        joined_samples([summary.light for summary in summaries]),
        np.stack([summary.nodes for summary in summaries]),
        [view.image for view in views],
        [view.camera for view in views],
    )
    write_light(folder / "light.json", light)
    tasks = tile_tasks(store, grid, views, summaries, light, offset, edge, doubt)
    tiles = parallel_map(fuse_tile, tasks, threads=threads, label="fuse")
    parts = _write_rasters(folder, grid, model.frame, tiles)
    with laz_writer(folder / "cloud.laz", offset, model.frame) as write_laz:
        count = write_ply(folder / "cloud.ply", write_laz(parts), offset, model.frame)
    if count == 0:
        raise ReconstructionError(
            f"no depth was confirmed by a second view in {len(views)} pictures; they need more "
            "overlap, sharper texture or better positions"
        )
    write_cloud_json(folder / "cloud.json", count, offset, edge, model.frame)
    write_json(
        folder / "surface.json",
        {
            "format": "alice-survey surface",
            "version": 1,
            "matching_scale": conditions.scale,
            "match_sigma_px": conditions.match_sigma_px,
            "refined_with": _LOOKS,
            "sigma_factor": round(doubt, 3),
            "cell": grid.cell,
            "unit": model.frame.unit,
            "rows": grid.rows,
            "columns": grid.columns,
            "frame": model.frame.name,
            "vertical_datum": model.frame.vertical_datum,
            "pairs": sum(len(pairs) for pairs in partners),
            "gaps_bridged_cells": FILL_CELLS,
            "notes": list(model.frame.notes),
        },
    )
    preview_dem(folder / "dem.tif", folder / "dem.png")
    shutil.rmtree(store.folder)


def prepare_view(task: PrepareTask) -> None:
    """Keep a picture's colour and validity at the size of matching."""
    store = task.store
    if store.has(task.index, "low"):
        return
    colour, valid = shrunk(open_pictures(task.workspace), task.image, task.size_px)
    store.save_colour(task.index, colour)
    store.save_mask(task.index, "valid", valid)
    store.save(task.index, "low", low_pass(colour, valid))


@lru_cache(maxsize=8)
def _evened(store: ViewStore, index: int) -> NDArray[np.uint8]:
    """A picture of even light and contrast."""
    return normalise(store.load_bright(index))


@lru_cache(maxsize=8)
def _look(store: ViewStore, index: int, width: int) -> tuple[NDArray[Any], ...]:
    """Contrast, spline and validity of a picture."""
    return prepared(store.load_bright(index), store.load_mask(index, "valid", width))


def view_depth(task: DepthTask) -> None:
    """Match a view with its partners and merge what they say."""
    store = task.store
    if store.has(task.index, "agreeing"):
        return
    shape = (task.view.height_px, task.view.width_px)
    depths, sigmas = [], []
    for number, partner in task.partners:
        found = pair_depth(
            task.view,
            partner,
            _evened(store, task.index),
            _evened(store, number),
            store.load_mask(task.index, "valid", task.view.width_px),
            store.load_mask(number, "valid", partner.width_px),
            task.points_world,
            task.match_sigma_px,
        )
        if found is not None:
            depths.append(found[0])
            sigmas.append(found[1])
    if depths:
        depth, sigma, agreeing = merge_depths(np.stack(depths), np.stack(sigmas), GATE_SIGMAS)
    else:
        depth = np.full(shape, np.nan, np.float32)
        sigma, agreeing = depth, np.zeros(shape, np.uint8)
    store.save_depth(task.index, "depth", depth, sigma)
    store.save(task.index, "agreeing", agreeing)


def refine_view(task: RefineTask) -> None:
    """Make a view's depth exact by all of its neighbours at once, and fill its gaps."""
    store = task.store
    if store.has(task.index, "fine"):
        return
    looks = []
    for number, view in ((task.index, task.view), *task.others):
        contrast, spline, valid = _look(store, number, view.width_px)
        looks.append(Look(view=view, contrast=contrast, spline=spline, valid=valid))
    depth, _ = store.load_depth(task.index, "depth")
    refined = refine(looks[0], depth, looks[1:])
    agreeing = np.asarray(store.load(task.index, "agreeing"))
    support = np.where(np.isfinite(depth), np.maximum(agreeing, refined.seen), refined.seen)
    store.save(task.index, "seen", support.astype(np.uint8))
    store.save_depth(task.index, "fine", refined.depth, refined.sigma)
    store.drop(task.index, "agreeing")
    store.drop(task.index, "depth")
    store.drop(task.index, "depth.sigma")


def find_doubt(checks: Sequence[CheckTask], threads: int) -> float:
    """How far refined depths of neighbouring views differ, in standard deviations as stated.

    What the noise of pictures cannot tell (detail finer than the window, poses, calibration) shows
    where views differ. The median over some views spread over the survey; at least 1.
    """
    step = max(1, len(checks) // _DOUBTERS)
    spreads = list(parallel_map(disagreement, checks[::step], threads=threads, label="compare"))
    told = [spread for spread in spreads if np.isfinite(spread)]
    return max(1.0, float(np.median(told))) if told else 1.0


def disagreement(task: CheckTask) -> float:
    """Scatter of a view's depths against its neighbours', in standard deviations; NaN if none."""
    depth, sigma = task.store.load_depth(task.index, "fine")
    lattice = np.zeros(depth.shape, np.bool_)
    lattice[_DOUBT_STEP // 2 :: _DOUBT_STEP, _DOUBT_STEP // 2 :: _DOUBT_STEP] = True
    rows, columns = np.nonzero(lattice & np.isfinite(depth))
    points = _world_points(task.view, depth, rows, columns)
    parts = []
    for number, other in task.neighbours:
        there, doubt = task.store.load_depth(number, "fine")
        seen = in_frame(other, points)
        at = np.floor(other.project(points[seen])).astype(np.int64)
        z = other.world_from_cam.inv().apply(points[seen])[:, 2]
        other_z, other_sigma = there[at[:, 1], at[:, 0]], doubt[at[:, 1], at[:, 0]]
        own = sigma[rows, columns][seen]
        parts.append((other_z - z) / np.hypot(own, other_sigma))
    apart = np.concatenate(parts) if parts else np.empty(0)
    apart = apart[np.isfinite(apart)]
    return 1.4826 * float(np.median(np.abs(apart))) if len(apart) >= _LEAST_PIXELS else np.nan


def _looked_at(pairs: Sequence[StereoPair], neighbours: Sequence[int]) -> list[int]:
    """Views to refine depth with: the partners, then those that share most."""
    chosen = [pair.partner for pair in pairs]
    if not chosen:
        return []
    chosen += [n for n in neighbours if n not in chosen]
    return chosen[:_LOOKS]


def check_view(task: CheckTask) -> ViewSummary:
    """Keep the depths that two independent looks support.

    A depth stays where the neighbours whose windows look alike (or the partners that agree) and the
    neighbouring views that find the same surface number two or more, and no more views see through
    it than confirm it.
    """
    store, view = task.store, task.view
    depth, sigma = store.load_depth(task.index, "fine")
    sigma *= np.float32(task.doubt)
    alike = np.asarray(store.load(task.index, "seen")).astype(np.int16)
    refuted = np.zeros_like(alike)
    supported = np.zeros_like(alike)
    for number, other in task.neighbours:
        other_from_ref = other.world_from_cam.inv() * view.world_from_cam
        other_depth, other_sigma = store.load_depth(number, "fine")
        seen, through = count_witnesses(
            depth,
            sigma,
            lens_of(view),
            np.ascontiguousarray(other_from_ref.as_matrix()[:3]),
            other_depth,
            other_sigma * np.float32(task.doubt),
            lens_of(other),
            GATE_SIGMAS,
        )
        supported += seen
        refuted += through
    kept = np.isfinite(depth) & (alike + supported >= 2) & (refuted <= supported)
    rows, columns = np.nonzero(kept)
    nodes = at_nodes(np.asarray(store.load(task.index, "low")))
    if len(rows) < _LEAST_PIXELS:
        store.save_mask(task.index, "kept", np.zeros_like(kept))
        return ViewSummary(
            bounds=None,
            up=np.nan,
            footprint=np.nan,
            sigma=np.nan,
            light=joined_samples([]),
            nodes=nodes,
        )
    points = _world_points(view, depth, rows, columns)
    low, high = np.percentile(points[:, :2], [_BOUND_PERCENT, 100 - _BOUND_PERCENT], axis=0)
    beyond = (points[:, :2] < low) | (points[:, :2] > high)
    kept[rows, columns] = ~beyond.any(axis=1)
    store.save_mask(task.index, "kept", kept)
    return ViewSummary(
        bounds=(float(low[0]), float(low[1]), float(high[0]), float(high[1])),
        up=float(-np.median(points[:, 2])),
        footprint=float(np.median(depth[kept]) / np.sqrt(view.fx_px * view.fy_px)),
        sigma=float(np.median(sigma[kept])),
        light=_shared_light(task, points, rows, columns),
        nodes=nodes,
    )


def _shared_light(
    task: CheckTask, points: Array, rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> LightSamples:
    """Compare the light of a view and its neighbours on a lattice of its pixels."""
    step = max(1, task.view.width_px // _LIGHT_LATTICE)
    chosen = (rows % step == 0) & (columns % step == 0)
    spots = points[chosen]
    size = np.array([task.view.width_px, task.view.height_px])
    here = (np.stack([columns[chosen], rows[chosen]], axis=1) + 0.5) / size
    own = np.asarray(task.store.load(task.index, "low"))
    parts = []
    for number, other in task.neighbours:
        seen = in_frame(other, spots)
        there = other.project(spots[seen]) / [other.width_px, other.height_px]
        parts.append(
            compare_light(
                (task.index, number),
                (own, np.asarray(task.store.load(number, "low"))),
                (here[seen].astype(np.float32), there.astype(np.float32)),
            )
        )
    return joined_samples(parts)


def surface_grid(
    summaries: Sequence[ViewSummary], cell: float | None, frame: WorldFrame
) -> DemGrid:
    """The grid over all points.

    Raises:
        ReconstructionError: no view has depth, or the grid would be too large.
    """
    bounds = [s.bounds for s in summaries if s.bounds is not None]
    if not bounds:
        raise ReconstructionError(
            f"no depth was confirmed by a second view in {len(summaries)} pictures; they need "
            "more overlap, sharper texture or better positions"
        )
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


def _world_points(
    view: View, depth: NDArray[np.float32], rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> Array:
    pixels: Array = np.column_stack([columns, rows]).astype(np.float64) + 0.5
    return view.at_depth(pixels, depth[rows, columns].astype(np.float64))


def _points_in_sight(model: SparseModel) -> Iterator[Array]:
    """Per view the points it observed and those of others that fall into its frame."""
    for view, own in zip(model.views, points_of_views(model), strict=True):
        if len(own) == 0:
            yield own
            continue
        centre = view.world_from_cam.translation
        farthest = np.linalg.norm(own - centre, axis=1).max()
        others = model.points_world[in_frame(view, model.points_world)]
        yield others[np.linalg.norm(others - centre, axis=1) <= 1.2 * farthest]


def _neighbours(model: SparseModel) -> list[list[int]]:
    """For each view the others that share most sparse points with it, then the nearest."""
    views = len(model.views)
    from scipy.sparse import coo_matrix

    points, numbers = model.observations.T
    seen = coo_matrix(
        (np.ones(len(points), np.float32), (numbers, points)),
        shape=(views, len(model.points_world)),
    ).tocsr()
    shared = (seen @ seen.T).tolil()
    shared.setdiag(0)
    found = []
    for view in range(views):
        columns = np.array(shared.rows[view], dtype=np.int64)
        counts = np.array(shared.data[view], dtype=np.float64)
        order = np.lexsort((columns, -counts))
        found.append([int(n) for n in columns[order][:_WITNESSES] if counts.size])
    return found


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
