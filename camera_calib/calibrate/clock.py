"""Clock offsets between the cameras of a rig, estimated from moving objects.

A camera that is late shows a moving object where it will be a little later: its ray misses those of
the others in proportion to how fast the object crosses its picture. The share of all misses that
follows these speeds is the lag.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from alice_survey.base.frames import Array
from camera_calib.camera import Camera
from camera_calib.triangulate import Triangulation

_WIDEST_FRAMES = 4
"""A speed is taken between the frames before and after, if they are no farther apart."""
_FEWEST_POINTS = 100
_ROUNDS = 50
_CAUCHY = 2.385
"""Tuning of Cauchy's weights: 95 % of the efficiency of least squares for normal errors."""


@dataclass(frozen=True, kw_only=True)
class Lag:
    """Lag of a camera behind the first, for pictures of equal numbers."""

    frames: float
    sigma: float
    """Standard deviation as if misses were independent; those of neighbouring frames are not."""
    points: int
    """Number of observations with a speed."""


def estimate_lags(
    cameras: Sequence[Camera],
    cam_from_world: Sequence[RigidTransform],
    speeds_px: Array,
    found: Triangulation,
) -> tuple[Lag, ...]:
    """Lags of all cameras but the first; empty where too few objects move.

    Args:
        cameras: C cameras.
        cam_from_world: their poses.
        speeds_px: (C, N, 2) see `pixel_speeds`.
        found: the N points, triangulated from the pixels that have these speeds.
    """
    count = len(found.points_world)
    slopes = np.zeros((count, len(cameras), 2, 3))
    for i, (camera, pose) in enumerate(zip(cameras, cam_from_world, strict=True)):
        by_point = camera.project_jacobian(pose.apply(found.points_world))[1]
        slopes[:, i] = by_point @ pose.rotation.as_matrix()
    usable = np.isfinite(slopes).all(axis=(1, 2, 3)) & np.isfinite(speeds_px).all(axis=(0, 2))
    usable &= np.isfinite(found.residuals_px).all(axis=(0, 2))
    total = int(usable.sum())
    if total < _FEWEST_POINTS:
        return ()
    by_point = slopes[usable].reshape(total, -1, 3)
    along = np.linalg.solve(by_point.transpose(0, 2, 1) @ by_point, by_point.transpose(0, 2, 1))
    apart = np.eye(2 * len(cameras)) - by_point @ along
    late = np.zeros((total, len(cameras), 2, len(cameras) - 1))
    for i in range(1, len(cameras)):
        late[:, i, :, i - 1] = speeds_px[i, usable]
    # Pixels of a camera that is late by L frames should be moved back by L times their speed.
    by_lag = apart @ late.reshape(total, 2 * len(cameras), len(cameras) - 1)
    misses = found.residuals_px[:, usable].transpose(1, 0, 2).reshape(total, -1)
    lags, sigmas = _robust_fit(by_lag, misses, 2 * len(cameras) - 3)
    return tuple(
        Lag(frames=float(lag), sigma=float(sigma), points=total)
        for lag, sigma in zip(lags, sigmas, strict=True)
    )


def pixel_speeds(frames: NDArray[np.int64], ids: NDArray[np.int64], pixels: Array) -> Array:
    """Speeds of moving objects in the pictures, (C, N, 2), pixels a frame; NaN where not known.

    Args:
        frames: (N,) increasing for each object; a frame that one object has twice gives no speed.
        ids: (N,) which object.
        pixels: (C, N, 2); NaN where a camera does not see it.
    """
    speeds = np.full_like(pixels, np.nan)
    for thing in np.unique(ids):
        of_thing = np.flatnonzero(ids == thing)
        _, at, counts = np.unique(frames[of_thing], return_inverse=True, return_counts=True)
        rows = of_thing[counts[at] == 1]
        span = frames[rows][2:] - frames[rows][:-2]
        near = (span > 0) & (span <= _WIDEST_FRAMES)
        tracks = pixels[:, rows]
        change = tracks[:, 2:] - tracks[:, :-2]
        speeds[:, rows[1:-1][near]] = change[:, near] / span[near, None]
    return speeds


def _robust_fit(by_lag: Array, misses: Array, freedom: int) -> tuple[Array, Array]:
    """Lags of least residuals, with Cauchy's weights, and their sigmas."""
    lags = np.zeros(by_lag.shape[2])
    for _ in range(_ROUNDS):
        left2 = ((misses + by_lag @ lags) ** 2).sum(axis=1) / freedom
        scale2 = float(np.median(left2)) / 0.4549  # of a chi-squared variable
        weights = 1.0 / (1.0 + left2 / (_CAUCHY**2 * scale2))
        weighted = by_lag * weights[:, None, None]
        normal = np.einsum("nij,nik->jk", weighted, by_lag)
        lags = -np.linalg.solve(normal, np.einsum("nij,ni->j", weighted, misses))
    return lags, np.sqrt(scale2 * np.diag(np.linalg.inv(normal)))
