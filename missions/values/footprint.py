"""What cameras behind flat ports see of a level sea floor: footprints, swaths, overlaps."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform
from shapely.geometry import Polygon

from alice_survey.core.errors import PlanError
from alice_survey.core.frames import BODY_FROM_NADIR_CAM, Array, rotation_from_attitude
from camera_calib.camera import Camera
from camera_calib.fov.table import sides_of, sure_size_m
from camera_calib.rig import Rig

_POINTS_PER_SIDE = 16


@dataclass(frozen=True, kw_only=True)
class Swath:
    """What is surely seen of a level sea floor on a line, about the left port's outer glass.

    A footprint bulges: seen through a flat port its sides are convex. `port_m` and `starboard_m`
    are the least reach of the union of the footprints of a line, without gaps while its stations
    are no farther apart than `along_m`; `ahead_m` and `astern_m` are the reach of one footprint
    over its whole width. All count along the vehicle's axes from the point below
    the glass, positive in the direction of their names, and may be negative.
    """

    port_m: float
    starboard_m: float
    astern_m: float
    ahead_m: float

    @property
    def across_m(self) -> float:
        """Width across the vehicle."""
        return self.port_m + self.starboard_m

    @property
    def along_m(self) -> float:
        """Length fore and aft."""
        return self.astern_m + self.ahead_m

    @property
    def half_across_m(self) -> float:
        """The reach on the side that sees less."""
        return min(self.port_m, self.starboard_m)


def level_pose(
    camera: Camera, glass_ne: Array, altitude_m: float, depth_m: float, heading_rad: float
) -> RigidTransform:
    """Pose `ned_from_cam` of a nadir camera on a level vehicle.

    Args:
        camera: the camera.
        glass_ne: (2,) place of the outer glass, north and east.
        altitude_m: of the outer glass above the sea floor.
        depth_m: of the sea floor.
        heading_rad: of the vehicle.
    """
    rotation = rotation_from_attitude(0.0, 0.0, heading_rad) * BODY_FROM_NADIR_CAM
    glass_ned = np.array([glass_ne[0], glass_ne[1], depth_m - altitude_m])
    pupil_ned = glass_ned - rotation.apply(camera.front_cam)
    return RigidTransform.from_components(pupil_ned, rotation)


def footprint_ne(
    camera: Camera,
    ned_from_cam: RigidTransform,
    seafloor_depth_m: float,
    points_per_side: int = _POINTS_PER_SIDE,
) -> Array:
    """Where the border of a picture falls on a level sea floor, exactly through the flat port.

    Args:
        camera: the camera.
        ned_from_cam: its pose (entrance pupil), metres.
        seafloor_depth_m: depth of the sea floor, positive down.
        points_per_side: points on each side of the border.

    Returns:
        (4 * points_per_side, 2) north and east in the order of the border; a row is NaN where its
        ray never reaches the sea floor.
    """
    points_cam, rays_cam = camera.unproject(camera.border(points_per_side))
    points_ned = ned_from_cam.apply(points_cam)
    rays_ned = ned_from_cam.rotation.apply(rays_cam)
    descent = np.where(rays_ned[:, 2] > 0, rays_ned[:, 2], np.nan)
    reach = (seafloor_depth_m - points_ned[:, 2]) / descent
    hits: Array = points_ned + np.where(reach > 0, reach, np.nan)[:, None] * rays_ned
    return hits[:, :2]


def footprint_polygon(
    camera: Camera, ned_from_cam: RigidTransform, seafloor_depth_m: float
) -> Polygon:
    """The footprint as a polygon with x = north and y = east.

    Raises:
        PlanError: part of the picture looks past the sea floor.
    """
    border = footprint_ne(camera, ned_from_cam, seafloor_depth_m)
    if not np.all(np.isfinite(border)):
        raise PlanError(
            f"a camera at depth {ned_from_cam.translation[2]:.2f} m does not see the sea floor at "
            f"{seafloor_depth_m:.2f} m with its whole frame"
        )
    return Polygon(border)


def footprint_size_m(camera: Camera, altitude_m: float) -> tuple[float, float]:
    """Across and along size of the upright rectangle that a level camera surely sees.

    See `camera_calib.fov.table.sure_size_m`.

    Args:
        camera: the camera.
        altitude_m: of the outer glass above the sea floor.

    Raises:
        PlanError: part of the picture looks past the sea floor.
    """
    size_m = sure_size_m(camera, camera.front_cam[2] + altitude_m)
    if not np.all(np.isfinite(size_m)):
        raise PlanError("the camera does not see the sea floor with its whole frame")
    return size_m


def camera_swath(rig: Rig, name: str, altitude_m: float, step_m: float) -> Swath:
    """What one camera of a rig surely sees on a line when the vehicle is level.

    Args:
        rig: the rig; the altitude and the swath's origin are of its first camera's outer glass.
        name: which camera.
        altitude_m: of the first camera's outer glass above the sea floor.
        step_m: from station to station.

    Raises:
        PlanError: part of the picture looks past the sea floor.
    """
    glass_body = rig.body_from_cam(rig.reference).apply(rig.cameras[rig.reference].front_cam)
    body_from_cam = rig.body_from_cam(name)
    local_from_cam = RigidTransform.from_translation(-glass_body) * body_from_cam
    border = footprint_ne(rig.cameras[name], local_from_cam, altitude_m)
    if not np.all(np.isfinite(border)):
        raise PlanError(
            f"camera {name} does not see the sea floor {altitude_m:g} m below with its whole frame"
        )
    top, starboard, bottom, port = sides_of(border)
    middle = (top[:, 0].min() + bottom[:, 0].max()) / 2
    return Swath(
        port_m=_min_reach(port[:, 0] - middle, -port[:, 1], step_m),
        starboard_m=_min_reach(middle - starboard[:, 0], starboard[:, 1], step_m),
        astern_m=float(-bottom[:, 0].max()),
        ahead_m=float(top[:, 0].min()),
    )


def common_swath(rig: Rig, altitude_m: float, step_m: float) -> Swath:
    """What every camera of the rig surely sees on a line: the swath of stereo."""
    swaths = [camera_swath(rig, name, altitude_m, step_m) for name in rig.cameras]
    return Swath(
        port_m=min(s.port_m for s in swaths),
        starboard_m=min(s.starboard_m for s in swaths),
        astern_m=min(s.astern_m for s in swaths),
        ahead_m=min(s.ahead_m for s in swaths),
    )


def overlap(extent_m: float, step_m: float) -> float:
    """Share of an extent seen again after a step; 0 where nothing is."""
    return max(0.0, 1.0 - step_m / extent_m)


def step_for_overlap(extent_m: float, share: float) -> float:
    """The step after which the given share of an extent is seen again."""
    return extent_m * (1.0 - share)


def _min_reach(along_m: Array, reach_m: Array, step_m: float) -> float:
    """Least reach of a side of the border within half a step of its middle.

    Args:
        along_m: (N,) ascending places along the side.
        reach_m: (N,) how far out the side is there.
        step_m: from station to station.
    """
    ends = np.interp([-step_m / 2, step_m / 2], along_m, reach_m)
    within = reach_m[np.abs(along_m) <= step_m / 2]
    return float(min(*ends, *within))
