"""Matches between the features of two pictures, and the two-view geometry that vouches for them.

Descriptors are bytes, so that every dot product is a whole number below 2^24 and comes out of
float32 matrix products exactly: matches depend neither on the number of threads nor on the blocks.
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numba import njit
from numpy.typing import NDArray

from alice_survey.frames import Array
from reconstruct.lenses.lens import Lens
from reconstruct.matching.features import Features, load_features

Matches = NDArray[np.uint32]
_BLOCK = 1024
_COARSE_FEATURES = 800


@njit(cache=True)  # type: ignore[untyped-decorator]
def _best_two(
    products: Any, norms_a: Any, norms_b: Any, best: Any, first: Any, second: Any, best_b: Any,
    nearest_b: Any, offset: int,
) -> None:  # fmt: skip
    """Fold one block of products into the nearest neighbours of both sides.

    Rows of a get their nearest index and the two least squared distances; columns of b get their
    nearest row. The first of equals wins.
    """
    for i in range(products.shape[0]):
        row = offset + i
        least, next_least, index = first[row], second[row], best[row]
        for j in range(products.shape[1]):
            distance = norms_a[row] + norms_b[j] - 2.0 * products[i, j]
            if distance < least:
                next_least = least
                least = distance
                index = j
            elif distance < next_least:
                next_least = distance
            if distance < nearest_b[j]:
                nearest_b[j] = distance
                best_b[j] = row
        first[row], second[row], best[row] = least, next_least, index


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
    if not len(a) or len(b) < 2:
        return np.zeros((0, 2), np.uint32)
    left, right = a.astype(np.float32), b.astype(np.float32)
    norms_a, norms_b = (left**2).sum(axis=1), (right**2).sum(axis=1)
    best = np.zeros(len(a), np.int64)
    first = np.full(len(a), np.inf, np.float32)
    second = np.full(len(a), np.inf, np.float32)
    best_b = np.zeros(len(b), np.int64)
    nearest_b = np.full(len(b), np.inf, np.float32)
    for start in range(0, len(a), block):
        products = left[start : start + block] @ right.T
        _best_two(
            products, norms_a, norms_b, best, first, second, best_b, nearest_b, start
        )  # fmt: skip
    rows = np.arange(len(a))
    clear = first < ratio * ratio * second
    good = rows[clear & (best_b[best] == rows)]
    return np.stack([good, best[good]], axis=1).astype(np.uint32)


@dataclass(frozen=True, kw_only=True)
class PairTask:
    """Two pictures to match: files of their features, and cameras where they are to be verified."""

    first: Path
    second: Path
    ratio: float
    cameras: tuple[str, str] = ("", "")
    """COLMAP cameras as `camera_text` writes them; empty for a coarse look."""
    lenses: tuple[Lens | None, Lens | None] = (None, None)
    """What takes pixels to those of the cameras, where these are ideal pinholes."""
    seed: int = 0


@dataclass(frozen=True, kw_only=True, eq=False)
class PairMatches:
    """Verified matches of a pair."""

    matches: Matches
    """(K, 2) inliers."""
    geometry: dict[str, Any] | None
    """What COLMAP needs to know of the pair's geometry, or None where there is none."""


def _features(path: Path) -> Features:
    """Features from their file; those read last are kept, as long as their file is the same."""
    stat = path.stat()
    return _kept(path, stat.st_mtime_ns, stat.st_ino)


@lru_cache(maxsize=32)
def _kept(path: Path, _changed_ns: int, _inode: int) -> Features:
    return load_features(path)


def coarse_matches(task: PairTask) -> int:
    """How many of the first (largest) features of two pictures match: cheap, to choose pairs by."""
    first, second = (_features(p).descriptors[:_COARSE_FEATURES] for p in (task.first, task.second))
    return len(match_descriptors(first, second, task.ratio))


def camera_text(camera: pycolmap.Camera) -> str:
    """A COLMAP camera as text, for another process."""
    known = int(camera.has_prior_focal_length)
    values = " ".join(repr(float(p)) for p in camera.params)
    return f"{camera.model_name} {camera.width} {camera.height} {known} {values}"


def camera_from_text(text: str) -> pycolmap.Camera:
    """The inverse of `camera_text`."""
    model, width, height, known, *params = text.split()
    return pycolmap.Camera(
        model=model,
        width=int(width),
        height=int(height),
        params=[float(p) for p in params],
        has_prior_focal_length=known == "1",
    )


def match_pair(task: PairTask) -> PairMatches:
    """Match two pictures and keep what one two-view geometry explains."""
    a, b = _features(task.first), _features(task.second)
    matches = match_descriptors(a.descriptors, b.descriptors, task.ratio)
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = task.seed
    # A strip's overlap lies along the border and moves by one shift, as a watermark would.
    options.detect_watermark = False
    if len(matches) < options.min_num_inliers:
        return PairMatches(matches=matches[:0], geometry=None)
    geometry = pycolmap.estimate_two_view_geometry(
        camera_from_text(task.cameras[0]),
        as_seen(a.pixels, task.lenses[0]),
        camera_from_text(task.cameras[1]),
        as_seen(b.pixels, task.lenses[1]),
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


def as_seen(pixels: Array, lens: Lens | None) -> Array:
    """Pixels (N, 2) as the camera of the model sees them.

    A feature without an ideal pixel, beyond the reach of the lens model, is put at (-1e6, -1e6),
    where no geometry explains it.
    """
    if lens is None:
        return pixels
    ideal = lens.to_pinhole(pixels)
    return np.where(np.isfinite(ideal).all(axis=1, keepdims=True), ideal, -1e6)


def _matrix(value: Any) -> Array | None:
    return None if value is None else np.asarray(value, dtype=np.float64)
