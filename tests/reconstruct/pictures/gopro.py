"""Videos as a GoPro writes them, after the public specification of MP4."""

import struct
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

EPOCH = datetime(1904, 1, 1, tzinfo=UTC)


def box(kind: bytes, *contents: bytes) -> bytes:
    """A box of ISO/IEC 14496-12."""
    content = b"".join(contents)
    return struct.pack(">I4s", 8 + len(content), kind) + content


def full_box(kind: bytes, *contents: bytes, version: int = 0) -> bytes:
    """A box with a version."""
    return box(kind, struct.pack(">I", version << 24), *contents)


def film(
    path: Path, frames: Sequence[NDArray[np.uint8]], rate_hz: float, *,
    created: datetime | None = None, gopro: bool = True,
) -> Path:  # fmt: skip
    """Write an MP4, with its time of creation where it is given."""
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = frames[0].shape[:2]
    scratch = path.with_name(f"scratch_{path.stem}.mp4")
    writer = cv2.VideoWriter(
        str(scratch), cv2.VideoWriter.fourcc(*"mp4v"), rate_hz, (width, height)
    )
    for frame in frames:
        writer.write(frame)
    writer.release()
    data = scratch.read_bytes()
    scratch.unlink()
    at, others, index = 0, b"", b""
    while at < len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        if kind == b"moov":
            index = data[at + 8 : at + size]
        else:
            assert not index, "the index comes last, so that offsets stay"
            others += data[at : at + size]
        at += size
    if created is not None:
        place = index.index(b"mvhd") + 8
        seconds = round((created - EPOCH).total_seconds())
        index = index[:place] + struct.pack(">I", seconds) + index[place + 4 :]
    if gopro:
        index = index.replace(b"VideoHandler\0", b"GoPro AVC  \0\0")
    path.write_bytes(others + box(b"moov", index))
    return path
