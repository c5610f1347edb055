"""Cells: pieces of lines that follow one another from row to row without a choice.

The discrete form of H. Choset's boustrophedon decomposition (2000): where a row has as many pieces
as the one before and each overlaps one of them, cells go on; where the area parts, joins, begins or
ends, cells do. Within a cell lines are flown to and fro; it may be entered at either end of its
first or last line, and the number of its lines says where it is left.
"""

import math

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.compiled import compiled
from alice_survey.core.frames import Array
from missions.lines.hops import hop_j, line_j
from missions.values.costs import Costs

CORNERS = 4
"""Where a cell is entered: 0 at the beginning of its first line, 1 at its end, 2 and 3 the same of
its last line. A cell of one line has 0 and 1 only."""


@compiled
def followers(pieces: Array) -> NDArray[np.int64]:
    """The piece of the next row that goes on a piece's cell.

    Args:
        pieces: (P, 4) row, begin, end, steps; by row and begin.

    Returns:
        (P,) index; -1 where the cell ends.
    """
    count = pieces.shape[0]
    before = np.zeros(count, np.int64)
    after = np.zeros(count, np.int64)
    follower = np.full(count, -1, np.int64)
    row_begin = np.zeros(count + 1, np.int64)
    rows = 0
    for i in range(count):
        if i == 0 or pieces[i, 0] != pieces[i - 1, 0]:
            row_begin[rows] = i
            rows += 1
    row_begin[rows] = count
    for r in range(rows - 1):
        if pieces[row_begin[r + 1], 0] != pieces[row_begin[r], 0] + 1:
            continue
        i, j = row_begin[r], row_begin[r + 1]
        while i < row_begin[r + 1] and j < row_begin[r + 2]:
            if min(pieces[i, 2], pieces[j, 2]) > max(pieces[i, 1], pieces[j, 1]):
                after[i] += 1
                before[j] += 1
                follower[i] = j
            if pieces[i, 2] < pieces[j, 2]:
                i += 1
            else:
                j += 1
    for i in range(count):
        if follower[i] >= 0 and (after[i] > 1 or before[follower[i]] > 1):
            follower[i] = -1
    return follower


@compiled
def chains(follower: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Sort pieces by cell.

    Args:
        follower: (P,) from `followers`.

    Returns:
        (C + 1,) where each cell begins, and (P,) the pieces, cell after cell.
    """
    count = follower.size
    leads = np.ones(count, np.int64)
    for i in range(count):
        if follower[i] >= 0:
            leads[follower[i]] = 0
    begins = np.zeros(count + 1, np.int64)
    listed = np.empty(count, np.int64)
    cells, used = 0, 0
    for i in range(count):
        if leads[i] == 0:
            continue
        piece = i
        while piece >= 0:
            listed[used] = piece
            used += 1
            piece = follower[piece]
        cells += 1
        begins[cells] = used
    return begins[: cells + 1].copy(), listed


@compiled
def cell_corners(
    begins: NDArray[np.int64], listed: NDArray[np.int64], ends: Array, course: float
) -> tuple[Array, NDArray[np.int64]]:
    """Where cells are entered and left.

    Args:
        begins: from `chains`.
        listed: from `chains`.
        ends: (P, 4) north and east of begin and end of every piece.
        course: from begin to end.

    Returns:
        (C, 4, 3) north, east and course on entering at each corner; (C, 4) the corner where the
        cell is left after that.
    """
    count = begins.size - 1
    corners = np.empty((count, CORNERS, 3))
    exits = np.empty((count, CORNERS), np.int64)
    for c in range(count):
        first, last = listed[begins[c]], listed[begins[c + 1] - 1]
        size = begins[c + 1] - begins[c]
        for k in range(CORNERS):
            piece = first if k < 2 else last
            at_end = k % 2
            corners[c, k, 0] = ends[piece, 2 * at_end]
            corners[c, k, 1] = ends[piece, 2 * at_end + 1]
            corners[c, k, 2] = course + math.pi * at_end
            # After an odd number of lines at the other end of them, else at the same.
            side = 1 - at_end if size % 2 else at_end
            exits[c, k] = side if size == 1 or k >= 2 else 2 + side
    return corners, exits


@compiled
def cell_costs(
    costs: Costs,
    begins: NDArray[np.int64],
    listed: NDArray[np.int64],
    ends: Array,
    course: float,
    links_m: Array,
) -> Array:
    """Energy of flying each cell, from each corner.

    Args:
        costs: of the vehicle.
        begins: from `chains`.
        listed: from `chains`.
        ends: (P, 4) north and east of begin and end of every piece.
        course: from begin to end.
        links_m: (P, 2) way from a piece's begin to that of its follower, and from end to end.

    Returns:
        (C, 4) joules by the corner of entry; inf at corners 2 and 3 of a cell of one line.
    """
    count = begins.size - 1
    energies = np.zeros((count, CORNERS))
    leave, enter = np.empty(3), np.empty(3)
    for c in range(count):
        size = begins[c + 1] - begins[c]
        for k in range(CORNERS):
            at_end = k % 2
            if size == 1 and k >= 2:
                energies[c, k] = np.inf
                continue
            for i in range(size):
                place = begins[c] + (i if k < 2 else size - 1 - i)
                piece = listed[place]
                length = math.hypot(
                    ends[piece, 2] - ends[piece, 0], ends[piece, 3] - ends[piece, 1]
                )
                here = course + math.pi * at_end
                energies[c, k] += line_j(costs, length, here)
                at_end = 1 - at_end
                if i == size - 1:
                    continue
                following = listed[place + 1] if k < 2 else listed[place - 1]
                side = slice(2 * at_end, 2 * at_end + 2)
                leave[:2], leave[2] = ends[piece, side], here
                enter[:2], enter[2] = ends[following, side], here + math.pi
                way_m = links_m[piece if k < 2 else following, at_end]
                energies[c, k] += hop_j(costs, leave, enter, way_m)
    return energies


@compiled
def flown(
    tour: NDArray[np.int64], begins: NDArray[np.int64], listed: NDArray[np.int64]
) -> NDArray[np.int64]:
    """The pieces in the order of flight.

    Args:
        tour: (C,) corners of entry, counted through, in order.
        begins: from `chains`.
        listed: from `chains`.

    Returns:
        (P, 2) piece, and 1 where it is flown from its end to its begin.
    """
    order = np.empty((listed.size, 2), np.int64)
    used = 0
    for i in range(tour.size):
        c, k = tour[i] // CORNERS, tour[i] % CORNERS
        size = begins[c + 1] - begins[c]
        for j in range(size):
            order[used, 0] = listed[begins[c] + (j if k < 2 else size - 1 - j)]
            order[used, 1] = (k + j) % 2
            used += 1
    return order
