"""Messages of ROS 2 from numbers in NED and FRD, and back.

ROS has ENU worlds and FLU bodies (REP-103); `missions.logs.ros_frames` swaps the axes.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from alice_survey.base.errors import VehicleError
from alice_survey.base.frames import Array
from missions.live.loop import Odometry
from missions.logs.bag import MAP
from missions.logs.ros_frames import flipped_body, flipped_quaternion, flipped_world

_NS_PER_S = 1_000_000_000
TURN_RAD = 2.0 * math.pi


@dataclass(frozen=True, kw_only=True)
class Ros:
    """The modules of ROS 2 that are used, once they are known to be installed."""

    rclpy: Any
    messages: Any
    """A namespace of message classes."""
    qos: Any
    """Reliable, the last 10 messages."""


def load_ros() -> Ros:
    """Import ROS 2.

    Raises:
        VehicleError: it is not installed.
    """
    from types import SimpleNamespace

    try:
        import rclpy
        from builtin_interfaces.msg import Time
        from geometry_msgs.msg import TwistWithCovarianceStamped, WrenchStamped
        from nav_msgs.msg import Odometry as OdometryMessage
        from rclpy.qos import QoSProfile
        from rosgraph_msgs.msg import Clock
        from sensor_msgs.msg import Imu, JointState, Range
        from std_msgs.msg import String
    except ImportError as error:
        raise VehicleError(
            f"ROS 2 is not installed ({error}): pip install 'alice-survey[ros]', or source the "
            "setup file of a ROS 2 installation"
        ) from None
    messages = SimpleNamespace(
        Time=Time, Twist=TwistWithCovarianceStamped, Wrench=WrenchStamped,
        Odometry=OdometryMessage, Clock=Clock, Imu=Imu, JointState=JointState, Range=Range,
        String=String,
    )  # fmt: skip
    return Ros(rclpy=rclpy, messages=messages, qos=QoSProfile(depth=10))


def seconds(stamp: Any) -> float:
    """A stamp of a message as seconds."""
    return float(stamp.sec) + float(stamp.nanosec) / _NS_PER_S


def stamp(ros: Ros, time_s: float) -> Any:
    """Seconds as the stamp of a message."""
    sec, nanosec = divmod(round(time_s * _NS_PER_S), _NS_PER_S)
    return ros.messages.Time(sec=sec, nanosec=nanosec)


def _xyz(vector: Any) -> Array:
    return np.array([vector.x, vector.y, vector.z])


def _set(vector: Any, xyz: Array) -> None:
    vector.x, vector.y, vector.z = (float(value) for value in xyz)


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


def odometry_message(ros: Ros, odometry: Odometry, body: str, pose_variances: Array) -> Any:
    """A `nav_msgs/Odometry` in the map.

    Args:
        ros: the modules.
        odometry: of the body.
        body: the body's frame.
        pose_variances: (6,) of east, north, up, and of small turns about them.
    """
    message = ros.messages.Odometry()
    message.header.stamp, message.header.frame_id = stamp(ros, odometry.stamp_s), MAP
    message.child_frame_id = body
    pose, twist = message.pose.pose, message.twist.twist
    _set(pose.position, flipped_world(odometry.position_ned))
    set_turn(pose.orientation, odometry.quaternion_xyzw)
    message.pose.covariance = np.diag(pose_variances).ravel()
    _set(twist.linear, flipped_body(odometry.velocity_body))
    _set(twist.angular, flipped_body(odometry.rates_body))
    return message


def set_turn(orientation: Any, ned_from_body_xyzw: Array) -> None:
    """Write a quaternion message."""
    x, y, z, w = (float(value) for value in flipped_quaternion(ned_from_body_xyzw))
    orientation.x, orientation.y, orientation.z, orientation.w = x, y, z, w


def range_from(message: Any) -> float:
    """Metres of a `sensor_msgs/Range`; infinite where it is out of its bounds (REP-117)."""
    value = float(message.range)
    return value if message.min_range <= value <= message.max_range else math.inf


def range_message(ros: Ros, time_s: float, frame: str, range_m: float, most_m: float) -> Any:
    """A `sensor_msgs/Range`; NaN is no echo, which is +inf there."""
    message = ros.messages.Range(radiation_type=0, min_range=0.0, max_range=most_m)
    message.header.stamp, message.header.frame_id = stamp(ros, time_s), frame
    message.range = math.inf if math.isnan(range_m) else float(range_m)
    return message


def wrench_from(message: Any) -> Array:
    """(6,) N and N m in the body frame, of a `geometry_msgs/WrenchStamped` in the body's."""
    wrench = message.wrench
    return np.concatenate([flipped_body(_xyz(wrench.force)), flipped_body(_xyz(wrench.torque))])


def wrench_message(ros: Ros, time_s: float, body: str, wrench_body: Array) -> Any:
    """A `geometry_msgs/WrenchStamped` in the body's frame."""
    message = ros.messages.Wrench()
    message.header.stamp, message.header.frame_id = stamp(ros, time_s), body
    _set(message.wrench.force, flipped_body(wrench_body[:3]))
    _set(message.wrench.torque, flipped_body(wrench_body[3:]))
    return message


def speeds_from(message: Any, thrusters: tuple[str, ...]) -> Array:
    """(n,) rev/s of a `sensor_msgs/JointState`; NaN of a thruster that it does not name."""
    named = dict(zip(message.name, message.velocity, strict=False))
    return np.array([named.get(name, math.nan) for name in thrusters]) / TURN_RAD


def speeds_message(
    ros: Ros,
    time_s: float,
    thrusters: tuple[str, ...],
    rps: Array,
    thrust_n: Array | None = None,
) -> Any:
    """A `sensor_msgs/JointState`: speeds in rad/s, and thrusts as efforts, both signed."""
    message = ros.messages.JointState(name=list(thrusters), velocity=(TURN_RAD * rps).tolist())
    message.header.stamp = stamp(ros, time_s)
    if thrust_n is not None:
        message.effort = thrust_n.tolist()
    return message


def imu_message(
    ros: Ros, time_s: float, frame: str, turn_xyzw: Array, rates: Array, force: Array
) -> Any:
    """A `sensor_msgs/Imu`.

    Args:
        ros: the modules.
        time_s: of its stamp.
        frame: the instrument's.
        turn_xyzw: (4,) `ned_from_body`.
        rates: (3,) rad/s in the body.
        force: (3,) specific force in the body, m/s^2.
    """
    message = ros.messages.Imu()
    message.header.stamp, message.header.frame_id = stamp(ros, time_s), frame
    set_turn(message.orientation, turn_xyzw)
    _set(message.angular_velocity, flipped_body(rates))
    _set(message.linear_acceleration, flipped_body(force))
    return message


def velocity_message(ros: Ros, time_s: float, frame: str, velocity_body: Array) -> Any:
    """A `geometry_msgs/TwistWithCovarianceStamped` of a DVL; turns are not known."""
    message = ros.messages.Twist()
    message.header.stamp, message.header.frame_id = stamp(ros, time_s), frame
    _set(message.twist.twist.linear, flipped_body(velocity_body))
    return message
