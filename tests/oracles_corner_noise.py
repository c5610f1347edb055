"""Slow twin of the corners' noise: dense matrices over all residuals."""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from camera_calib.calibrate.adjust import Adjustment
from camera_calib.calibrate.normal_equations import CalibrationProblem

Array = NDArray[np.float64]
REACHES = (0.12, 0.3, 0.8)


def dense_spread(problem: CalibrationProblem, found: Adjustment) -> tuple[Array, Array, Array]:
    """Variances of all parts, their mean products, and the covariance, by definition.

    Parts: independent; by reach in a picture; by reach in a view; places in the plane and across.
    """
    views, cameras, count = problem.seen.shape
    size, rows = len(problem.names), 2 * views * cameras * count
    by_rig = np.zeros((views, cameras, count, 2, size))
    by_pose = np.zeros((views, cameras, count, 2, 6 * views))
    by_place = np.zeros((views, cameras, count, 2, count, 3))
    missed = np.zeros((views, cameras, count, 2))
    weights = np.nan_to_num(found.weights)
    slope = np.mean(np.where(weights < 1.0, 0.5 * weights, 1.0)[problem.seen])
    state = problem.state(found.rig, found.rig_from_target, found.shape.values)
    for slopes in problem.slopes(state):
        c, p = slopes.camera, len(slopes.at)
        for i, v in enumerate(slopes.views):
            for n in np.flatnonzero(problem.seen[v, c]):
                scale = 1.0 / (found.noise_px * found.blur[v, c])
                by_rig[v, c, n][:, slopes.at] = scale * slopes.rows[i, n, :, :p]
                by_pose[v, c, n, :, 6 * v : 6 * v + 6] = scale * slopes.rows[i, n, :, p:-1]
                by_place[v, c, n, :, n] = scale * slopes.by_place[i, n]
                missed[v, c, n] = scale * slopes.rows[i, n, :, -1] * weights[v, c, n] / slope
    both = np.concatenate([by_rig.reshape(rows, size), by_pose.reshape(rows, -1)], axis=1)
    information = both.T @ both
    at = problem.prior_at
    information[np.ix_(at, at)] += problem.prior_information
    scale = 1.0 / np.sqrt(np.diag(information))
    inverse = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    left = np.eye(rows) - both @ inverse @ both.T

    view, camera, place, axis = (a.ravel() for a in np.indices((views, cameras, count, 2)))
    seen = problem.seen[view, camera, place]
    alike = (view[:, None] == view) & (axis[:, None] == axis) & np.outer(seen, seen)
    apart = np.linalg.norm(problem.points[:, None] - problem.points, axis=-1)
    diagonal = np.linalg.norm(np.ptp(problem.points, axis=0))
    own = alike & (camera[:, None] == camera)
    parts = [np.diag(seen.astype(float))]
    for which in (own, alike)[:cameras]:
        for reach in REACHES:
            kernel = np.exp(-0.5 * (apart / (reach * diagonal)) ** 2)
            parts.append(np.where(which, kernel[np.ix_(place, place)], 0.0))
    flat = by_place.reshape(rows, count, 3)
    for axes in (slice(0, 2), slice(2, 3)):
        some = flat[..., axes].reshape(rows, -1)
        parts.append(some @ some.T)

    # Poses take up their part of the residuals exactly; the rig's is in the residuals already.
    poses = np.linalg.qr(by_pose.reshape(rows, -1))[0]
    misses = missed.ravel() - poses @ (poses.T @ missed.ravel())
    seen_products = np.array([misses @ part @ misses for part in parts])
    table = np.array([[np.sum((a @ left) * (b @ left).T) for b in parts] for a in parts])
    norm = 1.0 / np.sqrt(np.diag(table))
    root = np.linalg.cholesky(table * np.outer(norm, norm) + 1e-12 * np.eye(len(parts)))
    variances = norm * nnls(root.T, np.linalg.solve(root, seen_products * norm))[0]
    variances[0] = max(variances[0], 0.05)
    gain = (inverse @ both.T)[:size]
    noise = sum(v * part for v, part in zip(variances, parts, strict=True))
    by_prior = inverse[:size][:, at]
    covariance = gain @ noise @ gain.T + by_prior @ problem.prior_information @ by_prior.T
    return variances, table, covariance
