"""QGroundControl plans: mission, fence of allowed area and no-go zones, and a survey item.

Keys and versions: QGroundControl's developer guide, "Plan File Format". A survey item holds the
very items of the mission; QGroundControl shows it as a survey, and lays lines of its own only when
a person changes it.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely.geometry import Polygon

from alice_survey.base.artefacts import write_json
from alice_survey.base.errors import warn
from alice_survey.base.frames import Array
from camera_calib.rig import Rig
from missions.exports.mavlink import (
    DO_SET_CAM_TRIGG_DIST,
    FRAME_ABOVE_HOME,
    FRAME_ABOVE_TERRAIN,
    FRAME_MISSION,
    NAV_WAYPOINT,
    Item,
)
from missions.exports.mount import Mount
from missions.exports.options import Options
from missions.exports.places import grown, lat_lon
from missions.exports.waypoints import Waypoint
from missions.values.plan_file import Plan

_ARDUPILOT, _SUBMARINE = 3, 12
"""MAV_AUTOPILOT_ARDUPILOTMEGA and MAV_TYPE_SUBMARINE."""
_ALTITUDE_MODES = {FRAME_ABOVE_HOME: 1, FRAME_ABOVE_TERRAIN: 4}
"""QGroundControl's own numbers for MAVLink frames."""
_MIXED = 0


def write_qgroundcontrol(
    path: Path,
    plan: Plan,
    points: Sequence[Waypoint],
    items: Sequence[Item],
    home_lat_lon_deg: tuple[float, float],
    mount: Mount,
) -> None:
    """Write a dive as single mission items.

    Args:
        path: where to.
        plan: what the dive is of.
        points: the dive's way-points.
        items: the same as mission items.
        home_lat_lon_deg: where the vehicle is launched.
        mount: of the camera; the fence is of the vehicle's reference point.
    """
    simple = [_simple(item, index) for index, item in enumerate(items, start=1)]
    write_json(path, _document(plan, points, simple, home_lat_lon_deg, mount))


def write_qgroundcontrol_survey(
    path: Path,
    plan: Plan,
    points: Sequence[Waypoint],
    items: Sequence[Item],
    home_lat_lon_deg: tuple[float, float],
    mount: Mount,
    rig: Rig,
    options: Options,
) -> None:
    """Write a dive with its lines as one survey item.

    Args: as of `write_qgroundcontrol`, and
        rig: whose first camera the survey item describes.
        options: size of a pixel.
    """
    ways = [index for index, item in enumerate(items) if item.frame == FRAME_ABOVE_TERRAIN]
    if not ways:
        write_qgroundcontrol(path, plan, points, items, home_lat_lon_deg, mount)
        return
    first, last = ways[0], ways[-1] + 1
    while last < len(items) and items[last].command == DO_SET_CAM_TRIGG_DIST:
        last += 1
    before = [_simple(item, index) for index, item in enumerate(items[:first], start=1)]
    inside = [_simple(item, index) for index, item in enumerate(items[first:last], first + 1)]
    after = [_simple(item, index) for index, item in enumerate(items[last:], start=last + 1)]
    survey = _survey(plan, points, inside, items[first:last], rig, options)
    write_json(path, _document(plan, points, [*before, survey, *after], home_lat_lon_deg, mount))


def _document(
    plan: Plan,
    points: Sequence[Waypoint],
    items: list[dict[str, Any]],
    home: tuple[float, float],
    mount: Mount,
) -> dict[str, Any]:
    return {
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
            "items": items,
        },
        "geoFence": {"version": 2, "circles": [], "polygons": _fence(plan, points, mount)},
        "rallyPoints": {"version": 2, "points": []},
        "aliceSurvey": {"name": plan.name, "about": mount.about},
    }


def _simple(item: Item, number: int) -> dict[str, Any]:
    data: dict[str, Any] = {
        "type": "SimpleItem",
        "autoContinue": True,
        "command": item.command,
        "doJumpId": number,
        "frame": item.frame,
        "params": list(item.params),
    }
    if item.command == NAV_WAYPOINT:
        data |= {
            "AMSLAltAboveTerrain": None,
            "Altitude": item.params[6],
            "AltitudeMode": _ALTITUDE_MODES[item.frame],
        }
    return data


def _fence(plan: Plan, points: Sequence[Waypoint], mount: Mount) -> list[dict[str, Any]]:
    """The areas of the glass as those of the vehicle's reference point, a lever arm away.

    The allowed area grows by the lever arm. A zone to keep out of stays as it is, unless the
    reference point has to cut its corner to bring the glass along its edge: then it shrinks by the
    lever arm, which the reference point surely keeps out of.
    """
    outer = [Polygon(part.exterior) for part in grown(plan.area.allowed, mount.reach_m)]
    zones: list[Polygon] = []
    holes = [Polygon(hole) for part in plan.area.allowed.geoms for hole in part.interiors]
    for zone in (*holes, *plan.area.no_go.geoms):
        # A hole of the allowed area is most often a no-go zone: say it once.
        if not any(other.buffer(1e-3).contains(zone) for other in zones):
            zones.append(Polygon(zone.exterior))
    track = shapely.LineString([point.vehicle_ne_m for point in points])
    fences = [_polygon(plan, part, inclusion=True) for part in outer]
    for zone in zones:
        parts = [zone]
        if zone.intersects(track):
            parts = grown(shapely.MultiPolygon([zone]), -mount.reach_m)
            if not parts:
                warn(
                    f"a no-go zone of {zone.area:.2f} m2 is left out of the fence: the vehicle's "
                    f"reference point, {mount.reach_m:.2f} m from the glass, crosses it in a turn"
                )
        fences += [_polygon(plan, part, inclusion=False) for part in parts]
    return fences


def _polygon(plan: Plan, polygon: Polygon, *, inclusion: bool) -> dict[str, Any]:
    return {"version": 1, "inclusion": inclusion, "polygon": _corners(plan, polygon)}


def _corners(plan: Plan, polygon: Polygon) -> list[list[float]]:
    corners = np.asarray(polygon.exterior.coords, dtype=np.float64)[:-1, :2]
    rows = lat_lon(plan.datum, corners, 0.0)
    return [[round(float(lat), 10), round(float(lon), 10)] for lat, lon in rows]


def _survey(
    plan: Plan,
    points: Sequence[Waypoint],
    inside: list[dict[str, Any]],
    items: Sequence[Item],
    rig: Rig,
    options: Options,
) -> dict[str, Any]:
    ways = [item for item in items if item.frame != FRAME_MISSION]
    parts = plan.area.survey.geoms
    corners = np.vstack([np.asarray(part.exterior.coords)[:, :2] for part in parts])
    outline = parts[0] if len(parts) == 1 else Polygon(_hull(corners))
    heading = plan.lines[0].heading_rad
    flown = {point.line for point in points if point.line >= 0}
    shots = sum(plan.lines[index].stations for index in flown)
    return {
        "type": "ComplexItem",
        "complexItemType": "survey",
        "version": 5,
        "angle": round(math.degrees(heading), 6) % 360.0,
        "entryLocation": 0,
        "flyAlternateTransects": False,
        "splitConcavePolygons": False,
        "polygon": _corners(plan, Polygon(outline.exterior)),
        "TransectStyleComplexItem": {
            "version": 2,
            "CameraCalc": _camera_calc(plan, rig, options),
            "CameraShots": shots,
            "CameraTriggerInTurnAround": False,
            "HoverAndCapture": False,
            "Refly90Degrees": False,
            "TurnAroundDistance": plan.run_in_m,
            "TerrainFlightSpeed": plan.speed_mps,
            "Items": inside,
            "VisualTransectPoints": [[item.params[4], item.params[5]] for item in ways],
        },
    }


def _hull(corners: Array) -> Array:
    """Corners of the convex hull of (N, 2) places."""
    hull: Array = shapely.get_coordinates(shapely.MultiPoint(corners).convex_hull)
    return hull


def _camera_calc(plan: Plan, rig: Rig, options: Options) -> dict[str, Any]:
    """The camera as QGroundControl reckons with it: a pinhole, so with its focal length in water.

    It is the focal length at which a pinhole in air sees what the real camera sees of the sea floor
    across the track through port and water.
    """
    camera = rig.cameras[rig.reference]
    sensor_mm = (
        camera.width_px * options.pixel_um / 1000,
        camera.height_px * options.pixel_um / 1000,
    )
    across_m, along_m = plan.footprint_m
    return {
        "version": 2,
        "CameraName": "Custom Camera",
        "DistanceMode": _ALTITUDE_MODES[FRAME_ABOVE_TERRAIN],
        "DistanceToSurface": plan.altitude_m,
        "FixedOrientation": False,
        "FocalLength": round(sensor_mm[0] * plan.altitude_m / across_m, 6),
        "SensorWidth": round(sensor_mm[0], 6),
        "SensorHeight": round(sensor_mm[1], 6),
        "ImageWidth": camera.width_px,
        "ImageHeight": camera.height_px,
        "ImageDensity": round(100 * across_m / camera.width_px, 6),
        "Landscape": True,
        "MinTriggerInterval": 0,
        "ValueSetIsDistance": True,
        "FrontalOverlap": round(100 * (1 - plan.station_spacing_m / along_m), 3),
        "SideOverlap": round(100 * (1 - plan.line_spacing_m / across_m), 3),
        "AdjustedFootprintFrontal": plan.station_spacing_m,
        "AdjustedFootprintSide": plan.line_spacing_m,
    }
