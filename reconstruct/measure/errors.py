"""What moves a surface's heights: errors that its cells share, on a lattice, and each cell's own.

`sigma.tif` holds both together, a cell at a time, so that a sum over cells needs more: how errors
go together. Poses and calibration move all of a surface, smoothly, by the motions that
`sparse/covariance.npz` states; a figure that hardly changes when all of its points move together
is hardly touched by them. What the dense stage adds is a cell's own, and fades within about two
cells. It is white noise of pixels under two kernels: the Gaussian window of 1.25 px in which
pictures are compared (`dense.refine_depth`), half a cell where a cell is 2.5 px wide
(`dense.matching_trial.CELL_PIXELS`), and the bilinear shares by which points count for the cells
around them (`dense.dem.cells_over`), whose variance is a sixth of a cell. Noise under a kernel of
variance s² correlates by exp(-d² / 4s²), here 4s² = 4 (1/4 + 1/6) cells².
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from alice_survey.core.frames import Array
from alice_survey.core.records import RegistrationRecord
from reconstruct.adjustment.uncertainty import SharedMotions, read_uncertainty
from reconstruct.planes import Plane
from reconstruct.views.model import WorldFrame

_NODES = 33
"""Nodes of the lattice along its longer side: motions that points share are smooth."""
_COMPANY = 8
"""Points around a node of which the mean counts."""
REACH_CELLS = 3
"""Cells up to which own errors go together: by 0.005 there."""
_OWN_KERNEL = 1 / 4 + 1 / 6
"""Variance of the kernels under which own errors are white noise, in cells."""


def own_correlation(cells: Array) -> Array:
    """Correlation of own errors at a distance in cells."""
    fading: Array = np.exp(-(cells**2) / (4 * _OWN_KERNEL))
    return np.where(cells < REACH_CELLS + 0.5, fading, 0.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class SharedErrors:
    """Motions that a surface's points share, in the axes of its rasters: right, up, out."""

    west: float
    south: float
    """Of the first node."""
    pitch: float
    motions: Array
    """(rows, columns, 3, K) of the nodes, rows from south to north, each by one sigma."""
    covariance: Array
    """(K, K) of these."""
    rest: Array
    """(rows, columns, 3, 3) covariances that the places around a node share with no others."""
    scale_sigma: float = 0.0
    """Of the logarithm of the scale, where it is known apart from the shape."""
    notes: tuple[str, ...] = ()
    """What is counted, and what is not."""

    @property
    def nodes(self) -> int:
        """Number of nodes."""
        return int(self.motions.shape[0] * self.motions.shape[1])

    def around(self, places: Array) -> tuple[NDArray[np.int64], Array]:
        """Numbers (N, 4) of the nodes around (N, 2) places, and their bilinear weights or NaN."""
        rows, columns = self.motions.shape[:2]
        x = np.clip((places[:, 0] - self.west) / self.pitch, 0.0, columns - 1.0)
        y = np.clip((places[:, 1] - self.south) / self.pitch, 0.0, rows - 1.0)
        left = np.minimum(np.nan_to_num(x).astype(np.int64), max(columns - 2, 0))
        low = np.minimum(np.nan_to_num(y).astype(np.int64), max(rows - 2, 0))
        right, high = np.minimum(left + 1, columns - 1), np.minimum(low + 1, rows - 1)
        x, y = x - left, y - low
        nodes = np.stack([low * columns + left, low * columns + right,
                          high * columns + left, high * columns + right], axis=1)  # fmt: skip
        weights = np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], axis=1)
        return nodes, weights

    def variance_of_heights(self, places: Array) -> Array:
        """Variances (N,) of the heights of (N, 2) places by what they share."""
        nodes, weights = self.around(places)
        return np.asarray((weights * self._of_heights[nodes]).sum(axis=1))

    def own_sigma(self, places: Array, sigma: Array) -> Array:
        """What a sigma (N,) of heights leaves to each of (N, 2) places alone."""
        return np.sqrt(np.maximum(sigma**2 - self.variance_of_heights(places), 0.0))

    @cached_property
    def _of_heights(self) -> Array:
        up = self.motions[..., 2, :].reshape(self.nodes, -1)
        rest = self.rest[..., 2, 2].ravel()
        return np.asarray(((up @ self.covariance) * up).sum(axis=1) + rest)

    def along(self, places: Array, axis: int) -> tuple[Array, Array]:
        """Bilinear weights, and those of the nearest node, (N, rows or columns) along an axis.

        Args:
            places: (N,) to the right, or up.
            axis: 0 to the right, 1 up.
        """
        count = self.motions.shape[1 - axis]
        at = np.clip((places - (self.west, self.south)[axis]) / self.pitch, 0.0, count - 1.0)
        smooth = np.maximum(1.0 - np.abs(at[:, None] - np.arange(count)), 0.0)
        return smooth, np.eye(count)[np.rint(at).astype(np.int64)]


@dataclass(frozen=True, kw_only=True, eq=False)
class PackedSlopes:
    """Derivatives of a figure by the motions of the few nodes that move it."""

    errors: SharedErrors
    nodes: NDArray[np.int64]
    """(N,) their numbers."""
    smooth: Array
    """(N, 3) by motions that change from node to node."""
    near: Array
    """(N, 3) by what the places around a node share."""
    own: float
    """Variance by own errors."""

    @property
    def shared(self) -> float:
        """Variance by what poses and calibration do to all."""
        errors, nodes = self.errors, self.nodes
        motions = errors.motions.reshape(errors.nodes, 3, -1)[nodes]
        by_motion = np.einsum("ni,nik->k", self.smooth, motions)
        rest = np.einsum("ni,nij,nj->", self.near, errors.rest.reshape(-1, 3, 3)[nodes], self.near)
        return max(float(by_motion @ errors.covariance @ by_motion) + float(rest), 0.0)


def sum_slopes(terms: Sequence[tuple[float, PackedSlopes]]) -> PackedSlopes:
    """A sum of figures, each times a factor, which know different own errors."""
    slopes = [one for _, one in terms]
    nodes, at = np.unique(np.concatenate([one.nodes for one in slopes]), return_inverse=True)
    smooth, near = (np.zeros((len(nodes), 3)) for _ in range(2))
    np.add.at(smooth, at, np.concatenate([factor * one.smooth for factor, one in terms]))
    np.add.at(near, at, np.concatenate([factor * one.near for factor, one in terms]))
    return PackedSlopes(
        errors=slopes[0].errors, nodes=nodes, smooth=smooth, near=near,
        own=sum(factor**2 * one.own for factor, one in terms),
    )  # fmt: skip


class FigureSlopes:
    """Derivatives of a figure with respect to the surface's motions, gathered part by part."""

    def __init__(self, errors: SharedErrors) -> None:
        """Begin with a figure that nothing moves."""
        self._errors = errors
        self._smooth, self._near = (np.zeros((errors.nodes, 3)) for _ in range(2))
        self._own = 0.0

    def add(self, places: Array, slopes: Array, own: float) -> None:
        """Add places (N, 2), derivatives (N, 3) by their motions, and variance by own errors."""
        nodes, weights = self._errors.around(places)
        for axis in range(3):
            shares = weights * slopes[:, axis, None]
            self._smooth[:, axis] += np.bincount(
                nodes.ravel(), shares.ravel(), minlength=self._errors.nodes
            )
            nearest = nodes[np.arange(len(nodes)), weights.argmax(axis=1)]
            self._near[:, axis] += np.bincount(
                nearest, slopes[:, axis], minlength=self._errors.nodes
            )
        self._own += own

    def add_grid(self, x: Array, y: Array, slopes: Array, own: float) -> None:
        """Add derivatives (rows, columns, 3) of a grid at x (columns,) and y (rows,)."""
        right, up = (self._errors.along(places, axis) for axis, places in enumerate((x, y)))
        for gathered, across, upwards in zip(
            (self._smooth, self._near), right, up, strict=True
        ):  # fmt: skip
            for axis in range(3):
                part = np.ascontiguousarray(slopes[..., axis])
                gathered[:, axis] += (upwards.T @ (part @ across)).ravel()
        self._own += own

    def count_once(self, scatter: float) -> None:
        """Own variance of a figure that noise enters as a square, too.

        Derivatives at measured heights count that twice: of a quadratic form q = nᵀAn of noise of
        covariance K their variance is 4 tr(AKAK) in the mean, and that of q is 2 tr(AKAK).

        Args:
            scatter: variance of the quadratic form.
        """
        self._own = max(self._own - scatter, scatter)

    @property
    def packed(self) -> PackedSlopes:
        """Those that are not zero: a small polygon is moved by few nodes."""
        nodes = np.flatnonzero((self._smooth != 0.0).any(axis=1) | (self._near != 0.0).any(axis=1))
        return PackedSlopes(
            errors=self._errors, nodes=nodes, smooth=self._smooth[nodes], near=self._near[nodes],
            own=self._own,
        )  # fmt: skip


def shared_errors(
    workspace: Path, plane: Plane, frame: WorldFrame, bounds: tuple[float, float, float, float]
) -> SharedErrors:
    """What poses, calibration and scale do to the surface of a workspace.

    Args:
        workspace: reconstructed.
        plane: of its rasters.
        frame: of its model.
        bounds: west, south, east and north of its rasters.
    """
    notes = ["counted: own errors of cells, which go together within about two cells"]
    path = workspace / "sparse" / "covariance.npz"
    shared = read_uncertainty(path).shared if path.is_file() else None
    if shared is None:
        notes.append("not counted: errors of poses and calibration, which are not known here")
        shared = SharedMotions(
            np.zeros((1, 3)), np.zeros((1, 3, 0)), np.zeros((0, 0)), np.zeros((1, 3, 3))
        )
    else:
        notes.append("counted: shape and scale of the model, by its poses and its calibration")
    found = on_lattice(in_plane(shared, plane), bounds, _NODES)
    record = RegistrationRecord.read_existing(workspace / RegistrationRecord.path)
    place = None if record is None else record.georeference
    scale = 0.0 if place is None else place.sigma_scale
    if not frame.scaled:
        notes.append("not counted: the model has no scale, figures are in its own units")
    elif scale > 0.0:
        notes.append(f"counted: the scale of navigation, sigma {scale:.2g}")
    return replace(found, scale_sigma=scale, notes=tuple(notes))


def in_plane(shared: SharedMotions, plane: Plane) -> SharedMotions:
    """Motions in the axes of a plane's rasters: right, up, out."""
    to_raster = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    turn = to_raster @ plane.plane_from_world.rotation.as_matrix()
    return SharedMotions(
        plane.plane_from_world.apply(shared.places) @ to_raster.T,
        turn @ shared.motions,
        shared.covariance,
        turn @ shared.rest @ turn.T,
    )


def on_lattice(
    shared: SharedMotions, bounds: tuple[float, float, float, float], nodes: int
) -> SharedErrors:
    """Motions of points as those of a lattice over a raster.

    Args:
        shared: of points, in the raster's axes.
        bounds: west, south, east and north of the raster.
        nodes: along its longer side.
    """
    # A variance that rounding left below zero is none.
    values, axes = np.linalg.eigh((shared.rest + shared.rest.swapaxes(1, 2)) / 2)
    rest = np.einsum("nij,nj,nkj->nik", axes, np.maximum(values, 0.0), axes)
    west, south, east, north = bounds
    pitch = max(east - west, north - south) / (nodes - 1)
    columns, rows = (
        max(2, int(np.ceil(side / pitch - 1e-9)) + 1) for side in (east - west, north - south)
    )
    y, x = np.mgrid[:rows, :columns]
    places = np.column_stack([west + pitch * x.ravel(), south + pitch * y.ravel()])
    company = np.arange(1, min(_COMPANY, len(shared.places)) + 1)
    near = np.asarray(KDTree(shared.places[:, :2]).query(places, k=company)[1])
    return SharedErrors(
        west=west, south=south, pitch=pitch, covariance=shared.covariance,
        motions=shared.motions[near].mean(axis=1).reshape(rows, columns, 3, -1),
        rest=rest[near].mean(axis=1).reshape(rows, columns, 3, 3),
    )  # fmt: skip
