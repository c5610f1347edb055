"""KML 2.2 (OGC 07-147r2) for maps and globes: areas, lines, routes."""

from pathlib import Path
from xml.etree.ElementTree import Element

import shapely
from shapely.geometry.base import BaseGeometry

from missions.exports.format import Export, ExportFile, ExportFormat
from missions.exports.geometry import map_features
from missions.exports.xml_text import child, degrees, metres, write_xml

_KML = "http://www.opengis.net/kml/2.2"
_FOLDERS = {"line": "Lines", "route": "Routes"}
_STYLES = {
    # aabbggrr; line, width, fill
    "area": ("ff3d55c8", "2", "203d55c8"),
    "allowed": ("ff8d8c7f", "1", "00ffffff"),
    "no_go": ("ff2b39c0", "2", "802b39c0"),
    "survey": ("ff724f1b", "2", "00ffffff"),
    "cross": ("ff833469", "2", "00ffffff"),
    "closing": ("ff12859c", "2", "00ffffff"),
    "fill": ("ff3c8f2e", "2", "00ffffff"),
    "tie": ("ff2b39c0", "2", "00ffffff"),
    "route": ("b08d8c7f", "1", "00ffffff"),
}


def write_kml(path: Path, export: Export, _dive: int) -> None:
    """Write areas, lines and routes of the left port's glass; heights are negative depths."""
    root = Element("kml", xmlns=_KML)
    document = child(root, "Document")
    child(document, "name", export.plan.name)
    for name, (colour, width, fill) in _STYLES.items():
        style = child(document, "Style", id=name)
        line = child(style, "LineStyle")
        child(line, "color", colour)
        child(line, "width", width)
        child(child(style, "PolyStyle"), "color", fill)
    folders = {name: child(document, "Folder") for name in ("Areas", *_FOLDERS.values())}
    for name, folder in folders.items():
        child(folder, "name", name)
    for one in map_features(export.plan):
        mark = child(folders[_FOLDERS.get(one.role, "Areas")], "Placemark")
        child(mark, "name", one.name)
        style_name = one.about.get("kind", one.role)
        if style_name in _STYLES:
            child(mark, "styleUrl", f"#{style_name}")
        data = child(mark, "ExtendedData")
        for key, value in {"role": one.role, **one.about}.items():
            child(child(data, "Data", name=key), "value", str(value))
        _add_shape(mark, one.shape)
    write_xml(path, root)


def _add_shape(mark: Element, shape: BaseGeometry) -> None:
    element = child(mark, shape.geom_type)
    if isinstance(shape, shapely.Polygon):
        for index, ring in enumerate((shape.exterior, *shape.interiors)):
            edge = child(element, "outerBoundaryIs" if index == 0 else "innerBoundaryIs")
            _add_coordinates(child(edge, "LinearRing"), ring)
        return
    child(element, "altitudeMode", "clampToGround" if shape.geom_type == "Point" else "absolute")
    _add_coordinates(element, shape)


def _add_coordinates(element: Element, shape: BaseGeometry) -> None:
    rows = shapely.get_coordinates(shape, include_z=True).tolist()
    text = " ".join(f"{degrees(lon)},{degrees(lat)},{metres(z)}" for lon, lat, z in rows)
    child(element, "coordinates", text)


FORMAT = ExportFormat(
    read_by="globes: areas with holes, lines, routes",
    files=(ExportFile("plan.kml", "KML for globes", write_kml),),
)
