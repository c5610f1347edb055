"""Fill lines."""

import numpy as np


def fill_table(*a):
    return np.empty((0, 6))
