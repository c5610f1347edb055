"""COLMAP's bundle adjustment as used here: poses and points move, rig and cameras do not.

It takes full Gauss-Newton steps, since it starts near its end: COLMAP's own first trust region
costs ten times the iterations along a block's weak directions.

Not all keypoints have similar errors. Shadow edges move with the lamps, tracks jump from one place
to the next: a few in a hundred miss by many sigmas, and not at random, since lamps go where the
cameras go. With equal weights they bend a block by more than all other noise together. Cauchy's
loss (Rey 1983, "Introduction to robust and quasi-robust statistical methods") lets them go by and
costs almost nothing where errors are normal. The last adjustment, which begins near its end, takes
that of Geman and McClure (1987), whose pull falls to nothing (`reconstruct.adjustment`).

Poses of a few thousand keypoints a picture are as good from a few hundred that are spread over it,
those of the longest tracks first; the adjustment then takes a fraction of the time and memory. The
other points follow, one by one, with poses held.
"""

import numpy as np
import pycolmap

from alice_survey.core.block_solver import CAUCHY_TUNING, RAYLEIGH_MEDIAN, Flags
from alice_survey.core.compiled import compiled
from alice_survey.core.frames import Array
from reconstruct.mapping.arrays import Indices, Observed, observations

_MIN_SIGMA_PX = 1e-3
_WELL_SEEN = 4
_MAX_ADAPTED = 0.9
_TUNING = 4.096
"""Scale of the weights of Geman and McClure, in sigmas: 95 % efficiency for normal residuals of two
coordinates."""


def pixel_sigma(model: pycolmap.Reconstruction) -> float:
    """Standard deviation of one coordinate of a keypoint, from a model's residuals."""
    seen = observations(model)
    counts = np.bincount(seen.point, minlength=len(seen.point_ids))[seen.point]
    return sigma_of(seen.residuals(model), counts, model.num_reg_frames())


def sigma_of(residuals: Array, counts: Indices, stations: int) -> float:
    """Standard deviation of one coordinate, from the median of residuals.

    Residuals are smaller than errors by what points and stations adapt to. Points seen only twice
    adapt so much that what is left is not normal: they do not count where there are others.

    Args:
        residuals: (O, 2) residuals.
        counts: (O,) how many observations each one's point has.
        stations: how many there are.
    """
    if not len(residuals):
        return _MIN_SIGMA_PX
    free = float((3.0 / counts).sum())  # unknowns of points
    by_station = 1.0 - min(_MAX_ADAPTED, 6.0 * stations / max(2.0 * len(residuals) - free, 1.0))
    left = (1.0 - 1.5 / counts) * by_station
    well_seen = counts >= min(_WELL_SEEN, int(np.median(counts)))
    median = float(
        np.median(np.linalg.norm(residuals[well_seen], axis=1) / np.sqrt(left[well_seen]))
    )
    return max(median / RAYLEIGH_MEDIAN, _MIN_SIGMA_PX)


def loss_scale(sigma_px: float) -> float:
    """Length of a residual, in pixels, that counts half."""
    return CAUCHY_TUNING * sigma_px


def robust_weights(residuals: Array, sigma_px: float) -> Array:
    """Weights (O,) of observations that miss by (O, 2) pixels."""
    return np.asarray((1.0 + (residuals**2).sum(axis=1) / (_TUNING * sigma_px) ** 2) ** -2)


def robust_cost(residuals: Array, sigma_px: float) -> float:
    """Loss of (O, 2) residuals, px^2; the sum of squares where all are small."""
    squares = (residuals**2).sum(axis=1)
    return float((squares / (1.0 + squares / (_TUNING * sigma_px) ** 2)).sum())


def variance_of(residuals: Array, weights: Array, share_left: float) -> float:
    """Variance of one coordinate that makes `(J' W J)^-1` a covariance.

    Huber (1981), "Robust statistics", section 7.6: the estimate's covariance is K^2 E[psi^2] /
    E[psi']^2 (J'J)^-1 with K = 1 + p/n var(psi') / E[psi']^2, and (J'J)^-1 is (J'WJ)^-1 times the
    mean weight. psi is weight w times residual, and its mean slope over both coordinates of a
    residual is w (2 sqrt(w) - 1).

    Args:
        residuals: (O, 2) residuals.
        weights: (O,) of `robust_weights`.
        share_left: of the observations' freedom, what an adjustment left.
    """
    squares = float((weights**2 * (residuals**2).sum(axis=1)).mean()) / (2.0 * share_left)
    slopes = weights * (2.0 * np.sqrt(weights) - 1.0)
    slope = float(slopes.mean())
    few = 1.0 + (1.0 - share_left) * float(slopes.var()) / slope**2
    return float(weights.mean()) * few**2 * squares / slope**2


_TRUST = 1e12
"""First radius of the trust region: no bound."""
FULLY, ROUGHLY = 1e-4, 1e-2
"""Relative changes of the cost at which an adjustment ends: where none follows, and others.
The last steps of a robust loss are many and small: in a block of 25 stations with camera errors of
0.22 mm, an end 10,000 times tighter takes 75 more of them and moves no camera by 0.007 mm."""
_EVERY_SIZE = 1_000_000_000
"""Pictures up to which an adjustment is solved directly."""


def direct_solver(options: pycolmap.BundleAdjustmentOptions) -> pycolmap.BundleAdjustmentOptions:
    """Make an adjustment quiet, of one thread and solved directly, in place, and return it.

    Sums of several threads are not the same twice. Beyond 1,000 pictures COLMAP would change to
    conjugate gradients, whose steps along a block's weak directions are so short that the cost
    seems to have converged: of 1,020 pictures 26 mm of bend were left where the optimum has 7 mm.
    The sparse factor of the reduced system is faster there as well (0.5 s for 2.3 s).
    """
    options.print_summary = False
    options.ceres.max_num_images_direct_sparse_cpu_solver = _EVERY_SIZE
    options.ceres.solver_options.num_threads = 1
    return options


def held_options(sigma_px: float, tolerance: float = FULLY) -> pycolmap.BundleAdjustmentOptions:
    """Options that hold cameras and rig, for keypoints of this sigma and some that are wrong."""
    options = direct_solver(pycolmap.BundleAdjustmentOptions())
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = loss_scale(sigma_px)
    options.refine_sensor_from_rig = False
    options.refine_focal_length = options.refine_extra_params = False
    solver = options.ceres.solver_options
    solver.initial_trust_region_radius = _TRUST
    solver.function_tolerance = tolerance
    return options


def all_pictures(model: pycolmap.Reconstruction) -> pycolmap.BundleAdjustmentConfig:
    """The part of a model to adjust: all of it."""
    config = pycolmap.BundleAdjustmentConfig()
    for number, image in sorted(model.images.items()):
        if image.has_pose:
            config.add_image(number)
    return config


_CELLS = 8
"""Cells along each side of a picture."""
_EACH = 12
"""Observations that are wanted in each cell."""
_WORTH = 0.5
"""Share of the observations from which leaving out the others does not pay."""
_TRIES = 50
_SHORT = 1e-10
"""Relative drop of a point's cost at which it is settled."""


def spread_part(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction | None:
    """A copy of a model with fewer points; None where nearly all are needed.

    Args:
        model: with registered pictures.
    """
    seen = observations(model)
    cell = _cells(model, seen)[np.argsort(seen.point, kind="stable")]
    starts, chosen = _starts(seen), np.zeros(len(seen.point_ids), np.bool_)
    longest = np.argsort(-np.diff(starts), kind="stable")
    _choose(starts, cell, longest, np.zeros(len(seen.pictures) * _CELLS**2, np.int64), chosen)
    kept = int(chosen[seen.point].sum())
    if kept > _WORTH * len(seen.point):
        return None
    part = pycolmap.Reconstruction(model)
    for number in seen.point_ids[~chosen].tolist():
        part.delete_point3D(number)
    return part


def take_poses(model: pycolmap.Reconstruction, part: pycolmap.Reconstruction) -> None:
    """Put the frames of a model, in place, where those of a part of it are."""
    for number in model.reg_frame_ids():
        model.frames[number].rig_from_world = part.frames[number].rig_from_world


def move_points(model: pycolmap.Reconstruction, robust_px: float | None = None) -> None:
    """Put points, in place, where the keypoints have them: poses, rig and cameras are held.

    Args:
        model: of pinholes without distortion.
        robust_px: scale of a Cauchy loss; None: plain least squares.
    """
    seen = observations(model)
    focal, rays = np.empty((len(seen.point), 2)), np.empty((len(seen.point), 2))
    pose_of = np.repeat(np.arange(len(seen.pictures)), np.diff(seen.starts))
    poses = np.empty((len(seen.pictures), 3, 4))
    for n, number in enumerate(seen.pictures.tolist()):
        image, rows = model.images[number], seen.of(n)
        camera = image.camera
        if camera.model != pycolmap.CameraModelId.PINHOLE:
            raise ValueError(f"points of a {camera.model.name} camera")
        poses[n] = image.cam_from_world().matrix()
        focal[rows] = camera.params[:2]
        rays[rows] = (seen.pixels[rows] - camera.params[2:]) / camera.params[:2]
    order = np.argsort(seen.point, kind="stable")
    points = seen.points.copy()
    _settle(
        _starts(seen), pose_of[order], rays[order], focal[order], poses, points,
        np.inf if robust_px is None else robust_px**2,
    )  # fmt: skip
    stored = model.points3D
    for number, xyz in zip(seen.point_ids.tolist(), points, strict=True):
        stored[number].xyz = xyz


def _starts(seen: Observed) -> Indices:
    """(P + 1,) where each point's observations start once they are sorted by point."""
    counts = np.bincount(seen.point, minlength=len(seen.point_ids))
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


def _cells(model: pycolmap.Reconstruction, seen: Observed) -> Indices:
    """(O,) the cell of each observation, counted through all pictures."""
    found = np.empty(len(seen.point), np.int64)
    for n, number in enumerate(seen.pictures.tolist()):
        camera, rows = model.images[number].camera, seen.of(n)
        at = np.floor(_CELLS * seen.pixels[rows] / [camera.width, camera.height])
        column, row = np.clip(at, 0, _CELLS - 1).astype(np.int64).T
        found[rows] = (n * _CELLS + row) * _CELLS + column
    return found


@compiled
def _choose(starts: Indices, cell: Indices, order: Indices, count: Indices, chosen: Flags) -> None:
    """Choose points, in order, that a cell still wants, in place."""
    for p in order:
        first, end = starts[p], starts[p + 1]
        for o in range(first, end):
            if count[cell[o]] < _EACH:
                chosen[p] = True
                break
        if chosen[p]:
            for o in range(first, end):
                count[cell[o]] += 1


@compiled(error_model="numpy")
def _settle(
    starts: Indices, pose_of: Indices, rays: Array, focal: Array, poses: Array, points: Array,
    robust: float,
) -> None:  # fmt: skip
    """Minimise the reprojection errors of each point by Levenberg-Marquardt steps, in place.

    Args:
        starts: (P + 1,) of the observations, sorted by point.
        pose_of: (O,) the pose of each.
        rays: (O, 2) slopes of the keypoints' rays.
        focal: (O, 2) focal lengths, pixels.
        poses: (N, 3, 4) `cam_from_world`.
        points: (P, 3) to move.
        robust: square of the scale of a Cauchy loss, pixels^2; inf for plain least squares.
    """
    for p in range(starts.shape[0] - 1):
        first, end = starts[p], starts[p + 1]
        damping, cost = 0.0, np.inf
        x, y, z = points[p]
        to_x, to_y, to_z = x, y, z
        xx = xy = xz = yy = yz = zz = gx = gy = gz = 0.0
        for _ in range(_TRIES):
            # Normal equations where the last step led.
            axx = axy = axz = ayy = ayz = azz = bx = by = bz = now = 0.0
            for o in range(first, end):
                pose = poses[pose_of[o]]
                depth = pose[2, 0] * to_x + pose[2, 1] * to_y + pose[2, 2] * to_z + pose[2, 3]
                residuals = 0.0
                for k in range(2):
                    at = pose[k, 0] * to_x + pose[k, 1] * to_y + pose[k, 2] * to_z + pose[k, 3]
                    residuals += (focal[o, k] * (at / depth - rays[o, k])) ** 2
                now += residuals if robust == np.inf else robust * np.log1p(residuals / robust)
                weight = 1.0 / (1.0 + residuals / robust)
                for k in range(2):
                    at = pose[k, 0] * to_x + pose[k, 1] * to_y + pose[k, 2] * to_z + pose[k, 3]
                    slope = at / depth
                    scale = focal[o, k] / depth
                    u = scale * (pose[k, 0] - slope * pose[2, 0])
                    v = scale * (pose[k, 1] - slope * pose[2, 1])
                    w = scale * (pose[k, 2] - slope * pose[2, 2])
                    miss = focal[o, k] * (slope - rays[o, k])
                    axx += weight * u * u
                    axy += weight * u * v
                    axz += weight * u * w
                    ayy += weight * v * v
                    ayz += weight * v * w
                    azz += weight * w * w
                    bx += weight * u * miss
                    by += weight * v * miss
                    bz += weight * w * miss
            if now <= cost:
                settled = cost < np.inf and cost - now <= _SHORT * cost
                x, y, z, cost = to_x, to_y, to_z, now
                xx, xy, xz, yy, yz, zz, gx, gy, gz = axx, axy, axz, ayy, ayz, azz, bx, by, bz
                damping *= 0.1
                if settled:
                    break
            else:
                damping = max(10.0 * damping, 1e-4)
            dxx, dyy, dzz = (1.0 + damping) * xx, (1.0 + damping) * yy, (1.0 + damping) * zz
            # Cramer's rule with the cofactors of the symmetric matrix.
            cxx, cxy, cxz = dyy * dzz - yz * yz, xz * yz - xy * dzz, xy * yz - xz * dyy
            cyy, cyz, czz = dxx * dzz - xz * xz, xy * xz - dxx * yz, dxx * dyy - xy * xy
            volume = dxx * cxx + xy * cxy + xz * cxz
            if not volume > 0.0:  # rays that do not fix the point
                break
            to_x = x - (cxx * gx + cxy * gy + cxz * gz) / volume
            to_y = y - (cxy * gx + cyy * gy + cyz * gz) / volume
            to_z = z - (cxz * gx + cyz * gy + czz * gz) / volume
        points[p, 0], points[p, 1], points[p, 2] = x, y, z
