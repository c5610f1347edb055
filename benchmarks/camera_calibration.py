"""Calibration through the ports from synthetic views, compared with its Cramer-Rao bound.

25 stereo views of a board of 12 x 9 squares of 30 mm at 0.6 to 2.2 m, tilted, with 0.1 px of noise
in each coordinate. Distance and normal of both ports, the pose of the right camera and the board's
shape (but for its usual spread) are unknown;
the intrinsics are held at the truth, drawn from what a calibration in air would know and then taken
with that prior, or unknown too. The adjustment starts from the design.

The root mean square of 200 errors scatters by 5 % about the true one: of 39 that equal their
bounds (13 in each mode) some exceed 1.15 times it by chance in up to 6 % of all runs. Errors are
nearly linear in the noise, though, and of that linear part the mean square is known: it is the
bound. Figures `without luck` are the bound and what is found of the rest (control variates); they
scatter by less than 1 %.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from alice_survey.core.executor import SERIAL, Executor
from alice_survey.core.frames import Array
from benchmarks.figures import Figure, Goal
from camera_calib.calibrate.normal_equations import CalibrationProblem
from camera_calib.calibrate.solve import Intrinsics, calibrate_through_ports
from camera_calib.calibration import TargetView, stack_views
from camera_calib.freedom import Freedom, Prior, intrinsics, of_cameras, of_ports, pose_names, value
from camera_calib.judge.uncertainty import baselines_m
from camera_calib.rig import Covariance, Rig
from camera_calib.target_shape import AS_DRAWN, TargetShape, usual_shape
from tests.camera_calib.calibration_scenes import (
    BOARD,
    DESIGN,
    board_poses,
    built_rig,
    in_air,
    views_of,
    with_values,
)

MODES: tuple[Intrinsics, ...] = ("held", "prior", "free")
GOAL_OF_BOUND = 1.15
GOAL_OF_SIGMA = (0.8, 1.25)

_NOISE_PX = 0.1
_VIEWS = 25
_TRUTH = built_rig()
_LENS = of_cameras(_TRUTH, intrinsics("opencv5"))
_PORTS = (*of_ports(_TRUTH), *pose_names(_TRUTH))
_BASELINE = "baseline_m"
RIG = (*_PORTS, _BASELINE)
"""What the goals of the errors are for."""


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """How well one parameter is found over all trials."""

    name: str
    rms: float
    """In the parameter's unit."""
    bound: float
    by_sigma: float
    """Root mean square of error / sigma."""
    ratio_without_luck: float
    """Error over its bound."""
    by_sigma_without_luck: float

    @property
    def ratio(self) -> float:
        """Error over its bound."""
        return self.rms / self.bound


@dataclass(frozen=True, kw_only=True, eq=False)
class Trial:
    """Of all parameters of one calibration and of the baseline, in the order of the bound."""

    errors: Array
    first_order: Array
    """The errors that the same noise causes if it is so small that all is linear."""
    sigmas: Array
    """By the calibration itself."""


@dataclass(frozen=True, kw_only=True)
class Mode:
    """All parameters of one mode; those of the lens only where they are found again."""

    known: str
    trials: int
    parameters: tuple[Parameter, ...]

    def figures(self, *, judged: bool) -> list[Figure]:
        """Errors of ports and rig next to their bounds, and of all parameters by their sigmas.

        Args:
            judged: whether there are trials enough for goals.
        """
        low, high = GOAL_OF_SIGMA
        bound_goal = Goal(maximum=GOAL_OF_BOUND, of="ratio") if judged else None
        errors = [
            Figure(
                name=f"{self.known}: {p.name}, rms error", value=p.rms, unit=_unit(p.name),
                peer="Cramer-Rao bound", peer_value=p.bound, goal=bound_goal,
            )
            for p in self.parameters
            if p.name in RIG
        ]  # fmt: skip
        scores = [
            Figure(
                name=f"{self.known}: {p.name}, error over sigma, rms", value=p.by_sigma,
                unit="sigmas", goal=Goal(minimum=low, maximum=high) if judged else None,
            )
            for p in self.parameters
        ]  # fmt: skip
        calm = [p.ratio_without_luck for p in self.parameters if p.name in RIG]
        ends = (("least", min(calm)), ("most", max(calm)))
        return [*errors, *scores] + [
            Figure(name=f"{self.known}: rms error without luck, {which}", value=end, unit="bounds")
            for which, end in ends
        ]


@cache
def _scene() -> tuple[RigidTransform, Covariance]:
    """Poses of the board, and what a calibration in air from as many views knows of the lenses."""
    rng = np.random.default_rng(6)
    poses = board_poses(_TRUTH, _VIEWS, rng)
    air = in_air(_TRUTH)
    whole = cramer_rao(
        air,
        BOARD,
        board_poses(air, _VIEWS, rng),
        np.ones((_VIEWS, 2, len(BOARD)), dtype=np.bool_),
        Freedom(free=(*_LENS, *pose_names(air))),
        _NOISE_PX,
    )
    at = [whole.parameters.index(name) for name in _LENS]
    return poses, Covariance(parameters=_LENS, matrix=whole.matrix[np.ix_(at, at)])


def cramer_rao(
    rig: Rig,
    points: Array,
    rig_from_target: RigidTransform,
    seen: NDArray[np.bool_],
    freedom: Freedom,
    noise_px: float,
    shape: TargetShape = AS_DRAWN,
) -> Covariance:
    """The least covariance that any unbiased calibration can have, at the true values.

    Args:
        rig: the truth.
        points: (N, 3) of the target, metres.
        rig_from_target: (V,) true poses.
        seen: (V, cameras, N) which points are measured.
        freedom: what of the rig is unknown.
        noise_px: standard deviation of one coordinate.
        shape: what of the target's shape is unknown.

    Raises:
        CalibrationError: the views do not determine a parameter.
    """
    pixels = np.where(seen[..., None], 0.0, np.nan)
    problem = CalibrationProblem(pixels, points, rig, freedom, shape)
    state = problem.state(rig, rig_from_target)
    weights = np.where(problem.seen, 1.0 / noise_px**2, 0.0)
    return problem.covariance(problem.equations(state, weights)).marginal(freedom.names(rig))


def bound_of(known: Intrinsics) -> Covariance:
    """The least covariance of any unbiased calibration of these views."""
    poses, lens = _scene()
    freedom = _freedom(known, replace(_TRUTH, covariance=lens))
    everywhere = np.ones((_VIEWS, 2, len(BOARD)), dtype=np.bool_)
    shape = usual_shape(BOARD)
    return cramer_rao(_TRUTH, BOARD, poses, everywhere, freedom, _NOISE_PX, shape)


def _freedom(known: Intrinsics, start: Rig) -> Freedom:
    if known == "prior":
        return Freedom(free=_PORTS, prior=Prior.of_rig(start, _LENS))
    return Freedom(free=(*_PORTS, *_LENS) if known == "free" else _PORTS)


def run_trial(seed: int, known: Intrinsics) -> Trial:
    """Calibrate once."""
    rng = np.random.default_rng([seed, 3])
    poses, lens = _scene()
    truth = np.array([value(_TRUTH, name) for name in _LENS])
    start = DESIGN
    if known == "held":
        start = with_values(DESIGN, dict(zip(_LENS, truth, strict=True)))
    if known == "prior":
        drawn = rng.multivariate_normal(truth, lens.matrix)
        start = with_values(replace(DESIGN, covariance=lens), dict(zip(_LENS, drawn, strict=True)))
    views = views_of(_TRUTH, poses, _NOISE_PX, rng)
    found = calibrate_through_ports(views, BOARD, start, known).rig
    names = list(found.sigmas)
    errors = np.array([value(found, name) - value(_TRUTH, name) for name in names])
    turn = found.cam_from_rig["right"].rotation * _TRUTH.cam_from_rig["right"].rotation.inv()
    for axis, angle in zip("xyz", turn.as_rotvec(), strict=True):
        errors[names.index(f"right.r{axis}_rad")] = angle
    linear = _first_order(views, poses, _freedom(known, start))
    shift = _TRUTH.cam_from_rig["right"].translation
    at = [names.index(f"right.{axis}_m") for axis in "xyz"]
    along = float(linear[at] @ shift / np.linalg.norm(shift))
    return Trial(
        errors=np.append(errors, found.baseline_m - _TRUTH.baseline_m),
        first_order=np.append(linear, along),
        sigmas=np.array([*found.sigmas.values(), baselines_m(found)["right"][1]]),
    )


def _first_order(views: Sequence[TargetView], poses: RigidTransform, freedom: Freedom) -> Array:
    """The step of Gauss and Newton from the truth: its covariance is the bound."""
    pixels, shape = stack_views(views, _TRUTH, len(BOARD)), usual_shape(BOARD)
    problem = CalibrationProblem(pixels, BOARD, _TRUTH, freedom, shape)
    weights = np.where(problem.seen, _NOISE_PX**-2.0, 0.0)
    equations = problem.equations(problem.state(_TRUTH, poses), weights)
    return equations.step().shared[: -len(shape.parameters)]


def run_mode(known: Intrinsics, seeds: Sequence[int], executor: Executor = SERIAL) -> Mode:
    """All trials of one mode."""
    work, label = partial(run_trial, known=known), f"calibrations, {known}"
    found = list(executor.map(work, seeds, label=label))
    bound = bound_of(known)
    names = (*bound.parameters, _BASELINE)
    truth = replace(_TRUTH, covariance=bound)
    bounds = np.array([*bound.sigmas.values(), baselines_m(truth)["right"][1]])
    square = np.mean([trial.errors**2 for trial in found], axis=0)
    by_sigma = np.mean([(trial.errors / trial.sigmas) ** 2 for trial in found], axis=0)
    luck = np.mean([(trial.first_order / bounds) ** 2 for trial in found], axis=0) - 1.0
    columns = zip(names, square, bounds, by_sigma, luck, strict=True)
    return Mode(
        known=known,
        trials=len(found),
        parameters=tuple(
            Parameter(
                name=name,
                rms=float(np.sqrt(s)),
                bound=float(b),
                by_sigma=float(np.sqrt(e)),
                ratio_without_luck=float(np.sqrt(s / b**2 - more)),
                by_sigma_without_luck=float(np.sqrt(e - more)),
            )
            for name, s, b, e, more in columns
        ),
    )


def _unit(name: str) -> str:
    """Of a parameter, which ends in it."""
    last = name.rsplit("_", 1)[-1]
    return last if last in ("m", "rad", "px") else "1"
