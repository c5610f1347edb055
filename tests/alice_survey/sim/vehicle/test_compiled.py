"""Kernels of the vehicle allocate nothing."""

import numpy as np
import pytest
from numba.core.errors import TypingError

import alice_survey.sim.vehicle.compiled as compiled


def test_a_kernel_cannot_allocate() -> None:
    def allocates(x: float) -> float:
        return float(np.zeros(3)[0] + x)

    with pytest.raises(TypingError):
        compiled.kernel(allocates)(1.0)
