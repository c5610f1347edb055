"""Port, water and rig refined from the survey's own pictures, through the exact flat-port cameras.

An adjustment of stations, points and the rig's parameters, each parameter within what calibration
knew of it: the covariance of `rig.json`, or wide bounds where it has none. What is requested is
free; other uncertain parameters of the calibration (focal lengths, say) moves with it within its
covariance, since holding that would push its errors into what is requested.

The model is then rebuilt on the refined rig: settings `refine_port`, `refine_rig`. It writes
`port.json` (values, sigmas, correlation) and `rig.json` (the refined rig) next to the model.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.base.block_solver import BlockStep, Flags, inverse_of, minimise
from alice_survey.base.config import ReconstructConfig
from alice_survey.base.errors import ReconstructionError, warn
from alice_survey.base.frames import Array, Datum
from alice_survey.base.records import PortRecord
from alice_survey.base.run import progress
from camera_calib.approximation.pinhole_warp import PinholeWarp, best_warp
from camera_calib.freedom import POSE as TURN_AND_SHIFT
from camera_calib.freedom import Prior, at_bound, moved, pose_names, value
from camera_calib.rig import Covariance, Rig, write_rig
from reconstruct.adjustment.exact_observations import (
    Pixels,
    RigState,
    calibrated_parameters,
    choose_pixels,
    exact_observations,
    start_state,
)
from reconstruct.adjustment.normal_equations import (
    POSE,
    TURN_INFORMATION,
    LinearObservations,
    PointEquations,
    reduce_points,
)
from reconstruct.mapping.arrays import Indices, cross_matrices, first_pictures, frames_of
from reconstruct.mapping.bundle import move_points
from reconstruct.mapping.database import Observations
from reconstruct.mapping.mapper import Mapped, model_baseline
from reconstruct.mapping.priors import NavigationAdjuster
from reconstruct.mapping.refraction import Convergence, refract
from reconstruct.mapping.robust import cauchy_cost, cauchy_weights, sigma_of, variance_of
from reconstruct.mapping.working_range import WorkingDistances
from reconstruct.matching.pairs import positions_ned
from reconstruct.views.model_files import colmap_pinhole, rigid3d

_RIG_SIGMAS = dict(zip(TURN_AND_SHIFT, [0.02] * 3 + [0.005] * 3, strict=True))
"""Prior sigmas of parameters that no calibration determines: very wide."""
_LEVER = ("lever.x_m", "lever.y_m", "lever.z_m")
"""The body's origin in the rig's frame."""
_LEVER_SIGMA_M = 0.05
_MOST_CORRELATED = 0.98
"""Correlation of navigation's errors from one station to the next."""
_BASELINE_SIGMA_M = 1e-7
"""Sigma of an uncalibrated baseline: it is the scale, which no picture determines."""
_STEPS = 20
_SETTLED = 0.05
"""Length of a step of all parameters, in sigmas, at which the adjustment ends."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RigFit:
    """A refined rig and how well it is known."""

    rig: Rig
    """Rig with the covariance of all that was adjusted; the lever arm is its `body_from_rig`."""
    parameters: tuple[str, ...]
    before: Array
    """(G,) values, in the parameters' units."""
    after: Array
    prior_sigmas: Array
    covariance: Array
    """(G, G) covariance of the values."""
    sigma_px: float
    """Sigma of one coordinate of a keypoint."""
    observations: int
    stations: tuple[RigidTransform, ...]
    """`world_from_rig` at the reference camera's entrance pupil, by ascending frame."""
    points: Array
    """(P, 3) those points that took part."""
    point_ids: Indices

    def to_json(self) -> dict[str, Any]:
        """What `port.json` says."""
        known = Covariance(parameters=self.parameters, matrix=self.covariance)
        return {
            "parameters": list(self.parameters),
            "before": self.before.tolist(),
            "after": self.after.tolist(),
            "prior_sigmas": self.prior_sigmas.tolist(),
            "sigmas": list(known.sigmas.values()),
            "correlation": known.correlation.tolist(),
            "sigma_px": self.sigma_px,
            "observations": self.observations,
            "stations": len(self.stations),
        }


@dataclass(frozen=True, kw_only=True, eq=False)
class NavigationFixes:
    """Positions of the body's origin by navigation, in the model's frame."""

    positions: Array
    """(F, 3) positions by ascending frame; NaN where unknown."""
    sigmas: Array


@progress.step("refine the rig")
def fit_rig(
    mapped: Mapped,
    seen: Observations,
    rig: Rig,
    *,
    port: bool,
    pose: bool,
    fixes: NavigationFixes | None = None,
) -> RigFit:
    """Refine a rig from a finished model.

    Args:
        mapped: exact model on the rig; picture i of `seen` has the id i + 1.
        seen: keypoints as warped by the model's lenses.
        rig: as calibrated or designed.
        port: free distance and normal of the ports and the water's index.
        pose: free the poses of the cameras on the rig, and the lever arm where positions are given.
        fixes: positions of the body.

    Raises:
        ReconstructionError: the survey does not determine what is requested.
    """
    names = list(seen.cameras)
    frames = frames_of(mapped.model)
    pixels, ids = choose_pixels(mapped, seen, names, frames)
    problem = _SurveyProblem(
        pixels, start_state(mapped, rig, names, frames, ids), fixes if pose else None,
        _prior(rig, names, port=port, pose=pose),
    )  # fmt: skip
    found = minimise(problem, problem.start, settled=_SETTLED, most_steps=_STEPS)
    if not found.is_settled:
        warn(f"the rig's refinement did not settle in {_STEPS} steps: trust it with care")
    covariance = inverse_of(found.equations.information)
    state = found.guess.state
    sigma_px, variance = found.noise.tolist()
    weights = cauchy_weights(found.guess.linear.miss, sigma_px)
    return RigFit(
        rig=_as_rig(rig, names, state, problem.fields, covariance, problem.fixes is not None),
        parameters=problem.names,
        before=problem.values(problem.start.state),
        after=problem.values(state),
        prior_sigmas=np.sqrt(np.diag(inverse_of(problem.information))),
        covariance=covariance,
        sigma_px=float(np.sqrt(variance / weights.mean())),
        observations=len(pixels.station),
        stations=tuple(
            RigidTransform.from_components(state.centres, Rotation.from_matrix(state.turns))
        ),
        points=state.points,
        point_ids=ids,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _RigGuess:
    """One guess of all unknowns, with what is seen from there."""

    state: RigState
    linear: LinearObservations
    lost: int
    """Observations that no ray explains: they do not count."""


class _SurveyProblem:
    """Stations, points and rig of a survey as `minimise` adjusts them."""

    def __init__(
        self, pixels: Pixels, state: RigState, fixes: NavigationFixes | None, prior: Prior
    ) -> None:
        self.pixels, self.prior, self.fields = pixels, prior, prior.parameters
        self.fixes = None if fixes is None else _with_correlation(fixes, state)
        self.names = (*self.fields, *(_LEVER if fixes is not None else ()))
        self.information = np.zeros((len(self.names),) * 2)
        self.information[: len(self.fields), : len(self.fields)] = prior.information
        if fixes is not None:
            self.information[-3:, -3:] = np.eye(3) / _LEVER_SIGMA_M**2
        _hold_baseline(self.information, self.fields, state.rig)
        self.first_lever = state.lever
        self.left = self._spare(state) / (2 * len(pixels.station))
        self.start = self._seen(state)

    def _spare(self, state: RigState) -> int:
        observations, points = len(self.pixels.station), self.pixels.points
        stations, shared = len(state.centres), len(self.information)
        spare = 2 * observations - 3 * points - POSE * stations
        if spare < 10 * shared:
            raise ReconstructionError(
                f"{observations} observations of {points} points from {stations} stations do not "
                f"determine {shared} parameters of the rig: leave refine_port and refine_rig off"
            )
        return spare

    def _seen(self, state: RigState) -> _RigGuess:
        linear = exact_observations(state, self.pixels, self.fields, lever=self.fixes is not None)
        lost = int((~linear.by_point[:, 0].any(axis=1)).sum())
        return _RigGuess(state=state, linear=linear, lost=lost)

    def values(self, state: RigState) -> Array:
        """(G,) values of what is shared."""
        lever = state.lever[: 0 if self.fixes is None else 3]
        return np.array([*(value(state.rig, name) for name in self.fields), *lever])

    def misfit(self, state: RigState) -> Array:
        """(G,) what is shared minus what is known of it."""
        off = np.concatenate([self.prior.misfit(state.rig), state.lever - self.first_lever])
        return off[: len(self.information)]

    def fix_rows(self, state: RigState) -> Array:
        """Fixes in sigmas: slopes (F, 3, 10) by station and lever arm, then misses; 0 for none."""
        if self.fixes is None:
            return np.zeros((len(state.turns), 3, POSE + 4))
        arms = state.turns @ state.lever
        unit = np.broadcast_to(np.eye(3), state.turns.shape)
        off = (state.centres + arms - self.fixes.positions)[:, :, None]
        rows = np.concatenate([-cross_matrices(arms), unit, state.turns, off], axis=2)
        rows = rows / self.fixes.sigmas[:, :, None]
        return np.where(np.isfinite(rows).all(axis=(1, 2), keepdims=True), rows, 0.0)

    def noise(self, guess: _RigGuess) -> Array:
        """Sigma of a keypoint's coordinate for the weights, and variance that scales them."""
        miss = guess.linear.miss
        sigma = sigma_of(miss, guess.linear.seen_by, len(guess.state.centres))
        return np.array([sigma, variance_of(miss, cauchy_weights(miss, sigma), self.left)])

    def cost(self, guess: _RigGuess, noise: Array) -> float:
        """Half of Cauchy's loss, prior and fixes."""
        if guess.lost > self.start.lost:
            return math.inf
        sigma, variance = noise
        off, fixes = self.misfit(guess.state), self.fix_rows(guess.state)[..., -1]
        pixels = cauchy_cost(guess.linear.miss, sigma) / variance
        return 0.5 * float(pixels + off @ self.information @ off + (fixes**2).sum())

    def linearised(self, guess: _RigGuess, noise: Array) -> PointEquations:
        """Normal equations with the points eliminated."""
        sigma, variance = noise
        weights = cauchy_weights(guess.linear.miss, sigma) / variance
        found = reduce_points(guess.linear.weighted(weights), len(guess.state.centres))
        found.shared[:-1, :-1] += self.information
        found.shared[:-1, -1] += self.information @ self.misfit(guess.state)
        if self.fixes is None:
            found.free[0] = False
            return found
        rows = self.fix_rows(guess.state)
        square = rows.swapaxes(1, 2) @ rows
        square[:, -1, -1] = 0.0
        fixed = np.flatnonzero(rows.any(axis=(1, 2)))
        square[fixed[:, None], np.arange(3), np.arange(3)] += TURN_INFORMATION
        found.border[:, :, -4:] += square[:, :POSE, POSE:]
        found.shared[-4:, -4:] += square[:, POSE:, POSE:].sum(axis=0)
        return found.knowing(square[:, :POSE, :POSE])

    def moved(self, guess: _RigGuess, equations: PointEquations, step: BlockStep) -> _RigGuess:
        """The guess after a step."""
        state, count = guess.state, len(self.fields)
        return self._seen(
            RigState(
                rig=moved(state.rig, self.fields, step.shared[:count]),
                turns=Rotation.from_rotvec(step.poses[:, :3]).as_matrix() @ state.turns,
                centres=state.centres + step.poses[:, 3:],
                points=state.points + equations.point_steps(step),
                lever=state.lever if self.fixes is None else state.lever + step.shared[count:],
            )
        )

    def at_bound(self, guess: _RigGuess) -> Flags:
        """Parameters that have their least value."""
        return at_bound(guess.state.rig, self.names)


def _with_correlation(fixes: NavigationFixes, state: RigState) -> NavigationFixes:
    """Sigmas that account for correlated errors of navigation.

    Correlated errors average out less than independent ones: a first-order process of correlation
    r from one station to the next widens the sigma of a mean by sqrt((1 + r) / (1 - r)).
    """
    known = np.flatnonzero(np.isfinite(fixes.positions + fixes.sigmas).all(axis=1))
    bodies = state.centres[known] + state.turns[known] @ state.lever
    off = fixes.positions[known] - bodies
    off = off - off.mean(axis=0)
    spread = np.maximum((off**2).sum(axis=0), 1e-12)
    correlation = np.clip((off[1:] * off[:-1]).sum(axis=0) / spread, 0.0, _MOST_CORRELATED)
    return replace(fixes, sigmas=fixes.sigmas * np.sqrt((1.0 + correlation) / (1.0 - correlation)))


def _prior(rig: Rig, names: Sequence[str], *, port: bool, pose: bool) -> Prior:
    """What is known before the pictures of what may move."""
    known = calibrated_parameters(rig, names)
    wide: dict[str, float] = {}
    if port:
        for name in names:
            camera = rig.cameras[name]
            if camera.refracts:
                wide |= {f"{name}.{field}": sigma for field, sigma in camera.port.spreads.items()}
    if pose:
        wide |= {
            name: _RIG_SIGMAS[name.split(".")[1]]
            for name in pose_names(rig)
            if name.split(".")[0] in names
        }
    wide = {name: sigma for name, sigma in wide.items() if name not in known}
    loose = Prior.around(rig, wide)
    return Prior.of_rig(rig, known).and_also(loose) if known else loose


def _hold_baseline(information: Array, fields: Sequence[str], rig: Rig) -> None:
    """Keep the length of a baseline that no calibration measured, in place."""
    for name, pose in rig.cam_from_rig.items():
        shift = [f"{name}.{axis}" for axis in TURN_AND_SHIFT[3:]]
        if set(shift) <= set(fields) and shift[0] not in rig.sigmas:
            at = [fields.index(field) for field in shift]
            along = pose.translation / np.linalg.norm(pose.translation)
            information[np.ix_(at, at)] += np.outer(along, along) / _BASELINE_SIGMA_M**2


def _as_rig(
    rig: Rig,
    names: Sequence[str],
    state: RigState,
    fields: Sequence[str],
    covariance: Array,
    lever: bool,
) -> Rig:
    reference = rig.cam_from_rig[names[0]]
    cameras = {**rig.cameras, **state.rig.cameras}
    moved: Mapping[str, RigidTransform] = {
        name: pose * reference for name, pose in state.rig.cam_from_rig.items()
    }
    body_from_rig = rig.body_from_rig
    if lever:
        rig_from_body = reference * body_from_rig.inv()
        body_from_rig = (
            RigidTransform.from_components(state.lever, rig_from_body.rotation).inv() * reference
        )
    count = len(fields)
    return replace(
        rig,
        cameras=cameras,
        cam_from_rig={**rig.cam_from_rig, **moved},
        body_from_rig=body_from_rig,
        source=f"{rig.source}; refined from the survey",
        covariance=Covariance(parameters=tuple(fields), matrix=covariance[:count, :count]),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class RefinedSurvey:
    """A survey mapped on its own refined rig."""

    mapped: Mapped
    seen: Observations
    """Keypoints as warped by the refined rig's lenses."""
    rig: Rig
    convergence: Convergence
    """How the keypoints converged."""
    adjust: NavigationAdjuster
    """What adjusted the model."""


def frees_rig(settings: ReconstructConfig, rig: Rig, names: Sequence[str]) -> bool:
    """Whether the settings, or the calibration, call for a refinement of the rig.

    A calibration that states its covariance leaves the poses on the rig to the survey as well,
    unless that is turned off: the two together know more than either.
    """
    return settings.refine_port or _frees_poses(settings, rig, names)


def _frees_poses(settings: ReconstructConfig, rig: Rig, names: Sequence[str]) -> bool:
    if settings.refine_rig == "auto":
        moving = [n for n in pose_names(rig) if n.split(".")[0] in names]
        return bool(moving) and set(moving) <= set(rig.sigmas)
    return settings.refine_rig == "on"


def refine_rig(
    mapped: Mapped,
    seen: Observations,
    rig: Rig,
    distances: WorkingDistances | None,
    adjust: NavigationAdjuster,
    datum: Datum | None,
    folder: Path,
    settings: ReconstructConfig,
) -> RefinedSurvey | str:
    """Refine a rig from a model, as far as `frees_rig` calls for it, and map again on it.

    Args:
        mapped: model on the rig, near its end; picture i of `seen` has the id i + 1.
        seen: keypoints as warped by the model's lenses.
        rig: as calibrated or designed.
        distances: for which the new lenses are the best.
        adjust: that adjusted the model.
        datum: of the positions of navigation.
        folder: where `port.json` and `rig.json` go.
        settings: `refine_port` and `refine_rig`.

    Returns:
        The survey on its refined rig; or what prevented it, where the settings do not insist.

    Raises:
        ReconstructionError: the settings insist, and the model has no scale, or the survey does not
            determine what is to be refined.
    """
    names = list(seen.cameras)
    fixes = None
    if datum is not None and adjust.sigmas is not None:
        fixes = navigation_fixes(mapped.model, seen, datum)
    try:
        if not mapped.scaled or distances is None:
            raise ReconstructionError(
                "refine_port and refine_rig need two cameras, whose known baseline gives the "
                'scale: set refine_port = false and refine_rig = "off" in survey.toml'
            )
        pose = _frees_poses(settings, rig, names)
        fit = fit_rig(mapped, seen, rig, port=settings.refine_port, pose=pose, fixes=fixes)
    except ReconstructionError as error:
        if settings.refine_port or settings.refine_rig == "on":
            raise
        return f"rig as calibrated: {error}"
    warps = {
        name: best_warp(fit.rig.cameras[name], distances.near_m, distances.far_m) for name in names
    }
    mapped, seen = on_rig(mapped, seen, fit, warps)
    adjust = NavigationAdjuster(seen.images, fit.rig, warps, datum)
    poses = {name: fit.rig.cam_from_rig[name] for name in names}
    mapped, convergence = refract(mapped, seen, folder, adjust, poses, near=True)
    PortRecord.save(folder / "port.json", fit.to_json())
    write_rig(folder / "rig.json", fit.rig)
    return RefinedSurvey(
        mapped=mapped, seen=seen, rig=fit.rig, convergence=convergence, adjust=adjust
    )


def on_rig(
    mapped: Mapped, seen: Observations, fit: RigFit, warps: Mapping[str, PinholeWarp]
) -> tuple[Mapped, Observations]:
    """A model and its keypoints for the pinholes of a refined rig."""
    model = pycolmap.Reconstruction(mapped.model)
    names = list(seen.cameras)
    pinholes = {name: colmap_pinhole(warps[name].pinhole) for name in names}
    seen = replace(seen, warps=warps, cameras=pinholes)
    pinhole_from_rig: dict[str, RigidTransform] = {
        name: warps[name].pinhole_from_cam * fit.rig.cam_from_rig[name] for name in names
    }
    rig_from_reference = pinhole_from_rig[names[0]].inv()
    for number, name in enumerate(names, 1):
        camera = model.cameras[number]
        camera.width, camera.height = warps[name].pinhole.size_px
        camera.params = pinholes[name].params
        if number > 1:
            for rig in model.rigs.values():
                rig.set_sensor_from_rig(
                    camera.sensor_id, rigid3d(pinhole_from_rig[name] * rig_from_reference)
                )
    frames = frames_of(model).tolist()
    for frame, station in zip(frames, fit.stations, strict=True):
        pose = warps[names[0]].pinhole_from_cam * station.inv()
        model.frames[frame].rig_from_world = rigid3d(pose)
    for point, xyz in zip(fit.point_ids.tolist(), fit.points, strict=True):
        model.points3D[point].xyz = xyz
    for number, image in model.images.items():
        for point, xy in zip(image.points2D, seen.pixels[number - 1], strict=True):
            point.xy = xy
    if len(fit.points) < len(model.points3D):  # the others lie where the old rig had them
        move_points(model, fit.sigma_px)
    notes = (*mapped.notes, "rig and port refined from the survey's own pictures")
    baseline = model_baseline(model)
    return replace(mapped, model=model, warps=warps, baseline=baseline, notes=notes), seen


def navigation_fixes(
    model: pycolmap.Reconstruction, seen: Observations, datum: Datum
) -> NavigationFixes:
    """Where navigation says that the body's origin was, by ascending frame."""
    bodies = positions_ned(seen.images, datum)
    frames = frames_of(model).tolist()
    positions, sigmas = np.full((len(frames), 3), np.nan), np.full((len(frames), 3), np.nan)
    for frame, number in first_pictures(model).items():
        record, row = seen.images[number - 1], frames.index(frame)
        positions[row] = bodies[number - 1]
        level = record.sigma_horizontal_m
        sigmas[row] = [level, level, record.sigma_depth_m]
    sigmas[~(sigmas > 0).all(axis=1)] = np.nan
    return NavigationFixes(positions=positions, sigmas=sigmas)
