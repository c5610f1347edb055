"""How far the clocks of fixed cameras are apart, told from things that move.

A camera that is late shows a moving thing where it will be a little later: its ray misses those of
the others in proportion to how fast the thing crosses its picture. The share of all misses that
follows these speeds is the lag.
"""

from dataclasses import dataclass

import numpy as np

from alice_survey.base.frames import Array
from camera_calib.tank.adjust import CAUCHY, Tank
from camera_calib.tank.files import Detections
from camera_calib.triangulate import Triangulation

_WIDEST_FRAMES = 4
"""A speed is taken between the frames before and after, if they are no farther apart."""
_FEWEST_POINTS = 100
_ROUNDS = 50


@dataclass(frozen=True, kw_only=True)
class Lag:
    """How much later than the first camera another one takes pictures of equal numbers."""

    camera: str
    frames: float
    sigma: float
    """As if misses were independent; those of neighbouring frames are not quite."""
    points: int
    """How many detections with a speed it rests on."""


def estimate_lags(tank: Tank, detections: Detections, found: Triangulation) -> tuple[Lag, ...]:
    """Lags of all cameras but the first; empty where too few things move.

    Args:
        tank: the cameras.
        detections: with their frames and ids.
        found: their points.
    """
    speeds = pixel_speeds(detections)
    count, cameras = len(detections.frames), len(tank.cameras)
    slopes = np.zeros((count, cameras, 2, 3))
    for i, camera in enumerate(tank.cameras):
        slopes[:, i] = camera.slopes(found.points_world)[0]
    usable = np.isfinite(slopes).all(axis=(1, 2, 3)) & np.isfinite(speeds).all(axis=(0, 2))
    usable &= np.isfinite(found.residuals_px).all(axis=(0, 2))
    total = int(usable.sum())
    if total < _FEWEST_POINTS:
        return ()
    by_point = slopes[usable].reshape(total, -1, 3)
    along = np.linalg.solve(by_point.transpose(0, 2, 1) @ by_point, by_point.transpose(0, 2, 1))
    apart = np.eye(2 * cameras) - by_point @ along
    late = np.zeros((total, cameras, 2, cameras - 1))
    for i in range(1, cameras):
        late[:, i, :, i - 1] = speeds[i, usable]
    # Pixels of a camera that is late by L frames should be moved back by L times their speed.
    by_lag = apart @ late.reshape(total, 2 * cameras, cameras - 1)
    misses = found.residuals_px[:, usable].transpose(1, 0, 2).reshape(total, -1)
    lags, sigmas = _robust_fit(by_lag, misses, 2 * cameras - 3)
    return tuple(
        Lag(camera=camera.name, frames=float(lag), sigma=float(sigma), points=total)
        for camera, lag, sigma in zip(tank.cameras[1:], lags, sigmas, strict=True)
    )


def pixel_speeds(detections: Detections) -> Array:
    """Speeds of detections in the pictures, (C, N, 2), pixels a frame; NaN where not known."""
    speeds = np.full_like(detections.pixels, np.nan)
    for thing in np.unique(detections.ids):
        rows = np.flatnonzero((detections.ids == thing) & (detections.candidates == 1))
        frames = detections.frames[rows]
        span = frames[2:] - frames[:-2]
        near = (span > 0) & (span <= _WIDEST_FRAMES)
        tracks = detections.pixels[:, rows]
        change = tracks[:, 2:] - tracks[:, :-2]
        speeds[:, rows[1:-1][near]] = change[:, near] / span[near, None]
    return speeds


def _robust_fit(by_lag: Array, misses: Array, freedom: int) -> tuple[Array, Array]:
    """Lags that leave the least of the misses, with Cauchy's weights, and their sigmas."""
    lags = np.zeros(by_lag.shape[2])
    for _ in range(_ROUNDS):
        left2 = ((misses + by_lag @ lags) ** 2).sum(axis=1) / freedom
        scale2 = float(np.median(left2)) / 0.4549  # of a chi-squared variable
        weights = 1.0 / (1.0 + left2 / (CAUCHY**2 * scale2))
        weighted = by_lag * weights[:, None, None]
        normal = np.einsum("nij,nik->jk", weighted, by_lag)
        lags = -np.linalg.solve(normal, np.einsum("nij,ni->j", weighted, misses))
    return lags, np.sqrt(scale2 * np.diag(np.linalg.inv(normal)))
