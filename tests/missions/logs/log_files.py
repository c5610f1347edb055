"""Logs of other makers' formats, written here from numbers that tests know."""

import csv
import struct
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from missions.logs.import_log import ImportOptions, import_log

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


def fields_of(names: str, values: Iterable[float]) -> dict[str, float]:
    """Numbers by the names of their fields, such as `x y z`."""
    return dict(zip(names.split(), map(float, values), strict=True))


def imported(log: Path, **options: Any) -> dict[str, Any]:
    """What importing a log into `n.csv` next to it reports."""
    return import_log(log, log.with_name("n.csv"), ImportOptions(**options))[1]


def numbers(folder: Path, *names: str) -> NDArray[np.float64]:
    """Columns of `n.csv`, NaN where they are empty; one is flat."""
    rows = csv.DictReader((folder / "n.csv").read_text().splitlines())
    found = np.array([[float(row[name] or "nan") for name in names] for row in rows])
    return found[:, 0] if len(names) == 1 else found


class Bag:
    """Messages by topic, to be written as a bag of ROS 1 or ROS 2."""

    def __init__(self, version: int) -> None:
        self.version = version
        self.store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
        for name, text in {**_COLA2, _DVL: _DVL_TEXT}.items():
            self.store.register(get_types_from_msg(text, name))
        self.rows: list[tuple[int, str, str, Any]] = []

    def make(self, kind: str, fields: Mapping[str, Any]) -> Any:
        """A message; nested ones are mappings, and what is left out is 0 or empty."""
        values = {}
        described: Any = self.store.fielddefs[kind][1]
        for name, (node, of) in described:
            if node == Nodetype.NAME:
                values[name] = self.make(of, fields.get(name, {}))
            elif node == Nodetype.BASE:
                values[name] = fields.get(name, "" if of[0] == "string" else 0)
            else:
                values[name] = fields.get(name, np.zeros(of[1]))
        return self.store.types[kind](**values)

    def add(
        self, topic: str, kind: str, stamp_ns: int, frame: str, stored_ns: Any = 0, **fields: Any
    ) -> None:  # fmt: skip
        """A message with a header, stored when it was stamped if not later."""
        sec, nanosec = divmod(stamp_ns, 10**9)
        header = {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame}
        message = self.make(kind, {"header": header, **fields})
        self.rows.append((stored_ns or stamp_ns, topic, kind, message))

    def add_nav_sts(
        self, stamp_ns: int, place: Sequence[float], attitude_rad: Sequence[float],
        altitude_m: float, *, topic: str = "/sparus2/navigator/navigation",
    ) -> None:  # fmt: skip
        """Place: latitude, longitude, depth."""
        self.add(
            topic, NAV_STS, stamp_ns, "world_ned",
            global_position=fields_of("latitude longitude", place[:2]),
            origin={"latitude": 41.0, "longitude": 3.0},
            position={"depth": float(place[2])},
            altitude=altitude_m,
            body_velocity=fields_of("x y z", (0.5, -0.1, 0.02)),
            orientation=fields_of("roll pitch yaw", attitude_rad),
            orientation_rate=fields_of("roll pitch yaw", (0.01, 0.02, 0.03)),
            position_variance=fields_of("north east depth", (0.04, 0.09, 0.0025)),
            orientation_variance=fields_of("roll pitch yaw", (1e-4, 4e-4, 9e-4)),
        )  # fmt: skip

    def add_odometry(
        self, stamp_ns: int, topic: str, frame: str, position: Numbers, xyzw: Numbers,
        velocity: Numbers,
    ) -> None:  # fmt: skip
        place = {
            "position": fields_of("x y z", position), "orientation": fields_of("x y z w", xyzw),
        }  # fmt: skip
        twist = {
            "linear": fields_of("x y z", velocity[:3]),
            "angular": fields_of("x y z", velocity[3:]),
        }
        self.add(
            topic, "nav_msgs/msg/Odometry", stamp_ns, frame,
            pose={"pose": place}, twist={"twist": twist},
        )  # fmt: skip

    def add_fix(self, stamp_ns: int, topic: str, place: Sequence[float], status: int = 0) -> None:
        """Place: latitude, longitude, height."""
        self.add(
            topic, "sensor_msgs/msg/NavSatFix", stamp_ns, "gps",
            status={"status": status, "service": 1},
            position_covariance=np.diag([4.0, 16.0, 25.0]).ravel(), position_covariance_type=2,
            **fields_of("latitude longitude altitude", place),
        )  # fmt: skip

    def add_imu(self, stamp_ns: int, topic: str, frame: str, xyzw: Numbers) -> None:
        turn = fields_of("x y z w", xyzw)
        self.add(topic, "sensor_msgs/msg/Imu", stamp_ns, frame, orientation=turn)

    def add_range(self, stamp_ns: int, topic: str, range_m: float) -> None:
        self.add(
            topic, "sensor_msgs/msg/Range", stamp_ns, "sonar",
            field_of_view=0.1, min_range=0.1, max_range=50.0, range=range_m,
        )  # fmt: skip

    def add_dvl(
        self, stamp_ns: int, topic: str, velocity_frd: Numbers, altitude_m: float,
        *, valid: bool = True,
    ) -> None:  # fmt: skip
        """What a Water Linked DVL's driver publishes (the fields of dvl_msgs that matter)."""
        self.add(
            topic, _DVL, stamp_ns, "dvl", time=0.1, fom=0.01, altitude=altitude_m,
            velocity=fields_of("x y z", velocity_frd), velocity_valid=valid,
        )  # fmt: skip

    def add_twist(self, stamp_ns: int, topic: str, frame: str, velocity: Numbers) -> None:
        twist = {"linear": fields_of("x y z", velocity)}
        self.add(topic, "geometry_msgs/msg/TwistStamped", stamp_ns, frame, twist=twist)

    def add_pressure(self, stamp_ns: int, topic: str, pressure_pa: float) -> None:
        kind = "sensor_msgs/msg/FluidPressure"
        self.add(topic, kind, stamp_ns, "p", fluid_pressure=pressure_pa)

    def write(self, path: Path, storage: StoragePlugin = StoragePlugin.MCAP) -> Path:
        bag: Any
        with (
            Writer1(path) if self.version == 1
            else Writer2(path, version=9, storage_plugin=storage)
        ) as bag:  # fmt: skip
            self.fill(bag)
        return path

    def fill(self, bag: Any) -> None:
        """Write the messages to an open writer."""
        serialize = self.store.serialize_ros1 if self.version == 1 else self.store.serialize_cdr
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
