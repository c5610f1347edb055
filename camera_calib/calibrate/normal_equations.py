"""Normal equations of a calibration: observations of rig, ports and target poses.

The unknowns are a few parameters of the rig, those of the target's shape, and six of every view's
target pose. A view's pose meets only its own pixels, so that the equations have a small dense part
of rig and shape, a 6 x 6 block for every view, and what couples the two
(`alice_survey.core.block_solver`).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.block_solver import BlockStep, Equations, Flags, Indices
from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array
from camera_calib.camera import pose_jacobian
from camera_calib.freedom import POSE, Freedom, move_rig, select_slopes, slope_columns
from camera_calib.rig import Covariance, Rig
from camera_calib.target_shape import AS_DRAWN, TargetShape

_SINGULAR = 1e-13
"""Least eigenvalue of the rig's information, scaled to 1 if all else were known."""
_TURNS = len(POSE) // 2


@dataclass(frozen=True, kw_only=True, eq=False)
class State:
    """One guess of all unknowns."""

    rig: Rig
    turns: Array
    """(V, 3, 3) rig_from_target, and (V, 3) its translation."""
    places: Array
    bend: Array
    """(K,) values of the target's shape."""


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
        self.shape, self.freedom = shape, freedom
        self.shape_at = np.arange(len(self.names) - len(shape.parameters), len(self.names))
        self.prior = freedom.prior.and_also(shape.prior)
        self.prior_information = self.prior.information
        self.prior_at = np.array(
            [self.names.index(n) for n in self.prior.parameters], dtype=np.intp
        )
        self.rig_names = freedom.names(rig)
        self.views = [np.flatnonzero(self.seen[:, c].any(axis=1)) for c in range(len(rig.cameras))]

    def state(self, rig: Rig, poses: RigidTransform, bend: Array | None = None) -> State:
        """A rig, poses of the target and values of its shape as a guess."""
        return State(
            rig=rig,
            turns=poses.rotation.as_matrix().reshape(-1, 3, 3),
            places=np.asarray(poses.translation).reshape(-1, 3),
            bend=self.shape.values if bend is None else bend,
        )

    def target_points(self, state: State) -> Array:
        """(N, 3) points of the target in the guessed shape."""
        return self.points + self.shape.with_values(state.bend).offsets_m

    def take_step(self, state: State, step: BlockStep) -> State:
        """Another guess; bounded parameters stop at their bound.

        Raises:
            CalibrationError: a parameter leaves the range of a real camera.
        """
        count = len(self.rig_names)
        turn = Rotation.from_rotvec(step.poses[:, :_TURNS]).as_matrix()
        return State(
            rig=move_rig(state.rig, self.rig_names, step.shared[:count]),
            turns=turn @ state.turns,
            places=state.places + step.poses[:, _TURNS:],
            bend=state.bend + step.shared[count:],
        )

    def residuals(self, state: State) -> Array:
        """(V, C, N, 2) projected minus measured; NaN where unseen or where nothing is projected."""
        out = np.full(self.pixels.shape, np.nan)
        turned = self.target_points(state) @ state.turns.transpose(0, 2, 1)
        for c, (name, camera) in enumerate(state.rig.cameras.items()):
            at, pose = self.views[c], state.rig.cam_from_rig[name]
            rig = turned[at] + state.places[at, None]
            cam = rig @ pose.rotation.as_matrix().T + pose.translation
            out[at, c] = camera.project(cam) - self.pixels[at, c]
        return out

    def equations(self, state: State, weights: Array) -> Equations:
        """Normal equations, with the prior, for weights (V, C, N) in 1/px^2."""
        count, views = len(self.names), len(self.pixels)
        shared, border = np.zeros((count + 1, count + 1)), np.zeros((views, 6, count + 1))
        blocks = np.zeros((views, 6, 6))
        for slopes in self.slopes(state):
            c, v, at, rows = slopes.camera, slopes.views, slopes.at, slopes.rows
            use = self.seen[v, c] & (weights[v, c] > 0)
            rows *= np.sqrt(weights[v, c])[..., None, None]
            rows[~use] = 0.0
            rows = rows.reshape(len(v), 2 * len(self.points), rows.shape[-1])
            square = rows.transpose(0, 2, 1) @ rows
            p = len(at)
            rest, at = np.append(np.arange(p), -1), np.append(at, count)
            shared[np.ix_(at, at)] += square.sum(axis=0)[np.ix_(rest, rest)]
            border[v[:, None], :, at] += square[:, rest, p:-1]
            blocks[v] += square[:, p:-1, p:-1]
        at = self.prior_at
        shared[np.ix_(at, at)] += self.prior_information
        shared[at, -1] += self.prior_information @ self.prior_residuals(state)
        shared[-1, -1] = 0.0
        return Equations.apart(blocks, border, shared)

    def slopes(self, state: State) -> Iterator[Slopes]:
        """Derivatives of all pixels, camera by camera."""
        turned = self.target_points(state) @ state.turns.transpose(0, 2, 1)
        for c, (name, camera) in enumerate(state.rig.cameras.items()):
            v, pose = self.views[c], state.rig.cam_from_rig[name]
            turn = pose.rotation.as_matrix()
            by_rig = (turned[v] + state.places[v, None]) @ turn.T
            pixels, by_point, by_parameter = camera.project_jacobian(by_rig + pose.translation)
            columns, at = slope_columns(self.rig, self.rig_names, name)
            rows = [select_slopes(columns, by_parameter, by_point, by_rig)]
            by_turned = by_point @ turn
            by_place = by_turned @ state.turns[v, None]
            if self.shape_at.size:
                rows.append(by_place @ self.shape.modes.transpose(1, 2, 0))
            rows.append(pose_jacobian(by_turned, turned[v]))
            rows.append((pixels - self.pixels[v, c])[..., None])
            yield Slopes(
                camera=c,
                views=v,
                at=np.concatenate([at, self.shape_at]),
                rows=np.concatenate(rows, axis=-1),
                by_place=by_place,
            )

    def prior_residuals(self, state: State) -> Array:
        """(K,) parameters minus the prior's mean; a turn counts from the mean's rotation."""
        return np.concatenate([self.freedom.prior.misfit(state.rig), state.bend])

    def covariance(self, equations: Equations) -> Covariance:
        """Inverse of the information.

        Raises:
            CalibrationError: a parameter, or a sum of some, is not determined.
        """
        if not self.names:
            return Covariance(parameters=(), matrix=np.zeros((0, 0)))
        # Held against what the views would determine if poses and all else were known.
        diagonal = np.diag(equations.shared)[:-1]
        blind = [n for n, d in zip(self.names, diagonal, strict=True) if not d > 0]
        if blind:
            raise CalibrationError(f"no picture depends on {', '.join(blind)}: hold it")
        scale = 1.0 / np.sqrt(diagonal)
        scaled = equations.information * np.outer(scale, scale)
        values, vectors = np.linalg.eigh(scaled)
        if values[0] < _SINGULAR:
            share = np.abs(vectors[:, 0]) / np.abs(vectors[:, 0]).max()
            mixed = [n for n, s in zip(self.names, share, strict=True) if s > 0.2]
            raise CalibrationError(
                f"the views do not determine {' with '.join(mixed)}: tilt the target more and "
                "vary its distance, or hold some of these"
            )
        inverse = (vectors / values) @ vectors.T
        return Covariance(parameters=self.names, matrix=inverse * np.outer(scale, scale))
