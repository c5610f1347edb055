"""Reports of BIIGLE: image annotations as CSV, and label trees as CSV.

Shapes are named, their points a JSON list x, y, x, y; a circle adds its radius; a rectangle has
four corners; an ellipse the ends of its two axes. Pixels count from the outer corner of the first.
"""

import csv
import io
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from alice_survey.core.contents import shown
from alice_survey.core.errors import WorkspaceError, warn
from reconstruct.annotations.backdrops import Backdrops
from reconstruct.annotations.formats.common import (
    Format,
    Reading,
    ToolFiles,
    check_size,
    one_ring,
    pairs,
    placed,
    polygon_of,
    shape_of,
)
from reconstruct.annotations.values import SEPARATOR, AnnotationSet, DrawnShape, Label, Place

_COLUMNS = (
    "annotation_label_id", "label_id", "label_name", "label_hierarchy", "user_id", "firstname",
    "lastname", "image_id", "filename", "image_longitude", "image_latitude", "shape_id",
    "shape_name", "points", "attributes", "annotation_id", "created_at",
)  # fmt: skip
_TREE = ("id", "name", "parent_id", "color", "source_id")
_SHAPES = {"Point": 1, "LineString": 2, "Polygon": 3, "Circle": 4, "Rectangle": 5}
_NAMES = {"point": "Point", "polyline": "LineString", "polygon": "Polygon", "circle": "Circle",
          "rectangle": "Rectangle"}  # fmt: skip
_ELLIPSE_SIDES = 64


def read_biigle(data: bytes, backdrops: Backdrops) -> AnnotationSet:
    """Annotations of a report, or labels of a label tree.

    Raises:
        WorkspaceError: it is neither, or a row is wrong.
    """
    try:
        reader = csv.DictReader(io.StringIO(data.decode("utf-8-sig"), newline=""), restval="")
        rows = [(reader.line_num, row) for row in reader]
        names = [name.strip() for name in reader.fieldnames or ()]
    except (UnicodeDecodeError, csv.Error) as error:
        raise WorkspaceError(f"no CSV file: {shown(str(error))}") from None
    if "video_filename" in names or "frames" in names:
        raise WorkspaceError("a report of videos: image annotations are read")
    if "shape_name" in names and "points" in names:
        missing = next((n for n in ("filename", "label_name") if n not in names), None)
        if missing is not None:
            raise WorkspaceError(f"column {missing} is missing")
        return _report(rows, backdrops)
    if "name" in names:
        return _tree(rows)
    raise WorkspaceError(
        "neither a report of image annotations (columns filename, label_name, shape_name, points) "
        f"nor a list of labels (column name): it has {shown(', '.join(names))}"
    )


def _report(rows: list[tuple[int, dict[str, str]]], backdrops: Backdrops) -> AnnotationSet:
    found, frames = Reading(), 0
    for line, row in rows:
        where, kind = f"line {line}", row["shape_name"].strip()
        if kind == "WholeFrame":
            frames += 1
            continue
        backdrop = backdrops.named(row["filename"].strip())
        attributes = _object(row.get("attributes"))
        check_size(where, backdrop, attributes.get("width"), attributes.get("height"))
        hierarchy = row.get("label_hierarchy") or row["label_name"]
        name = " ".join(p for p in (row.get("firstname"), row.get("lastname")) if p)
        found.add(
            where, backdrop, _shape(where, kind, row["points"]),
            label=found.label(hierarchy), author=name, time_utc=_time(row.get("created_at") or ""),
        )  # fmt: skip
    if frames:
        warn(f"{frames} labels of whole pictures are passed over")
    return found.values


def _shape(where: str, kind: str, text: str) -> DrawnShape:
    try:
        flat = json.loads(text)
    except ValueError:
        raise WorkspaceError(f"{where}: its points are no list of numbers") from None
    if kind == "Circle":
        if not isinstance(flat, list) or len(flat) != 3:
            raise WorkspaceError(f"{where}: a circle is x, y and radius")
        return shape_of(where, "circle", [pairs(where, flat[:2])], _radius(where, flat[2]))
    points = pairs(where, flat)
    if kind == "Ellipse":
        return shape_of(where, "polygon", [_ellipse(where, points)])
    if kind == "Polygon":
        return polygon_of(where, points)
    names = {name: kind for kind, name in _NAMES.items()}
    if kind not in names:
        raise WorkspaceError(f"{where}: shape {shown(kind)!r} is none of {', '.join(_SHAPES)}")
    return shape_of(where, names[kind], [points])


def _radius(where: str, value: Any) -> float:
    if not isinstance(value, (int, float)) or not value > 0:
        raise WorkspaceError(f"{where}: a circle of radius {value!r}")
    return float(value)


def _ellipse(where: str, ends: list[Place]) -> list[Place]:
    """A polygon along an ellipse through the ends of its two axes, in whatever order."""
    if len(ends) != 4:
        raise WorkspaceError(f"{where}: an ellipse of {len(ends)} points; it has 4")
    spots = np.array(ends)
    middle = spots.mean(axis=0)
    opposite = int(np.argmin(np.linalg.norm(spots[0] + spots[1:] - 2 * middle, axis=1))) + 1
    other = next(n for n in (1, 2, 3) if n != opposite)
    turns = 2 * np.pi * np.arange(_ELLIPSE_SIDES) / _ELLIPSE_SIDES
    along = np.cos(turns)[:, None] * (spots[0] - middle)
    across = np.sin(turns)[:, None] * (spots[other] - middle)
    return [(float(x), float(y)) for x, y in middle + along + across]


def _object(text: str | None) -> Mapping[str, Any]:
    try:
        found = json.loads(text or "{}")
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


def _time(text: str) -> str:
    """A time of BIIGLE (UTC) as ISO 8601."""
    plain = len(text) == 19 and text[10] == " "
    return f"{text[:10]}T{text[11:]}Z" if plain else text


def _time_back(text: str) -> str:
    plain = len(text) == 20 and text[10] == "T" and text[-1] == "Z"
    return f"{text[:10]} {text[11:19]}" if plain else text


def _tree(rows: list[tuple[int, dict[str, str]]]) -> AnnotationSet:
    """Labels of a tree, or of any list with a column `name`."""
    of_id = {row.get("id", "").strip(): row for _, row in rows if row.get("id", "").strip()}
    found = Reading()
    for line, row in rows:
        names, at, seen = [row["name"].strip()], row, {row.get("id", "").strip()}
        while (parent := (at.get("parent_id") or "").strip()) and parent != "NULL":
            if parent in seen or parent not in of_id:
                raise WorkspaceError(f"line {line}: parent_id {parent} is no other row of the list")
            seen.add(parent)
            at = of_id[parent]
            names.insert(0, at["name"].strip())
        if not all(names):
            raise WorkspaceError(f"line {line}: a label without a name")
        digits = next(
            (row[c].strip() for c in ("source_id", "aphia_id", "AphiaID") if row.get(c)), ""
        )
        colour = next((row[c].strip().lstrip("#") for c in ("color", "colour") if row.get(c)), "")
        fine = len(colour) == 6 and all(c in "0123456789abcdefABCDEF" for c in colour)
        aphia = int(digits) if digits.isascii() and digits.isdigit() and int(digits) else None
        found.label(SEPARATOR.join(names), aphia, f"#{colour.lower()}" if fine else "")
    return found.values


def write_biigle(values: AnnotationSet, backdrops: Backdrops) -> ToolFiles:
    """A report of annotations, and the label tree ("_labels")."""
    drawn, left_out = placed(values, backdrops, {}, has_holes=False)
    tree = _numbered(values.labels)
    users = {name: n for n, name in enumerate(dict.fromkeys(a.author for a, _, _ in drawn), 1)}
    images = {name: n for n, name in enumerate(dict.fromkeys(s.name for _, s, _ in drawn), 1)}
    rows = []
    for n, (one, backdrop, shape) in enumerate(drawn, 1):
        first, _, last = one.author.partition(" ")
        name = _NAMES[shape.kind]
        size = {"width": backdrop.width_px, "height": backdrop.height_px}
        rows.append((
            n, tree[one.label], one.label.rpartition(SEPARATOR)[2], one.label, users[one.author],
            first, last, images[backdrop.name], backdrop.name, "", "", _SHAPES[name], name,
            json.dumps(_flat(shape)), json.dumps(size), n, _time_back(one.time_utc),
        ))  # fmt: skip
    labels = []
    by_id = values.by_label
    for branch, number in tree.items():
        label = by_id.get(branch)
        parent, _, name = branch.rpartition(SEPARATOR)
        labels.append((
            number, name, tree.get(parent, ""),
            "" if label is None else label.colour.lstrip("#"),
            "" if label is None or label.aphia_id is None else label.aphia_id,
        ))  # fmt: skip
    texts = {"": _csv(_COLUMNS, rows), "_labels": _csv(_TREE, labels)}
    return ToolFiles(texts=texts, written=len(drawn), left_out=left_out)


def _numbered(labels: tuple[Label, ...]) -> dict[str, int]:
    """Numbers of labels and of all above them."""
    found: dict[str, int] = {}
    for label in labels:
        names = label.id.split(SEPARATOR)
        for count in range(1, len(names) + 1):
            found.setdefault(SEPARATOR.join(names[:count]), len(found) + 1)
    return found


def _flat(shape: DrawnShape) -> list[float]:
    if shape.kind == "circle" and shape.radius is not None:
        return [*shape.points[0], shape.radius]
    ring = shape.points
    if shape.kind == "polygon":
        ring = one_ring(shape) or shape.points
        ring = (*ring, ring[0])
    return [value for place in ring for value in place]


def _csv(header: tuple[str, ...], rows: list[tuple[Any, ...]]) -> str:
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue()


BIIGLE = Format(
    name="biigle", title="BIIGLE report", suffix=".csv", read=read_biigle, write=write_biigle
)
