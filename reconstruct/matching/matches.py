"""Matches between the features of two pictures, and the two-view geometry that verifies them.

Descriptors are bytes, so that every dot product is a whole number below 2^24 and comes out of
float32 matrix products exactly: matches depend neither on the number of threads nor on the blocks.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from alice_survey.core.compiled import compiled
from alice_survey.core.frames import Array
from camera_calib.approximation.pinhole_warp import PinholeWarp
from reconstruct.matching.features import Features, load_features

pycolmap.logging.minloglevel = 3  # its own account of every step is for its developers
Matches = NDArray[np.uint32]
SIFT_RATIO = 0.8
"""Largest distance of a match over that of the second nearest descriptor of SIFT."""
_BLOCK = 1024
_COARSE_FEATURES = 800
_PROBE_FEATURES = 1500
"""Largest features of both pictures whose matches predict where all others are."""
_WORTH_PROBING = 2.0
"""Products of a full match over those of the probe, from which prediction saves time."""
_MIN_PROBED = 30
"""Matches of the probe near one plane below which nothing is predicted."""
_CELLS_ALONG = 12
"""Cells along the longer side of a picture that share one prediction."""
_SLACK = 2.0
"""Radius of the search over the largest miss of the prediction at the probe's own matches."""
_FALSE = 4.0
"""Misses over the median from which a match of the probe is taken for false; relief stays below."""
_TRIALS = 300
"""Trials for the plane through the matches of the probe, most of which are right."""
_RELIEF = 0.1
"""Farthest that a match of the probe may be from one plane's, as a share of the longer side."""
_MIN_RADIUS = 0.02
"""Least radius of the search, as a share of the picture's longer side."""


@compiled
def _best_two(
    products: Any, norms_a: Any, norms_b: Any, best: Any, first: Any, second: Any, best_b: Any,
    nearest_b: Any,
) -> None:  # fmt: skip
    """Fold one block of products into the nearest neighbours of both sides.

    Rows of a get their nearest index and the two least squared distances; columns of b get their
    nearest row. The first of equals wins.
    """
    for i in range(products.shape[0]):
        minimum, next_least, index = first[i], second[i], best[i]
        for j in range(products.shape[1]):
            distance = norms_a[i] + norms_b[j] - 2.0 * products[i, j]
            if distance < minimum:
                next_least = minimum
                minimum = distance
                index = j
            elif distance < next_least:
                next_least = distance
            if distance < nearest_b[j]:
                nearest_b[j] = distance
                best_b[j] = i
        first[i], second[i], best[i] = minimum, next_least, index


def match_descriptors(
    a: NDArray[np.uint8], b: NDArray[np.uint8], ratio: float, block: int = _BLOCK
) -> Matches:
    """Mutual nearest neighbours that stand out from the second nearest.

    Args:
        a: (N, D) descriptors.
        b: (M, D) descriptors.
        ratio: largest distance to the nearest over that to the second nearest.
        block: rows of a at a time.

    Returns:
        (K, 2) indices into a and b, by rising index into a.
    """
    every = np.arange(len(b))
    blocks = (np.arange(start, min(start + block, len(a))) for start in range(0, len(a), block))
    return _mutual(a, b, ratio, ((rows, every) for rows in blocks))


def _mutual(
    a: NDArray[np.uint8],
    b: NDArray[np.uint8],
    ratio: float,
    searches: Iterable[tuple[NDArray[np.intp], NDArray[np.intp]]],
) -> Matches:
    """As `match_descriptors`, where some rows of a are compared with some of b, in turn."""
    if not len(a) or len(b) < 2:
        return np.zeros((0, 2), np.uint32)
    left, right = a.astype(np.float32), b.astype(np.float32)
    norms_a, norms_b = ((side**2).sum(axis=1) for side in (left, right))
    best = np.zeros(len(a), np.int64)
    first = np.full(len(a), np.inf, np.float32)
    second = np.full(len(a), np.inf, np.float32)
    best_b = np.full(len(b), -1, np.int64)
    nearest_b = np.full(len(b), np.inf, np.float32)
    for rows, near in searches:
        own_best, own_best_b = np.zeros(len(rows), np.int64), best_b[near]
        own_first, own_second = first[rows], second[rows]
        own_nearest = nearest_b[near]
        before = own_nearest.copy()
        _best_two(
            left[rows] @ right[near].T, norms_a[rows], norms_b[near], own_best, own_first,
            own_second, own_best_b, own_nearest,
        )  # fmt: skip
        best[rows], first[rows], second[rows] = near[own_best], own_first, own_second
        closer = own_nearest < before
        best_b[near[closer]] = rows[own_best_b[closer]]
        nearest_b[near] = own_nearest
    every = np.arange(len(a))
    # without a second to compare with, nothing stands out
    clear = (first < ratio * ratio * second) & np.isfinite(second)
    good = every[clear & (best_b[best] == every)]
    return np.stack([good, best[good]], axis=1).astype(np.uint32)


def match_near(
    a: Features, b: Features, ratio: float, predicted: Array, radius_px: float, cell_px: float
) -> Matches:
    """As `match_descriptors`, but features of b are sought only near where those of a are expected.

    Features of a share the search of their cell: all of b within `radius_px` of the bounding box of
    the cell's expected places.

    Args:
        a: features of the first picture.
        b: of the second.
        ratio: as of `match_descriptors`; among the features searched.
        predicted: (N, 2) where the features of a are expected in the second picture.
        radius_px: how far from there they may be.
        cell_px: side of the cells of the first picture.

    Returns:
        (K, 2) indices into a and b, by rising index into a.
    """
    if not len(a.pixels):
        return np.zeros((0, 2), np.uint32)
    across = np.argsort(b.pixels[:, 0], kind="stable")
    x, y = b.pixels[across].T
    cells = (a.pixels // cell_px).astype(np.int64)
    number = cells[:, 1] * (cells[:, 0].max() + 1) + cells[:, 0]
    order = np.argsort(number, kind="stable")

    starts = np.flatnonzero(np.diff(number[order], prepend=-1))
    low = np.minimum.reduceat(predicted[order], starts) - radius_px
    high = np.maximum.reduceat(predicted[order], starts) + radius_px
    first, last = np.searchsorted(x, low[:, 0]), np.searchsorted(x, high[:, 0], "right")

    def searches() -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp]]]:
        for n, rows in enumerate(np.split(order, starts[1:])):
            strip = slice(first[n], last[n])
            near = np.sort(across[strip][(y[strip] >= low[n, 1]) & (y[strip] <= high[n, 1])])
            if len(near):
                yield rows, near

    return _mutual(a.descriptors, b.descriptors, ratio, searches())


@dataclass(frozen=True, kw_only=True)
class PairTask:
    """Two pictures to match: files of their features, and cameras where they are to be verified."""

    first: Path
    second: Path
    ratio: float = SIFT_RATIO
    cameras: tuple[dict[str, Any], dict[str, Any]] = field(default_factory=lambda: ({}, {}))
    """COLMAP cameras as `todict` gives them; empty for a coarse look."""
    warps: tuple[PinholeWarp | None, PinholeWarp | None] = (None, None)
    """What takes pixels to those of the cameras, where these are ideal pinholes."""
    seed: int = 0


@dataclass(frozen=True, kw_only=True, eq=False)
class PairMatches:
    """Verified matches of a pair."""

    matches: Matches
    """(K, 2) inliers."""
    geometry: dict[str, Any] | None
    """What COLMAP needs to know of the pair's geometry, or None where there is none."""


def kept_features(path: Path) -> Features:
    """Features from their file; those read last are kept, as long as their file is the same."""
    stat = path.stat()
    return _keep_mutual(path, stat.st_mtime_ns, stat.st_ino)


@lru_cache(maxsize=32)
def _keep_mutual(path: Path, _changed_ns: int, _inode: int) -> Features:
    return load_features(path)


def coarse_matches(task: PairTask) -> int:
    """How many of the first (largest) features of two pictures match: cheap, to choose pairs by."""
    first, second = (
        kept_features(p).descriptors[:_COARSE_FEATURES] for p in (task.first, task.second)
    )
    return len(match_descriptors(first, second, task.ratio))


def match_pair(task: PairTask) -> PairMatches:
    """Match two pictures and keep what one two-view geometry explains.

    Where there are many features, the largest are matched first; the plane that their matches are
    near narrows the search. Where they are near none, all are compared with all.
    """
    a, b = kept_features(task.first), kept_features(task.second)
    seen = as_seen(a.pixels, task.warps[0]), as_seen(b.pixels, task.warps[1])
    probe = min(len(a.pixels), _PROBE_FEATURES) * min(len(b.pixels), _PROBE_FEATURES)
    worth_it = len(a.pixels) * len(b.pixels) >= _WORTH_PROBING * probe
    matches = _guided_matches(task, a, b) if worth_it else None
    if matches is None:
        matches = match_descriptors(a.descriptors, b.descriptors, task.ratio)
    return verify(task, seen, matches)


def _guided_matches(task: PairTask, a: Features, b: Features) -> Matches | None:
    """Matches where those of the largest features predict them; None where they predict nothing."""
    few = match_descriptors(
        a.descriptors[:_PROBE_FEATURES], b.descriptors[:_PROBE_FEATURES], task.ratio
    )
    if len(few) < _MIN_PROBED:
        return None
    at, there = a.pixels[few[:, 0]], b.pixels[few[:, 1]]
    long_side = float(a.pixels.max())
    homography, _ = cv2.findHomography(
        at, there, cv2.USAC_DEFAULT, _RELIEF * long_side, None, _TRIALS
    )
    if homography is None:
        return None
    miss = np.linalg.norm(apply_homography(homography, at) - there, axis=1)
    close = miss <= _RELIEF * long_side
    if close.sum() < _MIN_PROBED:
        return None
    near = close & (miss <= _FALSE * np.median(miss[close]))
    if near.sum() < _MIN_PROBED / 2:  # a fit that does not hold, or has no solution at all
        return None
    homography = fit_homography(at[near], there[near])
    miss = np.linalg.norm(apply_homography(homography, at[near]) - there[near], axis=1)
    radius = max(_SLACK * float(miss.max()), _MIN_RADIUS * long_side)
    predicted = apply_homography(homography, a.pixels)
    if not np.isfinite(predicted).all() or radius > long_side / 3:
        return None
    return match_near(a, b, task.ratio, predicted, radius, long_side / _CELLS_ALONG)


def fit_homography(first: Array, second: Array) -> Array:
    """The (3, 3) homography of least algebraic error (Hartley 1997) that takes first to second.

    Args:
        first: (N, 2) pixels, at least four.
        second: (N, 2).
    """
    scaled, norms = [], []
    for points in (first, second):
        centre = points.mean(axis=0)
        size = max(float(np.sqrt(((points - centre) ** 2).sum(axis=1).mean() / 2)), 1e-9)
        norms.append(np.array([[1 / size, 0, -centre[0] / size], [0, 1 / size, -centre[1] / size],
                               [0, 0, 1]]))  # fmt: skip
        scaled.append((points - centre) / size)
    (x, y), (u, v) = scaled[0].T, scaled[1].T
    one, nil = np.ones_like(x), np.zeros_like(x)
    rows = np.concatenate(
        [
            np.column_stack([x, y, one, nil, nil, nil, -u * x, -u * y, -u]),
            np.column_stack([nil, nil, nil, x, y, one, -v * x, -v * y, -v]),
        ]
    )
    middle = np.linalg.eigh(rows.T @ rows)[1][:, 0].reshape(3, 3)
    return np.asarray(np.linalg.inv(norms[1]) @ middle @ norms[0])


def apply_homography(homography: Array, pixels: Array) -> Array:
    """Pixels (N, 2) through a homography; NaN at and beyond its horizon."""
    moved = np.column_stack([pixels, np.ones(len(pixels))]) @ homography.T
    middle = np.array([*pixels.mean(axis=0), 1.0]) @ homography.T
    ahead = moved[:, 2] * middle[2] > 0
    w = np.where(ahead, moved[:, 2], np.nan)
    return moved[:, :2] / w[:, None]


def verify(task: PairTask, seen: tuple[Array, Array], matches: Matches) -> PairMatches:
    """What one geometry explains of matches of features that the model's cameras see at `seen`."""
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = task.seed
    # COLMAP's 100 are too many: its confidence of 0.999 asks for more where one in four is wrong.
    options.ransac.min_num_trials = 30
    # A strip's overlap lies along the border and moves by one shift, as a watermark would.
    options.detect_watermark = False
    if len(matches) < options.min_num_inliers:
        return PairMatches(matches=matches[:0], geometry=None)
    geometry = pycolmap.estimate_two_view_geometry(
        pycolmap.Camera(task.cameras[0]),
        seen[0],
        pycolmap.Camera(task.cameras[1]),
        seen[1],
        matches,
        options,
    )
    if len(geometry.inlier_matches) < options.min_num_inliers:
        return PairMatches(matches=matches[:0], geometry=None)
    return PairMatches(
        matches=np.asarray(geometry.inlier_matches, np.uint32),
        geometry={
            "config": int(geometry.config),
            **{k: _matrix(getattr(geometry, k)) for k in ("E", "F", "H")},
        },
    )


def as_seen(pixels: Array, warp: PinholeWarp | None) -> Array:
    """Pixels (N, 2) as the camera of the model sees them.

    A feature without an ideal pixel, beyond the reach of the lens model, is put at (-1e6, -1e6),
    where no geometry explains it.
    """
    if warp is None:
        return pixels
    ideal = warp.to_pinhole(pixels)
    return np.where(np.isfinite(ideal).all(axis=1, keepdims=True), ideal, -1e6)


def _matrix(value: Any) -> Array | None:
    return None if value is None else np.asarray(value, dtype=np.float64)
