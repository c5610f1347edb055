"""When a video was made and where a GoPro was, by the index of an MP4 and its telemetry (GPMF).

Boxes are those of ISO/IEC 14496-12; keys, lengths and values of telemetry as
https://github.com/gopro/gpmf-parser documents them; what a file states is bounded before it is
used. Only GPS is read: time and place where there was a fix, which is above water. Its
accelerometers are not: their axes differ from model to model, and a stabilised picture does not
turn with its body.
"""

import math
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.errors import ImageError
from alice_survey.core.frames import Array

_MP4_EPOCH = datetime(1904, 1, 1, tzinfo=UTC)
_YEARS = range(2000, 2200)
"""Years in which a digital camera can have made a video."""
_MAX_BOX = 32 << 20
"""Bytes of a table of the index of a video: a day of it takes less."""
_MAX_BOXES = 4096
_MAX_SAMPLES = 1_000_000
_MAX_PAYLOAD = 4 << 20
"""Bytes of telemetry of one sample, which holds a second."""
_MAKER = b"GoPro"
_MIN_FIX = 3
"""A fix in three dimensions."""
_MAX_DOP = 5.0
"""Dilution of precision below which GoPro calls a fix good."""
_MAX_ITEMS = 20_000
_GPS_EPOCH = datetime(2000, 1, 1, tzinfo=UTC)
_GPS9 = "lllllllSS"
"""Latitude, longitude, altitude, speeds in 2D and 3D, days, seconds, dilution, fix."""
_CODES = {"b": "b", "B": "B", "s": "h", "S": "H", "l": "i", "L": "I", "f": "f", "d": "d",
          "j": "q", "J": "Q"}  # fmt: skip
_MAX_FIX_AGE_S = 1.0
"""Time to a fix within which a picture has its place."""

Span = tuple[int, int]
"""First byte and end of the content of a box."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Fixes:
    """Good fixes of a GPS, (N,) each, by the time of the video."""

    time_s: Array
    """Seconds from the start of the video, increasing."""
    places: Array
    """(N, 3) latitude, longitude (degrees) and altitude (m)."""
    utc_s: Array
    """Seconds since 2000 of the fix itself; NaN where they are not stated."""

    def at(self, time_s: float) -> tuple[float, float, float] | None:
        """Latitude, longitude and altitude at a time; None where no fix is near."""
        if not len(self.time_s) or np.abs(self.time_s - time_s).min() > _MAX_FIX_AGE_S:
            return None
        latitude, longitude, altitude = (
            float(np.interp(time_s, self.time_s, values)) for values in self.places.T
        )
        return latitude, longitude, altitude

    def start_utc(self) -> datetime | None:
        """When the video began, by the median fix; None without any."""
        known = np.isfinite(self.utc_s)
        if not known.any():
            return None
        seconds = float(np.median(self.utc_s[known] - self.time_s[known]))
        return _GPS_EPOCH + timedelta(seconds=seconds)


@dataclass(frozen=True, kw_only=True)
class Mp4Facts:
    """What an MP4 says of when and where it was made."""

    created: datetime | None = None
    """As the container states it, in UTC; None where it states nothing that can be."""
    is_gopro: bool = False
    """Whether a GoPro made it, which writes its local time as if it were UTC."""
    fixes: Fixes | None = None
    """Of its telemetry; what is damaged counts as none."""


def read_mp4(path: Path) -> Mp4Facts:
    """The facts of an MP4 or MOV; of other files, and of damaged ones, nothing.

    Raises:
        ImageError: the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            return _facts(file, file.seek(0, os.SEEK_END))
    except OSError as error:
        raise ImageError(f"{path}: cannot be read: {error.strerror}") from None
    except (struct.error, ValueError, IndexError, OverflowError):
        return Mp4Facts()  # OpenCV decides whether its pictures can be read all the same


def _boxes(file: BinaryIO, inside: Span) -> Iterator[tuple[bytes, Span]]:
    """Kinds and contents of the boxes that lie one after the other."""
    at, end = inside
    for _ in range(_MAX_BOXES):
        file.seek(at)
        head = file.read(16)
        if at + 8 > end or len(head) < 8:
            return
        size, kind = struct.unpack(">I4s", head[:8])
        begin = at + 8
        if size == 1 and len(head) == 16:
            size, begin = struct.unpack(">Q", head[8:])[0], at + 16
        at = end if size == 0 else min(at + size, end)
        if at < begin:
            return
        yield kind, (begin, at)


def _find(file: BinaryIO, inside: Span, *kinds: bytes) -> Span:
    """The first box of a kind, in the first box of the kind before; else an empty one."""
    for requested in kinds:
        inside = next((span for kind, span in _boxes(file, inside) if kind == requested), (0, 0))
    return inside


def _content(file: BinaryIO, inside: Span, *kinds: bytes) -> bytes:
    begin, end = _find(file, inside, *kinds)
    file.seek(begin)
    return file.read(min(end - begin, _MAX_BOX))


def _facts(file: BinaryIO, total: int) -> Mp4Facts:
    index = _find(file, (0, total), b"moov")
    tracks = [span for kind, span in _boxes(file, index) if kind == b"trak"]
    of_gopro = any(_MAKER in _content(file, track, b"mdia", b"hdlr") for track in tracks)
    tables = [_find(file, track, b"mdia", b"minf", b"stbl") for track in tracks]
    telemetry = [
        (_content(file, track, b"mdia", b"mdhd"), table)
        for track, table in zip(tracks, tables, strict=True)
        if _content(file, table, b"stsd")[12:16] == b"gpmd"
    ]
    return Mp4Facts(
        created=_creation_time(_content(file, index, b"mvhd")),
        is_gopro=of_gopro or bool(telemetry),
        fixes=_read_fixes(file, total, *telemetry[0]) if telemetry else None,
    )


def _creation_time(header: bytes) -> datetime | None:
    if len(header) < 12:
        return None
    (seconds,) = struct.unpack_from(">Q" if header[0] == 1 else ">I", header, 4)
    if seconds > 1 << 34:
        return None
    made = _MP4_EPOCH + timedelta(seconds=seconds)
    return made if made.year in _YEARS else None


def _payloads(
    file: BinaryIO, total: int, header: bytes, table: Span
) -> Iterator[tuple[float, float, bytes]]:
    """Start, end (seconds) and bytes of each sample of a track that the file holds."""
    (scale,) = struct.unpack_from(">I", header, 20 if header[0] == 1 else 12)
    sizes = _sizes(_content(file, table, b"stsz"))
    offsets = _offsets(file, table, sizes)
    times = _rows(_content(file, table, b"stts"), 4, 2)
    if scale == 0 or times[:, 0].sum() > _MAX_SAMPLES:
        return
    starts_s = np.concatenate([[0], np.cumsum(np.repeat(times[:, 1], times[:, 0]))]) / scale
    left = total
    for offset, size, start_s, end_s in zip(
        offsets.tolist(), sizes.tolist(), starts_s.tolist(), starts_s[1:].tolist(), strict=False
    ):
        left -= size  # samples do not overlap
        if 0 < size <= _MAX_PAYLOAD and 0 <= offset <= total - size and left >= 0:
            file.seek(offset)
            yield start_s, end_s, file.read(size)


def _sizes(box: bytes) -> NDArray[np.int64]:
    same, count = struct.unpack_from(">II", box, 4)
    if count > _MAX_SAMPLES:
        return np.zeros(0, np.int64)
    return np.full(count, same) if same else _rows(box, 8, 1)[:, 0]


def _offsets(file: BinaryIO, table: Span, sizes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Where samples are: by chunks, in each of which some of them follow one another."""
    narrow = _content(file, table, b"stco")
    wide = b"" if narrow else _content(file, table, b"co64")
    chunks = _rows(narrow, 4, 1)[:, 0] if narrow else _rows(wide, 4, 1, wide=True)[:, 0]
    runs = _rows(_content(file, table, b"stsc"), 4, 3)
    run = np.searchsorted(runs[:, 0], np.arange(1, len(chunks) + 1), side="right") - 1
    held = np.where(run >= 0, runs[run, 1], 0) if len(runs) else np.zeros(len(chunks), np.int64)
    first = np.concatenate([[0], np.cumsum(np.minimum(held, len(sizes)))])[:-1]
    held = np.clip(len(sizes) - first, 0, held)
    starts = np.concatenate([[0], np.cumsum(sizes)])
    in_chunk = starts[: held.sum()] - np.repeat(starts[np.minimum(first, len(sizes))], held)
    found: NDArray[np.int64] = np.repeat(chunks, held) + in_chunk
    return found


def _rows(box: bytes, at: int, columns: int, *, wide: bool = False) -> NDArray[np.int64]:
    """(N, columns) numbers of a table, which follow their count at a place."""
    (count,) = struct.unpack_from(">I", box, at)
    kind = np.dtype(">u8" if wide else ">u4")
    count = min(count, (len(box) - at - 4) // (columns * kind.itemsize), _MAX_SAMPLES)
    flat = np.frombuffer(box, kind, count * columns, at + 4)
    return flat.astype(np.int64).reshape(count, columns)


def _read_fixes(file: BinaryIO, total: int, header: bytes, table: Span) -> Fixes:
    """Good fixes in a track of telemetry."""
    rows: list[tuple[float, ...]] = []
    for start_s, end_s, data in _payloads(file, total, header, table):
        for device in _items(data):
            for stream in _items(device.data) if device.key == b"DEVC" else ():
                if stream.key == b"STRM":
                    found = _fixes_of(list(_items(stream.data)))
                    for i, row in enumerate(found):
                        rows.append((start_s + (end_s - start_s) * i / len(found), *row))
    fixes = np.array(rows, dtype=np.float64).reshape(-1, 7)
    good = (
        np.isfinite(fixes[:, :4]).all(axis=1)
        & (np.abs(fixes[:, 1]) <= 90)
        & (np.abs(fixes[:, 2]) <= 180)
        & (fixes[:, 5] >= _MIN_FIX)
        & (fixes[:, 6] < _MAX_DOP)
    )
    fixes = fixes[good]
    fixes = fixes[np.argsort(fixes[:, 0], kind="stable")]
    return Fixes(time_s=fixes[:, 0], places=fixes[:, 1:4], utc_s=fixes[:, 4])


class _KlvItem(NamedTuple):
    """One key with its values."""

    key: bytes
    kind: str
    size: int
    data: bytes


def _items(data: bytes) -> Iterator[_KlvItem]:
    """Keys that lie one after the other, each padded to 4 bytes."""
    at = 0
    for _ in range(_MAX_ITEMS):
        if at + 8 > len(data):
            return
        key, kind, size, repeat = struct.unpack_from(">4scBH", data, at)
        end = at + 8 + size * repeat
        if key == b"\0\0\0\0" or end > len(data):
            return
        yield _KlvItem(key, kind.decode("latin-1"), size, data[at + 8 : end])
        at = end + -(size * repeat) % 4


def _values(item: _KlvItem | None, kinds: str = "") -> Array:
    """(repeat, N) numbers of an item; (0, 0) of a kind that holds none."""
    if item is None:
        return np.zeros((0, 0))
    codes = "".join(_CODES.get(kind, "") for kind in kinds)
    if not codes and (code := _CODES.get(item.kind)):
        codes = code * (item.size // struct.calcsize(f">{code}"))
    if not codes or struct.calcsize(f">{codes}") != item.size:
        return np.zeros((0, 0))
    return np.array(list(struct.iter_unpack(f">{codes}", item.data)), dtype=np.float64)


def _fixes_of(stream: list[_KlvItem]) -> list[tuple[float, ...]]:
    """Latitude, longitude, altitude, seconds since 2000, fix and dilution of every sample."""
    said = {item.key: item for item in stream}
    newer = said.get(b"GPS9")
    scale = _values(said.get(b"SCAL")).ravel()
    values = _values(newer, _GPS9) if newer else _values(said.get(b"GPS5"))
    width = len(_GPS9) if newer else 5
    if values.shape[1:] != (width,) or scale.size not in (1, width) or not scale.all():
        return []
    values = values / scale
    if newer:
        utc_s, fix, precision = values[:, 5] * 86400.0 + values[:, 6], values[:, 8], values[:, 7]
    else:
        fix, precision = (
            np.full(len(values), next(iter(_values(said.get(key)).ravel()), math.nan))
            for key in (b"GPSF", b"GPSP")
        )
        precision = precision / 100.0
        utc_s = np.full(len(values), math.nan)
        utc_s[:1] = _utc_s(said.get(b"GPSU"))  # of the first sample
    columns = (*values[:, :3].T, utc_s, fix, precision)
    return [tuple(map(float, row)) for row in zip(*columns, strict=True)]


def _utc_s(item: _KlvItem | None) -> float:
    """Seconds since 2000 of a text such as 240701120000.000."""
    if item is None:
        return math.nan
    text = item.data.decode("latin-1").strip("\0 ")
    try:
        when = datetime.strptime(text, "%y%m%d%H%M%S.%f").replace(tzinfo=UTC)
    except ValueError:
        return math.nan
    return (when - _GPS_EPOCH).total_seconds()
