"""Missions of COLA2, the control software of the SPARUS II: XML of versions 1 and 2.0.

Structure as its loaders read it (facts in the project's notes; cola2_lib, class Mission): actions
of a step are called when its manoeuvre is done, so the camera starts with the step that ends at a
line's start. `no_altitude_goes_up` makes the vehicle rise while its altimeter sees no floor.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from xml.etree.ElementTree import Element

from missions.exports.mount import Mount
from missions.exports.options import Options
from missions.exports.text import child, degrees, metres, write_xml
from missions.exports.waypoints import Waypoint
from missions.values.plan_file import Plan

_DEPTH, _ALTITUDE, _BOTH = 0, 1, 2
"""Version 2.0's heave modes. Both: altitude where the altimeter sees the floor, else depth."""


def write_cola2(
    path: Path,
    plan: Plan,
    points: Sequence[Waypoint],
    mount: Mount,
    options: Options,
    tolerance_m: float,
) -> None:
    """Write a dive as a mission of version 2.0: sections along lines, gotos, parks for turns.

    Args:
        path: where to.
        plan: what the dive is of.
        points: the dive's way-points.
        mount: stated in the file.
        options: names of actions.
        tolerance_m: at the ends of lines.
    """
    root = Element("mission")
    child(root, "version", "2.0")
    for index, point in enumerate(points):
        step = child(root, "mission_step")
        if point.kind in ("turn", "sway"):
            _park(step, point)
        elif point.kind in ("line", "run-in"):
            _section(step, points[index - 1], point, tolerance_m)
        else:
            _goto(step, point, _way_tolerance_m(plan, tolerance_m))
        _actions(step, point, options)
    write_xml(path, root, _comment(plan, mount, tolerance_m))


def write_cola2_v1(
    path: Path,
    plan: Plan,
    points: Sequence[Waypoint],
    mount: Mount,
    options: Options,
    tolerance_m: float,
) -> None:
    """Write a dive as a mission of version 1, which knows no yaw: parks only wait.

    Args: as of `write_cola2`.
    """
    root = Element("mission")
    for index, point in enumerate(points):
        step = child(root, "mission_step")
        if point.kind in ("turn", "sway"):
            manoeuvre = child(step, "maneuver", type="park")
            _position(manoeuvre, "position", point)
            child(manoeuvre, "speed", metres(point.speed_mps))
            child(manoeuvre, "time", f"{point.hold_s:.1f}")
            within_m = tolerance_m
        elif point.kind in ("line", "run-in"):
            manoeuvre = child(step, "maneuver", type="section")
            _position(manoeuvre, "initial_position", points[index - 1])
            _position(manoeuvre, "final_position", point)
            child(manoeuvre, "speed", metres(point.speed_mps))
            within_m = tolerance_m
        else:
            manoeuvre = child(step, "maneuver", type="waypoint")
            _position(manoeuvre, "position", point)
            child(manoeuvre, "speed", metres(point.speed_mps))
            within_m = _way_tolerance_m(plan, tolerance_m)
        box = child(manoeuvre, "tolerance")
        for axis in "xyz":
            child(box, axis, metres(within_m))
        _actions(step, point, options)
    write_xml(path, root, _comment(plan, mount, tolerance_m))


def _goto(step: Element, point: Waypoint, tolerance_m: float) -> None:
    mode = {"descend": _BOTH, "surface": _DEPTH}.get(point.kind, _ALTITUDE)
    manoeuvre = child(step, "maneuver", type="goto")
    _final(manoeuvre, point)
    child(manoeuvre, "heave_mode", mode)
    child(manoeuvre, "surge_velocity", metres(point.speed_mps))
    child(manoeuvre, "tolerance_xy", metres(tolerance_m))
    # On the way down no floor is seen at first; on the way up none need be.
    child(manoeuvre, "no_altitude_goes_up", _bool(mode == _ALTITUDE))


def _section(step: Element, start: Waypoint, end: Waypoint, tolerance_m: float) -> None:
    manoeuvre = child(step, "maneuver", type="section")
    child(manoeuvre, "initial_latitude", degrees(start.latitude_deg))
    child(manoeuvre, "initial_longitude", degrees(start.longitude_deg))
    child(manoeuvre, "initial_depth", metres(start.depth_m))
    _final(manoeuvre, end)
    child(manoeuvre, "heave_mode", _ALTITUDE)
    child(manoeuvre, "surge_velocity", metres(end.speed_mps))
    child(manoeuvre, "tolerance_xy", metres(tolerance_m))
    child(manoeuvre, "no_altitude_goes_up", _bool(True))


def _park(step: Element, point: Waypoint) -> None:
    """Hold place and heading; used to turn on the spot and to step sideways."""
    manoeuvre = child(step, "maneuver", type="park")
    _final(manoeuvre, point)
    child(manoeuvre, "final_yaw", f"{math.remainder(point.heading_rad, 2 * math.pi):.6f}")
    child(manoeuvre, "use_yaw", _bool(True))
    child(manoeuvre, "heave_mode", _ALTITUDE)
    child(manoeuvre, "surge_velocity", metres(point.speed_mps))
    child(manoeuvre, "time", f"{point.hold_s:.1f}")
    child(manoeuvre, "no_altitude_goes_up", _bool(True))


def _final(manoeuvre: Element, point: Waypoint) -> None:
    child(manoeuvre, "final_latitude", degrees(point.latitude_deg))
    child(manoeuvre, "final_longitude", degrees(point.longitude_deg))
    child(manoeuvre, "final_depth", metres(point.depth_m))
    child(manoeuvre, "final_altitude", metres(point.altitude_m))


def _position(manoeuvre: Element, tag: str, point: Waypoint) -> None:
    """Of version 1: z is an altitude or a depth."""
    by_depth = point.kind in ("descend", "surface")
    position = child(manoeuvre, tag)
    child(position, "latitude", degrees(point.latitude_deg))
    child(position, "longitude", degrees(point.longitude_deg))
    child(position, "z", metres(point.depth_m if by_depth else point.altitude_m))
    child(position, "altitude_mode", "False" if by_depth else "True")


def _actions(step: Element, point: Waypoint, options: Options) -> None:
    if point.camera is None:
        return
    action = child(child(step, "actions_list"), "action")
    name = options.camera_on if point.camera == "on" else options.camera_off
    child(action, "action_id", name)


def _way_tolerance_m(plan: Plan, tolerance_m: float) -> float:
    """Between lines: as far as the run-in lets the vehicle settle again."""
    return max(tolerance_m, min(plan.run_in_m, plan.line_spacing_m / 2))


def _comment(plan: Plan, mount: Mount, tolerance_m: float) -> str:
    return (
        f"{plan.name}: {mount.about} Tolerance at the ends of lines {tolerance_m:.3f} m: half of "
        f"what lines {plan.line_spacing_m:.3f} m apart see twice, or half a step."
    )


def _bool(value: bool) -> str:
    return "true" if value else "false"
