"""Depth of a reference view from one partner by semi-global matching."""

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.base.frames import Array
from reconstruct.dense.rectify import Rectification, depth_in_reference, rectify, warp
from reconstruct.views.model import View

MATCH_SIGMA_PX = 0.3
"""Standard deviation of a match that semi-global matching finds, before a survey gives its own."""
_BLOCK_PX = 5
_JUMP_PX = 1.0
"""A step of disparity between neighbours from which on both are taken to mix near and far."""
_SPECKLE_PX = 200
_LEAST_SLOPE = 2.0
"""Mean change over two pixels, grey levels, around a pixel that can be matched."""
_STEPS = 16
"""OpenCV counts disparity in sixteenths of a pixel."""


def match(
    left: NDArray[np.uint8], right: NDArray[np.uint8], disparities_px: int
) -> NDArray[np.float32]:
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
    mean: NDArray[np.float32] = cv2.boxFilter(np.abs(slope), -1, (side, side))
    return np.asarray(mean >= _LEAST_SLOPE)


def unrounded(fixed: NDArray[np.int16]) -> NDArray[np.float32]:
    """The mean value, in steps of 1/16 px, of what OpenCV rounds to each step.

    OpenCV adds half a step to the offset from the best whole disparity and truncates towards
    zero. That rounds positive offsets, but lifts negative ones by a whole step (and half of what
    becomes zero), 1/32 px on average over a surface.
    """
    step = fixed % _STEPS
    lift = np.where(step > _STEPS // 2, 1.0, np.where(step == 0, 0.5, 0.0))
    found: NDArray[np.float32] = fixed.astype(np.float32) - lift.astype(np.float32)
    return found


def without_mixed(disparity_px: NDArray[np.float32]) -> NDArray[np.float32]:
    """Remove the pixels on either side of a step, which mix what is near and what is far."""
    kernel = np.ones((3, 3), np.uint8)
    known = np.isfinite(disparity_px)
    high = cv2.dilate(np.where(known, disparity_px, np.float32(-1e6)), kernel)
    low = cv2.erode(np.where(known, disparity_px, np.float32(1e6)), kernel)
    return np.where(known & (high - low <= _JUMP_PX * 2), disparity_px, np.float32(np.nan))


def pair_depth(
    reference: View,
    partner: View,
    grey_reference: NDArray[np.uint8],
    grey_partner: NDArray[np.uint8],
    valid_reference: NDArray[np.bool_],
    valid_partner: NDArray[np.bool_],
    points_world: Array,
    match_sigma_px: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
    """Depth of the reference from one partner.

    Args:
        reference: view to find depth for.
        partner: view to match with.
        grey_reference: (H, W) picture of even light.
        grey_partner: of the partner.
        valid_reference: (H, W) which pixels may be used.
        valid_partner: of the partner.
        points_world: (N, 3) points that bound the depth.
        match_sigma_px: standard deviation of a match.

    Returns:
        (H, W) depth along the reference's axis and its standard deviation, NaN where unknown; None
        where the pair cannot be rectified.
    """
    pair = rectify(reference, partner, points_world)
    if pair is None:
        return None
    left = warp(grey_reference, pair.rect_from_reference, pair)
    right = warp(grey_partner, pair.rect_from_partner, pair)
    disparity = match(left, right, pair.disparities_px)
    inside = _valid(valid_reference, pair.rect_from_reference, pair)
    disparity[~inside] = np.nan
    _drop_outside(disparity, _valid(valid_partner, pair.rect_from_partner, pair))
    depth, _ = depth_in_reference(reference, partner, pair, without_mixed(disparity))
    sigma = depth * depth * np.float32(match_sigma_px / (pair.focal_px * pair.baseline))
    return depth, sigma


def _valid(valid: NDArray[np.bool_], homography: Array, pair: Rectification) -> NDArray[np.bool_]:
    mask = valid.astype(np.uint8) * 255
    warped = warp(mask, homography, pair, cv2.INTER_LINEAR)
    return np.asarray(cv2.erode(warped, np.ones((_BLOCK_PX, _BLOCK_PX), np.uint8)) == 255)


def _drop_outside(disparity: NDArray[np.float32], valid_right: NDArray[np.bool_]) -> None:
    rows, columns = np.nonzero(np.isfinite(disparity))
    at = np.rint(columns - disparity[rows, columns]).astype(np.int64)
    inside = (at >= 0) & (at < disparity.shape[1])
    inside[inside] = valid_right[rows[inside], at[inside]]
    disparity[rows[~inside], columns[~inside]] = np.nan
