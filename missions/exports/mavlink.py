"""A dive as MAVLink mission items, for ArduSub: what WPL files and QGroundControl plans hold.

Commands, frames and parameters: MAVLink common message set (mavlink.io, MAV_CMD and MAV_FRAME).
ArduSub 4.5 and later take the frame above the terrain in AUTO; what is not a way to a place (DO_
and CONDITION_ commands) is done on leaving the way-point before it.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from missions.exports.waypoints import Waypoint
from missions.values.mission import Mission, MissionStep
from missions.values.plan_file import Plan

FRAME_GLOBAL, FRAME_MISSION, FRAME_ABOVE_HOME, FRAME_ABOVE_TERRAIN = 0, 2, 3, 10
NAV_WAYPOINT, CONDITION_YAW, DO_CHANGE_SPEED, DO_SET_CAM_TRIGG_DIST = 16, 115, 178, 206

_DESCENT_ALTITUDES = 2.0
"""The way down is by depth, since from the surface an altimeter may see no floor: down to this many
times the altitude of the lines above the sea floor as charted, so that a chart in error by less
than the altitude does no harm. On from there by altitude."""

_PARAMS = 7

_FROM_REST = ("turn", "sway", "surface")
"""What begins where the vehicle has stopped."""


@dataclass(frozen=True, kw_only=True)
class Item:
    """One mission item."""

    command: int
    frame: int
    params: tuple[float, ...]
    """Parameters as the command defines them; the last three of a way-point are latitude and
    longitude, degrees, and altitude, metres."""


def trigger_m(plan: Plan, line: int) -> float:
    """Distance from picture to picture, at least 0.1 mm short so that a line's last is not lost."""
    requested = plan.lines[line]
    if requested.stations < 2:
        return plan.station_spacing_m
    return (math.ceil(requested.length_m / (requested.stations - 1) * 1e4 - 1e-6) - 1) / 1e4


def mission_items(
    plan: Plan, points: Sequence[Waypoint], tolerance_m: float, turn_rate_rad_s: float
) -> Iterator[Item]:
    """All items of a dive, without home.

    Args:
        plan: what the dive is of.
        points: the dive's way-points.
        tolerance_m: how near to pass; ArduSub takes its parameter WPNAV_RADIUS instead.
        turn_rate_rad_s: of turns on the spot.
    """
    rate_deg_s = math.degrees(turn_rate_rad_s)
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
    elif plan.is_flown_by_depth:
        frame, altitude_m = FRAME_ABOVE_HOME, -point.depth_m
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
    rounded = (round(float(value), 6) for value in params)
    return Item(
        command=command, frame=FRAME_MISSION, params=(*rounded, *[0.0] * (_PARAMS - len(params)))
    )


def item_of(command: Any, frame: Any, params: Sequence[Any], where: str) -> Item:
    """An item from the cells of a file.

    Raises:
        ValueError: it is not one.
    """
    try:
        numbers = [float(value) for value in params]
        code, in_frame = int(command), int(frame)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{where} holds a value that is not a number") from None
    if len(numbers) != _PARAMS or not all(map(math.isfinite, numbers)):
        raise ValueError(f"{where} does not have {_PARAMS} finite parameters")
    return Item(command=code, frame=in_frame, params=tuple(numbers))


def mission_of(items: Sequence[Item]) -> Mission:
    """Items as ArduSub flies them.

    `CONDITION_YAW` counts only as the second command after a way-point (see `mission_items`).

    Raises:
        ValueError: a command or a frame is not one that ArduSub flies, or a way-point comes before
            any speed.
    """
    steps: list[MissionStep] = []
    speed_mps = heading_rad = math.nan
    since = 0
    for number, item in enumerate(items, start=1):
        first = item.params[0]
        if item.command == NAV_WAYPOINT:
            steps.append(_step_of(item, number, speed_mps, heading_rad))
            heading_rad, since = math.nan, 0
            continue
        since += 1
        if item.command == DO_CHANGE_SPEED:
            speed_mps = item.params[1]
        elif item.command == CONDITION_YAW:
            heading_rad = math.radians(first) if since > 1 else math.nan
        elif item.command == DO_SET_CAM_TRIGG_DIST and steps:
            camera: Any = "on" if first > 0.0 else "off"
            steps[-1] = replace(
                steps[-1], camera=camera, picture_step_m=first if first > 0.0 else math.nan
            )
        else:
            raise ValueError(
                f"item {number} is the command {item.command}, which is not flown here: "
                f"{NAV_WAYPOINT}, {CONDITION_YAW}, {DO_CHANGE_SPEED} and, after a way-point, "
                f"{DO_SET_CAM_TRIGG_DIST} are"
            )
    return Mission(autopilot="ardusub", steps=tuple(steps))


def _step_of(item: Item, number: int, speed_mps: float, heading_rad: float) -> MissionStep:
    by_altitude = item.frame == FRAME_ABOVE_TERRAIN
    if not by_altitude and item.frame != FRAME_ABOVE_HOME:
        raise ValueError(
            f"item {number} is in the frame {item.frame}; ArduSub flies {FRAME_ABOVE_HOME} (above "
            f"home) and {FRAME_ABOVE_TERRAIN} (above the terrain)"
        )
    if not math.isfinite(speed_mps):
        raise ValueError(f"item {number} is a way-point before any speed (DO_CHANGE_SPEED)")
    hold_s, radius_m, _, _, latitude_deg, longitude_deg, up_m = item.params
    return MissionStep(
        manoeuvre="goto",
        latitude_deg=latitude_deg,
        longitude_deg=longitude_deg,
        heave="altitude" if by_altitude else "depth",
        depth_m=math.nan if by_altitude else -up_m,
        altitude_m=up_m if by_altitude else math.nan,
        speed_mps=speed_mps,
        tolerance_m=radius_m,
        hold_s=hold_s,
        heading_rad=heading_rad,
    )
