"""Depth of single pixels by least-squares matching, with its standard deviation.

The patch around a pixel of the left picture is looked for in the right one at several depths, each
through both exact lenses and along the slope of the surface, brightness and contrast fitted. The
sum of squared differences is a parabola near its least value; its curvature and the scatter of what
remains at its bottom determine the standard deviation (Gruen 1985, "Adaptive least squares
correlation").
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from alice_survey.core.errors import ReconstructionError
from alice_survey.core.frames import Array
from camera_calib.approximation.pinhole_warp import PinholeWarp
from reconstruct.mesh.texture import remapped
from reconstruct.views.model import View

Float32 = NDArray[np.float32]
Sampler = Callable[[Array], Array]

_HALF_PX = 7
"""A patch has this many pixels to either side of its middle."""
_STEP_PX, _STEPS = 0.25, 5
"""Step of disparity between depths tried, and how many to either side."""
_FITTED = 3
"""Brightness, contrast and depth."""
_SLOPE_SIGMA_PX = 10.0
"""Sigma of the Gaussian that takes the slope of the surface from the depth map: wider than a patch,
so that the noise of the map does not bend it."""
_SPLINE = 5
_LAG_PX = 1
"""Residuals farther apart are independent: the noise of a picture as taken is white, and the spline
between its pixels joins neighbours only."""
_MIN_CORRELATION = 0.5
_MIN_SAMPLE = 20
_GROSS_SIGMAS = 5.0
_ROUNDS = 2


@dataclass(frozen=True, kw_only=True, eq=False)
class PreciseDepth:
    """Depth of N pixels; NaN where the pictures do not determine it."""

    depth: Array
    """(N,) before the left pinhole's centre."""
    sigma: Array
    """(N,) sigma from the noise of the pictures alone."""
    missed_sigmas: Array
    """(N,) how far the patches miss each other across the epipolar line; see `inflation`."""


def precise_depth(
    views: tuple[View, View],
    greys: tuple[Sampler, Sampler],
    depth_map: Float32,
    pixels: Array,
) -> PreciseDepth:
    """Refine the depth of pixels of the left view.

    Args:
        views: left and right.
        greys: what each view shows at pixels; see `sampler`.
        depth_map: (H, W) of the left view, NaN where unknown: start and slope.
        pixels: (N, 2) of the left view.
    """
    left, right = views
    steady = _smoothed(depth_map)
    start = at_pixels(steady, pixels)
    reach = np.arange(-_HALF_PX, _HALF_PX + 1.0)
    grid = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
    patch = pixels[:, None, :] + grid
    flat = patch.reshape(-1, 2)
    with np.errstate(invalid="ignore"):
        tilt = 1.0 / at_pixels(steady, flat).reshape(len(pixels), -1) - (1.0 / start)[:, None]
    tilt = np.where(np.isfinite(tilt), tilt, 0.0)
    shown = greys[0](flat).reshape(len(pixels), -1)
    weight = np.exp(-0.5 * (grid**2).sum(axis=1) / (0.5 * _HALF_PX) ** 2)
    inverse = 1.0 / start
    per_px, across = _epipolar(left, right, pixels, start)
    tried = _STEP_PX * np.arange(-_STEPS, _STEPS + 1.0)
    for _ in range(_ROUNDS):
        misfits, fits, rests = [], [], []
        for step in tried:
            at = inverse[:, None] + (step * per_px)[:, None] + tilt
            with np.errstate(divide="ignore", invalid="ignore"):
                seen = right.project(left.at_depth(flat, (1.0 / at).reshape(-1)))
            other = greys[1](seen).reshape(len(pixels), -1)
            rest, correlation = _compare(shown, other, weight)
            misfits.append((rest * rest) @ weight)
            fits.append(correlation)
            rests.append(rest.astype(np.float32))
        cost, likeness = np.stack(misfits, axis=1), np.stack(fits, axis=1)
        best = np.argmin(np.where(np.isfinite(cost), cost, np.inf), axis=1)
        inside = (best > 0) & (best < len(tried) - 1)
        middle = np.clip(best, 1, len(tried) - 2)
        rows = np.arange(len(pixels))
        a, b, c = (cost[rows, middle + k] for k in (-1, 0, 1))
        bend = (a - 2 * b + c) / 2
        with np.errstate(divide="ignore", invalid="ignore"):
            shift = np.where(bend > 0, (a - c) / (4 * bend), np.nan)
        inverse = inverse + (tried[middle] + shift * _STEP_PX) * per_px
        stack = np.stack(rests, axis=1)
        before, rest, after = (stack[rows, middle + k].astype(np.float64) for k in (-1, 0, 1))
        tried = _STEP_PX * np.arange(-1.0, 2.0)
    sigma_px = _sigma_px(before, rest, after, bend, weight)
    good = inside & (bend > 0) & (likeness.max(axis=1) >= _MIN_CORRELATION)
    depth = np.where(good, 1.0 / inverse, np.nan)
    sigma_px = np.where(good, sigma_px, np.nan)
    # the same across the epipolar line, where the true answer is known to be none
    with np.errstate(divide="ignore", invalid="ignore"):
        seen = right.project(left.at_depth(flat, (1.0 / (inverse[:, None] + tilt)).reshape(-1)))
    square = np.repeat(across, len(grid), axis=0)
    offset_rests = [
        _compare(
            shown,
            greys[1](seen + k * _STEP_PX * square).reshape(len(pixels), -1),
            weight,
        )[0]
        for k in (-1.0, 0.0, 1.0)
    ]
    a, b, c = ((r * r) @ weight for r in offset_rests)
    bend = (a - 2 * b + c) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        missed = (
            (a - c)
            / (4 * bend)
            * _STEP_PX
            / _sigma_px(offset_rests[0], offset_rests[1], offset_rests[2], bend, weight)
        )
    return PreciseDepth(
        depth=depth,
        sigma=sigma_px * np.abs(per_px) * depth * depth,
        missed_sigmas=np.where(good & (bend > 0), missed, np.nan),
    )


def inflation(found: PreciseDepth) -> float:
    """Factor by which the sigmas of many pixels are too small, at least 1.

    Aliasing and resampling leave errors that one patch cannot show. Across the epipolar line the
    true miss is the same for all (the calibration's): its scatter (rms, gross errors held back), in
    stated sigmas, gives it.

    Raises:
        ReconstructionError: too few pixels are matched.
    """
    missed = found.missed_sigmas[np.isfinite(found.missed_sigmas)]
    if len(missed) < _MIN_SAMPLE:
        raise ReconstructionError(
            f"only {len(missed)} of {len(found.depth)} sampled pixels match to a fraction of a "
            "pixel; the pair needs more light or texture"
        )
    away = np.minimum(np.abs(missed - np.median(missed)), _GROSS_SIGMAS)
    return max(1.0, float(np.sqrt(np.mean(away**2))))


def _sigma_px(before: Array, rest: Array, after: Array, bend: Array, weight: Array) -> Array:
    """Standard deviation (N,) of the place of the least misfit, px, from residuals (N, P)."""
    count = weight.sum() ** 2 / (weight**2).sum()
    with np.errstate(divide="ignore", invalid="ignore"):
        scatter = _scatter(weight * rest * 0.5 * (after - before))
        sigma: Array = np.sqrt(scatter * count / (count - _FITTED)) / bend * _STEP_PX
    return sigma


def sampler(taken: NDArray[np.uint8], warp: PinholeWarp, view: View) -> Sampler:
    """What a view, perhaps shrunk, shows at pixels (N, 2): grey levels (N,), NaN beyond it.

    The picture is read as taken, by a quintic spline, once: an undistorted copy would be read
    twice, and cubic convolution pulls matches towards whole pixels by hundredths.
    """
    grey = cv2.cvtColor(taken, cv2.COLOR_BGR2GRAY).astype(np.float64)
    find: Any = ndimage
    spline = find.spline_filter(grey, order=_SPLINE, mode="mirror")
    ratio = np.array(warp.pinhole.size_px) / view.pinhole.size_px
    size = np.array(warp.size_px)

    def at(pixels: Array) -> Array:
        place = warp.from_pinhole(pixels * ratio)
        with np.errstate(invalid="ignore"):
            inside = ((place >= 0) & (place <= size)).all(axis=1)
        found = np.full(len(place), np.nan)
        found[inside] = find.map_coordinates(
            spline, place[inside, ::-1].T - 0.5, order=_SPLINE, mode="mirror", prefilter=False
        )
        return found

    return at


def at_pixels(picture: Float32, pixels: Array) -> Array:
    """Cubic values (N,) of a picture at pixels (N, 2); NaN beyond it or next to NaN."""
    found = remapped(picture, pixels, cv2.INTER_CUBIC, cv2.BORDER_REPLICATE)
    size = np.array(picture.shape[1::-1])
    with np.errstate(invalid="ignore"):
        inside = ((pixels >= 0) & (pixels <= size)).all(axis=1)
    return np.where(inside, found, np.nan)


def _scatter(terms: Array) -> Array:
    """Variance of the sums of (N, P) terms of square patches, whose neighbours are correlated.

    The noise of resampled pictures is not white: products of terms up to some pixels apart count,
    with weights that fall off linearly, so that no variance is negative (Newey & West 1987, "A
    simple, positive semi-definite, heteroskedasticity and autocorrelation consistent covariance
    matrix").
    """
    side = 2 * _HALF_PX + 1
    patch = terms.reshape(-1, side, side)
    fall = 1.0 - np.abs(np.arange(-_LAG_PX, _LAG_PX + 1)) / (_LAG_PX + 1)
    near = ndimage.convolve1d(patch, fall, axis=1, mode="constant")
    near = ndimage.convolve1d(near, fall, axis=2, mode="constant")
    total: Array = (patch * near).sum(axis=(1, 2))
    return total


def _compare(first: Array, second: Array, weight: Array) -> tuple[Array, Array]:
    """What remains of the first (N, P) once the second is fitted in brightness and contrast.

    Returns:
        (N, P) residuals, in the grey levels of the first, and (N,) correlations; NaN next to
        unknown.
    """
    total = weight.sum()
    a = first - (first @ weight / total)[:, None]
    b = second - (second @ weight / total)[:, None]
    aa, bb, ab = (a * a) @ weight, (b * b) @ weight, (a * b) @ weight
    with np.errstate(divide="ignore", invalid="ignore"):
        return a - (ab / bb)[:, None] * b, ab / np.sqrt(aa * bb)


def _epipolar(left: View, right: View, pixels: Array, depth: Array) -> tuple[Array, Array]:
    """How depth shows in the right view.

    Returns:
        Change of inverse depth that moves a point by a pixel, (N,), and the unit vectors square to
        that motion, (N, 2).
    """
    inverse = 1.0 / depth
    step = 1e-4 * inverse
    ends = [right.project(left.at_depth(pixels, 1.0 / (inverse + s))) for s in (step, -step)]
    moved = ends[0] - ends[1]
    speed = np.linalg.norm(moved, axis=1)
    across = np.column_stack([-moved[:, 1], moved[:, 0]]) / speed[:, None]
    return 2.0 * step / speed, across


def _smoothed(depth: Float32) -> Float32:
    known = np.isfinite(depth)
    weight = cv2.GaussianBlur(known.astype(np.float32), (0, 0), _SLOPE_SIGMA_PX)
    total = cv2.GaussianBlur(
        np.where(known, depth, np.float32(0)).astype(np.float32), (0, 0), _SLOPE_SIGMA_PX
    )
    smooth: Float32 = np.where(weight > 0.1, total / np.maximum(weight, 0.1), np.float32(np.nan))
    return smooth
