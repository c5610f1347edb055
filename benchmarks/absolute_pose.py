"""Pose of a camera, or of a rig of cameras, behind flat ports from known points, among outliers.

Through a flat port no two rays meet in one centre, so each pixel is a ray of its own:

1. The exact rays of all pixels go to COLMAP's generalised absolute pose (RANSAC on three points).
2. From there the exact reprojection error is minimised (Levenberg-Marquardt), first under
   Cauchy's loss, which forgives outliers among the first inliers, then as plain least squares.
3. Inliers are chosen again by the noise that the residuals themselves show, until they stay.

Least squares over the inliers reaches the Cramer-Rao bound when noise is normal; what the cut at
`_CUT` sigmas throws away of good points is one in 3,000.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array
from camera_calib.camera import Camera, pose_jacobian

MIN_INLIERS = 6

_CUT = 4.0
_FLOOR_PX = 1e-6
"""Residuals below this are rounding and never make an outlier."""
_CAUCHY = 2.385
"""Scale of Cauchy's loss in sigmas: 95 % efficient under normal noise."""
_MEDIAN_OF_RADII = math.sqrt(2.0 * math.log(2.0))
"""Median length of a normal error in two dimensions, in sigmas of one."""
_ROUNDS = 20
_STEPS = 60
_TRIALS = (200, 20_000)
_CONFIDENCE = 0.99999
_SCORED = 2000
"""RANSAC looks at this many observations at most; the rest would cost time and add nothing."""

_FALSE_ALARMS = 1e-3

Mask = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True, eq=False)
class Sighting:
    """What one camera of the rig saw: pixels and the points they show, row by row."""

    camera: Camera
    pixels: Array
    """(N, 2); a row that is not finite is left out."""
    points_world: Array
    """(N, 3), metres; a row that is not finite is left out."""
    cam_from_rig: RigidTransform = field(default_factory=RigidTransform.identity)

    def __post_init__(self) -> None:
        shapes = np.shape(self.pixels), np.shape(self.points_world)
        if shapes[0] != (len(self.pixels), 2) or shapes[1] != (len(self.pixels), 3):
            raise CalibrationError(
                f"pose: pixels {shapes[0]} and points {shapes[1]} must be (N, 2) and (N, 3)"
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class AbsolutePose:
    """A pose and how well it is known."""

    rig_from_world: RigidTransform
    covariance: Array
    """(6, 6) of a small motion in the rig's frame, rotation vector (rad) then translation (m):
    the true pose is that motion after `rig_from_world`."""
    inliers: tuple[Mask, ...]
    """Per sighting, (N,): the observations that the pose rests on."""
    sigma_px: float
    """Noise of the inliers' pixels, per axis."""
    ignored: int
    """Observations that are not finite, or whose pixel no ray reaches."""

    @property
    def sigma_rotation_rad(self) -> float:
        """Standard deviation of the rotation's angle (all three axes together)."""
        return math.sqrt(float(np.trace(self.covariance[:3, :3])))

    @property
    def sigma_position_m(self) -> float:
        """Standard deviation of the rig's place in the world (all three axes together)."""
        return math.sqrt(float(np.trace(self.covariance[3:, 3:])))


def absolute_pose(
    sightings: Sequence[Sighting], rng: np.random.Generator, start_error_px: float = 10.0
) -> AbsolutePose:
    """Find where a rig is from pixels of known points, of which many may be wrong.

    Args:
        sightings: one per camera; a single camera has `cam_from_rig` = identity.
        rng: draws RANSAC's samples; the same state gives the same pose.
        start_error_px: within this, a first guess from three points counts an observation as
            right: some five sigmas of the noise. The final limit comes from the data.

    Raises:
        CalibrationError: fewer than `MIN_INLIERS` observations agree, or they leave the pose open
            (all points on a line).
    """
    if not start_error_px > 0.0:
        raise CalibrationError(f"pose: start_error_px = {start_error_px} must be positive")
    if not sightings:
        raise CalibrationError("pose: no sightings were given")
    usable = np.concatenate([_usable(sighting) for sighting in sightings])
    count = int(usable.sum())
    if count < MIN_INLIERS:
        raise CalibrationError(
            f"pose: {count} of {len(usable)} observations are usable; at least {MIN_INLIERS} are "
            f"needed"
        )
    # Far from the world's origin, numbers lose digits and the rotation couples to the place.
    centre = np.concatenate([s.points_world for s in sightings])[usable].mean(axis=0)
    local = [replace(s, points_world=s.points_world - centre) for s in _chosen(sightings, usable)]
    start = _start(local, rng, start_error_px)
    pose, inliers, sigma_px = _settle(start, local, start_error_px)
    bound = np.linalg.inv(pose_information(pose, _chosen(local, inliers)))
    kept = np.zeros(len(usable), dtype=np.bool_)
    kept[usable] = inliers
    return AbsolutePose(
        rig_from_world=pose * RigidTransform.from_translation(-centre),
        covariance=np.asarray(sigma_px**2 * bound, dtype=np.float64),
        inliers=tuple(_by_sighting(sightings, kept)),
        sigma_px=sigma_px,
        ignored=len(usable) - count,
    )


def pose_information(rig_from_world: RigidTransform, sightings: Sequence[Sighting]) -> Array:
    """Information on a pose in pixels with noise of 1 px, (6, 6).

    Its inverse is the Cramer-Rao bound: the least covariance of any unbiased estimate, in the
    coordinates of `AbsolutePose.covariance`.

    Raises:
        CalibrationError: the points leave the pose open.
    """
    _, information, _ = _normal_equations(rig_from_world, sightings, math.inf)
    scale = np.sqrt(np.diag(information))
    if not np.all(scale > 0) or np.linalg.cond(information / np.outer(scale, scale)) > 1e13:
        count = sum(len(s.pixels) for s in sightings)
        raise CalibrationError(
            f"pose: {count} points leave it open; give points that are not all on one line"
        )
    return information


def _usable(sighting: Sighting) -> Mask:
    _, directions = sighting.camera.unproject(sighting.pixels)
    rows = np.hstack([directions, sighting.points_world])
    return np.asarray(np.isfinite(rows).all(axis=1), dtype=np.bool_)


def _start(
    sightings: Sequence[Sighting], rng: np.random.Generator, error_px: float
) -> RigidTransform:
    """A pose from three rays and points that many others agree with.

    Each ray becomes a pinhole of its own that looks along the camera's axis. Its centre may be any
    point of the ray: where the pupil seems to be, seen from the water, a focal length of
    f * n_water makes COLMAP's error about that in pixels.
    """
    centres, aims, cameras, index = [], [], [], []
    for number, sighting in enumerate(sightings):
        camera = sighting.camera
        points, directions = camera.unproject(sighting.pixels)
        back_m = camera.n_water * (
            camera.parameter("port_distance_m")
            + camera.parameter("glass_thickness_m") / camera.parameter("n_glass")
        )
        focal_px = camera.n_water * math.sqrt(camera.fx_px * camera.fy_px)
        centres.append(points - back_m * directions)
        aims.append(focal_px * directions[:, :2] / directions[:, 2:])
        cameras.append(
            pycolmap.Camera(model="SIMPLE_PINHOLE", width=1, height=1, params=[focal_px, 0.0, 0.0])
        )
        index.append(np.full(len(points), number))
    which = np.concatenate(index)
    chosen = np.arange(len(which))
    if len(which) > _SCORED:
        chosen = np.sort(rng.choice(len(which), _SCORED, replace=False))
    centre, aim = np.concatenate(centres)[chosen], np.concatenate(aims)[chosen]
    world = np.concatenate([s.points_world for s in sightings])[chosen]
    poses = []
    for number, place in zip(which[chosen], centre, strict=True):
        moved = RigidTransform.from_translation(-place) * sightings[number].cam_from_rig
        quaternion = pycolmap.Rotation3d(moved.rotation.as_quat())
        poses.append(pycolmap.Rigid3d(quaternion, moved.translation))
    options = pycolmap.RANSACOptions(
        max_error=error_px,
        confidence=_CONFIDENCE,
        min_num_trials=_TRIALS[0],
        max_num_trials=_TRIALS[1],
        random_seed=int(rng.integers(2**31 - 1)),
        num_threads=1,
    )
    found = pycolmap.estimate_generalized_absolute_pose(
        aim,
        world,
        np.arange(len(aim)),
        poses,
        [cameras[number] for number in which[chosen]],
        options,
    )
    if found is None:
        raise CalibrationError(
            f"pose: no three of {len(which)} observations give a pose that others agree with; "
            f"check that pixels and points belong together"
        )
    matrix = found["rig_from_world"].matrix()
    return RigidTransform.from_components(matrix[:, 3], Rotation.from_matrix(matrix[:, :3]))


def _settle(
    pose: RigidTransform, sightings: Sequence[Sighting], start_error_px: float
) -> tuple[RigidTransform, Mask, float]:
    """Refine, choosing inliers again by their own noise until they stay the same."""
    limit_px, loss_px = start_error_px, 0.0
    inliers: Mask = np.zeros(0, dtype=np.bool_)
    for turn in range(_ROUNDS):
        radii = _radii(pose, sightings)
        chosen: Mask = radii < limit_px
        count = int(chosen.sum())
        if count < MIN_INLIERS:
            raise CalibrationError(
                f"pose: {count} of {len(radii)} observations lie within {limit_px:.3g} px of one "
                f"pose; at least {MIN_INLIERS} are needed: raise start_error_px or check that "
                f"pixels and points belong together"
            )
        if turn > 1 and np.array_equal(chosen, inliers):
            break
        inliers = chosen
        loss_px = _CAUCHY * _noise_px(radii[inliers]) if turn == 0 else math.inf
        pose = _descend(pose, _chosen(sightings, inliers), loss_px)
        limit_px = max(_CUT * _noise_px(_radii(pose, sightings)[inliers]), _FLOOR_PX)
    found = int(inliers.sum())
    if _false_alarms(found, limit_px, sightings) > _FALSE_ALARMS:
        raise CalibrationError(
            f"pose: only {found} of {len(inliers)} observations lie within {limit_px:.3g} px of "
            f"one pose, and random pixels would do as well: check that pixels and points belong "
            f"together, or start_error_px"
        )
    squares = float((_radii(pose, sightings)[inliers] ** 2).sum())
    return pose, inliers, math.sqrt(squares / (2 * found - 6))


def _false_alarms(found: int, limit_px: float, sightings: Sequence[Sighting]) -> float:
    """How many poses with as many inliers to expect among random pixels.

    The a-contrario criterion of Moisan & Stival (2004): ways to choose the inliers and the three of
    them that make the pose, times the probability that the others fall so close by chance.
    """
    total = sum(len(s.pixels) for s in sightings)
    pixels = sum(len(s.pixels) * s.camera.width_px * s.camera.height_px for s in sightings) / total
    share = min(1.0, math.pi * limit_px**2 / pixels)
    exponent = math.log(total) + (found - 3) * math.log(share)
    exponent += _log_ways(total, found) + _log_ways(found, 3)
    return math.exp(min(exponent, 700.0))


def _log_ways(total: int, taken: int) -> float:
    """Logarithm of the binomial coefficient."""
    ways = math.lgamma(total + 1) - math.lgamma(taken + 1) - math.lgamma(total - taken + 1)
    return float(ways)


def _noise_px(radii: Array) -> float:
    """Sigma per axis of residuals of these lengths, from their median: outliers hardly move it."""
    count = len(radii)
    freedom = 2 * count / (2 * count - 6)
    return max(float(np.median(radii)) / _MEDIAN_OF_RADII * math.sqrt(freedom), 1e-12)


def _radii(pose: RigidTransform, sightings: Sequence[Sighting]) -> Array:
    """Lengths of all reprojection errors, px; infinite where a point cannot be seen."""
    lengths = []
    for sighting in sightings:
        points_cam = (sighting.cam_from_rig * pose).apply(sighting.points_world)
        lengths.append(
            np.linalg.norm(sighting.camera.project(points_cam) - sighting.pixels, axis=1)
        )
    radii = np.concatenate(lengths)
    return np.where(np.isfinite(radii), radii, np.inf)


def _by_sighting(sightings: Sequence[Sighting], rows: Mask) -> list[Mask]:
    """Rows counted through all sightings, cut into those of each."""
    return np.split(rows, np.cumsum([len(s.pixels) for s in sightings])[:-1])


def _chosen(sightings: Sequence[Sighting], rows: Mask) -> list[Sighting]:
    """The sightings with only some of their rows."""
    masks = _by_sighting(sightings, rows)
    return [
        replace(s, pixels=s.pixels[mask], points_world=s.points_world[mask])
        for s, mask in zip(sightings, masks, strict=True)
    ]


def _normal_equations(
    pose: RigidTransform, sightings: Sequence[Sighting], loss_px: float
) -> tuple[float, Array, Array]:
    """Cost, its approximate second and its half first derivative by a small motion of the rig.

    The cost of a residual of length r is c^2 log(1 + r^2 / c^2) with c = `loss_px` (Cauchy), r^2
    for c = inf. It is NaN when a point cannot be seen.
    """
    cost, squared, gradient = 0.0, np.zeros((6, 6)), np.zeros(6)
    for sighting in sightings:
        points_rig = pose.apply(sighting.points_world)
        points_cam = sighting.cam_from_rig.apply(points_rig)
        pixels, by_point, _ = sighting.camera.project_jacobian(points_cam)
        by_rig_point = by_point @ sighting.cam_from_rig.rotation.as_matrix()
        slopes = pose_jacobian(by_rig_point, points_rig)
        miss = pixels - sighting.pixels
        radius2 = (miss**2).sum(axis=1)
        weight = 1.0 / (1.0 + radius2 / loss_px**2)
        if math.isfinite(loss_px):
            cost += loss_px**2 * float(np.log1p(radius2 / loss_px**2).sum())
        else:
            cost += float(radius2.sum())
        weighted = slopes * weight[:, None, None]
        squared += np.einsum("nij,nik->jk", weighted, slopes)
        gradient += np.einsum("nij,ni->j", weighted, miss)
    return cost, squared, gradient


def _descend(pose: RigidTransform, sightings: Sequence[Sighting], loss_px: float) -> RigidTransform:
    """Minimise the cost from here by Levenberg-Marquardt's method."""
    cost, squared, gradient = _normal_equations(pose, sightings, loss_px)
    damping = 1e-4
    for _ in range(_STEPS):
        damped = squared + damping * np.diag(np.diag(squared))
        try:
            step = -np.linalg.solve(damped, gradient)
        except np.linalg.LinAlgError:
            break
        gain = -float(gradient @ step)
        if gain <= 1e-13 * cost:
            break
        motion = RigidTransform.from_components(step[3:], Rotation.from_rotvec(step[:3]))
        candidate = motion * pose
        found = _normal_equations(candidate, sightings, loss_px)
        if found[0] < cost:
            pose, (cost, squared, gradient) = candidate, found
            damping = max(damping / 10.0, 1e-12)
        elif gain <= 1e-9 * cost or damping > 1e9:
            break  # what is left to gain drowns in rounding
        else:
            damping *= 10.0
    return pose
