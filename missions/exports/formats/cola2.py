"""Missions of COLA2, the control software of the SPARUS II: XML of version 2.0.

Structure as its loaders read it (cola2_lib, class Mission): actions
of a step are called when its manoeuvre is done, so the camera starts with the step that ends at a
line's start. `no_altitude_goes_up` makes the vehicle rise while its altimeter sees no floor.

COLA2 ends a step only near its end and turns on the spot by itself: a heading far off the requested
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
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from xml.etree.ElementTree import Element

import numpy as np

from missions.exports.follower import swing_ne_m
from missions.exports.format import MIN_TOLERANCE_M, Export, ExportFile, ExportFormat
from missions.exports.waypoints import MAX_STEP_M, Waypoint, gone_on, move, room_m
from missions.exports.xml_text import (
    child,
    degrees,
    metres,
    number_of,
    root_of,
    value_of,
    write_xml,
)
from missions.values.mission import Heave, Manoeuvre, Mission, MissionStep

_DEPTH, _ALTITUDE, _BOTH = 0, 1, 2
"""Version 2.0's heave modes. Both: altitude where the altimeter sees the floor, else depth."""
_HEAVES: tuple[Heave, ...] = ("depth", "altitude", "both")
_MANOEUVRES: dict[str, Manoeuvre] = {
    "goto": "goto", "section": "section", "park": "anchor", "turn": "keep",
}  # fmt: skip
"""How steps are flown, by their type; of a park that turns, `turn`."""
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


def _steps(export: Export, points: tuple[Waypoint, ...]) -> Iterator[Cola2Step]:
    """The steps of a dive's way-points."""
    exact_m, ways_m = export.cola2_tolerance_m, _way_tolerance_m(export)
    before = start = points[0]
    for i, planned in enumerate(points):
        point, following = planned, points[i + 1] if i + 1 < len(points) else None
        leads_in = following is not None and following.kind in ("line", "run-in", "turn")
        near = math.dist(point.vehicle_ne_m, before.vehicle_ne_m) < 2.0 * ways_m
        near = near and abs(point.depth_m - before.depth_m) < MAX_STEP_M
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


def _way_tolerance_m(export: Export) -> float:
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
    allowed_m = max(plan.allowed_offset_m, MIN_TOLERANCE_M)
    requested_m = follower.delta_m * math.log(max(export.cola2_tolerance_m / allowed_m, 1.0))
    line = plan.lines[start.line]
    back = -np.array([math.cos(line.heading_rad), math.sin(line.heading_rad)])
    lever_m = export.mount.glass_body_m[0]
    turn_m = lever_m + max(float(back @ swing_ne_m(follower, back, lever_m)), 0.0)
    reach_m = max(requested_m, plan.run_in_m) + turn_m
    free_m = room_m(plan, np.array(line.start_ne_m), reach_m * back) - turn_m
    by_m = free_m - math.dist(point.vehicle_ne_m, start.vehicle_ne_m)
    return move(plan, point, max(by_m, 0.0) * back)


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
    return move(export.plan, point, by_m / length_m * way)


def write_cola2(path: Path, export: Export, dive: int) -> None:
    """Write a dive as a mission of version 2.0: sections along lines, gotos, parks for sways."""
    root = Element("mission")
    child(root, "version", "2.0")
    for planned in _steps(export, export.dives[dive]):
        step = child(root, "mission_step")
        _manoeuvre(step, planned, by_depth=export.plan.is_flown_by_depth)
        if planned.end.camera is not None:
            on, off = export.options.camera_on, export.options.camera_off
            action = child(child(step, "actions_list"), "action")
            child(action, "action_id", on if planned.end.camera == "on" else off)
    write_xml(path, root, _comment(export))


def _manoeuvre(step: Element, planned: Cola2Step, *, by_depth: bool) -> None:
    """How a step is flown; a park holds place and heading, and is used to step sideways."""
    start, end = planned.start, planned.end
    parks = end.kind == "sway"
    mode = _DEPTH if by_depth else {"descend": _BOTH, "surface": _DEPTH}.get(end.kind, _ALTITUDE)
    values: dict[str, str | float] = {}
    if planned.is_section:
        values["initial_latitude"] = degrees(start.latitude_deg)
        values["initial_longitude"] = degrees(start.longitude_deg)
        values["initial_depth"] = metres(start.depth_m)
    values["final_latitude"] = degrees(end.latitude_deg)
    values["final_longitude"] = degrees(end.longitude_deg)
    values["final_depth"] = metres(end.depth_m)
    values["final_altitude"] = metres(0.0 if by_depth else end.altitude_m)
    if parks:
        values["final_yaw"] = f"{math.remainder(end.heading_rad, 2 * math.pi):.6f}"
        values["use_yaw"] = "true"
    values |= {"heave_mode": mode, "surge_velocity": metres(end.speed_mps)}
    if parks:
        values["time"] = f"{end.hold_s:.1f}"
    else:
        values["tolerance_xy"] = metres(planned.tolerance_m)
    # On the way down no floor is seen at first; on the way up none need be.
    values["no_altitude_goes_up"] = "true" if mode == _ALTITUDE else "false"
    kind = "park" if parks else "section" if planned.is_section else "goto"
    manoeuvre = child(step, "maneuver", type=kind)
    for tag, value in values.items():
        child(manoeuvre, tag, value)


def _comment(export: Export) -> str:
    """What the places of a mission are of, for people who read the file."""
    plan = export.plan
    return (
        f"{plan.name}: {export.mount.about} Tolerance at the ends of lines "
        f"{export.cola2_tolerance_m:.3f} m: half of what lines {plan.line_spacing_m:.3f} m apart "
        "see twice, or half a step, or what this software needs so as not to circle an end. Lines "
        "go on past their last picture by as much, where they may."
    )


def read_cola2(text: str) -> Mission | None:
    """Read a mission of version 2.0, as cola2_lib's class Mission does."""
    root = root_of(text)
    if root is None or root.tag != "mission" or root.find("version") is None:
        return None
    if value_of(root, "version") != "2.0":
        raise ValueError(f"version {value_of(root, 'version')} of COLA2 missions is not known")
    elements = root.findall("mission_step")
    cameras = _camera_switches(elements)
    return Mission(
        autopilot="cola2",
        steps=tuple(
            _read_step(element, camera) for element, camera in zip(elements, cameras, strict=True)
        ),
    )


def _read_step(step: Element, camera: Literal["on", "off"] | None) -> MissionStep:
    manoeuvre = step.find("maneuver")
    if manoeuvre is None:
        raise ValueError("a <mission_step> lacks <maneuver>")
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
        manoeuvre=_MANOEUVRES[kind if kind != "park" or not turns else "turn"],
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


def _camera_switches(steps: Sequence[Element]) -> list[Literal["on", "off"] | None]:
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
        ExportFile("mission_dive{}.xml", "COLA2 mission, version 2.0 (SPARUS II)", write_cola2),
    ),
    read=read_cola2,
    is_flown=True,
)
