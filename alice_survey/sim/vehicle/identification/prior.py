"""What is known of the parameters before a fit: that they are near the values it starts from.

A coefficient that keeps its sign and starts from a value theta_0 is as likely to be too large as
to be too small by one factor: ln(theta / theta_0) is normal about zero, and it never ends at zero.
A damping that starts from zero is normal about it, with the scale of the motion's other damping
at the speeds that the logs hold. Cross terms and body lift may change sign and are normal about
their start. There is no prior on what changes from day to day, such as a current or the trim,
nor on terms that start from zero and have no damping to be compared with.

The residuals of a log are correlated in time, so that their sum of squares claims more than the log
knows. The prior counts times that ratio (adjustment of the magnitude of a composite likelihood:
M. Ribatet, D. Cooley & A. C. Davison, Statistica Sinica 22, 2012).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.coefficients import MOTIONS
from alice_survey.sim.vehicle.identification.parameters import QUADRATICS, Parameters, place_of
from alice_survey.sim.vehicle.identification.sensitivity import (
    ADDED_MASS,
    GAIN,
    LIFT,
    LINEAR,
)
from alice_survey.sim.vehicle.identification.windows import Mask, Window


@dataclass(frozen=True, kw_only=True)
class PriorSigmas:
    """Relative standard deviations of the start, by kind of parameter; infinite: none."""

    damping: float = 0.5
    added_mass: float = 0.3
    lift: float = 0.5
    gain: float = 1.0

    def __post_init__(self) -> None:
        for one in fields(self):
            value = getattr(self, one.name)
            if not value > 0:
                raise VehicleError(f"prior {one.name}={value:g}: a relative sigma is above 0")

    def __str__(self) -> str:
        named = ((one.name, getattr(self, one.name)) for one in fields(self))
        return ", ".join(f"{name} {value:g}" for name, value in named if math.isfinite(value))

    def of_kind(self, kind: int) -> float:
        """The sigma of a kind of parameter; infinite of kinds without prior."""
        known = {
            LINEAR: self.damping, **dict.fromkeys(QUADRATICS, self.damping),
            ADDED_MASS: self.added_mass, LIFT: self.lift, GAIN: self.gain,
        }  # fmt: skip
        return known.get(kind, math.inf)


def read_prior(text: str) -> PriorSigmas | None:
    """A prior as the command line has it: `none`, one number for all, or `KIND=SIGMA,...`.

    Kinds that are not named have their default.

    Raises:
        VehicleError: it is neither.
    """
    if text.strip() == "none":
        return None
    kinds = [one.name for one in fields(PriorSigmas)]
    given: dict[str, float] = {}
    for part in filter(None, text.split(",")):
        name, mark, number = (one.strip() for one in part.partition("="))
        try:
            value = float(number if mark else name)
        except ValueError:
            value = math.nan
        if math.isnan(value) or (mark and name not in kinds) or (not mark and "," in text):
            raise VehicleError(
                f"--prior {text!r}: give none, a relative sigma, or KIND=SIGMA,... with kinds of "
                f"{', '.join(kinds)}"
            )
        given |= {name: value} if mark else dict.fromkeys(kinds, value)
    return PriorSigmas(**given)


@dataclass(frozen=True, kw_only=True, eq=False)
class StartPrior:
    """A normal distribution of each parameter, or of its logarithm."""

    start: Array
    """(P,)"""
    sigma: Array
    """(P,) of the parameter, or of the logarithm; infinite where nothing is known."""
    logarithmic: Mask
    """(P,)"""

    def residuals(self, values: Array) -> Array:
        """Distances, (P,), from the start in sigmas; zero where nothing is known."""
        away = values - self.start
        with np.errstate(divide="ignore"):
            away[self.logarithmic] = np.log((values / self.start_or_one)[self.logarithmic])
        return away / self.sigma

    def slopes(self, values: Array) -> Array:
        """Derivatives of the residuals, (P,)."""
        slope: Array = 1.0 / (self.sigma * np.where(self.logarithmic, values, 1.0))
        return slope

    @property
    def start_or_one(self) -> Array:
        """(P,) the start where logarithms are taken, else one."""
        return np.where(self.logarithmic, self.start, 1.0)


def prior_of(
    parameters: Parameters, windows: Sequence[Window], sigmas: PriorSigmas | None
) -> StartPrior | None:
    """The prior of parameters for a fit to windows; None if there is none."""
    if sigmas is None:
        return None
    speeds = _speeds(windows)
    known, start = parameters.vehicle.coefficients.values, parameters.start
    sigma = np.full(len(start), math.inf)
    logarithmic = np.zeros(len(start), bool)
    for k, name in enumerate(parameters.names):
        kind, i, j = place_of(name)
        relative = sigmas.of_kind(kind)
        if not math.isfinite(relative):
            continue
        definite = kind == GAIN or (kind != LIFT and i == j)
        if definite and start[k] != 0.0:
            sigma[k], logarithmic[k] = relative, True
            continue
        scale = abs(start[k])
        if kind == LINEAR:
            scale = max(scale, abs(known.get(f"{name}{name[2]}", 0.0)) * speeds[j])
        elif kind in QUADRATICS and speeds[j] > 0:
            scale = max(scale, abs(known.get(name[:3], 0.0)) / speeds[j])
        if scale > 0:
            sigma[k] = relative * scale
    if not np.any(np.isfinite(sigma)):
        return None
    return StartPrior(start=start, sigma=sigma, logarithmic=logarithmic)


def _speeds(windows: Sequence[Window]) -> Array:
    """Root mean square, (6,), of the motions that the windows measured; zero of others."""
    table = np.concatenate([window.measured for window in windows])
    known = np.isfinite(table)
    total = np.sum(np.where(known, table, 0.0) ** 2, axis=0)
    return np.asarray(np.sqrt(total / np.maximum(known.sum(axis=0), 1)))[: len(MOTIONS)]
