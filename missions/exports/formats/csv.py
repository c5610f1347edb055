"""A plan as tables: lines, stations, and the way-points of the paper's lawnmower; CSV."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from alice_survey.core.artefacts import write_csv
from missions.exports.format import Export, ExportFile, ExportFormat
from missions.exports.geometry import dive_of_line, lat_lon, line_depths, line_ends_deg
from missions.values.plan_file import Plan


def write_lines(path: Path, export: Export, _dive: int) -> None:
    """The lines with their ends in latitude and longitude and in local metres."""
    plan = export.plan
    header = (
        "line", "kind", "start_latitude_deg", "start_longitude_deg", "end_latitude_deg",
        "end_longitude_deg", "start_north_m", "start_east_m", "end_north_m", "end_east_m",
        "heading_deg", "length_m", "stations", "depth_m", "altitude_m", "speed_mps", "interval_s",
    )  # fmt: skip
    ends_deg = line_ends_deg(plan)
    rows = []
    for index, (line, depths) in enumerate(zip(plan.lines, line_depths(plan), strict=True)):
        rows.append(
            [
                index, line.kind,
                *(f"{value:.10f}" for value in ends_deg[index]),
                *(f"{value:.4f}" for value in (*line.start_ne_m, *line.end_ne_m)),
                f"{math.degrees(line.heading_rad):.6f}", f"{line.length_m:.4f}", line.stations,
                f"{sum(depths) / len(depths):.3f}", f"{plan.altitude_m:.3f}", plan.speed_mps,
                plan.interval_s,
            ]
        )  # fmt: skip
    write_csv(path, header, rows)


def write_stations(path: Path, export: Export, _dive: int) -> None:
    """Every place where all cameras take a picture, in the order of flight."""
    header = (
        "station", "dive", "line", "kind", "latitude_deg", "longitude_deg", "north_m", "east_m",
        "depth_m", "altitude_m", "heading_deg",
    )  # fmt: skip
    write_csv(path, header, _stations(export.plan))


def write_waypoints(path: Path, export: Export, _dive: int) -> None:
    """One row for each way-point: of the glass, and of the vehicle that brings it there."""
    header = (
        "number", "dive", "latitude_deg", "longitude_deg", "depth_m", "altitude_m", "speed_mps",
        "heading_deg", "action", "line", "hold_s", "vehicle_latitude_deg", "vehicle_longitude_deg",
        "vehicle_depth_m", "altimeter_altitude_m",
    )  # fmt: skip
    write_csv(path, header, _waypoints(export))


def _stations(plan: Plan) -> Iterator[list[Any]]:
    depth_m = plan.seafloor_depth_m - plan.altitude_m
    dive_of = dive_of_line(plan)
    station = 0
    for index, (line, depths) in enumerate(zip(plan.lines, line_depths(plan), strict=True)):
        places = line.stations_ne
        heading = f"{math.degrees(line.heading_rad):.6f}"
        for place, (lat, lon), depth in zip(
            places, lat_lon(plan.datum, places, depth_m), depths, strict=True
        ):
            yield [
                station, dive_of.get(index), index, line.kind, f"{lat:.10f}", f"{lon:.10f}",
                f"{place[0]:.4f}", f"{place[1]:.4f}", f"{depth:.3f}", f"{plan.altitude_m:.3f}",
                heading,
            ]  # fmt: skip
            station += 1


def _waypoints(export: Export) -> Iterator[list[Any]]:
    number = 1
    for dive, points in enumerate(export.dives, start=1):
        for point in points:
            yield [
                number, dive, f"{point.glass_latitude_deg:.10f}",
                f"{point.glass_longitude_deg:.10f}", f"{point.glass_depth_m:.3f}",
                f"{export.plan.altitude_m:.3f}", point.speed_mps,
                f"{math.degrees(point.heading_rad):.4f}",
                point.kind + (f", camera {point.camera}" if point.camera else ""),
                point.line if point.line >= 0 else None, f"{point.hold_s:.1f}",
                f"{point.latitude_deg:.10f}", f"{point.longitude_deg:.10f}",
                f"{point.depth_m:.3f}", f"{point.altitude_m:.3f}",
            ]  # fmt: skip
            number += 1


FORMAT = ExportFormat(
    read_by="tables; `waypoints.csv` is the lawnmower's way-point table",
    files=(
        ExportFile("lines.csv", "table of the lines", write_lines),
        ExportFile("stations.csv", "table of the places of pictures", write_stations),
        ExportFile(
            "waypoints.csv", "table of the way-points, of glass and vehicle", write_waypoints
        ),
    ),
)
