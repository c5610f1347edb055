"""Slow, obvious twins of the matching kernels."""

import numpy as np


def match_slowly(
    a: np.ndarray, b: np.ndarray, ratio: float, searched: np.ndarray | None = None
) -> np.ndarray:
    """Mutual nearest neighbours with a ratio test, one pair of descriptors at a time.

    Among the pairs that a (N, M) table allows, where there is one.
    """
    searched = np.ones((len(a), len(b)), bool) if searched is None else searched
    distance = np.full(searched.shape, np.iinfo(np.int64).max)
    for i, j in np.argwhere(searched):
        distance[i, j] = int(((a[i].astype(int) - b[j].astype(int)) ** 2).sum())
    matches = []
    for i in np.flatnonzero(searched.sum(axis=1) >= 2):
        j = int(np.argmin(distance[i]))
        others = [distance[i, k] for k in np.flatnonzero(searched[i]) if k != j]
        if int(np.argmin(distance[:, j])) == i and distance[i, j] < ratio**2 * min(others):
            matches.append((i, j))
    return np.array(matches, dtype=np.uint32).reshape(-1, 2)


def track_references_slowly(
    pairs: list[tuple[int, int, np.ndarray]], starts: np.ndarray
) -> np.ndarray:
    """Walk each track node by node and take its best connected feature."""
    links: dict[int, set[int]] = {n: set() for n in range(int(starts[-1]))}
    for i, j, matches in pairs:
        for a, b in matches.astype(int):
            links[starts[i] + a].add(int(starts[j] + b))
            links[starts[j] + b].add(int(starts[i] + a))
    reference = np.full(len(links), -1)
    for begin in links:
        if reference[begin] >= 0:
            continue
        track, open_nodes = {begin}, [begin]
        while open_nodes:
            for other in links[open_nodes.pop()] - track:
                track.add(other)
                open_nodes.append(other)
        best = min(track, key=lambda n: (-len(links[n]), n))
        reference[list(track)] = best
    return reference


def align_slowly(
    first: np.ndarray,
    second: np.ndarray,
    reference: np.ndarray,
    pixel: np.ndarray,
    affine: np.ndarray,
    radius: int,
    sigma: float,
) -> np.ndarray:
    """Least squares over position, affine warp, gain and offset by a general solver."""
    from scipy.ndimage import map_coordinates
    from scipy.optimize import least_squares

    steps = np.arange(-radius, radius + 1.0)
    v, u = (x.ravel() for x in np.meshgrid(steps, steps, indexing="ij"))
    weight = np.exp(-(u**2 + v**2) / (4 * sigma**2))  # the root of the weight of squares

    def level(picture: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return map_coordinates(picture.astype(float), [y - 0.5, x - 0.5], order=3)

    wanted = level(first, reference[0] + u, reference[1] + v)

    def misses(unknowns: np.ndarray) -> np.ndarray:
        x, y, a, b, c, d, gain, offset = unknowns
        seen = level(second, x + a * u + b * v, y + c * u + d * v)
        return weight * (gain * seen + offset - wanted)

    start = np.concatenate([pixel, affine.ravel(), [1.0, 0.0]])
    return least_squares(misses, start, x_scale=[1, 1, 0.1, 0.1, 0.1, 0.1, 0.1, 10]).x[:2]


def vlad_slowly(descriptors: np.ndarray, words: np.ndarray) -> np.ndarray:
    """Sum what each descriptor is off its nearest word, word by word, one at a time."""
    sums = np.zeros(words.shape)
    for row in descriptors.astype(float):
        nearest = int(np.argmin(((words - row) ** 2).sum(axis=1)))
        sums[nearest] += row - words[nearest]
    for k in range(len(sums)):
        length = np.linalg.norm(sums[k])
        sums[k] = sums[k] / length if length > 0 else 0.0
    return sums.ravel()


def sampled_slowly(field: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Bilinear weights of all places of a field, one place and channel at a time."""
    rows, columns, channels = field.shape
    found = np.zeros((len(at), channels))
    for n, (x, y) in enumerate(at):
        x, y = min(max(x, 0.0), columns - 1.0), min(max(y, 0.0), rows - 1.0)
        for row in range(rows):
            for column in range(columns):
                weight = max(0.0, 1 - abs(x - column)) * max(0.0, 1 - abs(y - row))
                found[n] += weight * field[row, column]
    return found


def false_alarms_slowly(agreeing: int, matches: int, size: tuple[int, int]) -> float:
    """Exact binomials and powers of Moisan & Stival's count, for bands of 4 pixels on each side."""
    from fractions import Fraction
    from math import comb, hypot

    share = Fraction(8.0 * hypot(*size)) / (size[0] * size[1])
    power = share ** (agreeing - 7)
    return float((matches - 7) * comb(matches, agreeing) * comb(agreeing, 7) * power)
