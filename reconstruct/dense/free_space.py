"""Points of the surface that views see through: what stands in free space is no surface.

Next to the outline of a body matching carries its depth on over what is behind or nothing, the same
way in all views from about there, which confirm each other. Views from other sides see the body
itself beyond such a point.
"""

import math

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.compiled import compiled
from alice_survey.core.frames import Array
from reconstruct.dense.view_store import StoredDepth
from reconstruct.views.range_shift import FAST, KernelLens, warped_at

Float32 = NDArray[np.float32]

_GATE = 3.0
"""Depths that differ by no more than this many standard deviations of their difference agree."""
_MIN_KNOWN = 5
"""Of the nine pixels around a spot, for a view to see through it."""
_FRAME = 1.2
"""Times half a picture up to which a port may shift what is in the frame."""


@compiled(error_model="numpy", fastmath=FAST)
def look_at_points(
    points: Float32,
    sigmas: Float32,
    cam_from_enu: Array,
    depth: StoredDepth,
    factor: float,
    lens: KernelLens,
    cell: float,
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Which points a view finds at their place, and which it sees through.

    A view finds a point where any of the nine pixels around shows the point's depth, and sees
    through it where all that are known show something beyond.

    Args:
        points: (N, 3) east, north, up from an offset.
        sigmas: (N,) of the points.
        cam_from_enu: (3, 4) transform of such points into the view's camera.
        depth: (H, W) of the view.
        factor: on its standard deviations.
        lens: of the view.
        cell: distance between neighbouring points of the surface.

    Returns:
        (N,) 1 where the view finds the point, and (N,) 1 where it sees through it.
    """
    levels, shares, depth_of, share_of = depth
    height, width = levels.shape
    found = np.zeros(points.shape[0], np.uint8)
    through = np.zeros(points.shape[0], np.uint8)
    pinhole, field, inverse_working = lens
    t = cam_from_enu
    for n in range(points.shape[0]):
        e, m, u = points[n, 0], points[n, 1], points[n, 2]
        z = t[2, 0] * e + t[2, 1] * m + t[2, 2] * u + t[2, 3]
        if z <= 0.0:
            continue
        x = pinhole[0] * (t[0, 0] * e + t[0, 1] * m + t[0, 2] * u + t[0, 3]) / z + pinhole[2]
        y = pinhole[1] * (t[1, 0] * e + t[1, 1] * m + t[1, 2] * u + t[1, 3]) / z + pinhole[3]
        if abs(2.0 * x - width) > _FRAME * width or abs(2.0 * y - height) > _FRAME * height:
            continue
        x, y = warped_at(field, inverse_working, x, y, 1.0 / z)
        column, row = math.floor(x), math.floor(y)
        if column < 1 or row < 1 or column >= width - 1 or row >= height - 1:
            continue
        known, beyond, here = 0, 0, False
        for i in range(row - 1, row + 2):
            for j in range(column - 1, column + 2):
                if levels[i, j] == 0:
                    continue
                known += 1
                there = depth_of[levels[i, j]]
                sigma = factor * there * share_of[shares[i, j]]
                tolerance = cell + _GATE * math.sqrt(sigmas[n] ** 2 + sigma**2)
                if abs(there - z) <= tolerance:
                    here = True
                elif there > z:
                    beyond += 1
        if here:
            found[n] = 1
        elif known >= _MIN_KNOWN and beyond == known:
            through[n] = 1
    return found, through
