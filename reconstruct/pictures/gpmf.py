"""Where and when a GoPro was, by the telemetry in its video (GPMF).

Keys, lengths and values as https://github.com/gopro/gpmf-parser documents them. Only GPS is read:
time and place where there was a fix, which is above water. Its accelerometers are not: their axes
differ from model to model, and a stabilised picture does not turn with the body that they are in.
"""

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from alice_survey.core.frames import Array
from reconstruct.pictures.mp4 import TelemetryTrack, payloads

_MIN_FIX = 3
"""A fix in three dimensions."""
_MAX_DOP = 5.0
"""Dilution of precision below which GoPro calls a fix good."""
_MAX_ITEMS = 20_000
_EPOCH = datetime(2000, 1, 1, tzinfo=UTC)
_GPS9 = "lllllllSS"
"""Latitude, longitude, altitude, speeds in 2D and 3D, days, seconds, dilution, fix."""
_CODES = {"b": "b", "B": "B", "s": "h", "S": "H", "l": "i", "L": "I", "f": "f", "d": "d",
          "j": "q", "J": "Q"}  # fmt: skip
_FURTHEST_S = 1.0
"""From a fix at which a picture may have its place."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Fixes:
    """Good fixes of a GPS, (N,) each, by the time of the video."""

    time_s: Array
    """Seconds from the start of the video, increasing."""
    latitude_deg: Array
    longitude_deg: Array
    altitude_m: Array
    utc_s: Array
    """Seconds since 2000 of the fix itself; NaN where they are not stated."""

    def at(self, time_s: float) -> tuple[float, float, float] | None:
        """Latitude, longitude and altitude at a time; None where no fix is near."""
        if not len(self.time_s) or np.abs(self.time_s - time_s).min() > _FURTHEST_S:
            return None
        latitude, longitude, altitude = (
            float(np.interp(time_s, self.time_s, values))
            for values in (self.latitude_deg, self.longitude_deg, self.altitude_m)
        )
        return latitude, longitude, altitude

    def start_utc(self) -> datetime | None:
        """When the video began, by the median fix; None without any."""
        known = np.isfinite(self.utc_s)
        if not known.any():
            return None
        seconds = float(np.median(self.utc_s[known] - self.time_s[known]))
        return _EPOCH + timedelta(seconds=seconds)


@dataclass(frozen=True, kw_only=True)
class _KlvItem:
    """One key with its values."""

    key: bytes
    kind: str
    size: int
    repeat: int
    data: bytes


def read_fixes(path: Path, track: TelemetryTrack) -> Fixes:
    """Good fixes in the telemetry of a video; what is damaged counts as none."""
    rows: list[tuple[float, ...]] = []
    for start_s, end_s, data in payloads(path, track):
        for device in _items(data):
            for stream in _items(device.data) if device.key == b"DEVC" else ():
                if stream.key == b"STRM":
                    found = _fixes_of(list(_items(stream.data)))
                    for i, row in enumerate(found):
                        rows.append((start_s + (end_s - start_s) * i / len(found), *row))
    table = np.array(rows, dtype=np.float64).reshape(-1, 7)
    good = (
        np.isfinite(table[:, :4]).all(axis=1)
        & (np.abs(table[:, 1]) <= 90)
        & (np.abs(table[:, 2]) <= 180)
        & (table[:, 5] >= _MIN_FIX)
        & (table[:, 6] < _MAX_DOP)
    )
    table = table[good]
    table = table[np.argsort(table[:, 0], kind="stable")]
    return Fixes(
        time_s=table[:, 0],
        latitude_deg=table[:, 1],
        longitude_deg=table[:, 2],
        altitude_m=table[:, 3],
        utc_s=table[:, 4],
    )


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
        yield _KlvItem(
            key=key, kind=kind.decode("latin-1"), size=size, repeat=repeat, data=data[at + 8 : end]
        )
        at = end + -(size * repeat) % 4


def _values(item: _KlvItem, kinds: str = "") -> Array:
    """(repeat, N) numbers of an item; (0, 0) of a kind that holds none."""
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
    item = newer or said.get(b"GPS5")
    if item is None or b"SCAL" not in said:
        return []
    scale, values = _values(said[b"SCAL"]).ravel(), _values(item, _GPS9 if newer else "")
    width = len(_GPS9) if newer else 5
    if values.shape[1:] != (width,) or scale.size not in (1, width) or not scale.all():
        return []
    values = values / scale
    if newer:
        utc_s = values[:, 5] * 86400.0 + values[:, 6]
        columns = (*values[:, :3].T, utc_s, values[:, 8], values[:, 7])
        return [tuple(map(float, row)) for row in zip(*columns, strict=True)]
    fix, precision = (_first(said.get(key)) for key in (b"GPSF", b"GPSP"))
    first_utc_s = _utc_s(said.get(b"GPSU"))  # of the first sample
    return [
        (*map(float, row[:3]), first_utc_s if i == 0 else math.nan, fix, precision / 100.0)
        for i, row in enumerate(values)
    ]


def _first(item: _KlvItem | None) -> float:
    values = np.zeros(0) if item is None else _values(item).ravel()
    return float(values[0]) if values.size else math.nan


def _utc_s(item: _KlvItem | None) -> float:
    """Seconds since 2000 of a text such as 240701120000.000."""
    if item is None:
        return math.nan
    text = item.data.decode("latin-1").strip("\0 ")
    try:
        when = datetime.strptime(text, "%y%m%d%H%M%S.%f").replace(tzinfo=UTC)
    except ValueError:
        return math.nan
    return (when - _EPOCH).total_seconds()
