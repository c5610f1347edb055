"""Cross lines: at right angles to the survey lines, so that these are tied to one another.

Neighbouring survey lines form blocks. Over the length of each block a given number of cross
lines is spread evenly. Where that leaves survey lines uncrossed (the arm of an L, the rest of a row
next to a no-go zone), the cross lines are moved if as many can cross all; else short ones are
added, from a neighbour that is crossed to the next. The least number of places that meet all of
some intervals is found exactly by taking the end of the interval that ends first, again and again
(greedy stabbing; e.g. J. Kleinberg and E. Tardos 2006, chapter 4).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from alice_survey.core.frames import Array
from missions.lines.rows import rooms
from missions.values.pattern import Pattern

MIN_STEPS = 2
"""Survey lines of fewer steps from picture to picture may stay uncrossed. Chosen: a line of one or
two pictures is tied to its neighbours and does not bend the block."""
_ROWS_APART = 2
"""A cross line goes on over one row that has no line there."""
_EVEN = 1e-9
_MIN_M = 1e-3


class _CrossedBlock(NamedTuple):
    """Pieces that lie side by side, and where lines across them may be."""

    begin: Array
    """(P,) least u of each piece, by row."""
    end: Array
    row: NDArray[np.int64]
    v: Array
    edges: Array
    """(A, 4) v, -u of the edges of the allowed area."""
    pattern: Pattern


def cross_table(
    pieces: Array, offsets: Array, allowed: Array, pattern: Pattern, count: int
) -> Array:
    """Lay the cross lines over the pieces of all rows.

    Args:
        pieces: (P, 4) row, begin, end, steps; by row and begin.
        offsets: (R,) v of the rows.
        allowed: (A, 4) u, v of the edges of the area where lines may be.
        pattern: how far it is from picture to picture.
        count: of cross lines over each block.

    Returns:
        (N, 4) u, least and greatest v, steps.
    """
    block, tied = blocks(pieces)
    edges = np.ascontiguousarray(allowed[:, [1, 0, 3, 2]] * [1.0, -1.0, 1.0, -1.0])
    lines: list[list[float]] = []
    for number in range(block.max(initial=-1) + 1):
        members = np.flatnonzero(block == number)
        row, begin, end, steps = pieces[members].T
        if row[0] == row[-1]:
            continue  # one row has nothing to be tied to
        rows = row.astype(np.int64)
        here = _CrossedBlock(begin, end, rows, offsets[rows], edges, pattern)
        target, spans = steps >= MIN_STEPS, tied[members]
        places = begin.min() + (end.max() - begin.min()) * np.arange(1, count + 1) / (count + 1)
        groups = stabs(spans[target])
        uncrossed = target.copy()
        found = [line for u in places for line in _lines_at(here, u, uncrossed)]
        if uncrossed.any() and len(groups) <= count:
            uncrossed = target.copy()
            found = [line for u in _move(places, groups) for line in _lines_at(here, u, uncrossed)]
        for first, last in stabs(spans[target & uncrossed]):
            found += _lines_at(here, (first + last) / 2, uncrossed, only_uncrossed=True)
        lines += found
    return np.array(lines).reshape(-1, 4)


def blocks(pieces: Array) -> tuple[NDArray[np.int64], Array]:
    """Sort pieces by what lies side by side.

    Args:
        pieces: (P, 4) row, begin, end, steps; by row and begin.

    Returns:
        (P,) number of each piece's block, and (P, 2) the longest stretch of u of each that lies
        next to a piece of a neighbouring row; all of the piece, where there is none.
    """
    rows, begins, ends, _ = pieces.T
    # Of the next row, those that end behind a piece's begin, up to those that begin before its end.
    width = 2 * (np.abs(pieces[:, 1:3]).max(initial=0.0) + 1.0)
    first = np.searchsorted(rows * width + ends, (rows + 1) * width + begins, side="right")
    last = np.searchsorted(rows * width + begins, (rows + 1) * width + ends)
    counts = np.maximum(last - first, 0)
    one = np.repeat(np.arange(len(pieces)), counts)
    two = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts - first, counts)
    graph = csr_array((np.ones(len(one)), (one, two)), shape=(len(pieces), len(pieces)))
    _, block = connected_components(graph, directed=False)
    tied = pieces[:, 1:3].copy()
    both = np.stack([one, two], axis=1).ravel()[::-1]
    shared = np.stack([np.maximum(begins[one], begins[two]), np.minimum(ends[one], ends[two])], 1)
    shared = np.repeat(shared, 2, axis=0)[::-1]
    order = np.argsort(shared[:, 1] - shared[:, 0], kind="stable")
    tied[both[order]] = shared[order]  # the longest stays, the first of several
    return block.astype(np.int64), tied


def stabs(intervals: Array) -> Array:
    """The fewest places that meet all intervals.

    Args:
        intervals: (N, 2) begin and end.

    Returns:
        (K, 2) ascending, apart: anywhere in each of these is such a place.
    """
    found: list[list[float]] = []
    for begin, end in intervals[np.argsort(intervals[:, 1], kind="stable")].tolist():
        if not found or begin > found[-1][1]:
            found.append([begin, end])
        else:
            found[-1][0] = max(found[-1][0], begin)
    return np.array(found).reshape(-1, 2)


def _move(places: Array, groups: Array) -> Array:
    """Places, each group of `stabs` with the nearest that is left moved into it."""
    moved, free = places.copy(), np.ones(len(places), dtype=np.bool_)
    for low, high in groups:
        away = np.maximum(np.maximum(low - places, places - high), 0.0)
        nearest = int(np.argmin(np.where(free, away, np.inf)))
        free[nearest] = False
        moved[nearest] = np.clip(places[nearest], low, high)
    return np.unique(moved)


def _lines_at(
    block: _CrossedBlock, u: float, uncrossed: NDArray[np.bool_], *, only_uncrossed: bool = False
) -> list[list[float]]:
    """The cross lines of a block at one place, (N, 4) as of `cross_table`.

    Args:
        block: what to cross.
        u: the place.
        uncrossed: (P,) whether a piece must still be crossed; what the lines cross is cleared.
        only_uncrossed: lay no more than crosses such pieces, and ties them to a neighbour.
    """
    begins, counts, room = rooms(block.edges, np.array([-u]))
    room = room[begins[0] : begins[0] + counts[0]]
    here = np.flatnonzero((block.begin <= u) & (u <= block.end))
    row, v = block.row[here], block.v[here]
    lines, first = [], 0
    while first < len(here):
        inside = room[(room[:, 0] <= v[first]) & (v[first] <= room[:, 1])]
        low, high = inside[-1] if len(inside) else (v[first], v[first])
        stops = (np.diff(row[first:]) > _ROWS_APART) | (v[first + 1 :] > high)
        last = first + int(np.argmax(np.append(stops, True)))
        following = last + 1
        if only_uncrossed:
            needed = first + np.flatnonzero(uncrossed[here[first:following]])
            useful = len(needed) > 0
            if useful:
                first, last = max(first, needed[0] - 1), min(last, needed[-1] + 1)
        else:
            useful = last > first
        if useful and high - low > _MIN_M:
            span = v[last] - v[first]
            steps = max(block.pattern.min_steps, math.ceil(span / block.pattern.step_m - _EVEN))
            length = steps * block.pattern.step_m
            v_0 = max(low, v[first] - (length - span) / 2)
            v_1 = min(high, v_0 + length)
            v_0 = max(low, v_1 - length)
            lines.append([u, v_0, v_1, steps])
            uncrossed[here[first : last + 1]] = False
        first = following
    return lines
