"""The pinhole that stands in for a camera, and the warp of its pictures to that pinhole.

A port has no single centre of projection, but every ray is straight in the water: at depth z before
the centre of an axial pinhole it is at `s + t z`, where `s` is its offset in the plane of that
centre and `t` its slope. The pinhole therefore sees its spot at `c + f (t + s / z)`. Pictures that
are warped to be right at one working range suit any software that knows pinholes; what the warp
leaves at other depths is `f s (1/z - 1/z0)`, exactly. The best centre makes the offsets least. They
are zero where a camera has one centre: without a port, or behind a dome centred on the pupil.
"""

from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array
from camera_calib.camera import Camera, camera_from_json
from camera_calib.lenses.values import FOCAL_AND_CENTRE

_GRID = 15
"""Rays along each side of the frame."""
_MAX_GROWTH = 1.5
"""A pinhole's picture has at most this many times the width and height of the one taken: the edge
of a lens of 120 degrees would take 1.65 times, its corners 3 times, most of it blur."""
_HALVINGS = 40
_ROUNDING_M = 1e-12
"""Offsets below are those of rays that meet in one point."""


@dataclass(frozen=True, kw_only=True)
class Pinhole:
    """An ideal pinhole camera; pixels count from the outer corner of the first pixel."""

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height."""
        return self.width_px, self.height_px

    @property
    def focal_px(self) -> float:
        """Geometric mean of the two focal lengths."""
        return float(np.sqrt(self.fx_px * self.fy_px))

    @property
    def matrix(self) -> Array:
        """(3, 3) that takes rays to pixels."""
        return np.array([[self.fx_px, 0, self.cx_px], [0, self.fy_px, self.cy_px], [0, 0, 1]])

    @property
    def numbers(self) -> Array:
        """(4,) fx, fy, cx, cy."""
        return np.array([self.fx_px, self.fy_px, self.cx_px, self.cy_px])

    def pixels(self, slopes: Array) -> Array:
        """Pixels (..., 2) of rays with slopes x/z and y/z (..., 2)."""
        return slopes * self.numbers[:2] + self.numbers[2:]

    def slopes(self, pixels: Array) -> Array:
        """The inverse of `pixels`."""
        return (pixels - self.numbers[2:]) / self.numbers[:2]

    def project(self, points: Array) -> Array:
        """Pixels (..., 2) of points (..., 3) in the pinhole's frame; NaN unless z is positive."""
        z = np.where(points[..., 2:] > 0, points[..., 2:], np.nan)
        return self.pixels(points[..., :2] / z)

    def resize(self, width_px: int, height_px: int) -> "Pinhole":
        """The same view in a picture of another size."""
        growth = np.tile([width_px / self.width_px, height_px / self.height_px], 2)
        numbers = zip(FOCAL_AND_CENTRE, (self.numbers * growth).tolist(), strict=True)
        return Pinhole(width_px=width_px, height_px=height_px, **dict(numbers))


@dataclass(frozen=True, kw_only=True)
class PinholeWarp:
    """A calibrated camera, and the axial pinhole in water that stands in for it.

    Axes of the pinhole are the camera's; its centre lies elsewhere.
    """

    camera: Camera
    pinhole: Pinhole
    centre_m: tuple[float, float, float]
    """Centre of the pinhole in the camera's frame, whose origin is the entrance pupil."""
    working_range_m: float
    """Distance from the entrance pupil along the axis at which the warp is exact."""

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the picture as taken."""
        return self.camera.width_px, self.camera.height_px

    @property
    def pinhole_from_cam(self) -> RigidTransform:
        """From the camera's frame to the pinhole's."""
        return RigidTransform.from_translation([-one for one in self.centre_m])

    @property
    def working_depth_m(self) -> float:
        """The working range from the pinhole's centre."""
        return self.working_range_m - self.centre_m[2]

    def lines(self, taken: Array) -> tuple[Array, Array]:
        """The straight rays in water of pixels (..., 2) as taken, in the pinhole's frame.

        Returns:
            Slopes, (..., 2), and offsets in the plane of the centre, (..., 2) metres: at depth z a
            ray is at `offset + slope * z`. NaN where the camera sees nothing forward.
        """
        return _lines(self.camera, taken, np.array(self.centre_m))

    def to_pinhole(self, taken: Array, depth_m: Array | float | None = None) -> Array:
        """Where the pinhole sees what the camera sees.

        Args:
            taken: (..., 2) pixels as taken.
            depth_m: distances from the entrance pupil along the axis; the working range unless
                given, as pictures are warped.

        Returns:
            (..., 2) pixels of the pinhole; NaN where the camera sees nothing.
        """
        slope, offset = self.lines(taken)
        depth = np.asarray(self.working_range_m if depth_m is None else depth_m)
        return self.pinhole.pixels(slope + offset / (depth - self.centre_m[2])[..., None])

    def from_pinhole(self, warped: Array) -> Array:
        """The inverse of `to_pinhole` at the working range."""
        depth = np.full((*warped.shape[:-1], 1), self.working_depth_m)
        points = np.concatenate([self.pinhole.slopes(warped) * depth, depth], axis=-1)
        return self.camera.project(points + np.array(self.centre_m))

    @cached_property
    def largest_offset_m(self) -> float:
        """Largest distance by which rays of the frame miss the centre; 0 where all meet there."""
        _, offset = self.lines(self.camera.frame_grid(2 * _GRID, 2 * _GRID))
        largest = float(np.nanmax(np.linalg.norm(offset, axis=-1)))
        return largest if largest > _ROUNDING_M else 0.0

    @cached_property
    def cut_share(self) -> float:
        """Share of the frame as taken that the pinhole's picture leaves out."""
        seen = self.to_pinhole(self.camera.frame_grid(4 * _GRID, 4 * _GRID))
        inside = ((seen >= -0.5) & (seen <= np.array(self.pinhole.size_px) + 0.5)).all(axis=-1)
        return float(1.0 - inside.mean())

    def to_json(self) -> dict[str, Any]:
        """All fields as JSON values."""
        return {
            "camera": self.camera.to_json(),
            "pinhole": asdict(self.pinhole),
            "centre_m": list(self.centre_m),
            "working_range_m": self.working_range_m,
        }


def warp_from_json(data: dict[str, Any]) -> PinholeWarp:
    """The inverse of `PinholeWarp.to_json`.

    Raises:
        KeyError: a value is missing.
        ValueError: one is wrong.
    """
    x_m, y_m, z_m = map(float, data["centre_m"])
    try:
        camera = camera_from_json(data["camera"])
    except CalibrationError as error:
        raise ValueError(str(error)) from None
    return PinholeWarp(
        camera=camera,
        pinhole=Pinhole(**data["pinhole"]),
        centre_m=(x_m, y_m, z_m),
        working_range_m=float(data["working_range_m"]),
    )


def best_warp(
    camera: Camera, near_m: float, far_m: float, working_range_m: float | None = None
) -> PinholeWarp:
    """The pinhole whose centre the rays of the whole frame miss least, in the rms.

    The focal length keeps the ground resolution on the axis, and the picture holds what the frame
    shows at the working range, up to `_MAX_GROWTH`.

    Args:
        camera: any whose rays are straight in water.
        near_m: nearest distance from the entrance pupil along the axis.
        far_m: farthest.
        working_range_m: where the warp is exact; the harmonic mean of near and far (equal parallax
            to either) when not given.

    Raises:
        CalibrationError: the frame sees nothing.
    """
    working = working_range_m or 2.0 / (1.0 / near_m + 1.0 / far_m)
    # In the plane of a centre c a ray passes it by offset - c_xy + c_z slope: linear in c.
    slope, offset = _lines(camera, camera.frame_grid(_GRID, _GRID), np.zeros(3))
    if not np.isfinite(slope[_GRID // 2, _GRID // 2]).all():
        raise CalibrationError("camera: the middle of its frame sees nothing through lens and port")
    known = np.isfinite(slope).all(axis=-1)
    slope, offset = slope[known], offset[known]
    rows = np.zeros((len(slope), 2, 3))
    rows[:, 0, 0] = rows[:, 1, 1] = 1.0
    rows[:, :, 2] = -slope
    centre = np.linalg.lstsq(rows.reshape(-1, 3), offset.ravel(), rcond=None)[0]
    x_m, y_m, z_m = (float(one) for one in centre)
    focal = camera.focal_in_water_px
    warp = PinholeWarp(
        camera=camera,
        pinhole=Pinhole(width_px=1, height_px=1, fx_px=focal, fy_px=focal, cx_px=0.0, cy_px=0.0),
        centre_m=(x_m, y_m, z_m),
        working_range_m=working,
    )
    return replace(warp, pinhole=_fitted_to_frame(warp))


def residual_px(warp: PinholeWarp, depths_m: Array) -> Array:
    """Distance of a warped picture's pixels from where the pinhole would see each point.

    Args:
        warp: camera and pinhole.
        depths_m: (D,) distances along the axis from the entrance pupil.

    Returns:
        (D, 15, 15) distances over the frame in pixels of the pinhole.
    """
    pixels = warp.camera.frame_grid(_GRID, _GRID)
    residuals = [warp.to_pinhole(pixels, d) - warp.to_pinhole(pixels) for d in depths_m]
    return np.asarray(np.linalg.norm(np.stack(residuals), axis=-1))


def _lines(camera: Camera, taken: Array, centre_m: Array) -> tuple[Array, Array]:
    point, direction = camera.unproject(taken)
    point = point - centre_m
    forward = np.where(direction[..., 2:] > 0, direction[..., 2:], np.nan)
    slope = direction[..., :2] / forward
    return slope, point[..., :2] - point[..., 2:] * slope


def _fitted_to_frame(warp: PinholeWarp) -> Pinhole:
    """The warp's pinhole, whose axis is at pixel 0, 0, with a picture that holds the frame."""
    middle, border = np.array(warp.size_px) / 2, warp.camera.border()
    near, far = np.zeros(len(border)), np.ones(len(border))
    for _ in range(_HALVINGS):  # a part of the frame may lie beyond the reach of the lens
        share = (near + far) / 2
        seen = np.isfinite(warp.to_pinhole(middle + share[:, None] * (border - middle))).all(axis=1)
        near, far = np.where(seen, share, near), np.where(seen, far, share)
    edge = warp.to_pinhole(middle + near[:, None] * (border - middle))
    at = warp.to_pinhole(middle)
    low = np.maximum(edge.min(axis=0), at - _MAX_GROWTH * middle)
    high = np.minimum(edge.max(axis=0), at + _MAX_GROWTH * middle)
    width, height = np.ceil(high - low - 1e-6).astype(int).tolist()
    centre = {"cx_px": float(-low[0]), "cy_px": float(-low[1])}
    return replace(warp.pinhole, width_px=width, height_px=height, **centre)
