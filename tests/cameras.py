"""Cameras for tests."""

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.sim.seafloor import renderer
from camera_calib.camera import Camera
from camera_calib.lenses.opencv import OpenCVLens
from camera_calib.ports.flat import FlatPort
from camera_calib.rig import Rig


def flat_port_camera(*, width_px: int, height_px: int, **values: Any) -> Camera:
    """A camera with OpenCV's lens behind a flat port, from the fields of both."""
    lens = {name: values.pop(name) for name in OpenCVLens.parameters if name in values}
    return Camera(
        width_px=width_px, height_px=height_px, lens=OpenCVLens(**lens), port=FlatPort(**values)
    )


MANTA = flat_port_camera(
    width_px=3384, height_px=2710, fx_px=3388.0, fy_px=3388.0, cx_px=1692.0, cy_px=1355.0,
    port_distance_m=0.02, glass_thickness_m=0.01,
)  # fmt: skip
"""The camera of the project's design, behind its port."""


def changed(camera: Camera, **values: Any) -> Camera:
    """The camera with fields of its size, its lens or its port set to other values."""
    size, lens, port = (
        {f.name: values.pop(f.name) for f in fields(part) if f.name in values}
        for part in (camera, camera.lens, camera.port)
    )
    assert not values, values
    return replace(
        camera,
        **{"lens": replace(camera.lens, **lens), "port": replace(camera.port, **port), **size},
    )


def rig_of(
    cameras: Mapping[str, Camera],
    turns_deg: Mapping[str, Sequence[float]],
    places_m: Mapping[str, Sequence[float]],
    body_from_rig: RigidTransform,
) -> Rig:
    """A rig of cameras turned about its x, y and z, and at places on it."""
    poses = {
        name: RigidTransform.from_components(
            places_m[name], Rotation.from_euler("xyz", turns_deg[name], degrees=True)
        )
        for name in cameras
    }
    return Rig(
        cameras=cameras,
        cam_from_rig={name: pose.inv() for name, pose in poses.items()},
        body_from_rig=body_from_rig,
        source="truth",
    )


def pair_of(left: Camera, right: Camera, right_from_left: RigidTransform) -> Rig:
    """A stereo rig."""
    return Rig(
        cameras={"left": left, "right": right},
        cam_from_rig={"left": RigidTransform.identity(), "right": right_from_left},
        body_from_rig=RigidTransform.identity(),
        source="a test",
    )


def range_map(
    scene: renderer.Scene, camera: Camera, ned_from_cam: RigidTransform, reach_m: float = 20.0
) -> np.ndarray:
    """(H, W) metres to the renderer's sea floor along the axis, from the pupil; NaN on nothing.

    Terrain may be left out beyond `reach_m` of path along rays to the horizon.
    """
    pose = RigidTransform.from_matrix(ned_from_cam.as_matrix().reshape(1, 4, 4))
    patch = renderer._patch_in_sight(scene.terrain, camera, pose, reach_m)
    places = pose.translation - patch.origin_ned
    result = np.empty((camera.height_px, camera.width_px), dtype=np.float32)
    for first, last in renderer.ray_bands(camera, 1):
        rays = renderer.camera_rays(camera, 1, first, last)
        moments = np.zeros(len(rays.origins), dtype=np.uint8)
        world = renderer._to_world(
            rays.origins, rays.directions, moments, pose.rotation.as_matrix(), places
        )
        path = renderer._cast(patch, world)[0]
        z = rays.origins[:, 2] + path * rays.directions[:, 2]
        result[first:last] = np.where(np.isfinite(path), z, np.nan).reshape(-1, camera.width_px)
    return result
