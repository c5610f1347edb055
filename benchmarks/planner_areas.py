"""Areas to plan: a quad, two L-shapes, a star, a coast, harbours; each some rows wide."""

import math

import numpy as np
import shapely
import shapely.affinity
from shapely.geometry import MultiPoint, MultiPolygon, Point, Polygon, box
from shapely.geometry.base import BaseGeometry

from alice_survey.core.frames import Array, Datum
from missions.values.area import Area, multipolygon

_COAST_SEED = 5
_COAST_CORNERS = 500
_PILE = 0.006
"""Radius of a pile: 0.6 m in a harbour 100 m wide."""


def shapes() -> dict[str, Polygon]:
    """By name; x = north is one unit wide, and rows follow y = east."""
    ell = Polygon([(0, 0), (1, 0), (1, 0.5), (0.5, 0.5), (0.5, 1), (0, 1)])
    holes = Polygon([(0.1, 0.12), (0.3, 0.1), (0.33, 0.3), (0.12, 0.28)]), box(0.6, 0.15, 0.8, 0.32)
    angles = np.arange(10) * math.pi / 5
    radii = np.where(np.arange(10) % 2, 0.45, 1.0)
    named = {
        "quad": Polygon([(0, 0.1), (0.9, 0), (1, 0.8), (0.15, 1)]),
        "L": ell,
        "L, two holes": ell.difference(shapely.union_all(holes)),
        "star": Polygon(np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=1)),
        f"coast, {_COAST_CORNERS} corners": _coast(),
        "harbour, 28 piles": harbour(4, 7),
        "harbour, 56 piles": harbour(7, 8),
        "marina, 44 piles": marina(4, 11),
        "quay, 24 piles": quay(24),
    }
    return {name: _one_wide(_whole(shape)) for name, shape in named.items()}


def marina(jetties: int, piles: int) -> Polygon:
    """A basin into which jetties lead, each on a row of piles.

    Args:
        jetties: side by side, from the same quay.
        piles: under each.
    """
    basin = Polygon([(0, 0), (1, 0.05), (0.95, 0.8), (0.05, 0.75)])
    rows = [
        Point(0.12 + 0.6 * pile / (piles - 1), 0.12 + 0.52 * jetty / (jetties - 1)).buffer(_PILE, 6)
        for jetty in range(jetties)
        for pile in range(piles)
    ]
    return _whole(basin.difference(shapely.union_all(rows)))


def quay(piles: int) -> Polygon:
    """A strip along a wall that stands on piles, two and two.

    Args:
        piles: an even number, askew to the lines.
    """
    strip = shapely.affinity.rotate(box(0, 0, 1, 0.3), 17.0)
    pairs = [
        Point(0.06 + 0.88 * (pile // 2) / (piles // 2 - 1), 0.06 + 0.035 * (pile % 2))
        for pile in range(piles)
    ]
    turned = shapely.affinity.rotate(MultiPoint(pairs), 17.0, origin=(0.5, 0.15))
    return _whole(strip.difference(turned.buffer(_PILE, 6)))


def harbour(rows: int, columns: int) -> Polygon:
    """A basin with a pier, and a field of round piles on one side of it.

    Args:
        rows: of piles, along the basin.
        columns: of piles.
    """
    basin = Polygon([(0, 0), (1, 0), (1, 0.9), (0, 0.9)])
    pier = Polygon([(0.5, 0.95), (0.5, 0.5), (0.6, 0.5), (0.62, 0.95)])
    piles = [
        Point((column + 0.7) / (columns + 0.3), 0.45 * (row + 0.7) / rows).buffer(_PILE, 6)
        for row in range(rows)
        for column in range(columns)
    ]
    return _whole(basin.difference(pier).difference(shapely.union_all(piles)))


def planned_area(shape: Polygon, rows: int, spacing_m: float, margin_m: float) -> Area:
    """A shape as large as some rows; its holes are no-go zones, a margin is left to turn."""
    size_m = rows * spacing_m
    survey = shapely.affinity.scale(shape, size_m, size_m, origin=(0, 0))
    holes = MultiPolygon([Polygon(ring) for ring in survey.interiors])
    around = survey.buffer(margin_m, join_style="mitre").difference(holes)
    return Area(
        datum=Datum(latitude_deg=32.8, longitude_deg=34.9),
        survey=multipolygon(survey),
        allowed=multipolygon(around),
        no_go=multipolygon(holes),
    )


def _whole(shape: BaseGeometry) -> Polygon:
    """The same shape, which is one polygon."""
    if not isinstance(shape, Polygon):
        raise TypeError(f"{shape.geom_type} where one polygon is needed")
    return shape


def _one_wide(shape: Polygon) -> Polygon:
    north_0, east_0, north_1, _ = shape.bounds
    moved = shapely.affinity.translate(shape, -north_0, -east_0)
    scale = 1.0 / (north_1 - north_0)
    return shapely.affinity.scale(moved, scale, scale, origin=(0, 0))


def _coast() -> Polygon:
    """A closed coast by midpoint displacement (B. Mandelbrot 1982), the first that is simple."""
    for attempt in range(1000):
        rng = np.random.default_rng([_COAST_SEED, attempt])
        angles = np.arange(8) * math.pi / 4
        ring: Array = np.stack([np.cos(angles), 0.7 * np.sin(angles)], axis=1)
        while len(ring) < _COAST_CORNERS:
            sides = np.roll(ring, -1, axis=0) - ring
            normals = sides[:, ::-1] * np.array([1.0, -1.0])
            middles = ring + sides / 2 + normals * rng.normal(0, 0.13, (len(ring), 1))
            ring = np.stack([ring, middles], axis=1).reshape(-1, 2)
        kept = np.sort(rng.choice(len(ring), _COAST_CORNERS, replace=False))
        coast = Polygon(ring[kept])
        if coast.is_valid:
            return coast
    raise RuntimeError("no coast of these is simple")
