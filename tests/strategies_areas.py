"""Random areas: stars with holes, and blocks of cells whose edges lie on one line."""

import math
from typing import Any

import numpy as np
import shapely
from hypothesis import strategies as st
from shapely.geometry import MultiPolygon, Point, Polygon, box
from shapely.geometry.base import BaseGeometry

from missions.values.area import multipolygon


@st.composite
def stars(draw: Any) -> MultiPolygon:
    """A star-like polygon 12 to 24 m across less some boxes; of one or more parts."""
    reaches = draw(st.lists(st.floats(3.0, 12.0), min_size=5, max_size=9))
    angles = np.linspace(0, 2 * math.pi, len(reaches), endpoint=False)
    corners = np.array(reaches)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    area: BaseGeometry = Polygon(corners)
    for _ in range(draw(st.integers(0, 3))):
        north, east = draw(st.floats(-6, 6)), draw(st.floats(-6, 6))
        size = draw(st.floats(0.5, 3.0))
        area = area.difference(Point(north, east).buffer(size, quad_segs=draw(st.integers(1, 3))))
    return _without_pinches(area)


@st.composite
def blocks(draw: Any) -> MultiPolygon:
    """Cells of 2 m of a 5 x 5 board: right angles, holes, and edges that lie on one line."""
    filled = draw(st.lists(st.booleans(), min_size=25, max_size=25))
    filled[12] = True
    cells = [
        box(2 * (i // 5), 2 * (i % 5), 2 * (i // 5) + 2, 2 * (i % 5) + 2)
        for i, yes in enumerate(filled)
        if yes
    ]
    return _without_pinches(shapely.union_all(cells))


def areas() -> st.SearchStrategy[MultiPolygon]:
    """Either."""
    return stars() | blocks()


def _without_pinches(area: BaseGeometry) -> MultiPolygon:
    """The area less its passages narrower than a few mm, which shapely lets a path through."""
    return multipolygon(area.buffer(-0.005, join_style="mitre").buffer(0.002, join_style="mitre"))


def places_in(area: MultiPolygon, rng: np.random.Generator, count: int) -> np.ndarray:
    """Places (count, 2) inside, some of them corners and on edges."""
    low_n, low_e, high_n, high_e = area.bounds
    found: list[tuple[float, float]] = []
    corners = shapely.get_coordinates(area)
    while len(found) < count:
        kind = rng.integers(4)
        if kind == 0:
            found.append(tuple(corners[rng.integers(len(corners))].tolist()))
        elif kind == 1:
            i = rng.integers(len(corners) - 1)
            middle = (corners[i] + corners[i + 1]) / 2
            if area.distance(Point(middle)) < 1e-9:
                found.append(tuple(middle.tolist()))
        else:
            place = rng.uniform((low_n, low_e), (high_n, high_e))
            if area.covers(Point(place)):
                found.append(tuple(place.tolist()))
    return np.array(found)
