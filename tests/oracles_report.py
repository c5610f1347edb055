"""Synthetic calibrations whose truth is known, and slow twins of what the report computes."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.frames import Array
from camera_calib.calibrate.adjust import adjust
from camera_calib.calibrate.start import locate
from camera_calib.calibration import Calibration, TargetView
from camera_calib.camera import Camera
from camera_calib.freedom import POSE, Freedom, intrinsics, of_cameras, pose_names
from camera_calib.judge.validation import HeldOut, hold_out
from camera_calib.ports.flat import FlatPort
from camera_calib.rig import Covariance, Rig, design_rig

DESIGN = design_rig(CameraConfig(port_distance_m=0.05), WaterConfig(), scale=4)
SQUARE_M = 0.03


def board_points(columns: int = 11, rows: int = 8) -> Array:
    y, x = np.mgrid[:rows, :columns]
    return np.stack([x, y, 0.0 * x], axis=-1).reshape(-1, 3) * SQUARE_M


def true_rig() -> Rig:
    """Near the design, and nothing nominal."""
    lens = {"k1": -0.06, "k2": 0.03, "p1": 4e-4, "p2": -3e-4, "k3": 0.004}
    left = {**lens, "fx_px": 849.3, "fy_px": 849.9, "cx_px": 424.5, "port_distance_m": 0.0508}
    right = {**lens, "fx_px": 845.1, "cy_px": 337.2, "normal_x": 0.01, "port_distance_m": 0.0494}
    turn = Rotation.from_euler("xyz", [0.2, -0.3, 0.25], degrees=True)
    return replace(
        DESIGN,
        cameras={
            "left": DESIGN.cameras["left"].with_parameters(left),
            "right": DESIGN.cameras["right"].with_parameters(right),
        },
        cam_from_rig={
            "left": RigidTransform.identity(),
            "right": RigidTransform.from_components([-0.1001, 0.0003, -0.0002], turn),
        },
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Synthetic:
    views: tuple[TargetView, ...]
    rig_from_target: RigidTransform
    points: Array


def synthetic_views(
    rig: Rig, count: int, noise_px: float, seed: int, points: Array | None = None
) -> Synthetic:
    """Views anywhere in the frames; points that leave a frame are NaN there."""
    rng = np.random.default_rng([41, seed])
    board = board_points() if points is None else points
    views, poses = [], []
    while len(views) < count:
        turn = Rotation.from_rotvec(np.deg2rad(rng.uniform(-30, 30, 3)))
        range_m = rng.uniform(0.6, 2.2)
        place = range_m * np.array([rng.uniform(-0.3, 0.35), rng.uniform(-0.25, 0.25), 1.0])
        pose = RigidTransform.from_components(place - turn.apply(board.mean(axis=0)), turn)
        pixels = {}
        for name, camera in rig.cameras.items():
            seen = camera.project(rig.cam_from_rig[name].apply(pose.apply(board)))
            seen = seen + rng.normal(0, noise_px, seen.shape)
            inside = np.all((seen > 0) & (seen < [camera.width_px, camera.height_px]), axis=1)
            pixels[name] = np.where(inside[:, None], seen, np.nan)
        if all(np.isfinite(p[:, 0]).sum() > 40 for p in pixels.values()):
            views.append(TargetView(name=f"{len(views):02d}", pixels=pixels))
            poses.append(pose)
    return Synthetic(
        views=tuple(views), rig_from_target=RigidTransform.concatenate(poses), points=board
    )


def adjusted(
    views: Sequence[TargetView], points: Array, start: Rig, freedom: Freedom
) -> Calibration:
    """The calibration that real code computes from some views."""
    poses = RigidTransform.concatenate([locate(start, view, points) for view in views])
    found = adjust(views, points, start, poses, freedom)
    return Calibration(
        rig=replace(found.rig, source="synthetic views"),
        target_points=points,
        views=tuple(views),
        rig_from_target=found.rig_from_target,
        residuals_px=found.residuals_px,
        weights=found.weights,
        noise_px=found.noise_px,
        freedom=freedom,
    )


def all_free(rig: Rig) -> Freedom:
    names = (*intrinsics("opencv5"), *FlatPort.places, *FlatPort.tilts)
    return Freedom(free=(*of_cameras(rig, names), *pose_names(rig)))


@cache
def usual(seed: int = 1, count: int = 14, noise_px: float = 0.1) -> Calibration:
    """A sound calibration through the ports."""
    made = synthetic_views(true_rig(), count, noise_px, seed)
    return adjusted(made.views, made.points, DESIGN, all_free(DESIGN))


@cache
def usual_held_out(seed: int = 1) -> HeldOut:
    found = usual(seed)

    def again(views: Sequence[TargetView]) -> Calibration:
        return adjusted(views, found.target_points, found.rig, all_free(DESIGN))

    held = hold_out(found.views, again, locate)
    assert held is not None
    return held


def without_ports(rig: Rig) -> Rig:
    """Pinholes with the focal length in water: what most software would start from."""
    air = {"port_distance_m": 0.0, "glass_thickness_m": 0.0, "n_water": 1.0, "n_glass": 1.0}
    level = {"normal_x": 0.0, "normal_y": 0.0}
    return replace(
        rig,
        cameras={
            name: c.with_parameters(
                {**air, **level, "fx_px": c.fx_px * c.n_water, "fy_px": c.fy_px * c.n_water}
            )
            for name, c in rig.cameras.items()
        },
    )


def moved_rig(rig: Rig, errors: dict[str, float]) -> Rig:
    """The rig with errors of some parameters; rotations turn about the camera's axes."""
    cameras, poses = dict(rig.cameras), dict(rig.cam_from_rig)
    for name in rig.cameras:
        own = {k.split(".")[1]: e for k, e in errors.items() if k.split(".")[0] == name}
        pose = np.array([own.pop(axis, 0.0) for axis in POSE])
        cameras[name] = cameras[name].with_parameters(
            {field: cameras[name].parameter(field) + error for field, error in own.items()}
        )
        old = poses[name]
        poses[name] = RigidTransform.from_components(
            old.translation + pose[3:], Rotation.from_rotvec(pose[:3]) * old.rotation
        )
    return replace(rig, cameras=cameras, cam_from_rig=poses)


def with_one_error(rig: Rig, errors: dict[str, float]) -> Rig:
    """The rig with the covariance of one error of all parameters at once: a sigma is its effect."""
    vector = np.array(list(errors.values()))
    covariance = Covariance(parameters=tuple(errors), matrix=np.outer(vector, vector))
    return replace(rig, covariance=covariance)


def some_errors(rig: Rig, seed: int, share: float = 0.02) -> dict[str, float]:
    """A small draw from a rig's covariance."""
    covariance = rig.covariance
    assert covariance is not None
    rng = np.random.default_rng([43, seed])
    draw = rng.multivariate_normal(
        np.zeros(len(covariance.parameters)), covariance.matrix, method="eigh"
    )
    return dict(zip(covariance.parameters, share * draw, strict=True))


def best_pose_by_search(true: Camera, wrong: Camera, anchors_cam: Array) -> RigidTransform:
    """The pose that makes a wrong camera see the anchors where the true one does."""
    wanted = true.project(anchors_cam)

    def pose(vector: Array) -> RigidTransform:
        return RigidTransform.from_components(vector[3:], Rotation.from_rotvec(vector[:3]))

    def misses(vector: Array) -> Array:
        return (wrong.project(pose(vector).apply(anchors_cam)) - wanted).ravel()

    exactly: Any = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}
    return pose(least_squares(misses, np.zeros(6), x_scale=[1e-3] * 6, **exactly).x)
