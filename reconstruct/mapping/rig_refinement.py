"""Port, water and rig refined from the survey's own pictures, through the exact flat-port cameras.

An adjustment of stations, points and the rig's parameters, each parameter within what calibration
knew of it: the covariance of `rig.json`, or wide bounds where it has none. What is requested is
free; other uncertain parameters of the calibration (focal lengths, say) moves with it within its
covariance, since holding that would push its errors into what is requested.

The model is then rebuilt on the refined rig: settings `refine_port`, `refine_rig`. It writes
`port.json` (values, sigmas, correlation) and `rig.json` (the refined rig) next to the model.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.sparse import block_diag, csc_matrix
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.base.config import ReconstructConfig
from alice_survey.base.errors import ReconstructionError, warn
from alice_survey.base.frames import Array, Datum
from alice_survey.base.records import PortRecord
from alice_survey.base.run import progress
from camera_calib.approximation.pinhole_warp import PinholeWarp, best_warp
from camera_calib.freedom import POSE as TURN_AND_SHIFT
from camera_calib.freedom import Prior, pose_names, value
from camera_calib.ports.values import lowest
from camera_calib.rig import Covariance, Rig, write_rig
from reconstruct.mapping.arrays import Indices, first_pictures, frames_of
from reconstruct.mapping.bundle import move_points
from reconstruct.mapping.database import Observations
from reconstruct.mapping.exact_observations import (
    Pixels,
    RigState,
    calibrated_parameters,
    choose_pixels,
    exact_observations,
    start_state,
)
from reconstruct.mapping.mapper import Mapped, model_baseline
from reconstruct.mapping.normal_equations import (
    POSE,
    TURN_INFORMATION,
    LinearObservations,
    ReducedSystem,
    moved_points,
    reduce_points,
    solver_of,
)
from reconstruct.mapping.priors import NavigationAdjuster
from reconstruct.mapping.refraction import Convergence, refract
from reconstruct.mapping.robust import cauchy_weights, sigma_of, variance_of
from reconstruct.mapping.working_range import WorkingDistances
from reconstruct.matching.pairs import positions_ned
from reconstruct.views.model_files import colmap_pinhole, rigid3d

_PORT_SIGMAS = {
    "port_distance_m": 0.02, "normal_x": 0.05, "normal_y": 0.05, "n_water": 0.005,
    "dome_x_m": 0.005, "dome_y_m": 0.005, "dome_z_m": 0.02,
}  # fmt: skip
_RIG_SIGMAS = dict(zip(TURN_AND_SHIFT, [0.02] * 3 + [0.005] * 3, strict=True))
"""Prior sigmas of parameters that no calibration determines: very wide."""
_LEVER = ("lever.x_m", "lever.y_m", "lever.z_m")
"""The body's origin in the rig's frame."""
_LEVER_SIGMA_M = 0.05
_MOST_CORRELATED = 0.98
"""Correlation of navigation's errors from one station to the next."""
_BASELINE_SIGMA_M = 1e-7
"""Sigma of an uncalibrated baseline: it is the scale, which no picture determines."""
_ROUNDS = 20
_SETTLED = 3e-2
"""Steps of all parameters, in their sigmas, at which the adjustment ends."""


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
        sigmas = np.sqrt(np.diag(self.covariance))
        scale = 1.0 / np.where(sigmas > 0, sigmas, np.inf)
        return {
            "parameters": list(self.parameters),
            "before": self.before.tolist(),
            "after": self.after.tolist(),
            "prior_sigmas": self.prior_sigmas.tolist(),
            "sigmas": sigmas.tolist(),
            "correlation": (self.covariance * np.outer(scale, scale)).tolist(),
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
    prior = _prior(rig, names, port=port, pose=pose)
    fields = prior.parameters
    fixes = fixes if pose else None
    information = np.zeros((len(fields) + 3 * (fixes is not None),) * 2)
    information[: len(fields), : len(fields)] = prior.information
    if fixes is not None:
        information[-3:, -3:] = np.eye(3) / _LEVER_SIGMA_M**2
    _hold_baseline(information, fields, rig, names)
    state = start_state(mapped, rig, names, frames, ids)
    fixes = None if fixes is None else _with_correlation(fixes, state)
    first = _values(state, fields, names, lever=fixes is not None)
    drift = np.zeros(len(first))
    variance = np.nan
    for _ in range(_ROUNDS):
        linear = exact_observations(state, pixels, fields, names, lever=fixes is not None)
        left = _spare(pixels, len(frames), len(first)) / (2 * len(pixels.station))
        sigma = sigma_of(linear.miss, linear.seen_by, len(frames))
        weights = cauchy_weights(linear.miss, sigma)
        now = variance_of(linear.miss, weights, left)
        linear = linear.weighted(weights)
        variance = now if np.isnan(variance) else min(variance, now)
        step = _step(linear, state, variance, information, drift, fixes)
        state = _moved(state, pixels, step, linear, fields, names)
        drift = drift + step.shared
        if np.all(np.abs(step.shared) < _SETTLED * np.sqrt(np.diag(step.covariance))):
            break
    else:
        warn(f"the rig's refinement did not settle in {_ROUNDS} rounds: trust it with care")
    parameters = (*fields, *(_LEVER if fixes is not None else ()))
    after = _values(state, fields, names, lever=fixes is not None)
    return RigFit(
        rig=_as_rig(rig, names, state, fields, step.covariance, fixes is not None),
        parameters=parameters,
        before=first,
        after=after,
        prior_sigmas=np.sqrt(np.diag(_inverse(information))),
        covariance=step.covariance,
        sigma_px=float(np.sqrt(variance / weights.mean())),
        observations=len(pixels.station),
        stations=tuple(
            RigidTransform.from_components(c, Rotation.from_matrix(r))
            for r, c in zip(state.turns, state.centres, strict=True)
        ),
        points=state.points,
        point_ids=ids,
    )


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


def _spare(pixels: Pixels, stations: int, shared: int) -> int:
    spare = 2 * len(pixels.station) - 3 * pixels.points - POSE * stations
    if spare < 10 * shared:
        raise ReconstructionError(
            f"{len(pixels.station)} observations of {pixels.points} points from {stations} "
            f"stations do not determine {shared} parameters of the rig: leave refine_port and "
            "refine_rig off"
        )
    return spare


def _prior(rig: Rig, names: Sequence[str], *, port: bool, pose: bool) -> Prior:
    """What is known before the pictures of what may move."""
    known = calibrated_parameters(rig, names)
    wide: dict[str, float] = {}
    if port:
        for name in names:
            camera = rig.cameras[name]
            if camera.refracts:
                found = (*camera.port.estimated, "n_water")
                wide |= {f"{name}.{field}": _PORT_SIGMAS[field] for field in found}
    if pose:
        wide |= {
            name: _RIG_SIGMAS[name.split(".")[1]]
            for name in pose_names(rig)
            if name.split(".")[0] in names
        }
    wide = {name: sigma for name, sigma in wide.items() if name not in known}
    loose = Prior.around(rig, wide)
    return Prior.of_rig(rig, known).and_also(loose) if known else loose


def _hold_baseline(
    information: Array, fields: Sequence[str], rig: Rig, names: Sequence[str]
) -> None:
    """Keep the length of a baseline that no calibration measured, in place."""
    known = rig.sigmas
    for name in names:
        at = [
            fields.index(n)
            for n in (f"{name}.{axis}" for axis in TURN_AND_SHIFT[3:])
            if n in fields
        ]
        if len(at) < 3 or f"{name}.x_m" in known:
            continue
        along = rig.cam_from_rig[name].translation
        along = along / np.linalg.norm(along)
        information[np.ix_(at, at)] += np.outer(along, along) / _BASELINE_SIGMA_M**2


def _values(state: RigState, fields: Sequence[str], names: Sequence[str], *, lever: bool) -> Array:
    now = Rig(
        cameras=dict(zip(names, state.cameras, strict=True)),
        cam_from_rig=dict(zip(names, state.cam_from_rig, strict=True)),
        body_from_rig=RigidTransform.identity(),
        source="",
    )
    values = [value(now, name) for name in fields]
    return np.array([*values, *(state.lever if lever else [])])


@dataclass(frozen=True, kw_only=True, eq=False)
class _RigStep:
    stations: Array
    shared: Array
    covariance: Array
    reduced: ReducedSystem


def _step(
    linear: LinearObservations,
    state: RigState,
    variance: float,
    information: Array,
    drift: Array,
    fixes: NavigationFixes | None,
) -> _RigStep:
    """One Gauss-Newton step of stations and shared parameters, and the shared ones' covariance."""
    count = len(state.centres)
    reduced = reduce_points(linear, count)
    shared = reduced.shared / variance + information
    pull = reduced.shared_slope / variance + information @ drift
    border, slope = reduced.border / variance, reduced.slope / variance
    matrix = csc_matrix(reduced.matrix / variance)
    free = np.ones(POSE * count, dtype=np.bool_)
    if fixes is None:
        free[:POSE] = False
    else:
        extra = np.zeros((count, POSE, POSE))
        for s in np.flatnonzero(np.isfinite(fixes.positions + fixes.sigmas).all(axis=1)).tolist():
            arm = state.turns[s] @ state.lever
            x, y, z = arm
            rows = np.hstack([[[0, z, -y], [-z, 0, x], [y, -x, 0]], np.eye(3), state.turns[s]])
            rows = rows / fixes.sigmas[s][:, None]
            off = (state.centres[s] + arm - fixes.positions[s]) / fixes.sigmas[s]
            extra[s] = rows[:, :POSE].T @ rows[:, :POSE]
            extra[s][[0, 1, 2], [0, 1, 2]] += TURN_INFORMATION
            at = slice(POSE * s, POSE * s + POSE)
            border[at, -3:] += rows[:, :POSE].T @ rows[:, POSE:]
            slope[at] += rows[:, :POSE].T @ off
            shared[-3:, -3:] += rows[:, POSE:].T @ rows[:, POSE:]
            pull[-3:] += rows[:, POSE:].T @ off
        matrix = csc_matrix(matrix + block_diag(list(extra), format="csc"))
    solve = solver_of(matrix, free)
    back, plain = solve(border), solve(slope)
    covariance = _inverse(shared - border.T @ back)
    moved = -covariance @ (pull - border.T @ plain)
    return _RigStep(
        stations=(-plain - back @ moved).reshape(count, POSE),
        shared=moved,
        covariance=covariance,
        reduced=reduced,
    )


def _inverse(matrix: Array) -> Array:
    """Inverse of a symmetric matrix whose parameters have many units."""
    scale = 1.0 / np.sqrt(np.diag(matrix))
    inverse: Array = np.linalg.inv(matrix * np.outer(scale, scale)) * np.outer(scale, scale)
    return (inverse + inverse.T) / 2.0


def _moved(
    state: RigState,
    pixels: Pixels,
    step: _RigStep,
    linear: LinearObservations,
    fields: Sequence[str],
    names: Sequence[str],
) -> RigState:
    points = moved_points(
        linear.starts, linear.station, linear.by_point, linear.arm, linear.by_shared, linear.miss,
        step.reduced.point_inverse, step.stations, step.shared,
    )  # fmt: skip
    cameras, poses = list(state.cameras), list(state.cam_from_rig)
    for c, name in enumerate(names):
        changes: dict[str, float] = {}
        motion = np.zeros(POSE)
        for g, field in enumerate(fields):
            camera, parameter = field.split(".")
            if camera != name:
                continue
            if parameter in cameras[c].parameters:
                changes[parameter] = max(
                    lowest(parameter), cameras[c].parameter(parameter) + step.shared[g]
                )
            else:
                motion[TURN_AND_SHIFT.index(parameter)] = step.shared[g]
        cameras[c] = cameras[c].with_parameters(changes)
        poses[c] = RigidTransform.from_components(
            poses[c].translation + motion[3:],
            Rotation.from_rotvec(motion[:3]) * poses[c].rotation,
        )
    turns = Rotation.from_rotvec(step.stations[:, :3]).as_matrix() @ state.turns
    lever = state.lever + step.shared[-3:] if len(step.shared) > len(fields) else state.lever
    return RigState(
        cameras=tuple(cameras),
        cam_from_rig=tuple(poses),
        turns=turns,
        centres=state.centres + step.stations[:, 3:],
        points=state.points + points,
        lever=lever,
    )


def _as_rig(
    rig: Rig,
    names: Sequence[str],
    state: RigState,
    fields: Sequence[str],
    covariance: Array,
    lever: bool,
) -> Rig:
    reference = rig.cam_from_rig[names[0]]
    cameras = {**rig.cameras, **dict(zip(names, state.cameras, strict=True))}
    moved: Mapping[str, RigidTransform] = {
        name: pose * reference for name, pose in zip(names, state.cam_from_rig, strict=True)
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
