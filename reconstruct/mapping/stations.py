"""Poses of stereo stations relative to each other, straight from the pictures.

What both cameras of a station see is a metric cloud, so that the pose of any other
station that shares features with it follows from a resection: no first pair, no growing model and
no navigation is needed, and every pair of stations costs the same however large the survey is.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import pycolmap
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.base.executor import Executor
from alice_survey.base.frames import Array
from reconstruct.mapping.database import Observations, as_transform
from reconstruct.mapping.link_refinement import RigSight, refine_link
from reconstruct.mapping.working_range import ray_passes
from reconstruct.matching.matches import Matches

_LARGEST_GAP_PX = 3.0
"""Distance by which the two rays of a stereo point may miss each other, as seen from the cameras.
"""
_LARGEST_ERROR_PX = 12.0
"""Largest error of a resection: stereo depths are noisy, and show as parallax from the next
station."""
_LEAST_INLIERS = 15
_LEAST_SHARE = 0.25
_ENOUGH = 300
"""Points that a resection takes; more add time but little accuracy before the adjustment."""
_PARTNERS = 6
"""Stations that each is linked with: those that share most with it. Others add time, not shape."""
_BLOCK = 32
"""Pairs of stations in one task, so that sending them costs little."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StationLink:
    """Where one station is as another sees it."""

    first: int
    second: int
    """The two stations."""
    second_from_first: RigidTransform
    """Transform between the rigs' frames, metres."""
    inliers: int
    share: float
    """Inliers over the points tried."""
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
class _LinkAnswer:
    """The second station's rig as the first sees it; covariance of turn, then shift."""

    quaternion: Array
    shift: Array
    inliers: int
    covariance: Array


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
            good = (along > 0) & (other > 0) & (gap * focal < _LARGEST_GAP_PX * along)
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
        if len(best[0]) >= _LEAST_INLIERS:
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
    ransac.max_error = _LARGEST_ERROR_PX
    ransac.min_inlier_ratio = _LEAST_SHARE
    ransac.random_seed = seed
    ransac.min_num_trials, ransac.max_num_trials = 30, 1000
    ransac.confidence = 0.999
    refine = pycolmap.AbsolutePoseRefinementOptions()
    refine.print_summary = False
    sight = _sight(cameras, cam_from_rig)
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
        refined = refine_link(task.points, task.pixels, np.array(task.cameras), sight, start)
        if refined is None:
            answers.append(None)
            continue
        pose, covariance = refined
        answers.append(
            _LinkAnswer(
                quaternion=pose.rotation.as_quat(),
                shift=np.asarray(pose.translation),
                inliers=int(found["num_inliers"]),
                covariance=covariance,
            )
        )
    return answers


def _sight(
    cameras: Sequence[Mapping[str, object]], cam_from_rig: Sequence[tuple[Array, Array]]
) -> RigSight:
    params = np.array([camera["params"] for camera in cameras], float)  # of pinholes
    return RigSight(
        focal_px=params[:, :2],
        centre_px=params[:, 2:],
        turn=np.array([Rotation.from_quat(quat).as_matrix() for quat, _ in cam_from_rig]),
        shift=np.array([shift for _, shift in cam_from_rig]),
    )


def _link(task: _Resection, found: _LinkAnswer | None) -> StationLink | None:
    if found is None:
        return None
    share = found.inliers / len(task.points)
    turn, shift = np.trace(found.covariance[:3, :3]), np.trace(found.covariance[3:, 3:])
    known = turn > 0 and shift > 0 and np.isfinite(turn + shift)
    if found.inliers < _LEAST_INLIERS or share < _LEAST_SHARE or not known:
        return None
    return StationLink(
        first=task.first,
        second=task.second,
        second_from_first=RigidTransform.from_components(
            found.shift, Rotation.from_quat(found.quaternion)
        ),
        inliers=found.inliers,
        share=share,
        turn_variance=float(turn),
        shift_variance=float(shift),
    )
