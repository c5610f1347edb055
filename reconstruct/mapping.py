"""Incremental mapping with COLMAP: one model of ideal pinholes, on one rigid rig if there is one.

The mapper runs on one core, so that the same input gives the same bytes whatever the number of
threads; only work on single pictures and pairs is spread.
"""

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.errors import ReconstructionError, warn
from alice_survey.frames import Array
from alice_survey.manifest import ImageRecord
from reconstruct.database import Observations, rigid3d, write_database
from reconstruct.lens import Lens, self_calibrated_lens

SELF_CALIBRATION = "OPENCV"
"""COLMAP's camera model for pictures without a calibration."""
_LEAST_ANGLE_DEG = 6.0
"""Of the first pair: nadir pictures with 60 % overlap rarely reach COLMAP's 16 degrees."""
_LEAST_STATIONS = 3
"""Stations with both cameras from which a rig is taken."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Mapped:
    """The largest model that the pictures gave."""

    model: pycolmap.Reconstruction
    lenses: Mapping[str, Lens]
    """By camera, for the cameras of the model."""
    models: tuple[int, ...]
    """Pictures in each model found, most first; all but the first were dropped."""
    scaled: bool
    """Lengths are metres, since the rig is known."""
    baseline: float
    """Distance between the first two pinhole centres, in units of the model; NaN for one camera."""
    rig_factor: float
    """By what the model was multiplied to give the rig its known (or unit) size back."""
    notes: tuple[str, ...] = ()


def map_calibrated(
    seen: Observations,
    cam_from_rig: Mapping[str, RigidTransform],
    lenses: Mapping[str, Lens],
    folder: Path,
    seed: int,
) -> Mapped:
    """Map with cameras and rig held constant: the rig gives the scale.

    Args:
        seen: pinhole cameras, keypoints as the pinholes see them, matches.
        cam_from_rig: poses of the flat-port cameras on the rig.
        lenses: between those cameras and their pinholes, whose centres they shift.
        folder: for scratch files.
        seed: of the mapper.
    """
    pinhole_from_rig = {
        name: lenses[name].pinhole_from_cam * cam_from_rig[name] for name in seen.cameras
    }
    found = _run_mapper(seen, pinhole_from_rig, folder, seed, calibrated=True)
    model = _largest(found, seen.images)
    known = _baseline(list(pinhole_from_rig.values())[:2])
    factor = 1.0
    if len(seen.cameras) > 1:
        factor = known / model_baseline(model)
        if abs(factor - 1.0) > 1e-12:
            scale_model(model, factor)
    return Mapped(
        model=model,
        lenses=lenses,
        models=_sizes(found),
        scaled=len(seen.cameras) > 1,
        baseline=known,
        rig_factor=factor,
    )


def map_self_calibrated(seen: Observations, folder: Path, seed: int) -> Mapped:
    """Map with cameras calibrated from the pictures; two cameras become one rigid rig.

    Two cameras are first mapped freely. The mean of their relative poses is the rig of a second
    mapping that holds it constant, after which one adjustment refines that one rig with all else.
    The baseline is then the model's unit of length.

    Args:
        seen: cameras to start from, keypoints as found, matches.
        folder: for scratch files.
        seed: of the mapper.
    """
    found = _run_mapper(seen, None, folder, seed, calibrated=False)
    model = _largest(found, seen.images)
    notes: tuple[str, ...] = ()
    baseline, factor = float("nan"), 1.0
    if len(seen.cameras) == 2:
        cam_from_rig = rig_from_model(model, seen.images, list(seen.cameras))
        if cam_from_rig is None:
            notes = ("fewer than 3 stations have both cameras: mapped without a rig",)
            warn(notes[0])
        else:
            cameras = {
                name: pycolmap.Camera(model.cameras[number].todict())
                for number, name in enumerate(seen.cameras, 1)
                if number in model.cameras
            }
            second = replace(seen, cameras={**seen.cameras, **cameras})
            found = _run_mapper(second, cam_from_rig, folder, seed, calibrated=False)
            model = _largest(found, seen.images)
            _adjust(model)
            factor = 1.0 / model_baseline(model)
            scale_model(model, factor)
            baseline = 1.0
            notes = ("the baseline of the self-calibrated stereo rig is the unit of length",)
    lenses: dict[str, Lens] = {
        name: self_calibrated_lens(model.cameras[number])
        for number, name in enumerate(seen.cameras, 1)
        if number in model.cameras
    }
    _to_pinholes(
        model, {n: lenses[name] for n, name in enumerate(seen.cameras, 1) if name in lenses}
    )
    return Mapped(
        model=model,
        lenses=lenses,
        models=_sizes(found),
        scaled=False,
        baseline=baseline,
        rig_factor=factor,
        notes=notes,
    )


def rig_from_model(
    model: pycolmap.Reconstruction, images: Sequence[ImageRecord], cameras: Sequence[str]
) -> dict[str, RigidTransform] | None:
    """The mean pose of the second camera in the first's frame, over the stations that have both.

    Returns:
        `cam_from_rig` of both, or None where fewer than 3 stations have both.
    """
    poses: dict[int, dict[str, RigidTransform]] = {}
    for number, record in enumerate(images, 1):
        if number in model.images and model.images[number].has_pose:
            pose = as_transform(model.images[number].cam_from_world())
            poses.setdefault(record.station, {})[record.camera] = pose
    first, second = cameras
    relative = [p[second] * p[first].inv() for _, p in sorted(poses.items()) if len(p) == 2]
    if len(relative) < _LEAST_STATIONS:
        return None
    turns = Rotation.concatenate([r.rotation for r in relative])
    shifts = np.stack([r.translation for r in relative])
    for _ in range(2):  # a station that went astray must not turn the rig
        away = (turns * turns.mean().inv()).magnitude()
        keep = np.flatnonzero(away <= 3.0 * np.median(away) + 1e-9)
        turns, shifts = turns[keep], shifts[keep]
    mean = RigidTransform.from_components(np.median(shifts, axis=0), turns.mean())
    return {first: RigidTransform.identity(), second: mean}


def as_transform(pose: Any) -> RigidTransform:
    """A COLMAP pose as scipy's."""
    return RigidTransform.from_components(
        np.asarray(pose.translation), Rotation.from_quat(np.asarray(pose.rotation.quat))
    )


def model_baseline(model: pycolmap.Reconstruction) -> float:
    """Distance between the first two cameras of the model's rig; NaN without one."""
    for rig in model.rigs.values():
        for _, sensor_from_rig in sorted(
            rig.non_ref_sensors.items(), key=lambda item: int(item[0].id)
        ):
            return float(np.linalg.norm(sensor_from_rig.translation))
    return float("nan")


def scale_model(model: pycolmap.Reconstruction, factor: float) -> None:
    """Multiply all lengths of a model, its rig's too, in place."""
    rigs = {rig_id: _sensor_poses(rig) for rig_id, rig in model.rigs.items()}
    model.transform(pycolmap.Sim3d(factor, pycolmap.Rotation3d(), np.zeros(3)))
    for rig_id, poses in rigs.items():
        for sensor, pose in poses.items():
            now = model.rigs[rig_id].sensor_from_rig(sensor).translation
            if not np.allclose(now, factor * pose, rtol=1e-9, atol=0):
                raise RuntimeError("COLMAP did not scale the rig with the model")


def _sensor_poses(rig: Any) -> dict[Any, Array]:
    return {s: np.array(p.translation) for s, p in rig.non_ref_sensors.items()}


def _run_mapper(
    seen: Observations,
    cam_from_rig: Mapping[str, RigidTransform] | None,
    folder: Path,
    seed: int,
    *,
    calibrated: bool,
) -> list[pycolmap.Reconstruction]:
    """All models, largest first."""
    pycolmap.logging.minloglevel = 2
    scratch = folder / "mapper"
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    write_database(scratch / "database.db", seen, cam_from_rig)
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    options.num_threads = options.mapper.num_threads = 1
    options.extract_colors = False
    options.min_model_size = 3
    options.mapper.init_min_tri_angle = _LEAST_ANGLE_DEG
    options.ba_refine_sensor_from_rig = False
    if cam_from_rig is not None:
        # A station at the end of a line may share with its neighbour only what the two pictures
        # of one station saw: such points carry it.
        options.triangulation.ignore_two_view_tracks = False
        # The first pair is of arbitrary scale, in which the rig does not fit; what it failed to
        # triangulate within a station is tried again once the scale has settled.
        options.triangulation.re_min_ratio = 0.9
    if calibrated:
        options.ba_refine_focal_length = False
        options.ba_refine_extra_params = False
        options.mapper.abs_pose_refine_focal_length = False
        options.mapper.abs_pose_refine_extra_params = False
    total = len({r.station for r in seen.images}) if cam_from_rig else len(seen.images)
    found = _with_bar(
        "mapping",
        total,
        lambda step: pycolmap.incremental_mapping(
            scratch / "database.db", scratch, scratch, options, next_image_callback=step
        ),
    )
    models = [pycolmap.Reconstruction(model) for model in found.values()]
    shutil.rmtree(scratch)
    return sorted(models, key=lambda m: (-m.num_reg_images(), -m.num_points3D()))


def _largest(
    models: Sequence[pycolmap.Reconstruction], images: Sequence[ImageRecord]
) -> pycolmap.Reconstruction:
    if not models:
        raise ReconstructionError(
            f"no model: no two of the {len(images)} pictures share enough of the same spots; "
            "check that they overlap, or raise max_features under [reconstruct] in survey.toml"
        )
    return models[0]


def _sizes(models: Sequence[pycolmap.Reconstruction]) -> tuple[int, ...]:
    return tuple(int(model.num_reg_images()) for model in models)


def _baseline(cam_from_rig: Sequence[RigidTransform]) -> float:
    if len(cam_from_rig) < 2:
        return float("nan")
    first, second = cam_from_rig
    return float(np.linalg.norm((second * first.inv()).translation))


def _adjust(model: pycolmap.Reconstruction) -> None:
    """Refine everything, the one rig and the cameras included, in place."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.solver_options.num_threads = 1
    pycolmap.bundle_adjustment(model, options)


def _to_pinholes(model: pycolmap.Reconstruction, lenses: Mapping[int, Lens]) -> None:
    """Make the model one of ideal pinholes, in place."""
    for image in model.images.values():
        lens = lenses[image.camera_id]
        points = image.points2D
        ideal = lens.to_pinhole(np.array([p.xy for p in points]).reshape(-1, 2))
        for point, xy in zip(points, ideal, strict=True):
            point.xy = xy if np.all(np.isfinite(xy)) else np.full(2, -1e6)
    for number, lens in lenses.items():
        camera, pinhole = model.cameras[number], lens.pinhole.colmap
        camera.model = pinhole.model
        camera.width, camera.height = pinhole.width, pinhole.height
        camera.params = pinhole.params
    model.update_point_3d_errors()


def _with_bar(label: str, total: int, work: Callable[[Callable[[], None]], Any]) -> Any:
    """Do work that reports every step, with a bar that shows how far it is."""
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(label, total=total)
        return work(lambda: bar.advance(task))


__all__ = [
    "Mapped",
    "as_transform",
    "map_calibrated",
    "map_self_calibrated",
    "model_baseline",
    "rig_from_model",
    "rigid3d",
    "scale_model",
]
