"""Where a model lies in the world: fitted to navigation, or levelled where there is none."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.errors import warn
from alice_survey.frames import Array, Datum, rotation_from_attitude
from alice_survey.manifest import ImageRecord
from reconstruct.matching.pairs import positions_ned
from reconstruct.sparse.alignment import Similarity

_LEVEL_SIGMA_DEG = 10.0
"""How far from level the sea floor's mean plane may be, where no attitude was measured."""
_SIGMA_HORIZONTAL_M = 3.0
_SIGMA_DEPTH_M = 3.0
_SIGMA_ATTITUDE_DEG = 2.0
_SIGMA_HEADING_DEG = 5.0
"""Used where navigation states no sigma."""
_TRIMS = 5
"""Rounds of leaving out what stands off the mean plane."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Fit:
    """A model placed by navigation."""

    ned_from_model: Similarity
    used: int
    """Pictures with a position."""
    rms_m: Array
    """(3,) north, east, down misses of the positions, root mean square."""
    free_scale: float
    """Scale that a similarity would choose: 1 where navigation agrees with the known scale."""


def level(points: Array, centres: Array) -> Similarity:
    """Put a model's mean plane level, its third axis down, away from the cameras.

    The origin is the middle of the plane's points; the first axis points from the first camera to
    the last.

    Args:
        points: (N, 3) points of the model, 3 or more.
        centres: (M, 3) camera centres in order.

    Returns:
        `world_from_model`, of scale one.
    """
    kept = points
    for _ in range(_TRIMS):
        middle = kept.mean(axis=0)
        normal = np.linalg.svd(kept - middle, full_matrices=False)[2][2]
        away = np.abs((points - middle) @ normal)
        kept = points[away <= 3.0 * np.median(away) + 1e-12]
    middle = kept.mean(axis=0)
    normal = np.linalg.svd(kept - middle, full_matrices=False)[2][2]
    if (centres.mean(axis=0) - middle) @ normal > 0:
        normal = -normal
    ahead = centres[-1] - centres[0]
    ahead = ahead - (ahead @ normal) * normal
    if np.linalg.norm(ahead) < 1e-9 * (1.0 + np.abs(centres).max()):
        ahead = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    ahead = ahead / np.linalg.norm(ahead)
    rotation = Rotation.from_matrix(np.stack([ahead, np.cross(normal, ahead), normal]))
    return Similarity(scale=1.0, rotation=rotation, translation=-rotation.apply(middle))


def fit_navigation(
    records: Sequence[ImageRecord],
    model_from_cam: Sequence[RigidTransform],
    body_from_cam: Mapping[str, RigidTransform],
    datum: Datum,
    levelled: Similarity,
    *,
    known_scale: float | None,
) -> Fit | None:
    """Fit a model to the positions and attitudes of navigation, weighted and robustly.

    Args:
        records: registered pictures.
        model_from_cam: pose of each picture's camera in the model.
        body_from_cam: lever arm of every camera, metres; the identity where positions are of the
            cameras themselves.
        datum: origin of the local frame.
        levelled: `level` of the model; where no attitude is known it keeps the model from turning
            about a straight track, with a sigma of 10 degrees.
        known_scale: metres in a unit of the model, or None: then the scale is fitted too.

    Returns:
        The fit; None, after a warning, where positions are too few or too close together.
    """
    problem = _problem(records, model_from_cam, body_from_cam, datum)
    if problem is None:
        return None
    start = _start(problem, levelled, known_scale)
    if start is None:
        return None
    fixed = _solve(problem, start, levelled, free=known_scale is None)
    free = fixed if known_scale is None else _solve(problem, fixed, levelled, free=True)
    misses = problem.positions(fixed) - problem.measured_ned
    return Fit(
        ned_from_model=fixed,
        used=len(problem.measured_ned),
        rms_m=np.sqrt((misses**2).mean(axis=0)),
        free_scale=free.scale / fixed.scale if known_scale is not None else 1.0,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Problem:
    centres: Array
    """(N, 3) camera centres in the model."""
    model_from_body: Rotation
    """(N,) attitudes in the model."""
    levers: Array
    """(N, 3) body origin less camera centre, in the body frame, metres."""
    measured_ned: Array
    position_sigma_m: Array
    ned_from_body: Rotation
    has_attitude: Array
    attitude_sigma: Array
    """(N, 3) radians about north, east and down."""

    def positions(self, ned_from_model: Similarity) -> Array:
        """Body origins in NED, (N, 3)."""
        arms = (ned_from_model.rotation * self.model_from_body).apply(self.levers)
        moved: Array = ned_from_model.apply(self.centres) + arms
        return moved


def _problem(
    records: Sequence[ImageRecord],
    model_from_cam: Sequence[RigidTransform],
    body_from_cam: Mapping[str, RigidTransform],
    datum: Datum,
) -> _Problem | None:
    chosen = [i for i, r in enumerate(records) if r.has_position]
    if not chosen:
        return None
    rows = [records[i] for i in chosen]
    levers = [body_from_cam[r.camera] for r in rows]
    attitudes = np.array([[r.roll_deg, r.pitch_deg, r.heading_deg] for r in rows])
    known = np.isfinite(attitudes).all(axis=1)

    def sigma(values: Sequence[float], default: float) -> Array:
        array = np.array(values)
        return np.where(array > 0, array, default)

    horizontal = sigma([r.sigma_horizontal_m for r in rows], _SIGMA_HORIZONTAL_M)
    tilt = np.deg2rad(sigma([r.sigma_attitude_deg for r in rows], _SIGMA_ATTITUDE_DEG))
    return _Problem(
        centres=np.stack([model_from_cam[i].translation for i in chosen]),
        model_from_body=Rotation.concatenate(
            [
                model_from_cam[i].rotation * lever.rotation.inv()
                for i, lever in zip(chosen, levers, strict=True)
            ]
        ),
        levers=np.stack([-lever.translation for lever in levers]),
        measured_ned=positions_ned(rows, datum),
        position_sigma_m=np.stack(
            [horizontal, horizontal, sigma([r.sigma_depth_m for r in rows], _SIGMA_DEPTH_M)], axis=1
        ),
        ned_from_body=rotation_from_attitude(
            *np.deg2rad(np.where(known[:, None], attitudes, 0.0)).T
        ),
        has_attitude=known,
        attitude_sigma=np.stack(
            [
                tilt,
                tilt,
                np.deg2rad(sigma([r.sigma_heading_deg for r in rows], _SIGMA_HEADING_DEG)),
            ],
            axis=1,
        ),
    )


def _start(problem: _Problem, levelled: Similarity, known_scale: float | None) -> Similarity | None:
    """A first placement: from attitudes, else from the levelled model and the positions' plan."""
    measured, count = problem.measured_ned, len(problem.measured_ned)
    spread = float(np.sqrt(measured[:, :2].var(axis=0).sum()))
    need = float(np.median(problem.position_sigma_m[:, 0]))
    flat = levelled.apply(problem.centres)
    if not problem.has_attitude.any() or known_scale is None:
        least = 2 if problem.has_attitude.any() else 3
        if count < least or spread <= need:
            warn(
                f"{count} positions spread over {spread:.2f} m at a sigma of {need:.2f} m do not "
                "place the model: it stays without CRS"
            )
            return None
    a = (flat[:, :2] - flat[:, :2].mean(axis=0)) @ [1.0, 1j]
    b = (measured[:, :2] - measured[:, :2].mean(axis=0)) @ [1.0, 1j]
    turn = complex(np.vdot(a, b) / max(float(np.vdot(a, a).real), 1e-300))
    if problem.has_attitude.any():
        some = np.flatnonzero(problem.has_attitude)
        rotation = (problem.ned_from_body[some] * problem.model_from_body[some].inv()).mean()
    else:
        rotation = Rotation.from_rotvec([0.0, 0.0, np.angle(turn)]) * levelled.rotation
    scale = abs(turn) if known_scale is None else known_scale
    start = Similarity(scale=scale, rotation=rotation, translation=np.zeros(3))
    shift = np.median(measured - problem.positions(start), axis=0)
    return Similarity(scale=scale, rotation=rotation, translation=shift)


def _solve(problem: _Problem, start: Similarity, levelled: Similarity, *, free: bool) -> Similarity:
    some = np.flatnonzero(problem.has_attitude)
    down_model = levelled.rotation.inv().apply([0.0, 0.0, 1.0])

    def placed(x: Array) -> Similarity:
        return Similarity(
            scale=start.scale * float(np.exp(x[6])) if free else start.scale,
            rotation=Rotation.from_rotvec(x[:3]) * start.rotation,
            translation=start.translation + x[3:6],
        )

    def misses(x: Array) -> Array:
        now = placed(x)
        parts = [(problem.positions(now) - problem.measured_ned) / problem.position_sigma_m]
        if len(some):
            turned = now.rotation * problem.model_from_body[some]
            off = (turned * problem.ned_from_body[some].inv()).as_rotvec()
            parts.append(off / problem.attitude_sigma[some])
        else:
            tilt = now.rotation.apply(down_model)[:2] / np.deg2rad(_LEVEL_SIGMA_DEG)
            parts.append(np.r_[tilt, 0.0][None])
        return np.concatenate(parts).ravel()

    found = least_squares(
        misses,
        np.zeros(7 if free else 6),
        x_scale="jac",
        loss="soft_l1",
        f_scale=2.0,
        xtol=1e-14,
        ftol=1e-14,
        gtol=1e-14,
    )
    return placed(found.x)
