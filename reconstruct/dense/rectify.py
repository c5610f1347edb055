"""Turning two views so that matches lie on one row, and disparities back into depth.

Both views are rotated about their own centres until their x axes point along the baseline and
their optical axes agree (Fusiello, Trucco & Verri 2000, "A compact algorithm for rectification of
stereo pairs"). The reference becomes the left picture whatever the direction of the baseline, so
that a disparity is always positive: `d = f B / Z`.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from alice_survey.core.compiled import compiled
from alice_survey.core.frames import Array
from reconstruct.views.model import View
from reconstruct.views.range_shift import FAST, KernelLens, between_nodes

_MIN_COSINE = 0.75
"""Least cosine of the angle by which a view may be turned."""
_ROUNDS = 2
"""Rounds of depth and the port's shift, which depends on it."""
_HALF = 0.5
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
    corner = np.array([[1.0, 0, _HALF], [0, 1, _HALF], [0, 0, 1]])
    homography = np.linalg.inv(corner) @ rect_from_picture @ corner
    size = (rectification.width_px, rectification.height_px)
    warped: NDArray[np.uint8] = cv2.warpPerspective(picture, homography, size, flags=interpolation)
    return warped


def depth_in_reference(
    reference: View,
    partner: View,
    rectification: Rectification,
    disparity_px: NDArray[np.float32],
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
    corner = np.array([[1.0, 0, _HALF], [0, 1, _HALF], [0, 0, 1]])
    depth: NDArray[np.float32] = triangulate(
        disparity_px,
        reference.pinhole.size_px[::-1],
        reference.kernel_lens,
        partner.kernel_lens,
        np.linalg.inv(corner) @ rectification.rect_from_reference,
        np.linalg.inv(corner) @ rectification.rect_from_partner,
        rectification.cosines,
        rectification.focal_px * rectification.baseline,
        rectification.disparity_offset_px,
    )
    return depth


@compiled(error_model="numpy", fastmath=FAST)
def triangulate(
    disparity_px: NDArray[np.float32],
    shape: tuple[int, int],
    reference: KernelLens,
    partner: KernelLens,
    rect_from_reference: Array,
    rect_from_partner: Array,
    cosines: Array,
    focal_baseline: float,
    offset_px: float,
) -> NDArray[np.float32]:
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
        cosines: as in `Rectification`.
        focal_baseline: of the virtual pictures.
        offset_px: of the disparity.

    Returns:
        (H, W) depth, NaN where unknown.
    """
    rows, columns = disparity_px.shape
    height, width = shape
    depth = np.full(shape, np.nan, np.float32)
    h, g = rect_from_reference, rect_from_partner
    back = np.linalg.inv(g)
    c = cosines
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
