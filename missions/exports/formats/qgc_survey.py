"""QGroundControl plans with a survey item, which holds the very items of the mission.

QGroundControl shows it as a survey, and lays other lines only when a person changes it.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from alice_survey.core.artefacts import write_json
from missions.exports.format import Export, ExportFile, ExportFormat
from missions.exports.formats.qgc import (
    ALTITUDE_MODES,
    corners,
    document,
    simple_items,
    write_qgc,
)
from missions.exports.mavlink import (
    DO_SET_CAM_TRIGG_DIST,
    FRAME_ABOVE_TERRAIN,
    FRAME_MISSION,
    Item,
)


def write_qgc_survey(path: Path, export: Export, dive: int) -> None:
    """Write a dive with its lines as one survey item."""
    items = export.items(dive)
    ways = [index for index, item in enumerate(items) if item.frame == FRAME_ABOVE_TERRAIN]
    if not ways:
        write_qgc(path, export, dive)
        return
    first, last = ways[0], ways[-1] + 1
    while last < len(items) and items[last].command == DO_SET_CAM_TRIGG_DIST:
        last += 1
    survey = _survey(export, dive, items[first:last], first + 1)
    after = simple_items(items[last:], last + 1)
    write_json(path, document(export, dive, [*simple_items(items[:first]), survey, *after]))


def _survey(export: Export, dive: int, items: Sequence[Item], number: int) -> dict[str, Any]:
    """The survey item of mission items, of which the first has a number."""
    plan, points = export.plan, export.dives[dive]
    ways = [item for item in items if item.frame != FRAME_MISSION]
    parts = plan.area.survey.geoms
    outline: Any = parts[0] if len(parts) == 1 else plan.area.survey.convex_hull
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
        "polygon": corners(plan, outline),
        "TransectStyleComplexItem": {
            "version": 2,
            "CameraCalc": _camera_calc(export),
            "CameraShots": shots,
            "CameraTriggerInTurnAround": False,
            "HoverAndCapture": False,
            "Refly90Degrees": False,
            "TurnAroundDistance": plan.run_in_m,
            "TerrainFlightSpeed": plan.speed_mps,
            "Items": simple_items(items, number),
            "VisualTransectPoints": [[item.params[4], item.params[5]] for item in ways],
        },
    }


def _camera_calc(export: Export) -> dict[str, Any]:
    """The camera as QGroundControl models it: a pinhole, so with its focal length in water.

    It is the focal length at which a pinhole in air sees what the real camera sees of the sea floor
    across the track through port and water.
    """
    plan, pixel_um = export.plan, export.options.pixel_um
    camera = export.rig.cameras[export.rig.reference]
    sensor_mm = (
        camera.width_px * pixel_um / 1000,
        camera.height_px * pixel_um / 1000,
    )
    across_m, along_m = plan.footprint_m
    return {
        "version": 2,
        "CameraName": "Custom Camera",
        "DistanceMode": ALTITUDE_MODES[FRAME_ABOVE_TERRAIN],
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


FORMAT = ExportFormat(
    read_by="QGroundControl: the same, lines as one survey item",
    files=(
        ExportFile(
            name="survey_dive{}.plan",
            about="QGroundControl plan for ArduSub, its lines as one survey item",
            write=write_qgc_survey,
        ),
    ),
    keeps_altitude=True,
)
