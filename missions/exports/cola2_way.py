"""The way-points of a dive as COLA2 can follow them.

COLA2 ends a step only near its end and turns on the spot by itself: a heading far off the wanted
one stops its surge. So

- a line goes on past its end by the tolerance, as far as the allowed area lets it: the step may end
  early and still take the line's last picture, and the vehicle does not circle the end;
- turns on the spot are left to the step that follows; they need no thrusters sideways;
- the step that leads to a line ends beyond it by the tolerance, less the turning circle, so that it
  is done where the vehicle has just the room to turn onto the line;
- of the chords that stand for an arc those are left out that lie nearer to the one before than
  twice their tolerance, except the last before a line.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import shapely
from shapely.geometry import LineString, Point

from alice_survey.base.frames import Array
from missions.exports.follower import circle_m
from missions.exports.format import Export
from missions.exports.waypoints import Waypoint
from missions.values.plan_file import Plan

_TOUCH_M = 1e-6


@dataclass(frozen=True, kw_only=True)
class Cola2Step:
    """A step of a COLA2 mission."""

    start: Waypoint
    """Where its way begins; of a section, what the file states."""
    end: Waypoint
    tolerance_m: float

    @property
    def is_section(self) -> bool:
        """Whether it goes along a straight that is stated."""
        return self.end.kind in ("line", "run-in")


def cola2_steps(export: Export, dive: int) -> list[Cola2Step]:
    """The steps of a dive.

    Args:
        export: the plan.
        dive: counted from 0.
    """
    points = export.dives[dive]
    return list(_steps(export, points))


def _steps(export: Export, points: tuple[Waypoint, ...]) -> Iterator[Cola2Step]:
    sections_m, ways_m = export.cola2_tolerance_m, way_tolerance_m(export)
    before = points[0]
    for i, point in enumerate(points):
        following = points[i + 1] if i + 1 < len(points) else None
        start = points[max(i - 1, 0)]
        if point.kind == "turn" and point.camera is None:
            continue
        leads_in = following is not None and following.kind in ("line", "run-in", "turn")
        near = math.dist(point.vehicle_ne_m, before.vehicle_ne_m) < 2.0 * ways_m
        if near and point.kind == "way" and point.camera is None and not leads_in:
            continue
        came_from, before = before, point
        exact = leads_in or point.kind in ("line", "run-in", "turn")
        tolerance_m = sections_m if exact else ways_m
        if point.kind == "line" and point.camera == "off":
            point = _gone_on(export.plan, point, tolerance_m)
        elif leads_in and point.kind == "way":
            point = _led_beyond(export, came_from, point, tolerance_m)
        yield Cola2Step(start=start, end=point, tolerance_m=tolerance_m)


def way_tolerance_m(export: Export) -> float:
    """Tolerance between lines: as far as the run-in lets the vehicle settle again."""
    plan = export.plan
    return max(export.cola2_tolerance_m, min(plan.run_in_m, plan.line_spacing_m / 2))


def _gone_on(plan: Plan, point: Waypoint, by_m: float) -> Waypoint:
    """The end of a line, moved on along its course as far as the glass may go."""
    line = plan.lines[point.line]
    ahead = np.array([math.cos(line.heading_rad), math.sin(line.heading_rad)])
    end = np.array(line.end_ne_m)
    way = LineString([end, end + by_m * ahead]).intersection(plan.area.allowed.buffer(_TOUCH_M))
    parts = [part for part in shapely.get_parts(way) if part.distance(Point(end)) <= _TOUCH_M]
    room_m = min(by_m, max((float(part.length) for part in parts), default=0.0))
    return _moved(plan, point, room_m * ahead)


def _led_beyond(
    export: Export, came_from: Waypoint, point: Waypoint, tolerance_m: float
) -> Waypoint:
    """A way-point before a line, moved on along the way to it."""
    follower, plan = export.options.follower, export.plan
    way = np.subtract(point.vehicle_ne_m, came_from.vehicle_ne_m)
    length_m = float(np.hypot(*way))
    if follower is None or length_m < _TOUCH_M:
        return point
    by_m = max(0.0, tolerance_m - circle_m(follower, plan.speed_mps))
    return _moved(plan, point, by_m / length_m * way)


def _moved(plan: Plan, point: Waypoint, by_ne: Array) -> Waypoint:
    vehicle_ne = np.array(point.vehicle_ne_m) + by_ne
    place = np.array([[*vehicle_ne, point.depth_m]])
    ((latitude, longitude, _),) = plan.datum.geodetic_from_ned(place)
    return replace(
        point,
        vehicle_ne_m=(float(vehicle_ne[0]), float(vehicle_ne[1])),
        latitude_deg=float(latitude),
        longitude_deg=float(longitude),
    )
