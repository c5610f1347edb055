"""What only the evaluation may read: the truth next to simulated pictures.

Poses and cameras also give the overlaps that a flight reached.
"""

from collections.abc import Iterable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation
from shapely.geometry import Polygon

from alice_survey.core.artefacts import read_csv
from alice_survey.core.contents import taken_from
from alice_survey.core.frames import Array
from alice_survey.core.manifest import ImageRecord
from alice_survey.core.run import progress
from alice_survey.core.trajectory import read_columns
from alice_survey.sim.seafloor.terrain import Floats, Terrain
from camera_calib.rig import Rig
from missions.values.footprint import footprint_polygon
from missions.values.plan_file import Plan

_ABOVE_M = 8.0
"""Rays start this far above the mean sea floor: far enough, and near enough for float32."""


def read_true_poses(path: Path) -> dict[str, RigidTransform]:
    """`ned_from_cam` (entrance pupil) of every picture, from `poses.csv` of the truth."""
    columns = ("north_m", "east_m", "depth_m", "qx", "qy", "qz", "qw")
    values = np.column_stack(list(read_columns(path, columns).values()))
    with taken_from(path):
        names = [row["image"] for _, row in read_csv(path, exact=True)[1]]
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
    return np.asarray(found.numpy().astype(np.float64))


@progress.step("measure a pixel on the ground")
def ground_pixel_m(rig: Rig, cameras: Mapping[str, str], poses: Mapping[str, RigidTransform],
                   terrain: Terrain) -> float:  # fmt: skip
    """Median side of a pixel on the true sea floor below the cameras.

    Args:
        rig: true cameras.
        cameras: camera by picture.
        poses: true `ned_from_cam` by picture.
        terrain: true sea floor.
    """
    names = [name for name in poses if name in cameras]
    pupils = np.array([poses[name].translation for name in names])
    below = surface_depth(terrain, pupils[:, :2]) - pupils[:, 2]
    focal = np.array([rig.cameras[cameras[name]].focal_in_water_px for name in names])
    return float(np.nanmedian(below / focal))


def overlaps_reached(
    triggers: Path,
    plan: Plan,
    rig: Rig,
    records: Iterable[ImageRecord],
    poses: Mapping[str, RigidTransform],
) -> dict[str, float]:
    """Shares of a footprint seen again by the next picture of its line.

    Footprints are of the reference camera at its true poses, exactly through the port, on a level
    sea floor of the mean depth.

    Args:
        triggers: file of the flight's exposures, with station and line.
        plan: that was flown.
        rig: true cameras.
        records: of the pictures.
        poses: true `ned_from_cam` by picture.

    Returns:
        `forward_mean` and `forward_least`; nothing where no line has two pictures.
    """
    camera = rig.cameras[rig.reference]
    image_of = {r.station: r.image for r in records if r.camera == rig.reference}
    lines: dict[int, list[Polygon]] = {}
    columns = read_columns(triggers, ("station", "line")).values()
    for station, line in np.column_stack(list(columns)).astype(int).tolist():
        polygon = footprint_polygon(camera, poses[image_of[station]], plan.seafloor_depth_m)
        lines.setdefault(line, []).append(polygon)
    shares = [
        one.intersection(other).area / one.area
        for line in lines.values()
        for one, other in pairwise(line)
    ]
    return {"forward_mean": float(np.mean(shares)), "forward_least": min(shares)} if shares else {}
