"""Ways inside a polygon with holes: whether a straight stays inside, and the shortest way.

A shortest way bends only at corners that point into the allowed water, and there only round the
corner (T. Lozano-Perez and M. A. Wesley 1979: visibility graph; H. Rohnert 1986: of it only the
straights that touch the corners at both ends). So the graph has few nodes and fewer edges. It is
built when a straight is first blocked; among places in a convex area it never is.
"""

import math
from functools import cached_property
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from shapely.geometry import MultiPolygon, Polygon
from shapely.geometry.polygon import orient

from alice_survey.core.compiled import compiled_ieee
from alice_survey.core.errors import PlanError
from alice_survey.core.frames import Array
from missions.route.fence import TOUCH_M, Fence, fence_of, point_inside, straight_inside
from missions.values.area import multipolygon

Place = tuple[float, float]

COARSE_M = 0.05
"""How far ways that only order lines may cut corners: far less than a turn costs."""
SMALL_M = 10.0
"""Girth of zones that ways for choosing a heading pass over: a detour round them is some 2 m."""


class Ways:
    """The ways inside an allowed area.

    What is outside by no more than `fence.TOUCH_M` counts as inside, so that ways may run along the
    edge. Between parts that do not touch there is no way.
    """

    def __init__(self, allowed: MultiPolygon) -> None:
        """Sort the area's edges; no graph is built yet.

        Args:
            allowed: x = north, y = east, metres; valid, not empty.
        """
        self.allowed = allowed
        self.fence: Fence = fence_of(allowed)
        self._from_node: dict[int, Array] = {}

    def free(self, a: Place, b: Place) -> bool:
        """Whether the straight between two places is inside."""
        return bool(straight_inside(self.fence, a[0], a[1], b[0], b[1]))

    def free_many(self, starts_ne: Array, ends_ne: Array) -> NDArray[np.bool_]:
        """Which straights from (N, 2) to (N, 2) are inside, (N,)."""
        starts = np.ascontiguousarray(starts_ne, dtype=np.float64).reshape(-1, 2)
        ends = np.ascontiguousarray(ends_ne, dtype=np.float64).reshape(-1, 2)
        if starts.shape != ends.shape:
            raise ValueError(f"{len(starts)} starts for {len(ends)} ends")
        result: NDArray[np.bool_] = _straights_inside(self.fence, starts, ends)
        return result

    @cached_property
    def coarse(self) -> "Ways":
        """Ways for choosing the order of lines: round zones with fewer corners.

        They may pass through up to `COARSE_M` of what is forbidden, never stop short of what is
        allowed; so they are as long or hardly shorter. None is flown.
        """
        simple = self.allowed.simplify(COARSE_M)
        corners = shapely.get_num_coordinates(self.allowed)
        if shapely.get_num_coordinates(simple) == corners:
            return self
        joint = multipolygon(shapely.union(self.allowed, simple))
        fewer = shapely.get_num_coordinates(joint) < corners
        return Ways(joint) if fewer and len(joint.geoms) == len(self.allowed.geoms) else self

    @cached_property
    def sketch(self) -> "Ways":
        """Ways for choosing a heading: coarse ones that pass over piles and other small zones."""
        coarse = self.coarse
        parts = [
            Polygon(part.exterior, [hole for hole in part.interiors if hole.length > SMALL_M])
            for part in coarse.allowed.geoms
        ]
        joint = multipolygon(shapely.union_all(parts))
        fewer = shapely.get_num_coordinates(joint) < shapely.get_num_coordinates(coarse.allowed)
        return Ways(joint) if fewer else coarse

    def between_m(self, places_ne: Array) -> Array:
        """Lengths of the shortest ways among places (N, 2), (N, N); inf where none is."""
        places, index = np.unique(places_ne, axis=0, return_inverse=True)
        index = index.ravel()
        distances: Array = _straights_among(self.fence, places)
        blocked = np.flatnonzero(np.isinf(distances).any(axis=1))
        if len(blocked) and len(self._nodes):
            self._round_corners(distances, blocked, blocked, places, places)
        return distances[index[:, None], index]

    def distances_m(self, a_ne: Array, b_ne: Array) -> Array:
        """Lengths of the shortest ways from places (N, 2) to (M, 2), (N, M); inf where none is."""
        a = np.ascontiguousarray(a_ne, dtype=np.float64).reshape(-1, 2)
        b = np.ascontiguousarray(b_ne, dtype=np.float64).reshape(-1, 2)
        distances: Array = _straight_distances(self.fence, a, b)
        if np.isfinite(distances).all() or len(self._nodes) == 0:
            return distances
        blocked_a = np.flatnonzero(np.isinf(distances).any(axis=1))
        blocked_b = np.flatnonzero(np.isinf(distances).any(axis=0))
        self._round_corners(distances, blocked_a, blocked_b, a, b)
        return distances

    def lengths_m(self, starts_ne: Array, ends_ne: Array) -> Array:
        """Lengths, (N,), of the shortest ways from (N, 2) to (N, 2); inf where none is."""
        starts = np.ascontiguousarray(starts_ne, dtype=np.float64).reshape(-1, 2)
        ends = np.ascontiguousarray(ends_ne, dtype=np.float64).reshape(-1, 2)
        blocked = np.flatnonzero(~self.free_many(starts, ends))
        lengths: Array = np.hypot(*(ends - starts).T)
        lengths[blocked] = np.inf
        if len(blocked) == 0 or len(self._nodes) == 0:
            return lengths
        seen_a, seen_b = self._seen(starts[blocked]), self._seen(ends[blocked])
        used = np.flatnonzero(np.isfinite(seen_a).any(axis=0))
        goals = np.flatnonzero(np.isfinite(seen_b).any(axis=0))
        seen_a, seen_b = seen_a[:, used], seen_b[:, goals]
        between = self._between(used, goals)
        lengths[blocked] = _over_corners(_listed(seen_a), _listed(seen_b), between)
        return lengths

    def path_ne(self, a: Place, b: Place) -> Array:
        """The shortest way as places (K, 2), from `a` to `b` with the corners it bends at.

        Raises:
            PlanError: a place is outside, or they are in parts that are not connected.
        """
        if self.free(a, b):
            return np.array([a, b])
        for place in (a, b):
            if not point_inside(self.fence, place[0], place[1]):
                raise PlanError(
                    f"the place {place[0]:.2f} m north, {place[1]:.2f} m east is outside of the "
                    "allowed area: move it, or widen area.turn_margin_m or the allowed area"
                )
        best_m, chain = self._over_nodes(np.array([a]), np.array([b]))
        if math.isinf(best_m):
            raise PlanError(
                f"no way inside the allowed area from {a[0]:.2f} m north, {a[1]:.2f} m east to "
                f"{b[0]:.2f} m north, {b[1]:.2f} m east: its parts are not connected; widen "
                "the allowed area (area.turn_margin_m), or survey the parts one by one"
            )
        path = np.concatenate([[a], self._nodes[chain, :2], [b]])
        moved = np.linalg.norm(np.diff(path, axis=0), axis=1) > TOUCH_M
        moved[-1] |= not moved.any()
        kept = np.concatenate([[True], moved])
        kept[-1] = True
        if not moved[-1]:
            kept[np.flatnonzero(kept[:-1])[-1]] = False  # a corner that is the goal itself
        result: Array = path[kept]
        return result

    def _over_nodes(self, a: Array, b: Array) -> tuple[float, list[int]]:
        """The shortest way over corners between two places, (1, 2) each: length, and which."""
        size = len(self._nodes)
        if size == 0:
            return math.inf, []
        seen_a, seen_b = self._seen(a)[0], self._seen(b)[0]
        near, graph = np.flatnonzero(np.isfinite(seen_a)), self._graph
        # The place is one more corner; an edge of no length would be none.
        joint = csr_array(
            (
                np.append(graph.data, np.maximum(seen_a[near], 1e-12)),
                np.append(graph.indices, near),
                np.append(graph.indptr, graph.nnz + len(near)),
            ),
            shape=(size + 1, size + 1),
        )
        found = dijkstra(joint, directed=False, indices=[size], return_predecessors=True)
        far, before = found[0][0], found[1][0]
        through = far[:size] + seen_b
        node = int(np.argmin(through))
        if math.isinf(through[node]):
            return math.inf, []
        chain = [node]
        while before[chain[-1]] != size:
            chain.append(int(before[chain[-1]]))
        return float(through[node]), chain[::-1]

    @cached_property
    def _nodes(self) -> Array:
        """(V, 6) corners that ways may bend at, the corner before and the one after."""
        # Between corners that nearly coincide the turn is undefined.
        single = shapely.remove_repeated_points(self.allowed, 0.1 * TOUCH_M)
        parts = [orient(part) for part in single.geoms]
        rings = [ring for part in parts for ring in (part.exterior, *part.interiors)]
        nodes = []
        for ring in rings:
            corners = shapely.get_coordinates(ring)[:-1]
            before, after = np.roll(corners, 1, axis=0), np.roll(corners, -1, axis=0)
            # The water is on the left of every ring (x to the right, y up).
            arriving, leaving = corners - before, after - corners
            turn = arriving[:, 0] * leaving[:, 1] - arriving[:, 1] * leaving[:, 0]
            nodes.append(np.concatenate([corners, before, after], axis=1)[turn < 0])
        return np.ascontiguousarray(np.concatenate(nodes))

    @cached_property
    def _graph(self) -> csr_array:
        rows, columns, lengths = _tangents(self.fence, self._nodes)
        size = len(self._nodes)
        return csr_array((lengths, (rows, columns)), shape=(size, size))

    def _between(self, nodes: NDArray[np.intp], goals: NDArray[np.intp]) -> Array:
        """(U, V) lengths of the shortest ways from corners to corners; ways to all are kept."""
        new = [node for node in nodes.tolist() if node not in self._from_node]
        if new:
            distances = dijkstra(self._graph, directed=False, indices=new)
            self._from_node |= dict(zip(new, distances, strict=True))
        rows = [self._from_node[node][goals] for node in nodes.tolist()]
        return np.array(rows).reshape(len(rows), len(goals))

    def _round_corners(
        self,
        distances: Array,
        blocked_a: NDArray[np.intp],
        blocked_b: NDArray[np.intp],
        a: Array,
        b: Array,
    ) -> None:
        """Fill what is infinite of distances from (N, 2) to (M, 2) by ways over corners."""
        seen_a = seen_b = self._seen(a[blocked_a])
        if b is not a:
            seen_b = self._seen(b[blocked_b])
        used = np.flatnonzero(np.isfinite(seen_a).any(axis=0))
        goals = np.flatnonzero(np.isfinite(seen_b).any(axis=0))
        seen_a, seen_b = seen_a[:, used], seen_b[:, goals]
        between = self._between(used, goals)
        _shorten(distances, blocked_a, blocked_b, _listed(seen_a), _listed(seen_b), between)

    def _seen(self, points_ne: Array) -> Array:
        """(N, V) distances to the corners that can be seen and passed; inf of the others."""
        seen: Array = _seen(self.fence, self._nodes, np.ascontiguousarray(points_ne))
        return seen


@compiled_ieee
def _straights_inside(fence: Fence, starts: Array, ends: Array) -> NDArray[np.bool_]:
    result = np.empty(starts.shape[0], dtype=np.bool_)
    for i in range(starts.shape[0]):
        result[i] = straight_inside(fence, starts[i, 0], starts[i, 1], ends[i, 0], ends[i, 1])
    return result


@compiled_ieee
def _straight_distances(fence: Fence, a: Array, b: Array) -> Array:
    """(N, M) lengths of the straights that are inside; inf of the others."""
    result = np.full((a.shape[0], b.shape[0]), np.inf)
    for i in range(a.shape[0]):
        for j in range(b.shape[0]):
            if straight_inside(fence, a[i, 0], a[i, 1], b[j, 0], b[j, 1]):
                result[i, j] = math.hypot(b[j, 0] - a[i, 0], b[j, 1] - a[i, 1])
    return result


@compiled_ieee
def _straights_among(fence: Fence, places: Array) -> Array:
    """(N, N) lengths of the straights among places that are inside; inf of the others."""
    result = np.full((places.shape[0], places.shape[0]), np.inf)
    for i in range(places.shape[0]):
        for j in range(i, places.shape[0]):
            if straight_inside(fence, places[i, 0], places[i, 1], places[j, 0], places[j, 1]):
                length = math.hypot(places[j, 0] - places[i, 0], places[j, 1] - places[i, 1])
                result[i, j] = result[j, i] = length
    return result


@compiled_ieee
def _passes(nodes: Array, i: int, north: float, east: float) -> bool:
    """Whether a taut way from a place may bend at a corner: both its edges are on one side."""
    u, v = nodes[i, 0] - north, nodes[i, 1] - east
    length = math.hypot(u, v)
    if length <= TOUCH_M:
        return True
    one = (u * (nodes[i, 3] - east) - v * (nodes[i, 2] - north)) / length
    two = (u * (nodes[i, 5] - east) - v * (nodes[i, 4] - north)) / length
    passes: bool = max(one, two) <= TOUCH_M or min(one, two) >= -TOUCH_M
    return passes


@compiled_ieee
def _seen(fence: Fence, nodes: Array, points: Array) -> Array:
    result = np.full((points.shape[0], nodes.shape[0]), np.inf)
    for i in range(points.shape[0]):
        n, e = points[i, 0], points[i, 1]
        for j in range(nodes.shape[0]):
            if _passes(nodes, j, n, e) and straight_inside(fence, n, e, nodes[j, 0], nodes[j, 1]):
                result[i, j] = math.hypot(nodes[j, 0] - n, nodes[j, 1] - e)
    return result


@compiled_ieee
def _tangents(fence: Fence, nodes: Array) -> tuple[NDArray[np.int32], NDArray[np.int32], Array]:
    """Pairs of corners (each once) whose straight is inside and touches at both, with lengths."""
    count, room = 0, 4 * nodes.shape[0] + 16
    rows, columns = np.empty(room, dtype=np.int32), np.empty(room, dtype=np.int32)
    lengths = np.empty(room)
    for i in range(nodes.shape[0]):
        for j in range(i + 1, nodes.shape[0]):
            if not _passes(nodes, j, nodes[i, 0], nodes[i, 1]):
                continue
            if not _passes(nodes, i, nodes[j, 0], nodes[j, 1]):
                continue
            if not straight_inside(fence, nodes[i, 0], nodes[i, 1], nodes[j, 0], nodes[j, 1]):
                continue
            if count == room:
                room *= 2
                old = rows, columns, lengths
                rows, columns = np.empty(room, dtype=np.int32), np.empty(room, dtype=np.int32)
                lengths = np.empty(room)
                for k in range(count):
                    rows[k], columns[k], lengths[k] = old[0][k], old[1][k], old[2][k]
            rows[count], columns[count] = i, j
            # Corners of two rings at one place are joined by a way of almost no length.
            lengths[count] = max(
                math.hypot(nodes[j, 0] - nodes[i, 0], nodes[j, 1] - nodes[i, 1]), 1e-12
            )
            count += 1
    return rows[:count], columns[:count], lengths[:count]


class _Listed(NamedTuple):
    """The corners that places see: few of all."""

    firsts: NDArray[np.intp]
    """(N + 1,) start of each place's list."""
    nodes: NDArray[np.intp]
    lengths_m: Array


def _listed(seen: Array) -> _Listed:
    """The finite ones of distances (N, V) from places to corners."""
    places, nodes = np.nonzero(np.isfinite(seen))
    firsts = np.searchsorted(places, np.arange(len(seen) + 1))
    return _Listed(firsts=firsts, nodes=nodes, lengths_m=seen[places, nodes])


@compiled_ieee
def _shorten(
    distances: Array,
    blocked_a: NDArray[np.intp],
    blocked_b: NDArray[np.intp],
    seen_a: _Listed,
    seen_b: _Listed,
    between: Array,
) -> None:
    """Fill the blocked distances with those of the ways over corners.

    Args:
        distances: (N, M) to fill.
        blocked_a: (A,) rows with something blocked.
        blocked_b: (B,) columns the same way.
        seen_a: from the A places to U corners.
        seen_b: from the B places to V corners.
        between: (U, V)
    """
    size = between.shape[1]
    through = np.empty(size)
    for i in range(blocked_a.shape[0]):
        through[:] = np.inf
        for k in range(seen_a.firsts[i], seen_a.firsts[i + 1]):
            node, length = seen_a.nodes[k], seen_a.lengths_m[k]
            for other in range(size):
                through[other] = min(through[other], length + between[node, other])
        for j in range(blocked_b.shape[0]):
            if distances[blocked_a[i], blocked_b[j]] < np.inf:
                continue
            best = np.inf
            for k in range(seen_b.firsts[j], seen_b.firsts[j + 1]):
                best = min(best, through[seen_b.nodes[k]] + seen_b.lengths_m[k])
            distances[blocked_a[i], blocked_b[j]] = best


@compiled_ieee
def _over_corners(seen_a: _Listed, seen_b: _Listed, between: Array) -> Array:
    """(N,) lengths of ways over corners; arguments as of `_shorten`, row by row."""
    count = seen_a.firsts.size - 1
    result = np.full(count, np.inf)
    for i in range(count):
        for k in range(seen_b.firsts[i], seen_b.firsts[i + 1]):
            for m in range(seen_a.firsts[i], seen_a.firsts[i + 1]):
                length = seen_a.lengths_m[m] + between[seen_a.nodes[m], seen_b.nodes[k]]
                result[i] = min(result[i], length + seen_b.lengths_m[k])
    return result
