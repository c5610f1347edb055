"""COLMAP models of synthetic scenes that start near the truth, without a mapper."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial.transform import RigidTransform

from alice_survey.core.frames import Array
from alice_survey.core.records import RangeRecord
from camera_calib.approximation.pinhole_warp import PinholeWarp, best_warp
from reconstruct.mapping.database import Observations
from reconstruct.mapping.mapper import Mapped
from reconstruct.mapping.refraction import refract
from reconstruct.placing.alignment import align_rigid
from reconstruct.views.model_files import as_transform, colmap_pinhole, rigid3d
from tests.reconstruct.scenes import Scene

DISTANCES = RangeRecord(near_m=1.75, far_m=2.35, source="test")
POSE_ERROR = (2e-3, 5e-3)
"""Sigmas of rotations, rad, and positions, m, from which models start."""


def warped_scene(
    scene: Scene, near_m: float = 1.75, far_m: float = 2.35
) -> tuple[Observations, dict[str, PinholeWarp]]:
    """A scene as pinholes see it that are exact at one working depth."""
    warps: dict[str, PinholeWarp] = {
        name: best_warp(camera, near_m, far_m) for name, camera in scene.rig.cameras.items()
    }
    seen = Observations(
        images=scene.records,
        cameras={name: colmap_pinhole(warp.pinhole) for name, warp in warps.items()},
        taken=scene.pixels,
        pairs=(),
        warps=warps,
    )
    return seen, warps


def started(
    scene: Scene, rng: int | np.random.Generator = 1, error: tuple[float, float] = POSE_ERROR
) -> tuple[Mapped, Observations]:
    """A model that starts near the truth, and what its pinholes see."""
    seen, warps = warped_scene(scene)
    return near_truth(scene, seen, warps, np.random.default_rng(rng), error), seen


def near_truth(
    scene: Scene,
    seen: Observations,
    warps: Mapping[str, PinholeWarp],
    rng: np.random.Generator,
    error: tuple[float, float] = POSE_ERROR,
) -> Mapped:
    """A model of all stations and all points seen twice, a little away from the truth.

    Point i of the scene has the id i + 1. Stereo rigs are as given by the scene.
    """
    pinhole_from_rig = {
        name: warps[name].pinhole_from_cam * pose for name, pose in scene.rig.cam_from_rig.items()
    }
    model = _without_poses(scene, seen, pinhole_from_rig)
    reference = scene.rig.reference
    for number, record in enumerate(scene.records, 1):
        if record.camera != reference:
            continue
        true = scene.ned_from_cam[number - 1] * warps[reference].pinhole_from_cam.inv()
        moved = true * RigidTransform.from_exp_coords(
            np.concatenate([rng.normal(0, error[0], 3), rng.normal(0, error[1], 3)])
        )
        frame = model.images[number].frame_id
        model.frames[frame].rig_from_world = rigid3d(moved.inv())
        model.register_frame(frame)
    tracks: dict[int, list[tuple[int, int]]] = {}
    for picture, ids in enumerate(scene.ids, 1):
        for keypoint, point in enumerate(ids.tolist()):
            tracks.setdefault(point, []).append((picture, keypoint))
    for point, track in sorted(tracks.items()):
        if len(track) < 2:
            continue
        xyz = scene.points_ned[point] + rng.normal(0, error[1], 3)
        model.add_point3D_with_id(
            point + 1,
            pycolmap.Point3D(
                xyz=xyz, track=pycolmap.Track([pycolmap.TrackElement(*e) for e in track])
            ),
        )
    return Mapped(
        model=model,
        warps=warps,
        models=(len(seen.images),),
        scaled=True,
        baseline=model_baseline_of(pinhole_from_rig),
        rig_factor=1.0,
    )


def refracted(
    scene: Scene, folder: Path, rng: int | np.random.Generator = 1
) -> tuple[Mapped, Observations]:
    """A model that starts near the truth, adjusted to exact rays, and what its pinholes see."""
    start, seen = started(scene, rng)
    return refract(start, seen, folder)[0], seen


def _without_poses(
    scene: Scene, seen: Observations, pinhole_from_rig: Mapping[str, RigidTransform]
) -> pycolmap.Reconstruction:
    """Cameras, rig, stations and keypoints; the reference camera's is each station's first."""
    model = pycolmap.Reconstruction()
    rig = pycolmap.Rig(rig_id=1)
    rig_from_reference = pinhole_from_rig[scene.rig.reference].inv()
    sensors = {}
    for number, (name, camera) in enumerate(seen.cameras.items(), 1):
        camera.camera_id = number
        model.add_camera(camera)
        sensors[name] = camera.sensor_id
        if name == scene.rig.reference:
            rig.add_ref_sensor(camera.sensor_id)
        else:
            rig.add_sensor(camera.sensor_id, rigid3d(pinhole_from_rig[name] * rig_from_reference))
    model.add_rig(rig)
    for station in sorted({record.station for record in scene.records}):
        frame = pycolmap.Frame(frame_id=station + 1, rig_id=1)
        for number, record in enumerate(scene.records, 1):
            if record.station == station:
                frame.add_data_id(pycolmap.data_t(sensors[record.camera], number))
        model.add_frame(frame)
    for number, record in enumerate(scene.records, 1):
        keypoints = [pycolmap.Point2D(xy) for xy in seen.pixels[number - 1]]
        model.add_image(
            pycolmap.Image(
                name=record.image,
                image_id=number,
                camera_id=sensors[record.camera].id,
                frame_id=record.station + 1,
                points2D=pycolmap.Point2DList(keypoints),
            )
        )
    return model


def true_stations(scene: Scene, mapped: Mapped) -> list[RigidTransform]:
    """`ned_from_rig` of every station, at the reference pinhole."""
    reference = scene.rig.reference
    rig_from_cam = mapped.warps[reference].pinhole_from_cam
    return [
        pose * rig_from_cam.inv()
        for pose, record in zip(scene.ned_from_cam, scene.records, strict=True)
        if record.camera == reference
    ]


def model_baseline_of(pinhole_from_rig: Mapping[str, RigidTransform]) -> float:
    """Distance between the two pinholes; NaN for one alone."""
    if len(pinhole_from_rig) < 2:
        return float("nan")
    first, second = pinhole_from_rig.values()
    return float(np.linalg.norm((second * first.inv()).translation))


def pupils(mapped: Mapped, scene: Scene) -> tuple[Array, Array]:
    """Entrance pupils found and true, (N, 3), of the pictures that have a pose."""
    found, true = [], []
    for number, image in sorted(mapped.model.images.items()):
        if image.has_pose:
            warp = mapped.warps[scene.records[number - 1].camera]
            pose = as_transform(image.cam_from_world()).inv() * warp.pinhole_from_cam
            found.append(pose.translation)
            true.append(scene.ned_from_cam[number - 1].translation)
    return np.array(found), np.array(true)


def points_of(mapped: Mapped, scene: Scene) -> tuple[Array, Array]:
    """Points found and true, (P, 3), of a model that numbers them as `near_truth` does."""
    ids = sorted(mapped.model.points3D)
    points = np.array([mapped.model.points3D[i].xyz for i in ids])
    return points, scene.points_ned[np.array(ids) - 1]


def pupils_and_points(mapped: Mapped, scene: Scene) -> tuple[Array, Array, Array, Array]:
    """Entrance pupils found and true, (N, 3), and points found and true, (P, 3)."""
    return *pupils(mapped, scene), *points_of(mapped, scene)


def rigid_rms(found: Array, true: Array) -> float:
    """What is left of errors when places, (N, 3), are laid onto the true ones."""
    return float(np.sqrt(((align_rigid(found, true).apply(found) - true) ** 2).sum(axis=1).mean()))
