"""Mapping with COLMAP: one model of ideal pinholes, on one rigid rig if there is one.

Stations of a known stereo rig are mapped all at once (`global_mapper`), everything else, and what
that does not explain, incrementally. Adjustments run on one core, so that the same input gives
the same bytes whatever the number of threads; only work on single pictures and pairs is spread.
Of several models those that share stations become one. Others are kept apart in it where a rig
gives them the same scale, for navigation to join; else they are left out and reported by name.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pycolmap
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.errors import ReconstructionError, warn
from alice_survey.core.executor import SERIAL, Executor
from alice_survey.core.manifest import ImageRecord
from alice_survey.core.run import progress
from camera_calib.approximation.pinhole_warp import PinholeWarp
from reconstruct.mapping.arrays import observations
from reconstruct.mapping.database import Observations, new_folder, scratch_database
from reconstruct.mapping.global_mapper import (
    adjust,
    frame_poses,
    map_globally,
    triangulate_and_adjust,
)
from reconstruct.pictures.files import list_names
from reconstruct.views.model_files import as_transform, rigid3d

Free = Literal["nothing", "distortion", "all"]
"""What of the cameras is refined: `all` is distortion and focal length."""

_FEW_MATCHES = 12
"""Matches that suffice in a second try, when the first one lost pictures (COLMAP: 15 to 100)."""
_REPAIRS = 3
_COLLAPSED = 0.05
"""Share of the usual depth below which a point lies in the camera."""
_MAX_COLLAPSED = 0.1
"""Share of a frame's points; the sea floor never comes so near."""
_MIN_ANGLE_DEG = 6.0
"""Least angle of the first pair: nadir pictures with 60 % overlap rarely reach COLMAP's 16 degrees.
"""
_GROWTH = 1.4
"""Growth of a model between adjustments of all of it (COLMAP: 1.1). On a known rig half the time
goes: 17.8 to 8.4 s on 24 stations, for the same rms. Where cameras calibrate themselves none to a
quarter goes, for the same pictures and errors: 22.2 to 16.5, 5.3 to 4.3, 60.6 to 60.0 s."""
_MAX_LOST = 0.02
"""Share of connected pictures lost by the global mapper from which the incremental one is tried."""
_MAX_REPROJECTION_PX = 2.0
_MAX_SPREAD = 0.1
"""Radians, and lengths over the models' usual distance to the floor, by which shared stations may
disagree about where the second model lies in the first."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Mapped:
    """What the pictures gave."""

    model: pycolmap.Reconstruction
    """The largest model; on a calibrated rig also the others, wherever they are."""
    warps: Mapping[str, PinholeWarp]
    """Each camera of the model, and its pinhole."""
    models: tuple[int, ...]
    """Pictures in each model found, most first."""
    scaled: bool
    """Lengths are metres, since the rig is known."""
    baseline: float
    """Distance between the first two pinhole centres, in units of the model; NaN for one camera."""
    rig_factor: float
    """Factor on the model that gives the rig its known (or unit) size back."""
    notes: tuple[str, ...] = ()
    """What a reader of the result must know."""


def map_calibrated(
    seen: Observations,
    cam_from_rig: Mapping[str, RigidTransform],
    folder: Path,
    seed: int,
    *,
    executor: Executor = SERIAL,
) -> Mapped:
    """Map with cameras and rig held constant: the rig gives the scale.

    Args:
        seen: pinhole cameras, keypoints as the pinholes see them, matches.
        cam_from_rig: poses of the cameras on the rig; their pinholes' centres lie elsewhere.
        folder: for scratch files.
        seed: of the mapper.
        executor: where tasks run for work on pairs; the result does not depend on it.
    """
    pinhole_from_rig = {
        name: warp.pinhole_from_cam * cam_from_rig[name] for name, warp in seen.warps.items()
    }
    found, notes = _map_rig(seen, pinhole_from_rig, folder, seed, executor)
    model, kept = largest(found, seen.images), found
    scaled, known, factor = len(seen.cameras) > 1, float("nan"), 1.0
    if scaled:
        model, *_ = kept = side_by_side(found)
        first, second, *_ = pinhole_from_rig.values()
        known = float(np.linalg.norm((second * first.inv()).translation))
        factor = known / model_baseline(model)
        if abs(factor - 1.0) > 1e-12:
            scale_model(model, factor)
    return Mapped(
        model=model,
        warps=seen.warps,
        models=sizes(found),
        scaled=scaled,
        baseline=known,
        rig_factor=factor,
        notes=(*notes, *report_left_out(kept)),
    )


def _map_rig(
    seen: Observations,
    cam_from_rig: Mapping[str, RigidTransform],
    folder: Path,
    seed: int,
    executor: Executor,
) -> tuple[list[pycolmap.Reconstruction], list[str]]:
    """Models, largest first, and how they came about."""
    total = seen.connected
    one_station = len({record.station for record in seen.images}) == 1
    if len(seen.cameras) < 2 or one_station:
        why = "there is one station" if one_station else "one camera has no stereo pairs"
        found = run_mapper(seen, cam_from_rig, folder, seed, free="nothing")
        return found, [f"incremental mapping: {why}"]
    found = _globally(seen, cam_from_rig, folder, seed, executor)
    faults = faults_of(found, total)
    if not faults:
        return found, ["global mapping of stations"]
    again = run_mapper(seen, cam_from_rig, folder, seed, free="nothing")
    best = max(found, again, key=lambda ms: (not (ms and unsound(ms[0])), pictures_in_largest(ms)))
    note = (
        f"global mapping {' and '.join(faults)}: incremental mapping "
        f"{'was no better' if best is found else 'instead'}, "
        f"with {pictures_in_largest(again)} of {total} pictures that match"
    )
    warn(note)
    return best, [note]


def _globally(
    seen: Observations,
    cam_from_rig: Mapping[str, RigidTransform],
    folder: Path,
    seed: int,
    executor: Executor,
) -> list[pycolmap.Reconstruction]:
    """Map all stations at once, then register what is left over one by one; largest first."""
    options = _options(cam_from_rig, seed, "nothing")
    with scratch_database(folder / "mapper", seen, cam_from_rig) as scratch:
        database = scratch / "database.db"
        found = _sort_by_size(map_globally(database, seen, cam_from_rig, options, seed, executor))
        if found and not unsound(found[0]):
            grown = _grow(found[0], seen.connected, scratch, options)
            if grown is not found[0]:
                found = merge_models(_sort_by_size([grown, *found[1:]]), database, options)
    return _sort_by_size(found)


def map_from_poses(
    seen: Observations,
    cam_from_rig: Mapping[str, RigidTransform],
    rig_from_world: Mapping[int, RigidTransform],
    folder: Path,
    seed: int,
    *,
    free: Free,
) -> pycolmap.Reconstruction:
    """A model on a rig that is held constant, from poses that are nearly right.

    Pictures without a pose are then registered one by one, at last with lower demands.

    Args:
        seen: cameras, keypoints, matches.
        cam_from_rig: poses of the cameras on the rig, the first camera's the identity.
        rig_from_world: pose by station.
        folder: for scratch files.
        seed: of the mapper.
        free: what of the cameras is refined in addition to their poses.
    """
    options = _options(cam_from_rig, seed, free)
    with scratch_database(folder / "mapper", seen, cam_from_rig) as scratch:
        poses = frame_poses(seen, rig_from_world)
        model = triangulate_and_adjust(scratch / "database.db", poses, options)
        model = _grow(model, seen.connected, scratch, options)
        return _grow(model, seen.connected, scratch, _lower_demands(options))


def _grow(
    model: pycolmap.Reconstruction,
    total: int,
    scratch: Path,
    options: pycolmap.IncrementalPipelineOptions,
) -> pycolmap.Reconstruction:
    """A model to which pictures that it lacks are added one by one; itself where none can be."""
    if model.num_reg_images() >= total:
        return model
    options.multiple_models = False
    grown = max(
        model, *map(pycolmap.Reconstruction, _continue_mapping(model, scratch, options)), key=_size
    )
    if grown.num_reg_images() <= model.num_reg_images():
        return model
    adjust(grown, options, tolerance=1e-7)
    grown.update_point_3d_errors()
    return grown


def faults_of(found: Sequence[pycolmap.Reconstruction], total: int) -> list[str]:
    """Reasons to reject a mapping as it is: ends of sentences, none when it is sound."""
    if not found:
        return ["found no model"]
    faults = unsound(found[0])
    lost = total - found[0].num_reg_images()
    if lost > _MAX_LOST * total:
        faults.append(f"left {lost} of {total} pictures that match out of its largest model")
    return faults


def unsound(model: pycolmap.Reconstruction) -> list[str]:
    """What is wrong with a model itself."""
    faults = []
    collapsed = collapsed_frames(model)
    if collapsed:
        faults.append(f"collapsed {len(collapsed)} stations")
    error = model.compute_mean_reprojection_error()
    if not error <= _MAX_REPROJECTION_PX:
        faults.append(f"left a mean reprojection error of {error:.1f} px")
    return faults


def _size(model: pycolmap.Reconstruction) -> tuple[int, int]:
    return model.num_reg_images(), model.num_points3D()


def _sort_by_size(models: Sequence[pycolmap.Reconstruction]) -> list[pycolmap.Reconstruction]:
    return sorted(models, key=_size, reverse=True)


def pictures_in_largest(models: Sequence[pycolmap.Reconstruction]) -> int:
    """Pictures in the first of models by falling size; 0 where there is none."""
    return models[0].num_reg_images() if models else 0


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
    model.transform(pycolmap.Sim3d(factor, pycolmap.Rotation3d(), np.zeros(3)))


def run_mapper(
    seen: Observations,
    cam_from_rig: Mapping[str, RigidTransform] | None,
    folder: Path,
    seed: int,
    *,
    free: Free,
) -> list[pycolmap.Reconstruction]:
    """Map incrementally; with lower demands once more if that loses pictures.

    Args:
        seen: cameras, keypoints, matches.
        cam_from_rig: poses of the cameras on one rig, which are held constant; None: every camera
            moves by itself.
        folder: for scratch files.
        seed: of the mapper.
        free: what of the cameras is refined in addition to their poses.

    Returns:
        All models, largest first.
    """
    options = _options(cam_from_rig, seed, free)
    found = _map_once(seen, cam_from_rig, folder, options, free)
    if pictures_in_largest(found) >= seen.connected:
        return found
    again = _map_once(seen, cam_from_rig, folder, _lower_demands(options), free)
    return max(found, again, key=pictures_in_largest)


def _options(
    cam_from_rig: Mapping[str, RigidTransform] | None, seed: int, free: Free
) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    options.num_threads = options.mapper.num_threads = 1
    options.extract_colors = False
    options.min_model_size = 3
    options.mapper.init_min_tri_angle = _MIN_ANGLE_DEG
    options.ba_refine_sensor_from_rig = False
    options.ba_global_frames_ratio = options.ba_global_points_ratio = _GROWTH
    options.ba_global_max_refinements = 2
    options.ba_global_function_tolerance = 1e-5
    if cam_from_rig is not None:
        # A station at the end of a line may share with its neighbour only what the two pictures
        # of one station saw: such points carry it.
        options.triangulation.ignore_two_view_tracks = False
        # The first pair is of arbitrary scale, in which the rig does not fit; what it failed to
        # triangulate within a station is tried again once the scale has settled.
        options.triangulation.re_min_ratio = 0.9
        options.ba_local_max_num_iterations = 15
    options.ba_refine_focal_length = free == "all"
    options.mapper.abs_pose_refine_focal_length = free == "all"
    options.ba_refine_extra_params = free != "nothing"
    options.mapper.abs_pose_refine_extra_params = free != "nothing"
    return options


def _lower_demands(
    options: pycolmap.IncrementalPipelineOptions,
) -> pycolmap.IncrementalPipelineOptions:
    """Lower the demands on matches, in place, and return the options."""
    options.min_num_matches = _FEW_MATCHES
    options.mapper.abs_pose_min_num_inliers = _FEW_MATCHES
    options.mapper.init_min_num_inliers = 3 * _FEW_MATCHES
    options.triangulation.ignore_two_view_tracks = False
    return options


def _map_once(
    seen: Observations,
    cam_from_rig: Mapping[str, RigidTransform] | None,
    folder: Path,
    options: pycolmap.IncrementalPipelineOptions,
    free: Free,
) -> list[pycolmap.Reconstruction]:
    total = len({r.station for r in seen.images}) if cam_from_rig else len(seen.images)
    with (
        scratch_database(folder / "mapper", seen, cam_from_rig) as scratch,
        progress.step("add pictures to the model", total) as counter,
    ):
        database = scratch / "database.db"
        found = pycolmap.incremental_mapping(
            database, scratch, scratch, options, next_image_callback=counter.advance
        )
        models = [pycolmap.Reconstruction(model) for model in found.values()]
        models = [_repair(model, scratch, options) for model in models]
        if cam_from_rig is not None and free == "nothing":
            for model in models:
                adjust(model, options, tolerance=1e-7)
                model.update_point_3d_errors()
            models = merge_models(_sort_by_size(models), database, options)
    return _sort_by_size(models)


def _repair(
    model: pycolmap.Reconstruction, scratch: Path, options: pycolmap.IncrementalPipelineOptions
) -> pycolmap.Reconstruction:
    """A model whose collapsed stations are taken out and registered again from the others.

    The first pair is of arbitrary scale; now and then the adjustment shrinks its baseline to
    nothing, with its points in the cameras' common centre, where every ray meets them. The stereo
    points of one of both then carry the model on, and the other stays where it is.
    """
    for _ in range(_REPAIRS):
        collapsed = collapsed_frames(model)
        if not collapsed or len(collapsed) >= model.num_reg_frames() - 1:
            return model
        for frame in collapsed:
            model.deregister_frame(frame)
        found = _continue_mapping(model, scratch, options)
        if found:
            model = max(found, key=lambda m: m.num_reg_images())
    return model


def _continue_mapping(
    model: pycolmap.Reconstruction, scratch: Path, options: pycolmap.IncrementalPipelineOptions
) -> list[pycolmap.Reconstruction]:
    """What mapping makes of a model, with the database in the folder `scratch`."""
    begun, output = new_folder(scratch / "begun"), new_folder(scratch / "more")
    model.write(begun)
    found = pycolmap.incremental_mapping(
        scratch / "database.db", scratch, output, options, input_path=begun
    )
    return list(found.values())


def collapsed_frames(model: pycolmap.Reconstruction) -> list[int]:
    """Frames many of whose points lie in their cameras' own centres."""
    seen = observations(model)
    frames = [model.images[number].frame_id for number in seen.pictures.tolist()]
    frame, depth = np.repeat(frames, np.diff(seen.starts)), seen.in_cameras[:, 2]
    near = depth < _COLLAPSED * np.median(depth) if len(depth) else np.zeros(0, np.bool_)
    return [f for f in dict.fromkeys(frame.tolist()) if near[frame == f].mean() > _MAX_COLLAPSED]


def largest(
    models: Sequence[pycolmap.Reconstruction], images: Sequence[ImageRecord]
) -> pycolmap.Reconstruction:
    """The model with the most pictures.

    Raises:
        ReconstructionError: there is none.
    """
    if not models:
        raise ReconstructionError(
            f"no model: no two of the {len(images)} pictures share enough of the same spots; "
            "check that they overlap, or raise max_features under [reconstruct] in survey.toml"
        )
    return models[0]


def sizes(models: Sequence[pycolmap.Reconstruction]) -> tuple[int, ...]:
    """Pictures in each model."""
    return tuple(int(model.num_reg_images()) for model in models)


@progress.step("merge models")
def merge_models(
    models: Sequence[pycolmap.Reconstruction],
    database: Path,
    options: pycolmap.IncrementalPipelineOptions,
) -> list[pycolmap.Reconstruction]:
    """Join models on one known rig that share stations.

    A rig gives every model its scale, so that one shared station suffices to place it. Joined
    models are triangulated and adjusted again, so that points of both sides link them.

    Args:
        models: largest first, on the rig of the database, which is held constant.
        database: what they were made from.
        options: of triangulation and adjustment.

    Returns:
        What is left, largest first; a joined model that lost pictures is not used.
    """
    left = list(models)
    merged = True
    while merged and len(left) > 1:
        merged = False
        for k in range(1, len(left)):
            step = second_from_first(left[0], left[k])
            if step is None:
                continue
            poses = _poses(left[0])
            for frame, pose in _poses(left[k]).items():
                poses.setdefault(frame, pose * step)
            joined = triangulate_and_adjust(database, poses, options)
            if joined.num_reg_frames() == len(poses):
                left = [joined, *left[1:k], *left[k + 1 :]]
                merged = True
                break
    return left


def second_from_first(
    first: pycolmap.Reconstruction, second: pycolmap.Reconstruction
) -> RigidTransform | None:
    """Where the world of one model lies in that of another, by the stations that both have.

    Returns:
        None where they share none or these disagree.
    """
    ours, theirs = _poses(first), _poses(second)
    shared = sorted(ours.keys() & theirs.keys())
    if not shared:
        return None
    steps = [theirs[frame].inv() * ours[frame] for frame in shared]
    middle = np.median([ours[frame].inv().translation for frame in shared], axis=0)
    turn = Rotation.concatenate([step.rotation for step in steps]).mean()
    places = np.array([step.apply(middle) for step in steps])
    place = np.median(places, axis=0)
    away = np.median([(step.rotation * turn.inv()).magnitude() for step in steps])
    spread = np.median(np.linalg.norm(places - place, axis=1))
    if away > _MAX_SPREAD or spread > _MAX_SPREAD * _reach(first):
        return None
    return RigidTransform.from_components(place - turn.apply(middle), turn)


def side_by_side(models: Sequence[pycolmap.Reconstruction]) -> list[pycolmap.Reconstruction]:
    """Put models on one rig into one, apart from each other.

    Args:
        models: largest first; of the database that all were made from.

    Returns:
        The one model, and those that are not in it: they are unsound, or have stations of larger
        ones and contradict these.
    """
    whole, left = pycolmap.Reconstruction(models[0]), []
    for model in models[1:]:
        if unsound(model) or set(model.reg_frame_ids()) & set(whole.reg_frame_ids()):
            left.append(model)
        else:
            _add(whole, model)
    return [whole, *left]


def _add(whole: pycolmap.Reconstruction, model: pycolmap.Reconstruction) -> None:
    """Add a model to another, in place, farther out along the first axis than all that is there."""
    ends = [np.array([p.xyz[0] for p in m.points3D.values()]) for m in (whole, model)]
    gap = float(np.ptp(ends[0]) + np.ptp(ends[1]))
    apart = RigidTransform.from_translation([ends[0].max() - ends[1].min() + gap, 0.0, 0.0])
    poses = _poses(model)
    for number in poses:
        theirs = model.frames[number]
        frame = pycolmap.Frame(frame_id=number, rig_id=theirs.rig_id)
        for data in theirs.image_ids:
            frame.add_data_id(data)
        whole.add_frame(frame)
        whole.frames[number].rig_from_world = rigid3d(poses[number] * apart.inv())
        for data in theirs.image_ids:
            image = model.images[data.id]
            rows = pycolmap.Point2DList([pycolmap.Point2D(p.xy) for p in image.points2D])
            whole.add_image(
                pycolmap.Image(
                    name=image.name, image_id=data.id, camera_id=image.camera_id,
                    frame_id=number, points2D=rows,
                )
            )  # fmt: skip
        whole.register_frame(number)
    for _, point in sorted(model.points3D.items()):
        whole.add_point3D(apart.apply(point.xyz), point.track, point.color)


def report_left_out(models: Sequence[pycolmap.Reconstruction]) -> list[str]:
    """A line for every model but the first, with its pictures; each is warned of, too."""
    notes = []
    have = {i.name for i in models[0].images.values() if i.has_pose} if models else set()
    for model in models[1:]:
        names = sorted({i.name for i in model.images.values() if i.has_pose} - have)
        have |= set(names)
        if names:
            notes.append(
                f"{len(names)} pictures make a separate model that could not be joined to the "
                f"largest: {list_names(names)}"
            )
            warn(notes[-1])
    return notes


def _poses(model: pycolmap.Reconstruction) -> dict[int, RigidTransform]:
    """`rig_from_world` by frame."""
    frames = sorted(model.reg_frame_ids())
    return {frame: as_transform(model.frames[frame].rig_from_world) for frame in frames}


def _reach(model: pycolmap.Reconstruction) -> float:
    """Median distance from the stations to the points."""
    points = np.array([p.xyz for _, p in sorted(model.points3D.items())])
    centres = np.array([pose.inv().translation for pose in _poses(model).values()])
    return float(np.linalg.norm(np.median(points, axis=0) - np.median(centres, axis=0)))
