"""Slow, obvious twins for focus and stereo through a flat port."""

import numpy as np
from numpy.typing import NDArray

from camera_calib.camera import Camera
from camera_calib.fov.focus import FocusedLens
from camera_calib.rig import Rig
from tests.cameras import changed
from tests.oracles_camera import project_by_shortest_path

Array = NDArray[np.float64]


def air_slope(camera: Camera, start: Array, point: Array) -> Array:
    """dx/dz and dy/dz, in air, of the ray from a point in water that ends at `start` near z = 0.

    It is the shortest optical path to a pupil that sits at `start`: the port is as much nearer to
    it as `start` lies along the normal.
    """
    moved = changed(
        camera,
        port_distance_m=camera.parameter("port_distance_m")
        - float(start @ np.array(camera.port.axis_cam)),
    )
    pixel = project_by_shortest_path(moved, point - start)
    return (pixel - [camera.cx_px, camera.cy_px]) / [camera.fx_px, camera.fy_px]


def traced_blur_px(camera: Camera, lens: FocusedLens, point: Array, along: Array) -> float:
    """Extent of a point's blur on the sensor along a unit direction (2,), by its outermost rays.

    Rays to opposite edges of the aperture are traced through the port; where they meet the plane
    that the lens is focused on, the (perfect) lens images them one to one, magnified by image
    distance over focus distance.
    """
    image_m = 1.0 / (1.0 / lens.focal_m - 1.0 / lens.focus_m)
    radius_m = lens.focal_m / lens.f_number / 2
    met = []
    for side in (-1.0, 1.0):
        edge = np.append(side * radius_m * along, 0.0)
        met.append(edge[:2] + lens.focus_m * air_slope(camera, edge, point))
    return abs(float((met[1] - met[0]) @ along)) / lens.focus_m * image_m / lens.pixel_m


def triangulated_depth_sigma_m(
    rig: Rig, floor_z_m: float, sigma_px: float, draws: int, rng: np.random.Generator
) -> float:
    """Scatter of the depth of one point below the pair, found again and again from noisy pixels.

    Each coordinate has sigma / sqrt(2) of noise, so that disparities have sigma. The point is the
    middle of the shortest line between both rays.
    """
    left, right = (rig.cameras[name] for name in list(rig.cameras)[:2])
    names = list(rig.cameras)
    right_from_left = rig.cam_from_rig[names[1]] * rig.cam_from_rig[names[0]].inv()
    left_from_right = right_from_left.inv()
    point = np.append(left_from_right.translation[:2] / 2, floor_z_m)

    def noisy(pixel: Array) -> Array:
        return pixel + rng.normal(0.0, sigma_px / np.sqrt(2.0), (draws, 2))

    p, u = left.unproject(noisy(left.project(point)))
    q, v = right.unproject(noisy(right.project(right_from_left.apply(point))))
    q, v = left_from_right.apply(q), left_from_right.rotation.apply(v)
    across = np.cross(u, v)
    square = (across**2).sum(axis=1)
    s = (np.cross(q - p, v) * across).sum(axis=1) / square
    t = (np.cross(q - p, u) * across).sum(axis=1) / square
    depths = (p + s[:, None] * u + q + t[:, None] * v)[:, 2] / 2
    return float(depths.std())
