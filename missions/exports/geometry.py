"""Places, areas, routes and footprints of a plan, in local metres and on the ellipsoid."""

import math
from collections.abc import Iterator

import numpy as np
import shapely
from shapely.geometry import MultiPolygon, Polygon

from alice_survey.core.frames import Array, Datum
from camera_calib.rig import Rig
from missions.values.footprint import footprint_ne, level_pose
from missions.values.legs import Leg, Route, places_on
from missions.values.line import Line
from missions.values.plan_file import Plan

CHORD_M = 0.02
"""How far the chords that stand for an arc may lie off it."""


def lat_lon(datum: Datum, points_ne: Array, depth_m: float) -> Array:
    """Latitudes and longitudes, (N, 2) degrees, of places (N, 2) north and east at one depth."""
    points_ned = np.column_stack([points_ne, np.full(len(points_ne), depth_m)])
    return datum.geodetic_from_ned(points_ned)[:, :2]


def rings_ne(polygon: Polygon) -> Iterator[Array]:
    """Outer ring and holes of a polygon, each (N, 2) without the closing corner."""
    for ring in (polygon.exterior, *polygon.interiors):
        corners: Array = np.asarray(ring.coords, dtype=np.float64)[:-1, :2]
        yield corners


def dive_of_line(plan: Plan) -> dict[int, int]:
    """Number of the dive, from 1 on, that flies each line."""
    return {
        line: number
        for number, dive in enumerate(plan.dives, start=1)
        for line in range(dive.first_line, dive.last_line + 1)
    }


def line_depths_m(plan: Plan, index: int) -> tuple[float, ...]:
    """Depth of the glass at each station of a line."""
    if plan.line_depths_m:
        return plan.line_depths_m[index]
    return (plan.seafloor_depth_m - plan.altitude_m,) * plan.lines[index].stations


def grown(geometry: MultiPolygon, by_m: float) -> list[Polygon]:
    """The parts of a geometry grown by a distance, sharp corners kept; shrunk where negative."""
    parts: list[Polygon] = [
        part
        for part in shapely.get_parts(geometry.buffer(by_m, join_style="mitre")).tolist()
        if part.geom_type == "Polygon" and part.area > 0
    ]
    return parts


def route_ne(route: Route, chord_m: float = CHORD_M) -> Array:
    """Corners of a route, (N, 2); arcs as chords that lie within a distance of them."""
    legs = [leg for leg in route.legs if leg.length_m > 0]
    counts = np.array([chords(leg, chord_m) for leg in legs], dtype=np.intp)
    lengths_m = np.array([leg.length_m for leg in legs])
    of = np.repeat(np.arange(len(legs)), counts)
    number = np.arange(len(of)) - np.repeat(np.cumsum(counts) - counts, counts) + 1
    along_m = np.where(number == counts[of], lengths_m[of], number * (lengths_m / counts)[of])
    places = places_on(legs, of, along_m)
    return np.vstack([np.array([route.legs[0].start_ne_m]), places])


def chords(leg: Leg, chord_m: float = CHORD_M) -> int:
    """How many chords stand for a leg: one for a straight."""
    if not leg.curvature_per_m:
        return 1
    # The sagitta of a chord over an angle a is r (1 - cos(a / 2)).
    widest_rad = 2 * math.acos(max(0.0, 1.0 - chord_m * abs(leg.curvature_per_m)))
    return max(1, math.ceil(leg.length_m * abs(leg.curvature_per_m) / widest_rad - 1e-9))


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
