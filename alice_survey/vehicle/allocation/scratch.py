"""Room in which the allocation works, so that it allocates no memory."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from alice_survey.base.frames import Array


class AllocationScratch(NamedTuple):
    """Work arrays of both solvers; what they hold between calls means nothing."""

    matrices: Array
    """(5, N, N), N the greater of 6 and the number of thrusters."""
    vectors: Array
    """(9, N)"""
    states: NDArray[np.int64]
    """(N,) what each thruster is doing."""


def allocation_scratch(thrusters: int) -> AllocationScratch:
    """Room for so many thrusters."""
    size = max(6, thrusters)
    return AllocationScratch(
        np.zeros((5, size, size)), np.zeros((9, size)), np.zeros(size, dtype=np.int64)
    )
