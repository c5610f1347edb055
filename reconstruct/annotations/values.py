"""Annotations as values: a label, a shape, and where it lies."""

import itertools
import math
import secrets
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Literal

import numpy as np
import shapely
from pydantic import (
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
)
from shapely.geometry import MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry

from alice_survey.core.config import Config
from alice_survey.core.frames import Array

Kind = Literal["point", "polyline", "polygon", "rectangle", "circle"]
Coordinate = Annotated[float, Field(ge=-1e9, le=1e9)]
Place = tuple[Coordinate, Coordinate]
Value = str | float | int | bool | None
Name = Annotated[str, Field(min_length=1, max_length=500)]
Text = Annotated[str, Field(max_length=10_000)]

SEPARATOR = " > "
"""Between the names of a label and those above it in a tree."""
COLOURS = (
    "#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#f0e442", "#999999",
)  # fmt: skip
"""Colours that the colour-blind tell apart (Okabe and Ito 2008)."""
MAX_VERTICES = 100_000
_LEAST = {"point": 1, "polyline": 2, "polygon": 3, "rectangle": 4, "circle": 1}
_MOST = {"point": 1, "polyline": MAX_VERTICES, "polygon": MAX_VERTICES, "rectangle": 4,
         "circle": 1}  # fmt: skip
_CIRCLE_SIDES = 128
_SAME = 1e-3
"""Pixels within which vertices are the same."""


class Label(Config):
    """What an annotation is of: a species, a substrate, a damage."""

    id: Name
    """Names from the root of its tree to itself; unique in a list."""
    aphia_id: int | None = Field(None, ge=1)
    """Of the World Register of Marine Species."""
    colour: str = Field(COLOURS[0], pattern=r"^#[0-9a-fA-F]{6}$")
    code: str = Field("", max_length=3)
    """One to three letters that tell it from others without colour."""

    @field_validator("id")
    @classmethod
    def _has_names(cls, label: str) -> str:
        if label != clean_id(label):
            raise ValueError("names of a label are not empty, and have no blanks at their ends")
        return label

    @property
    def name(self) -> str:
        """Its own name."""
        return self.id.rpartition(SEPARATOR)[2]

    @property
    def parent(self) -> str:
        """The id of the label above it in a tree; empty at the root."""
        return self.id.rpartition(SEPARATOR)[0]


def clean_id(text: str) -> str:
    """The id of a label from what a file calls it; empty where that is nothing."""
    plain = "".join(c if c.isprintable() else " " for c in text)
    return SEPARATOR.join(name for part in plain.split(SEPARATOR) if (name := part.strip()))


class DrawnShape(Config):
    """Vertices in the plane of the mosaic, or in a picture as taken.

    Pixels count from the outer corner of the first, x to the right and y down.
    """

    kind: Kind
    points: tuple[Place, ...]
    """East and north, or x and y: the place, the line, the outer ring (its first vertex not
    repeated), the four corners in order, the middle of the circle."""
    holes: tuple[tuple[Place, ...], ...] = ()
    """Rings of a polygon within which it is not; they turn the other way round than the outer."""
    radius: float | None = Field(None, gt=0, le=1e9)
    """Of a circle."""

    @field_validator("holes")
    @classmethod
    def _turned(
        cls, holes: tuple[tuple[Place, ...], ...], info: ValidationInfo
    ) -> tuple[tuple[Place, ...], ...]:
        sense = signed_area(info.data.get("points", ()))
        return tuple(
            (ring[0], *ring[:0:-1]) if ring and signed_area(ring) * sense > 0 else ring
            for ring in holes
        )

    @model_validator(mode="after")
    def _is_whole(self) -> "DrawnShape":
        count, minimum, maximum = len(self.points), _LEAST[self.kind], _MOST[self.kind]
        if not minimum <= count <= maximum:
            wanted = (
                f"{minimum}" if minimum == maximum else f"{minimum} or more, at most {maximum},"
            )
            raise ValueError(f"a {self.kind} of {count} points; it has {wanted}")
        if self.holes and self.kind != "polygon":
            raise ValueError(f"a {self.kind} with holes: only a polygon has them")
        if any(len(ring) < 3 for ring in self.holes):
            raise ValueError("a hole of fewer than 3 points")
        if (self.radius is None) != (self.kind != "circle"):
            raise ValueError("a circle has a radius, and other shapes have none")
        return self

    @property
    def is_area(self) -> bool:
        """Whether it encloses one."""
        return self.kind in ("polygon", "rectangle", "circle")

    @property
    def rings(self) -> tuple[tuple[Place, ...], ...]:
        """Its vertices, ring by ring; a circle's as a polygon of many sides."""
        if self.kind != "circle" or self.radius is None:
            return (self.points, *self.holes)
        (x, y), radius = self.points[0], self.radius
        turns = [math.tau * n / _CIRCLE_SIDES for n in range(_CIRCLE_SIDES)]
        return (
            tuple((x + radius * math.cos(turn), y + radius * math.sin(turn)) for turn in turns),
        )

    @property
    def geometry(self) -> BaseGeometry:
        """As shapely has it; a ring that crosses itself is made valid by the even-odd rule."""
        if self.kind == "point":
            return shapely.Point(self.points[0])
        if self.kind == "polyline":
            return shapely.LineString(self.points)
        if self.kind == "circle" and self.radius is not None:
            return shapely.Point(self.points[0]).buffer(self.radius, quad_segs=_CIRCLE_SIDES // 4)
        outer, *holes = self.rings
        return area_only(shapely.make_valid(Polygon(outer, holes)))

    @property
    def area(self) -> float:
        """Enclosed area in squares of its unit; of a circle exactly; 0 of points and lines."""
        if self.kind == "circle" and self.radius is not None:
            return math.pi * self.radius**2
        return float(self.geometry.area) if self.is_area else 0.0

    def moved(self, to: "Affine") -> "DrawnShape":
        """The same shape in other coordinates."""
        return self.with_rings(
            [to.apply(np.array(ring, dtype=np.float64)) for ring in (self.points, *self.holes)],
            None if self.radius is None else self.radius * to.scale,
        )

    def with_rings(self, rings: Sequence[Array], radius: float | None = None) -> "DrawnShape":
        """The same kind of shape through other points.

        Args:
            rings: (N, 2) points, then holes.
            radius: of a circle.
        """
        outer, *holes = ([(float(x), float(y)) for x, y in ring] for ring in rings)
        return DrawnShape(
            kind=self.kind, points=tuple(outer), holes=tuple(tuple(h) for h in holes), radius=radius
        )


def signed_area(ring: Sequence[Place]) -> float:
    """Area within a ring, positive where it turns from the first axis to the second."""
    if len(ring) < 3:
        return 0.0
    x, y = (np.array(ring) - ring[0]).T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def area_only(geometry: BaseGeometry) -> BaseGeometry:
    """The polygons of a geometry."""
    parts = shapely.get_parts(geometry).tolist()
    flat = [inner for part in parts for inner in shapely.get_parts(part).tolist()]
    polygons = [part for part in flat if isinstance(part, Polygon)]
    return polygons[0] if len(polygons) == 1 else MultiPolygon(polygons)


class Affine(Config):
    """A change of coordinates: a scale, a flip of the second axis, a shift."""

    scale: float = Field(gt=0)
    flipped: bool
    shift: Place

    def apply(self, points: Array) -> Array:
        """Points (N, 2) in the other coordinates."""
        signs = np.array([1.0, -1.0 if self.flipped else 1.0])
        moved: Array = points * signs * self.scale + np.array(self.shift)
        return moved

    @property
    def inverse(self) -> "Affine":
        """The way back."""
        sign = -1.0 if self.flipped else 1.0
        x, y = self.shift
        return Affine(
            scale=1.0 / self.scale, flipped=self.flipped,
            shift=(-x / self.scale, -sign * y / self.scale),
        )  # fmt: skip


class Annotation(Config):
    """One thing that somebody marked."""

    id: str = Field(default_factory=lambda: secrets.token_hex(6), pattern=r"^[0-9a-zA-Z_-]{1,64}$")
    label: Name
    """The id of its label."""
    shape: DrawnShape
    image: str | None = None
    """Name of the picture, as in the manifest; None in the plane of the mosaic."""
    author: str = Field("", max_length=200)
    time_utc: str = Field("", max_length=40)
    """When it was made, ISO 8601."""
    note: Text = ""
    attributes: Mapping[str, Value] = Field(default_factory=dict)


class _Known:
    """Annotations by what they mark, to find one again that marks the same."""

    def __init__(self, pixel: float) -> None:
        """Take the length in which places on the mosaic are taken for different."""
        self._pixel = pixel
        self._at: dict[tuple[object, ...], list[Annotation]] = {}

    def add(self, one: Annotation) -> bool:
        """Note an annotation; False where one that marks the same was there already."""
        step = _SAME * (1.0 if one.image is not None else self._pixel)
        shape = one.shape
        kind = (one.label, one.image, shape.kind, len(shape.points), len(shape.holes))
        x, y = (np.mean(shape.points, axis=0) / step).tolist()
        column, row = math.floor(x), math.floor(y)
        for right, down in itertools.product((-1, 0, 1), repeat=2):
            for other in self._at.get((*kind, column + right, row + down), ()):
                if _is_same(shape, other.shape, step):
                    return False
        self._at.setdefault((*kind, column, row), []).append(one)
        return True


def _is_same(a: DrawnShape, b: DrawnShape, step: float) -> bool:
    """Whether vertices and radius of two shapes differ by less than a step, and holes by none."""
    far = np.abs(np.array(a.points) - np.array(b.points)).max()
    around = abs((a.radius or 0.0) - (b.radius or 0.0))
    holes = abs(sum(map(signed_area, a.holes)) - sum(map(signed_area, b.holes)))
    reach = float(np.ptp(np.array(a.points), axis=0).max())
    return bool(far < step and around < step and holes <= 4.0 * step * reach)


class AnnotationSet(Config):
    """Labels and what carries them."""

    labels: tuple[Label, ...] = ()
    annotations: tuple[Annotation, ...] = ()

    @model_validator(mode="after")
    def _is_whole(self) -> "AnnotationSet":
        ids = [label.id for label in self.labels]
        if len(ids) != len(set(ids)):
            raise ValueError(f"the label {_first_double(ids)!r} stands twice in the list")
        marks = [one.id for one in self.annotations]
        if len(marks) != len(set(marks)):
            raise ValueError(f"the annotation {_first_double(marks)!r} is there twice")
        missing = next((one.label for one in self.annotations if one.label not in set(ids)), None)
        if missing is not None:
            raise ValueError(f"an annotation of {missing!r}, which is no label of the list")
        return self

    @property
    def by_label(self) -> dict[str, Label]:
        """Labels by their ids."""
        return {label.id: label for label in self.labels}

    def with_more(self, other: "AnnotationSet", pixel: float) -> tuple["AnnotationSet", int]:
        """These and those of another set, without what is there already.

        Args:
            other: what to add; its labels that are not in the list come after those that are.
            pixel: length in which places on the mosaic are taken for different.

        Returns:
            All, and how many of the other set were already there.
        """
        known = _Known(pixel)
        for one in self.annotations:
            known.add(one)
        ids = {one.id for one in self.annotations}
        new: list[Annotation] = []
        for one in filter(known.add, other.annotations):
            own = one if one.id not in ids else one.model_copy(update={"id": secrets.token_hex(6)})
            ids.add(own.id)
            new.append(own)
        labels = with_labels(self.labels, other.labels)
        both = AnnotationSet(labels=labels, annotations=(*self.annotations, *new))
        return both, len(other.annotations) - len(new)


def with_labels(labels: Sequence[Label], more: Iterable[Label]) -> tuple[Label, ...]:
    """A list with further labels, each of its own code; known ones stay as they are."""
    found = {label.id: label for label in labels}
    codes = {label.code for label in labels}
    for label in more:
        if label.id in found:
            continue
        if not label.code or label.code in codes:
            label = label.model_copy(update={"code": _free_code(label.name, codes)})
        codes.add(label.code)
        found[label.id] = label
    return tuple(found.values())


def new_label(label_id: str, number: int, aphia_id: int | None = None, colour: str = "") -> Label:
    """A label with the colour of its number unless it has one."""
    chosen = colour or COLOURS[number % len(COLOURS)]
    return Label(id=label_id, aphia_id=aphia_id, colour=chosen)


def _free_code(name: str, taken: set[str]) -> str:
    """Letters of a name that no other label has."""
    letters = [c.upper() for c in name if c.isalnum()] or ["X"]
    initials = "".join(word[0].upper() for word in name.split() if word[0].isalnum())
    tries = [letters[0], initials[:2], *(letters[0] + c for c in letters[1:])]
    tries += [f"{letters[0]}{n}" for n in range(1, 100)]
    tries += [f"{n}" for n in range(1000)]
    return next((code for code in tries if code and len(code) <= 3 and code not in taken), "")


def _first_double(names: Sequence[str]) -> str:
    seen: set[str] = set()
    for name in names:
        if name in seen:
            return name
        seen.add(name)
    return ""
