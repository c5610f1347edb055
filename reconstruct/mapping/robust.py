"""How far observations may miss: the sigma of keypoints and the weights of an adjustment.

Not all keypoints have similar errors. Shadow edges move with the lamps, tracks jump from one spot
to the next: a few in a hundred miss by many sigmas, and not at random, since lamps go where the
cameras go. With equal weights they bend a block by more than all other noise together. Cauchy's
loss (Rey 1983, "Introduction to robust and quasi-robust statistical methods") lets them go by and
costs almost nothing where errors are normal.
"""

import numpy as np
import pycolmap

from alice_survey.core.frames import Array
from alice_survey.core.robust import CAUCHY_TUNING, RAYLEIGH_MEDIAN
from reconstruct.mapping.arrays import Indices, observed

_MIN_SIGMA_PX = 1e-3
_WELL_SEEN = 4
_MAX_ADAPTED = 0.9


def pixel_sigma(model: pycolmap.Reconstruction) -> float:
    """Standard deviation of one coordinate of a keypoint, from a model's residuals."""
    seen = observed(model)
    counts = np.bincount(seen.point, minlength=len(seen.point_ids))[seen.point]
    return sigma_of(seen.misses(model), counts, model.num_reg_frames())


def sigma_of(misses: Array, counts: Indices, stations: int) -> float:
    """Standard deviation of one coordinate, from the median of residuals.

    Residuals are smaller than errors by what points and stations adapt to. Points seen only twice
    adapt so much that what is left is not normal: they do not count where there are others.

    Args:
        misses: (O, 2) residuals.
        counts: (O,) how many observations each one's point has.
        stations: how many there are.
    """
    if not len(misses):
        return _MIN_SIGMA_PX
    free = float((3.0 / counts).sum())  # unknowns of points
    by_station = 1.0 - min(_MAX_ADAPTED, 6.0 * stations / max(2.0 * len(misses) - free, 1.0))
    left = (1.0 - 1.5 / counts) * by_station
    well_seen = counts >= min(_WELL_SEEN, int(np.median(counts)))
    median = float(np.median(np.linalg.norm(misses[well_seen], axis=1) / np.sqrt(left[well_seen])))
    return max(median / RAYLEIGH_MEDIAN, _MIN_SIGMA_PX)


def loss_scale(sigma_px: float) -> float:
    """Length of a residual, in pixels, that counts half."""
    return CAUCHY_TUNING * sigma_px


def cauchy_weights(misses: Array, sigma_px: float) -> Array:
    """Weights (O,) of observations that miss by (O, 2) pixels."""
    weights: Array = 1.0 / (1.0 + (misses**2).sum(axis=1) / loss_scale(sigma_px) ** 2)
    return weights


def cauchy_cost(misses: Array, sigma_px: float) -> float:
    """Cauchy's loss of (O, 2) residuals, px^2; the sum of squares where all are small."""
    squares = loss_scale(sigma_px) ** 2
    return squares * float(np.log1p((misses**2).sum(axis=1) / squares).sum())


def variance_of(misses: Array, weights: Array, share_left: float) -> float:
    """Variance of one coordinate that makes `(J' W J)^-1` a covariance.

    Huber (1981), "Robust statistics", section 7.6: the estimate's covariance is K^2 E[psi^2] /
    E[psi']^2 (J'J)^-1 with K = 1 + p/n var(psi') / E[psi']^2, and (J'J)^-1 is (J'WJ)^-1 times the
    mean weight. For Cauchy's loss of plane residuals psi is weight times residual and the mean
    slope of psi, over both coordinates, is the square of the weight.

    Args:
        misses: (O, 2) residuals.
        weights: (O,) of `cauchy_weights`.
        share_left: of the observations' freedom, what an adjustment left.
    """
    squares = float((weights**2 * (misses**2).sum(axis=1)).mean()) / (2.0 * share_left)
    slope = float((weights**2).mean())
    few = 1.0 + (1.0 - share_left) * float((weights**2).var()) / slope**2
    return float(weights.mean()) * few**2 * squares / slope**2
