"""A flight as a ROS 2 bag (MCAP): what RViz, Foxglove, PlotJuggler and `ros2 bag` open.

World `map` is ENU with its origin at the datum on the sea surface, the body is FLU (REP-103). Times
are those of the flight: the same flight gives the same bytes.
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
from missions.logs.ros_builder import (
    FIX,
    JOINTS,
    MAP,
    NS_PER_S,
    NUMBERS,
    ODOMETRY,
    RANGE,
    TRANSFORMS,
    MessageBuilder,
    flipped_body,
    flipped_quaternion,
    flipped_world,
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
                writer.add_connection(topic.name, topic.kind, typestore=store) for topic in topics
            ]
            ordered = heapq.merge(
                *(
                    zip(topic.stamps_ns, itertools.repeat(rank), itertools.count(), strict=False)
                    for rank, topic in enumerate(topics)
                )
            )
            total = sum(len(topic.stamps_ns) for topic in topics)
            for stamp, rank, row in progress(ordered, "bag", total):
                topic = topics[rank]
                data = store.serialize_cdr(topic.message(stamp, row), topic.kind)
                writer.write(connections[rank], stamp, data)
        os.replace(outer / path.name, path)  # noqa: PTH105 (a folder onto a free name)
    except OSError as error:
        raise WorkspaceError(f"{path}: cannot be written: {error.strerror}") from None
    finally:
        shutil.rmtree(outer, ignore_errors=True)


@dataclass(frozen=True)
class _BagTopic:
    """One topic: when its messages are, and how to make one."""

    name: str
    kind: str
    stamps_ns: list[int]
    message: Callable[[int, int], Any]
    """Makes the message of a stamp and a row of the record."""


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

    def beam(number: int) -> _BagTopic:
        frame, ranges = f"{name}/dvl_beam_{number + 1}", record.beam_m[:, number]
        return _BagTopic(
            f"/{name}/dvl/beam_{number + 1}", RANGE, heard,
            lambda stamp, i: ros.range(stamp, frame, ranges[i]),
        )  # fmt: skip

    return [
        _BagTopic(
            f"/{name}/datum", FIX, stamps[:1], lambda stamp, _: ros.fix(stamp, MAP, origin, None)
        ),
        _BagTopic(
            f"/{name}/truth/odometry", ODOMETRY, stamps,
            lambda stamp, i: ros.odometry(
                stamp, true_body, true_place[i], true_turn[i], exact, true_speed[i]
            ),
        ),
        _BagTopic(
            f"/{name}/navigation/odometry", ODOMETRY, stamps,
            lambda stamp, i: ros.odometry(stamp, body, place[i], turn[i], variances[i], speed[i]),
        ),
        _BagTopic(
            f"/{name}/navigation/fix", FIX, stamps,
            lambda stamp, i: ros.fix(stamp, body, geodetic[i], variances[i, :3]),
        ),
        _BagTopic(
            "/tf", TRANSFORMS, stamps,
            lambda stamp, i: ros.transforms(
                stamp, {body: (place[i], turn[i]), true_body: (true_place[i], true_turn[i])}
            ),
        ),
        _BagTopic(
            f"/{name}/navigation/altitude", RANGE, stamps,
            lambda stamp, i: ros.range(stamp, f"{name}/port", record.altitude_m[i]),
        ),
        _BagTopic(
            f"/{name}/thrusters/state", JOINTS, stamps,
            lambda stamp, i: ros.joints(stamp, record.thrusters, rad_s[i]),
        ),
        _BagTopic(
            f"/{name}/thrusters/power", NUMBERS, stamps,
            lambda _, i: ros.numbers(label, record.power_w[i]),
        ),
        *(beam(number) for number in range(record.beam_m.shape[1])),
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
