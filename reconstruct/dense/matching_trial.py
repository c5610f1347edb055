"""A look at a few pairs before the work: at which scale to match, and how well matches agree.

In dim or turbid water the finest detail of a picture is noise: half the resolution then finds more
matches, and better ones. How far depths from different partners differ, in units of what a match of
`MATCH_SIGMA_PX` would give, shows the true precision: noise, calibration and poses together.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.base.executor import Executor
from alice_survey.base.frames import Array
from alice_survey.base.robust import MAD_TO_SIGMA
from reconstruct.dense.depth import MATCH_SIGMA_PX, Look, pair_depth
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


def matching_scale(view: View) -> float:
    """1, 1/2, 1/4, ...: the largest at which a picture has no more than `LARGEST_PIXELS`."""
    scale = 1.0
    while np.prod(view.pinhole.size_px) * scale * scale > LARGEST_PIXELS:
        scale /= 2.0
    return scale


def find_conditions(
    workspace: Path,
    views: Sequence[View],
    partners: Sequence[Sequence[int]],
    points_of: Callable[[int], Array],
    scale: float | None,
    executor: Executor,
) -> Conditions:
    """Try a few views spread over the survey.

    Args:
        workspace: with the pictures.
        views: of the model.
        partners: of every view, best first.
        points_of: from the number of a view to the points (N, 3) that bound its depth.
        scale: of matching, or None to choose it.
        executor: where tasks run.
    """
    able = [number for number, found in enumerate(partners) if found]
    chosen = able[:: max(1, len(able) // _PROBES)][:_PROBES]
    largest = min(matching_scale(views[number]) for number in chosen)
    scales = tuple(largest / 2**n for n in range(_SCALES)) if scale is None else (scale,)
    tasks = [
        ((views[number], *(views[n] for n in partners[number][:3])), points_of(number))
        for number in chosen
    ]
    found = executor.map(partial(probe, workspace, scales), tasks, label="try matching")
    known, spreads = np.moveaxis(np.array(list(found)), -1, 0)
    share = known.mean(axis=0)
    best = 0
    while best + 1 < len(scales) and share[best + 1] > _WORTH * share[best]:
        best += 1
    spread = spreads[:, best][np.isfinite(spreads[:, best])]
    sigma = MATCH_SIGMA_PX * (float(np.median(spread)) if len(spread) else 1.0)
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


def probe(
    workspace: Path, scales: Sequence[float], task: tuple[tuple[View, ...], Array]
) -> list[tuple[float, float]]:
    """Match a view with its partners at every scale.

    Args:
        workspace: with the pictures.
        scales: to try.
        task: the view and its partners, and points (N, 3) that bound its depth.

    Returns:
        For each scale the share of the view's pixels with depth from its first partner, and the
        scatter of the difference between two partners, in its expected standard deviations.
    """
    views, points_world = task
    looks = [_looks(workspace, view, scales) for view in views]
    found = []
    for n, scale in enumerate(scales):
        small = [scaled_view(view, scale) for view in views]
        shown = [look[n] for look in looks]
        pairs = (
            pair_depth((small[0], other), (shown[0], look), points_world, MATCH_SIGMA_PX)
            for other, look in zip(small[1:], shown[1:], strict=True)
        )
        maps = [pair for pair in pairs if pair is not None]
        found.append((float(np.isfinite(maps[0][0]).mean()) if maps else 0.0, _spread(maps)))
    return found


def _looks(workspace: Path, view: View, scales: Sequence[float]) -> list[Look]:
    """An evened picture and its validity at every scale, the picture read once."""
    pictures = Pictures.open(workspace)
    colour, valid = pictures.colour(view.image), pictures.valid(view.image)
    found = []
    for scale in scales:
        small = scaled_view(view, scale)
        part, usable = _resized(colour, valid, small.pinhole.size_px)
        found.append((normalise(part), usable))
    return found


def _spread(maps: Sequence[tuple[NDArray[np.float32], NDArray[np.float32]]]) -> float:
    """Median over pairs of partners of the normalised scatter of their difference; NaN if none."""
    spreads = []
    for (z, s), (y, t) in combinations(maps, 2):
        both = np.isfinite(z) & np.isfinite(y)
        if both.sum() >= _LEAST_COMMON:
            difference = (z[both] - y[both]) / np.hypot(s[both], t[both])
            spreads.append(MAD_TO_SIGMA * float(np.median(np.abs(difference))))
    return float(np.median(spreads)) if spreads else float("nan")
