"""Projects of TagLab: pictures with regions and points, and the dictionary of labels.

Regions of a picture are outlines with holes through the middles of pixels: half a pixel less in
x and y than from the outer corner; TagLab writes them as text, the first point and then each one's
way from the one before, in tenths of a pixel, and reads lists of pairs too, which lose nothing.
Boxes are top, left, width, height. TagLab has no lines; a rectangle or circle is a region, whose
`data` says what it was.
"""

import contextlib
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from alice_survey.core.errors import WorkspaceError
from reconstruct.annotations.backdrops import Backdrop, Backdrops
from reconstruct.annotations.formats.common import (
    OURS,
    Format,
    Reading,
    ToolFiles,
    check_size,
    hint_of,
    pairs,
    placed,
    read_object,
    shape_of,
    with_hint,
)
from reconstruct.annotations.values import AnnotationSet, DrawnShape, Label, Place

_MIDDLE = 0.5
"""Of the first pixel, from its outer corner."""
_BORDER = [200, 200, 200]
_TENTHS = 10.0
_APHIA = "AphiaID "
_EMPTY = "Empty"
"""Class of regions without a label."""


def read_taglab(data: bytes, backdrops: Backdrops) -> AnnotationSet:
    """Annotations of a TagLab project.

    Raises:
        WorkspaceError: it is none, or a part of it is wrong.
    """
    whole = read_object(data, "TagLab project")
    images = whole.get("images")
    if not isinstance(images, list) or not all(isinstance(one, dict) for one in images):
        raise WorkspaceError("no TagLab project: 'images' is no list of objects")
    found = Reading()
    for entry in _labels(whole.get("labels")):
        found.label(*entry)
    for n, image in enumerate(images):
        regions, points = _marks(image, n)
        if not regions and not points:
            continue
        backdrop = _backdrop(image, n, backdrops)
        for m, region in enumerate(regions):
            where = f"{backdrop.name}, region {region.get('id', m)}"
            shape, values = _region(where, region)
            values["label"] = found.label(_class(region, "class name"))
            found.add(where, backdrop, shape, **values)
        for m, point in enumerate(points):
            of = {str(key).lower(): value for key, value in point.items()}
            where = f"{backdrop.name}, point {of.get('id', m)}"
            spot = pairs(where, [of.get("x", of.get("coordx")), of.get("y", of.get("coordy"))])
            shape = shape_of(where, "point", [spot])
            label = found.label(_class(of, "class", "class name", "class_name"))
            _, values = _said(of.get("note"), of.get("data"))
            found.add(where, backdrop, shape, label=label, **values)
    return found.values


def _labels(given: Any) -> list[tuple[str, int | None, str]]:
    """Id, AphiaID and colour of the labels of a project: by their ids, or a list."""
    entries = list(given.values()) if isinstance(given, dict) else given or []
    if not isinstance(entries, list) or not all(isinstance(one, dict) for one in entries):
        raise WorkspaceError("no TagLab project: 'labels' is no list of objects")
    labels = []
    for one in entries:
        name = one.get("id") or one.get("name")
        if not isinstance(name, str) or not name:
            raise WorkspaceError("a label of the TagLab project has neither an id nor a name")
        fill, about = one.get("fill"), one.get("description")
        colour = ""
        if (
            isinstance(fill, list)
            and len(fill) >= 3
            and all(isinstance(v, int) and 0 <= v < 256 for v in fill[:3])
        ):
            colour = "#" + "".join(f"{v:02x}" for v in fill[:3])
        digits = about.removeprefix(_APHIA) if isinstance(about, str) else ""
        aphia = int(digits) if digits.isascii() and digits.isdigit() and int(digits) else None
        if name != _EMPTY:
            labels.append((name, aphia, colour))
    return labels


def _marks(image: Mapping[str, Any], n: int) -> tuple[list[Any], list[Any]]:
    """Regions and points of a picture; older projects have a list of regions alone."""
    marks = image.get("annotations") or {}
    both = (marks, []) if isinstance(marks, list) else (
        (marks.get("regions") or [], marks.get("points") or []) if isinstance(marks, dict)
        else (None, None)
    )  # fmt: skip
    for part in both:
        if not isinstance(part, list) or not all(isinstance(one, dict) for one in part):
            raise WorkspaceError(f"image {n}: its annotations are not lists of objects")
    regions, points = both
    return list(regions or ()), list(points or ())


def _backdrop(image: Mapping[str, Any], n: int, backdrops: Backdrops) -> Backdrop:
    channels = image.get("channels")
    listed = channels if isinstance(channels, list) else []
    files = [one.get("filename") for one in listed if isinstance(one, dict)]
    names = [one for one in (*files, image.get("name"), image.get("id")) if isinstance(one, str)]
    if not names:
        raise WorkspaceError(f"image {n}: neither a file of a channel, nor a name")
    fault: WorkspaceError | None = None
    for name in names:
        try:
            backdrop = backdrops.named(name)
        except WorkspaceError as error:
            fault = fault or error
            continue
        check_size(f"image {name}", backdrop, image.get("width"), image.get("height"))
        return backdrop
    raise fault or WorkspaceError(f"image {n}: no picture")


def _region(where: str, region: Mapping[str, Any]) -> tuple[DrawnShape, dict[str, Any]]:
    holes = region.get("inner contours") or []
    if not isinstance(holes, list):
        raise WorkspaceError(f"{where}: its inner contours are no list")
    rings = [_ring(where, ring) for ring in (region.get("contour"), *holes)]
    corner = [[(x + _MIDDLE, y + _MIDDLE) for x, y in ring] for ring in rings]
    hint, values = _said(region.get("note"), region.get("data"))
    return with_hint(shape_of(where, "polygon", corner), hint), values


def _ring(where: str, given: Any) -> list[Place]:
    """Points of a contour, as a list of pairs or as TagLab's text of ways in tenths of a pixel."""
    if not isinstance(given, str):
        return pairs(where, given)
    try:
        steps = [int(word) for word in given.split()]
    except ValueError:
        raise WorkspaceError(f"{where}: its contour is no text of whole numbers") from None
    ways = np.array(pairs(where, steps))
    return pairs(where, np.cumsum(ways, axis=0) / _TENTHS)


def _said(note: Any, data: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """What we wrote of a region beyond TagLab's words, and the values of its annotation."""
    plain = (str, int, float, bool, type(None))
    attributes = dict(data) if isinstance(data, dict) else {}
    hint: Any = None
    with contextlib.suppress(ValueError, TypeError):
        hint = json.loads(attributes.pop(OURS, "null"))
    own = hint if isinstance(hint, dict) else {}
    texts = {k: own[k] for k in ("id", "author", "time_utc") if isinstance(own.get(k), str)}
    return own, texts | {
        "note": note if isinstance(note, str) else "",
        "attributes": {str(k): v for k, v in attributes.items() if isinstance(v, plain)},
    }


def _class(of: Mapping[str, Any], *keys: str) -> str:
    for key in keys:
        if isinstance(of.get(key), str) and of[key]:
            return str(of[key])
    return _EMPTY


def write_taglab(values: AnnotationSet, backdrops: Backdrops) -> ToolFiles:
    """A TagLab project of annotations; lines are left out."""
    drawn, left_out = placed(values, backdrops, {"polyline": "TagLab has no lines"}, has_holes=True)
    images: dict[str, dict[str, Any]] = {}
    for n, (one, backdrop, shape) in enumerate(drawn):
        image = images.setdefault(backdrop.name, _image(backdrop))
        ours = {"id": one.id, "author": one.author, "time_utc": one.time_utc, **hint_of(shape)}
        data = {**one.attributes, OURS: json.dumps(ours)}
        if shape.kind == "point":
            (x, y), marks = shape.points[0], image["annotations"]["points"]
            marks.append({"X": x, "Y": y, "Class": one.label, "Id": n, "Note": one.note,
                          "Data": data})  # fmt: skip
        else:
            region = _outlined(shape) | {
                "class name": one.label, "instance name": f"coral{n}", "blob name": f"c-{n}",
                "id": n, "note": one.note, "data": data,
            }  # fmt: skip
            image["annotations"]["regions"].append(region)
    whole: dict[str, Any] = {
        "filename": "",
        "labels": {label.id: _label(label) for label in values.labels},
        "images": list(images.values()),
        "correspondences": {},
        "spatial_reference_system": None,
        "metadata": {},
        "image_metadata_template": {},
    }
    text = json.dumps(whole, allow_nan=False, indent=1) + "\n"
    return ToolFiles(texts={"": text}, written=len(drawn), left_out=left_out)


def _image(backdrop: Backdrop) -> dict[str, Any]:
    factor = 1.0 if backdrop.plane is None else 1e3 * backdrop.plane.scale
    return {
        "rect": [0.0, 0.0, 0.0, 0.0], "map_px_to_mm_factor": f"{factor:.9g}",
        "width": backdrop.width_px, "height": backdrop.height_px,
        "annotations": {"regions": [], "points": []}, "layers": [],
        "channels": [{"filename": backdrop.name, "type": "RGB"}],
        "id": backdrop.name, "name": backdrop.name, "workspace": [], "export_dataset_area": [],
        "georef_filename": "", "metadata": {},
    }  # fmt: skip


def _outlined(shape: DrawnShape) -> dict[str, Any]:
    outer, *holes = ([(x - _MIDDLE, y - _MIDDLE) for x, y in ring] for ring in shape.rings)
    left, top, right, bottom = shape.geometry.bounds
    middle = shape.geometry.centroid
    return {
        "bbox": [int(np.floor(top)), int(np.floor(left)),
                 int(np.ceil(right) - np.floor(left)), int(np.ceil(bottom) - np.floor(top))],
        "centroid": [middle.x - _MIDDLE, middle.y - _MIDDLE],
        "area": shape.area,
        "perimeter": float(shape.geometry.length),
        "contour": _lists(outer),
        "inner contours": [_lists(ring) for ring in holes],
    }  # fmt: skip


def _lists(ring: list[Place]) -> list[list[float]]:
    return [[x, y] for x, y in ring]


def _label(label: Label) -> dict[str, Any]:
    about = "" if label.aphia_id is None else f"{_APHIA}{label.aphia_id}"
    fill = [int(label.colour[n : n + 2], 16) for n in (1, 3, 5)]
    return {"id": label.id, "name": label.id, "description": about, "fill": fill,
            "border": list(_BORDER), "visible": True}  # fmt: skip


TAGLAB = Format(
    name="taglab", title="TagLab project", suffix=".json", read=read_taglab, write=write_taglab
)
