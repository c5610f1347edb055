"""One stereo pair: where its points are, and how well they are known."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.errors import ReconstructionError
from alice_survey.core.frames import Array
from camera_calib.approximation.pinhole_warp import PinholeWarp, best_warp
from camera_calib.camera import Camera
from camera_calib.freedom import POSE
from camera_calib.rig import Rig
from camera_calib.triangulate import triangulate
from reconstruct.mapping.working_range import ray_passes
from reconstruct.views.model import View
from reconstruct.views.range_shift import range_shift

_MIN_POINTS = 50
_MAX_GAP_PX = 2.0
"""Rays of a match pass each other by at most this many pixels."""
_STEP_SIGMAS = 0.1
"""Share of a parameter's standard deviation, as the step for slopes."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StereoRig:
    """Two cameras; the world is the frame of the first (right, down, forward, at its pupil)."""

    names: tuple[str, str]
    cameras: tuple[Camera, Camera]
    second_from_first: RigidTransform

    @property
    def poses(self) -> tuple[RigidTransform, RigidTransform]:
        """`cam_from_world` of both."""
        return RigidTransform.identity(), self.second_from_first

    def points(self, pixels: Array) -> Array:
        """Points (N, 3) whose rays through the ports end at pixels (2, N, 2), as taken."""
        return triangulate(self.cameras, self.poses, pixels).points_world

    def pixels(self, points: Array) -> Array:
        """Pixels (2, N, 2), as taken, of points (N, 3)."""
        return np.stack(
            [c.project(p.apply(points)) for c, p in zip(self.cameras, self.poses, strict=True)]
        )


def stereo_rig(rig: Rig) -> StereoRig:
    """The first two cameras of a rig.

    Raises:
        ReconstructionError: it has only one.
    """
    names = list(rig.cameras)
    if len(names) < 2:
        raise ReconstructionError(
            f"the rig has one camera ({names[0]}): two are needed for a stereo pair"
        )
    first, second = names[:2]
    return StereoRig(
        names=(first, second),
        cameras=(rig.cameras[first], rig.cameras[second]),
        second_from_first=rig.cam_from_rig[second] * rig.cam_from_rig[first].inv(),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class PairOptics:
    """A stereo rig as the pinholes that stand in for it at its working range."""

    rig: StereoRig
    warps: tuple[PinholeWarp, PinholeWarp]

    @cached_property
    def views(self) -> tuple[View, View]:
        """Both views, in the world of the rig."""
        views = []
        for name, warp, pose in zip(self.rig.names, self.warps, self.rig.poses, strict=True):
            views.append(
                View(
                    image=name,
                    camera=name,
                    station=0,
                    pinhole=warp.pinhole,
                    world_from_cam=pose.inv() * warp.pinhole_from_cam.inv(),
                    shift=range_shift(warp),
                )
            )
        return views[0], views[1]


def optics_for(rig: StereoRig, near_m: float, far_m: float) -> PairOptics:
    """The best pinholes for distances between near and far."""
    first, second = (best_warp(camera, near_m, far_m) for camera in rig.cameras)
    return PairOptics(rig=rig, warps=(first, second))


def matched_points(rig: StereoRig, pixels: tuple[Array, Array]) -> Array:
    """Points (M, 3) of those matches whose rays meet before the cameras.

    Args:
        rig: both cameras.
        pixels: (N, 2) each, as taken, row by row a match; false ones among them.

    Raises:
        ReconstructionError: too few rays meet, or they meet behind the cameras: the pictures are
            swapped.
    """
    start_a, ray_a = rig.cameras[0].unproject(pixels[0])
    start_b, ray_b = rig.cameras[1].unproject(pixels[1])
    back = rig.second_from_first.inv()
    start_b, ray_b = back.apply(start_b), back.rotation.apply(ray_b)
    along, gap = ray_passes(start_a, ray_a, start_b, ray_b)
    focal = rig.cameras[0].focal_in_water_px
    with np.errstate(invalid="ignore"):
        meet = gap * focal < _MAX_GAP_PX * np.abs(along)
        before, behind = meet & (along > 0), meet & (along < 0)
    if behind.sum() > max(before.sum(), _MIN_POINTS):
        raise ReconstructionError(
            f"{int(behind.sum())} matches meet behind the cameras and {int(before.sum())} before "
            f"them: the pictures are swapped; give that of {rig.names[0]!r} first"
        )
    if before.sum() < _MIN_POINTS:
        raise ReconstructionError(
            f"hardly any match: {len(along)} found and {int(before.sum())} whose rays meet, "
            f"{_MIN_POINTS} are needed; were both pictures taken at one moment, sharp, and with "
            "this rig?"
        )
    found: Array = start_a[before] + along[before, None] * ray_a[before]
    return found


def calibration_slopes(
    rig: Rig, pixels: Array, sigmas: Mapping[str, float]
) -> tuple[Array, NDArray[np.intp]]:
    """How points move with the parameters of the rig while their pixels stay.

    Args:
        rig: as calibrated.
        pixels: (2, N, 2) as taken.
        sigmas: of the parameters to look at, by name.

    Returns:
        (P, N, 3) slopes, metres per unit of the parameter; and the numbers of the parameters, in
        the order of `sigmas`, that have one (a camera that is not of the pair has none).
    """
    names, used, slopes = stereo_rig(rig).names, [], []
    for number, (name, sigma) in enumerate(sigmas.items()):
        camera, _, field = name.partition(".")
        if camera not in names or sigma <= 0:
            continue
        step = _STEP_SIGMAS * sigma
        ends = [stereo_rig(_changed(rig, camera, field, s)).points(pixels) for s in (step, -step)]
        used.append(number)
        slopes.append((ends[0] - ends[1]) / (2.0 * step))
    empty = np.zeros((0, pixels.shape[1], 3))
    return np.stack(slopes) if slopes else empty, np.array(used, dtype=np.intp)


def _changed(rig: Rig, camera: str, field: str, step: float) -> Rig:
    """The rig with one parameter moved by a step; see `camera_calib.freedom`."""
    if field in rig.cameras[camera].parameters:
        old = rig.cameras[camera]
        new = old.with_parameters({field: old.parameter(field) + step})
        return replace(rig, cameras={**rig.cameras, camera: new})
    pose = rig.cam_from_rig[camera]
    if field not in POSE:
        raise ReconstructionError(f"the rig's covariance names {camera}.{field}: it is not known")
    motion = np.zeros(6)
    motion[POSE.index(field)] = step
    moved = RigidTransform.from_components(
        pose.translation + motion[3:], Rotation.from_rotvec(motion[:3]) * pose.rotation
    )
    return replace(rig, cam_from_rig={**rig.cam_from_rig, camera: moved})
