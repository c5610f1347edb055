"""A look at a few pairs before the work: at which scale to match, and how well matches agree.

In dim or turbid water the finest detail of a picture is noise: half the resolution then finds more
matches, and better ones. How far depths from different partners differ, in units of what a match of
`MATCH_SIGMA_PX` would give, shows the true precision: noise, calibration and poses together.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.base.executor import Executor
from alice_survey.base.frames import Array
from alice_survey.base.robust import MAD_TO_SIGMA
from reconstruct.dense.depth import MATCH_SIGMA_PX, pair_depth
from reconstruct.dense.stereo_pairs import StereoPair
from reconstruct.pictures.normalise import normalise
from reconstruct.pictures.undistorted import Pictures
from reconstruct.views.model import View, scaled_view

LARGEST_PIXELS = 3_000_000
"""Pictures with more pixels are halved for matching, until they have fewer."""
_PROBES = 8
_SCALES = 3
_WORTH = 1.15
"""Half the resolution is taken where it finds this many times the depths."""
_LEAST_COMMON = 500
"""Pixels that two partners must share for their difference to count."""
_SIGMA_LIMITS_PX = (0.15, 1.5)


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """How to match the pictures of a survey."""

    scale: float
    """Factor by which pictures are shrunk for matching."""
    match_sigma_px: float
    """Standard deviation of a match in pixels of the shrunk pictures."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ProbeTask:
    """One view to try."""

    workspace: Path
    view: View
    partners: tuple[View, ...]
    points_world: Array
    scales: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class ProbeResult:
    """What was found at each scale."""

    known: tuple[float, ...]
    """Share of the view's pixels with depth from its first partner."""
    spread: tuple[float, ...]
    """Scatter of the difference between two partners, in its expected standard deviations."""


def matching_scale(view: View) -> float:
    """1, 1/2, 1/4, ...: the largest at which a picture has no more than `LARGEST_PIXELS`."""
    scale = 1.0
    while view.width_px * view.height_px * scale * scale > LARGEST_PIXELS:
        scale /= 2.0
    return scale


def find_conditions(
    workspace: Path,
    views: Sequence[View],
    pairs: Sequence[Sequence[StereoPair]],
    points: Sequence[Array],
    scale: float | None,
    executor: Executor,
) -> Conditions:
    """Try a few views spread over the survey.

    Args:
        workspace: with the pictures.
        views: of the model.
        pairs: for every view.
        points: (N, 3) for every view, that bound its depth.
        scale: of matching, or None to choose it.
        executor: where tasks run.
    """
    able = [number for number, found in enumerate(pairs) if found]
    chosen = able[:: max(1, len(able) // _PROBES)][:_PROBES]
    largest = min(matching_scale(views[number]) for number in chosen)
    scales = tuple(largest / 2**n for n in range(_SCALES)) if scale is None else (scale,)
    tasks = [
        ProbeTask(
            workspace=workspace,
            view=views[number],
            partners=tuple(views[pair.partner] for pair in pairs[number][:3]),
            points_world=points[number],
            scales=scales,
        )
        for number in chosen
    ]
    results = list(executor.map(probe, tasks, label="try matching"))
    known = np.mean([result.known for result in results], axis=0)
    best = 0
    while best + 1 < len(scales) and known[best + 1] > _WORTH * known[best]:
        best += 1
    spreads = [result.spread[best] for result in results]
    known_spreads = [spread for spread in spreads if np.isfinite(spread)]
    sigma = MATCH_SIGMA_PX * (float(np.median(known_spreads)) if known_spreads else 1.0)
    return Conditions(
        scale=scales[best],
        match_sigma_px=round(float(np.clip(sigma, *_SIGMA_LIMITS_PX)), 3),
    )


def shrunk(
    pictures: Pictures, image: str, size_px: tuple[int, int]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Colour and validity of a picture at a size (width, height)."""
    return _resized(pictures.colour(image), pictures.valid(image), size_px)


def _resized(
    colour: NDArray[np.uint8], valid: NDArray[np.bool_], size_px: tuple[int, int]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    if colour.shape[1::-1] == size_px:
        return colour, valid
    small = cv2.resize(valid.astype(np.uint8) * 255, size_px, interpolation=cv2.INTER_AREA)
    return cv2.resize(colour, size_px, interpolation=cv2.INTER_AREA), np.asarray(small == 255)


def probe(task: ProbeTask) -> ProbeResult:
    """Match a view with its partners at every scale."""
    known, spread = [], []
    whole = (task.view, *task.partners)
    looks = [_looks(task.workspace, view, task.scales) for view in whole]
    for n, scale in enumerate(task.scales):
        views = [scaled_view(view, scale) for view in whole]
        greys, valids = zip(*(look[n] for look in looks), strict=True)
        maps = []
        for number in range(1, len(views)):
            found = pair_depth(
                views[0],
                views[number],
                greys[0],
                greys[number],
                valids[0],
                valids[number],
                task.points_world,
                MATCH_SIGMA_PX,
            )
            if found is not None:
                maps.append(found)
        known.append(float(np.isfinite(maps[0][0]).mean()) if maps else 0.0)
        spread.append(_spread(maps))
    return ProbeResult(known=tuple(known), spread=tuple(spread))


def _looks(
    workspace: Path, view: View, scales: Sequence[float]
) -> list[tuple[NDArray[np.uint8], NDArray[np.bool_]]]:
    """An evened picture and its validity at every scale, the picture read once."""
    pictures = Pictures.open(workspace)
    colour, valid = pictures.colour(view.image), pictures.valid(view.image)
    found = []
    for scale in scales:
        small = scaled_view(view, scale)
        part, usable = _resized(colour, valid, (small.width_px, small.height_px))
        found.append((normalise(part), usable))
    return found


def _spread(maps: Sequence[tuple[NDArray[np.float32], NDArray[np.float32]]]) -> float:
    """Median over pairs of partners of the normalised scatter of their difference; NaN if none."""
    spreads = []
    for first in range(len(maps)):
        for second in range(first + 1, len(maps)):
            (z, s), (y, t) = maps[first], maps[second]
            both = np.isfinite(z) & np.isfinite(y)
            if both.sum() < _LEAST_COMMON:
                continue
            difference = (z[both] - y[both]) / np.hypot(s[both], t[both])
            spreads.append(MAD_TO_SIGMA * float(np.median(np.abs(difference))))
    return float(np.median(spreads)) if spreads else float("nan")
