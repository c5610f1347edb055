"""ROS 2 messages from rows of numbers in NED and FRD: each is built here in ENU and FLU.

Definitions of the messages: ros2/common_interfaces, as shipped with rosbags (those of Humble, which
later releases kept).
"""

import math
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from alice_survey.base.frames import Array

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

ODOMETRY = "nav_msgs/msg/Odometry"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
FIX = "sensor_msgs/msg/NavSatFix"
IMU = "sensor_msgs/msg/Imu"
PRESSURE = "sensor_msgs/msg/FluidPressure"
RANGE = "sensor_msgs/msg/Range"
JOINTS = "sensor_msgs/msg/JointState"
NUMBERS = "std_msgs/msg/Float64MultiArray"
TWIST = "geometry_msgs/msg/TwistWithCovarianceStamped"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"

MAP = "map"
"""The world's frame: ENU, origin at the datum."""
NS_PER_S = 1_000_000_000

_NOT_GIVEN = -1.0
"""First element of a covariance in sensor_msgs/Imu whose quantity the message does not hold."""
_UNKNOWN, _DIAGONAL = 0, 2
"""COVARIANCE_TYPE_UNKNOWN and _DIAGONAL_KNOWN of sensor_msgs/NavSatFix."""


def as_nanoseconds(time_s: Array, start_ns: int = 0) -> list[int]:
    """Times, (N,) seconds, as whole nanoseconds after a start."""
    return [
        start_ns + ns for ns in np.rint(np.asarray(time_s) * NS_PER_S).astype(np.int64).tolist()
    ]


class Messages:
    """Builds messages of the types that a bag of ours holds."""

    @cached_property
    def store(self) -> "Typestore":
        """Where rosbags keeps the types."""
        from rosbags.typesys import Stores, get_typestore

        return get_typestore(Stores.ROS2_HUMBLE)

    def _make(self, kind: str, **fields: Any) -> Any:
        return self.store.types[kind](**fields)

    def _header(self, stamp_ns: int, frame: str) -> Any:
        sec, nanosec = divmod(stamp_ns, NS_PER_S)
        stamp = self._make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        return self._make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def _vector(self, xyz: Array, kind: str = "Vector3") -> Any:
        x, y, z = (float(v) for v in xyz)
        return self._make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)

    def _quaternion(self, xyzw: Array) -> Any:
        x, y, z, w = (float(v) for v in xyzw)
        return self._make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def _pose(self, position_enu: Array, enu_from_flu: Array, variances: Array) -> Any:
        pose = self._make(
            "geometry_msgs/msg/Pose",
            position=self._vector(position_enu, "Point"),
            orientation=self._quaternion(enu_from_flu),
        )
        covariance = np.diag(np.asarray(variances, dtype=np.float64)).ravel()
        return self._make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance)

    def _twist(self, velocity_flu: Array, variances: Array) -> Any:
        twist = self._make(
            "geometry_msgs/msg/Twist",
            linear=self._vector(velocity_flu[:3]),
            angular=self._vector(velocity_flu[3:]),
        )
        covariance = np.diag(np.asarray(variances, dtype=np.float64)).ravel()
        return self._make(
            "geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=covariance
        )

    def odometry(
        self,
        stamp_ns: int,
        child: str,
        position_enu: Array,
        enu_from_flu: Array,
        pose_variances: Array,
        velocity_flu: Array,
        twist_variances: Array,
    ) -> Any:
        """A pose in the map and a velocity in the body.

        Args:
            stamp_ns: of the header.
            child: the body's frame.
            position_enu: (3,).
            enu_from_flu: (4,) quaternion xyzw.
            pose_variances: (6,) of east, north, up, and of small turns about them.
            velocity_flu: (6,).
            twist_variances: (6,).
        """
        return self._make(
            ODOMETRY,
            header=self._header(stamp_ns, MAP),
            child_frame_id=child,
            pose=self._pose(position_enu, enu_from_flu, pose_variances),
            twist=self._twist(velocity_flu, twist_variances),
        )

    def transforms(self, stamp_ns: int, children: dict[str, tuple[Array, Array]]) -> Any:
        """Transforms of bodies in the map: of each position ENU, (3,), and quaternion, (4,)."""
        stamped = [
            self._make(
                "geometry_msgs/msg/TransformStamped",
                header=self._header(stamp_ns, MAP),
                child_frame_id=child,
                transform=self._make(
                    "geometry_msgs/msg/Transform",
                    translation=self._vector(position),
                    rotation=self._quaternion(quaternion),
                ),
            )
            for child, (position, quaternion) in children.items()
        ]
        return self._make(TRANSFORMS, transforms=stamped)

    def fix(self, stamp_ns: int, frame: str, geodetic: Array, variances_enu: Array | None) -> Any:
        """Latitude, longitude (degrees) and height above the ellipsoid, (3,)."""
        covariance = np.diag(variances_enu).ravel() if variances_enu is not None else np.zeros(9)
        return self._make(
            FIX,
            header=self._header(stamp_ns, frame),
            status=self._make("sensor_msgs/msg/NavSatStatus", status=0, service=1),
            latitude=float(geodetic[0]),
            longitude=float(geodetic[1]),
            altitude=float(geodetic[2]),
            position_covariance=np.asarray(covariance, dtype=np.float64),
            position_covariance_type=_UNKNOWN if variances_enu is None else _DIAGONAL,
        )

    def imu(
        self,
        stamp_ns: int,
        frame: str,
        *,
        rate_flu: Array | None = None,
        force_flu: Array | None = None,
        enu_from_flu: Array | None = None,
        variance: float = 0.0,
    ) -> Any:
        """Rates, specific force or orientation; what is None is marked as not given."""
        absent = np.zeros(9)
        absent[0] = _NOT_GIVEN
        known = np.diag(np.full(3, variance)).ravel()
        nothing, upright = np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])
        return self._make(
            IMU,
            header=self._header(stamp_ns, frame),
            orientation=self._quaternion(upright if enu_from_flu is None else enu_from_flu),
            orientation_covariance=absent if enu_from_flu is None else known,
            angular_velocity=self._vector(nothing if rate_flu is None else rate_flu),
            angular_velocity_covariance=absent if rate_flu is None else known,
            linear_acceleration=self._vector(nothing if force_flu is None else force_flu),
            linear_acceleration_covariance=absent if force_flu is None else known,
        )

    def pressure(self, stamp_ns: int, frame: str, pressure_pa: float, variance: float) -> Any:
        """Absolute pressure."""
        return self._make(
            PRESSURE,
            header=self._header(stamp_ns, frame),
            fluid_pressure=float(pressure_pa),
            variance=float(variance),
        )

    def range(self, stamp_ns: int, frame: str, range_m: float) -> Any:
        """A range; one that is NaN is +inf, no echo (REP-117)."""
        return self._make(
            RANGE,
            header=self._header(stamp_ns, frame),
            radiation_type=0,
            field_of_view=0.0,
            min_range=0.0,
            max_range=math.inf,
            range=math.inf if math.isnan(range_m) else float(range_m),
        )

    def joints(
        self, stamp_ns: int, names: tuple[str, ...], speed_radps: Array, effort: Array | None
    ) -> Any:
        """Speeds, (n,), and thrusts, (n,) N, of propellers."""
        return self._make(
            JOINTS,
            header=self._header(stamp_ns, ""),
            name=list(names),
            position=np.zeros(0),
            velocity=np.ascontiguousarray(speed_radps, dtype=np.float64),
            effort=np.zeros(0) if effort is None else np.ascontiguousarray(effort),
        )

    def numbers(self, label: str, values: Array) -> Any:
        """A row of numbers whose dimension carries a label."""
        size = len(values)
        dimension = self._make(
            "std_msgs/msg/MultiArrayDimension", label=label, size=size, stride=size
        )
        layout = self._make("std_msgs/msg/MultiArrayLayout", dim=[dimension], data_offset=0)
        return self._make(
            NUMBERS, layout=layout, data=np.ascontiguousarray(values, dtype=np.float64)
        )

    def twist(self, stamp_ns: int, frame: str, velocity_flu: Array, variance: float) -> Any:
        """A velocity, (3,), with one variance for all; the rates are not known."""
        variances = np.array([variance] * 3 + [_NOT_GIVEN, 0.0, 0.0])
        return self._make(
            TWIST,
            header=self._header(stamp_ns, frame),
            twist=self._twist(np.concatenate([velocity_flu, np.zeros(3)]), variances),
        )

    def position(self, stamp_ns: int, position_enu: Array, variance: float) -> Any:
        """A position in the map without an attitude, (3,)."""
        variances = np.array([variance] * 3 + [_NOT_GIVEN, 0.0, 0.0])
        return self._make(
            POSE,
            header=self._header(stamp_ns, MAP),
            pose=self._pose(position_enu, np.array([0.0, 0.0, 0.0, 1.0]), variances),
        )
