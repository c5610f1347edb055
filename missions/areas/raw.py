"""Shapes as they were given: rings, lines and points, not yet checked."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from alice_survey.core.errors import PlanError
from alice_survey.core.frames import Array

_CLOSED = 0.02
"""Gap of a closed line, over its length: drawn by hand, ends seldom meet."""
Ring = Array
"""(N, 2) corners; the first may or may not be repeated as the last."""


def is_closed(line: Array) -> bool:
    """Whether a line (N, 2) goes round something: for its length its ends are near."""
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    gap = float(np.linalg.norm(line[-1] - line[0]))
    return len(line) > 3 and gap <= _CLOSED * float(steps.sum())


@dataclass(frozen=True, kw_only=True, eq=False)
class RawShapes:
    """What one setting or file holds.

    Coordinates are latitude and longitude (degrees, WGS 84) where `geographic`, else north and east
    of the datum (metres).
    """

    origin: str
    """How messages name the source, such as `polygon_ne_m` or `reef.kml`."""
    geographic: bool
    polygons: tuple[tuple[Ring, ...], ...] = ()
    """For each polygon its outer ring, then its holes."""
    lines: tuple[Array, ...] = ()
    """Each (N, 2): what stands for a corridor."""
    points: Array
    """(N, 2) points."""

    @property
    def coordinates(self) -> Array:
        """(N, 2) coordinates of everything."""
        rings = [ring for polygon in self.polygons for ring in polygon]
        return np.concatenate([*rings, *self.lines, self.points])

    @property
    def parts(self) -> int:
        """How many rings, lines and points there are."""
        return sum(map(len, self.polygons)) + len(self.lines) + len(self.points)

    @property
    def is_empty(self) -> bool:
        """Whether there is neither a polygon, a line nor a point."""
        return not (self.polygons or self.lines or len(self.points))

    def change(self, change: Callable[[Array, str], Array], *, geographic: bool) -> "RawShapes":
        """The shapes with other coordinates.

        Args:
            change: takes (N, 2) coordinates and their name, such as `polygon 2, hole 1`.
            geographic: what they are then.
        """
        return replace(
            self,
            geographic=geographic,
            polygons=tuple(
                tuple(change(ring, self.ring_name(i, j)) for j, ring in enumerate(rings))
                for i, rings in enumerate(self.polygons)
            ),
            lines=tuple(change(line, self.line_name(i)) for i, line in enumerate(self.lines)),
            points=change(self.points, "points"),
        )

    def ring_name(self, polygon: int, ring: int) -> str:
        """Such as `polygon 2, hole 1`; empty for the outer ring of the only polygon."""
        names = [f"polygon {polygon + 1}"] if len(self.polygons) > 1 else []
        return ", ".join([*names, *([f"hole {ring}"] if ring else [])])

    def line_name(self, line: int) -> str:
        """Such as `line 2`."""
        return f"line {line + 1}" if len(self.lines) > 1 else "line"


def closed_as_polygons(raw: RawShapes) -> RawShapes:
    """The shapes with lines that close as polygons."""
    rings = [line for line in raw.lines if is_closed(line)]
    lines = tuple(line for line in raw.lines if not is_closed(line))
    return replace(raw, lines=lines, polygons=(*raw.polygons, *((ring,) for ring in rings)))


def no_points() -> Array:
    """(0, 2)."""
    return np.empty((0, 2))


def from_rings(origin: str, rings: Iterable[object], *, geographic: bool) -> RawShapes:
    """Polygons without holes, of lists of corners."""
    polygons = tuple((np.asarray(ring, dtype=np.float64).reshape(-1, 2),) for ring in rings)
    return RawShapes(origin=origin, geographic=geographic, polygons=polygons, points=no_points())


def from_geometries(origin: str, geometries: Iterable[BaseGeometry]) -> RawShapes:
    """Split geometries, collections too, into polygons, lines and points; heights are left out.

    Args:
        origin: their source.
        geometries: valid or not, x = east, y = north.

    Returns:
        Shapes in the geometries' own coordinates, y (north) before x (east).

    Raises:
        PlanError: a geometry of another kind.
    """
    polygons: list[tuple[Ring, ...]] = []
    lines: list[Array] = []
    points: list[Array] = []

    def corners(geometry: BaseGeometry) -> Array:
        return shapely.get_coordinates(geometry)[:, [1, 0]]

    waiting = list(geometries)[::-1]
    while waiting:
        geometry = waiting.pop()
        if geometry is None or geometry.is_empty:
            continue
        if geometry.geom_type == "Polygon":
            rings = [ring for ring in shapely.get_rings(geometry).tolist() if not ring.is_empty]
            polygons.append(tuple(corners(ring) for ring in rings))
        elif geometry.geom_type in ("LineString", "LinearRing"):
            lines.append(corners(geometry))
        elif geometry.geom_type == "Point":
            points.append(corners(geometry))
        elif hasattr(geometry, "geoms"):
            waiting += list(geometry.geoms)[::-1]
        else:
            raise PlanError(f"area: {origin}: a {geometry.geom_type} is not an area")
    return RawShapes(
        origin=origin,
        geographic=False,
        polygons=tuple(polygons),
        lines=tuple(lines),
        points=np.concatenate([no_points(), *points]),
    )
