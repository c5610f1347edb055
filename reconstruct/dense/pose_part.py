"""How far errors of poses move the surface: the share of its error that fusing views leaves.

Depths of one place from many views share errors, since they rest on the same poses. How much
is known at every sparse point: its covariance from the adjustment (`sparse/covariance.npz`), which
holds poses and pixels together, minus what its own observations leave with poses held.
The rest is what the poses around it do to a surface there.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from alice_survey.core.errors import warn
from alice_survey.core.frames import Array
from alice_survey.core.run import progress
from reconstruct.views.model import SparseModel

_COMPANY = 16
"""Sparse points around a spot of which the median counts: a single one may be a wrong match."""
_CHUNK = 50_000


@dataclass(frozen=True, kw_only=True, eq=False)
class ErrorsOfPoses:
    """What errors of poses do to sparse points."""

    points_world: Array
    """(P, 3)."""
    covariances: Array
    """(P, 3, 3)."""

    def median_along(self, normal_world: Array) -> float:
        """Standard deviation along a direction at half of the points or less."""
        return float(np.sqrt(np.median(_along(self.covariances, normal_world))))

    def around(self, low: Array, high: Array) -> "ErrorsOfPoses":
        """Those of the points around a box, of south and west (2,) to north and east (2,)."""
        margin = float(np.max(high - low))
        while True:
            reach = margin + float(np.max(high - low))
            near = np.array(self._level_tree.query_ball_point(low, reach, p=np.inf), np.int64)
            place = self.points_world[near, :2]
            near = near[((place > low - margin) & (place < high + margin)).all(axis=1)]
            if len(near) >= min(_COMPANY, len(self.points_world)):
                near.sort()
                return ErrorsOfPoses(
                    points_world=self.points_world[near], covariances=self.covariances[near]
                )
            margin *= 2.0

    def at(self, points_world: Array, normals_world: Array, block: float) -> Array:
        """Standard deviations (N,) of a surface's points along its normals.

        Args:
            points_world: (N, 3).
            normals_world: (N, 3) unit vectors.
            block: side of cubes whose points share the sparse points around.
        """
        cubes, of_point = np.unique(np.floor(points_world / block), axis=0, return_inverse=True)
        count = min(_COMPANY, len(self.points_world))
        near = np.asarray(self._tree.query((cubes + 0.5) * block, k=count)[1])
        near = near.reshape(len(cubes), count)[of_point.reshape(-1)]
        found = np.empty(len(points_world))
        for start in range(0, len(found), _CHUNK):
            part = slice(start, start + _CHUNK)
            covariances = self.covariances[near[part]]
            found[part] = np.median(_along(covariances, normals_world[part, None]), axis=1)
        sigmas: Array = np.sqrt(found)
        return sigmas

    @cached_property
    def _level_tree(self) -> cKDTree:
        return cKDTree(self.points_world[:, :2])

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.points_world)


def _along(covariances: Array, directions: Array) -> Array:
    """Variances (...,) along directions (..., 3) of covariances (..., 3, 3)."""
    found = np.einsum("...i,...ij,...j->...", directions, covariances, directions)
    variances: Array = np.maximum(found, 0.0)
    return variances


@progress.step("find what poses add to errors")
def find_errors_of_poses(workspace: Path, model: SparseModel) -> ErrorsOfPoses | None:
    """What poses do to points; None, with a warning, where it is not known."""
    path = workspace / "sparse" / "covariance.npz"
    if not path.is_file():
        warn("no sparse/covariance.npz: sigma.tif leaves out what errors of poses do to heights")
        return None
    from reconstruct.adjustment.uncertainty import read_uncertainty

    known = read_uncertainty(path)
    if len(known.point_ids) != len(model.points_world):
        warn("sparse/covariance.npz is not of this model: sigma.tif leaves out errors of poses")
        return None
    own = known.point_cov - known.point_noise
    seen = np.isfinite(own).all(axis=(1, 2))
    if not seen.any():
        warn("sparse/covariance.npz knows no point: sigma.tif leaves out errors of poses")
        return None
    return ErrorsOfPoses(points_world=model.points_world[seen], covariances=own[seen])
