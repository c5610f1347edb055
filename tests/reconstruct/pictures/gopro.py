"""Videos as a GoPro writes them, after the public specifications of MP4 and GPMF."""

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


def klv(key: bytes, kind: str, size: int, *samples: bytes) -> bytes:
    """A key, its type, size and number of samples, and the samples, padded to 4 bytes."""
    content = b"".join(samples)
    head = struct.pack(">4scBH", key, kind.encode("latin-1"), size, len(samples))
    return head + content + b"\0" * (-len(content) % 4)


def nest(key: bytes, *items: bytes) -> bytes:
    """Keys in a key."""
    content = b"".join(items)
    return struct.pack(">4sBBH", key, 0, 1, len(content)) + content


def gps5(
    places: Sequence[tuple[float, float, float]], when: datetime, fix: int = 3, dop: float = 1.2
) -> bytes:
    """One second of telemetry of HERO5 to HERO10: latitudes, longitudes, altitudes."""
    scale = (10**7, 10**7, 1000, 1000, 100)
    rows = [
        struct.pack(">5i", *(round(v * s) for v, s in zip((*p, 0.1, 0.1), scale, strict=True)))
        for p in places
    ]
    text = when.strftime("%y%m%d%H%M%S.") + f"{when.microsecond // 1000:03d}"
    return nest(
        b"DEVC",
        klv(b"DVID", "L", 4, struct.pack(">I", 1)),
        klv(b"DVNM", "c", 6, b"Camera"),
        nest(b"STRM", klv(b"ACCL", "s", 6, *[struct.pack(">3h", 1, 2, 3)] * 5)),
        nest(
            b"STRM",
            klv(b"GPSF", "L", 4, struct.pack(">I", fix)),
            klv(b"GPSU", "U", 16, text.encode()),
            klv(b"GPSP", "S", 2, struct.pack(">H", round(100 * dop))),
            klv(b"SCAL", "l", 4, *(struct.pack(">i", s) for s in scale)),
            klv(b"GPS5", "l", 20, *rows),
        ),
    )


def gps9(places: Sequence[tuple[float, float, float]], when: datetime, fix: int = 3) -> bytes:
    """One second of telemetry of HERO11 and later."""
    scale = (10**7, 10**7, 1000, 1000, 100, 1, 1000, 100, 1)
    since = when - datetime(2000, 1, 1, tzinfo=UTC)
    rows = []
    for i, place in enumerate(places):
        seconds = since.seconds + since.microseconds / 1e6 + i / len(places)
        values = (*place, 0.1, 0.1, since.days, seconds, 1.5, fix)
        scaled = (round(v * s) for v, s in zip(values, scale, strict=True))
        rows.append(struct.pack(">7i2H", *scaled))
    return nest(
        b"DEVC",
        nest(
            b"STRM",
            klv(b"TYPE", "c", 1, *(bytes([c]) for c in b"lllllllSS")),
            klv(b"SCAL", "l", 4, *(struct.pack(">i", s) for s in scale)),
            klv(b"GPS9", "?", 32, *rows),
        ),
    )


def telemetry_track(offsets: Sequence[int], sizes: Sequence[int]) -> bytes:
    """The track of payloads of a second each."""
    table = box(
        b"stbl",
        full_box(b"stsd", struct.pack(">I", 1), box(b"gpmd", b"\0" * 6 + b"\0\1")),
        full_box(b"stts", struct.pack(">III", 1, len(sizes), 1000)),
        full_box(b"stsc", struct.pack(">IIII", 1, 1, 1, 1)),
        full_box(b"stsz", struct.pack(f">II{len(sizes)}I", 0, len(sizes), *sizes)),
        full_box(b"stco", struct.pack(f">I{len(offsets)}I", len(offsets), *offsets)),
    )
    header = full_box(b"mdhd", struct.pack(">IIIIHH", 0, 0, 1000, 1000 * len(sizes), 0, 0))
    kind = full_box(b"hdlr", b"mhlrmeta", b"\0" * 12, b"\x0bGoPro MET  ")
    links = full_box(b"dref", struct.pack(">I", 1), full_box(b"url "))
    media = box(b"minf", full_box(b"nmhd"), box(b"dinf", links), table)
    head = full_box(
        b"tkhd", struct.pack(">IIII", 0, 0, 9, 0), struct.pack(">I", 1000 * len(sizes)),
        b"\0" * 16, struct.pack(">9i", 65536, 0, 0, 0, 65536, 0, 0, 0, 1 << 30), b"\0" * 8,
    )  # fmt: skip
    return box(b"trak", head, box(b"mdia", header, kind, media))


def film(
    path: Path, frames: Sequence[NDArray[np.uint8]], rate_hz: float = 10.0, *,
    created: datetime | None = None, payloads: Sequence[bytes] = (), gopro: bool = True,
) -> Path:  # fmt: skip
    """Write an MP4, with its time of creation and with telemetry where they are given."""
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
    if payloads:
        starts = np.cumsum([len(others) + 8, *(len(p) for p in payloads)])[:-1]
        others += box(b"mdat", *payloads)
        index += telemetry_track([int(s) for s in starts], [len(p) for p in payloads])
    path.write_bytes(others + box(b"moov", index))
    return path
