"""Where one view ends and the next begins: seams laid where neighbours agree.

Each cell of the survey takes one of the few views that see it best. The energy is the sum over
cells of the loss of quality, and over neighbouring cells that take different views of a cost that
grows with how much those two views differ there, so that seams go around what the views show
differently: edges of objects, shadows, things that move. It is lowered by sequential
tree-reweighted message passing (Kolmogorov 2006, TPAMI 28(10)), which takes a data term and many
views in the same sweep and for two views comes close to the minimal cut.

Views are joined along seams in bands, fine detail sharply and broad tones softly: multi-band
blending (Burt & Adelson 1983, "A multiresolution spline with application to image mosaics") with
pyramids that know where a view shows nothing: levels are means over what is valid.
"""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.compiled import compiled
from reconstruct.mosaic.grid import ALIGNED_PX

Float32 = NDArray[np.float32]

MAX_VIEWS = 6
"""Candidates of a cell."""
MIN_SHARE = 0.3
"""Share of the best quality that a candidate must have."""
_SWEEPS = 24
_SEAM_COST = 0.1
"""Cost of a seam along one cell where views agree, in logarithms of quality lost in one cell."""
_DIFFERENCE_COST = 10.0
"""Cost of a seam along one cell where views differ by a factor of e."""
_MAX_DIFFERENCE = 1.0
_UNSETTLING_COST = 1000.0
"""Cost of another view than the one that a cell has already."""


def candidates(
    qualities: Float32, views: NDArray[np.int32]
) -> tuple[NDArray[np.int32], Float32, NDArray[np.int64]]:
    """The best views of each cell.

    Args:
        qualities: (V, H, W), 0 where a view does not see a cell.
        views: (V,) their numbers.

    Returns:
        (H, W, K) numbers, -1 where there are fewer, best first; (H, W, K) qualities over the best;
        and (H, W, K) rows of `qualities`.
    """
    kept = min(MAX_VIEWS, len(views))
    order = np.argsort(-qualities, axis=0, kind="stable")[:kept]
    best = np.take_along_axis(qualities, order, axis=0)
    share = best / np.maximum(best[:1], np.float32(1e-30))
    number = np.where((best > 0) & (share >= MIN_SHARE), views[order], -1)
    return (
        np.ascontiguousarray(number.transpose(1, 2, 0)).astype(np.int32),
        np.ascontiguousarray(share.transpose(1, 2, 0)),
        np.ascontiguousarray(order.transpose(1, 2, 0)),
    )


def choose_views(
    number: NDArray[np.int32],
    share: Float32,
    colours: Float32,
    settled: NDArray[np.int32] | None = None,
) -> NDArray[np.int32]:
    """Index of the candidate that each cell takes, (H, W); -1 where it has none.

    Args:
        number: (H, W, K) views, -1 where there are fewer.
        share: (H, W, K) quality over the best one's.
        colours: (H, W, K, 3) logarithm of what they show there.
        settled: (H, W) views that cells have already, -1 of others, which seams are laid up to.
    """
    own = np.where(number >= 0, -np.log(np.maximum(share, 1e-6)), np.inf).astype(np.float32)
    if settled is not None:
        had = (number == settled[..., None]) & (number >= 0)
        own += np.where(had.any(axis=2, keepdims=True) & ~had, np.float32(_UNSETTLING_COST), 0)
    edges = np.zeros((*number.shape[:2], 2, *2 * number.shape[2:]), np.float32)
    for way, here, there in ((0, np.s_[:, :-1], np.s_[:, 1:]), (1, np.s_[:-1], np.s_[1:])):
        pair = (number[here], number[there]), (colours[here], colours[there])
        edges[here][..., way, :, :] = seam_costs(*pair)
    return _trws(number, own, edges, _SWEEPS)


def seam_costs(
    numbers: tuple[NDArray[np.int32], NDArray[np.int32]], colours: tuple[Float32, Float32]
) -> Float32:
    """Costs (H, W, K, K) between neighbouring cells, by the candidates that one and other take.

    Args:
        numbers: (H, W, K) candidates of the ones, and of the others.
        colours: (H, W, K, 3) what they show.
    """
    same = numbers[0][..., :, None] == numbers[1][..., None, :]
    total = np.zeros(same.shape)
    for side, shown in enumerate(colours):  # how much the two views differ in one of the cells
        match = same if side == 0 else same.swapaxes(-1, -2)
        apart = np.abs(shown[..., :, None, :] - shown[..., None, :, :]).astype(np.float64) / 3.0
        known = (apart[..., 0] + apart[..., 1] + apart[..., 2]) @ match
        cost = np.where(match.any(axis=-2)[..., None, :], known, _MAX_DIFFERENCE)
        cost = np.minimum(cost, _MAX_DIFFERENCE)  # unknown counts as most
        total += cost if side == 0 else cost.swapaxes(-1, -2)
    seam: Float32 = (_SEAM_COST + _DIFFERENCE_COST * 0.5 * total).astype(np.float32)
    return np.where(same, np.float32(0), seam)


@compiled
def _trws(
    number: NDArray[np.int32], own: Float32, edges: NDArray[np.float32], sweeps: int
) -> NDArray[np.int32]:
    """Choose candidates by costs `edges` (H, W, 2, K, K) to the cell to the right, and below."""
    rows, columns, maximum = number.shape
    # messages into a cell come from left, up, right, down
    count = np.zeros((rows, columns), np.int32)
    for r in range(rows):
        for c in range(columns):
            while count[r, c] < maximum and number[r, c, count[r, c]] >= 0:
                count[r, c] += 1
    messages = np.zeros((rows, columns, 4, maximum), np.float32)
    chosen = np.full((rows, columns), -1, np.int32)
    total = np.zeros(maximum)
    for sweep in range(sweeps):
        forward = sweep % 2 == 0
        for i in range(rows * columns):
            at = i if forward else rows * columns - 1 - i
            r, c = at // columns, at % columns
            n = count[r, c]
            if n == 0:
                continue
            for a in range(n):
                total[a] = own[r, c, a]
                for side in range(4):
                    total[a] += messages[r, c, side, a]
            for way in range(2):
                s, d = (r + way, c + 1 - way) if forward else (r - way, c - 1 + way)
                if s < 0 or d < 0 or s >= rows or d >= columns or count[s, d] == 0:
                    continue
                came = (2 + way) if forward else way
                into = way if forward else 2 + way
                minimum = np.inf
                for b in range(count[s, d]):
                    low = np.inf
                    for a in range(n):
                        pair = edges[r, c, way, a, b] if forward else edges[s, d, way, b, a]
                        low = min(low, 0.5 * total[a] - messages[r, c, came, a] + pair)
                    messages[s, d, into, b] = low
                    minimum = min(minimum, low)
                for b in range(count[s, d]):
                    messages[s, d, into, b] -= minimum
    for r in range(rows):
        for c in range(columns):
            lowest = np.inf
            for a in range(count[r, c]):
                cost = own[r, c, a] + messages[r, c, 2, a] + messages[r, c, 3, a]
                if c > 0 and chosen[r, c - 1] >= 0:
                    cost += edges[r, c - 1, 0, chosen[r, c - 1], a]
                if r > 0 and chosen[r - 1, c] >= 0:
                    cost += edges[r - 1, c, 1, chosen[r - 1, c], a]
                if cost < lowest:
                    lowest, chosen[r, c] = cost, a
    return chosen


LEVELS = 4
"""Halvings: the broadest band is blended over some 2^LEVELS pixels, which are `ALIGNED_PX`."""
_NOTHING = np.float32(1e-6)
SUPPORT_PX = 4 * ALIGNED_PX
"""How far a pixel's colour reaches."""


class Blend:
    """A tile as parts are added to it."""

    def __init__(self, rows: int, columns: int) -> None:
        """Sizes in pixels, multiples of `ALIGNED_PX`."""
        sizes = [(rows >> k, columns >> k) for k in range(LEVELS + 1)]
        self._bands = [np.zeros((*size, 3), np.float32) for size in sizes]
        self._weights = [np.zeros(size, np.float32) for size in sizes]

    def add(
        self,
        row: int,
        column: int,
        colour: Float32,
        valid: NDArray[np.bool_],
        taken: NDArray[np.bool_],
    ) -> None:
        """Add a view.

        Args:
            row: of its first pixel in the tile; this and all sizes are multiples of `ALIGNED_PX`.
            column: of it.
            colour: (h, w, 3); any value where not valid.
            valid: (h, w) where the view shows something.
            taken: (h, w) where the tile takes this view; a subset of `valid`.
        """
        weight = taken.astype(np.float32)
        share = valid.astype(np.float32)
        total = colour * share[..., None]
        for level in range(LEVELS + 1):
            height, width = weight.shape
            top, left = row >> level, column >> level
            at = slice(top, top + height), slice(left, left + width)
            mean = total / np.maximum(share, _NOTHING)[..., None]
            if level < LEVELS:
                share_next, total_next = cv2.pyrDown(share), cv2.pyrDown(total)
                band = mean - _expand(total_next, share_next, (width, height))
                share, total = share_next, total_next
            else:
                band = mean
            self._bands[level][at] += weight[..., None] * band
            self._weights[level][at] += weight
            weight = cv2.pyrDown(weight) if level < LEVELS else weight

    def result(self) -> Float32:
        """(rows, columns, 3); 0 where no view is taken near."""
        colour: Float32 = self._bands[-1]
        known: Any = self._weights[-1]
        for level in reversed(range(LEVELS)):
            weight = self._weights[level]
            height, width = weight.shape
            broad = _expand(colour, known, (width, height))
            known = (weight > _NOTHING).astype(np.float32)
            mean = self._bands[level] / np.maximum(weight, _NOTHING)[..., None]
            colour = ((mean + broad) * known[..., None]).astype(np.float32)
        return colour


def _expand(total: Float32, share: Float32, size: tuple[int, int]) -> Float32:
    """Means total / share at twice the size, of what is known alone."""
    known = (share > _NOTHING).astype(np.float32)
    mean = total / np.maximum(share, _NOTHING)[..., None] * known[..., None]
    spread = cv2.pyrUp(known, dstsize=size)
    broad = cv2.pyrUp(mean, dstsize=size) / np.maximum(spread, _NOTHING)[..., None]
    return np.asarray(broad.astype(np.float32))
