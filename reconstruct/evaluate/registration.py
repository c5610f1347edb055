"""Lay one surface on another: heights so that real change does not pull them, or clouds.

Of heights, a rough shift comes from the correlation of the two reliefs; then all six parameters of
a rigid motion are adjusted until the heights agree, where what changed is taken out by Tukey's
weights.

A cloud is laid on another by the distance of its points from the other's surface: point-to-plane
closest points (Chen & Medioni 1992) with Tukey's weights, coarse to fine, for a rigid motion or
with a free scale: Open3D's has no scale in that form.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve
from scipy.spatial import cKDTree
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.block_solver import MAD_TO_SIGMA
from alice_survey.core.errors import ReconstructionError, WorkspaceError
from alice_survey.core.frames import Array
from reconstruct.elevation import Elevation
from reconstruct.evaluate.figures import json_number, mean_grid, rms, tukey_weights
from reconstruct.placing.alignment import Similarity

_ROUNDS = 40
_STILL = 1e-6
"""Share of a cell: motion of the block's rim at which the adjustment has settled."""
_MAX_POINTS = 150_000
_COARSE_CELLS = 320
_PEAKS = 4
_MIN_OVERLAP = 0.3
"""Share of the smaller survey that must lie on the other one."""
_CLUSTERS = 12
"""Blocks along a side whose errors are taken as independent of one another."""
_MIN_POINTS = 500


@dataclass(frozen=True, kw_only=True, eq=False)
class HeightFit:
    """How the moving survey lies on the fixed one."""

    fixed_from_moving: RigidTransform
    """East, north, up."""
    centre: Array
    """(3,) about which `covariance` holds, in the fixed frame."""
    covariance: Array
    """(6, 6) covariance of a small turn (rad) and shift (m) of the fixed frame about `centre`."""
    spread: float
    """Robust standard deviation of the height differences left."""
    used: int
    """Number of cells compared."""

    def sigma_at(self, points: Array, normals: Array) -> Array:
        """(N,) sigma of the height difference at (N, 3) points that the registration leaves."""
        slopes = _jacobian(points - self.centre, normals)
        variance: Array = np.einsum("ni,ij,nj->n", slopes, self.covariance, slopes)
        return np.sqrt(np.maximum(variance, 0.0))


def register_heights(
    fixed: Elevation, moving: Elevation, fixed_from_moving: RigidTransform
) -> HeightFit:
    """Adjust where `moving` lies on `fixed`.

    Args:
        fixed: heights that stay.
        moving: heights of the other survey, in its own frame.
        fixed_from_moving: as the georeferences give, east, north, up.

    Raises:
        ReconstructionError: the two hardly overlap.
    """
    fits = []
    for shift in rough_shifts(fixed, moving, fixed_from_moving):
        start = RigidTransform.from_translation([*shift, 0.0]) * fixed_from_moving
        fit = adjust_heights(fixed, moving, start, coarser=4)
        if fit is not None:
            fits.append(fit)
    if not fits:
        raise ReconstructionError(
            f"the two surfaces overlap by less than {_MIN_OVERLAP:.0%} of the smaller one (or by "
            f"under {_MIN_POINTS} cells): they show different places, or their georeferences are "
            "far apart"
        )
    best = min(fits, key=lambda fit: fit.spread)
    return adjust_heights(fixed, moving, best.fixed_from_moving) or best


def rough_shifts(
    fixed: Elevation, moving: Elevation, fixed_from_moving: RigidTransform
) -> list[tuple[float, float]]:
    """Shifts (east, north) at which the reliefs correlate best, and no shift at all.

    Normalised correlation of images with holes after Padfield (2012, "Masked object registration
    in the Fourier domain", equation 11), of heights minus a plane. Relief like ripples repeats:
    several peaks are handed on.
    """
    both = max(fixed.height.shape + moving.height.shape)
    cell = fixed.cell * max(1.0, both / _COARSE_CELLS)
    points, moved = fixed.points(), fixed_from_moving.apply(moving.points())
    one, *corner = mean_grid(points[:, :2], points[:, 2], cell)
    two, *other = mean_grid(moved[:, :2], moved[:, 2], cell)
    mask1, mask2 = np.isfinite(one).astype(float), np.isfinite(two).astype(float)
    one, two = _level(one), _level(two)
    flipped, mask_flipped = two[::-1, ::-1], mask2[::-1, ::-1]
    count = np.maximum(np.rint(fftconvolve(mask1, mask_flipped)), 1e-9)
    sum1, sum2 = fftconvolve(one, mask_flipped), fftconvolve(mask1, flipped)
    product = fftconvolve(one, flipped) - sum1 * sum2 / count
    variance1 = fftconvolve(one**2, mask_flipped) - sum1**2 / count
    variance2 = fftconvolve(mask1, flipped**2) - sum2**2 / count
    scale = np.sqrt(np.maximum(variance1, 0) * np.maximum(variance2, 0))
    enough = count >= _MIN_OVERLAP * min(mask1.sum(), mask2.sum())
    floor = 1e-9 * max(float(scale.max()), 1e-30)
    score = np.where(enough & (scale > floor), product / np.maximum(scale, floor), -1.0)
    shifts: list[tuple[float, float]] = [(0.0, 0.0)]
    for _ in range(_PEAKS):
        row, column = np.unravel_index(int(score.argmax()), score.shape)
        if score[row, column] <= 0:
            break
        east = corner[0] - other[0] + (int(column) - two.shape[1] + 1) * cell
        north = corner[1] - other[1] - (int(row) - two.shape[0] + 1) * cell
        shifts.append((east, north))
        score[max(row - 3, 0) : row + 4, max(column - 3, 0) : column + 4] = -1.0
    return shifts


def _level(height: Array) -> Array:
    """Heights minus the best plane; 0 where unknown."""
    rows, columns = np.nonzero(np.isfinite(height))
    design = np.column_stack([np.ones(len(rows)), rows, columns])
    plane, *_ = np.linalg.lstsq(design, height[rows, columns], rcond=None)
    level = np.zeros_like(height)
    level[rows, columns] = height[rows, columns] - design @ plane
    return level


@dataclass(frozen=True, kw_only=True, eq=False)
class _Compared:
    """Height differences at one pose, and how they change with a motion of the fixed points."""

    index: NDArray[np.int64]
    """(N,) indices of the fixed points that lie on the moving survey."""
    miss: Array
    """(N,) height of the moving surface minus that of the fixed points, in the moving frame."""
    normals: Array
    """(N, 3) slope of `miss` by the fixed point, in the fixed frame."""
    variance: Array
    """(N,) variances of the heights, both surveys; ones where it is not stated."""


def adjust_heights(
    fixed: Elevation, moving: Elevation, start: RigidTransform, *, coarser: int = 1
) -> HeightFit | None:
    """Adjust a registration that is nearly right; None when too little overlaps.

    Args:
        fixed: heights that stay.
        moving: of the other survey.
        start: `fixed_from_moving`.
        coarser: times the step between cells that suffices.
    """
    # Gauss-Newton with Tukey's weights
    step = coarser * max(1, int(np.sqrt(fixed.known.sum() / _MAX_POINTS)))
    points = fixed.points(step)
    variance = fixed.at(fixed.sigma, points[:, :2]) ** 2
    centre = points.mean(axis=0)
    rim = float(np.linalg.norm(points[:, :2] - centre[:2], axis=1).max())
    area = min(fixed.known.sum() * fixed.cell**2, moving.known.sum() * moving.cell**2)
    minimum = max(_MIN_POINTS, _MIN_OVERLAP * area / (fixed.cell * step) ** 2)
    slopes = _slopes(moving)
    pose = start
    for _ in range(_ROUNDS):
        compared = _compare(points, variance, moving, slopes, pose)
        if compared.miss.size < minimum:
            return None
        jacobian = _jacobian(points[compared.index] - centre, compared.normals)
        jacobian[:, :3] /= rim  # turns as motions of the rim: all six in metres
        weight = _tukey_weights(compared)
        normal = jacobian.T @ (weight[:, None] * jacobian)
        # A plane cannot say where it lies sideways: what is not seen must not run away
        normal += 1e-9 * np.trace(normal) * np.eye(6)
        move = -np.linalg.solve(normal, jacobian.T @ (weight * compared.miss))
        turn = Rotation.from_rotvec(move[:3] / rim)
        moved = RigidTransform.from_components(centre + move[3:] - turn.apply(centre), turn)
        pose = moved.inv() * pose
        if np.abs(move).max() < _STILL * fixed.cell:
            break
    return _fit(points, compared, pose, centre)


def _compare(
    points: Array, variance: Array, moving: Elevation, slopes: tuple[Array, Array],
    pose: RigidTransform,
) -> _Compared:  # fmt: skip
    there = pose.inv().apply(points)
    height, east, north = (moving.at(field, there[:, :2]) for field in (moving.height, *slopes))
    known = np.flatnonzero(np.isfinite(height + east + north))
    normals = np.column_stack([east[known], north[known], -np.ones(len(known))])
    total = variance[known] + moving.at(moving.sigma, there[known, :2]) ** 2
    middle = float(np.nanmedian(total)) if np.isfinite(total).any() else 1.0
    return _Compared(
        index=known,
        miss=height[known] - there[known, 2],
        normals=pose.rotation.apply(normals),
        variance=np.where(np.isfinite(total), total, middle),
    )


def _slopes(elevation: Elevation) -> tuple[Array, Array]:
    """Height per east and per north of the smoothed surface: noise would flatten the slopes."""
    known = elevation.known.astype(np.float64)
    weight = cv2.GaussianBlur(known, (0, 0), 1.5)
    smooth = cv2.GaussianBlur(np.nan_to_num(elevation.height), (0, 0), 1.5)
    with np.errstate(invalid="ignore", divide="ignore"):
        smooth = np.where(known > 0, smooth / weight, np.nan)
    down, right = np.gradient(smooth, elevation.cell)
    return right, -down


def _jacobian(offsets: Array, normals: Array) -> Array:
    """(N, 6) slopes by a small turn and shift of points at (N, 3) offsets from the centre."""
    return np.column_stack([np.cross(offsets, normals), normals])


def _tukey_weights(compared: _Compared) -> Array:
    """(N,) weights, 1 / m^2: none for what lies beyond Tukey's limit about the median."""
    scaled = (compared.miss - np.median(compared.miss)) / np.sqrt(compared.variance)
    return tukey_weights(scaled)[0] / compared.variance


def _fit(points: Array, compared: _Compared, pose: RigidTransform, centre: Array) -> HeightFit:
    """Covariance from the scatter of blocks of the survey: errors of neighbours are correlated."""
    places = points[compared.index]
    jacobian = _jacobian(places - centre, compared.normals)
    weight = _tukey_weights(compared)
    low, high = places[:, :2].min(axis=0), places[:, :2].max(axis=0)
    block = np.minimum((_CLUSTERS * (places[:, :2] - low) / (high - low)).astype(np.int64),
                       _CLUSTERS - 1)  # fmt: skip
    number = block[:, 0] * _CLUSTERS + block[:, 1]
    pulls = np.zeros((_CLUSTERS**2, 6))
    np.add.at(pulls, number, (weight * compared.miss)[:, None] * jacobian)
    blocks = len(np.unique(number))
    inverse = np.linalg.pinv(jacobian.T @ (weight[:, None] * jacobian), hermitian=True)
    meat = pulls.T @ pulls * blocks / max(blocks - 1, 1)
    level = compared.miss - np.median(compared.miss)
    return HeightFit(
        fixed_from_moving=pose,
        centre=centre,
        covariance=inverse @ meat @ inverse,
        spread=MAD_TO_SIGMA * float(np.median(np.abs(level))),
        used=int((weight > 0).sum()),
    )


_NEIGHBOURS = 12
_SAMPLES = (8_000, 40_000)
_COMPARED = 300_000
_COVER_SPACINGS = 4.0
"""Side of the squares in which a cloud counts as covering the ground, in its own spacings."""
_CLOUD_ROUNDS = 60
_CLOUD_STILL = 1e-3
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
        found, index = self.tree.query(points, k=_NEIGHBOURS)
        around = self.points[index]
        middles = around.mean(axis=1)
        offset = around - middles[:, None]
        covariance = np.einsum("nki,nkj->nij", offset, offset)
        return middles, np.linalg.eigh(covariance)[1][:, :, 0], np.asarray(found)[:, 0]

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
        fit = _adjust_cloud(sample, reference, start, free_scale=free_scale)
        start = fit.reference_from_cloud
    assert fit is not None  # noqa: S101 - for the type checker: _SAMPLES is not empty
    return fit


def _adjust_cloud(
    cloud: Array, reference: ReferenceSurface, start: Similarity, *, free_scale: bool
) -> CloudFit:  # fmt: skip
    pose, spacing = start, reference.spacing
    unknowns = 7 if free_scale else 6
    low, high = reference.points.min(axis=0), reference.points.max(axis=0)
    for _ in range(_CLOUD_ROUNDS):
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
        turn = Rotation.from_rotvec(move[:3] / rim)
        stretch = 1.0 + (float(move[6]) / rim if free_scale else 0.0)
        pose = Similarity(
            scale=stretch * pose.scale,
            rotation=turn * pose.rotation,
            translation=centre + move[3:6] + stretch * turn.apply(pose.translation - centre),
        )
        if np.abs(move).max() < _CLOUD_STILL * spacing:
            break
    variance = spread**2 * np.linalg.inv(system)
    scale_sigma = pose.scale * float(np.sqrt(variance[6, 6])) / rim if free_scale else 0.0
    return CloudFit(reference_from_cloud=pose, scale_sigma=scale_sigma, spread=spread)


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
            "nearest_point_median_m": json_number(float(np.median(self.nearest_m)), 5),
        }
        for name, value in (
            ("median", float(np.median(away))),
            ("rms", rms(away)),
            ("95", float(np.percentile(away, 95))),
        ):
            figures[f"{name}_m"] = json_number(value, 5)
            figures[f"{name}_px"] = json_number(value / pixel_m, 3)
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
