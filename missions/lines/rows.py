"""Rows of line pieces: where parallel lines must be flown, and where they may be.

In the frame of the lines u runs along them and v to the right of them. A row is a line of one
offset v; it looks after a strip of v about it. Where the area within the strip has parts, or
no-go zones block the way, the row has pieces.

The reach of an area within a strip is its projection on u. It is exact: the outline of the area
within the strip is made of the area's edges clipped to the strip and of the stretches of the
strip's two borders that lie in the area, and each connected part projects onto one interval, which
its outline covers.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.compiled import compiled
from alice_survey.core.frames import Array
from missions.route.ways import edges_of
from missions.values.area import Area

TOUCH_M = 1e-7
"""Strips are this much narrower at both sides, so that an area that only touches a strip does not
count; and a line may run this close outside of the allowed area, so that it may follow its edge."""
_MIN_M = 1e-3
"""Shortest room along a line: where the vehicle has less, no line is flown."""
_EVEN = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class Site:
    """An area as compiled code takes it."""

    survey: Array
    """(E, 4) north and east of both ends of every edge, metres."""
    allowed: Array
    area_m2: float

    @classmethod
    def of(cls, area: Area) -> "Site":
        """The site of an area."""
        return cls(
            survey=edges_of(area.survey),
            allowed=edges_of(area.allowed),
            area_m2=float(area.survey.area),
        )


@compiled
def to_uv(edges_ne: Array, heading_rad: float) -> Array:
    """Turn edges into the frame of the lines.

    Args:
        edges_ne: (E, 4) north and east of both ends.
        heading_rad: of the lines.

    Returns:
        (E, 4) u and v of both ends.
    """
    c, s = math.cos(heading_rad), math.sin(heading_rad)
    uv = np.empty_like(edges_ne)
    for e in range(edges_ne.shape[0]):
        for k in (0, 2):
            uv[e, k] = c * edges_ne[e, k] + s * edges_ne[e, k + 1]
            uv[e, k + 1] = c * edges_ne[e, k + 1] - s * edges_ne[e, k]
    return uv


@compiled
def row_offsets(low_m: float, high_m: float, spacing_m: float, edge_m: float, passes: int) -> Array:
    """Offsets of the rows: the fewest of constant spacing, centred, that reach over both sides.

    Args:
        low_m: least v of the area.
        high_m: greatest v.
        spacing_m: kept exactly.
        edge_m: how far outside of the area the outermost lie at least; negative is inside.
        passes: least number of rows.
    """
    steps = max(math.ceil((high_m - low_m + 2 * edge_m) / spacing_m - _EVEN), passes - 1, 0)
    places = np.arange(steps + 1, dtype=np.float64) - steps / 2
    return (low_m + high_m) / 2 + spacing_m * places


@compiled
def sort_pairs(pairs: Array, first: int, last: int) -> None:
    """Sort rows first to last - 1 of (N, 2) by their first column, in place (shell sort)."""
    gap = 1
    while gap < (last - first) // 3:
        gap = 3 * gap + 1
    while gap >= 1:
        for i in range(first + gap, last):
            start, end = pairs[i, 0], pairs[i, 1]
            k = i
            while k >= first + gap and pairs[k - gap, 0] > start:
                pairs[k, 0] = pairs[k - gap, 0]
                pairs[k, 1] = pairs[k - gap, 1]
                k -= gap
            pairs[k, 0] = start
            pairs[k, 1] = end
        gap //= 3


@compiled
def unite(pairs: Array, first: int, last: int) -> int:
    """Unite intervals in rows first to last - 1 of (N, 2), in place; returns how many are left."""
    if last <= first:
        return 0
    sort_pairs(pairs, first, last)
    top = first
    for i in range(first + 1, last):
        if pairs[i, 0] <= pairs[top, 1]:
            pairs[top, 1] = max(pairs[top, 1], pairs[i, 1])
        else:
            top += 1
            pairs[top, 0] = pairs[i, 0]
            pairs[top, 1] = pairs[i, 1]
    return top - first + 1


@compiled
def stretches(edges: Array, levels: Array) -> tuple[NDArray[np.int64], Array]:
    """The stretches of level lines that lie in an area, by even and odd crossings.

    Args:
        edges: (E, 4) u, v of both ends of every edge of closed rings.
        levels: (L,) ascending v.

    Returns:
        (L + 1,) where each level's stretches begin, and (N, 2) their begin and end, ascending.
    """
    count = levels.size
    starts = np.zeros(count + 1, np.int64)
    for e in range(edges.shape[0]):
        low, high = min(edges[e, 1], edges[e, 3]), max(edges[e, 1], edges[e, 3])
        for i in range(np.searchsorted(levels, low), np.searchsorted(levels, high)):
            starts[i + 1] += 1
    for i in range(count):
        starts[i + 1] += starts[i]
    crossings = np.empty((starts[count], 2))
    filled = starts[:-1].copy()
    for e in range(edges.shape[0]):
        u0, v0, u1, v1 = edges[e, 0], edges[e, 1], edges[e, 2], edges[e, 3]
        for i in range(np.searchsorted(levels, min(v0, v1)), np.searchsorted(levels, max(v0, v1))):
            share = (levels[i] - v0) / (v1 - v0)
            crossings[filled[i], 0] = u0 + share * (u1 - u0)
            crossings[filled[i], 1] = 0.0
            filled[i] += 1
    found = np.empty((starts[count] // 2, 2))
    for i in range(count):
        sort_pairs(crossings, starts[i], starts[i + 1])
        for k in range(starts[i], starts[i + 1] - 1, 2):
            found[k // 2, 0] = crossings[k, 0]
            found[k // 2, 1] = crossings[k + 1, 0]
    for i in range(count + 1):
        starts[i] //= 2
    return starts, found


@compiled
def reaches(
    edges: Array, offsets: Array, half_m: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Project an area within strips on u.

    Args:
        edges: (E, 4) u, v of both ends of every edge of the area's rings.
        offsets: (R,) ascending middles of the strips.
        half_m: half their width.

    Returns:
        (R,) where each strip's intervals begin, (R,) how many they are, and (N, 2) intervals, each
        strip's apart and ascending.
    """
    half = half_m - TOUCH_M
    low, high = offsets - half, offsets + half
    low_starts, low_found = stretches(edges, low)
    high_starts, high_found = stretches(edges, high)
    count = offsets.size
    begins = np.zeros(count + 1, np.int64)
    for i in range(count):
        begins[i + 1] = low_starts[i + 1] - low_starts[i] + high_starts[i + 1] - high_starts[i]
    for e in range(edges.shape[0]):
        minimum, maximum = min(edges[e, 1], edges[e, 3]), max(edges[e, 1], edges[e, 3])
        for i in range(np.searchsorted(high, minimum), np.searchsorted(low, maximum)):
            begins[i + 1] += 1
    for i in range(count):
        begins[i + 1] += begins[i]
    found = np.empty((begins[count], 2))
    filled = begins[:-1].copy()
    for i in range(count):
        for k in range(low_starts[i], low_starts[i + 1]):
            found[filled[i]] = low_found[k]
            filled[i] += 1
        for k in range(high_starts[i], high_starts[i + 1]):
            found[filled[i]] = high_found[k]
            filled[i] += 1
    for e in range(edges.shape[0]):
        u0, v0, u1, v1 = edges[e, 0], edges[e, 1], edges[e, 2], edges[e, 3]
        minimum, maximum = min(v0, v1), max(v0, v1)
        for i in range(np.searchsorted(high, minimum), np.searchsorted(low, maximum)):
            a, b = u0, u1
            if v1 != v0:
                at_low = u0 + (low[i] - v0) / (v1 - v0) * (u1 - u0)
                at_high = u0 + (high[i] - v0) / (v1 - v0) * (u1 - u0)
                if v0 < low[i]:
                    a = at_low
                elif v0 > high[i]:
                    a = at_high
                if v1 < low[i]:
                    b = at_low
                elif v1 > high[i]:
                    b = at_high
            found[filled[i], 0] = min(a, b)
            found[filled[i], 1] = max(a, b)
            filled[i] += 1
    counts = np.zeros(count, np.int64)
    for i in range(count):
        counts[i] = unite(found, begins[i], begins[i + 1])
    return begins, counts, found


@compiled
def rooms(edges: Array, offsets: Array) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Where lines may be flown: the stretches of rows that lie in an area or follow its edge.

    Args:
        edges: (E, 4) u, v of both ends of every edge of the allowed area's rings.
        offsets: (R,) ascending v of the rows.

    Returns:
        As `reaches`.
    """
    left_starts, left = stretches(edges, offsets - TOUCH_M)
    right_starts, right = stretches(edges, offsets + TOUCH_M)
    count = offsets.size
    begins = left_starts + right_starts
    found = np.empty((begins[count], 2))
    counts = np.zeros(count, np.int64)
    for i in range(count):
        k = begins[i]
        for j in range(left_starts[i], left_starts[i + 1]):
            found[k] = left[j]
            k += 1
        for j in range(right_starts[i], right_starts[i + 1]):
            found[k] = right[j]
            k += 1
        counts[i] = unite(found, begins[i], begins[i + 1])
    return begins, counts, found


@compiled
def lay_rows(
    survey: Array,
    allowed: Array,
    offsets: Array,
    half_m: float,
    overhang_m: float,
    step_m: float,
    min_steps: int,
) -> tuple[Array, Array]:
    """Lay the pieces of all rows.

    A piece reaches as far as the area does within the row's strip and `overhang_m` beyond; it is a
    whole number of steps long where there is room, else its steps are a little shorter. Pieces less
    than two steps apart become one where the way between is allowed.

    Args:
        survey: (E, 4) u, v of both ends of the edges of the area to see.
        allowed: (A, 4) the same of the area where lines may be.
        offsets: (R,) ascending v of the rows.
        half_m: half the width of the strip a row looks after.
        overhang_m: how far a line begins before the area, and ends behind it.
        step_m: most from picture to picture.
        min_steps: of a piece.

    Returns:
        (P, 4) pieces: row, begin, end, steps; by row and u. And (C, 3) stretches that should be
        flown and cannot: row, begin, end.
    """
    reach_begins, reach_counts, reach = reaches(survey, offsets, half_m)
    room_begins, room_counts, room = rooms(allowed, offsets)
    count = offsets.size
    bound = 0
    for i in range(count):
        bound += reach_counts[i] + room_counts[i]
    pieces = np.empty((bound, 4))
    cuts = np.empty((bound + count, 3))
    laid, cut = 0, 0
    min_m = min_steps * step_m
    for i in range(count):
        first_of_row = laid
        first_wish, last_wish = reach_begins[i], reach_begins[i] + reach_counts[i]
        for k in range(first_wish, last_wish):
            begin, end = reach[k, 0] - overhang_m, reach[k, 1] + overhang_m
            if begin > end:
                begin = end = (begin + end) / 2
            reach[k, 0], reach[k, 1] = begin, end
        wished = unite(reach, first_wish, last_wish)
        k = first_wish
        for r in range(room_begins[i], room_begins[i] + room_counts[i]):
            room_begin, room_end = room[r, 0], room[r, 1]
            if room_end - room_begin < _MIN_M:
                continue
            first_of_room = laid
            while k < first_wish + wished and reach[k, 1] < room_begin:
                k += 1
            j = k
            while j < first_wish + wished and reach[j, 0] <= room_end:
                begin, end = max(reach[j, 0], room_begin), min(reach[j, 1], room_end)
                lack = min_m - (end - begin)
                if lack > 0.0:
                    begin = max(room_begin, min(begin - lack / 2, room_end - min_m))
                    end = min(room_end, begin + min_m)
                j += 1
                if laid > first_of_room and begin - pieces[laid - 1, 2] < 2 * step_m:
                    pieces[laid - 1, 2] = max(pieces[laid - 1, 2], end)
                    pieces[laid - 1, 1] = min(pieces[laid - 1, 1], begin)
                    continue
                pieces[laid, 0], pieces[laid, 1], pieces[laid, 2] = i, begin, end
                laid += 1
            for p in range(first_of_room, laid):
                begin, end = pieces[p, 1], pieces[p, 2]
                steps = max(min_steps, math.ceil((end - begin) / step_m - _EVEN))
                lack = steps * step_m - (end - begin)
                begin = max(room_begin, begin - lack / 2)
                end = min(room_end, begin + steps * step_m)
                begin = max(room_begin, end - steps * step_m)
                pieces[p, 1], pieces[p, 2], pieces[p, 3] = begin, end, steps
        p = first_of_row
        for k in range(first_wish, first_wish + wished):
            begin = reach[k, 0]
            while p < laid and pieces[p, 2] < begin:
                p += 1
            j, lacking = p, True
            while lacking:
                end = reach[k, 1] if j == laid else min(reach[k, 1], pieces[j, 1])
                # A wish may be a single place; then it is met or it is not.
                if end > begin + TOUCH_M or (end == begin == reach[k, 0] == reach[k, 1]):
                    if j < laid and pieces[j, 1] <= begin:
                        break
                    if cut == cuts.shape[0]:
                        cuts = np.concatenate((cuts, np.empty_like(cuts)))
                    cuts[cut, 0], cuts[cut, 1], cuts[cut, 2] = i, begin, end
                    cut += 1
                lacking = j < laid and pieces[j, 2] < reach[k, 1]
                if lacking:
                    begin = max(begin, pieces[j, 2])
                    j += 1
    return pieces[:laid].copy(), cuts[:cut].copy()
