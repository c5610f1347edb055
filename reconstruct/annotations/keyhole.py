"""Polygons with holes as one ring: a slit joins each hole to the outside, there and back.

Formats without holes keep the area exactly in this way; a reader finds the slits again, since no
other edge of a valid polygon is gone along in both directions.
"""

import numpy as np
import shapely
from shapely.geometry import LineString, Polygon

from reconstruct.annotations.values import Place

Ring = tuple[Place, ...]
_MAX_TRIED = 200
"""Slits tried for each hole, the shortest first."""


def joined(outer: Ring, holes: tuple[Ring, ...]) -> Ring | None:
    """The ring through the outside and all holes; None where no straight slit reaches a hole."""
    whole = Polygon(outer, holes)
    shapely.prepare(whole)
    ring, left = list(outer), list(holes)
    while left:
        found = next(
            (slit for hole in left if (slit := _slit(ring, hole, whole)) is not None), None
        )
        if found is None:
            return None
        at, hole, start = found
        turned = [*hole[start:], *hole[:start]]
        ring = [*ring[: at + 1], *turned, turned[0], *ring[at:]]
        left.remove(hole)
    return tuple(ring)


def parted(ring: Ring) -> tuple[Ring, tuple[Ring, ...]]:
    """The outside and the holes of a ring that `joined` made; any other ring has no holes."""
    edges: dict[tuple[Place, Place], int] = {}
    count = len(ring)
    for n in range(count):
        start, end = ring[n], ring[(n + 1) % count]
        back = edges.get((end, start))
        if back is not None and start != end:
            # ... end, start, (between), start, end ...: what lies between is a hole
            inside = ring[back + 1 : n]
            outside = (*ring[: back + 1], *ring[n + 2 :])
            outer, holes = parted(outside)
            hole, further = parted(inside)
            return outer, (*holes, hole, *further)
        edges[start, end] = n
    return ring, ()


def _slit(ring: list[Place], hole: Ring, whole: Polygon) -> tuple[int, Ring, int] | None:
    """Where a hole is joined to a ring: index in the ring, hole, index in the hole."""
    away = np.linalg.norm(np.array(ring)[:, None] - np.array(hole)[None], axis=2)
    order = np.argsort(away, axis=None, kind="stable")[:_MAX_TRIED]
    gone = {frozenset((a, b)) for a, b in zip(ring, [*ring[1:], ring[0]], strict=True)}
    for flat in order:
        at, start = divmod(int(flat), len(hole))
        ends = ring[at], hole[start]
        if ends[0] != ends[1] and frozenset(ends) not in gone and whole.covers(LineString(ends)):
            return at, hole, start
    return None
