"""Missions of COLA2, the control software of the SPARUS II: XML of version 2.0.

Structure as its loaders read it (cola2_lib, class Mission): actions
of a step are called when its manoeuvre is done, so the camera starts with the step that ends at a
line's start. `no_altitude_goes_up` makes the vehicle rise while its altimeter sees no floor.
"""

import math
from pathlib import Path
from xml.etree.ElementTree import Element

from missions.exports.format import Export, ExportFile, ExportFormat
from missions.exports.options import Options
from missions.exports.waypoints import Waypoint
from missions.exports.xml_text import child, degrees, metres, write_xml

_DEPTH, _ALTITUDE, _BOTH = 0, 1, 2
"""Version 2.0's heave modes. Both: altitude where the altimeter sees the floor, else depth."""


def write_cola2(path: Path, export: Export, dive: int) -> None:
    """Write a dive as a mission of version 2.0: sections along lines, gotos, parks for turns."""
    points, tolerance_m = export.dives[dive], export.tolerance_m
    root = Element("mission")
    child(root, "version", "2.0")
    for index, point in enumerate(points):
        step = child(root, "mission_step")
        if point.kind in ("turn", "sway"):
            _park(step, point)
        elif point.kind in ("line", "run-in"):
            _section(step, points[index - 1], point, tolerance_m)
        else:
            _goto(step, point, way_tolerance_m(export))
        add_actions(step, point, export.options)
    write_xml(path, root, comment(export))


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


def add_actions(step: Element, point: Waypoint, options: Options) -> None:
    """Call the service that starts or stops pictures, where a way-point does so."""
    if point.camera is None:
        return
    action = child(child(step, "actions_list"), "action")
    name = options.camera_on if point.camera == "on" else options.camera_off
    child(action, "action_id", name)


def way_tolerance_m(export: Export) -> float:
    """Tolerance between lines: as far as the run-in lets the vehicle settle again."""
    plan = export.plan
    return max(export.tolerance_m, min(plan.run_in_m, plan.line_spacing_m / 2))


def comment(export: Export) -> str:
    """What the places of a mission are of, for people who read the file."""
    plan, tolerance_m = export.plan, export.tolerance_m
    return (
        f"{plan.name}: {export.mount.about} Tolerance at the ends of lines {tolerance_m:.3f} m: "
        f"half of what lines {plan.line_spacing_m:.3f} m apart see twice, or half a step."
    )


def _bool(value: bool) -> str:
    return "true" if value else "false"


FORMAT = ExportFormat(
    read_by="COLA2, version 2.0: SPARUS II and its kin",
    files=(
        ExportFile(
            name="mission_dive{}.xml",
            about="COLA2 mission, version 2.0 (SPARUS II)",
            write=write_cola2,
        ),
    ),
)
