"""What a survey's pictures say against the calibration of their rig.

A right calibration with covariance P lets pictures move its parameters by d, and leaves the
covariance Q: d is then normal with covariance P - Q. In the directions that pictures measure, the
eigenvectors u of P^-1/2 (P - Q) P^-T/2 with eigenvalues above zero, (u . P^-1/2 d)^2 / eigenvalue
adds up to chi-square.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from alice_survey.core.frames import Array

_MEASURED = 0.05
"""Share of the prior variance that pictures take away, from which a direction is measured."""
_UNLIKELY = 1e-4
"""Probability of the whole pull, if the calibration were right, below which it is named."""
_FAR = 2.0
"""Prior sigmas from which a parameter is named."""
_MAX_NAMED = 4
_NAMES = {
    "port_distance_m": "distance of the port",
    "normal_x": "tilt of the port",
    "normal_y": "tilt of the port",
    "n_water": "index of the water",
}
_MOTIONS = ("rx_rad", "ry_rad", "rz_rad", "x_m", "y_m", "z_m")


@dataclass(frozen=True, kw_only=True)
class Contradiction:
    """Pictures and calibration disagree by more than chance."""

    chi_square: float
    directions: int
    """Combinations of parameters that the pictures measure: the mean of a right calibration's."""
    named: tuple[str, ...]
    """Parameters that moved by the most prior sigmas, the most moved first."""
    pulls: tuple[float, ...]
    """By how many."""

    @property
    def words(self) -> str:
        """What to tell, in one line."""
        moved = ", ".join(
            f"{_about(name)} by {pull:+.1f} sigmas"
            for name, pull in zip(self.named, self.pulls, strict=True)
        )
        return (
            f"the pictures contradict the calibration (chi-square {self.chi_square:.0f} of "
            f"{self.directions}): they move {moved} of what it states: calibrate again in the "
            "water, or state sigmas that hold"
        )


def contradiction(
    parameters: Sequence[str], change: Array, prior: Array, left: Array
) -> Contradiction | None:
    """What pictures say against a calibration; None where they agree with it.

    Args:
        parameters: (G,) names.
        change: (G,) by the adjustment.
        prior: (G, G) covariance before.
        left: (G, G) covariance after.
    """
    if not len(parameters):
        return None
    sigmas = np.sqrt(np.diag(prior))
    scaled = np.outer(sigmas, sigmas)
    values, axes = np.linalg.eigh(prior / scaled)
    kept = values > values.max() * len(values) * np.finfo(float).eps
    white = (axes[:, kept] / np.sqrt(values[kept])).T / sigmas
    gain, directions = np.linalg.eigh(np.eye(kept.sum()) - white @ left @ white.T)
    measured = gain > _MEASURED
    along = directions[:, measured].T @ (white @ change)
    total = float((along**2 / gain[measured]).sum())
    count = int(measured.sum())
    if count == 0 or chi2.sf(total, count) > _UNLIKELY:
        return None
    pulls = change / sigmas
    order = np.argsort(-np.abs(pulls))
    far = [int(k) for k in order if abs(pulls[k]) > _FAR][:_MAX_NAMED] or [int(order[0])]
    return Contradiction(
        chi_square=total,
        directions=count,
        named=tuple(parameters[k] for k in far),
        pulls=tuple(float(pulls[k]) for k in far),
    )


def _about(name: str) -> str:
    camera, field = name.split(".", 1)
    if field in _MOTIONS:
        return f"the place of {camera!r} on the rig ({name})"
    return f"the {_NAMES.get(field, 'lens')} of {camera!r} ({name})"
