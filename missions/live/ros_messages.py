"""Messages of ROS 2 from numbers in NED and FRD, and back.

ROS has ENU worlds and FLU bodies (REP-103); `missions.logs.ros_builder` swaps the axes.
"""

import importlib
import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array
from missions.live.loop import Odometry
from missions.logs.ros_builder import (
    NS_PER_S,
    MessageBuilder,
    flipped_body,
    flipped_quaternion,
    flipped_world,
)

_TURN_RAD = 2.0 * math.pi


@dataclass(frozen=True, kw_only=True)
class RosLibrary:
    """What is used of ROS 2, once it is known to be installed."""

    rclpy: Any
    build: MessageBuilder
    qos: Any
    """Reliable, the last 10 messages."""


def load_ros() -> RosLibrary:
    """Import ROS 2.

    Raises:
        VehicleError: it is not installed.
    """
    try:
        import rclpy
        from rclpy.qos import QoSProfile
    except ImportError as error:
        raise VehicleError(
            f"ROS 2 is not installed ({error}): pip install 'alice-survey[ros]', or source the "
            "setup file of a ROS 2 installation"
        ) from None
    return RosLibrary(rclpy=rclpy, build=MessageBuilder(message_class), qos=QoSProfile(depth=10))


@cache
def message_class(kind: str) -> Any:
    """Class of a message by its name, such as `nav_msgs/msg/Odometry`.

    Raises:
        VehicleError: its package is not installed.
    """
    package, _, name = kind.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except ImportError:
        raise VehicleError(
            f"{package} of ROS 2 is not installed: pip install 'alice-survey[ros]'"
        ) from None


def seconds(stamp: Any) -> float:
    """A stamp of a message as seconds."""
    return float(stamp.sec) + float(stamp.nanosec) / NS_PER_S


def nanoseconds(time_s: float) -> int:
    """Seconds as whole nanoseconds."""
    return round(time_s * NS_PER_S)


def _xyz(vector: Any) -> Array:
    return np.array([vector.x, vector.y, vector.z])


def flipped_pair(vectors: Array) -> Array:
    """Two vectors in a row, (6,), from FRD to FLU or back."""
    return flipped_body(vectors.reshape(2, 3)).ravel()


def odometry_from(message: Any) -> Odometry:
    """Odometry of a `nav_msgs/Odometry`."""
    pose, twist, turn = message.pose.pose, message.twist.twist, message.pose.pose.orientation
    return Odometry(
        stamp_s=seconds(message.header.stamp),
        position_ned=flipped_world(_xyz(pose.position)),
        quaternion_xyzw=flipped_quaternion(np.array([turn.x, turn.y, turn.z, turn.w])),
        velocity_body=flipped_body(_xyz(twist.linear)),
        rates_body=flipped_body(_xyz(twist.angular)),
    )


def odometry_message(
    build: MessageBuilder, odometry: Odometry, body: str, pose_variances: Array
) -> Any:
    """A `nav_msgs/Odometry` in the map.

    Args:
        build: of messages.
        odometry: of the body.
        body: the body's frame.
        pose_variances: (6,) of east, north, up, and of small turns about them.
    """
    return build.odometry(
        nanoseconds(odometry.stamp_s),
        body,
        flipped_world(odometry.position_ned),
        flipped_quaternion(odometry.quaternion_xyzw),
        pose_variances,
        flipped_pair(np.concatenate([odometry.velocity_body, odometry.rates_body])),
    )


def range_from(message: Any) -> float:
    """Metres of a `sensor_msgs/Range`; infinite where it is out of its bounds (REP-117)."""
    value = float(message.range)
    return value if message.min_range <= value <= message.max_range else math.inf


def wrench_from(message: Any) -> Array:
    """(6,) N and N m in the body frame, of a `geometry_msgs/WrenchStamped` in the body's."""
    wrench = message.wrench
    return flipped_pair(np.concatenate([_xyz(wrench.force), _xyz(wrench.torque)]))


def speeds_from(message: Any, thrusters: tuple[str, ...]) -> Array:
    """(n,) rev/s of a `sensor_msgs/JointState`; NaN of a thruster that it does not name."""
    named = dict(zip(message.name, message.velocity, strict=False))
    return np.array([named.get(name, math.nan) for name in thrusters]) / _TURN_RAD


def speeds_message(
    build: MessageBuilder,
    time_s: float,
    thrusters: tuple[str, ...],
    rps: Array,
    thrust_n: Array | None = None,
) -> Any:
    """A `sensor_msgs/JointState`: speeds, (n,) rev/s, in rad/s; thrusts as efforts, both signed."""
    return build.joints(nanoseconds(time_s), thrusters, _TURN_RAD * rps, thrust_n)
