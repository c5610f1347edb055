"""Whether places, straights and arcs are inside a polygon with holes: compiled tests.

The polygon's edges are sorted into the cells of a grid, so that a test looks only at the edges that
are near. Touching is allowed: what is outside by no more than `TOUCH_M` counts as inside, so that
rounding never keeps a vehicle from running along the edge. A straight or an arc is cut where it
meets the edge; each piece is then inside as a whole, outside as a whole, or along the edge.
"""

import math
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon

from alice_survey.core.compiled import compiled_ieee
from alice_survey.core.frames import Array

TOUCH_M = 1e-6
"""What is outside by less counts as inside: far below what any vehicle holds, far above rounding
of coordinates of some kilometres."""
_PAD_M = 4 * TOUCH_M
_FULL = 2 * math.pi
_MAX_CELLS = 256


class Fence(NamedTuple):
    """The edges of a polygon, by cell of a grid; what compiled tests take."""

    edges: Array
    """(E, 4) north and east of both ends; none: nothing is forbidden."""
    firsts: NDArray[np.int32]
    """(cells + 1,) start of each cell's list, by rows of equal north."""
    listed: NDArray[np.int32]
    """Indices of edges, cell after cell."""
    north_m: float
    east_m: float
    """East of the grid's corner."""
    rows_per_m: float
    columns_per_m: float
    rows: int
    columns: int


OPEN_WATER = Fence(
    edges=np.empty((0, 4)),
    firsts=np.zeros(2, dtype=np.int32),
    listed=np.empty(0, dtype=np.int32),
    north_m=0.0,
    east_m=0.0,
    rows_per_m=0.0,
    columns_per_m=0.0,
    rows=1,
    columns=1,
)
"""No fence at all: everything is inside."""


def fence_of(allowed: MultiPolygon) -> Fence:
    """Sort the edges of a polygon into a grid with about as many cells as edges."""
    edges = edges_of(allowed)
    edges = edges[(edges[:, 0] != edges[:, 2]) | (edges[:, 1] != edges[:, 3])]
    low, high = edges.reshape(-1, 2).min(axis=0), edges.reshape(-1, 2).max(axis=0)
    cells = min(_MAX_CELLS, max(1, math.isqrt(len(edges))))
    per_m = cells / np.maximum(high - low, 1.0)
    empty = OPEN_WATER._replace(
        edges=edges,
        firsts=np.zeros(cells * cells + 1, dtype=np.int32),
        north_m=float(low[0]),
        east_m=float(low[1]),
        rows_per_m=float(per_m[0]),
        columns_per_m=float(per_m[1]),
        rows=cells,
        columns=cells,
    )
    firsts, listed = _sorted_into_cells(empty)
    return empty._replace(firsts=firsts, listed=listed)


def edges_of(polygons: MultiPolygon) -> Array:
    """Both ends, (E, 4) north and east, of every edge of every ring."""
    coordinates, ring_of = shapely.get_coordinates(
        shapely.get_rings(list(polygons.geoms)), return_index=True
    )
    both = np.concatenate([coordinates[:-1], coordinates[1:]], axis=1)
    edges: Array = np.ascontiguousarray(both[ring_of[:-1] == ring_of[1:]], dtype=np.float64)
    return edges


@compiled_ieee
def _row(fence: Fence, north: float) -> int:
    """The grid's row at a north, the first or last one beyond the grid."""
    row = math.floor((north - fence.north_m) * fence.rows_per_m)
    return min(max(row, 0), fence.rows - 1)


@compiled_ieee
def _column(fence: Fence, east: float) -> int:
    """The grid's column at an east, the first or last one beyond the grid."""
    column = math.floor((east - fence.east_m) * fence.columns_per_m)
    return min(max(column, 0), fence.columns - 1)


@compiled_ieee
def _columns_met(
    fence: Fence, row: int, a_n: float, a_e: float, b_n: float, b_e: float
) -> tuple[int, int]:
    """First and last column that a straight, padded, meets in a row."""
    low_t, high_t = 0.0, 1.0
    run = b_n - a_n
    if abs(run) > _PAD_M:
        bottom = fence.north_m + row / fence.rows_per_m - _PAD_M if row > 0 else -math.inf
        top = (
            fence.north_m + (row + 1) / fence.rows_per_m + _PAD_M
            if row < fence.rows - 1
            else math.inf
        )
        one, two = (bottom - a_n) / run, (top - a_n) / run
        low_t, high_t = max(low_t, min(one, two)), min(high_t, max(one, two))
    first, last = a_e + low_t * (b_e - a_e), a_e + high_t * (b_e - a_e)
    return (
        _column(fence, min(first, last) - _PAD_M),
        _column(fence, max(first, last) + _PAD_M),
    )


@compiled_ieee
def _sorted_into_cells(fence: Fence) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Lists of the edges that each cell, padded, holds a part of."""
    firsts = np.zeros(fence.rows * fence.columns + 1, dtype=np.int32)
    listed = np.empty(0, dtype=np.int32)
    for filling in (False, True):
        if filling:
            for cell in range(fence.rows * fence.columns):
                firsts[cell + 1] += firsts[cell]
            listed = np.empty(firsts[-1], dtype=np.int32)
            free = firsts[:-1].copy()
        for i in range(fence.edges.shape[0]):
            a_n, a_e, b_n, b_e = fence.edges[i]
            for row in range(
                _row(fence, min(a_n, b_n) - _PAD_M), _row(fence, max(a_n, b_n) + _PAD_M) + 1
            ):
                first, last = _columns_met(fence, row, a_n, a_e, b_n, b_e)
                for cell in range(row * fence.columns + first, row * fence.columns + last + 1):
                    if filling:
                        listed[free[cell]] = i
                        free[cell] += 1
                    else:
                        firsts[cell + 1] += 1
    return firsts, listed


@compiled_ieee
def _encloses(fence: Fence, north: float, east: float) -> bool:
    """Whether a ray to the east meets the edges an odd number of times."""
    row, odd = _row(fence, north), False
    for column in range(_column(fence, east), fence.columns):
        cell = row * fence.columns + column
        for k in range(fence.firsts[cell], fence.firsts[cell + 1]):
            a_n, a_e, b_n, b_e = fence.edges[fence.listed[k]]
            if (a_n > north) != (b_n > north):
                meets = a_e + (north - a_n) / (b_n - a_n) * (b_e - a_e)
                # An edge is listed in several cells and counts in the one where it is met.
                if meets > east and _column(fence, meets) == column:
                    odd = not odd
    return odd


@compiled_ieee
def _at_edge(fence: Fence, north: float, east: float, touch_m: float) -> bool:
    """Whether an edge is within reach, which is at most `TOUCH_M`."""
    cell = _row(fence, north) * fence.columns + _column(fence, east)
    for k in range(fence.firsts[cell], fence.firsts[cell + 1]):
        a_n, a_e, b_n, b_e = fence.edges[fence.listed[k]]
        u, v = b_n - a_n, b_e - a_e
        t = ((north - a_n) * u + (east - a_e) * v) / (u * u + v * v)
        t = min(max(t, 0.0), 1.0)
        if math.hypot(north - a_n - t * u, east - a_e - t * v) <= touch_m:
            return True
    return False


@compiled_ieee
def _sort(values: Array, count: int) -> None:
    """Sort the first few values in place; numba's own sort takes a second to compile."""
    for i in range(1, count):
        value, k = values[i], i
        while k > 0 and values[k - 1] > value:
            values[k] = values[k - 1]
            k -= 1
        values[k] = value


@compiled_ieee
def point_inside(fence: Fence, north: float, east: float) -> bool:
    """Whether a place is inside or no more than `TOUCH_M` outside."""
    if fence.edges.shape[0] == 0:
        return True
    inside: bool = _encloses(fence, north, east) or _at_edge(fence, north, east, TOUCH_M)
    return inside


@compiled_ieee
def straight_inside(fence: Fence, a_n: float, a_e: float, b_n: float, b_e: float) -> bool:
    """Whether all of a straight is inside or no more than `TOUCH_M` outside.

    A slit of forbidden water narrower than `TOUCH_M` between two long edges counts as forbidden.
    """
    if fence.edges.shape[0] == 0:
        return True
    u, v = b_n - a_n, b_e - a_e
    length = math.hypot(u, v)
    if length <= TOUCH_M:
        short: bool = point_inside(fence, a_n, a_e) and point_inside(fence, b_n, b_e)
        return short
    cuts = np.empty(0)
    for filling in (False, True):
        count = 2
        for row in range(
            _row(fence, min(a_n, b_n) - _PAD_M), _row(fence, max(a_n, b_n) + _PAD_M) + 1
        ):
            first, last = _columns_met(fence, row, a_n, a_e, b_n, b_e)
            start = fence.firsts[row * fence.columns + first]
            for k in range(start, fence.firsts[row * fence.columns + last + 1]):
                c_n, c_e, d_n, d_e = fence.edges[fence.listed[k]]
                # Signed distances of the edge's ends from the straight's line.
                c_off = ((c_n - a_n) * v - (c_e - a_e) * u) / length
                d_off = ((d_n - a_n) * v - (d_e - a_e) * u) / length
                if min(c_off, d_off) > 2 * TOUCH_M or max(c_off, d_off) < -2 * TOUCH_M:
                    continue
                if abs(c_off) <= 2 * TOUCH_M:
                    t = ((c_n - a_n) * u + (c_e - a_e) * v) / (length * length)
                    if 0.0 < t < 1.0:
                        if filling:
                            cuts[count] = t
                        count += 1
                if abs(d_off) <= 2 * TOUCH_M:
                    t = ((d_n - a_n) * u + (d_e - a_e) * v) / (length * length)
                    if 0.0 < t < 1.0:
                        if filling:
                            cuts[count] = t
                        count += 1
                if (c_off > 0.0) == (d_off > 0.0):
                    continue
                edge = math.hypot(d_n - c_n, d_e - c_e)
                a_off = ((a_n - c_n) * (d_e - c_e) - (a_e - c_e) * (d_n - c_n)) / edge
                b_off = ((b_n - c_n) * (d_e - c_e) - (b_e - c_e) * (d_n - c_n)) / edge
                if (a_off > 0.0) == (b_off > 0.0):
                    continue
                minimum = min(min(abs(a_off), abs(b_off)), min(abs(c_off), abs(d_off)))
                if minimum > TOUCH_M:
                    return False
                if filling:
                    cuts[count] = a_off / (a_off - b_off)
                count += 1
        if not filling:
            if count == 2 and _encloses(fence, a_n + 0.5 * u, a_e + 0.5 * v):
                return True  # no edge is met: all of it is where its middle is
            cuts = np.empty(count)
    cuts[0], cuts[1] = 0.0, 1.0
    _sort(cuts, cuts.shape[0])
    for i in range(cuts.shape[0] - 1):
        middle = 0.5 * (cuts[i] + cuts[i + 1])
        if _encloses(fence, a_n + middle * u, a_e + middle * v):
            continue
        # Outside by less than allowed at both ends and the middle is so between them too: edges
        # are straight, and none ends near the piece.
        for t in (cuts[i], middle, cuts[i + 1]):
            if not point_inside(fence, a_n + t * u, a_e + t * v):
                return False
    return True


@compiled_ieee
def arc_inside(
    fence: Fence, north: float, east: float, heading: float, curvature: float, length: float
) -> bool:
    """Whether all of an arc (or straight) is inside or no more than `TOUCH_M` outside.

    Args:
        fence: the polygon.
        north: of its start.
        east: of its start.
        heading: at its start, from north.
        curvature: per metre, positive to starboard.
        length: at most one full turn.
    """
    if fence.edges.shape[0] == 0:
        return True
    if abs(curvature) * length < 1e-12:
        end_n, end_e = north + length * math.cos(heading), east + length * math.sin(heading)
        straight: bool = straight_inside(fence, north, east, end_n, end_e)
        return straight
    radius, side = 1.0 / abs(curvature), 1.0 if curvature > 0 else -1.0
    centre_n = north - math.sin(heading) / curvature
    centre_e = east + math.cos(heading) / curvature
    swept = length / radius
    reach = radius + _PAD_M
    first_row, last_row = _row(fence, centre_n - reach), _row(fence, centre_n + reach)
    first, last = _column(fence, centre_e - reach), _column(fence, centre_e + reach)
    near = 0
    for row in range(first_row, last_row + 1):
        near += fence.firsts[row * fence.columns + last + 1]
        near -= fence.firsts[row * fence.columns + first]
    # The direction from the centre to the vehicle is its heading minus a right angle to the side.
    ahead = heading - side * 0.5 * math.pi
    cuts = np.empty(2 + 5 * near)
    cuts[0], cuts[1] = 0.0, swept
    count = 2
    for row in range(first_row, last_row + 1):
        start = fence.firsts[row * fence.columns + first]
        for k in range(start, fence.firsts[row * fence.columns + last + 1]):
            c_n, c_e, d_n, d_e = fence.edges[fence.listed[k]]
            c_n, c_e, d_n, d_e = c_n - centre_n, c_e - centre_e, d_n - centre_n, d_e - centre_e
            u, v = d_n - c_n, d_e - c_e
            edge = math.hypot(u, v)
            u, v = u / edge, v / edge
            off = c_e * u - c_n * v
            if abs(off) > reach:
                continue
            half = math.sqrt(max(radius * radius - off * off, 0.0))
            foot = -(c_n * u + c_e * v)
            for place in (foot - half, foot, foot + half):
                # Where the circle meets the edge, and where it is nearest to one that it grazes.
                if place == foot and abs(abs(off) - radius) > _PAD_M:
                    continue
                if -_PAD_M <= place <= edge + _PAD_M:
                    direction = math.atan2(c_e + place * v, c_n + place * u)
                    cuts[count] = (side * (direction - ahead)) % _FULL
                    count += 1
            for end_n, end_e in ((c_n, c_e), (d_n, d_e)):
                if abs(math.hypot(end_n, end_e) - radius) <= 2 * TOUCH_M:
                    cuts[count] = (side * (math.atan2(end_e, end_n) - ahead)) % _FULL
                    count += 1
    _sort(cuts, count)
    for i in range(count - 1):
        if cuts[i + 1] > swept:
            break
        middle = ahead + side * 0.5 * (cuts[i] + cuts[i + 1])
        middle_n = centre_n + radius * math.cos(middle)
        middle_e = centre_e + radius * math.sin(middle)
        if _encloses(fence, middle_n, middle_e):
            continue
        # Along the edge, or a touch: half of what is allowed, since between the samples an arc may
        # bend away from an edge a little more.
        for share in range(9):
            angle = ahead + side * (cuts[i] + share / 8 * (cuts[i + 1] - cuts[i]))
            place_n = centre_n + radius * math.cos(angle)
            place_e = centre_e + radius * math.sin(angle)
            touches = _at_edge(fence, place_n, place_e, 0.5 * TOUCH_M)
            if not touches and not _encloses(fence, place_n, place_e):
                return False
    return True
