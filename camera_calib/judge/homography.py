"""Residuals of a homography between a flat target and its picture, without lens and port.

Through a perfect model a flat target is seen as a plane by a pinhole, so its points map to the
pinhole's pixels by a homography, whatever its pose. The flat port has no single centre: a pixel's
ray is followed exactly to the target's own distance there, and a virtual pinhole looks at that
spot. Of the pose only these distances are used, and they hardly matter: an error of 1 cm moves
such a pixel by about 0.001 px (20 mm port, 12.5 mm lens). No truth is needed; a trend with the
radius is an error of the model. What the found shape of a bent target moves is taken off first.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from alice_survey.core.frames import Array
from camera_calib.approximation.pinhole_warp import PinholeWarp, best_warp
from camera_calib.calibration import Calibration, stack_views
from camera_calib.judge.fit_quality import (
    Profile,
    largest_radius_px,
    outward,
    profile,
    radius_px,
)

_MIN_POINTS = 12
"""Fewest points of a view: 8 unknowns against 24 coordinates."""
_FLAT_SHARE = 1e-6
"""A target is flat if its points leave a plane by less than this share of its size."""
_OUTLYING = 6.0
"""Outlier limit of length over median length: 7 sigmas of normal noise."""
_HALF_STEP_PX = 0.5
_OUTER_SHARE = 0.7
"""Residuals beyond this share of the largest radius with points are compared with the others."""


@dataclass(frozen=True, kw_only=True, eq=False)
class HomographyTest:
    """Homography residuals of one camera, over all views."""

    profile: Profile
    """Residuals against the radius; expected as predicted from those of the inner points."""
    views: int
    inner_px: float
    """Standard deviation of one coordinate of the inner points, by the degrees of freedom."""
    outer_px: float
    """The same of the outer points."""
    outer_from_px: float
    """Radius at which outer points begin."""
    outer_count: int
    """Number of outer points."""

    @property
    def excess_px(self) -> float:
        """Excess of the outer residuals over the inner ones and chance (3 sigma); 0 if none.

        The variance of n points, two coordinates each, has a relative sigma of 1 / sqrt(n).
        """
        if not self.outer_count:
            return 0.0
        chance = self.inner_px**2 * (1.0 + 3.0 / self.outer_count**0.5)
        return float(max(self.outer_px**2 - chance, 0.0) ** 0.5)


def homography_test(calibration: Calibration, camera: str) -> HomographyTest | None:
    """Fit a homography to every view of one camera.

    Returns:
        None where the target is not flat, or no view has enough points.
    """
    points = calibration.drawn_points
    if not _is_flat(points):
        return None
    index = list(calibration.rig.cameras).index(camera)
    model = calibration.rig.cameras[camera]
    kept = np.isfinite(calibration.residuals_px[:, index, :, 0])
    measured = stack_views(calibration.views, calibration.rig, len(points))[:, index]
    poses = [calibration.rig.cam_from_rig[camera] * pose for pose in calibration.rig_from_target]
    if calibration.shape.parameters:
        for v, pose in enumerate(poses):
            bent = model.project(pose.apply(calibration.target_points))
            measured[v] -= bent - model.project(pose.apply(points))
    usable = [v for v in range(len(poses)) if kept[v].sum() >= _MIN_POINTS]
    if not usable:
        return None
    depths = np.concatenate([poses[v].apply(points[kept[v]])[:, 2] for v in usable])
    warp = best_warp(model, float(depths.min()), float(depths.max()))
    fits = []
    for v in usable:
        at = np.nonzero(kept[v])[0]
        stay, residual, freedom = _fit_view(warp, points[at], measured[v, at], poses[v])
        kept[v, at[~stay]] = False
        fits.append((residual, freedom))
    pixels = np.concatenate([measured[v, kept[v]] for v in usable])
    residuals = np.concatenate([residual for residual, _ in fits])
    freedom = np.concatenate([share for _, share in fits])
    radius = radius_px(model, pixels)
    outer_from = _OUTER_SHARE * float(radius.max())
    inner, outer = radius < outer_from, radius >= outer_from
    inner_px = _sigma(residuals[inner], freedom[inner])
    return HomographyTest(
        profile=profile(
            radius,
            residuals,
            (residuals * outward(model, pixels)).sum(axis=1),
            inner_px * np.sqrt(freedom),
            largest_radius_px(model),
        ),
        views=len(usable),
        inner_px=inner_px,
        outer_px=_sigma(residuals[outer], freedom[outer]),
        outer_from_px=outer_from,
        outer_count=int(outer.sum()),
    )


def _fit_view(
    warp: PinholeWarp,
    target_points: Array,
    pixels: Array,
    cam_from_target: RigidTransform,
) -> tuple[NDArray[np.bool_], Array, Array]:
    """Which points stay, and their `homography_residuals`, once outliers are set aside.

    Outliers are judged by the homography, not by the calibration's residuals: what its model cannot
    fit must not hide here.
    """
    stay = np.ones(len(pixels), dtype=bool)
    while True:
        residuals, freedom = homography_residuals(
            warp, target_points[stay], pixels[stay], cam_from_target
        )
        length = np.linalg.norm(residuals, axis=1)
        outlying = length > _OUTLYING * float(np.median(length))
        if not outlying.any() or len(length) - outlying.sum() < _MIN_POINTS:
            return stay, residuals, freedom
        stay[np.nonzero(stay)[0][outlying]] = False


def _sigma(residuals: Array, freedom: Array) -> float:
    total = float(freedom.sum())
    return float(((residuals**2).mean(axis=1).sum() / total) ** 0.5) if total > 0 else float("nan")


def _is_flat(points: Array) -> bool:
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[2] < _FLAT_SHARE * spread[0])


def homography_residuals(
    warp: PinholeWarp,
    target_points: Array,
    pixels: Array,
    cam_from_target: RigidTransform,
) -> tuple[Array, Array]:
    """Fit one view's homography, least squares in the camera's own pixels.

    Args:
        warp: the camera, whose lens and port are undone, and the pinhole that looks instead.
        target_points: (N, 3) on one plane, N > 4.
        pixels: (N, 2) as measured.
        cam_from_target: gives the distances of the points.

    Returns:
        Residuals (N, 2), fitted minus measured, in the camera's pixels; and (N,) the share of the
        noise's variance that the fit leaves in each (1 minus its leverage).
    """
    depth = cam_from_target.apply(target_points)[:, 2]

    def ideal(at: Array) -> Array:
        return warp.to_pinhole(at, depth)

    seen = ideal(pixels)
    # How ideal pixels move with measured ones, whose noise is the same everywhere.
    steps = _HALF_STEP_PX * np.eye(2)
    columns = [(ideal(pixels + s) - ideal(pixels - s)) / (2 * _HALF_STEP_PX) for s in steps]
    back = np.linalg.inv(np.stack(columns, axis=-1))
    plane = _plane_coordinates(target_points)
    centre, size = seen.mean(axis=0), np.abs(seen - seen.mean(axis=0)).max()
    h = np.ravel(cv2.findHomography(plane, (seen - centre) / size)[0])[:8]
    for _ in range(20):
        mapped, slopes = _map(h, plane)
        miss = np.einsum("nab,nb->na", back, size * mapped + centre - seen)
        rows = (back @ (size * slopes)).reshape(-1, 8)
        step = np.linalg.lstsq(rows, -miss.ravel(), rcond=None)[0]
        h = h + step
        if np.abs(step).max() < 1e-13:
            break
    mapped, slopes = _map(h, plane)
    miss = np.einsum("nab,nb->na", back, size * mapped + centre - seen)
    basis = np.linalg.qr((back @ (size * slopes)).reshape(-1, 8))[0]
    leverage = (basis**2).sum(axis=1).reshape(-1, 2).mean(axis=1)
    return miss, 1.0 - leverage


def _plane_coordinates(points: Array) -> Array:
    """(N, 2) in the points' own plane, about their middle, at most about 1 in size."""
    centred = points - points.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2][:2]
    flat: Array = centred @ axes.T / np.abs(centred @ axes.T).max()
    return flat


def _map(h: Array, plane: Array) -> tuple[Array, Array]:
    """Where a homography takes the plane's points, (N, 2), and its slopes by h, (N, 2, 8)."""
    x, y = plane.T
    bottom = h[6] * x + h[7] * y + 1.0
    u, v = (h[0] * x + h[1] * y + h[2]) / bottom, (h[3] * x + h[4] * y + h[5]) / bottom
    zero = np.zeros_like(x)
    row = [x / bottom, y / bottom, 1.0 / bottom]
    slopes = np.stack(
        [
            np.stack([*row, zero, zero, zero, -u * row[0], -u * row[1]], axis=1),
            np.stack([zero, zero, zero, *row, -v * row[0], -v * row[1]], axis=1),
        ],
        axis=1,
    )
    return np.stack([u, v], axis=1), slopes
