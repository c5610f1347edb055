"""Work arrays of the allocation, so that it allocates no memory."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from alice_survey.base.frames import Array


class AllocationScratch(NamedTuple):
    """Work arrays of both solvers; their contents between calls have no meaning."""

    matrices: Array
    """(5, N, N), N the greater of 6 and the number of thrusters."""
    vectors: Array
    """(9, N)"""
    states: NDArray[np.int64]
    """(N,) state of each thruster."""


def allocation_scratch(thrusters: int) -> AllocationScratch:
    """Work arrays for a number of thrusters."""
    size = max(6, thrusters)
    return AllocationScratch(
        np.zeros((5, size, size)), np.zeros((9, size)), np.zeros(size, dtype=np.int64)
    )
