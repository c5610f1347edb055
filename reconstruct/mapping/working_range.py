"""How far the sea floor is from the cameras: it decides where the warp to a pinhole is exact."""

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.core.errors import ReconstructionError, warn
from alice_survey.core.executor import Executor
from alice_survey.core.frames import Array
from alice_survey.core.manifest import ImageRecord
from alice_survey.core.records import RangeRecord, WarpRecord
from camera_calib.approximation.pinhole_warp import PinholeWarp
from camera_calib.camera import Camera
from camera_calib.rig import Rig
from reconstruct.matching.features import load_features
from reconstruct.matching.matches import SIFT_RATIO, match_descriptors
from reconstruct.views.range_shift import range_shift

_STATIONS = 24
"""Stations looked at, spread evenly; fewer where cameras make more pairs than there are cameras."""
_FEATURES = 3000
_MIN_POINTS = 50
_FIRST, _EXCHANGED = 6, 5.0
"""Stations that show whether cameras are exchanged, and how many times more points are then in
front of both cameras the other way round."""
_MAX_GAP_PX = 2.0
"""Rays of a match pass each other by at most this many pixels."""
_NEAR, _FAR = 0.75, 1.5
"""Nearest and farthest distances over the working range, when only the range is known."""
ANY_DISTANCE = "no refraction"
"""Source of distances where any would do."""
_MAX_CONTRACTION = 0.5
"""At which warped pictures are stretched by half, or twice as dense; at 1 they fold."""
_MAX_CUT = 0.05
"""Share of a frame whose loss is worth a warning."""


_StereoTask = tuple[tuple[Path, Path], tuple[Camera, Camera], RigidTransform, tuple[str, str]]
"""Features of two pictures of a station, their cameras, `second_from_first`, and their names."""


def first_stations(records: Sequence[ImageRecord]) -> list[int]:
    """Pictures of a few stations, spread evenly, by number."""
    stations = sorted({record.station for record in records})
    some = stations[:: max(1, len(stations) // _FIRST)]
    return [i for i, record in enumerate(records) if record.station in some]


def refuse_exchanged(
    records: Sequence[ImageRecord], features: Sequence[Path], rig: Rig, *, executor: Executor
) -> None:
    """Refuse pictures whose matches lie in front of the rig with two of its cameras exchanged.

    Args:
        records: pictures, of a few stations.
        features: file of features of every picture.
        rig: calibrated cameras.
        executor: where tasks run.

    Raises:
        ReconstructionError: two cameras seem exchanged.
    """
    tasks = _stereo_tasks(records, features, rig)
    ways = [*tasks, *((files[::-1], both, pose, pair) for files, both, pose, pair in tasks)]
    points: Counter[tuple[tuple[str, str], bool]] = Counter()
    for i, depths in enumerate(executor.map(stereo_depths, ways, label="order of cameras")):
        points[ways[i][-1], i < len(tasks)] += len(depths) // 2
    for pair in dict.fromkeys(pair for *_, pair in tasks):
        given, other = points[pair, True], points[pair, False]
        if other >= _MIN_POINTS and other > _EXCHANGED * given:
            raise ReconstructionError(
                f"{' and '.join(pair)} seem exchanged: {other} points lie in front of the rig that "
                f"way, {given} as they are: import the pictures the other way round"
            )


def find_distances(
    records: Sequence[ImageRecord], features: Sequence[Path], rig: Rig, *, executor: Executor
) -> RangeRecord:
    """Distances of the sea floor from stereo matches, else from the altitudes measured.

    Args:
        records: pictures.
        features: file of features of every picture.
        rig: calibrated cameras.
        executor: where tasks run.

    Raises:
        ReconstructionError: neither is there, and a camera refracts.
    """
    if not any(camera.refracts for camera in rig.cameras.values()):
        return RangeRecord(near_m=_NEAR, far_m=_FAR, source=ANY_DISTANCE)
    tasks = _stereo_tasks(records, features, rig)
    depths = np.concatenate([np.zeros(0), *executor.map(
        stereo_depths, tasks, label="working range"
    )])  # fmt: skip
    if len(depths) >= _MIN_POINTS:
        near, far = np.percentile(depths, [2.0, 98.0])
        return RangeRecord(near_m=float(near), far_m=float(far), source="stereo")
    altitudes = np.array([r.altitude_m for r in records])
    if np.isfinite(altitudes).any():
        glass = float(rig.cameras[rig.reference].front_cam[2])
        middle = float(np.nanmedian(altitudes)) + glass
        if tasks:
            warn(f"{len(depths)} points in stereo matches: the altitude sets the working range")
        return RangeRecord(near_m=_NEAR * middle, far_m=_FAR * middle, source="altitude")
    raise ReconstructionError(
        f"the distance to the sea floor is not known ({len(depths)} points in stereo matches, no "
        "altitude): import the pictures with a navigation log that has the altitude"
    )


def warp_record(warp: PinholeWarp, distances: RangeRecord | None) -> WarpRecord:
    """How well a pinhole stands in for a camera over distances; None: it has one centre."""
    contraction = np.zeros(1)
    if distances is not None:
        ends = np.array([distances.near_m, distances.far_m])
        contraction = range_shift(warp).contraction(ends - warp.centre_m[2])
    return WarpRecord(
        offset_m=warp.largest_offset_m,
        contraction=float(contraction.max()),
        cut_share=warp.cut_share,
    )


def warn_of_warps(warps: Mapping[str, PinholeWarp], distances: RangeRecord) -> None:
    """Warn, one line a camera, where a pinhole stands in badly or leaves much of the frame out."""
    for name, warp in warps.items():
        found = warp_record(warp, distances)
        if found.contraction > _MAX_CONTRACTION:
            warn(
                f"camera {name}: from {distances.near_m:.3g} to {distances.far_m:.3g} m its port "
                f"shifts neighbouring pixels by up to {found.contraction:.2f} px differently, and "
                "from 1 on two of them show one spot: centre the pupil behind the port, or keep "
                "farther from the sea floor"
            )
        if found.cut_share > _MAX_CUT:
            warn(
                f"camera {name}: {found.cut_share:.0%} of its frame, at the edges, lie beyond the "
                "undistorted picture and are left out: narrow the lens, or crop the pictures"
            )


def stereo_depths(task: _StereoTask) -> Array:
    """Depths of the matches of two pictures along the axis of either camera, exactly refracted."""
    files, (first, second), second_from_first, _ = task
    a, b = map(load_features, files)
    some, other = a.descriptors[:_FEATURES], b.descriptors[:_FEATURES]
    matches = match_descriptors(some, other, SIFT_RATIO)
    start_a, ray_a = first.unproject(a.pixels[matches[:, 0]])
    start_b, ray_b = second.unproject(b.pixels[matches[:, 1]])
    first_from_second = second_from_first.inv()
    start_b, ray_b = first_from_second.apply(start_b), first_from_second.rotation.apply(ray_b)
    along_a, gap = ray_passes(start_a, ray_a, start_b, ray_b)
    points = start_a + along_a[:, None] * ray_a
    depths = np.stack([points[:, 2], second_from_first.apply(points)[:, 2]])
    focal = first.focal_in_water_px
    with np.errstate(invalid="ignore"):
        good = (along_a > 0) & (gap * focal < _MAX_GAP_PX * depths[0]) & (depths[1] > 0)
    return depths[:, good].ravel()


def ray_passes(start_a: Array, ray_a: Array, start_b: Array, ray_b: Array) -> tuple[Array, Array]:
    """Where rays pass nearest to each other.

    Args:
        start_a: (N, 3) points of the first rays.
        ray_a: (N, 3) unit directions.
        start_b: (N, 3), the same of the second.
        ray_b: (N, 3).

    Returns:
        Distance along the first ray, (N,), and least distance between the two, (N,), metres; NaN
        where rays are parallel.
    """
    between = start_b - start_a
    cosine = (ray_a * ray_b).sum(axis=1)
    sine2 = 1.0 - cosine**2
    sine2 = np.where(sine2 > 1e-9, sine2, np.nan)
    to_a, to_b = (between * ray_a).sum(axis=1), (between * ray_b).sum(axis=1)
    along_a = (to_a - cosine * to_b) / sine2
    along_b = (cosine * to_a - to_b) / sine2
    gap = np.linalg.norm(between + along_b[:, None] * ray_b - along_a[:, None] * ray_a, axis=1)
    return along_a, gap


def _stereo_tasks(
    records: Sequence[ImageRecord], features: Sequence[Path], rig: Rig
) -> list[_StereoTask]:
    stations: dict[int, dict[str, int]] = {}
    for i, record in enumerate(records):
        stations.setdefault(record.station, {})[record.camera] = i
    together = [list(combinations(members.items(), 2)) for _, members in sorted(stations.items())]
    together = [pairs for pairs in together if pairs]
    cameras = max(map(len, stations.values()), default=0)
    step = max(1, sum(map(len, together)) // (_STATIONS * max(1, cameras - 1)))
    poses = rig.cam_from_rig
    return [
        (
            (features[i], features[j]),
            (rig.cameras[first], rig.cameras[second]),
            poses[second] * poses[first].inv(),
            (first, second),
        )
        for pairs in together[::step]
        for (first, i), (second, j) in pairs
    ]
