"""Slow, obvious twins of the mosaic's kernels."""

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.frames import Array


def labels_energy(number: Array, share: Array, colours: Array, chosen: NDArray[np.int32]) -> float:
    """What `choose_views` lowers, by its definition."""
    total = 0.0
    rows, columns = chosen.shape
    for r, c in np.ndindex(rows, columns):
        a = chosen[r, c]
        total -= math.log(share[r, c, a])
        for s, d in ((r + 1, c), (r, c + 1)):
            if s >= rows or d >= columns:
                continue
            b = chosen[s, d]
            if number[r, c, a] == number[s, d, b]:
                continue
            differ = 0.0
            for own, mine, other in (((r, c), a, number[s, d, b]), ((s, d), b, number[r, c, a])):
                found = np.flatnonzero(number[own] == other)
                gap = 1.0
                if len(found):
                    gap = float(np.abs(colours[own][mine] - colours[own][found[0]]).mean())
                differ += min(gap, 1.0)
            total += 0.1 + 10.0 * 0.5 * differ
    return total


def lowest_energy(number: Array, share: Array, colours: Array) -> float:
    """The least energy of all labellings of a small grid."""
    rows, columns, maximum = number.shape
    minimum = math.inf
    for labels in itertools.product(range(maximum), repeat=rows * columns):
        chosen = np.array(labels).reshape(rows, columns)
        minimum = min(minimum, labels_energy(number, share, colours, chosen))
    return minimum
