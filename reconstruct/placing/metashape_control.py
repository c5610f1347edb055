"""Markers as Metashape (and PhotoScan) exports them: File > Export > Export Markers, as XML.

A chunk lists `cameras` (labels by number), `markers` with `reference` coordinates (x, y, z and
their accuracies; unticked ones are check points), and by frame the `location` of each marker in
pictures, in pixels from the outer corner of the first one. Locations that were not pinned by a
person are what the program expects, and are not used.
"""

import math
import re
from xml.etree import ElementTree as ET

from alice_survey.base.contents import shown
from reconstruct.placing.control_file import PICK_SIGMA_PX
from reconstruct.placing.foreign_control import (
    Coordinates,
    ForeignControl,
    ForeignPick,
    ForeignPoint,
)

_ACCURACIES = ("accuracy_markers", "accuracy_projections")
"""Settings of a chunk: sigma of markers' coordinates (m) and of their places in pictures (px)."""


def is_markers(text: str) -> bool:
    """Whether a text is such an XML."""
    return text.lstrip().startswith("<") and "<markers" in text


def read_markers(text: str) -> ForeignControl:
    """Read it.

    Raises:
        ValueError: it is not valid, or lacks something.
    """
    if re.search(r"<!\s*(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        raise ValueError("declares a DOCTYPE or ENTITY, which is refused")
    try:
        top = ET.fromstring(text)  # noqa: S314 - without a document type
    except ET.ParseError as error:
        raise ValueError(f"not valid XML: {error}") from None
    chunks = [top] if top.tag == "chunk" else list(top.iter("chunk"))
    chunks = [chunk for chunk in chunks if chunk.find("markers") is not None]
    if len(chunks) != 1:
        raise ValueError(f"{len(chunks)} chunks have markers: export the markers of one")
    (chunk,) = chunks
    coordinates = _coordinates(chunk)
    settings = {
        str(item.get("name")): item.get("value") for item in chunk.findall("settings/property")
    }
    sigma_m, sigma_px = (_sigma(settings.get(name), name) for name in _ACCURACIES)
    cameras = {camera.get("id"): str(camera.get("label")) for camera in chunk.iter("camera")}
    labels: dict[str | None, str] = {}
    points = []
    for marker in chunk.findall("markers/marker"):
        name = (marker.get("label") or f"marker {marker.get('id')}").strip()
        labels[marker.get("id")] = name
        reference = marker.find("reference")
        if reference is not None:
            points.append(_point(name, reference, coordinates, sigma_m))
    picks = []
    for marker in chunk.findall("frames/frame/markers/marker"):
        for location in marker.findall("location"):
            if location.get("pinned", "true").lower() not in ("true", "1"):
                continue
            picture = cameras.get(location.get("camera_id"))
            point = labels.get(marker.get("marker_id"))
            if picture is None or point is None:
                raise ValueError(
                    f"a location names camera {location.get('camera_id')} and marker "
                    f"{marker.get('marker_id')}, which it does not list"
                )
            x, y = (_number(location, axis, point) for axis in "xy")
            picks.append(
                ForeignPick(
                    picture=picture, point=point, x_px=x, y_px=y, sigma_px=sigma_px or PICK_SIGMA_PX
                )
            )
    bars = len(chunk.findall("scalebars/scalebar"))
    notes = [f"{bars} scale bars are not read: write them to control.csv as bars"] if bars else []
    return ForeignControl(points=tuple(points), picks=tuple(picks), notes=tuple(notes))


def _coordinates(chunk: ET.Element) -> Coordinates:
    """The system of the markers: their own, or the chunk's."""
    for tag in ("markers_reference", "reference"):
        text = (chunk.findtext(tag) or "").strip()
        if text:
            return Coordinates(text)
    raise ValueError("names no coordinate system: set one in Metashape's reference pane and export")


def _point(
    name: str, reference: ET.Element, coordinates: Coordinates, sigma_m: float | None
) -> ForeignPoint:
    if any(reference.get(axis) is None for axis in "xyz"):
        return ForeignPoint(name=name, place=(math.nan,) * 3, geodetic=coordinates.geodetic)
    x, y, z = (_number(reference, axis, name) for axis in "xyz")
    own = {axis: _sigma(reference.get(axis), f"{axis} of {name}") for axis in ("sx", "sy", "sz")}
    level = [own[axis] for axis in ("sx", "sy")]
    return ForeignPoint(
        name=name,
        place=coordinates.place(x, y, z),
        geodetic=coordinates.geodetic,
        use="control" if reference.get("enabled", "true").lower() in ("true", "1") else "check",
        sigma_m=max((s for s in level if s is not None), default=sigma_m),
        sigma_vertical_m=own["sz"] if own["sz"] is not None else sigma_m,
    )


def _number(element: ET.Element, key: str, name: str) -> float:
    return _finite(element.get(key, ""), f"{key} of {name}")


def _sigma(text: str | None, name: str) -> float | None:
    """A positive number, or None where nothing is stated."""
    if text is None or not text.strip():
        return None
    value = _finite(text, name)
    if value <= 0:
        raise ValueError(f"{shown(name)} is {value}: it must be more than 0")
    return value


def _finite(text: str, name: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{shown(name)} is {shown(text)!r}, not a number")
    return value
