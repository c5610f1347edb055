"""A plan as GeoJSON (RFC 7946, WGS 84): areas, lines, routes, stations and footprints."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import shapely

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.executor import progress
from missions.exports.format import Export, ExportFile, ExportFormat
from missions.exports.geometry import (
    dive_of_line,
    footprint_outline,
    footprints_ne,
    lon_lat,
    map_features,
)

_FEATURE = '{{"type": "Feature", "properties": {}, "geometry": {}}}'


def write_geojson(path: Path, export: Export, _dive: int) -> None:
    """Write what a plan holds, of the left port's glass; footprints are of the first camera."""
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write('{"type": "FeatureCollection", "features": [\n')
        for index, feature in enumerate(_features(export)):
            file.write((",\n" if index else "") + feature)
        file.write("\n]}\n")


def _features(export: Export) -> Iterator[str]:
    plan = export.plan
    for one in map_features(plan):
        about = json.dumps({"role": one.role, "name": one.name, **one.about}, allow_nan=False)
        yield _FEATURE.format(about, shapely.to_geojson(one.shape))
    floor_m, glass_m = plan.seafloor_depth_m, plan.seafloor_depth_m - plan.altitude_m
    outline = footprint_outline(plan, export.rig)
    if not shapely.LinearRing(outline[:, ::-1]).is_ccw:  # east before north, as in the file
        outline = outline[::-1]
    dives = dive_of_line(plan)
    station = 0
    lines = progress(plan.lines, "lines of plan.geojson", len(plan.lines))
    for index, line in enumerate(lines):
        corners = lon_lat(plan, footprints_ne(line, outline).reshape(-1, 2), floor_m)
        shapes = {
            "station": shapely.points(lon_lat(plan, line.stations_ne, glass_m)),
            "footprint": shapely.polygons(corners.reshape(line.stations, -1, 2)),
        }
        texts = [(role, shapely.to_geojson(np.asarray(found))) for role, found in shapes.items()]
        of = f'"line": {index}, "dive": {json.dumps(dives.get(index))}'
        for i in range(line.stations):
            for role, geometries in texts:
                about = f'{{"role": "{role}", "station": {station + i}, {of}}}'
                yield _FEATURE.format(about, geometries[i])
        station += line.stations


FORMAT = ExportFormat(
    read_by="GIS: areas, lines, routes, stations, footprints",
    files=(
        ExportFile("plan.geojson", "GeoJSON for geographic information systems", write_geojson),
    ),
)
