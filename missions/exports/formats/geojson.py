"""A plan as GeoJSON (RFC 7946, WGS 84): areas, lines, routes, stations and footprints."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely.geometry import MultiPolygon

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.executor import progress
from alice_survey.core.frames import Array, Datum
from camera_calib.rig import Rig
from missions.exports.format import Export, ExportFile, ExportFormat
from missions.exports.geometry import (
    dive_of_line,
    footprint_outline,
    footprints_ne,
    lat_lon,
    rings_ne,
    route_ne,
)
from missions.values.plan_file import Plan


def write_geojson(path: Path, export: Export, _dive: int) -> None:
    """Write what a plan holds, of the left port's glass; footprints are of the first camera."""
    plan, rig = export.plan, export.rig
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write('{"type": "FeatureCollection", "features": [\n')
        areas = (plan.area.survey, plan.area.allowed, plan.area.no_go)
        count = sum(len(area.geoms) for area in areas) + 1
        count += 2 * len(plan.lines) + len(plan.dives)
        features = progress(_features(plan, rig), "plan features", count)
        for index, feature in enumerate(features):
            file.write((",\n" if index else "") + feature)
        file.write("\n]}\n")


def _features(plan: Plan, rig: Rig) -> Iterator[str]:
    floor_m, glass_m = plan.seafloor_depth_m, plan.seafloor_depth_m - plan.altitude_m
    yield from _areas(plan, "area", plan.area.survey)
    yield from _areas(plan, "allowed", plan.area.allowed)
    yield from _areas(plan, "no_go", plan.area.no_go)
    (home,) = _lon_lat(plan.datum, np.array([plan.home_ne_m]), 0.0)
    yield _feature("Point", home, {"role": "home"})
    dive_of = dive_of_line(plan)
    for number, dive in enumerate(plan.dives, start=1):
        about = {
            "role": "route", "dive": number, "length_m": round(dive.route.length_m, 4),
            "duration_s": round(dive.duration_s, 1), "energy_wh": round(dive.energy_wh, 2),
            "depth_m": glass_m,
        }  # fmt: skip
        corners = _lon_lat(plan.datum, route_ne(dive.route), glass_m)
        yield _feature("LineString", corners, about)
    for index, line in enumerate(plan.lines):
        ends = _lon_lat(plan.datum, np.array([line.start_ne_m, line.end_ne_m]), glass_m)
        about = {"line": index, "kind": line.kind, "dive": dive_of.get(index)}
        yield _feature("LineString", ends, {"role": "line", **about, "depth_m": glass_m})
    yield from _stations(plan, rig, dive_of, floor_m, glass_m)


def _stations(
    plan: Plan, rig: Rig, dive_of: dict[int, int], floor_m: float, glass_m: float
) -> Iterator[str]:
    """Stations and footprints of each line; put together as text, since there may be millions."""
    outline = footprint_outline(plan, rig)
    if not shapely.LinearRing(outline[:, ::-1]).is_ccw:  # east before north, as in the file
        outline = outline[::-1]
    per_ring = len(outline)
    station = 0
    for index, line in enumerate(plan.lines):
        places = _texts(plan.datum, line.stations_ne, glass_m)
        corners = _texts(plan.datum, footprints_ne(line, outline).reshape(-1, 2), floor_m)
        dive = json.dumps(dive_of.get(index))
        features = []
        for i, place in enumerate(places):
            about = f'"station": {station}, "line": {index}, "dive": {dive}'
            features.append(
                f'{{"type": "Feature", "properties": {{"role": "station", {about}}}, '
                f'"geometry": {{"type": "Point", "coordinates": {place}}}}}'
            )
            ring = corners[i * per_ring : (i + 1) * per_ring]
            closed = ", ".join((*ring, ring[0]))
            features.append(
                f'{{"type": "Feature", "properties": {{"role": "footprint", {about}}}, '
                f'"geometry": {{"type": "Polygon", "coordinates": [[{closed}]]}}}}'
            )
            station += 1
        yield ",\n".join(features)


def _areas(plan: Plan, role: str, geometry: MultiPolygon) -> Iterator[str]:
    for polygon in geometry.geoms:
        edges = [
            _ring(_lon_lat(plan.datum, ring, plan.seafloor_depth_m), hole=index > 0)
            for index, ring in enumerate(rings_ne(polygon))
        ]
        yield _feature("Polygon", edges, {"role": role, "name": plan.name})


def _feature(kind: str, coordinates: Any, properties: dict[str, Any]) -> str:
    geometry = {"type": kind, "coordinates": coordinates}
    feature = {"type": "Feature", "properties": properties, "geometry": geometry}
    return json.dumps(feature, allow_nan=False)


def _ring(lon_lat: list[list[float]], *, hole: bool) -> list[list[float]]:
    """A closed ring; as RFC 7946 has it, outer ones counter-clockwise and holes clockwise."""
    closed = [*lon_lat, lon_lat[0]]
    return closed if shapely.LinearRing(closed).is_ccw != hole else closed[::-1]


def _lon_lat(datum: Datum, points_ne: Array, depth_m: float) -> list[list[float]]:
    rows = lat_lon(datum, points_ne, depth_m)
    return [[round(float(lon), 10), round(float(lat), 10)] for lat, lon in rows]


def _texts(datum: Datum, points_ne: Array, depth_m: float) -> list[str]:
    """Each place as a JSON array of longitude and latitude."""
    return [f"[{lon:.10f}, {lat:.10f}]" for lat, lon in lat_lon(datum, points_ne, depth_m).tolist()]


FORMAT = ExportFormat(
    read_by="GIS: areas, lines, routes, stations, footprints",
    files=(
        ExportFile(
            name="plan.geojson",
            about="GeoJSON for geographic information systems",
            write=write_geojson,
        ),
    ),
)
