"""Messages of ROS as rows of numbers: what of each type says where a vehicle was.

Orientations and velocities come out in NED and FRD. They are taken to be ENU and FLU (REP-103)
unless the name of the message's frame holds `ned`, as in COLA2 and Stonefish.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from missions.logs.ros_frames import flipped_body, flipped_quaternion, flipped_world

NAV_STS, ODOMETRY, FIX = "NavSts", "Odometry", "NavSatFix"
IMU, PRESSURE, RANGE, JOINTS = "Imu", "FluidPressure", "Range", "JointState"
NUMBERS = ("Float32", "Float64")

VARIANCES = ("var_north", "var_east", "var_depth", "var_roll", "var_pitch", "var_heading")
ANGLES = ("roll", "pitch", "heading")
QUATERNION = ("qx", "qy", "qz", "qw")
NED = ("north", "east", "down")
VELOCITY, RATES = ("u", "v", "w"), ("p", "q", "r")
PLACE = ("latitude", "longitude")

_NOTHING = math.nan


def _nav_sts(m: Any) -> list[float]:
    place, turn, spread, spin = (
        m.global_position, m.orientation, m.position_variance, m.orientation_variance,
    )  # fmt: skip
    v, rate = m.body_velocity, m.orientation_rate
    return [
        place.latitude, place.longitude, m.position.depth, m.altitude,
        turn.roll, turn.pitch, turn.yaw,
        spread.north, spread.east, spread.depth, spin.roll, spin.pitch, spin.yaw,
        v.x, v.y, v.z, rate.roll, rate.pitch, rate.yaw,
    ]  # fmt: skip


def _odometry(m: Any) -> list[float]:
    """A twist whose covariance begins with a negative number is not given (as in Imu)."""
    p, q = m.pose.pose.position, m.pose.pose.orientation
    v, rate = m.twist.twist.linear, m.twist.twist.angular
    place, turn = np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w])
    motion = np.array([[v.x, v.y, v.z], [rate.x, rate.y, rate.z]])
    if not _is_ned(m):
        place, turn, motion = flipped_world(place), flipped_quaternion(turn), flipped_body(motion)
    if m.twist.covariance[0] < 0:
        motion = np.full((2, 3), _NOTHING)
    c = m.pose.covariance
    return [*place, *turn, *c[[0, 7, 14, 21, 28, 35]], *motion.ravel()]


def _fix(m: Any) -> list[float]:
    """No place without a fix (STATUS_NO_FIX is -1)."""
    if m.status.status < 0:
        return [_NOTHING] * 5
    c, known = m.position_covariance, m.position_covariance_type > 0
    variances = [c[0], c[4]] if known else [_NOTHING, _NOTHING]
    return [m.latitude, m.longitude, m.altitude, *variances]


def _imu(m: Any) -> list[float]:
    q = m.orientation
    if m.orientation_covariance[0] < 0:
        return [_NOTHING] * 4
    turn = np.array([q.x, q.y, q.z, q.w])
    return list(turn if _is_ned(m) else flipped_quaternion(turn))


def _range(m: Any) -> list[float]:
    """Not finite, or outside of what the sensor measures, is no echo (REP-117)."""
    most = m.max_range if m.max_range > 0 else math.inf
    known = math.isfinite(m.range) and m.min_range <= m.range <= most
    return [m.range if known else _NOTHING]


ROWS: Mapping[str, tuple[tuple[str, ...], Callable[[Any], list[float]]]] = {
    NAV_STS: (
        (*PLACE, "depth", "altitude", *ANGLES, *VARIANCES, *VELOCITY, *RATES), _nav_sts,
    ),
    ODOMETRY: ((*NED, *QUATERNION, *VARIANCES, *VELOCITY, *RATES), _odometry),
    FIX: ((*PLACE, "height", "var_north", "var_east"), _fix),
    IMU: (QUATERNION, _imu),
    PRESSURE: (("pressure",), lambda m: [m.fluid_pressure]),
    RANGE: (("altitude",), _range),
} | {kind: (("number",), lambda m: [m.data]) for kind in NUMBERS}  # fmt: skip
"""For each type: the names of the columns, and what takes them from a message."""


def _is_ned(m: Any) -> bool:
    return "ned" in m.header.frame_id.lower()
