"""Places, areas, routes and footprints of a plan, and where the glass is on the vehicle.

A plan's places, depths and altitudes are of the left port's outer glass. A vehicle steers its own
reference point (COLA2: base_link; ArduSub: the origin of its EKF) and holds the altitude that its
altimeter (DVL, sounder) measures. The ways between are fixed lengths on the vehicle; here it is
level, as the plan assumes.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import shapely
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry
from shapely.geometry.polygon import orient

from alice_survey.core.errors import PlanError
from alice_survey.core.frames import Array, Datum
from camera_calib.rig import Rig
from missions.values.footprint import footprint_ne, level_pose
from missions.values.legs import Leg, Route, places_on
from missions.values.line import Line
from missions.values.plan_file import Plan


class MapFeature(NamedTuple):
    """A shape on a map."""

    role: str
    name: str
    about: dict[str, Any]
    shape: BaseGeometry
    """x = longitude, y = latitude, z = height, the negative depth; outer rings to the left."""


def map_features(plan: Plan) -> Iterator[MapFeature]:
    """Areas, home, lines and routes of a plan."""
    floor_m, glass_m = plan.seafloor_depth_m, plan.seafloor_depth_m - plan.altitude_m
    for role, name, area in (
        ("area", plan.name, plan.area.survey),
        ("allowed", "allowed area", plan.area.allowed),
        ("no_go", "no-go zone", plan.area.no_go),
    ):
        for part in area.geoms:
            edges = orient(shapely.transform(part, lambda ne: lon_lat(plan, ne, floor_m)))
            yield MapFeature(role, name, {}, shapely.force_3d(edges, -floor_m))
    home = lon_lat(plan, np.array([plan.home_ne_m]), 0.0)
    yield MapFeature("home", "home", {}, shapely.Point(np.append(home, 0.0)))
    dives = dive_of_line(plan)
    for index, (line, depths) in enumerate(zip(plan.lines, line_depths(plan), strict=True)):
        about = {
            "line": index, "kind": line.kind, "dive": dives.get(index), "stations": line.stations,
            "length_m": round(line.length_m, 4), "depth_m": glass_m,
            "heading_deg": round(float(np.degrees(line.heading_rad)), 4),
            "altitude_m": plan.altitude_m, "speed_mps": plan.speed_mps,
        }  # fmt: skip
        ends = lon_lat(plan, np.array([line.start_ne_m, line.end_ne_m]), depths[0])
        shape = shapely.LineString(np.column_stack([ends, -depths[[0, -1]]]))
        yield MapFeature("line", f"line {index}", about, shape)
    for number, dive in enumerate(plan.dives, start=1):
        about = {
            "dive": number, "length_m": round(dive.route.length_m, 4),
            "duration_s": round(dive.duration_s, 1), "energy_wh": round(dive.energy_wh, 2),
            "depth_m": glass_m,
        }  # fmt: skip
        shape = shapely.LineString(lon_lat(plan, route_ne(dive.route), glass_m))
        yield MapFeature("route", f"dive {number}", about, shapely.force_3d(shape, -glass_m))


def lon_lat(plan: Plan, points_ne: Array, depth_m: float) -> Array:
    """Longitudes and latitudes, (N, 2) degrees, to 1e-10 degrees, 0.01 mm."""
    return np.round(lat_lon(plan.datum, points_ne, depth_m)[:, ::-1], 10)


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


def line_ends_deg(plan: Plan) -> Array:
    """(lines, 4) latitude and longitude of the start, then of the end, at the lines' depth."""
    ends_ne = np.array([end for line in plan.lines for end in (line.start_ne_m, line.end_ne_m)])
    return lat_lon(plan.datum, ends_ne, plan.seafloor_depth_m - plan.altitude_m).reshape(-1, 4)


def dive_of_line(plan: Plan) -> dict[int, int]:
    """Number of the dive, from 1 on, that flies each line."""
    return {
        line: number
        for number, dive in enumerate(plan.dives, start=1)
        for line in range(dive.first_line, dive.last_line + 1)
    }


def line_depths(plan: Plan) -> list[Array]:
    """Depths of the glass at each line's stations.

    Raises:
        PlanError: they do not fit the lines.
    """
    if not plan.line_depths_m:
        level_m = plan.seafloor_depth_m - plan.altitude_m
        return [np.full(line.stations, level_m) for line in plan.lines]
    depths = [np.asarray(row, dtype=np.float64) for row in plan.line_depths_m]
    stations, requested = [len(row) for row in depths], [line.stations for line in plan.lines]
    if stations != requested:
        raise PlanError(
            f"depths of {len(stations)} lines with {sum(stations)} stations do not fit a plan of "
            f"{len(requested)} lines with {sum(requested)} stations: plan again"
        )
    return depths


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


@dataclass(frozen=True, kw_only=True)
class CameraMount:
    """Where glass and altimeter are on the vehicle; metres forward, right and down."""

    glass_body_m: tuple[float, float, float]
    """The left port's outer glass, from the vehicle's reference point."""
    altimeter_body_m: tuple[float, float, float]
    """The face of the sensor whose altitude the vehicle holds."""

    @property
    def reach_m(self) -> float:
        """Between glass and reference point, seen from above."""
        return float(np.hypot(*self.glass_body_m[:2]))

    def vehicle_ne(self, glass_ne: Array, heading_rad: Array) -> Array:
        """Places of the reference point, (N, 2), that bring the glass to its places.

        Args:
            glass_ne: (N, 2) north and east, metres.
            heading_rad: (N,) of the vehicle.
        """
        forward_m, right_m, _ = self.glass_body_m
        cos, sin = np.cos(heading_rad), np.sin(heading_rad)
        arm_ne = np.stack([forward_m * cos - right_m * sin, forward_m * sin + right_m * cos], 1)
        vehicle: Array = glass_ne - arm_ne
        return vehicle

    def vehicle_depth_m(self, glass_depth_m: float) -> float:
        """Depth of the reference point."""
        return glass_depth_m - self.glass_body_m[2]

    def altimeter_altitude_m(self, glass_altitude_m: float) -> float:
        """What the altimeter measures over a level sea floor."""
        return glass_altitude_m + self.glass_body_m[2] - self.altimeter_body_m[2]

    def glass_altitude_m(self, altimeter_altitude_m: float) -> float:
        """Height of the glass over a level sea floor."""
        return altimeter_altitude_m - self.altimeter_altitude_m(0.0)

    @property
    def about(self) -> str:
        """The convention, in words, for people who read a file."""
        forward_m, right_m, down_m = self.glass_body_m
        return (
            "Places are of the vehicle's reference point, altitudes of its altimeter, such that "
            f"the left port's glass ({forward_m:+.3f} m forward, {right_m:+.3f} m right, "
            f"{down_m:+.3f} m down of the reference point; altimeter "
            f"{self.altimeter_body_m[2]:+.3f} m down) flies the plan's lines."
        )


def mount_of(rig: Rig, altimeter_body_m: tuple[float, float, float]) -> CameraMount:
    """The mount of a rig.

    Args:
        rig: its reference camera's glass is what plans are of.
        altimeter_body_m: forward, right and down; the setting `camera.dvl_position_body_m`.
    """
    glass_cam = rig.cameras[rig.reference].front_cam
    glass_body = rig.body_from_cam(rig.reference).apply(glass_cam)
    forward_m, right_m, down_m = (float(value) for value in glass_body)
    return CameraMount(glass_body_m=(forward_m, right_m, down_m), altimeter_body_m=altimeter_body_m)
