"""Normal equations of a calibration: observations of rig, ports and target poses.

The unknowns are a few parameters of the rig, those of the target's shape, and six of every view's
target pose. A view's pose meets only its own pixels, so that the equations have a small dense part
of rig and shape, a 6 x 6 block for every view, and what couples the two. Poses are eliminated block
by block (Schur complement).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.base.errors import CalibrationError
from alice_survey.base.frames import Array
from camera_calib.camera import Camera, pose_jacobian
from camera_calib.freedom import POSE, Freedom
from camera_calib.ports.values import lowest
from camera_calib.rig import Covariance, Rig
from camera_calib.target_shape import AS_DRAWN, TargetShape

Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]

_SINGULAR = 1e-13
"""Least eigenvalue of the rig's information, scaled to 1 if all else were known."""
_TURNS = len(POSE) // 2


@dataclass(frozen=True, kw_only=True, eq=False)
class State:
    """One guess of all unknowns."""

    cameras: tuple[Camera, ...]
    rotations: Array
    """(C, 3, 3) cam_from_rig, and (C, 3) its translation."""
    shifts: Array
    turns: Array
    """(V, 3, 3) rig_from_target, and (V, 3) its translation."""
    places: Array
    bend: Array
    """(K,) values of the target's shape."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Equations:
    """Normal equations: of rig and shape (P), of each view's pose, and between them."""

    rig: Array
    """(P, P)."""
    between: Array
    """(V, P, 6)."""
    view: Array
    """(V, 6, 6)."""
    rig_slope: Array
    """(P,) gradient."""
    view_slope: Array
    """(V, 6)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Slopes:
    """Derivatives of the pixels of one camera in the views it took part in."""

    camera: int
    views: Indices
    """(v,)."""
    at: Indices
    """(p,) the parameters on which these pixels depend."""
    rows: Array
    """(v, N, 2, p + 6 + 1) by these, by the view's pose; last the residual."""
    by_place: Array
    """(v, N, 2, 3) by the point in the target's frame."""


class CalibrationProblem:
    """Measured pixels, and the parameters that explain them."""

    def __init__(
        self,
        pixels: Array,
        points: Array,
        rig: Rig,
        freedom: Freedom,
        shape: TargetShape = AS_DRAWN,
    ) -> None:
        self.pixels, self.points, self.rig = pixels, np.asarray(points, dtype=np.float64), rig
        self.seen: Flags = np.asarray(np.isfinite(pixels).all(axis=-1))
        self.names = (*freedom.names(rig), *shape.parameters)
        self.shape = shape
        self.shape_at = np.arange(len(self.names) - len(shape.parameters), len(self.names))
        self.prior = freedom.prior.and_also(shape.prior)
        self.prior_information = self.prior.information
        self.prior_at = np.array(
            [self.names.index(n) for n in self.prior.parameters], dtype=np.intp
        )
        self.lens_columns, self.lens_at = self._columns(
            [camera.parameters for camera in rig.cameras.values()]
        )
        self.pose_columns, self.pose_at = self._columns([POSE] * len(rig.cameras))
        self.views = [np.flatnonzero(self.seen[:, c].any(axis=1)) for c in range(len(rig.cameras))]
        self.low = np.array([lowest(name.split(".")[1]) for name in self.names])

    def _columns(self, of: Sequence[Sequence[str]]) -> tuple[list[Indices], list[Indices]]:
        """For each camera: which of its fields are adjusted, and where they stand in the vector."""
        columns, places = [], []
        for camera, fields in zip(self.rig.cameras, of, strict=True):
            mine = [f for f in fields if f"{camera}.{f}" in self.names]
            columns.append(np.array([fields.index(f) for f in mine], dtype=np.intp))
            at = [self.names.index(f"{camera}.{f}") for f in mine]
            places.append(np.array(at, dtype=np.intp))
        return columns, places

    def state(self, rig: Rig, poses: RigidTransform, bend: Array | None = None) -> State:
        """A rig, poses of the target and values of its shape as a guess."""
        cams = [rig.cam_from_rig[name] for name in rig.cameras]
        return State(
            cameras=tuple(rig.cameras.values()),
            rotations=np.stack([c.rotation.as_matrix() for c in cams]),
            shifts=np.stack([c.translation for c in cams]),
            turns=poses.rotation.as_matrix().reshape(-1, 3, 3),
            places=np.asarray(poses.translation).reshape(-1, 3),
            bend=self.shape.values if bend is None else bend,
        )

    def target_points(self, state: State) -> Array:
        """(N, 3) points of the target in the guessed shape."""
        return self.points + self.shape.found(state.bend).offsets_m

    def values(self, state: State) -> Array:
        """Adjusted parameters of cameras and shape; 0 for those of poses."""
        vector = np.zeros(len(self.names))
        vector[self.shape_at] = state.bend
        for c, camera in enumerate(state.cameras):
            fields = [camera.parameters[i] for i in self.lens_columns[c]]
            vector[self.lens_at[c]] = [camera.parameter(field) for field in fields]
        return vector

    def moved(self, state: State, rig_step: Array, view_step: Array) -> State:
        """Another guess; bounded parameters stop at their bound.

        Raises:
            CalibrationError: a parameter leaves the range of a real camera.
        """
        values = np.maximum(self.values(state) + rig_step, self.low)
        cameras, rotations, shifts = [], state.rotations.copy(), state.shifts.copy()
        for c, camera in enumerate(state.cameras):
            changed = {
                camera.parameters[i]: float(values[at])
                for i, at in zip(self.lens_columns[c], self.lens_at[c], strict=True)
            }
            cameras.append(camera.with_parameters(changed) if changed else camera)
            step = np.zeros(6)
            step[self.pose_columns[c]] = rig_step[self.pose_at[c]]
            rotations[c] = Rotation.from_rotvec(step[:_TURNS]).as_matrix() @ rotations[c]
            shifts[c] += step[_TURNS:]
        turn = Rotation.from_rotvec(view_step[:, :_TURNS]).as_matrix()
        return State(
            cameras=tuple(cameras),
            rotations=rotations,
            shifts=shifts,
            turns=turn @ state.turns,
            places=state.places + view_step[:, _TURNS:],
            bend=values[self.shape_at],
        )

    def residuals(self, state: State) -> Array:
        """(V, C, N, 2) projected minus measured; NaN where unseen or where nothing is projected."""
        out = np.full(self.pixels.shape, np.nan)
        turned = self.target_points(state) @ state.turns.transpose(0, 2, 1)
        for c, camera in enumerate(state.cameras):
            at = self.views[c]
            rig = turned[at] + state.places[at, None]
            cam = rig @ state.rotations[c].T + state.shifts[c]
            out[at, c] = camera.project(cam) - self.pixels[at, c]
        return out

    def equations(self, state: State, weights: Array) -> Equations:
        """Normal equations, with the prior, for weights (V, C, N) in 1/px^2."""
        count, views = len(self.names), len(self.pixels)
        rig, rig_slope = np.zeros((count, count)), np.zeros(count)
        between, view_slope = np.zeros((views, count, 6)), np.zeros((views, 6))
        view = np.zeros((views, 6, 6))
        for slopes in self.slopes(state):
            c, v, at, rows = slopes.camera, slopes.views, slopes.at, slopes.rows
            use = self.seen[v, c] & (weights[v, c] > 0)
            rows *= np.sqrt(weights[v, c])[..., None, None]
            rows[~use] = 0.0
            rows = rows.reshape(len(v), 2 * len(self.points), rows.shape[-1])
            square = rows.transpose(0, 2, 1) @ rows
            p = len(at)
            total = square.sum(axis=0)
            rig[np.ix_(at, at)] += total[:p, :p]
            rig_slope[at] += total[:p, -1]
            between[v[:, None], at] += square[:, :p, p:-1]
            view[v] += square[:, p:-1, p:-1]
            view_slope[v] += square[:, p:-1, -1]
        at = self.prior_at
        rig[np.ix_(at, at)] += self.prior_information
        rig_slope[at] += self.prior_information @ self.prior_residuals(state)
        return Equations(
            rig=rig, between=between, view=view, rig_slope=rig_slope, view_slope=view_slope
        )

    def slopes(self, state: State) -> Iterator[Slopes]:
        """Derivatives of all pixels, camera by camera."""
        turned = self.target_points(state) @ state.turns.transpose(0, 2, 1)
        for c, camera in enumerate(state.cameras):
            v = self.views[c]
            by_turn = turned[v] @ state.rotations[c].T
            by_rig = by_turn + state.places[v, None] @ state.rotations[c].T
            cam = by_rig + state.shifts[c]
            pixels, by_point, by_parameter = camera.project_jacobian(cam)
            blocks = [by_parameter[..., self.lens_columns[c]]]
            if self.pose_columns[c].size:
                blocks.append(pose_jacobian(by_point, by_rig)[..., self.pose_columns[c]])
            by_turned = by_point @ state.rotations[c]
            by_place = by_turned @ state.turns[v, None]
            if self.shape_at.size:
                blocks.append(by_place @ self.shape.modes.transpose(1, 2, 0))
            blocks.append(pose_jacobian(by_turned, turned[v]))
            blocks.append((pixels - self.pixels[v, c])[..., None])
            yield Slopes(
                camera=c,
                views=v,
                at=np.concatenate([self.lens_at[c], self.pose_at[c], self.shape_at]),
                rows=np.concatenate(blocks, axis=-1),
                by_place=by_place,
            )

    def prior_residuals(self, state: State) -> Array:
        """(K,) parameters minus the prior's mean; a turn counts from the mean's rotation."""
        prior = self.prior
        out = self.values(state)[self.prior_at] - prior.mean
        at = {name: i for i, name in enumerate(prior.parameters)}
        for c, camera in enumerate(self.rig.cameras):
            for j, field in enumerate(POSE):
                i = at.get(f"{camera}.{field}")
                if i is not None and j >= _TURNS:
                    out[i] = state.shifts[c, j - _TURNS] - prior.mean[i]
            turns = [at[n] for f in POSE[:_TURNS] if (n := f"{camera}.{f}") in at]
            if turns:
                mean = Rotation.from_rotvec(prior.mean[turns])
                out[turns] = (Rotation.from_matrix(state.rotations[c]) * mean.inv()).as_rotvec()
        return out

    def information(self, equations: Equations) -> Array:
        """Information of the rig's parameters, (P, P), with the target's poses marginalised."""
        solved = np.linalg.solve(equations.view, equations.between.transpose(0, 2, 1))
        eliminated: Array = np.tensordot(equations.between, solved, axes=([0, 2], [0, 1]))
        return equations.rig - eliminated

    def covariance(self, equations: Equations) -> Covariance:
        """Inverse of the information.

        Raises:
            CalibrationError: a parameter, or a sum of some, is not determined.
        """
        schur = self.information(equations)
        if not self.names:
            return Covariance(parameters=(), matrix=np.zeros((0, 0)))
        # Held against what the views would determine if poses and all else were known.
        diagonal = np.diag(equations.rig)
        blind = [n for n, d in zip(self.names, diagonal, strict=True) if not d > 0]
        if blind:
            raise CalibrationError(f"no picture depends on {', '.join(blind)}: hold it")
        scale = 1.0 / np.sqrt(diagonal)
        scaled = schur * np.outer(scale, scale)
        values, vectors = np.linalg.eigh(0.5 * (scaled + scaled.T))
        if values[0] < _SINGULAR:
            share = np.abs(vectors[:, 0]) / np.abs(vectors[:, 0]).max()
            mixed = [n for n, s in zip(self.names, share, strict=True) if s > 0.2]
            raise CalibrationError(
                f"the views do not determine {' with '.join(mixed)}: tilt the target more and "
                "vary its distance, or hold some of these"
            )
        inverse = (vectors / values) @ vectors.T
        return Covariance(parameters=self.names, matrix=inverse * np.outer(scale, scale))
