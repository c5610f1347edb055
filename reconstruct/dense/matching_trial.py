"""A look at a few views before the work: at which scale to match, and how well matches agree.

In dim or turbid water the finest detail of a picture is noise: half the resolution then finds more
matches, and better ones.
"""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.base.executor import Executor
from alice_survey.base.frames import Array
from alice_survey.base.robust import MAD_TO_SIGMA
from reconstruct.dense.depth import MATCH_SIGMA_PX, Look, PartnerDepth, pair_depth
from reconstruct.dense.rectify import rectify
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
_COMPARED = 3
"""Partners of a view whose depths are compared."""
_SIGMA_LIMITS_PX = (0.15, 1.5)


def matching_scale(view: View) -> float:
    """1, 1/2, 1/4, ...: the largest at which a picture has no more than `LARGEST_PIXELS`."""
    scale = 1.0
    while np.prod(view.pinhole.size_px) * scale * scale > LARGEST_PIXELS:
        scale /= 2.0
    return scale


def probed(partners: Sequence[Sequence[int]]) -> list[int]:
    """A few views with partners, spread over the survey."""
    able = [number for number, found in enumerate(partners) if found]
    return able[:: max(1, len(able) // _PROBES)][:_PROBES]


def find_scale(
    workspace: Path,
    views: Sequence[View],
    partners: Sequence[Sequence[int]],
    points_of: Callable[[int], Array],
    executor: Executor,
) -> float:
    """Factor by which pictures are shrunk for matching, from a few views.

    Args:
        workspace: with the pictures.
        views: of the model.
        partners: of every view, best first.
        points_of: from the number of a view to the points (N, 3) that bound its depth.
        executor: where tasks run.
    """
    chosen = probed(partners)
    tasks = [
        ((views[number], *(views[n] for n in partners[number])), points_of(number))
        for number in chosen
    ]
    largest = min(matching_scale(views[number]) for number in chosen)
    scales = [largest * 0.5**n for n in range(_SCALES)]
    shares: list[float] = []
    for tried in (scales[:2], scales[2:]):  # the third is asked only where the second is better
        found = executor.map(partial(probe, workspace, tried), tasks, label="try matching")
        shares.extend(np.mean(list(found), axis=0).tolist())
        best = 0
        while best + 1 < len(shares) and shares[best + 1] > _WORTH * shares[best]:
            best += 1
        if best + 1 < len(shares):
            break
    return scales[best]


def match_sigma(spreads: Sequence[float]) -> float:
    """Standard deviation of a match in pixels as matched, from the `spread` of some views."""
    known = [one for one in spreads if np.isfinite(one)]
    sigma = MATCH_SIGMA_PX * (float(np.median(known)) if known else 1.0)
    return round(float(np.clip(sigma, *_SIGMA_LIMITS_PX)), 3)


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
) -> list[float]:
    """Match a view with its best partner at every scale.

    Args:
        workspace: with the pictures.
        scales: to try.
        task: the view and its partners, and points (N, 3) that bound its depth.

    Returns:
        For each scale the share of the view's pixels with depth.
    """
    (view, *partners), points_world = task
    able = (other for other in partners if rectify(view, other, points_world) is not None)
    partner = next(able, None)
    if partner is None:
        return [0.0] * len(scales)
    looks = [_looks(workspace, one, scales) for one in (view, partner)]
    found = []
    for n, scale in enumerate(scales):
        pair = scaled_view(view, scale), scaled_view(partner, scale)
        depth = pair_depth(pair, (looks[0][n], looks[1][n]), points_world)
        found.append(0.0 if depth is None else float(np.isfinite(depth.depth).mean()))
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


def spread(depths: Sequence[PartnerDepth]) -> float:
    """How far the depths of a view by different partners differ, in standard deviations as assumed.

    The median, over pairs of partners, of the normalised scatter of their difference; NaN if none.
    """
    spreads = []
    for one, other in combinations(depths[:_COMPARED], 2):
        both = np.isfinite(one.depth) & np.isfinite(other.depth)
        if both.sum() >= _LEAST_COMMON:
            z, y = one.depth[both], other.depth[both]
            s, t = z * z / one.focal_baseline, y * y / other.focal_baseline
            difference = (z - y) / (np.float32(MATCH_SIGMA_PX) * np.hypot(s, t))
            spreads.append(MAD_TO_SIGMA * float(np.median(np.abs(difference))))
    return float(np.median(spreads)) if spreads else float("nan")
