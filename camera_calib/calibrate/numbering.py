"""One numbering of a symmetric target for all cameras.

A chessboard of two odd or two even counts looks the same when turned by half a turn, so that two
cameras may number its corners differently. The rig decides: only with one numbering do the
cameras stand to each other in the same way in all views.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.base.frames import Array
from camera_calib.calibrate.start import poses_alone
from camera_calib.calibration import TargetView
from camera_calib.flat_port import FlatPortCamera

Indices = NDArray[np.intp]


def same_numbering(
    cameras: Mapping[str, FlatPortCamera],
    views: Sequence[TargetView],
    points: Array,
    symmetries: Sequence[Indices],
) -> list[TargetView]:
    """Number points in every camera as in the first camera of a view.

    Args:
        cameras: near the truth.
        views: what they saw.
        points: (N, 3) of the target, metres.
        symmetries: other numberings (`Target.symmetries`).
    """
    names = list(cameras)
    poses = {name: poses_alone(name, cameras[name], views, points) for name in names}
    turns = [RigidTransform.identity(), *(_motion(points, entry) for entry in symmetries)]
    numbered = list(views)
    for c, name in enumerate(names):
        # The first camera before this one that sees a view is the measure, pair by pair.
        for other in names[:c]:
            both = [
                v for v in poses[name]
                if next(n for n in names if v in poses[n]) == other
            ]  # fmt: skip
            for v, choice in _choices(both, poses[name], poses[other], turns).items():
                if choice:
                    pixels = np.empty_like(views[v].pixels[name])
                    pixels[symmetries[choice - 1]] = views[v].pixels[name]
                    numbered[v] = replace(numbered[v], pixels={**numbered[v].pixels, name: pixels})
    return numbered


def _motion(points: Array, entry: Indices) -> RigidTransform:
    """The turn of the target that takes every point i to the place of point entry[i]."""
    middle = points.mean(axis=0)
    turn, _ = Rotation.align_vectors(points[entry] - middle, points - middle)
    return RigidTransform.from_components(middle - turn.apply(middle), turn)


def _choices(
    views: Sequence[int],
    poses: Mapping[int, RigidTransform],
    reference: Mapping[int, RigidTransform],
    turns: Sequence[RigidTransform],
) -> dict[int, int]:
    """Which of the turns of the target makes one camera agree with the reference, by view."""
    if not views:
        return {}
    between = RigidTransform.concatenate(
        [poses[v] * turn.inv() * reference[v].inv() for v in views for turn in turns]
    )
    matrices = between.rotation.as_matrix()
    cosines = (np.einsum("aij,bij->ab", matrices, matrices) - 1.0) / 2.0
    apart = np.arccos(np.clip(cosines, -1.0, 1.0))
    places = np.linalg.norm(between.translation[:, None] - between.translation, axis=-1)
    scale = float(np.median([np.linalg.norm(reference[v].translation) for v in views]))
    distance = (apart + places / scale).reshape(len(apart), len(views), len(turns))
    best = distance[int(np.argmin(distance.min(axis=2).sum(axis=1)))]
    return dict(zip(views, best.argmin(axis=1).tolist(), strict=True))
