"""Control of a model: known points and lengths place and scale it, or show how accurate it is.

Control may be coarser than stated, or wrong in part. A wrong point is found by least median of
squares (Rousseeuw & Leroy 1987, "Robust regression and outlier detection", chapter 5): of the
placements that three points give, the one that most others agree with. The residuals of the other
points at that placement give their real sigma.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from alice_survey.core.block_solver import MAD_TO_SIGMA
from alice_survey.core.errors import warn
from alice_survey.core.frames import Array, Datum
from alice_survey.core.records import BarRow, ControlRecord, ControlRms, PointRow
from reconstruct.placing.alignment import Similarity, align_rigid, align_similarity
from reconstruct.placing.control_points import Control, KnownLength, TriangulatedPoint
from reconstruct.placing.correlated_fit import Extra
from reconstruct.placing.navigation import PARAMETERS, PLACE, SCALE, slopes_by_place

_CONTRADICTED_SIGMAS = 4.0
_MIN_SPREAD = 1e-3
"""Points this close to one line, over their length, do not say how the model is turned about it."""


MotionAt = Callable[[Array], Array]
"""Motions (N, 3, K) of points (N, 3) of the model by its soft modes."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Tie:
    """A known point and where the model has it."""

    name: str
    use: str
    picked_point: TriangulatedPoint
    ned: Array
    sigma: Array
    """(3,) sigma of `ned`."""

    def residual(self, place: Similarity) -> tuple[Array, Array]:
        """At a placement, model minus known point, (3,) metres, and what picks add, (3, 3)."""
        turn = place.rotation.as_matrix()
        spread = place.scale**2 * turn @ self.picked_point.covariance @ turn.T
        return place.apply(self.picked_point.model[None])[0] - self.ned, spread


@dataclass(frozen=True, kw_only=True, eq=False)
class _Bar:
    """A known length and the model's points that span it."""

    pairs: tuple[tuple[TriangulatedPoint, TriangulatedPoint], ...]
    """One for a bar; the four sides of a marker."""
    known: KnownLength

    @property
    def in_model(self) -> float:
        """Mean length in the model."""
        return float(np.mean([np.linalg.norm(b.model - a.model) for a, b in self.pairs]))

    @property
    def sigma_in_model(self) -> float:
        """Sigma of the length by the picks."""
        squares = []
        for a, b in self.pairs:
            way = (b.model - a.model) / np.linalg.norm(b.model - a.model)
            squares.append(float(way @ (a.covariance + b.covariance) @ way))
        return float(np.sqrt(np.sum(squares)) / len(self.pairs))


@dataclass(frozen=True, kw_only=True, eq=False)
class ControlFit:
    """Control that the model shows."""

    ties: tuple[_Tie, ...]
    bars: tuple[_Bar, ...]
    lost: Mapping[str, str]
    """Why other control is not used, by name."""
    motion_at: MotionAt | None = None
    """How the model moves with its soft modes; None where it is stiff."""
    sigma_factor: float = 1.0
    """How many times larger sigmas of points are than stated."""

    @property
    def used_points(self) -> tuple[_Tie, ...]:
        """Points that place the model."""
        return tuple(t for t in self.ties if t.use == "control")

    @property
    def used_bars(self) -> tuple[_Bar, ...]:
        """Bars that scale the model."""
        return tuple(b for b in self.bars if b.known.use == "control")

    @property
    def informs_scale(self) -> bool:
        """Whether the scale is seen."""
        return len(self.used_points) > 1 or bool(self.used_bars)

    def equations(self, place: Similarity, middle: Array, sizes: Array) -> Extra:
        """White equations of what is used, for `georeference.fit_navigation`."""
        columns = PARAMETERS + len(sizes)
        misfits, rows = [np.zeros(0)], [np.zeros((0, columns))]
        turn = place.rotation.as_matrix()
        for tie in self.used_points:
            motion = self._motion(tie.picked_point, len(sizes))
            at = place.apply((tie.picked_point.model + motion @ sizes)[None])[0]
            spread = tie.residual(place)[1] + np.diag(tie.sigma**2)
            white = np.linalg.inv(np.linalg.cholesky(spread))
            jacobian = np.zeros((3, columns))
            jacobian[:, :PLACE] = slopes_by_place((at - middle)[None])[0]
            jacobian[:, PARAMETERS:] = place.scale * turn @ motion
            misfits.append(white @ (at - tie.ned))
            rows.append(white @ jacobian)
        for bar in self.used_bars:
            factor, sigma = _log_factor(bar)
            jacobian = np.zeros((1, columns))
            jacobian[0, SCALE] = 1.0 / sigma
            grown = np.zeros(len(sizes))
            for a, b in bar.pairs:
                way = b.model - a.model
                moved = self._motion(b, len(sizes)) - self._motion(a, len(sizes))
                grown += way @ moved / (way @ way) / len(bar.pairs)
            jacobian[0, PARAMETERS:] = grown / sigma
            misfits.append(np.array([(np.log(place.scale) + grown @ sizes - factor) / sigma]))
            rows.append(jacobian)
        return Extra(misfit=np.concatenate(misfits), jacobian=np.concatenate(rows))

    def deform(self, sizes: Array) -> "ControlFit":
        """The same on the model after its soft modes (K,) have been found."""

        def shift(point: TriangulatedPoint) -> TriangulatedPoint:
            return replace(point, model=point.model + self._motion(point, len(sizes)) @ sizes)

        ties = [replace(tie, picked_point=shift(tie.picked_point)) for tie in self.ties]
        bars = [
            replace(bar, pairs=tuple((shift(a), shift(b)) for a, b in bar.pairs))
            for bar in self.bars
        ]
        return replace(self, ties=tuple(ties), bars=tuple(bars), motion_at=None)

    def _motion(self, picked_point: TriangulatedPoint, modes: int) -> Array:
        """(3, K) of a point by the soft modes."""
        if self.motion_at is None:
            return np.zeros((3, modes))
        return np.asarray(self.motion_at(picked_point.model[None])[0])

    def start(self, known_scale: float | None) -> Similarity | None:
        """A first placement from the points alone; None where fewer than three, or on a line."""
        ties = self.used_points
        if len(ties) < 3:
            return None
        model, ned = np.stack([t.picked_point.model for t in ties]), np.stack([t.ned for t in ties])
        return align_points(model, ned, known_scale)

    def misfits(self, place: Similarity) -> Array:
        """(N,) misfits of the used points, in sigmas: root mean square of the three axes."""
        found = []
        for tie in self.used_points:
            miss, spread = tie.residual(place)
            root = np.linalg.cholesky(spread + np.diag(tie.sigma**2))
            found.append(np.linalg.norm(np.linalg.solve(root, miss)) / np.sqrt(3.0))
        return np.array(found)

    def bar_scale(
        self, known_scale: float | None, scale_sigma: float
    ) -> tuple[float, float] | None:
        """Scale from bars (and the known one, weighted) and its relative sigma; None without."""
        factors = [_log_factor(bar) for bar in self.used_bars]
        if not factors:
            return None
        if known_scale is not None:
            factors.append((float(np.log(known_scale)), scale_sigma))
        weights = np.array([sigma**-2 for _, sigma in factors])
        mean = float(weights @ np.array([factor for factor, _ in factors]) / weights.sum())
        return float(np.exp(mean)), float(weights.sum() ** -0.5)

    def score(self, place: Similarity, *, located: bool) -> ControlRecord:
        """What `control.json` says of a placed model.

        Args:
            place: `world_from_model`, metres.
            located: whether the world is the one in which the points are known.
        """
        points = tuple(_score_point(tie, place) for tie in self.ties) if located else ()
        bars = tuple(_score_bar(bar, place.scale) for bar in self.bars)
        return ControlRecord(
            points=points,
            bars=bars,
            not_found=dict(self.lost),
            sigma_factor=self.sigma_factor,
            rms={
                use: _rms_of([p for p in points if p.use == use], [b for b in bars if b.use == use])
                for use in ("control", "check")
            },
        )


def align_points(model: Array, ned: Array, known_scale: float | None) -> Similarity | None:
    """The placement of points (N, 3) of the model on known ones; None where they are on a line."""
    spread = np.linalg.svd(ned - ned.mean(axis=0), compute_uv=False)
    if spread[1] < _MIN_SPREAD * spread[0]:
        return None
    if known_scale is None:
        return align_similarity(model, ned)
    rigid = align_rigid(known_scale * model, ned)
    return Similarity(scale=known_scale, rotation=rigid.rotation, translation=rigid.translation)


def tie_control(
    control: Control,
    picked: Mapping[str, TriangulatedPoint],
    lost: Mapping[str, str],
    datum: Datum | None,
) -> ControlFit:
    """Bring together what is known and what the model shows."""
    missing, ties, bars = dict(lost), [], []
    for point in control.points:
        if point.name not in picked:
            missing.setdefault(point.name, "not picked in any picture")
            continue
        sigma = np.array([point.sigma_m, point.sigma_m, point.sigma_vertical_m])
        tie = _Tie(
            name=point.name, use=point.use, picked_point=picked[point.name],
            ned=point.place_ned(datum), sigma=sigma,
        )  # fmt: skip
        ties.append(tie)
    for length in control.lengths:
        sides = [(f"{length.name}.{k}", f"{length.name}.{(k + 1) % 4}") for k in range(4)]
        names = [length.ends] if length.ends else sides  # of a marker
        absent = sorted({n for pair in names for n in pair} - set(picked))
        if absent:
            missing.setdefault(length.name, f"{', '.join(absent)} not found in the pictures")
            continue
        pairs = tuple((picked[a], picked[b]) for a, b in names)
        bars.append(_Bar(pairs=pairs, known=length))
    return ControlFit(ties=tuple(ties), bars=tuple(bars), lost=missing)


def warn_of_contradictions(score: ControlRecord) -> None:
    """Warn of control that the model contradicts, by what `ControlFit.score` says."""
    for row in (*score.points, *score.bars):
        if row.use == "control" and row.misfit_sigmas > _CONTRADICTED_SIGMAS:
            warn(
                f"control {row.name} is {row.misfit_sigmas:.1f} sigmas off the model: "
                "check its coordinates and picks, or set use to check"
            )


def _log_factor(bar: _Bar) -> tuple[float, float]:
    """Logarithm of the scale that a bar gives, and its sigma."""
    relative = np.hypot(bar.known.sigma_m / bar.known.length_m, bar.sigma_in_model / bar.in_model)
    return float(np.log(bar.known.length_m / bar.in_model)), float(relative)


def _score_point(tie: _Tie, place: Similarity) -> PointRow:
    residual, spread = tie.residual(place)
    sigmas = np.sqrt(np.diag(spread) + tie.sigma**2)
    north, east, down = residual.tolist()
    return PointRow(
        name=tie.name,
        use=tie.use,
        misfit_sigmas=float(np.abs(residual / sigmas).max()),
        views=tie.picked_point.views,
        north_m=north,
        east_m=east,
        down_m=down,
        left_out=tie.picked_point.left_out,
        reprojection_px=tie.picked_point.rms_px,
        sigma_picks_m=float(np.sqrt(np.trace(spread))),
    )


def _score_bar(bar: _Bar, scale: float) -> BarRow:
    length = scale * bar.in_model
    error = length - bar.known.length_m
    sigma = float(np.hypot(bar.known.sigma_m, scale * bar.sigma_in_model))
    return BarRow(
        name=bar.known.name,
        use=bar.known.use,
        misfit_sigmas=abs(error) / sigma,
        known_m=bar.known.length_m,
        error_m=error,
        error_relative=error / bar.known.length_m,
        length_m=length,
        sigma_picks_m=scale * bar.sigma_in_model,
    )


def _rms_of(points: Sequence[PointRow], bars: Sequence[BarRow]) -> ControlRms:
    def rms(values: Sequence[float]) -> float | None:
        return float(np.sqrt(np.mean(np.square(values)))) if len(values) else None

    return ControlRms(
        points=len(points),
        north_m=rms([p.north_m for p in points]),
        east_m=rms([p.east_m for p in points]),
        down_m=rms([p.down_m for p in points]),
        bars=len(bars),
        length_m=rms([b.error_m for b in bars]),
        length_relative=rms([b.error_relative for b in bars]),
    )


_TRIPLE = 3
_MAX_TRIPLES = 500
_INSIDE_SIGMAS, _WRONG_SIGMAS = 2.5, 4.0
"""What takes part in a first spread of the misfits, and what is wrong by the spread of these."""
_CHI_SIGMAS = 3.0
"""A misfit larger than stated sigmas allow, at this significance, makes them larger."""


def without_wrong_points(control: ControlFit, known_scale: float | None) -> ControlFit:
    """Control whose points agree: what most others contradict is left out, after a warning.

    With four points or fewer none can be told to be the wrong one.
    """
    ties = control.used_points
    count = len(ties)
    agreeing = (count + _TRIPLE + 1) // 2
    if count <= agreeing:
        return control
    model, ned = np.stack([t.picked_point.model for t in ties]), np.stack([t.ned for t in ties])
    best = np.full(count, np.inf)
    for triple in _triples(count):
        place = align_points(model[triple], ned[triple], known_scale)
        if place is None:
            continue
        off = control.misfits(place)
        if np.sort(off)[agreeing - 1] < np.sort(best)[agreeing - 1]:
            best = off
    if not np.isfinite(best).all():
        return control
    spread = MAD_TO_SIGMA * (1.0 + 5.0 / (count - _TRIPLE)) * float(np.median(best))
    inside = best <= max(_INSIDE_SIGMAS * max(1.0, spread), np.sort(best)[agreeing - 1])
    place = align_points(model[inside], ned[inside], known_scale)
    if place is None:
        return control
    off = control.misfits(place)
    freedom = 3 * int(inside.sum()) - (7 if known_scale is None else 6)
    spread = np.sqrt(3.0 * float(np.square(off[inside]).sum()) / freedom)
    residuals = np.linalg.norm(place.apply(model) - ned, axis=1)
    wrong = {
        tie.name: float(miss)
        for tie, sigmas, miss in zip(ties, off, residuals, strict=True)
        if sigmas > _WRONG_SIGMAS * max(1.0, spread)
    }
    for name, miss in wrong.items():
        warn(
            f"control point {name} is {miss:.2g} m off where the others place it and is left out: "
            "check its coordinates and picks"
        )
    kept = tuple(
        replace(tie, use="left out") if tie.use == "control" and tie.name in wrong else tie
        for tie in control.ties
    )
    return replace(control, ties=kept)


def _triples(count: int) -> list[list[int]]:
    every = [list(triple) for triple in itertools.combinations(range(count), _TRIPLE)]
    if len(every) <= _MAX_TRIPLES:
        return every
    rng = np.random.default_rng(0)  # any choice will do; the same each time
    return [every[k] for k in rng.choice(len(every), _MAX_TRIPLES, replace=False)]


def real_sigma_factor(control: ControlFit, place: Similarity, parameters: int) -> float:
    """Factor that sigmas of points need for what they miss by, 1 or more.

    What picks are worth shows in the pictures; the rest is the coordinates'.

    Args:
        control: on the model as placed.
        place: that fits it.
        parameters: of the placement that the points themselves may have absorbed.
    """
    freedom = 3 * len(control.used_points) - parameters
    if freedom < 1:
        return 1.0

    def excess(log_factor: float) -> float:
        coarser = widen(control, float(np.exp(log_factor)))
        return 3.0 * float(np.square(coarser.misfits(place)).sum()) / freedom - 1.0

    from scipy.optimize import brentq

    ratio = 1.0 + excess(0.0)
    if ratio <= 1.0 + _CHI_SIGMAS * np.sqrt(2.0 / freedom):
        return 1.0
    maximum = np.log(ratio)
    while excess(maximum) > 0:
        maximum *= 2.0
    return float(np.exp(brentq(excess, 0.0, maximum)))


def widen(control: ControlFit, factor: float) -> ControlFit:
    """The same with sigmas of its points that are larger by a factor."""
    ties = tuple(
        replace(tie, sigma=factor * tie.sigma) if tie.use == "control" else tie
        for tie in control.ties
    )
    return replace(control, ties=ties, sigma_factor=factor * control.sigma_factor)


def warn_of_coarse(control: ControlFit) -> None:
    """Say what sigma points count with, where that is not the stated one."""
    if control.sigma_factor > 1.0:
        used = control.used_points
        real = float(np.median([tie.sigma for tie in used]))
        warn(
            f"{len(used)} control points miss by more than their sigmas and picks allow: they "
            f"count with a sigma of {real:.2g} m, not {real / control.sigma_factor:.2g} m"
        )
