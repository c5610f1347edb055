"""Calibration through the ports from synthetic views, beside its Cramer-Rao bound.

25 stereo views of a board of 12 x 9 squares of 30 mm at 0.6 to 2.2 m, tilted, with 0.1 px of noise
in each coordinate. Distance and normal of both ports and the pose of the right camera are unknown;
the intrinsics are held at the truth, drawn from what a calibration in air would know and then taken
with that prior, or unknown too. The adjustment starts from the design.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.executor import parallel_map
from alice_survey.frames import Array
from camera_calib.calibration.adjust import cramer_rao
from camera_calib.calibration.calibrate import Intrinsics, calibrate_through_ports
from camera_calib.calibration.freedom import (
    PORT,
    Freedom,
    Prior,
    intrinsics,
    of_cameras,
    pose_names,
    value,
)
from camera_calib.rig import Covariance, Rig
from tests.camera_calib.calibration_scenes import (
    BOARD,
    DESIGN,
    board_poses,
    built_rig,
    in_air,
    views_of,
)

MODES: tuple[Intrinsics, ...] = ("held", "prior", "free")
GOAL_OF_BOUND = 1.15
GOAL_OF_SIGMA = (0.8, 1.25)

_NOISE_PX = 0.1
_VIEWS = 25
_TRUTH = built_rig()
_LENS = of_cameras(_TRUTH, intrinsics("opencv5"))
_PORTS = (*of_cameras(_TRUTH, PORT), *pose_names(_TRUTH))
_BASELINE = "baseline_m"


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """How well one parameter is found over all trials."""

    name: str
    rms: float
    """In the parameter's unit."""
    bound: float
    by_sigma: float
    """Root mean square of error / sigma."""

    @property
    def ratio(self) -> float:
        """Error over its bound."""
        return self.rms / self.bound


@dataclass(frozen=True, kw_only=True)
class Mode:
    """All parameters of one mode; those of the lens only where they are found anew."""

    known: str
    trials: int
    parameters: tuple[Parameter, ...]

    def misses(self) -> list[str]:
        """Parameters that miss a goal, in words."""
        low, high = GOAL_OF_SIGMA
        found = []
        for p in self.parameters:
            if (p.name in _PORTS or p.name == _BASELINE) and not p.ratio <= GOAL_OF_BOUND:
                found.append(f"{self.known}, {p.name}: {p.ratio:.3f} x its bound > {GOAL_OF_BOUND}")
            if not low <= p.by_sigma <= high:
                found.append(f"{self.known}, {p.name}: error / sigma {p.by_sigma:.3f}")
        return found


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


def bound_of(known: Intrinsics) -> Covariance:
    """The least covariance of any unbiased calibration of these views."""
    poses, lens = _scene()
    free = (*_PORTS, *_LENS) if known == "free" else _PORTS
    prior = Prior.of_rig(replace(_TRUTH, covariance=lens), _LENS) if known == "prior" else None
    freedom = Freedom(free=free) if prior is None else Freedom(free=free, prior=prior)
    everywhere = np.ones((_VIEWS, 2, len(BOARD)), dtype=np.bool_)
    return cramer_rao(_TRUTH, BOARD, poses, everywhere, freedom, _NOISE_PX)


def run_trial(seed: int, known: Intrinsics) -> tuple[Array, Array]:
    """Errors of all parameters and of the baseline, and their sigmas by the calibration itself."""
    rng = np.random.default_rng([seed, 3])
    poses, lens = _scene()
    truth = np.array([value(_TRUTH, name) for name in _LENS])
    start = DESIGN
    if known == "held":
        start = _with_lens(DESIGN, truth, None)
    if known == "prior":
        start = _with_lens(DESIGN, rng.multivariate_normal(truth, lens.matrix), lens)
    views = views_of(_TRUTH, poses, _NOISE_PX, rng)
    found = calibrate_through_ports(views, BOARD, start, known).rig
    if found.covariance is None:
        raise RuntimeError("a calibration came without its covariance")
    names = found.covariance.parameters
    errors = np.array([value(found, name) - value(_TRUTH, name) for name in names])
    turn = found.cam_from_rig["right"].rotation * _TRUTH.cam_from_rig["right"].rotation.inv()
    for axis, angle in zip("xyz", turn.as_rotvec(), strict=True):
        errors[names.index(f"right.r{axis}_rad")] = angle
    sigmas = [*found.sigmas.values(), _baseline_sigma(found, found.covariance)]
    return np.append(errors, found.baseline_m - _TRUTH.baseline_m), np.array(sigmas)


def run_mode(known: Intrinsics, seeds: Sequence[int], threads: int = 1) -> Mode:
    """All trials of one mode."""
    work, label = partial(run_trial, known=known), f"calibrations, {known}"
    found = list(parallel_map(work, seeds, threads=threads, label=label))
    bound = bound_of(known)
    rms = np.sqrt(np.mean([errors**2 for errors, _ in found], axis=0))
    scores = np.sqrt(np.mean([(errors / sigmas) ** 2 for errors, sigmas in found], axis=0))
    names = (*bound.parameters, _BASELINE)
    bounds = [*bound.sigmas.values(), _baseline_sigma(_TRUTH, bound)]
    return Mode(
        known=known,
        trials=len(found),
        parameters=tuple(
            Parameter(name=n, rms=float(r), bound=b, by_sigma=float(s))
            for n, r, b, s in zip(names, rms, bounds, scores, strict=True)
        ),
    )


def _baseline_sigma(rig: Rig, covariance: Covariance) -> float:
    at = [covariance.parameters.index(f"right.{axis}_m") for axis in "xyz"]
    shift = rig.cam_from_rig["right"].translation
    along = shift / np.linalg.norm(shift)
    return float(np.sqrt(along @ covariance.matrix[np.ix_(at, at)] @ along))


def _with_lens(rig: Rig, values: Array, covariance: Covariance | None) -> Rig:
    """The rig behind lenses of these values of `_LENS`."""
    cameras = {
        name: camera.with_parameters(
            {
                parameter.split(".")[1]: float(number)
                for parameter, number in zip(_LENS, values, strict=True)
                if parameter.startswith(f"{name}.")
            }
        )
        for name, camera in rig.cameras.items()
    }
    return replace(rig, cameras=cameras, covariance=covariance)


def table(modes: Sequence[Mode]) -> str:
    """The parameters of ports and rig in Markdown; the lens's are in the JSON."""
    lines = ["| parameter |", "|---|"]
    for mode in modes:
        lines[0] += f" {mode.known}: bound | rms / bound | error / sigma |"
        lines[1] += "---|---|---|"
    for name in (*_PORTS, _BASELINE):
        line = f"| {name} |"
        for mode in modes:
            p = next(p for p in mode.parameters if p.name == name)
            line += f" {_in_words(p.name, p.bound)} | {p.ratio:.3f} | {p.by_sigma:.3f} |"
        lines.append(line)
    return "\n".join(lines)


def _in_words(name: str, size: float) -> str:
    if name.endswith("_m"):
        return f"{1e3 * size:.3g} mm"
    return f"{np.rad2deg(size):.2g} deg"
