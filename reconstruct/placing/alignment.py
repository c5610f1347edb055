"""Alignments of corresponding points in closed form, a level start, and how bent a block is.

Near-parallel views bend a model like a dome while every reprojection error stays small (James &
Robson 2014, "Mitigating systematic error in topographic models derived from UAV and ground-based
image networks"). Neither a pressure sensor nor an attitude reference bends with it.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.frames import Array
from alice_survey.core.records import BendRecord

_TRIMS = 5
"""Rounds of leaving out what is off the mean plane."""


@dataclass(frozen=True, kw_only=True)
class Similarity:
    """`target = scale * rotation * source + translation`."""

    scale: float
    rotation: Rotation
    translation: Array

    def apply(self, points: Array) -> Array:
        """Take (N, 3) source points to the target's frame."""
        return np.asarray(self.scale * self.rotation.apply(points) + self.translation)


def align_rigid(source: Array, target: Array, weight: Array | None = None) -> RigidTransform:
    """The rigid transform that takes source to target with the least squares error (Kabsch).

    Args:
        source: (N, 3), N >= 3, not on one line.
        target: (N, 3).
        weight: (N,) of the squares; equal if None.

    Returns:
        `target_from_source`.
    """
    similarity = _align(source, target, weight, with_scale=False)
    return RigidTransform.from_components(similarity.translation, similarity.rotation)


def align_similarity(source: Array, target: Array) -> Similarity:
    """The same transform with a free scale (Umeyama 1991, equations 40 to 43)."""
    return _align(source, target, None, with_scale=True)


def _align(source: Array, target: Array, weight: Array | None, *, with_scale: bool) -> Similarity:
    centre_source, centre_target = (np.average(p, axis=0, weights=weight) for p in (source, target))
    a, b = source - centre_source, target - centre_target
    u, singular, vt = np.linalg.svd(b.T @ (a if weight is None else weight[:, None] * a))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = Rotation.from_matrix(u @ np.diag(signs) @ vt)
    scale = float((singular * signs).sum() / (a**2).sum()) if with_scale else 1.0
    translation = centre_target - scale * rotation.apply(centre_source)
    return Similarity(scale=scale, rotation=rotation, translation=translation)


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


_THIN = 0.1
"""Width over length of a block below which it has no curvature across."""
MIN_STATIONS = 8
"""A paraboloid has six coefficients."""


def bend_of(
    curvature_per_m: float, sigma_per_m: float, length_m: float, straightened_per_m: float = 0.0
) -> BendRecord:
    """The bend of a curvature: the middle is off against the ends by `curvature length^2 / 8`."""
    return BendRecord(
        length_m=length_m,
        sag_m=curvature_per_m * length_m**2 / 8.0,
        sag_sigma_m=sigma_per_m * length_m**2 / 8.0,
        straightened_per_m=straightened_per_m,
        curvature_per_m=curvature_per_m,
        sigma_per_m=sigma_per_m,
    )


def quadratic(places: Array) -> tuple[Array, Array, Array]:
    """Columns 1, u, u^2 / 2 and, of a wide block, v, v^2 / 2, u v of places (N, 2).

    Here u and v are places about their middle in principal axes.

    Returns:
        The columns, (N, 3 or 6); the extents along u and v, (2,); the axes, (2, 2) by rows.
    """
    flat = places - places.mean(axis=0)
    axes = np.linalg.svd(flat, full_matrices=False)[2]
    u, v = axes @ flat.T
    sizes = np.array([np.ptp(u), np.ptp(v)])
    columns = [np.ones(len(u)), u, u**2 / 2]
    if sizes[1] > _THIN * sizes[0]:
        columns += [v, v**2 / 2, u * v]
    return np.column_stack(columns), sizes, axes


def sag_weights(places: Array) -> Array:
    """(1 or 2, N) that take heights at places (N, 2) to the sags along and, if wide, across."""
    columns, sizes, _ = quadratic(places)
    curvatures = np.linalg.pinv(columns)[2::2]
    return np.asarray(curvatures * sizes[: len(curvatures), None] ** 2 / 8.0)


def bend_modes(places_ned: Array, place: Similarity) -> Array:
    """Deformations that bend a model by a unit of curvature downwards, like its soft modes.

    Args:
        places_ned: (N, 3) of cameras.
        place: of the model.

    Returns:
        (N, 6, 1 or 3) motions and turns in the model's axes: along u, along v, and twisted.
    """
    columns, _, axes = quadratic(places_ned[:, :2])
    wide = columns.shape[1] > 3
    u, v = columns[:, 1], columns[:, 3] if wide else np.zeros(len(columns))
    zero = np.zeros_like(u)
    # Depth, then its slopes along u and v.
    shapes = [(u**2 / 2, u, zero), (v**2 / 2, zero, v), (u * v, v, u)][: 3 if wide else 1]
    found = np.zeros((len(u), 6, len(shapes)))
    back = place.rotation.inv().as_matrix()
    for k, (depth, by_u, by_v) in enumerate(shapes):
        found[:, :3, k] = np.column_stack([zero, zero, depth]) @ back.T / place.scale
        north, east = axes.T @ np.stack([by_u, by_v])
        found[:, 3:, k] = np.column_stack([east, -north, zero]) @ back.T
    return found
