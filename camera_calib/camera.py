"""A camera: a lens, and the port through which it looks into the water.

Axes are the camera's (right, down, forward) with the origin at the entrance pupil. Pixels count
from the outer corner of the first pixel, whose centre is (0.5, 0.5).
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np
from pydantic import ConfigDict

from alice_survey.core.artefacts import check_type
from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array
from camera_calib import optics
from camera_calib.lenses.opencv import OpenCVLens
from camera_calib.lenses.values import MAX_PX, LensValues
from camera_calib.ports.flat import FlatPort
from camera_calib.ports.none import NO_PORT
from camera_calib.ports.values import PortValues

_Part = TypeVar("_Part", LensValues, PortValues)


@dataclass(frozen=True, kw_only=True)
class Camera:
    """One camera: its picture's size, its lens as in air, and its port.

    Example:
        >>> import alice_survey as alice
        >>> camera = alice.Camera(
        ...     width_px=1600, height_px=1200,
        ...     lens=alice.OpenCVLens(fx_px=1500, fy_px=1500, cx_px=800, cy_px=600),
        ...     port=alice.FlatPort(port_distance_m=0.02, glass_thickness_m=0.01, n_water=1.34),
        ... )
        >>> camera.project([[0.0, 0.0, 2.0], [0.5, 0.2, 2.0], [0.0, 0.0, -1.0]]).round(1)
        array([[ 800. ,  600. ],
               [1315.9,  806.4],
               [   nan,    nan]])
    """

    width_px: int
    height_px: int
    lens: LensValues
    port: PortValues = NO_PORT

    def __post_init__(self) -> None:
        if min(self.width_px, self.height_px) < 1:
            raise CalibrationError("camera: width_px, height_px, fx_px and fy_px must be positive")
        if max(self.width_px, self.height_px) > MAX_PX:
            raise CalibrationError(f"camera: a size or focal length exceeds {MAX_PX:g} px")

    @property
    def fx_px(self) -> float:
        """Focal length along the rows, in air."""
        return self.lens.fx_px

    @property
    def fy_px(self) -> float:
        """Focal length along the columns, in air."""
        return self.lens.fy_px

    @property
    def cx_px(self) -> float:
        """Principal point."""
        return self.lens.cx_px

    @property
    def cy_px(self) -> float:
        """Principal point."""
        return self.lens.cy_px

    @property
    def n_water(self) -> float:
        """Index of refraction of the water behind the port; 1 without a port."""
        return self.port.n_water

    @property
    def refracts(self) -> bool:
        """Whether light bends at the port; not so in air, or for a camera calibrated in water."""
        return self.port.refracts

    @property
    def focal_in_water_px(self) -> float:
        """Pixels per tangent of the ray in water, on the axis."""
        return self.port.magnification * 0.5 * (self.fx_px + self.fy_px)

    @property
    def front_cam(self) -> Array:
        """(3,) foremost point of the port's outer surface, from which altitudes are measured."""
        return np.array(self.port.front_cam)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Parameters that can be calibrated, ordered as in `project_jacobian`."""
        return (*self.lens.parameters, *self.port.parameters)

    def parameter(self, name: str) -> float:
        """The value of one of `parameters`."""
        return (self.lens if name in self.lens.parameters else self.port).parameter(name)

    def with_parameters(self, values: Mapping[str, float]) -> "Camera":
        """The same camera with some of `parameters` set to other values.

        Raises:
            CalibrationError: a name is unknown or a value out of range.
        """
        unknown = sorted(set(values) - set(self.parameters))
        if unknown:
            raise CalibrationError(f"camera: no parameter is called {', '.join(unknown)}")
        lens = {name: value for name, value in values.items() if name in self.lens.parameters}
        port = {name: value for name, value in values.items() if name in self.port.parameters}
        return replace(
            self,
            lens=self.lens.with_parameters(lens) if lens else self.lens,
            port=self.port.with_parameters(port) if port else self.port,
        )

    def in_water(self, n_water: float) -> "Camera":
        """The same camera in other water; one without a port is left as it is."""
        if "n_water" not in self.parameters:
            return self
        return self.with_parameters({"n_water": n_water})

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
        pixels: Array = optics.project(points.reshape(-1, 3), self.lens, self.port)
        return pixels.reshape(*points.shape[:-1], 2)

    def project_jacobian(self, points_cam: Array) -> tuple[Array, Array, Array]:
        """Project points, with the analytic derivatives of the pixels.

        Args:
            points_cam: (..., 3) points in the camera frame, metres.

        Returns:
            Pixels, (..., 2); their derivatives by the point, (..., 2, 3), px/m; and by each of
            `parameters`, (..., 2, P). NaN where `project` is.
        """
        points = np.ascontiguousarray(points_cam, dtype=np.float64)
        pixels, by_point, by_parameter = optics.project_jacobian(
            points.reshape(-1, 3), self.lens, self.port
        )
        shape = points.shape[:-1]
        return (
            pixels.reshape(*shape, 2),
            by_point.reshape(*shape, 2, 3),
            by_parameter.reshape(*shape, 2, len(self.parameters)),
        )

    def unproject(self, pixels: Array) -> tuple[Array, Array]:
        """The ray in water that ends at each pixel.

        Args:
            pixels: (..., 2).

        Returns:
            Points on the port's outer surface (the pupil without a port), (..., 3) metres, and unit
            directions in water, (..., 3), both in the camera frame; NaN where the lens model has no
            inverse or light is totally reflected.
        """
        array = np.ascontiguousarray(pixels, dtype=np.float64)
        points, directions = optics.unproject(array.reshape(-1, 2), self.lens, self.port)
        shape = (*array.shape[:-1], 3)
        return points.reshape(shape), directions.reshape(shape)

    def at_depth(self, pixels: Array, depth_m: Array | float) -> Array:
        """The points, (..., 3), where the rays of pixels (..., 2) reach z = depth_m in `cam`."""
        points, directions = self.unproject(pixels)
        reach = (np.asarray(depth_m) - points[..., 2]) / directions[..., 2]
        return points + reach[..., None] * directions

    def in_air(self) -> "Camera":
        """The same camera without its port."""
        return replace(self, port=NO_PORT)

    def downscale(self, scale: int) -> "Camera":
        """The same camera with pixels `scale` times as large; partial ones are cut off."""
        return replace(
            self,
            width_px=self.width_px // scale,
            height_px=self.height_px // scale,
            lens=self.lens.downscale(scale),
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
        """All values as JSON values; lens and port by the names of their kinds."""
        values = {
            "width_px": self.width_px,
            "height_px": self.height_px,
            "lens": self.lens.model,
            **asdict(self.lens),
            "port": self.port.shape,
            **asdict(self.port),
        }
        return {k: list(v) if isinstance(v, tuple) else v for k, v in values.items()}


@dataclass(frozen=True, kw_only=True)
class _Size:
    __pydantic_config__ = ConfigDict(extra="forbid", strict=True)

    width_px: int
    height_px: int


def _kind(part: str, name: object, known: Mapping[str, type[_Part]]) -> type[_Part]:
    if not (isinstance(name, str) and name in known):
        raise CalibrationError(f"{part} = {name!r} is none of {', '.join(known)}")
    return known[name]


def camera_from_json(data: Mapping[str, Any]) -> Camera:
    """The inverse of `Camera.to_json`; without a kind, the lens is OpenCV's and the port flat.

    Raises:
        CalibrationError: a key is missing or unknown, or a value is out of range.
    """
    values = dict(data)
    try:
        lens = _kind("lens", values.pop("lens", OpenCVLens.model), optics.LENSES)
        port = _kind("port", values.pop("port", FlatPort.shape), optics.PORTS)
        of_lens = {f.name: values.pop(f.name) for f in fields(lens) if f.name in values}
        of_port = {f.name: values.pop(f.name) for f in fields(port) if f.name in values}
        size = check_type(_Size, values)
        return Camera(
            width_px=size.width_px,
            height_px=size.height_px,
            lens=check_type(lens, of_lens),
            port=check_type(port, of_port),
        )
    except (ValueError, CalibrationError) as error:
        raise CalibrationError(f"camera: {str(error).removeprefix('camera: ')}") from None


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
