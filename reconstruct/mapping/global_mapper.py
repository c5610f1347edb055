"""Mapping all stations of a stereo rig at once, at a cost per picture that does not grow.

Poses of stations relative to each other are averaged; COLMAP then triangulates from
those poses and adjusts them a few times, first with wide thresholds and a robust loss. Incremental
mapping adjusts the whole model again and again while it grows; here that happens a fixed number
of times. COLMAP's own global mapper is not used: it positions cameras by directions alone, and so
lost the scale of a rig whose baseline is a twentieth of the range (72-fold on a 24-station scene).

Averages are first of rotations, then of positions, each a sparse linear problem, solved a few
times with weights that fade out links which contradict the others (iteratively reweighted least
squares, as Chatterjee & Govindu 2013, "Efficient and Robust Large-Scale Rotation Averaging"). Since
a rig gives every link its length, positions are as linear as rotations.

Relative poses come straight from the pictures. What both cameras of a station see is a metric
cloud, so that the pose of any other station that shares features with it follows from a resection:
no first pair, no growing model and no navigation is needed, and every pair of stations costs the
same however large the survey is.

A resection takes the first station's stereo points as exact. They are not: where depths are noisy
by some centimetres, what the second station sees misses by the parallax of that noise, which grows
with the distance between the stations, so that least squares shortens the distance (by 7 % on a
synthetic block with 0.3 px of noise). In `refine_link` the points move as well, held by what the
stereo pixels say of them, and are eliminated (Schur complement; Triggs et al. 2000, "Bundle
adjustment: a modern synthesis", section 6).
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.sparse.linalg import splu
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.block_solver import CAUCHY_TUNING
from alice_survey.core.executor import Executor
from alice_survey.core.frames import Array
from alice_survey.core.run import progress
from reconstruct.mapping.arrays import Indices, cross_matrices
from reconstruct.mapping.bundle import (
    all_pictures,
    direct_solver,
    move_points,
    spread_part,
    take_poses,
)
from reconstruct.mapping.database import Observations
from reconstruct.mapping.working_range import ray_passes
from reconstruct.matching.matches import Matches
from reconstruct.views.model_files import as_transform, rigid3d

_MAX_GAP_PX = 3.0
"""Distance by which the two rays of a stereo point may miss each other, as seen from the cameras.
"""
_MAX_ERROR_PX = 12.0
"""Largest error of a resection: stereo depths are noisy, and show as parallax from the next
station."""
_MIN_INLIERS = 15
_MIN_SHARE = 0.25
_ENOUGH = 300
"""Points that a resection takes; more add time but little accuracy before the adjustment."""
_PARTNERS = 6
"""Stations that each is linked with: those that share most with it. Others add time, not shape."""
_BLOCK = 32
"""Pairs of stations in one task, so that sending them costs little."""
_RigCamera = tuple[Mapping[str, object], Array, Array]
"""COLMAP's pinhole as `todict` gives it, and `cam_from_rig`: quaternion and shift. Numbers, not
poses, go to and from processes: unpickling a pose rounds it once more."""
_LINK_ROUNDS = 10
_SETTLED = 1e-7
"""Radians, or metres, below which a step ends the search."""
_MEDIAN_OF_TWO = 1.3863
"""Median of the sum of two squared unit normal numbers, which is what a seen point leaves over."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StationLink:
    """Where one station is as another sees it."""

    first: int
    second: int
    """The two stations."""
    quaternion: Array
    shift: Array
    """The second station's rig as the first sees it, metres."""
    turn_variance: float
    shift_variance: float
    """Variances of the turn and the shift, but for a factor common to all links (rad^2 and m^2,
    were points exact)."""

    @property
    def second_from_first(self) -> RigidTransform:
        """Transform between the rigs' frames, metres."""
        return RigidTransform.from_components(self.shift, Rotation.from_quat(self.quaternion))


class _Resection(NamedTuple):
    first: int
    second: int
    points: Array
    pixels: Array
    cameras: Indices


@dataclass(frozen=True, kw_only=True, eq=False)
class RigPinholes:
    """How the pinholes of a rig see points in the rig's frame."""

    focal_px: Array
    """(K, 2) focal lengths."""
    centre_px: Array
    """(K, 2) principal points."""
    turn: Array
    """(K, 3, 3) and (K, 3): `cam_from_rig`."""
    shift: Array

    def see(self, points: Array, camera: Indices) -> tuple[Array, Array]:
        """Pixels (N, 2) of points (N, 3), each in one camera, and their slopes (N, 2, 3)."""
        turn, focal = self.turn[camera], self.focal_px[camera]
        local = np.einsum("nij,nj->ni", turn, points) + self.shift[camera]
        at_one = local[:, :2] / local[:, 2:]
        slopes = focal[:, :, None] * (turn[:, :2] - at_one[:, :, None] * turn[:, 2:])
        return focal * at_one + self.centre_px[camera], slopes / local[:, 2][:, None, None]

    def information(self, points: Array) -> Array:
        """What pixels of unit sigma in all cameras say of points, (N, 3, 3)."""
        found = np.zeros((len(points), 3, 3))
        for k in range(len(self.focal_px)):
            _, slopes = self.see(points, np.full(len(points), k))
            found += slopes.swapaxes(1, 2) @ slopes
        return found


def stereo_points(
    seen: Observations, cam_from_rig: Mapping[str, RigidTransform]
) -> tuple[Array, ...]:
    """What the features of every picture are, in its station's frame, from that station alone.

    Args:
        seen: pictures, keypoints and matches.
        cam_from_rig: poses of the cameras on the rig.

    Returns:
        (N, 3) points per picture in the rig's frame, metres; NaN where the station's other
        pictures do not show the feature, or rays miss each other or meet behind the cameras.
    """
    found = tuple(np.full((len(pixels), 3), np.nan) for pixels in seen.pixels)
    gaps = tuple(np.full(len(pixels), np.inf) for pixels in seen.pixels)
    for i, j, pair in seen.pairs:
        a, b = seen.images[i], seen.images[j]
        if a.station != b.station:
            continue
        here, there = (
            _rays(seen, picture, pair.matches[:, side], cam_from_rig)
            for side, picture in enumerate((i, j))
        )
        along, gap = ray_passes(*here, *there)
        other, _ = ray_passes(*there, *here)
        points = 0.5 * (here[0] + along[:, None] * here[1] + there[0] + other[:, None] * there[1])
        focal = seen.cameras[a.camera].mean_focal_length()
        with np.errstate(invalid="ignore"):
            good = (along > 0) & (other > 0) & (gap * focal < _MAX_GAP_PX * along)
        for side, picture in enumerate((i, j)):
            rows = pair.matches[good, side]
            better = gap[good] < gaps[picture][rows]
            found[picture][rows[better]] = points[good][better]
            gaps[picture][rows[better]] = gap[good][better]
    return found


def link_stations(
    seen: Observations, cam_from_rig: Mapping[str, RigidTransform], seed: int, executor: Executor
) -> list[StationLink]:
    """Find the relative pose of every two stations whose pictures share enough.

    Args:
        seen: pictures, keypoints and matches.
        cam_from_rig: poses of the cameras on the rig.
        seed: of the robust estimation.
        executor: where tasks run; the result does not depend on it.

    Returns:
        Links by rising stations; those that no pose explains are left out.
    """
    tasks = list(_resections(seen, stereo_points(seen, cam_from_rig)))
    blocks = [tasks[k : k + _BLOCK] for k in range(0, len(tasks), _BLOCK)]
    rig = [
        (camera.todict(), cam_from_rig[name].rotation.as_quat(), cam_from_rig[name].translation)
        for name, camera in seen.cameras.items()
    ]
    resect = partial(_resect_all, rig=rig, seed=seed)
    found = executor.map(resect, blocks, label="linking stations")
    return [link for block in found for link in block if link is not None]


def _rays(
    seen: Observations, picture: int, rows: Matches, cam_from_rig: Mapping[str, RigidTransform]
) -> tuple[Array, Array]:
    """Starts and unit directions in the rig's frame, (N, 3) each."""
    name = seen.images[picture].camera
    at_one = np.asarray(seen.cameras[name].cam_from_img(seen.pixels[picture][rows]))
    rays = np.column_stack([at_one.reshape(-1, 2), np.ones(len(rows))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    rig_from_cam = cam_from_rig[name].inv()
    return np.broadcast_to(rig_from_cam.translation, rays.shape), rig_from_cam.rotation.apply(rays)


def _resections(seen: Observations, points: Sequence[Array]) -> Iterable[_Resection]:
    """The better of the two ways to resect one station from another: more points."""
    shared: dict[tuple[int, int], list[tuple[int, int, Matches]]] = {}
    for i, j, pair in seen.pairs:
        a, b = seen.images[i].station, seen.images[j].station
        if a < b:
            shared.setdefault((a, b), []).append((i, j, pair.matches))
        elif b < a:
            shared.setdefault((b, a), []).append((j, i, pair.matches[:, ::-1]))
    for a, b in _best_pairs({ends: sum(len(m) for _, _, m in r) for ends, r in shared.items()}):
        there = _collect(seen, points, shared[a, b])
        back = _collect(seen, points, [(j, i, m[:, ::-1]) for i, j, m in shared[a, b]])
        best = max(there, back, key=lambda task: len(task.points))
        if len(best.points) >= _MIN_INLIERS:
            yield best


def _best_pairs(matches: Mapping[tuple[int, int], int]) -> list[tuple[int, int]]:
    """Every station's best partners, and what else joins all that can be joined; ascending.

    Args:
        matches: of pairs of stations.
    """
    ordered = sorted(matches, key=lambda ends: (-matches[ends], ends))
    partners = dict.fromkeys((station for ends in ordered for station in ends), 0)
    group = {station: station for station in partners}

    def root(station: int) -> int:
        while group[station] != station:
            group[station] = group[group[station]]
            station = group[station]
        return station

    chosen = []
    for a, b in ordered:
        joins = root(a) != root(b)
        if joins or min(partners[a], partners[b]) < _PARTNERS:
            chosen.append((a, b))
            group[root(a)] = root(b)
            partners[a] += 1
            partners[b] += 1
    return sorted(chosen)


def _collect(
    seen: Observations, points: Sequence[Array], rows: Sequence[tuple[int, int, Matches]]
) -> _Resection:
    """Points of the first station, pixels of the second, and the cameras of those."""
    names, known, pixels, cameras = list(seen.cameras), [], [], []
    for i, j, matches in rows:
        place = points[i][matches[:, 0]]
        good = np.isfinite(place[:, 0])
        known.append(place[good])
        pixels.append(seen.pixels[j][matches[good, 1]])
        cameras.append(np.full(int(good.sum()), names.index(seen.images[j].camera)))
    count = sum(map(len, known))
    some = np.linspace(0, count - 1, min(count, _ENOUGH)).astype(int)
    first, second = (seen.images[picture].station for picture in rows[0][:2])
    return _Resection(
        first, second, *(np.concatenate(parts)[some] for parts in (known, pixels, cameras))
    )


def _resect_all(
    tasks: Sequence[_Resection], rig: Sequence[_RigCamera], seed: int
) -> list[StationLink | None]:
    ransac = pycolmap.RANSACOptions()
    ransac.max_error = _MAX_ERROR_PX
    ransac.min_inlier_ratio = _MIN_SHARE
    ransac.random_seed = seed
    ransac.min_num_trials, ransac.max_num_trials = 30, 1000
    ransac.confidence = 0.999
    refine = pycolmap.AbsolutePoseRefinementOptions()
    refine.print_summary = False
    params = np.array([camera["params"] for camera, _, _ in rig], float)
    pinholes = RigPinholes(
        focal_px=params[:, :2],
        centre_px=params[:, 2:],
        turn=np.array([Rotation.from_quat(quat).as_matrix() for _, quat, _ in rig]),
        shift=np.array([shift for _, _, shift in rig]),
    )
    estimate = partial(
        pycolmap.estimate_and_refine_generalized_absolute_pose,
        cams_from_rig=[pycolmap.Rigid3d(pycolmap.Rotation3d(q), shift) for _, q, shift in rig],
        cameras=[pycolmap.Camera(dict(camera)) for camera, _, _ in rig],
        estimation_options=ransac,
        refinement_options=refine,
    )
    return [_resect(task, estimate, pinholes) for task in tasks]


def _resect(
    task: _Resection, estimate: Callable[..., Any], pinholes: RigPinholes
) -> StationLink | None:
    found = estimate(task.pixels, task.points, task.cameras.tolist())
    if found is None or found["num_inliers"] < max(_MIN_INLIERS, _MIN_SHARE * len(task.points)):
        return None
    start = as_transform(found["rig_from_world"])
    refined = refine_link(task.points, task.pixels, task.cameras, pinholes, start)
    if refined is None:
        return None
    pose, covariance = refined
    turns, shifts = float(np.trace(covariance[:3, :3])), float(np.trace(covariance[3:, 3:]))
    if not (turns > 0 and shifts > 0 and np.isfinite(turns + shifts)):
        return None
    return StationLink(
        first=task.first, second=task.second,
        quaternion=pose.rotation.as_quat(), shift=np.asarray(pose.translation),
        turn_variance=turns, shift_variance=shifts,
    )  # fmt: skip


def refine_link(
    points: Array, pixels: Array, camera: Indices, pinholes: RigPinholes, start: RigidTransform
) -> tuple[RigidTransform, Array] | None:
    """Refine the pose of one station's rig from another's stereo points.

    Args:
        points: (N, 3) by the first station's stereo, in its rig's frame.
        pixels: (N, 2) where the second station sees them.
        camera: (N,) by which of its cameras.
        pinholes: cameras of the rig of both.
        start: `second_from_first`.

    Returns:
        The refined pose and the covariance (6, 6) of its turn, then shift; None where the pixels
        do not determine it.
    """
    held, moved = pinholes.information(points), points
    turn, shift = start.rotation.as_matrix(), start.translation
    weight = np.zeros(len(points))
    for first in (True, *[False] * _LINK_ROUNDS):
        turned = moved @ turn.T
        found, by_place = pinholes.see(turned + shift, camera)
        miss, away = found - pixels, np.einsum("nij,nj->ni", held, moved - points)
        by_point = by_place @ turn
        square = held + by_point.swapaxes(1, 2) @ by_point
        # a wrong match near a camera's own plane leaves nothing of what stereo knows but rounding
        back = np.linalg.inv(square * (1.0 + 1e-12 * np.eye(3)))
        pull = away + np.einsum("nij,ni->nj", by_point, miss)
        if first:  # the points alone, so that weights mean something
            moved = moved - np.einsum("nij,nj->ni", back, pull)
            continue
        left = (miss**2).sum(axis=1) + ((moved - points) * away).sum(axis=1)
        usual = max(float(np.median(left)) / _MEDIAN_OF_TWO, 1e-12)
        weight = 1.0 / (1.0 + left / (CAUCHY_TUNING**2 * usual))
        by_pose = np.concatenate([-by_place @ cross_matrices(turned), by_place], axis=2)
        cross = by_pose.swapaxes(1, 2) @ by_point
        gain = cross @ back
        normal = np.einsum("n,nij->ij", weight, by_pose.swapaxes(1, 2) @ by_pose)
        normal -= np.einsum("n,nij,nkj->ik", weight, gain, cross)
        slope = np.einsum("n,nij,ni->j", weight, by_pose, miss)
        slope -= np.einsum("n,nij,nj->i", weight, gain, pull)
        if not np.isfinite(normal).all() or np.linalg.cond(normal) > 1e14:
            return None
        step = -np.linalg.solve(normal, slope)
        moved = moved - np.einsum("nij,nj->ni", back, pull + np.einsum("nij,i->nj", cross, step))
        turn, shift = Rotation.from_rotvec(step[:3]).as_matrix() @ turn, shift + step[3:]
        if np.abs(step).max() < _SETTLED:
            break
    pose = RigidTransform.from_components(shift, Rotation.from_matrix(turn))
    return pose, usual * np.linalg.inv(normal)


_FIRST_ERROR_PX = 20.0
"""Reprojection errors that the first adjustment keeps."""
_FIRST_ANGLE_DEG = 3.0
"""Largest angle between a ray and its point at the first triangulation."""
_ROBUST_PX = 4.0
"""Residuals beyond this count less in the first adjustment."""
_NO_BOUND = 1e12
"""Radius of the trust region."""
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
        # The database's rig has the frame of its first camera.
        reference = cam_from_rig[next(iter(seen.cameras))]
        poses = {station: reference * pose for station, pose in poses.items()}
        model = triangulate_and_adjust(database, frame_poses(seen, poses), options)
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
    wide, loose = options.get_triangulation(), options.get_mapper()
    wide.create_max_angle_error = wide.continue_max_angle_error = _FIRST_ANGLE_DEG
    wide.complete_max_reproj_error = wide.merge_max_reproj_error = _FIRST_ERROR_PX
    loose.filter_max_reproj_error = _FIRST_ERROR_PX
    rough = _triangulate(cache, rig_from_world, wide)
    rough.filter_points(loose)
    model = rough.reconstruction
    adjust(model, options, tolerance=1e-2, robust_px=_ROBUST_PX)
    # Again, since the first poses joined what they should not, and left out what they should not.
    poses = {f: as_transform(model.frames[f].rig_from_world) for f in model.reg_frame_ids()}
    mapper = _triangulate(cache, poses, options.get_triangulation())
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


def _triangulate(
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


def frame_poses(
    seen: Observations, rig_from_world: Mapping[int, RigidTransform]
) -> dict[int, RigidTransform]:
    """Poses of stations by the ids that their frames have in a database with one rig."""
    stations = enumerate(sorted({record.station for record in seen.images}), 1)
    return {frame: rig_from_world[s] for frame, s in stations if s in rig_from_world}


def station_groups(links: Sequence[StationLink]) -> list[list[int]]:
    """Stations that links join, the largest group first (of equals that with the first station)."""
    names, ends = _number_stations(links)
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
    names, ends = _number_stations(links)
    first, second = ends.T
    turn = 1.0 / np.array([link.turn_variance for link in links])
    shift = 1.0 / np.array([link.shift_variance for link in links])
    relative = RigidTransform.concatenate([link.second_from_first for link in links])
    root, start = _along_tree(len(names), first, second, relative, turn)
    turned, centres = start.rotation, start.inv().translation
    differences = coo_array(
        (np.repeat([-1.0, 1.0], len(links)), (np.tile(np.arange(len(links)), 2), ends.T.ravel()))
    ).tocsr()
    solve = partial(_solve, differences, root)
    for _ in range(_ROUNDS):
        # (relative * first).inv() * second is what is left over, about the world's axes.
        left = ((relative.rotation * turned[first]).inv() * turned[second]).as_rotvec()
        step = solve(left, turn, _MIN_ANGLE_RAD)
        turned = turned * Rotation.from_rotvec(step)
        if np.abs(step).max() < 1e-8:
            break
    # Where the second station's origin lies as the first sees it, turned into the world's axes.
    steps = turned[first].inv().apply(relative.inv().translation)
    floor = _MIN_LENGTH * float(np.median(np.linalg.norm(steps, axis=1)))
    for _ in range(_ROUNDS):
        step = solve(centres[second] - centres[first] - steps, shift, floor)
        centres = centres + step
        if np.abs(step).max() < 1e-6 * floor:
            break
    poses = RigidTransform.from_components(-turned.apply(centres), turned)
    return {name: poses[k] for k, name in enumerate(names.tolist())}


def _number_stations(links: Sequence[StationLink]) -> tuple[Indices, Indices]:
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
    steps = {}
    for a, b, pose in zip(first.tolist(), second.tolist(), relative, strict=True):
        steps[a, b], steps[b, a] = pose, pose.inv()
    poses = [RigidTransform.identity() for _ in range(count)]
    for node in order[1:].tolist():
        poses[node] = steps[int(parent[node]), node] * poses[parent[node]]
    return root, RigidTransform.concatenate(poses)


def _solve(differences: csr_array, root: int, left: Array, weight: Array, floor: float) -> Array:
    """A step that reduces what links leave over, (N, 3), where the root does not move.

    Links fade out that contradict the others: those that leave more than the usual, or `floor`.
    """
    size = np.linalg.norm(left, axis=1)
    scale = max(_MEDIANS * float(np.median(size)), floor)
    trust = weight * (1.0 / (1.0 + (size / scale) ** 2))
    free = np.flatnonzero(np.arange(differences.shape[1]) != root)
    reduced = differences[:, free]
    normal = csr_array(reduced.T @ (diags_array(trust).tocsr() @ reduced)).tocsc()
    solved = np.zeros((differences.shape[1], 3))
    solved[free] = splu(normal).solve(reduced.T @ (trust[:, None] * -left))
    return solved
