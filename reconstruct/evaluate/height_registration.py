"""Lay one survey's heights on another's, so that real change does not pull them.

A rough shift comes from the correlation of the two reliefs; then all six parameters of a rigid
motion are adjusted until the heights agree, where what changed is taken out by Tukey's weights.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.errors import ReconstructionError
from alice_survey.core.frames import Array
from alice_survey.core.robust import MAD_TO_SIGMA
from reconstruct.evaluate.elevation import Elevation
from reconstruct.evaluate.figures import mean_grid, tukey_weights

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
_APART = (
    f"the two surfaces overlap by less than {_MIN_OVERLAP:.0%} of the smaller one (or by under "
    f"{_MIN_POINTS} cells): they show different places, or their georeferences are far apart"
)


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


def refine_heights(
    fixed: Elevation, moving: Elevation, fixed_from_moving: RigidTransform
) -> HeightFit:
    """Adjust a registration that is nearly right; raises as `register_heights` does."""
    fit = _adjust(fixed, moving, fixed_from_moving, _step(fixed))
    if fit is None:
        raise ReconstructionError(_APART)
    return fit


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
    step = _step(fixed)
    starts = rough_shifts(fixed, moving, fixed_from_moving)
    coarse = 4 * step
    fits = []
    for shift in starts:
        start = RigidTransform.from_translation([*shift, 0.0]) * fixed_from_moving
        fit = _adjust(fixed, moving, start, coarse)
        if fit is not None:
            fits.append(fit)
    if not fits:
        raise ReconstructionError(_APART)
    best = min(fits, key=lambda fit: fit.spread)
    final = _adjust(fixed, moving, best.fixed_from_moving, step)
    return best if final is None else final


def _step(elevation: Elevation) -> int:
    """Step between cells that suffices."""
    return max(1, int(np.sqrt(elevation.known.sum() / _MAX_POINTS)))


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
    one, two = _levelled(one), _levelled(two)
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


def _levelled(height: Array) -> Array:
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


def _adjust(
    fixed: Elevation, moving: Elevation, start: RigidTransform, step: int
) -> HeightFit | None:
    """Gauss-Newton with Tukey's weights; None when too little overlaps."""
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
    height = moving.at(moving.height, there[:, :2])
    east, north = (moving.at(slope, there[:, :2]) for slope in slopes)
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
