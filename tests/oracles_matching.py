"""Slow, obvious twins of the matching kernels."""

import numpy as np


def match_slowly(a: np.ndarray, b: np.ndarray, ratio: float) -> np.ndarray:
    """Mutual nearest neighbours with a ratio test, one pair of descriptors at a time."""
    distance = np.array([[int(((x.astype(int) - y.astype(int)) ** 2).sum()) for y in b] for x in a])
    matches = []
    for i in range(len(a)):
        j = int(np.argmin(distance[i]))
        others = [distance[i, k] for k in range(len(b)) if k != j]
        if int(np.argmin(distance[:, j])) != i:
            continue
        if distance[i, j] < ratio**2 * min(others):
            matches.append((i, j))
    return np.array(matches, dtype=np.uint32).reshape(-1, 2)
