"""Joint least-squares adjustment of cameras, ports, rig, target poses and the target's shape.

Poses of the target are eliminated view by view, so that each step solves for the rig's parameters
alone; slopes are analytic. The loss is Huber's on the length of a residual, its scale taken from
the residuals' median: 99.8 % efficient for normal noise, and no outlier pulls more than a point at
three sigmas (`alice_survey.core.block_solver` takes the steps).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.block_solver import (
    RAYLEIGH_MEDIAN,
    BlockStep,
    Equations,
    Flags,
    Minimum,
    minimise,
)
from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array
from camera_calib.calibrate.normal_equations import CalibrationProblem, State
from camera_calib.calibration import TargetView, stack_views
from camera_calib.freedom import Freedom, at_bound
from camera_calib.rig import Covariance, Rig
from camera_calib.target_shape import AS_DRAWN, TargetShape

HUBER = 3.0
"""Length, in sigmas of a coordinate, beyond which a residual's influence is constant."""
_MIN_NOISE_PX = 1e-6
"""Smallest noise: below it the rounding of projections shows."""
_STEPS = 1000
"""A guard: an adjustment ends by its own test, most in ten steps."""
_AS_PREDICTED = 0.25
"""Share of its gain that a step drops the cost by if it is not much too long; one half is exact."""
_USELESS = 0.05
"""Such a share below which a step is not taken."""
_SETTLED = 1e-4
_DAMPING = 1e-3
"""Of the first step."""
_MIN_DAMPING = 1e-13
"""Parameters of a rig can be so similar that more damping than this hides their difference."""
_POSE_DAMPING = 1e-6
"""Least damping of poses, whose parameters are never so similar."""


class UnsettledError(CalibrationError):
    """An adjustment ended at its guard, which says nothing about its model."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Adjustment:
    """The most likely rig and poses, with the residuals."""

    rig: Rig
    """The rig with the covariance of its adjusted parameters; the target's poses and shape are
    marginalised."""
    shape: TargetShape
    """The target's shape with its covariance."""
    covariance: Covariance
    """Covariance of rig and shape together."""
    rig_from_target: RigidTransform
    """(V,)."""
    residuals_px: Array
    """(V, cameras, N, 2) projected minus measured; NaN where unseen."""
    weights: Array
    """(V, cameras, N) robust weights in (0, 1]; NaN where unseen."""
    noise_px: float
    """Standard deviation of one coordinate of a measured point, over all pictures."""
    blur: Array
    """(V, cameras) noise of each picture over that."""
    is_settled: bool
    """Whether an undamped step would be as short as requested."""


def adjust(
    views: Sequence[TargetView],
    points: Array,
    start: Rig,
    rig_from_target: RigidTransform,
    freedom: Freedom,
    settled: float = _SETTLED,
    *,
    at_most: int | None = None,
    blur: Array | None = None,
    shape: TargetShape = AS_DRAWN,
) -> Adjustment:
    """Adjust a rig and all poses of the target together.

    Args:
        views: what the cameras saw.
        points: (N, 3) the target's points as drawn, in its own frame, metres.
        start: a rig near the truth; what is not adjusted is taken from it.
        rig_from_target: (V,) poses near the truth.
        freedom: what of the rig is adjusted.
        settled: length of a step, in sigmas, at which the adjustment ends.
        at_most: it may also end, not settled, after this many steps: views that do not fit at all
            creep for long, and can be left out once the others fit.
        blur: (V, cameras) noise of each picture over that of all; None if all are equal.
        shape: how the target may differ from its drawing, with first values.

    Raises:
        CalibrationError: there are fewer measurements than unknowns, the views do not determine
            a parameter, or the adjustment does not settle though it must.
    """
    problem = _Solver(stack_views(views, start, len(points)), points, start, freedom, shape)
    if blur is not None:
        problem.blur = blur[..., None]
    return problem.solve(problem.state(start, rig_from_target), settled, at_most)


@dataclass(frozen=True, kw_only=True, eq=False)
class _TargetGuess:
    """One guess of all unknowns, with how it explains the pixels."""

    state: State
    residuals: Array
    """(V, C, N, 2)."""
    lengths: Array
    """(V, C, N) of the residuals over the blur of their pictures."""


class _Solver(CalibrationProblem):
    """Minimisation of the robust loss."""

    blur: Array = np.ones((1, 1, 1))
    """(V, C, 1) noise of each picture over `noise_px`."""
    scales: tuple[float, ...] = ()
    """The last two of the loss."""

    def seen_from(self, state: State) -> _TargetGuess:
        """A guess with its residuals."""
        residuals = self.residuals(state)
        lengths = np.sqrt(np.einsum("vcni,vcni->vcn", residuals, residuals)) / self.blur
        return _TargetGuess(state=state, residuals=residuals, lengths=lengths)

    def cost(self, guess: _TargetGuess, noise: Array) -> float:
        """Half the robust sum of squares in sigmas; inf where a seen point is not projected."""
        length = guess.lengths[self.seen] / noise
        if not np.all(np.isfinite(length)):
            return math.inf
        loss = np.where(length <= HUBER, 0.5 * length**2, HUBER * (length - 0.5 * HUBER))
        off = self.prior_residuals(guess.state)
        return float(loss.sum() + 0.5 * off @ self.prior_information @ off)

    def linearise(self, guess: _TargetGuess, noise: Array) -> Equations:
        """Normal equations with Huber's weights."""
        self.scales = (*self.scales[-1:], float(noise[0]))
        weights = self.weights(guess, noise)
        return self.equations(guess.state, weights / (noise * self.blur) ** 2)

    def move(self, guess: _TargetGuess, equations: Equations, step: BlockStep) -> _TargetGuess:
        """The guess after a step, which is shortened where the curvature it left out is large.

        Gauss and Newton's step along which the cost bends h times more than its equations say ends
        h times too far: for h near 2 it jumps to and fro for ever, about as near to the end as
        before. The least point of the parabola through slope and drop has no such factor.

        Raises:
            CalibrationError: the cost bends so much along the step that it needs more damping.
        """
        noise, shared, poses = np.array(self.scales[-1:]), step.shared, step.poses
        before, share = self.cost(guess, noise), 1.0
        for _ in range(2):
            part = replace(step, poses=share * poses, shared=share * shared)
            tried = self.seen_from(self.take_step(guess.state, part))
            drop = before - self.cost(tried, noise)
            if drop > _AS_PREDICTED * step.gain:
                return tried
            share = 0.5 * step.gain / (step.gain - drop)
        if drop < _USELESS * step.gain:
            raise CalibrationError(f"the step drops the cost by {drop:.2g} of {step.gain:.2g}")
        return tried

    def at_bound(self, guess: _TargetGuess) -> Flags:
        """Parameters that have their least value."""
        return at_bound(guess.state.rig, self.names)

    @property
    def spare(self) -> int:
        """Measured coordinates more than unknowns (a prior counts as measured)."""
        coordinates = 2 * int(self.seen.sum()) + len(self.prior_at)
        return coordinates - len(self.names) - 6 * len(self.pixels)

    def noise(self, guess: _TargetGuess) -> Array:
        """(1,) sigma of a coordinate from the median length of the residuals.

        A wrong model and its median can chase each other in a cycle; what turns back goes halfway.
        """
        share = math.sqrt(2 * int(self.seen.sum()) / self.spare)
        sigma_px = float(np.median(guess.lengths[self.seen])) / RAYLEIGH_MEDIAN * share
        if len(self.scales) > 1 and (sigma_px - self.scales[1]) * np.diff(self.scales)[0] < 0.0:
            sigma_px = math.sqrt(sigma_px * self.scales[1])
        return np.array([max(sigma_px, _MIN_NOISE_PX)])

    def solve(self, state: State, settled: float, at_most: int | None) -> Adjustment:
        """Iterate from a guess until a step is shorter than `settled` sigmas."""
        if self.spare <= 0:
            raise CalibrationError(
                f"{int(self.seen.sum())} measured points in {len(self.pixels)} views are too few "
                f"for {len(self.names)} parameters and the poses: take more views"
            )
        start, self.scales = self.seen_from(state), ()
        lost = self.seen & ~np.isfinite(start.residuals).all(axis=-1)
        if lost.any():  # points that the start cannot project take part once it has improved
            self.seen = self.seen & ~lost
            first = self.solve(state, settled, at_most)
            self.seen = self.seen | lost
            start = self.seen_from(self.state(first.rig, first.rig_from_target, first.shape.values))
            if not np.isfinite(start.residuals[self.seen]).all():
                raise CalibrationError(
                    f"{int(lost.sum())} measured points lie where the camera model sees nothing: "
                    "start from values nearer to the truth, or choose a simpler lens"
                )
        found = minimise(
            self, start, settled=settled, max_steps=at_most or _STEPS, damping=_DAMPING,
            min_damping=_MIN_DAMPING if self.names else _POSE_DAMPING,
        )  # fmt: skip
        if found.is_settled or at_most is not None:
            return self.result(found)
        self.covariance(found.equations)  # names what the views leave open, if that is the reason
        if found.is_stuck:
            raise CalibrationError(
                f"the adjustment is stuck {found.length:.2g} sigmas from its end, where measured "
                "points leave what the camera model sees: start from values nearer to the truth, "
                "such as another port, or another distance of it"
            )
        raise UnsettledError(
            f"the adjustment did not settle in {_STEPS} steps (the last moved by "
            f"{found.length:.2g} sigmas): take views at more angles and distances"
        )

    def weights(self, guess: _TargetGuess, noise: Array) -> Array:
        """(V, C, N) Huber's weights; 0 where unseen."""
        length = np.where(self.seen, guess.lengths / noise, 0.0)
        return np.where(self.seen, HUBER / np.maximum(length, HUBER), 0.0)

    def result(self, found: Minimum[_TargetGuess, Equations]) -> Adjustment:
        """The adjusted rig and poses, with the covariance at this guess."""
        state, weights = found.guess.state, self.weights(found.guess, found.noise)
        noise_px = self._noise(found.guess.lengths, weights)
        covariance = self.covariance(
            self.equations(state, np.where(self.seen, (noise_px * self.blur) ** -2.0, 0.0))
        )
        of_shape = covariance.marginal(self.shape.parameters)
        return Adjustment(
            rig=replace(state.rig, covariance=covariance.marginal(self.rig_names)),
            shape=self.shape.with_values(state.bend, of_shape.matrix),
            covariance=covariance,
            rig_from_target=RigidTransform.from_components(
                state.places, Rotation.from_matrix(state.turns)
            ),
            residuals_px=np.where(self.seen[..., None], found.guess.residuals, np.nan),
            weights=np.where(self.seen, weights, np.nan),
            noise_px=noise_px,
            blur=np.broadcast_to(self.blur[..., 0], self.seen.shape[:2]),
            is_settled=found.is_settled,
        )

    def _noise(self, lengths: Array, weights: Array) -> float:
        """Sigma of a coordinate such that an M-estimator's covariance is sigma^2 (J^T J)^-1.

        P. J. Huber 1981, "Robust Statistics", section 7.6: mean square of the pull over the square
        of its mean slope; in two dimensions the slope of a clipped pull is half its weight.
        """
        pull = (weights * lengths)[self.seen]
        w = weights[self.seen]
        slope = float(np.mean(np.where(w < 1.0, 0.5 * w, 1.0)))
        noise_px = math.sqrt(float((pull**2).sum()) / self.spare) / slope
        return max(noise_px, _MIN_NOISE_PX)
