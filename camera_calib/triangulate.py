"""Points in the water from their pixels in two or more cameras behind flat ports, exactly.

The start is the point nearest to all rays in water (for two rays, the middle of their common
perpendicular). From there the sum of the squared reprojection errors of all cameras is minimised
over the point, by Gauss-Newton with analytic slopes, damped where it must be (Levenberg-Marquardt).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array
from camera_calib.camera import Camera

_STEPS = 200
_SETTLED_PX = 1e-10
"""A full step that would move the pixels by less ends the search."""
_ROUNDING = 1e-11
"""Growth of the squared error, in px^2 or as a share of it, that may be rounding."""
_SINGULAR = 1e-14
"""Least over greatest eigenvalue of a matrix that has an inverse."""
_INSIDE = 1e-4
"""A start out of the water is moved into it by this share of its distance from the camera."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Triangulation:
    """Points in the water; a row is NaN where there is no solution (see `triangulate`).

    Example:
        >>> import alice_survey as alice
        >>> config = alice.SurveyConfig()
        >>> rig = alice.design_rig(config.camera, config.water)
        >>> cameras, poses = list(rig.cameras.values()), list(rig.cam_from_rig.values())
        >>> pixels = np.stack([c.project(p.apply([[0, 0, 2.0]])) for c, p in zip(cameras, poses)])
        >>> found = alice.triangulate(cameras, poses, pixels, sigma_px=0.1)
        >>> bool(found.sigmas_m[0, 2] < 0.002)
        True
    """

    points_world: Array
    """(N, 3) points of least squared reprojection error, metres."""
    covariance: Array
    """(N, 3, 3) covariances from the noise of the pixels alone, m^2."""
    residuals_px: Array
    """(C, N, 2) projected minus measured; NaN where a camera does not see the point."""

    @property
    def sigmas_m(self) -> Array:
        """(N, 3) standard deviations from the noise of the pixels alone."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))


def triangulate(
    cameras: Sequence[Camera],
    cam_from_world: Sequence[RigidTransform],
    pixels: Array,
    sigma_px: float | Sequence[float] = 1.0,
) -> Triangulation:
    """Find the points that two or more cameras see.

    A row has no solution, and is NaN, where fewer than two cameras see the point, the rays are
    parallel, or the squared error has no minimum in the water beyond every port.

    Args:
        cameras: C cameras.
        cam_from_world: their poses.
        pixels: (C, N, 2); NaN where a camera does not see the point.
        sigma_px: standard deviation of one coordinate of a pixel, of all cameras or of each; it
            weighs cameras against each other and scales the covariance.

    Raises:
        CalibrationError: lists that do not pair, or a sigma that is not positive.

    Example:
        >>> import alice_survey as alice
        >>> config = alice.SurveyConfig()
        >>> rig = alice.design_rig(config.camera, config.water)
        >>> cameras, poses = list(rig.cameras.values()), list(rig.cam_from_rig.values())
        >>> point = np.array([[0.1, 0.2, 2.0]])
        >>> pixels = np.stack([c.project(p.apply(point)) for c, p in zip(cameras, poses)])
        >>> found = alice.triangulate(cameras, poses, pixels, sigma_px=0.1)
        >>> bool(np.allclose(found.points_world, point))
        True
    """
    measured = np.ascontiguousarray(pixels, dtype=np.float64)
    sigmas = np.broadcast_to(np.asarray(sigma_px, dtype=np.float64), (len(cameras),))
    if measured.ndim != 3 or measured.shape[::2] != (len(cameras), 2):
        raise CalibrationError(
            f"triangulation: pixels {measured.shape} of {len(cameras)} cameras; (C, N, 2) expected"
        )
    if len(cam_from_world) != len(cameras) or len(cameras) < 2:
        raise CalibrationError(
            f"triangulation: {len(cameras)} cameras and {len(cam_from_world)} poses; two or more "
            "of each are needed"
        )
    if not np.all(np.isfinite(sigmas) & (sigmas > 0)):
        raise CalibrationError(f"triangulation: sigma_px {sigmas.tolist()} must be positive")
    origins, directions = rays_world(cameras, cam_from_world, measured)
    nearest = nearest_to_rays(origins, directions)
    # Weights relative to the best camera keep the search's own threshold in pixels.
    best = float(sigmas.min())
    points, covariance = _search(cameras, cam_from_world, measured, (best / sigmas) ** 2, nearest)
    return Triangulation(
        points_world=points,
        covariance=covariance * best**2,
        residuals_px=reproject(cameras, cam_from_world, points) - measured,
    )


def reproject(
    cameras: Sequence[Camera], cam_from_world: Sequence[RigidTransform], points_world: Array
) -> Array:
    """Pixels, (C, N, 2), of points (N, 3) in every camera; NaN where it cannot see them."""
    return np.stack(
        [
            camera.project(pose.apply(points_world))
            for camera, pose in zip(cameras, cam_from_world, strict=True)
        ]
    )


def nearest_to_rays(origins: Array, directions: Array) -> Array:
    """The points with the least sum of squared distances to several straight rays.

    Args:
        origins: (C, N, 3) a point of each ray; NaN rays do not count.
        directions: (C, N, 3) unit vectors.

    Returns:
        (N, 3); NaN where fewer than two rays count or they are parallel.
    """
    known = np.asarray(np.isfinite(origins + directions).all(axis=-1))
    across = np.eye(3) - directions[..., :, None] * directions[..., None, :]
    across = np.where(known[..., None, None], across, 0.0)
    right = (across @ np.where(known[..., None], origins, 0.0)[..., None]).sum(axis=0)
    matrices = across.sum(axis=0)
    solvable = (known.sum(axis=0) >= 2) & _are_regular(matrices)
    points = np.full((len(matrices), 3), np.nan)
    points[solvable] = np.linalg.solve(matrices[solvable], right[solvable])[..., 0]
    return points


def rays_world(
    cameras: Sequence[Camera], cam_from_world: Sequence[RigidTransform], pixels: Array
) -> tuple[Array, Array]:
    """Where rays in water leave the ports, and their unit directions, (C, N, 3) in the world."""
    origins, directions = np.empty((2, *pixels.shape[:2], 3))
    for i, (camera, pose) in enumerate(zip(cameras, cam_from_world, strict=True)):
        points_cam, directions_cam = camera.unproject(pixels[i])
        back = pose.rotation.as_matrix()  # rows times the matrix are the inverse rotation
        origins[i] = (points_cam - pose.translation) @ back
        directions[i] = directions_cam @ back
    return origins, directions


def _are_regular(matrices: Array) -> NDArray[np.bool_]:
    """(N,) which symmetric matrices (N, 3, 3) have an inverse beyond rounding."""
    values = np.linalg.eigvalsh(matrices)
    return values[:, 0] > _SINGULAR * values[:, -1]


def _equations(
    cameras: Sequence[Camera],
    cam_from_world: Sequence[RigidTransform],
    pixels: Array,
    weights: Array,
    points_world: Array,
) -> tuple[Array, Array, Array]:
    """Costs (N,) of points and their normal equations, matrix (N, 3, 3) step = right (N, 3).

    The cost is inf where a camera that sees a point has no pixel for it.
    """
    cost, right = np.zeros(len(points_world)), np.zeros((len(points_world), 3))
    matrix = np.zeros((len(points_world), 3, 3))
    for camera, pose, measured, weight in zip(
        cameras, cam_from_world, pixels, weights, strict=True
    ):
        found, by_point, _ = camera.project_jacobian(pose.apply(points_world))
        seen = np.isfinite(measured).all(axis=1)
        residuals = np.where(seen[:, None], found - measured, 0.0)
        slopes = np.where(seen[:, None, None], by_point @ pose.rotation.as_matrix(), 0.0)
        cost += weight * (residuals**2).sum(axis=1)
        matrix += weight * np.einsum("nki,nkj->nij", slopes, slopes)
        right -= weight * np.einsum("nki,nk->ni", slopes, residuals)
    return np.where(np.isnan(cost), np.inf, cost), matrix, right


def _in_water(
    cameras: Sequence[Camera],
    cam_from_world: Sequence[RigidTransform],
    pixels: Array,
    points_world: Array,
) -> Array:
    """Points, (N, 3), of which those not beyond every port that sees them are moved just inside."""
    seen = np.asarray(np.isfinite(pixels).all(axis=-1))
    points = points_world
    for _ in range(20):
        before = points
        for camera, pose, sees in zip(cameras, cam_from_world, seen, strict=True):
            cam = pose.apply(points)
            beyond, normals = camera.port.clearance(cam)
            lacking = _INSIDE * np.linalg.norm(cam, axis=1) - beyond
            push = np.where(sees & (lacking > 0.0), 2.0 * lacking, 0.0)
            points = points + push[:, None] * pose.rotation.inv().apply(normals)
        if np.array_equal(points, before, equal_nan=True):
            break
    return points


def _search(
    cameras: Sequence[Camera],
    cam_from_world: Sequence[RigidTransform],
    pixels: Array,
    weights: Array,
    starts: Array,
) -> tuple[Array, Array]:
    """Points of least cost, (N, 3), and the inverse of their normal matrices, (N, 3, 3)."""
    points, inverses = np.full(starts.shape, np.nan), np.full((*starts.shape, 3), np.nan)
    here = _in_water(cameras, cam_from_world, pixels, starts)
    cost, matrix, right = _equations(cameras, cam_from_world, pixels, weights, here)
    damping, at = np.zeros(len(starts)), np.flatnonzero(np.isfinite(cost))
    for _ in range(_STEPS):
        at = at[_are_regular(matrix[at])]
        if not at.size:
            break
        step = np.linalg.solve(matrix[at], right[at, :, None])[..., 0]
        settled = (step * right[at]).sum(axis=1) < _SETTLED_PX**2
        ridge = 1.0 + np.where(settled, 0.0, damping[at])[:, None, None] * np.eye(3)
        trial = here[at] + np.linalg.solve(ridge * matrix[at], right[at, :, None])[..., 0]
        tried = _equations(cameras, cam_from_world, pixels[:, at], weights, trial)
        good = tried[0] <= cost[at] + _ROUNDING * (1.0 + cost[at])
        better = at[good]
        here[better] = trial[good]
        cost[better], matrix[better], right[better] = (values[good] for values in tried)
        eased = np.where(damping[at] > 1e-4, 0.1 * damping[at], 0.0)
        damping[at] = np.where(good, eased, np.maximum(1e-3, 10.0 * damping[at]))
        done = at[settled & _are_regular(matrix[at])]
        points[done], inverses[done] = here[done], np.linalg.inv(matrix[done])
        at = at[~settled & (damping[at] <= 1e12)]
    return points, inverses
