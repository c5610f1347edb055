"""A COLMAP model's observations as arrays."""

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from alice_survey.frames import Array
from reconstruct.mapping.database import as_transform

Indices = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Observed:
    """Keypoints that have a point, picture by picture."""

    pictures: Indices
    """(N,) ids of the registered pictures, ascending."""
    starts: Indices
    """(N + 1,) where each picture's observations begin."""
    keypoint: Indices
    """(O,) index among the picture's keypoints."""
    point: Indices
    """(O,) index among `point_ids`."""
    point_ids: Indices
    """(P,) ascending."""

    def of(self, number: int) -> slice:
        """The observations of the picture with this index among `pictures`."""
        return slice(int(self.starts[number]), int(self.starts[number + 1]))

    def points(self, model: pycolmap.Reconstruction) -> Array:
        """Where the points are now, (P, 3)."""
        return np.array([model.points3D[i].xyz for i in self.point_ids.tolist()]).reshape(-1, 3)

    def in_cameras(self, model: pycolmap.Reconstruction, points: Array) -> Array:
        """The observations' points in the frames of their cameras, (O, 3)."""
        found = np.empty((len(self.point), 3))
        for n, number in enumerate(self.pictures.tolist()):
            pose = as_transform(model.images[number].cam_from_world())
            rows = self.of(n)
            if rows.stop > rows.start:
                found[rows] = pose.apply(points[self.point[rows]])
        return found

    def pixels(self, model: pycolmap.Reconstruction) -> Array:
        """Where the keypoints are, (O, 2)."""
        rows = [
            p.xy
            for number in self.pictures.tolist()
            for p in model.images[number].get_observation_points2D()
        ]
        return np.array(rows).reshape(-1, 2)

    def misses(self, model: pycolmap.Reconstruction) -> Array:
        """Where pinholes see the points less where the keypoints are, (O, 2) pixels."""
        local = self.in_cameras(model, self.points(model))
        found = np.empty((len(local), 2))
        for n, number in enumerate(self.pictures.tolist()):
            found[self.of(n)] = model.images[number].camera.img_from_cam(local[self.of(n)])
        missed: Array = found - self.pixels(model)
        return missed


def frames_of(model: pycolmap.Reconstruction) -> Indices:
    """Ids of the frames that have a posed picture, ascending."""
    frames = {image.frame_id for image in model.images.values() if image.has_pose}
    return np.array(sorted(frames), dtype=np.int64)


def observed(model: pycolmap.Reconstruction) -> Observed:
    """The observations of a model."""
    count = len(model.points3D)
    ids = np.sort(np.fromiter(model.points3D.keys(), dtype=np.int64, count=count))
    pictures = [n for n, image in sorted(model.images.items()) if image.has_pose]
    keypoints, points, starts = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [0]
    for number in pictures:
        image = model.images[number]
        keypoints.append(np.array(image.get_observation_point2D_idxs(), dtype=np.int64))
        mine = [p.point3D_id for p in image.get_observation_points2D()]
        points.append(np.searchsorted(ids, np.array(mine, dtype=np.int64)).astype(np.int64))
        starts.append(starts[-1] + len(mine))
    return Observed(
        pictures=np.array(pictures, dtype=np.int64),
        starts=np.array(starts, dtype=np.int64),
        keypoint=np.concatenate(keypoints),
        point=np.concatenate(points),
        point_ids=ids,
    )
