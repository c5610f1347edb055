"""Missions of COLA2 before versions were written into them: XML of version 1."""

from pathlib import Path
from xml.etree.ElementTree import Element

from missions.exports.format import Export, ExportFile, ExportFormat
from missions.exports.formats.cola2 import add_actions, comment, way_tolerance_m
from missions.exports.waypoints import Waypoint
from missions.exports.xml_text import child, degrees, metres, write_xml


def write_cola2_v1(path: Path, export: Export, dive: int) -> None:
    """Write a dive as a mission of version 1, which knows no yaw: parks only wait."""
    points, tolerance_m = export.dives[dive], export.tolerance_m
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
            within_m = way_tolerance_m(export)
        box = child(manoeuvre, "tolerance")
        for axis in "xyz":
            child(box, axis, metres(within_m))
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


FORMAT = ExportFormat(
    read_by="COLA2 before versions were written into missions",
    files=(
        ExportFile(
            name="mission_v1_dive{}.xml", about="COLA2 mission, version 1", write=write_cola2_v1
        ),
    ),
)
