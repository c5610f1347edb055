"""A small cloud of many nodes, as the dense stage would write it."""

import numpy as np

STEP_M = 1e-4
SPACING_M = 0.02


def rippled(length_m: float, width_m: float) -> np.ndarray:
    """(N, 3) points of a rippled floor about zero."""
    x, y = np.meshgrid(
        np.arange(-length_m / 2, length_m / 2, SPACING_M),
        np.arange(-width_m / 2, width_m / 2, SPACING_M),
    )
    z = 0.05 * np.sin(9 * x) * np.cos(7 * y)
    return np.stack([x, y, z], axis=-1).reshape(-1, 3)
