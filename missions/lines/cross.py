"""Cross lines: at right angles to the survey lines, so that these are tied to one another.

Neighbouring survey lines form blocks. Over the length of each block a given number of cross
lines is spread evenly. Where that leaves survey lines uncrossed (the arm of an L, the rest of a row
next to a no-go zone), the cross lines are moved if as many can cross all; else short ones are
added, from a neighbour that is crossed to the next. The least number of places that meet all of
some intervals is found exactly by taking the end of the interval that ends first, again and again
(greedy stabbing; e.g. J. Kleinberg and E. Tardos 2006, chapter 4).
"""

import math

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.compiled import compiled
from alice_survey.core.frames import Array
from missions.lines.rows import rooms

MIN_STEPS = 2
"""Survey lines of fewer steps from picture to picture may stay uncrossed. Chosen: a line of one or
two pictures is tied to its neighbours and does not bend the block."""
_ROWS_APART = 2
"""A cross line goes on over one row that has no line there."""
_EVEN = 1e-9
_MIN_M = 1e-3


@compiled
def cross_table(
    pieces: Array, offsets: Array, allowed: Array, step: float, min_steps: int, count: int
) -> Array:
    """Lay the cross lines over the pieces of all rows.

    Args:
        pieces: (P, 4) row, begin, end, steps; by row and begin.
        offsets: (R,) v of the rows.
        allowed: (A, 4) u, v of the edges of the area where lines may be.
        step: most from picture to picture.
        min_steps: of a line.
        count: of cross lines over each block.

    Returns:
        (N, 4) u, least and greatest v, steps.
    """
    block, tied = blocks(pieces)
    edges = np.empty_like(allowed)
    for e in range(allowed.shape[0]):
        for k in (0, 2):
            edges[e, k], edges[e, k + 1] = allowed[e, k + 1], -allowed[e, k]
    found = np.empty((64, 4))
    used = 0
    for b in range(block.max() + 1 if block.size else 0):
        members = np.flatnonzero(block == b)
        if pieces[members[0], 0] == pieces[members[-1], 0]:
            continue  # one row has nothing to be tied to
        targets = members[pieces[members, 3] >= MIN_STEPS]
        uncrossed = np.zeros(pieces.shape[0], np.bool_)
        uncrossed[targets] = True
        low, high = pieces[members, 1].min(), pieces[members, 2].max()
        places = low + (high - low) * np.arange(1, count + 1) / (count + 1)
        groups = stabs(tied[targets])
        before = used
        for u in places:
            found, used = _laid(
                found, used, u, members, pieces, offsets, edges, step, min_steps, uncrossed, False
            )
        if uncrossed.any() and groups.shape[0] <= count:
            used = before
            uncrossed[targets] = True
            for u in _moved(places, groups):
                found, used = _laid(
                    found, used, u, members, pieces, offsets, edges, step, min_steps, uncrossed,
                    False,
                )  # fmt: skip
        left = targets[uncrossed[targets]]
        for group in stabs(tied[left]):
            u = (group[0] + group[1]) / 2
            found, used = _laid(
                found, used, u, members, pieces, offsets, edges, step, min_steps, uncrossed, True
            )
    return found[:used].copy()


@compiled
def blocks(pieces: Array) -> tuple[NDArray[np.int64], Array]:
    """Sort pieces by what lies side by side.

    Args:
        pieces: (P, 4) row, begin, end, steps; by row and begin.

    Returns:
        (P,) number of each piece's block, and (P, 2) the longest stretch of u of each that lies
        next to a piece of a neighbouring row; all of the piece, where there is none.
    """
    count = pieces.shape[0]
    parent = np.arange(count)
    tied = pieces[:, 1:3].copy()
    longest = np.zeros(count)
    firsts = np.searchsorted(pieces[:, 0], np.arange(pieces[-1, 0] + 2 if count else 1))
    for r in range(firsts.size - 2):
        i, j = firsts[r], firsts[r + 1]
        while i < firsts[r + 1] and j < firsts[r + 2]:
            low, high = max(pieces[i, 1], pieces[j, 1]), min(pieces[i, 2], pieces[j, 2])
            if high > low:
                for p in (i, j):
                    if high - low > longest[p]:
                        longest[p] = high - low
                        tied[p, 0], tied[p, 1] = low, high
                a, b = _root(parent, i), _root(parent, j)
                parent[max(a, b)] = min(a, b)
            if pieces[i, 2] < pieces[j, 2]:
                i += 1
            else:
                j += 1
    block = np.empty(count, np.int64)
    number = 0
    for i in range(count):
        root = _root(parent, i)
        if root == i:
            block[i] = number
            number += 1
        else:
            block[i] = block[root]
    return block, tied


@compiled
def _root(parent: NDArray[np.int64], i: int) -> int:
    """The least piece of a block as far as it is known, by halving the way to it."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@compiled
def stabs(intervals: Array) -> Array:
    """The fewest places that meet all intervals.

    Args:
        intervals: (N, 2) begin and end.

    Returns:
        (K, 2) ascending, apart: anywhere in each of these is such a place.
    """
    order = np.argsort(intervals[:, 1], kind="mergesort")
    found = np.empty((intervals.shape[0], 2))
    used = 0
    for i in order:
        begin, end = intervals[i, 0], intervals[i, 1]
        if used == 0 or begin > found[used - 1, 1]:
            found[used, 0], found[used, 1] = begin, end
            used += 1
        else:
            found[used - 1, 0] = max(found[used - 1, 0], begin)
    return found[:used].copy()


@compiled
def _moved(places: Array, groups: Array) -> Array:
    """Places, each group of `stabs` with the nearest that is left moved into it."""
    moved = places.copy()
    taken = np.zeros(places.size, np.bool_)
    for g in range(groups.shape[0]):
        nearest, minimum = -1, np.inf
        for i in range(places.size):
            away = max(groups[g, 0] - places[i], places[i] - groups[g, 1], 0.0)
            if not taken[i] and away < minimum:
                nearest, minimum = i, away
        taken[nearest] = True
        moved[nearest] = min(max(places[nearest], groups[g, 0]), groups[g, 1])
    return np.unique(moved)


@compiled
def _laid(
    found: Array,
    used: int,
    u: float,
    members: NDArray[np.int64],
    pieces: Array,
    offsets: Array,
    edges: Array,
    step: float,
    min_steps: int,
    uncrossed: NDArray[np.bool_],
    only_uncrossed: bool,
) -> tuple[Array, int]:
    """Add the cross lines at one place to a table, and note what they cross; see `cross_table`.

    Args:
        found: (N, 4) the table; a larger one comes back where it is full.
        used: how many rows it has.
        u: the place.
        members: pieces of the block.
        pieces: of all rows.
        offsets: of the rows.
        edges: (A, 4) v, -u of the edges of the allowed area.
        step: most from picture to picture.
        min_steps: of a line.
        uncrossed: (P,) whether a piece must still be crossed; changed.
        only_uncrossed: lay no more than crosses such pieces, and ties them to a neighbour.
    """
    begins, counts, room = rooms(edges, np.array([-u]))
    here = members[(pieces[members, 1] <= u) & (u <= pieces[members, 2])]
    first = 0
    while first < here.size:
        v = offsets[int(pieces[here[first], 0])]
        low, high = v, v
        for r in range(begins[0], begins[0] + counts[0]):
            if room[r, 0] <= v <= room[r, 1]:
                low, high = room[r, 0], room[r, 1]
        last = first
        while (
            last + 1 < here.size
            and pieces[here[last + 1], 0] - pieces[here[last], 0] <= _ROWS_APART
            and offsets[int(pieces[here[last + 1], 0])] <= high
        ):
            last += 1
        following = last + 1
        if only_uncrossed:
            begin, end = last + 1, first - 1
            for k in range(first, last + 1):
                if uncrossed[here[k]]:
                    begin, end = min(begin, k), max(end, k)
            wanted = end >= begin
            first, last = max(first, begin - 1), min(last, end + 1)
        else:
            wanted = last > first
        if wanted and high - low > _MIN_M:
            v_0 = offsets[int(pieces[here[first], 0])]
            v_1 = offsets[int(pieces[here[last], 0])]
            steps = max(min_steps, math.ceil((v_1 - v_0) / step - _EVEN))
            v_0 = max(low, v_0 - (steps * step - (v_1 - v_0)) / 2)
            v_1 = min(high, v_0 + steps * step)
            v_0 = max(low, v_1 - steps * step)
            if used == found.shape[0]:
                found = np.concatenate((found, np.empty_like(found)))
            found[used, 0], found[used, 1], found[used, 2], found[used, 3] = u, v_0, v_1, steps
            used += 1
            for k in range(first, last + 1):
                uncrossed[here[k]] = False
        first = following
    return found, used
