"""What only the evaluation may read: the truth next to simulated pictures."""

import csv
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.base.contents import taken_from
from alice_survey.base.frames import Array
from alice_survey.base.trajectory import read_columns
from alice_survey.seafloor.terrain import Floats, Terrain

_ABOVE_M = 8.0
"""Rays start this far above the mean sea floor: far enough, and near enough for float32."""


def read_true_poses(path: Path) -> dict[str, RigidTransform]:
    """`ned_from_cam` (entrance pupil) of every picture, from `poses.csv` of the truth."""
    columns = ("north_m", "east_m", "depth_m", "qx", "qy", "qz", "qw")
    values = np.column_stack(list(read_columns(path, columns).values()))
    with taken_from(path), path.open(newline="", encoding="utf-8") as file:
        names = [row["image"] for row in csv.DictReader(file)]
        poses = RigidTransform.from_components(values[:, :3], Rotation.from_quat(values[:, 3:]))
        return {name: poses[i] for i, name in enumerate(names)}


def surface_depth(terrain: Terrain, points_ne: Array) -> Array:
    """Depth of the topmost true surface, objects included, under (N, 2) north and east.

    Returns:
        (N,) metres, positive down; NaN beyond the terrain's edge.
    """
    return _look_down(terrain, points_ne)[0]


def surface_material(terrain: Terrain, points_ne: Array) -> tuple[Array, Floats]:
    """The topmost true surface under (N, 2) north and east.

    Returns:
        Points, (N, 3) NED, and their material, (N,); NaN depth beyond the terrain's edge.
    """
    depth, hits = _look_down(terrain, points_ne)
    patch = terrain.patch()
    triangle = np.where(np.isfinite(depth), hits["primitive_ids"].numpy(), 0).astype(np.int64)
    corners = patch.material[patch.triangles[triangle]]
    uv = hits["primitive_uvs"].numpy()
    shares = np.column_stack([1 - uv.sum(axis=1), uv])
    material: Floats = (corners * shares).sum(axis=1).astype(np.float32)
    return np.column_stack([points_ne, depth]), material


def _look_down(terrain: Terrain, points_ne: Array) -> tuple[Array, Any]:
    import open3d as o3d

    places = points_ne - terrain.offset_ned[:2]
    starts = np.column_stack([places, np.full(len(places), -_ABOVE_M)])
    rays = np.column_stack([starts, np.broadcast_to([0.0, 0.0, 1.0], starts.shape)])
    hits = terrain.raycasting_scene().cast_rays(o3d.core.Tensor(rays.astype(np.float32)))
    reach = hits["t_hit"].numpy().astype(np.float64)
    depth: Array = np.where(np.isfinite(reach), reach - _ABOVE_M, np.nan) + terrain.offset_ned[2]
    return depth, hits


def surface_distance(terrain: Terrain, points_ned: Array) -> Array:
    """Distance, (N,) metres, of (N, 3) points from the nearest point of the true surface."""
    import open3d as o3d

    local = (points_ned - terrain.offset_ned).astype(np.float32)
    found = terrain.raycasting_scene().compute_distance(o3d.core.Tensor(local))
    distance: Array = found.numpy().astype(np.float64)
    return distance
