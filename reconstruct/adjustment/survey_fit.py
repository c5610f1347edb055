"""The last adjustment: stations, points and the rig's parameters, on exact rays.

Each parameter of the rig moves within what calibration knew of it: the covariance of `rig.json`, or
wide bounds where it has none. Where anything is free, all uncertain parameters of the calibration
(focal lengths, say) move within its covariance, since holding them would push their errors into
what is free. The model is then rebuilt on the pinholes of the refined rig.

A detector of features finds texture whose blur, light and scale change over a picture a little off,
and does so in all pictures alike, so that the number of keypoints does not lessen it: half a
hundredth of a pixel, fitted as a focal length, an index of the water or a tilt of a port, moves
surfaces by more than all other noise. Where the rig is free, each camera therefore has shifts of
its keypoints, a smooth field over the frame with a prior, and the rig moves by what these leave.

A right calibration with covariance P lets pictures move its parameters by d, and leaves the
covariance Q: d is then normal with covariance P - Q. In the directions that pictures measure, the
eigenvectors u of P^-1/2 (P - Q) P^-T/2 with eigenvalues above zero, (u . P^-1/2 d)^2 / eigenvalue
adds up to chi-square. Where that contradicts the calibration, its sigmas are too small by the root
of chi-square over the number of directions, and so are all that follow from them.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
import pycolmap
from scipy.linalg import block_diag
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.special import chdtrc

from alice_survey.core.block_solver import BlockStep, Flags, inverse_of, minimise
from alice_survey.core.config import ReconstructConfig
from alice_survey.core.errors import ReconstructionError, warn
from alice_survey.core.frames import Array
from alice_survey.core.manifest import ImageRecord
from alice_survey.core.records import PortRecord, RangeRecord
from alice_survey.core.run import progress
from camera_calib.approximation.pinhole_warp import PinholeWarp, best_warp
from camera_calib.freedom import POSE as TURN_AND_SHIFT
from camera_calib.freedom import Prior, at_bound, move_rig, part_of_rig, pose_names, value
from camera_calib.lenses.fisheye import FisheyeLens
from camera_calib.lenses.opencv import OpenCVLens
from camera_calib.rig import Covariance, Rig
from reconstruct.adjustment.exact_observations import (
    ALONE,
    PixelParts,
    Pixels,
    RigState,
    Workers,
    calibrated_parameters,
    exact_survey,
    linearise_parts,
)
from reconstruct.adjustment.normal_equations import POSE, PointEquations, reduce_parts
from reconstruct.adjustment.uncertainty import Motions, SoftModes, Uncertainty, estimate
from reconstruct.mapping.arrays import (
    MIN_POINTS,
    Indices,
    first_of,
    frames_of,
    linked_groups,
    observations,
    rig_poses,
)
from reconstruct.mapping.bundle import (
    loss_scale,
    move_points,
    robust_cost,
    robust_weights,
    sigma_of,
    variance_of,
)
from reconstruct.mapping.database import Observations
from reconstruct.mapping.mapper import Mapped, model_baseline
from reconstruct.mapping.refraction import Keypoints
from reconstruct.views.model_files import colmap_pinhole, rigid3d, stored_of

BIAS_PX = {OpenCVLens.model: 0.01, FisheyeLens.model: 0.04}
"""Sigma of the shift of keypoints by lens, root mean square over a picture: 0.0015 and 0.006 for
each polynomial. In rendered surveys the largest of these are 0.001 behind flat ports and 0.007 with
a fisheye, where a line is flown again in the other direction and the lamps come from the other
side."""


def shift_information(state: RigState) -> Array:
    """What is known before the pictures of the shifts of a state, as a matrix (S, S).

    All of a camera are equally likely, which makes the square of its `BIAS_PX` the expected mean
    square over the picture.
    """
    count = state.shifts[:1].size
    lenses = [camera.lens.model for camera in state.rig.cameras.values()]
    return np.diag(np.repeat([count / BIAS_PX[lens] ** 2 for lens in lenses], count))


_MEASURED = 0.05
"""Share of the prior variance that pictures take away, from which a direction is measured."""
_UNLIKELY = 1e-4
"""Probability of the whole pull, if the calibration were right, below which it is named."""
_CHANCE = 0.02
"""Probability that the most moved of so many parameters moves as far, above which none is named."""
_FAR = 2.0
"""Prior sigmas from which a parameter is named next to the most moved."""
_MAX_NAMED = 4


@dataclass(frozen=True, kw_only=True)
class Contradiction:
    """Pictures and calibration disagree by more than chance."""

    chi_square: float
    directions: int
    """Combinations of parameters that the pictures measure: the mean of a right calibration's."""
    pulls: Mapping[str, float]
    """Parameters that moved by the most prior sigmas, by how many, the most moved first."""

    @property
    def words(self) -> str:
        """What to tell, in one line."""
        moved = ", ".join(f"{name} by {pull:+.1f} sigmas" for name, pull in self.pulls.items())
        return (
            f"the pictures contradict the calibration (chi-square {self.chi_square:.0f} of "
            f"{self.directions}): they move {moved} of what it states: calibrate again in the "
            "water, or state sigmas that hold"
        )


def contradiction(
    parameters: Sequence[str], change: Array, prior: Array, left: Array
) -> Contradiction | None:
    """What pictures say against a calibration; None where they agree with it.

    Args:
        parameters: (G,) names.
        change: (G,) by the adjustment.
        prior: (G, G) covariance before.
        left: (G, G) covariance after.
    """
    if not len(parameters):
        return None
    sigmas = np.sqrt(np.diag(prior))
    values, axes = np.linalg.eigh(prior / np.outer(sigmas, sigmas))
    kept = values > values.max() * len(values) * np.finfo(float).eps
    white = (axes[:, kept] / np.sqrt(values[kept])).T / sigmas
    gain, directions = np.linalg.eigh(np.eye(kept.sum()) - white @ left @ white.T)
    measured = gain > _MEASURED
    along = directions[:, measured].T @ (white @ change)
    total = float((along**2 / gain[measured]).sum())
    count, pulls = int(measured.sum()), change / sigmas
    far = [int(k) for k in np.argsort(-np.abs(pulls)) if abs(pulls[k]) > _FAR][:_MAX_NAMED]
    # Parameters that go together are known to thousandths of a pixel: alone that shows nothing.
    by_chance = len(pulls) * chdtrc(1, (pulls**2).max()) > _CHANCE
    if count == 0 or by_chance or chdtrc(count, total) > _UNLIKELY:
        return None
    named = {parameters[k]: float(pulls[k]) for k in far}
    return Contradiction(chi_square=total, directions=count, pulls=named)


_RIG_SIGMAS = dict(zip(TURN_AND_SHIFT, [0.02] * 3 + [0.005] * 3, strict=True))
"""Prior sigmas of parameters that no calibration determines: very wide."""
_BASELINE_SIGMA_M = 1e-7
"""Sigma of an uncalibrated baseline: it is the scale, which no picture determines."""
_STEPS = 20
_MAX_PLACES = 50_000
"""Points whose motions by 120 parameters take 150 MB."""
_SETTLED = 0.05
"""Length of a step of all parameters, in sigmas, at which the adjustment ends."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SurveyFit:
    """An adjusted survey, and how well its rig is known."""

    calibrated: Rig
    """The rig before."""
    state: RigState
    """Stations by ascending frame, and those points that took part."""
    point_ids: Indices
    parameters: tuple[str, ...]
    """What was adjusted of the rig."""
    before: Array
    """(G,) values, in the parameters' units."""
    prior_covariance: Array
    """(G, G) covariance of the values before."""
    covariance: Array
    """(G, G) covariance of the values."""
    calibration: Motions | None
    """What errors of the rig do to the block; None where they are unknown."""
    sigma_px: float
    """Sigma of one coordinate of a keypoint."""
    observations: int
    contradiction: Contradiction | None
    """What the pictures say against the calibration, by which `covariance` is wider; None where
    they agree with it."""

    @property
    def after(self) -> Array:
        """(G,) adjusted values."""
        return np.array([value(self.state.rig, name) for name in self.parameters])

    @cached_property
    def rig(self) -> Rig:
        """The rig with the covariance of all that was adjusted; as calibrated if nothing was."""
        if not self.parameters:
            return self.calibrated
        reference = self.calibrated.cam_from_rig[next(iter(self.state.rig.cameras))]
        poses = {name: pose * reference for name, pose in self.state.rig.cam_from_rig.items()}
        return replace(
            self.calibrated,
            cameras={**self.calibrated.cameras, **self.state.rig.cameras},
            cam_from_rig={**self.calibrated.cam_from_rig, **poses},
            source=f"{self.calibrated.source}; refined from the survey",
            covariance=Covariance(parameters=self.parameters, matrix=self.covariance),
        )

    def deform(self, modes: SoftModes, point_ids: Indices, sizes: Array, left: Array) -> Self:
        """The survey after measurements from outside have said how large its soft modes are.

        Args:
            modes: of the block.
            point_ids: (P,) of the modes' points, ascending.
            sizes: (K,) of every mode, in its sigmas.
            left: (K, K) covariance of these.
        """
        state, rows = self.state, np.searchsorted(point_ids, self.point_ids)
        turns, centres, points = modes.move(sizes, state.centres, state.points, rows)
        rig, covariance = state.rig, self.covariance
        if self.parameters:
            by_rig = modes.calibration[: len(self.parameters)]  # shifts come after
            rig = move_rig(rig, self.parameters, by_rig @ sizes)
            covariance = covariance - by_rig @ (np.diag(modes.known) - left) @ by_rig.T
        return replace(
            self,
            covariance=covariance,
            state=replace(
                state, rig=rig, turns=turns.as_matrix() @ state.turns, centres=centres,
                points=points,
            ),
        )  # fmt: skip

    @property
    def record(self) -> PortRecord:
        """What `port.json` says."""
        known = Covariance(parameters=self.parameters, matrix=self.covariance)
        found = self.contradiction
        return PortRecord(
            stations=len(self.state.centres),
            observations=self.observations,
            parameters=self.parameters,
            before=tuple(self.before.tolist()),
            after=tuple(self.after.tolist()),
            prior_sigmas=tuple(np.sqrt(np.diag(self.prior_covariance)).tolist()),
            sigmas=tuple(known.sigmas.values()),
            correlation=tuple(map(tuple, known.correlation.tolist())),
            contradiction=None if found is None else found.words,
            sigma_px=self.sigma_px,
        )


@progress.step("adjust stations, points and rig")
def fit_survey(
    mapped: Mapped,
    seen: Observations,
    rig: Rig,
    *,
    port: bool,
    pose: bool,
    workers: Workers = ALONE,
) -> SurveyFit:
    """Adjust a finished model on exact rays.

    Args:
        mapped: exact model on the rig, in metres; picture i of `seen` has the id i + 1.
        seen: keypoints as warped by the model's lenses.
        rig: as calibrated or designed.
        port: free distance and normal of the ports and the water's index.
        pose: free the poses of the cameras on the rig. Without both the rig is held.
        workers: where parts of a large survey are worked on.

    Raises:
        ReconstructionError: the survey does not determine what is requested.
    """
    names = list(seen.cameras)
    pixels, start, ids = exact_survey(mapped, seen, rig)
    free = _prior(rig, names, port=port, pose=pose) if port or pose else Prior.around(rig, {})
    pixels, order = pixels.by_place(start.centres)
    start = replace(start, points=start.points[order])
    before = np.array([value(start.rig, name) for name in free.parameters])
    problem = SurveyProblem(pixels, start, free, workers)
    found = minimise(problem, problem.start, settled=_SETTLED, max_steps=_STEPS)
    if free.parameters:  # from near by: with shifts a step takes five times as long
        problem = SurveyProblem(pixels, found.guess.state.with_shifts(), free, workers)
        found = minimise(problem, problem.start, settled=_SETTLED, max_steps=_STEPS)
    if not found.is_settled:
        warn(f"the last adjustment did not settle in {_STEPS} steps: trust it with care")
    equations, guess = found.equations, found.guess
    known, own = inverse_of(equations.information), slice(len(problem.fields))
    covariance, fields = known[own, own], problem.fields
    if not fields:  # held: what errors of the calibration do, all the same
        fields = calibrated_parameters(rig, names)
        guess = replace(guess, state=guess.state.with_shifts())
        known = inverse_of(calibrated_information(guess.state, fields))
        equations = problem.reduce(guess, found.noise, fields)
    sigma_px, variance = found.noise.tolist()
    prior_covariance = inverse_of(problem.information)[own, own]
    change = np.array([value(guess.state.rig, name) for name in problem.fields]) - before
    against = contradiction(problem.fields, change, prior_covariance, covariance)
    wider = 1.0 if against is None else max(1.0, against.chi_square / against.directions)
    return SurveyFit(
        calibrated=rig,
        state=replace(guess.state, points=guess.state.points[np.argsort(order)]),
        point_ids=ids,
        parameters=problem.fields,
        before=before,
        prior_covariance=prior_covariance,
        covariance=wider * covariance,
        calibration=motions_of(equations, guess.state.points, wider * known) if fields else None,
        sigma_px=float(np.sqrt(variance / robust_weights(guess.miss, sigma_px).mean())),
        observations=len(pixels.station),
        contradiction=against,
    )


def motions_of(equations: PointEquations, points: Array, covariance: Array) -> Motions:
    """What changes of the shared parameters do to stations and to points, evenly chosen.

    Args:
        equations: of the block.
        points: (P, 3).
        covariance: (G, G) of the parameters.
    """
    stations, every = equations.response, -(-len(points) // _MAX_PLACES)
    return Motions(
        stations=stations,
        places=points[::every],
        points=equations.follow_shared(stations, every),
        covariance=covariance,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Guess:
    """One guess of all unknowns, with what is seen from there."""

    state: RigState
    miss: Array
    """(O, 2) computed pixels minus observed ones, 0 where no ray explains one."""
    lost: int
    """Observations that no ray explains: they do not count."""


class SurveyProblem:
    """Stations, points and rig of a survey as `minimise` adjusts them."""

    def __init__(
        self, pixels: Pixels, state: RigState, prior: Prior, workers: Workers = ALONE
    ) -> None:
        self.pixels, self.prior, self.fields = pixels, prior, prior.parameters
        self.parts = PixelParts(pixels, len(state.centres), workers)
        known = prior.information.copy()
        _hold_baseline(known, self.fields, state.rig)
        self.information = block_diag(known, shift_information(state))
        observed, stations = len(pixels.station), len(state.centres)
        spare, shared = 2 * observed - 3 * pixels.points - POSE * stations, len(known)
        if spare < 10 * shared:
            raise ReconstructionError(
                f"{observed} observations of {pixels.points} points from {stations} stations do "
                f"not determine {shared} parameters of the rig: leave refine_port and refine_rig "
                "off"
            )
        self.left = spare / (2 * observed)
        seen = np.bincount(pixels.station, minlength=len(state.centres))
        self.held = seen < MIN_POINTS
        group = linked_groups(pixels.station, pixels.point, len(seen))
        self.held[first_of(group)] = True
        self.start = self._observations(state)

    def _observations(self, state: RigState) -> _Guess:
        miss = self.parts.residuals(state)
        lost = ~np.isfinite(miss).all(axis=1)
        miss[lost] = 0.0
        return _Guess(state=state, miss=miss, lost=int(lost.sum()))

    def noise(self, guess: _Guess) -> Array:
        """Sigma of a keypoint's coordinate for the weights, and variance that scales them."""
        miss = guess.miss
        sigma = sigma_of(miss, self.pixels.seen_by, len(guess.state.centres))
        return np.array([sigma, variance_of(miss, robust_weights(miss, sigma), self.left)])

    def cost(self, guess: _Guess, noise: Array) -> float:
        """Half of the robust loss and prior."""
        if guess.lost > self.start.lost:
            return math.inf
        off = self.misfit(guess.state)
        pixels = robust_cost(guess.miss, noise[0]) / noise[1]
        return 0.5 * float(pixels + off @ self.information @ off)

    def linearise(self, guess: _Guess, noise: Array) -> PointEquations:
        """Normal equations with the points eliminated."""
        found = self.reduce(guess, noise, self.fields)
        found.shared[:-1, :-1] += self.information
        found.shared[:-1, -1] += self.information @ self.misfit(guess.state)
        return found

    def misfit(self, state: RigState) -> Array:
        """How far rig and shifts are from what is expected of them."""
        return np.concatenate([self.prior.misfit(state.rig), state.shifts.ravel()])

    def reduce(self, guess: _Guess, noise: Array, fields: Sequence[str]) -> PointEquations:
        """The same without what is known before the pictures, for any fields of the rig."""
        sigma, variance = noise.tolist()
        found = reduce_parts(linearise_parts(self.parts, guess.state, fields, (sigma, variance)))
        found.free[self.held] = False
        return found

    def move(self, guess: _Guess, equations: PointEquations, step: BlockStep) -> _Guess:
        """The guess after a step."""
        state, by_rig, by_shifts = guess.state, *np.split(step.shared, [len(self.fields)])
        return self._observations(
            RigState(
                rig=move_rig(state.rig, self.fields, by_rig),
                turns=Rotation.from_rotvec(step.poses[:, :3]).as_matrix() @ state.turns,
                centres=state.centres + step.poses[:, 3:],
                points=state.points + equations.point_steps(step),
                shifts=state.shifts + by_shifts.reshape(state.shifts.shape),
            )
        )

    def at_bound(self, guess: _Guess) -> Flags:
        """Parameters that have their least value."""
        rig = at_bound(guess.state.rig, self.fields)
        return np.concatenate([rig, np.zeros(guess.state.shifts.size, np.bool_)])


def _prior(rig: Rig, names: Sequence[str], *, port: bool, pose: bool) -> Prior:
    """What is known before the pictures of what may move."""
    known = calibrated_parameters(rig, names)
    wide: dict[str, float] = {}
    for name in names if port else ():
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


def calibrated_information(state: RigState, names: Sequence[str]) -> Array:
    """What a calibration and a detector know of where keypoints lie: parameters, then shifts."""
    rig = np.zeros((0, 0))
    if state.rig.covariance is not None:
        rig = inverse_of(state.rig.covariance.marginal(names).matrix)
    return block_diag(rig, shift_information(state))


def _hold_baseline(information: Array, fields: Sequence[str], rig: Rig) -> None:
    """Keep the length of a baseline that no calibration measured, in place."""
    for name, pose in rig.cam_from_rig.items():
        shift = [f"{name}.{axis}" for axis in TURN_AND_SHIFT[3:]]
        if set(shift) <= set(fields) and shift[0] not in rig.sigmas:
            at = [fields.index(field) for field in shift]
            along = pose.translation / np.linalg.norm(pose.translation)
            information[np.ix_(at, at)] += np.outer(along, along) / _BASELINE_SIGMA_M**2


def frees_poses(settings: ReconstructConfig, rig: Rig, names: Sequence[str]) -> bool:
    """Whether the settings, or the calibration, leave the poses of cameras to the survey.

    A calibration that states its covariance does, unless that is turned off: the two together know
    more than either.
    """
    if settings.refine_rig == "auto":
        moving = [n for n in pose_names(rig) if n.split(".")[0] in names]
        return bool(moving) and set(moving) <= set(rig.sigmas)
    return settings.refine_rig == "on"


@dataclass(frozen=True, kw_only=True, eq=False)
class ExactSurvey:
    """A survey adjusted on exact rays."""

    mapped: Mapped
    """As it was mapped."""
    seen: Observations
    distances: RangeRecord
    """For which the pinholes are the best."""
    fit: SurveyFit

    def on_pinholes(self) -> Mapped:
        """A model of the pinholes of its rig, with keypoints where these see them."""
        fit, warps = self.fit, self.mapped.warps
        if fit.parameters:
            near, far = self.distances.near_m, self.distances.far_m
            warps = {name: best_warp(fit.rig.cameras[name], near, far) for name in warps}
        model = pycolmap.Reconstruction(self.mapped.model)
        names = list(self.seen.cameras)
        pinholes = {name: colmap_pinhole(warps[name].pinhole) for name in names}
        seen = replace(self.seen, warps=warps, cameras=pinholes)
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
        stations = RigidTransform.from_components(
            fit.state.centres, Rotation.from_matrix(fit.state.turns)
        )
        rig_from_world = warps[names[0]].pinhole_from_cam * stations.inv()
        _put(model, rig_from_world, fit.point_ids, fit.state.points)
        for number, image in model.images.items():
            for point, xy in zip(image.points2D, seen.pixels[number - 1], strict=True):
                point.xy = xy
        notes = self.mapped.notes
        if fit.parameters:
            notes = (*notes, "rig refined from the survey's own pictures")
        found = replace(
            self.mapped, model=model, warps=warps, baseline=model_baseline(model), notes=notes
        )
        keypoints = Keypoints(found, seen)
        if len(fit.point_ids) < len(model.points3D):  # the others lie where the old rig had them
            keypoints.correct(model, 1.0)
            move_points(model, loss_scale(fit.sigma_px))
        keypoints.correct(model, 1.0)
        model.update_point_3d_errors()
        return found


@dataclass(frozen=True, kw_only=True, eq=False)
class AdjustedSurvey:
    """A model of pinholes after the last adjustment."""

    mapped: Mapped
    rig: Rig | None
    exact: ExactSurvey | None
    """What the model stands for; None where lenses or scale are not known beforehand."""
    shape: Uncertainty | None
    """How well its shape is known; None where it is not."""

    def deform(self, sizes: Array, left: Array) -> Self:
        """The same after measurements from outside have said how large its soft modes are.

        Args:
            sizes: (K,) of every mode of the `shape`, in its sigmas.
            left: (K, K) covariance of these.
        """
        if self.shape is None:
            raise ValueError("a model of unknown shape has no modes")
        shape, modes = self.shape.knowing(left), self.shape.modes
        if self.exact is None:
            return replace(self, mapped=_move_model(self.mapped, modes, sizes), shape=shape)
        fit = self.exact.fit.deform(modes, self.shape.point_ids, sizes, left)
        exact = replace(self.exact, fit=fit)
        return replace(self, mapped=exact.on_pinholes(), rig=fit.rig, exact=exact, shape=shape)


def adjust_survey(
    mapped: Mapped,
    records: Sequence[ImageRecord],
    rig: Rig | None,
    distances: RangeRecord | None,
    settings: ReconstructConfig,
    workers: Workers = ALONE,
) -> AdjustedSurvey:
    """Adjust a mapped survey a last time by its pictures and its calibration.

    Args:
        mapped: exact model; picture i of `records` has the id i + 1.
        records: pictures.
        rig: as calibrated; None where the cameras calibrated themselves.
        distances: for which the model's pinholes are the best.
        settings: `refine_port` and `refine_rig`.
        workers: where parts of a large survey are worked on.

    Raises:
        ReconstructionError: the settings insist on a refinement of the rig, and the model has no
            scale or does not determine it.
    """
    exact, notes = None, mapped.notes
    if rig is not None and list(rig.cameras) != list(mapped.warps):
        rig = part_of_rig(rig, list(mapped.warps))
    try:
        if rig is not None and distances is not None and mapped.scaled:
            names = list(mapped.warps)
            seen = Observations(
                images=records,
                cameras={name: colmap_pinhole(w.pinhole) for name, w in mapped.warps.items()},
                taken=taken_pixels(mapped.model, records, mapped.warps),
                pairs=(),
                warps=mapped.warps,
            )
            fit = fit_survey(
                mapped, seen, rig, port=settings.refine_port,
                pose=frees_poses(settings, rig, names), workers=workers,
            )  # fmt: skip
            exact = ExactSurvey(mapped=mapped, seen=seen, distances=distances, fit=fit)
        elif settings.refine_port or settings.refine_rig == "on":
            raise ReconstructionError(
                "refine_port and refine_rig need two cameras, whose known baseline gives the "
                'scale: set refine_port = false and refine_rig = "off" in survey.toml'
            )
    except ReconstructionError as error:
        if settings.refine_port or settings.refine_rig == "on":
            raise
        notes = (*notes, f"rig as calibrated: {error}")
    found = replace(mapped, notes=notes) if exact is None else exact.on_pinholes()
    shape, fit_of = None, None if exact is None else exact.fit
    try:
        with progress.step("covariance of the model"):
            shape = estimate(
                found, records, None if fit_of is None else fit_of.calibration,
                held=fit_of is not None and not fit_of.parameters,
                workers=workers.apart("covariance"),
            )  # fmt: skip
    except ReconstructionError as error:
        warn(f"no covariance: {error}")
    if exact is not None:
        rig = exact.fit.rig
    return AdjustedSurvey(mapped=found, rig=rig, exact=exact, shape=shape)


def taken_pixels(
    model: pycolmap.Reconstruction, records: Sequence[ImageRecord], warps: Mapping[str, PinholeWarp]
) -> list[Array]:
    """The keypoints of all pictures as taken, (N, 2) each.

    A keypoint that has a point is where its pinhole sees that spot, at the point's depth; others
    are as at the working range.

    Args:
        model: exact, in metres; picture i of `records` has the id i + 1.
        records: pictures.
        warps: by camera.
    """
    seen, stored = observations(model), stored_of(model).keypoints
    found = [np.zeros((0, 2))] * len(records)
    for number, rows in sorted(stored.items()):
        warp = warps[records[number - 1].camera]
        depths = np.full(len(rows), warp.working_depth_m)
        if number in seen.pictures:
            mine = seen.of(seen.row(number))
            depths[seen.keypoint[mine]] = seen.in_cameras[mine, 2]
        points = np.column_stack([warp.pinhole.slopes(rows["xy"]), np.ones(len(rows))])
        in_cam = points * depths[:, None] + np.array(warp.centre_m)
        found[number - 1] = warp.camera.project(in_cam)
    return found


def _move_model(mapped: Mapped, modes: SoftModes, sizes: Array) -> Mapped:
    """A model of pinholes with its soft modes (K,) of these sizes."""
    model = pycolmap.Reconstruction(mapped.model)
    frames, seen = frames_of(model), observations(model)
    poses = rig_poses(model, frames).inv()
    turns, centres, points = modes.move(sizes, poses.translation, seen.points, slice(None))
    stations = RigidTransform.from_components(centres, turns * poses.rotation)
    _put(model, stations.inv(), seen.point_ids, points)
    model.update_point_3d_errors()
    return replace(mapped, model=model)


def _put(
    model: pycolmap.Reconstruction, rig_from_world: RigidTransform, ids: Indices, points: Array
) -> None:
    """Put all stations and the points of these ids where they are, in place."""
    for frame, pose in zip(frames_of(model).tolist(), rig_from_world, strict=True):
        model.frames[frame].rig_from_world = rigid3d(pose)
    for point, xyz in zip(ids.tolist(), points, strict=True):
        model.points3D[point].xyz = xyz
