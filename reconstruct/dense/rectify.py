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

from alice_survey.frames import Array
from reconstruct.model import View

_LEAST_COSINE = 0.75
"""Of the angle by which a view may be turned."""
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
    cosine: Array
    """(3,) row that takes rays of the reference (x, y, 1) to their share along the virtual axis."""

    def range_from_disparity(self, disparity_px: NDArray[np.float32]) -> NDArray[np.float32]:
        """Distance along the virtual optical axis; NaN stays NaN."""
        total = disparity_px + np.float32(self.disparity_offset_px)
        return np.float32(self.focal_px * self.baseline) / total


def intrinsics(view: View) -> Array:
    """The (3, 3) matrix that takes rays in the camera to pixels."""
    return np.array([[view.fx_px, 0.0, view.cx_px], [0.0, view.fy_px, view.cy_px], [0.0, 0.0, 1.0]])


def scaled_view(view: View, scale: float) -> View:
    """The same view in a picture shrunk by a factor (1 keeps it)."""
    from dataclasses import replace

    if scale == 1.0:
        return view
    width, height = round(view.width_px * scale), round(view.height_px * scale)
    sx, sy = width / view.width_px, height / view.height_px
    return replace(
        view,
        width_px=width,
        height_px=height,
        fx_px=view.fx_px * sx,
        cx_px=view.cx_px * sx,
        fy_px=view.fy_px * sy,
        cy_px=view.cy_px * sy,
        shift=None if view.shift is None else view.shift.scaled(sx, sy),
    )


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
    sights = [v.world_from_cam.rotation.apply([0.0, 0.0, 1.0]) for v in (reference, partner)]
    sight = sights[0] + sights[1]
    z_axis = sight - (sight @ x_axis) * x_axis
    if np.linalg.norm(z_axis) < _LEAST_COSINE:
        return None
    z_axis /= np.linalg.norm(z_axis)
    if min(s @ z_axis for s in sights) < _LEAST_COSINE:
        return None
    world_from_rect = Rotation.from_matrix(np.stack([x_axis, np.cross(z_axis, x_axis), z_axis], 1))
    # a picture turned by t is stretched by cos(t)^-3 in area at its middle: undo it on average
    stretch = float(np.prod([(s @ z_axis) ** -1.5 for s in sights])) ** 0.5
    focal = (reference.fx_px + reference.fy_px) / 2.0 / stretch
    turn = (world_from_rect.inv() * reference.world_from_cam.rotation).as_matrix()
    homographies, boxes = [], []
    for view in (reference, partner):
        rotation = (world_from_rect.inv() * view.world_from_cam.rotation).as_matrix()
        homography = np.diag([focal, focal, 1.0]) @ rotation @ np.linalg.inv(intrinsics(view))
        w, h = view.width_px, view.height_px
        corners = np.array([[0.0, 0, 1], [w, 0, 1], [w, h, 1], [0, h, 1]]) @ homography.T
        if corners[:, 2].min() <= 0.2:
            return None
        corners = corners[:, :2] / corners[:, 2:]
        homographies.append(homography)
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
        cosine=turn[2],
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


def rect_pixels(reference: View, rectification: Rectification) -> tuple[Array, Array]:
    """Where each pixel of the reference lies in its virtual picture.

    Returns:
        x and y, (H, W) float32, in OpenCV's pixels, for `cv2.remap`.
    """
    x = np.arange(reference.width_px) + _HALF
    y = np.arange(reference.height_px) + _HALF
    h = rectification.rect_from_reference
    grid_x, grid_y = np.meshgrid(x, y)
    w = h[2, 0] * grid_x + h[2, 1] * grid_y + h[2, 2]
    rect_x = (h[0, 0] * grid_x + h[0, 1] * grid_y + h[0, 2]) / w - _HALF
    rect_y = (h[1, 0] * grid_x + h[1, 1] * grid_y + h[1, 2]) / w - _HALF
    return rect_x.astype(np.float32), rect_y.astype(np.float32)


def depth_in_reference(
    reference: View, rectification: Rectification, disparity_px: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Take a disparity map of the virtual picture to depth along the reference's own axis.

    Args:
        reference: the view.
        rectification: of the pair.
        disparity_px: (h, w) of the virtual left picture, NaN where unknown.

    Returns:
        (H, W) depth, NaN where any of the four virtual pixels around is unknown.
    """
    x, y = rect_pixels(reference, rectification)
    disparity = cv2.remap(
        disparity_px, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan
    )
    reach = rectification.range_from_disparity(disparity)
    rays_x = (np.arange(reference.width_px) + _HALF - reference.cx_px) / reference.fx_px
    rays_y = (np.arange(reference.height_px) + _HALF - reference.cy_px) / reference.fy_px
    c = rectification.cosine
    share = c[0] * rays_x[None, :] + c[1] * rays_y[:, None] + c[2]
    depth: NDArray[np.float32] = (reach / share).astype(np.float32)
    return depth
