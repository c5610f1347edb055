"""A dive as MAVLink mission items, for ArduSub: what WPL files and QGroundControl plans hold.

Commands, frames and parameters: MAVLink common message set (mavlink.io, MAV_CMD and MAV_FRAME).
ArduSub 4.5 and later take the frame above the terrain in AUTO; what is not a way to a place (DO_
and CONDITION_ commands) is done on leaving the way-point before it.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from missions.exports.waypoints import Waypoint
from missions.values.plan_file import Plan

FRAME_GLOBAL, FRAME_MISSION, FRAME_ABOVE_HOME, FRAME_ABOVE_TERRAIN = 0, 2, 3, 10
NAV_WAYPOINT, CONDITION_YAW, DO_CHANGE_SPEED, DO_SET_CAM_TRIGG_DIST = 16, 115, 178, 206

_DESCENT_ALTITUDES = 2.0
"""The way down is by depth, since from the surface an altimeter may see no floor: down to this many
times the altitude of the lines above the sea floor as charted, so that a chart in error by less
than the altitude does no harm. On from there by altitude."""

_FROM_REST = ("turn", "sway", "surface")
"""What begins where the vehicle has stopped."""


@dataclass(frozen=True, kw_only=True)
class Item:
    """One mission item."""

    command: int
    frame: int
    params: tuple[float, float, float, float, float, float, float]
    """Parameters as the command defines them; the last three of a way-point are latitude and
    longitude, degrees, and altitude, metres."""


def mission_items(
    plan: Plan, points: Sequence[Waypoint], tolerance_m: float, turn_rate_rad_s: float
) -> list[Item]:
    """All items of a dive, without home.

    Args:
        plan: what the dive is of.
        points: the dive's way-points.
        tolerance_m: how near to pass; ArduSub takes its parameter WPNAV_RADIUS instead.
        turn_rate_rad_s: of turns on the spot.
    """
    return list(_items(plan, points, tolerance_m, math.degrees(turn_rate_rad_s)))


def trigger_m(plan: Plan, line: int) -> float:
    """Distance from picture to picture, at least 0.1 mm short so that a line's last is not lost."""
    wanted = plan.lines[line]
    if wanted.stations < 2:
        return plan.station_spacing_m
    return (math.ceil(wanted.length_m / (wanted.stations - 1) * 1e4 - 1e-6) - 1) / 1e4


def _items(
    plan: Plan, points: Sequence[Waypoint], tolerance_m: float, rate_deg_s: float
) -> Iterator[Item]:
    speed = _command(DO_CHANGE_SPEED, 1, plan.speed_mps, -1)  # over ground; throttle as it is
    yield speed
    heading_deg = math.degrees(points[0].heading_rad)
    for index, point in enumerate(points):
        following = points[index + 1].kind if index + 1 < len(points) else "surface"
        to_deg = math.degrees(point.heading_rad)
        if point.kind in ("turn", "sway"):
            # The first command after a way-point is done before the next way begins, which turns
            # the vehicle along it; only the second can give it another heading (ArduPilot,
            # AP_Mission and ModeAuto::auto_wp_start). So the speed is said again before it.
            if points[index - 1].camera is None:
                yield speed
            turned = math.remainder(to_deg - heading_deg, 360.0)
            yield _command(CONDITION_YAW, to_deg % 360.0, rate_deg_s, 1 if turned >= 0 else -1)
        heading_deg = to_deg
        # A place without a stay is passed in a curve; the least stay that can be said is 1 s.
        stays_s = max(math.ceil(point.hold_s), 1 if following in _FROM_REST else 0)
        yield _waypoint(plan, point, stays_s, tolerance_m)
        if point.camera == "on":
            yield _command(DO_SET_CAM_TRIGG_DIST, trigger_m(plan, point.line), 0, 1)
        elif point.camera == "off":
            yield _command(DO_SET_CAM_TRIGG_DIST)


def _waypoint(plan: Plan, point: Waypoint, stays_s: int, tolerance_m: float) -> Item:
    if point.kind == "surface":
        frame, altitude_m = FRAME_ABOVE_HOME, 0.0
    elif point.kind == "descend":
        lift_m = (_DESCENT_ALTITUDES - 1.0) * plan.altitude_m
        frame, altitude_m = FRAME_ABOVE_HOME, -max(0.0, point.depth_m - lift_m)
    else:
        frame, altitude_m = FRAME_ABOVE_TERRAIN, point.altitude_m
    return Item(
        command=NAV_WAYPOINT,
        frame=frame,
        params=(
            float(stays_s),
            round(tolerance_m, 4),
            0.0,
            round(math.degrees(point.heading_rad), 6) % 360.0,
            round(point.latitude_deg, 10),
            round(point.longitude_deg, 10),
            round(altitude_m, 4) + 0.0,
        ),
    )


def _command(command: int, *params: float) -> Item:
    p = [round(float(value), 6) for value in params] + [0.0] * (7 - len(params))
    return Item(
        command=command, frame=FRAME_MISSION, params=(p[0], p[1], p[2], p[3], p[4], p[5], p[6])
    )
