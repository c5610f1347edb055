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
Places = NDArray[np.int64]


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


def to_uv(edges_ne: Array, heading_rad: float) -> Array:
    """Turn edges into the frame of the lines.

    Args:
        edges_ne: (E, 4) north and east of both ends.
        heading_rad: of the lines.

    Returns:
        (E, 4) u and v of both ends.
    """
    c, s = math.cos(heading_rad), math.sin(heading_rad)
    north, east = edges_ne[:, ::2], edges_ne[:, 1::2]
    uv = np.empty((len(edges_ne), 4))
    uv[:, ::2], uv[:, 1::2] = c * north + s * east, c * east - s * north
    return uv


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
    offsets: Array = (low_m + high_m) / 2 + spacing_m * places
    return offsets


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
def _strip_intervals(
    edges: Array, sides: Array, with_edges: bool, overhang_m: float
) -> tuple[Places, Places, Array]:
    """As `reaches`, of strips whose sides are levels (2, R), with or without what is between."""
    count, rows = edges.shape[0], sides.shape[1]
    # Of each row three parts: where edges cross its left side, its right side, and lie between.
    met = np.empty((count, 2, 2), np.int64)
    starts = np.zeros(3 * rows + 1, np.int64)
    for e in range(count):
        for side in range(2):
            for end in range(2):
                low, high = 0, rows
                while low < high:
                    middle = (low + high) // 2
                    if sides[side, middle] < edges[e, 1 + 2 * end]:
                        low = middle + 1
                    else:
                        high = middle
                met[e, side, end] = low
            low, high = met[e, side, 0], met[e, side, 1]
            met[e, side, 0], met[e, side, 1] = min(low, high), max(low, high)
            for i in range(met[e, side, 0], met[e, side, 1]):
                starts[3 * i + side + 1] += 1
        if with_edges:
            for i in range(met[e, 1, 0], met[e, 0, 1]):
                starts[3 * i + 3] += 1
    for k in range(3 * rows):
        starts[k + 1] += starts[k]
    pairs, filled = np.empty((starts[3 * rows], 2)), starts.copy()
    for e in range(count):
        u0, v0, u1, v1 = edges[e, 0], edges[e, 1], edges[e, 2], edges[e, 3]
        for side in range(2):
            for i in range(met[e, side, 0], met[e, side, 1]):
                share = (sides[side, i] - v0) / (v1 - v0)
                pairs[filled[3 * i + side], 0] = u0 + share * (u1 - u0)
                pairs[filled[3 * i + side], 1] = 0.0
                filled[3 * i + side] += 1
        if not with_edges:
            continue
        for i in range(met[e, 1, 0], met[e, 0, 1]):
            a, b = u0, u1
            if v1 != v0:
                at_left = u0 + (sides[0, i] - v0) / (v1 - v0) * (u1 - u0)
                at_right = u0 + (sides[1, i] - v0) / (v1 - v0) * (u1 - u0)
                if v0 < sides[0, i]:
                    a = at_left
                elif v0 > sides[1, i]:
                    a = at_right
                if v1 < sides[0, i]:
                    b = at_left
                elif v1 > sides[1, i]:
                    b = at_right
            pairs[filled[3 * i + 2], 0] = min(a, b)
            pairs[filled[3 * i + 2], 1] = max(a, b)
            filled[3 * i + 2] += 1
    begins, counts = np.empty(rows, np.int64), np.empty(rows, np.int64)
    for i in range(rows):
        first = top = begins[i] = starts[3 * i]
        for part in range(3):
            # The area is between one crossing and the next.
            step = 1 if part == 2 else 2
            if step == 2:
                sort_pairs(pairs, starts[3 * i + part], starts[3 * i + part + 1])
            for k in range(starts[3 * i + part], starts[3 * i + part + 1], step):
                pairs[top, 0] = pairs[k, 0]
                pairs[top, 1] = pairs[k, 1] if step == 1 else pairs[k + 1, 0]
                top += 1
        for again in range(2):
            top = first + unite(pairs, first, top)
            if again or overhang_m == 0.0:
                break
            for k in range(first, top):
                begin, end = pairs[k, 0] - overhang_m, pairs[k, 1] + overhang_m
                if begin > end:
                    begin = end = (begin + end) / 2
                pairs[k, 0], pairs[k, 1] = begin, end
        counts[i] = top - first
    return begins, counts, pairs


def reaches(
    edges: Array, offsets: Array, half_m: float, overhang_m: float = 0.0
) -> tuple[Places, Places, Array]:
    """Project an area within strips on u.

    Args:
        edges: (E, 4) u, v of both ends of every edge of the area's rings.
        offsets: (R,) ascending middles of the strips.
        half_m: half their width.
        overhang_m: how far the projections are made longer at both ends.

    Returns:
        (R,) where each strip's intervals begin, (R,) how many they are, and (N, 2) intervals, each
        strip's apart and ascending.
    """
    half = half_m - TOUCH_M
    sides = np.stack([offsets - half, offsets + half])
    found: tuple[Places, Places, Array] = _strip_intervals(edges, sides, True, overhang_m)
    return found


def rooms(edges: Array, offsets: Array, touch_m: float = TOUCH_M) -> tuple[Places, Places, Array]:
    """Where lines may be flown: the stretches of rows that lie in an area or follow its edge.

    Args:
        edges: (E, 4) u, v of both ends of every edge of the allowed area's rings.
        offsets: (R,) ascending v of the rows.
        touch_m: how close outside of the area a row may follow its edge.

    Returns:
        As `reaches`, by even and odd crossings of the edges.
    """
    sides = np.stack([offsets - touch_m, offsets + touch_m])
    found: tuple[Places, Places, Array] = _strip_intervals(edges, sides, False, 0.0)
    return found


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
    reach, room = reaches(survey, offsets, half_m, overhang_m), rooms(allowed, offsets)
    bound = int(reach[1].sum() + room[1].sum())
    # Each piece that lies within a stretch to fly parts what is cut of it.
    pieces, cuts = np.empty((bound, 4)), np.empty((3 * bound, 3))
    laid, cut = lay_pieces(*reach, *room, step_m, min_steps, pieces, cuts)
    return pieces[:laid].copy(), cuts[:cut].copy()


@compiled
def lay_pieces(
    reach_begins: Places,
    reach_counts: Places,
    reach: Array,
    room_begins: Places,
    room_counts: Places,
    room: Array,
    step_m: float,
    min_steps: int,
    pieces: Array,
    cuts: Array,
) -> tuple[int, int]:
    """Write the pieces and cuts of `lay_rows` within rooms; return how many they are."""
    laid, cut = 0, 0
    min_m = min_steps * step_m
    for i in range(reach_counts.size):
        first_of_row = laid
        first_wish = k = reach_begins[i]
        last_wish = first_wish + reach_counts[i]
        for r in range(room_begins[i], room_begins[i] + room_counts[i]):
            room_begin, room_end = room[r, 0], room[r, 1]
            if room_end - room_begin < _MIN_M:
                continue
            first_of_room = laid
            while k < last_wish and reach[k, 1] < room_begin:
                k += 1
            j = k
            while j < last_wish and reach[j, 0] <= room_end:
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
        for k in range(first_wish, last_wish):
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
                    cuts[cut, 0], cuts[cut, 1], cuts[cut, 2] = i, begin, end
                    cut += 1
                lacking = j < laid and pieces[j, 2] < reach[k, 1]
                if lacking:
                    begin = max(begin, pieces[j, 2])
                    j += 1
    return laid, cut
