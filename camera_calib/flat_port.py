"""A pinhole camera with lens distortion that looks into water through a flat port, exactly.

Light leaves the water, crosses a plane glass and an air gap, and enters the pupil of a camera
calibrated in air. From pixel to ray in water is closed form (Snell's law twice); from point to
pixel is one root of a concave function, found by Newton's method to machine precision.

Axes are the camera's (right, down, forward) with the origin at the entrance pupil. Pixels count
from the outer corner of the first pixel, whose centre is (0.5, 0.5).
"""

import math
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numba import njit

from alice_survey.errors import CalibrationError
from alice_survey.frames import Array

_NEWTON_STEPS = 60
_FORWARD = (0.0, 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class FlatPortCamera:
    """One camera: pinhole and distortion as in air (OpenCV's model), and the port before it.

    A port of zero distance and thickness in water of index n is a pinhole magnified by n; with
    n_water = 1 it is the camera in air.
    """

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
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
    port_distance_m: float = 0.0
    """From the entrance pupil to the inner glass, along the port's normal."""
    glass_thickness_m: float = 0.0
    n_glass: float = 1.52
    n_water: float = 1.34
    normal: tuple[float, float, float] = _FORWARD
    """Unit normal of the port in the camera frame, pointing into the water."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not np.all(np.isfinite(value)):
                raise CalibrationError(f"camera: {field.name} = {value} is not finite")
        if min(self.width_px, self.height_px) < 1 or min(self.fx_px, self.fy_px) <= 0:
            raise CalibrationError("camera: width_px, height_px, fx_px and fy_px must be positive")
        if min(self.port_distance_m, self.glass_thickness_m) < 0:
            raise CalibrationError("camera: port_distance_m and glass_thickness_m must be >= 0")
        if min(self.n_glass, self.n_water) < 1:
            raise CalibrationError("camera: n_glass and n_water must be 1 or more")
        if abs(math.hypot(*self.normal) - 1) > 1e-6 or self.normal[2] <= 0:
            raise CalibrationError(f"camera: normal {self.normal} is no unit vector facing forward")

    @cached_property
    def _parameters(self) -> Array:
        lens = [self.fx_px, self.fy_px, self.cx_px, self.cy_px]
        distortion = [self.k1, self.k2, self.p1, self.p2, self.k3]
        port = [self.port_distance_m, self.glass_thickness_m, self.n_glass, self.n_water]
        unit = np.asarray(self.normal) / math.hypot(*self.normal)
        return np.array([*lens, *distortion, *port, *unit, self._fold])

    @property
    def _fold(self) -> float:
        """Square of the tangent in air at which radial distortion turns back; inf if it never does.

        There d/dr (r + k1 r^3 + k2 r^5 + k3 r^7) = 0, a cubic in w = 1 / r^2 with a leading 1.
        """
        roots = np.roots([1.0, 3 * self.k1, 5 * self.k2, 7 * self.k3])
        nearest = max(roots.real[np.abs(roots.imag) < 1e-9], default=0.0)
        return 1.0 / float(nearest) if nearest > 1e-9 else math.inf

    def project(self, points_cam: Array) -> Array:
        """Project points in the water to pixels.

        Args:
            points_cam: (..., 3) points in the camera frame, metres.

        Returns:
            (..., 2) pixels (not clipped to the frame); NaN where the point is not in the water
            before the port, no light reaches the pupil from it, or it lies so far out that the lens
            model folds back.
        """
        points = np.ascontiguousarray(points_cam, dtype=np.float64)
        pixels: Array = _project(points.reshape(-1, 3), self._parameters)
        return pixels.reshape(*points.shape[:-1], 2)

    def unproject(self, pixels: Array) -> tuple[Array, Array]:
        """The ray in water that ends at each pixel.

        Args:
            pixels: (..., 2).

        Returns:
            Points on the outer glass, (..., 3) metres, and unit directions in water, (..., 3), both
            in the camera frame; NaN where the lens model has no inverse or light is totally
            reflected.
        """
        array = np.ascontiguousarray(pixels, dtype=np.float64)
        points, directions = _unproject(array.reshape(-1, 2), self._parameters)
        shape = (*array.shape[:-1], 3)
        return points.reshape(shape), directions.reshape(shape)

    def at_depth(self, pixels: Array, depth_m: Array | float) -> Array:
        """The points, (..., 3), where the rays of pixels (..., 2) reach z = depth_m in `cam`."""
        points, directions = self.unproject(pixels)
        reach = (np.asarray(depth_m) - points[..., 2]) / directions[..., 2]
        hits: Array = points + reach[..., None] * directions
        return hits

    def reduced(self, scale: int) -> "FlatPortCamera":
        """The same camera with pixels `scale` times as large; a rest at right and bottom is cut."""
        return replace(
            self,
            width_px=self.width_px // scale,
            height_px=self.height_px // scale,
            fx_px=self.fx_px / scale,
            fy_px=self.fy_px / scale,
            cx_px=self.cx_px / scale,
            cy_px=self.cy_px / scale,
        )

    def pixel_centres(self, step: int = 1) -> Array:
        """Centres of every `step`-th pixel, (rows, columns, 2)."""
        x = np.arange(0, self.width_px, step) + 0.5
        y = np.arange(0, self.height_px, step) + 0.5
        return np.stack(np.meshgrid(x, y), axis=-1)

    def border(self, points_per_side: int = 16) -> Array:
        """Pixels along the outer border of the frame, (4 * points_per_side, 2), in order."""
        t = np.arange(points_per_side) / points_per_side
        w, h, one = float(self.width_px), float(self.height_px), np.ones_like(t)
        sides = [(w * t, 0 * one), (w * one, h * t), (w * (1 - t), h * one), (0 * one, h * (1 - t))]
        return np.concatenate([np.stack(side, axis=1) for side in sides])

    def to_json(self) -> dict[str, Any]:
        """All fields as JSON values."""
        return {f.name: getattr(self, f.name) for f in fields(self)} | {"normal": list(self.normal)}


def camera_from_json(data: dict[str, Any]) -> FlatPortCamera:
    """The inverse of `FlatPortCamera.to_json`.

    Raises:
        CalibrationError: a key is missing or unknown, or a value is out of range.
    """
    try:
        return FlatPortCamera(**(data | {"normal": tuple(data.get("normal", _FORWARD))}))
    except TypeError as error:
        raise CalibrationError(f"camera: {error}") from None


@njit(cache=True)  # type: ignore[untyped-decorator]
def _project(points: Array, camera: Array) -> Array:
    fx, fy, cx, cy, k1, k2, p1, p2, k3, air, glass, n_glass, n_water, nx, ny, nz, fold = camera
    a_glass, b_glass = n_glass * n_glass, n_glass * n_glass - 1.0
    a_water, b_water = n_water * n_water, n_water * n_water - 1.0
    pixels = np.full((points.shape[0], 2), np.nan)
    for i in range(points.shape[0]):
        x, y, z = points[i]
        along = nx * x + ny * y + nz * z
        water = along - air - glass
        if not water > 0.0:
            continue
        rx, ry, rz = x - along * nx, y - along * ny, z - along * nz
        radius = math.sqrt(rx * rx + ry * ry + rz * rz)
        tangent = 0.0
        if radius > 0.0:
            if air == 0.0:
                reach = glass / math.sqrt(b_glass) if b_glass > 0.0 else math.inf
                if glass == 0.0:
                    reach = 0.0
                reach += water / math.sqrt(b_water) if b_water > 0.0 else math.inf
                if not radius < reach:
                    continue
            # f(t) = air t + glass t / sqrt(n_g^2 + (n_g^2 - 1) t^2) + water ... - radius, with t
            # the tangent in air, is concave: from its tangent at 0 Newton climbs to the root and
            # never passes it.
            tangent = radius / (air + glass / n_glass + water / n_water)
            for _ in range(_NEWTON_STEPS):
                t2 = tangent * tangent
                root_glass = math.sqrt(a_glass + b_glass * t2)
                root_water = math.sqrt(a_water + b_water * t2)
                miss = tangent * (air + glass / root_glass + water / root_water) - radius
                slope = air + glass * a_glass / root_glass**3 + water * a_water / root_water**3
                step = miss / slope
                tangent -= step
                if abs(step) <= 1e-15 * tangent:
                    break
            else:
                if not abs(step) <= 1e-12 * tangent:
                    continue
            tangent /= radius
        dx, dy, dz = rx * tangent + nx, ry * tangent + ny, rz * tangent + nz
        if not dz > 0.0:
            continue
        u, v = dx / dz, dy / dz
        r2 = u * u + v * v
        if not r2 < fold:
            continue
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        pixels[i, 0] = fx * (u * radial + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u)) + cx
        pixels[i, 1] = fy * (v * radial + p1 * (r2 + 2.0 * v * v) + 2.0 * p2 * u * v) + cy
    return pixels


@njit(cache=True)  # type: ignore[untyped-decorator]
def _unproject(pixels: Array, camera: Array) -> tuple[Array, Array]:
    fx, fy, cx, cy, k1, k2, p1, p2, k3, air, glass, n_glass, n_water, nx, ny, nz, fold = camera
    points = np.full((pixels.shape[0], 3), np.nan)
    directions = np.full((pixels.shape[0], 3), np.nan)
    for i in range(pixels.shape[0]):
        ud, vd = (pixels[i, 0] - cx) / fx, (pixels[i, 1] - cy) / fy
        u, v = ud, vd
        converged = False
        for _ in range(_NEWTON_STEPS):
            r2 = u * u + v * v
            radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
            slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
            miss_u = u * radial + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u) - ud
            miss_v = v * radial + p1 * (r2 + 2.0 * v * v) + 2.0 * p2 * u * v - vd
            uu = radial + u * u * slope + 2.0 * p1 * v + 6.0 * p2 * u
            uv = u * v * slope + 2.0 * p1 * u + 2.0 * p2 * v
            vv = radial + v * v * slope + 6.0 * p1 * v + 2.0 * p2 * u
            determinant = uu * vv - uv * uv
            if not determinant > 0.0:
                break
            step_u = (vv * miss_u - uv * miss_v) / determinant
            step_v = (uu * miss_v - uv * miss_u) / determinant
            u -= step_u
            v -= step_v
            if abs(step_u) + abs(step_v) <= 1e-15 * (1.0 + abs(u) + abs(v)):
                converged = True
                break
        if not (converged and u * u + v * v < fold):
            continue
        length = math.sqrt(u * u + v * v + 1.0)
        dx, dy, dz = u / length, v / length, 1.0 / length
        cos_air = dx * nx + dy * ny + dz * nz
        if not cos_air > 0.0:
            continue
        x, y, z = dx * air / cos_air, dy * air / cos_air, dz * air / cos_air
        sin2 = 1.0 - cos_air * cos_air
        cos_glass = math.sqrt(1.0 - sin2 / (n_glass * n_glass))
        bend = cos_glass - cos_air / n_glass
        gx, gy, gz = dx / n_glass + bend * nx, dy / n_glass + bend * ny, dz / n_glass + bend * nz
        x += gx * glass / cos_glass
        y += gy * glass / cos_glass
        z += gz * glass / cos_glass
        cos_water = math.sqrt(1.0 - sin2 / (n_water * n_water))
        bend = cos_water - cos_air / n_water
        points[i] = x, y, z
        directions[i] = dx / n_water + bend * nx, dy / n_water + bend * ny, dz / n_water + bend * nz
    return points, directions
