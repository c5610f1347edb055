"""Correlated errors: a Markov process with exponential correlation, in linear time.

The error of a channel of navigation, over its stated sigma, is taken as
`u = sqrt(1 - w) m + sqrt(w) n`: m a first-order Gauss-Markov process of unit variance that keeps
`exp(-dt / tau)` of itself (Uhlenbeck & Ornstein 1930), n white. Where the sigma changes, m is
also reduced by the lesser over the greater of the two: an error in metres neither grows with a
sigma that grows (drift is added to it) nor shrinks in proportion (the errors before and after the
update of an optimal filter covary by the variance after it). The covariance matrix K of all values
is dense, but a scalar Kalman filter turns values into innovations, which are white: the same as a
multiplication by the inverse of K's Cholesky factor, in one pass (Kailath 1968).
"""

import math

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.compiled import compiled
from alice_survey.core.frames import Array

MIN_WHITE = 1e-4
"""Share of white error that two readings at the same time need to have any innovation."""


@compiled
def _kept(time: Array, sigma: Array, i: int, j: int, tau: float) -> float:
    """Correlation of the Markov parts of two neighbours."""
    lesser, greater = min(sigma[i], sigma[j]), max(sigma[i], sigma[j])
    kept: float = math.exp(-abs(time[j] - time[i]) / tau) * lesser / greater
    return kept


@compiled
def whiten(
    time: Array, sigma: Array, used: NDArray[np.bool_], values: Array, tau: float, white: float
) -> tuple[Array, float]:
    """Make columns of correlated values of unit variance white.

    Args:
        time: (N,) not decreasing.
        sigma: (N,) of the values before they were divided by it.
        used: (N,) what is there; the rest is passed over as a gap.
        values: (N, P) columns, each over its sigma.
        tau: time in which the correlation falls to 1/e, above 0.
        white: share w of the variance that is white, `MIN_WHITE` to 1.

    Returns:
        (N, P) innovations over their standard deviation, zero where not used, and the logarithm of
        the determinant of the covariance matrix of what is used.
    """
    found, log_det, _, _ = _filtered(time, sigma, used, values, tau, white)
    return found, log_det


@compiled
def _filtered(
    time: Array, sigma: Array, used: NDArray[np.bool_], values: Array, tau: float, white: float
) -> tuple[Array, float, Array, Array]:
    """As `whiten`; also the mean (N, P) and variance (N,) of the Markov part before each value."""
    count, columns = values.shape
    found = np.zeros((count, columns))
    means, variances = np.zeros((count, columns)), np.ones(count)
    state = np.zeros(columns)
    gain_in = math.sqrt(1.0 - white)
    variance, log_det, last = 1.0, 0.0, -1
    for i in range(count):
        if not used[i]:
            continue
        kept = _kept(time, sigma, last, i, tau) if last >= 0 else 1.0
        last = i
        variance = kept * kept * variance + 1.0 - kept * kept
        variances[i] = variance
        spread = gain_in * gain_in * variance + white
        root = math.sqrt(spread)
        gain = gain_in * variance / spread
        for k in range(columns):
            state[k] *= kept
            means[i, k] = state[k]
            innovation = values[i, k] - gain_in * state[k]
            found[i, k] = innovation / root
            state[k] += gain * innovation
        variance -= gain * gain_in * variance
        log_det += math.log(spread)
    return found, log_det, means, variances


def standard_residuals(
    time: Array, sigma: Array, used: NDArray[np.bool_], values: Array, tau: float, white: float
) -> Array:
    """How far each value is from what all the others predict, in standard deviations.

    Past and future predict independently but for the process's own mean and variance, which both
    hold and which is taken out once (the two-filter smoother; Fraser & Potter 1969).

    Args:
        time: (N,) not decreasing.
        sigma: (N,) of the values before they were divided by it.
        used: (N,) what is there.
        values: (N,), each over its sigma.
        tau: as in `whiten`.
        white: as in `whiten`.

    Returns:
        (N,), meaningless where not used.
    """
    past, past_variance = _filtered(time, sigma, used, values[:, None], tau, white)[2:]
    reversed_ = (np.ascontiguousarray(row[::-1]) for row in (time, sigma, used, values[:, None]))
    future, future_variance = (row[::-1] for row in _filtered(*reversed_, tau, white)[2:])
    past, future = past[:, 0], future[:, 0]
    precision = 1.0 / past_variance + 1.0 / future_variance - 1.0
    mean = (past / past_variance + future / future_variance) / precision
    spread = (1.0 - white) / precision + white
    found: Array = (values - math.sqrt(1.0 - white) * mean) / np.sqrt(spread)
    return found


def correlated_share(time: Array, tau: float, white: float) -> float:
    """Share of the variance that the plain mean over all times keeps beyond that of white error.

    0 for white error, near 1 where one error is constant. The times are taken as evenly
    spread: twice the integral of `(1 - s) exp(-s T / tau)`.
    """
    ratio = float(time[-1] - time[0]) / tau
    if ratio < 1e-6:
        return 1.0 - white
    return (1.0 - white) * 2.0 / ratio * (1.0 - (1.0 - math.exp(-ratio)) / ratio)
