"""From NED and FRD to the frames of ROS (REP-103: ENU world, FLU body), and back.

Both changes of axes are exact in floating point: they swap and negate components. A rotation
`enu_from_flu` is `C_EN * ned_from_frd * C_FB` with the two constant half turns below
(ROS REP-103, "Coordinate Frame Conventions"; REP-105 names the frames).
"""

import numpy as np

from alice_survey.core.frames import Array

_HALF_ROOT = float(np.sqrt(0.5))


def flipped_world(points: Array) -> Array:
    """NED to ENU or back, (..., 3): north and east change places, the vertical its sign."""
    flipped: Array = np.stack([points[..., 1], points[..., 0], -points[..., 2]], axis=-1)
    return flipped


def flipped_body(vectors: Array) -> Array:
    """FRD to FLU or back, (..., 3): the second and third component change sign."""
    flipped: Array = np.stack([vectors[..., 0], -vectors[..., 1], -vectors[..., 2]], axis=-1)
    return flipped


def flipped_quaternion(quaternion_xyzw: Array) -> Array:
    """Quaternion of `ned_from_frd` to that of `enu_from_flu` or back, (..., 4).

    The product of the half turn about (1, 1, 0) / sqrt 2, the quaternion and the half turn about x,
    multiplied out; the sign is chosen so that w is not negative.
    """
    x, y, z, w = np.moveaxis(np.asarray(quaternion_xyzw, dtype=np.float64), -1, 0)
    turned = _HALF_ROOT * np.stack([x + y, x - y, w - z, w + z], axis=-1)
    positive: Array = np.where(turned[..., 3:] < 0, -turned, turned)
    return positive
