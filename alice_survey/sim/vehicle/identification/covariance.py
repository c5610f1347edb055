"""Covariance of fitted parameters whose residuals are correlated: stretches are left out.

Logs are cut into stretches that are long against the residuals' memory, and so hardly depend on one
another. Leaving one out moves the parameters by a Gauss-Newton step; the spread of these moves is
the delete-a-group jackknife (J. Shao & D. Tu, The Jackknife and Bootstrap, 1995, 2.3), a sandwich
that allows for what each stretch weighs. It needs no model of the noise: forces of waves, of a
tether, and what the vehicle's equations do not hold, all count by how differently the stretches
would have the parameters. White residuals give the inverse information.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.frames import Array

_LEAST, _MOST = 10, 20
"""Stretches that logs are cut into: few are long, many show the spread better."""
_WINDOWS = 4
"""Windows in a stretch where there are many."""
_FEWEST = 5
"""With fewer stretches the spread is not known."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Stretches:
    """What stretches of logs say of P parameters."""

    scores: Array
    """(B, P) gradients: slopes times residuals, in sigmas."""
    information: Array
    """(B, P, P) slopes times slopes."""

    def __len__(self) -> int:
        return len(self.scores)


def in_stretches(residuals: Array, slopes: Array, number: NDArray[np.intp]) -> Stretches:
    """Sum up residuals, (N,), and slopes, (N, P), by the numbers, (N,), of their stretches."""
    count, width = int(number.max()) + 1, slopes.shape[1]
    scores, information = np.zeros((count, width)), np.zeros((count, width, width))
    order = np.argsort(number, kind="stable")
    edges = np.searchsorted(number[order], np.arange(count + 1))
    for b in range(count):
        rows = order[edges[b] : edges[b + 1]]
        scores[b] = slopes[rows].T @ residuals[rows]
        information[b] = slopes[rows].T @ slopes[rows]
    return Stretches(scores=scores, information=information)


def stretch_numbers(times_s: list[Array]) -> list[NDArray[np.intp]]:
    """Put windows, given by the times of their rows, into stretches of about one length.

    Each window has a start of its own, that balances the residuals within it: windows stay whole,
    several of them in a stretch. Only fewer than five are cut.

    Returns:
        The number of its stretch for each row of each window.
    """
    spans = np.array([float(time_s[-1] - time_s[0]) for time_s in times_s])
    wanted = min(max(len(spans) // _WINDOWS, _LEAST), _MOST)
    length_s, ends = spans.sum() / wanted, np.cumsum(spans)
    numbers: list[NDArray[np.intp]] = []
    if len(spans) < _FEWEST:
        for time_s, end_s in zip(times_s, ends.tolist(), strict=True):
            passed = end_s - (time_s[-1] - time_s)
            numbers.append(np.minimum(passed / length_s, wanted - 1).astype(np.intp))
    else:
        middles = (ends - 0.5 * spans) / length_s
        places = np.minimum(middles, wanted - 1).astype(np.intp)
        _, places = np.unique(places, return_inverse=True)
        numbers = [np.full(len(t), k) for t, k in zip(times_s, places.tolist(), strict=True)]
    return numbers


def jackknife_covariance(stretches: Stretches, prior: Array) -> Array | None:
    """Covariance, (P, P), of parameters as far as the logs' noise makes it; None of few stretches.

    Args:
        stretches: at the fit.
        prior: (P, P) information that is not of the logs and stays when a stretch is left out.
    """
    count = len(stretches)
    if count < _FEWEST:
        return None
    total = stretches.information.sum(axis=0) + prior
    moves = np.array(
        [
            np.linalg.solve(total - information, score - stretches.scores.mean(axis=0))
            for score, information in zip(stretches.scores, stretches.information, strict=True)
        ]
    )
    # Errors by a spread of few are spread as Student's t, with a variance of n / (n - 2).
    student = (count - 1.0) / (count - 3.0)
    covariance: Array = student * (count - 1.0) / count * (moves.T @ moves)
    return covariance


def design_effect(stretches: Stretches, prior: Array) -> float:
    """How many times more the residuals vary in what they say than white ones would; at least 1.

    The trace of the sandwich by that of the Hessian, as in the information criterion for models
    that are wrong (K. Takeuchi, 1976; C. Varin & P. Vidoni, Biometrika 92(3), 2005).

    Args:
        stretches: at the fit.
        prior: (P, P) information that is not of the logs.
    """
    count = len(stretches)
    if count < _FEWEST:
        return 1.0
    away = stretches.scores - stretches.scores.mean(axis=0)
    logs = stretches.information.sum(axis=0)
    inverse = np.linalg.pinv(logs + prior, hermitian=True)
    spread = count / (count - 1.0) * np.trace(inverse @ (away.T @ away))
    return max(float(spread / np.trace(inverse @ logs)), 1.0)
