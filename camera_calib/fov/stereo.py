"""What the two cameras of a rig see together, and how well they tell depth, through their ports."""

import math

import numpy as np
from scipy.spatial.transform import RigidTransform
from shapely import Polygon

from camera_calib.flat_port import FlatPortCamera
from camera_calib.fov.focus import glass_z_m
from camera_calib.rig import Rig


def _pair(rig: Rig) -> tuple[FlatPortCamera, FlatPortCamera, RigidTransform] | None:
    """Left, right and `right_from_left`; None for a single camera."""
    if len(rig.cameras) < 2:
        return None
    left, right = list(rig.cameras)[:2]
    right_from_left = rig.cam_from_rig[right] * rig.cam_from_rig[left].inv()
    return rig.cameras[left], rig.cameras[right], right_from_left


def stereo_overlap(rig: Rig, floor_z_m: float) -> float:
    """Share of the area of the left footprint that the right camera sees too.

    Args:
        rig: its first two cameras are the pair.
        floor_z_m: where a sea floor square to the left axis is, in the left camera's frame.

    Returns:
        NaN for a single camera, or where rays of a border never reach the sea floor.
    """
    pair = _pair(rig)
    if pair is None:
        return math.nan
    left, right, right_from_left = pair
    footprint = left.at_depth(left.border(64), floor_z_m)
    # The sea floor in the right camera's frame: its ray's fall along the left camera's axis.
    outer, directions = right.unproject(right.border(64))
    left_from_right = right_from_left.inv()
    starts = left_from_right.apply(outer)
    falls = left_from_right.rotation.apply(directions)
    partner = starts + ((floor_z_m - starts[:, 2]) / falls[:, 2])[:, None] * falls
    if not (np.all(np.isfinite(partner)) and np.all(falls[:, 2] > 0)):
        return math.nan
    ours = Polygon(footprint[:, :2])
    return float(ours.intersection(Polygon(partner[:, :2])).area / ours.area)


def disparity_per_m(rig: Rig, floor_z_m: float) -> float:
    """How fast a point that slides along its left ray moves in the right picture, px/m.

    The point lies on the sea floor below the middle of the pair; NaN where one camera misses it,
    and for a single camera. The noise of a disparity over this is the depth precision.
    """
    pair = _pair(rig)
    if pair is None:
        return math.nan
    left, right, right_from_left = pair
    middle = right_from_left.inv().translation / 2
    pixel = left.project(np.array([middle[0], middle[1], floor_z_m]))
    step = 1e-4 * (floor_z_m - glass_z_m(left))
    along_ray = left.at_depth(
        np.stack([pixel, pixel]), np.array([floor_z_m - step, floor_z_m + step])
    )
    pixels = right.project(right_from_left.apply(along_ray))
    for camera, pixel_xy in ((left, pixel), (right, pixels[0])):
        if not np.all((pixel_xy >= 0) & (pixel_xy <= [camera.width_px, camera.height_px])):
            return math.nan
    return float(np.linalg.norm(pixels[1] - pixels[0]) / (2 * step))
