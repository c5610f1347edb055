"""Slow, obvious twins of the mesh kernels, and scenes for meshes and single stereo pairs."""

import math
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.frames import Array
from camera_calib.camera import Camera
from camera_calib.rig import Rig
from tests.cameras import flat_port_camera
from tests.oracles_dense import texture


def implicit_value(points: Array, normals: Array, weights: Array, node: Array) -> float:
    """`splat` at one node."""
    away = node - points
    square = (away**2).sum(axis=1)
    shares = np.where(square <= 2.5**2, weights * np.exp(-0.5 * square / 0.8**2), 0.0)
    return shares @ (away * normals).sum(axis=1) / shares.sum() if shares.any() else math.nan


def spread_value(corners: Array, values: Array, x: float, y: float) -> Array | None:
    """`spread_corners` of one triangle at one spot: None outside."""
    matrix = np.vstack([corners.T, np.ones(3)])
    shares = np.linalg.solve(matrix, [x, y, 1.0])
    return shares @ values if (shares >= 0).all() else None


def boxes_overlap(corner: Array, box: Array) -> bool:
    """Whether any two boxes share a pixel."""
    before = ((corner + box)[:, None] <= corner).any(axis=2)
    apart: Any = before | before.T
    return not apart[np.triu_indices(len(box), 1)].all()


SIZE = (320, 256)


def port_rig(port_distance_m: float = 0.03, glass_m: float = 0.01, n_water: float = 1.34) -> Rig:
    """Two small cameras 0.1 m apart behind ports that are a little tilted."""
    normal = np.array([0.02, -0.015, 1.0])
    normal /= np.linalg.norm(normal)
    ported = port_distance_m > 0 or glass_m > 0
    camera = flat_port_camera(
        width_px=SIZE[0], height_px=SIZE[1], fx_px=320.0, fy_px=321.0, cx_px=161.0, cy_px=127.0,
        k1=-0.04, k2=0.02, port_distance_m=port_distance_m, glass_thickness_m=glass_m,
        n_water=n_water, normal=tuple(normal) if ported else (0.0, 0.0, 1.0),
    )  # fmt: skip
    turned = Rotation.from_rotvec([0.002, -0.004, 0.003])
    return Rig(
        cameras={"left": camera, "right": camera},
        cam_from_rig={
            "left": RigidTransform.identity(),
            "right": RigidTransform.from_components([-0.1, 0.001, 0.002], turned),
        },
        body_from_rig=RigidTransform.identity(),
        source="a test",
    )


def depth_of(x: Array, y: Array) -> Array:
    """The surface before the left camera, metres."""
    return 1.2 + 0.05 * x - 0.08 * y + 0.02 * np.sin(5 * x) * np.cos(4 * y)


def surface_points(camera: Camera, world_from_cam: RigidTransform, pixels: Array) -> Array:
    """Where the rays of pixels (N, 2), through the port, meet `depth_of`; world of the left."""
    start, ray = camera.unproject(pixels)
    start, ray = world_from_cam.apply(start), world_from_cam.rotation.apply(ray)
    along = (1.2 - start[:, 2]) / ray[:, 2]
    for _ in range(30):
        at = start + along[:, None] * ray
        along = along + (depth_of(at[:, 0], at[:, 1]) - at[:, 2]) / ray[:, 2]
    return start + along[:, None] * ray


def station_pictures(rig: Rig, noise: float, seed: int) -> tuple[Array, Array]:
    """Both pictures of `depth_of` under random smooth texture, with white noise."""
    rng = np.random.default_rng(seed)
    step, half = 0.002, 1.2
    picture = texture(rng, half, step, (0.02, 0.05))
    pictures = []
    for name, camera in rig.cameras.items():
        pixels = camera.pixel_centres().reshape(-1, 2)
        points = surface_points(camera, rig.cam_from_rig[name].inv(), pixels)
        x, y = ((points[:, k] + half) / step - 0.5 for k in (0, 1))
        shape = (camera.height_px, camera.width_px)
        at = (axis.astype(np.float32).reshape(shape) for axis in (x, y))
        grey = cv2.remap(picture, *at, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        level = 120 + 30 * grey + noise * rng.normal(size=shape)
        pictures.append(np.repeat(np.clip(np.rint(level), 0, 255)[..., None], 3, axis=2))
    return pictures[0].astype(np.uint8), pictures[1].astype(np.uint8)
