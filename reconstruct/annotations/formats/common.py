"""What all formats of annotation tools need: checks, labels, and shapes that a tool lacks."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydantic import ValidationError

from alice_survey.core.contents import first_fault, shown
from alice_survey.core.errors import WorkspaceError
from reconstruct.annotations.backdrops import Backdrop, Backdrops
from reconstruct.annotations.keyhole import joined, parted
from reconstruct.annotations.values import (
    Annotation,
    AnnotationSet,
    DrawnShape,
    Label,
    Place,
    clean_id,
    new_label,
    with_labels,
)

OURS = "alice_survey"
"""Key of what a format has no word for; other programs pass over it."""
NAMELESS = "unnamed"
"""Label of what a file gives an empty one."""
_SAME_PX = 1e-6


@dataclass(frozen=True, kw_only=True)
class ToolFiles:
    """What a format writes."""

    texts: Mapping[str, str]
    """Contents by what comes after the name of the file, such as "" and "_labels"."""
    written: int
    """Annotations."""
    left_out: tuple[str, ...] = ()
    """Why others are not in it, one line each."""


@dataclass(frozen=True, kw_only=True)
class Format:
    """The files of one tool."""

    name: str
    title: str
    suffix: str
    read: Callable[[bytes, Backdrops], AnnotationSet]
    write: Callable[[AnnotationSet, Backdrops], ToolFiles]


@dataclass
class Reading:
    """Labels and annotations as they are read."""

    labels: dict[str, Label] = field(default_factory=dict)
    annotations: list[Annotation] = field(default_factory=list)

    def label(self, name: str, aphia_id: int | None = None, colour: str = "") -> str:
        """Note a label as a file calls it, and return its id; the first mention counts."""
        name = clean_id(name) or NAMELESS
        if name not in self.labels:
            self.labels[name] = new_label(name, len(self.labels), aphia_id, colour)
        return name

    def add(self, where: str, backdrop: Backdrop, shape: DrawnShape, **values: Any) -> None:
        """Note an annotation, its shape in pixels of a backdrop.

        Raises:
            WorkspaceError: a value is wrong; the line begins with `where`.
        """
        try:
            self.annotations.append(
                Annotation(shape=backdrop.from_pixels(shape), image=backdrop.image, **values)
            )
        except ValidationError as error:
            raise WorkspaceError(f"{where}: {first_fault(error)}") from None

    @property
    def values(self) -> AnnotationSet:
        """All that was noted."""
        ids: set[str] = set()
        whole = []
        for one in self.annotations:
            if one.id in ids:
                one = Annotation.model_validate(one.model_dump(exclude={"id"}))
            ids.add(one.id)
            whole.append(one)
        return AnnotationSet(labels=with_labels((), self.labels.values()), annotations=tuple(whole))


def read_object(data: bytes, what: str) -> dict[str, Any]:
    """The JSON object in a file.

    Raises:
        WorkspaceError: it is none.
    """
    try:
        found = json.loads(data.decode("utf-8-sig"))
    except (UnicodeDecodeError, ValueError, RecursionError) as error:
        raise WorkspaceError(f"no {what}: not JSON: {shown(str(error))}") from None
    if not isinstance(found, dict):
        raise WorkspaceError(f"no {what}: a list or a value where an object is expected")
    return found


def shape_of(
    where: str, kind: str, rings: Sequence[Sequence[Place]], radius: float | None = None
) -> DrawnShape:
    """A shape of points as they stand in a file; a repeated last vertex is dropped.

    Raises:
        WorkspaceError: it is not one; the line begins with `where`.
    """
    outer, *holes = (_open(ring) if kind in ("polygon", "rectangle") else ring for ring in rings)
    try:
        return DrawnShape.model_validate(
            {"kind": kind, "points": outer, "holes": holes, "radius": radius}
        )
    except ValidationError as error:
        raise WorkspaceError(f"{where}: {first_fault(error)}") from None


def pairs(where: str, flat: Any) -> list[Place]:
    """Points of a list x, y, x, y, or of a list of pairs.

    Raises:
        WorkspaceError: it is neither; the line begins with `where`.
    """
    try:
        array = np.array(flat, dtype=np.float64).reshape(-1)
    except (TypeError, ValueError):
        raise WorkspaceError(f"{where}: its points are no list of numbers") from None
    if array.size == 0 or array.size % 2 or not np.isfinite(array).all():
        raise WorkspaceError(f"{where}: {array.size} numbers, where pairs of x and y are expected")
    return [(float(x), float(y)) for x, y in array.reshape(-1, 2)]


def hint_of(shape: DrawnShape) -> dict[str, Any]:
    """What a polygon alone does not say of a rectangle or a circle."""
    if shape.kind == "circle":
        return {"kind": "circle", "middle": list(shape.points[0]), "radius": shape.radius}
    return {"kind": shape.kind} if shape.kind == "rectangle" else {}


def with_hint(polygon: DrawnShape, hint: Any) -> DrawnShape:
    """The shape that a polygon was written for, where it is still the polygon written for it."""
    if not isinstance(hint, Mapping):
        return polygon
    try:
        if hint.get("kind") == "rectangle":
            return DrawnShape(kind="rectangle", points=polygon.points)
        if hint.get("kind") == "circle":
            shape = DrawnShape.model_validate(
                {"kind": "circle", "points": [hint["middle"]], "radius": hint["radius"]}
            )
            (outline,) = shape.rings
            if len(outline) == len(polygon.points) and np.allclose(
                outline, polygon.points, rtol=0.0, atol=_SAME_PX
            ):
                return shape
    except (ValidationError, KeyError):
        pass
    return polygon


def one_ring(shape: DrawnShape) -> tuple[Place, ...] | None:
    """An area as one ring, its holes by slits; None where no slit reaches a hole."""
    outer, *holes = shape.rings
    return joined(outer, tuple(holes)) if holes else outer


def polygon_of(where: str, ring: Sequence[Place]) -> DrawnShape:
    """The way back."""
    outer, holes = parted(tuple(_open(ring)))
    return shape_of(where, "polygon", [outer, *holes])


def check_size(where: str, backdrop: Backdrop, width: Any, height: Any) -> None:
    """Check that a tool had a picture of this size.

    Raises:
        WorkspaceError: it had another.
    """
    if not isinstance(width, (int, float)) or not isinstance(height, (int, float)):
        return
    if (width, height) != (backdrop.width_px, backdrop.height_px) and width > 0 and height > 0:
        raise WorkspaceError(
            f"{where}: {width:g} x {height:g} pixels, but {backdrop.name} has "
            f"{backdrop.width_px} x {backdrop.height_px}: annotate the picture itself, not a "
            "smaller copy"
        )


def placed(
    values: AnnotationSet, backdrops: Backdrops, lacks: Mapping[str, str], *, has_holes: bool
) -> tuple[list[tuple[Annotation, Backdrop, DrawnShape]], tuple[str, ...]]:
    """Annotations with the backdrops they are drawn on and their shapes there; what is left out.

    Args:
        values: annotations.
        backdrops: pictures.
        lacks: why a kind of shape is not written, by kind.
        has_holes: whether the format has them.
    """
    unseen, cut_off = "no picture shows it", "no straight slit reaches its hole"
    found, why = [], dict.fromkeys([unseen, cut_off, *lacks.values()], 0)
    over = 0
    for one in values.annotations:
        backdrop = backdrops.of(one)
        if one.shape.kind in lacks:
            why[lacks[one.shape.kind]] += 1
        elif backdrop is None:
            why[unseen] += 1
        elif not has_holes and one.shape.holes and one_ring(one.shape) is None:
            why[cut_off] += 1
        else:
            shape = backdrop.to_pixels(one.shape)
            low, high = np.min(shape.points, axis=0), np.max(shape.points, axis=0)
            over += bool((low < 0).any() or (high > [backdrop.width_px, backdrop.height_px]).any())
            found.append((one, backdrop, shape))
    lines = [f"{count} left out: {reason}" for reason, count in why.items() if count]
    if over:
        lines.append(f"{over} reach over the edge of their picture: cut tiles with more overlap")
    return found, tuple(lines)


def _open(ring: Sequence[Place]) -> Sequence[Place]:
    return ring[:-1] if len(ring) > 1 and tuple(ring[0]) == tuple(ring[-1]) else ring
