"""Correlated errors of measured corners, and the covariance that they give a calibration.

Corners of one picture err together (light, blur, water), and so does one place of a board in all
pictures (print, paste). Counted as independent they make a calibration look better than it is. The
residuals show how much: their covariance is taken as a sum of a few known matrices, each times an
unknown variance, found from the residuals' products by least squares with no variance below 0
(C. R. Rao 1971, "Estimation of variance and covariance components - MINQUE theory"). What pose,
rig and shape take up of every matrix is taken off exactly. The covariance of the estimate is then
A^-1 B A^-1, with A the information that independent errors would give and B that of the slopes
under the errors as found (P. J. Huber 1967, "The behavior of maximum likelihood estimates under
nonstandard conditions").
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import nnls
from scipy.spatial.distance import cdist

from alice_survey.core.frames import Array
from camera_calib.calibrate.adjust import Adjustment
from camera_calib.calibrate.normal_equations import CalibrationProblem
from camera_calib.calibration import CornerNoise, ErrorBudget
from camera_calib.rig import Covariance

_REACHES = (0.12, 0.3, 0.8)
"""Lengths over the target's diagonal at which errors in one picture may go together."""
_AXES = (slice(0, 2), slice(2, 3))
"""Components of a place's offset with a variance of their own: in the target's plane, across it."""
_MIN_ALONE = 0.05
"""Least share of the noise's variance that is independent."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Part:
    """Errors that go together within a picture, or in all pictures of a view."""

    kernel: Array
    """(N, N) correlation of an axis between points."""
    in_all: bool
    """Whether all cameras of a view err alike: the board bends in a hand, or moves."""

    def smooth(self, values: Array, seen: Array) -> Array:
        """The correlation applied to (V, C, N, 2, m), with (V, C, N) of 0 where unseen."""
        base = values.sum(axis=1, keepdims=True) if self.in_all else values
        spread = self.kernel @ base.reshape(*base.shape[:3], -1)
        return spread.reshape(base.shape) * seen[..., None, None]


class _Weighted:
    """Weighted slopes and residuals of all views; 0 where unseen."""

    def __init__(self, problem: CalibrationProblem, found: Adjustment) -> None:
        state = problem.state(found.rig, found.rig_from_target, found.shape.values)
        views, cameras, count = problem.seen.shape
        size = len(problem.names)
        weights = np.nan_to_num(found.weights)
        slope = np.mean(np.where(weights < 1.0, 0.5 * weights, 1.0)[problem.seen])
        self.seen = problem.seen.astype(np.float64)
        self.by_rig = np.zeros((views, cameras, count, 2, size))
        self.by_place = np.zeros((views, cameras, count, 2, 3))
        self.missed = np.zeros((views, cameras, count, 2))
        by_pose = np.zeros((views, cameras, count, 2, 6))
        for slopes in problem.slopes(state):
            c, v, p = slopes.camera, slopes.views, len(slopes.at)
            use = np.where(problem.seen[v, c], 1.0, 0.0) / (found.noise_px * found.blur[v, c, None])
            rows = np.where(use[..., None, None] > 0, slopes.rows, 0.0) * use[..., None, None]
            self.by_rig[v[:, None, None, None], c, np.arange(count)[:, None, None],
                        np.arange(2)[:, None], slopes.at] = rows[..., :p]  # fmt: skip
            self.by_place[v, c] = np.where(use > 0, 1.0, 0.0)[..., None, None] * (
                np.nan_to_num(slopes.by_place) * use[..., None, None]
            )
            by_pose[v, c] = rows[..., p:-1]
            self.missed[v, c] = rows[..., -1] * (weights[v, c] / slope)[..., None]
        self.poses = np.linalg.qr(by_pose.reshape(views, -1, 6))[0].reshape(by_pose.shape)
        taken = np.einsum("vcnak,vcnap->vkp", self.poses, self.by_rig)
        self.by_rig -= np.einsum("vcnak,vkp->vcnap", self.poses, taken)
        taken_px = np.einsum("vcnak,vcna->vk", self.poses, self.missed)
        self.missed -= np.einsum("vcnak,vk->vcna", self.poses, taken_px)


def spread_of(
    problem: CalibrationProblem, found: Adjustment, tightened: float = 1.0
) -> ErrorBudget:
    """Estimate the noise from the residuals of an adjustment, and propagate it.

    Args:
        problem: whose pixels and parameters were adjusted.
        found: the result.
        tightened: how many times too small the rig's prior was taken, as a variance.
    """
    rows = _Weighted(problem, found)
    diagonal_m = float(np.linalg.norm(np.ptp(problem.points, axis=0)))
    squares = cdist(problem.points, problem.points, "sqeuclidean")
    parts = [_Part(kernel=np.eye(len(problem.points)), in_all=False)]
    for in_all in (False, True)[: len(problem.rig.cameras)]:
        for reach in _REACHES:
            kernel = np.exp(-0.5 * squares / (reach * diagonal_m) ** 2)
            parts.append(_Part(kernel=kernel, in_all=in_all))
    # In units of the covariance's root the unknowns are independent, each of variance 1.
    root = np.linalg.cholesky(found.covariance.matrix).astype(np.float64)
    products = _Products(rows, parts, root)
    theta = products.variances()
    pictures, places = theta[: len(parts)], theta[len(parts) :]
    pictures[0] = max(pictures[0], _MIN_ALONE)
    meat = np.einsum("k,kpq->pq", pictures, products.by_rig)
    shared = [
        root @ products.by_place[:, axes].reshape(-1, len(root)).T * np.sqrt(variance)
        for axes, variance in zip(_AXES, places, strict=True)
    ]
    at = problem.prior_at
    if at.size:
        known = np.linalg.cholesky(problem.prior_information)
        known[:, : len(problem.freedom.prior.parameters)] *= tightened**0.5
        shared.append(found.covariance.matrix[:, at] @ known)
    factor = np.concatenate(shared, axis=1)
    by_place = sum(
        variance * float((products.by_place[:, axes] ** 2).sum())
        for axes, variance in zip(_AXES, places, strict=True)
    )
    matrix = root @ meat @ root.T + factor @ factor.T
    return ErrorBudget(
        noise=CornerNoise(
            alone=float(pictures[0]),
            together=pictures[1:],
            place_sigmas_m=(float(np.sqrt(places[0])), float(np.sqrt(places[1]))),
        ),
        covariance=Covariance(parameters=problem.names, matrix=0.5 * (matrix + matrix.T)),
        shared=factor,
        excess=float((np.trace(meat) + by_place) / np.trace(products.by_rig[0])),
    )


class _Products:
    """Products of residuals by every part of the noise, and what each part would make of them.

    With M what is left of the residuals after all unknowns were fitted, r = M e, and K_j the parts'
    matrices, the mean of r^T K_i r is the sum of v_j tr(K_i M K_j M).
    """

    def __init__(self, rows: _Weighted, parts: list[_Part], root: Array) -> None:
        views, size = len(rows.seen), len(root)
        self.rows, self.parts = rows, parts
        by_rig = rows.by_rig @ root
        smoothed = np.stack([part.smooth(by_rig, rows.seen) for part in parts])
        poses = np.stack([part.smooth(rows.poses, rows.seen) for part in parts])
        self.smooth, self.poses = smoothed, poses
        self.by_rig = by_rig.reshape(-1, size).T @ smoothed.reshape(len(parts), -1, size)
        """(K, P, P) slopes' products under every part within pictures."""
        self.by_place = np.einsum("vcnai,vcnap->nip", rows.by_place, by_rig, optimize=True)
        """(N, 3, P)."""
        self.place_of_pose = np.einsum("vcnai,vcnak->vnik", rows.by_place, rows.poses)
        turned = rows.poses.reshape(views, -1, 6).transpose(0, 2, 1)
        self.crossed = turned @ smoothed.reshape(len(parts), views, -1, size)
        self.overlap = turned @ poses.reshape(len(parts), views, -1, 6)

    def variances(self) -> Array:
        """Variances of the parts within pictures, then of places by axes (square metres)."""
        count, rows = len(self.parts), self.rows
        size = count + len(_AXES)
        table, seen = np.zeros((size, size)), np.zeros(size)
        table[:count, :count] = self._of_pictures()
        pulled = np.einsum("vcnai,vcna->ni", rows.by_place, rows.missed)
        for i, part in enumerate(self.parts):
            table[i, count:] = table[count:, i] = self._of_both(i)
            smooth = part.smooth(rows.missed[..., None], rows.seen)
            seen[i] = float((rows.missed * smooth[..., 0]).sum())
        of_places = self._of_places()
        for i, axes in enumerate(_AXES, start=count):
            seen[i] = float((pulled[:, axes] ** 2).sum())
            for j, others in enumerate(_AXES, start=count):
                table[i, j] = float((of_places[:, axes][..., others] ** 2).sum())
        scale = 1.0 / np.sqrt(np.diag(table))
        # Under independent errors the products' covariance is twice the table.
        root = np.linalg.cholesky(table * np.outer(scale, scale) + 1e-12 * np.eye(size))
        found = nnls(root.T, solve_triangular(root, seen * scale, lower=True))[0]
        return found * scale

    def _of_pictures(self) -> Array:
        """(K, K) tr(K_i M K_j M) of the parts within pictures."""
        table = np.zeros((len(self.parts), len(self.parts)))
        for i, one in enumerate(self.parts):
            for j, other in enumerate(self.parts[: i + 1]):
                seen = self.rows.seen
                if one.in_all and other.in_all:
                    seen = seen.sum(axis=1, keepdims=True)
                both = one.kernel * other.kernel
                table[i, j] = table[j, i] = 2.0 * float(((seen @ both) * seen).sum())
        table -= 2.0 * (_inner(self.poses) + _inner(self.smooth) - _inner(self.crossed))
        return table + _inner(self.overlap) + _inner(self.by_rig)

    def _of_both(self, i: int) -> list[float]:
        """Of one part within pictures and the places, by axes."""
        rows, posed = self.rows, self.place_of_pose
        alike = rows.by_place.sum(axis=1) if self.parts[i].in_all else rows.by_place
        of_pose = np.einsum("vcnai,vcnak->vnik", rows.by_place, self.poses[i], optimize=True)
        through = np.einsum("vcnai,vcnap->nip", rows.by_place, self.smooth[i], optimize=True)
        through -= np.einsum("vnik,vkp->nip", posed, self.crossed[i], optimize=True)
        found = []
        for axes in _AXES:
            some, by_place = posed[:, :, axes], self.by_place[:, axes]
            total = float((alike[..., axes] ** 2).sum())
            total -= 2.0 * float((of_pose[:, :, axes] * some).sum())
            square = np.einsum("vnik,vnil->vkl", some, some)
            total += float((self.overlap[i] * square).sum())
            total -= 2.0 * float((by_place * through[:, axes]).sum())
            flat = by_place.reshape(-1, by_place.shape[-1])
            found.append(total + float((self.by_rig[i] * (flat.T @ flat)).sum()))
        return found

    def _of_places(self) -> Array:
        """(N, 3, N, 3) products of places' slopes, after all unknowns were fitted."""
        rows, count = self.rows, self.by_place.shape[0]
        posed = self.place_of_pose.transpose(1, 2, 0, 3).reshape(3 * count, -1)
        by_place = self.by_place.reshape(3 * count, -1)
        left = -(posed @ posed.T) - by_place @ by_place.T
        blocks: Array = left.reshape(count, 3, count, 3)
        own = np.einsum("vcnai,vcnaj->nij", rows.by_place, rows.by_place)
        blocks[np.arange(count), :, np.arange(count)] += own
        return blocks


def _inner(values: Array) -> Array:
    """(K, K) inner products of K arrays."""
    flat = values.reshape(len(values), -1)
    return flat @ flat.T
