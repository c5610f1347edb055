"""First values of a calibration: target poses, focal lengths, camera poses.

Poses come from the closed form for planar targets (T. Collins, A. Bartoli 2014, "Infinitesimal
plane-based pose estimation", in OpenCV), with every pixel's exact ray in water in place of a
pinhole's, and are then refined through the ports.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array
from camera_calib.calibrate.adjust import adjust
from camera_calib.calibration import TargetView
from camera_calib.camera import Camera
from camera_calib.freedom import HELD
from camera_calib.rig import Rig
from camera_calib.target_shape import is_sheet

MIN_POINTS = 6
"""Fewest points that give a pose: six coordinates and some to spare."""
_THINNEST = 0.02
"""Least width over length of the seen part of a target: points in one row give no pose."""
_CLEAR = 2.0
"""A second pose with residuals this many times larger than the first is ignored."""
_ALIKE = 0.3
"""Largest difference of poses between cameras that is an error: radians and share of the range."""
_ROUGHLY = 0.3
"""Convergence limit, in sigmas, of poses that only serve as a start."""
_STEPS = 30
_FOCALS = 0.5 * 1.25 ** np.arange(14)
"""Focal lengths that are tried, in widths of the picture: 0.5 to 9 (90 to 6 degrees)."""


def locate(rig: Rig, view: TargetView, points: Array) -> RigidTransform:
    """The pose `rig_from_target` of one view, with the rig held.

    Args:
        rig: calibrated.
        view: what its cameras saw.
        points: (N, 3) of the target, metres.

    Raises:
        CalibrationError: no camera sees enough of the target.
    """
    found = locate_all(rig, [view], points, settled=1e-3)[0]
    if found is None:
        raise CalibrationError(
            f"view {view.name}: no pose; {MIN_POINTS} points of the target that are not in one "
            "row must be seen by one camera"
        )
    return found


def locate_all(
    rig: Rig, views: Sequence[TargetView], points: Array, settled: float = _ROUGHLY
) -> list[RigidTransform | None]:
    """Poses `rig_from_target` of views, with the rig held; None where too little is seen.

    Args:
        rig: near the truth.
        views: what its cameras saw.
        points: (N, 3) of the target, metres.
        settled: how well, in sigmas of the poses.
    """
    guesses = [_guesses(rig, view, points) for view in views]
    found: list[RigidTransform | None] = [None] * len(views)
    residuals = np.full(len(views), np.inf)
    for attempt in range(2):
        at = [v for v, guess in enumerate(guesses) if len(guess) > attempt]
        if not at:
            continue
        start = RigidTransform.concatenate([guesses[v][attempt] for v in at])
        poses, lengths = _refine(rig, [views[v] for v in at], points, start, settled)
        for i, v in enumerate(at):
            if lengths[i] < residuals[v]:
                found[v], residuals[v] = poses[i], lengths[i]
    return found


def _refine(
    rig: Rig, views: Sequence[TargetView], points: Array, start: RigidTransform, settled: float
) -> tuple[RigidTransform, Array]:
    """Poses of least residuals, and the mean robust length of each view's residuals."""
    adjusted = adjust(views, points, rig, start, HELD, settled, at_most=_STEPS)
    lengths = np.sqrt((adjusted.residuals_px**2).sum(axis=-1)) * np.sqrt(adjusted.weights)
    return adjusted.rig_from_target, np.nanmean(lengths.reshape(len(views), -1), axis=1)


def _guesses(rig: Rig, view: TargetView, points: Array) -> list[RigidTransform]:
    """One or two poses of the target from the camera that sees most of it, the better first."""
    counts = {
        name: int(np.isfinite(seen).all(axis=1).sum())
        for name, seen in view.pixels.items()
        if spans(seen, points)
    }
    if not counts:
        return []
    best = max(counts, key=lambda name: counts[name])
    rig_from_cam = rig.cam_from_rig[best].inv()
    return [rig_from_cam * pose for pose in _poses(rig.cameras[best], view.pixels[best], points)]


def spans(pixels: Array, points: Array) -> bool:
    """Whether the seen points, (N, 2) pixels of (N, 3) points, are enough for a pose."""
    seen = points[np.isfinite(pixels).all(axis=1)]
    if len(seen) < MIN_POINTS:
        return False
    width = np.linalg.svd(seen - seen.mean(axis=0), compute_uv=False)
    return bool(width[1] > _THINNEST * width[0])


def _poses(camera: Camera, pixels: Array, points: Array) -> list[RigidTransform]:
    """Poses `cam_from_target`: rays are taken to start at the point that is nearest to all."""
    origins, directions = camera.unproject(pixels)
    known = np.asarray(np.isfinite(np.hstack([directions, pixels])).all(axis=1))
    if not spans(np.where(known[:, None], pixels, np.nan), points):
        return []
    origins, directions = origins[known], directions[known]
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    matrix = across.sum(axis=0) + 1e-9 * len(across) * np.eye(3)
    centre = np.linalg.solve(matrix, (across @ origins[..., None]).sum(axis=0)[:, 0])
    return _pinhole_poses(directions[:, :2] / directions[:, 2:], points[known], centre)


def _pinhole_poses(tangents: Array, points: Array, centre: Array) -> list[RigidTransform]:
    planar = is_sheet(points)
    points = points * [1.0, 1.0, 0.0] if planar else points
    flag = cv2.SOLVEPNP_IPPE if planar else cv2.SOLVEPNP_SQPNP
    try:
        _, turns, shifts, residuals = cv2.solvePnPGeneric(
            points, np.ascontiguousarray(tangents), np.eye(3), None, flags=flag
        )
    except cv2.error:
        return []
    poses: list[RigidTransform] = []
    for turn, shift, residual in zip(turns, shifts, np.ravel(residuals), strict=True):
        clear = poses and residual > _CLEAR * float(np.ravel(residuals)[0])
        if not clear and np.all(np.isfinite(turn)) and np.all(np.isfinite(shift)):
            place = shift.ravel() + centre
            poses.append(RigidTransform.from_components(place, Rotation.from_rotvec(turn.ravel())))
    return poses


def first_focal_px(pixels: Sequence[Array], points: Array, size: tuple[int, int]) -> float:
    """A focal length, within a quarter, that explains views of a target, without a start.

    The principal point is taken in the middle and the lens without distortion. Of some focal
    lengths the one with the least residuals of the target's poses is returned.

    Args:
        pixels: (N, 2) of each view; NaN where not seen.
        points: (N, 3) of the target, metres.
        size: width and height of the pictures.

    Raises:
        CalibrationError: no view shows enough of the target.
    """
    usable = [seen for seen in pixels if spans(seen, points)]
    if not usable:
        raise CalibrationError("no view shows enough of the target to start from")
    middle = np.array(size) / 2.0
    residuals = [
        np.mean([_homography_miss(seen - middle, points, share * size[0]) for seen in usable])
        for share in _FOCALS
    ]
    return float(_FOCALS[int(np.argmin(residuals))] * size[0])


def _homography_miss(centred: Array, points: Array, focal_px: float) -> float:
    """Mean squared residual, px^2, of the best pose under one focal length."""
    known = np.isfinite(centred).all(axis=1)
    tangents = centred[known] / focal_px
    residuals = [np.inf]
    for pose in _pinhole_poses(tangents, points[known], np.zeros(3)):
        cam = pose.apply(points[known])
        residual = cam[:, :2] / cam[:, 2:] - tangents
        residuals.append(float((residual**2).sum(axis=1).mean()) * focal_px**2)
    return min(residuals)


def first_cam_from_rig(
    cameras: Mapping[str, Camera], views: Sequence[TargetView], points: Array
) -> dict[str, RigidTransform]:
    """Poses of the cameras relative to the first, from the target's poses in each.

    Args:
        cameras: near the truth.
        views: what they saw.
        points: (N, 3) of the target, metres.

    Raises:
        CalibrationError: no chain of shared views joins a camera to the first, or in most views it
            stands elsewhere than in the others.
    """
    poses = {name: poses_alone(name, camera, views, points) for name, camera in cameras.items()}
    names = list(cameras)
    found = {names[0]: RigidTransform.identity()}
    while len(found) < len(names):
        shared = {
            (known, new): set(poses[known]) & set(poses[new])
            for known in found
            for new in names
            if new not in found
        }
        (known, new), both = max(shared.items(), key=lambda item: len(item[1]))
        if not both:
            raise CalibrationError(
                f"no view shows the target to both {known} and {new}: take some that do"
            )
        between = RigidTransform.concatenate(
            [poses[new][v] * poses[known][v].inv() for v in sorted(both)]
        )
        ranges_m = [np.linalg.norm(poses[known][v].translation) for v in sorted(both)]
        _check_alike(known, new, between, float(np.median(ranges_m)))
        found[new] = _middle(between) * found[known]
    return {name: found[name] for name in names}


def _check_alike(known: str, new: str, between: RigidTransform, range_m: float) -> None:
    """Reject views that show different moments to two cameras: no rig explains them."""
    alike = int((poses_apart(between, range_m) < _ALIKE).sum(axis=1).max())
    if alike < len(between) / 2.0:
        raise CalibrationError(
            f"{new} stands to {known} in one way in {alike} of the {len(between)} views of both, "
            "and elsewhere in the others: are pictures of one number, or of one place in the "
            "lists, of one moment, and did the cameras stay as they were to each other?"
        )


def poses_alone(
    name: str, camera: Camera, views: Sequence[TargetView], points: Array
) -> dict[int, RigidTransform]:
    """Poses of the target in the frame of one camera, by the number of the view."""
    alone = Rig(
        cameras={name: camera},
        cam_from_rig={name: RigidTransform.identity()},
        body_from_rig=None,
        source="one camera",
    )
    at = [v for v, view in enumerate(views) if name in view.pixels]
    seen = [replace(views[v], pixels={name: views[v].pixels[name]}) for v in at]
    found = locate_all(alone, seen, points)
    return {v: pose for v, pose in zip(at, found, strict=True) if pose is not None}


def _middle(poses: RigidTransform) -> RigidTransform:
    """The pose that differs least from the others, turn and place together."""
    scale = float(np.median(np.linalg.norm(poses.translation, axis=1))) + 1e-12
    return poses[int(np.argmin(poses_apart(poses, scale).sum(axis=1)))]


def poses_apart(poses: RigidTransform, scale: float) -> Array:
    """Differences of all poses from each other, (N, N): radians and lengths over the scale."""
    turns = poses.rotation.as_matrix()
    cosines = (np.einsum("aij,bij->ab", turns, turns) - 1.0) / 2.0
    places = np.linalg.norm(poses.translation[:, None] - poses.translation, axis=-1)
    return np.asarray(np.arccos(np.clip(cosines, -1.0, 1.0)) + places / scale)
