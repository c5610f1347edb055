"""A picture of a textured mesh seen at a slant, by casting a ray for every pixel."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.base.frames import Array
from alice_survey.base.run import progress
from reconstruct.mesh.texture import Textured, remapped
from reconstruct.mesh.topology import face_normals
from reconstruct.mesh.visibility import ray_scene

_WIDTH_PX = 1600
_SAMPLES = 2
"""Rays a pixel along either axis."""
_ELEVATION_DEG, _AZIMUTH_DEG = 40.0, 200.0
"""Of the eye over the horizon, and where it stands, from north over east."""
_FOV_DEG = 30.0
_ROWS = 128
_BACK = 255.0


@progress.step("draw the mesh")
def render_oblique(mesh: Textured) -> NDArray[np.uint8]:
    """Draw a mesh whose pages exist, (H, W, 3) BGR on white."""
    corners = mesh.wedges.vertex[mesh.wedges.triangles]
    scene = ray_scene(mesh.vertices, corners.astype(np.int32))
    normals = face_normals(mesh.vertices, corners.astype(np.int32))
    pages = [_read(page) for page in mesh.pages]
    eye, right, down, forward, slope, shape = _camera(mesh.vertices)
    rows, columns = shape[0] * _SAMPLES, shape[1] * _SAMPLES
    picture = np.empty((shape[0], shape[1], 3), np.float32)
    x = ((np.arange(columns) + 0.5) / columns * 2 - 1) * slope
    y = ((np.arange(rows) + 0.5) / rows * 2 - 1) * slope * rows / columns
    for top in range(0, rows, _ROWS):
        strip = y[top : top + _ROWS]
        rays = forward + x[None, :, None] * right + strip[:, None, None] * down
        colour = _shade(mesh, scene, normals, pages, eye, rays.reshape(-1, 3))
        small = colour.reshape(len(strip) // _SAMPLES, _SAMPLES, shape[1], _SAMPLES, 3)
        first = top // _SAMPLES
        picture[first : first + len(small)] = small.mean(axis=(1, 3))
    return np.asarray(np.rint(picture), np.uint8)


def _read(page: Path) -> NDArray[np.uint8]:
    picture = cv2.imread(str(page))
    if picture is None:
        raise FileNotFoundError(page)
    return np.asarray(picture, np.uint8)


def _camera(vertices: Array) -> tuple[Array, Array, Array, Array, float, tuple[int, int]]:
    """Eye, axes, half the width's slope, and rows and columns that hold the whole mesh."""
    elevation, azimuth = np.deg2rad([_ELEVATION_DEG, _AZIMUTH_DEG])
    back = np.array(
        [
            np.sin(azimuth) * np.cos(elevation),
            np.cos(azimuth) * np.cos(elevation),
            np.sin(elevation),
        ]
    )
    forward = -back
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    slope = float(np.tan(np.deg2rad(_FOV_DEG / 2)))
    sample = vertices[:: max(1, len(vertices) // 100_000)]
    middle = 0.5 * (sample.min(axis=0) + sample.max(axis=0))
    local = (sample - middle) @ np.stack([right, down, forward], axis=1)
    distance = float((np.abs(local[:, 0]) / slope - local[:, 2]).max()) * 1.03
    seen = local[:, 1] / (local[:, 2] + distance)
    middle_slope = 0.5 * (seen.min() + seen.max())
    height = (seen.max() - seen.min()) / (2 * slope) * 1.04
    rows = int(np.clip(np.ceil(_WIDTH_PX * height / 64) * 64, 128, 2 * _WIDTH_PX))
    eye = middle - distance * forward
    return eye, right, down, forward + middle_slope * down, slope, (rows, _WIDTH_PX)


def _shade(
    mesh: Textured,
    scene: Any,
    normals: Array,
    pages: list[NDArray[np.uint8]],
    eye: Array,
    rays: Array,
) -> NDArray[np.float32]:
    import open3d as o3d

    packed = np.concatenate([np.broadcast_to(eye, rays.shape), rays], axis=1).astype(np.float32)
    hit = scene.cast_rays(o3d.core.Tensor(packed))
    seen = np.flatnonzero(np.isfinite(hit["t_hit"].numpy()))
    face = hit["primitive_ids"].numpy()[seen].astype(np.int64)
    share = hit["primitive_uvs"].numpy()[seen].astype(np.float64)
    weights = np.column_stack([1 - share.sum(axis=1), share])
    uv = (mesh.uv[mesh.wedges.triangles[face]] * weights[..., None]).sum(axis=1)
    colour = np.full((len(rays), 3), _BACK, np.float32)
    light = np.array([-0.35, 0.35, 0.87])
    lit = np.clip(0.55 + 0.5 * np.abs(normals[face] @ light), 0.0, 1.05)
    for number, page in enumerate(pages):
        mine = mesh.page[face] == number
        height, width = page.shape[:2]
        at = np.column_stack([uv[mine, 0] * width, (1 - uv[mine, 1]) * height])
        found = remapped(page, at, cv2.INTER_LINEAR, cv2.BORDER_REPLICATE)
        colour[seen[mine]] = np.clip(found * lit[mine][:, None], 0, 255)
    return colour
