"""A robust mean of heights that several views of several stations claim for one place."""

import math

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.compiled import compiled
from alice_survey.core.robust import MAD_TO_SIGMA
from reconstruct.dense.surfaces import sorted_ranks

Float32 = NDArray[np.float32]


@compiled
def robust_height(
    heights: Float32,
    sigmas: Float32,
    views: NDArray[np.int32],
    stations: NDArray[np.int64],
    gate: float,
    shared: float,
) -> tuple[float, float, int, int]:
    """Robust height of some points: the weighted mean of what lies near the median.

    The gate around the median is `gate` times the larger of the scatter (from the MAD) and the
    median's own sigma. The standard deviation adds the formal one to the scatter over the square
    root of the number of views: pixels of one view share their errors, and so do views of which
    one was refined by the other. Views of a single station count as one.

    Args:
        heights: (N,) sorted by view, one or more.
        sigmas: (N,) of the heights.
        views: (N,) of the heights.
        stations: (V,) of every view, by its number.
        gate: in standard deviations.
        shared: views whose depths rest on the same pair of pictures, in the mean, 1 to 2.

    Returns:
        Height and sigma, and number of views and of stations used (255 stands for more).
    """
    order = sorted_ranks(heights)
    half = 0.0
    for i in range(heights.size):
        half += 0.5 / sigmas[i] ** 2
    median_at, below = order[-1], 0.0
    for i in order:
        below += 1.0 / sigmas[i] ** 2
        if below >= half:
            median_at = i
            break
    median = heights[median_at]
    misses = np.empty(heights.size, np.float32)
    for i in range(heights.size):
        misses[i] = abs(heights[i] - median)
    ranks = sorted_ranks(misses)
    middle = heights.size // 2
    scatter = MAD_TO_SIGMA * misses[ranks[middle]]
    if heights.size % 2 == 0:
        scatter = 0.5 * (scatter + MAD_TO_SIGMA * misses[ranks[middle - 1]])
    reach = gate * max(scatter, sigmas[median_at])
    total, weights, squares = 0.0, 0.0, 0.0
    formal, in_view, view_weight, seen, last_view = 0.0, 0, 0.0, 0, -1
    places, companions = np.empty(heights.size, np.int64), 0
    for i in range(heights.size):
        if abs(heights[i] - median) > reach:
            continue
        w = 1.0 / sigmas[i] ** 2
        total += w * (heights[i] - median)
        squares += w * (heights[i] - median) ** 2
        weights += w
        if views[i] != last_view:
            if in_view > 0:
                formal += view_weight / in_view
            last_view, in_view, view_weight = views[i], 0, 0.0
            seen += 1
            place, known = stations[last_view], False
            for k in range(companions):
                known = known or places[k] == place
            if not known:
                places[companions] = place
                companions += 1
        in_view += 1
        view_weight += w
    formal += view_weight / in_view
    if companions == 1:
        formal /= seen  # one pair of pictures, however often looked at
    elif seen > 1:
        formal /= shared
    mean = total / weights
    variance = max(squares / weights - mean * mean, 0.0)
    return median + mean, math.sqrt(1.0 / formal + variance / seen), seen, min(companions, 255)
