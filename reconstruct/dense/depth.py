"""Depth of a view: semi-global matching with single partners, and what several of them agree on.

A depth is accepted where several independent matches agree: partners of one view, then the depth
maps of neighbouring views. What only one match claims and nothing confirms is left out.

Two views are turned so that matches lie on one row, and disparities become depth. Both views are
rotated about their own centres until their x axes point along the baseline and their optical axes
agree (Fusiello, Trucco & Verri 2000, "A compact algorithm for rectification of stereo pairs"). The
reference becomes the left picture whatever the direction of the baseline, so that a disparity is
always positive: `d = f B / Z`.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from alice_survey.core.compiled import compiled
from alice_survey.core.frames import Array
from reconstruct.dense.refine_depth import known_span
from reconstruct.dense.view_store import StoredDepth
from reconstruct.views.model import View
from reconstruct.views.range_shift import FAST, KernelLens, between_nodes, warped_at

_MIN_COSINE = 0.75
"""Least cosine of the angle by which a view may be turned."""
_ROUNDS = 2
"""Rounds of depth and the port's shift, which depends on it."""
_FROM_CORNER = np.array([[1.0, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
"""OpenCV counts pixels from the first pixel's centre, the model from its outer corner."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Rectification:
    """A pair of virtual pictures with a common rotation, focal length and rows."""

    rect_from_reference: Array
    """(3, 3) homography of pixels, model convention, from the reference to its virtual picture."""
    rect_from_partner: Array
    width_px: int
    height_px: int
    focal_px: float
    baseline: float
    disparity_offset_px: float
    """Disparity of a match that lies in the same column of both virtual pictures."""
    disparities_px: int
    """How many whole disparities from `disparity_offset_px` on are to be searched."""
    cosines: Array
    """(2, 3) rows that take rays (x, y, 1) of reference and partner to their shares along the
    virtual axis."""


def rectify(reference: View, partner: View, points_world: Array) -> Rectification | None:
    """Find the virtual pictures of a pair that hold what both see.

    Args:
        reference: the left one after rectification.
        partner: the right one.
        points_world: (N, 3) points of the scene that bound the search for disparities.

    Returns:
        None where the views share too little, or look too much along their baseline.
    """
    base = partner.world_from_cam.translation - reference.world_from_cam.translation
    baseline = float(np.linalg.norm(base))
    x_axis = base / baseline
    axes = [v.world_from_cam.rotation.apply([0.0, 0.0, 1.0]) for v in (reference, partner)]
    mean = axes[0] + axes[1]
    z_axis = mean - (mean @ x_axis) * x_axis
    if np.linalg.norm(z_axis) < _MIN_COSINE:
        return None
    z_axis /= np.linalg.norm(z_axis)
    if min(s @ z_axis for s in axes) < _MIN_COSINE:
        return None
    world_from_rect = Rotation.from_matrix(np.stack([x_axis, np.cross(z_axis, x_axis), z_axis], 1))
    # a picture turned by t is stretched by cos(t)^-3 in area at its middle: undo it on average
    stretch = float(np.prod([(s @ z_axis) ** -1.5 for s in axes])) ** 0.5
    focal = reference.pinhole.focal_px / stretch
    homographies, boxes, cosines = [], [], []
    for view in (reference, partner):
        rotation = (world_from_rect.inv() * view.world_from_cam.rotation).as_matrix()
        homography = np.diag([focal, focal, 1.0]) @ rotation @ np.linalg.inv(view.pinhole.matrix)
        w, h = view.pinhole.size_px
        corners = np.array([[0.0, 0, 1], [w, 0, 1], [w, h, 1], [0, h, 1]]) @ homography.T
        if corners[:, 2].min() <= 0.2:
            return None
        corners = corners[:, :2] / corners[:, 2:]
        homographies.append(homography)
        cosines.append(rotation[2])
        boxes.append((corners.min(axis=0), corners.max(axis=0)))

    depth = (points_world - reference.world_from_cam.translation) @ z_axis
    depth = depth[depth > 0]
    if depth.size == 0:
        return None
    nearest, farthest = np.percentile(depth, [0.5, 99.5])
    low, high = focal * baseline / farthest, focal * baseline / nearest
    margin = 0.15 * (high - low) + 4.0  # tops of rocks have no sparse point
    low, high = max(low - margin, 1.0), high + margin
    count = int(-(-(high - low) // 16) * 16)
    offset = float(np.floor((low + high - count) / 2.0))

    (left_min, left_max), (right_min, right_max) = boxes
    top, bottom = max(left_min[1], right_min[1]), min(left_max[1], right_max[1])
    start = max(left_min[0], right_min[0] + low) - count  # SGBM leaves that many columns empty
    end = min(left_max[0], right_max[0] + high)
    width, height = int(end - start), int(bottom - top)
    if width < count + 32 or height < 32:
        return None
    shift = np.array([[1.0, 0, -np.floor(start)], [0, 1, -np.floor(top)], [0, 0, 1]])
    shift_partner = shift.copy()
    shift_partner[0, 2] += offset
    return Rectification(
        rect_from_reference=shift @ homographies[0],
        rect_from_partner=shift_partner @ homographies[1],
        width_px=width,
        height_px=height,
        focal_px=focal,
        baseline=baseline,
        disparity_offset_px=offset,
        disparities_px=count,
        cosines=np.array(cosines),
    )


def warp(
    picture: NDArray[np.uint8],
    rect_from_picture: Array,
    rectification: Rectification,
    interpolation: int = cv2.INTER_CUBIC,
) -> NDArray[np.uint8]:
    """Resample a picture into its virtual one; 0 beyond its rim."""
    homography = _FROM_CORNER @ rect_from_picture @ np.linalg.inv(_FROM_CORNER)
    size = (rectification.width_px, rectification.height_px)
    return np.asarray(cv2.warpPerspective(picture, homography, size, flags=interpolation))


def mirror(pair: Rectification) -> Rectification:
    """The pair with its partner as the left picture: both virtual pictures seen in a mirror."""
    turn = np.array([[-1.0, 0, pair.width_px], [0, 1, 0], [0, 0, 1]])
    return replace(
        pair,
        rect_from_reference=turn @ pair.rect_from_partner,
        rect_from_partner=turn @ pair.rect_from_reference,
        cosines=pair.cosines[::-1].copy(),
    )


def depth_in_reference(
    reference: View, partner: View, rectification: Rectification, disparity_px: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Take a disparity map of the virtual picture to depth along the reference's own axis.

    Args:
        reference: the view.
        partner: the other view of the pair.
        rectification: of the pair.
        disparity_px: (h, w) of the virtual left picture, NaN where unknown.

    Returns:
        (H, W) depth, NaN where any of the four virtual pixels around is unknown.
    """
    rect_from_partner = _FROM_CORNER @ rectification.rect_from_partner
    return triangulate(
        disparity_px,
        reference.pinhole.size_px[::-1],
        reference.kernel_lens,
        partner.kernel_lens,
        _FROM_CORNER @ rectification.rect_from_reference,
        rect_from_partner,
        np.linalg.inv(rect_from_partner),
        rectification.cosines,
        rectification.focal_px * rectification.baseline,
        rectification.disparity_offset_px,
    )


@compiled(error_model="numpy", fastmath=FAST)
def triangulate(
    disparity_px: NDArray[np.float32], shape: tuple[int, int], reference: KernelLens,
    partner: KernelLens, rect_from_reference: Array, rect_from_partner: Array,
    partner_from_rect: Array, cosines: Array, focal_baseline: float, offset_px: float,
) -> NDArray[np.float32]:  # fmt: skip
    """Depth of every pixel from the two refracted rays of its match.

    A match says which pixels p and q of the two warped pictures show one spot. Where the pinholes
    see it depends on its depth, which the pair of pinhole pixels gives: two rounds, of which each
    gains the ratio of the port's shift to the disparity (under 0.01), settle it.

    Args:
        disparity_px: (h, w) of the virtual left picture, NaN where unknown.
        shape: rows and columns of the reference.
        reference: its lens.
        partner: its lens.
        rect_from_reference: (3, 3) from the model's pixels to the virtual picture's array indices.
        rect_from_partner: (3, 3) rotation of the partner.
        partner_from_rect: its inverse.
        cosines: as in `Rectification`.
        focal_baseline: of the virtual pictures.
        offset_px: of the disparity.

    Returns:
        (H, W) depth, NaN where unknown.
    """
    rows, columns = disparity_px.shape
    height, width = shape
    depth = np.full(shape, np.nan, np.float32)
    h, g, back, c = rect_from_reference, rect_from_partner, partner_from_rect, cosines
    pinhole, other = reference[0], partner[0]
    near, far = reference[2], partner[2]
    for row in range(height):
        y = row + 0.5
        for column in range(width):
            x = column + 0.5
            w = 1.0 / (h[2, 0] * x + h[2, 1] * y + h[2, 2])
            left = (h[0, 0] * x + h[0, 1] * y + h[0, 2]) * w
            level = (h[1, 0] * x + h[1, 1] * y + h[1, 2]) * w
            if not (0.0 <= left < columns - 1 and 0.0 <= level < rows - 1):
                continue
            i, j = int(level), int(left)
            b, a = level - i, left - j
            above = (1 - a) * disparity_px[i, j] + a * disparity_px[i, j + 1]
            below = (1 - a) * disparity_px[i + 1, j] + a * disparity_px[i + 1, j + 1]
            disparity = (1 - b) * above + b * below
            if not disparity + offset_px > 0.0:  # NaN as well
                continue
            ray = c[0, 2] + c[0, 0] * (x - pinhole[2]) / pinhole[0]
            ray += c[0, 1] * (y - pinhole[3]) / pinhole[1]
            shifted = disparity + offset_px  # of the two pinhole pixels
            px, py = x, y
            if near != 0.0 or far != 0.0:
                right = left - disparity
                w = 1.0 / (back[2, 0] * right + back[2, 1] * level + back[2, 2])
                u = (back[0, 0] * right + back[0, 1] * level + back[0, 2]) * w
                v = (back[1, 0] * right + back[1, 1] * level + back[1, 2]) * w
                other_ray = c[1, 2] + c[1, 0] * (u - other[2]) / other[0]
                other_ray += c[1, 1] * (v - other[3]) / other[1]
                ax, ay, _, _, _, _ = between_nodes(reference[1], x, y)
                bx, by, _, _, _, _ = between_nodes(partner[1], u, v)
                for _ in range(_ROUNDS):
                    inverse_reach = shifted / focal_baseline
                    step = ray * inverse_reach - near
                    px, py = x + ax * step, y + ay * step
                    step = other_ray * inverse_reach - far
                    qx, qy = u + bx * step, v + by * step
                    w = 1.0 / (h[2, 0] * px + h[2, 1] * py + h[2, 2])
                    here = (h[0, 0] * px + h[0, 1] * py + h[0, 2]) * w
                    w = 1.0 / (g[2, 0] * qx + g[2, 1] * qy + g[2, 2])
                    there = (g[0, 0] * qx + g[0, 1] * qy + g[0, 2]) * w
                    shifted = here - there + offset_px
                ray = c[0, 2] + c[0, 0] * (px - pinhole[2]) / pinhole[0]
                ray += c[0, 1] * (py - pinhole[3]) / pinhole[1]
            z = focal_baseline / (shifted * ray)
            if z > 0.0:
                depth[row, column] = z
    return depth


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
_CODES = 32
"""What `undo_rounding` makes of them are thirty-seconds."""
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
    disparity = undo_rounding(fixed) / np.float32(_STEPS)
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


def undo_rounding(fixed: NDArray[np.int16]) -> Float32:
    """The mean value, in steps of 1/16 px, of what OpenCV rounds to each step.

    OpenCV adds half a step to the offset from the best whole disparity and truncates towards
    zero. That rounds positive offsets, but lifts negative ones by a whole step (and half of what
    becomes zero), 1/32 px on average over a surface.
    """
    step = fixed % _STEPS
    lift = np.where(step > _STEPS // 2, 1.0, np.where(step == 0, 0.5, 0.0))
    return fixed.astype(np.float32) - lift.astype(np.float32)


def without_mixed(disparity_px: Float32) -> Float32:
    """Remove the pixels on either side of a step, which mix what is near and what is far."""
    known, span = known_span(disparity_px, 3)
    return np.where(known & (span <= _JUMP_PX * 2), disparity_px, np.float32(np.nan))


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


class PairMatch(NamedTuple):
    """What the virtual pictures of a pair show at which disparity."""

    pair: Rectification
    codes: NDArray[np.uint16]
    """(h, w) disparity of the left one, 32 a pixel, 0 where unknown."""

    def depth(self, reference: View, partner: View) -> PartnerDepth:
        """Depth of the reference."""
        disparity = np.where(self.codes > 0, self.codes * np.float32(1 / _CODES), np.nan)
        depth = depth_in_reference(reference, partner, self.pair, disparity.astype(np.float32))
        return PartnerDepth(depth=depth, focal_baseline=self.pair.focal_px * self.pair.baseline)

    def swap(self) -> "PairMatch":
        """The same of the partner: where it shows what the reference was matched with."""
        return PairMatch(mirror(self.pair), as_partner(self.codes))


@compiled
def as_partner(codes: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """A map of disparity as the right virtual picture has it, both mirrored left to right.

    Between neighbours in the left picture it is linear, and it ends half a pixel beyond the last;
    where two surfaces fall on one pixel the nearer one counts.
    """
    height, width = codes.shape
    found, wide = np.zeros_like(codes), codes.astype(np.int64)
    for row in range(height):
        goes_on = False
        for column in range(width):
            here, after = int(wide[row, column]), int(wide[row, min(column + 1, width - 1)])
            start = _CODES * column - here  # where the right picture has it
            first = start if goes_on else start - _CODES // 2 + 1
            goes_on = here > 0 and after > 0 and 0 < _CODES + here - after < 2 * _CODES
            span, rise = (_CODES + here - after, after - here) if goes_on else (_CODES // 2, 0)
            if here == 0:
                continue
            for right in range(max(-(-first // _CODES), 0), (start + span) // _CODES + 1):
                share = max(_CODES * right - start, 0) / span
                code = np.uint16(here + share * rise + 0.5)
                found[row, width - 1 - right] = max(found[row, width - 1 - right], code)
    return found


def pair_depth(
    views: tuple[View, View], looks: tuple[Look, Look], points_world: Array
) -> PartnerDepth | None:
    """Depth of a reference view from one partner; None where the pair cannot be rectified."""
    found = match_pair(views, looks, points_world)
    return None if found is None else found.depth(*views)


def match_pair(
    views: tuple[View, View], looks: tuple[Look, Look], points_world: Array
) -> PairMatch | None:
    """Match two views.

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
    codes = np.nan_to_num(without_mixed(disparity) * np.float32(_CODES))
    return PairMatch(pair, np.rint(codes).astype(np.uint16))


def enlarge(depth: Float32, size_px: tuple[int, int]) -> Float32:
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
    return np.asarray(np.where(known, np.float32(1.0) / between, nearest))


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
def count_confirming(
    depth: Float32, sigma: Float32, slopes: Float32, other_from_ref: Array, other: StoredDepth,
    factor: float, other_lens: KernelLens, gate: float,
) -> tuple[NDArray[np.int8], NDArray[np.int8]]:  # fmt: skip
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
