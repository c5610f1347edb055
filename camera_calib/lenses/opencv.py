"""A pinhole with OpenCV's lens distortion and all its named terms.

    x = u L + 2 p1 u v + p2 (r2 + 2 u^2) + s1 r2 + s2 r2^2
    y = v L + p1 (r2 + 2 v^2) + 2 p2 u v + s3 r2 + s4 r2^2
    L = (1 + k1 r2 + k2 r2^2 + k3 r2^3) / (1 + k4 r2 + k5 r2^2 + k6 r2^3),  r2 = u^2 + v^2

(u, v) are tangents of the ray in air, (x, y) what the sensor sees of them. The source is OpenCV's
documentation of `calib3d`. Coefficients come as one vector in the order of `COEFFICIENTS`; kernels
of whole rays take `OpenCVLens.values`.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from alice_survey.core.compiled import compiled_ieee
from alice_survey.core.frames import Array
from camera_calib.lenses.values import FOCAL_AND_CENTRE, LensValues

COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
"""The same order as OpenCV's vector of distortion coefficients."""

_NEWTON_STEPS = 60
_BISECTIONS = 60
_SETTLED = 1e-9
"""After a step of Newton's method this short in a tangent, the remaining error is its square."""
_COUNT = 4 + len(COEFFICIENTS)
_Terms = tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class OpenCVLens(LensValues):
    """A pinhole with the distortion terms of OpenCV.

    Example:
        >>> import alice_survey as alice
        >>> lens = alice.OpenCVLens(fx_px=1500, fy_px=1500, cx_px=800, cy_px=600, k1=-0.1)
        >>> lens.model
        'opencv'
    """

    model: ClassVar[str] = "opencv"
    parameters: ClassVar[tuple[str, ...]] = (*FOCAL_AND_CENTRE, *COEFFICIENTS)

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    """k4 to k6 divide: OpenCV's rational model."""
    s1: float = 0.0
    s2: float = 0.0
    s3: float = 0.0
    s4: float = 0.0
    """s1 to s4: OpenCV's thin prism."""

    @cached_property
    def values(self) -> Array:
        """(17,) focal lengths, centre, distortion, and the squared tangent at the fold."""
        terms = np.array([getattr(self, name) for name in self.parameters])
        return np.append(terms, fold(terms[4:]))

    @cached_property
    def distorts(self) -> bool:
        """Whether any of its coefficients counts."""
        return any(getattr(self, name) for name in COEFFICIENTS)


def fold(k: Array) -> float:
    """Square of the tangent in air at which radial distortion turns back; inf if it never does.

    With N and D the numerator and denominator of L, d(r N / D)/dr vanishes where
    N D + 2 w (N' D - N D') = 0 in w = r^2; beyond the first such w, or the first pole of L, two
    rays meet in one pixel.

    Args:
        k: (12,) coefficients.
    """
    top = np.polynomial.Polynomial([1.0, k[0], k[1], k[4]])
    bottom = np.polynomial.Polynomial([1.0, k[5], k[6], k[7]])
    w = np.polynomial.Polynomial([0.0, 1.0])
    turns = top * bottom + 2.0 * w * (top.deriv() * bottom - top * bottom.deriv())
    found = [_first_positive_root(polynomial) for polynomial in (turns, bottom)]
    return min(found)


def _first_positive_root(polynomial: np.polynomial.Polynomial) -> float:
    # With w = 1 / q the leading coefficient is 1, however small the others are.
    roots = np.roots(polynomial.trim().coef)
    nearest = max(roots.real[np.abs(roots.imag) < 1e-9], default=0.0)
    return 1.0 / float(nearest) if nearest > 1e-9 else math.inf


@compiled_ieee
def _terms(lens: Array) -> _Terms:
    """Coefficients as a tuple, which unlike an array no store to another can change."""
    k = lens[4:_COUNT]
    return k[0], k[1], k[2], k[3], k[4], k[5], k[6], k[7], k[8], k[9], k[10], k[11]


@compiled_ieee
def radial(r2: float, k: _Terms) -> tuple[float, float, float]:
    """L, its derivative dL/d(r2), and its denominator."""
    top = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
    bottom = 1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
    top_slope = k[0] + r2 * (2.0 * k[1] + 3.0 * r2 * k[4])
    bottom_slope = k[5] + r2 * (2.0 * k[6] + 3.0 * r2 * k[7])
    ratio = top / bottom
    return ratio, (top_slope - ratio * bottom_slope) / bottom, bottom


@compiled_ieee
def distort_slopes(
    u: float, v: float, k: _Terms
) -> tuple[float, float, float, float, float, float]:
    """(x, y) and their derivatives dx/du, dx/dv, dy/du, dy/dv."""
    r2 = u * u + v * v
    ratio, slope, _ = radial(r2, k)
    uv2 = 2.0 * u * v
    x = u * ratio + k[2] * uv2 + k[3] * (r2 + 2.0 * u * u) + r2 * (k[8] + r2 * k[9])
    y = v * ratio + k[2] * (r2 + 2.0 * v * v) + k[3] * uv2 + r2 * (k[10] + r2 * k[11])
    prism_x, prism_y = 2.0 * (k[8] + 2.0 * r2 * k[9]), 2.0 * (k[10] + 2.0 * r2 * k[11])
    cross = uv2 * slope + 2.0 * (k[2] * u + k[3] * v)
    x_u = ratio + 2.0 * u * u * slope + 2.0 * k[2] * v + 6.0 * k[3] * u + prism_x * u
    y_v = ratio + 2.0 * v * v * slope + 6.0 * k[2] * v + 2.0 * k[3] * u + prism_y * v
    return x, y, x_u, cross + prism_x * v, cross + prism_y * u, y_v


@compiled_ieee
def undistort(x: float, y: float, k: _Terms, fold2: float) -> tuple[float, float]:
    """The ray (u, v) that the sensor sees at (x, y); NaN where no ray before the fold goes there.

    Newton's method from (x, y); if it diverges, from the radial part's inverse, which bisection
    finds as it is monotonic up to the fold.
    """
    for attempt in range(2):
        u, v = x, y
        if attempt == 1:
            seen = math.sqrt(x * x + y * y)
            low, high = 0.0, math.sqrt(fold2) if fold2 < math.inf else max(1.0, seen)
            while fold2 == math.inf and high * radial(high * high, k)[0] < seen and high < 1e6:
                high *= 2.0
            for _ in range(_BISECTIONS):
                middle = 0.5 * (low + high)
                if middle * radial(middle * middle, k)[0] < seen:
                    low = middle
                else:
                    high = middle
            u, v = x * low / seen, y * low / seen
        for _ in range(_NEWTON_STEPS):
            found_x, found_y, x_u, x_v, y_u, y_v = distort_slopes(u, v, k)
            determinant = x_u * y_v - x_v * y_u
            if not determinant > 0.0:
                break
            miss_x, miss_y = found_x - x, found_y - y
            step_u = (y_v * miss_x - x_v * miss_y) / determinant
            step_v = (x_u * miss_y - y_u * miss_x) / determinant
            u -= step_u
            v -= step_v
            if abs(step_u) + abs(step_v) <= 1e-15 * (1.0 + abs(u) + abs(v)):
                if u * u + v * v < fold2:
                    return u, v
                break
    return math.nan, math.nan


@compiled_ieee
def opencv_pixels(rays: Array, lens: Array, pixels: Array) -> None:
    """Pixels (B, 2), to be filled in, of rays in air (B, 3) of any length."""
    fx, fy, cx, cy, fold2 = lens[0], lens[1], lens[2], lens[3], lens[_COUNT]
    k = _terms(lens)
    for j in range(len(rays)):
        pixels[j, 0] = pixels[j, 1] = math.nan
        dz = rays[j, 2]
        if not dz > 0.0:
            continue
        u, v = rays[j, 0] / dz, rays[j, 1] / dz
        r2 = u * u + v * v
        if r2 < fold2:
            top = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
            ratio = top / (1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))
            uv2 = 2.0 * u * v
            x = u * ratio + k[2] * uv2 + k[3] * (r2 + 2.0 * u * u) + r2 * (k[8] + r2 * k[9])
            y = v * ratio + k[2] * (r2 + 2.0 * v * v) + k[3] * uv2 + r2 * (k[10] + r2 * k[11])
            pixels[j, 0], pixels[j, 1] = fx * x + cx, fy * y + cy


@compiled_ieee
def opencv_rays(pixels: Array, lens: Array, rays: Array) -> None:
    """Unit rays in air (B, 3), to be filled in, that pixels (B, 2) see.

    Newton's method takes four steps without a branch, so that they become vector instructions;
    where the last one was not tiny yet, `undistort` takes over.
    """
    count, fold2, k = len(pixels), lens[_COUNT], _terms(lens)
    x, y, u, v = np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    for j in range(count):
        x[j] = (pixels[j, 0] - lens[2]) / lens[0]
        y[j] = (pixels[j, 1] - lens[3]) / lens[1]
    for j in range(count):
        a, b, minimum, last = x[j], y[j], 1.0, 0.0
        for _ in range(4):
            found_x, found_y, x_u, x_v, y_u, y_v = distort_slopes(a, b, k)
            determinant = x_u * y_v - x_v * y_u
            minimum = min(minimum, determinant)
            miss_x, miss_y = found_x - x[j], found_y - y[j]
            step_a = (y_v * miss_x - x_v * miss_y) / determinant
            step_b = (x_u * miss_y - y_u * miss_x) / determinant
            a -= step_a
            b -= step_b
            last = abs(step_a) + abs(step_b)
        settled = (minimum > 0.0) & (last <= _SETTLED) & (a * a + b * b < fold2)
        u[j] = a if settled else math.nan
        v[j] = b if settled else math.nan
    for j in range(count):
        if not math.isfinite(u[j]):
            u[j], v[j] = undistort(x[j], y[j], k, fold2)
        length = math.sqrt(u[j] * u[j] + v[j] * v[j] + 1.0)
        rays[j, 0], rays[j, 1], rays[j, 2] = u[j] / length, v[j] / length, 1.0 / length


@compiled_ieee
def opencv_slopes(rays: Array, lens: Array, pixels: Array, by_ray: Array, by_lens: Array) -> None:
    """Pixels of rays in air with their slopes, all to be filled in; NaN without a pixel.

    Args:
        rays: (B, 3), of any length.
        lens: `OpenCVLens.values`.
        pixels: (B, 2).
        by_ray: (B, 2, 3).
        by_lens: (B, 2, 16).
    """
    fold2, k = lens[_COUNT], _terms(lens)
    for j in range(len(rays)):
        dz = rays[j, 2]
        u, v = rays[j, 0] / dz, rays[j, 1] / dz
        r2 = u * u + v * v
        if not (dz > 0.0 and r2 < fold2):
            pixels[j, :] = math.nan
            by_ray[j, :, :] = math.nan
            by_lens[j, :, :] = math.nan
            continue
        x, y, x_u, x_v, y_u, y_v = distort_slopes(u, v, k)
        ratio, _, bottom = radial(r2, k)
        one = r2 / bottom
        two = r2 * one
        three = r2 * two
        for row in range(2):
            focal, tangent, seen = lens[row], u if row == 0 else v, x if row == 0 else y
            by_u, by_v = (x_u, x_v) if row == 0 else (y_u, y_v)
            by_u, by_v = focal * by_u / dz, focal * by_v / dz
            pixels[j, row] = focal * seen + lens[2 + row]
            by_ray[j, row, 0], by_ray[j, row, 1] = by_u, by_v
            by_ray[j, row, 2] = -(u * by_u + v * by_v)
            out = by_lens[j, row]
            across = 1 - row
            out[row], out[across] = seen, 0.0
            out[2 + row], out[2 + across] = 1.0, 0.0
            outward = focal * tangent
            out[4], out[5], out[8] = outward * one, outward * two, outward * three
            out[6 + row] = focal * 2.0 * u * v
            out[6 + across] = focal * (r2 + 2.0 * tangent * tangent)
            inward = -outward * ratio
            out[9], out[10], out[11] = inward * one, inward * two, inward * three
            out[12 + 2 * row], out[13 + 2 * row] = focal * r2, focal * r2 * r2
            out[12 + 2 * across], out[13 + 2 * across] = 0.0, 0.0


def pinhole_pixels(rays: Array, lens: Array, pixels: Array) -> None:
    """As `opencv_pixels`, of a lens without distortion: nothing is compiled."""
    ahead = np.where(rays[:, 2:] > 0.0, rays[:, 2:], np.nan)
    pixels[:] = lens[:2] * (rays[:, :2] / ahead) + lens[2:4]


def pinhole_rays(pixels: Array, lens: Array, rays: Array) -> None:
    """As `opencv_rays`, of a lens without distortion."""
    rays[:, :2], rays[:, 2] = (pixels - lens[2:4]) / lens[:2], 1.0
    rays /= np.sqrt(rays[:, 0] ** 2 + rays[:, 1] ** 2 + 1.0)[:, None]


def pinhole_slopes(rays: Array, lens: Array, pixels: Array, by_ray: Array, by_lens: Array) -> None:
    """As `opencv_slopes`, of a lens without distortion."""
    ahead = np.where(rays[:, 2] > 0.0, rays[:, 2], np.nan)
    u, v = tangents = rays[:, :2].T / ahead
    r2 = u * u + v * v
    terms = np.stack([r2, r2 * r2, r2 * (r2 * r2)], axis=1)
    by_ray[:], by_lens[:] = (0.0 * u)[:, None, None], (0.0 * u)[:, None, None]  # or NaN
    for row, tangent in enumerate(tangents):
        focal, across, out = lens[row], 1 - row, by_lens[:, row]
        outward = focal * tangent
        pixels[:, row] = outward + lens[2 + row]
        by_ray[:, row, row] = focal / ahead
        by_ray[:, row, 2] = -(tangent * by_ray[:, row, row])
        out[:, row] = tangent
        out[:, 2 + row] += 1.0
        out[:, [4, 5, 8]] = outward[:, None] * terms
        out[:, 9:12] = -out[:, [4, 5, 8]]
        out[:, 6 + row] = focal * 2.0 * u * v
        out[:, 6 + across] = focal * (r2 + 2.0 * tangent * tangent)
        out[:, 12 + 2 * row], out[:, 13 + 2 * row] = focal * r2, focal * r2 * r2
