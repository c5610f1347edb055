"""Joint least-squares adjustment of cameras, ports, rig, target poses and the target's shape.

Poses of the target are eliminated view by view, so that each step solves for the rig's parameters
alone; slopes are analytic. The loss is Huber's on the length of a residual, its scale taken from
the residuals' median: 99.8 % efficient for normal noise, and no outlier pulls more than a point at
three sigmas. Steps follow Levenberg and Marquardt (J. J. More 1978, "The Levenberg-Marquardt
algorithm: implementation and theory").
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.base.errors import CalibrationError
from alice_survey.base.frames import Array
from camera_calib.calibrate.normal_equations import CalibrationProblem, Equations, Flags, State
from camera_calib.calibration import TargetView, stack_views
from camera_calib.freedom import Freedom
from camera_calib.rig import Covariance, Rig
from camera_calib.target_shape import AS_DRAWN, TargetShape

HUBER = 3.0
"""Length, in sigmas of a coordinate, beyond which a residual's influence is constant."""
RAYLEIGH_MEDIAN = math.sqrt(2.0 * math.log(2.0))
"""Median residual length, in sigmas of a coordinate, for normal noise."""
_LEAST_NOISE_PX = 1e-6
"""Smallest noise: below it the rounding of projections shows."""
_STEPS = 100
_SETTLED = 1e-4
_LEAST_DAMPING = 1e-13
"""Parameters of a rig can be so similar that more damping than this hides their difference."""
_POSE_DAMPING = 1e-6
"""Least damping of poses, whose parameters are never so similar."""


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


class _Solver(CalibrationProblem):
    """Minimisation of the robust loss."""

    blur: Array = np.ones((1, 1, 1))
    """(V, C, 1) noise of each picture over `noise_px`."""

    def lengths(self, residuals: Array, noise_px: float) -> Array:
        """(V, C, N) of residuals, in sigmas of their pictures."""
        length: Array = np.sqrt(np.einsum("vcni,vcni->vcn", residuals, residuals))
        return length / (noise_px * self.blur)

    def cost(self, state: State, residuals: Array, noise_px: float) -> float:
        """Half the robust sum of squares in sigmas; inf where a seen point is not projected."""
        length = self.lengths(residuals, noise_px)[self.seen]
        if not np.all(np.isfinite(length)):
            return math.inf
        loss = np.where(length <= HUBER, 0.5 * length**2, HUBER * (length - 0.5 * HUBER))
        off = self.prior_residuals(state)
        return float(loss.sum() + 0.5 * off @ self.prior_information @ off)

    @property
    def spare(self) -> int:
        """Measured coordinates more than unknowns (a prior counts as measured)."""
        coordinates = 2 * int(self.seen.sum()) + len(self.prior_at)
        return coordinates - len(self.names) - 6 * len(self.pixels)

    def spread(self, residuals: Array) -> float:
        """Sigma of a coordinate from the median length of the residuals."""
        lengths = self.lengths(residuals, 1.0)[self.seen]
        share = math.sqrt(2 * int(self.seen.sum()) / self.spare)
        return max(float(np.median(lengths)) / RAYLEIGH_MEDIAN * share, _LEAST_NOISE_PX)

    def solve(self, state: State, settled: float, at_most: int | None) -> Adjustment:
        """Iterate from a guess until a step is shorter than `settled` sigmas."""
        least = _LEAST_DAMPING if self.names else _POSE_DAMPING
        if self.spare <= 0:
            raise CalibrationError(
                f"{int(self.seen.sum())} measured points in {len(self.pixels)} views are too few "
                f"for {len(self.names)} parameters and the poses: take more views"
            )
        residuals = self.residuals(state)
        lost = self.seen & ~np.isfinite(residuals).all(axis=-1)
        if lost.any():  # points that the start cannot project take part once it has improved
            self.seen = self.seen & ~lost
            first = self.solve(state, settled, at_most)
            self.seen = self.seen | lost
            state = self.state(first.rig, first.rig_from_target, first.shape.values)
            residuals = self.residuals(state)
            if not np.isfinite(residuals[self.seen]).all():
                raise CalibrationError(
                    f"{int(lost.sum())} measured points lie where the camera model sees nothing: "
                    "start from values nearer to the truth, or choose a simpler lens"
                )
        damping, noise_px = 1e-3, self.spread(residuals)
        for _ in range(at_most or _STEPS):
            weights = self.weights(residuals, noise_px)
            equations = self.equations(state, weights / (noise_px * self.blur) ** 2)
            cost = self.cost(state, residuals, noise_px)
            pinned = (self.values(state) <= self.low) & (equations.rig_slope > 0)
            while True:
                rig_step, view_step, gain = _damped_step(equations, damping, pinned)
                try:
                    tried = self.moved(state, rig_step, view_step)
                    tried_residuals = self.residuals(tried)
                    drop = cost - self.cost(tried, tried_residuals, noise_px)
                except CalibrationError:
                    drop = -math.inf
                if drop >= 0 or gain < settled**2:
                    break
                damping = max(10.0 * damping, 1e-9)
            if drop >= 0:
                state, residuals = tried, tried_residuals
            noise_before, noise_px = noise_px, self.spread(residuals)
            same_noise = abs(noise_px / noise_before - 1) < settled or noise_px == _LEAST_NOISE_PX
            if gain < settled**2 and same_noise and (damping <= least or drop < 0):
                # Damping shortens any step: at the edge of what the model sees only it is short.
                gain = _damped_step(equations, least, pinned)[2]
                if drop >= 0 or gain < settled**2:
                    return self.result(state, residuals, noise_px, is_settled=True)
                break
            good = drop > 0.25 * gain or gain < settled**2
            damping = max(damping * (0.01 if good else 0.5), 0.1 * _LEAST_DAMPING)
        if at_most is not None:
            return self.result(state, residuals, noise_px, is_settled=False)
        self.covariance(equations)  # names what the views leave open, if that is the reason
        if drop < 0:
            raise CalibrationError(
                f"the adjustment is stuck {math.sqrt(gain):.2g} sigmas from its end, where measured "
                "points leave what the camera model sees: start from values nearer to the truth, "
                "such as another port distance"
            )
        raise CalibrationError(
            f"the adjustment did not settle in {_STEPS} steps (the last moved by "
            f"{math.sqrt(gain):.2g} sigmas): take views at more angles and distances"
        )

    def weights(self, residuals: Array, noise_px: float) -> Array:
        """(V, C, N) Huber's weights; 0 where unseen."""
        length = np.where(self.seen, self.lengths(residuals, noise_px), 0.0)
        weights: Array = np.where(self.seen, HUBER / np.maximum(length, HUBER), 0.0)
        return weights

    def result(
        self, state: State, residuals: Array, spread: float, *, is_settled: bool
    ) -> Adjustment:
        """The adjusted rig and poses, with the covariance at this guess."""
        weights = self.weights(residuals, spread)
        noise_px = self._noise(residuals, weights)
        covariance = self.covariance(
            self.equations(state, np.where(self.seen, (noise_px * self.blur) ** -2.0, 0.0))
        )
        of_shape = covariance.marginal(self.shape.parameters)
        names = list(self.rig.cameras)
        poses = RigidTransform.from_components(state.shifts, Rotation.from_matrix(state.rotations))
        rig = replace(
            self.rig,
            cameras=dict(zip(names, state.cameras, strict=True)),
            cam_from_rig={name: poses[i] for i, name in enumerate(names)},
            covariance=covariance.marginal(
                self.names[: len(self.names) - len(of_shape.parameters)]
            ),
        )
        return Adjustment(
            rig=rig,
            shape=self.shape.found(state.bend, of_shape.matrix),
            covariance=covariance,
            rig_from_target=RigidTransform.from_components(
                state.places, Rotation.from_matrix(state.turns)
            ),
            residuals_px=np.where(self.seen[..., None], residuals, np.nan),
            weights=np.where(self.seen, weights, np.nan),
            noise_px=noise_px,
            blur=np.broadcast_to(self.blur[..., 0], self.seen.shape[:2]),
            is_settled=is_settled,
        )

    def _noise(self, residuals: Array, weights: Array) -> float:
        """Sigma of a coordinate such that an M-estimator's covariance is sigma^2 (J^T J)^-1.

        P. J. Huber 1981, "Robust Statistics", section 7.6: mean square of the pull over the square
        of its mean slope; in two dimensions the slope of a clipped pull is half its weight.
        """
        pull = (weights * self.lengths(residuals, 1.0))[self.seen]
        w = weights[self.seen]
        slope = float(np.mean(np.where(w < 1.0, 0.5 * w, 1.0)))
        noise_px = math.sqrt(float((pull**2).sum()) / self.spare) / slope
        return max(noise_px, _LEAST_NOISE_PX)


def _damped_step(equations: Equations, damping: float, pinned: Flags) -> tuple[Array, Array, float]:
    """The step of rig and poses against the gradient, and twice the drop it promises."""
    ridge = damping * np.einsum("vii->vi", equations.view)
    view = equations.view + ridge[:, :, None] * np.eye(6)
    free = np.flatnonzero(~pinned)
    between = equations.between[:, free]
    # Columns: what the rig's parameters and the gradient do to each pose.
    right = np.concatenate([between.transpose(0, 2, 1), equations.view_slope[..., None]], axis=-1)
    solved = np.linalg.solve(view, right)
    rig_step = np.zeros(len(pinned))
    if free.size:
        diagonal = np.diag(equations.rig)[free]
        scale = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
        reduced = np.tensordot(between, solved, axes=([0, 2], [0, 1]))
        schur = equations.rig[np.ix_(free, free)] - reduced[:, :-1]
        schur = schur * np.outer(scale, scale)
        schur[np.diag_indices_from(schur)] += damping + 1e-15
        slope = (equations.rig_slope[free] - reduced[:, -1]) * scale
        try:
            rig_step[free] = -scale * cho_solve(cho_factor(schur), slope)
        except np.linalg.LinAlgError:  # rounding left it indefinite
            rig_step[free] = -scale * np.linalg.lstsq(schur, slope, rcond=1e-13)[0]
    view_step = -solved[..., -1] - solved[..., :-1] @ rig_step[free]
    gain = -float(equations.rig_slope @ rig_step) - float((equations.view_slope * view_step).sum())
    return rig_step, view_step, gain
