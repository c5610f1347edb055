"""Ways inside a polygon with holes: what stays inside, and the shortest way.

Touching is allowed: what is outside by no more than `TOUCH_M` counts as inside, so that rounding
never keeps a vehicle from running along the edge.

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
from scipy.spatial.distance import cdist
from shapely.geometry import MultiPolygon, Polygon, box
from shapely.geometry.polygon import orient

from alice_survey.core.compiled import compiled
from alice_survey.core.errors import PlanError
from alice_survey.core.frames import Array
from missions.values.area import multipolygon

Place = tuple[float, float]

TOUCH_M = 1e-6
"""What is outside by less counts as inside: far below what any vehicle holds, far above rounding
of coordinates of some kilometres."""
COARSE_M = 0.05
"""How far ways that only order lines may cut corners: far less than a turn costs."""
SMALL_M = 10.0
"""Girth of zones that ways for choosing a heading pass over: a detour round them is some 2 m."""
_BLOCK = 1 << 15
"""Pairs of places and corners that are looked at together."""
_TOGETHER = 8
"""Edges of the area that share a box."""
_LOOSE_M = 1e-3
"""By which the boxes are wider."""
_NONE, _CROSSED, _UNSURE = 0, 1, 2


class _Visibility(NamedTuple):
    """The corners that places see: few of all."""

    places: NDArray[np.intp]
    """(K,) ascending."""
    corners: NDArray[np.intp]
    lengths_m: Array

    def by_place(self, count: int) -> list[slice]:
        """The rows of each of so many places."""
        bounds = np.searchsorted(self.places, np.arange(count + 1)).tolist()
        return list(map(slice, bounds, bounds[1:]))

    def of(self, rows: slice) -> "_Visibility":
        """Some rows."""
        return _Visibility(self.places[rows], self.corners[rows], self.lengths_m[rows])


class Ways:
    """The ways inside an allowed area; between parts that do not touch there is none."""

    def __init__(self, allowed: MultiPolygon) -> None:
        """Prepare the area; no graph is built yet.

        Args:
            allowed: x = north, y = east, metres; valid, not empty.
        """
        self.allowed = allowed
        self._water = shapely.buffer(allowed, TOUCH_M, join_style="mitre")
        shapely.prepare(self._water)
        self._convex = self._water.covers(allowed.convex_hull)
        self._from_corner: dict[int, tuple[Array, NDArray[np.int32]]] = {}

    def inside(self, places_ne: Array) -> NDArray[np.bool_]:
        """Which places, (N, 2), are inside."""
        return np.asarray(shapely.intersects_xy(self._water, *places_ne.T))

    def free(self, a: Place, b: Place) -> bool:
        """Whether the straight between two places is inside."""
        return bool(self.free_many(np.array([a]), np.array([b]))[0])

    def free_many(self, starts_ne: Array, ends_ne: Array) -> NDArray[np.bool_]:
        """Which straights from (N, 2) to (N, 2) are inside, (N,)."""
        if len(starts_ne) != len(ends_ne):
            raise ValueError(f"{len(starts_ne)} starts for {len(ends_ne)} ends")
        if self._convex:
            return self.inside(starts_ne) & self.inside(ends_ne)
        _, edges, boxes = self._edges
        both = (np.array(places, np.float64, order="C") for places in (starts_ne, ends_ne))
        met = _crossings(*both, edges, boxes)
        unsure = met == _UNSURE
        free: NDArray[np.bool_] = met == _NONE
        free[free] = self.inside(starts_ne[free])
        straights = shapely.linestrings(np.stack([starts_ne[unsure], ends_ne[unsure]], axis=1))
        free[unsure] = shapely.covers(self._water, straights)
        return free

    def arcs_free(
        self, starts: Array, curvature_per_m: Array, length_m: Array
    ) -> NDArray[np.bool_]:
        """Which arcs and straights are inside, (N,): they begin inside and never meet the edge.

        Args:
            starts: (N, 3) north, east, heading.
            curvature_per_m: (N,) positive to starboard.
            length_m: (N,) at most one full turn.
        """
        free = self.inside(starts[:, :2])
        bent = np.flatnonzero(free & (np.abs(curvature_per_m) * length_m >= 1e-12))
        even = np.flatnonzero(free & (np.abs(curvature_per_m) * length_m < 1e-12))
        ahead = np.stack([np.cos(starts[:, 2]), np.sin(starts[:, 2])], axis=1)
        free[even] = self.free_many(
            starts[even, :2], (starts[:, :2] + length_m[:, None] * ahead)[even]
        )
        radius, side = 1 / np.abs(curvature_per_m[bent]), np.sign(curvature_per_m[bent])
        right = np.stack([-ahead[bent, 1], ahead[bent, 0]], axis=1)
        centre = starts[bent, :2] + (side * radius)[:, None] * right
        tree, edges, _ = self._edges
        arc, edge = tree.query(
            shapely.box(*(centre - radius[:, None]).T, *(centre + radius[:, None]).T)
        )
        # Where the circle meets the edge: |begin + t span| = radius, a quadratic equation in t.
        begin = edges[edge, :2] - centre[arc]
        span = edges[edge, 2:] - edges[edge, :2]
        square, along = (span**2).sum(axis=1), (begin * span).sum(axis=1)
        inner = along**2 - square * ((begin**2).sum(axis=1) - radius[arc] ** 2)
        root = np.sqrt(np.where(inner >= 0, inner, np.nan))
        for share in ((-along - root) / square, (-along + root) / square):
            north, east = (begin + share[:, None] * span).T
            # From the centre the vehicle is a right angle to the side behind its heading.
            turned = np.arctan2(east, north) - starts[bent[arc], 2] + side[arc] * math.pi / 2
            swept = (side[arc] * turned) % (2 * math.pi) * radius[arc]
            meets = (share >= 0) & (share <= 1) & (swept <= length_m[bent[arc]])
            free[bent[arc[meets]]] = False
        return free

    @cached_property
    def _edges(self) -> tuple[shapely.STRtree, Array, Array]:
        """A tree of the edges of what counts as inside; the edges, (E, 4); boxes of `_TOGETHER`."""
        edges = edges_of(multipolygon(self._water))
        # Neighbours next to each other: strips from west to east of edges from south to north.
        strip = np.argsort(np.argsort(edges[:, 1])) // math.ceil(math.sqrt(_TOGETHER * len(edges)))
        edges = edges[np.lexsort((edges[:, 0], strip))]
        tree = shapely.STRtree(np.asarray(shapely.linestrings(edges.reshape(-1, 2, 2))))
        low, high = np.minimum(edges[:, :2], edges[:, 2:]), np.maximum(edges[:, :2], edges[:, 2:])
        firsts = np.arange(0, len(edges), _TOGETHER)
        boxes = (np.minimum.reduceat(low, firsts), np.maximum.reduceat(high, firsts))
        return tree, edges, np.concatenate(boxes, axis=1)

    @cached_property
    def coarse(self) -> "Ways":
        """Ways for choosing the order of lines: round zones with fewer corners.

        They may pass through up to `COARSE_M` of what is forbidden, never stop short of what is
        allowed; so they are as long or hardly shorter. None is flown.
        """
        joint = multipolygon(shapely.union(self.allowed, self.allowed.simplify(COARSE_M)))
        fewer = shapely.get_num_coordinates(joint) < shapely.get_num_coordinates(self.allowed)
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
        one, two = np.triu_indices(len(places))
        distances = self._distances_m(places, places, one, two)
        return distances[index[:, None], index]

    def distances_m(self, a_ne: Array, b_ne: Array) -> Array:
        """Lengths of the shortest ways from places (N, 2) to (M, 2), (N, M); inf where none is."""
        one, two = np.indices((len(a_ne), len(b_ne))).reshape(2, -1)
        return self._distances_m(a_ne, b_ne, one, two)

    def _distances_m(
        self, a: Array, b: Array, one: NDArray[np.intp], two: NDArray[np.intp]
    ) -> Array:
        """(N, M) as of `distances_m`; of pairs that are not in (K,) lists the mirrored ones are."""
        distances = cdist(a, b)
        blocked = ~self.free_many(a[one], b[two])
        distances[one[blocked], two[blocked]] = np.inf
        if a is b:
            distances[two[blocked], one[blocked]] = np.inf
        if not blocked.any() or not len(self._nodes):
            return distances
        rows = np.flatnonzero(np.isinf(distances).any(axis=1))
        columns = np.flatnonzero(np.isinf(distances).any(axis=0))
        far = self._sight(b[columns])
        near = far if a is b else self._sight(a[rows])
        if not len(near.corners) or not len(far.corners):
            return distances
        firsts, lasts = np.unique(near.corners), np.unique(far.corners)
        between = np.array([lengths_m[lasts] for lengths_m, _ in self._from(firsts)])
        first, last = np.searchsorted(firsts, near.corners), np.searchsorted(lasts, far.corners)
        reached, begins = np.unique(far.places, return_index=True)
        for i, seen in zip(rows.tolist(), near.by_place(len(rows)), strict=True):
            if seen.stop > seen.start:
                through = (near.lengths_m[seen, None] + between[first[seen]]).min(axis=0)
                over = np.minimum.reduceat(through[last] + far.lengths_m, begins)
                found = distances[i, columns[reached]]
                distances[i, columns[reached]] = np.where(np.isinf(found), over, found)
        return distances

    def lengths_m(self, starts_ne: Array, ends_ne: Array) -> Array:
        """Lengths, (N,), of the shortest ways from (N, 2) to (N, 2); inf where none is."""
        blocked = np.flatnonzero(~self.free_many(starts_ne, ends_ne))
        lengths: Array = np.hypot(*(ends_ne - starts_ne).T)
        lengths[blocked] = np.inf
        if len(blocked) and len(self._nodes):
            near, far = self._sight(starts_ne[blocked]), self._sight(ends_ne[blocked])
            both = near.by_place(len(blocked)), far.by_place(len(blocked))
            for i, here, there in zip(blocked.tolist(), *both, strict=True):
                lengths[i] = self._through(near.of(here), far.of(there)).min(initial=np.inf)
        return lengths

    def path_ne(self, a: Place, b: Place) -> Array:
        """The shortest way as places (K, 2), from `a` to `b` with the corners it bends at.

        Raises:
            PlanError: a place is outside, or they are in parts that are not connected.
        """
        ends = np.array([a, b])
        if self.free(a, b):
            return ends
        for north, east in ends[~self.inside(ends)]:
            raise PlanError(
                f"the place {north:.2f} m north, {east:.2f} m east is outside of the allowed area: "
                "move it, or widen area.turn_margin_m or the allowed area"
            )
        near, far = self._sight(ends[:1]), self._sight(ends[1:])
        through = self._through(near, far)
        if math.isinf(through.min(initial=np.inf)):
            raise PlanError(
                f"no way inside the allowed area from {a[0]:.2f} m north, {a[1]:.2f} m east to "
                f"{b[0]:.2f} m north, {b[1]:.2f} m east: its parts are not connected; widen "
                "the allowed area (area.turn_margin_m), or survey the parts one by one"
            )
        first, last = np.unravel_index(np.argmin(through), through.shape)
        ((_, before),) = self._from(near.corners[[first]])
        chain = [int(far.corners[last])]
        while chain[-1] != near.corners[first]:
            chain.append(int(before[chain[-1]]))
        path = np.concatenate([ends[:1], self._nodes[chain[::-1], :2], ends[1:]])
        moves = np.linalg.norm(np.diff(path, axis=0), axis=1) > TOUCH_M
        moves[-1] |= not moves.any()
        kept = np.concatenate([[True], moves])
        kept[-1] = True
        if not moves[-1]:
            kept[np.flatnonzero(kept[:-1])[-1]] = False  # a corner that is the goal itself
        result: Array = path[kept]
        return result

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
        return np.concatenate(nodes)

    @cached_property
    def _graph(self) -> csr_array:
        """Lengths of the straights between corners that are inside and touch at both."""
        corners = self._nodes[:, :2]
        passes = self._passes(corners)
        one, two = np.nonzero(np.triu(passes & passes.T, 1))
        free = self.free_many(corners[one], corners[two])
        one, two = one[free], two[free]
        # Corners of two rings at one place are joined by a way of almost no length.
        lengths = np.maximum(np.hypot(*(corners[two] - corners[one]).T), 1e-12)
        return csr_array((lengths, (one, two)), shape=(len(corners), len(corners)))

    def _passes(self, places_ne: Array) -> NDArray[np.bool_]:
        """Whether taut ways from places may bend at corners, (N, V): both edges are on one side."""
        corner, before, after = self._nodes[:, :2], self._nodes[:, 2:4], self._nodes[:, 4:]
        passes = np.empty((len(places_ne), len(corner)), dtype=np.bool_)
        rows = max(_BLOCK // max(len(corner), 1), 1)
        for first in range(0, len(places_ne), rows):
            place = places_ne[first : first + rows, None]
            ahead = corner - place
            reach = TOUCH_M * np.hypot(ahead[..., 0], ahead[..., 1])
            one, two = (
                ahead[..., 0] * (x - place)[..., 1] - ahead[..., 1] * (x - place)[..., 0]
                for x in (before, after)
            )
            passes[first : first + rows] = (
                (np.maximum(one, two) <= reach)
                | (np.minimum(one, two) >= -reach)
                | (reach <= TOUCH_M**2)
            )
        return passes

    def _sight(self, places_ne: Array) -> _Visibility:
        """The corners that places, (N, 2), see and may pass."""
        corners = self._nodes[:, :2]
        place, corner = np.nonzero(self._passes(places_ne))
        free = self.free_many(places_ne[place], corners[corner])
        place, corner = place[free], corner[free]
        return _Visibility(place, corner, np.hypot(*(corners[corner] - places_ne[place]).T))

    def _through(self, near: _Visibility, far: _Visibility) -> Array:
        """Lengths, (K, M), of the ways over each corner near one place and each near another."""
        between = [lengths_m[far.corners] for lengths_m, _ in self._from(near.corners)]
        shape = len(near.corners), len(far.corners)
        through: Array = near.lengths_m[:, None] + np.reshape(between, shape) + far.lengths_m
        return through

    def _from(self, corners: NDArray[np.intp]) -> list[tuple[Array, NDArray[np.int32]]]:
        """Lengths, (V,), of the shortest ways from corners to all, and the corners before; kept."""
        listed = corners.tolist()
        new = sorted(set(listed) - self._from_corner.keys())
        if new:
            found = dijkstra(self._graph, directed=False, indices=new, return_predecessors=True)
            self._from_corner |= dict(zip(new, zip(*found, strict=True), strict=True))
        return [self._from_corner[corner] for corner in listed]


@compiled
def _crossings(starts: Array, ends: Array, edges: Array, boxes: Array) -> NDArray[np.int8]:
    """Whether straights cross edges: `_NONE` or `_CROSSED` for certain, else `_UNSURE`.

    It is certain where rounding cannot change on which sides of a line two corners lie (J. R.
    Shewchuk 1997, more than thrice the bound of his first stage).

    Args:
        starts: (N, 2) of the straights.
        ends: (N, 2) of the same.
        edges: (E, 4) both ends.
        boxes: (ceil(E / _TOGETHER), 4) least, then most, of so many edges each.
    """
    met = np.empty(len(starts), np.int8)
    for i in range(len(starts)):
        x, y, to_x, to_y = starts[i, 0], starts[i, 1], ends[i, 0], ends[i, 1]
        dx, dy = to_x - x, to_y - y
        met[i] = _NONE if math.isfinite(dx + dy) else _UNSURE
        for k in range(len(boxes)):
            low_x, low_y, high_x, high_y = boxes[k]
            if low_x > max(x, to_x) or low_y > max(y, to_y):
                continue
            if high_x < min(x, to_x) or high_y < min(y, to_y):
                continue
            off_x, off_y = low_x + high_x - 2 * x, low_y + high_y - 2 * y
            size_x, size_y = high_x - low_x + _LOOSE_M, high_y - low_y + _LOOSE_M
            if abs(dx * off_y - dy * off_x) > abs(dx) * size_y + abs(dy) * size_x:
                continue
            for e in range(k * _TOGETHER, min((k + 1) * _TOGETHER, len(edges))):
                ax, ay, bx, by = edges[e, 0] - x, edges[e, 1] - y, edges[e, 2] - x, edges[e, 3] - y
                a, b = dx * ay - dy * ax, dx * by - dy * bx
                sum_m, sum_a_m = abs(dx) + abs(dy), abs(ax) + abs(ay)
                bound = 1e-15 * sum_m * (sum_a_m + abs(bx) + abs(by))
                if min(a, b) > bound or max(a, b) < -bound:
                    continue
                ex, ey = edges[e, 2] - edges[e, 0], edges[e, 3] - edges[e, 1]
                p = ey * ax - ex * ay
                q = ex * (to_y - edges[e, 1]) - ey * (to_x - edges[e, 0])
                p_bound = 1e-15 * (abs(ex) + abs(ey)) * (sum_a_m + sum_m)
                if min(p, q) > p_bound or max(p, q) < -p_bound:
                    continue
                if min(abs(a), abs(b)) > bound and min(abs(p), abs(q)) > p_bound:
                    met[i] = _CROSSED
                    break
                met[i] = _UNSURE
            if met[i] == _CROSSED:
                break
    return met


def edges_of(polygons: MultiPolygon) -> Array:
    """Both ends, (E, 4) north and east, of every edge of every ring."""
    coordinates, ring_of = shapely.get_coordinates(
        shapely.get_rings(list(polygons.geoms)), return_index=True
    )
    both = np.concatenate([coordinates[:-1], coordinates[1:]], axis=1)
    edges: Array = np.ascontiguousarray(both[ring_of[:-1] == ring_of[1:]], dtype=np.float64)
    return edges


OPEN_WATER = Ways(multipolygon(box(-1e7, -1e7, 1e7, 1e7)))
"""Ways where nothing is forbidden."""
