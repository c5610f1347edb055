"""Synthetic truth for calibrations: a rig as built, a board before it, noisy views."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.frames import Array
from camera_calib.calibrate.detect_views import Detections
from camera_calib.calibrate.from_pictures import calibrate_task
from camera_calib.calibrate.options import CalibrateOptions, task_of
from camera_calib.calibration import TargetView
from camera_calib.freedom import POSE, value
from camera_calib.rig import Rig, design_rig
from camera_calib.targets.target import parse_target
from tests.cameras import changed

DESIGN = design_rig(CameraConfig(), WaterConfig())
COLUMNS, ROWS, SQUARE_M = 11, 8, 0.03
"""A board of 12 x 9 squares has 11 x 8 inner corners."""


def board(columns: int = COLUMNS, rows: int = ROWS, square_m: float = SQUARE_M) -> Array:
    y, x = np.mgrid[:rows, :columns]
    return np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3) * square_m


BOARD = board()


def tilted(x_deg: float, y_deg: float) -> tuple[float, float, float]:
    normal = np.array([np.tan(np.deg2rad(x_deg)), np.tan(np.deg2rad(y_deg)), 1.0])
    x, y, z = (normal / np.linalg.norm(normal)).tolist()
    return x, y, z


def built_rig() -> Rig:
    """Near the design, not equal to it: lenses, ports with tilt, pose of the right camera."""
    lens = {"k1": -0.05, "k2": 0.03, "p1": 2e-4, "p2": -2e-4, "k3": 0.004}
    left = changed(
        DESIGN.cameras["left"], fx_px=3395.0, fy_px=3396.0, cx_px=1698.0, cy_px=1350.0,
        port_distance_m=0.0212, normal=tilted(0.6, -0.4), **lens,
    )  # fmt: skip
    right = changed(
        DESIGN.cameras["right"], fx_px=3380.0, fy_px=3381.0, cx_px=1685.0, cy_px=1361.0,
        port_distance_m=0.0191, normal=tilted(-0.5, 0.7), **lens,
    )  # fmt: skip
    turn = Rotation.from_rotvec(np.deg2rad([0.2, -0.3, 0.25]))
    return replace(
        DESIGN,
        cameras={"left": left, "right": right},
        cam_from_rig={
            "left": RigidTransform.identity(),
            "right": RigidTransform.from_components([-0.1003, 0.0002, -0.0003], turn),
        },
    )


def in_air(rig: Rig) -> Rig:
    cameras = {name: camera.in_air() for name, camera in rig.cameras.items()}
    return replace(rig, cameras=cameras)


def with_values(rig: Rig, values: Mapping[str, float]) -> Rig:
    """The rig with other values of some parameters of its cameras, such as `left.fx_px`."""
    cameras = {
        name: camera.with_parameters(
            {n.split(".")[1]: v for n, v in values.items() if n.startswith(f"{name}.")}
        )
        for name, camera in rig.cameras.items()
    }
    return replace(rig, cameras=cameras)


def seen_in(rig: Rig, pose: RigidTransform, points: Array) -> dict[str, Array]:
    """Pixels of points of a target in each camera of a rig."""
    return {
        name: camera.project((rig.cam_from_rig[name] * pose).apply(points))
        for name, camera in rig.cameras.items()
    }


def board_poses(
    rig: Rig,
    count: int,
    rng: np.random.Generator,
    *,
    near_m: float = 0.6,
    far_m: float = 2.2,
    tilt_deg: float = 35.0,
    points: Array = BOARD,
) -> RigidTransform:
    """Poses `rig_from_target` in which every camera sees the whole board."""
    poses: list[RigidTransform] = []
    first = rig.cameras[rig.reference]
    size = np.array([first.width_px, first.height_px])
    while len(poses) < count:
        turn = Rotation.from_rotvec(np.deg2rad(rng.uniform(-tilt_deg, tilt_deg, 3)))
        place = first.at_depth(rng.uniform(0.15, 0.85, 2) * size, rng.uniform(near_m, far_m))
        pose = RigidTransform.from_components(place - turn.apply(points.mean(axis=0)), turn)
        if all(np.all((p > 5) & (p < size - 5)) for p in seen_in(rig, pose, points).values()):
            poses.append(pose)
    return RigidTransform.concatenate(poses)


def views_of_some(
    rig: Rig, points: Array, count: int, rng: np.random.Generator
) -> list[tuple[RigidTransform, dict[str, Array]]]:
    """Poses `rig_from_target`, and pixels by camera of those that see it whole: two or more.

    The place aimed at is anywhere in the frame of each camera in turn.
    """
    views: list[tuple[RigidTransform, dict[str, Array]]] = []
    while len(views) < count:
        name = list(rig.cameras)[len(views) % len(rig.cameras)]
        camera = rig.cameras[name]
        turn = Rotation.from_euler("xyz", rng.uniform(-40, 40, 3), degrees=True)
        pixel = rng.uniform(0.0, 1.0, 2) * [camera.width_px, camera.height_px]
        place = camera.at_depth(pixel, rng.uniform(0.45, 1.4)) - turn.apply(points.mean(axis=0))
        pose = rig.cam_from_rig[name].inv() * RigidTransform.from_components(place, turn)
        whole = {}
        for n, pixels in seen_in(rig, pose, points).items():
            size = np.array([rig.cameras[n].width_px, rig.cameras[n].height_px])
            if np.all((pixels > 15) & (pixels < size - 15)):
                whole[n] = pixels
        if name in whole and len(whole) >= 2:
            views.append((pose, whole))
    return views


def views_of(
    rig: Rig,
    poses: RigidTransform,
    noise_px: float,
    rng: np.random.Generator,
    points: Array = BOARD,
) -> list[TargetView]:
    return [
        TargetView(
            name=f"{v:02d}",
            pixels={
                name: pixels + rng.normal(0.0, noise_px, pixels.shape)
                for name, pixels in seen_in(rig, poses[v], points).items()
            },
        )
        for v in range(len(poses))
    ]


def with_pixels(view: TargetView, camera: str, pixels: Array | None) -> TargetView:
    """The same view with other pixels of one camera, or without that camera."""
    rest: Mapping[str, Array] = {n: p for n, p in view.pixels.items() if n != camera}
    return replace(view, pixels=dict(rest) if pixels is None else {**rest, camera: pixels})


def posed_scene(
    rig: Rig,
    count: int,
    seed: int | list[int] = 1,
    noise_px: float = 0.1,
    points: Array = BOARD,
    **poses: float,
) -> tuple[list[TargetView], RigidTransform]:
    """Noisy views of a board in random poses (see `board_poses`), and these."""
    rng = np.random.default_rng(seed)
    found = board_poses(rig, count, rng, points=points, **poses)
    return views_of(rig, found, noise_px, rng, points), found


def scene(*arguments: Any, **options: Any) -> list[TargetView]:
    """The views of `posed_scene`."""
    return posed_scene(*arguments, **options)[0]


def differences(found: Rig, truth: Rig) -> dict[str, float]:
    """Found minus true values of all parameters that have a sigma; of turns, the turn between."""
    errors = {name: value(found, name) - value(truth, name) for name in found.sigmas}
    for name, pose in found.cam_from_rig.items():
        turn = (pose.rotation * truth.cam_from_rig[name].rotation.inv()).as_rotvec()
        between = {f"{name}.{axis}": float(one) for axis, one in zip(POSE, turn, strict=False)}
        errors |= {key: one for key, one in between.items() if key in errors}
    return errors


def errors_over_sigmas(found: Rig, truth: Rig) -> dict[str, float]:
    """Error over sigma of every parameter that was found."""
    errors = differences(found, truth)
    return {key: errors[key] / sigma for key, sigma in found.sigmas.items()}


def rig_of_corners(truth: Rig, design: CameraConfig, seed: int, stream: int) -> Rig:
    """A rig as `calibrate` finds it in air, then in water, from corners with 0.03 px of noise."""
    target = parse_target("chessboard 11x8 40mm")
    sizes = {name: (camera.width_px, camera.height_px) for name, camera in truth.cameras.items()}
    known: dict[str, Any] = {"water": True, "port": design.port, "n_glass": f"{design.n_glass}"}
    known |= {"glass_mm": f"{1e3 * design.glass_thickness_m}"}
    if design.port == "dome":
        known["dome_radius_mm"] = f"{1e3 * design.dome_radius_m}"
    lens, found = "fisheye" if design.lens == "fisheye" else "opencv5", None
    for wet, rig in enumerate((in_air(truth), truth)):
        views = scene(rig, 12, [seed, wet, stream], 0.03, target.points, near_m=0.6, far_m=1.6)
        options = CalibrateOptions(lens=lens, **(known if wet else {}))
        task = task_of(options, dict.fromkeys(sizes, "corners"), target, found)
        found = calibrate_task(task, Detections(views=tuple(views), sizes=sizes, rejections=())).rig
    assert found is not None
    return replace(found, body_from_rig=truth.body_from_rig)
