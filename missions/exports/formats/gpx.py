"""GPX 1.1 (topografix.com) for chart plotters: home, ends of lines, a route for each dive."""

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from missions.exports.format import Export, ExportFile, ExportFormat
from missions.exports.geometry import lat_lon, line_depths, line_ends_deg
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
    ends = zip(plan.lines, line_ends_deg(plan).tolist(), line_depths(plan), strict=True)
    for index, (line, ends_deg, depths) in enumerate(ends):
        _point(root, "wpt", ends_deg[0], ends_deg[1], -depths[0], f"line {index} start", line.kind)
        _point(root, "wpt", ends_deg[2], ends_deg[3], -depths[-1], f"line {index} end", line.kind)
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
