"""Positions of features made consistent along their tracks, to a few hundredths of a pixel.

SIFT places each feature by itself, with an error of a quarter pixel or more. What the mapping needs
is that all pictures of a track mean the same spot. So one observation of every track is
its reference, and the patch around it is aligned in all other pictures of the track by least
squares (Gruen 1985), in the inverse compositional form (Baker & Matthews 2004): an affine warp with
a gain and an offset of the grey level. The warp starts from the matches around. Where lenses and
ports are known it also bends as these do: an affine warp alone would put the patch off by half the
bend times the patch's mean square radius, alike at one place of all pictures (0.01 px, a focal
length wrong by 60 ppm).
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from alice_survey.core.block_solver import solve_symmetric
from alice_survey.core.compiled import compiled
from alice_survey.core.executor import Executor
from alice_survey.core.frames import Array
from camera_calib.approximation.pinhole_warp import PinholeWarp
from reconstruct.matching.matches import Matches
from reconstruct.views.range_shift import FAST

_RADIUS = 7
"""Radius of a patch, pixels."""
_SIGMA = 5.0
"""Sigma of the weight that falls towards the border of a patch, pixels."""
_STEPS = 12
_SETTLED_PX = 0.005
_MAX_PX = 3.0
"""A position that would move by more has found something else, and stays."""
_MIN_CORRELATION = 0.7
_LEVELS = 3
"""Pictures tried: the whole, its half and its quarter."""
_MIN_SUPPORT = 6
_SUPPORT = 12
"""Matches around a feature from which its first affine warp is estimated."""
_BEND_STEP_PX = 4.0
_UNKNOWNS = 10
"""Shift, affine change, gain, the gain's two slopes, offset."""


@dataclass(frozen=True, eq=False)
class _Partner:
    """Features of one picture whose references all lie in another."""

    grey: Path
    nodes: NDArray[np.int64]
    """(N,) numbers of the features over all pictures."""
    reference: Array
    """(N, 2) pixels in the picture of the references."""
    pixels: Array
    """(N, 2) pixels."""
    support: tuple[Array, Array]
    """(M, 2) pixels of verified matches, in the picture of the references and in this one."""
    warps: tuple[PinholeWarp, PinholeWarp] | None
    """Pinholes of the two pictures' cameras; None where they are not known."""


_Pair = tuple[int, int, Matches]
_TrackTask = tuple[Path, Sequence[_Partner]]
"""A picture that has references, and their partners."""


def refine_tracks(
    pixels: Sequence[Array], greys: Sequence[Path], pairs: Sequence[_Pair],
    warps: Sequence[PinholeWarp], *, executor: Executor,
) -> list[Array]:  # fmt: skip
    """Align every observation of a track with the track's reference.

    The reference is the observation that was matched with most others. An observation stays where
    it is if its patch does not resemble that of the reference, or would move far.

    Args:
        pixels: features of every picture, (N, 2).
        greys: files of the evened pictures, (H, W) bytes as `numpy.save` writes them.
        pairs: indices of two pictures and (K, 2) verified matches.
        warps: the pinhole of every picture's camera; empty where cameras are not known.
        executor: where tasks run.

    Returns:
        Pixels of all features by picture, (N, 2), moved or not.
    """
    starts = np.concatenate([[0], np.cumsum([len(p) for p in pixels])]).astype(np.int64)
    reference = track_references(pairs, starts)
    tasks = _tasks(pixels, starts, reference, pairs, greys, warps)
    together = np.concatenate([np.zeros((0, 2)), *pixels])
    for nodes, found in executor.map(align, tasks, label="sub-pixel positions"):
        good = np.isfinite(found[:, 0])
        together[nodes[good]] = found[good]
    return [together[a:b] for a, b in itertools.pairwise(starts)]


def track_references(pairs: Sequence[_Pair], starts: NDArray[np.int64]) -> NDArray[np.int64]:
    """The reference of each feature: that of its track with most direct matches, first of equals.

    Args:
        pairs: indices of two pictures and matches.
        starts: (P + 1,) number of the first feature of every picture, features counted over all.

    Returns:
        (N,) numbers; a feature without a match is its own reference.
    """
    count = int(starts[-1])
    links = [m.astype(np.int64) + starts[[i, j]] for i, j, m in pairs]
    edges = np.concatenate([np.zeros((0, 2), np.int64), *links])
    degree = np.bincount(edges.ravel(), minlength=count)
    graph = coo_array((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), (count, count))
    label = connected_components(graph, directed=False)[1]
    order = np.lexsort((np.arange(count), -degree, label))
    first = np.flatnonzero(np.r_[True, np.diff(label[order]) != 0][:count])
    return order[first][label].astype(np.int64)


def _tasks(
    pixels: Sequence[Array], starts: NDArray[np.int64], reference: NDArray[np.int64],
    pairs: Sequence[_Pair], greys: Sequence[Path], warps: Sequence[PinholeWarp],
) -> list[_TrackTask]:  # fmt: skip
    """One task for each picture that has references."""
    picture = np.searchsorted(starts, np.arange(len(reference)), side="right") - 1
    of_reference = picture[reference]
    nodes = np.flatnonzero(picture != of_reference)
    nodes = nodes[np.lexsort((picture[nodes], of_reference[nodes]))]
    picture, of_reference = picture[nodes], of_reference[nodes]
    matched = {(i, j): m for i, j, m in pairs}
    changes = np.flatnonzero((np.diff(picture) != 0) | (np.diff(of_reference) != 0)) + 1
    partners: dict[int, list[_Partner]] = {}
    for members in np.split(np.arange(len(nodes)), changes):
        if not len(members):
            continue
        r, j = int(of_reference[members[0]]), int(picture[members[0]])
        mine = nodes[members]
        at = pixels[r][reference[mine] - starts[r]], pixels[j][mine - starts[j]]
        support = at
        if (min(r, j), max(r, j)) in matched:
            pair = matched[min(r, j), max(r, j)]
            own, other = pair.T if r < j else pair[:, ::-1].T
            support = pixels[r][own], pixels[j][other]
        if len(support[0]) >= _MIN_SUPPORT:
            partners.setdefault(r, []).append(
                _Partner(greys[j], mine, *at, support, (warps[r], warps[j]) if warps else None)
            )
    return [(greys[r], partners[r]) for r in sorted(partners)]


def align(task: _TrackTask) -> tuple[NDArray[np.int64], Array]:
    """Numbers of features and their aligned positions (N, 2); NaN where they are to stay."""
    grey, partners = task
    first = np.asarray(np.load(grey, mmap_mode="c"))
    found = []
    for partner in partners:
        second = np.asarray(np.load(partner.grey, mmap_mode="c"))
        affine = affine_from_neighbours(*partner.support, partner.reference)
        at, bend = (partner.reference, partner.pixels), np.zeros((len(affine), 2, 3))
        if partner.warps is not None:
            known = [bends(warp, pixels) for warp, pixels in zip(partner.warps, at, strict=True)]
            bend = bend_between(known[0], known[1], affine)
        found.append(align_coarser(first, second, *at, affine, bend))
    return np.concatenate([p.nodes for p in partners]), np.concatenate(found)


def bends(warp: PinholeWarp, at: Array) -> Array:
    """Second derivatives (N, 2, 2, 2) of a pinhole's pixels by those taken, in pixels taken.

    The last two axes are the directions. Where the camera sees nothing around, it bends nothing.
    """
    x, y = _BEND_STEP_PX * np.eye(2)
    middle, *away = (warp.to_pinhole(at + by) for by in (0.0 * x, x, -x, y, -y, x + y, -x - y))
    slopes = 0.5 * np.stack([away[0] - away[1], away[2] - away[3]], axis=-1)
    xx, yy, both = (away[k] + away[k + 1] - 2.0 * middle for k in (0, 2, 4))
    second = np.stack([xx, 0.5 * (both - xx - yy), 0.5 * (both - xx - yy), yy], axis=-1)
    known, found = np.isfinite(second).all(axis=(1, 2)), np.zeros((len(at), 2, 4))
    found[known] = np.linalg.solve(slopes[known], second[known]) / _BEND_STEP_PX
    return found.reshape(-1, 2, 2, 2)


def bend_between(first: Array, second: Array, affine: Array) -> Array:
    """Terms (N, 2, 3) of u^2, uv and v^2 in the warp from one picture to another.

    Args:
        first: (N, 2, 2, 2) of `bends`.
        second: the same of the other picture.
        affine: (N, 2, 2) slopes of the warp.
    """
    bend = np.einsum("nij,njkl->nikl", affine, first)
    bend -= np.einsum("nipq,npk,nql->nikl", second, affine, affine)
    return np.asarray(bend.reshape(-1, 2, 4)[..., [0, 1, 3]] * [0.5, 1.0, 0.5])


def align_coarser(
    first: Any, second: Any, reference: Array, pixels: Array, affine: Array, bend: Array
) -> Array:
    """As `align_patches`; what fails is tried again on halved pictures, and again on halved ones.

    Noisy and blurred pictures show little within a few pixels: wider patches there are alike.
    """
    found = np.full(pixels.shape, np.nan)
    for level in range(_LEVELS):
        open_ = np.isnan(found[:, 0])
        if not open_.any():
            break
        if level:
            first, second = (cv2.pyrDown(p) for p in (first, second))
        # the halves' first pixel is centred on that of the whole
        scale = 2.0**level
        start, guess = ((p[open_] - 0.5) / scale + 0.5 for p in (reference, pixels))
        places = map(np.ascontiguousarray, (start, guess, affine[open_], scale * bend[open_]))
        moved = align_patches(first, second, *places)
        found[open_] = (moved - 0.5) * scale + 0.5
    return found


def affine_from_neighbours(first: Array, second: Array, at: Array) -> Array:
    """Affine maps, (N, 2, 2), that the matches around places of the first picture agree on best.

    Args:
        first: (M, 2) pixels of matches in the first picture.
        second: (M, 2) in the second.
        at: (N, 2) places in the first picture.
    """
    around = KDTree(first).query(at, k=min(_SUPPORT, len(first)))[1].reshape(len(at), -1)
    source, target = (p[around] - p[around].mean(axis=1, keepdims=True) for p in (first, second))
    square = np.einsum("nki,nkj->nij", source, source)
    # where neighbours are in one line they give nothing across it: there nothing is stretched
    square += np.eye(2) * (1e-3 * np.trace(square, axis1=1, axis2=2)[:, None, None] + 1e-6)
    mixed = np.einsum("nki,nkj->nij", source, target)
    solved: Array = np.linalg.solve(square, mixed).transpose(0, 2, 1)
    return np.ascontiguousarray(solved)


_NEXT = np.uint64(1)


@compiled(error_model="numpy", fastmath=FAST)
def _across(picture: Any, left: Any, row: Any, a: float, b: float, c: float, d: float) -> float:
    """Four pixels of a row, weighted."""
    level: float = a * picture[row, left] + b * picture[row, left + _NEXT]
    left += _NEXT + _NEXT
    level += c * picture[row, left] + d * picture[row, left + _NEXT]
    return level


@compiled(error_model="numpy", fastmath=FAST)
def _cubic_level(picture: Any, x: float, y: float) -> float:
    """Grey level by cubic convolution (Keys 1981); the first pixel's centre is 0, 0."""
    column, row = math.floor(x), math.floor(y)
    p, q = x - column, y - row
    a = ((-0.5 * p + 1.0) * p - 0.5) * p
    b = (1.5 * p - 2.5) * p * p + 1.0
    c = ((-1.5 * p + 2.0) * p + 0.5) * p
    d = (0.5 * p - 0.5) * p * p
    left, top = np.uint64(column - 1), np.uint64(row - 1)  # unsigned: never counted from the end
    level = (((-0.5 * q + 1.0) * q - 0.5) * q) * _across(picture, left, top, a, b, c, d)
    level += ((1.5 * q - 2.5) * q * q + 1.0) * _across(picture, left, top + _NEXT, a, b, c, d)
    top += _NEXT + _NEXT
    level += (((-1.5 * q + 2.0) * q + 0.5) * q) * _across(picture, left, top, a, b, c, d)
    level += ((0.5 * q - 0.5) * q * q) * _across(picture, left, top + _NEXT, a, b, c, d)
    return level


@compiled
def _is_inside(picture: Any, x: float, y: float, margin: float) -> bool:
    """Whether a place lies in a picture, this many pixels from its rim or more."""
    height, width = picture.shape
    return bool(margin <= x < width - margin - 1 and margin <= y < height - margin - 1)


@compiled(error_model="numpy", fastmath=FAST)
def _template(picture: Any, x: float, y: float, patch: Any, levels: Any, slopes: Any) -> None:
    """Grey levels of the reference's patch, and how they change with the unknowns."""
    side = 2 * _RADIUS + 3
    for i in range(side):
        for j in range(side):
            patch[i, j] = _cubic_level(picture, x + j - _RADIUS - 1, y + i - _RADIUS - 1)
    k = 0
    for i in range(1, side - 1):
        for j in range(1, side - 1):
            u, v = j - _RADIUS - 1.0, i - _RADIUS - 1.0
            gx = 0.5 * (patch[i, j + 1] - patch[i, j - 1])
            gy = 0.5 * (patch[i + 1, j] - patch[i - 1, j])
            levels[k] = patch[i, j]
            slopes[0, k], slopes[1, k] = gx, gy
            slopes[2, k], slopes[3, k] = gx * u, gx * v
            slopes[4, k], slopes[5, k] = gy * u, gy * v
            slopes[6, k], slopes[7, k] = patch[i, j], 1.0
            slopes[8, k], slopes[9, k] = patch[i, j] * u, patch[i, j] * v
            k += 1


@compiled(error_model="numpy", fastmath=FAST)
def _weighted_sum(weights: Any, slopes: Any, weighted: Any, square: Any) -> None:
    """Fill the weighted slopes, and the matrix of the normal equations."""
    count = len(weights)
    for n in range(_UNKNOWNS):
        for k in range(count):
            weighted[n, k] = weights[k] * slopes[n, k]
        for o in range(n + 1):
            total = 0.0
            for k in range(count):
                total += weighted[n, k] * slopes[o, k]
            square[n, o] = square[o, n] = total
    for n in range(_UNKNOWNS):
        # a patch without texture must not divide by zero; 1e-9 moves nothing else
        square[n, n] += 1e-9 * square[n, n] + 1e-9


@compiled(error_model="numpy", fastmath=FAST)
def _compare(
    picture: Any, x: float, y: float, m: Any, bend: Any, weights: Any, levels: Any, weighted: Any,
    seen: Any, right: Any,
) -> float:  # fmt: skip
    """Fill the right-hand side; the weighted correlation of the patches, -2 beyond the picture.

    Loops over the patch are one for each sum, so that they become vector instructions.
    """
    reach_x = _RADIUS * (abs(m[0, 0]) + abs(m[0, 1]) + _RADIUS * np.abs(bend[0]).sum())
    reach_y = _RADIUS * (abs(m[1, 0]) + abs(m[1, 1]) + _RADIUS * np.abs(bend[1]).sum())
    if not (
        _is_inside(picture, x - reach_x, y - reach_y, 2.0)
        and _is_inside(picture, x + reach_x, y + reach_y, 2.0)
    ):
        return -2.0
    k = 0
    for i in range(-_RADIUS, _RADIUS + 1):
        for j in range(-_RADIUS, _RADIUS + 1):
            at_x = x + (m[0, 0] + bend[0, 0] * j + bend[0, 1] * i) * j
            at_x += (m[0, 1] + bend[0, 2] * i) * i
            at_y = y + (m[1, 0] + bend[1, 0] * j + bend[1, 1] * i) * j
            at_y += (m[1, 1] + bend[1, 2] * i) * i
            seen[k] = _cubic_level(picture, at_x, at_y)
            k += 1
    for n in range(_UNKNOWNS):
        total = 0.0
        for k in range(len(seen)):
            total += weighted[n, k] * (seen[k] - levels[k])
        right[n, 0] = total
    total = sum_a = sum_b = sum_aa = sum_bb = sum_ab = 0.0
    for k in range(len(seen)):
        weight, a, b = weights[k], levels[k], seen[k]
        total += weight
        sum_a += weight * a
        sum_b += weight * b
        sum_aa += weight * a * a
        sum_bb += weight * b * b
        sum_ab += weight * a * b
    spread = (sum_aa - sum_a * sum_a / total) * (sum_bb - sum_b * sum_b / total)
    return float((sum_ab - sum_a * sum_b / total) / math.sqrt(max(spread, 1e-9)))


@compiled
def align_patches(
    first: Any, second: Any, reference: Any, pixels: Any, affine: Any, bend: Any
) -> Any:
    """Positions in the second picture of what the first shows at others.

    Args:
        first: (H, W) grey levels.
        second: (H2, W2) grey levels.
        reference: (N, 2) pixels of the first picture.
        pixels: (N, 2) first guesses in the second.
        affine: (N, 2, 2) how steps from `reference` map to steps from `pixels`.
        bend: (N, 2, 3) how squares of steps do, of `bend_between`.

    Returns:
        (N, 2); NaN where the patch leaves a picture, does not converge or does not resemble.
    """
    side = 2 * _RADIUS + 1
    count = side * side
    patch = np.empty((side + 2, side + 2))
    levels, seen, n = np.empty(count), np.empty(count), np.arange(count)
    away = (n % side - _RADIUS) ** 2 + (n // side - _RADIUS) ** 2
    weights = np.exp(-0.5 * away / (_SIGMA * _SIGMA))
    slopes, weighted = np.empty((_UNKNOWNS, count)), np.empty((_UNKNOWNS, count))
    square, right = np.empty((_UNKNOWNS, _UNKNOWNS)), np.empty((_UNKNOWNS, 1))
    m, step = np.empty((2, 2)), np.empty(6)
    found = np.full(pixels.shape, np.nan)
    for point in range(len(pixels)):
        x, y = reference[point, 0] - 0.5, reference[point, 1] - 0.5
        if not _is_inside(first, x, y, _RADIUS + 3.0):
            continue
        _template(first, x, y, patch, levels, slopes)
        _weighted_sum(weights, slopes, weighted, square)
        x, y = pixels[point, 0] - 0.5, pixels[point, 1] - 0.5
        m[:] = affine[point]
        settled = False
        for _ in range(_STEPS):
            own = bend[point]
            correlation = _compare(second, x, y, m, own, weights, levels, weighted, seen, right)
            if correlation < -1.5:
                break
            solved = solve_symmetric(square, right)
            gain = 1.0 + solved[6, 0]
            if not gain > 0.1:
                break
            for k in range(6):
                step[k] = solved[k, 0] / gain
            # the second picture shows the reference moved by `step`: undo that in the warp
            a, b, c, d = 1.0 + step[2], step[3], step[4], 1.0 + step[5]
            area = a * d - b * c
            if not area > 0.2:
                break
            for axis in range(2):
                e, f = m[axis, 0] / area, m[axis, 1] / area
                m[axis, 0], m[axis, 1] = e * d - f * c, f * a - e * b
            go_x = m[0, 0] * step[0] + m[0, 1] * step[1]
            go_y = m[1, 0] * step[0] + m[1, 1] * step[1]
            x, y = x - go_x, y - go_y
            away_x, away_y = x + 0.5 - pixels[point, 0], y + 0.5 - pixels[point, 1]
            if not away_x * away_x + away_y * away_y <= _MAX_PX * _MAX_PX:
                break
            if go_x * go_x + go_y * go_y < _SETTLED_PX * _SETTLED_PX:
                settled = correlation >= _MIN_CORRELATION
                break
        if settled:
            found[point, 0], found[point, 1] = x + 0.5, y + 0.5
    return found
