"""The dense surface: depth of every view, fused into a DEM and a coloured point cloud.

Steps, each over independent views or tiles and through files, so that memory stays bounded:
prepare pictures, find each view's depth with a few partners, let neighbours confirm it, fuse tiles.
"""

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rasterio.windows import Window

from alice_survey.artefacts import Stage, need_stage, run_stage
from alice_survey.config import ReconstructConfig, SurveyConfig
from alice_survey.errors import ReconstructionError, warn
from alice_survey.executor import parallel_map
from alice_survey.frames import Array
from reconstruct.cloud import (
    normals_of_depth,
    thinned_points,
    voxel_edge,
    write_cloud_json,
    write_ply,
)
from reconstruct.dem import FILL_CELLS, DemGrid, fill_gaps, fuse_points, grid_over, round_cell
from reconstruct.depth import pair_depth
from reconstruct.fusion import GATE_SIGMAS, count_witnesses, merge_depths, pinhole_of
from reconstruct.model import SparseModel, View, WorldFrame, read_model
from reconstruct.normalise import normalise
from reconstruct.pictures import Pictures
from reconstruct.raster import preview_dem, tiled_raster, tiles_of
from reconstruct.rectify import scaled_view
from reconstruct.stereo_pairs import choose_pairs, in_frame, points_of_views
from reconstruct.view_store import ViewStore

LARGEST_PIXELS = 3_000_000
"""Pictures with more pixels are halved for matching, until they have fewer."""
CELL_PIXELS = 2.5
"""Side of a DEM cell in mean ground pixels of the pictures as matched."""
_WITNESSES = 8
"""Neighbouring views that a view's depth is held against."""
_TILE_CELLS = 512
_MOST_CELLS = 4_000_000_000
_MOST_POINTS = 40_000_000
_BOUND_PERCENT = 0.1
"""Points of a view left out at each side when the extent of the DEM is found."""


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


@dataclass(frozen=True, kw_only=True)
class CheckTask:
    """One view whose depth the neighbours are asked about."""

    store: ViewStore
    index: int
    view: View
    neighbours: tuple[tuple[int, View], ...]


@dataclass(frozen=True, kw_only=True)
class ViewSummary:
    """Where the points of a view lie."""

    bounds: tuple[float, float, float, float] | None
    """South, west, north, east; None where no depth was found."""
    up: float
    """Median height of its points."""
    footprint: float
    """Side of a pixel on the ground."""


@dataclass(frozen=True, kw_only=True)
class TileTask:
    """One tile of the grid to fuse."""

    store: ViewStore
    window: Window
    grid: DemGrid
    """Of the tile with its rim."""
    rim: tuple[int, int, int, int]
    """Cells around the tile, top, bottom, left, right, that only serve to fill gaps."""
    views: tuple[tuple[int, View], ...]
    offset_enu: tuple[float, float, float]
    edge: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Tile:
    """A fused tile."""

    window: Window
    height: NDArray[np.float32]
    sigma: NDArray[np.float32]
    count: NDArray[np.uint16]
    vertices: NDArray[Any]


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
        version=1,
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
    views = [
        scaled_view(view, settings.dense_scale or matching_scale(view)) for view in model.views
    ]
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
            points_world=points,
        )
        for index, (pairs, points) in enumerate(zip(partners, _points_in_sight(model), strict=True))
    ]
    _drain(parallel_map(view_depth, depths, threads=threads, label="match"))
    checks = [
        CheckTask(
            store=store,
            index=index,
            view=views[index],
            neighbours=tuple((n, views[n]) for n in neighbours),
        )
        for index, neighbours in enumerate(_neighbours(model))
    ]
    summaries = list(parallel_map(check_view, checks, threads=threads, label="cross-check"))
    grid = surface_grid(summaries, settings.dem_cell_m, model.frame)
    offset = _offset(grid, summaries)
    edge = voxel_edge(grid.cell, grid.rows * grid.columns, _MOST_POINTS)
    tasks = tile_tasks(store, grid, views, summaries, offset, edge)
    tiles = parallel_map(fuse_tile, tasks, threads=threads, label="fuse")
    count = write_ply(
        folder / "cloud.ply", _write_rasters(folder, grid, model.frame, tiles), offset, model.frame
    )
    if count == 0:
        raise ReconstructionError(
            f"no depth was confirmed by a second view in {len(views)} pictures; they need more "
            "overlap, sharper texture or better positions"
        )
    write_cloud_json(folder / "cloud.json", count, offset, edge, model.frame)
    preview_dem(folder / "dem.tif", folder / "dem.png")
    shutil.rmtree(store.folder)


def matching_scale(view: View) -> float:
    """1, 1/2, 1/4, ...: the largest at which a picture has no more than `LARGEST_PIXELS`."""
    scale = 1.0
    while view.width_px * view.height_px * scale * scale > LARGEST_PIXELS:
        scale /= 2.0
    return scale


@lru_cache(maxsize=1)
def _pictures(workspace: Path) -> Pictures:
    return Pictures.open(workspace)


def prepare_view(task: PrepareTask) -> None:
    """Keep a picture's colour, evened-out grey and validity at the size of matching."""
    if task.store.has(task.index, "grey"):
        return
    pictures = _pictures(task.workspace)
    colour, valid = pictures.colour(task.image), pictures.valid(task.image)
    if colour.shape[1::-1] != task.size_px:
        colour = cv2.resize(colour, task.size_px, interpolation=cv2.INTER_AREA)
        valid = cv2.resize(valid.astype(np.uint8), task.size_px, interpolation=cv2.INTER_AREA) > 0
    task.store.save(task.index, "colour", colour)
    task.store.save(task.index, "valid", valid)
    task.store.save(task.index, "grey", normalise(colour))


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
            np.asarray(store.load(task.index, "grey")),
            np.asarray(store.load(number, "grey")),
            np.asarray(store.load(task.index, "valid")),
            np.asarray(store.load(number, "valid")),
            task.points_world,
        )
        if found is not None:
            depths.append(found[0])
            sigmas.append(found[1])
    if depths:
        depth, sigma, agreeing = merge_depths(np.stack(depths), np.stack(sigmas), GATE_SIGMAS)
    else:
        depth = np.full(shape, np.nan, np.float32)
        sigma, agreeing = depth, np.zeros(shape, np.uint8)
    store.save(task.index, "depth", depth)
    store.save(task.index, "sigma", sigma)
    store.save(task.index, "agreeing", agreeing)


def check_view(task: CheckTask) -> ViewSummary:
    """Keep the depths that at least two matches beside the view's own word support.

    A depth stays where the partners that agree and the neighbouring views that find the same
    surface number three or more, and no more views see through it than confirm it.
    """
    store, view = task.store, task.view
    depth = np.asarray(store.load(task.index, "depth"))
    sigma = np.asarray(store.load(task.index, "sigma"))
    confirmed = np.asarray(store.load(task.index, "agreeing")).astype(np.int16)
    refuted = np.zeros_like(confirmed)
    supported = np.zeros_like(confirmed)
    for number, other in task.neighbours:
        other_from_ref = other.world_from_cam.inv() * view.world_from_cam
        seen, through = count_witnesses(
            depth,
            sigma,
            pinhole_of(view),
            np.ascontiguousarray(other_from_ref.as_matrix()[:3]),
            np.asarray(store.load(number, "depth")),
            np.asarray(store.load(number, "sigma")),
            pinhole_of(other),
            GATE_SIGMAS,
        )
        supported += seen
        refuted += through
    kept = np.isfinite(depth) & (confirmed + supported >= 3) & (refuted <= supported)
    store.save(task.index, "kept", kept)
    rows, columns = np.nonzero(kept)
    if len(rows) < 100:
        return ViewSummary(bounds=None, up=np.nan, footprint=np.nan)
    points = _world_points(view, depth, rows, columns)
    low, high = np.percentile(points[:, :2], [_BOUND_PERCENT, 100 - _BOUND_PERCENT], axis=0)
    return ViewSummary(
        bounds=(float(low[0]), float(low[1]), float(high[0]), float(high[1])),
        up=float(-np.median(points[:, 2])),
        footprint=float(np.median(depth[kept]) / np.sqrt(view.fx_px * view.fy_px)),
    )


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
    footprints = [s.footprint for s in summaries if s.bounds is not None]
    size = cell or round_cell(CELL_PIXELS * float(np.median(footprints)))
    grid = grid_over(bounds, size)
    if grid.rows * grid.columns > _MOST_CELLS:
        raise ReconstructionError(
            f"cells of {size} {frame.unit} would make a grid of {grid.rows} x {grid.columns}; "
            "raise reconstruct.dem_cell_m"
        )
    return grid


def tile_tasks(
    store: ViewStore,
    grid: DemGrid,
    views: Sequence[View],
    summaries: Sequence[ViewSummary],
    offset_enu: tuple[float, float, float],
    edge: float,
) -> list[TileTask]:
    """Tiles in the order of the file's rows, each with the views whose points may fall in it."""
    tasks = []
    for window in tiles_of(grid, _TILE_CELLS):
        row, column = int(window.row_off), int(window.col_off)
        rows, columns = int(window.height), int(window.width)
        rim = (
            min(FILL_CELLS, row),
            min(FILL_CELLS, grid.rows - row - rows),
            min(FILL_CELLS, column),
            min(FILL_CELLS, grid.columns - column - columns),
        )
        part = grid.window(
            row - rim[0], column - rim[2], rows + rim[0] + rim[1], columns + rim[2] + rim[3]
        )
        south, east = float(part.north_of(part.rows)), float(part.east_of(part.columns))
        seeing = []
        for index, summary in enumerate(summaries):
            if summary.bounds is None:
                continue
            s, w, n, e = summary.bounds
            margin = 0.05 * max(n - s, e - w)  # points beyond the percentiles of the bounds
            beside = s - margin >= part.north or n + margin <= south
            if not (beside or w - margin >= east or e + margin <= part.west):
                seeing.append((index, views[index]))
        tasks.append(
            TileTask(
                store=store,
                window=window,
                grid=part,
                rim=rim,
                views=tuple(seeing),
                offset_enu=offset_enu,
                edge=edge,
            )
        )
    return tasks


def fuse_tile(task: TileTask) -> Tile:
    """Fuse the points of all views in a tile into cells and cloud points."""
    grid, (top, bottom, left, right) = task.grid, task.rim
    parts = [_points_in_tile(task, index, view) for index, view in task.views]
    points = np.concatenate([p.points for p in parts] or [np.empty((0, 3))])
    sigmas = np.concatenate([p.sigmas for p in parts] or [np.empty(0, np.float32)])
    numbers = np.concatenate(
        [
            np.full(len(p.points), index, np.int32)
            for p, (index, _) in zip(parts, task.views, strict=True)
        ]
        or [np.empty(0, np.int32)]
    )
    height, sigma, count = fuse_points(grid, points, sigmas, numbers)
    height, sigma = fill_gaps(height, sigma, FILL_CELLS)
    inner = (slice(top, grid.rows - bottom), slice(left, grid.columns - right))
    own = grid.window(top, left, grid.rows - top - bottom, grid.columns - left - right)
    inside = (
        (points[:, 0] <= own.north)
        & (points[:, 0] > own.north_of(own.rows))
        & (points[:, 1] >= own.west)
        & (points[:, 1] < own.east_of(own.columns))
    )
    normals = np.concatenate([p.normals_world for p in parts] or [np.empty((0, 3), np.float32)])
    colours = np.concatenate([p.colours for p in parts] or [np.empty((0, 3), np.uint8)])
    inside &= np.isfinite(normals).all(axis=1)
    local = _enu(points[inside]) - np.array(task.offset_enu)
    vertices = thinned_points(
        local.astype(np.float32),
        _enu(normals[inside]).astype(np.float32),
        colours[inside],
        sigmas[inside],
        task.edge,
    )
    return Tile(
        window=task.window,
        height=height[inner],
        sigma=sigma[inner],
        count=count[inner],
        vertices=vertices,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Points:
    points: Array
    sigmas: NDArray[np.float32]
    normals_world: NDArray[np.float32]
    colours: NDArray[np.uint8]
    """RGB."""


def _points_in_tile(task: TileTask, index: int, view: View) -> _Points:
    store, grid = task.store, task.grid
    depth = np.asarray(store.load(index, "depth"))
    rows, columns = np.nonzero(store.load(index, "kept"))
    points = _world_points(view, depth, rows, columns)
    inside = (
        (points[:, 0] <= grid.north)
        & (points[:, 0] > grid.north_of(grid.rows))
        & (points[:, 1] >= grid.west)
        & (points[:, 1] < grid.east_of(grid.columns))
    )
    rows, columns, points = rows[inside], columns[inside], points[inside]
    if len(rows) == 0:
        empty = np.empty((0, 3))
        return _Points(
            points=empty,
            sigmas=np.empty(0, np.float32),
            normals_world=empty.astype(np.float32),
            colours=empty.astype(np.uint8),
        )
    top, bottom = max(rows.min() - 2, 0), rows.max() + 3
    pinhole = pinhole_of(view) - [0, 0, 0, top]
    normals = normals_of_depth(depth[top:bottom], pinhole)[rows - top, columns]
    return _Points(
        points=points,
        sigmas=np.asarray(store.load(index, "sigma"))[rows, columns],
        normals_world=view.world_from_cam.rotation.apply(normals).astype(np.float32),
        colours=np.asarray(store.load(index, "colour"))[rows, columns][:, ::-1],
    )


def _world_points(
    view: View, depth: NDArray[np.float32], rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> Array:
    z = depth[rows, columns].astype(np.float64)
    x = (columns + 0.5 - view.cx_px) / view.fx_px * z
    y = (rows + 0.5 - view.cy_px) / view.fy_px * z
    points: Array = view.world_from_cam.apply(np.stack([x, y, z], axis=1))
    return points


def _enu(vectors_world: Array | NDArray[np.float32]) -> Array:
    return np.stack([vectors_world[:, 1], vectors_world[:, 0], -vectors_world[:, 2]], axis=1)


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
    datum = frame.vertical_datum
    texts = (
        f"height above {datum}, positive up ({frame.unit})",
        f"standard deviation of the height ({frame.unit})",
        "views that the height rests on; 0 where a small gap was bridged",
    )
    with (
        tiled_raster(folder / "dem.tif", grid, frame, "float32", np.nan, texts[0]) as dem,
        tiled_raster(folder / "sigma.tif", grid, frame, "float32", np.nan, texts[1]) as sigma,
        tiled_raster(folder / "count.tif", grid, frame, "uint16", None, texts[2]) as count,
    ):
        for tile in tiles:
            dem.write(tile.height, 1, window=tile.window)
            sigma.write(tile.sigma, 1, window=tile.window)
            count.write(tile.count, 1, window=tile.window)
            yield tile.vertices


def _drain(results: Iterator[None]) -> None:
    for _ in results:
        pass
