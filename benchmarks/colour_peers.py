"""Published ways to correct colours of underwater pictures, in short, for comparison."""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from scipy.optimize import least_squares

from alice_survey.core.frames import Array

_RANGES = 10
"""Clusters of range in which the darkest pixels are looked for."""
_DARK_SHARE = 0.01
_STEP = 7
"""Step between pixels that coefficients are fitted to."""


def grey_world(pictures: Sequence[Array], ranges: Sequence[Array]) -> list[Array]:
    """Each picture by itself: its mean is made grey (Buchsbaum 1980).

    Args:
        pictures: (H, W, 3) linear light.
        ranges: not used.
    """
    means = [picture.mean(axis=(0, 1)) for picture in pictures]
    return [p * (mean.mean() / mean) for p, mean in zip(pictures, means, strict=True)]


def sea_thru(pictures: Sequence[Array], ranges: Sequence[Array]) -> list[Array]:
    """Backscatter and attenuation by range (Akkaynak and Treibitz 2019, "Sea-thru").

    Backscatter `B (1 - exp(-b z)) + J exp(-d z)` through the darkest hundredth of each of ten
    clusters of range (equation 10); attenuation `a exp(b z) + c exp(d z)` (equation 11) through
    the local average of what is left (equations 13 to 16, here a wide blur in place of the average
    over neighbours of like range); grey world at last. Coefficients are those of the whole survey,
    not of one picture, which they suit better; true ranges.

    Args:
        pictures: (H, W, 3) linear light.
        ranges: (H, W) metres.
    """
    light = np.concatenate([p[::_STEP, ::_STEP].reshape(-1, 3) for p in pictures])
    z = np.concatenate([r[::_STEP, ::_STEP].ravel() for r in ranges])
    nearest, farthest = np.percentile(z, [0.5, 99.5])
    edges = np.linspace(nearest, farthest, _RANGES + 1)
    dark = []
    for near, far in pairwise(edges):
        inside = np.flatnonzero((z >= near) & (z < far))
        order = inside[np.argsort(light[inside].sum(axis=1))]
        dark.append(order[: max(1, int(_DARK_SHARE * len(order)))])
    chosen = np.concatenate(dark)
    added = [
        _fitted(
            lambda p, z: p[0] * (1 - np.exp(-p[1] * z)) + p[2] * np.exp(-p[3] * z),
            z[chosen], light[chosen, channel], [0.05, 1.0, 0.02, 1.0], [1.0, 5.0, 1.0, 5.0],
        )
        for channel in range(3)
    ]  # fmt: skip
    left = [
        np.stack([np.maximum(p[..., c] - added[c](r), 1e-4) for c in range(3)], axis=-1)
        for p, r in zip(pictures, ranges, strict=True)
    ]
    wide = [2.0 * cv2.GaussianBlur(p, (0, 0), 0.1 * p.shape[1]) for p in left]
    lamp = np.concatenate([p[::_STEP, ::_STEP].reshape(-1, 3) for p in wide])
    fall = [
        _fitted(
            lambda p, z: (p[0] * np.exp(-p[1] * z) + p[2] * np.exp(-p[3] * z)) * z,
            z, -np.log(np.clip(lamp[:, channel], 1e-4, 1.0)), [1.0, 1.0, 0.5, 0.1],
            [20.0, 5.0, 20.0, 5.0],
        )
        for channel in range(3)
    ]  # fmt: skip
    found = [
        np.stack([p[..., c] * np.exp(fall[c](r)) for c in range(3)], axis=-1)
        for p, r in zip(left, ranges, strict=True)
    ]
    means = np.mean([p.mean(axis=(0, 1)) for p in found], axis=0)
    return [p * (means.mean() / means) for p in found]


def _fitted(
    law: Callable[[Any, Array], Array], z: Array, value: Array, start: list[float],
    maximum: list[float],
) -> Callable[[Array], Array]:  # fmt: skip
    """A law of range through values, by least squares with Huber's weights."""
    scale = max(float(np.median(np.abs(value - np.median(value)))), 1e-4)

    def misses(p: Array) -> Array:
        return law(p, z) - value

    bounds = [0.0] * len(maximum), maximum
    best = least_squares(misses, start, bounds=bounds, loss="huber", f_scale=scale)
    return lambda z: law(best.x, z)
