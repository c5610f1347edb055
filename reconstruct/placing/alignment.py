"""Closed-form alignment of two sets of corresponding points."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.frames import Array


@dataclass(frozen=True, kw_only=True)
class Similarity:
    """`target = scale * rotation * source + translation`."""

    scale: float
    rotation: Rotation
    translation: Array

    def apply(self, points: Array) -> Array:
        """Take (N, 3) source points to the target's frame."""
        moved: Array = self.scale * self.rotation.apply(points) + self.translation
        return moved


def align_rigid(source: Array, target: Array) -> RigidTransform:
    """The rigid transform that takes source to target with the least squares error (Kabsch).

    Args:
        source: (N, 3), N >= 3, not on one line.
        target: (N, 3).

    Returns:
        `target_from_source`.
    """
    similarity = _align(source, target, with_scale=False)
    return RigidTransform.from_components(similarity.translation, similarity.rotation)


def align_similarity(source: Array, target: Array) -> Similarity:
    """The same transform with a free scale (Umeyama 1991, equations 40 to 43)."""
    return _align(source, target, with_scale=True)


def _align(source: Array, target: Array, *, with_scale: bool) -> Similarity:
    centre_source, centre_target = source.mean(axis=0), target.mean(axis=0)
    a, b = source - centre_source, target - centre_target
    u, singular, vt = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = Rotation.from_matrix(u @ np.diag(signs) @ vt)
    scale = float((singular * signs).sum() / (a**2).sum()) if with_scale else 1.0
    translation = centre_target - scale * rotation.apply(centre_source)
    return Similarity(scale=scale, rotation=rotation, translation=translation)
