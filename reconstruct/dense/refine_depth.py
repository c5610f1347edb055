"""Depth made exact where several pictures look alike: multi-view least-squares matching.

All neighbours are warped onto the reference through its present depth map, pixel by pixel, so that
windows follow slopes and bends of the surface. What then differs between warped and reference is
explained by one correction of the inverse depth in a window around each pixel (Lucas & Kanade 1981,
"An iterative image registration technique"), the same for all neighbours: each sees it along its
own epipolar line. Sums over windows are filters over the picture, so that the work does not depend
on the window's size (Le Besnerais & Champagnat 2005, "Dense optical flow by iterative local window
registration"). The correction is repeated where it is large.

The same sums show how sure a depth is: the curvature of the misfit along the inverse depth, and
the noise that remains between pictures.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.block_solver import MAD_TO_SIGMA
from alice_survey.core.compiled import compiled
from alice_survey.core.frames import Array
from reconstruct.pictures.undistorted import spline_nodes, spline_weights
from reconstruct.views.model import View
from reconstruct.views.range_shift import FAST, KernelLens, line_of, warped_at

Float32 = NDArray[np.float32]
Share = tuple[int, int, int, int]
"""The pixels that a kernel works on: first row, step to the next, first column, step."""
ALL: Share = (0, 1, 0, 1)

_CONTRAST_SIGMA_PX = 8.0
"""Sigma of the Gaussian window in which pictures are brought to zero mean and unit contrast."""
_QUARTER = 4
_MIN_CONTRAST = 1.5
"""Grey levels of noise that are not blown up to full contrast."""
WINDOW_SIGMA_PX = 1.25
"""Sigma of the Gaussian window that is compared. Wider ones blur the surface, narrower ones are
noisier; the noise is averaged when views are fused, the blur is not."""
_CONVERGED_PX = 0.5
"""A first step below this lands so near that a second round does not lower the error."""
_WINDOW_PX = 9
"""Side of the square that holds what counts in the Gaussian window."""
_STEP_WINDOW_PX = 5
_STEP_PX = 4.0
"""Change of disparity in that square from which on a window mixes near and far."""
_NONE = np.float32(1e6)
_ALIKE = 0.5
"""Correlation from which two windows look alike."""
_MIN_SHARE = 0.4
"""Share of a window's weight that a neighbour must see."""
_OUTLYING = 2.5
"""Deviations beyond which a pixel counts less than half."""
_BAND_PIXELS = 500_000
"""Pixels of a picture that are worked on at once: they take some 0.1 kB each."""
_MARGIN_ROWS = 16
"""Rows around a band that its windows reach: twice 5 for sums, and 4 around what moves far."""
_MIN_UNSEEN = 0.005
"""Share of a band that no other station sees, from which its own station's pictures are asked."""
_MAX_STEP_PX = 1.0
"""Longest step of a round, along the epipolar line of the neighbour that moves most."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ComparedView:
    """A picture ready to be compared."""

    view: View
    contrast: Float32
    """(H, W) grey levels of zero mean and unit variance around every pixel."""
    spline: Float32
    """(H, W) coefficients of the cubic B-spline through it."""
    valid: NDArray[np.bool_]
    """(H, W) which pixels may be used."""


def prepare(
    grey: NDArray[np.uint8], valid: NDArray[np.bool_]
) -> tuple[Float32, Float32, NDArray[np.bool_]]:
    """Contrast, spline and validity of a picture (H, W), as `ComparedView` has them."""
    level = grey.astype(np.float32)
    rest: Float32 = level - _level(level)
    variance = _level(rest * rest) + np.float32(_MIN_CONTRAST**2)
    contrast = rest * (variance ** np.float32(-0.5))
    return contrast, spline_nodes(contrast), valid


def _level(picture: Float32) -> Float32:
    """Means in the window of contrast, of a picture at a quarter of its size: they are smooth."""
    size = [max(1, -(-side // _QUARTER)) for side in picture.shape[::-1]]
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    small = _blur(small, _CONTRAST_SIGMA_PX / _QUARTER)
    return np.asarray(cv2.resize(small, picture.shape[::-1], interpolation=cv2.INTER_LINEAR))


def _blur(picture: Float32, sigma_px: float) -> Float32:
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), sigma_px, borderType=cv2.BORDER_REFLECT))


@compiled(error_model="numpy", fastmath=FAST)
def pixel_lines(lens: KernelLens, height: int, width: int, top: int = 0) -> Float32:
    """Lines on which the spots of a view's pixels lie, (H, W, 4), from a row of it on.

    Slopes x/z, y/z at an inverse depth of zero, and how they change with it.
    """
    pinhole, field, inverse_working = lens
    lines = np.empty((height, width, 4), np.float32)
    for row in range(height):
        for column in range(width):
            line = line_of(pinhole, field, inverse_working, column + 0.5, top + row + 0.5)
            for k in range(4):
                lines[row, column, k] = line[k]
    return lines


@compiled(error_model="numpy", fastmath=FAST)
def compare(
    share: Share, inverse_depth: Float32, reference: Float32, lines: Float32, spline: Float32,
    valid: NDArray[np.bool_], other_lens: KernelLens, other_from_ref: Array, rest: Float32,
    slope: Float32, speed: Float32,
) -> None:  # fmt: skip
    """Warp a neighbour onto the reference through its depth.

    Args:
        share: which pixels.
        inverse_depth: (H, W) along the reference's axis, NaN where unknown.
        reference: (H, W) contrast.
        lines: (H, W, 4) of the reference, see `pixel_lines`.
        spline: (h, w) B-spline coefficients of the neighbour's contrast.
        valid: (h, w) of the neighbour.
        other_lens: of the neighbour.
        other_from_ref: (3, 4) transform of points.
        rest: (H, W), to be filled with reference minus warped neighbour, NaN where it does not see
            the spot.
        slope: (H, W), with the warped neighbour's change per unit of inverse depth.
        speed: (H, W), with how many of its pixels one unit moves.
    """
    height, width = inverse_depth.shape
    rows, columns = spline.shape
    pinhole, field, inverse_working = other_lens
    t = other_from_ref
    for row in range(share[0], height, share[1]):
        for column in range(share[2], width, share[3]):
            rest[row, column] = slope[row, column] = speed[row, column] = np.float32(np.nan)
            w = inverse_depth[row, column]
            if not w > 0.0:
                continue
            x = lines[row, column, 0] + w * lines[row, column, 2]
            y = lines[row, column, 1] + w * lines[row, column, 3]
            a = t[0, 0] * x + t[0, 1] * y + t[0, 2]
            b = t[1, 0] * x + t[1, 1] * y + t[1, 2]
            c = t[2, 0] * x + t[2, 1] * y + t[2, 2]
            deep = c + w * t[2, 3]
            if deep <= 0.0:
                continue
            inverse = 1.0 / deep
            u = pinhole[0] * (a + w * t[0, 3]) * inverse + pinhole[2]
            v = pinhole[1] * (b + w * t[1, 3]) * inverse + pinhole[3]
            u, v = warped_at(field, inverse_working, u, v, w * inverse)
            u -= 0.5
            v -= 0.5
            j, i = int(math.floor(u)), int(math.floor(v))  # noqa: RUF046 (a float on a GPU)
            if j < 1 or i < 1 or j >= columns - 2 or i >= rows - 2:
                continue
            if not (valid[i, j] and valid[i + 1, j + 1] and valid[i, j + 1] and valid[i + 1, j]):
                continue
            p, q = np.float32(u - j), np.float32(v - i)
            (a0, a1, a2, a3), (b0, b1, b2, b3) = spline_weights(p)
            across, changes = spline_weights(q)
            value, right, down = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for m in range(4):
                k = i - 1 + m
                c0, c1 = spline[k, j - 1], spline[k, j]
                c2, c3 = spline[k, j + 1], spline[k, j + 2]
                line = a0 * c0 + a1 * c1 + a2 * c2 + a3 * c3
                value += across[m] * line
                down += changes[m] * line
                right += across[m] * (b0 * c0 + b1 * c1 + b2 * c2 + b3 * c3)
            scale = inverse * inverse
            du = pinhole[0] * (t[0, 3] * c - a * t[2, 3]) * scale
            dv = pinhole[1] * (t[1, 3] * c - b * t[2, 3]) * scale
            rest[row, column] = reference[row, column] - value
            slope[row, column] = right * du + down * dv
            speed[row, column] = math.sqrt(du * du + dv * dv)


class RefinedDepth(NamedTuple):
    """Depth of a view where pictures agree, arrays of (H, W)."""

    depth: Float32
    """Depth; NaN where unknown, or where no neighbour looks alike."""
    sigma: Float32
    """Standard deviation from what differs between the pictures, NaN where unknown."""
    seen: NDArray[np.uint8]
    """How many neighbours look alike there."""


class _NeighbourSums(NamedTuple):
    """What all neighbours say of a correction of the inverse depth, (H, W) each."""

    pull: Float32
    curvature: Float32
    speed: Float32
    """Pixels per unit of inverse depth, of the neighbour that moves most."""
    likeness: Float32
    """Correlation of the window with its neighbours, their mean weighted as they were used."""
    seen: NDArray[np.uint8]


class Device:
    """What works on all pixels of a view: the processor, with arrays of numpy.

    Another device has arrays of its own (of type `Any` here).
    """

    def put(self, values: Any) -> Any:
        """An array, or a tuple of arrays, numbers and tuples, as the device takes it."""
        return values

    def get(self, array: Any) -> NDArray[Any]:
        """An array of the device."""
        return np.asarray(array)

    def empty(self, *shape: int) -> Any:
        """An array of 32-bit floats."""
        return np.empty(shape, np.float32)

    def run(self, kernel: Callable[..., None], _: tuple[int, ...], *arguments: Any) -> None:
        """Run a kernel that takes its share of (H, W) pixels, then these arguments."""
        kernel(ALL, *arguments)

    def blur(self, planes: Any, sigma_px: float) -> Any:
        """Planes (N, H, W), each as `_blur` gives it."""
        for plane in planes:
            plane[:] = _blur(plane, sigma_px)
        return planes


PROCESSOR = Device()


_Look = tuple[View, Any]
"""A neighbour, and its spline, its validity and its lens as arrays of the device."""


def _look(other: ComparedView, device: Device) -> _Look:
    return other.view, device.put((other.spline, other.valid, other.view.kernel_lens))


class _Reference(NamedTuple):
    """Rows of a reference, with what all comparisons share as arrays of the device."""

    view: View
    valid: NDArray[np.bool_]
    device: Device
    contrast: Any
    lines: Any
    spread: Any
    """Variance of the contrast in a window."""


def _reference(reference: ComparedView, rows: slice, device: Device) -> _Reference:
    contrast = reference.contrast[rows]
    lines = pixel_lines(reference.view.kernel_lens, *contrast.shape, rows.start)
    mean = _blur(contrast, WINDOW_SIGMA_PX)
    spread = _blur(contrast * contrast, WINDOW_SIGMA_PX) - mean * mean
    on_device = device.put((contrast, lines, spread))
    return _Reference(reference.view, reference.valid[rows], device, *on_device)


def refine(
    reference: ComparedView, depth: Float32, sigma: Float32, others: Sequence[ComparedView],
    spare: Sequence[ComparedView] = (), device: Device = PROCESSOR,
) -> RefinedDepth:  # fmt: skip
    """Correct a depth map by all neighbours at once.

    A window that holds a step of the surface has no single correction: there the depth and its
    deviation stay as they were. Rows are worked on in bands, so that memory does not grow with the
    picture.

    Args:
        reference: whose depth it is.
        depth: (H, W) along its axis, NaN where unknown.
        sigma: (H, W) of the depth.
        others: neighbours to compare with.
        spare: those to compare with where none of the others sees the spot.
        device: what compares them.
    """
    height, width = depth.shape
    count = -(-height * width // _BAND_PIXELS)
    ends = np.linspace(0, height, count + 1).astype(int).tolist()
    looks, more = ([_look(other, device) for other in views] for views in (others, spare))
    bands = []
    for first, last in pairwise(ends):
        part = slice(max(first - _MARGIN_ROWS, 0), last + _MARGIN_ROWS)
        inner = slice(first - part.start, last - part.start)
        rows = _reference(reference, part, device)
        band = _refine_band(rows, depth[part], sigma[part], looks, more)
        bands.append([values[inner] for values in band])
    return RefinedDepth(*map(np.concatenate, zip(*bands, strict=True)))


def _refine_band(
    one: _Reference, depth: Float32, sigma: Float32, others: Sequence[_Look], spare: Sequence[_Look]
) -> RefinedDepth:
    inverse = (1.0 / depth).astype(np.float32)
    first = _sums_of(one, inverse, others, spare)
    moved, step_px = _step(inverse, first)
    sums = first
    far = (step_px > _CONVERGED_PX).astype(np.uint8)
    if far.any():  # elsewhere a second round would change little
        window = np.ones((_WINDOW_PX, _WINDOW_PX), np.uint8)
        part = np.where(cv2.dilate(far, window) > 0, moved, np.float32(np.nan))
        second = _sums_of(one, part, others, spare)
        again = np.isfinite(part) & (second.curvature > 0)
        sums = _choose(again, second, first)
        moved = np.where(again, _step(part, second)[0], moved)
    alike = (sums.curvature > 0) & (sums.likeness >= _ALIKE)
    kept = alike & _has_step(inverse, first.speed)
    unknown = np.float32(np.nan)
    refined: Float32 = np.where(alike & ~kept, np.float32(1.0) / moved, unknown)
    root: Float32 = np.sqrt(np.where(alike, sums.curvature, unknown))
    return RefinedDepth(
        depth=np.where(kept, depth, refined),
        sigma=np.where(kept, sigma, refined * refined / root),
        seen=sums.seen,
    )


def _has_step(inverse: Float32, speed: Float32) -> NDArray[np.bool_]:
    """Where known inverse depths in a window differ by much, in pixels of the farthest move."""
    known, span = known_span(inverse, _STEP_WINDOW_PX)
    return np.asarray(known & (span * speed > _STEP_PX))


def known_span(values: Float32, side: int) -> tuple[NDArray[np.bool_], Float32]:
    """Which values (H, W) are known, and the span of those known in a square of a side around."""
    known, window = np.isfinite(values), np.ones((side, side), np.uint8)
    high = cv2.dilate(np.where(known, values, -_NONE), window)
    return known, high - cv2.erode(np.where(known, values, _NONE), window)


def _choose(mask: NDArray[np.bool_], yes: _NeighbourSums, no: _NeighbourSums) -> _NeighbourSums:
    pairs: list[Any] = list(zip(yes, no, strict=True))
    return _NeighbourSums(*(np.where(mask, *both) for both in pairs))


def _step(inverse: Float32, sums: _NeighbourSums) -> tuple[Float32, Float32]:
    """Inverse depths moved to where the pictures agree best, and by how many pixels at most.

    Where little pulls they are held back, by a prior of one pixel's deviation along the longest
    epipolar line.
    """
    fast = np.maximum(sums.speed, np.float32(1e-6))
    reach = _MAX_STEP_PX / fast
    step: Float32 = np.clip(sums.pull / (sums.curvature + fast * fast), -reach, reach)
    return inverse + step, np.abs(step) * sums.speed


def _sums_of(
    one: _Reference, inverse: Float32, others: Sequence[_Look], spare: Sequence[_Look]
) -> _NeighbourSums:
    """What the others say, and where none of them sees a spot what the spare ones say."""
    sums = _sums(one, inverse, others)
    unseen = np.isfinite(inverse) & ~(sums.curvature > 0)
    if not spare or unseen.mean() < _MIN_UNSEEN:
        return sums
    alone = _sums(one, np.where(unseen, inverse, np.float32(np.nan)), spare)
    return _choose(unseen, alone, sums)


def _sums(one: _Reference, inverse: Float32, others: Sequence[_Look]) -> _NeighbourSums:
    device, shape = one.device, inverse.shape
    totals = device.put((*np.zeros((4, *shape), np.float32), np.zeros(shape, np.uint8)))
    depths = device.put(inverse)
    samples = np.float32(4.0 * np.pi * WINDOW_SIGMA_PX**2)  # one over the sum of squared weights
    for view, look in others:
        other_from_ref = view.world_from_cam.inv() * one.view.world_from_cam
        move = device.put(np.ascontiguousarray(other_from_ref.as_matrix()[:3]))
        there, slope, fast = (device.empty(*shape) for _ in range(3))
        shared = depths, one.contrast, one.lines
        device.run(compare, shape, *shared, *look, move, there, slope, fast)
        rest = device.get(there)
        known = np.isfinite(rest) & one.valid
        sample = rest[::3, ::3][known[::3, ::3]]
        if sample.size == 0:
            continue
        noise = max(np.float32(MAD_TO_SIGMA * np.median(np.abs(sample))), np.float32(1e-3))
        used = device.put(known)
        products, outlying = device.empty(6, *shape), noise * np.float32(_OUTLYING)
        device.run(weigh, shape, there, slope, used, outlying, products)
        products = device.blur(products, WINDOW_SIGMA_PX)
        device.run(add, shape, products, one.spread, fast, used, noise, samples, *totals)
    pull, curvature, speed, likeness, seen = map(device.get, totals)
    with np.errstate(invalid="ignore"):
        likeness = likeness / curvature
    return _NeighbourSums(pull, curvature, speed, likeness, seen)


@compiled(error_model="numpy", fastmath=FAST)
def weigh(
    share: Share, rest: Float32, slope: Float32, known: NDArray[np.bool_], outlying: float,
    products: Float32,
) -> None:  # fmt: skip
    """Weights, falling with the square of what is left (Cauchy), and weighted products.

    Args:
        share: which pixels.
        rest: (H, W) what is left.
        slope: (H, W) change per unit of inverse depth.
        known: (H, W) where these are known.
        outlying: what is left at which the weight is one half.
        products: (6, H, W), to be filled with the weight and, each times it, rest, slope,
            rest x slope, slope squared, rest squared; zero where unknown.
    """
    height, width = rest.shape
    for row in range(share[0], height, share[1]):
        for column in range(share[2], width, share[3]):
            w, a, b = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            if known[row, column]:
                a, b = rest[row, column], slope[row, column]
                w = 1.0 / (1.0 + (a / outlying) ** 2)
            products[0, row, column] = w
            products[1, row, column], products[2, row, column] = w * a, w * b
            products[3, row, column], products[4, row, column] = w * a * b, w * b * b
            products[5, row, column] = w * a * a


@compiled(error_model="numpy", fastmath=FAST)
def add(
    share: Share, products: Float32, spread: Float32, fast: Float32, known: NDArray[np.bool_],
    noise: float, samples: float, pull: Float32, curvature: Float32, speed: Float32,
    likeness: Float32, seen: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Add one neighbour's normal equations to the totals, each over the variance it leaves.

    Means over the window are taken out, so that brightness does not count; a window that hardly
    looks alike (occluded, moved) counts little.

    Args:
        share: which pixels.
        products: (6, H, W) of `weigh`, blurred.
        spread: (H, W) variance of the reference's contrast in the window.
        fast: (H, W) pixels per unit of inverse depth.
        known: (H, W) where the neighbour sees the spot.
        noise: standard deviation of what is left.
        samples: independent pixels in the window.
        pull: (H, W) total; this and the next are added to.
        curvature: (H, W) total.
        speed: (H, W) largest.
        likeness: (H, W) total.
        seen: (H, W) total.
    """
    height, width = known.shape
    for row in range(share[0], height, share[1]):
        for column in range(share[2], width, share[3]):
            weight = products[0, row, column]
            if not known[row, column] or weight < _MIN_SHARE:
                continue
            r, g, rg = products[1, row, column], products[2, row, column], products[3, row, column]
            cross = rg - r * g / weight
            square = products[4, row, column] - g * g / weight
            misfit = products[5, row, column] / weight - (r / weight) ** 2
            alike = 1.0 - 0.5 * misfit / max(spread[row, column], 1e-3)
            trust = min(max(alike, 0.05), 1.0)
            certainty = samples * trust * trust / max(misfit, 0.1 * noise * noise)
            pull[row, column] += certainty * cross
            curvature[row, column] += certainty * square
            likeness[row, column] += certainty * square * alike
            speed[row, column] = max(speed[row, column], fast[row, column])
            if alike >= _ALIKE:
                seen[row, column] += 1
