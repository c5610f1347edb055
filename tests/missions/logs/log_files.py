"""Logs of other makers' formats, written here from numbers that tests know."""

import struct
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

NAV_STS = "cola2_msgs/msg/NavSts"
_COLA2 = {
    "cola2_msgs/msg/DecimalLatLon": "float64 latitude\nfloat64 longitude\n",
    "cola2_msgs/msg/NED": "float64 north\nfloat64 east\nfloat64 depth\n",
    "cola2_msgs/msg/RPY": "float32 roll\nfloat32 pitch\nfloat32 yaw\n",
    NAV_STS: """std_msgs/Header header
cola2_msgs/DecimalLatLon global_position
cola2_msgs/DecimalLatLon origin
cola2_msgs/NED position
float32 altitude
geometry_msgs/Point body_velocity
cola2_msgs/RPY orientation
cola2_msgs/RPY orientation_rate
cola2_msgs/NED position_variance
cola2_msgs/RPY orientation_variance
""",
}
_DVL = "dvl_msgs/msg/DVL"
_DVL_TEXT = """std_msgs/Header header
float64 time
geometry_msgs/Vector3 velocity
float64 fom
float64 altitude
bool velocity_valid
int64 status
"""

Numbers = Sequence[float] | NDArray[np.float64]


class Bag:
    """Messages by topic, to be written as a bag of ROS 1 or ROS 2."""

    def __init__(self, version: int) -> None:
        self.version = version
        self.store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
        for name, text in _COLA2.items():
            self.store.register(get_types_from_msg(text, name))
        self.rows: list[tuple[int, str, str, Any]] = []

    def make(self, kind: str, **fields: Any) -> Any:
        return self.store.types[kind](**fields)

    def header(self, stamp_ns: int, frame: str = "world_ned") -> Any:
        sec, nanosec = divmod(stamp_ns, 10**9)
        stamp = self.make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        more = {"seq": 0} if self.version == 1 else {}
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **more)

    def point(self, xyz: Iterable[float], kind: str = "Point") -> Any:
        x, y, z = map(float, xyz)
        return self.make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)

    def quaternion(self, xyzw: Numbers) -> Any:
        x, y, z, w = (float(v) for v in xyzw)
        return self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def add(self, topic: str, kind: str, recorded_ns: int, message: Any) -> None:
        self.rows.append((recorded_ns, topic, kind, message))

    def add_nav_sts(
        self,
        stamp_ns: int,
        place: Sequence[float],
        attitude_rad: Sequence[float],
        altitude_m: float,
        *,
        topic: str = "/sparus2/navigator/navigation",
        variances: Sequence[float] = (0.04, 0.09, 0.0025, 1e-4, 4e-4, 9e-4),
    ) -> None:
        """Place: latitude, longitude, depth."""

        def rpy(values: Sequence[float]) -> Any:
            roll, pitch, yaw = values
            return self.make("cola2_msgs/msg/RPY", roll=roll, pitch=pitch, yaw=yaw)

        def ned(values: Sequence[float]) -> Any:
            north, east, depth = values
            return self.make("cola2_msgs/msg/NED", north=north, east=east, depth=depth)

        message = self.make(
            NAV_STS,
            header=self.header(stamp_ns),
            global_position=self.make(
                "cola2_msgs/msg/DecimalLatLon", latitude=place[0], longitude=place[1]
            ),
            origin=self.make("cola2_msgs/msg/DecimalLatLon", latitude=41.0, longitude=3.0),
            position=ned((0.0, 0.0, place[2])),
            altitude=altitude_m,
            body_velocity=self.point((0.5, -0.1, 0.02)),
            orientation=rpy(attitude_rad),
            orientation_rate=rpy((0.01, 0.02, 0.03)),
            position_variance=ned(variances[:3]),
            orientation_variance=rpy(variances[3:]),
        )
        self.add(topic, NAV_STS, stamp_ns, message)

    def add_odometry(
        self,
        stamp_ns: int,
        topic: str,
        frame: str,
        position: Numbers,
        xyzw: Numbers,
        velocity: Numbers = (0.0,) * 6,
    ) -> None:
        pose = self.make(
            "geometry_msgs/msg/Pose",
            position=self.point(position),
            orientation=self.quaternion(xyzw),
        )
        twist = self.make(
            "geometry_msgs/msg/Twist",
            linear=self.point(velocity[:3], kind="Vector3"),
            angular=self.point(velocity[3:], kind="Vector3"),
        )
        message = self.make(
            "nav_msgs/msg/Odometry",
            header=self.header(stamp_ns, frame),
            child_frame_id="base",
            pose=self.make(
                "geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)
            ),
            twist=self.make(
                "geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)
            ),
        )
        self.add(topic, "nav_msgs/msg/Odometry", stamp_ns, message)

    def add_fix(self, stamp_ns: int, topic: str, place: Sequence[float], status: int = 0) -> None:
        """Place: latitude, longitude, height."""
        message = self.make(
            "sensor_msgs/msg/NavSatFix",
            header=self.header(stamp_ns, "gps"),
            status=self.make("sensor_msgs/msg/NavSatStatus", status=status, service=1),
            latitude=place[0],
            longitude=place[1],
            altitude=place[2],
            position_covariance=np.diag([4.0, 16.0, 25.0]).ravel(),
            position_covariance_type=2,
        )
        self.add(topic, "sensor_msgs/msg/NavSatFix", stamp_ns, message)

    def add_imu(self, stamp_ns: int, topic: str, frame: str, xyzw: Numbers) -> None:
        zero = self.point((0.0, 0.0, 0.0), kind="Vector3")
        message = self.make(
            "sensor_msgs/msg/Imu",
            header=self.header(stamp_ns, frame),
            orientation=self.quaternion(xyzw),
            orientation_covariance=np.zeros(9),
            angular_velocity=zero,
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=zero,
            linear_acceleration_covariance=np.zeros(9),
        )
        self.add(topic, "sensor_msgs/msg/Imu", stamp_ns, message)

    def add_range(self, stamp_ns: int, topic: str, range_m: float, max_m: float = 50.0) -> None:
        message = self.make(
            "sensor_msgs/msg/Range",
            header=self.header(stamp_ns, "sonar"),
            radiation_type=0,
            field_of_view=0.1,
            min_range=0.1,
            max_range=max_m,
            range=range_m,
        )
        self.add(topic, "sensor_msgs/msg/Range", stamp_ns, message)

    def add_dvl(
        self, stamp_ns: int, topic: str, velocity_frd: Numbers, altitude_m: float,
        *, valid: bool = True,
    ) -> None:  # fmt: skip
        """What a Water Linked DVL's driver publishes (the fields of dvl_msgs that matter)."""
        if _DVL not in self.store.types:
            self.store.register(get_types_from_msg(_DVL_TEXT, _DVL))
        message = self.make(
            _DVL,
            header=self.header(stamp_ns, "dvl"),
            time=0.1,
            velocity=self.point(velocity_frd, kind="Vector3"),
            fom=0.01,
            altitude=altitude_m,
            velocity_valid=valid,
            status=0,
        )
        self.add(topic, _DVL, stamp_ns, message)

    def add_twist(self, stamp_ns: int, topic: str, frame: str, velocity: Numbers) -> None:
        zero = self.point((0.0, 0.0, 0.0), kind="Vector3")
        linear = self.point(velocity, kind="Vector3")
        twist = self.make("geometry_msgs/msg/Twist", linear=linear, angular=zero)
        message = self.make(
            "geometry_msgs/msg/TwistStamped", header=self.header(stamp_ns, frame), twist=twist
        )
        self.add(topic, "geometry_msgs/msg/TwistStamped", stamp_ns, message)

    def add_pressure(self, stamp_ns: int, topic: str, pressure_pa: float) -> None:
        message = self.make(
            "sensor_msgs/msg/FluidPressure",
            header=self.header(stamp_ns, "p"),
            fluid_pressure=pressure_pa,
            variance=0.0,
        )
        self.add(topic, "sensor_msgs/msg/FluidPressure", stamp_ns, message)

    def write(self, path: Path, storage: StoragePlugin = StoragePlugin.MCAP) -> Path:
        if self.version == 1:
            with Writer1(path) as bag:
                self._write(bag, self.store.serialize_ros1)
        else:
            with Writer2(path, version=9, storage_plugin=storage) as bag:
                self._write(bag, self.store.serialize_cdr)
        return path

    def fill(self, bag: Any) -> None:
        """Write the messages to an open writer."""
        self._write(
            bag, self.store.serialize_ros1 if self.version == 1 else self.store.serialize_cdr
        )

    def _write(self, bag: Any, serialize: Any) -> None:
        connections: dict[str, Any] = {}
        for recorded_ns, topic, kind, message in sorted(self.rows, key=lambda row: row[0]):
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, kind, typestore=self.store)
            bag.write(connections[topic], recorded_ns, serialize(message, kind))


DATAFLASH = {
    "FMT": (128, "BBnNZ", "Type,Length,Name,Format,Columns"),
    "PARM": (64, "QNf", "TimeUS,Name,Value"),
    "GPS": (
        130, "QBBIHBcLLeffffB",
        "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U",
    ),
    "POS": (10, "QLLfff", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt"),
    "ATT": (20, "QccccCCCCB", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw,ErrRP,ErrYaw,AEKF"),
    "XKF1": (30, "QBccCfffffffccce", "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD,dPD,PN,PE,PD,GX,GY,GZ,OH"),
    "ORGN": (31, "QBLLe", "TimeUS,Type,Lat,Lng,Alt"),
    "RFND": (40, "QBCBB", "TimeUS,Instance,Dist,Stat,Orient"),
    "BARO": (41, "QBff", "TimeUS,I,Alt,Press"),
    "RCOU": (42, "QHHHHHHHH", "TimeUS,C1,C2,C3,C4,C5,C6,C7,C8"),
    "IMU": (43, "QBfff", "TimeUS,I,GyrX,GyrY,GyrZ"),
}  # fmt: skip
_STRUCT = {
    "B": "B", "H": "H", "h": "h", "I": "I", "i": "i", "f": "f", "Q": "Q", "c": "h", "C": "H",
    "e": "i", "E": "I", "L": "i", "n": "4s", "N": "16s", "Z": "64s",
}  # fmt: skip
_SCALE = {"c": 100, "C": 100, "e": 100, "E": 100, "L": 10_000_000}


def dataflash_message(name: str, *values: Any) -> bytes:
    """One message of an on-board log, values in the units that readers get."""
    number, kinds, _ = DATAFLASH[name]
    raw = [
        value.encode() if isinstance(value, str)
        else round(value * _SCALE[kind]) if kind in _SCALE
        else value
        for kind, value in zip(kinds, values, strict=True)
    ]  # fmt: skip
    return struct.pack("<BBB" + "".join(_STRUCT[k] for k in kinds), 0xA3, 0x95, number, *raw)


def dataflash_log(messages: Iterable[tuple[Any, ...]], names: Iterable[str] | None = None) -> bytes:
    """An on-board log: FMT of all names, then messages (name, value, ...)."""
    own = list(messages)
    log = b""
    for name in names or dict.fromkeys(["FMT", *(m[0] for m in own)]):
        number, kinds, fields = DATAFLASH[name]
        length = 3 + struct.calcsize("<" + "".join(_STRUCT[k] for k in kinds))
        log += dataflash_message("FMT", number, length, name, kinds, fields)
    return log + b"".join(dataflash_message(*message) for message in own)


def tlog(records: Iterable[tuple[float, Any]], *, version: int = 2, system: int = 1) -> bytes:
    """A ground station's log of messages (time recorded, message of pymavlink's dialect)."""
    from pymavlink.dialects.v20 import ardupilotmega as mavlink

    sender = mavlink.MAVLink(None, srcSystem=system, srcComponent=1)
    log = b""
    for recorded_s, message in records:
        packet = message.pack(sender, force_mavlink1=version == 1)
        log += struct.pack(">Q", round(recorded_s * 1e6)) + bytes(packet)
    return log
