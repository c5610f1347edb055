"""Tasks of the mosaic: compare light, lay seams, paint tiles. Each works on one block.

A process keeps lenses, small copies and a few pictures between tasks.
"""

import uuid
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.windows import Window

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.run.resources import release_memory
from reconstruct.light.solve import LightSamples, at_places, joined_samples
from reconstruct.mosaic.colour import ColourModel
from reconstruct.mosaic.grid import ALIGNED_PX, CELL_PX, Block, coarse, dem_around, height_at_pixels
from reconstruct.mosaic.picture_measures import DARKEST, linear_table, read_small, well_exposed
from reconstruct.mosaic.seams import Blend, candidates, choose_views
from reconstruct.mosaic.visibility import (
    CameraOptics,
    GridHeights,
    Ground,
    SeenCells,
    Water,
    camera_optics,
    channel_optics,
    see,
)
from reconstruct.pictures.undistorted import SPLINE_REACH, Pictures, sample_spline, spline_nodes
from reconstruct.raster import small_cache
from reconstruct.views.model import View, enu_from_cam

_SMALL_COPIES = 40
"""Small copies of pictures that each process keeps."""


@dataclass(frozen=True, kw_only=True)
class MosaicSetup:
    """What all tasks share; it travels to each process once a task."""

    workspace: Path
    scratch: Path
    """Folder of what is known of pictures."""
    dem: Path
    """The surface, in the frame of a plane."""
    sights: Path
    """Folder of what views see of it."""
    scaled: bool
    water: Water | None
    """Water of the port's dispersion; None where channels are not distinguished."""
    run: str = field(default_factory=lambda: uuid.uuid4().hex)
    """Distinguishes runs in a process that works for several: files may have changed."""


class Tools:
    """What a process keeps between tasks."""

    def __init__(self, survey: MosaicSetup) -> None:
        self._pictures = Pictures.still(survey.workspace)
        self.small = lru_cache(maxsize=_SMALL_COPIES)(partial(read_small, survey.scratch))
        self.picture, self.usable = self._pictures.as_taken, self._pictures.usable
        """A picture as taken, and its mask."""
        self.table = linear_table()
        self._survey = survey
        self._optics: dict[str, CameraOptics] = {}
        self._channels: dict[str, tuple[CameraOptics, ...]] = {}

    def optics(self, view: View) -> CameraOptics:
        """Optics of a view's camera (its green channel)."""
        if view.camera not in self._optics:
            warp = self._pictures.warp(view.image)
            self._optics[view.camera] = camera_optics(warp, self._survey.scaled)
        return self._optics[view.camera]

    def channels(self, view: View) -> tuple[CameraOptics, ...] | None:
        """Optics of a view's channels, BGR; None where they share one."""
        warp, water = self._pictures.warp(view.image), self._survey.water
        if water is None or warp.camera.n_water == 1:
            return None
        if view.camera not in self._channels:
            self._channels[view.camera] = channel_optics(warp, water, self._survey.scaled)
        return self._channels[view.camera]


@lru_cache(maxsize=1)
def tools_of(survey: MosaicSetup) -> Tools:
    """The tools of this process for a survey."""
    return Tools(survey)


Float32 = NDArray[np.float32]

_BROAD_POWER = 3
"""Power of quality that weighs views in the broadest band."""
_MAX_CHANGE = 3.0
"""Factor by which broad tones of a view are changed at most to meet its neighbours'."""
_AROUND = np.ones((9, 9), np.uint8)
"""Cells around those of a view in which it is sampled: as far as the broadest band reaches."""
_REACHED = np.ones((9, 9), np.uint8)
"""Pixels of a picture beyond which one shows in `sample_spline` by less than 0.5 %."""
_SHARP = (0.4, 1.1)
"""Least and largest factor of quality for a picture less or more sharp than the median one."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SeenView:
    """A view and what the survey knows of its picture."""

    number: int
    view: View
    sharpness: float
    """Sharpness over the survey's median."""


class _ViewOfCells(NamedTuple):
    """How a view sees the cells of a box of a block."""

    entry: SeenView
    sight: SeenCells
    box: tuple[slice, slice]


@dataclass(frozen=True, kw_only=True, eq=False)
class BlockTask:
    """A block on which to compare what views show."""

    survey: MosaicSetup
    block: Block
    views: tuple[SeenView, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class PaintTask(BlockTask):
    """A block to lay seams in, or to paint."""

    colour: ColourModel
    even: bool
    """Broad tones are made to meet."""
    settled: tuple[Window, ...] = ()
    """Cores of neighbouring blocks whose seams are laid."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Labels:
    """Views of a block's cells."""

    block: Block
    label: NDArray[np.int32]
    """(rows, columns) of the core's cells: number of the view plus one; 0 where none sees."""
    pictures: NDArray[np.uint16]
    """(rows, columns) how many pictures see the cell."""
    stations: NDArray[np.uint16]
    """(rows, columns) how many stations do."""
    places: NDArray[np.uint16]
    """(rows, columns) sigma of places, thousandths, on interpolated surface; 0 elsewhere."""
    tones: Float32
    """(3, rows, columns) logarithm of the broad light that all views agree on, BGR."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Painted:
    """A painted tile."""

    window: Window
    rgba: NDArray[np.uint8]
    """(4, H, W) colour and opacity."""
    source: NDArray[np.int32]
    """(H, W) number of the view plus one; 0 where nothing is known."""


_SHOWN = np.dtype([("lattice", "i8"), ("places", "f4", 2), ("levels", "f4", 3), ("ranges", "f4")])
"""A spot of a lattice that a view shows."""


@small_cache()
def compare_block(step_px: int, maximum: int, task: BlockTask) -> LightSamples:
    """What views show of the same spots of a lattice, in linear light.

    The survey's light is found from it.

    Args:
        step_px: distance of spots.
        maximum: samples to return at most.
        task: the block.
    """
    tools = tools_of(task.survey)
    surface = ground_of(task.survey, task.block).surface(coarse(task.block.grid, step_px))
    if not np.isfinite(surface.height).any():
        return joined_samples([])
    seen = []
    for entry in task.views:
        optics = tools.optics(entry.view)
        sight = see(entry.view, optics, surface)
        copy = tools.small(entry.view.image)
        lattice = np.flatnonzero(sight.quality.ravel() > 0)
        rows = np.empty(len(lattice), _SHOWN)
        places = sight.places(optics.size_px)[lattice]
        levels = at_places(copy.broad, places)
        rows["lattice"], rows["places"] = lattice, places
        rows["levels"] = np.log(np.maximum(levels, DARKEST))
        rows["ranges"] = sight.range.ravel()[lattice]
        valid = at_places(copy.valid[..., None], places, 1)[:, 0] > 0.9
        seen.append((entry.number, rows[well_exposed(levels) & valid]))
    kept = _thin([rows for _, rows in seen], surface.height.size, maximum, task.block)
    seen = [(number, rows[kept[rows["lattice"]]]) for number, rows in seen]
    parts = []
    for (n, one), (m, other) in combinations(seen, 2):
        lattices = one["lattice"], other["lattice"]
        _, a, b = np.intersect1d(*lattices, assume_unique=True, return_indices=True)
        if len(a):
            both = {
                name: np.stack([one[name][a], other[name][b]], axis=1)
                for name in ("places", "levels", "ranges")
            }
            views = np.tile(np.array([[n, m]], np.int32), (len(a), 1))
            parts.append(LightSamples(views=views, **both))
    return joined_samples(parts)


def _thin(
    seen: Sequence[NDArray[np.void]], lattice: int, maximum: int, block: Block
) -> NDArray[np.bool_]:
    """Which spots of a lattice, drawn at random, give no more samples than allowed."""
    times = np.zeros(lattice, np.int64)
    for rows in seen:
        times[rows["lattice"]] += 1
    pairs = times * (times - 1) // 2
    kept = np.ones(lattice, np.bool_)
    if pairs.sum() > maximum:
        rng = np.random.default_rng([block.core.row_off, block.core.col_off])
        order = rng.permutation(np.flatnonzero(pairs))
        kept[:] = False
        kept[order[np.cumsum(pairs[order]) <= maximum]] = True
    return kept


@small_cache()
def label_block(task: PaintTask) -> Labels:
    """Choose the view of each cell of a block, and keep it for the blocks next to it."""
    block = task.block
    inner = _inner(block)
    rows, columns = block.grid.rows // CELL_PX, block.grid.columns // CELL_PX
    label = np.zeros((rows, columns), np.int32)
    pictures, stations = (np.zeros(label.shape, np.uint16) for _ in range(2))
    tones = np.zeros((rows, columns, 3), np.float32)
    surface = ground_of(task.survey, block).surface(coarse(block.grid))
    looks = _looks(task, surface, task.views) if np.isfinite(surface.height).any() else []
    if looks:
        tools = tools_of(task.survey)
        quality = np.zeros((len(looks), rows, columns), np.float32)
        by_station: dict[int, NDArray[np.bool_]] = {}
        for row, found in enumerate(looks):
            quality[row][found.box] = found.sight.quality
            pictures += quality[row] > 0
            seen = by_station.setdefault(found.entry.view.station, np.zeros(label.shape, bool))
            seen |= quality[row] > 0
        stations = np.sum(list(by_station.values()), axis=0, dtype=np.uint16)
        numbers = np.array([found.entry.number for found in looks], np.int32)
        number, share, row_of = candidates(quality, numbers)
        colours = np.zeros((*number.shape, 3), np.float32)
        for row, found in enumerate(looks):
            used = ((row_of == row) & (number >= 0))[found.box]
            if used.any():
                at = np.nonzero(used)
                shown = _logarithm(_small_light(task, tools, found, broad=False))
                colours[found.box][at] = shown[at[0], at[1]]
        if task.even:
            tones = _tones(task, tools, looks, quality)
        chosen = choose_views(number, share, colours, settled_around(task))
        known = chosen >= 0
        taken = np.take_along_axis(number, np.maximum(chosen, 0)[..., None], axis=2)[..., 0]
        label = np.where(known, taken + 1, 0).astype(np.int32)
    with atomic_path(label_path_of_core(task.survey, block.core), lasting=False) as path:
        np.save(path, label[inner])
    return Labels(
        block=block,
        label=label[inner],
        pictures=pictures[inner],
        stations=stations[inner],
        places=_sigma_of_places(task, surface, label)[inner],
        tones=tones[inner].transpose(2, 0, 1),
    )


def _sigma_of_places(
    task: PaintTask, surface: GridHeights, label: NDArray[np.int32]
) -> NDArray[np.uint16]:
    """Sigmas of places by that of interpolated heights along the rays of the cells' views."""
    grid, found = surface.grid, np.zeros(label.shape, np.uint16)
    bridged, around = dem_around(task.survey.sights / BRIDGED, grid, 0.0)
    spread = height_at_pixels(np.nan_to_num(bridged), around, grid)
    for entry in task.views if (spread > 0).any() else ():
        rows, columns = np.nonzero((label == entry.number + 1) & (spread > 0))
        east, north, up = enu_from_cam(entry.view, np.zeros(3))[:, 3]
        aside = np.hypot(grid.east_of(columns + 0.5) - east, grid.north_of(rows + 0.5) - north)
        shifts = spread[rows, columns] * aside / (up - surface.height[rows, columns])
        found[rows, columns] = np.clip(np.ceil(1e3 * shifts), 1, np.iinfo(np.uint16).max)
    return found


def settled_around(task: PaintTask) -> NDArray[np.int32]:
    """Views that cells of a block's window have in its neighbours, -1 of others."""
    shape = (task.block.grid.rows // CELL_PX, task.block.grid.columns // CELL_PX)
    settled = np.full(shape, -1, np.int32)
    for core in task.settled:
        label = np.load(label_path_of_core(task.survey, core)) - 1
        here, there = [], []
        for axis, name in enumerate(("row_off", "col_off")):
            start = (getattr(core, name) - getattr(task.block.window, name)) // CELL_PX
            first = max(start, 0)
            last = max(first, min(start + label.shape[axis], shape[axis]))
            here.append(slice(first, last))
            there.append(slice(first - start, last - start))
        settled[tuple(here)] = label[tuple(there)]
    return settled


def label_path_of_core(survey: MosaicSetup, core: Window) -> Path:
    """File of the views of the cells of a block."""
    return survey.sights / f"seams_{core.row_off}_{core.col_off}.npy"


@small_cache()
def paint_tiles(tasks: Sequence[PaintTask]) -> list[Painted]:
    """Paint neighbouring tiles, which share pictures."""
    painted = [paint_tile(task) for task in tasks]
    release_memory()  # arrays of a tile are of any size, and leave holes
    return painted


def paint_tile(task: PaintTask) -> Painted:
    """Paint one tile with the views that the survey's seams give it."""
    block, tools = task.block, tools_of(task.survey)
    grid = block.grid
    label, mean = _read_cells(task.survey, block)
    blend = Blend(grid.rows, grid.columns)
    source = np.zeros((grid.rows, grid.columns), np.int32)
    if label.any():
        ground = ground_of(task.survey, block)
        surface = ground.surface(grid)
        used = [entry for entry in task.views if (label == entry.number + 1).any()]
        looks = _looks(task, ground.surface(coarse(grid)), used)
        changes = _changes(task, tools, looks, mean)
        seen_by = _take_sources(task, surface, label, used, source)
        for value, (entry, part, sight, requested) in seen_by.items():
            taken = source[part] == value
            if taken.any():
                local = surface.part(*part)
                change = changes.get(entry.number)
                colour = _colours(task, tools, entry, sight, (local, part, requested), change)
                blend.add(part[0].start, part[1].start, colour, sight.quality > 0, taken)
    inner = _inner(block, 1)
    source = source[inner]
    known = source > 0
    levels = np.rint(np.clip(blend.result()[inner], 0, 255)).astype(np.uint8)
    rgba = np.zeros((4, *known.shape), np.uint8)
    rgba[:3] = np.where(known[..., None], levels[..., ::-1], 0).transpose(2, 0, 1)
    rgba[3] = np.where(known, 255, 0)
    return Painted(window=block.core, rgba=rgba, source=source)


def _take_sources(
    task: PaintTask,
    surface: GridHeights,
    label: NDArray[np.int32],
    used: Sequence[SeenView],
    source: NDArray[np.int32],
) -> dict[int, tuple[SeenView, tuple[slice, slice], SeenCells, NDArray[np.bool_]]]:
    """Write the view of each pixel, plus one, into `source`; how views see parts of the tile."""
    named = cv2.resize(label, source.shape[::-1], interpolation=cv2.INTER_NEAREST)
    named[~np.isfinite(surface.height)] = 0
    seen_by = {}
    for entry in used:  # pixels of a cell that its view does not see go to the best that does
        value = entry.number + 1
        requested = cv2.dilate((label == value).astype(np.uint8), _AROUND) > 0
        part, box = _box(requested)
        sight = _sight_of(task, entry, surface.part(*part), requested[box])
        seen_by[value] = (entry, part, sight, requested[box])
        source[part][(named[part] == value) & (sight.quality > 0)] = value
    left = (named > 0) & (source == 0)
    best = np.zeros(left.shape, np.float32)
    for value, (_, part, sight, _) in seen_by.items() if left.any() else ():
        better = left[part] & (sight.quality > best[part])
        best[part][better] = sight.quality[better]
        source[part][better] = value
    return seen_by


def _box(used: NDArray[np.bool_]) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """The pixels, and the cells, of a box around cells that are used, on whole aligned pixels."""
    pixels, cells = [], []
    for axis, count in ((1, used.shape[0]), (0, used.shape[1])):
        at = np.flatnonzero(used.any(axis=axis))
        step = ALIGNED_PX // CELL_PX
        first = int(at[0]) // step * step
        last = min(-(-(int(at[-1]) + 1) // step) * step, count)
        pixels.append(slice(first * CELL_PX, last * CELL_PX))
        cells.append(slice(first, last))
    return (pixels[0], pixels[1]), (cells[0], cells[1])


def ground_of(survey: MosaicSetup, block: Block) -> Ground:
    """The surface of a block, and what around it may hide it."""
    return Ground(*dem_around(survey.dem, block.grid, block.reach), survey.sights)


def _looks(
    task: PaintTask, surface: GridHeights, entries: Sequence[SeenView]
) -> list[_ViewOfCells]:
    """How views see a block's cells; quality takes sharpness and light in, masks leave out."""
    tools = tools_of(task.survey)
    looks = []
    for entry in entries:
        optics = tools.optics(entry.view)
        sight = see(entry.view, optics, surface)
        if not sight.quality.any():
            continue
        box = _bounding(sight.quality > 0)
        sight = SeenCells(*(values[box] for values in sight))
        places = sight.places(optics.size_px)
        copy = tools.small(entry.view.image)
        quality = sight.quality * np.float32(np.clip(entry.sharpness, *_SHARP))
        # dark rims are noisy: their light, where it is less than the middle one, counts as distance
        pattern = task.colour.light.patterns[entry.view.camera]
        light = np.exp(np.minimum(pattern.mean(axis=2), 0.0)).astype(np.float32)
        quality *= at_places(light[..., None], places, 1).reshape(quality.shape)
        if not copy.whole:
            valid = at_places(copy.valid[..., None], places, 1).reshape(quality.shape)
            quality[valid < 0.999] = 0
        if quality.any():
            looks.append(_ViewOfCells(entry, sight._replace(quality=quality), box))
    return looks


def _bounding(used: NDArray[np.bool_]) -> tuple[slice, slice]:
    rows, columns = np.flatnonzero(used.any(axis=1)), np.flatnonzero(used.any(axis=0))
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def _small_light(task: PaintTask, tools: Tools, found: _ViewOfCells, *, broad: bool) -> Float32:
    """Corrected light of a view's small copy at the cells of its box, (h, w, 3)."""
    view, sight = found.entry.view, found.sight
    copy = tools.small(view.image)
    places = sight.places(tools.optics(view).size_px)
    shape = (*sight.quality.shape, 3)
    shown = at_places(copy.broad if broad else copy.detail, places).reshape(shape)
    return task.colour.correct(shown, view.camera, view.image, places, sight.range)


def _logarithm(light: Float32) -> Float32:
    return np.log(np.maximum(light, np.float32(1e-3)))


def _tones(task: PaintTask, tools: Tools, looks: list[_ViewOfCells], quality: Float32) -> Float32:
    """(rows, columns, 3) logarithm of broad light, the mean of all views by their quality."""
    best: Float32 = quality.max(axis=0)
    total = np.zeros((*best.shape, 3), np.float32)
    weight = np.zeros(best.shape, np.float32)
    for found in looks:
        tone = _logarithm(_small_light(task, tools, found, broad=True))
        share = found.sight.quality / np.maximum(best[found.box], np.float32(1e-30))
        share = (share**_BROAD_POWER).astype(np.float32)
        total[found.box] += share[..., None] * tone
        weight[found.box] += share
    mean = total / np.maximum(weight, np.float32(1e-12))[..., None]
    return mean.astype(np.float32)


def _changes(
    task: PaintTask, tools: Tools, looks: list[_ViewOfCells], mean: Float32
) -> dict[int, tuple[Float32, tuple[slice, slice]]]:
    """Per view factors (h, w, 3) at the cells of a box that take its broad tones to the mean."""
    changes = {}
    limit = np.float32(np.log(_MAX_CHANGE))
    for found in looks if task.even else ():
        tone = _logarithm(_small_light(task, tools, found, broad=True))
        seen = found.sight.quality > 0
        change = np.clip(mean[found.box] - tone, -limit, limit) * seen[..., None]
        # cells that the view does not see take the change of those next to them
        near = cv2.GaussianBlur(seen.astype(np.float32), (0, 0), 1.5)
        spread = cv2.GaussianBlur(change, (0, 0), 1.5).reshape(change.shape)
        spread = spread / np.maximum(near, np.float32(1e-3))[..., None]
        factor = np.exp(np.where(seen[..., None], change, spread))
        changes[found.entry.number] = (factor.astype(np.float32), found.box)
    return changes


def _sight_of(
    task: PaintTask, entry: SeenView, surface: GridHeights, requested: NDArray[np.bool_]
) -> SeenCells:
    """How a view sees the pixels of cells, its mask applied exactly."""
    tools = tools_of(task.survey)
    sight = see(entry.view, tools.optics(entry.view), surface, (requested, CELL_PX))
    usable = tools.usable(entry.view.image)
    if usable is not None and sight.quality.any():
        # as far as the kernel reaches, what is masked would colour its surroundings
        clear = cv2.erode(usable.astype(np.uint8) * np.uint8(255), _REACHED)
        inside = cv2.remap(
            clear, sight.x, sight.y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
        )
        sight = sight._replace(quality=np.where(inside < 255, np.float32(0), sight.quality))
    return sight


def _colours(
    task: PaintTask,
    tools: Tools,
    entry: SeenView,
    sight: SeenCells,
    at: tuple[GridHeights, tuple[slice, slice], NDArray[np.bool_]],
    change: tuple[Float32, tuple[slice, slice]] | None,
) -> Float32:
    """Corrected colours of a view at the pixels of a box, levels, BGR."""
    view, (local, part, requested) = entry.view, at
    x = np.where(sight.quality > 0, sight.x, np.float32(-1))
    channels = [(x, sight.y)]
    for optics in tools.channels(view) or ():
        own = see(view, optics, local, (requested, CELL_PX))
        seen = (own.quality > 0) & (sight.quality > 0)
        channels.append((np.where(seen, own.x, x), np.where(seen, own.y, sight.y)))
    light = _light_at(tools.picture(view.image), tools.table, channels)
    places = sight.places(tools.optics(view).size_px)
    light = task.colour.correct(light, view.camera, view.image, places, sight.range)
    if change is not None:  # bilinear between the centres of cells
        factor, box = change
        rows, columns = (
            (np.arange(size) + 0.5) / CELL_PX - 0.5 + pixels.start / CELL_PX - cells.start
            for size, pixels, cells in zip(x.shape, part, box, strict=True)
        )
        at = np.meshgrid(columns.astype(np.float32), rows.astype(np.float32))
        light *= cv2.remap(factor, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return task.colour.levels(light)


def _light_at(
    picture: NDArray[np.uint8], table: Float32, at: Sequence[tuple[Float32, Float32]]
) -> Float32:
    """Linear light (h, w, 3) at columns and rows (h, w), of all channels and then of each.

    It is 0 where the first columns are negative. Only the part of the picture around is worked on.
    """
    inside = at[0][0] >= 0
    light = np.zeros((*inside.shape, 3), np.float32)
    if inside.any():
        ends = [np.array([axis[inside] for axis in axes]) for axes in zip(*at, strict=True)]
        low = [max(0, int(axis.min()) - SPLINE_REACH - 1) for axis in ends]
        high = [int(axis.max()) + SPLINE_REACH + 3 for axis in ends]
        part = picture[low[1] : high[1], low[0] : high[0]]
        nodes = spline_nodes(cv2.LUT(part, table))
        for n, (x, y) in enumerate(at[1:] or at):
            first, last = (0, 3) if len(at) == 1 else (n, n + 1)
            x = np.where(inside, x - np.float32(low[0]), np.float32(-1))
            sample_spline(nodes, x, y - np.float32(low[1]), first, last, light)
    return np.maximum(light, np.float32(0))


def _inner(block: Block, side_px: int = CELL_PX) -> tuple[slice, slice]:
    """Cells of the core within the block's, or pixels of a side of 1."""
    margin = (block.core.row_off - block.window.row_off) // side_px
    rows, columns = (-(-size // side_px) for size in (block.core.height, block.core.width))
    return slice(margin, margin + rows), slice(margin, margin + columns)


LABELS, TONES, BRIDGED = "labels.tif", "tones.tif", "bridged.tif"
"""Files of the survey's labels, and of its broad tones, by cell; of sigmas where the surface is
interpolated, 0 where it is measured."""


def _read_cells(survey: MosaicSetup, block: Block) -> tuple[NDArray[np.int32], Float32]:
    """Labels (rows, columns), and tones (rows, columns, 3), of a block; 0 beyond the mosaic."""
    rows, columns = block.grid.rows // CELL_PX, block.grid.columns // CELL_PX
    top, left = block.window.row_off // CELL_PX, block.window.col_off // CELL_PX
    label = np.zeros((rows, columns), np.int32)
    tones = np.zeros((rows, columns, 3), np.float32)
    with rasterio.open(survey.sights / LABELS) as raster:
        r0, c0 = max(0, top), max(0, left)
        r1, c1 = min(raster.height, top + rows), min(raster.width, left + columns)
        window = Window(c0, r0, c1 - c0, r1 - r0)
        at = slice(r0 - top, r1 - top), slice(c0 - left, c1 - left)
        label[at] = raster.read(1, window=window)
    if label.any():
        with rasterio.open(survey.sights / TONES) as raster:
            tones[at] = raster.read(window=window).transpose(1, 2, 0)
    return label, tones
