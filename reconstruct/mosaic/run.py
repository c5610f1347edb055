"""The orthomosaic: every pixel of the DEM's plane painted by the views that see it best.

Fine detail comes from the best view (with a seam a few pixels wide), broad brightness is blended
over all views that see a place: two bands of a multi-band blend (Burt & Adelson 1983). Light is
evened out by the survey's own model (`light.json`) before, never picture by picture.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import rasterio
import rasterio.shutil
from numpy.typing import NDArray
from rasterio.windows import Window

from alice_survey.artefacts import Stage, need_stage, run_stage, write_json
from alice_survey.config import SurveyConfig
from alice_survey.errors import ReconstructionError, warn
from alice_survey.executor import parallel_map
from reconstruct.dense.dem import DemGrid, round_cell
from reconstruct.dense.points import enu_from_cam, pinhole_of
from reconstruct.dense.run import picture_files
from reconstruct.dense.stereo_pairs import points_of_views
from reconstruct.model import SparseModel, View, WorldFrame, read_model
from reconstruct.mosaic.light import LightModel, low_pass, read_light
from reconstruct.mosaic.ortho import look_up, visible_cells
from reconstruct.pictures.undistorted import Pictures
from reconstruct.raster import BLOCK, crs_of, frame_tags, tiles_of, transform_of, write_png

Float32 = NDArray[np.float32]

_TILE_PX = 1024
_MOST_PIXELS = 4_000_000_000
_CACHED_BYTES = 600_000_000
"""Pictures kept by each process."""
_BROAD_POWER, _FINE_POWER = 3, 24
"""Powers of quality that weigh views in the broad and in the fine band."""
_HIDES_CELLS = 2.5
"""Height over a line of sight, in cells of the DEM, at which a cell hides what is behind it."""
_LEAST_SHARE = 0.1
"""Views of less than this share of the best quality are not used."""
_THUMBNAIL_PX = 1600


@dataclass(frozen=True, kw_only=True)
class TileTask:
    """One tile of the mosaic to paint."""

    workspace: Path
    window: Window
    grid: DemGrid
    """Of the tile's pixels."""
    views: tuple[tuple[int, View], ...]
    light: LightModel
    reach: float
    """How far off, on the ground, the DEM may hide something in the tile."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Painted:
    """A painted tile."""

    window: Window
    rgba: NDArray[np.uint8]
    """(4, H, W)."""
    source: NDArray[np.uint16]
    """(H, W) number of the best view plus one; 0 where nothing is known."""


def run_mosaic(workspace: Path, config: SurveyConfig, threads: int) -> bool:
    """Paint the mosaic on a finished surface and write `mosaic/`.

    Returns:
        True when done, False when nothing had changed.

    Raises:
        ReconstructionError: the surface has no cell.
        WorkspaceError: a stage is missing.
    """
    need_stage(workspace, "images", "image")
    sparse = need_stage(workspace, "sparse", "reconstruct")
    dense = need_stage(workspace, "dense", "reconstruct")
    model = read_model(sparse)
    wanted = config.reconstruct.mosaic_pixel_m
    inputs = [sparse, dense / "dem.tif", dense / "light.json", dense / "cloud.json"]
    stage = Stage(
        name="mosaic",
        version=1,
        settings={"mosaic_pixel_m": wanted},
        inputs=[*inputs, *picture_files(workspace, sparse, model)],
    )

    def work(folder: Path) -> None:
        build_mosaic(workspace, model, folder, wanted, threads)

    return run_stage(workspace, stage, work)


def build_mosaic(
    workspace: Path, model: SparseModel, folder: Path, wanted: float | None, threads: int
) -> None:
    """Do the work of the stage in a folder; see `run_mosaic`."""
    dem = workspace / "dense" / "dem.tif"
    light = read_light(workspace / "dense" / "light.json")
    views = [(n, view) for n, view in enumerate(model.views) if view.image in light.gains]
    with rasterio.open(dem) as raster:
        low, high = _height_range(raster)
        pixel = wanted or round_cell(_mean_pixel(model))
        grid = mosaic_grid(raster, pixel, model.frame)
    tasks = tile_tasks(workspace, grid, views, light, (low, high))
    names = [view.image for view in model.views]
    rough = folder / "rough.tif"
    tiles = parallel_map(paint_tile, tasks, threads=threads, label="mosaic")
    covered = _write_tiles(rough, folder / "mosaic_source.tif", grid, model.frame, tiles, names)
    _cloud_optimised(rough, folder / "mosaic.tif")
    rough.unlink()
    _thumbnail(folder / "mosaic.tif", folder / "mosaic.png")
    write_json(
        folder / "mosaic.json",
        {
            "format": "alice-survey mosaic",
            "version": 1,
            "width_px": grid.columns,
            "height_px": grid.rows,
            "pixel": grid.cell,
            "unit": model.frame.unit,
            "frame": model.frame.name,
            "covered": covered,
            "vertical_datum": model.frame.vertical_datum,
            "white_blue_green_red": [float(w) for w in light.white],
            "notes": [
                *model.frame.notes,
                "colours: light of lamp and lens evened out over the survey; one factor per "
                "colour for the whole survey makes what is bright in it neutral",
            ],
            "pictures": names,
        },
    )


def mosaic_grid(raster: rasterio.DatasetReader, pixel: float, frame: WorldFrame) -> DemGrid:
    """Pixels over the whole of the DEM; larger ones than wanted where there would be too many."""
    transform = raster.transform
    width, height = raster.width * transform.a, -raster.height * transform.e
    while width * height / pixel**2 > _MOST_PIXELS:
        warn(
            f"pixels of {pixel} {frame.unit} would make a mosaic of "
            f"{width * height / pixel**2 / 1e9:.0f} Gpx; they are doubled"
        )
        pixel *= 2.0
    return DemGrid(
        west=transform.c,
        north=transform.f,
        cell=pixel,
        rows=int(np.ceil(height / pixel)),
        columns=int(np.ceil(width / pixel)),
    )


def tile_tasks(
    workspace: Path,
    grid: DemGrid,
    views: list[tuple[int, View]],
    light: LightModel,
    heights: tuple[float, float],
) -> list[TileTask]:
    """Tiles row by row, each with the views whose footprint between two heights reaches it."""
    boxes = [_footprint(view, heights) for _, view in views]
    tasks = []
    for window in tiles_of(grid, _TILE_PX):
        part = grid.window(window.row_off, window.col_off, window.height, window.width)
        east, south = float(part.east_of(part.columns)), float(part.north_of(part.rows))
        seeing, reach = [], 0.0
        for (number, view), (w, e, s, n, slope) in zip(views, boxes, strict=True):
            if w < east and e > part.west and s < part.north and n > south:
                seeing.append((number, view))
                reach = max(reach, slope * (heights[1] - heights[0]))
        tasks.append(
            TileTask(
                workspace=workspace,
                window=window,
                grid=part,
                views=tuple(seeing),
                light=light,
                reach=min(reach, 0.5 * _TILE_PX * grid.cell),
            )
        )
    return tasks


def paint_tile(task: TileTask) -> Painted:
    """Paint one tile from all views that see it."""
    grid = task.grid
    with rasterio.open(task.workspace / "dense" / "dem.tif") as raster:
        dem, around = _dem_around(raster, grid, task.reach)
    height = _height_at_pixels(dem, around, grid)
    shape = (grid.rows, grid.columns)
    broad, fine = np.zeros((*shape, 3), np.float32), np.zeros((*shape, 3), np.float32)
    broad_weight, fine_weight = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    best, source = np.zeros(shape, np.float32), np.zeros(shape, np.uint16)
    looks = []
    if np.isfinite(height).any():
        for number, view in task.views:
            x, y, quality = _look(task, view, dem, around, height)
            if quality.any():
                source[quality > best] = number + 1
                best = np.maximum(best, quality)
                looks.append((view, x, y, quality))
    for view, x, y, quality in looks:
        share = np.divide(quality, best, out=np.zeros_like(quality), where=best > 0)
        used = share > _LEAST_SHARE
        if not used.any():
            continue
        part = _bounding(used)
        share = np.where(used, share, 0)[part]
        low, detail = _sample(task, view, x[part], y[part])
        w = share**_BROAD_POWER
        broad[part] += w[..., None] * low
        broad_weight[part] += w
        w = share**_FINE_POWER
        fine[part] += w[..., None] * detail
        fine_weight[part] += w
    known = fine_weight > 0
    colour = np.zeros((*shape, 3), np.float32)
    colour[known] = (
        broad[known] / broad_weight[known][:, None] + fine[known] / fine_weight[known][:, None]
    )
    rgba = np.zeros((4, *shape), np.uint8)
    rgba[:3] = np.rint(np.clip(colour[..., ::-1], 0, 255)).astype(np.uint8).transpose(2, 0, 1)
    rgba[3] = np.where(known, 255, 0)
    return Painted(window=task.window, rgba=rgba, source=np.where(known, source, 0))


def _look(
    task: TileTask, view: View, dem: Float32, around: DemGrid, height: Float32
) -> tuple[Float32, Float32, Float32]:
    """Where and how well a view sees the tile's pixels, its mask applied."""
    grid = task.grid
    camera = enu_from_cam(view, np.zeros(3))
    visible = visible_cells(
        dem, camera[:, 3], around.west, around.north, around.cell, _HIDES_CELLS * around.cell
    )
    east, north = float(grid.east_of(0.5)), float(grid.north_of(0.5))
    rotation = camera[:, :3].T
    cam_from_enu = np.column_stack([rotation, -rotation @ camera[:, 3]])
    x, y, quality = look_up(
        height,
        visible,
        ((around.north - north) / around.cell - 0.5, (east - around.west) / around.cell - 0.5),
        grid.cell / around.cell,
        np.ascontiguousarray(cam_from_enu),
        pinhole_of(view),
        (view.width_px, view.height_px),
        (east, north),
        grid.cell,
        2.0,
    )
    if quality.any():
        valid = _loader(task.workspace).load(view.image)[2]
        inside = cv2.remap(valid, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        quality[inside < 255] = 0
    return x, y, quality


def _sample(task: TileTask, view: View, x: Float32, y: Float32) -> tuple[Float32, Float32]:
    """Broad and fine band of a view's evened-out colour at pixels, BGR."""
    colour, low, _ = _loader(task.workspace).load(view.image)
    factors = task.light.factors(view.camera, view.image)
    rows, columns = factors.shape[:2]
    lift = cv2.remap(
        factors,
        ((x + 0.5) / view.width_px * (columns - 1)).astype(np.float32),
        ((y + 0.5) / view.height_px * (rows - 1)).astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    sharp = cv2.remap(colour, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    shrink_x, shrink_y = low.shape[1] / view.width_px, low.shape[0] / view.height_px
    smooth = cv2.remap(
        low,
        ((x + 0.5) * shrink_x - 0.5).astype(np.float32),
        ((y + 0.5) * shrink_y - 0.5).astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    broad: Float32 = smooth * lift
    return broad, sharp.astype(np.float32) * lift - broad


class _Loader:
    """Pictures of a workspace with their broad band; the last few stay in memory."""

    def __init__(self, workspace: Path) -> None:
        self._pictures = Pictures.open(workspace)
        self._kept: dict[str, tuple[NDArray[np.uint8], Float32, NDArray[np.uint8]]] = {}

    def load(self, image: str) -> tuple[NDArray[np.uint8], Float32, NDArray[np.uint8]]:
        """Colour BGR, its broad band (small) and its validity (255 where usable)."""
        if image in self._kept:
            self._kept[image] = self._kept.pop(image)  # now the last to go
            return self._kept[image]
        colour, valid = self._pictures.colour(image), self._pictures.valid(image)
        found = (colour, low_pass(colour, valid), valid.astype(np.uint8) * np.uint8(255))
        room = max(1, _CACHED_BYTES // (colour.nbytes + valid.nbytes))
        while len(self._kept) >= room:
            del self._kept[next(iter(self._kept))]
        self._kept[image] = found
        return found


@lru_cache(maxsize=1)
def _loader(workspace: Path) -> _Loader:
    return _Loader(workspace)


def _mean_pixel(model: SparseModel) -> float:
    """Median over the views of the side of a pixel on the ground."""
    sides = []
    for view, points in zip(model.views, points_of_views(model), strict=True):
        if len(points):
            depth = view.world_from_cam.inv().apply(points)[:, 2]
            sides.append(np.median(depth) / np.sqrt(view.fx_px * view.fy_px))
    return float(np.median(sides))


def _height_range(raster: rasterio.DatasetReader) -> tuple[float, float]:
    low, high = np.inf, -np.inf
    for _, window in raster.block_windows(1):
        block = raster.read(1, window=window)
        if np.isfinite(block).any():
            low, high = min(low, float(np.nanmin(block))), max(high, float(np.nanmax(block)))
    if low > high:
        raise ReconstructionError(f"{raster.name} has no cell with a height to paint on")
    return low, high


def _footprint(
    view: View, heights: tuple[float, float]
) -> tuple[float, float, float, float, float]:
    """West, east, south, north of what a view sees between two heights, and the flattest slope.

    Views that reach the horizon see everywhere; slopes (ground per height) end at 5.
    """
    camera = enu_from_cam(view, np.zeros(3))
    w, h = view.width_px, view.height_px
    corners = np.array([[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]]) - [view.cx_px, view.cy_px]
    rays = np.column_stack([corners / [view.fx_px, view.fy_px], np.ones(4)]) @ camera[:, :3].T
    if (rays[:, 2] > -0.2 * np.linalg.norm(rays[:, :2], axis=1)).any():
        return -np.inf, np.inf, -np.inf, np.inf, 5.0
    slope = float((np.linalg.norm(rays[:, :2], axis=1) / -rays[:, 2]).max())
    centre = camera[:, 3]
    reach = [(centre[2] - height) / -rays[:, 2:] for height in heights]
    ground = np.concatenate([centre[:2] + r * rays[:, :2] for r in reach])
    (west, south), (east, north) = ground.min(axis=0), ground.max(axis=0)
    return float(west), float(east), float(south), float(north), slope


def _dem_around(
    raster: rasterio.DatasetReader, grid: DemGrid, reach: float
) -> tuple[Float32, DemGrid]:
    """The DEM of a tile and as far around it as something may hide it."""
    transform = raster.transform
    cell = transform.a
    margin = int(np.ceil(reach / cell)) + 2
    left = max(0, int((grid.west - transform.c) / cell) - margin)
    top = max(0, int((transform.f - grid.north) / cell) - margin)
    right = int(np.ceil((grid.west + grid.columns * grid.cell - transform.c) / cell)) + margin
    bottom = int(np.ceil((transform.f - grid.north + grid.rows * grid.cell) / cell)) + margin
    right, bottom = min(raster.width, right), min(raster.height, bottom)
    heights = raster.read(1, window=Window(left, top, right - left, bottom - top))
    around = DemGrid(
        west=transform.c + left * cell,
        north=transform.f - top * cell,
        cell=cell,
        rows=bottom - top,
        columns=right - left,
    )
    return heights, around


def _height_at_pixels(dem: Float32, around: DemGrid, grid: DemGrid) -> Float32:
    """Bilinear heights at the centres of a tile's pixels; NaN where a cell around is unknown.

    At the outer edge of the DEM the last cell's height holds for the half cell beyond its centre.
    """
    columns = (grid.east_of(np.arange(grid.columns) + 0.5) - around.west) / around.cell - 0.5
    rows = (around.north - grid.north_of(np.arange(grid.rows) + 0.5)) / around.cell - 0.5
    x, y = np.meshgrid(columns.astype(np.float32), rows.astype(np.float32))
    height: Float32 = cv2.remap(dem, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return height


def _bounding(used: NDArray[np.bool_]) -> tuple[slice, slice]:
    rows, columns = np.flatnonzero(used.any(axis=1)), np.flatnonzero(used.any(axis=0))
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def _write_tiles(
    rough: Path,
    source: Path,
    grid: DemGrid,
    frame: WorldFrame,
    tiles: Iterator[Painted],
    names: list[str],
) -> float:
    """Write colours and sources as they come; return the share of pixels that have colour."""
    shared = {
        "driver": "GTiff",
        "width": grid.columns,
        "height": grid.rows,
        "crs": crs_of(frame),
        "transform": transform_of(grid),
        "tiled": True,
        "blockxsize": BLOCK,
        "blockysize": BLOCK,
        "compress": "deflate",
        "zlevel": 1,
        "bigtiff": "if_safer",
    }
    painted = 0
    with (
        rasterio.open(
            rough, "w", count=4, dtype="uint8", photometric="RGB", alpha="yes", **shared
        ) as colours,
        rasterio.open(source, "w", count=1, dtype="uint16", **shared) as sources,
    ):
        colours.update_tags(**frame_tags(frame))
        sources.update_tags(**frame_tags(frame), PICTURES=json.dumps(names))
        sources.set_band_description(1, "picture that painted the pixel, from 1; 0 is none")
        for tile in tiles:
            colours.write(tile.rgba, window=tile.window)
            sources.write(tile.source, 1, window=tile.window)
            painted += int((tile.rgba[3] > 0).sum())
    if painted == 0:
        raise ReconstructionError("no picture sees any cell of dense/dem.tif; redo 'dense'")
    return painted / (grid.rows * grid.columns)


def _cloud_optimised(rough: Path, final: Path) -> None:
    rasterio.shutil.copy(
        rough,
        final,
        driver="COG",
        compress="DEFLATE",
        predictor="YES",
        overview_resampling="AVERAGE",
        blocksize=512,
        bigtiff="IF_SAFER",
        num_threads="1",
    )


def _thumbnail(mosaic: Path, picture: Path) -> None:
    """Write a small copy, unknown pixels transparent."""
    with rasterio.open(mosaic) as raster:
        shrink = max(1.0, max(raster.width, raster.height) / _THUMBNAIL_PX)
        shape = (4, max(1, int(raster.height / shrink)), max(1, int(raster.width / shrink)))
        small = raster.read(out_shape=shape, resampling=rasterio.enums.Resampling.average)
    write_png(picture, np.ascontiguousarray(small[[2, 1, 0, 3]].transpose(1, 2, 0)))
