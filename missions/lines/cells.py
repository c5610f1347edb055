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
from missions.lines import hops
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


def chains(follower: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Sort pieces by cell.

    Args:
        follower: (P,) from `followers`.

    Returns:
        (C + 1,) where each cell begins, and (P,) the pieces, cell after cell.
    """
    after, begins, listed = follower.tolist(), [0], []
    for piece in np.setdiff1d(np.arange(len(after)), follower).tolist():
        while piece >= 0:
            listed.append(piece)
            piece = after[piece]
        begins.append(len(listed))
    return np.array(begins), np.array(listed, dtype=np.int64)


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
    both, sizes = ends.reshape(-1, 2, 2), np.diff(begins)
    corners = np.empty((len(sizes), CORNERS, 3))
    corners[:, :2, :2], corners[:, 2:, :2] = both[listed[begins[:-1]]], both[listed[begins[1:] - 1]]
    corners[..., 2] = course + math.pi * np.array([0, 1, 0, 1])
    # After an odd number of lines at the other end of them, else at the same.
    sides = np.where(sizes[:, None] % 2, [1, 0, 1, 0], [0, 1, 0, 1])
    return corners, sides + np.where(sizes[:, None] == 1, 0, [2, 2, 0, 0])


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
    both, sizes = ends[listed].reshape(-1, 2, 2), np.diff(begins)
    courses = np.array([course, course + math.pi])
    lengths: Array = np.hypot(*(both[:, 1] - both[:, 0]).T)
    lines: Array = hops.line_j(costs, lengths.reshape(-1, 1), courses)
    # Hops at a side, 0 where lines begin: on to the next piece, and back from it.
    leaving = np.broadcast_to(courses[::-1, None], (len(both), 2, 1))
    places = np.concatenate([both, leaving], axis=2)
    entering = np.concatenate([both, leaving + math.pi], axis=2)
    on, back = np.zeros((2, *lines.shape))
    on[:-1] = hops.hop_j(costs, places[:-1], entering[1:], links_m[listed[:-1]])
    back[:-1] = hops.hop_j(costs, places[1:], entering[:-1], links_m[listed[:-1]])
    on[begins[1:] - 1] = back[begins[1:] - 1] = 0.0
    # The first piece of a cell is flown from one side, its second from the other, and so on; a hop
    # is at the side where the piece before it ends.
    side = (np.arange(len(both)) - np.repeat(begins[:-1], sizes)) % 2
    by_side = np.stack([side, 1 - side], axis=1)
    energies = np.empty((len(sizes), CORNERS))
    flown = np.take_along_axis(lines, by_side, axis=1)
    ahead = flown + np.take_along_axis(on, 1 - by_side, axis=1)
    astern = flown + np.take_along_axis(back, by_side, axis=1)
    energies[:, :2] = np.add.reduceat(ahead, begins[:-1])
    # From the last piece on: entered at the side that the first one is flown from in the end.
    last = (np.arange(2) + sizes[:, None] - 1) % 2
    energies[:, 2:] = np.take_along_axis(np.add.reduceat(astern, begins[:-1]), last, axis=1)
    energies[sizes == 1, 2:] = np.inf
    return energies


def flight_order(
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
    order = []
    for cell, corner in zip(*(x.tolist() for x in divmod(tour, CORNERS)), strict=True):
        pieces = listed[begins[cell] : begins[cell + 1]][:: 1 if corner < 2 else -1]
        order.append(np.stack([pieces, (corner + np.arange(len(pieces))) % 2], axis=1))
    return np.concatenate(order)
