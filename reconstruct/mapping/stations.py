"""Poses of stereo stations relative to each other, straight from the pictures.

What both cameras of a station see is a metric cloud, so that the pose of any other
station that shares features with it follows from a resection: no first pair, no growing model and
no navigation is needed, and every pair of stations costs the same however large the survey is.

A resection takes the first station's stereo points as exact. They are not: where depths are noisy
by some centimetres, what the second station sees misses by the parallax of that noise, which grows
with the distance between the stations, so that least squares shortens the distance (by 7 % on a
synthetic block with 0.3 px of noise). In `refine_link` the points move as well, held by what the
stereo pixels say of them, and are eliminated (Schur complement; Triggs et al. 2000, "Bundle
adjustment: a modern synthesis", section 6).
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.executor import Executor
from alice_survey.core.frames import Array
from alice_survey.core.robust import CAUCHY_TUNING
from reconstruct.mapping.arrays import cross_matrices
from reconstruct.mapping.database import Observations
from reconstruct.mapping.working_range import ray_passes
from reconstruct.matching.matches import Matches
from reconstruct.views.model_files import as_transform

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
_LinkAnswer = tuple[Array, Array, int, Array]
"""The second station's rig as the first sees it: quaternion, shift, inliers, covariance of turn,
then shift."""
Indices = NDArray[np.int64]
_ROUNDS = 10
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
    second_from_first: RigidTransform
    """Transform between the rigs' frames, metres."""
    inliers: int
    turn_variance: float
    shift_variance: float
    """Variances of the turn and the shift, but for a factor common to all links (rad^2 and m^2,
    were points exact)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Resection:
    first: int
    second: int
    points: Array
    pixels: Array
    cameras: tuple[int, ...]


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
        if a.station != b.station or pair.geometry is None:
            continue
        start, ray = zip(
            *(
                _rays(seen, picture, pair.matches[:, side], cam_from_rig[record.camera])
                for side, (picture, record) in enumerate(((i, a), (j, b)))
            ),
            strict=True,
        )
        along, gap = ray_passes(start[0], ray[0], start[1], ray[1])
        other, _ = ray_passes(start[1], ray[1], start[0], ray[0])
        points = 0.5 * (start[0] + along[:, None] * ray[0] + start[1] + other[:, None] * ray[1])
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
    points = stereo_points(seen, cam_from_rig)
    names = list(seen.cameras)
    tasks = list(_resections(seen, points, names))
    blocks = [tasks[k : k + _BLOCK] for k in range(0, len(tasks), _BLOCK)]
    resect = partial(
        _resect_all,
        cameras=[seen.cameras[name].todict() for name in names],
        # Numbers, not poses, go to and from processes: unpickling a pose rounds it once more.
        cam_from_rig=[
            (cam_from_rig[n].rotation.as_quat(), cam_from_rig[n].translation) for n in names
        ],
        seed=seed,
    )
    found = executor.map(resect, blocks, label="linking stations")
    answers = [answer for block in found for answer in block]
    links = [_link(*pair) for pair in zip(tasks, answers, strict=True)]
    return [link for link in links if link is not None]


def _rays(
    seen: Observations, picture: int, rows: Matches, cam_from_rig: RigidTransform
) -> tuple[Array, Array]:
    """Starts and unit directions in the rig's frame, (N, 3) each."""
    camera = seen.cameras[seen.images[picture].camera]
    at_one = np.asarray(camera.cam_from_img(np.asarray(seen.pixels[picture][rows], float)))
    rays = np.column_stack([at_one.reshape(-1, 2), np.ones(len(rows))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    rig_from_cam = cam_from_rig.inv()
    start = np.broadcast_to(rig_from_cam.translation, rays.shape)
    return start, rig_from_cam.rotation.apply(rays)


def _resections(
    seen: Observations, points: Sequence[Array], names: Sequence[str]
) -> Iterable[_Resection]:
    """The better of the two ways to resect one station from another: more points."""
    shared: dict[tuple[int, int], list[tuple[int, int, Matches]]] = {}
    for i, j, pair in seen.pairs:
        a, b = seen.images[i].station, seen.images[j].station
        if a == b or pair.geometry is None:
            continue
        if a > b:
            shared.setdefault((b, a), []).append((j, i, pair.matches[:, ::-1]))
        else:
            shared.setdefault((a, b), []).append((i, j, pair.matches))
    for a, b in _best_pairs({ends: sum(len(m) for _, _, m in r) for ends, r in shared.items()}):
        rows = shared[a, b]
        there = _collect(seen, points, names, rows)
        back = _collect(seen, points, names, [(j, i, m[:, ::-1]) for i, j, m in rows])
        first, second, best = (b, a, back) if len(back[0]) > len(there[0]) else (a, b, there)
        if len(best[0]) >= _MIN_INLIERS:
            yield _Resection(
                first=first,
                second=second,
                points=best[0],
                pixels=best[1],
                cameras=tuple(int(c) for c in best[2]),
            )


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
    seen: Observations,
    points: Sequence[Array],
    names: Sequence[str],
    rows: Sequence[tuple[int, int, Matches]],
) -> tuple[Array, Array, Array]:
    """Points of the first station, pixels of the second, and the cameras of those."""
    known, pixels, cameras = [], [], []
    for i, j, matches in rows:
        place = points[i][matches[:, 0]]
        good = np.isfinite(place[:, 0])
        known.append(place[good])
        pixels.append(np.asarray(seen.pixels[j][matches[good, 1]], float))
        cameras.append(np.full(int(good.sum()), names.index(seen.images[j].camera)))
    stacked = np.concatenate(known), np.concatenate(pixels), np.concatenate(cameras)
    if len(stacked[0]) <= _ENOUGH:
        return stacked
    some = np.linspace(0, len(stacked[0]) - 1, _ENOUGH).astype(int)
    return stacked[0][some], stacked[1][some], stacked[2][some]


def _resect_all(
    tasks: Sequence[_Resection],
    cameras: Sequence[Mapping[str, object]],
    cam_from_rig: Sequence[tuple[Array, Array]],
    seed: int,
) -> list[_LinkAnswer | None]:
    ransac = pycolmap.RANSACOptions()
    ransac.max_error = _MAX_ERROR_PX
    ransac.min_inlier_ratio = _MIN_SHARE
    ransac.random_seed = seed
    ransac.min_num_trials, ransac.max_num_trials = 30, 1000
    ransac.confidence = 0.999
    refine = pycolmap.AbsolutePoseRefinementOptions()
    refine.print_summary = False
    pinholes = _pinholes(cameras, cam_from_rig)
    made = [pycolmap.Camera(dict(camera)) for camera in cameras]
    poses = [pycolmap.Rigid3d(pycolmap.Rotation3d(quat), shift) for quat, shift in cam_from_rig]
    answers: list[_LinkAnswer | None] = []
    for task in tasks:
        found = pycolmap.estimate_and_refine_generalized_absolute_pose(
            task.pixels, task.points, task.cameras, poses, made, ransac, refine
        )
        if found is None:
            answers.append(None)
            continue
        start = as_transform(found["rig_from_world"])
        refined = refine_link(task.points, task.pixels, np.array(task.cameras), pinholes, start)
        if refined is None:
            answers.append(None)
            continue
        pose, covariance = refined
        place = pose.rotation.as_quat(), np.asarray(pose.translation)
        answers.append((*place, int(found["num_inliers"]), covariance))
    return answers


def _pinholes(
    cameras: Sequence[Mapping[str, object]], cam_from_rig: Sequence[tuple[Array, Array]]
) -> RigPinholes:
    params = np.array([camera["params"] for camera in cameras], float)  # of pinholes
    return RigPinholes(
        focal_px=params[:, :2],
        centre_px=params[:, 2:],
        turn=np.array([Rotation.from_quat(quat).as_matrix() for quat, _ in cam_from_rig]),
        shift=np.array([shift for _, shift in cam_from_rig]),
    )


def _link(task: _Resection, found: _LinkAnswer | None) -> StationLink | None:
    if found is None:
        return None
    quaternion, shift, inliers, covariance = found
    turns, shifts = np.trace(covariance[:3, :3]), np.trace(covariance[3:, 3:])
    known = turns > 0 and shifts > 0 and np.isfinite(turns + shifts)
    if inliers < max(_MIN_INLIERS, _MIN_SHARE * len(task.points)) or not known:
        return None
    return StationLink(
        first=task.first,
        second=task.second,
        second_from_first=RigidTransform.from_components(shift, Rotation.from_quat(quaternion)),
        inliers=inliers,
        turn_variance=float(turns),
        shift_variance=float(shifts),
    )


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
    for first in (True, *[False] * _ROUNDS):
        turned = moved @ turn.T
        found, by_place = pinholes.see(turned + shift, camera)
        miss, away = found - pixels, np.einsum("nij,nj->ni", held, moved - points)
        by_point = by_place @ turn
        back = np.linalg.inv(held + by_point.swapaxes(1, 2) @ by_point)
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
