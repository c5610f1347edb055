"""Chunks of bags, unpacked within bounds: a kilobyte of bz2 or zstd can hold a gigabyte."""

import bz2
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

LARGEST_BYTES = 256 << 20
"""Largest chunk, unpacked. Recorders close theirs after 1 to 4 MB, or after one message."""


@contextmanager
def bounded_chunks() -> Iterator[None]:
    """Meanwhile rosbags unpacks no chunk of over `LARGEST_BYTES`: it raises ValueError.

    It has no setting for that: its tables of what unpacks a chunk are changed, and put back.
    """
    import lz4.frame  # type: ignore[import-untyped]
    from rosbags.rosbag1.reader import decompressors as of_ros1
    from rosbags.rosbag2.storage_mcap import DECOMPRESSORS as OF_MCAP
    from rosbags.rosbag2.storage_mcap import zstd  # type: ignore[attr-defined]  # by Python's age

    lz4_frames = _bounded(lambda: lz4.frame.LZ4FrameDecompressor())
    zstd_frames = _bounded(lambda: zstd.ZstdDecompressor())
    before = dict(of_ros1), dict(OF_MCAP)
    of_ros1.update(bz2=_bounded(bz2.BZ2Decompressor), lz4=lz4_frames)
    OF_MCAP.update(lz4=lambda data, _: lz4_frames(data), zstd=lambda data, _: zstd_frames(data))
    try:
        yield
    finally:
        of_ros1.update(before[0])
        OF_MCAP.update(before[1])


def _bounded(decompressor: Callable[[], Any]) -> Callable[[bytes], bytes]:
    def unpack(data: bytes) -> bytes:
        unpacked: bytes = decompressor().decompress(data, LARGEST_BYTES + 1)
        if len(unpacked) > LARGEST_BYTES:
            raise ValueError(
                f"a chunk of {len(data)} bytes unpacks to over {LARGEST_BYTES >> 20} MiB"
            )
        return unpacked

    return unpack
