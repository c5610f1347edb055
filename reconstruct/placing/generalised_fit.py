"""Generalised least squares for a model's place, with sigmas that account for correlated errors.

Errors of navigation are correlated: weights that take readings as independent give sigmas that are
far too small. Here every group of channels (horizontal position, depth, tilt, heading) has the
marginal sigma that navigation states, and a correlation time and white and constant shares that the
misfit between navigation and the model gives, the model being stiff. Whether errors restart with a
dive, and how far the constants of dives are apart, is found in the same way. They are found by
restricted maximum likelihood (Patterson & Thompson 1971), which counts what the placement itself
has absorbed, and the covariance of the placement is averaged over all that are likely.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.frames import Array
from alice_survey.core.robust import MAD_TO_SIGMA
from reconstruct.placing.correlated_errors import MIN_WHITE, standard_residuals
from reconstruct.placing.navigation_equations import GROUPS, NavigationEquations
from reconstruct.placing.placement_problem import Correlation, Extra, PlacementProblem, channels_of

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
class Estimate:
    """The parameters' change that the equations give, with its covariance."""

    change: Array
    """(P,) change, zero for what is held."""
    covariance: Array
    """(P, P) covariance, zero for what is held."""
    correlation: Mapping[str, Correlation]
    """Correlation by group, of those with readings."""
    used: NDArray[np.bool_]
    """(M, 6) readings that took part."""


def estimate(
    time: Array,
    found: NavigationEquations,
    used: NDArray[np.bool_],
    free: Sequence[int],
    extra: Extra,
    *,
    frame_bounds: Mapping[int, float],
    widened: Mapping[str, float] | None = None,
    correlation: Mapping[str, Correlation] | None = None,
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
        parameters, spread = problem.total(used, correlation).solve()
        change, covariance = _filled(problem, parameters, spread)
        return Estimate(change=change, covariance=covariance, correlation=correlation, used=used)
    correlation = {
        group: Correlation(tau=float(np.ptp(time)) or 1.0, white=0.1)
        for group in GROUPS
        if used[:, channels_of(group)].any()
    }
    for _ in range(_ROUNDS):
        correlation = _likeliest(problem, used, correlation)
        kept = _without_contradicted(problem, used, correlation)
        if np.array_equal(kept, used):
            break
        used = kept
    change, covariance = _averaged(problem, used, correlation)
    return Estimate(change=change, covariance=covariance, correlation=correlation, used=used)


def dives_of(time: Array) -> NDArray[np.int64]:
    """(M,) number of the dive of each of the times (M,), from 0: long gaps lie between dives."""
    steps = np.diff(time)
    usual = np.median(steps[steps > 0]) if np.any(steps > 0) else 0.0
    surfaced = steps > max(_SURFACED_S, _SURFACED_STEPS * float(usual))
    return np.concatenate([[0], np.cumsum(surfaced)]).astype(np.int64)


def without_gross_errors(time: Array, misfit: Array, known: NDArray[np.bool_]) -> NDArray[np.bool_]:
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


def _grid(problem: PlacementProblem) -> list[Correlation]:
    time = problem.time
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
        for constant in _CONSTANT
        for restart in ((0.0, 1.0) if problem.dives[-1] else (0.0,))
    ]


def _choices(grid: Sequence[Correlation], now: Correlation) -> list[Correlation]:
    """What is tried with the present factor, and with the present jumps where dives contradict."""
    if now.restart <= 1.0:
        return [replace(how, factor=now.factor) for how in grid]
    return [
        replace(how, factor=now.factor, restart=now.restart)
        for how in grid
        if how.restart and how.constant
    ]


def _likeliest(
    problem: PlacementProblem, used: NDArray[np.bool_], correlation: Mapping[str, Correlation]
) -> dict[str, Correlation]:
    """The likeliest correlation of every group, one after the other, in several rounds."""
    now = {group: how for group, how in correlation.items() if used[:, channels_of(group)].any()}
    grid = _grid(problem)
    for _ in range(_SWEEPS):
        before = dict(now)
        for group in now:
            choices = _choices(grid, now[group])
            scores = _scores(problem, used, now, group, choices)
            now[group] = choices[int(np.argmax(scores))]
            if problem.dives[-1]:
                now[group] = _with_jumps(problem, used, now, group)
            now[group] = replace(now[group], factor=_factor(problem, used, now, group))
        if now == before:
            break
    return now


def _with_jumps(
    problem: PlacementProblem,
    used: NDArray[np.bool_],
    now: Mapping[str, Correlation],
    group: str,
) -> Correlation:
    """A group's correlation with dives apart as far as they contradict each other, if they do."""
    present = replace(now[group], restart=min(now[group].restart, 1.0))
    jumps = [
        replace(present, restart=jump, constant=constant)
        for jump in _JUMPS
        for constant in _CONSTANT[1:]
    ]
    scores = _scores(problem, used, now, group, [present, *jumps])
    best = int(np.argmax(scores[1:]))
    contradicted = scores[1 + best] > scores[0] + 0.5 * _CHI_SIGMAS**2
    return jumps[best] if contradicted else present


def _scores(
    problem: PlacementProblem,
    used: NDArray[np.bool_],
    now: Mapping[str, Correlation],
    group: str,
    choices: Sequence[Correlation],
) -> Array:
    """Logarithm of the restricted likelihood of each choice for a group, but for a constant."""
    others = problem.rest(now)
    for name, how in now.items():
        if name != group:
            others = others.plus(problem.group(name, used, how))
    parts = [problem.group(group, used, choice) for choice in choices]
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


def _factor(
    problem: PlacementProblem, used: NDArray[np.bool_], now: Mapping[str, Correlation], group: str
) -> float:
    """Factor by which a group's misfits are larger than its sigmas allow, 1 or more."""
    minimum = problem.widened.get(group, 1.0)
    change, covariance = problem.total(used, now).solve()
    own = problem.group(group, used, now[group])
    square = own.square + 2.0 * float(own.vector @ change) + float(change @ own.matrix @ change)
    freedom = own.rows - float(np.trace(covariance @ own.matrix))
    if freedom < 1.0:
        return now[group].factor
    ratio = square / freedom * now[group].factor ** 2
    significant = ratio > 1.0 + _CHI_SIGMAS * np.sqrt(2.0 / freedom)
    return max(float(np.sqrt(ratio)) if significant else 1.0, minimum)


def _without_contradicted(
    problem: PlacementProblem, used: NDArray[np.bool_], correlation: Mapping[str, Correlation]
) -> NDArray[np.bool_]:
    """Leave out, of each group, readings that all others contradict, the worst of neighbours first.

    An outlier makes its neighbours look wrong too: of two in a row only the worse goes at a time.
    """
    change, _ = problem.total(used, correlation).solve()
    kept = used.copy()
    for group, how in correlation.items():
        channels = channels_of(group)
        worst = np.zeros(len(problem.time))
        for channel in channels:
            rows = used[:, channel]
            jacobian = problem.found.jacobian[:, channel][:, problem.free]
            misfit = problem.found.misfit[:, channel] + jacobian @ change
            varying, constants = problem.shares(channel, rows, how)
            sigma = varying * problem.found.sigma[:, channel]
            both = np.column_stack([misfit / how.factor, constants])
            even = problem.whitened(channel, rows, how, varying, both)[0]
            inner = np.eye(constants.shape[1]) + even[:, 1:].T @ even[:, 1:]
            steady = np.linalg.solve(inner, even[:, 1:].T @ even[:, 0])
            off = np.where(rows, (both[:, 0] - constants @ steady) / varying, 0.0)
            off = standard_residuals(problem.times(how), sigma, rows, off, how.tau, how.white)
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


def _averaged(
    problem: PlacementProblem, used: NDArray[np.bool_], correlation: Mapping[str, Correlation]
) -> tuple[Array, Array]:
    """Parameters and covariance over all likely correlations of errors, (P,) and (P, P).

    The covariance is the mean of those of the single ways and the scatter of their solutions.
    """
    rng = np.random.default_rng(0)  # any draws will do; the same bytes each time
    grid = _grid(problem)
    draws: dict[str, list[Correlation]] = {}
    for group, how in correlation.items():
        choices = _choices(grid, how)
        scores = _scores(problem, used, correlation, group, choices)
        weights = np.exp(scores - scores.max())
        picked = rng.choice(len(choices), size=_DRAWS, p=weights / weights.sum())
        draws[group] = [choices[k] for k in picked]
    solutions = [
        problem.total(used, {group: draws[group][k] for group in correlation}).solve()
        for k in range(_DRAWS if correlation else 1)
    ]
    changes = np.stack([change for change, _ in solutions])
    mean = changes.mean(axis=0)
    spread = (changes - mean).T @ (changes - mean) / len(changes)
    covariance = np.mean([c for _, c in solutions], axis=0) + spread
    return _filled(problem, mean, covariance)


def _filled(problem: PlacementProblem, mean: Array, covariance: Array) -> tuple[Array, Array]:
    """Parameters and covariance with zeros for what is held."""
    columns = problem.found.jacobian.shape[2]
    full, matrix = np.zeros(columns), np.zeros((columns, columns))
    full[problem.free] = mean
    matrix[np.ix_(problem.free, problem.free)] = covariance
    return full, matrix
