"""Mapping all stations of a stereo rig at once, at a cost per picture that does not grow.

Relative poses of stations (`stations`) are averaged (`pose_graph`); COLMAP then triangulates from
those poses and adjusts them a few times, first with wide thresholds and a robust loss. Incremental
mapping adjusts the whole model again and again while it grows; here that happens a fixed number
of times. COLMAP's own global mapper is not used: it positions cameras by directions alone, and so
lost the scale of a rig whose baseline is a twentieth of the range (72-fold on a 24-station scene).
"""

from collections.abc import Mapping
from pathlib import Path

import pycolmap
from scipy.spatial.transform import RigidTransform

from alice_survey.base.executor import Executor
from alice_survey.base.run import progress
from reconstruct.mapping.database import Observations, as_transform, rigid3d, station_frames
from reconstruct.mapping.pose_graph import average_poses, station_groups
from reconstruct.mapping.solver import direct_solver
from reconstruct.mapping.stations import link_stations

_FIRST_ERROR_PX = 20.0
"""Reprojection errors that the first adjustment keeps."""
_FIRST_ANGLE_DEG = 3.0
"""Largest angle between a ray and its point at the first triangulation."""
_ROBUST_PX = 4.0
"""Residuals beyond this count less in the first adjustment."""
_NO_BOUND = 1e12
"""Radius of the trust region."""


def map_globally(
    database: Path,
    seen: Observations,
    cam_from_rig: Mapping[str, RigidTransform],
    options: pycolmap.IncrementalPipelineOptions,
    seed: int,
    executor: Executor,
) -> list[pycolmap.Reconstruction]:
    """Map stations of one rig with metric poses from its stereo pairs.

    Args:
        database: COLMAP's, as `write_database` makes it.
        seen: what it was made of.
        cam_from_rig: poses of two cameras or more on the rig.
        options: of the last triangulation and adjustment.
        seed: of robust estimation.
        executor: where tasks run for the relative poses.

    Returns:
        One model per group of linked stations (of 2 and more), in no particular order.
    """
    links = link_stations(seen, cam_from_rig, seed, executor)
    models = []
    for group in station_groups(links) if links else []:
        members = set(group)
        poses = average_poses([link for link in links if link.first in members])
        model = triangulate_and_adjust(database, _frame_poses(seen, cam_from_rig, poses), options)
        if model.num_reg_images() and model.num_points3D():
            models.append(model)
    return models


@progress.step("triangulate and adjust")
def triangulate_and_adjust(
    database: Path,
    rig_from_world: Mapping[int, RigidTransform],
    options: pycolmap.IncrementalPipelineOptions,
) -> pycolmap.Reconstruction:
    """A model from approximate poses of frames.

    Args:
        database: COLMAP's.
        rig_from_world: pose by frame.
        options: of the last triangulation and adjustment.

    Returns:
        The adjusted model; frames that lost all their points are not registered.
    """
    with pycolmap.Database.open(database) as opened:
        cache_options = pycolmap.DatabaseCacheOptions()
        cache_options.min_num_matches = options.min_num_matches
        cache = pycolmap.DatabaseCache.create(opened, cache_options)
    rough = _triangulated(cache, rig_from_world, _wide(options))
    rough.filter_points(_filter(options, _FIRST_ERROR_PX))
    model = rough.reconstruction
    adjust(model, options, tolerance=1e-2, robust_px=_ROBUST_PX)
    # Again, since the first poses joined what they should not, and left out what they should not.
    poses = {f: as_transform(model.frames[f].rig_from_world) for f in model.reg_frame_ids()}
    mapper = _triangulated(cache, poses, options.get_triangulation())
    model = mapper.reconstruction
    # Filter before every plain adjustment: what is wrong would bend the model, and the next
    # adjustment would spend most of its rounds on straightening it (23 rounds instead of 3).
    mapper.filter_points(options.get_mapper())
    adjust(model, options, tolerance=1e-3)
    mapper.complete_and_merge_tracks(options.get_triangulation())
    mapper.filter_points(options.get_mapper())
    adjust(model, options, tolerance=1e-3)
    mapper.filter_frames(options.get_mapper())
    mapper.end_reconstruction(False)
    model.update_point_3d_errors()
    return model


def adjust(
    model: pycolmap.Reconstruction,
    options: pycolmap.IncrementalPipelineOptions,
    *,
    tolerance: float,
    robust_px: float | None = None,
) -> None:
    """Adjust a whole model of a rig in place; nothing but the rig sets its scale.

    COLMAP's mappers hold two cameras of different frames where they are: with a rig that holds a
    length as well, which then stays as it was (0.5 % off on a 24-station scene).

    Args:
        model: with registered frames and points.
        options: say what of cameras and rig is refined.
        tolerance: relative decrease of the cost below which it ends.
        robust_px: scale of a Cauchy loss; None: plain least squares.
    """
    config = pycolmap.BundleAdjustmentConfig()
    for number in sorted(model.reg_image_ids()):
        config.add_image(number)
    config.set_constant_rig_from_world_pose(min(model.reg_frame_ids()))
    adjustment = direct_solver(options.get_global_bundle_adjustment())
    if robust_px is not None:
        adjustment.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        adjustment.ceres.loss_function_scale = robust_px
    solver = adjustment.ceres.solver_options
    solver.function_tolerance = tolerance
    if robust_px is None:  # near its end: full Gauss-Newton steps, since weak directions are many
        solver.initial_trust_region_radius = _NO_BOUND
    pycolmap.create_default_bundle_adjuster(adjustment, config, model).solve()


def _triangulated(
    cache: pycolmap.DatabaseCache,
    rig_from_world: Mapping[int, RigidTransform],
    options: pycolmap.IncrementalTriangulatorOptions,
) -> pycolmap.IncrementalMapper:
    """A mapper whose model has the given poses, and points by them."""
    model = pycolmap.Reconstruction()
    model.load(cache)
    for frame, pose in sorted(rig_from_world.items()):
        model.frames[frame].rig_from_world = rigid3d(pose)
        model.register_frame(frame)
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(model)
    for number in sorted(model.reg_image_ids()):
        mapper.triangulate_image(options, number)
    mapper.complete_and_merge_tracks(options)
    return mapper


def _wide(
    options: pycolmap.IncrementalPipelineOptions,
) -> pycolmap.IncrementalTriangulatorOptions:
    wide = options.get_triangulation()
    wide.create_max_angle_error = wide.continue_max_angle_error = _FIRST_ANGLE_DEG
    wide.complete_max_reproj_error = wide.merge_max_reproj_error = _FIRST_ERROR_PX
    return wide


def _filter(
    options: pycolmap.IncrementalPipelineOptions, error_px: float
) -> pycolmap.IncrementalMapperOptions:
    wide = options.get_mapper()
    wide.filter_max_reproj_error = error_px
    return wide


def _frame_poses(
    seen: Observations,
    cam_from_rig: Mapping[str, RigidTransform],
    rig_from_world: Mapping[int, RigidTransform],
) -> dict[int, RigidTransform]:
    """Poses by frame of the database, whose rig's frame is that of its first camera."""
    reference = cam_from_rig[next(iter(seen.cameras))]
    return {
        frame: reference * rig_from_world[station]
        for frame, station in station_frames(seen.images).items()
        if station in rig_from_world
    }
