"""Slow, obvious twins of the matching kernels."""

from fractions import Fraction
from math import comb, hypot

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.optimize import least_squares
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist


def match_slowly(
    a: np.ndarray, b: np.ndarray, ratio: float, searched: np.ndarray | None = None
) -> np.ndarray:
    """Mutual nearest neighbours with a ratio test, one pair of descriptors at a time.

    Among the pairs that a (N, M) table allows, where there is one.
    """
    searched = np.ones((len(a), len(b)), bool) if searched is None else searched
    distance = np.where(searched, cdist(a.astype(float), b.astype(float), "sqeuclidean"), np.inf)
    matches = []
    for i in np.flatnonzero(searched.sum(axis=1) >= 2):
        j = int(np.argmin(distance[i]))
        nearest, second = np.sort(distance[i])[:2]
        if int(np.argmin(distance[:, j])) == i and nearest < ratio**2 * second:
            matches.append((i, j))
    return np.array(matches, dtype=np.uint32).reshape(-1, 2)


def track_references_slowly(
    pairs: list[tuple[int, int, np.ndarray]], starts: np.ndarray
) -> np.ndarray:
    """The best connected feature of each track, the first of those as good."""
    linked = np.zeros((starts[-1], starts[-1]), bool)
    for i, j, matches in pairs:
        a, b = matches.T.astype(int)
        linked[starts[i] + a, starts[j] + b] = True
    linked |= linked.T
    _, track = connected_components(linked)
    same = track[:, None] == track
    return np.argmax(np.where(same, linked.sum(axis=0), -1), axis=1)


def align_slowly(
    first: np.ndarray,
    second: np.ndarray,
    reference: np.ndarray,
    pixel: np.ndarray,
    affine: np.ndarray,
    bend: np.ndarray,
    radius: int,
    sigma: float,
) -> np.ndarray:
    """Least squares over position, affine warp, gain and offset by a general solver."""
    v, u = np.mgrid[-radius : radius + 1, -radius : radius + 1].reshape(2, -1).astype(float)
    weight = np.exp(-(u**2 + v**2) / (4 * sigma**2))  # the root of the weight of squares

    def level(picture: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return map_coordinates(picture.astype(float), [y - 0.5, x - 0.5], order=3)

    wanted = level(first, reference[0] + u, reference[1] + v)

    def misses(unknowns: np.ndarray) -> np.ndarray:
        x, y, a, b, c, d, gain, offset = unknowns
        off_x, off_y = bend @ [u * u, u * v, v * v]
        seen = level(second, x + a * u + b * v + off_x, y + c * u + d * v + off_y)
        return weight * (gain * seen + offset - wanted)

    start = np.concatenate([pixel, affine.ravel(), [1.0, 0.0]])
    return least_squares(misses, start, x_scale=[1, 1, 0.1, 0.1, 0.1, 0.1, 0.1, 10]).x[:2]


def vlad_slowly(descriptors: np.ndarray, words: np.ndarray) -> np.ndarray:
    """Sum what descriptors are off their nearest word, word by word, one at a time."""
    off = descriptors.astype(float) - words[:, None]
    nearest = np.argmin(np.linalg.norm(off, axis=2), axis=0)
    sums = np.stack([off[k, nearest == k].sum(axis=0) for k in range(len(words))])
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.divide(sums, length, out=np.zeros_like(sums), where=length > 0).ravel()


def sampled_slowly(field: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Bilinear weights as SciPy has them, one channel at a time."""
    channels = np.moveaxis(field, 2, 0)
    return np.stack(
        [map_coordinates(one, at[:, ::-1].T, order=1, mode="nearest") for one in channels], axis=1
    )


def false_alarms_slowly(agreeing: int, matches: int, size: tuple[int, int]) -> float:
    """Exact binomials and powers of Moisan & Stival's count, for bands of 4 pixels on each side."""
    share = Fraction(8.0 * hypot(*size)) / (size[0] * size[1])
    power = share ** (agreeing - 7)
    return float((matches - 7) * comb(matches, agreeing) * comb(agreeing, 7) * power)
