"""Generalised least squares for a model's place, with sigmas that account for correlated errors.

Errors of navigation are correlated: weights that take readings as independent give sigmas that are
far too small. Here every group of channels (horizontal position, depth, tilt, heading) has the
marginal sigma that navigation states, and a correlation time and white and constant shares that the
misfit between navigation and the model gives, the model being stiff. Whether errors restart with a
dive, and how far the constants of dives are apart, is found in the same way. They are found by
restricted maximum likelihood (Patterson & Thompson 1971), which counts what the placement itself
has absorbed, and the covariance of the placement is averaged over all that are likely.

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
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from alice_survey.core.block_solver import MAD_TO_SIGMA, Flags, Indices
from alice_survey.core.compiled import compiled
from alice_survey.core.frames import Array
from reconstruct.placing.navigation import GROUP_OF, GROUPS, NavigationEquations

MIN_WHITE = 1e-4
"""Share of white error that two readings at the same time need to have any innovation."""


@compiled
def whiten(
    time: Array, sigma: Array, used: Flags, values: Array, tau: float, white: float
) -> tuple[Array, float, Array, Array]:
    """Make columns of correlated values of unit variance white.

    Args:
        time: (N,) not decreasing.
        sigma: (N,) of the values before they were divided by it.
        used: (N,) what is there; the rest is passed over as a gap.
        values: (N, P) columns, each over its sigma.
        tau: time in which the correlation falls to 1/e, above 0.
        white: share w of the variance that is white, `MIN_WHITE` to 1.

    Returns:
        (N, P) innovations over their standard deviation, zero where not used; the logarithm of the
        determinant of the covariance matrix of what is used; and the mean (N, P) and variance (N,)
        of the Markov part before each value.
    """
    count, columns = values.shape
    found = np.zeros((count, columns))
    means, variances = np.zeros((count, columns)), np.ones(count)
    state = np.zeros(columns)
    gain_in = math.sqrt(1.0 - white)
    variance, log_det, last = 1.0, 0.0, -1
    for i in range(count):
        if not used[i]:
            continue
        kept = 1.0
        if last >= 0:
            lesser, greater = min(sigma[i], sigma[last]), max(sigma[i], sigma[last])
            kept = math.exp(-abs(time[i] - time[last]) / tau) * lesser / greater
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
    time: Array, sigma: Array, used: Flags, values: Array, tau: float, white: float
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
    rows = time, sigma, np.ascontiguousarray(used), values[:, None]
    past, past_variance = whiten(*rows, tau, white)[2:]
    reversed_ = (np.ascontiguousarray(row[::-1]) for row in rows)
    future, future_variance = (row[::-1] for row in whiten(*reversed_, tau, white)[2:])
    past, future = past[:, 0], future[:, 0]
    precision = 1.0 / past_variance + 1.0 / future_variance - 1.0
    mean = (past / past_variance + future / future_variance) / precision
    spread = (1.0 - white) / precision + white
    return np.asarray((values - math.sqrt(1.0 - white) * mean) / np.sqrt(spread))


def correlated_share(time: Array, tau: float, white: float) -> float:
    """Share of the variance that the plain mean over all times keeps beyond that of white error.

    0 for white error, near 1 where one error is constant. The times are taken as evenly
    spread: twice the integral of `(1 - s) exp(-s T / tau)`.
    """
    ratio = float(time[-1] - time[0]) / tau
    if ratio < 1e-6:
        return 1.0 - white
    return (1.0 - white) * 2.0 / ratio * (1.0 - (1.0 - math.exp(-ratio)) / ratio)


@dataclass(frozen=True, kw_only=True)
class Correlation:
    """How the errors of a group of channels are correlated in time."""

    tau: float
    """Correlation time of the varying part, in the unit of the epochs' time."""
    white: float
    """Share of the varying part's variance that is white."""
    constant: float = 0.0
    """Share of all variance that one constant error has."""
    factor: float = 1.0
    """Factor by which the stated sigmas are too small."""
    restart: float = 0.0
    """Constant error of each dive over what the constant share allows; 0: errors outlast gaps."""


Correlations = Mapping[str, Correlation]
"""By group."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Extra:
    """Independent further equations, made white: misfit + jacobian x change = N(0, 1)."""

    misfit: Array
    """(E,) misfits."""
    jacobian: Array
    """(E, P) their slopes."""


def frame_sigma(bound: float, time: Array, how: Correlation) -> float:
    """Sigma of a turn or stretch of navigation's own frame, from that of errors that last."""
    share = correlated_share(time, how.tau, how.white)
    share = how.constant + (1.0 - how.constant) * share
    return max(bound * how.factor * float(np.sqrt(share)), 1e-9)


class _Normal(NamedTuple):
    """Normal equations and likelihood of a group."""

    matrix: Array
    vector: Array
    square: float
    log_det: float = 0.0
    rows: int = 0

    def plus(self, other: "_Normal") -> "_Normal":
        pairs: Iterable[tuple[Any, Any]] = zip(self, other, strict=True)
        return _Normal(*(mine + theirs for mine, theirs in pairs))

    def solve(self) -> tuple[Array, Array]:
        """Parameters and their covariance."""
        size = np.sqrt(np.diag(self.matrix))
        size = np.where(size > 0, size, 1.0)
        inverse = np.linalg.pinv(self.matrix / np.outer(size, size), rcond=1e-14, hermitian=True)
        covariance = inverse / np.outer(size, size)
        return -covariance @ self.vector, covariance


_WHITE = (MIN_WHITE, 3e-3, 0.05, 0.3, 0.8, 0.97)
_CONSTANT = (0.0, 0.5, 0.75, 0.9)
"""The varying part's variance goes down by halves: what is not known of a variance is its size."""
_JUMPS = (4.0, 16.0, 64.0, 256.0)
"""Constant errors of dives over what stated sigmas allow, tried where dives contradict."""
_SURFACED_S, _SURFACED_STEPS = 300.0, 20.0
"""A gap between stations is one between dives from these times on, in seconds and usual steps."""
_TAUS = 10
_MIN_STEPS, _MAX_SPANS = 0.2, 30.0
"""Correlation times tried: from this many median time steps to this many lengths of the survey."""
_GROSS_SIGMAS = 5.0
_CONTRADICTED_SIGMAS = 4.5
"""A reading this far from what all others say is left out."""
_SWEEPS = 3
_ROUNDS = 6
_DRAWS = 64
_CHI_SIGMAS = 3.0
"""A misfit larger than stated sigmas allow, at this significance, makes them larger."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacementProblem:
    """What a place is solved from, whatever the correlation of navigation's errors."""

    time: Array
    """(M,) times, not decreasing."""
    found: NavigationEquations
    free: Indices
    """Parameters to solve for."""
    extra: Extra
    frame_bounds: Mapping[int, float]
    """Sigmas of nuisances of navigation's own frame if its position errors lasted throughout."""
    widened: Mapping[str, float]
    """Groups whose stated sigmas are too small by this factor or more."""
    dives: Indices
    """(M,) number of the dive of each time."""
    cache: dict[Any, _Normal] = field(default_factory=dict)

    def group(self, group: str, used: Flags, correlation: Correlation) -> _Normal:
        """Normal equations of one group.

        Constant errors of variance 1 with columns C add `C C'` to the covariance matrix: its
        inverse is that of the varying part minus a product (Woodbury 1950).
        """
        key = group, used.tobytes(), replace(correlation, factor=1.0)
        if key not in self.cache:
            self.cache[key] = self._unscaled_group(group, used, correlation)
        found, square = self.cache[key], correlation.factor**2
        return _Normal(
            matrix=found.matrix / square,
            vector=found.vector / square,
            square=found.square / square,
            log_det=found.log_det + found.rows * float(np.log(square)),
            rows=found.rows,
        )

    def _unscaled_group(self, group: str, used: Flags, correlation: Correlation) -> _Normal:
        size = len(self.free)
        total = _Normal(np.zeros((size, size)), np.zeros(size), 0.0)
        for channel in channels_of(group):
            rows = used[:, channel]
            if not rows.any():
                continue
            varying, constants = self.shares(channel, rows, correlation)
            columns = np.column_stack(
                [
                    self.found.jacobian[:, channel][:, self.free],
                    self.found.misfit[:, channel],
                    constants,
                ]
            )
            even, log_det = self.whiten_columns(channel, rows, correlation, varying, columns)
            product = even.T @ even
            log_det += 2.0 * float(np.log(varying[rows]).sum())
            matrix, steady = product[: size + 1, : size + 1], product[: size + 1, size + 1 :]
            inner = np.eye(steady.shape[1]) + product[size + 1 :, size + 1 :]
            kept = matrix - steady @ np.linalg.solve(inner, steady.T)
            total = total.plus(
                _Normal(
                    matrix=kept[:-1, :-1],
                    vector=kept[:-1, -1],
                    square=float(kept[-1, -1]),
                    log_det=log_det + float(np.linalg.slogdet(inner)[1]),
                    rows=int(rows.sum()),
                )
            )
        return total

    def whiten_columns(
        self, channel: int, rows: Flags, how: Correlation, varying: Array, columns: Array
    ) -> tuple[Array, float]:
        """Columns (M, C) over the stated sigma, made white; log det of what is used."""
        columns = np.where(rows[:, None], columns / varying[:, None], 0.0)
        rows, columns = np.ascontiguousarray(rows), np.ascontiguousarray(columns)
        sigma = varying * self.found.sigma[:, channel]
        return whiten(self.times(how), sigma, rows, columns, how.tau, how.white)[:2]

    def times(self, how: Correlation) -> Array:
        """(M,) times; dives where errors restart are too far apart for any correlation."""
        if not how.restart:
            return self.time
        apart = 100.0 * how.tau + float(np.ptp(self.time))
        return self.time + apart * self.dives

    def shares(self, channel: int, rows: Flags, correlation: Correlation) -> tuple[Array, Array]:
        """Sigmas of the varying (M,) and the constant parts (M, D) over the stated one.

        The constant part is as large as the least of the stated sigmas allows.
        """
        sigma = self.found.sigma[:, channel]
        constant = np.sqrt(correlation.constant) * sigma[rows].min() / sigma
        constant = np.minimum(constant, np.sqrt(correlation.constant))
        own = np.ones((len(sigma), 1))
        if correlation.restart:
            own = correlation.restart * np.eye(self.dives[-1] + 1)[self.dives]
        return np.sqrt(1.0 - constant**2), constant[:, None] * own

    def rest(self, correlation: Correlations) -> _Normal:
        """Normal equations of what is not navigation, and of the turn of navigation's frame."""
        jacobian, misfit = self.extra.jacobian[:, self.free], self.extra.misfit
        matrix, vector = jacobian.T @ jacobian, jacobian.T @ misfit
        if "horizontal" in correlation:
            how = correlation["horizontal"]
            for parameter, bound in self.frame_bounds.items():
                at = np.flatnonzero(self.free == parameter)
                matrix[at, at] += frame_sigma(bound, self.time, how) ** -2
        return _Normal(matrix, vector, float(misfit @ misfit))

    def total(self, used: Flags, correlation: Correlations) -> _Normal:
        """Normal equations of all."""
        total = self.rest(correlation)
        for group, how in correlation.items():
            total = total.plus(self.group(group, used, how))
        return total

    def _grid(self, group: str) -> list[Correlation]:
        """What is tried.

        The place turns with a compass's constant error, so that scatter alone shows, and does not
        show that there is none: half of a stated variance stays constant, however much scatters.
        """
        time, constants = self.time, _CONSTANT[1:] if group == "heading" else _CONSTANT
        steps = np.diff(np.unique(time))
        if not len(steps):
            return [Correlation(tau=1.0, white=0.1)]
        taus = np.geomspace(
            _MIN_STEPS * float(np.median(steps)), _MAX_SPANS * float(np.ptp(time)), _TAUS
        )
        return [
            Correlation(tau=float(tau), white=white, constant=constant, restart=restart)
            for tau in taus
            for white in _WHITE
            for constant in constants
            for restart in ((0.0, 1.0) if self.dives[-1] else (0.0,))
        ]

    def likeliest(self, used: Flags, correlation: Correlations) -> dict[str, Correlation]:
        """The likeliest correlation of every group, one after the other, in several rounds."""
        now = {
            group: how for group, how in correlation.items() if used[:, channels_of(group)].any()
        }
        for _ in range(_SWEEPS):
            before = dict(now)
            for group in now:
                choices = _choices(self._grid(group), now[group])
                scores = self._scores(used, now, group, choices)
                now[group] = choices[int(np.argmax(scores))]
                if self.dives[-1]:
                    now[group] = self._with_jumps(used, now, group)
                now[group] = replace(now[group], factor=self._factor(used, now, group))
            if now == before:
                break
        return now

    def _with_jumps(self, used: Flags, now: Correlations, group: str) -> Correlation:
        """A group's correlation, with dives as far apart as they contradict each other."""
        present = replace(now[group], restart=min(now[group].restart, 1.0))
        jumps = [
            replace(present, restart=jump, constant=constant)
            for jump in _JUMPS
            for constant in _CONSTANT[1:]
        ]
        scores = self._scores(used, now, group, [present, *jumps])
        best = int(np.argmax(scores[1:]))
        contradicted = scores[1 + best] > scores[0] + 0.5 * _CHI_SIGMAS**2
        return jumps[best] if contradicted else present

    def _scores(
        self, used: Flags, now: Correlations, group: str, choices: Sequence[Correlation]
    ) -> Array:
        """Logarithm of the restricted likelihood of each choice for a group, but for a constant."""
        others = self.rest(now)
        for name, how in now.items():
            if name != group:
                others = others.plus(self.group(name, used, how))
        parts = [self.group(group, used, choice) for choice in choices]
        matrix = others.matrix + np.stack([part.matrix for part in parts])
        vector = others.vector + np.stack([part.vector for part in parts])
        square, own = (
            np.array(row) for row in zip(*((p.square, p.log_det) for p in parts), strict=True)
        )
        size = np.sqrt(np.diagonal(matrix[0]))
        size = np.where(size > 0, size, 1.0)
        scaled = matrix / np.outer(size, size)
        sign, log_det = np.linalg.slogdet(scaled)
        usable = sign > 0
        scores = np.full(len(choices), -np.inf)
        change = np.linalg.solve(scaled[usable], (vector[usable] / size)[..., None])[..., 0]
        gained = np.einsum("ki,ki->k", change, vector[usable] / size)
        scores[usable] = -0.5 * (own[usable] + log_det[usable] + square[usable] - gained)
        return scores

    def _factor(self, used: Flags, now: Correlations, group: str) -> float:
        """Factor by which a group's misfits are larger than its sigmas allow, 1 or more."""
        minimum = self.widened.get(group, 1.0)
        change, covariance = self.total(used, now).solve()
        own = self.group(group, used, now[group])
        square = own.square + 2.0 * float(own.vector @ change) + float(change @ own.matrix @ change)
        freedom = own.rows - float(np.trace(covariance @ own.matrix))
        if freedom < 1.0:
            return now[group].factor
        ratio = square / freedom * now[group].factor ** 2
        significant = ratio > 1.0 + _CHI_SIGMAS * np.sqrt(2.0 / freedom)
        return max(float(np.sqrt(ratio)) if significant else 1.0, minimum)

    def without_contradicted(self, used: Flags, correlation: Correlations) -> Flags:
        """Leave out, of each group, readings that all others contradict, the worst of neighbours.

        An outlier makes its neighbours look wrong too: of two in a row only the worse goes at once.
        """
        change, _ = self.total(used, correlation).solve()
        kept = used.copy()
        for group, how in correlation.items():
            channels = channels_of(group)
            worst = np.zeros(len(self.time))
            for channel in channels:
                rows = used[:, channel]
                jacobian = self.found.jacobian[:, channel][:, self.free]
                misfit = self.found.misfit[:, channel] + jacobian @ change
                varying, constants = self.shares(channel, rows, how)
                sigma = varying * self.found.sigma[:, channel]
                both = np.column_stack([misfit / how.factor, constants])
                even = self.whiten_columns(channel, rows, how, varying, both)[0]
                inner = np.eye(constants.shape[1]) + even[:, 1:].T @ even[:, 1:]
                steady = np.linalg.solve(inner, even[:, 1:].T @ even[:, 0])
                off = np.where(rows, (both[:, 0] - constants @ steady) / varying, 0.0)
                off = standard_residuals(self.times(how), sigma, rows, off, how.tau, how.white)
                off = np.abs(off)
                worst = np.maximum(worst, np.where(rows, off, 0.0))
            if np.count_nonzero(worst) < 3:
                continue
            peak = np.ones(len(worst), dtype=bool)
            peak[1:] &= worst[1:] >= worst[:-1]
            peak[:-1] &= worst[:-1] > worst[1:]
            contradicted = np.flatnonzero(peak & (worst > _CONTRADICTED_SIGMAS))
            kept[contradicted[:, None], channels] = False
        return kept

    def average(self, used: Flags, correlation: Correlations) -> tuple[Array, Array]:
        """Free parameters and their covariance over all likely correlations of errors.

        The covariance is the mean of those of the single ways and the scatter of their solutions.
        """
        rng = np.random.default_rng(0)  # any draws will do; the same bytes each time
        draws: dict[str, list[Correlation]] = {}
        for group, how in correlation.items():
            choices = _choices(self._grid(group), how)
            scores = self._scores(used, correlation, group, choices)
            weights = np.exp(scores - scores.max())
            picked = rng.choice(len(choices), size=_DRAWS, p=weights / weights.sum())
            draws[group] = [choices[k] for k in picked]
        solutions = [
            self.total(used, {group: draws[group][k] for group in correlation}).solve()
            for k in range(_DRAWS if correlation else 1)
        ]
        changes = np.stack([change for change, _ in solutions])
        mean = changes.mean(axis=0)
        spread = (changes - mean).T @ (changes - mean) / len(changes)
        covariance = np.mean([c for _, c in solutions], axis=0) + spread
        return mean, covariance


def channels_of(group: str) -> list[int]:
    """Numbers of a group's channels among the six."""
    return [k for k, name in enumerate(GROUP_OF) if name == group]


@dataclass(frozen=True, kw_only=True, eq=False)
class Estimate:
    """The parameters' change that the equations give, with its covariance."""

    change: Array
    """(P,) change, zero for what is held."""
    covariance: Array
    """(P, P) covariance, zero for what is held."""
    correlation: Correlations
    """Correlation by group, of those with readings."""
    used: Flags
    """(M, 6) readings that took part."""


def estimate(
    time: Array,
    found: NavigationEquations,
    used: Flags,
    free: Sequence[int],
    extra: Extra,
    *,
    frame_bounds: Mapping[int, float],
    widened: Mapping[str, float] | None = None,
    correlation: Correlations | None = None,
) -> Estimate:
    """Solve for the parameters, the correlation of errors and the readings to leave out.

    Args:
        time: (M,) times, not decreasing.
        found: equations of navigation.
        used: (M, 6) readings that may take part.
        free: parameters to solve for; nuisances among them need an equation in `extra` or are
            otherwise determined.
        extra: further equations.
        frame_bounds: sigmas of the nuisances of navigation's own frame (turn, stretch) if its
            position errors lasted throughout; they shrink as those average out.
        widened: groups whose stated sigmas are too small by this factor or more.
        correlation: of errors, where that is known: then no reading is left out either, and the
            covariance is that of this one alone.
    """
    problem = PlacementProblem(
        time=time, found=found, free=np.array(free), extra=extra, frame_bounds=frame_bounds,
        widened=widened or {}, dives=dives_of(time),
    )  # fmt: skip
    used = used & np.isfinite(found.misfit)
    if correlation is not None:
        solution = problem.total(used, correlation).solve()
    else:
        correlation = {
            group: Correlation(tau=float(np.ptp(time)) or 1.0, white=0.1)
            for group in GROUPS
            if used[:, channels_of(group)].any()
        }
        for _ in range(_ROUNDS):
            correlation = problem.likeliest(used, correlation)
            kept = problem.without_contradicted(used, correlation)
            if np.array_equal(kept, used):
                break
            used = kept
        solution = problem.average(used, correlation)
    columns = found.jacobian.shape[2]
    change, covariance = np.zeros(columns), np.zeros((columns, columns))
    change[problem.free], covariance[np.ix_(problem.free, problem.free)] = solution
    return Estimate(change=change, covariance=covariance, correlation=correlation, used=used)


def dives_of(time: Array) -> Indices:
    """(M,) number of the dive of each of the times (M,), from 0: long gaps lie between dives."""
    steps = np.diff(time)
    usual = np.median(steps[steps > 0]) if np.any(steps > 0) else 0.0
    surfaced = steps > max(_SURFACED_S, _SURFACED_STEPS * float(usual))
    return np.concatenate([[0], np.cumsum(surfaced)]).astype(np.int64)


def without_gross_errors(time: Array, misfit: Array, known: Flags) -> Flags:
    """Leave out readings far from their channel's median misfit in a dive, all of a group together.

    A frame that is off as a whole in a dive (a constant error) leaves nothing out.
    """
    used, dives = known.copy(), dives_of(time)
    for group in GROUPS:
        channels = channels_of(group)
        for channel in channels:
            for dive in range(dives[-1] + 1):
                rows = known[:, channel] & (dives == dive)
                if rows.sum() < 3:
                    continue
                off = np.abs(misfit[:, channel] - np.median(misfit[rows, channel]))
                spread = max(1.0, MAD_TO_SIGMA * float(np.median(off[rows])))
                used[rows & (off > _GROSS_SIGMAS * spread), min(channels)] = False
        used[:, channels] &= used[:, [min(channels)]]
    return used


def _choices(grid: Sequence[Correlation], now: Correlation) -> list[Correlation]:
    """What is tried with the present factor, and with the present jumps where dives contradict."""
    if now.restart <= 1.0:
        return [replace(how, factor=now.factor) for how in grid]
    return [
        replace(how, factor=now.factor, restart=now.restart)
        for how in grid
        if how.restart and how.constant
    ]
