"""The stage `mosaic`: every pixel of the DEM's plane painted by the picture that sees it best.

Pictures are measured; pairs of views that see one spot give the light of the whole survey; seams
are laid survey-wide on small cells; tiles are painted one by one, each colour resampled once from
the picture as taken. No step holds more than one block, so that memory does not grow with the area.

Blocks of a raster in which nothing is seen are left out, so that a strip across a large box takes
the room of the strip.
"""

import json
import shutil
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import rasterio.shutil
from numpy.typing import NDArray
from rasterio.windows import Window

from alice_survey.core.config import ReconstructConfig, WaterConfig
from alice_survey.core.errors import ReconstructionError, warn
from alice_survey.core.executor import Executor
from alice_survey.core.records import CloudRecord, MosaicRecord, PicturesRecord
from alice_survey.core.run import progress
from reconstruct.dense.cloud import cloud_in_parts
from reconstruct.dense.dem import fill_gaps
from reconstruct.light.solve import joined_samples
from reconstruct.mosaic.colour import ColourModel, solve_colour
from reconstruct.mosaic.exports import write_footprints
from reconstruct.mosaic.grid import (
    CELL_PX,
    Block,
    Footprints,
    blocks_of,
    coarse,
    footprints,
    height_range,
    in_passes,
    mean_pixel,
    mosaic_grid,
    neighbours,
)
from reconstruct.mosaic.paint import (
    BRIDGED,
    LABELS,
    TONES,
    BlockTask,
    Labels,
    MosaicSetup,
    Painted,
    PaintTask,
    SeenView,
    compare_block,
    label_block,
    paint_tiles,
)
from reconstruct.mosaic.picture_measures import (
    PictureMeasures,
    ReferencePatch,
    measure_picture,
    outline_view,
    read_references,
)
from reconstruct.mosaic.seams import SUPPORT_PX
from reconstruct.mosaic.visibility import Water, find_occluders, occluders_folder
from reconstruct.planes import PLANES, Plane, plane_folders, read_plane, turn_model, write_plane
from reconstruct.raster import (
    DemGrid,
    frame_tags,
    geotiff_profile,
    grid_of,
    opened_raster,
    read_cells,
    round_cell,
    small_cache,
    tiled_raster,
    tiles_of,
    write_png,
)
from reconstruct.views.model import SparseModel, WorldFrame, read_model, read_warps

_THUMBNAIL_PX = 1600
_MAX_UINT16 = 65_535


def write_tiles(
    rough: Path,
    source: Path,
    grid: DemGrid,
    frame: WorldFrame,
    groups: Iterator[list[Painted]],
    names: list[str],
    threads: int,
) -> float:
    """Write colours and sources as they come; return the share of pixels that have colour."""
    shared = geotiff_profile(grid, frame, threads) | {"zlevel": 1}
    numbers = "uint16" if len(names) <= _MAX_UINT16 else "uint32"
    painted = 0
    with (
        rasterio.open(
            rough, "w", count=4, dtype="uint8", photometric="RGB", alpha="yes", **shared
        ) as colours,
        rasterio.open(source, "w", count=1, dtype=numbers, **shared) as sources,
    ):
        colours.update_tags(**frame_tags(frame))
        sources.update_tags(**frame_tags(frame), PICTURES=json.dumps(names))
        sources.set_band_description(1, "picture that painted the pixel, from 1; 0 is none")
        for group in groups:
            for tile in group:
                seen = int(np.count_nonzero(tile.rgba[3]))
                if seen:
                    colours.write(tile.rgba, window=tile.window)
                    sources.write(tile.source.astype(numbers), 1, window=tile.window)
                    painted += seen
    return painted / (grid.rows * grid.columns)


def write_labels(
    cells_of: tuple[Path, Path],
    coverage: Path,
    grid: DemGrid,
    frame: WorldFrame,
    blocks: Iterator[Labels],
    threads: int,
) -> None:
    """Write view and tones of each cell, and a raster of how many pictures and stations see it."""
    shared = geotiff_profile(coarse(grid), frame, threads) | {"zlevel": 1}
    with (
        rasterio.open(cells_of[0], "w", count=1, dtype="int32", **shared) as labels,
        rasterio.open(
            cells_of[1], "w", count=3, dtype="float32", **shared | {"compress": None}
        ) as tones,
        rasterio.open(coverage, "w", count=3, dtype="uint16", predictor=2, **shared) as raster,
    ):
        raster.update_tags(**frame_tags(frame))
        raster.set_band_description(1, "pictures that see the cell")
        raster.set_band_description(2, "stations that see the cell")
        about = "sigma of a place, where the surface is interpolated, in thousandths of a "
        raster.set_band_description(3, about + frame.unit + "; 0 where it was measured")
        for block in blocks:
            top, left = block.block.core.row_off // CELL_PX, block.block.core.col_off // CELL_PX
            high, wide = block.label.shape
            window = Window(left, top, wide, high)
            labels.write(block.label, 1, window=window)
            tones.write(block.tones, window=window)
            raster.write(np.stack([block.pictures, block.stations, block.places]), window=window)


@progress.step("write the mosaic with overviews")
def cloud_optimised(rough: Path, final: Path, threads: int) -> None:
    """Copy a GeoTIFF with overviews in the layout of a COG.

    GDAL works through what is empty too, for overviews mostly.
    """
    rasterio.shutil.copy(
        rough,
        final,
        driver="COG",
        compress="DEFLATE",
        level=3,
        predictor="YES",
        overview_resampling="AVERAGE",
        blocksize=512,
        bigtiff="IF_SAFER",
        sparse_ok="YES",
        num_threads=str(threads),
    )


@progress.step("draw the mosaic")
def thumbnail(mosaic: Path, picture: Path) -> None:
    """Write a small copy, unknown pixels transparent."""
    with opened_raster(mosaic) as raster:
        shrink = max(1.0, max(raster.width, raster.height) / _THUMBNAIL_PX)
        shape = (4, max(1, int(raster.height / shrink)), max(1, int(raster.width / shrink)))
        small: NDArray[np.uint8] = raster.read(
            out_shape=shape, resampling=rasterio.enums.Resampling.average
        )
    write_png(picture, np.ascontiguousarray(small[[2, 1, 0, 3]].transpose(1, 2, 0)))


_TILE_PX = 1024
_GROUP = 2
"""Tiles along and across that one process paints, since they share pictures."""
_LABEL_PX, _MIN_LABEL_PX = 2048, 512
_LABEL_MARGIN_PX = 256
_MAX_LOOKS = 12e6
"""Views times cells of a block whose seams are solved at once, which take some 30 bytes each."""
_LIGHT_LATTICE = 24
"""Spots across a picture at which light is compared."""
_MAX_SAMPLES = 150_000
_CACHE_MIB = 48
"""Cache for files that GDAL reads and writes in this process."""
_TASK_MIB = 400
"""Memory that a process takes for a block of any kind."""
_TEMPERATURE_C, _SALINITY_PSU = 15.0, 35.0
"""Sea water where none is stated; red and blue move by 2 % of their dispersion from 5 to 30 C."""


@small_cache(_CACHE_MIB)
def run_mosaic(
    workspace: Path,
    folder: Path,
    executor: Executor,
    *,
    reconstruct: ReconstructConfig,
    water: WaterConfig,
    seafloor_depth_m: float,
) -> None:
    """Paint the mosaics on a finished surface, one for each of its planes.

    Raises:
        ReconstructionError: the surface has no cell.
        WorkspaceError: the model or the surface is damaged.
    """
    model = read_model(workspace / "sparse")
    scratch = folder / "scratch"
    scratch.mkdir()
    measure = partial(measure_picture, workspace, scratch)
    facts = list(executor.map(measure, model.views, label="measure pictures", task_mib=_TASK_MIB))
    grey = all(fact.grey for fact in facts)
    references = read_references(workspace, [fact.image for fact in facts])
    sea, dispersion = _dispersion(workspace, water, seafloor_depth_m, grey)
    painting = Painting(
        workspace=workspace,
        model=model,
        scratch=scratch,
        cloud=cloud_in_parts(workspace / "dense", scratch, model.frame),
        facts=facts,
        references=references,
        water=sea,
        dispersion=dispersion,
        reconstruct=reconstruct,
        executor=executor,
    )
    painted = []
    for surface in plane_folders(workspace / "dense"):
        plane = read_plane(surface)
        below = surface != workspace / "dense"
        target = folder / PLANES / plane.name if below else folder
        painted.append(paint_plane(painting, plane, surface / "dem.tif", target))
        if not painted[-1]:
            if below:
                target.rmdir()
            warn(f"plane {plane.name!r} ({plane.about}): no picture sees its surface: no mosaic")
    shutil.rmtree(scratch)
    if not any(painted):
        raise ReconstructionError("no picture sees any cell of dense/dem.tif; redo 'dense'")


@dataclass(frozen=True, kw_only=True, eq=False)
class Painting:
    """What the mosaics of all planes share."""

    workspace: Path
    model: SparseModel
    """In the world."""
    scratch: Path
    cloud: Path
    """PLY of the surface's points."""
    facts: Sequence[PictureMeasures]
    references: Sequence[ReferencePatch]
    water: Water | None
    dispersion: dict[str, Any]
    """What `mosaic.json` says about the water."""
    reconstruct: ReconstructConfig
    executor: Executor


def paint_plane(painting: Painting, plane: Plane, dem: Path, folder: Path) -> bool:
    """Paint the mosaic of a plane; return whether any picture sees the surface over it.

    Args:
        painting: pictures and model.
        plane: the plane.
        dem: the surface over it.
        folder: to write to.

    Raises:
        ReconstructionError: the surface has no cell.
        WorkspaceError: it is damaged.
    """
    reconstruct, executor = painting.reconstruct, painting.executor
    model = turn_model(painting.model, plane)
    sights = painting.scratch / plane.name
    sights.mkdir()
    with opened_raster(dem) as raster:
        heights = height_range(raster)
        pixel = reconstruct.mosaic_pixel_m or round_cell(mean_pixel(model))
    grid = mosaic_grid(grid_of(dem), pixel)
    dem = _bridge(dem, sights, model.frame, executor, _label(plane, "bridge gaps"))
    names = [view.image for view in model.views]
    outline = partial(outline_view, dem, sights, heights)
    label = partial(_label, plane)
    spacing = CloudRecord.read(painting.workspace / "dense" / "cloud.json").thinned_to
    find = partial(find_occluders, painting.cloud, spacing, plane, dem, occluders_folder(sights))
    find(executor, label("find what hides the surface"))
    outlines = list(
        executor.map(outline, model.views, label=label("outline pictures"), task_mib=_TASK_MIB)
    )
    survey = MosaicSetup(
        workspace=painting.workspace,
        scratch=painting.scratch,
        dem=dem,
        sights=sights,
        scaled=model.frame.scaled,
        water=painting.water,
    )
    views = _seen_views(model, painting.facts)
    ground = footprints(model.views, heights)
    folder.mkdir(parents=True, exist_ok=True)
    blocks = seam_blocks(grid, ground)
    if not blocks:
        return False
    colour = _solve(painting, model, survey, views, blocks, label("compare light"))

    def task(block: Block, settled: tuple[Window, ...] = ()) -> PaintTask:
        return PaintTask(
            survey=survey,
            block=block,
            views=tuple(views[n] for n in block.views),
            colour=_part_of(colour, [names[n] for n in block.views]),
            even=reconstruct.colour != "raw",
            settled=settled,
        )

    def labels() -> Iterator[Labels]:
        passes = in_passes(blocks)
        for number, some in enumerate(passes, 1):
            name = "seams" if len(passes) == 1 else f"seams, {number} of {len(passes)}"
            tasks = [task(*one) for one in some]
            yield from executor.map(label_block, tasks, label=label(name), task_mib=_TASK_MIB)

    files, threads = (sights / LABELS, sights / TONES), executor.local_cores
    write_labels(files, folder / "coverage.tif", grid, model.frame, labels(), threads)
    tiles = blocks_of(grid, ground, _TILE_PX, SUPPORT_PX)
    rough = sights / "rough.tif"
    groups = [[task(tile) for tile in group] for group in neighbours(tiles, _GROUP * _TILE_PX)]
    painted = executor.map(paint_tiles, groups, label=label("mosaic"), task_mib=_TASK_MIB)
    source = folder / "mosaic_source.tif"
    covered = write_tiles(rough, source, grid, model.frame, painted, names, threads)
    if covered == 0.0:
        (folder / "coverage.tif").unlink()
        source.unlink()
        return False
    cloud_optimised(rough, folder / "mosaic.tif", threads)
    thumbnail(folder / "mosaic.tif", folder / "mosaic.png")
    shutil.rmtree(sights)
    write_footprints(folder, model.views, outlines, model.frame)
    write_plane(folder, plane, painting.model.frame)
    MosaicRecord.save(
        folder / "mosaic.json",
        {
            "format": "alice-survey mosaic",
            "version": 2,
            "width_px": grid.columns,
            "height_px": grid.rows,
            "pixel": grid.cell,
            "unit": model.frame.unit,
            "frame": model.frame.name,
            "covered": covered,
            "vertical_datum": model.frame.vertical_datum,
            "colour": reconstruct.colour,
            **colour.to_json(),
            "dispersion": painting.dispersion,
            "notes": [*model.frame.notes, *colour.notes],
            "pictures": names,
        },
    )
    return True


_BRIDGED_CELLS = 32
"""Gaps of the surface that are painted over: cells to what is known, at most, on either side."""
_TILE_CELLS = 256


def _bridge(dem: Path, sights: Path, frame: WorldFrame, executor: Executor, label: str) -> Path:
    """Write a DEM without its gaps, and sigmas where it is interpolated."""
    grid, paths = grid_of(dem), (sights / "ground.tif", sights / BRIDGED)
    tiles = tiles_of(grid, _TILE_CELLS)
    with ExitStack() as files:
        rasters = [
            files.enter_context(tiled_raster(path, grid, frame, "float32", np.nan, path.stem))
            for path in paths
        ]
        for window, bands in executor.map(partial(_bridge_tile, dem), tiles, label=label):
            for raster, band in zip(rasters, bands, strict=True):
                raster.write(band, 1, window=window)
    return paths[0]


def _bridge_tile(dem: Path, window: Window) -> tuple[Window, NDArray[np.float32]]:
    """Heights of a tile, and sigmas of those that are interpolated, 0 of others, (2, H, W)."""
    rim = _BRIDGED_CELLS
    place = int(window.row_off) - rim, int(window.col_off) - rim
    size = int(window.height) + 2 * rim, int(window.width) + 2 * rim
    height, sigma, count = (
        read_cells(dem.with_name(f"{name}.tif"), *place, *size).astype(np.float32)
        for name in ("dem", "sigma", "count")
    )
    if np.isnan(height).any():
        height, sigma = fill_gaps(height, sigma, rim, grid_of(dem).cell, over_steps=True)
    bands = np.stack([height, np.where(count > 0, np.float32(0), sigma)])
    return window, bands[:, rim:-rim, rim:-rim]


def _label(plane: Plane, what: str) -> str:
    return what if plane.is_level else f"{what} of {plane.name}"


def seam_blocks(grid: DemGrid, ground: Footprints) -> list[Block]:
    """Blocks whose seams are solved at once: the smaller, the more pictures see each spot."""
    size = _LABEL_PX
    while True:
        blocks = blocks_of(grid, ground, size, _LABEL_MARGIN_PX)
        cells = [len(b.views) * b.grid.rows * b.grid.columns // CELL_PX**2 for b in blocks]
        looks = max(cells, default=0)
        if looks <= _MAX_LOOKS or size <= _MIN_LABEL_PX:
            return blocks
        size //= 2


def _seen_views(model: SparseModel, facts: Sequence[PictureMeasures]) -> list[SeenView]:
    sharpness = np.array([fact.sharpness for fact in facts])
    typical = float(np.nanmedian(sharpness)) if np.isfinite(sharpness).any() else 1.0
    relative = np.nan_to_num(sharpness / max(typical, 1e-9))
    return [
        SeenView(number=n, view=view, sharpness=float(relative[n]))
        for n, view in enumerate(model.views)
    ]


def _solve(
    painting: Painting,
    model: SparseModel,
    survey: MosaicSetup,
    views: Sequence[SeenView],
    blocks: Sequence[Block],
    label: str,
) -> ColourModel:
    """The survey's light from spots that two views see."""
    requested, facts = painting.reconstruct.colour, painting.facts
    if requested == "raw":
        return solve_colour(requested, joined_samples([]), facts)
    width = float(np.median([view.pinhole.width_px for view in model.views]))
    step_px = max(CELL_PX, round(width * mean_pixel(model) / blocks[0].grid.cell / _LIGHT_LATTICE))
    tasks = [
        BlockTask(survey=survey, block=block, views=tuple(views[n] for n in block.views))
        for block in blocks
    ]
    compare = partial(compare_block, step_px, max(1000, _MAX_SAMPLES // len(blocks)))
    found = painting.executor.map(compare, tasks, label=label, task_mib=_TASK_MIB)
    parts = [part for part in found if len(part.views)]
    return solve_colour(requested, joined_samples(parts), facts, painting.references)


def _part_of(colour: ColourModel, images: Sequence[str]) -> ColourModel:
    """What a block needs of the model, so that little travels."""
    gains = {image: colour.light.gains[image] for image in images}
    return replace(colour, light=replace(colour.light, gains=gains))


def _dispersion(
    workspace: Path, config: WaterConfig, depth_m: float, grey: bool
) -> tuple[Water | None, dict[str, Any]]:
    """The water through which colours are distinguished, or None, and what to say about it."""
    warps = read_warps(workspace / "sparse" / "cameras.json").values()
    reason = "grey pictures" if grey else ""
    if all(warp.camera.n_water == 1 for warp in warps):
        reason = "no port"
    elif not grey and PicturesRecord.read(workspace / "images/survey.json").source == "simulated":
        reason = "rendered pictures have none"
    if reason:
        return None, {"corrected": False, "reason": reason}
    values = {
        "temperature_c": _TEMPERATURE_C if config.temperature_c is None else config.temperature_c,
        "salinity_psu": _SALINITY_PSU if config.salinity_psu is None else config.salinity_psu,
    }
    water = Water(depth_m=depth_m, **values)
    return water, {"corrected": True, **values}
