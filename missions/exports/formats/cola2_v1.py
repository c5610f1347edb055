"""Missions of COLA2 before versions were written into them: XML of version 1."""

import math
from pathlib import Path
from xml.etree.ElementTree import Element

from missions.exports.cola2_way import cola2_steps
from missions.exports.format import Export, ExportFile, ExportFormat
from missions.exports.formats.cola2 import (
    add_actions,
    camera_switches,
    comment,
    manoeuvre_of,
)
from missions.exports.waypoints import Waypoint
from missions.exports.xml_text import (
    child,
    degrees,
    metres,
    number_of,
    root_of,
    value_of,
    write_xml,
)
from missions.values.mission import Mission, MissionStep


def write_cola2_v1(path: Path, export: Export, dive: int) -> None:
    """Write a dive as a mission of version 1, which knows no yaw: parks only wait."""
    root = Element("mission")
    for planned in cola2_steps(export, dive):
        step, point = child(root, "mission_step"), planned.end
        if point.kind == "sway":
            manoeuvre = child(step, "maneuver", type="park")
            _position(manoeuvre, "position", point)
            child(manoeuvre, "speed", metres(point.speed_mps))
            child(manoeuvre, "time", f"{point.hold_s:.1f}")
        elif planned.is_section:
            manoeuvre = child(step, "maneuver", type="section")
            _position(manoeuvre, "initial_position", planned.start)
            _position(manoeuvre, "final_position", point)
            child(manoeuvre, "speed", metres(point.speed_mps))
        else:
            manoeuvre = child(step, "maneuver", type="waypoint")
            _position(manoeuvre, "position", point)
            child(manoeuvre, "speed", metres(point.speed_mps))
        box = child(manoeuvre, "tolerance")
        for axis in "xyz":
            child(box, axis, metres(planned.tolerance_m))
        add_actions(step, point, export.options)
    write_xml(path, root, comment(export))


def _position(manoeuvre: Element, tag: str, point: Waypoint) -> None:
    """A place, of which z is an altitude or a depth."""
    by_depth = point.kind in ("descend", "surface")
    position = child(manoeuvre, tag)
    child(position, "latitude", degrees(point.latitude_deg))
    child(position, "longitude", degrees(point.longitude_deg))
    child(position, "z", metres(point.depth_m if by_depth else point.altitude_m))
    child(position, "altitude_mode", "False" if by_depth else "True")


def read_cola2_v1(text: str) -> Mission | None:
    """Read a mission of version 1: one without a version."""
    root = root_of(text)
    if root is None or root.tag != "mission" or root.find("version") is not None:
        return None
    elements = root.findall("mission_step")
    steps = []
    for element, camera in zip(elements, camera_switches(elements), strict=True):
        manoeuvre = manoeuvre_of(element)
        kind = manoeuvre.get("type", "")
        if kind not in ("waypoint", "section", "park"):
            raise ValueError(f"the maneuver {kind[:40]!r} is not known")
        start_deg = None
        if kind == "section":
            start = _child_of(manoeuvre, "initial_position")
            start_deg = number_of(start, "latitude"), number_of(start, "longitude")
        end = _child_of(manoeuvre, "final_position" if start_deg else "position")
        by_altitude = value_of(end, "altitude_mode").lower() == "true"
        z_m = number_of(end, "z")
        steps.append(
            MissionStep(
                manoeuvre="section" if start_deg else ("anchor" if kind == "park" else "goto"),
                latitude_deg=number_of(end, "latitude"),
                longitude_deg=number_of(end, "longitude"),
                start_deg=start_deg,
                heave="altitude" if by_altitude else "depth",
                depth_m=math.nan if by_altitude else z_m,
                altitude_m=z_m if by_altitude else math.nan,
                speed_mps=number_of(manoeuvre, "speed"),
                tolerance_m=number_of(_child_of(manoeuvre, "tolerance"), "x"),
                hold_s=number_of(manoeuvre, "time") if kind == "park" else 0.0,
                camera=camera,
            )
        )
    return Mission(autopilot="cola2", steps=tuple(steps))


def _child_of(parent: Element, tag: str) -> Element:
    found = parent.find(tag)
    if found is None:
        raise ValueError(f"<{parent.tag}> lacks <{tag}>")
    return found


FORMAT = ExportFormat(
    read_by="COLA2 before versions were written into missions",
    files=(
        ExportFile(
            name="mission_v1_dive{}.xml", about="COLA2 mission, version 1", write=write_cola2_v1
        ),
    ),
    read=read_cola2_v1,
    keeps_altitude=True,
)
