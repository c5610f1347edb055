"""The way-points of a dive as COLA2 can follow them.

COLA2 ends a step only near its end and turns on the spot by itself: a heading far off the wanted
one stops its surge. So

- a line goes on past its end by the tolerance and a picture's step, as far as the allowed area lets
  it: the step may end early and still take the line's last picture;
- turns on the spot are left to the step that follows; they need no thrusters sideways;
- the step that leads to a line ends beyond it by the tolerance, less the way that the vehicle goes
  on while it turns, so that it is done where there is just that way left to the line;
- a run-in begins as far before its line as the vehicle needs to come onto it, where there is room;
- of the chords that stand for an arc those are left out that lie nearer to the one before than
  twice their tolerance, except the last before a line.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from missions.exports.format import Export
from missions.exports.options import MIN_TOLERANCE_M
from missions.exports.waypoints import Waypoint, gone_on, moved, room_m

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
    exact_m, ways_m = export.cola2_tolerance_m, way_tolerance_m(export)
    before = start = points[0]
    for i, planned in enumerate(points):
        point, following = planned, points[i + 1] if i + 1 < len(points) else None
        leads_in = following is not None and following.kind in ("line", "run-in", "turn")
        near = math.dist(point.vehicle_ne_m, before.vehicle_ne_m) < 2.0 * ways_m
        idle = point.camera is None
        if idle and (point.kind == "turn" or (near and point.kind == "way" and not leads_in)):
            if following is not None and following.kind == "run-in":
                point = _set_back(export, point, following)
            start = point
            continue
        tolerance_m = exact_m if leads_in or point.kind in ("line", "run-in", "turn") else ways_m
        end = point
        if point.kind == "line" and point.camera == "off":
            end = gone_on(export.plan, point, tolerance_m)
        elif leads_in and idle and point.kind == "way":
            if following is not None and following.kind == "run-in":
                point = _set_back(export, point, following)
            end = _led_beyond(export, before, point, tolerance_m)
        yield Cola2Step(start=start, end=end, tolerance_m=tolerance_m)
        before = start = point


def way_tolerance_m(export: Export) -> float:
    """Tolerance between lines: as far as the run-in lets the vehicle settle again."""
    plan = export.plan
    return max(export.cola2_tolerance_m, min(plan.run_in_m, plan.line_spacing_m / 2))


def _set_back(export: Export, point: Waypoint, start: Waypoint) -> Waypoint:
    """The place where a run-in begins, moved back along it as far as the vehicle may turn there.

    Coming onto it as far off as its tolerance, COLA2 needs the way delta ln(tolerance / allowed)
    until it is no farther off than its pictures may be.

    Args:
        export: the plan.
        point: where the run-in is planned to begin.
        start: where the line begins.
    """
    follower, plan = export.options.follower, export.plan
    if follower is None or not math.isfinite(follower.delta_m):
        return point
    allowed_m = max(0.5 * (plan.footprint_m[0] - plan.line_spacing_m), MIN_TOLERANCE_M)
    wanted_m = follower.delta_m * math.log(max(export.cola2_tolerance_m / allowed_m, 1.0))
    line = plan.lines[start.line]
    back = -np.array([math.cos(line.heading_rad), math.sin(line.heading_rad)])
    reach_m = max(wanted_m, plan.run_in_m) + follower.circle_m
    free_m = room_m(plan, np.array(line.start_ne_m), reach_m * back) - follower.circle_m
    by_m = free_m - math.dist(point.vehicle_ne_m, start.vehicle_ne_m)
    return moved(plan, point, max(by_m, 0.0) * back)


def _led_beyond(
    export: Export, came_from: Waypoint, point: Waypoint, tolerance_m: float
) -> Waypoint:
    """A way-point before a line, moved on along the way to it."""
    follower = export.options.follower
    way = np.subtract(point.vehicle_ne_m, came_from.vehicle_ne_m)
    length_m = float(np.hypot(*way))
    if follower is None or length_m < _TOUCH_M:
        return point
    by_m = max(tolerance_m - follower.turn_in_m, -length_m)
    return moved(export.plan, point, by_m / length_m * way)
