"""A pinhole camera with lens distortion that looks into water through a flat port, exactly.

Light leaves the water, crosses a plane glass and an air gap, and enters the pupil of a camera
calibrated in air. From pixel to ray in water is closed form (Snell's law twice); from point to
pixel is one root of a concave function, found by Newton's method to machine precision.

Axes are the camera's (right, down, forward) with the origin at the entrance pupil. Pixels count
from the outer corner of the first pixel, whose centre is (0.5, 0.5).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from pydantic import ConfigDict

from alice_survey.base.artefacts import checked
from alice_survey.base.errors import CalibrationError
from alice_survey.base.frames import Array
from camera_calib import lens, refraction

_FORWARD = (0.0, 0.0, 1.0)
_LENS = ("fx_px", "fy_px", "cx_px", "cy_px", *lens.COEFFICIENTS)
_PORT = ("port_distance_m", "glass_thickness_m", "n_glass", "n_water")
_NORMAL = ("normal_x", "normal_y")
_MOST_PX = 1e7
_RANGES = (
    ("port_distance_m", 100.0, " m"),
    ("glass_thickness_m", 10.0, " m"),
    ("n_glass", 3.0, ""),
    ("n_water", 2.0, ""),
)
"""Largest port distance or thickness; the wall of a tank may be some metres away."""

IN_AIR: Mapping[str, Any] = {
    "port_distance_m": 0.0,
    "glass_thickness_m": 0.0,
    "n_water": 1.0,
    "normal": _FORWARD,
}
"""Values of a camera without a port."""
PARAMETERS = (*_LENS, *_PORT, *_NORMAL)
"""Parameters that can be calibrated, ordered as in `project_jacobian`. The unit normal has
two: its first two components, sines of the port's tilt about the camera's y and x axes."""


@dataclass(frozen=True, kw_only=True)
class FlatPortCamera:
    """One camera: pinhole and distortion as in air (OpenCV's model), and its flat port.

    A port of zero distance and thickness in water of index n is a pinhole magnified by n; with
    n_water = 1 it is the camera in air.

    Example:
        >>> import alice_survey as alice
        >>> camera = alice.FlatPortCamera(
        ...     width_px=1600, height_px=1200, fx_px=1500, fy_px=1500, cx_px=800, cy_px=600,
        ...     port_distance_m=0.02, glass_thickness_m=0.01, n_water=1.34,
        ... )
        >>> camera.project([[0.0, 0.0, 2.0], [0.5, 0.2, 2.0], [0.0, 0.0, -1.0]]).round(1)
        array([[ 800. ,  600. ],
               [1315.9,  806.4],
               [   nan,    nan]])
    """

    __pydantic_config__ = ConfigDict(extra="forbid", strict=True)

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
    """Distance from the entrance pupil to the inner glass, along the port's normal."""
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
        if max(self.width_px, self.height_px, self.fx_px, self.fy_px) > _MOST_PX:
            raise CalibrationError(f"camera: a size or focal length exceeds {_MOST_PX:g} px")
        for name, most, unit in _RANGES:
            least, given = 1.0 if unit == "" else 0.0, getattr(self, name)
            if not least <= given <= most:
                raise CalibrationError(
                    f"camera: {name} = {given:g}: {least:g} to {most:g}{unit} allowed"
                )
        if abs(math.hypot(*self.normal) - 1) > 1e-6 or self.normal[2] <= 0:
            raise CalibrationError(
                f"camera: normal {self.normal} is not a unit vector facing forward"
            )

    @cached_property
    def _lens(self) -> Array:
        return np.array([getattr(self, name) for name in _LENS])

    @cached_property
    def _port(self) -> Array:
        unit = np.asarray(self.normal) / math.hypot(*self.normal)
        return np.array([*(getattr(self, name) for name in _PORT), *unit])

    @cached_property
    def _fold(self) -> float:
        return lens.fold(self._lens[4:])

    def parameter(self, name: str) -> float:
        """The value of one of `PARAMETERS`."""
        if name in _NORMAL:
            return float(self.normal[_NORMAL.index(name)])
        return float(getattr(self, name))

    @property
    def refracts(self) -> bool:
        """Whether light bends at the port; not so in air, or for a pinhole calibrated in water."""
        return self.n_water != 1.0 or (self.glass_thickness_m > 0.0 and self.n_glass != 1.0)

    def with_parameters(self, values: Mapping[str, float]) -> "FlatPortCamera":
        """The same camera with some of `PARAMETERS` set to other values.

        Raises:
            CalibrationError: a name is unknown or a value out of range.
        """
        unknown = sorted(set(values) - set(PARAMETERS))
        if unknown:
            raise CalibrationError(f"camera: no parameter is called {', '.join(unknown)}")
        x, y = (float(values.get(name, self.parameter(name))) for name in _NORMAL)
        if not x * x + y * y < 1.0:
            raise CalibrationError(f"camera: normal_x, normal_y = {x:.6g}, {y:.6g} exceed 1")
        plain: dict[str, Any] = {n: float(v) for n, v in values.items() if n not in _NORMAL}
        if set(_NORMAL) & set(values):
            plain["normal"] = (x, y, math.sqrt(1.0 - x * x - y * y))
        return replace(self, **plain)

    def project(self, points_cam: Array) -> Array:
        """Project points in the water to pixels.

        Args:
            points_cam: (..., 3) points in the camera frame, metres.

        Returns:
            (..., 2) pixels (not clipped to the frame); NaN where the point is not in the water
            beyond the port, no light reaches the pupil from it, or it lies so far out that the lens
            model folds back.
        """
        points = np.ascontiguousarray(points_cam, dtype=np.float64)
        pixels: Array = refraction.project(
            points.reshape(-1, 3), self._lens, self._port, self._fold
        )
        return pixels.reshape(*points.shape[:-1], 2)

    def project_jacobian(self, points_cam: Array) -> tuple[Array, Array, Array]:
        """Project points, with the analytic derivatives of the pixels.

        Args:
            points_cam: (..., 3) points in the camera frame, metres.

        Returns:
            Pixels, (..., 2); their derivatives by the point, (..., 2, 3), px/m; and by each of
            `PARAMETERS`, (..., 2, 22). NaN where `project` is.
        """
        points = np.ascontiguousarray(points_cam, dtype=np.float64)
        pixels, by_point, by_parameter = refraction.project_jacobian(
            points.reshape(-1, 3), self._lens, self._port, self._fold
        )
        shape = points.shape[:-1]
        return (
            pixels.reshape(*shape, 2),
            by_point.reshape(*shape, 2, 3),
            by_parameter.reshape(*shape, 2, len(PARAMETERS)),
        )

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
        points, directions = refraction.unproject(
            array.reshape(-1, 2), self._lens, self._port, self._fold
        )
        shape = (*array.shape[:-1], 3)
        return points.reshape(shape), directions.reshape(shape)

    def at_depth(self, pixels: Array, depth_m: Array | float) -> Array:
        """The points, (..., 3), where the rays of pixels (..., 2) reach z = depth_m in `cam`."""
        points, directions = self.unproject(pixels)
        reach = (np.asarray(depth_m) - points[..., 2]) / directions[..., 2]
        hits: Array = points + reach[..., None] * directions
        return hits

    def reduced(self, scale: int) -> "FlatPortCamera":
        """The same camera with pixels `scale` times as large; partial ones are cut off."""
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

    def frame_grid(self, columns: int, rows: int) -> Array:
        """Pixels over the whole frame, evenly spaced, edges included, (rows, columns, 2)."""
        x = np.linspace(0.0, self.width_px, columns)
        y = np.linspace(0.0, self.height_px, rows)
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
        return checked(FlatPortCamera, data)
    except ValueError as error:
        raise CalibrationError(f"camera: {error}") from None


def pose_jacobian(by_point: Array, points_cam: Array) -> Array:
    """Derivatives of pixels by a small motion of the points in the camera's frame.

    Args:
        by_point: (..., 2, 3) derivatives of the pixels by the points.
        points_cam: (..., 3).

    Returns:
        (..., 2, 6): by a rotation vector about the pupil (p becomes exp(r) p, per radian), then by
        a translation.
    """
    x, y, z = points_cam[..., 0], points_cam[..., 1], points_cam[..., 2]
    zero = np.zeros_like(x)
    turned = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=-1)
    by_rotation = by_point @ turned.reshape(*x.shape, 3, 3)
    return np.concatenate([by_rotation, by_point], axis=-1)
