"""Mapping all stations of a stereo rig at once, at a cost per picture that does not grow.

Relative poses of stations (`stations`) are averaged; COLMAP then triangulates from
those poses and adjusts them a few times, first with wide thresholds and a robust loss. Incremental
mapping adjusts the whole model again and again while it grows; here that happens a fixed number
of times. COLMAP's own global mapper is not used: it positions cameras by directions alone, and so
lost the scale of a rig whose baseline is a twentieth of the range (72-fold on a 24-station scene).

Averages are first of rotations, then of positions, each a sparse linear problem, solved a few
times with weights that fade out links which contradict the others (iteratively reweighted least
squares, as Chatterjee & Govindu 2013, "Efficient and Robust Large-Scale Rotation Averaging"). Since
a rig gives every link its length, positions are as linear as rotations.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.sparse.linalg import splu
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.executor import Executor
from alice_survey.core.frames import Array
from alice_survey.core.run import progress
from reconstruct.mapping.bundle import all_pictures, direct_solver
from reconstruct.mapping.database import Observations, station_frames
from reconstruct.mapping.spread_points import move_points, spread_part, take_poses
from reconstruct.mapping.stations import StationLink, link_stations
from reconstruct.views.model_files import as_transform, rigid3d

_FIRST_ERROR_PX = 20.0
"""Reprojection errors that the first adjustment keeps."""
_FIRST_ANGLE_DEG = 3.0
"""Largest angle between a ray and its point at the first triangulation."""
_ROBUST_PX = 4.0
"""Residuals beyond this count less in the first adjustment."""
_NO_BOUND = 1e12
"""Radius of the trust region."""
Indices = NDArray[np.int64]
_ROUNDS = 8
_MIN_ANGLE_RAD = 1e-3
_MIN_LENGTH = 1e-3
"""Share of the links' usual length; with the angle, floors of what counts as a contradiction."""
_MEDIANS = 2.0
"""Residuals of this many medians keep half their weight."""


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
    length as well, which then stays as it was (0.5 % off on a 24-station scene). Where cameras are
    held, points that are spread over the pictures adjust the poses, and all points follow.

    Args:
        model: with registered frames and points.
        options: say what of cameras and rig is refined.
        tolerance: relative decrease of the cost below which it ends.
        robust_px: scale of a Cauchy loss; None: plain least squares.
    """
    refines = options.ba_refine_focal_length or options.ba_refine_extra_params
    part = None if refines else spread_part(model)
    whole, model = model, model if part is None else part
    config = all_pictures(model)
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
    if part is not None:
        take_poses(whole, part)
        move_points(whole, robust_px)


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


def station_groups(links: Sequence[StationLink]) -> list[list[int]]:
    """Stations that links join, the largest group first (of equals that with the first station)."""
    names, ends = _numbered(links)
    graph = coo_array((np.ones(len(links)), tuple(ends.T)), shape=(len(names),) * 2)
    count, label = connected_components(graph, directed=False)
    groups = [names[label == g].tolist() for g in range(count)]
    return sorted(groups, key=lambda group: (-len(group), group[0]))


@progress.step("average poses")
def average_poses(links: Sequence[StationLink]) -> Mapping[int, RigidTransform]:
    """Poses that agree best with all links.

    Args:
        links: of one group (see `station_groups`).

    Returns:
        `rig_from_world` by station; the world is the frame of the best linked station.

    Raises:
        ValueError: the links join more than one group.
    """
    if len(station_groups(links)) != 1:
        raise ValueError("links of more than one group have no common frame")
    names, ends = _numbered(links)
    first, second = ends.T
    turn = 1.0 / np.array([link.turn_variance for link in links])
    shift = 1.0 / np.array([link.shift_variance for link in links])
    relative = RigidTransform.concatenate([link.second_from_first for link in links])
    root, start = _along_tree(len(names), first, second, relative, turn)
    turned = _average_rotations(start.rotation, first, second, relative.rotation, turn, root)
    # Where the second station's origin lies as the first sees it, turned into the world's axes.
    steps = turned[first].inv().apply(relative.inv().translation)
    centres = _average_centres(start.inv().translation, first, second, steps, shift, root)
    poses = RigidTransform.from_components(-turned.apply(centres), turned)
    return {name: poses[k] for k, name in enumerate(names.tolist())}


def _numbered(links: Sequence[StationLink]) -> tuple[Indices, Indices]:
    """Stations, ascending, and for each link the indices (N, 2) of its two."""
    ends = np.array([(link.first, link.second) for link in links], dtype=np.int64)
    names, index = np.unique(ends, return_inverse=True)
    return names, index.reshape(-1, 2).astype(np.int64)


def _along_tree(
    count: int, first: Indices, second: Indices, relative: RigidTransform, weight: Array
) -> tuple[int, RigidTransform]:
    """Chain the most precise links from the best linked station: (root, rig_from_world)."""
    strength = np.bincount(first, weight, count) + np.bincount(second, weight, count)
    root = int(np.argmax(strength))
    graph = csr_array(coo_array((1.0 / weight, (first, second)), shape=(count, count)))
    tree = minimum_spanning_tree(graph)
    order, parent = breadth_first_order(tree, root, directed=False)
    of_pair = {(int(a), int(b)): k for k, (a, b) in enumerate(zip(first, second, strict=True))}
    poses = [RigidTransform.identity() for _ in range(count)]
    for node in order[1:]:
        above = int(parent[node])
        k = of_pair.get((above, int(node)))
        step = relative[k] if k is not None else relative[of_pair[int(node), above]].inv()
        poses[node] = step * poses[above]
    return root, RigidTransform.concatenate(poses)


def _average_rotations(
    start: Rotation, first: Indices, second: Indices, relative: Rotation, weight: Array, root: int
) -> Rotation:
    turned = start
    for _ in range(_ROUNDS):
        # (relative * first).inv() * second is what is left over, about the world's axes.
        left = ((relative * turned[first]).inv() * turned[second]).as_rotvec()
        trust = weight * _trust(np.linalg.norm(left, axis=1), _MIN_ANGLE_RAD)
        step = _solve(len(turned), first, second, -left, trust, root)
        turned = turned * Rotation.from_rotvec(step)
        if np.abs(step).max() < 1e-8:
            break
    return turned


def _average_centres(
    centres: Array, first: Indices, second: Indices, steps: Array, weight: Array, root: int
) -> Array:
    floor = _MIN_LENGTH * float(np.median(np.linalg.norm(steps, axis=1)))
    for _ in range(_ROUNDS):
        left = centres[second] - centres[first] - steps
        trust = weight * _trust(np.linalg.norm(left, axis=1), floor)
        step = _solve(len(centres), first, second, -left, trust, root)
        centres = centres + step
        if np.abs(step).max() < 1e-6 * floor:
            break
    return centres


def _trust(residuals: Array, floor: float) -> Array:
    scale = max(_MEDIANS * float(np.median(residuals)), floor)
    trust: Array = 1.0 / (1.0 + (residuals / scale) ** 2)
    return trust


def _solve(
    count: int, first: Indices, second: Indices, wanted: Array, weight: Array, root: int
) -> Array:
    """Least squares of `x[second] - x[first] = wanted` with `x[root] = 0`; (count, 3)."""
    rows = np.arange(len(first))
    sign = np.concatenate([-np.ones(len(first)), np.ones(len(first))])
    incidence = csr_array(
        coo_array(
            (sign, (np.concatenate([rows, rows]), np.concatenate([first, second]))),
            shape=(len(first), count),
        )
    )
    free = np.flatnonzero(np.arange(count) != root)
    reduced = incidence[:, free]
    normal = csr_array(reduced.T @ (diags_array(weight).tocsr() @ reduced)).tocsc()
    solved = np.zeros((count, 3))
    solved[free] = splu(normal).solve(reduced.T @ (weight[:, None] * wanted))
    return solved
