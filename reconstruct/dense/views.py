"""The work on one view at a time: its picture, its depth, and what its neighbours say of it.

Each step takes a task that travels to another process, reads what earlier steps left in the store,
and leaves its own there.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.block_solver import MAD_TO_SIGMA
from alice_survey.core.executor import Executor
from alice_survey.core.frames import Array
from reconstruct.dense.depth import (
    GATE_SIGMAS,
    Look,
    PairMatch,
    PartnerDepth,
    Rectification,
    count_confirming,
    enlarge,
    match_pair,
    merge_depths,
)
from reconstruct.dense.matching_trial import match_sigma, resize, spread
from reconstruct.dense.points import block_bounds, points_of_pixels
from reconstruct.dense.refine_depth import ComparedView, prepare, refine
from reconstruct.dense.stereo_pairs import in_frame
from reconstruct.dense.surface_tiles import ViewSummary
from reconstruct.dense.view_store import CHECKED, PICTURE, ViewStore, pack, pack_mask
from reconstruct.light.solve import (
    LightSamples,
    Parts,
    as_rows,
    at_nodes,
    compare_light,
    from_rows,
    joined_samples,
    low_pass,
)
from reconstruct.pictures.normalise import normalise
from reconstruct.pictures.undistorted import Pictures
from reconstruct.views.model import View, scaled_view
from reconstruct.views.range_shift import slopes_of

_BOUND_PERCENT = 0.1
"""Share of a view's points left out on each of its four sides, so that none strays far off."""
LIGHT = "samples"
"""Name of a view's samples of light in the store."""
_PART = 400_000
"""Samples of light that are worked on at a time, some: they take 0.3 kB each."""
_LIGHT_LATTICE = 28
"""Pixels along a picture's width at which the light of views is compared."""
_PAIRS = "pairs"
_ENOUGH_APART = 2
"""From so many on the pictures of its own station only serve where none of them sees."""
_COMPARED_VIEWS = 12
_COMPARED_STEP_PX = 7
"""Views, and pixels between the pixels of each, by which the sigma factor is measured."""
_MIN_PIXELS = 100
"""A view with fewer pixels of confirmed depth is left out."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewTask:
    """One view, and the other views that it is compared with."""

    store: ViewStore
    index: int
    view: View
    others: tuple[tuple[int, View], ...]


def prepare_view(workspace: Path, task: ViewTask) -> None:
    """Keep a picture's colour and validity at the size of depth."""
    store, view = task.store, task.view
    if store.has(task.index, PICTURE):
        return
    size_px = view.pinhole.size_px
    pictures = Pictures.open(workspace)
    colour, valid = resize(pictures.colour(view.image), pictures.valid(view.image), size_px)
    low = low_pass(colour, valid)
    store.save_colour(task.index, colour, valid=pack_mask(valid), low=low)


Size = tuple[int, int]
"""Width and height of a picture."""


def _brightness(store: ViewStore, index: int, kept_px: Size, size_px: Size) -> Look:
    """Brightness of a picture and which of its pixels may be used, at a size."""
    valid = store.load_mask(index, PICTURE, "valid", kept_px[0])
    return resize(store.load_bright(index), valid, size_px)


@lru_cache(maxsize=8)
def _even_picture(store: ViewStore, index: int, kept_px: Size, size_px: Size) -> Look:
    """A picture of even light and contrast, at a size."""
    bright, valid = _brightness(store, index, kept_px, size_px)
    return normalise(bright), valid


@lru_cache(maxsize=8)
def _look(store: ViewStore, index: int, kept_px: Size, size_px: Size) -> tuple[NDArray[Any], ...]:
    """Contrast, spline and validity of a picture, at a size."""
    return prepare(*_brightness(store, index, kept_px, size_px))


def find_match_sigma(scale: float, probes: Sequence[ViewTask], executor: Executor) -> float:
    """Standard deviation of a match in pixels as matched.

    How far depths from different partners differ, in units of what a match of `MATCH_SIGMA_PX`
    would give, shows the true precision: noise, calibration and poses together.

    Args:
        scale: of matching, a factor on the size of the views.
        probes: some views with their partners, all matched.
        executor: where tasks run.
    """
    match = partial(_match_apart, scale)
    return match_sigma(list(executor.map(match, probes, label="compare partners")))


def _match_apart(scale: float, task: ViewTask) -> float:
    """The `spread` of what a view's partners find."""
    return spread(_pair_depths(scale, task))


def match_view(scale: float, matched: tuple[ViewTask, Array]) -> None:
    """Match a view with partners, for both views of each pair.

    Args:
        scale: of matching, a factor on the size of the views.
        matched: the view with those of its partners to match it with here (see `pairs_once`), and
            points (N, 3) that bound its depth.
    """
    (task, points_world), smalls, looks = matched, [], []
    if task.store.has(task.index, _PAIRS):
        return
    for number, view in ((task.index, task.view), *task.others):
        smalls.append(scaled_view(view, scale))
        size_px = smalls[-1].pinhole.size_px
        looks.append(_even_picture(task.store, number, view.pinhole.size_px, size_px))
    pairs: dict[str, Any] = {"view": task.index}
    for (number, _), small, look in zip(task.others, smalls[1:], looks[1:], strict=True):
        found = match_pair((smalls[0], small), (looks[0], look), points_world)
        if found is not None:
            pairs[str(number)] = pack(codes=found.codes, **vars(found.pair))
    task.store.save(task.index, _PAIRS, pack(**pairs))


def pairs_once(partners: Sequence[Sequence[int]]) -> list[list[int]]:
    """Those of every view's partners that it is matched with: each pair is in one of two lists."""
    return [
        [m for m in chosen if n < m or n not in partners[m]] for n, chosen in enumerate(partners)
    ]


def _pair_depths(scale: float, task: ViewTask) -> list[PartnerDepth]:
    """Depth of a view, shrunk by a factor, from each partner with which it could be rectified."""
    depths, one = [], scaled_view(task.view, scale)
    for number, view in task.others:
        found = _pair(task.store, task.index, number)
        swapped = None if found else _pair(task.store, number, task.index)
        found = swapped.swap() if swapped else found
        if found:
            depths.append(found.depth(one, scaled_view(view, scale)))
    return depths


def _pair(store: ViewStore, view: int, partner: int) -> PairMatch | None:
    """What `match_view` found of a view and a partner of its list."""
    pairs = store.load(view, _PAIRS)
    if str(partner) not in (pairs.dtype.names or ()):
        return None
    kept = pairs[str(partner)]
    pair: dict[str, Any] = {name: np.array(kept[name]) for name in kept.dtype.names or ()}
    codes = pair.pop("codes")
    numbers = {name: value.item() for name, value in pair.items() if not value.shape}
    return PairMatch(Rectification(**pair | numbers), codes)


def _compared_view(store: ViewStore, scale: float, number: int, view: View) -> ComparedView:
    small = scaled_view(view, scale)
    shown = _look(store, number, view.pinhole.size_px, small.pinhole.size_px)
    contrast, spline, valid = shown
    return ComparedView(view=small, contrast=contrast, spline=spline, valid=valid)


def refining_scales(scale: float) -> list[float]:
    """Factors on the size of a view at which a depth that was matched at one of them is refined.

    Each is twice the one before, so that an error of matching is within the reach of the
    refinement; the last is 1.
    """
    octaves = max(1, math.ceil(-math.log2(scale)))
    return [0.5**n for n in reversed(range(octaves))]


def refine_view(
    scale: float, match_sigma_px: float, task: ViewTask, *, on_gpu: bool = False
) -> None:
    """Merge what a view's partners find, and make it exact by all of them at once.

    Pictures of its own station serve where no other station sees, or where there is hardly one.

    Args:
        scale: at which the depth was matched.
        match_sigma_px: standard deviation of a match, in pixels as matched.
        task: the view and its partners.
        on_gpu: whether a GPU does it.
    """
    store, full_px = task.store, task.view.pinhole.size_px
    if store.has(task.index, "fine"):
        return
    apart = [other for other in task.others if other[1].station != task.view.station]
    rig = [other for other in task.others if other[1].station == task.view.station]
    first, spare = (apart, rig) if len(apart) >= _ENOUGH_APART else (task.others, [])
    depths = _pair_depths(scale, task)
    shape = 2, len(depths), *scaled_view(task.view, scale).pinhole.size_px[::-1]
    both = [one.depth for one in depths], [one.sigma(match_sigma_px) for one in depths]
    depth, sigma, agreeing = merge_depths(*np.array(both, np.float32).reshape(shape), GATE_SIGMAS)
    del depths, both
    if on_gpu:
        from reconstruct.dense.refine_gpu import refine_on_gpu as refined_by
    else:
        refined_by = refine
    for factor in refining_scales(scale):
        reference = _compared_view(store, factor, task.index, task.view)
        depth, sigma = (enlarge(of, reference.view.pinhole.size_px) for of in (depth, sigma))
        start = depth
        compared = [
            [_compared_view(store, factor, *other) for other in views] for views in (first, spare)
        ]
        refined = refined_by(reference, depth, sigma, *compared)
        depth, sigma = refined.depth, refined.sigma
    agreeing = cv2.resize(agreeing, full_px, interpolation=cv2.INTER_NEAREST)
    support = np.where(np.isfinite(start), np.maximum(agreeing, refined.seen), refined.seen)
    store.save_depth(task.index, "fine", depth, sigma, seen=support.astype(np.uint8))


def find_sigma_factor(checks: Sequence[ViewTask], executor: Executor) -> float:
    """How far refined depths of neighbouring views differ, in standard deviations as stated.

    What the noise of pictures cannot show (detail finer than the window, poses, calibration) shows
    where views differ. The median over some views spread over the survey; at least 1.
    """
    step = max(1, len(checks) // _COMPARED_VIEWS)
    spreads = list(executor.map(disagreement, checks[::step], label="compare"))
    known = [spread for spread in spreads if np.isfinite(spread)]
    return max(1.0, float(np.median(known))) if known else 1.0


def disagreement(task: ViewTask) -> float:
    """Scatter of a view's depths against its neighbours', in standard deviations; NaN if none."""
    depth, sigma = task.store.load_depth(task.index, "fine")
    lattice = np.zeros(depth.shape, np.bool_)
    chosen = slice(_COMPARED_STEP_PX // 2, None, _COMPARED_STEP_PX)
    lattice[chosen, chosen] = True
    rows, columns = np.nonzero(lattice & np.isfinite(depth))
    points = points_of_pixels(task.view, depth, lattice & np.isfinite(depth))
    parts = []
    for number, other in task.others:
        level, share, depths, shares = task.store.stored_depth(number, "fine")
        seen = in_frame(other, points)
        at = np.floor(other.project(points[seen])).astype(np.int64)
        z = other.world_from_cam.inv().apply(points[seen])[:, 2]
        other_z = depths[level[at[:, 1], at[:, 0]]]
        other_sigma = other_z * shares[share[at[:, 1], at[:, 0]]]
        own = sigma[rows, columns][seen]
        parts.append((other_z - z) / np.hypot(own, other_sigma))
    apart = np.concatenate(parts) if parts else np.empty(0)
    apart = apart[np.isfinite(apart)]
    return MAD_TO_SIGMA * float(np.median(np.abs(apart))) if len(apart) >= _MIN_PIXELS else np.nan


def check_view(sigma_factor: float, task: ViewTask) -> tuple[Array, int, ViewSummary]:
    """Keep the depths that two independent looks support.

    A depth stays where the neighbours whose windows look alike (or the partners that agree) and the
    neighbouring views that find the same surface number two or more, and no more views see through
    it than confirm it.

    Args:
        sigma_factor: on the standard deviations of refined depths.
        task: the view and its neighbours.

    Returns:
        What the view shows at the nodes of the light model (see `light.at_nodes`), how many
        spots it and its neighbours show, which are left in the store, and where its points lie.
    """
    store, view = task.store, task.view
    depth, sigma = store.load_depth(task.index, "fine")
    sigma *= np.float32(sigma_factor)
    alike = store.load(task.index, "fine")["seen"].astype(np.int16)
    refuted = np.zeros_like(alike)
    supported = np.zeros_like(alike)
    slopes = slopes_of(depth, view.kernel_lens, 0, 0)
    for number, other in task.others:
        move = (other.world_from_cam.inv() * view.world_from_cam).as_matrix()[:3]
        there = np.ascontiguousarray(move), store.stored_depth(number, "fine")
        seen, through = count_confirming(
            depth, sigma, slopes, *there, sigma_factor, other.kernel_lens, GATE_SIGMAS
        )
        supported += seen
        refuted += through
    kept = np.isfinite(depth) & (alike + supported >= 2) & (refuted <= supported)
    kept &= np.count_nonzero(kept) >= _MIN_PIXELS
    nodes = at_nodes(np.asarray(store.load(task.index, PICTURE)["low"]))
    light = as_rows(_shared_light(task, depth, kept))
    store.save(task.index, LIGHT, light)
    return nodes, len(light), _lay_out(task, depth, sigma, kept)


def light_parts(
    store: ViewStore, samples: Sequence[int], executor: Executor
) -> Parts[range, LightSamples]:
    """What all views and their neighbours show of the same spots, by runs of views.

    Args:
        store: with the samples of all views.
        samples: how many each view has.
        executor: where tasks run.
    """
    part = np.cumsum([0, *samples])[:-1] // _PART
    bounds = [0, *(np.flatnonzero(np.diff(part)) + 1).tolist(), len(samples)]
    return Parts(
        items=[range(first, end) for first, end in pairwise(bounds)],
        load=partial(_load_light, store), label="light of all pictures", executor=executor,
    )  # fmt: skip


def _load_light(store: ViewStore, views: range) -> LightSamples:
    return joined_samples([from_rows(store.load(view, LIGHT)) for view in views])


def _lay_out(
    task: ViewTask, depth: NDArray[np.float32], sigma: NDArray[np.float32], kept: NDArray[np.bool_]
) -> ViewSummary:
    """Keep which points of a view are kept, and where they lie without the few that lie far off."""
    view, inside = task.view, kept.copy()
    points = points_of_pixels(view, depth, kept)
    ends = [_BOUND_PERCENT, 100 - _BOUND_PERCENT]
    if len(points):
        low, high = np.transpose([np.percentile(points[:, k].copy(), ends) for k in range(2)])
        inside[kept] = np.logical_and(*((points[:, :2] >= low) & (points[:, :2] <= high)).T)
    blocks, masks = block_bounds(kept, points), (pack_mask(kept), pack_mask(inside))
    task.store.save(task.index, CHECKED, pack(kept=masks[0], inside=masks[1], blocks=blocks))
    if not len(points):
        return ViewSummary(bounds=None, up=np.nan, footprint=np.nan, sigma=np.nan)
    return ViewSummary(
        bounds=(float(low[0]), float(low[1]), float(high[0]), float(high[1])),
        up=float(-np.median(points[:, 2])),
        footprint=float(np.median(depth[inside]) / view.pinhole.focal_px),
        sigma=float(np.median(sigma[inside])),
    )


def _shared_light(
    task: ViewTask, depth: NDArray[np.float32], kept: NDArray[np.bool_]
) -> LightSamples:
    """Compare the light of a view and its neighbours on a lattice of its pixels."""
    step = max(1, task.view.pinhole.width_px // _LIGHT_LATTICE)
    chosen = np.zeros_like(kept)
    chosen[::step, ::step] = kept[::step, ::step]
    ground = points_of_pixels(task.view, depth, chosen)
    here = (np.argwhere(chosen)[:, ::-1] + 0.5) / task.view.pinhole.size_px
    own = np.asarray(task.store.load(task.index, PICTURE)["low"])
    parts = []
    for number, other in task.others:
        seen = in_frame(other, ground)
        there = other.project(ground[seen]) / other.pinhole.size_px
        pictures = own, np.asarray(task.store.load(number, PICTURE)["low"])
        places = here[seen].astype(np.float32), there.astype(np.float32)
        parts.append(compare_light((task.index, number), pictures, places))
    return joined_samples(parts)
