"""The order of cells: from home through every cell once, and home again.

Few cells are ordered exactly, by dynamic programming over the sets of cells flown (M. Held and
R. M. Karp 1962) with the corner at which each is entered. Many are ordered by going to the nearest,
then improving: stretches of the tour are reversed, cells are moved, and corners of entry are chosen
again by dynamic programming along the tour, until nothing improves; then it is shaken and improved
again.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.compiled import compiled
from alice_survey.core.frames import Array
from missions.lines.cells import CORNERS

EXACT = 8
"""Most cells that are ordered exactly."""
_ROUNDS = 200
_GAIN = 1e-9
_SHAKES = 60
"""Most shakes of a tour; of very many cells fewer, since each then takes longer."""
_SHAKEN = 1200


class Cells(NamedTuple):
    """What a tour of C cells may cost; corner k of cell c is corner 4 c + k."""

    hops: Array
    """(4C, 4C) cost from leaving at a corner to entering at another."""
    exits: NDArray[np.int64]
    """(4C,) corner where a cell is left that is entered at a corner."""
    inner: Array
    """(4C,) cost of a cell by the corner of entry; inf where it cannot be entered."""
    start: Array
    """(4C,) cost to enter first at a corner; inf where the tour may not begin."""
    finish: Array
    """(4C,) cost after leaving last at a corner."""


@compiled
def exact_tour(problem: Cells, finish: Array, each: bool) -> tuple[float, NDArray[np.int64]]:
    """The cheapest tour.

    Args:
        problem: what it may cost; its `finish` does not count.
        finish: (4C, 4C) cost after leaving at a corner, by the corner first entered.
        each: whether `finish` depends on the corner first entered; else its first row holds.

    Returns:
        Cost, and (C,) the corners of entry in order.
    """
    hops, exits, inner, start, _ = problem
    corners = inner.size
    cells = corners // CORNERS
    sets = 1 << cells
    best, best_tour = np.inf, np.zeros(cells, np.int64)
    costs = np.empty((sets, corners))
    before = np.empty((sets, corners), np.int64)
    for only in range(corners if each else 1):
        if each and not (start[only] < np.inf and inner[only] < np.inf):
            continue
        costs[:] = np.inf
        for y in range(corners):
            if not each or y == only:
                costs[1 << (y // CORNERS), y] = start[y] + inner[y]
        for flown in range(1, sets):
            for y in range(corners):
                if costs[flown, y] == np.inf:
                    continue
                for z in range(corners):
                    joined = flown | (1 << (z // CORNERS))
                    if joined == flown:
                        continue
                    cost = costs[flown, y] + hops[exits[y], z] + inner[z]
                    if cost < costs[joined, z]:
                        costs[joined, z] = cost
                        before[joined, z] = y
        for y in range(corners):
            cost = costs[sets - 1, y] + finish[only, exits[y]]
            if cost < best:
                best = cost
                last, flown = y, sets - 1
                for i in range(cells - 1, -1, -1):
                    best_tour[i] = last
                    following = last
                    last = before[flown, following]
                    flown ^= 1 << (following // CORNERS)
    return best, best_tour


@compiled
def _link(tour: NDArray[np.int64], i: int, j: int, problem: Cells) -> float:
    """Cost from place i of the tour to place j; -1 is home before it, its size home after it."""
    cost: float = 0.0
    if i < 0:
        cost = problem.start[tour[j]]
    elif j >= tour.size:
        cost = problem.finish[problem.exits[tour[i]]]
    else:
        cost = problem.hops[problem.exits[tour[i]], tour[j]]
    return cost


def tour_cost(tour: NDArray[np.int64], problem: Cells) -> float:
    """Cost of a tour."""
    links = problem.hops[problem.exits[tour[:-1]], tour[1:]]
    links = np.append(links, problem.finish[problem.exits[tour[-1]]])
    return float(problem.start[tour[0]] + links.sum() + problem.inner[tour].sum())


def nearest_tour(problem: Cells) -> NDArray[np.int64]:
    """Tour from home always on to the cell reached at least cost."""
    hops, exits, inner, start, _ = problem
    free = np.where(np.isinf(inner), np.inf, 0.0)
    cost, tour = start, []
    for _ in range(inner.size // CORNERS):
        chosen = int(np.argmin(cost + free))
        tour.append(chosen)
        free[chosen // CORNERS * CORNERS :][:CORNERS] = np.inf
        cost = hops[exits[chosen]]
    return np.array(tour, dtype=np.int64)


@compiled
def _reenter(tour: NDArray[np.int64], problem: Cells, fixed: int) -> None:
    """Choose the corners of entry along a tour again, exactly, in place."""
    hops, exits, inner, start, finish = problem
    cells = tour.size
    costs = np.full((cells, CORNERS), np.inf)
    before = np.zeros((cells, CORNERS), np.int64)
    for i in range(cells):
        first = tour[i] // CORNERS * CORNERS
        for k in range(CORNERS):
            y = first + k
            if inner[y] == np.inf or (i < fixed and y != tour[i]):
                continue
            if i == 0:
                costs[i, k] = start[y] + inner[y]
                continue
            previous = tour[i - 1] // CORNERS * CORNERS
            for j in range(CORNERS):
                cost = costs[i - 1, j] + hops[exits[previous + j], y] + inner[y]
                if cost < costs[i, k]:
                    costs[i, k] = cost
                    before[i, k] = j
    best, k = np.inf, tour[cells - 1] % CORNERS
    for j in range(CORNERS):
        y = tour[cells - 1] // CORNERS * CORNERS + j
        if costs[cells - 1, j] + finish[exits[y]] < best:
            best, k = costs[cells - 1, j] + finish[exits[y]], j
    for i in range(cells - 1, -1, -1):
        tour[i] = tour[i] // CORNERS * CORNERS + k
        k = before[i, k]


@compiled
def improved_tour(tour: NDArray[np.int64], problem: Cells, fixed: int) -> NDArray[np.int64]:
    """Improve a tour until no reversal, no move and no other corner of entry gains.

    Args:
        tour: (C,) corners of entry in order.
        problem: what it costs.
        fixed: how many cells at its start stay as they are, 0 or 1.
    """
    hops, exits, inner, start, finish = problem
    tour = tour.copy()
    cells = tour.size
    ahead = np.zeros(cells)
    back = np.zeros(cells)
    for _ in range(_ROUNDS):
        _reenter(tour, problem, fixed)
        gained = False
        for i in range(fixed, cells):
            if i == fixed or gained:
                ahead[0], back[0] = inner[tour[0]], inner[exits[tour[0]]]
                for j in range(1, cells):
                    one, two = tour[j - 1], tour[j]
                    ahead[j] = ahead[j - 1] + hops[exits[one], two] + inner[two]
                    back[j] = back[j - 1] + hops[two, exits[one]] + inner[exits[two]]
            enter_i = _link(tour, i - 1, i, problem)
            best, best_j, kind, corner = -_GAIN, -1, 0, 0
            for j in range(i, cells):
                # Fly i to j the other way round.
                one, two = tour[i], tour[j]
                leave_j = _link(tour, j, j + 1, problem)
                ahead_ij = ahead[j] - ahead[i] + inner[one]
                back_ij = back[j] - back[i] + inner[exits[one]]
                enter = start[exits[two]] if i == 0 else hops[exits[tour[i - 1]], exits[two]]
                leave = finish[one] if j + 1 == cells else hops[one, tour[j + 1]]
                change = enter + back_ij + leave - enter_i - ahead_ij - leave_j
                if change < best:
                    best, best_j, kind = change, j, 1
            # Fly i elsewhere.
            leave_i = _link(tour, i, i + 1, problem)
            closed = 0.0
            if i == 0 and cells > 1:
                closed = start[tour[1]]
            elif i > 0 and i + 1 == cells:
                closed = finish[exits[tour[i - 1]]]
            elif i > 0:
                closed = hops[exits[tour[i - 1]], tour[i + 1]]
            saved = enter_i + inner[tour[i]] + leave_i - closed
            for j in range(fixed - 1, cells):
                if j == i or j == i - 1:
                    continue
                broken = _link(tour, j, j + 1, problem)
                first = tour[i] // CORNERS * CORNERS
                for k in range(CORNERS):
                    y = first + k
                    if inner[y] == np.inf:
                        continue
                    enter = start[y] if j < 0 else hops[exits[tour[j]], y]
                    leave = finish[exits[y]] if j + 1 == cells else hops[exits[y], tour[j + 1]]
                    change = enter + inner[y] + leave - broken - saved
                    if change < best:
                        best, best_j, kind, corner = change, j, 2, y
            if best_j < 0:
                continue
            gained = True
            if kind == 1:
                low, high = i, best_j
                while low < high:
                    tour[low], tour[high] = exits[tour[high]], exits[tour[low]]
                    low += 1
                    high -= 1
                if low == high:
                    tour[low] = exits[tour[low]]
            elif best_j < i:
                for j in range(i, best_j + 1, -1):
                    tour[j] = tour[j - 1]
                tour[best_j + 1] = corner
            else:
                for j in range(i, best_j):
                    tour[j] = tour[j + 1]
                tour[best_j] = corner
        if not gained:
            break
    return tour


def good_tour(first: NDArray[np.int64], problem: Cells, fixed: int) -> NDArray[np.int64]:
    """A good tour of many cells: improved, shaken and improved again, the best is kept.

    A shake swaps two neighbouring stretches (the double bridge of O. Martin, S. W. Otto and
    E. W. Felten 1991), which no reversal or move undoes. Its places are a fixed sequence.

    Args:
        first: (C,) tour to begin with.
        problem: what it costs.
        fixed: as of `improved_tour`.
    """
    best: NDArray[np.int64] = improved_tour(first, problem, fixed)
    cells = first.size
    if cells - fixed < 4:
        return best
    cost = tour_cost(best, problem)
    number = 1
    cuts = np.empty(3, np.int64)
    for _ in range(min(_SHAKES, _SHAKEN // cells)):
        for k in range(3):
            # Numerical Recipes' linear congruence; its high bits serve.
            number = (1664525 * number + 1013904223) % 4294967296
            cuts[k] = fixed + (number >> 16) % (cells - fixed + 1)
        cuts.sort()
        shaken = np.concatenate(
            (best[: cuts[0]], best[cuts[1] : cuts[2]], best[cuts[0] : cuts[1]], best[cuts[2] :])
        )
        shaken = improved_tour(shaken, problem, fixed)
        other = tour_cost(shaken, problem)
        if other < cost - _GAIN:
            best, cost = shaken, other
    return best
