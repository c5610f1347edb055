"""A plan as tables: lines, stations, and the way-points of the paper's lawnmower; CSV."""

import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.artefacts import write_csv
from missions.exports.format import Export, ExportFile, ExportFormat
from missions.exports.geometry import dive_of_line, lat_lon, line_depths, line_ends_deg
from missions.values.plan_file import Plan


def write_lines(path: Path, export: Export, _dive: int) -> None:
    """The lines with their ends in latitude and longitude and in local metres."""
    plan, ends_deg = export.plan, line_ends_deg(export.plan)
    rows: list[dict[str, Any]] = []
    for index, (line, depths) in enumerate(zip(plan.lines, line_depths(plan), strict=True)):
        start_lat, start_lon, end_lat, end_lon = (f"{value:.10f}" for value in ends_deg[index])
        start_north, start_east, end_north, end_east = (
            f"{value:.4f}" for value in (*line.start_ne_m, *line.end_ne_m)
        )
        rows.append({
            "line": index, "kind": line.kind,
            "start_latitude_deg": start_lat, "start_longitude_deg": start_lon,
            "end_latitude_deg": end_lat, "end_longitude_deg": end_lon,
            "start_north_m": start_north, "start_east_m": start_east,
            "end_north_m": end_north, "end_east_m": end_east,
            "heading_deg": f"{math.degrees(line.heading_rad):.6f}",
            "length_m": f"{line.length_m:.4f}", "stations": line.stations,
            "depth_m": f"{sum(depths) / len(depths):.3f}", "altitude_m": f"{plan.altitude_m:.3f}",
            "speed_mps": plan.speed_mps, "interval_s": plan.interval_s,
        })  # fmt: skip
    _write(path, iter(rows))


def write_stations(path: Path, export: Export, _dive: int) -> None:
    """Every place where all cameras take a picture, in the order of flight."""
    _write(path, _stations(export.plan))


def _stations(plan: Plan) -> Iterator[dict[str, Any]]:
    number = itertools.count()
    dive_of, glass_m = dive_of_line(plan), plan.seafloor_depth_m - plan.altitude_m
    for index, (line, depths) in enumerate(zip(plan.lines, line_depths(plan), strict=True)):
        floors = plan.line_floors_m[index] if plan.line_floors_m else depths + plan.altitude_m
        places = line.stations_ne
        places_deg = lat_lon(plan.datum, places, glass_m)
        heading_deg = f"{math.degrees(line.heading_rad):.6f}"
        columns = np.column_stack([places, places_deg, depths, floors - depths])
        for north, east, lat, lon, depth, altitude in columns.tolist():
            yield {
                "station": next(number), "dive": dive_of.get(index), "line": index,
                "kind": line.kind, "latitude_deg": f"{lat:.10f}", "longitude_deg": f"{lon:.10f}",
                "north_m": f"{north:.4f}", "east_m": f"{east:.4f}", "depth_m": f"{depth:.3f}",
                "altitude_m": f"{altitude:.3f}", "heading_deg": heading_deg,
            }  # fmt: skip


def write_waypoints(path: Path, export: Export, _dive: int) -> None:
    """One row for each way-point: of the glass, and of the vehicle that brings it there."""
    points = [(dive, p) for dive, points in enumerate(export.dives, start=1) for p in points]
    rows = (
        {
            "number": number, "dive": dive, "latitude_deg": f"{p.glass_latitude_deg:.10f}",
            "longitude_deg": f"{p.glass_longitude_deg:.10f}", "depth_m": f"{p.glass_depth_m:.3f}",
            "altitude_m": _metres_or_blank(export.mount.glass_altitude_m(p.altitude_m)),
            "speed_mps": p.speed_mps,
            "heading_deg": f"{math.degrees(p.heading_rad):.4f}",
            "action": p.kind + (f", camera {p.camera}" if p.camera else ""),
            "line": p.line if p.line >= 0 else None, "hold_s": f"{p.hold_s:.1f}",
            "vehicle_latitude_deg": f"{p.latitude_deg:.10f}",
            "vehicle_longitude_deg": f"{p.longitude_deg:.10f}",
            "vehicle_depth_m": f"{p.depth_m:.3f}",
            "altimeter_altitude_m": _metres_or_blank(p.altitude_m),
        }
        for number, (dive, p) in enumerate(points, start=1)
    )  # fmt: skip
    _write(path, rows)


def _metres_or_blank(metres: float) -> str:
    return "" if math.isnan(metres) else f"{metres:.3f}"


def _write(path: Path, rows: Iterator[dict[str, Any]]) -> None:
    """Write rows as they come: a plan may have millions of stations."""
    first = next(rows)
    cells = (tuple(row.values()) for row in itertools.chain([first], rows))
    write_csv(path, tuple(first), cells)


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
