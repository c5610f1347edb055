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

from alice_survey.base.errors import warn
from alice_survey.base.frames import Array
from alice_survey.base.run import progress
from reconstruct.planes import Plane
from reconstruct.views.model import SparseModel

_COMPANY = 16
"""Sparse points around a spot of which the median counts: a single one may be a wrong match."""
_NODE_CELLS = 16
"""Cells of the DEM between places where it is computed."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PosePart:
    """Variances of the surface's height over a plane from poses, at sparse points."""

    places: Array
    """(P, 2) north and east, or up and right of another plane."""
    variances: Array
    """(P,) variances of the height, in the square of the model's unit."""

    @property
    def median(self) -> float:
        """Standard deviation at half of the points or less."""
        return float(np.sqrt(np.median(self.variances)))

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.places)

    def at_nodes(self, north: float, west: float, cell: float, rows: int, columns: int) -> Array:
        """Standard deviations (m, n) on a lattice over a grid of cells, its corners included.

        Args:
            north: coordinate of the grid's northern edge.
            west: of its western edge.
            cell: side of a cell.
            rows: of cells.
            columns: of cells.
        """
        m, n = (max(2, -(-count // _NODE_CELLS) + 1) for count in (rows, columns))
        norths = north - np.linspace(0, rows * cell, m)
        easts = west + np.linspace(0, columns * cell, n)
        spots = np.stack(np.meshgrid(norths, easts, indexing="ij"), axis=-1).reshape(-1, 2)
        count = min(_COMPANY, len(self.places))
        _, near = self._tree.query(spots, k=count)
        near = np.asarray(near).reshape(len(spots), count)
        found: Array = np.sqrt(np.median(self.variances[near], axis=1)).reshape(m, n)
        return found


@dataclass(frozen=True, kw_only=True, eq=False)
class ErrorsOfPoses:
    """What errors of poses do to sparse points."""

    points_world: Array
    """(P, 3)."""
    covariances: Array
    """(P, 3, 3)."""

    def over(self, plane: Plane) -> PosePart:
        """The part of it along a plane's normal."""
        normal = plane.normal_world
        variances = np.einsum("i,pij,j->p", normal, self.covariances, normal)
        places = plane.plane_from_world.apply(self.points_world)[:, :2]
        return PosePart(places=places, variances=np.maximum(variances, 0.0))


def spread_over(nodes: Array, rows: int, columns: int) -> Array:
    """A lattice (m, n) whose corners are a grid's at its cells (rows, columns), bilinear."""
    m, n = nodes.shape
    y = (np.arange(rows) + 0.5) / rows * (m - 1)
    x = (np.arange(columns) + 0.5) / columns * (n - 1)
    i, j = np.minimum(y.astype(int), m - 2), np.minimum(x.astype(int), n - 2)
    q, p = (y - i)[:, None], (x - j)[None, :]
    above = nodes[i][:, j] * (1 - p) + nodes[i][:, j + 1] * p
    below = nodes[i + 1][:, j] * (1 - p) + nodes[i + 1][:, j + 1] * p
    found: Array = above * (1 - q) + below * q
    return found


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
