"""Rotations for compiled code: quaternions xyzw, `ned_from_body`, rows written in place."""

import math

from alice_survey.core.compiled import kernel
from alice_survey.core.frames import Array

Row = tuple[float, float, float]


@kernel
def matrix_rows(x: float, y: float, z: float, s: float) -> tuple[Row, Row, Row]:
    """The rows of the rotation matrix of a unit quaternion."""
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * s), 2 * (x * z + y * s)),
        (2 * (x * y + z * s), 1 - 2 * (x * x + z * z), 2 * (y * z - x * s)),
        (2 * (x * z - y * s), 2 * (y * z + x * s), 1 - 2 * (x * x + y * y)),
    )


@kernel
def matrix_of(quaternion: Array, out: Array) -> None:
    """The rotation matrix, (3, 3) into `out`, of a unit quaternion (4,)."""
    rows = matrix_rows(quaternion[0], quaternion[1], quaternion[2], quaternion[3])
    out[0, 0], out[0, 1], out[0, 2] = rows[0]
    out[1, 0], out[1, 1], out[1, 2] = rows[1]
    out[2, 0], out[2, 1], out[2, 2] = rows[2]


@kernel
def rotate(matrix: Array, x: float, y: float, z: float) -> Row:
    """A rotation matrix, (3, 3), times a vector."""
    return (
        matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z,
        matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z,
        matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z,
    )


@kernel
def rotate_back(matrix: Array, x: float, y: float, z: float) -> Row:
    """The inverse of a rotation matrix, (3, 3), times a vector."""
    return (
        matrix[0, 0] * x + matrix[1, 0] * y + matrix[2, 0] * z,
        matrix[0, 1] * x + matrix[1, 1] * y + matrix[2, 1] * z,
        matrix[0, 2] * x + matrix[1, 2] * y + matrix[2, 2] * z,
    )


@kernel
def turn(quaternion: Array, angle: Array) -> None:
    """Turn a unit quaternion (4,), overwritten, by a rotation vector (3,) in its own body frame.

    q exp(angle) (J. Sola, Quaternion kinematics for the error-state Kalman filter, 2017, 101).
    """
    size = math.sqrt(angle[0] * angle[0] + angle[1] * angle[1] + angle[2] * angle[2])
    half = 0.5 * size
    # sin(half) / size, by its series where that would divide by next to nothing.
    ratio = math.sin(half) / size if size > 1e-4 else 0.5 - half * half / 12.0
    a, b, c, d = ratio * angle[0], ratio * angle[1], ratio * angle[2], math.cos(half)
    x, y, z, s = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    p = s * a + x * d + y * c - z * b
    q = s * b - x * c + y * d + z * a
    r = s * c + x * b - y * a + z * d
    t = s * d - x * a - y * b - z * c
    norm = 1.0 / math.sqrt(p * p + q * q + r * r + t * t)
    quaternion[0], quaternion[1], quaternion[2], quaternion[3] = (
        p * norm, q * norm, r * norm, t * norm,
    )  # fmt: skip


@kernel
def turn_between(before: Array, after: Array, out: Array) -> None:
    """The rotation vector, (3,) into `out`, that takes one unit quaternion (4,) to another.

    In the body frame: log(before* after) (Sola 2017, 105).
    """
    x, y, z, s = -before[0], -before[1], -before[2], before[3]
    a, b, c, d = after[0], after[1], after[2], after[3]
    p = s * a + x * d + y * c - z * b
    q = s * b - x * c + y * d + z * a
    r = s * c + x * b - y * a + z * d
    t = s * d - x * a - y * b - z * c
    if t < 0.0:
        p, q, r, t = -p, -q, -r, -t
    sine = math.sqrt(p * p + q * q + r * r)
    ratio = 2.0 * math.atan2(sine, t) / sine if sine > 1e-9 else 2.0
    out[0], out[1], out[2] = ratio * p, ratio * q, ratio * r


@kernel
def wrap_angle(angle_rad: float) -> float:
    """The same angle between -pi and pi."""
    return angle_rad - 2.0 * math.pi * math.floor(angle_rad / (2.0 * math.pi) + 0.5)
