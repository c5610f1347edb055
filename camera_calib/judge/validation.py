"""Tests of a calibration that are independent of its own residuals.

- Held-out views: pictures that took no part, posed in the rig; their error against what noise and
  the rig's covariance predict.
- Halves: two calibrations from disjoint views, and how far their parameters lie apart, against what
  their covariances predict.
- Lengths: distances on the target, from triangulated points.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from scipy.spatial.transform import RigidTransform
from scipy.special import chdtrc, stdtr

from alice_survey.core.errors import CalibrationError, warn
from alice_survey.core.frames import Array
from alice_survey.core.run import progress
from camera_calib.calibration import Calibration, TargetView, residuals_px, stack_views
from camera_calib.camera import pose_jacobian
from camera_calib.freedom import POSE, value
from camera_calib.judge.residuals import rms_length_px, within_gate
from camera_calib.judge.uncertainty import covariance_of, rig_slopes, taken_up
from camera_calib.rig import Rig
from camera_calib.triangulate import triangulate

_EVERY = 5
"""One view in this many is held out."""
_MIN_KNOWN = 1e-12
"""Least eigenvalue over the largest of a covariance scaled to unit variances; less is rounding."""
_P_WIDER = 0.05
"""Level of the test that widens sigmas: for one exact calibration in twenty, too."""

Calibrate = Callable[[Sequence[TargetView]], Calibration]
Locate = Callable[[Rig, TargetView, Array], RigidTransform]


@dataclass(frozen=True, kw_only=True, eq=False)
class HeldOut:
    """Views that took no part in a calibration, and two calibrations from halves of the views."""

    used: Calibration
    """Calibration without the held-out views."""
    views: tuple[TargetView, ...]
    """(H) held-out views."""
    rig_from_target: RigidTransform
    """(H,) their poses, found in the rig of `used`."""
    residuals_px: Array
    """(H, cameras, N, 2) projected minus measured."""
    halves: tuple[Calibration, Calibration] | None
    """Each from every other view; None where a half did not suffice."""


@progress.step("hold views out")
def hold_out(views: Sequence[TargetView], calibrate: Calibrate, locate: Locate) -> HeldOut | None:
    """Calibrate without every n-th view and pose those; calibrate from either half of the views.

    Args:
        views: those that the calibration kept.
        calibrate: the calibration to be tested.
        locate: finds `rig_from_target` of one view in a rig, from the target's points.

    Returns:
        None, with a warning, where too few views are left to calibrate from.
    """
    # The middle of each run, so that first and last views, often the odd ones, are used.
    held = tuple(view for i, view in enumerate(views) if i % _EVERY == _EVERY // 2)
    rest = [view for i, view in enumerate(views) if i % _EVERY != _EVERY // 2]
    try:
        used = calibrate(rest)
    except CalibrationError as error:
        warn(f"no hold-out test: {len(rest)} of {len(views)} views do not calibrate: {error}")
        return None
    placed = []
    for view in held:
        try:
            placed.append((view, locate(used.rig, view, used.target_points)))
        except CalibrationError as error:
            warn(f"hold-out test: view {view.name} is left out: {error}")
    if not placed:
        warn(f"no hold-out test: none of {len(held)} held-out views could be posed")
        return None
    try:
        halves = (calibrate(views[::2]), calibrate(views[1::2]))
    except CalibrationError as error:
        warn(f"no test by halves: half of {len(views)} views does not calibrate: {error}")
        halves = None
    posed = tuple(view for view, _ in placed)
    poses = RigidTransform.concatenate([pose for _, pose in placed])
    pixels = stack_views(posed, used.rig, len(used.target_points))
    return HeldOut(
        used=used,
        views=posed,
        rig_from_target=poses,
        residuals_px=residuals_px(used.rig, poses, used.target_points, pixels),
        halves=halves,
    )


@dataclass(frozen=True, kw_only=True)
class HoldOutScore:
    """Held-out views against used ones, outliers set aside. Lengths of residuals."""

    views: int
    points: int
    rms_px: float
    expected_px: float
    """Rms expected from noise and the rig's covariance, as far as a pose cannot absorb it."""
    used_rms_px: float
    outliers: int
    p_value: float
    """Probability of as large residuals by chance, as it scatters between the views."""


def score_hold_out(held: HeldOut) -> HoldOutScore:
    """Compare held-out residuals with what the calibration without them predicts.

    With G the slopes by a view's pose, J those by the rig's parameters and S their covariance, the
    residuals of a posed view are P (noise + J d), P = 1 - G (G^T G)^-1 G^T.
    """
    rig, noise_px = held.used.rig, held.used.noise_px
    matrix = covariance_of(rig).matrix
    kept = within_gate(held.residuals_px, noise_px)
    expected = np.zeros(len(held.views))
    for v in range(len(held.views)):
        points_rig = held.rig_from_target[v].apply(held.used.target_points)
        by_pose, by_parameter = [], []
        for c, camera in enumerate(rig.cameras):
            _, by_point, slopes = rig_slopes(rig, camera, points_rig[kept[v, c]])
            by_pose.append(pose_jacobian(by_point, points_rig[kept[v, c]]).reshape(-1, 6))
            by_parameter.append(slopes.reshape(-1, slopes.shape[-1]))
        g, j = np.concatenate(by_pose), np.concatenate(by_parameter)
        if len(g) <= 6:
            continue
        left = j - g @ taken_up(g, j)
        expected[v] = noise_px**2 * (len(g) - 6)
        expected[v] += float(np.einsum("np,pq,nq->", left, matrix, left))
    points, total = int(kept.sum()), float(expected.sum())
    fitting = within_gate(held.used.residuals_px, noise_px)
    found, used = (
        (one**2).sum(axis=(1, 2, 3), where=stay[..., None])
        for one, stay in ((held.residuals_px, kept), (held.used.residuals_px, fitting))
    )
    usual = noise_px**2 * np.maximum(2.0 * fitting.sum(axis=(1, 2)) - 6.0, 1.0)
    return HoldOutScore(
        views=len(held.views),
        points=points,
        rms_px=rms_length_px(held.residuals_px, noise_px),
        expected_px=float(np.sqrt(total / points)) if points else float("nan"),
        used_rms_px=rms_length_px(held.used.residuals_px, held.used.sigma_px[..., None]),
        outliers=int(np.isfinite(held.residuals_px[..., 0]).sum()) - points,
        p_value=_p_larger(found, expected, used, usual),
    )


def _p_larger(found: Array, expected: Array, used: Array, usual: Array) -> float:
    """Student's test of whether views have larger squares than expected, by all views' scatter."""
    known = expected > 0.0
    if not known.any():
        return 0.0
    held, rest = np.log(found[known] / expected[known]), np.log(used / usual)
    freedom = len(held) + len(rest) - 2
    squares = (held.var() * len(held) + rest.var() * len(rest)) / freedom
    sigma = np.sqrt(squares * (1.0 / len(held) + 1.0 / len(rest)))
    return float(stdtr(freedom, -held.mean() / sigma))


@dataclass(frozen=True, kw_only=True)
class HalvesAgreement:
    """Difference of the parameters of two calibrations, by their covariances."""

    chi2: float
    parameters: int
    """Mean of `chi2`, if the covariances are true."""
    p_value: float
    """Probability of as large a difference, if the covariances are true."""

    @property
    def widening(self) -> float:
        """Factor for the sigmas: Birge's ratio where chance seldom makes such a difference."""
        return float((self.chi2 / self.parameters) ** 0.5) if self.p_value < _P_WIDER else 1.0


def halves_agreement(halves: tuple[Calibration, Calibration]) -> HalvesAgreement:
    """Compare all calibrated parameters of two calibrations of one rig, turns as small turns.

    Errors of what both took as known, and of the one target that both saw, are the same in both:
    only the difference of their effects shows.
    """
    first, second = (half.rig for half in halves)
    names = covariance_of(first).parameters
    apart = np.array([value(second, name) - value(first, name) for name in names])
    for camera in first.cameras:
        turns = [f"{camera}.{axis}" for axis in POSE[:3]]
        if set(turns) <= set(names):
            turn = second.cam_from_rig[camera].rotation * first.cam_from_rig[camera].rotation.inv()
            apart[[names.index(name) for name in turns]] = turn.as_rotvec()
    between = halves[0].shared - halves[1].shared
    matrix = between @ between.T
    for half in halves:
        matrix = matrix + covariance_of(half.rig).matrix - half.shared @ half.shared.T
    scale = 1.0 / np.sqrt(np.diag(matrix))
    values, vectors = np.linalg.eigh(matrix * np.outer(scale, scale))
    known = values > _MIN_KNOWN * values[-1]
    along = vectors[:, known].T @ (scale * apart)
    total, count = float((along**2 / values[known]).sum()), int(known.sum())
    return HalvesAgreement(chi2=total, parameters=count, p_value=float(chdtrc(count, total)))


@dataclass(frozen=True, kw_only=True, eq=False)
class LengthErrors:
    """Distances on the target, triangulated minus true."""

    true_m: Array
    """(L,)"""
    error_m: Array
    """(L,)"""
    bias_m: Array
    """(L,) expected from the noise of the pixels alone: errors across a length make it longer."""
    sigma_m: Array
    """(L,) expected from the noise of the pixels alone."""
    view: NDArray[np.intp]
    """(L,) number of the view."""

    def scale_ppm(self) -> tuple[float, float]:
        """Relative error of the lengths, and its sigma from the scatter between views.

        The error of a view is that of its lengths beyond their bias; its weight the inverse of
        their mean variance. NaN where fewer than two views have lengths.
        """
        views = np.unique(self.view)
        count = len(views)
        if count < 2:
            return float("nan"), float("nan")
        errors, weights = np.zeros((2, count))
        for i, v in enumerate(views):
            at = self.view == v
            beyond, true = self.error_m[at] - self.bias_m[at], self.true_m[at]
            errors[i] = beyond @ true / (true @ true)
            weights[i] = 1.0 / (self.sigma_m[at] ** 2).mean()
        share = weights / weights.sum()
        mean = float(share @ errors)
        variance = float(share**2 @ (errors - mean) ** 2) * count / (count - 1)
        return 1e6 * mean, 1e6 * variance**0.5

    def rms_m(self) -> tuple[float, float]:
        """Rms error of the lengths, and the expected one; NaN for none."""
        if not len(self.view):
            return float("nan"), float("nan")
        squares = self.error_m**2, self.sigma_m**2 + self.bias_m**2
        found, expected = (float(np.sqrt(square.mean())) for square in squares)
        return found, expected


def length_errors(
    rig: Rig,
    views: Sequence[TargetView],
    rig_from_target: RigidTransform,
    residuals: Array,
    target_points: Array,
    noise_px: Array | float,
) -> LengthErrors:
    """Triangulate the points of two or more cameras and compare long lengths with the target's.

    With C the covariance of the difference of both points, u the length's direction, L the length
    and Q = 1 - u u^T, noise gives a length the bias tr(Q C) / 2L and the variance
    u^T C u + tr((Q C)^2) / 2L^2, to second order.

    Args:
        rig: calibrated.
        views: (V) where the cameras saw the target.
        rig_from_target: (V,) its poses; they only give the directions of the lengths.
        residuals: (V, cameras, N, 2); outliers among them take no part.
        target_points: (N, 3).
        noise_px: standard deviation of one coordinate, of all or of each picture (V, cameras).
    """
    sigma_px = np.broadcast_to(noise_px, (len(views), len(rig.cameras)))
    pixels = stack_views(views, rig, len(target_points))
    pixels[~within_gate(residuals, sigma_px[..., None])] = np.nan
    poses = [rig.cam_from_rig[camera] for camera in rig.cameras]
    parts: list[tuple[Array, ...]] = []
    for v in range(len(views)):
        found = triangulate(list(rig.cameras.values()), poses, pixels[v], sigma_px[v].tolist())
        seen = np.nonzero(np.isfinite(found.points_world).all(axis=1))[0]
        if len(seen) < 2:
            continue
        a, b = farthest(target_points, seen).T
        along = target_points[a] - target_points[b]
        true = np.linalg.norm(along, axis=1)
        unit = rig_from_target[v].rotation.apply(along / true[:, None])
        length = np.linalg.norm(found.points_world[a] - found.points_world[b], axis=1)
        spread = found.covariance[a] + found.covariance[b]
        lengthwise = np.einsum("na,nab,nb->n", unit, spread, unit)
        across = (np.eye(3) - unit[:, :, None] * unit[:, None, :]) @ spread
        bias = np.trace(across, axis1=1, axis2=2) / (2 * true)
        variance = lengthwise + np.einsum("nab,nba->n", across, across) / (2 * true**2)
        parts.append((true, length - true, bias, np.sqrt(variance), np.full(len(a), v)))
    empty = (np.zeros(0),) * 5
    true, error, bias, sigma, number = (
        np.concatenate(columns) for columns in zip(*(parts or [empty]), strict=True)
    )
    return LengthErrors(
        true_m=true, error_m=error, bias_m=bias, sigma_m=sigma,
        view=number.astype(np.intp),
    )  # fmt: skip


def farthest(target_points: Array, seen: NDArray[np.intp]) -> NDArray[np.intp]:
    """Pairs (K, 2): each seen point with the seen one farthest from it, no pair twice."""
    away = cdist(target_points[seen], target_points[seen]).argmax(axis=1)
    pairs = np.sort(np.stack([seen, seen[away]], axis=1), axis=1)
    return np.unique(pairs, axis=0)
