"""A ROS 1 or ROS 2 bag as a logged dive.

Understood are `NavSts` (COLA2's cola2_msgs, and auv_msgs), nav_msgs/Odometry, and sensor_msgs
NavSatFix with Imu; depth from FluidPressure or a number; altitude from Range; velocity over ground
from a Doppler log's `DVL` (dvl_msgs, cola2_msgs), TwistStamped or TwistWithCovarianceStamped;
thrusters from JointState. Orientations and velocities are ENU and FLU (REP-103) unless the frame's
name holds `ned`, as in COLA2 and Stonefish; those of a `DVL` are forward, right, down.
Bags may be damaged, or made to harm.
"""

import bz2
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from alice_survey.core.contents import one_line, ordinary_file
from alice_survey.core.errors import AliceError, NavigationError
from alice_survey.core.executor import progress
from alice_survey.core.frames import Array, Datum
from missions.logs.dive import (
    LoggedDive,
    Signal,
    angles_of,
    clean_signal,
    of_known,
    usable_positions,
)
from missions.logs.navigation_csv import DATED_AFTER_S
from missions.logs.ros_builder import flipped_body, flipped_quaternion, flipped_world

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

NAV_STS, ODOMETRY, FIX = "NavSts", "Odometry", "NavSatFix"
IMU, PRESSURE, RANGE, JOINTS = "Imu", "FluidPressure", "Range", "JointState"
NUMBERS = ("Float32", "Float64")
DVL, TWIST, TWIST_COVARIANCE = "DVL", "TwistStamped", "TwistWithCovarianceStamped"

VARIANCES = ("var_north", "var_east", "var_depth", "var_roll", "var_pitch", "var_heading")
ANGLES = ("roll", "pitch", "heading")
QUATERNION = ("qx", "qy", "qz", "qw")
NED = ("north", "east", "down")
VELOCITY, RATES = ("u", "v", "w"), ("p", "q", "r")
PLACE = ("latitude", "longitude")

_NOTHING = math.nan

_TAKES: Mapping[str, tuple[str, ...]] = {
    "navigation": (NAV_STS, ODOMETRY, FIX),
    "depth": (PRESSURE, *NUMBERS, NAV_STS, ODOMETRY),
    "attitude": (IMU, NAV_STS, ODOMETRY),
    "altitude": (RANGE, *NUMBERS, NAV_STS, DVL),
    "velocity": (DVL, TWIST_COVARIANCE, TWIST, NAV_STS, ODOMETRY),
}
"""Types that serve each role, the best first."""
_TRUTH = ("truth", "ground_truth", "_gt", "/gt")
_ORIGIN = ("datum", "origin")
_WORLDS = ("map", "odom", "world", "earth")
"""Frames that do not turn with the body."""
_NOT_ALTITUDE = ("beam", "front", "forward", "fls", "obstacle")

_DENSITY_KG_M3, _SURFACE_PA, _GRAVITY_MPS2 = 1025.0, 101325.0, 9.80665
"""What makes a depth of a pressure; the standard atmosphere (ISO 2533)."""
_SIGMAS: Mapping[str, tuple[tuple[str, ...], float]] = {
    "sigma_horizontal_m": (VARIANCES[0:2], 1.0),
    "sigma_depth_m": (VARIANCES[2:3], 1.0),
    "sigma_attitude_deg": (VARIANCES[3:5], float(np.rad2deg(1.0))),
    "sigma_heading_deg": (VARIANCES[5:6], float(np.rad2deg(1.0))),
}
"""For each column of the navigation CSV: which variances make it, and its unit."""


class _Topic(NamedTuple):
    name: str
    kind: str
    """Type without its package."""

    @property
    def last_name(self) -> str:
        return self.name.rsplit("/", 1)[-1]


def read_ros_bag(path: Path, requested: Mapping[str, str], datum: Datum | None) -> LoggedDive:
    """Read a bag.

    Args:
        path: a ROS 1 file, a ROS 2 folder, or the single .mcap or .db3 of one.
        requested: the topic to use for each role (`dive.ROLES`).
        datum: origin of an odometry's world, where the bag does not state it.

    Raises:
        NavigationError: it is not a bag, is damaged, or lacks what navigation needs.
    """
    lost: Counter[str] = Counter()
    notes: list[str] = []
    with opened_bag(path) as reader:
        present = sorted({_Topic(c.topic, c.msgtype.split("/")[-1]) for c in reader.connections})
        chosen = _choose(path, present, requested)
        origin = [t for t in present if t.kind == FIX and t.last_name in _ORIGIN]
        navigation = chosen.get("navigation")
        local = navigation if navigation is not None and navigation.kind == ODOMETRY else None
        if local is not None and not (datum or origin):
            raise NavigationError(
                f"{path}: {local.name} counts from an origin that the bag does not "
                "hold: give --datum LATITUDE LONGITUDE (of a tank any)"
            )
        joints = [topic for topic in present if topic.kind == JOINTS]
        times, tables = _collect(reader, {*chosen.values(), *origin, *joints}, lost, notes)
    if local is not None:
        _add_geodetic(tables, datum or _datum(path, origin[0], tables[origin[0]]))

    for role, convert in (
        ("navigation", _add_sigmas), ("attitude", _add_angles), ("altitude", _drop_no_bottom)
    ):  # fmt: skip
        if (topic := chosen.get(role, navigation)) is not None:
            convert(topic, tables[topic], lost)

    def signal(topic: _Topic | None, names: Sequence[str], scale: float = 1.0) -> Signal | None:
        """A signal of columns, None where there is no topic, or it lacks them or is empty."""
        if topic is None or not set(names) <= tables[topic].keys():
            return None
        values = scale * np.stack([tables[topic][name] for name in names], axis=1)
        return clean_signal(topic.name, times[topic], values, lost)

    def of_role(role: str, names: Sequence[str]) -> Signal | None:
        return signal(chosen.get(role, navigation), names)

    if len(joints) > 1:
        notes.append(f"thrusters are left out: {_list_topics(joints)} all have joints")
    thrusters = tuple(tables[joints[0]]) if len(joints) == 1 else ()
    if any(role == "depth" and topic.kind == PRESSURE for role, topic in chosen.items()):
        notes.append(
            f"depth is pressure minus {_SURFACE_PA:g} Pa, in water of {_DENSITY_KG_M3:g} kg/m^3"
        )
    all_s = np.concatenate([times[topic] for topic in chosen.values()])
    ranged = chosen.get("altitude")
    sigmas = {name: signal(navigation, (name,)) for name in _SIGMAS}
    return LoggedDive(
        kind="a bag of ROS",
        clock="the times of the message headers",
        dated=bool(len(all_s) and np.median(all_s) > DATED_AFTER_S),
        position=usable_positions(signal(navigation, PLACE), lost),
        depth=of_role("depth", ("depth",)),
        attitude=of_role("attitude", ANGLES),
        altitude=of_role("altitude", ("altitude",)),
        altitude_slant=(
            ranged is not None
            and ranged.kind in (RANGE, DVL)
            and not ranged.name.endswith("altitude")
        ),
        sigmas={name: sigma for name, sigma in sigmas.items() if sigma is not None},
        velocity_body=of_role("velocity", VELOCITY),
        rates=signal(navigation, RATES),
        rpm=signal(joints[0], thrusters, 60.0 / (2.0 * np.pi)) if thrusters else None,
        thrusters=thrusters,
        lost=lost,
        notes=tuple(notes),
    )


def _choose(
    path: Path, present: Sequence[_Topic], requested: Mapping[str, str]
) -> dict[str, _Topic]:
    """Which topic serves each role; roles that nothing serves are left out."""
    chosen = {}
    by_name = {topic.name: topic for topic in present}
    for role, name in requested.items():
        topic = by_name.get(name)
        if topic is None:
            raise NavigationError(f"{path}: no topic {name}; it has {_list_topics(present)}")
        if topic.kind not in _TAKES[role]:
            raise NavigationError(
                f"{path}: {name} is {topic.kind}; {role} can come from {', '.join(_TAKES[role])}"
            )
        chosen[role] = topic

    def choose(role: str, groups: Sequence[Sequence[str]], but: Sequence[str] = ()) -> list[_Topic]:
        """Choose the one topic of the first group of types that there is; else all of them."""
        fitting = [
            topic for topic in present
            if topic.last_name not in _ORIGIN and not any(w in topic.name.lower() for w in but)
        ]  # fmt: skip
        of_groups = ([t for t in fitting if t.kind in kinds] for kinds in groups)
        found = next((some for some in of_groups if some), [])
        named = [t for t in found if role == "navigation" and "navig" in t.name.lower()]
        found = named if len(named) == 1 else found
        if len(found) == 1:
            chosen.setdefault(role, found[0])
        return [] if role in chosen else found

    unclear = {"navigation": choose("navigation", [(k,) for k in _TAKES["navigation"]], _TRUTH)}
    main = chosen["navigation"].kind if "navigation" in chosen else None
    if main in (FIX, None):
        unclear |= {
            "depth": choose("depth", [(PRESSURE,)]),
            "attitude": choose("attitude", [(IMU,)]),
        }
    for role, found in unclear.items():
        if found:
            raise NavigationError(
                f"{path}: {_list_topics(found)} could all be {role}: choose one with --topic "
                f"{role}=NAME"
            )
    choose("velocity", [(DVL,), (TWIST_COVARIANCE, TWIST)], (*_TRUTH, "cmd", "command"))
    if main != NAV_STS:
        choose("altitude", [(RANGE,), (DVL,)], (*_TRUTH, *_NOT_ALTITUDE))
    if not chosen:
        known = dict.fromkeys(kind for kinds in _TAKES.values() for kind in kinds)
        raise NavigationError(
            f"{path}: no one topic of {', '.join(known)}; it has {_list_topics(present)}: "
            "choose with --topic ROLE=NAME"
        )
    return chosen


def _list_topics(topics: Sequence[_Topic]) -> str:
    return ", ".join(f"{topic.name} ({topic.kind})" for topic in topics) or "no topics"


def _collect(
    reader: "AnyReader", needed: set[_Topic], lost: Counter[str], notes: list[str]
) -> tuple[dict[_Topic, Array], dict[_Topic, dict[str, Array]]]:
    """Times of messages, and their columns by name (`ROWS`) or joint.

    Times are of the header, else (unset, or no header) of the recording.
    """
    kinds = {topic.name: topic for topic in needed}
    connections = [c for c in reader.connections if c.topic in kinds]
    times: dict[str, list[float]] = {name: [] for name in kinds}
    rows: dict[str, list[Sequence[float]]] = {name: [] for name in kinds}
    names: dict[str, tuple[str, ...]] = {
        topic.name: ROWS[topic.kind][0] for topic in needed if topic.kind in ROWS
    }
    unset: Counter[str] = Counter()
    total = sum(c.msgcount for c in connections)
    messages = reader.messages(connections) if connections else iter(())
    for connection, recorded_ns, raw in progress(messages, "log", total):
        message: Any = reader.deserialize(raw, connection.msgtype)
        name = connection.topic
        stamp = getattr(getattr(message, "header", None), "stamp", None)
        time_s = recorded_ns * 1e-9
        if stamp is not None and (stamp.sec or stamp.nanosec):
            time_s = stamp.sec + stamp.nanosec * 1e-9
        elif stamp is not None and time_s > DATED_AFTER_S:
            unset[name] += 1
        if kinds[name].kind == JOINTS:
            joints = names.setdefault(name, tuple(message.name))
            if tuple(message.name) != joints or len(message.velocity) != len(joints):
                lost[f"{name}: joints without a speed, or not those of the first message"] += 1
                continue
            rows[name].append(message.velocity)
        else:
            try:
                rows[name].append(ROWS[kinds[name].kind][1](message))
            except AttributeError as error:
                raise NavigationError(
                    f"{name}: {connection.msgtype} is not the {kinds[name].kind} that is known: "
                    f"{error}"
                ) from None
        times[name].append(time_s)
    for name, count in sorted(unset.items()):
        notes.append(f"{name}: {count} headers without a time have that of their recording")
    tables = {}
    for name, topic in kinds.items():
        columns = names.get(name, ())
        table = np.array(rows[name], dtype=np.float64).reshape(-1, len(columns))
        tables[topic] = dict(zip(columns, table.T, strict=True))
    return {topic: np.array(times[name]) for name, topic in kinds.items()}, tables


def _add_sigmas(_: _Topic, table: dict[str, Array], __: Counter[str]) -> None:
    """Standard deviations of variances; one that is not positive is not known."""
    for column, (names, scale) in _SIGMAS.items():
        if set(names) <= table.keys():
            variance = np.mean([table[name] for name in names], axis=0)
            table[column] = scale * np.sqrt(np.where(variance > 0, variance, np.nan))


def _add_angles(topic: _Topic, table: dict[str, Array], lost: Counter[str]) -> None:
    """Angles in degrees, of quaternions where there are such."""
    if QUATERNION[0] in table:
        xyzw = np.stack([table[name] for name in QUATERNION], axis=1)
        angles = angles_of(xyzw)
        if bad := int((np.isfinite(xyzw).all(axis=1) & np.isnan(angles[:, 0])).sum()):
            lost[f"{topic.name}: quaternions that are not of length 1"] += bad
        table.update(zip(ANGLES, angles.T, strict=True))
    elif ANGLES[0] in table:
        table.update({name: table[name] * float(np.rad2deg(1.0)) for name in ANGLES})


def _drop_no_bottom(topic: _Topic, table: dict[str, Array], lost: Counter[str]) -> None:
    if "altitude" in table:
        absent = table["altitude"] <= 0
        if absent.any():
            lost[f"{topic.name}: altitudes not above 0: no bottom"] += int(absent.sum())
        table["altitude"] = np.where(absent, np.nan, table["altitude"])


def _datum(path: Path, topic: _Topic, fixes: Mapping[str, Array]) -> Datum:
    """The place that a topic states first."""
    place = [float(fixes[name][0]) for name in (*PLACE, "height") if len(fixes[name])]
    if len(place) < 3 or not np.isfinite(place).all():
        raise NavigationError(f"{path}: {topic.name} holds no place: give --datum")
    return Datum(*place)


def _add_geodetic(tables: Mapping[_Topic, dict[str, Array]], datum: Datum) -> None:
    """Latitude, longitude and depth to every odometry, which counts from the datum."""
    for topic, table in tables.items():
        if topic.kind == ODOMETRY:
            ned = np.stack([table[name] for name in NED], axis=1)
            place = of_known(ned, 3, datum.geodetic_from_ned)
            table.update(zip((*PLACE, "depth"), place.T, strict=True))


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


def _dvl(m: Any) -> list[float]:
    """Forward, right, down and the range along the last; nothing without bottom lock."""
    if not getattr(m, "velocity_valid", True):
        return [_NOTHING] * 4
    v = m.velocity
    return [v.x, v.y, v.z, m.altitude]


def _twist(m: Any) -> list[float]:
    """A velocity in the frame of the body; a covariance that begins below 0 is not given."""
    frame = m.header.frame_id.lower().strip("/").rsplit("/", 1)[-1]
    if frame.removesuffix("_ned") in _WORLDS:
        raise NavigationError(
            f"a {type(m).__name__} is of the frame {frame}, which does not turn with the body: "
            "choose another topic with --topic velocity=NAME"
        )
    twist = m.twist
    if hasattr(twist, "covariance"):
        if twist.covariance[0] < 0:
            return [_NOTHING] * 3
        twist = twist.twist
    v = np.array([twist.linear.x, twist.linear.y, twist.linear.z])
    return list(v if _is_ned(m) else flipped_body(v))


def _imu(m: Any) -> list[float]:
    q = m.orientation
    if m.orientation_covariance[0] < 0:
        return [_NOTHING] * 4
    turn = np.array([q.x, q.y, q.z, q.w])
    return list(turn if _is_ned(m) else flipped_quaternion(turn))


def _range(m: Any) -> list[float]:
    """Not finite, or outside of what the sensor measures, is no echo (REP-117)."""
    maximum = m.max_range if m.max_range > 0 else math.inf
    known = math.isfinite(m.range) and m.min_range <= m.range <= maximum
    return [m.range if known else _NOTHING]


def _pressure(m: Any) -> list[float]:
    return [(m.fluid_pressure - _SURFACE_PA) / (_DENSITY_KG_M3 * _GRAVITY_MPS2)]


ROWS: Mapping[str, tuple[tuple[str, ...], Callable[[Any], list[float]]]] = {
    NAV_STS: (
        (*PLACE, "depth", "altitude", *ANGLES, *VARIANCES, *VELOCITY, *RATES), _nav_sts,
    ),
    ODOMETRY: ((*NED, *QUATERNION, *VARIANCES, *VELOCITY, *RATES), _odometry),
    FIX: ((*PLACE, "height", "var_north", "var_east"), _fix),
    IMU: (QUATERNION, _imu),
    PRESSURE: (("depth",), _pressure),
    RANGE: (("altitude",), _range),
    DVL: ((*VELOCITY, "altitude"), _dvl),
    TWIST: (VELOCITY, _twist),
    TWIST_COVARIANCE: (VELOCITY, _twist),
} | {kind: (("depth", "altitude"), lambda m: [m.data] * 2) for kind in NUMBERS}  # fmt: skip
"""For each type: the names of the columns, and what takes them from a message."""


def _is_ned(m: Any) -> bool:
    frame = m.header.frame_id.lower()
    return "ned" in frame or "frd" in frame


MAX_BYTES = 256 << 20
"""Largest chunk of a bag, unpacked, since a kilobyte of bz2 or zstd can hold a gigabyte. Recorders
close theirs after 1 to 4 MB, or after one message."""

_COLA2 = {
    "cola2_msgs/msg/DecimalLatLon": "float64 latitude\nfloat64 longitude\n",
    "cola2_msgs/msg/NED": "float64 north\nfloat64 east\nfloat64 depth\n",
    "cola2_msgs/msg/RPY": "float32 roll\nfloat32 pitch\nfloat32 yaw\n",
    "cola2_msgs/msg/NavSts": (
        "std_msgs/Header header\nDecimalLatLon global_position\nDecimalLatLon origin\n"
        "NED position\nfloat32 altitude\ngeometry_msgs/Point body_velocity\nRPY orientation\n"
        "RPY orientation_rate\nNED position_variance\nRPY orientation_variance\n"
    ),
}
"""Message definitions for bags of ROS 2 before Iron, which hold none."""


def is_bag(path: Path) -> bool:
    """Whether a path looks like a bag of ROS."""
    return path.suffix.lower() in (".bag", ".mcap", ".db3") or (path / "metadata.yaml").is_file()


@contextmanager
def opened_bag(path: Path) -> Iterator["AnyReader"]:
    """An open reader; what goes wrong while it is open names the file in one line."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if not path.exists():
        raise NavigationError(f"{path}: no such file or folder")
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in _COLA2.items():
        store.register(get_types_from_msg(text, name))
    try:
        files = path.iterdir() if path.is_dir() else [path]
        for file in (one for one in files if not one.is_dir()):
            with ordinary_file(file, None).open("rb") as opened:
                if file.suffix.lower() == ".bag" and b"\n" not in opened.read(16):
                    raise ValueError("its first line is not that of a bag")
        with _bounded_chunks(), AnyReader([path], default_typestore=store) as reader:
            yield reader
    except AliceError:
        raise
    except Exception as error:  # damaged bags raise all kinds, MemoryError too
        if path.is_file() and path.open("rb").read(4) == b"\x89HDF":
            raise NavigationError(
                f"{path}: a bathymetric attributed grid (HDF5), not a bag of ROS"
            ) from None
        reason = one_line(error)
        raise NavigationError(
            f"{path}: cannot be read as a bag of ROS, is it cut off? ({reason}); `rosbag reindex` "
            "or `ros2 bag reindex` repairs a bag whose recording was killed"
        ) from None


@contextmanager
def _bounded_chunks() -> Iterator[None]:
    """Meanwhile rosbags unpacks no chunk of over `MAX_BYTES`: it raises ValueError.

    It has no setting for that: its tables of what unpacks a chunk are changed, and put back.
    """
    import lz4.frame  # type: ignore[import-untyped]  # it has no types
    from rosbags.rosbag1.reader import decompressors as of_ros1
    from rosbags.rosbag2.storage_mcap import DECOMPRESSORS as OF_MCAP
    from rosbags.rosbag2.storage_mcap import zstd  # type: ignore[attr-defined]  # by Python's age

    lz4_frames = _limit_unpacking(lambda: lz4.frame.LZ4FrameDecompressor())
    zstd_frames = _limit_unpacking(lambda: zstd.ZstdDecompressor())
    before = dict(of_ros1), dict(OF_MCAP)
    of_ros1.update(bz2=_limit_unpacking(bz2.BZ2Decompressor), lz4=lz4_frames)
    OF_MCAP.update(lz4=lambda data, _: lz4_frames(data), zstd=lambda data, _: zstd_frames(data))
    try:
        yield
    finally:
        of_ros1.update(before[0])
        OF_MCAP.update(before[1])


def _limit_unpacking(decompressor: Callable[[], Any]) -> Callable[[bytes], bytes]:
    def unpack(data: bytes) -> bytes:
        unpacked: bytes = decompressor().decompress(data, MAX_BYTES + 1)
        if len(unpacked) > MAX_BYTES:
            raise ValueError(f"a chunk of {len(data)} bytes unpacks to over {MAX_BYTES >> 20} MiB")
        return unpacked

    return unpack
