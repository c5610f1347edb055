"""Lay a cloud on another by the distance of its points from the other's surface.

Point-to-plane closest points (Chen & Medioni 1992) with Tukey's weights, coarse to fine, for a
rigid motion or with a free scale: Open3D's has no scale in that form.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from alice_survey.core.errors import ReconstructionError, WorkspaceError
from alice_survey.core.frames import Array
from alice_survey.core.robust import MAD_TO_SIGMA
from reconstruct.evaluate.figures import rms, rounded, tukey_weights
from reconstruct.placing.alignment import Similarity

_NEIGHBOURS = 12
_SAMPLES = (8_000, 40_000)
_COMPARED = 300_000
_COVER_SPACINGS = 4.0
"""Side of the squares in which a cloud counts as covering the ground, in its own spacings."""
_ROUNDS = 60
_STILL = 1e-3
"""Share of the reference's spacing: motion of the cloud's rim at which the adjustment settles."""
_MIN_PAIRS = 200


@dataclass(frozen=True, kw_only=True, eq=False)
class ReferenceSurface:
    """A cloud that knows the plane through the neighbours of each point."""

    points: Array
    """(N, 3) points."""
    tree: cKDTree

    @classmethod
    def of(cls, points: Array) -> "ReferenceSurface":
        """The surface through (N, 3) points."""
        return cls(points=points, tree=cKDTree(points))

    @property
    def spacing(self) -> float:
        """Median distance of a point from the nearest other one."""
        some = self.points[:: max(1, len(self.points) // 5000)]
        return float(np.median(self.tree.query(some, k=[2])[0]))

    def planes_at(self, points: Array) -> tuple[Array, Array, Array]:
        """The planes through the neighbours of the points nearest to (N, 3) others.

        Returns:
            Middles, (N, 3); unit normals, (N, 3); and distances, (N,), of the nearest point.
        """
        middles, normals = np.empty_like(points), np.empty_like(points)
        nearest = np.empty(len(points))
        for start in range(0, len(points), 50_000):
            part = slice(start, start + 50_000)
            found, index = self.tree.query(points[part], k=_NEIGHBOURS)
            around = self.points[index]
            middles[part] = around.mean(axis=1)
            offset = around - middles[part, None]
            covariance = np.einsum("nki,nkj->nij", offset, offset)
            normals[part] = np.linalg.eigh(covariance)[1][:, :, 0]
            nearest[part] = np.asarray(found)[:, 0]
        return middles, normals, nearest

    def distance(self, points: Array) -> tuple[Array, Array]:
        """Signed distance of (N, 3) points from the local plane, and distance of the nearest point.

        The plane makes the reference's own spacing not count; it is positive above the surface.
        """
        middles, normals, nearest = self.planes_at(points)
        normals = normals * np.where(normals[:, 2:] < 0, -1.0, 1.0)
        return np.einsum("ni,ni->n", points - middles, normals), nearest


@dataclass(frozen=True, kw_only=True, eq=False)
class CloudFit:
    """How a cloud lies on the reference."""

    reference_from_cloud: Similarity
    scale_sigma: float
    """0 where the scale was held."""
    spread: float
    """Robust standard deviation of the distances from the reference's planes."""
    rounds: int


def register_cloud(
    cloud: Array, reference: ReferenceSurface, start: Similarity, *, free_scale: bool,
    rng: np.random.Generator,
) -> CloudFit:  # fmt: skip
    """Adjust where a cloud lies on a reference.

    Args:
        cloud: (N, 3) points.
        reference: that stays.
        start: from the cloud to the reference, such as the georeferences give.
        free_scale: adjust the scale too.
        rng: draws points of the cloud.

    Raises:
        ReconstructionError: hardly any point finds a partner.
    """
    fit = None
    for count in _SAMPLES:
        sample = cloud[rng.choice(len(cloud), min(count, len(cloud)), replace=False)]
        fit = _adjust(sample, reference, start, free_scale=free_scale)
        start = fit.reference_from_cloud
    assert fit is not None  # noqa: S101 - for the type checker: _SAMPLES is not empty
    return fit


def _adjust(
    cloud: Array, reference: ReferenceSurface, start: Similarity, *, free_scale: bool
) -> CloudFit:  # fmt: skip
    pose, spacing = start, reference.spacing
    unknowns = 7 if free_scale else 6
    low, high = reference.points.min(axis=0), reference.points.max(axis=0)
    for done in range(1, _ROUNDS + 1):  # noqa: B007 - used in the result
        moved = pose.apply(cloud)
        middles, normals, nearest = reference.planes_at(moved)
        inside = np.all((moved[:, :2] >= low[:2]) & (moved[:, :2] <= high[:2]), axis=1)
        # Beyond the rim of the reference the nearest plane says nothing
        limit = 3 * MAD_TO_SIGMA * np.median(nearest[inside]) + spacing if inside.any() else 0.0
        paired = np.flatnonzero(inside & (nearest <= limit))
        if len(paired) < _MIN_PAIRS:
            raise ReconstructionError(
                f"{len(paired)} points of the cloud lie near the reference; {_MIN_PAIRS} are "
                "needed: they show different places, or the georeference is far off"
            )
        points, normal = moved[paired], normals[paired]
        miss = np.einsum("ni,ni->n", points - middles[paired], normal)
        weight, spread = tukey_weights(miss)
        centre = points.mean(axis=0)
        rim = float(np.linalg.norm(points - centre, axis=1).max())
        arm = (points - centre) / rim
        slopes = np.column_stack(
            [np.cross(arm, normal), normal, np.einsum("ni,ni->n", arm, normal)]
        )
        slopes = slopes[:, :unknowns]
        system = slopes.T @ (weight[:, None] * slopes)
        system += 1e-9 * np.trace(system) * np.eye(unknowns)
        move = -np.linalg.solve(system, slopes.T @ (weight * miss))
        pose = _moved(pose, centre, move, rim)
        if np.abs(move).max() < _STILL * spacing:
            break
    variance = spread**2 * np.linalg.inv(system)
    scale_sigma = pose.scale * float(np.sqrt(variance[6, 6])) / rim if free_scale else 0.0
    return CloudFit(reference_from_cloud=pose, scale_sigma=scale_sigma, spread=spread, rounds=done)


def _moved(pose: Similarity, centre: Array, move: Array, rim: float) -> Similarity:
    """A pose followed by a small turn, shift and stretch about a centre."""
    turn = Rotation.from_rotvec(move[:3] / rim)
    stretch = 1.0 + (float(move[6]) / rim if len(move) == 7 else 0.0)
    return Similarity(
        scale=stretch * pose.scale,
        rotation=turn * pose.rotation,
        translation=centre + move[3:6] + stretch * turn.apply(pose.translation - centre),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class CloudDistances:
    """Points of one cloud from the surface of another, where that one covers the ground."""

    points: Array
    """(N, 3) points of the first cloud."""
    signed_m: Array
    """(N,) distances from the plane through the nearest points of the other; positive above."""
    nearest_m: Array
    """(N,) distances from the nearest point of the other."""
    covered_share: float
    """Share of the first cloud's points where the other covers the ground."""

    def to_json(self, pixel_m: float) -> dict[str, Any]:
        """Figures in metres and ground pixels."""
        away = np.abs(self.signed_m)
        figures: dict[str, Any] = {
            "points": len(away),
            "covered_share": round(self.covered_share, 4),
            "median_signed_m": rounded(float(np.median(self.signed_m)), 5),
            "nearest_point_median_m": rounded(float(np.median(self.nearest_m)), 5),
        }
        for name, value in (
            ("median", float(np.median(away))),
            ("rms", rms(away)),
            ("95", float(np.percentile(away, 95))),
        ):
            figures[f"{name}_m"] = rounded(value, 5)
            figures[f"{name}_px"] = rounded(value / pixel_m, 3)
        return figures


def distances(points: Array, surface: ReferenceSurface, rng: np.random.Generator) -> CloudDistances:
    """Distances of a cloud from a surface, both ways to be called.

    Args:
        points: (N, 3) of the first cloud, registered; of many a sample is compared.
        surface: the other cloud.
        rng: draws the sample.

    Raises:
        WorkspaceError: the two cover no common ground.
    """
    if len(points) > _COMPARED:
        points = points[np.sort(rng.choice(len(points), _COMPARED, replace=False))]
    covered = covers(surface, points)
    if not covered.any():
        raise WorkspaceError("the survey and the reference cover no common ground")
    signed, nearest = surface.distance(points[covered])
    return CloudDistances(
        points=points[covered],
        signed_m=signed,
        nearest_m=nearest,
        covered_share=float(covered.mean()),
    )


def covers(surface: ReferenceSurface, points: Array) -> NDArray[np.bool_]:
    """Whether a square of the plan under each of (N, 3) points holds points of a surface."""
    side = _COVER_SPACINGS * surface.spacing
    low = surface.points[:, :2].min(axis=0)
    own = np.floor((surface.points[:, :2] - low) / side).astype(np.int64)
    shape = own.max(axis=0) + 1
    full = np.zeros(shape, dtype=np.bool_)
    full[own[:, 0], own[:, 1]] = True
    cell = np.floor((points[:, :2] - low) / side).astype(np.int64)
    inside = np.all((cell >= 0) & (cell < shape), axis=1)
    found = np.zeros(len(points), dtype=np.bool_)
    found[inside] = full[cell[inside, 0], cell[inside, 1]]
    return found
