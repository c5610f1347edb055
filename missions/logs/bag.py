"""A flight as a ROS 2 bag (MCAP): what RViz, Foxglove, PlotJuggler and `ros2 bag` open.

World `map` is ENU with its origin at the datum on the sea surface, the body is FLU (REP-103). Times
are those of the flight from a start that is an argument: the same flight gives the same bytes.
"""

import heapq
import math
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.base.errors import WorkspaceError
from alice_survey.base.executor import progress
from alice_survey.base.frames import Array, Datum, rotation_from_attitude
from missions.logs import messages as kinds
from missions.logs.messages import Messages, as_nanoseconds
from missions.logs.ros_frames import flipped_body, flipped_quaternion, flipped_world


@dataclass(frozen=True, kw_only=True, eq=False)
class Samples:
    """What one sensor measured; a row with a NaN was not measured and gets no message."""

    time_s: Array
    """(M,) seconds of the flight, increasing."""
    values: Array
    """(M, k) values."""
    sigma: float = 0.0
    """Standard deviation of each value; 0 is not known."""

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or len(self.values) != len(self.time_s):
            raise ValueError(f"{self.values.shape} values for {len(self.time_s)} times")


@dataclass(frozen=True, kw_only=True, eq=False)
class BagRecord:
    """A flight as arrays over one clock, (T,) rows; what is None is left out of the bag.

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
    believed_velocity: Array | None = None
    """(T, 6) as `truth_velocity`."""
    sigma_horizontal_m: Array
    """(T,) sigma of north and of east each."""
    sigma_depth_m: Array
    """(T,) sigma of depth."""
    sigma_attitude_rad: Array
    """(T,) sigma of roll and of pitch each."""
    sigma_heading_rad: Array
    """(T,) sigma of heading."""
    sigma_velocity_mps: Array | None = None
    """(T,) sigma of u, v and w each."""
    altitude_m: Array | None = None
    """(T,) altitude of the left port's glass above the sea floor as navigation has it; NaN is not
    known."""
    thrusters: tuple[str, ...] = ()
    rpm: Array | None = None
    """(T, n) revolutions per minute."""
    power_w: Array | None = None
    """(T, n) electrical power."""
    thrust_n: Array | None = None
    """(T, n) thrusts."""
    imu: Samples | None = None
    """(M, 6) p, q, r, rad/s, and specific force, m/s^2 (acceleration minus gravity: -g along down
    at rest), in the body frame (FRD)."""
    ahrs_rad: Samples | None = None
    """(M, 3) roll, pitch and heading as measured."""
    dvl_mps: Samples | None = None
    """(M, 3) velocity over ground in the body frame (FRD)."""
    beam_m: Samples | None = None
    """(M, b) slant ranges of the DVL's beams; NaN of one beam means no echo."""
    pressure_pa: Samples | None = None
    """(M, 1) absolute."""
    gps: Samples | None = None
    """(M, 3) latitude and longitude, degrees, height above the ellipsoid, metres; sigma in
    metres."""
    usbl_ned_m: Samples | None = None
    """(M, 3) position fixes in NED."""
    start_utc_ns: int = 0
    """Date of `time_s` 0, nanoseconds since 1970; 0 keeps the flight's own clock."""
    notes: dict[str, str] = field(default_factory=dict)
    """Kept in the bag's metadata."""

    def __post_init__(self) -> None:
        rows = len(self.time_s)
        if not np.all(np.diff(self.time_s) > 0):
            raise ValueError("time_s must increase strictly")
        if not np.all(np.isfinite(self.time_s)) or self.time_s.min(initial=0.0) < 0:
            raise ValueError("time_s must be finite and not negative")
        if len(self.truth) != rows or len(self.believed) != rows:
            raise ValueError(f"{len(self.truth)} and {len(self.believed)} poses for {rows} times")
        columns: dict[str, tuple[int, ...]] = {
            "truth_velocity": (rows, 6),
            "believed_velocity": (rows, 6),
            "sigma_horizontal_m": (rows,),
            "sigma_depth_m": (rows,),
            "sigma_attitude_rad": (rows,),
            "sigma_heading_rad": (rows,),
            "sigma_velocity_mps": (rows,),
            "altitude_m": (rows,),
            "rpm": (rows, len(self.thrusters)),
            "power_w": (rows, len(self.thrusters)),
            "thrust_n": (rows, len(self.thrusters)),
        }
        for name, shape in columns.items():
            values = getattr(self, name)
            if values is not None and values.shape != shape:
                raise ValueError(f"{name} has the shape {values.shape}, not {shape}")


def write_bag(path: Path, record: BagRecord) -> int:
    """Write a flight as a ROS 2 bag of MCAP storage: the folder `path`, whole or not at all.

    Messages are made one by one in the order of their times, so that memory holds the record and
    one chunk of the file (1 MiB, compressed) only. The bytes depend on the record, on the folder's
    name and on the versions of rosbags, which names itself in the file, and of zstd.

    Args:
        path: folder to write; it must not exist.
        record: the flight.

    Returns:
        How many messages were written.

    Raises:
        WorkspaceError: the folder exists, or cannot be written.
    """
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

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
            messages = Messages()
            streams = _streams(record, messages)
            connections = {
                stream.topic: writer.add_connection(
                    stream.topic, stream.kind, typestore=messages.store
                )
                for stream in streams
            }
            total = sum(len(stream.stamps_ns) for stream in streams)
            for stamp, rank, row in progress(_merged(streams), "bag", total):
                stream = streams[rank]
                data = messages.store.serialize_cdr(stream.build(stamp, row), stream.kind)
                writer.write(connections[stream.topic], stamp, data)
        os.replace(outer / path.name, path)  # noqa: PTH105 (a folder onto a free name)
    except OSError as error:
        raise WorkspaceError(f"{path}: cannot be written: {error.strerror}") from None
    finally:
        shutil.rmtree(outer, ignore_errors=True)
    return total


@dataclass(frozen=True, kw_only=True, eq=False)
class _Stream:
    """One topic: when its messages are, and how to make one."""

    topic: str
    kind: str
    stamps_ns: list[int]
    rows: list[int]
    """Rows of the record that the messages are made of."""
    build: Callable[[int, int], Any]
    """Builds the message from stamp and row."""


def _merged(streams: list[_Stream]) -> Iterator[tuple[int, int, int]]:
    """Stamp, number of the stream and row of every message, in the order of their times."""

    def numbered(rank: int) -> Iterator[tuple[int, int, int]]:
        stream = streams[rank]
        for stamp, row in zip(stream.stamps_ns, stream.rows, strict=True):
            yield stamp, rank, row

    return heapq.merge(*(numbered(rank) for rank in range(len(streams))))


def _streams(record: BagRecord, messages: Messages) -> list[_Stream]:
    """All topics of a record."""
    return [
        *_datum_stream(record, messages),
        *_pose_streams(record, messages),
        *_thruster_streams(record, messages),
        *_sensor_streams(record, messages),
    ]


def _datum_stream(record: BagRecord, messages: Messages) -> list[_Stream]:
    """Where the map's origin is, once."""
    datum = record.datum
    place = np.array([datum.latitude_deg, datum.longitude_deg, datum.height_m])

    def origin(stamp: int, _: int) -> Any:
        return messages.fix(stamp, kinds.MAP, place, None)

    stamps = as_nanoseconds(record.time_s[:1], record.start_utc_ns)
    return [
        _Stream(
            topic=f"/{record.name}/datum", kind=kinds.FIX, stamps_ns=stamps,
            rows=[0] * len(stamps), build=origin,
        )
    ]  # fmt: skip


def _pose_streams(record: BagRecord, messages: Messages) -> list[_Stream]:
    """Truth and navigation."""
    name, rows = record.name, list(range(len(record.time_s)))
    stamps = as_nanoseconds(record.time_s, record.start_utc_ns)
    true_enu = flipped_world(record.truth.translation)
    true_turn = flipped_quaternion(record.truth.rotation.as_quat())
    true_speed = _flu(record.truth_velocity)
    enu = flipped_world(record.believed.translation)
    turn = flipped_quaternion(record.believed.rotation.as_quat())
    geodetic = record.datum.geodetic_from_ned(record.believed.translation)
    geodetic[:, 2] = record.datum.height_m - geodetic[:, 2]
    horizontal, vertical = record.sigma_horizontal_m**2, record.sigma_depth_m**2
    tilt, heading = record.sigma_attitude_rad**2, record.sigma_heading_rad**2
    position_variances = np.column_stack([horizontal, horizontal, vertical])
    pose_variances = np.column_stack([position_variances, tilt, tilt, heading])
    believed_speed = record.believed_velocity
    speed = np.zeros((len(rows), 6)) if believed_speed is None else _flu(believed_speed)
    speed_variances = np.zeros((len(rows), 6))
    if record.sigma_velocity_mps is not None:
        speed_variances[:, :3] = record.sigma_velocity_mps[:, None] ** 2
    if believed_speed is None:
        # The first element of a covariance says that there is nothing (as in sensor_msgs/Imu).
        speed_variances[:, 0] = -1.0
    exact = np.zeros(6)
    body, true_body = f"{name}/base_link", f"{name}/base_link_truth"

    def truth(stamp: int, i: int) -> Any:
        return messages.odometry(
            stamp, true_body, true_enu[i], true_turn[i], exact, true_speed[i], exact
        )

    def believed(stamp: int, i: int) -> Any:
        return messages.odometry(
            stamp, body, enu[i], turn[i], pose_variances[i], speed[i], speed_variances[i]
        )

    def fix(stamp: int, i: int) -> Any:
        return messages.fix(stamp, body, geodetic[i], position_variances[i])

    def transforms(stamp: int, i: int) -> Any:
        return messages.transforms(
            stamp, {body: (enu[i], turn[i]), true_body: (true_enu[i], true_turn[i])}
        )

    streams = [
        (f"/{name}/truth/odometry", kinds.ODOMETRY, truth),
        (f"/{name}/navigation/odometry", kinds.ODOMETRY, believed),
        (f"/{name}/navigation/fix", kinds.FIX, fix),
        ("/tf", kinds.TRANSFORMS, transforms),
    ]
    altitude = record.altitude_m
    if altitude is not None:

        def level(stamp: int, i: int) -> Any:
            return messages.range(stamp, f"{name}/port", float(altitude[i]))

        streams.append((f"/{name}/navigation/altitude", kinds.RANGE, level))
    return [
        _Stream(topic=topic, kind=kind, stamps_ns=stamps, rows=rows, build=build)
        for topic, kind, build in streams
    ]


def _thruster_streams(record: BagRecord, messages: Messages) -> list[_Stream]:
    rows = list(range(len(record.time_s)))
    stamps = as_nanoseconds(record.time_s, record.start_utc_ns)
    streams: list[tuple[str, str, Callable[[int, int], Any]]] = []
    rpm, thrust, power = record.rpm, record.thrust_n, record.power_w
    if rpm is not None:
        radps = rpm * (2.0 * math.pi / 60.0)

        def state(stamp: int, i: int) -> Any:
            efforts = None if thrust is None else thrust[i]
            return messages.joints(stamp, record.thrusters, radps[i], efforts)

        streams.append(("state", kinds.JOINTS, state))
    if power is not None:
        label = ",".join(record.thrusters)

        def watts(_: int, i: int) -> Any:
            return messages.numbers(label, power[i])

        streams.append(("power", kinds.NUMBERS, watts))
    return [
        _Stream(
            topic=f"/{record.name}/thrusters/{topic}", kind=kind, stamps_ns=stamps, rows=rows,
            build=build,
        )
        for topic, kind, build in streams
    ]  # fmt: skip


def _sensor_streams(record: BagRecord, messages: Messages) -> list[_Stream]:
    """What sensors measured, each by its own clock."""
    name = record.name
    streams: list[_Stream] = []

    def add(
        topic: str, kind: str, samples: Samples | None, build: Callable[[int, Array], Any]
    ) -> None:
        if samples is None:
            return
        measured = np.flatnonzero(np.isfinite(samples.values).all(axis=1))
        values = samples.values
        streams.append(
            _Stream(
                topic=f"/{name}/{topic}",
                kind=kind,
                stamps_ns=as_nanoseconds(samples.time_s[measured], record.start_utc_ns),
                rows=measured.tolist(),
                build=lambda stamp, i: build(stamp, values[i]),
            )
        )

    def variance(samples: Samples | None) -> float:
        return 0.0 if samples is None else samples.sigma**2

    def attitude(stamp: int, row: Array) -> Any:
        turn = flipped_quaternion(rotation_from_attitude(*row).as_quat())
        return messages.imu(
            stamp, f"{name}/base_link", enu_from_flu=turn, variance=variance(record.ahrs_rad)
        )

    def gps(stamp: int, row: Array) -> Any:
        known = variance(record.gps)
        variances = np.full(3, known) if known else None
        return messages.fix(stamp, f"{name}/gps", row, variances)

    add("imu", kinds.IMU, record.imu, lambda stamp, row: messages.imu(
        stamp, f"{name}/base_link", rate_flu=flipped_body(row[:3]),
        force_flu=flipped_body(row[3:]),
    ))  # fmt: skip
    add("ahrs", kinds.IMU, record.ahrs_rad, attitude)
    add("dvl/velocity", kinds.TWIST, record.dvl_mps, lambda stamp, row: messages.twist(
        stamp, f"{name}/base_link", flipped_body(row), variance(record.dvl_mps),
    ))  # fmt: skip
    add("pressure", kinds.PRESSURE, record.pressure_pa, lambda stamp, row: messages.pressure(
        stamp, f"{name}/pressure", float(row[0]), variance(record.pressure_pa),
    ))  # fmt: skip
    add("gps/fix", kinds.FIX, record.gps, gps)
    add("usbl/position", kinds.POSE, record.usbl_ned_m, lambda stamp, row: messages.position(
        stamp, flipped_world(row), variance(record.usbl_ned_m),
    ))  # fmt: skip
    streams += _beam_streams(record, messages)
    return streams


def _beam_streams(record: BagRecord, messages: Messages) -> list[_Stream]:
    """Ranges along a DVL's beams; a time without any echo still has its messages."""
    samples = record.beam_m
    if samples is None:
        return []
    stamps = as_nanoseconds(samples.time_s, record.start_utc_ns)

    def stream(beam: int) -> _Stream:
        def heard(stamp: int, i: int) -> Any:
            frame = f"{record.name}/dvl_beam_{beam + 1}"
            return messages.range(stamp, frame, float(samples.values[i, beam]))

        return _Stream(
            topic=f"/{record.name}/dvl/beam_{beam + 1}", kind=kinds.RANGE, stamps_ns=stamps,
            rows=list(range(len(stamps))), build=heard,
        )  # fmt: skip

    return [stream(beam) for beam in range(samples.values.shape[1])]


def _flu(velocity_frd: Array) -> Array:
    """(T, 6) velocities from FRD to FLU."""
    return np.hstack([flipped_body(velocity_frd[:, :3]), flipped_body(velocity_frd[:, 3:])])
