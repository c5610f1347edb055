"""Many depths of one view become one, and views check each other.

A depth is accepted where several independent matches agree: partners of one view, then the depth
maps of neighbouring views. What only one match claims and nothing confirms is left out.
"""

import math

import numpy as np
from numpy.typing import NDArray

from alice_survey.base.compiled import compiled
from alice_survey.base.frames import Array
from reconstruct.views.sight import FAST, KernelLens, pixel_at

Float32 = NDArray[np.float32]

_SHIFTED = 0.2
"""Share of half a picture by which no port shifts a pixel: what lies farther out is not seen."""
GATE_SIGMAS = 3.0
"""Depths that differ by no more than this many standard deviations of their difference agree."""


@compiled(error_model="numpy", fastmath=FAST)
def merge_depths(
    depths: Float32, sigmas: Float32, gate: float
) -> tuple[Float32, Float32, NDArray[np.uint8]]:
    """Take the depth that most partners agree on, pixel by pixel.

    Among the depths of a pixel the one with most others within the gate wins (the more certain
    company where numbers are equal); the result is the weighted mean of that company. A pixel at
    which two or more partners have a depth and none agree stays unknown.

    Args:
        depths: (K, H, W) depths from K partners, NaN where unknown.
        sigmas: (K, H, W) their standard deviations.
        gate: largest difference in standard deviations of the difference.

    Returns:
        (H, W) depth and its standard deviation, NaN where unknown, and how many partners agree.
    """
    count, height, width = depths.shape
    merged = np.full((height, width), np.nan, np.float32)
    sigma = np.full((height, width), np.nan, np.float32)
    agreeing = np.zeros((height, width), np.uint8)
    for row in range(height):
        for column in range(width):
            known = 0
            best_company, best_weight, best = 0, 0.0, -1
            for k in range(count):
                z = depths[k, row, column]
                if math.isnan(z):
                    continue
                known += 1
                s = sigmas[k, row, column]
                company, weight = 0, 0.0
                for j in range(count):
                    other = depths[j, row, column]
                    if math.isnan(other):
                        continue
                    t = sigmas[j, row, column]
                    if (z - other) ** 2 <= gate * gate * (s * s + t * t):
                        company += 1
                        weight += 1.0 / (t * t)
                if company > best_company or (company == best_company and weight > best_weight):
                    best_company, best_weight, best = company, weight, k
            if best < 0 or (known > 1 and best_company == 1):
                continue
            z = depths[best, row, column]
            s = sigmas[best, row, column]
            total, weights = 0.0, 0.0
            for j in range(count):
                other = depths[j, row, column]
                if math.isnan(other):
                    continue
                t = sigmas[j, row, column]
                if (z - other) ** 2 <= gate * gate * (s * s + t * t):
                    total += other / (t * t)
                    weights += 1.0 / (t * t)
            merged[row, column] = total / weights
            sigma[row, column] = math.sqrt(1.0 / weights)
            agreeing[row, column] = best_company
    return merged, sigma, agreeing


@compiled(error_model="numpy", fastmath=FAST)
def count_witnesses(
    depth: Float32,
    sigma: Float32,
    slopes: Float32,
    other_from_ref: Array,
    other_depth: Float32,
    other_sigma: Float32,
    other_lens: KernelLens,
    gate: float,
) -> tuple[NDArray[np.int8], NDArray[np.int8]]:
    """See which depths another view confirms and which it sees through.

    Args:
        depth: (H, W) of the reference.
        sigma: (H, W) of it.
        slopes: (H, W, 2) ray slopes of the reference, see `sight.slopes_of`.
        other_from_ref: (3, 4) transform of points from the reference camera to the other.
        other_depth: (h, w) of the other view.
        other_sigma: (h, w) of it.
        other_lens: of the other view.
        gate: largest difference in standard deviations of the difference.

    Returns:
        (H, W) 1 where the other view finds its surface at the same depth, and (H, W) 1 where it
        finds its surface clearly behind, so that the reference's point cannot be there.
    """
    height, width = depth.shape
    confirmed = np.zeros((height, width), np.int8)
    refuted = np.zeros((height, width), np.int8)
    pinhole, t = other_lens[0], other_from_ref
    middle_x, middle_y = 0.5 * other_depth.shape[1], 0.5 * other_depth.shape[0]
    reach_x, reach_y = (1 + _SHIFTED) * middle_x, (1 + _SHIFTED) * middle_y
    for row in range(height):
        for column in range(width):
            z = depth[row, column]
            if math.isnan(z):
                continue
            x, y = slopes[row, column, 0], slopes[row, column, 1]
            a = z * (t[0, 0] * x + t[0, 1] * y + t[0, 2]) + t[0, 3]
            b = z * (t[1, 0] * x + t[1, 1] * y + t[1, 2]) + t[1, 3]
            c = z * (t[2, 0] * x + t[2, 1] * y + t[2, 2]) + t[2, 3]
            if c <= 0.0:
                continue
            at_x = pinhole[0] * a / c + pinhole[2]
            at_y = pinhole[1] * b / c + pinhole[3]
            if abs(at_x - middle_x) > reach_x or abs(at_y - middle_y) > reach_y:
                continue
            at_x, at_y = pixel_at(other_lens, a, b, c)
            u, v = math.floor(at_x), math.floor(at_y)
            if u < 0 or v < 0 or u >= other_depth.shape[1] or v >= other_depth.shape[0]:
                continue
            there = other_depth[v, u]
            if math.isnan(there):
                continue
            s, r = sigma[row, column], other_sigma[v, u]
            tolerance = gate * math.sqrt(s * s + r * r)
            if abs(there - c) <= tolerance:
                confirmed[row, column] = 1
            elif there > c + tolerance:
                refuted[row, column] = 1
    return confirmed, refuted
