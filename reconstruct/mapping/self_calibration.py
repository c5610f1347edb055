"""Mapping without a calibration: cameras and their rig are found from the pictures.

Pictures that look straight down on a flat floor hardly separate focal length from distance, so
nothing is freed that they do not determine: the mapper gets a simple lens, a focal length that EXIF
states is kept unless the pictures contradict it, and the full lens model is accepted only where it
comes out sane.
"""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.errors import warn
from alice_survey.core.manifest import ImageRecord
from alice_survey.core.run import progress
from camera_calib.approximation.pinhole_warp import PinholeWarp, best_warp
from camera_calib.formats.camera_files import CameraRecord, camera_of_record
from reconstruct.mapping.bundle import all_pictures, direct_solver
from reconstruct.mapping.database import Observations
from reconstruct.mapping.mapper import (
    Mapped,
    largest,
    map_from_poses,
    model_baseline,
    pictures_in_largest,
    report_left_out,
    run_mapper,
    scale_model,
    sizes,
)
from reconstruct.views.model_files import as_transform, colmap_pinhole

SIMPLE, FULL = "RADIAL", "OPENCV"
"""COLMAP's lens models while mapping and in the last adjustment."""
_MIN_STATIONS = 3
"""Stations with a camera and the first one from which its place on the rig is taken."""
_TOLERANCE = 1e-6
"""Relative change of the cost at which the calibration ends. Going on until the gradient vanishes
takes half as long again and moves a focal length of 1,700 px by 0.06 px."""
_ROUNDS = 2
"""Times that a model is put on its rig: once its cameras suit the rig, a quarter more of the
observations fit."""
_CONTRADICTION = 1.05
"""EXIF's focal length goes when freeing it lowers the mean reprojection error by this factor."""
_NOT_EXIF = "focal length from the pictures, not EXIF"
_MAX_ASPECT, _MAX_TANGENTIAL = 0.03, 0.03
"""Bounds of a sane lens: difference of the two focal lengths, tangential distortion."""
_MIN_FULL = 8
"""Pictures of a camera from which the full lens model is tried."""


def map_self_calibrated(
    seen: Observations, exif_focal: Collection[str], folder: Path, seed: int
) -> Mapped:
    """Map with cameras calibrated from the pictures; several cameras become one rigid rig.

    They are first mapped freely. The means of their poses relative to the first are the rig on
    which the model is then put and adjusted, holding it constant, after which one adjustment
    refines that one rig with all else. The distance of the first two is then the unit of length.

    Args:
        seen: cameras to start from (`SIMPLE`), keypoints as found, matches.
        exif_focal: cameras whose focal length EXIF states.
        folder: for scratch files.
        seed: of the mapper.
    """
    known = set(exif_focal) == set(seen.cameras)
    found = run_mapper(seen, None, folder, seed, free="distortion" if known else "all")
    if known and pictures_in_largest(found) < seen.connected:
        freed = run_mapper(seen, None, folder, seed, free="all")
        if pictures_in_largest(freed) > pictures_in_largest(found):
            found, known = freed, False
    model = largest(found, seen.images)
    notes: list[str] = []
    names, cam_from_rig = list(seen.cameras), None
    stations = Counter(record.station for record in seen.images)
    if len(names) > 1 and max(stations.values()) == 1:
        notes.append("cameras that took no pictures together: each calibrates itself")
    elif len(names) > 1:
        cam_from_rig = rig_from_model(model, seen.images, names)
        if cam_from_rig is None:
            notes.append(
                f"fewer than {_MIN_STATIONS} stations have both {names[0]} and one of "
                f"{', '.join(names[1:])}: mapped without a rig"
            )
            warn(notes[0])
    if cam_from_rig is not None:
        for _ in range(_ROUNDS):
            calibrated = {
                names[number - 1]: pycolmap.Camera(camera.todict())
                for number, camera in model.cameras.items()
            }
            model = map_from_poses(
                replace(seen, cameras={**seen.cameras, **calibrated}),
                cam_from_rig,
                poses_on_rig(model, seen.images, cam_from_rig),
                folder,
                seed,
                free="distortion" if known else "all",
            )
            if known and not model.num_points3D():  # so wrong that no rig suits the cameras
                freed_rig = map_self_calibrated(seen, (), folder, seed)
                return replace(freed_rig, notes=(*freed_rig.notes, _NOT_EXIF))
        found = [model, *found[1:]]
    model, kept = calibrate_fully(model, keep_focal=known)
    if known:
        notes.append("focal length as EXIF states it" if kept else _NOT_EXIF)
    baseline, factor = float("nan"), 1.0
    if cam_from_rig is not None:
        factor, baseline = 1.0 / model_baseline(model), 1.0
        scale_model(model, factor)
        notes.append("the rig calibrated itself; unless scaled, its baseline is the unit of length")
    warps = {
        name: self_calibrated_warp(model.cameras[number])
        for number, name in enumerate(names, 1)
        if number in model.cameras
    }
    _to_pinholes(model, {names.index(name) + 1: warp for name, warp in warps.items()})
    return Mapped(
        model=model,
        warps=warps,
        models=sizes(found),
        scaled=False,
        baseline=baseline,
        rig_factor=factor,
        notes=(*notes, *report_left_out(found)),
    )


def self_calibrated_warp(camera: pycolmap.Camera) -> PinholeWarp:
    """A camera that COLMAP calibrated, without distortion; its pinhole has the same centre.

    COLMAP's models here are OpenCV's, with its pixels counted from the same corner as ours.

    Raises:
        CalibrationError: a value is out of any camera's range.
    """
    record = CameraRecord(
        camera_id=int(camera.camera_id),
        model=str(camera.model_name),
        width_px=camera.width,
        height_px=camera.height,
        params=tuple(float(p) for p in camera.params),
    )
    # Of one centre: exact at every distance.
    return best_warp(camera_of_record(Path("pictures"), record), 1.0, 1.0)


def rig_from_model(
    model: pycolmap.Reconstruction, images: Sequence[ImageRecord], cameras: Sequence[str]
) -> dict[str, RigidTransform] | None:
    """The mean pose of every camera in the first's frame, over the stations that have both.

    Returns:
        `cam_from_rig` of all, or None where fewer than 3 stations have one of them and the first.
    """
    poses = _poses_by_station(model, images)
    first, *others = cameras
    rig = {first: RigidTransform.identity()}
    for name in others:
        stations = [p for p in poses.values() if first in p and name in p]
        if len(stations) < _MIN_STATIONS:
            return None
        rig[name] = _mean_pose([p[name] * p[first].inv() for p in stations])
    return rig


def poses_on_rig(
    model: pycolmap.Reconstruction,
    images: Sequence[ImageRecord],
    cam_from_rig: Mapping[str, RigidTransform],
) -> dict[int, RigidTransform]:
    """`rig_from_world` of stations, each from the first of the rig's cameras that has a pose."""
    return {
        station: next(cam_from_rig[n].inv() * poses[n] for n in cam_from_rig if n in poses)
        for station, poses in _poses_by_station(model, images).items()
    }


def _poses_by_station(
    model: pycolmap.Reconstruction, images: Sequence[ImageRecord]
) -> dict[int, dict[str, RigidTransform]]:
    """`cam_from_world` by camera of every station that has one, stations in order."""
    poses: dict[int, dict[str, RigidTransform]] = {}
    for number, record in enumerate(images, 1):
        if number in model.images and model.images[number].has_pose:
            pose = as_transform(model.images[number].cam_from_world())
            poses.setdefault(record.station, {})[record.camera] = pose
    return dict(sorted(poses.items()))


def _mean_pose(poses: Sequence[RigidTransform]) -> RigidTransform:
    """The middle of poses of which some may be astray."""
    turns = Rotation.concatenate([pose.rotation for pose in poses])
    shifts = np.stack([pose.translation for pose in poses])
    for _ in range(2):
        away = (turns * turns.mean().inv()).magnitude()
        keep = np.flatnonzero(away <= 3.0 * np.median(away) + 1e-9)
        turns, shifts = turns[keep], shifts[keep]
    return RigidTransform.from_components(np.median(shifts, axis=0), turns.mean())


@progress.step("calibrate from the pictures")
def calibrate_fully(
    model: pycolmap.Reconstruction, *, keep_focal: bool
) -> tuple[pycolmap.Reconstruction, bool]:
    """Refine everything, the one rig included, with the full lens model where it comes out sane.

    Args:
        model: with lenses of the model `SIMPLE`; not changed.
        keep_focal: keep the focal lengths, unless freeing them explains the pictures better.

    Returns:
        The refined model, and whether its focal lengths were kept.
    """
    freed = _best_lens(model, focal=True)
    if not keep_focal:
        return freed, False
    held = _best_lens(model, focal=False)
    gain = held.compute_mean_reprojection_error() / freed.compute_mean_reprojection_error()
    return (held, True) if gain < _CONTRADICTION else (freed, False)


def _best_lens(model: pycolmap.Reconstruction, *, focal: bool) -> pycolmap.Reconstruction:
    simple = pycolmap.Reconstruction(model)
    _adjust(simple, focal=focal)
    counts = {
        number: sum(i.camera_id == number and i.has_pose for i in model.images.values())
        for number in model.cameras
    }
    if min(counts.values()) < _MIN_FULL:
        return simple
    full = pycolmap.Reconstruction(simple)
    for camera in full.cameras.values():
        f, cx, cy, k1, k2 = camera.params
        camera.model = FULL
        camera.params = [f, f, cx, cy, k1, k2, 0.0, 0.0]
    _adjust(full, focal=focal)
    for camera in full.cameras.values():
        fx, fy, _, _, _, _, p1, p2 = camera.params
        sane = abs(fx / fy - 1.0) <= _MAX_ASPECT and max(abs(p1), abs(p2)) <= _MAX_TANGENTIAL
        if not sane:
            return simple
    return full


def _adjust(model: pycolmap.Reconstruction, *, focal: bool) -> None:
    config = all_pictures(model)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = direct_solver(pycolmap.BundleAdjustmentOptions())
    options.refine_focal_length = focal
    options.ceres.solver_options.function_tolerance = _TOLERANCE
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()


def _to_pinholes(model: pycolmap.Reconstruction, of_camera: Mapping[int, PinholeWarp]) -> None:
    """Make the model one of ideal pinholes, in place."""
    for image in model.images.values():
        warp, points = of_camera[image.camera_id], image.points2D
        ideal = warp.to_pinhole(np.array([p.xy for p in points]).reshape(-1, 2))
        for point, xy in zip(points, ideal, strict=True):
            point.xy = xy if np.all(np.isfinite(xy)) else np.full(2, -1e6)
    for number, warp in of_camera.items():
        camera, pinhole = model.cameras[number], colmap_pinhole(warp.pinhole)
        camera.model = pinhole.model
        camera.width, camera.height = pinhole.width, pinhole.height
        camera.params = pinhole.params
    model.update_point_3d_errors()
