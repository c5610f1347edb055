"""What a plan sees: footprints at its stations, and the share of the area that is covered."""

import math
from collections.abc import Sequence

import numpy as np
import shapely
from shapely.geometry import Polygon

from alice_survey.frames import Array
from camera_calib.rig import Rig
from missions.footprint import Swath, footprint_ne, level_pose
from missions.lines.line import Line
from missions.plan_file import Plan


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


def covered_share(area: Polygon, lines: Sequence[Line], swath: Swath, step_m: float) -> float:
    """Least share of an area that is seen from lines flown exactly.

    Args:
        area: what should be seen.
        lines: with pictures every `step_m`.
        swath: what is surely seen on a line with that step.
        step_m: from station to station.
    """
    pieces = []
    gapless = step_m <= swath.along_m
    for line in lines:
        stations = line.stations_ne
        spans = [(stations[0], stations[-1])] if gapless else [(s, s) for s in stations]
        pieces += [_seen(np.array(span), line.heading_rad, swath) for span in spans]
    return float(area.intersection(shapely.union_all(pieces)).area / area.area)


def _seen(ends_ne: Array, heading_rad: float, swath: Swath) -> Polygon:
    ahead = np.array([math.cos(heading_rad), math.sin(heading_rad)])
    right = np.array([-math.sin(heading_rad), math.cos(heading_rad)])
    back, front = ends_ne[0] - swath.astern_m * ahead, ends_ne[1] + swath.ahead_m * ahead
    port, starboard = -swath.port_m * right, swath.starboard_m * right
    return Polygon([back + port, front + port, front + starboard, back + starboard])
