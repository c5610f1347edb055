"""A dive as way-points: what every format of a mission is written from."""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
import shapely
from shapely.geometry import LineString, Point

from alice_survey.core.errors import PlanError
from alice_survey.core.frames import Array
from missions.areas.bathymetry import Bathymetry
from missions.exports.geometry import CameraMount, chords, line_depths
from missions.route.terrain import Reach, highest_floor, with_depths_between
from missions.values.costs import SETTLE_S
from missions.values.legs import Leg
from missions.values.plan_file import Dive, Plan

Kind = Literal["descend", "way", "run-in", "turn", "sway", "line", "surface"]
"""How a way-point is reached. way: freely. run-in: straight, on the course of the line that
begins there. turn: by a turn on the spot. sway: sideways. line: along a line. descend, surface:
straight down and up."""

DEPTH_STEP_M = 0.05
"""A line's depth is given wherever straight lines between way-points would miss it by more."""
MAX_STEP_M = 0.25
"""From way-point to way-point of a line that is flown by depth: followers go to the next depth at
once, not along the straight to it."""
_SAMPLE_M, _SAMPLE_RAD = 0.25, math.radians(10.0)
_STRAIGHT_RAD = 1e-6
_TINY_M = 1e-6
_TOUCH_M = 1e-6


@dataclass(frozen=True, kw_only=True)
class Waypoint:
    """A place to go to, and what to do there."""

    kind: Kind
    line: int
    """Index of the plan's line that ends, goes on or begins here, else -1."""
    camera: Literal["on", "off"] | None
    """What to switch pictures to on arrival."""
    vehicle_ne_m: tuple[float, float]
    """North and east of the vehicle's reference point."""
    latitude_deg: float
    """Latitude of the reference point, as `longitude_deg`."""
    longitude_deg: float
    glass_latitude_deg: float
    glass_longitude_deg: float
    heading_rad: float
    """Heading of the vehicle on arrival, in [0, 2 pi)."""
    depth_m: float
    """Depth of the reference point below the surface."""
    altitude_m: float
    """Height of the altimeter above the sea floor; NaN where a plan over a bathymetry does not know
    it."""
    glass_depth_m: float
    speed_mps: float
    hold_s: float
    """How long to stay: to turn and to settle; 0 where it flies on."""


class _Point(NamedTuple):
    kind: Kind
    place_ne_m: tuple[float, float]
    heading_rad: float
    line: int = -1
    glass_depth_m: float | None = None
    altitude_m: float = math.nan
    leg: int = 0
    """Of the dive, that leads there."""
    hold_s: float = 0.0
    camera: Literal["on", "off"] | None = None


def waypoints(
    plan: Plan, dive: Dive, mount: CameraMount, turn_rate_rad_s: float, *, by_depth: bool = False
) -> tuple[Waypoint, ...]:
    """The way-points of a dive, from the surface to the surface.

    Arcs become chords that lie within 2 cm of them. Between lines the depth is the lesser of those
    of the lines' ends.

    Args:
        plan: whose dive it is.
        dive: one of the plan's.
        mount: of the camera on the vehicle.
        turn_rate_rad_s: of turns on the spot.
        by_depth: with way-points on lines wherever their depth changes by `MAX_STEP_M`.

    Raises:
        PlanError: depths do not fit the lines.
    """
    depths = line_depths(plan)
    if not dive.route.legs:
        raise PlanError("a dive has no legs: plan again")
    points = _switch_camera(list(_points(plan, dive, turn_rate_rad_s, depths, by_depth)))
    points = _with_depths(points, plan, depths)
    if plan.way_depths_m:
        points = _over_terrain(points, plan.way_depths_m[plan.dives.index(dive)])
    if by_depth:
        points = list(_with_rises(points))
    glass_ne = np.array([point.place_ne_m for point in points])
    headings = np.array([point.heading_rad for point in points])
    vehicle_ne = mount.vehicle_ne(glass_ne, headings)
    glass_depths = np.array([point.glass_depth_m for point in points], dtype=np.float64)
    geodetic = plan.datum.geodetic_from_ned(np.column_stack([vehicle_ne, glass_depths]))
    glass_geodetic = plan.datum.geodetic_from_ned(np.column_stack([glass_ne, glass_depths]))
    result = []
    for i, point in enumerate(points):
        at_surface = point.kind == "surface"
        result.append(
            Waypoint(
                kind=point.kind,
                line=point.line,
                camera=point.camera,
                vehicle_ne_m=(float(vehicle_ne[i, 0]), float(vehicle_ne[i, 1])),
                latitude_deg=float(geodetic[i, 0]),
                longitude_deg=float(geodetic[i, 1]),
                glass_latitude_deg=float(glass_geodetic[i, 0]),
                glass_longitude_deg=float(glass_geodetic[i, 1]),
                heading_rad=point.heading_rad % (2 * math.pi),
                depth_m=0.0 if at_surface else mount.vehicle_depth_m(float(glass_depths[i])),
                altitude_m=mount.altimeter_altitude_m(
                    point.altitude_m if by_depth else plan.altitude_m
                ),
                glass_depth_m=0.0 if at_surface else float(glass_depths[i]),
                speed_mps=plan.speed_mps,
                hold_s=point.hold_s,
            )
        )
    return tuple(result)


def _points(
    plan: Plan, dive: Dive, turn_rate_rad_s: float, depths: Sequence[Array], by_depth: bool
) -> Iterator[_Point]:
    """Where each leg leads, in order."""
    legs = dive.route.legs
    first, last = legs[0], legs[-1]
    yield _Point("descend", first.start_ne_m, first.heading_rad + first.side_rad)
    for index, leg in enumerate(legs):
        following = legs[index + 1] if index + 1 < len(legs) else None
        heading = leg.end_heading_rad + leg.side_rad
        if leg.length_m <= _TINY_M:
            if leg.turn_rad:
                hold_s = abs(leg.turn_rad) / turn_rate_rad_s + SETTLE_S
                yield _Point("turn", leg.start_ne_m, heading, hold_s=hold_s, leg=index)
        elif leg.line >= 0:
            for point in _line_points(plan, leg, depths[leg.line], by_depth):
                yield point._replace(leg=index)
        elif leg.side_rad:
            yield _Point("sway", leg.end_ne_m, heading, hold_s=SETTLE_S, leg=index)
        elif leg.curvature_per_m:
            for point in _arc_points(leg):
                yield point._replace(leg=index)
        else:
            kind: Kind = "run-in" if _leads_to_line(leg, following) else "way"
            yield _Point(kind, leg.end_ne_m, heading, leg=index)
    end_rad = last.end_heading_rad + last.side_rad
    yield _Point("surface", last.end_ne_m, end_rad, leg=len(legs) - 1)


def _line_points(plan: Plan, leg: Leg, depths: Array, by_depth: bool) -> Iterator[_Point]:
    """The end of a line, and places before it where its depth bends, or changes by a step."""
    line = plan.lines[leg.line]
    along_m = np.linspace(0.0, line.length_m, line.stations)
    kept = bends(along_m, depths, DEPTH_STEP_M)
    if by_depth:
        kept = _with_steps(kept, depths)
    for i in kept[1:] or [0]:
        north, east = line.stations_ne[i].tolist()
        floor_m = plan.line_floors_m[leg.line][i] if plan.line_floors_m else math.nan
        depth_m = float(depths[i])
        yield _Point(
            "line", (north, east), leg.heading_rad, leg.line, depth_m,
            altitude_m=floor_m - depth_m,
        )  # fmt: skip


def _with_steps(kept: list[int], depths: Array) -> list[int]:
    """Indices with more between them, so that no depth is farther than a step from the next."""
    rows = kept[:1]
    for end in kept[1:]:
        for i in range(rows[-1] + 1, end):
            if abs(depths[i + 1] - depths[rows[-1]]) > MAX_STEP_M:
                rows.append(i)
        rows.append(end)
    return rows


def bends(along_m: Array, depths_m: Array, tolerance_m: float) -> list[int]:
    """Few places, so that straights between them miss no depth by more.

    The method is D. H. Douglas and T. K. Peucker's (1973), with the vertical distance.

    Args:
        along_m: (N,) ascending.
        depths_m: (N,) there.
        tolerance_m: how far a straight between kept places may miss.

    Returns:
        Indices that are kept, ascending; the first and the last always.
    """
    # So far apart along it, the distance from a straight is the vertical one.
    scale = 1e6 * (1.0 + float(np.ptp(depths_m)))
    corners = np.column_stack([scale * along_m, depths_m])
    kept = shapely.get_coordinates(
        LineString(corners).simplify(tolerance_m, preserve_topology=False)
    )
    rows: list[int] = np.flatnonzero(np.isin(corners[:, 0], kept[:, 0])).tolist()
    return rows


def _arc_points(leg: Leg) -> Iterator[_Point]:
    """Ends of chords that stand for an arc."""
    along_m = np.linspace(0.0, leg.length_m, chords(leg) + 1)[1:]
    for distance_m, place in zip(along_m, leg.places(along_m), strict=True):
        heading = leg.heading_rad + leg.curvature_per_m * float(distance_m) + leg.side_rad
        yield _Point("way", (float(place[0]), float(place[1])), heading)


def _leads_to_line(leg: Leg, following: Leg | None) -> bool:
    if following is None or following.line < 0:
        return False
    return abs(math.remainder(leg.heading_rad - following.heading_rad, 2 * math.pi)) < _STRAIGHT_RAD


def _switch_camera(points: list[_Point]) -> list[_Point]:
    """Way-points with the camera on where a line begins and off where it ends."""
    result = list(points)
    for i, point in enumerate(points):
        if point.kind != "line":
            continue
        if points[i - 1].kind != "line" or points[i - 1].line != point.line:
            if points[i - 1].kind == "line":  # lines that touch: pictures go on
                result[i - 1] = result[i - 1]._replace(camera=None)
            else:
                result[i - 1] = result[i - 1]._replace(camera="on", line=point.line)
        after = points[i + 1] if i + 1 < len(points) else None
        if after is None or after.line != point.line:
            result[i] = result[i]._replace(camera="off")
    return result


def _with_depths(points: list[_Point], plan: Plan, line_depths: Sequence[Array]) -> list[_Point]:
    """Way-points with a depth each: between lines the shallower of the lines next to it."""
    depths = np.array(
        [
            float(line_depths[point.line][0])
            if point.camera == "on"
            else (math.nan if point.glass_depth_m is None else point.glass_depth_m)
            for point in points
        ]
    )
    if not np.isfinite(depths).any():
        level_m = plan.seafloor_depth_m - plan.altitude_m
        return [point._replace(glass_depth_m=level_m) for point in points]
    levels = with_depths_between(depths)
    return [p._replace(glass_depth_m=float(d)) for p, d in zip(points, levels, strict=True)]


def _over_terrain(points: Sequence[_Point], way_depths_m: Sequence[float]) -> list[_Point]:
    """Way-points off lines, no deeper than the legs to and from them allow."""
    raised = []
    for point, following in itertools.pairwise([*points, points[-1]]):
        if point.line < 0:
            legs = {point.leg, following.leg}
            allowed_m = min(way_depths_m[leg] for leg in legs)
            point = point._replace(glass_depth_m=min(float(point.glass_depth_m or 0.0), allowed_m))
        raised.append(point)
    return raised


def _with_rises(points: Sequence[_Point]) -> Iterator[_Point]:
    """Way-points with one more wherever the next is higher and away from a line: straight up."""
    for before, point in itertools.pairwise([points[0], *points]):
        up_m = float(before.glass_depth_m or 0.0) - float(point.glass_depth_m or 0.0)
        if up_m > MAX_STEP_M and point.kind not in ("line", "surface"):
            yield before._replace(
                kind="way", camera=None, line=-1, glass_depth_m=point.glass_depth_m
            )
        yield point


def min_clearance_by_depth(
    plan: Plan,
    dives: Sequence[Sequence[Waypoint]],
    bathymetry: Bathymetry,
    reach: Reach,
    steepest_rad: float,
) -> float:
    """How near the sea floor the glass comes where way-points are flown by depth, m.

    A follower goes down to the next depth at once, and up no steeper than the vehicle climbs, or
    straight up. The highest floor within reach counts, as the vehicle turns from way-point to
    way-point.

    Args:
        plan: of the dives.
        dives: way-points of each, by depth.
        bathymetry: of the sea floor.
        reach: how far from the glass the floor counts.
        steepest_rad: slope that the vehicle climbs.

    Returns:
        NaN where the floor is not known somewhere.
    """
    min_m = np.inf
    for points in dives:
        ne = plan.datum.ned_from_geodetic(
            np.array([(p.glass_latitude_deg, p.glass_longitude_deg, 0.0) for p in points])
        )[:, :2]
        for i in range(1, len(points) - 1):
            before, after = points[i - 1], points[i]
            length_m = math.dist(ne[i - 1], ne[i])
            turned_rad = math.remainder(after.heading_rad - before.heading_rad, 2 * math.pi)
            count = max(math.ceil(length_m / _SAMPLE_M), math.ceil(abs(turned_rad) / _SAMPLE_RAD))
            share = np.linspace(0.0, 1.0, count + 1)
            climbed_m = before.glass_depth_m - math.tan(steepest_rad) * length_m * share
            places = ne[i - 1] + share[:, None] * (ne[i] - ne[i - 1])
            headings = before.heading_rad + share * turned_rad
            floor_m = highest_floor(bathymetry, places, headings, reach)
            clearance_m = floor_m - np.maximum(after.glass_depth_m, climbed_m)
            min_m = np.minimum(min_m, clearance_m.min())
    return float(min_m)


def gone_on(plan: Plan, point: Waypoint, tolerance_m: float) -> Waypoint:
    """The end of a line, moved on along its course so that the last picture is surely taken.

    A vehicle may be done with it as much early as its tolerance, and up to a step after a picture.

    Args:
        plan: whose line it is; the glass stays in its allowed area.
        point: the end.
        tolerance_m: how near it is done.
    """
    line = plan.lines[point.line]
    ahead = np.array([math.cos(line.heading_rad), math.sin(line.heading_rad)])
    by_m = tolerance_m + plan.station_spacing_m
    return move(plan, point, room_m(plan, np.array(line.end_ne_m), by_m * ahead) * ahead)


def room_m(plan: Plan, place_ne: Array, way_ne: Array) -> float:
    """How far of a way from a place the glass may go."""
    way = LineString([place_ne, place_ne + way_ne])
    inside = shapely.get_parts(way.intersection(plan.area.touched))
    parts = [part for part in inside if part.distance(Point(place_ne)) <= _TOUCH_M]
    return min(way.length, max((float(part.length) for part in parts), default=0.0))


def move(plan: Plan, point: Waypoint, by_ne: Array) -> Waypoint:
    """A way-point of the reference point at another place."""
    vehicle_ne = np.array(point.vehicle_ne_m) + by_ne
    place = np.array([[*vehicle_ne, point.depth_m]])
    ((latitude, longitude, _),) = plan.datum.geodetic_from_ned(place)
    return replace(
        point,
        vehicle_ne_m=(float(vehicle_ne[0]), float(vehicle_ne[1])),
        latitude_deg=float(latitude),
        longitude_deg=float(longitude),
    )
