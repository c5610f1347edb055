"""The joint fit: parameters whose simulation comes closest to all measurements.

Output-error least squares (L. Ljung, System Identification, 1999): each window is
simulated from a start of its own, so that a log in one window is single shooting and one cut into
many is multiple shooting. The starts are eliminated (variable projection, Golub & Pereyra, Inverse
Problems 19, 2003): for given parameters each window's start is solved for, and the parameters see
residuals and slopes with the directions of the start taken out. The sensitivities are exact.

What is known of the parameters before a fit: that they are near the values it starts from.

A coefficient that keeps its sign and starts from a value theta_0 is as likely to be too large as
to be too small by one factor: ln(theta / theta_0) is normal about zero, and it never ends at zero.
A damping that starts from zero is normal about it, with the scale of the motion's other damping
at the speeds that the logs hold. Cross terms and body lift may change sign and are normal about
their start. There is no prior on what changes from day to day, such as a current or the trim,
nor on terms that start from zero and have no damping to be compared with.

The residuals of a log are correlated in time, so that their sum of squares claims more than the log
knows. The prior counts times that ratio (adjustment of the magnitude of a composite likelihood:
M. Ribatet, D. Cooley & A. C. Davison, Statistica Sinica 22, 2012).

Covariance of fitted parameters whose residuals are correlated: stretches are left out.

Logs are cut into stretches that are long against the residuals' memory, and so hardly depend on one
another. Leaving one out moves the parameters by a Gauss-Newton step; the spread of these moves is
the delete-a-group jackknife (J. Shao & D. Tu, The Jackknife and Bootstrap, 1995, 2.3), a sandwich
that allows for what each stretch weighs. It needs no model of the noise: forces of waves, of a
tether, and what the vehicle's equations do not hold, all count by how differently the stretches
would have the parameters. White residuals give the inverse information.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from alice_survey.core.errors import VehicleError
from alice_survey.core.executor import progress
from alice_survey.core.frames import Array
from alice_survey.core.run.progress import step as named_step
from alice_survey.sim.vehicle.coefficients import MOTIONS
from alice_survey.sim.vehicle.identification import sensitivity as term
from alice_survey.sim.vehicle.identification.problem import (
    QUADRATICS,
    Mask,
    Parameters,
    Window,
    cut,
    place_of,
    residual_channels,
)
from alice_survey.sim.vehicle.identification.sensitivity import Physics, simulate, with_given
from alice_survey.sim.vehicle.log import attitude_of

_MIN_STRETCHES, _MAX_STRETCHES = 10, 20
"""Stretches that logs are cut into: few are long, many show the spread better."""
_WINDOWS = 4
"""Windows in a stretch where there are many."""
_OF_FORCES = (term.LINEAR, *QUADRATICS, term.ADDED_MASS, term.LIFT, term.GAIN, term.BUOYANCY)
"""Kinds of parameters that a motion's force is made of, but for what differs from day to day."""
_CONFIRMED = 1.0
"""Sigmas by which the fit must predict a stretch that was left out better than its start does:
with one, five of six are."""
_MIN_JUDGED = 5
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
    target = min(max(len(spans) // _WINDOWS, _MIN_STRETCHES), _MAX_STRETCHES)
    ends = np.cumsum(spans)
    passed = [end_s + t - t[-1] for end_s, t in zip(ends.tolist(), times_s, strict=True)]
    if len(spans) >= _MIN_JUDGED:
        passed = [np.full(len(part), 0.5 * (part[0] + part[-1])) for part in passed]
    places = np.minimum(np.concatenate(passed) * target / ends[-1], target - 1).astype(np.intp)
    number = np.unique(places, return_inverse=True)[1]
    return np.split(number, np.cumsum([len(part) for part in passed])[:-1])


def jackknife_covariance(stretches: Stretches, prior: Array) -> Array | None:
    """Covariance, (P, P), of parameters as far as the logs' noise makes it; None of few stretches.

    Errors of a model last longer than a stretch: neighbours are joined, two by two, and the
    largest variance counts (blocking: H. Flyvbjerg & H. G. Petersen, J. Chem. Phys. 91, 1989).

    Args:
        stretches: at the fit.
        prior: (P, P) information that is not of the logs and stays when a stretch is left out.
    """
    found: list[Array] = []
    while (count := len(stretches)) >= _MIN_JUDGED:
        moves = moves_without(stretches, prior)
        # Errors by a spread of few are spread as Student's t, with a variance of n / (n - 2).
        student = (count - 1.0) / (count - 3.0)
        found.append(student * (count - 1.0) / count * (moves.T @ moves))
        joined, firsts = np.add.reduceat, np.arange(0, count, 2)
        scores, information = joined(stretches.scores, firsts), stretches.information
        stretches = Stretches(scores=scores, information=joined(information, firsts))
    return _widen(found[0], found) if found else None


def _widen(covariance: Array, others: Sequence[Array]) -> Array:
    """A covariance with its correlations, and variances no smaller than those of others."""
    variance = np.max([np.diag(covariance), *map(np.diag, others)], axis=0)
    factor = np.sqrt(variance / np.diag(covariance))
    return np.asarray(covariance * np.outer(factor, factor))


def moves_without(stretches: Stretches, prior: Array) -> Array:
    """Gauss-Newton steps, (B, P), of the parameters as each stretch is left out."""
    total = stretches.information.sum(axis=0) + prior
    scores = stretches.scores - stretches.scores.mean(axis=0)
    return np.linalg.solve(total - stretches.information, scores[..., None])[..., 0]


def design_effect(stretches: Stretches, prior: Array) -> float:
    """How many times more the residuals vary in what they say than white ones would; at least 1.

    The trace of the sandwich by that of the Hessian, as in the information criterion for models
    that are wrong (K. Takeuchi, 1976; C. Varin & P. Vidoni, Biometrika 92(3), 2005).

    Args:
        stretches: at the fit.
        prior: (P, P) information that is not of the logs.
    """
    count = len(stretches)
    if count < _MIN_JUDGED:
        return 1.0
    away = stretches.scores - stretches.scores.mean(axis=0)
    logs = stretches.information.sum(axis=0)
    inverse = np.linalg.pinv(logs + prior, hermitian=True)
    spread = count / (count - 1.0) * np.trace(inverse @ (away.T @ away))
    return max(float(spread / np.trace(inverse @ logs)), 1.0)


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

    def of_kind(self, kind: int) -> float:
        """The sigma of a kind of parameter; infinite of kinds without prior."""
        known = {
            term.LINEAR: self.damping, **dict.fromkeys(QUADRATICS, self.damping),
            term.ADDED_MASS: self.added_mass, term.LIFT: self.lift, term.GAIN: self.gain,
        }  # fmt: skip
        return known.get(kind, math.inf)


def read_prior(text: str) -> PriorSigmas | None:
    """A prior as the command line has it: `none`, one relative sigma for all, or the default.

    Raises:
        VehicleError: it is neither.
    """
    if text in ("", "none"):
        return PriorSigmas() if not text else None
    try:
        sigma = float(text)
    except ValueError:
        raise VehicleError(f"--prior {text!r}: give a relative sigma, or none") from None
    return PriorSigmas(**dict.fromkeys((one.name for one in fields(PriorSigmas)), sigma))


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
        away, logs = values - self.start, self.logarithmic
        with np.errstate(divide="ignore"):
            away[logs] = np.log(values[logs] / self.start[logs])
        return away / self.sigma

    def slopes(self, values: Array) -> Array:
        """Derivatives of the residuals, (P,)."""
        return 1.0 / (self.sigma * np.where(self.logarithmic, values, 1.0))


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
        definite = kind == term.GAIN or (kind != term.LIFT and i == j)
        if definite and start[k] != 0.0:
            sigma[k], logarithmic[k] = relative, True
            continue
        scale = abs(start[k])
        if kind == term.LINEAR:
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


_SHORT_S = 5.0
"""First approximation uses windows no longer than this: over a short time a simulation stays
near the measured motion whatever the parameters, so that the fit is led to the right minimum."""
MAX_STEP_S, _ROUGH_STEP_S = 0.025, 0.1
"""Rows farther apart are crossed in several steps: of the fit, and of its first approximation."""
_START_SIGMA = np.array([0.5] * 3 + [2.0] * 6)
"""Distance, rad, m/s and rad/s, of a start from the first measured values that costs one
sigma: wide, so that it matters only where nothing was measured."""
_SETTLED = 1e-2
"""A start has converged when the remaining gain is this small against one sigma squared."""
_NOTHING = 1e-6
"""Or this small against the whole sum of squares."""
_ROUGH_SHARE = 0.1
"""Share of a channel's spread used as sigma in the first approximation, if above noise."""
_BLIND = 1e-3
"""Sigmas by which all residuals together move where a parameter changes by itself, or by 1 if it is
smaller: a parameter that does less is not seen at all."""
_NOTICED = 2e-3
"""Change of the sum of squares, in sigmas squared, that ends a fit: a twentieth of a sigma of one
parameter."""
_MAX_EVALUATIONS = 60
"""Most evaluations of all windows, in each round."""
_ROUNDS = 4
"""Most re-estimations of the noise."""
_SAME = 0.02
"""Relative change of the noise that counts as zero."""
_SAME_WEIGHT = 0.1
"""The same of the prior's weight."""
_MIN_SIGMA = np.array([1e-6] * term.CHANNELS)
"""Noise cannot be estimated smaller: m/s, rad/s, rad."""
_SINGULAR = 1e-12
"""Ratio of the information's least to greatest eigenvalue, in units of its diagonal."""


@dataclass(frozen=True, kw_only=True, eq=False)
class OutputErrorFit:
    """Fitted parameters with their covariance."""

    parameters: Parameters
    values: Array
    """(P,)"""
    covariance: Array
    """(P, P) with the residuals' correlation in time and across channels, and that of the prior;
    zero of parameters at a bound."""
    prior_covariance: Array
    """(P, P) the part that comes of the start's own error; zero without a prior."""
    at_bound: Mask
    """(P,) bool: held by a bound, so without sigma."""
    at_start: Mask
    """(P,) bool: left at the start, as stretches that were left out do not confirm the fit; the
    sigma holds the distance to where the logs had them."""
    closer: Array
    """(2, 9) shares by which the fit is closer to such stretches than the start; see `closer`."""
    channel_sigma: Array
    """(9,) sigmas of the residuals, NaN where nothing was measured."""
    prior: PriorSigmas | None = None
    """As it was given."""

    @property
    def sigma(self) -> Array:
        """(P,) sigmas; NaN of parameters at a bound."""
        sigma: Array = np.sqrt(np.diag(self.covariance))
        return np.where(self.at_bound, np.nan, sigma)

    @property
    def correlation(self) -> Array:
        """(P, P) correlations; NaN of parameters at a bound."""
        sigma = self.sigma
        return self.covariance / np.outer(sigma, sigma)


@named_step("fit to the logs")
def fit_output_error(
    windows: Sequence[Window],
    parameters: Parameters,
    *,
    max_step_s: float = MAX_STEP_S,
    prior: PriorSigmas | None = None,
) -> OutputErrorFit:
    """Fit parameters to windows.

    Args:
        windows: all with the thrusters of the parameters' vehicle, or all without.
        parameters: what is free, and where it starts.
        max_step_s: longest step of the simulation.
        prior: how near the values are to those they start from; nothing is known if not given.

    Raises:
        VehicleError: the simulation does not stay finite at the start, the fit does not settle, or
            the logs do not determine the parameters.
    """
    lower, upper = parameters.bounds
    short = [part for window in windows for part in cut(window, _SHORT_S)]
    rough_s = max(max_step_s, _ROUGH_STEP_S)
    known = prior_of(parameters, windows, prior)
    approach = _FitProblem(short, parameters, rough_s, _first_sigma(windows), known, settled=1.0)
    approach.begin(parameters.start)
    result = least_squares(
        approach.residuals, np.clip(parameters.start, lower, upper), approach.jacobian,
        bounds=(lower, upper), x_scale="jac", ftol=1e-3, xtol=1e-10, gtol=None, max_nfev=20,
    )  # fmt: skip
    values = result.x
    approach.estimate_sigma(values)
    problem = _FitProblem(windows, parameters, max_step_s, approach.sigma, known)
    rounds = (1e2,) * _ROUNDS + (1.0,)
    settled = False
    for looseness in progress(rounds, "fit", len(rounds)):
        if settled and looseness > 1.0:
            continue
        problem.begin(values)
        result = least_squares(
            problem.residuals, np.clip(values, lower, upper), problem.jacobian,
            bounds=(lower, upper), x_scale="jac", ftol=looseness * _NOTICED / problem.samples,
            xtol=1e-10, gtol=None, max_nfev=_MAX_EVALUATIONS,
        )  # fmt: skip
        if result.status == 0:
            raise VehicleError(
                f"the fit has not settled after {_MAX_EVALUATIONS} evaluations: free fewer "
                "parameters, or start from coefficients that are closer"
            )
        values = result.x
        if looseness > 1.0:
            settled = problem.estimate_sigma(values) < _SAME
            settled &= problem.weigh_prior(values) < _SAME_WEIGHT
    held = result.active_mask
    values = np.where(held < 0, lower, np.where(held > 0, upper, values))
    return replace(problem.result(values, held != 0), prior=prior)


class _FitProblem:
    """Residuals of all windows with their starts solved for."""

    def __init__(
        self,
        windows: Sequence[Window],
        parameters: Parameters,
        max_step_s: float,
        sigma: Array,
        prior: StartPrior | None,
        settled: float = _SETTLED,
    ) -> None:
        self.windows, self.parameters, self.settled = windows, parameters, settled
        self.max_step_s = max_step_s
        self.prior, self.prior_weight = prior, 1.0
        self.sigma = np.maximum(np.where(np.isfinite(sigma), sigma, 1.0), _MIN_SIGMA)
        self.count = len(parameters.names)
        self.measured = [np.isfinite(residual_channels(w, _blank(w))) for w in windows]
        # Starts of the parameters whose slopes were last requested: a trial nearby begins there, so
        # that it comes back to the same residuals as its step goes to nothing.
        self.samples = sum(int(mask.sum()) for mask in self.measured)
        # Of each residual but those of the prior: its channel, none for those of the starts.
        blank = np.full(term.START, term.CHANNELS)
        places = [np.concatenate([np.nonzero(mask)[1], blank]) for mask in self.measured]
        self.channel = np.concatenate(places)
        # Its stretch, too; those of starts are with their window.
        numbers = stretch_numbers([window.record.time_s for window in windows])
        parts = [
            np.concatenate([number[np.nonzero(mask)[0]], np.full(term.START, number[0])])
            for number, mask in zip(numbers, self.measured, strict=True)
        ]
        self.number = np.concatenate(parts)
        self.starts = [window.start.copy() for window in windows]
        self.gains = [np.zeros((term.START, self.count)) for _ in windows]
        self.at = parameters.start.copy()
        self.trial: tuple[Array, list[Array], list[Array], Array] | None = None

    def begin(self, values: Array) -> None:
        """Check that the simulation works where the fit starts."""
        if not np.all(np.isfinite(self.residuals(values))):
            raise VehicleError(
                "the simulation does not stay finite with the coefficients the fit starts from: "
                "check signs and units of log and vehicle, or use shorter windows"
            )
        rows = self.samples + term.START * len(self.windows)
        reach = np.linalg.norm(self.jacobian(values)[:rows], axis=0) * np.maximum(
            np.abs(values), 1.0
        )
        names = [n for n, r in zip(self.parameters.names, reach, strict=True) if r < _BLIND]
        if names:
            raise VehicleError(f"the logs do not determine {', '.join(names)}: do not free them")

    def residuals(self, values: Array) -> Array:
        """All residuals in sigmas, minus what the starts explain; infinite where there are none."""
        solved = self._solve(values)
        if solved is None:
            size = self.samples + term.START * len(self.windows)
            size += 0 if self.prior is None else self.count
            return np.full(size, np.inf)
        residuals, slopes, starts, gains = [], [], [], []
        for start, residual, slope in solved:
            by_start = slope[:, self.count :]
            basis, triangle = np.linalg.qr(by_start)
            by_parameters = slope[:, : self.count]
            inner = basis.T @ by_parameters
            residuals.append(residual - basis @ (basis.T @ residual))
            slopes.append(by_parameters - basis @ inner)
            starts.append(start)
            gains.append(np.linalg.solve(triangle, inner))
        if self.prior is not None:
            share = np.sqrt(self.prior_weight)
            residuals.append(share * self.prior.residuals(values))
            slopes.append(np.diag(share * self.prior.slopes(values)))
        self.trial = (values.copy(), starts, gains, np.concatenate(slopes))
        return np.concatenate(residuals)

    def jacobian(self, values: Array) -> Array:
        """Slopes of the residuals; trials begin from here afterwards."""
        if self.trial is None or not np.array_equal(values, self.trial[0]):
            self.residuals(values)
        if self.trial is None:
            raise VehicleError("the simulation does not stay finite")
        self.at, self.starts, self.gains, slopes = self.trial
        return slopes

    def estimate_sigma(self, values: Array) -> float:
        """Estimate the noise from the residuals; return its relative change."""
        sigma = self._channel_sigma(self.residuals(values))
        known = np.isfinite(sigma)
        new = np.maximum(np.where(known, sigma * self.sigma, 1.0), _MIN_SIGMA)
        changed = float(np.max(np.abs(new / self.sigma - 1.0)[known]))
        self.sigma = new
        return changed

    def result(self, values: Array, at_bound: Mask) -> OutputErrorFit:
        """The fit at the values it settled on."""
        residuals, table = self.residuals(values), self.jacobian(values)
        free = np.flatnonzero(~at_bound)
        information = table[:, free].T @ table[:, free]
        inverse = _inverse(information, [self.parameters.names[k] for k in free])
        held = self._prior_information(values)[np.ix_(free, free)]
        stretches = self._stretches(residuals, table[:, free])
        scattered = jackknife_covariance(stretches, held)
        # By chance it may come out below that of white noise: this is not used.
        from_logs = inverse @ (information - held) @ inverse
        if scattered is not None:
            from_logs = _widen(scattered, [from_logs])
        # The start is off by its own sigma: a score of weight times that of the prior alone.
        from_prior = self.prior_weight * inverse @ held @ inverse
        whole = np.eye(self.count)[:, free]
        from_logs, from_prior = (whole @ part @ whole.T for part in (from_logs, from_prior))
        # Forces whose motions are not predicted better for sure are left as they were.
        shares, start = self._closer(residuals, table[:, free], held), self.parameters.start
        places = [place_of(name) for name in self.parameters.names]
        known = [kind in _OF_FORCES for kind, _, _ in places]
        forces = [2 if kind == term.BUOYANCY else force for kind, force, _ in places]
        at_start = np.array(known, bool) & (shares[0] < _CONFIRMED * shares[1])[forces]
        away = np.where(at_start, values - start, 0.0)
        return OutputErrorFit(
            parameters=self.parameters, values=values - away,
            covariance=from_logs + from_prior + np.outer(away, away),
            prior_covariance=from_prior, at_bound=at_bound & ~at_start, at_start=at_start,
            closer=shares,
            channel_sigma=self._channel_sigma(residuals) * self.sigma,
        )  # fmt: skip

    def _closer(self, residuals: Array, table: Array, prior: Array) -> Array:
        """Judge the fit against its start, by stretches that are left out of the fit.

        Of the distance between the two predictions of a stretch, a share of -1 to 1 is what one is
        closer to the log than the other. Stretches count by that distance: at rest they do not.

        Returns:
            (2, 9) mean share of each channel, and its standard deviation from stretch to stretch.
        """
        rows, width, stretches = (
            len(self.number),
            term.CHANNELS + 1,
            self._stretches(residuals, table),
        )
        if self.prior is None or len(stretches) < _MIN_JUDGED:
            return np.full((2, term.CHANNELS), np.nan)
        moves = moves_without(stretches, prior)[self.number]
        found = residuals[:rows] + np.sum(table[:rows] * moves, axis=1)
        begun = self.residuals(self.parameters.start)[:rows]
        place, size = self.number * width + self.channel, len(stretches) * width
        squares = (np.bincount(place, x**2, size) for x in (begun, found, begun - found))
        b, f, apart = (np.sqrt(x).reshape(-1, width)[:, :-1] for x in squares)
        with np.errstate(invalid="ignore"):
            weight, share = apart / apart.sum(axis=0), (b - f) / np.maximum(apart, _NOTHING)
            mean = np.sum(weight * share, axis=0)
            return np.stack([mean, np.sqrt(np.sum(weight * (share - mean) ** 2, axis=0))])

    def weigh_prior(self, values: Array) -> float:
        """Let the prior count as the logs' residuals are correlated; return its relative change."""
        if self.prior is None:
            return 0.0
        stretches = self._stretches(self.residuals(values), self.jacobian(values))
        new = design_effect(stretches, self._prior_information(values))
        changed = abs(new / self.prior_weight - 1.0)
        self.prior_weight = new
        return changed

    def _prior_information(self, values: Array) -> Array:
        """(P, P) information of the prior as it counts."""
        if self.prior is None:
            return np.zeros((self.count, self.count))
        return np.diag(self.prior_weight * self.prior.slopes(values) ** 2)

    def _stretches(self, residuals: Array, table: Array) -> Stretches:
        """Residuals and slopes by stretches of the logs."""
        count = len(self.number)
        return in_stretches(residuals[:count], table[:count], self.number)

    def _solve(self, values: Array) -> list[tuple[Array, Array, Array]] | None:
        """Starts, residuals in sigmas and slopes, by window; None where there are none."""
        try:
            physics = with_given(self.parameters.physics(values), self.windows[0].given)
        except VehicleError:
            return None  # an inertia that is none: the step was too long
        solved = []
        for i, window in enumerate(self.windows):
            start = _move_start(self.starts[i], -self.gains[i] @ (values - self.at))
            found = self._start(window, i, physics, start)
            found = found or self._start(window, i, physics, window.start)
            if found is None:
                return None
            solved.append(found)
        return solved

    def _start(
        self, window: Window, i: int, physics: Physics, start: Array
    ) -> tuple[Array, Array, Array] | None:
        """Gauss-Newton on the start of a window: it, residuals and slopes there."""
        found = self._simulate(window, i, physics, start)
        if found is None:
            return None
        for _ in range(12):
            residual, slope = found
            basis, triangle = np.linalg.qr(slope[:, self.count :])
            along = basis.T @ residual
            if along @ along < self.settled + _NOTHING * (residual @ residual):
                break
            step, share = -np.linalg.solve(triangle, along), 1.0
            while share > 1e-3:
                trial = _move_start(start, share * step)
                better = self._simulate(window, i, physics, trial)
                if better is not None and better[0] @ better[0] < residual @ residual:
                    start, found = trial, better
                    break
                share *= 0.3
            else:
                break
        return (start, *found)

    def _simulate(
        self, window: Window, i: int, physics: Physics, start: Array
    ) -> tuple[Array, Array] | None:
        _, observed, slopes = simulate(
            physics, self.parameters.terms, window.record, start, self.max_step_s
        )
        mask = self.measured[i]
        residual = (residual_channels(window, observed) / self.sigma)[mask]
        if not np.all(np.isfinite(residual)):
            return None
        slope = (slopes / self.sigma[:, None])[mask]
        prior = np.zeros((term.START, self.count + term.START))
        prior[:, self.count :] = np.diag(1.0 / _START_SIGMA)
        away = _between(window.start, start) / _START_SIGMA
        return np.concatenate([residual, away]), np.concatenate([slope, prior])

    def _channel_sigma(self, residuals: Array) -> Array:
        """Sigma of each channel, (9,), in those it was weighed by; NaN without samples."""
        left = self.samples - self.count - term.START * len(self.windows)
        if left < 0.1 * self.samples:
            raise VehicleError(
                f"{self.samples} samples for {self.count} parameters and {len(self.windows)} "
                "windows are too few: use longer windows or free fewer parameters"
            )
        counts = np.bincount(self.channel, minlength=term.CHANNELS + 1)
        squares = np.bincount(self.channel, residuals[: len(self.channel)] ** 2, len(counts))
        # Parameters and starts fit some of the noise.
        with np.errstate(invalid="ignore"):
            sigma: Array = np.sqrt(self.samples / left * squares / counts)
        return sigma[: term.CHANNELS]


def _first_sigma(windows: Sequence[Window]) -> Array:
    """First sigma of each channel, (9,): the noise, or a share of the spread if larger."""
    sigma = np.full(term.CHANNELS, np.nan)
    all_read = [np.hstack([w.measured, attitude_of(w.record.attitude)]) for w in windows]
    for channel in range(term.CHANNELS):
        table = [read[np.isfinite(read[:, channel]), channel] for read in all_read]
        table = [np.unwrap(series) for series in table] if channel >= 6 else table
        found = [noise_sigma(series) for series in table if len(series) >= 5]
        if found:
            spread = float(np.std(np.concatenate(table)))
            sigma[channel] = max(float(np.median(found)), _ROUGH_SHARE * spread)
    return sigma


_SECOND_DIFFERENCE = 6.0
"""Variance of the second difference of white noise, by its own: 1 + 4 + 1."""
_MAD = 1.4826
"""Standard deviation of a normal variable by its median absolute deviation."""


def noise_sigma(series: Array) -> float:
    """Standard deviation of the white noise on a smooth series, (T,), by second differences.

    The median suppresses steps and outliers.
    """
    second = np.diff(series, 2) / np.sqrt(_SECOND_DIFFERENCE)
    return float(_MAD * np.median(np.abs(second)))


def _blank(window: Window) -> Array:
    """Observations that are unknown only where the attitude is, (T, 9)."""
    blank = np.zeros((len(window.measured), term.CHANNELS))
    blank[:, 6:] = np.where(np.isfinite(window.record.attitude).all(axis=1), 0.0, np.nan)[:, None]
    return blank


def _move_start(start: Array, step: Array) -> Array:
    """A start (10,) turned about the body's axes and with nu changed by a step (9,)."""
    moved = start.copy()
    turned = Rotation.from_quat(start[:4]) * Rotation.from_rotvec(step[:3])
    quaternion = turned.as_quat()
    moved[:4] = quaternion if quaternion @ start[:4] >= 0 else -quaternion
    moved[4:] += step[3:]
    return moved


def _between(first: Array, second: Array) -> Array:
    """The step (9,) from one start to another."""
    turn = Rotation.from_quat(first[:4]).inv() * Rotation.from_quat(second[:4])
    return np.concatenate([turn.as_rotvec(), second[4:] - first[4:]])


def _inverse(information: Array, names: Sequence[str]) -> Array:
    """Inverse of the information.

    Raises:
        VehicleError: it has none: the parameters that cannot be separated are named.
    """
    scale = np.sqrt(np.diag(information))
    blind = [name for name, value in zip(names, scale, strict=True) if value == 0]
    if blind:
        raise VehicleError(f"the logs do not determine {', '.join(blind)}: do not free them")
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    if len(values) and values[0] < _SINGULAR * values[-1]:
        weight = np.abs(vectors[:, 0])
        mixed = [name for name, w in zip(names, weight, strict=True) if w > 0.3 * weight.max()]
        raise VehicleError(
            f"the logs cannot separate {', '.join(mixed)}: free fewer of them, or add manoeuvres"
        )
    return np.asarray((vectors / values) @ vectors.T / np.outer(scale, scale))
