"""QGroundControl plans: mission, and fence of allowed area and no-go zones.

Keys and versions: QGroundControl's developer guide, "Plan File Format".
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely.geometry import Polygon

from alice_survey.core.artefacts import write_json
from alice_survey.core.errors import warn
from missions.areas.survey import without_slivers
from missions.exports import mavlink
from missions.exports.format import Export, ExportFile, ExportFormat
from missions.exports.geometry import lat_lon
from missions.values.area import multipolygon
from missions.values.mission import Mission
from missions.values.plan_file import Plan

_ARDUPILOT, _SUBMARINE = 3, 12
"""MAV_AUTOPILOT_ARDUPILOTMEGA and MAV_TYPE_SUBMARINE."""
_ALTITUDE_MODES = {mavlink.FRAME_ABOVE_HOME: 1, mavlink.FRAME_ABOVE_TERRAIN: 4}
"""QGroundControl's own numbers for MAVLink frames."""
_MIXED = 0
_STOP_M = 0.55
"""How near to a place where ArduSub stops it surely stays: its law goes up to 0.52 m beyond the end
of a way of 1.5 m in simulation."""


def write_qgc(path: Path, export: Export, dive: int) -> None:
    """Write a dive as single mission items, with the fence."""
    plan, home, mount = export.plan, export.home_lat_lon_deg, export.mount
    document = {
        "fileType": "Plan",
        "version": 1,
        "groundStation": "QGroundControl",
        "mission": {
            "version": 2,
            "firmwareType": _ARDUPILOT,
            "vehicleType": _SUBMARINE,
            "globalPlanAltitudeMode": _MIXED,
            "cruiseSpeed": plan.speed_mps,
            "hoverSpeed": plan.speed_mps,
            "plannedHomePosition": [round(home[0], 10), round(home[1], 10), 0],
            "items": [_simple(item, i) for i, item in enumerate(export.items(dive), start=1)],
        },
        "geoFence": {"version": 2, "circles": [], "polygons": _fence(export, first=dive == 0)},
        "rallyPoints": {"version": 2, "points": []},
        "aliceSurvey": {"name": plan.name, "about": mount.about},
    }
    write_json(path, document)


def _simple(item: mavlink.Item, number: int) -> dict[str, Any]:
    data: dict[str, Any] = {
        "type": "SimpleItem",
        "autoContinue": True,
        "command": item.command,
        "doJumpId": number,
        "frame": item.frame,
        "params": list(item.params),
    }
    if item.command == mavlink.NAV_WAYPOINT:
        data |= {
            "AMSLAltAboveTerrain": None,
            "Altitude": item.params[6],
            "AltitudeMode": _ALTITUDE_MODES[item.frame],
        }
    return data


def _fence(export: Export, *, first: bool) -> list[dict[str, Any]]:
    """The areas of the glass as those of the vehicle's reference point, a lever arm away.

    The allowed area grows by the lever arm. A zone to keep out of stays as it is, but for where the
    reference point has to pass so that the glass flies its lines, and what it needs to each side.
    """
    plan, area = export.plan, export.plan.area
    grown = area.allowed.buffer(export.mount.reach_m, join_style="mitre")
    fences = [_polygon(plan, part, inclusion=True) for part in multipolygon(grown).geoms]
    # A hole of the allowed area is most often a no-go zone: say it once.
    said = area.no_go.buffer(1e-3)
    holes = [Polygon(hole) for part in area.allowed.geoms for hole in part.interiors]
    zones = [*(hole for hole in holes if not said.contains(hole)), *area.no_go.geoms]
    tracks = [[point.vehicle_ne_m for point in points] for points in export.dives]
    stops = [point.vehicle_ne_m for points in export.dives for point in points if point.hold_s]
    near = shapely.MultiLineString(tracks).buffer(2.0 * export.tolerance_m, 4)
    passed = near.union(shapely.MultiPoint(stops).buffer(_STOP_M, 4))
    crossed = lost = 0
    for zone in zones:
        parts = [zone]
        if zone.intersects(passed):
            crossed += 1
            left = without_slivers(multipolygon(zone.difference(passed)))
            parts = [part for part in left.geoms if len(part.interiors) <= len(zone.interiors)]
            lost += not parts
        fences += [_polygon(plan, part, inclusion=False) for part in parts]
    if crossed and first:
        warn(
            f"the QGroundControl fence excludes {crossed} of {len(zones)} no-go zones only in part"
            f"{f', {lost} of them not at all' if lost else ''}, since lines bring the vehicle's "
            "reference point over them: raise area.no_go_clearance_m to exclude them whole"
        )
    return fences


def _polygon(plan: Plan, polygon: Polygon, *, inclusion: bool) -> dict[str, Any]:
    outer_ne = np.asarray(polygon.exterior.coords, dtype=np.float64)[:-1, :2]
    corners = np.round(lat_lon(plan.datum, outer_ne, 0.0), 10).tolist()
    return {"version": 1, "inclusion": inclusion, "polygon": corners}


def read_qgc(text: str) -> Mission | None:
    """Read the mission of a plan: single items, and those that survey items hold."""
    try:
        data = json.loads(text.lstrip("\ufeff"))
    except (ValueError, RecursionError):
        return None
    if not isinstance(data, dict) or data.get("fileType") != "Plan":
        return None
    mission = data.get("mission")
    items = mission.get("items") if isinstance(mission, dict) else None
    if not isinstance(items, list):
        raise ValueError("the plan has no list of mission items")  # noqa: TRY004  a file's
    return mavlink.mission_of(list(_read_items(items)))


def _read_items(items: list[Any]) -> Iterator[mavlink.Item]:
    for number, item in enumerate(items, start=1):
        where = f"mission item {number}"
        if not isinstance(item, dict):
            raise ValueError(f"{where} is no object")  # noqa: TRY004  a file's
        style = item.get("TransectStyleComplexItem")
        if isinstance(style, dict) and isinstance(style.get("Items"), list):
            yield from _read_items(style["Items"])
        elif item.get("type") == "SimpleItem" and isinstance(item.get("params"), list):
            # null stands for a parameter that is not given.
            params = [0.0 if value is None else value for value in item["params"]]
            yield mavlink.item_of(item.get("command"), item.get("frame"), params, where)
        else:
            raise ValueError(f"{where} is of the type {str(item.get('type'))[:40]!r}")


FORMAT = ExportFormat(
    read_by="QGroundControl, MAVSDK: mission, fence",
    files=(ExportFile("mission_dive{}.plan", "QGroundControl plan for ArduSub", write_qgc),),
    read=read_qgc,
    is_flown=True,
)
