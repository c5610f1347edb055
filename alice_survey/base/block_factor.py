"""The factor of a large symmetric matrix of blocks, of which each row meets few others.

Nested dissection (A. George 1973, "Nested dissection of a regular finite element mesh"): a small
set of rows separates the others into two halves that do not meet, and so on in each half.
Separators are eliminated after what they separate, each as a dense front (multifrontal method; I.
S. Duff & J. K. Reid 1983, "The multifrontal solution of indefinite sparse symmetric linear
equations"): with A of a front's own rows, B between these and the later ones that they meet, A^-1
and X = A^-1 B are kept, and -B^T X goes to the next front.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from alice_survey.base.frames import Array

Indices = NDArray[np.int64]
_LEAF = 48
"""Rows that are not separated any more."""
_MOST_ONE_SIDED = 0.9
"""Share of the rows on one side above which a separator is of no use."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Front:
    """Rows that are eliminated together."""

    own: Indices
    """(s,) rows."""
    later: Indices
    """(b,) rows that they meet and that are eliminated later, in that order."""
    entries: Indices
    """(e,) blocks of the matrix in these rows, but for those of rows eliminated earlier."""
    mirrored: Indices
    """(e,) the blocks across the diagonal."""
    at: tuple[Indices, Indices]
    """(e,) and (e,): rows and columns of the blocks among `own` and `later`."""
    children: tuple[int, ...]
    """Fronts whose remainders go here."""
    into: tuple[Indices, ...]
    """Of each, where its `later` are among `own` and `later`."""


def fronts_of(pointers: Indices, columns: Indices) -> list[Front]:
    """The fronts of a matrix in the order of elimination, the last one without `later` rows.

    Args:
        pointers: (F + 1,) and (B,): the blocks of every row, and their columns, sorted; the pattern
            is symmetric.
        columns: (B,) of them.
    """
    count = len(pointers) - 1
    rows = np.repeat(np.arange(count), np.diff(pointers))
    owns, families = _separated(csr_array((np.ones(len(columns)), columns, pointers)))
    place, front = np.empty(count, np.int64), np.empty(count, np.int64)
    order = np.concatenate(owns)
    place[order] = np.arange(count)
    front[order] = np.repeat(np.arange(len(owns)), [len(own) for own in owns])
    mine = np.flatnonzero(front[rows] <= front[columns])
    mine = mine[np.argsort(front[rows[mine]], kind="stable")]
    bounds = np.searchsorted(front[rows[mine]], np.arange(len(owns) + 1))
    mirror = np.searchsorted(rows * count + columns, columns * count + rows)
    found: list[Front] = []
    for number, (own, children) in enumerate(zip(owns, families, strict=True)):
        entries = mine[bounds[number] : bounds[number + 1]]
        meets = np.unique(
            np.concatenate([place[columns[entries]], *(place[found[c].later] for c in children)])
        )
        later = order[meets[front[order[meets]] > number]]
        every = np.concatenate([own, later])
        among = np.argsort(place[every])
        places = place[every][among]

        def at(wanted: Indices, among: Indices = among, places: Indices = places) -> Indices:
            return among[np.searchsorted(places, place[wanted])]

        found.append(
            Front(
                own=own, later=later, entries=entries, mirrored=mirror[entries],
                at=(at(rows[entries]), at(columns[entries])), children=children,
                into=tuple(at(found[c].later) for c in children),
            )
        )  # fmt: skip
    return found


def _separated(graph: csr_array) -> tuple[list[Indices], list[tuple[int, ...]]]:
    """Rows of every front in the order of elimination, and which fronts each follows."""
    owns: list[Indices] = []
    families: list[tuple[int, ...]] = []

    def add(nodes: Indices) -> int:
        halves = None if len(nodes) <= _LEAF else _halves(graph[nodes][:, nodes])
        children: tuple[int, ...] = ()
        if halves is not None:
            first, second, nodes_between = (nodes[part] for part in halves)
            children, nodes = (add(first), add(second)), nodes_between
        owns.append(nodes)
        families.append(children)
        return len(owns) - 1

    add(np.arange(graph.shape[0]))
    return owns, families


def _halves(graph: csr_array) -> tuple[NDArray[np.bool_], ...] | None:
    """Two sides that do not meet, and what is between them; None where there is no such.

    By steps from a row at the far end: rows nearer than some number of them, and farther ones.
    """
    steps = dijkstra(graph, unweighted=True, indices=[0])[0]
    if np.isfinite(steps).all():
        steps = dijkstra(graph, unweighted=True, indices=[int(np.argmax(steps))])[0]
    away = np.isinf(steps)
    if away.any():
        return ~away, away, np.zeros(len(steps), np.bool_)
    middle = np.sort(steps)[len(steps) // 2]
    near, level, far = steps < middle, steps == middle, steps > middle
    between = level & (graph @ far.astype(np.float64) > 0)
    near = near | (level & ~between)
    if max(near.sum(), far.sum()) > _MOST_ONE_SIDED * len(steps):
        return None
    return near, far, between


class BlockFactor:
    """A factorised matrix of blocks (B, K, K)."""

    def __init__(self, pointers: Indices, columns: Indices, blocks: Array) -> None:
        """Factorise; the pattern is as in `fronts_of`."""
        self.wide = blocks.shape[1]
        self.fronts = fronts_of(pointers, columns)
        self.inverses: list[Array] = []
        self.follows: list[Array] = []
        waiting: dict[int, Array] = {}
        for number, front in enumerate(self.fronts):
            whole = self._assembled(front, blocks)
            for child, to in zip(front.children, front.into, strict=True):
                at = self._unknowns(to)
                whole[np.ix_(at, at)] += waiting.pop(child)
            split = self.wide * len(front.own)
            across = whole[:split, split:]
            inverse = _inverse(whole[:split, :split])
            follow = inverse @ across
            self.inverses.append(inverse)
            self.follows.append(follow)
            waiting[number] = whole[split:, split:] - across.T @ follow

    def solve(self, right: Array) -> Array:
        """Solve for (F, K, R) right-hand sides."""
        found = right.copy()
        for front, _, follow in self._each():
            pull = follow.T @ self._flat(found[front.own])
            found[front.later] -= pull.reshape(len(front.later), *right.shape[1:])
        for front, inverse, follow in reversed(list(self._each())):
            own = inverse @ self._flat(found[front.own]) - follow @ self._flat(found[front.later])
            found[front.own] = own.reshape(len(front.own), *right.shape[1:])
        return found

    def inverse_blocks(self, blocks: int) -> Array:
        """(B, K, K) blocks of the inverse, where the matrix has blocks.

        Backwards through the elimination: with Z the inverse of the later rows that a front meets,
        which is known by then, it is -X Z between these and its own, and A^-1 + X Z X^T of its own
        (K. Takahashi, J. Fagan & M.-S. Chin 1973, "Formation of a sparse bus impedance matrix").

        Args:
            blocks: B.
        """
        found = np.zeros((blocks, self.wide, self.wide))
        later: dict[int, Array] = {len(self.fronts) - 1: np.zeros((0, 0))}
        for number in range(len(self.fronts) - 1, -1, -1):
            front, follow, known = self.fronts[number], self.follows[number], later.pop(number)
            across = -follow @ known
            own = self.inverses[number] - across @ follow.T
            whole = np.block([[own, across], [across.T, known]])
            for child, to in zip(front.children, front.into, strict=True):
                at = self._unknowns(to)
                later[child] = whole[np.ix_(at, at)]
            shape = (len(whole) // max(1, self.wide), self.wide) * 2
            row, column = front.at
            values = whole.reshape(shape)[row, :, column, :]
            found[front.entries] = values
            found[front.mirrored] = values.swapaxes(1, 2)
        return found

    def _each(self) -> Iterator[tuple[Front, Array, Array]]:
        return zip(self.fronts, self.inverses, self.follows, strict=True)

    def _assembled(self, front: Front, blocks: Array) -> Array:
        size = len(front.own) + len(front.later)
        whole = np.zeros((size, self.wide, size, self.wide))
        row, column = front.at
        whole[row, :, column, :] = blocks[front.entries]
        return whole.reshape(size * self.wide, size * self.wide)

    def _unknowns(self, rows: Indices) -> Indices:
        found: Indices = (self.wide * rows[:, None] + np.arange(self.wide)).ravel()
        return found

    def _flat(self, rows: Array) -> Array:
        return rows.reshape(len(rows) * self.wide, rows.shape[2])


def _inverse(matrix: Array) -> Array:
    """Inverse of a symmetric matrix whose unknowns have many units."""
    size = np.sqrt(np.abs(np.diag(matrix)))
    scale = 1.0 / np.where(size > 0, size, 1.0)
    weight = np.outer(scale, scale)
    inverse: Array = np.linalg.inv(matrix * weight) * weight
    return 0.5 * (inverse + inverse.T)
