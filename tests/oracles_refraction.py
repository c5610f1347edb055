"""A refractive bundle adjustment as plain as possible, a twin of what the mapping does in turns."""

from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.block_solver import Equations
from alice_survey.core.frames import Array
from reconstruct.adjustment.normal_equations import LinearObservations
from reconstruct.adjustment.uncertainty import Uncertainty
from reconstruct.views.model_files import as_transform
from tests.reconstruct.scenes import Scene


def adjust_through_ports(
    scene: Scene, ned_from_rig: list[RigidTransform], points: Array, point_ids: Array
) -> tuple[list[RigidTransform], Array]:
    """All stations but the first, and all points, from the pixels as taken, through the ports.

    Args:
        scene: rig, pixels, and which point they show.
        ned_from_rig: where stations start; the first stays.
        points: (P, 3) where points start.
        point_ids: (P,) their numbers in the scene, sorted.

    Returns:
        `ned_from_rig` of all stations, and the points.
    """
    stations = len(ned_from_rig)
    names = [record.camera for record in scene.records]
    station_of = [record.station for record in scene.records]
    rows = []
    for ids in scene.ids:
        at = np.minimum(np.searchsorted(point_ids, ids), len(point_ids) - 1)
        rows.append((at, point_ids[at] == ids))

    def unpack(x: Array) -> tuple[list[RigidTransform], Array]:
        steps = x[: 6 * (stations - 1)].reshape(-1, 6)
        poses = [ned_from_rig[0]]
        for pose, step in zip(ned_from_rig[1:], steps, strict=True):
            turn = Rotation.from_rotvec(step[:3]) * pose.rotation
            poses.append(RigidTransform.from_components(pose.translation + step[3:], turn))
        return poses, points + x[6 * (stations - 1) :].reshape(-1, 3)

    def misses(x: Array) -> Array:
        poses, places = unpack(x)
        out = []
        for picture, (at, known) in enumerate(rows):
            cam_from_ned = scene.rig.cam_from_rig[names[picture]] * poses[station_of[picture]].inv()
            camera = scene.rig.cameras[names[picture]]
            local = cam_from_ned.apply(places[at[known]])
            out.append((camera.project(local) - scene.pixels[picture][known]).ravel())
        return np.concatenate(out)

    point = np.concatenate([at[known] for at, known in rows])
    station = np.repeat(station_of, [int(known.sum()) for _, known in rows])
    by_pose = np.kron(np.eye(stations)[station, 1:], np.ones((2, 6)))
    by_point = np.kron(np.eye(len(points))[point], np.ones((2, 3)))
    pattern = csr_matrix(np.hstack([by_pose, by_point]))
    x = np.zeros(pattern.shape[1])
    for _ in range(6):  # lsmr stops early along weak directions; a new start goes on
        found = least_squares(
            misses, x, jac="3-point", jac_sparsity=pattern, x_scale="jac", tr_solver="lsmr",
            tr_options={"atol": 1e-14, "btol": 1e-14, "maxiter": 1000},
            ftol=1e-14, xtol=1e-14, gtol=1e-14, max_nfev=30,
        )  # fmt: skip
        settled = float(np.abs(found.x - x).max()) < 1e-7
        x = found.x
        if settled:
            break
    return unpack(x)


def dense_normal_equations(linear: LinearObservations, stations: int) -> tuple[Array, Array]:
    """J^T J and J^T r of stations, points and shared parameters, in that order, from a full J."""
    observed, points = len(linear.station), len(linear.starts) - 1
    point = np.repeat(np.arange(points), np.diff(linear.starts))
    # R^T (X - c) with R' = exp(turn) R moves by R^T (X - c) x turn.
    turns = np.cross(linear.by_point, linear.arm[:, None])
    slopes = np.concatenate([turns, -linear.by_point], axis=2)
    by_pose = np.einsum("os,ork->orsk", np.eye(stations)[linear.station], slopes)
    by_point = np.einsum("op,ork->orpk", np.eye(points)[point], linear.by_point)
    parts = (by_pose, by_point, linear.rest[..., :-1])
    jacobian = np.hstack([part.reshape(2 * observed, -1) for part in parts])
    return jacobian.T @ jacobian, jacobian.T @ linear.miss.ravel()


def dense_of(equations: Equations) -> Array:
    """The whole matrix of normal equations: poses, then what is shared."""
    count, wide = equations.free.shape
    poses = np.zeros((count, wide, count, wide))
    for row, column, block in zip(equations.rows, equations.columns, equations.blocks, strict=True):
        poses[row, :, column] = block
    border = equations.border[..., :-1].reshape(count * wide, -1)
    square = poses.reshape(count * wide, count * wide)
    return np.block([[square, border], [border.T, equations.shared[:-1, :-1]]])


def laid_onto(
    model: Any,
    found: Uncertainty,
    true_stations: list[RigidTransform],
    true_points: Array,
    depth: float,
) -> tuple[Array, Array]:
    """Errors of stations, (F, 6), and points, (P, 3), once the block lies on the truth.

    The block is moved as a whole, to first order, so that the sum of squares of the stations'
    position errors and of `depth` times their turns is least. Point i + 1 of the model is point i.
    """
    poses = [as_transform(model.frames[int(f)].rig_from_world).inv() for f in found.frames]
    at, truth = RigidTransform.concatenate(poses), RigidTransform.concatenate(true_stations)
    turns, true = (at.rotation * truth.rotation.inv()).as_rotvec(), truth.translation
    misses = at.translation - true
    points = np.array([model.points3D[int(i)].xyz for i in found.point_ids])
    expected = true_points[found.point_ids - 1]
    middle = true.mean(axis=0)
    rows = np.zeros((len(true), 2, 3, 6))
    rows[:, 0, :, :3], rows[:, 1, :, 3:] = depth * np.eye(3), np.eye(3)
    rows[:, 1, :, :3] = np.cross((true - middle)[:, None], np.eye(3))
    right = np.stack([depth * turns, misses], axis=1)
    motion = np.linalg.lstsq(rows.reshape(-1, 6), right.ravel(), rcond=None)[0]
    moved = misses - motion[3:] - np.cross(motion[:3], true - middle)
    away = points - expected - motion[3:] - np.cross(motion[:3], expected - middle)
    return np.hstack([turns - motion[:3], moved]), away
