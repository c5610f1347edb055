"""A COLMAP model's observations as arrays."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.frames import Array
from reconstruct.views.model_files import stored_of

Indices = NDArray[np.int64]
MIN_POINTS = 4
"""A station that sees fewer is not determined."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Observed:
    """Keypoints that have a point, picture by picture, as they are now."""

    pictures: Indices
    """(N,) ids of the registered pictures, ascending."""
    starts: Indices
    """(N + 1,) start of each picture's observations."""
    keypoint: Indices
    """(O,) index among the picture's keypoints."""
    pixels: Array
    """(O, 2) pixels of the keypoints."""
    point: Indices
    """(O,) index among `point_ids`."""
    point_ids: Indices
    """(P,) ids of the points, ascending."""
    points: Array
    """(P, 3) points in the model's frame."""
    in_cameras: Array
    """(O, 3) the observations' points in the frames of their cameras."""

    def of(self, number: int) -> slice:
        """The observations of the picture with this index among `pictures`."""
        return slice(int(self.starts[number]), int(self.starts[number + 1]))

    def row(self, picture: int) -> int:
        """Index among `pictures` of the one with this id; it must be there."""
        return int(np.searchsorted(self.pictures, picture))

    def residuals(self, model: pycolmap.Reconstruction) -> Array:
        """Where the cameras see the points minus where the keypoints are, (O, 2) pixels."""
        found = np.empty((len(self.point), 2))
        for n, number in enumerate(self.pictures.tolist()):
            rows = self.of(n)
            found[rows] = model.images[number].camera.img_from_cam(self.in_cameras[rows])
        return found - self.pixels


def frames_of(model: pycolmap.Reconstruction) -> Indices:
    """Ids of the frames that have a posed picture, ascending."""
    frames = {image.frame_id for image in model.images.values() if image.has_pose}
    return np.array(sorted(frames), dtype=np.int64)


def rig_poses(model: pycolmap.Reconstruction, frames: Indices) -> RigidTransform:
    """Poses (F,) `rig_from_world` of frames."""
    poses: list[Any] = [model.frames[frame].rig_from_world for frame in frames.tolist()]
    turns = Rotation.from_quat(np.array([pose.rotation.quat for pose in poses]))
    return RigidTransform.from_components(np.array([pose.translation for pose in poses]), turns)


def linked_groups(station: Indices, point: Indices, stations: int) -> Indices:
    """Which group each station, (F,), is in: no point is seen from two of them.

    The largest group is 0, of equals that with the first station; stations that see too little to
    be determined link nothing, and count as of group 0.

    Args:
        station: (O,) of every observation.
        point: (O,) its point.
        stations: F, how many there are.
    """
    seen = np.bincount(station, minlength=stations) >= MIN_POINTS
    links = np.flatnonzero(seen[station])
    size = stations + int(point.max(initial=-1)) + 1
    ends = (station[links], stations + point[links])
    _, label = connected_components(coo_array((np.ones(len(links)), ends), shape=(size, size)))
    labels, first, count = np.unique(label[:stations][seen], return_index=True, return_counts=True)
    rank = np.lexsort((first, -count))
    group = np.zeros(stations, np.int64)
    group[seen] = np.argsort(rank)[np.searchsorted(labels, label[:stations][seen])]
    return group


def model_groups(model: pycolmap.Reconstruction) -> Indices:
    """(F,) the group of linked stations (see `linked_groups`) of each of `frames_of`."""
    frames, seen = frames_of(model), observations(model)
    of_picture = [model.images[number].frame_id for number in seen.pictures.tolist()]
    station = np.repeat(np.searchsorted(frames, of_picture), np.diff(seen.starts))
    return linked_groups(station, seen.point, len(frames))


def first_of(group: Indices) -> Indices:
    """Which station is the first of each group, (K,), from the groups of stations (F,)."""
    return np.unique(group, return_index=True)[1]


def first_pictures(model: pycolmap.Reconstruction, given: Array | None = None) -> dict[int, int]:
    """The first posed picture of every frame; where `given` (N, K), of those without a NaN in it.

    Row i of `given` is of the picture with the id i + 1.
    """
    found: dict[int, int] = {}
    for number, image in sorted(model.images.items()):
        if image.has_pose and (given is None or np.isfinite(given[number - 1]).all()):
            found.setdefault(image.frame_id, number)
    return found


def cross_matrices(vectors: Array) -> Array:
    """(N, 3, 3) matrices M with `M b = a x b` for rows a."""
    found = np.zeros((len(vectors), 3, 3))
    found[:, [2, 0, 1], [1, 2, 0]] = vectors
    found[:, [1, 2, 0], [2, 0, 1]] = -vectors
    return found


def observations(model: pycolmap.Reconstruction) -> Observed:
    """The observations of a model as it is now."""
    poses = {n: i.cam_from_world().matrix() for n, i in model.images.items() if i.has_pose}
    pictures = np.array(sorted(poses), dtype=np.int64)
    stored = stored_of(model)
    ids, points = stored.point_ids, stored.points
    # One of no length first, for a model without pictures.
    rows: list[tuple[Any, ...]] = [
        (np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0, np.int64), np.zeros((0, 3)))
    ]
    for number in pictures.tolist():
        own, pose = stored.keypoints[number], poses[number]
        at = np.flatnonzero(own["point"] >= 0)
        mine = np.searchsorted(ids, own["point"][at]).astype(np.int64)
        rows.append((at, own["xy"][at], mine, points[mine] @ pose[:, :3].T + pose[:, 3]))
    keypoint, pixels, point, in_cameras = map(np.concatenate, zip(*rows, strict=True))
    return Observed(
        pictures=pictures,
        starts=np.cumsum([len(row[0]) for row in rows]),
        keypoint=keypoint,
        pixels=pixels,
        point=point,
        point_ids=ids,
        points=points,
        in_cameras=in_cameras,
    )


def ground_pixel(model: pycolmap.Reconstruction, seen: Observed) -> float:
    """Median size of a pixel on the ground, in units of the model; NaN without points."""
    rows = []
    for n, number in enumerate(seen.pictures.tolist()):
        depth = seen.in_cameras[seen.of(n), 2]
        if len(depth):
            rows.append(np.median(depth) / model.images[number].camera.mean_focal_length())
    return float(np.median(rows)) if rows else float("nan")
