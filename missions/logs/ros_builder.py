"""ROS 2 messages from numbers, by whatever library has their classes, and the frames of ROS.

Definitions: ros2/common_interfaces, as of Humble, which later releases kept.

From NED and FRD to the frames of ROS (REP-103: ENU world, FLU body), and back.

Both changes of axes are exact in floating point: they swap and negate components. A rotation
`enu_from_flu` is `C_EN * ned_from_frd * C_FB` with the two constant half turns below
(ROS REP-103, "Coordinate Frame Conventions"; REP-105 names the frames).

A flight becomes a ROS 2 bag (MCAP): what RViz, Foxglove, PlotJuggler and `ros2 bag` open. World
`map` is ENU with its origin at the datum on the sea surface, the body is FLU. Times are those of
the flight: the same flight gives the same bytes.
"""

import heapq
import itertools
import math
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.core.errors import WorkspaceError
from alice_survey.core.executor import progress
from alice_survey.core.frames import Array, Datum

ODOMETRY = "nav_msgs/msg/Odometry"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
FIX = "sensor_msgs/msg/NavSatFix"
RANGE = "sensor_msgs/msg/Range"
JOINTS = "sensor_msgs/msg/JointState"
NUMBERS = "std_msgs/msg/Float64MultiArray"
WRENCH = "geometry_msgs/msg/WrenchStamped"
TWIST = "geometry_msgs/msg/TwistWithCovarianceStamped"
IMU = "sensor_msgs/msg/Imu"
CLOCK = "rosgraph_msgs/msg/Clock"
STRING = "std_msgs/msg/String"

MAP = "map"
"""The world's frame: ENU, origin at the datum."""
NS_PER_S = 1_000_000_000
_HALF_ROOT = float(np.sqrt(0.5))
_UNKNOWN, _DIAGONAL = 0, 2
"""COVARIANCE_TYPE_UNKNOWN and _DIAGONAL_KNOWN of sensor_msgs/NavSatFix."""


def flipped_world(points: Array) -> Array:
    """NED to ENU or back, (..., 3): north and east change places, the vertical its sign."""
    return np.stack([points[..., 1], points[..., 0], -points[..., 2]], axis=-1)


def flipped_body(vectors: Array) -> Array:
    """FRD to FLU or back, (..., 3): the second and third component change sign."""
    return np.stack([vectors[..., 0], -vectors[..., 1], -vectors[..., 2]], axis=-1)


def flipped_quaternion(quaternion_xyzw: Array) -> Array:
    """Quaternion of `ned_from_frd` to that of `enu_from_flu` or back, (..., 4).

    The product of the half turn about (1, 1, 0) / sqrt 2, the quaternion and the half turn about x,
    multiplied out; the sign is chosen so that w is not negative.
    """
    x, y, z, w = np.moveaxis(np.asarray(quaternion_xyzw, dtype=np.float64), -1, 0)
    turned = _HALF_ROOT * np.stack([x + y, x - y, w - z, w + z], axis=-1)
    return np.where(turned[..., 3:] < 0, -turned, turned)


class MessageBuilder:
    """Builds messages from numbers in ENU and FLU."""

    def __init__(self, kind: Callable[[str], Any]) -> None:
        """A builder by the classes of a library.

        Args:
            kind: class of a message by its name, such as `nav_msgs/msg/Odometry`.
        """
        self._kind = kind

    def make(self, kind: str, **fields: Any) -> Any:
        """A message by its fields; a library of ROS fills in those that are left out."""
        return self._kind(kind)(**fields)

    def stamp(self, stamp_ns: int) -> Any:
        """A time."""
        sec, nanosec = divmod(stamp_ns, NS_PER_S)
        return self.make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)

    def _header(self, stamp_ns: int, frame: str) -> Any:
        stamp = self.stamp(stamp_ns)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def _vector(self, xyz: Array, kind: str = "Vector3") -> Any:
        x, y, z = (float(v) for v in xyz)
        return self.make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)

    def _quaternion(self, xyzw: Array) -> Any:
        x, y, z, w = (float(v) for v in xyzw)
        return self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def _twist(self, linear: Array, angular: Array) -> Any:
        twist = self.make(
            "geometry_msgs/msg/Twist", linear=self._vector(linear), angular=self._vector(angular)
        )
        return self.make(
            "geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)
        )

    def odometry(
        self,
        stamp_ns: int,
        child: str,
        position_enu: Array,
        enu_from_flu: Array,
        pose_variances: Array,
        velocity_flu: Array,
    ) -> Any:
        """A pose in the map and a velocity in the body, whose covariance is not known.

        Args:
            stamp_ns: of the header.
            child: the body's frame.
            position_enu: (3,).
            enu_from_flu: (4,) quaternion xyzw.
            pose_variances: (6,) of east, north, up, and of small turns about them.
            velocity_flu: (6,).
        """
        pose = self.make(
            "geometry_msgs/msg/Pose",
            position=self._vector(position_enu, "Point"),
            orientation=self._quaternion(enu_from_flu),
        )
        return self.make(
            ODOMETRY,
            header=self._header(stamp_ns, MAP),
            child_frame_id=child,
            pose=self.make(
                "geometry_msgs/msg/PoseWithCovariance",
                pose=pose,
                covariance=np.diag(pose_variances).ravel(),
            ),
            twist=self._twist(velocity_flu[:3], velocity_flu[3:]),
        )

    def transforms(self, stamp_ns: int, children: dict[str, tuple[Array, Array]]) -> Any:
        """Transforms of bodies in the map: of each position ENU, (3,), and quaternion, (4,)."""
        stamped = [
            self.make(
                "geometry_msgs/msg/TransformStamped",
                header=self._header(stamp_ns, MAP),
                child_frame_id=child,
                transform=self.make(
                    "geometry_msgs/msg/Transform",
                    translation=self._vector(position),
                    rotation=self._quaternion(quaternion),
                ),
            )
            for child, (position, quaternion) in children.items()
        ]
        return self.make(TRANSFORMS, transforms=stamped)

    def fix(self, stamp_ns: int, frame: str, geodetic: Array, variances_enu: Array | None) -> Any:
        """Latitude, longitude (degrees) and height above the ellipsoid, (3,)."""
        variances = np.zeros(3) if variances_enu is None else variances_enu
        return self.make(
            FIX,
            header=self._header(stamp_ns, frame),
            status=self.make("sensor_msgs/msg/NavSatStatus", status=0, service=1),
            latitude=float(geodetic[0]),
            longitude=float(geodetic[1]),
            altitude=float(geodetic[2]),
            position_covariance=np.diag(variances).ravel(),
            position_covariance_type=_UNKNOWN if variances_enu is None else _DIAGONAL,
        )

    def range(self, stamp_ns: int, frame: str, range_m: float) -> Any:
        """A range; one that is NaN is +inf, no echo (REP-117)."""
        return self.make(
            RANGE,
            header=self._header(stamp_ns, frame),
            radiation_type=0,
            field_of_view=0.0,
            min_range=0.0,
            max_range=math.inf,
            range=math.inf if math.isnan(range_m) else float(range_m),
        )

    def joints(
        self,
        stamp_ns: int,
        names: tuple[str, ...],
        speed_radps: Array,
        thrust_n: Array | None = None,
    ) -> Any:
        """Speeds, (n,), of propellers, and their thrusts where they are given."""
        return self.make(
            JOINTS,
            header=self._header(stamp_ns, ""),
            name=list(names),
            position=np.zeros(0),
            velocity=np.ascontiguousarray(speed_radps),
            effort=np.zeros(0) if thrust_n is None else np.ascontiguousarray(thrust_n),
        )

    def numbers(self, label: str, values: Array) -> Any:
        """A row of numbers whose dimension carries a label."""
        size = len(values)
        dimension = self.make(
            "std_msgs/msg/MultiArrayDimension", label=label, size=size, stride=size
        )
        layout = self.make("std_msgs/msg/MultiArrayLayout", dim=[dimension], data_offset=0)
        return self.make(NUMBERS, layout=layout, data=np.ascontiguousarray(values))

    def wrench(self, stamp_ns: int, frame: str, wrench_flu: Array) -> Any:
        """Force and moment, (6,), on a body."""
        wrench = self.make(
            "geometry_msgs/msg/Wrench",
            force=self._vector(wrench_flu[:3]),
            torque=self._vector(wrench_flu[3:]),
        )
        return self.make(WRENCH, header=self._header(stamp_ns, frame), wrench=wrench)

    def velocity(self, stamp_ns: int, frame: str, velocity_flu: Array) -> Any:
        """Velocity, (3,), of a DVL, whose covariance is not known; turns are not measured."""
        twist = self._twist(velocity_flu, np.zeros(3))
        return self.make(TWIST, header=self._header(stamp_ns, frame), twist=twist)

    def imu(
        self, stamp_ns: int, frame: str, enu_from_flu: Array, rates_flu: Array, force_flu: Array
    ) -> Any:
        """Attitude, (4,) xyzw; rates, (3,) rad/s; specific force, (3,) m/s^2."""
        return self.make(
            IMU,
            header=self._header(stamp_ns, frame),
            orientation=self._quaternion(enu_from_flu),
            orientation_covariance=np.zeros(9),
            angular_velocity=self._vector(rates_flu),
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=self._vector(force_flu),
            linear_acceleration_covariance=np.zeros(9),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class BagRecord:
    """A flight as arrays over one clock, (T,) rows.

    Poses are of the body's origin, FRD body to NED with the origin at the datum.
    """

    name: str
    """Name of the vehicle: the first part of every topic's name."""
    datum: Datum
    time_s: Array
    """(T,) seconds since the start of the flight, strictly increasing."""
    truth: RigidTransform
    """(T,) `ned_from_body`."""
    truth_velocity: Array
    """(T, 6) u, v, w over ground, m/s, and p, q, r, rad/s, in the body frame."""
    believed: RigidTransform
    """(T,) `ned_from_body` as navigation has it."""
    believed_velocity: Array
    """(T, 6) as `truth_velocity`."""
    sigma_horizontal_m: Array
    """(T,) sigma of north and of east each."""
    sigma_depth_m: Array
    """(T,) sigma of depth."""
    sigma_attitude_rad: Array
    """(T,) sigma of roll and of pitch each."""
    sigma_heading_rad: Array
    """(T,) sigma of heading."""
    altitude_m: Array
    """(T,) altitude of the left port's glass above the sea floor as navigation has it; NaN is not
    known."""
    thrusters: tuple[str, ...]
    rpm: Array
    """(T, n) revolutions per minute."""
    power_w: Array
    """(T, n) electrical power."""
    beam_time_s: Array
    """(M,) times of the DVL's ranges, increasing."""
    beam_m: Array
    """(M, b) slant ranges of the DVL's beams; NaN means no echo."""
    notes: dict[str, str]
    """Kept in the bag's metadata."""


def write_bag(path: Path, record: BagRecord) -> None:
    """Write a flight as a ROS 2 bag of MCAP storage: the folder `path`, whole or not at all.

    Messages are made one by one in the order of their times, so that memory holds the record and
    one chunk of the file (1 MiB, compressed) only. The bytes depend on the record, on the folder's
    name and on the versions of rosbags, which names itself in the file, and of zstd.

    Args:
        path: folder to write; it must not exist.
        record: the flight.

    Raises:
        WorkspaceError: the folder exists, or cannot be written.
    """
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    if path.exists():
        raise WorkspaceError(f"{path} exists already: remove it or choose another name")
    # rosbags names the file inside after the folder, so the folder is made under its own name.
    outer = path.with_name(f"{path.name}.partial")
    shutil.rmtree(outer, ignore_errors=True)
    try:
        outer.mkdir(parents=True)
        writer = Writer(outer / path.name, version=9, storage_plugin=StoragePlugin.MCAP)
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        with writer:
            for key, value in sorted(record.notes.items()):
                writer.set_custom_data(key, value)
            store = get_typestore(Stores.ROS2_HUMBLE)
            topics = _topics(record, MessageBuilder(store.types.__getitem__))
            connections = [
                writer.add_connection(name, kind, typestore=store) for name, kind, _, _ in topics
            ]
            ordered = heapq.merge(
                *(
                    zip(stamps_ns, itertools.repeat(rank), itertools.count(), strict=False)
                    for rank, (_, _, stamps_ns, _) in enumerate(topics)
                )
            )
            total = sum(len(stamps_ns) for _, _, stamps_ns, _ in topics)
            for stamp, rank, row in progress(ordered, "bag", total):
                _, kind, _, message = topics[rank]
                data = store.serialize_cdr(message(stamp, row), kind)
                writer.write(connections[rank], stamp, data)
        os.replace(outer / path.name, path)  # noqa: PTH105 (a folder onto a free name)
    except OSError as error:
        raise WorkspaceError(f"{path}: cannot be written: {error.strerror}") from None
    finally:
        shutil.rmtree(outer, ignore_errors=True)


_BagTopic = tuple[str, str, list[int], Callable[[int, int], Any]]
"""Name, type, times of the messages, and what makes one of its time and its row of the record."""


def _topics(record: BagRecord, ros: MessageBuilder) -> list[_BagTopic]:
    """All topics of a record."""
    name, datum = record.name, record.datum
    body, true_body = f"{name}/base_link", f"{name}/base_link_truth"
    place, turn, speed = _in_ros(record.believed, record.believed_velocity)
    true_place, true_turn, true_speed = _in_ros(record.truth, record.truth_velocity)
    origin = np.array([datum.latitude_deg, datum.longitude_deg, datum.height_m])
    geodetic = datum.geodetic_from_ned(record.believed.translation)
    geodetic[:, 2] = datum.height_m - geodetic[:, 2]
    horizontal, tilt = record.sigma_horizontal_m**2, record.sigma_attitude_rad**2
    variances = np.column_stack(
        [
            horizontal, horizontal, record.sigma_depth_m**2,
            tilt, tilt, record.sigma_heading_rad**2,
        ]
    )  # fmt: skip
    exact = np.zeros(6)
    rad_s = record.rpm * (2.0 * math.pi / 60.0)
    label = ",".join(record.thrusters)
    stamps, heard = _nanoseconds(record.time_s), _nanoseconds(record.beam_time_s)

    def ranges(topic: str, frame: str, at_ns: list[int], values: Array) -> _BagTopic:
        topic, frame = f"/{name}/{topic}", f"{name}/{frame}"
        return topic, RANGE, at_ns, lambda stamp, i: ros.range(stamp, frame, values[i])

    return [
        (
            f"/{name}/datum", FIX, stamps[:1], lambda stamp, _: ros.fix(stamp, MAP, origin, None)
        ),
        (
            f"/{name}/truth/odometry", ODOMETRY, stamps,
            lambda stamp, i: ros.odometry(
                stamp, true_body, true_place[i], true_turn[i], exact, true_speed[i]
            ),
        ),
        (
            f"/{name}/navigation/odometry", ODOMETRY, stamps,
            lambda stamp, i: ros.odometry(stamp, body, place[i], turn[i], variances[i], speed[i]),
        ),
        (
            f"/{name}/navigation/fix", FIX, stamps,
            lambda stamp, i: ros.fix(stamp, body, geodetic[i], variances[i, :3]),
        ),
        (
            "/tf", TRANSFORMS, stamps,
            lambda stamp, i: ros.transforms(
                stamp, {body: (place[i], turn[i]), true_body: (true_place[i], true_turn[i])}
            ),
        ),
        ranges("navigation/altitude", "port", stamps, record.altitude_m),
        (
            f"/{name}/thrusters/state", JOINTS, stamps,
            lambda stamp, i: ros.joints(stamp, record.thrusters, rad_s[i]),
        ),
        (
            f"/{name}/thrusters/power", NUMBERS, stamps,
            lambda _, i: ros.numbers(label, record.power_w[i]),
        ),
        *(
            ranges(f"dvl/beam_{number}", f"dvl_beam_{number}", heard, beam)
            for number, beam in enumerate(record.beam_m.T, start=1)
        ),
    ]  # fmt: skip


def _in_ros(ned_from_body: RigidTransform, velocity_frd: Array) -> tuple[Array, Array, Array]:
    """Positions in ENU, quaternions `enu_from_flu`, and velocities (T, 6) in FLU."""
    return (
        flipped_world(ned_from_body.translation),
        flipped_quaternion(ned_from_body.rotation.as_quat()),
        np.hstack([flipped_body(velocity_frd[:, :3]), flipped_body(velocity_frd[:, 3:])]),
    )


def _nanoseconds(time_s: Array) -> list[int]:
    """Times, (N,) seconds, as whole nanoseconds."""
    stamps: list[int] = np.rint(time_s * NS_PER_S).astype(np.int64).tolist()
    return stamps
