"""COCO instances: polygons, masks and keypoints of pictures, by category.

A polygon's holes are joined to it by slits (`reconstruct.annotations.keyhole`), since COCO takes
the union of a segmentation's polygons. A point is an annotation with one keypoint. Pixels count
from the outer corner of the first.
"""

import json
from collections.abc import Mapping
from typing import Any

from alice_survey.core.errors import WorkspaceError
from reconstruct.annotations.backdrops import Backdrop, Backdrops
from reconstruct.annotations.formats.common import (
    OURS,
    Format,
    Reading,
    ToolFiles,
    check_size,
    hint_of,
    one_ring,
    pairs,
    placed,
    polygon_of,
    read_object,
    shape_of,
    with_hint,
)
from reconstruct.annotations.formats.rle import decoded, outlines, unpacked
from reconstruct.annotations.values import SEPARATOR, AnnotationSet, DrawnShape, Label

_NO_PARENT = ("", "none", None)


def read_coco(data: bytes, backdrops: Backdrops) -> AnnotationSet:
    """Annotations of a COCO file.

    Raises:
        WorkspaceError: it is none, or a part of it is wrong.
    """
    whole = read_object(data, "COCO file")
    for key in ("images", "annotations", "categories"):
        if not isinstance(whole.get(key), list) or not all(
            isinstance(one, dict) and isinstance(one.get("id", 0), int | str) for one in whole[key]
        ):
            raise WorkspaceError(f"no COCO file: {key!r} is no list of objects with an id")
    found = Reading()
    labels = {one.get("id"): _label(found, one) for one in whole["categories"]}
    images = {one.get("id"): one for one in whole["images"]}
    known: dict[Any, Backdrop] = {}
    for n, one in enumerate(whole["annotations"]):
        where = f"annotation {one.get('id', n)}"
        number, category = one.get("image_id"), one.get("category_id")
        if not isinstance(number, int | str) or number not in images:
            raise WorkspaceError(f"{where}: image_id {number!r} is no image of the file")
        if not isinstance(category, int | str) or category not in labels:
            raise WorkspaceError(f"{where}: category_id {category!r} is no category of the file")
        if number not in known:
            known[number] = _backdrop(images[number], backdrops)
        shapes = _shapes(where, one, known[number])
        for values, shape in zip(_values(one, len(shapes)), shapes, strict=True):
            found.add(where, known[number], shape, label=labels[category], **values)
    return found.values


def _backdrop(image: Mapping[str, Any], backdrops: Backdrops) -> Backdrop:
    name = image.get("file_name")
    if not isinstance(name, str):
        raise WorkspaceError(f"image {image.get('id')}: it has no file_name")
    backdrop = backdrops.named(name)
    check_size(f"image {name}", backdrop, image.get("width"), image.get("height"))
    return backdrop


def _label(found: Reading, category: Mapping[str, Any]) -> str:
    name, parent = category.get("name"), category.get("supercategory")
    if not isinstance(name, str) or not name:
        raise WorkspaceError(f"category {category.get('id')}: it has no name")
    ours = category.get(OURS)
    own = ours if isinstance(ours, dict) else {}
    plain = parent in _NO_PARENT or parent == name
    label = name if plain else f"{parent}{SEPARATOR}{name}"
    own_id = own.get("id")
    if isinstance(own_id, str) and own_id.rpartition(SEPARATOR)[::2] == (parent or "", name):
        label = own_id
    return found.label(label, _number(own.get("aphia_id")), _colour(category.get("color")))


def _number(value: Any) -> int | None:
    return value if isinstance(value, int) and value > 0 else None


def _colour(value: Any) -> str:
    fine = isinstance(value, list) and len(value) == 3
    if not fine or not all(isinstance(v, int) and 0 <= v < 256 for v in value):
        return ""
    return "#" + "".join(f"{v:02x}" for v in value)


def _values(one: Mapping[str, Any], parts: int) -> list[dict[str, Any]]:
    """Author and such of each part of an instance."""
    ours = one.get(OURS)
    own = ours if isinstance(ours, dict) else {}
    given = one.get("attributes")
    plain = (str, int, float, bool, type(None))
    attributes = {
        str(k): v for k, v in (given if isinstance(given, dict) else {}).items()
        if isinstance(v, plain)
    }  # fmt: skip
    if one.get("iscrowd") == 1:
        attributes["iscrowd"] = True
    if isinstance(one.get("score"), (int, float)):
        attributes["score"] = one["score"]
    if parts > 1:
        attributes["instance"] = f"coco {one.get('id', '')}"
    texts = {k: own[k] for k in ("author", "time_utc", "note") if isinstance(own.get(k), str)}
    if parts == 1 and isinstance(own.get("id"), str):
        texts["id"] = own["id"]
    return [{**texts, "attributes": attributes} for _ in range(parts)]


def _shapes(where: str, one: Mapping[str, Any], backdrop: Backdrop) -> list[DrawnShape]:
    segmentation, hint = one.get("segmentation"), (one.get(OURS) or {})
    if isinstance(segmentation, dict):
        return _masked(where, segmentation, backdrop)
    if segmentation:
        if not isinstance(segmentation, list):
            raise WorkspaceError(f"{where}: its segmentation is neither polygons nor a mask")
        parts = segmentation if isinstance(segmentation[0], list) else [segmentation]
        return [with_hint(polygon_of(where, pairs(where, part)), hint) for part in parts]
    keypoints = one.get("keypoints")
    if isinstance(keypoints, list) and keypoints and len(keypoints) % 3 == 0:
        seen = [keypoints[n : n + 2] for n in range(0, len(keypoints), 3) if keypoints[n + 2]]
        return [shape_of(where, "point", [pairs(where, spot)]) for spot in seen]
    box = pairs(where, one.get("bbox") or [])
    if len(box) != 2:
        raise WorkspaceError(f"{where}: its bbox is not x, y, width, height")
    (x, y), (w, h) = box
    return [shape_of(where, "rectangle", [[(x, y), (x + w, y), (x + w, y + h), (x, y + h)]])]


def _masked(where: str, segmentation: Mapping[str, Any], backdrop: Backdrop) -> list[DrawnShape]:
    size, counts = segmentation.get("size"), segmentation.get("counts")
    if size != [backdrop.height_px, backdrop.width_px]:
        raise WorkspaceError(
            f"{where}: a mask of {size}, but {backdrop.name} has {backdrop.height_px} rows and "
            f"{backdrop.width_px} columns"
        )
    try:
        runs = unpacked(counts) if isinstance(counts, str) else [int(n) for n in counts or ()]
        mask = decoded(runs, backdrop.height_px, backdrop.width_px)
    except (TypeError, ValueError, OverflowError):
        raise WorkspaceError(f"{where}: counts of a mask are a list of numbers or text") from None
    except WorkspaceError as error:
        raise WorkspaceError(f"{where}: {error}") from None
    if mask is None:
        raise WorkspaceError(f"{where}: its mask is empty")
    return [shape_of(where, "polygon", [outer, *holes]) for outer, holes in outlines(mask)]


def write_coco(values: AnnotationSet, backdrops: Backdrops) -> ToolFiles:
    """A COCO file of annotations; lines are left out."""
    drawn, left_out = placed(values, backdrops, {"polyline": "COCO has no lines"}, has_holes=False)
    names = list(dict.fromkeys(backdrop.name for _, backdrop, _ in drawn))
    numbers = {name: n for n, name in enumerate(names, 1)}
    sizes = {backdrop.name: backdrop for _, backdrop, _ in drawn}
    with_points = {one.label for one, _, shape in drawn if shape.kind == "point"}
    categories = [
        _category(n, label, label.id in with_points) for n, label in enumerate(values.labels, 1)
    ]
    of_label = {label.id: n for n, label in enumerate(values.labels, 1)}
    annotations = []
    for n, (one, backdrop, shape) in enumerate(drawn, 1):
        annotations.append({
            "id": n, "image_id": numbers[backdrop.name], "category_id": of_label[one.label],
            **_segmented(shape), "iscrowd": 0, "attributes": dict(one.attributes),
            OURS: {
                "id": one.id, "author": one.author, "time_utc": one.time_utc, "note": one.note,
                **hint_of(shape),
            },
        })  # fmt: skip
    whole = {
        "info": {"description": "annotations of alice-survey", "version": "1"},
        "licenses": [],
        "images": [
            {"id": numbers[name], "file_name": name, "width": sizes[name].width_px,
             "height": sizes[name].height_px}
            for name in names
        ],
        "annotations": annotations,
        "categories": categories,
    }  # fmt: skip
    text = json.dumps(whole, allow_nan=False, indent=1) + "\n"
    return ToolFiles(texts={"": text}, written=len(drawn), left_out=left_out)


def _category(number: int, label: Label, has_points: bool) -> dict[str, Any]:
    colour = [int(label.colour[n : n + 2], 16) for n in (1, 3, 5)]
    points = {"keypoints": ["point"], "skeleton": []} if has_points else {}
    ours = {"id": label.id, "aphia_id": label.aphia_id}
    return {"id": number, "name": label.name, "supercategory": label.parent, "color": colour,
            **points, OURS: ours}  # fmt: skip


def _segmented(shape: DrawnShape) -> dict[str, Any]:
    if shape.kind == "point":
        x, y = shape.points[0]
        return {"segmentation": [], "bbox": [x, y, 0.0, 0.0], "area": 0.0,
                "keypoints": [x, y, 2], "num_keypoints": 1}  # fmt: skip
    ring = one_ring(shape) or shape.rings[0]
    left, top, right, bottom = shape.geometry.bounds
    return {
        "segmentation": [[value for place in ring for value in place]],
        "bbox": [left, top, right - left, bottom - top],
        "area": shape.area,
    }


COCO = Format(name="coco", title="COCO", suffix=".json", read=read_coco, write=write_coco)
