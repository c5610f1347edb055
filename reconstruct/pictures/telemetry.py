"""Where and when a GoPro was, by the GPS in its video: only above water it has a fix.

Keys and values are those that https://github.com/gopro/gpmf-parser documents. Accelerometers are
not read: their axes differ from model to model, and a stabilised picture does not turn with its
body.
"""

import struct
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.frames import Array

_MIN_FIX = 3
"""A fix in three dimensions."""
_MAX_DOP = 5.0
"""Dilution of precision below which GoPro calls a fix good."""
_EPOCH_2000_S = datetime(2000, 1, 1, tzinfo=UTC).timestamp()
_FIX, _DOP, _UTC_MS, _GPS9 = (
    f"0x{key.hex().upper()}" for key in (b"GPSF", b"GPSP", b"GPSU", b"GPS9")
)
_GPS9_ROW = struct.Struct(">7i2H")
"""Latitude, longitude, altitude, speeds in 2D and 3D, days, seconds, dilution, fix."""
_HEAD = 8
"""Bytes of key, type and count before the rows."""
_MAX_FIX_AGE_S = 1.0
"""Time to a fix within which a picture has its place."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Fixes:
    """Good fixes of a GPS, (N,) each, by the time of the video."""

    time_s: Array
    """Seconds from the start of the video, increasing."""
    places: Array
    """(N, 3) latitude, longitude (degrees) and altitude (m)."""
    utc_s: Array
    """Seconds since 1970 of the fix itself; NaN where they are not stated."""

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
        return datetime.fromtimestamp(0, UTC) + timedelta(seconds=seconds)


def read_fixes(path: Path, duration_s: float) -> Fixes:
    """Good fixes of the telemetry of a video; what is damaged counts as none.

    Args:
        path: of the video.
        duration_s: of the video, over which its payloads of a second or so are spread evenly.
    """
    import telemetry_parser

    try:
        payloads = telemetry_parser.Parser(str(path)).telemetry()
    except BaseException as error:  # what the library panics at is not an Exception
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        payloads = []
    rows = []
    for number, payload in enumerate(payloads):
        found = _rows(payload)
        start, step = number / len(payloads), 1 / (len(payloads) * max(len(found), 1))
        rows += [(duration_s * (start + k * step), *row) for k, row in enumerate(found.tolist())]
    fixes = np.array(rows, dtype=np.float64).reshape(-1, 7)
    good = (
        np.isfinite(fixes[:, :4]).all(axis=1)
        & (np.abs(fixes[:, 1]) <= 90)
        & (np.abs(fixes[:, 2]) <= 180)
        & (fixes[:, 5] >= _MIN_FIX)
        & (fixes[:, 6] < _MAX_DOP)
    )
    fixes = fixes[good]
    return Fixes(time_s=fixes[:, 0], places=fixes[:, 1:4], utc_s=fixes[:, 4])


def _rows(payload: dict[str, Any]) -> Array:
    """(N, 6) latitude, longitude, altitude, seconds since 1970, fix and dilution of a payload."""
    newer, older = payload.get("GPS9", {}), payload.get("GPS", {})
    with np.errstate(all="ignore"):
        try:
            if _GPS9 in newer:
                data = bytes(newer[_GPS9][_HEAD:])
                whole = data[: len(data) // _GPS9_ROW.size * _GPS9_ROW.size]
                values = np.array(list(_GPS9_ROW.iter_unpack(whole))) / newer["Scale"]
                utc_s = _EPOCH_2000_S + values[:, 5] * 86400.0 + values[:, 6]
                return np.column_stack([values[:, :3], utc_s, values[:, 8], values[:, 7]])
            values = np.array(older.get("Data", []), np.float64).reshape(-1, 5) / older["Scale"]
            about = np.full((len(values), 3), [np.nan, older[_FIX], older[_DOP] / 100.0])
            about[:1, 0] = older.get(_UTC_MS, np.nan) / 1e3  # of the first sample
            return np.column_stack([values[:, :3], about])
        except (KeyError, TypeError, ValueError, IndexError, struct.error):
            return np.zeros((0, 6))
