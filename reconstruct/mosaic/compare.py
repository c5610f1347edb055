"""What views show of the same spots, block by block: the survey's light is found from it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reconstruct.light.solve import LightSamples, at_places, joined_samples
from reconstruct.mosaic.grid import Block
from reconstruct.mosaic.paint import Float32, SeenView, ground_of
from reconstruct.mosaic.picture_measures import well_exposed
from reconstruct.mosaic.tools import MosaicSetup, tools_of
from reconstruct.mosaic.visibility import see
from reconstruct.raster import DemGrid, small_cache


@dataclass(frozen=True, kw_only=True, eq=False)
class LightTask:
    """A block on which to compare what views show."""

    survey: MosaicSetup
    block: Block
    views: tuple[SeenView, ...]
    step_px: int
    """Distance of spots."""
    most: int
    """Samples to return at most."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Shown:
    """Spots of a lattice that a view shows; arrays of N rows."""

    number: int
    spots: NDArray[np.intp]
    places: Float32
    levels: Float32
    ranges: Float32


@small_cache()
def compare_block(task: LightTask) -> LightSamples:
    """Samples of light on a lattice of spots, in linear light."""
    tools = tools_of(task.survey)
    surface = ground_of(task.survey, task.block).surface(_lattice(task.block.grid, task.step_px))
    if not np.isfinite(surface.height).any():
        return joined_samples([])
    seen = []
    for entry in task.views:
        optics = tools.optics(entry.view)
        sight = see(entry.view, optics, surface)
        spots = np.flatnonzero(sight.quality.ravel() > 0)
        copy = tools.small.load(entry.view.image)
        across, down = sight.places(optics.size_px)
        places = np.column_stack([across.ravel()[spots], down.ravel()[spots]])
        levels = at_places(copy.broad, places)
        usable = well_exposed(levels) & (at_places(copy.valid[..., None], places, 1)[:, 0] > 0.9)
        seen.append(
            _Shown(
                number=entry.number,
                spots=spots[usable],
                places=places[usable],
                levels=np.log(levels[usable]),
                ranges=sight.range.ravel()[spots[usable]],
            )
        )
    seen = _thinned(seen, surface.height.size, task)
    parts = []
    for i, one in enumerate(seen):
        for other in seen[i + 1 :]:
            _, a, b = np.intersect1d(
                one.spots, other.spots, assume_unique=True, return_indices=True
            )
            if not len(a):
                continue
            parts.append(
                LightSamples(
                    views=np.tile(np.array([[one.number, other.number]], np.int32), (len(a), 1)),
                    places=np.stack([one.places[a], other.places[b]], axis=1),
                    levels=np.stack([one.levels[a], other.levels[b]], axis=1),
                    ranges=np.stack([one.ranges[a], other.ranges[b]], axis=1),
                )
            )
    return joined_samples(parts)


def _thinned(seen: list[_Shown], spots: int, task: LightTask) -> list[_Shown]:
    """Views with as many of the spots, chosen by chance, as give no more samples than wanted."""
    times = np.zeros(spots, np.int64)
    for shown in seen:
        times[shown.spots] += 1
    pairs = times * (times - 1) // 2
    if pairs.sum() <= task.most:
        return seen
    rng = np.random.default_rng([task.block.core.row_off, task.block.core.col_off])
    order = rng.permutation(np.flatnonzero(pairs))
    kept = np.zeros(spots, np.bool_)
    kept[order[np.cumsum(pairs[order]) <= task.most]] = True
    thin = []
    for shown in seen:
        at = kept[shown.spots]
        thin.append(
            _Shown(
                number=shown.number,
                spots=shown.spots[at],
                places=shown.places[at],
                levels=shown.levels[at],
                ranges=shown.ranges[at],
            )
        )
    return thin


def _lattice(grid: DemGrid, step_px: int) -> DemGrid:
    return DemGrid(
        west=grid.west,
        north=grid.north,
        cell=grid.cell * step_px,
        rows=-(-grid.rows // step_px),
        columns=-(-grid.columns // step_px),
    )
