"""The fit of a model's place to navigation and control, and what it shows of both.

The place, nuisances of navigation and sizes of the model's soft modes are found together, from a
robust first placement on; then what contradicts itself is named and counts as that unsure.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.errors import ReconstructionError, warn
from alice_survey.core.frames import Array, Datum, pose_to_json
from alice_survey.core.manifest import ImageRecord
from alice_survey.core.records import BendRecord, GeoreferenceRecord, MountRecord, NuisanceRecord
from camera_calib.mount import nearest_mount
from reconstruct.placing.alignment import MIN_STATIONS, Similarity, bend_modes, bend_of, quadratic
from reconstruct.placing.correlated_fit import (
    Correlation,
    Estimate,
    Extra,
    estimate,
    frame_sigma,
    without_gross_errors,
)
from reconstruct.placing.navigation import (
    CLOCK,
    DRIFT,
    GROUPS,
    LEVER,
    MOUNT,
    PARAMETERS,
    PLACE,
    SCALE,
    STRETCH,
    TURN,
    USUAL_INSTALLATION,
    Epochs,
    Installation,
    equations,
    first_placement,
    observable,
    read_epochs,
    scatter_of_times,
    with_times_unsure,
)

_ORDER = (
    "rotation_north_rad", "rotation_east_rad", "rotation_down_rad", "north_m", "east_m", "down_m",
    "log_scale",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundMount:
    """How the rig is mounted on the vehicle, found with the place."""

    body_from_rig: RigidTransform
    turn_sigma_deg: Array
    """(3,) about the vehicle's axes forward, right, down."""
    lever_sigma_m: Array
    """(3,) forward, right, down."""

    @property
    def record(self) -> MountRecord:
        """What `georeference.json` says."""
        arm = zip(self.body_from_rig.translation, self.lever_sigma_m, strict=True)
        forward, right, down = (f"{value:+.2f} (sigma {sigma:.2g})" for value, sigma in arm)
        return MountRecord(
            words=f"mount found: {nearest_mount(self.body_from_rig.rotation)}, sigma "
            f"{self.turn_sigma_deg.max():.2g} deg; pupil {forward} m forward, {right} m right, "
            f"{down} m down",
            body_from_rig=pose_to_json(self.body_from_rig),
            turn_sigma_deg=tuple(self.turn_sigma_deg.tolist()),
            lever_sigma_m=tuple(self.lever_sigma_m.tolist()),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacementFit:
    """A model placed by navigation, and how well."""

    ned_from_model: Similarity
    middle_ned: Array
    """(3,) middle of the camera track, about which the covariance's rotation and scale act."""
    correlation: Mapping[str, Correlation]
    """For each group, how navigation's errors are correlated."""
    modes: Array
    """(K,) sizes of the model's soft modes, in their sigmas."""
    joint: Array
    """(7 + K, 7 + K) covariance of the placement (as `covariance`) and the modes."""
    bends: tuple[BendRecord, ...]
    """How bent the model is still, along the block and, where it is wide, across; none where
    stations are too few."""
    stated: GeoreferenceRecord
    """What `georeference.json` says but for the covariance and the mount."""
    mount: FoundMount | None = None
    """The mount, where it was not known."""

    @property
    def covariance(self) -> Array:
        """(7, 7) of the placement.

        Rotation about north, east, down (rad), shift north, east, down of the middle (m), and the
        logarithm of the scale.
        """
        return self.joint[:PLACE, :PLACE]

    @property
    def sigma_position_m(self) -> Array:
        """(3,) sigma of the middle of the track, north, east and down."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[3:6]))

    @property
    def sigma_heading_deg(self) -> float:
        """Sigma of rotation about down."""
        return float(np.rad2deg(np.sqrt(self.covariance[2, 2])))

    @property
    def sigma_scale(self) -> float:
        """Sigma of the logarithm of the scale, 0 where it is held."""
        return float(np.sqrt(self.covariance[SCALE, SCALE]))

    @cached_property
    def record(self) -> GeoreferenceRecord:
        """What `georeference.json` says."""
        tilts, axes = np.linalg.eigh(self.covariance[:2, :2])
        # What is the model's own by choice has no sigma.
        north, east, down = (sigma or None for sigma in self.sigma_position_m.tolist())
        found = {
            "sigma_north_m": north,
            "sigma_east_m": east,
            "sigma_depth_m": down,
            "sigma_heading_deg": self.sigma_heading_deg or None,
            "sigma_tilt_deg": float(np.rad2deg(np.sqrt(tilts.mean()))) or None,
            "sigma_scale": self.sigma_scale,
            "mount": None if self.mount is None else self.mount.record,
            "largest_tilt_deg": float(np.rad2deg(np.sqrt(tilts[1]))),
            "largest_tilt_axis_deg": float(np.rad2deg(np.arctan2(axes[1, 1], axes[0, 1])) % 180.0),
            "covariance": tuple(map(tuple, self.covariance.tolist())),
        }
        return self.stated.model_copy(update=found)


_LEVEL_SIGMA_DEG = 10.0
"""How far from level the sea floor's mean plane may be, where no attitude was measured."""
_ROBUST_STEPS = 30
_ROBUST_SIGMAS = 2.0
"""Sigmas beyond which the first placement lets a misfit pull only in proportion."""
_STEPS = 8
_SETTLED_SIGMAS = 0.01
_MIN_BOUND = 1e-9
SHRUNK = 1e-6
"""Share of its first scale below which a model has shrunk to a point."""
_SIGNIFICANT = 3.0
"""Sigmas of its own by which a sum of squares must be too large to count as such."""
_CONTRADICTION_SIGMAS = 3.0
"""A nuisance this far from what is expected of it is reported."""
_DRIFT_SIGMAS = 0.3
"""Drift of depths that is likely over a survey (slope of their errors by time, times its length),
over their stated sigma: 24 simulated flights of Caesarea of 25 minutes, with the usual pressure
sensor and filter, drift by 0.34 rms and by 0.72 at most, less than the 0.9 that is named."""
_VAGUE_DRIFT_SIGMAS = 100.0
_VAGUE_PER_M = 10.0
"""Curvature that any model has less of by far."""
_STRETCH = 0.005
"""Stretch of positions integrated from a Doppler log: makers and users say 0.1 to 1 % (as in
`vehicle.navigation.sensors`)."""
LEVERS = ("lever_forward_m", "lever_right_m", "lever_down_m")
MOUNTS = ("mount_forward_deg", "mount_right_deg", "mount_down_deg")
_NUISANCES = {
    "turn_deg": (TURN, float(np.rad2deg(1.0))),
    "stretch": (STRETCH, 1.0),
    **{name: (LEVER.start + k, 1.0) for k, name in enumerate(LEVERS)},
    "clock_s": (CLOCK, 1.0),
    "depth_drift_m": (DRIFT, 1.0),
    **{name: (MOUNT.start + k, float(np.rad2deg(1.0))) for k, name in enumerate(MOUNTS)},
}


ExtraOf = Callable[[Similarity, Array, Array], Extra]
"""Equations in addition to navigation's at a placement, whose rotation acts about a point (3,), and
with soft modes of sizes (K,)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _FitGuess:
    """A placement on the way to the best."""

    place: Similarity
    sizes: Array
    """(K,) of the soft modes, in their sigmas."""
    free: Sequence[int] = ()
    """Parameters to solve for."""
    bounds: Mapping[int, float] = field(default_factory=dict)
    """Of navigation's frame (see `estimate`)."""
    widened: Mapping[str, float] = field(default_factory=dict)
    """Groups whose stated sigmas are too small, and by what factor."""
    factor: float = 1.0
    """How many times larger modes are than pictures say."""
    drift_m: float = 0.0
    """Drift of depths that is free, as a sigma; 0 where it is held."""


@dataclass(frozen=True, kw_only=True, eq=False)
class NavigationTask:
    """What a model's place is fitted to; arguments as of `fit_navigation`."""

    epochs: Epochs
    levelled: Similarity | None
    """The levelled model; None where control holds the model level."""
    known_scale: float | None
    scale_sigma: float
    control: ExtraOf | None
    joints: int
    installed: Installation = USUAL_INSTALLATION

    def fit(self, place: Similarity, free: list[int]) -> PlacementFit:
        """Iterate from a robust placement to the final one.

        Raises:
            ReconstructionError: the model shrinks to a point on the way, or grows without bound.
        """
        start, epochs = place, self.epochs
        found = equations(epochs, place, self._middle(place))
        used = without_gross_errors(epochs.time, found.misfit, epochs.known)
        count, bounds = epochs.modes.shape[2], self._frame_bounds()
        modes, soft = range(PARAMETERS, PARAMETERS + count), count - self.joints
        solved_for = [*free, *(p for p, bound in bounds.items() if bound > _MIN_BOUND), *modes]
        if epochs.has_attitude:
            solved_for += range(LEVER.start, LEVER.stop)
            if self.installed.mount_rad > 0:
                solved_for += range(MOUNT.start, MOUNT.stop)
        if epochs.timed and len(epochs.time) > 1:
            solved_for.append(CLOCK)
        settling = [*free, *modes]
        at = _FitGuess(place=place, sizes=np.zeros(count), free=solved_for, bounds=bounds)
        for _ in range(_STEPS):
            got = self._estimate(at, used)
            place = _move(at.place, _without_overshoot(got.change), self._middle(at.place))
            if not SHRUNK < place.scale / start.scale < 1.0 / SHRUNK:
                raise ReconstructionError("positions of navigation show no scale of the model")
            sizes = at.sizes + got.change[PARAMETERS:]
            sigma = np.sqrt(np.diag(got.covariance))
            factor = _mode_factor(sizes[:soft], sigma[PARAMETERS:][:soft], at.factor)
            still = np.abs(got.change[settling]) <= _SETTLED_SIGMAS * sigma[settling]
            settled = still.all() and abs(factor - at.factor) <= _SETTLED_SIGMAS * factor
            at = replace(at, place=place, sizes=sizes, factor=factor)
            if settled:
                if at.widened:
                    break
                at = self._widen(at, got)
                if not at.widened:
                    break
        scaled = got
        if SCALE not in free:
            stiff = [*(p for p in at.free if p not in modes[:soft]), SCALE]
            scaled = self._estimate(replace(at, free=stiff), got.used, got.correlation)
        return self._report(at, got, scaled)

    def _estimate(
        self,
        at: _FitGuess,
        used: NDArray[np.bool_],
        correlation: Mapping[str, Correlation] | None = None,
    ) -> Estimate:
        """Solve the equations of navigation, and of all else, about a guess."""
        found = equations(self.epochs.deform(at.sizes), at.place, self._middle(at.place))
        return estimate(
            self.epochs.time, found, used, at.free, self._extra(at), frame_bounds=at.bounds,
            widened=at.widened, correlation=correlation,
        )  # fmt: skip

    def _report(self, at: _FitGuess, got: Estimate, scaled: Estimate) -> PlacementFit:
        epochs = self.epochs.deform(at.sizes)
        kept = got.used[epochs.moment, :3].any(axis=1)
        residuals = (epochs.positions(at.place) - epochs.measured_ned)[kept]
        residuals = np.where(got.used[epochs.moment, :3][kept], residuals, np.nan)
        lost = epochs.known & ~got.used
        first = {group: k for k, group in zip((0, 2, 3, 5), GROUPS, strict=True)}
        joint = [*range(PLACE), *range(PARAMETERS, len(got.change))]
        sigmas = np.sqrt(np.diag(got.covariance))
        named = {
            name: NuisanceRecord(
                value=float(unit * got.change[column]), sigma=float(unit * sigmas[column])
            )
            for name, (column, unit) in _NUISANCES.items()
            if column in at.free
        }
        self._warn_of_installation(named)
        for group, how in got.correlation.items():
            if how.restart > 1.0:
                off = how.restart * how.factor * np.sqrt(how.constant)
                warn(
                    f"dives disagree on {group}, by {off:.0f} times the stated sigmas: the place "
                    "is as unsure as that; correct the log of one, or add control points"
                )
        middle = self._middle(at.place)
        north, east, depth = (None if np.isnan(v) else v for v in _rms(residuals).tolist())
        unit = "s" if epochs.timed else "stations"
        stated = GeoreferenceRecord(
            # With a position (without any, with a depth) that took part.
            stations=int((got.used[:, 0] if got.used[:, 0].any() else got.used[:, 2]).sum()),
            left_out={group: int(lost[:, k].sum()) for group, k in first.items()},
            rms_north_m=north,
            rms_east_m=east,
            rms_depth_m=depth,
            # That a similarity would choose: 1 where navigation agrees with the known scale.
            scale_of_navigation=1.0 if scaled is got else float(np.exp(scaled.change[SCALE])),
            scale_of_navigation_sigma=float(np.sqrt(scaled.covariance[SCALE, SCALE])),
            nuisances=named,
            soft_modes=tuple(at.sizes.tolist()),
            soft_modes_factor=at.factor,
            middle_ned_m=tuple(middle.tolist()),
            covariance_order=_ORDER,
            errors={
                group: {
                    f"correlation_{unit}": how.tau,
                    "white_share": how.white,
                    "constant_share": how.constant,
                    "sigma_factor": how.factor,
                    "dive_constants": how.restart,
                }
                for group, how in got.correlation.items()
            },
        )
        return PlacementFit(
            ned_from_model=at.place,
            middle_ned=middle,
            correlation=got.correlation,
            modes=at.sizes,
            joint=got.covariance[np.ix_(joint, joint)],
            bends=self._bends(at, got),
            stated=stated,
        )

    def _warn_of_installation(self, found: Mapping[str, NuisanceRecord]) -> None:
        """Name what is off by more than is likely, and what may be off in its place."""
        levers = dict.fromkeys(LEVERS, ("lever_sigma_m", self.installed.lever_m))
        stated = {**levers, "clock_s": ("clock_sigma_s", self.installed.clock_s)}
        off = {n: abs(found[n].value) / sigma for n, (_, sigma) in stated.items() if n in found}
        if max(off.values(), default=0.0) > _CONTRADICTION_SIGMAS:
            likely = ", ".join(
                f"{n} = {found[n].value:+.3g} ({stated[n][0]} = {stated[n][1]:g})"
                for n in sorted(off, key=off.__getitem__, reverse=True)
                if off[n] > 1.0
            )
            warn(
                f"navigation fits the pictures with {likely}: correct the log or the rig's mount, "
                "or state a larger sigma, for the place is as unsure as that"
            )

    def _bends(self, at: _FitGuess, got: Estimate) -> tuple[BendRecord, ...]:
        """How bent the placed model is by navigation alone, whatever its modes allow."""
        epochs, place = self.epochs.deform(at.sizes), at.place
        if got.used[:, 2].sum() < MIN_STATIONS:
            return ()
        places = place.apply(epochs.centres)
        modes = _VAGUE_PER_M * bend_modes(places, place)
        count = modes.shape[2]
        modes = np.concatenate([modes, epochs.modes[..., len(at.sizes) - self.joints :]], axis=2)
        bending = replace(self, control=None, epochs=replace(epochs, modes=modes))
        own = range(PARAMETERS, PARAMETERS + modes.shape[2])
        stiff = _FitGuess(
            place=place, sizes=np.zeros(len(own)), bounds=at.bounds,
            free=[*(p for p in at.free if p < PARAMETERS), *own],
        )  # fmt: skip
        bent = bending._estimate(stiff, got.used, got.correlation)
        values = _VAGUE_PER_M * bent.change[PARAMETERS:]
        sigmas = _VAGUE_PER_M * np.sqrt(np.diag(bent.covariance)[PARAMETERS:])
        design, lengths, _ = quadratic(places[:, :2])
        moved = place.scale * place.rotation.apply((self.epochs.modes @ at.sizes)[:, :3])[:, 2]
        straightened = np.linalg.lstsq(design, moved, rcond=None)[0][2::2]
        return tuple(
            bend_of(*map(float, (values[k], sigmas[k], lengths[k], straightened[k])))
            for k in range(min(count, 2))
        )

    def _drift(self, at: _FitGuess, got: Estimate) -> float:
        """Drift of depths over the survey, metres, if it is more than is likely, else 0.

        Only a known tilt tells it from one of the model.
        """
        epochs = self.epochs
        if not (epochs.timed and epochs.has_tilt and got.used[:, 2].sum() >= MIN_STATIONS):
            return 0.0
        usual = self._usual_sigma(2)
        vague = replace(at, drift_m=_VAGUE_DRIFT_SIGMAS * usual, free=[*at.free, DRIFT])
        found = self._estimate(vague, got.used)
        drift_m = float(found.change[DRIFT])
        likely = np.hypot(_DRIFT_SIGMAS * usual, np.sqrt(found.covariance[DRIFT, DRIFT]))
        return drift_m if abs(drift_m) > _CONTRADICTION_SIGMAS * likely else 0.0

    def _usual_sigma(self, channel: int) -> float:
        return float(np.median(self.epochs.sigma[self.epochs.known[:, channel], channel]))

    def _widen(self, at: _FitGuess, got: Estimate) -> _FitGuess:
        """Name what navigation says of itself in two ways, and make both as unsure as they differ.

        That is its turn of positions against headings, and a drift of depths against attitudes.
        """
        widened, free, bounds = {}, at.free, dict(at.bounds)
        turn, correlation, drift_m = got.change[TURN], got.correlation, self._drift(at, got)
        if drift_m:
            free = [*free, DRIFT]
            usual = self._usual_sigma(2)
            warn(
                f"depths of the navigation drift by {drift_m:+.2g} m against its attitudes and the "
                f"pictures, where {_DRIFT_SIGMAS * usual:.2g} m is likely: depth counts as that "
                "unsure; check the pressure sensor's zero and the tide"
            )
            # Its level may have been right at any time of the survey.
            widened["depth"] = float(np.hypot(1.0, 0.5 * drift_m / usual))
        if {"horizontal", "heading"} <= set(correlation) and bounds.get(TURN, 0.0) > 0:
            expected = frame_sigma(bounds[TURN], self.epochs.time, correlation["horizontal"])
            if abs(turn) > _CONTRADICTION_SIGMAS * expected:
                stated = self._usual_sigma(5)
                # Each takes its share of what they differ by.
                differ = abs(turn) * (1.0 + (stated / expected) ** 2)
                warn(
                    "headings of the navigation and its positions disagree by "
                    f"{np.rad2deg(differ):.2g} deg where "
                    f"{np.rad2deg(np.hypot(expected, stated)):.2g} deg is likely: both count as "
                    "that unsure; check the compass and the camera's mount (body_from_rig)"
                )
                widened["heading"] = max(differ / stated, 1.0)
                bounds[TURN] *= differ / expected
        return replace(at, widened=widened, free=free, bounds=bounds, drift_m=drift_m)

    def _middle(self, place: Similarity) -> Array:
        return np.asarray(place.apply(self.epochs.centres).mean(axis=0))

    def _frame_bounds(self) -> dict[int, float]:
        """How navigation's own frame may be turned and stretched within its positions' sigmas.

        Positions by dead reckoning on a wrong heading are turned as a whole by its error; to
        take their turn for a second, independent reading of the heading would count one error
        twice as if it were two. In the same way a log's velocities are all wrong by one factor.
        """
        if not (self.epochs.known[:, 5].any() and self.epochs.has_horizontal):
            return {}
        plan = self.epochs.measured_ned[self.epochs.known[self.epochs.moment, 0], :2]
        radius = float(np.sqrt(plan.var(axis=0).sum()))
        sigma = float(np.median(self.epochs.sigma[:, 0]))
        bound = sigma / radius if radius > sigma else 1.0
        return {TURN: bound, STRETCH: min(bound, _STRETCH)}

    def _extra(self, at: _FitGuess) -> Extra:
        place, sizes = at.place, at.sizes
        columns = PARAMETERS + len(sizes)
        misfits, rows = [np.zeros(0)], [np.zeros((0, columns))]
        if self.levelled is not None and not self.epochs.has_tilt:
            down = place.rotation.apply(self.levelled.rotation.inv().apply([0.0, 0.0, 1.0]))
            sigma = np.deg2rad(_LEVEL_SIGMA_DEG)
            tilt = np.zeros((2, columns))
            tilt[0, 1], tilt[0, 2] = down[2], -down[1]
            tilt[1, 0], tilt[1, 2] = -down[2], down[0]
            misfits.append(down[:2] / sigma)
            rows.append(tilt / sigma)
        if self.known_scale is not None and self.scale_sigma > 0:
            scale = np.zeros((1, columns))
            scale[0, SCALE] = 1.0 / self.scale_sigma
            misfits.append(np.log([place.scale / self.known_scale]) / self.scale_sigma)
            rows.append(scale)
        known = self.installed.weights(columns)
        if at.drift_m:
            known[DRIFT] = 1.0 / abs(at.drift_m)
        known[PARAMETERS : columns - self.joints] = 1.0 / at.factor
        stated = np.flatnonzero(known)
        misfits.append((known * np.concatenate([np.zeros(columns - len(sizes)), sizes]))[stated])
        rows.append(np.diag(known)[stated])
        if self.control is not None:
            more = self.control(place, self._middle(place), sizes)
            misfits.append(more.misfit)
            rows.append(more.jacobian)
        return Extra(misfit=np.concatenate(misfits), jacobian=np.concatenate(rows))

    def robust(self, start: Similarity, free: list[int]) -> Similarity:
        """A placement robust to a few wrong readings: readings as independent, soft L1.

        It ends early where the model shrinks to a point.
        """
        place = start
        for _ in range(_ROBUST_STEPS):
            middle = self._middle(place)
            found = equations(self.epochs, place, middle)
            extra = self._extra(_FitGuess(place=place, sizes=np.zeros(self.epochs.modes.shape[2])))
            known = self.epochs.known
            misfit = np.concatenate([found.misfit[known], extra.misfit])
            rows_of = np.concatenate([found.jacobian[known], extra.jacobian])
            rows = rows_of[:, free]
            weight = (1.0 + (misfit / _ROBUST_SIGMAS) ** 2) ** -0.25
            size = np.linalg.norm(rows, axis=0)
            size = np.where(size > 0, size, 1.0)
            step = -np.linalg.lstsq(weight[:, None] * rows / size, weight * misfit)[0] / size
            change = np.zeros(rows_of.shape[1])
            change[free] = step
            place = _move(place, _without_overshoot(change), middle)
            if np.all(np.abs(step) * size < 1e-6) or place.scale < SHRUNK * start.scale:
                break
        return place


def _without_overshoot(change: Array) -> Array:
    """A change (P,) whose scale grows by 1 + step, as a scale alone is solved, and not by exp."""
    grown = change.copy()
    if grown[SCALE] > 0:
        grown[SCALE] = np.log1p(grown[SCALE])
    return grown


def _move(place: Similarity, change: Array, middle: Array) -> Similarity:
    """A placement after a small change of its first seven parameters about a point."""
    turn, grow = Rotation.from_rotvec(change[:3]), float(np.exp(change[SCALE]))
    shift = middle + grow * turn.apply(place.translation - middle) + change[3:6]
    return Similarity(scale=place.scale * grow, rotation=turn * place.rotation, translation=shift)


def _mode_factor(sizes: Array, sigmas: Array, factor: float) -> float:
    """How many times larger the model's soft modes are than its pictures say, 1 or more.

    Keypoints err a little together, in ways that residuals do not show and that only the softest
    deformations add up. The evidence for the variance of the modes that outside measurements
    determine: their squares over the number so determined (MacKay 1992, "Bayesian interpolation").

    Args:
        sizes: (K,) of the modes, in the sigmas that the pictures give.
        sigmas: (K,) after the fit.
        factor: what was taken so far.
    """
    determined = float((1.0 - (sigmas / factor) ** 2).sum())
    if determined < 1.0:
        return factor
    ratio = float(sizes @ sizes) / determined
    if factor == 1.0 and ratio < 1.0 + _SIGNIFICANT * np.sqrt(2.0 / determined):
        return 1.0
    return max(1.0, float(np.sqrt(ratio)))


def _rms(residuals: Array) -> Array:
    """(3,) root mean squares of (N, 3) that may be NaN; NaN where all are."""
    known = np.isfinite(residuals)
    total = np.where(known, residuals, 0.0) ** 2
    counts = known.sum(axis=0)
    return np.sqrt(np.where(counts > 0, total.sum(axis=0) / np.maximum(counts, 1), np.nan))


_ROUGH_SCALE, _VAGUE_SCALE = 0.03, 0.15
"""Relative sigmas of a scale by positions: from the first it is worth a warning; beyond the second
it is none: of vaguer ones those that are too large would pass."""


def fit_navigation(
    records: Sequence[ImageRecord],
    model_from_cam: Sequence[RigidTransform],
    body_from_cam: Mapping[str, RigidTransform] | None,
    datum: Datum | None,
    levelled: Similarity,
    *,
    known_scale: float | None,
    installed: Installation = USUAL_INSTALLATION,
    scale_sigma: float = 0.0,
    control: ExtraOf | None = None,
    modes: Array | None = None,
    joints: int = 0,
) -> PlacementFit | None:
    """Fit a model to the positions and attitudes of navigation.

    Args:
        records: registered pictures.
        model_from_cam: pose of each picture's camera in the model.
        body_from_cam: mount of every camera, metres; None where it is unknown: positions are those
            of the cameras, and attitudes, which are the vehicle's, are not used.
        datum: origin of the local frame; None where no latitude and longitude are known: the model
            keeps the origin of `levelled`, its heading too where none is known.
        levelled: `level` of the model; where no attitude is known it keeps the model from turning
            about a straight track, with a sigma of 10 degrees.
        known_scale: metres in a unit of the model, or None: then the scale is fitted too.
        installed: how well it is known where the cameras are on the vehicle, and their clock.
        scale_sigma: relative, of a known scale; above 0 the scale is fitted about it.
        control: equations of control points and bars.
        modes: (N, 6, K) of the pictures by the model's soft modes; None where it is stiff.
        joints: how many of them, the last, are motions of groups of which pictures know nothing.

    Returns:
        The fit; None, after a warning, where positions are too few or too close together, or have
        no scale in common with the model.
    """
    epochs = read_epochs(records, model_from_cam, body_from_cam, datum, modes)
    if not epochs.known.any() or (datum is not None and not epochs.has_horizontal):
        return None
    start = first_placement(epochs, levelled, known_scale)
    if start is None:
        return None
    free = observable(epochs)
    if known_scale is None or scale_sigma > 0:
        free.append(SCALE)
    task = NavigationTask(
        epochs=epochs,
        levelled=levelled,
        known_scale=known_scale,
        scale_sigma=scale_sigma,
        installed=installed,
        control=control,
        joints=joints,
    )
    near, fit = task.robust(start, free), None
    scatter_s, scatter_sigma_s = scatter_of_times(epochs, near, installed.clock_s)
    if scatter_s:
        warn(
            f"times of the pictures scatter by {scatter_s:.2g} s against navigation's "
            f"(clock_sigma_s = {installed.clock_s:g}): what changes fast counts as that unsure; "
            "import with the times of the trigger, or state a larger clock_sigma_s"
        )
        task = replace(task, epochs=with_times_unsure(epochs, near, scatter_s))
    if near.scale >= SHRUNK * start.scale:
        with suppress(ReconstructionError):
            fit = task.fit(near, free)
    if fit is None:
        warn(
            "positions of navigation and model have no scale in common: it stays without CRS; are "
            "they of these pictures?"
        )
        return None
    if scatter_s:
        scatter = NuisanceRecord(value=scatter_s, sigma=scatter_sigma_s)
        named = {**fit.stated.nuisances, "time_scatter_s": scatter}
        fit = replace(fit, stated=fit.stated.model_copy(update={"nuisances": named}))
    return fit if known_scale is not None or control is not None else _with_rough_scale(fit)


def _with_rough_scale(fit: PlacementFit) -> PlacementFit | None:
    """The fit with a sigma of its scale that holds where positions hardly show the scale.

    Errors of the scale itself are normal, those of its logarithm not: three sigmas s below a scale
    are -ln(1 - 3 s) away. None, after a warning, where the scale might as well be zero.
    """
    sigma = fit.sigma_scale
    if sigma < _ROUGH_SCALE:
        return fit
    if sigma > _VAGUE_SCALE:
        warn(
            f"positions of navigation show the scale to {sigma:.0%} only: the model stays without "
            "CRS; measure a known length with 'alice-survey control'"
        )
        return None
    honest = -float(np.log1p(-3.0 * sigma)) / 3.0
    warn(
        f"positions spread little for their errors: the scale is rough, sigma {honest:.0%}; "
        "measure a known length with 'alice-survey control'"
    )
    grown = np.ones(len(fit.joint))
    grown[SCALE] = honest / sigma
    return replace(fit, joint=fit.joint * np.outer(grown, grown))


def fit_control(
    records: Sequence[ImageRecord],
    model_from_cam: Sequence[RigidTransform],
    start: Similarity,
    control: ExtraOf,
    *,
    known_scale: float | None,
    scale_sigma: float,
    modes: Array | None = None,
    joints: int = 0,
) -> PlacementFit:
    """Place a model by control points alone.

    Args:
        records: registered pictures.
        model_from_cam: pose of each picture's camera in the model.
        start: a placement near the right one.
        control: equations of three or more points that are not on one line.
        known_scale: metres in a unit of the model, or None: then the scale is fitted too.
        scale_sigma: relative, of a known scale.
        modes: as in `fit_navigation`.
        joints: as there.
    """
    free = [0, 1, 2, 3, 4, 5]
    if known_scale is None or scale_sigma > 0:
        free.append(SCALE)
    task = NavigationTask(
        epochs=read_epochs(records, model_from_cam, None, None, modes, measured=False),
        levelled=None,
        known_scale=known_scale,
        scale_sigma=scale_sigma,
        control=control,
        joints=joints,
    )
    return task.fit(task.robust(start, free), free)
