"""Slow, obvious twins of triangulation, and a rig before two interfaces whose truth is known."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.frames import Array
from camera_calib.camera import Camera
from camera_calib.triangulate import Triangulation, reproject, triangulate
from tests.cameras import changed, flat_port_camera

LENS = flat_port_camera(
    width_px=2704,
    height_px=1520,
    fx_px=1230.0,
    fy_px=1228.0,
    cx_px=1350.0,
    cy_px=750.0,
    k1=-0.2,
    k2=0.05,
    p1=-0.0008,
    p2=0.0005,
    n_water=1.0,
)
SIZE_M = np.array([0.40, 0.21, 0.20])
"""The tank: x right, y to the front camera, z down; the water surface is z = 0."""


def triangulate_slowly(
    cameras: Sequence[Camera], poses: Sequence[RigidTransform], pixels: Array, start: Array
) -> Array:
    """One point of least squared reprojection error, by scipy with numeric slopes."""

    def miss(point: Array) -> Array:
        seen = [c.project(pose.apply(point)) for c, pose in zip(cameras, poses, strict=True)]
        return (np.stack(seen) - pixels).ravel()

    found = least_squares(miss, start, jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return np.asarray(found.x)


def nearest_slowly(origins: Array, directions: Array) -> Array:
    """One point nearest to rays, (C, 3) each, as a linear least-squares problem."""
    across = [np.eye(3) - np.outer(d, d) for d in directions]
    rows = np.concatenate(across)
    right = np.concatenate([a @ o for a, o in zip(across, origins, strict=True)])
    return np.linalg.lstsq(rows, right, rcond=None)[0]


@dataclass(frozen=True, eq=False)
class Tank:
    """Fixed cameras in air that look into one body of water."""

    cameras: tuple[Camera, ...]
    poses: tuple[RigidTransform, ...]
    """Camera from world."""

    def triangulate(self, pixels: Array) -> Triangulation:
        return triangulate(self.cameras, self.poses, pixels)

    def seen(self, points_world: Array) -> Array:
        """(C, N, 2) exact pixels."""
        return reproject(self.cameras, self.poses, points_world)


def looking(position: Array, target: Array, right: Array) -> RigidTransform:
    """Camera from world, of a camera at a place that looks at another, its x axis near `right`."""
    z = (target - position) / np.linalg.norm(target - position)
    x = right - (right @ z) * z
    x /= np.linalg.norm(x)
    rotation = Rotation.from_matrix(np.stack([x, np.cross(z, x), z]))
    return RigidTransform.from_components(-rotation.apply(position), rotation)


def behind_interface(
    lens: Camera,
    cam_from_world: RigidTransform,
    points_world: Array,
    *,
    n_water: float = 1.333,
    glass_m: float = 0.0,
) -> Camera:
    """A camera in air with the plane of points of its interface, on the air's side, as its port."""
    points_cam = cam_from_world.apply(points_world)
    middle = points_cam.mean(axis=0)
    normal = np.linalg.svd(points_cam - middle)[2][2]
    normal *= np.sign(normal @ middle)
    return changed(
        lens, n_water=n_water, glass_thickness_m=glass_m, port_distance_m=float(normal @ middle)
    ).with_parameters({"normal_x": float(normal[0]), "normal_y": float(normal[1])})


def true_tank(
    glass_m: Sequence[float] = (0.0, 0.006), n_water: float = 1.333, lean_m: float = 0.008
) -> Tank:
    """Two cameras, above the water and before a front wall that leans, exactly where they are."""
    x, y, z = SIZE_M
    tops = np.array([[0, 0, 0], [x, 0, 0], [x, y, 0], [0, y, 0]], dtype=np.float64)
    fronts = np.array([[0, y, 0], [x, y, 0], [x, y - lean_m, z], [0, y - lean_m, z]])
    middle = SIZE_M / 2
    poses = (
        looking(np.array([0.19, 0.08, -0.21]), middle, np.array([-1.0, 0.02, 0.01])),
        looking(np.array([0.18, 0.40, 0.08]), middle, np.array([1.0, 0.02, 0.01])),
    )
    cameras = tuple(
        behind_interface(LENS, pose, points, n_water=n_water, glass_m=glass)
        for pose, points, glass in zip(poses, (tops, fronts), glass_m, strict=True)
    )
    return Tank(cameras=cameras, poses=poses)


def points_in_tank(rng: np.random.Generator, count: int) -> Array:
    """Places in the water, away from the walls."""
    return SIZE_M * rng.uniform(0.1, 0.75, (count, 3))
