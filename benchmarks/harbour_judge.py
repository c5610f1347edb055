"""How a reconstruction of the harbour compares with the truth: figures by part, slope and views.

Products are read as any user would and moved onto the truth by the rigid alignment of the cameras;
everything they are compared with comes from `harbour_truth` and `harbour_sight`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.executor import local_executor
from alice_survey.core.frames import Array
from alice_survey.core.manifest import read_manifest
from benchmarks.harbour_masks import score_masks
from benchmarks.harbour_mosaic import score_plane
from benchmarks.harbour_scene import PARTS
from benchmarks.harbour_sight import box_of_interest, instants_that_see, surface_samples, trace
from benchmarks.harbour_survey import DISTANCE_M, Station, body_poses, harbour_rig, time_of
from benchmarks.harbour_truth import clearance, distances, moving_distance, normals
from camera_calib.camera import Camera
from reconstruct.elevation import elevation_in
from reconstruct.evaluate.scores import read_mesh
from reconstruct.pictures.undistorted import MOVING
from reconstruct.placing.track import read_track_poses

SLOPES_DEG = (0.0, 27.0, 60.0, 100.0, 180.0)
"""Bounds of classes of slope: gentle, steep, walls, overhangs."""
_BEYOND, _NEAR_PX = 5.0, 3.0
_SPACING_M = 0.05
_MOST = 30_000
_MOVING_M = 0.03
_COLUMN_M, _COLUMN_STEP_M = 0.3, 0.004
_SEED = 5
_DOWN = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, kw_only=True, eq=False)
class Truth:
    """What the survey is compared with."""

    planned: tuple[Station, ...]
    scale: int
    samples: Array
    """(N, 3) points spread evenly over the true surface."""
    part: NDArray[np.int64]
    """(N,) of each, in `PARTS`."""
    away: Array
    """(N, 3) unit normals."""
    instants: NDArray[np.int64]
    """(N,) stations that see each with both cameras."""
    spacing_m: float = _SPACING_M
    """Each sample stands for a square of this side."""

    @property
    def pixel_m(self) -> float:
        """Side of a pixel at the nominal distance."""
        return DISTANCE_M / harbour_rig(self.scale).cameras["left"].focal_in_water_px

    def cameras(self) -> list[tuple[Camera, RigidTransform]]:
        """Each camera with its true poses at all stations."""
        return _cameras(self.planned, self.scale)


def _cameras(planned: Sequence[Station], scale: int) -> list[tuple[Camera, RigidTransform]]:
    rig, bodies = harbour_rig(scale), body_poses(planned)
    return [(camera, bodies * rig.body_from_cam(name)) for name, camera in rig.cameras.items()]


def true_harbour(planned: Sequence[Station], scale: int, spacing_m: float = _SPACING_M) -> Truth:
    """Sample the true surface and find what the stations see of it."""
    samples = surface_samples(*box_of_interest(), spacing_m, np.random.default_rng(_SEED))
    away = normals(samples)
    return Truth(
        planned=tuple(planned),
        scale=scale,
        samples=samples,
        part=distances(samples)[1],
        away=away,
        instants=instants_that_see(samples, away, _cameras(planned, scale)),
        spacing_m=spacing_m,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Alignment:
    """A rigid motion onto the truth, and what is left of the cameras' errors."""

    truth_from_world: RigidTransform
    figures: dict[str, float]


def align_cameras(
    found: Mapping[str, RigidTransform], truth: Mapping[str, RigidTransform]
) -> Alignment:
    """Align the pupils with the true ones (Kabsch 1976; the scale after Umeyama 1991)."""
    names = sorted(found)
    source = np.stack([found[name].translation for name in names])
    target = np.stack([truth[name].translation for name in names])
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    turn, _ = Rotation.align_vectors(b, a)
    shift = target.mean(axis=0) - turn.apply(source.mean(axis=0))
    moved = RigidTransform.from_components(shift, turn)
    misses = moved.apply(source) - target
    scale = float((turn.apply(a) * b).sum() / (a**2).sum())
    turns = [
        (truth[name].rotation.inv() * turn * found[name].rotation).magnitude() for name in names
    ]
    return Alignment(
        truth_from_world=moved,
        figures={
            "registered": len(names),
            "rms_mm": 1e3 * float(np.sqrt((misses**2).sum(axis=1).mean())),
            "max_mm": 1e3 * float(np.linalg.norm(misses, axis=1).max()),
            "attitude_rms_deg": float(np.rad2deg(np.sqrt(np.mean(np.square(turns))))),
            # The scale that the model should be multiplied by is the inverse of its own error.
            "scale_error_ppm": 1e6 * (1.0 / scale - 1.0),
            "moved_by_m": float(np.linalg.norm(moved.apply(source.mean(axis=0))
                                               - source.mean(axis=0))),
            "turned_by_deg": float(np.rad2deg(turn.magnitude())),
        },
    )  # fmt: skip


def spread(error_m: Array, sigma_m: Array | None = None) -> dict[str, float]:
    """Of signed errors: rms, 1.4826 times the median, shares; and the same over their sigmas."""
    if not len(error_m):
        return {"count": 0}
    size = np.abs(error_m)
    found = {
        "count": len(error_m),
        "rms_mm": 1e3 * float(np.sqrt((size**2).mean())),
        "robust_mm": 1e3 * 1.4826 * float(np.median(size)),
        "median_signed_mm": 1e3 * float(np.median(error_m)),
        "beyond_20_mm": float((size > 0.02).mean()),
    }
    if sigma_m is not None:
        stated = np.isfinite(sigma_m) & (sigma_m > 0)
        over = size[stated] / sigma_m[stated]
        found |= {
            "with_sigma": float(stated.mean()),
            "over_sigma_rms": float(np.sqrt((over**2).mean())),
            "over_sigma_robust": 1.4826 * float(np.median(over)),
            "beyond_5_sigma": float((over > _BEYOND).mean()),
        }
    return found


def slope_names() -> list[str]:
    """Names of the classes of slope."""
    return [f"{a:g} to {b:g} deg" for a, b in pairwise(SLOPES_DEG)]


def slope_class(away: Array) -> NDArray[np.int64]:
    """(N,) class of the slope of each normal, NED: 0 deg is level ground, 180 a ceiling."""
    slope = np.rad2deg(np.arccos(np.clip(-away[:, 2], -1.0, 1.0)))
    found: NDArray[np.int64] = np.digitize(slope, SLOPES_DEG[1:-1])
    return found


def score_points(points: Array, sigma: Array | None, truth: Truth) -> dict[str, Any]:
    """Distances of points from the true surface: over all, by part, by slope, by instants.

    A point is the fish's or the weed's where one of them was at the time of some station, and that
    is nearer than what stays; by part, slope and instants only the others count.
    """
    pick = _some(len(points))
    points, sigma = points[pick], None if sigma is None else sigma[pick]
    error, part = distances(points)
    fish, weed = moving_near(points, len(truth.planned))
    moved = (np.minimum(fish, weed) < np.abs(error)) & (np.abs(error) > 2 * truth.pixel_m)
    figures: dict[str, Any] = {
        "all": spread(error, sigma),
        "on_fish": float((moved & (fish < weed)).mean()),
        "on_weed": float((moved & (weed <= fish)).mean()),
    }
    kept = ~moved
    points, error, part = points[kept], error[kept], part[kept]
    sigma = None if sigma is None else sigma[kept]
    on_surface = points - error[:, None] * normals(points)
    away = normals(on_surface)
    seen = instants_that_see(on_surface, away, truth.cameras())
    groups = {
        "still": np.ones(len(points), bool),
        **{name: part == number for number, name in enumerate(PARTS)},
        **{name: slope_class(away) == number for number, name in enumerate(slope_names())},
        "seen by none": seen == 0,
        "seen by 1": seen == 1,
        "seen by 2": seen == 2,
        "seen by 3 or more": seen >= 3,
    }
    figures["by"] = {
        name: spread(error[group], None if sigma is None else sigma[group])
        for name, group in groups.items()
    }
    return figures


def moving_near(points: Array, stations: int) -> tuple[Array, Array]:
    """Distances from where fish and weed were at the times of the stations; inf beyond 30 mm."""
    fish, weed = np.full(len(points), np.inf), np.full(len(points), np.inf)
    for station in range(stations):
        one, other = moving_distance(points, time_of(station))
        fish, weed = np.minimum(fish, np.abs(one)), np.minimum(weed, np.abs(other))
    fish[fish > _MOVING_M], weed[weed > _MOVING_M] = np.inf, np.inf
    return fish, weed


def _some(count: int) -> NDArray[np.int64]:
    if count <= _MOST:
        return np.arange(count)
    return np.sort(np.random.default_rng(_SEED).choice(count, _MOST, replace=False))


def completeness(near: NDArray[np.bool_], truth: Truth) -> dict[str, Any]:
    """Share of the true surface that is there, of what instants see: by part, slope, instants.

    Args:
        near: (N,) whether the reconstruction comes near each sample.
        truth: samples and who sees them.
    """
    twice = truth.instants >= 2
    slopes = slope_class(truth.away)
    groups = {
        "two or more instants": twice,
        **{name: twice & (truth.part == number) for number, name in enumerate(PARTS)},
        **{name: twice & (slopes == number) for number, name in enumerate(slope_names())},
        "one instant": truth.instants == 1,
        "three or more instants": truth.instants >= 3,
    }
    return {
        name: {"complete": float(near[group].mean()) if group.any() else None,
               "area_m2": round(float(group.sum()) * truth.spacing_m**2, 2)}
        for name, group in groups.items()
    }  # fmt: skip


def points_near(points: Array, truth: Truth) -> NDArray[np.bool_]:
    """Whether a point lies within three ground pixels of each sample."""
    if not len(points):
        return np.zeros(len(truth.samples), bool)
    gap = cKDTree(points).query(truth.samples, distance_upper_bound=_NEAR_PX * truth.pixel_m)[0]
    near: NDArray[np.bool_] = np.isfinite(gap)
    return near


def overhangs(near: NDArray[np.bool_], truth: Truth) -> dict[str, Any]:
    """Where an overhang and the ground below are both seen twice: how often both are there."""
    over = np.nonzero((truth.instants >= 2) & (truth.away[:, 2] > 0.17))[0]
    start = truth.samples[over] + 0.01 * truth.away[over]
    down = np.broadcast_to(_DOWN, start.shape)
    path = trace(start, down, np.full(len(over), 5.0))
    there = ~np.isnan(path)
    below = start[there] + path[there, None] * down[there]
    away = normals(below)
    seen = instants_that_see(below, away, truth.cameras()) >= 2
    pairs = over[there][seen]
    if not len(pairs):
        return {"columns": 0}
    samples = cKDTree(truth.samples[truth.instants >= 2])
    nearest = np.nonzero(truth.instants >= 2)[0][samples.query(below[seen])[1]]
    return {
        "columns": len(pairs),
        "upper": float(near[pairs].mean()),
        "lower": float(near[nearest].mean()),
        "both": float((near[pairs] & near[nearest]).mean()),
    }


def height_errors(points: Array) -> Array:
    """How far each point is above (positive) or below the true surface along the vertical.

    The nearest crossing of the surface counts; 0.3 m stands for none within 0.3 m.
    """
    steps = np.arange(-_COLUMN_M, _COLUMN_M + 1e-9, _COLUMN_STEP_M)
    best = np.full(len(points), _COLUMN_M)
    before = clearance(points + steps[0] * _DOWN)
    for low, high in pairwise(steps):
        after = clearance(points + high * _DOWN)
        crosses = (before > 0) != (after > 0)
        at = low + (high - low) * before[crosses] / (before[crosses] - after[crosses])
        best[crosses] = np.where(np.abs(at) < np.abs(best[crosses]), at, best[crosses])
        before = after
    return best


def judge(workspace: Path, truth: Truth) -> dict[str, Any]:
    """All figures of a workspace; a product that is not there is left out by name."""
    rig, bodies = harbour_rig(truth.scale), body_poses(truth.planned)
    records = {r.image: r for r in read_manifest(workspace / "images" / "manifest.csv")}
    poses = {name: bodies[r.station] * rig.body_from_cam(r.camera) for name, r in records.items()}
    aligned = align_cameras(read_track_poses(workspace / "sparse" / "track.csv"), poses)
    found: dict[str, Any] = {
        "pixel_mm": 1e3 * truth.pixel_m,
        "pictures": len(records),
        "cameras": aligned.figures,
    }
    moved = aligned.truth_from_world
    dense = workspace / "dense"
    if (dense / "cloud.copc.laz").exists():
        points = laspy.read(dense / "cloud.copc.laz")
        cloud, sigma = _ned(points.xyz, moved), np.asarray(points["sigma"], np.float64)
        near = points_near(cloud, truth)
        found["cloud"] = score_points(cloud, sigma, truth)
        found["cloud"]["complete"] = completeness(near, truth)
        found["cloud"]["overhangs"] = overhangs(near, truth)
    if (dense / "dem.tif").exists():
        found["dem"] = _score_dem(dense, moved, truth)
    if (workspace / "mesh" / "mesh.glb").exists():
        found["mesh"] = _score_mesh(workspace / "mesh", moved, truth)
    for name, below in (("mosaic", Path()), ("mosaic of the wall", Path("planes/wall"))):
        if (workspace / "mosaic" / below / "mosaic.tif").exists():
            found[name] = score_plane(dense / below, workspace / "mosaic" / below, moved)
    if (dense / MOVING).is_dir():
        found["masks"] = score_masks(dense / MOVING, truth.planned, truth.scale, local_executor())
    wanted = ("cloud", "dem", "mesh", "masks", "mosaic", "mosaic of the wall")
    found["left_out"] = [name for name in wanted if name not in found]
    return found


def _ned(enu: Array, moved: RigidTransform) -> Array:
    points: Array = moved.apply(enu[:, [1, 0, 2]] * [1.0, 1.0, -1.0])
    return points


def _score_dem(dense: Path, moved: RigidTransform, truth: Truth) -> dict[str, Any]:
    """Cells as points, and the errors of their heights over their sigmas."""
    elevation = elevation_in(dense)
    cells = _ned(elevation.points(), moved)
    pick = _some(len(cells))
    sigma = elevation.sigma[elevation.known][pick]
    return {
        "cell_mm": 1e3 * elevation.cell,
        "cells": len(cells),
        "height": spread(height_errors(cells[pick]), sigma),
        "distance": score_points(cells, None, truth),
    }


def _score_mesh(folder: Path, moved: RigidTransform, truth: Truth) -> dict[str, Any]:
    """Vertices, points spread over the faces, and how much of the truth the faces come near."""
    import open3d as o3d

    vertices, triangles = read_mesh(folder)
    vertices = moved.apply(vertices)
    middle = vertices.mean(axis=0)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor.from_numpy((vertices - middle).astype(np.float32)),
        o3d.core.Tensor.from_numpy(np.ascontiguousarray(triangles.astype(np.uint32))),
    )
    wanted = o3d.core.Tensor.from_numpy((truth.samples - middle).astype(np.float32))
    near = scene.compute_distance(wanted).numpy() < _NEAR_PX * truth.pixel_m
    faces = score_points(face_points(vertices, triangles, _MOST), None, truth)
    return {
        "triangles": len(triangles),
        "vertices": spread(distances(vertices[_some(len(vertices))])[0]),
        "faces": faces,
        "complete": completeness(near, truth),
        "overhangs": overhangs(near, truth),
    }


def face_points(vertices: Array, triangles: NDArray[Any], count: int) -> Array:
    """(count, 3) points spread evenly over the area of triangles."""
    rng = np.random.default_rng(_SEED)
    corners = vertices[triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(across, axis=1)
    chosen = rng.choice(len(triangles), count, p=area / area.sum())
    shares = rng.dirichlet([1.0, 1.0, 1.0], count)
    points: Array = np.einsum("nk,nkc->nc", shares, corners[chosen])
    return points
