"""Annotations for tests, and the backdrops they lie on."""

import math

import numpy as np
from hypothesis import strategies as st
from shapely.geometry import Polygon

from reconstruct.annotations.backdrops import Backdrop, Backdrops
from reconstruct.annotations.values import (
    Affine,
    Annotation,
    AnnotationSet,
    DrawnShape,
    Label,
    with_labels,
)

PIXEL = 0.0027
WEST, NORTH = -3.1, 47.25
WIDE, HIGH = 1020, 1035
TAKEN = (564, 451)
KINDS = ("point", "polyline", "polygon", "rectangle", "circle")
LABELS = with_labels((), [
    Label(id="Porites", aphia_id=206987, colour="#0072b2"),
    Label(id="Cnidaria > Porites", colour="#e69f00"),
    Label(id="none > Porites", colour="#009e73"),
    Label(id="sand, coarse", colour="#999999"),
])  # fmt: skip


def backdrop(
    name: str = "mosaic.tif", column: int = 0, row: int = 0, side: int | None = None
) -> Backdrop:
    place = (WEST + column * PIXEL, NORTH - row * PIXEL)
    return Backdrop(
        name=name, width_px=side or WIDE, height_px=side or HIGH,
        plane=Affine(scale=PIXEL, flipped=True, shift=place),
    )  # fmt: skip


BACKDROPS = Backdrops([backdrop()], {"left/000.png": TAKEN, "right/000.png": TAKEN})
TILES = Backdrops(
    [
        backdrop(f"tile_{r:03d}_{c:03d}.png", 384 * c, 384 * r, 512)
        for r in range(3)
        for c in range(3)
    ],
    {"left/000.png": TAKEN},
)


def number(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False, allow_infinity=False)


@st.composite
def pixel_shapes(
    draw: st.DrawFn, wide: float, high: float, kinds: tuple[str, ...] = KINDS, min_holes: int = 0
) -> DrawnShape:
    """Any shape within a picture: its vertices by angle and distance from a middle."""
    kind = draw(st.sampled_from(kinds))
    radius = draw(number(4.0, min(wide, high) / 2.5))
    x, y = draw(number(radius, wide - radius)), draw(number(radius, high - radius))
    if kind == "point":
        return DrawnShape(kind="point", points=((x, y),))
    if kind == "circle":
        return DrawnShape(kind="circle", points=((x, y),), radius=radius)
    if kind == "rectangle":
        turn = draw(number(0.0, math.tau))
        return DrawnShape(kind="rectangle", points=_star(x, y, [radius] * 4, turn))
    count = draw(st.integers(3, 12))
    away = [radius * draw(number(0.6, 1.0)) for _ in range(count)]
    turn = draw(number(0.0, math.tau))
    if kind == "polyline":
        return DrawnShape(kind="polyline", points=_star(x, y, away, turn))
    outer = _star(x, y, away, turn)
    within = Polygon(outer).buffer(-0.05 * radius)
    holes = []
    for n in range(draw(st.integers(min_holes, 3))):
        around = 0.28 * radius
        spot = (x + around * math.cos(turn + 2.1 * n), y + around * math.sin(turn + 2.1 * n))
        sides = draw(st.integers(3, 6))
        hole_away = [radius * draw(number(0.05, 0.15)) for _ in range(sides)]
        hole = _star(*spot, hole_away, draw(number(0.0, math.tau)))
        if within.covers(Polygon(hole)):
            holes.append(hole)
    return DrawnShape(kind="polygon", points=outer, holes=tuple(holes))


def _star(x: float, y: float, away: list[float], turn: float) -> tuple[tuple[float, float], ...]:
    turns = [turn + math.tau * n / len(away) for n in range(len(away))]
    return tuple(
        (x + r * math.cos(t), y + r * math.sin(t)) for r, t in zip(away, turns, strict=True)
    )


words = st.text(st.characters(codec="utf-8", exclude_categories=("C", "Z")), min_size=1, max_size=9)
values = st.one_of(words, st.booleans(), st.none(), number(-9, 9), st.integers(-9, 9))


@st.composite
def marks(draw: st.DrawFn) -> Annotation:
    image = draw(st.sampled_from([None, "left/000.png"]))
    wide, high = TAKEN if image else (WIDE, HIGH)
    shape = draw(pixel_shapes(wide, high))
    return Annotation(
        label=draw(st.sampled_from(LABELS)).id,
        shape=shape if image else backdrop().from_pixels(shape),
        image=image,
        author=draw(st.sampled_from(["", "Ada", "Ada Love Lace"])),
        time_utc=draw(st.sampled_from(["", "2026-11-27T05:01:16Z", "last summer"])),
        note=draw(st.one_of(st.just(""), words)),
        attributes=draw(st.dictionaries(words, values, max_size=2)),
    )


sets = st.lists(marks(), min_size=1, max_size=4).map(
    lambda some: AnnotationSet(labels=LABELS, annotations=tuple(some))
)


def places_px(one: Annotation) -> list[np.ndarray]:
    """Its rings in pixels of the picture or the mosaic."""
    shape = one.shape if one.image is not None else backdrop().to_pixels(one.shape)
    return [np.array(ring) for ring in (shape.points, *shape.holes)]


def miss_px(a: Annotation, b: Annotation) -> float:
    """Largest distance of vertices; holes in whatever order and from whatever start."""
    first, second = places_px(a), places_px(b)
    assert [len(first[0]), len(first)] == [len(second[0]), len(second)]
    worst = float(np.abs(first[0] - second[0]).max())
    left = second[1:]
    for ring in first[1:]:
        near = min(left, key=lambda other: np.abs(other.mean(0) - ring.mean(0)).max())
        assert len(near) == len(ring)
        turned = [np.roll(near, n, axis=0) for n in range(len(near))]
        worst = max(worst, min(float(np.abs(t - ring).max()) for t in turned))
    if a.shape.radius is not None and b.shape.radius is not None:
        scale = 1.0 if a.image is not None else PIXEL
        worst = max(worst, abs(a.shape.radius - b.shape.radius) / scale)
    return worst
