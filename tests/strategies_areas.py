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
    corners = shapely.get_coordinates(area)
    middles = (corners[1:] + corners[:-1]) / 2
    middles = middles[shapely.distance(area, shapely.points(middles)) < 1e-9]
    anywhere = rng.uniform(area.bounds[:2], area.bounds[2:], (100 * count, 2))
    within = anywhere[shapely.covers(area, shapely.points(anywhere))]
    found = [*rng.choice(corners, count), *rng.choice(middles, count), *within[: 2 * count]]
    assert len(found) == 4 * count
    return rng.permutation(found)[:count]
