"""Depth of a view: semi-global matching with single partners, and what several of them agree on.

A depth is accepted where several independent matches agree: partners of one view, then the depth
maps of neighbouring views. What only one match claims and nothing confirms is left out.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.compiled import compiled
from alice_survey.core.frames import Array
from reconstruct.dense.rectify import Rectification, depth_in_reference, rectify, warp
from reconstruct.dense.view_store import StoredDepth
from reconstruct.views.model import View
from reconstruct.views.range_shift import FAST, KernelLens, warped_at

Float32 = NDArray[np.float32]
Look = tuple[NDArray[np.uint8], NDArray[np.bool_]]
"""A picture of even light, grey (H, W), and which of its pixels may be used, (H, W)."""

MATCH_SIGMA_PX = 0.3
"""Standard deviation of a match that semi-global matching finds, before a survey gives its own."""
_BLOCK_PX = 5
_JUMP_PX = 1.0
"""A step of disparity between neighbours from which on both are taken to mix near and far."""
_SPECKLE_PX = 200
_MIN_SLOPE = 2.0
"""Mean change over two pixels, grey levels, around a pixel that can be matched."""
_STEPS = 16
"""OpenCV counts disparity in sixteenths of a pixel."""
_SHIFTED = 0.2
"""Share of half a picture by which no port shifts a pixel: what lies farther out is not seen."""
GATE_SIGMAS = 3.0
"""Depths that differ by no more than this many standard deviations of their difference agree."""


def match(left: NDArray[np.uint8], right: NDArray[np.uint8], disparities_px: int) -> Float32:
    """Disparity of every pixel of a rectified left picture, NaN where no match is sure.

    Semi-global matching (Hirschmueller 2008) with OpenCV's Birchfield-Tomasi cost, along three
    directions: five or eight change the fused surface by 0.01 mm and cost time and memory.

    Args:
        left: (H, W) grey.
        right: (H, W) grey.
        disparities_px: disparities from 0 to this (a multiple of 16) are searched.
    """
    area = _BLOCK_PX * _BLOCK_PX
    matcher = cv2.StereoSGBM_create(
        minDisparity=0,
        numDisparities=disparities_px,
        blockSize=_BLOCK_PX,
        P1=4 * area,
        P2=24 * area,
        disp12MaxDiff=1,
        preFilterCap=31,
        uniquenessRatio=3,
        speckleWindowSize=_SPECKLE_PX,
        speckleRange=1,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    fixed = matcher.compute(left, right)
    disparity = unrounded(fixed) / np.float32(_STEPS)
    at_end = (disparity < 1) | (disparity > disparities_px - 2)  # the true one may lie beyond
    return np.where(at_end | ~has_texture(left), np.float32(np.nan), disparity)


def has_texture(grey: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Where a rectified picture changes along its rows enough for a match to mean something.

    Without this, an even area takes the smoothest surface that the search allows, and several
    pairs may agree on it.
    """
    slope = cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=1)
    side = 2 * _BLOCK_PX + 1
    mean: Float32 = cv2.boxFilter(np.abs(slope), -1, (side, side))
    return np.asarray(mean >= _MIN_SLOPE)


def unrounded(fixed: NDArray[np.int16]) -> Float32:
    """The mean value, in steps of 1/16 px, of what OpenCV rounds to each step.

    OpenCV adds half a step to the offset from the best whole disparity and truncates towards
    zero. That rounds positive offsets, but lifts negative ones by a whole step (and half of what
    becomes zero), 1/32 px on average over a surface.
    """
    step = fixed % _STEPS
    lift = np.where(step > _STEPS // 2, 1.0, np.where(step == 0, 0.5, 0.0))
    found: Float32 = fixed.astype(np.float32) - lift.astype(np.float32)
    return found


def without_mixed(disparity_px: Float32) -> Float32:
    """Remove the pixels on either side of a step, which mix what is near and what is far."""
    kernel = np.ones((3, 3), np.uint8)
    known = np.isfinite(disparity_px)
    high = cv2.dilate(np.where(known, disparity_px, np.float32(-1e6)), kernel)
    low = cv2.erode(np.where(known, disparity_px, np.float32(1e6)), kernel)
    return np.where(known & (high - low <= _JUMP_PX * 2), disparity_px, np.float32(np.nan))


@dataclass(frozen=True, kw_only=True, eq=False)
class PartnerDepth:
    """Depth of a view from one partner."""

    depth: Float32
    """(H, W) along the view's axis, NaN where unknown."""
    focal_baseline: float
    """Focal length in pixels times baseline, by which disparity becomes depth."""

    def sigma(self, match_sigma_px: float) -> Float32:
        """Standard deviation (H, W) of the depth, for that of a match."""
        return self.depth * self.depth * np.float32(match_sigma_px / self.focal_baseline)


def pair_depth(
    views: tuple[View, View], looks: tuple[Look, Look], points_world: Array
) -> PartnerDepth | None:
    """Depth of a reference view from one partner.

    Args:
        views: the reference, and the partner to match it with.
        looks: what they show.
        points_world: (N, 3) points that bound the depth.

    Returns:
        None where the pair cannot be rectified.
    """
    pair = rectify(*views, points_world)
    if pair is None:
        return None
    (grey, usable), (grey_partner, usable_partner) = looks
    left = warp(grey, pair.rect_from_reference, pair)
    right = warp(grey_partner, pair.rect_from_partner, pair)
    disparity = match(left, right, pair.disparities_px)
    disparity[~_valid(usable, pair.rect_from_reference, pair)] = np.nan
    _drop_outside(disparity, _valid(usable_partner, pair.rect_from_partner, pair))
    depth = depth_in_reference(*views, pair, without_mixed(disparity))
    return PartnerDepth(depth=depth, focal_baseline=pair.focal_px * pair.baseline)


def enlarged(depth: Float32, size_px: tuple[int, int]) -> Float32:
    """Depth, or a standard deviation of it, (H, W) on a picture of a larger size.

    Between four known pixels it is bilinear in the inverse, in which a plane is linear; next to an
    unknown one it is that of the nearest.

    Args:
        depth: (H, W) positive, NaN where unknown.
        size_px: width and height to enlarge to; of the same size it is returned as it is.
    """
    if depth.shape[::-1] == size_px:
        return depth
    between = cv2.resize(1.0 / depth, size_px, interpolation=cv2.INTER_LINEAR)
    nearest = cv2.resize(depth, size_px, interpolation=cv2.INTER_NEAREST)
    known = np.isfinite(between) & np.isfinite(nearest)
    large: Float32 = np.where(known, np.float32(1.0) / between, nearest)
    return large


def _valid(valid: NDArray[np.bool_], homography: Array, pair: Rectification) -> NDArray[np.bool_]:
    mask = valid.astype(np.uint8) * 255
    warped = warp(mask, homography, pair, cv2.INTER_LINEAR)
    return np.asarray(cv2.erode(warped, np.ones((_BLOCK_PX, _BLOCK_PX), np.uint8)) == 255)


def _drop_outside(disparity: Float32, valid_right: NDArray[np.bool_]) -> None:
    rows, columns = np.nonzero(np.isfinite(disparity))
    at = np.rint(columns - disparity[rows, columns]).astype(np.int64)
    inside = (at >= 0) & (at < disparity.shape[1])
    inside[inside] = valid_right[rows[inside], at[inside]]
    disparity[rows[~inside], columns[~inside]] = np.nan


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
            best_company, best_weight, best_total = 0, 0.0, 0.0
            for k in range(count):
                z = depths[k, row, column]
                if math.isnan(z):
                    continue
                known += 1
                s = sigmas[k, row, column]
                company, weight, total = 0, 0.0, 0.0
                for j in range(count):
                    other = depths[j, row, column]
                    if math.isnan(other):
                        continue
                    t = sigmas[j, row, column]
                    if (z - other) ** 2 <= gate * gate * (s * s + t * t):
                        company += 1
                        weight += 1.0 / (t * t)
                        total += other / (t * t)
                if company > best_company or (company == best_company and weight > best_weight):
                    best_company, best_weight, best_total = company, weight, total
            if best_company == 0 or (known > 1 and best_company == 1):
                continue
            merged[row, column] = best_total / best_weight
            sigma[row, column] = math.sqrt(1.0 / best_weight)
            agreeing[row, column] = best_company
    return merged, sigma, agreeing


@compiled(error_model="numpy", fastmath=FAST)
def count_witnesses(
    depth: Float32,
    sigma: Float32,
    slopes: Float32,
    other_from_ref: Array,
    other: StoredDepth,
    factor: float,
    other_lens: KernelLens,
    gate: float,
) -> tuple[NDArray[np.int8], NDArray[np.int8]]:
    """See which depths another view confirms and which it sees through.

    Args:
        depth: (H, W) of the reference.
        sigma: (H, W) of it.
        slopes: (H, W, 2) ray slopes of the reference, see `range_shift.slopes_of`.
        other_from_ref: (3, 4) transform of points from the reference camera to the other.
        other: (h, w) depth of the other view.
        factor: on its standard deviations.
        other_lens: of the other view.
        gate: largest difference in standard deviations of the difference.

    Returns:
        (H, W) 1 where the other view finds its surface at the same depth, and (H, W) 1 where it
        finds its surface clearly behind, so that the reference's point cannot be there.
    """
    height, width = depth.shape
    confirmed = np.zeros((height, width), np.int8)
    refuted = np.zeros((height, width), np.int8)
    levels, shares, depth_of, share_of = other
    rows, columns = levels.shape
    pinhole, field, inverse_working = other_lens
    t = other_from_ref
    middle_x, middle_y = 0.5 * columns, 0.5 * rows
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
            at_x, at_y = warped_at(field, inverse_working, at_x, at_y, 1.0 / c)
            u, v = math.floor(at_x), math.floor(at_y)
            if u < 0 or v < 0 or u >= columns or v >= rows or levels[v, u] == 0:
                continue
            there = depth_of[levels[v, u]]
            s, r = sigma[row, column], factor * there * share_of[shares[v, u]]
            tolerance = gate * math.sqrt(s * s + r * r)
            if abs(there - c) <= tolerance:
                confirmed[row, column] = 1
            elif there > c + tolerance:
                refuted[row, column] = 1
    return confirmed, refuted
