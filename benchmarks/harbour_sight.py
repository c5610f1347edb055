"""What a survey of the harbour sees of the true surface, by tracing rays through its distances.

Rays are straight in water from the entrance pupil, and the frame is a pinhole's with the focal
length in water: a flat port shifts both by millimetres.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from alice_survey.core.frames import Array
from benchmarks.harbour_scene import FLOOR_M
from benchmarks.harbour_truth import clearance, distances, normals
from camera_calib.camera import Camera

GRAZING = 0.26
"""Cosine between ray and normal below which a surface counts as not seen: 75 degrees."""
MAX_M = 3.5
NEAREST_M = 0.5
_MARGIN = 0.02
"""Share of the frame along its border that is left out for what the port shifts."""
_STEPS = 480
_TOUCH_M, _AHEAD_M = 4e-4, 0.008
_VOXEL_M = 0.08
_BLOCK = 50_000


def trace(origins: Array, directions: Array, longest: Array) -> Array:
    """Paths along rays to the first surface, (N,); NaN where none comes before `longest`.

    Sphere tracing (Hart 1996): each step is as long as nothing can be nearer.
    """
    path = np.zeros(len(origins))
    going = np.arange(len(origins))
    hit = np.zeros(len(origins), bool)
    for _ in range(_STEPS):
        if not len(going):
            break
        gap = clearance(origins[going] + path[going, None] * directions[going])
        close = gap < _TOUCH_M
        hit[going[close]] = True
        path[going] += np.maximum(gap, 0.0)
        going = going[~close & (path[going] < longest[going])]
    ended: Array = np.where(hit, path, np.nan)
    return ended


def surface_samples(low: Array, high: Array, spacing_m: float, rng: np.random.Generator) -> Array:
    """Points spread evenly over the true surface within a box, about one in each square.

    Random points of a thin shell about the surface, drawn onto it along its normal.
    """
    axes = [np.arange(a, b, _VOXEL_M) + _VOXEL_M / 2 for a, b in zip(low, high, strict=True)]
    centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    half = 0.003
    near = np.concatenate([
        np.abs(clearance(block)) < _VOXEL_M * np.sqrt(3.0) / 2 + half
        for block in np.array_split(centres, max(len(centres) // _BLOCK, 1))
    ])  # fmt: skip
    count = rng.poisson(_VOXEL_M**3 / (2.0 * half * spacing_m**2), near.sum())
    voxels = np.repeat(centres[near], count, axis=0)
    points = voxels + rng.uniform(-0.5, 0.5, voxels.shape) * _VOXEL_M
    shell = np.abs(clearance(points)) < half
    points = points[shell]
    distance = distances(points)[0]
    points, distance = points[np.abs(distance) < half], distance[np.abs(distance) < half]
    for _ in range(2):
        points = points - distance[:, None] * normals(points)
        distance = distances(points)[0]
    settled = np.abs(distance) < 1e-4
    inside = np.all((points > low) & (points < high), axis=1)
    kept: Array = points[settled & inside]
    return kept


def instants_that_see(
    points: Array, away: Array, cameras: Sequence[tuple[Camera, RigidTransform]]
) -> NDArray[np.int64]:
    """How many stations see each point with all of their cameras.

    Args:
        points: (N, 3) NED, on the true surface.
        away: (N, 3) its unit normals.
        cameras: each with its poses `ned_from_cam` (S,) at all stations.
    """
    count = np.zeros(len(points), np.int64)
    for station in range(len(cameras[0][1])):
        seen = np.arange(len(points))
        for camera, poses in cameras:
            if len(seen):
                kept = _in_sight(points[seen], away[seen], camera, poses[station])
                seen = seen[kept]
        count[seen] += 1
    return count


def _in_sight(
    points: Array, away: Array, camera: Camera, pose: RigidTransform
) -> NDArray[np.bool_]:
    local = pose.inv().apply(points)
    with np.errstate(divide="ignore", invalid="ignore"):
        x = camera.cx_px + camera.focal_in_water_px * local[:, 0] / local[:, 2]
        y = camera.cy_px + camera.focal_in_water_px * local[:, 1] / local[:, 2]
    edge = _MARGIN * camera.width_px
    ray = points - pose.translation
    length = np.linalg.norm(ray, axis=1)
    ray /= length[:, None]
    good = (local[:, 2] > NEAREST_M) & (length < MAX_M)
    good &= (x > edge) & (x < camera.width_px - edge)
    good &= (y > edge) & (y < camera.height_px - edge)
    good &= -(ray * away).sum(axis=1) > GRAZING
    at = np.nonzero(good)[0]
    origins = np.broadcast_to(pose.translation, (len(at), 3))
    blocked = trace(origins, ray[at], length[at] - _AHEAD_M)
    # A ray that grazes what it ends on stops a bit early: on its own surface.
    early = length[at] - blocked < _AHEAD_M / GRAZING
    good[at] = np.isnan(blocked) | early
    seen: NDArray[np.bool_] = good
    return seen


def box_of_interest() -> tuple[Array, Array]:
    """Corners of what the stations look at."""
    return np.array([-4.0, -3.0, 2.3]), np.array([1.2, 6.4, FLOOR_M + 0.1])
