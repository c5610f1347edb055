"""Open bags of ROS 1 and ROS 2 that may be damaged, or made to harm."""

import bz2
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from alice_survey.core.contents import one_line
from alice_survey.core.errors import NavigationError

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

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
    from apsw import Error as SqliteError
    from rosbags.highlevel import AnyReader, AnyReaderError
    from rosbags.rosbag1 import ReaderError as Reader1Error
    from rosbags.rosbag2 import ReaderError as Reader2Error
    from rosbags.rosbag2.storage_mcap import zstd  # type: ignore[attr-defined]  # by Python's age
    from rosbags.serde import SerdeError
    from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

    if not path.exists():
        raise NavigationError(f"{path}: no such file or folder")
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in _COLA2.items():
        store.register(get_types_from_msg(text, name))
    # A damaged file may claim lengths that no memory holds; lz4 raises RuntimeError.
    faults = (
        AnyReaderError, Reader1Error, Reader2Error, SerdeError, TypesysError, SqliteError,
        zstd.ZstdError, OSError, struct.error, ValueError, KeyError, IndexError, AssertionError,
        EOFError, MemoryError, RuntimeError, OverflowError, TypeError, AttributeError,
        RecursionError,
    )  # fmt: skip
    try:
        with _bounded_chunks(), AnyReader([path], default_typestore=store) as reader:
            yield reader
    except NavigationError:
        raise
    except faults as error:
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
