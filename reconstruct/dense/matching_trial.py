"""A look at a few views before the work: at which scale to match, and how well matches agree.

In dim or turbid water the finest detail of a picture is noise: half the resolution then finds more
matches, and better ones.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.block_solver import MAD_TO_SIGMA
from alice_survey.core.executor import Executor
from alice_survey.core.frames import Array
from reconstruct.dense.depth import MATCH_SIGMA_PX, Look, PartnerDepth, pair_depth, rectify
from reconstruct.pictures.normalise import normalise
from reconstruct.pictures.undistorted import Pictures
from reconstruct.views.model import View, scaled_view

MAX_PIXELS = 3_000_000
"""Depth with more pixels is matched in pictures that are halved until they have fewer."""
CELL_PIXELS = 2.5
"""Side of a cell of the surface in mean ground pixels of views, unless depth is coarser."""
_MIN_SCALE = 0.05


def matching_scale(pixels: float, finest: float = 1.0) -> float:
    """A factor, halved until a picture of so many pixels that is shrunk by it is small enough."""
    scale = finest
    while pixels * scale * scale > MAX_PIXELS:
        scale /= 2.0
    return scale


def scale_for_cell(cell: float | None, pixel: float) -> float:
    """Factor at which a cell of the surface has as many pixels of depth as it has by default.

    Args:
        cell: side of a cell; None for the finest that pictures give.
        pixel: side of a pixel on the ground, in the same unit.
    """
    return 1.0 if cell is None else min(1.0, max(_MIN_SCALE, CELL_PIXELS * pixel / cell))


_PROBES = 8
_LOOKED_AT = 50
"""Views from which the side of a pixel on the ground is taken, about."""
_SCALES = 3
_WORTH = 1.15
"""Half the resolution is taken where it finds this many times the depths."""
_MIN_COMMON = 500
"""Pixels that two partners must share for their difference to count."""
_COMPARED = 3
"""Partners of a view whose depths are compared."""
_SIGMA_LIMITS_PX = (0.15, 1.5)


@dataclass(frozen=True, kw_only=True)
class Scales:
    """Factors by which pictures are shrunk."""

    depth: float
    """For the depth of views, and all that is made of it."""
    matching: float
    """For semi-global matching, by which this depth is found before it is refined."""


def pixels_of(view: View) -> int:
    """How many a view has."""
    return view.pinhole.width_px * view.pinhole.height_px


def choose_probes(partners: Sequence[Sequence[int]]) -> list[int]:
    """A few views with partners, spread over the survey."""
    able = [number for number, found in enumerate(partners) if found]
    return able[:: max(1, len(able) // _PROBES)][:_PROBES]


def find_scales(
    workspace: Path, views: Sequence[View], partners: Sequence[Sequence[int]],
    points_of: Callable[[int], Array], finest: float, executor: Executor,
) -> Scales:  # fmt: skip
    """At which scale to match, and whether detail that is finer than that is worth refining.

    Where a few views find more depths at a lower resolution, what is finer is noise.

    Args:
        workspace: with the pictures.
        views: of the model.
        partners: of every view, best first.
        points_of: from the number of a view to the points (N, 3) that bound its depth.
        finest: scale of depth where pictures are clear.
        executor: where tasks run.
    """
    chosen = choose_probes(partners)
    tasks = [
        ((views[number], *(views[n] for n in partners[number])), points_of(number))
        for number in chosen
    ]
    largest = min(matching_scale(pixels_of(views[number]), finest) for number in chosen)
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
    return Scales(depth=scales[best] if best else finest, matching=scales[best])


def match_sigma(spreads: Sequence[float]) -> float:
    """Standard deviation of a match in pixels as matched, from the `spread` of some views."""
    known = [one for one in spreads if np.isfinite(one)]
    sigma = MATCH_SIGMA_PX * (float(np.median(known)) if known else 1.0)
    return round(float(np.clip(sigma, *_SIGMA_LIMITS_PX)), 3)


def resize(
    colour: NDArray[np.uint8], valid: NDArray[np.bool_], size_px: tuple[int, int]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """A picture and its validity at a size (width, height), no larger: valid where all of it is."""
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
        part, usable = resize(colour, valid, small.pinhole.size_px)
        found.append((normalise(part), usable))
    return found


def spread(depths: Sequence[PartnerDepth]) -> float:
    """How far the depths of a view by different partners differ, in standard deviations as assumed.

    The median, over pairs of partners, of the normalised scatter of their difference; NaN if none.
    """
    spreads = []
    for one, other in combinations(depths[:_COMPARED], 2):
        both = np.isfinite(one.depth) & np.isfinite(other.depth)
        if both.sum() >= _MIN_COMMON:
            z, y = one.depth[both], other.depth[both]
            s, t = z * z / one.focal_baseline, y * y / other.focal_baseline
            difference = (z - y) / (np.float32(MATCH_SIGMA_PX) * np.hypot(s, t))
            spreads.append(MAD_TO_SIGMA * float(np.median(np.abs(difference))))
    return float(np.median(spreads)) if spreads else float("nan")
