"""KML 2.2 (OGC 07-147r2) for maps and globes: areas, lines, routes."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from shapely.geometry import MultiPolygon

from alice_survey.core.frames import Array
from missions.exports.format import Export, ExportFile, ExportFormat
from missions.exports.geometry import lat_lon, line_depths_m, rings_ne, route_ne
from missions.exports.xml_text import child, degrees, metres, write_xml
from missions.values.plan_file import Plan

_KML = "http://www.opengis.net/kml/2.2"
_STYLES = {
    # aabbggrr; line, width, fill
    "area": ("ff3d55c8", "2", "203d55c8"),
    "allowed": ("ff8d8c7f", "1", "00ffffff"),
    "no-go": ("ff2b39c0", "2", "802b39c0"),
    "survey": ("ff724f1b", "2", "00ffffff"),
    "cross": ("ff833469", "2", "00ffffff"),
    "closing": ("ff12859c", "2", "00ffffff"),
    "fill": ("ff3c8f2e", "2", "00ffffff"),
    "tie": ("ff2b39c0", "2", "00ffffff"),
    "route": ("b08d8c7f", "1", "00ffffff"),
}


def write_kml(path: Path, export: Export, _dive: int) -> None:
    """Write areas, lines and routes of the left port's glass; heights are negative depths."""
    plan = export.plan
    root = Element("kml", xmlns=_KML)
    document = child(root, "Document")
    child(document, "name", plan.name)
    for name, (colour, width, fill) in _STYLES.items():
        _style(document, name, colour, width, fill)
    glass_m = plan.seafloor_depth_m - plan.altitude_m
    areas = _folder(document, "Areas")
    for name, style, geometry in (
        ("survey area", "area", plan.area.survey),
        ("allowed area", "allowed", plan.area.allowed),
        ("no-go zone", "no-go", plan.area.no_go),
    ):
        _areas(areas, plan, name, style, geometry)
    home = _placemark(areas, "home", None, {"role": "home"})
    place = lat_lon(plan.datum, np.array([plan.home_ne_m]), 0.0)
    _coordinates(child(home, "Point"), place, [0.0], on_surface=True)
    lines = _folder(document, "Lines")
    for index, line in enumerate(plan.lines):
        depths = line_depths_m(plan, index)
        about = {
            "line": index,
            "kind": line.kind,
            "stations": line.stations,
            "length_m": metres(line.length_m),
            "heading_deg": f"{np.degrees(line.heading_rad):.4f}",
            "altitude_m": metres(plan.altitude_m),
            "speed_mps": plan.speed_mps,
        }
        mark = _placemark(lines, f"line {index}", line.kind, about)
        ends = lat_lon(plan.datum, np.array([line.start_ne_m, line.end_ne_m]), depths[0])
        _coordinates(child(mark, "LineString"), ends, [depths[0], depths[-1]])
    routes = _folder(document, "Routes")
    for index, dive in enumerate(plan.dives, start=1):
        about = {
            "dive": index,
            "length_m": metres(dive.route.length_m),
            "duration_s": f"{dive.duration_s:.1f}",
            "energy_wh": f"{dive.energy_wh:.2f}",
        }
        mark = _placemark(routes, f"dive {index}", "route", about)
        corners = lat_lon(plan.datum, route_ne(dive.route), glass_m)
        _coordinates(child(mark, "LineString"), corners, [glass_m] * len(corners))
    write_xml(path, root)


def _areas(folder: Element, plan: Plan, name: str, style: str, geometry: MultiPolygon) -> None:
    for polygon in geometry.geoms:
        mark = _placemark(folder, name, style, {"role": style})
        shape = child(mark, "Polygon")
        for index, ring in enumerate(rings_ne(polygon)):
            edge = child(shape, "outerBoundaryIs" if index == 0 else "innerBoundaryIs")
            _ring(edge, lat_lon(plan.datum, ring, plan.seafloor_depth_m))


def _folder(document: Element, name: str) -> Element:
    folder = child(document, "Folder")
    child(folder, "name", name)
    return folder


def _style(document: Element, name: str, colour: str, width: str, fill: str) -> None:
    style = child(document, "Style", id=name)
    line = child(style, "LineStyle")
    child(line, "color", colour)
    child(line, "width", width)
    child(child(style, "PolyStyle"), "color", fill)


def _placemark(
    folder: Element, name: str, style: str | None, about: Mapping[str, object]
) -> Element:
    mark = child(folder, "Placemark")
    child(mark, "name", name)
    if style is not None:
        child(mark, "styleUrl", f"#{style}")
    data = child(mark, "ExtendedData")
    for key, value in about.items():
        child(child(data, "Data", name=key), "value", str(value))
    return mark


def _ring(edge: Element, corners: Array) -> None:
    ring = child(edge, "LinearRing")
    closed = np.vstack([corners, corners[:1]])
    text = " ".join(f"{degrees(lon)},{degrees(lat)}" for lat, lon in closed)
    child(ring, "coordinates", text)


def _coordinates(
    geometry: Element, rows: Array, depths_m: Iterable[float], *, on_surface: bool = False
) -> None:
    child(geometry, "altitudeMode", "clampToGround" if on_surface else "absolute")
    text = " ".join(
        f"{degrees(lon)},{degrees(lat)},{metres(-depth)}"
        for (lat, lon), depth in zip(rows, depths_m, strict=True)
    )
    child(geometry, "coordinates", text)


FORMAT = ExportFormat(
    read_by="globes: areas with holes, lines, routes",
    files=(ExportFile(name="plan.kml", about="KML for globes", write=write_kml),),
)
