"""The pinhole that comes nearest to a flat-port camera over a range of distances.

A flat port has no single centre of projection. A pinhole of focal length f n_water whose centre is
moved along the port's normal comes close; pictures warped to it at one working range suit any
software that knows pinholes, at a residual that `residual_px` states.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import RigidTransform

from alice_survey.base.frames import Array
from camera_calib.camera import Camera

_GRID = 15


@dataclass(frozen=True, kw_only=True)
class VirtualPinhole:
    """An ideal pinhole in water, with the axes of its camera and another centre."""

    width_px: int
    height_px: int
    focal_px: float
    cx_px: float
    cy_px: float
    centre_z_m: float
    """Position of the centre along the camera's axis, in front of (+) or behind (-) the pupil."""
    working_range_m: float
    """Distance from the entrance pupil along the axis at which the warp is exact."""
    centre_x_m: float = 0.0
    centre_y_m: float = 0.0
    """Offset from the axis: not zero where the port is tilted."""

    @property
    def virtual_from_cam(self) -> RigidTransform:
        """From the flat-port camera's frame to the pinhole's."""
        return RigidTransform.from_translation(
            [-self.centre_x_m, -self.centre_y_m, -self.centre_z_m]
        )

    def project(self, points_cam: Array) -> Array:
        """Ideal pixels, (..., 2), of points (..., 3) in the flat-port camera's frame."""
        z = points_cam[..., 2:] - self.centre_z_m
        sideways = points_cam[..., :2] - np.array([self.centre_x_m, self.centre_y_m])
        pixels: Array = self.focal_px * sideways / z + np.array([self.cx_px, self.cy_px])
        return pixels

    def at_depth(self, pixels: Array, depth_m: Array | float) -> Array:
        """Points (..., 3) in the flat-port camera's frame where pixels (..., 2) see z = depth_m."""
        z = np.broadcast_to(np.asarray(depth_m, dtype=np.float64), pixels.shape[:-1])
        slopes = (pixels - np.array([self.cx_px, self.cy_px])) / self.focal_px
        sideways = slopes * (z - self.centre_z_m)[..., None]
        sideways = sideways + np.array([self.centre_x_m, self.centre_y_m])
        return np.concatenate([sideways, z[..., None]], axis=-1)


def best_pinhole(
    camera: Camera, near_m: float, far_m: float, working_range_m: float | None = None
) -> VirtualPinhole:
    """The pinhole with the least rms residual over the frame and a range of distances.

    Its centre is sought along the port's normal through the entrance pupil.

    Args:
        camera: the flat-port camera.
        near_m: nearest distance from the entrance pupil along the axis.
        far_m: farthest.
        working_range_m: where the warp is exact; the harmonic mean of near and far (equal parallax
            to either) when not given.
    """
    working = working_range_m or 2.0 / (1.0 / near_m + 1.0 / far_m)
    depths = 1.0 / np.linspace(1.0 / far_m, 1.0 / near_m, 7)

    def at(shift_m: float) -> VirtualPinhole:
        x_m, y_m, z_m = (shift_m * component for component in camera.port.axis_cam)
        return VirtualPinhole(
            width_px=camera.width_px,
            height_px=camera.height_px,
            focal_px=camera.focal_in_water_px,
            cx_px=camera.cx_px,
            cy_px=camera.cy_px,
            centre_x_m=x_m,
            centre_y_m=y_m,
            centre_z_m=z_m,
            working_range_m=working,
        )

    reach = 2.0 * float(np.linalg.norm(camera.front_cam)) + 1e-6
    best = minimize_scalar(
        lambda shift: float(np.sqrt(np.nanmean(residual_px(camera, at(shift), depths) ** 2))),
        bounds=(-reach, reach),
        method="bounded",
        options={"xatol": 1e-7},
    )
    return at(float(best.x))


def residual_px(camera: Camera, pinhole: VirtualPinhole, depths_m: Array) -> Array:
    """Distance of a warped picture's pixels from where the pinhole would see each point.

    Args:
        camera: the flat-port camera.
        pinhole: its stand-in.
        depths_m: (D,) distances along the axis from the entrance pupil.

    Returns:
        (D, 15, 15) distances over the frame in pixels of the pinhole.
    """
    pixels = camera.frame_grid(_GRID, _GRID)
    ideal = pinhole.project(camera.at_depth(pixels, pinhole.working_range_m))
    rows = [
        np.linalg.norm(pinhole.project(camera.at_depth(pixels, d)) - ideal, axis=-1)
        for d in depths_m
    ]
    return np.stack(rows)
