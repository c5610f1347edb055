"""GPX 1.1 (topografix.com) for chart plotters: home, ends of lines, a route for each dive."""

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from missions.exports.format import Export, ExportFile, ExportFormat
from missions.exports.geometry import lat_lon, line_depths
from missions.exports.xml_text import child, degrees, metres, write_xml

_GPX = "http://www.topografix.com/GPX/1/1"


def write_gpx(path: Path, export: Export, _dive: int) -> None:
    """Write way-points of the left port's glass; elevations are negative depths."""
    plan = export.plan
    root = Element("gpx", {"xmlns": _GPX, "version": "1.1", "creator": "alice-survey"})
    metadata = child(root, "metadata")
    child(metadata, "name", plan.name)
    child(metadata, "desc", "Places of the left port's glass; elevation is the negative depth.")
    ((lat, lon),) = lat_lon(plan.datum, np.array([plan.home_ne_m]), 0.0)
    _point(root, "wpt", float(lat), float(lon), 0.0, "home")
    glass_m = plan.seafloor_depth_m - plan.altitude_m
    ends_ne = np.array([end for line in plan.lines for end in (line.start_ne_m, line.end_ne_m)])
    ends = lat_lon(plan.datum, ends_ne, glass_m)
    for index, (line, depths) in enumerate(zip(plan.lines, line_depths(plan), strict=True)):
        for place, depth_m, name in (
            (ends[2 * index], depths[0], "start"),
            (ends[2 * index + 1], depths[-1], "end"),
        ):
            _point(
                root, "wpt", float(place[0]), float(place[1]), -depth_m,
                f"line {index} {name}", line.kind,
            )  # fmt: skip
    for index, points in enumerate(export.dives, start=1):
        route = child(root, "rte")
        child(route, "name", f"{plan.name} dive {index}")
        child(route, "number", index)
        for number, point in enumerate(points):
            _point(
                route, "rtept", point.glass_latitude_deg, point.glass_longitude_deg,
                -point.glass_depth_m, str(number), point.kind,
            )  # fmt: skip
    write_xml(path, root)


def _point(
    parent: Element, tag: str, lat: float, lon: float, elevation_m: float, name: str,
    kind: str | None = None,
) -> None:  # fmt: skip
    point = child(parent, tag, lat=degrees(lat), lon=degrees(lon))
    child(point, "ele", metres(elevation_m))
    child(point, "name", name)
    if kind is not None:
        child(point, "type", kind)


FORMAT = ExportFormat(
    read_by="chart plotters: home, ends of lines, a route a dive",
    files=(ExportFile("plan.gpx", "GPX for chart plotters", write_gpx),),
)
