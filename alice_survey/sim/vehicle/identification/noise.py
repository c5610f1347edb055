"""The noise of a log's channels: its size, and its correlation in time.

Residuals of a simulation include model errors and unmeasured forces, which are correlated;
sigmas that assume white noise are too small. Here they are autoregressive, with the order that
the Bayesian information criterion chooses (G. Schwarz, Ann. Statist. 6, 1978); order 0 is white.
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.signal import fftconvolve

from alice_survey.core.frames import Array

_HIGHEST_ORDER = 20
_FADED = 1e-3
"""Correlation that counts as zero."""
_SECOND_DIFFERENCE = 6.0
"""Variance of the second difference of white noise, by its own: 1 + 4 + 1."""
_MAD = 1.4826
"""Standard deviation of a normal variable by its median absolute deviation."""


def noise_sigma(series: Array) -> float:
    """Standard deviation of the white noise on a smooth series, (T,), by second differences.

    NaN rows are skipped. The median suppresses steps and outliers.

    Returns:
        NaN if fewer than 5 values are known.
    """
    known = series[np.isfinite(series)]
    if len(known) < 5:
        return float("nan")
    second = np.diff(known, 2) / np.sqrt(_SECOND_DIFFERENCE)
    return float(_MAD * np.median(np.abs(second)))


def autocovariance(runs: Sequence[Array]) -> Array:
    """Autocovariance of a stationary process by the autoregressive model of the best order.

    Args:
        runs: series of it, (N_i,) each, about zero.

    Returns:
        (L,) at the lags 0, 1, ..., until the correlation has faded or the longest run ends.
    """
    count = sum(len(run) for run in runs)
    longest = max((len(run) for run in runs), default=0)
    if count == 0:
        return np.zeros(1)
    orders = min(_HIGHEST_ORDER, longest - 1, count // 10)
    sample = np.array(
        [sum(float(run[lag:] @ run[: len(run) - lag]) for run in runs) for lag in range(orders + 1)]
    )
    sample /= count
    if sample[0] <= 0 or orders < 1:
        return sample[:1]
    best, chosen, factors = 0.0, 0, np.zeros(0)
    for order in range(1, orders + 1):
        trial = solve_toeplitz(sample[:order], sample[1 : order + 1])
        share = 1.0 - float(trial @ sample[1 : order + 1]) / sample[0]
        if share <= 0:
            break
        criterion = count * np.log(share) + order * np.log(count)
        if criterion < best:
            best, chosen, factors = criterion, order, trial
    if chosen == 0:
        return sample[:1]
    lags = list(sample[: chosen + 1])
    while len(lags) < longest and max(abs(lag) for lag in lags[-chosen:]) > _FADED * sample[0]:
        lags.append(float(factors @ np.array(lags[: -chosen - 1 : -1])))
    return np.array(lags)


def correlated_information(slopes: Sequence[Array], covariance: Array) -> Array:
    """Sum of S^T T S, (P, P), over runs S, (N_i, P), with the Toeplitz matrix T of a process.

    With the residual's autocovariance this is the covariance of S^T e (E. A. Morelli & V. Klein,
    J. Guidance, Control, and Dynamics 20, 1997, on parameter accuracy with coloured residuals).
    """
    width = slopes[0].shape[1]
    total = np.zeros((width, width))
    for run in slopes:
        lags = covariance[: len(run)]
        if len(lags) == 1:
            total += lags[0] * (run.T @ run)
        elif len(run):
            filtered = fftconvolve(run, np.concatenate([lags[:0:-1], lags])[:, None], axes=0)
            total += run.T @ filtered[len(lags) - 1 : len(lags) - 1 + len(run)]
    return 0.5 * (total + total.T)
