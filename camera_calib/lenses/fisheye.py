"""A fisheye lens: the radius in the picture is a polynomial of the angle from the axis.

    r = a (1 + k1 a^2 + k2 a^4 + k3 a^6 + k4 a^8),  (x, y) = r (cos, sin of the ray's azimuth)

J. Kannala, S. Brandt 2006, "A generic camera model and calibration method for conventional,
wide-angle, and fish-eye lenses", with the terms that OpenCV (`fisheye`), Kalibr (`equidistant`) and
COLMAP (`OPENCV_FISHEYE`) share. Rays may leave at more than 90 degrees from the axis.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from alice_survey.core.compiled import compiled_ieee
from alice_survey.core.frames import Array
from camera_calib.lenses.values import FOCAL_AND_CENTRE, LensValues

COEFFICIENTS = ("k1", "k2", "k3", "k4")
_NEWTON_STEPS = 60
_LIMIT = 8
"""Place of the largest angle in `FisheyeLens.values`."""


@dataclass(frozen=True, kw_only=True)
class FisheyeLens(LensValues):
    """A fisheye lens of Kannala and Brandt, as OpenCV and Kalibr write it.

    Example:
        >>> import alice_survey as alice
        >>> lens = alice.FisheyeLens(fx_px=300, fy_px=300, cx_px=500, cy_px=400)
        >>> camera = alice.Camera(width_px=1000, height_px=800, lens=lens)
        >>> camera.project([[1.0, 0.0, 0.0]]).round(1)  # at a right angle to its axis
        array([[971.2, 400. ]])
    """

    model: ClassVar[str] = "fisheye"
    falloff: ClassVar[float] = 1.0
    parameters: ClassVar[tuple[str, ...]] = (*FOCAL_AND_CENTRE, *COEFFICIENTS)

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    @cached_property
    def values(self) -> Array:
        """(9,) focal lengths, centre, k1 to k4, and the angle at which the radius turns back."""
        terms = [getattr(self, name) for name in self.parameters]
        return np.array([*terms, _largest_angle(terms[4:])])


def _largest_angle(k: list[float]) -> float:
    """Angle from the axis up to which the radius grows; half a turn at most."""
    slope = np.polynomial.Polynomial([(2 * i + 1) * c for i, c in enumerate([1.0, *k])])
    roots = np.asarray(slope.trim().roots(), dtype=np.complex128)
    squares = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0.0)]
    return float(np.sqrt(squares).min(initial=math.pi))


@compiled_ieee
def _radius(angle: float, lens: Array) -> tuple[float, float]:
    """Radius in the picture over the focal length, and its slope."""
    w = angle * angle
    k1, k2, k3, k4 = lens[4], lens[5], lens[6], lens[7]
    radius = angle * (1.0 + w * (k1 + w * (k2 + w * (k3 + w * k4))))
    slope = 1.0 + w * (3.0 * k1 + w * (5.0 * k2 + w * (7.0 * k3 + w * 9.0 * k4)))
    return radius, slope


@compiled_ieee
def fisheye_pixels(rays: Array, lens: Array, pixels: Array) -> None:
    """Pixels (B, 2), to be filled in, of rays in air (B, 3) of any length."""
    for j in range(len(rays)):
        dx, dy, dz = rays[j, 0], rays[j, 1], rays[j, 2]
        sideways = math.sqrt(dx * dx + dy * dy)
        angle = math.atan2(sideways, dz)
        pixels[j, 0] = pixels[j, 1] = math.nan
        if angle < lens[_LIMIT]:
            radius, _ = _radius(angle, lens)
            stretch = radius / sideways if sideways > 0.0 else 1.0 / dz
            pixels[j, 0] = lens[0] * stretch * dx + lens[2]
            pixels[j, 1] = lens[1] * stretch * dy + lens[3]


@compiled_ieee
def fisheye_rays(pixels: Array, lens: Array, rays: Array) -> None:
    """Unit rays in air (B, 3), to be filled in, that pixels (B, 2) see."""
    maximum = lens[_LIMIT]
    end, _ = _radius(maximum, lens)
    for j in range(len(pixels)):
        x, y = (pixels[j, 0] - lens[2]) / lens[0], (pixels[j, 1] - lens[3]) / lens[1]
        radius = math.sqrt(x * x + y * y)
        rays[j, 0] = rays[j, 1] = rays[j, 2] = math.nan
        if not radius < end:
            continue
        angle = _angle_of(radius, maximum, lens)
        if not math.isfinite(angle):
            continue
        stretch = math.sin(angle) / radius if radius > 0.0 else 1.0
        rays[j, 0], rays[j, 1], rays[j, 2] = x * stretch, y * stretch, math.cos(angle)


@compiled_ieee
def _angle_of(radius: float, maximum: float, lens: Array) -> float:
    """The angle of a radius: Newton's method, kept between bounds by bisection."""
    low, high = 0.0, maximum
    angle = min(radius, 0.5 * maximum)
    for _ in range(_NEWTON_STEPS):
        found, slope = _radius(angle, lens)
        if found > radius:
            high = angle
        else:
            low = angle
        new = angle - (found - radius) / slope
        if not low <= new <= high:
            new = 0.5 * (low + high)
        if abs(new - angle) <= 1e-15 * (1.0 + angle):
            return new
        angle = new
    return angle


@compiled_ieee
def fisheye_slopes(rays: Array, lens: Array, pixels: Array, by_ray: Array, by_lens: Array) -> None:
    """Pixels of rays in air with their slopes, all to be filled in; NaN without a pixel.

    Args:
        rays: (B, 3), of any length.
        lens: `FisheyeLens.values`.
        pixels: (B, 2).
        by_ray: (B, 2, 3).
        by_lens: (B, 2, 8).
    """
    for j in range(len(rays)):
        dx, dy, dz = rays[j, 0], rays[j, 1], rays[j, 2]
        side2 = dx * dx + dy * dy
        length2 = side2 + dz * dz
        sideways = math.sqrt(side2)
        angle = math.atan2(sideways, dz)
        if not angle < lens[_LIMIT]:
            pixels[j, :] = math.nan
            by_ray[j, :, :] = math.nan
            by_lens[j, :, :] = math.nan
            continue
        radius, steep = _radius(angle, lens)
        if sideways > 0.0:
            stretch = radius / sideways
            radial, ex, ey = steep * dz / length2, dx / sideways, dy / sideways
        else:
            stretch = radial = 1.0 / dz
            ex = ey = 0.0
        bend = radial - stretch
        for row in range(2):
            focal, across = lens[row], 1 - row
            along, side = (ex, dx) if row == 0 else (ey, dy)
            by_ray[j, row, 0] = focal * bend * along * ex
            by_ray[j, row, 1] = focal * bend * along * ey
            by_ray[j, row, row] += focal * stretch
            by_ray[j, row, 2] = -focal * steep * side / length2
            by_lens[j, row, row], by_lens[j, row, across] = stretch * side, 0.0
            by_lens[j, row, 2 + row], by_lens[j, row, 2 + across] = 1.0, 0.0
            pixels[j, row] = focal * stretch * side + lens[2 + row]
            power = angle
            for i in range(4):
                power *= angle * angle
                by_lens[j, row, 4 + i] = focal * along * power
