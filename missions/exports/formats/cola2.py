"""Missions of COLA2, the control software of the SPARUS II: XML of version 2.0.

Structure as its loaders read it (cola2_lib, class Mission): actions
of a step are called when its manoeuvre is done, so the camera starts with the step that ends at a
line's start. `no_altitude_goes_up` makes the vehicle rise while its altimeter sees no floor.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Literal
from xml.etree.ElementTree import Element

from missions.exports.cola2_way import Cola2Step, cola2_steps
from missions.exports.format import Export, ExportFile, ExportFormat
from missions.exports.options import Options
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
from missions.values.mission import Heave, Mission, MissionStep

_DEPTH, _ALTITUDE, _BOTH = 0, 1, 2
"""Version 2.0's heave modes. Both: altitude where the altimeter sees the floor, else depth."""
_HEAVES: tuple[Heave, ...] = ("depth", "altitude", "both")


def write_cola2(path: Path, export: Export, dive: int) -> None:
    """Write a dive as a mission of version 2.0: sections along lines, gotos, parks for sways."""
    root = Element("mission")
    child(root, "version", "2.0")
    for planned in cola2_steps(export, dive):
        step = child(root, "mission_step")
        if planned.end.kind == "sway":
            _park(step, planned.end)
        elif planned.is_section:
            _section(step, planned)
        else:
            _goto(step, planned.end, planned.tolerance_m)
        add_actions(step, planned.end, export.options)
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


def _section(step: Element, planned: Cola2Step) -> None:
    start, end = planned.start, planned.end
    manoeuvre = child(step, "maneuver", type="section")
    child(manoeuvre, "initial_latitude", degrees(start.latitude_deg))
    child(manoeuvre, "initial_longitude", degrees(start.longitude_deg))
    child(manoeuvre, "initial_depth", metres(start.depth_m))
    _final(manoeuvre, end)
    child(manoeuvre, "heave_mode", _ALTITUDE)
    child(manoeuvre, "surge_velocity", metres(end.speed_mps))
    child(manoeuvre, "tolerance_xy", metres(planned.tolerance_m))
    child(manoeuvre, "no_altitude_goes_up", _bool(True))


def _park(step: Element, point: Waypoint) -> None:
    """Hold place and heading; used to step sideways."""
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


def comment(export: Export) -> str:
    """What the places of a mission are of, for people who read the file."""
    plan = export.plan
    return (
        f"{plan.name}: {export.mount.about} Tolerance at the ends of lines "
        f"{export.cola2_tolerance_m:.3f} m: half of what lines {plan.line_spacing_m:.3f} m apart "
        "see twice, or half a step, or what this software needs so as not to circle an end. Lines "
        "go on past their last picture by as much, where they may."
    )


def _bool(value: bool) -> str:
    return "true" if value else "false"


def read_cola2(text: str) -> Mission | None:
    """Read a mission of version 2.0, as cola2_lib's class Mission does."""
    root = root_of(text)
    if root is None or root.tag != "mission" or root.find("version") is None:
        return None
    if value_of(root, "version") != "2.0":
        raise ValueError(f"version {value_of(root, 'version')} of COLA2 missions is not known")
    elements = root.findall("mission_step")
    cameras = camera_switches(elements)
    return Mission(
        autopilot="cola2",
        steps=tuple(
            _read_step(manoeuvre_of(element), camera)
            for element, camera in zip(elements, cameras, strict=True)
        ),
    )


def manoeuvre_of(step: Element) -> Element:
    """The manoeuvre of a step.

    Raises:
        ValueError: there is none.
    """
    manoeuvre = step.find("maneuver")
    if manoeuvre is None:
        raise ValueError("a <mission_step> lacks <maneuver>")
    return manoeuvre


def _read_step(manoeuvre: Element, camera: Literal["on", "off"] | None) -> MissionStep:
    kind = manoeuvre.get("type", "")
    if kind not in ("goto", "section", "park"):
        raise ValueError(f"the maneuver {kind[:40]!r} is not known")
    mode = number_of(manoeuvre, "heave_mode")
    if mode not in (_DEPTH, _ALTITUDE, _BOTH):
        raise ValueError(f"<heave_mode> is {mode:g}, not 0, 1 or 2")
    parked, start_deg = kind == "park", None
    turns = parked and value_of(manoeuvre, "use_yaw") == "true"
    if kind == "section":
        start_deg = (
            number_of(manoeuvre, "initial_latitude"),
            number_of(manoeuvre, "initial_longitude"),
        )
    return MissionStep(
        manoeuvre="goto" if kind == "goto" else ("section" if start_deg else _park_kind(turns)),
        latitude_deg=number_of(manoeuvre, "final_latitude"),
        longitude_deg=number_of(manoeuvre, "final_longitude"),
        start_deg=start_deg,
        heave=_HEAVES[int(mode)],
        depth_m=number_of(manoeuvre, "final_depth"),
        altitude_m=number_of(manoeuvre, "final_altitude"),
        speed_mps=number_of(manoeuvre, "surge_velocity"),
        tolerance_m=math.nan if parked else number_of(manoeuvre, "tolerance_xy"),
        hold_s=number_of(manoeuvre, "time") if parked else 0.0,
        heading_rad=number_of(manoeuvre, "final_yaw") if turns else math.nan,
        camera=camera,
    )


def _park_kind(turns: bool) -> Literal["keep", "anchor"]:
    return "keep" if turns else "anchor"


def camera_switches(steps: Sequence[Element]) -> list[Literal["on", "off"] | None]:
    """What each step of a mission switches pictures to.

    A mission calls two services in turn, whatever their names are.

    Raises:
        ValueError: it calls other services too, or one twice in a row.
    """
    called = [[value_of(action, "action_id") for action in s.iter("action")] for s in steps]
    names = [name for calls in called for name in calls]
    if any(len(calls) > 1 for calls in called) or names != [
        names[i % 2] for i in range(len(names))
    ]:
        raise ValueError(
            "its actions are not two services in turn, of which the first starts pictures"
        )
    switches: list[Literal["on", "off"] | None] = []
    on = False
    for calls in called:
        on = on != bool(calls)
        switches.append(("on" if on else "off") if calls else None)
    return switches


FORMAT = ExportFormat(
    read_by="COLA2, version 2.0: SPARUS II and its kin",
    files=(
        ExportFile(
            name="mission_dive{}.xml",
            about="COLA2 mission, version 2.0 (SPARUS II)",
            write=write_cola2,
        ),
    ),
    read=read_cola2,
    keeps_altitude=True,
)
