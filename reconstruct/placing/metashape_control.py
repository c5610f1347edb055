"""Markers as Metashape (and PhotoScan) exports them: File > Export > Export Markers, as XML.

A chunk lists `cameras` (labels by number), `markers` with `reference` coordinates (x, y, z and
their accuracies; unticked ones are check points), `scalebars` between two of them with a
`reference` distance, and by frame the `location` of each marker in
pictures, in pixels from the outer corner of the first one. Locations that were not pinned by a
person are what the program expects, and are not used. A scale bar that does not name its markers
by their numbers has their labels in its own, `A_B`, as Metashape makes them.
"""

import math
from collections.abc import Mapping
from xml.etree import ElementTree as ET

from alice_survey.core.contents import shown
from alice_survey.core.untrusted import xml_root
from reconstruct.placing.control_file import PICK_SIGMA_PX
from reconstruct.placing.foreign_control import (
    Coordinates,
    ForeignBar,
    ForeignControl,
    ForeignPick,
    ForeignPoint,
)

_ACCURACIES = ("accuracy_markers", "accuracy_projections", "accuracy_scalebars")
"""Settings of a chunk: sigma of markers' coordinates (m), of their places in pictures (px) and of
scale bars (m)."""


def is_markers(text: str) -> bool:
    """Whether a text is such an XML."""
    return text.lstrip().startswith("<") and "<markers" in text


def read_markers(text: str) -> ForeignControl:
    """Read it.

    Raises:
        ValueError: it is not valid, or lacks something.
    """
    top = xml_root(text)
    chunks = [top] if top.tag == "chunk" else list(top.iter("chunk"))
    chunks = [chunk for chunk in chunks if chunk.find("markers") is not None]
    if len(chunks) != 1:
        raise ValueError(f"{len(chunks)} chunks have markers: export the markers of one")
    (chunk,) = chunks
    settings = {
        str(item.get("name")): item.get("value") for item in chunk.findall("settings/property")
    }
    sigma_m, sigma_px, sigma_bar_m = (_sigma(settings.get(name), name) for name in _ACCURACIES)
    cameras = {camera.get("id"): str(camera.get("label")) for camera in chunk.iter("camera")}
    labels: dict[str | None, str] = {}
    points = []
    placed = chunk.findall("markers/marker/reference[@x]")
    bars_only = not placed and chunk.find("scalebars/scalebar") is not None
    coordinates = None if bars_only else _coordinates(chunk)
    for marker in chunk.findall("markers/marker"):
        name = (marker.get("label") or f"marker {marker.get('id')}").strip()
        labels[marker.get("id")] = name
        reference = marker.find("reference")
        if reference is not None and coordinates is not None:
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
    bars, lost = [], []
    for number, item in enumerate(chunk.findall("scalebars/scalebar")):
        bar = _bar(item, labels, sigma_bar_m)
        if bar is None:
            lost.append(item.get("label") or f"number {number}")
        else:
            bars.append(bar)
    notes = (f"scale bars without a distance or two markers are left out: {', '.join(lost)}",)
    return ForeignControl(
        points=tuple(points), picks=tuple(picks), bars=tuple(bars), notes=notes if lost else ()
    )


def _bar(
    item: ET.Element, labels: Mapping[str | None, str], sigma_m: float | None
) -> ForeignBar | None:
    """A scale bar; None where it has no distance, or does not lie between two known markers."""
    reference = item.find("reference")
    if reference is None or reference.get("distance") is None:
        return None
    name = (item.get("label") or f"bar {item.get('id')}").strip()
    numbers = [
        value
        for part in item.iter()
        for key, value in sorted(part.attrib.items())
        if "marker" in key or (key == "id" and part.tag == "marker")
    ]
    ends = [labels[number] for number in numbers if number in labels]
    if not numbers:
        cuts = [k for k, letter in enumerate(name) if letter == "_"]
        known = set(labels.values())
        pairs = [(name[:k], name[k + 1 :]) for k in cuts]
        ends = next(([*pair] for pair in pairs if known.issuperset(pair)), [])
    if len(ends) != 2 or ends[0] == ends[1]:
        return None
    length_m = _number(reference, "distance", name)
    if length_m <= 0:
        raise ValueError(f"distance of {shown(name)} is {length_m}: it must be more than 0")
    own = _sigma(reference.get("accuracy"), f"accuracy of {name}")
    return ForeignBar(
        name=name,
        ends=(ends[0], ends[1]),
        length_m=length_m,
        use="control" if _ticked(reference) else "check",
        sigma_m=own if own is not None else sigma_m,
    )


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
        use="control" if _ticked(reference) else "check",
        sigma_m=max((s for s in level if s is not None), default=sigma_m),
        sigma_vertical_m=own["sz"] if own["sz"] is not None else sigma_m,
    )


def _ticked(reference: ET.Element) -> bool:
    return reference.get("enabled", "true").lower() in ("true", "1")


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
