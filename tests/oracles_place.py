"""Slow, obvious twins of the kernels that weigh correlated errors, and how large errors may be."""

import numpy as np
from scipy.stats import chi2

from alice_survey.core.frames import Array


def is_unit(ratios: object, count: int, freedom: float = np.inf) -> bool:
    """Whether errors over their sigmas are as large as stated, by their root mean square.

    Its square has a chi-squared distribution, outside of these quantiles once in 10,000.

    Args:
        ratios: errors over sigmas, of any shape.
        count: number of independent ones.
        freedom: degrees of freedom that each sigma was estimated with: then the mean square of the
            ratios is freedom / (freedom - 2).
    """
    low, high = chi2.ppf(np.array([5e-5, 1.0 - 5e-5]), count) / count
    wider = 1.0 if np.isinf(freedom) else freedom / (freedom - 2.0)
    return bool(low < np.mean(np.square(np.asarray(ratios))) < high * wider)


def covariance_matrix(time: Array, sigma: Array, tau: float, white: float) -> Array:
    """(N, N) correlations of errors over their sigmas, pair by pair along the chain."""
    count = len(time)
    matrix = np.eye(count)
    for i in range(count):
        for j in range(i + 1, count):
            kept = 1.0
            for k in range(i, j):
                kept *= np.exp(-(time[k + 1] - time[k]) / tau)
                kept *= min(sigma[k], sigma[k + 1]) / max(sigma[k], sigma[k + 1])
            matrix[i, j] = matrix[j, i] = (1.0 - white) * kept
    return matrix


def standard_residuals_densely(matrix: Array, values: Array) -> Array:
    """(N,) each value less what the others predict, over the sigma of that, by partitioning."""
    found = np.empty(len(values))
    for i in range(len(values)):
        others = np.arange(len(values)) != i
        weights = np.linalg.solve(matrix[np.ix_(others, others)], matrix[others, i])
        spread = matrix[i, i] - weights @ matrix[others, i]
        found[i] = (values[i] - weights @ values[others]) / np.sqrt(spread)
    return found
