"""Footprints at the stations of a plan, for maps and exports."""

import math

import numpy as np

from alice_survey.base.frames import Array
from camera_calib.rig import Rig
from missions.values.footprint import footprint_ne, level_pose
from missions.values.line import Line
from missions.values.plan_file import Plan


def footprint_outline(plan: Plan, rig: Rig) -> Array:
    """Outline of the first camera's footprint, (8, 2): ahead and to starboard of the glass, m."""
    camera = rig.cameras[rig.reference]
    pose = level_pose(camera, np.zeros(2), plan.altitude_m, plan.seafloor_depth_m, 0.0)
    return footprint_ne(camera, pose, plan.seafloor_depth_m, points_per_side=2)


def footprints_ne(line: Line, outline: Array) -> Array:
    """Outlines, (stations, N, 2) north and east, at all stations of a line."""
    c, s = math.cos(line.heading_rad), math.sin(line.heading_rad)
    turned = outline @ np.array([[c, s], [-s, c]])
    outlines: Array = line.stations_ne[:, None] + turned
    return outlines
