"""A plan in files that other tools read: GeoJSON and CSV."""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from alice_survey.artefacts import atomic_path, write_csv
from alice_survey.executor import progress
from alice_survey.frames import Array, Datum
from camera_calib.rig import Rig
from missions.coverage.footprints import footprint_outline, footprints_ne
from missions.plan_file import Plan


def write_lines(path: Path, plan: Plan) -> None:
    """The lines with their ends in latitude and longitude and in local metres, as CSV."""
    header = (
        "line", "kind", "start_latitude_deg", "start_longitude_deg", "end_latitude_deg",
        "end_longitude_deg", "start_north_m", "start_east_m", "end_north_m", "end_east_m",
        "heading_deg", "length_m", "stations", "depth_m", "altitude_m", "speed_mps", "interval_s",
    )  # fmt: skip
    depth_m = plan.seafloor_depth_m - plan.altitude_m
    rows = []
    for index, line in enumerate(plan.lines):
        ends = np.array([line.start_ne_m, line.end_ne_m])
        geodetic = _geodetic(plan.datum, ends, depth_m)
        rows.append(
            [
                index, line.kind,
                *(f"{value:.10f}" for value in geodetic.ravel()),
                *(f"{value:.4f}" for value in ends.ravel()),
                f"{math.degrees(line.heading_rad):.6f}", f"{line.length_m:.4f}", line.stations,
                f"{depth_m:.3f}", f"{plan.altitude_m:.3f}", plan.speed_mps, plan.interval_s,
            ]
        )  # fmt: skip
    write_csv(path, header, rows)


def write_geojson(path: Path, plan: Plan, rig: Rig) -> None:
    """Area, lines, stations and footprints of the first camera, RFC 7946 (WGS 84)."""
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write('{"type": "FeatureCollection", "features": [\n')
        count = 1 + len(plan.lines) + 2 * plan.stations
        features = progress(_features(plan, rig), "plan features", count)
        for index, feature in enumerate(features):
            file.write((",\n" if index else "") + json.dumps(feature, allow_nan=False))
        file.write("\n]}\n")


def _features(plan: Plan, rig: Rig) -> Iterator[dict[str, Any]]:
    floor_m, glass_m = plan.seafloor_depth_m, plan.seafloor_depth_m - plan.altitude_m
    for polygon in plan.area.survey.geoms:
        edges = [
            _ring(_lon_lat(plan.datum, np.asarray(ring.coords)[:-1, :2], floor_m))
            for ring in (polygon.exterior, *polygon.interiors)
        ]
        yield _feature("Polygon", edges, {"role": "area", "name": plan.name})
    outline = footprint_outline(plan, rig)
    for index, line in enumerate(plan.lines):
        ends = _lon_lat(plan.datum, np.array([line.start_ne_m, line.end_ne_m]), glass_m)
        about = {"line": index, "kind": line.kind}
        yield _feature("LineString", ends, {"role": "line", **about, "depth_m": glass_m})
    station = 0
    for index, line in enumerate(plan.lines):
        places = _lon_lat(plan.datum, line.stations_ne, glass_m)
        outlines = footprints_ne(line, outline)
        rings = _lon_lat(plan.datum, outlines.reshape(-1, 2), floor_m)
        per_ring = len(outline)
        for i, place in enumerate(places):
            about = {"station": station, "line": index}
            yield _feature("Point", place, {"role": "station", **about})
            ring = _ring(rings[i * per_ring : (i + 1) * per_ring])
            yield _feature("Polygon", [ring], {"role": "footprint", **about})
            station += 1


def _feature(kind: str, coordinates: Any, properties: dict[str, Any]) -> dict[str, Any]:
    geometry = {"type": kind, "coordinates": coordinates}
    return {"type": "Feature", "properties": properties, "geometry": geometry}


def _ring(lon_lat: list[list[float]]) -> list[list[float]]:
    """A closed ring, counter-clockwise as RFC 7946 asks for."""
    closed = [*lon_lat, lon_lat[0]]
    return closed if shapely.LinearRing(closed).is_ccw else closed[::-1]


def _lon_lat(datum: Datum, points_ne: Array, depth_m: float) -> list[list[float]]:
    rows = _geodetic(datum, points_ne, depth_m)
    return [[round(float(lon), 10), round(float(lat), 10)] for lat, lon in rows]


def _geodetic(datum: Datum, points_ne: Array, depth_m: float) -> Array:
    """Latitudes and longitudes, (N, 2) degrees, of places at one depth."""
    points_ned = np.column_stack([points_ne, np.full(len(points_ne), depth_m)])
    return datum.geodetic_from_ned(points_ned)[:, :2]
