"""A navigation log of a real dive, and what it gives at the time of each picture."""

import itertools
import math
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, tzinfo
from pathlib import Path
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np

from alice_survey.core.artefacts import stream_csv
from alice_survey.core.contents import as_line, parse_number
from alice_survey.core.errors import NavigationError, warn
from alice_survey.core.frames import Array
from missions.values.navigation import COLUMNS

POSITION, READINGS = COLUMNS[:3], COLUMNS[:7]
"""What a navigation log can measure; the other columns are sigmas."""
TURNING = ("roll_deg", "pitch_deg", "heading_deg", "longitude_deg")
"""Columns of angles that turn the short way round."""
_RANGES = {
    "latitude_deg": (-85.0, 85.0), "longitude_deg": (-180.0, 180.0), "depth_m": (-100.0, 11_000.0),
    "altitude_m": (-10.0, 11_000.0), "heading_deg": (-360.0, 720.0), "roll_deg": (-360.0, 360.0),
    "pitch_deg": (-360.0, 360.0),
}  # fmt: skip
_GAP_S, _GAP_INTERVALS = 2.0, 5.0
"""A gap is longer than both this many seconds and this many median intervals."""
_FEW = 5
"""So many known values show no interval of their own."""
_MS = 1000.0
_NAMED = 8


@dataclass(frozen=True, kw_only=True, eq=False)
class NavigationLog:
    """Positions and more against time; angles in degrees as logged."""

    time_s: Array
    """(T,) increasing seconds: as logged, or since `start_utc`."""
    columns: dict[str, Array]
    """(T,) values; NaN where a cell is empty."""
    start_utc: datetime | None
    """Date of the first row, where the log holds dates."""

    @property
    def max_gap_s(self) -> float:
        """Seconds between rows beyond which nothing is interpolated."""
        return max_gap_s(self.time_s)

    def at(self, time_s: Array) -> dict[str, Array]:
        """All columns at other times, (N,) each.

        NaN before the first and after the last row, in gaps, and where a time is NaN. Angles turn
        the short way round.
        """
        return {name: self._at(name, values, time_s) for name, values in self.columns.items()}

    def _at(self, name: str, values: Array, at_s: Array) -> Array:
        turning = name in TURNING
        return _within_turn(name, interpolate(self.time_s, values, at_s, turning=turning))


def _within_turn(name: str, values: Array) -> Array:
    """Values of a column, (N,), with angles in 0 to 360 degrees (headings), or within 180."""
    if name == "heading_deg":
        return values % 360.0
    return (values + 180.0) % 360.0 - 180.0 if name in TURNING else values


def max_gap_s(time_s: Array) -> float:
    """Seconds between rows, at times (T,), beyond which nothing is interpolated."""
    if len(time_s) < 2:
        return _GAP_S
    steps_ms = np.rint(np.diff(time_s) * _MS)
    return max(_GAP_S, _GAP_INTERVALS * float(np.median(steps_ms)) / _MS)


def _max_gap_of(known_s: Array, time_s: Array) -> float:
    """Seconds between known values, at times (K,) among those of all rows (T,), for the same.

    Positions may be rarer than depths in one log; few of them show no rate of their own.
    """
    return max_gap_s(known_s if len(known_s) > _FEW else time_s)


def interpolate(time_s: Array, values: Array, at_s: Array, *, turning: bool) -> Array:
    """Values at other times; NaN in gaps, beyond the ends, and where a time is NaN.

    Args:
        time_s: (T,) increasing.
        values: (T,); NaN is not known.
        at_s: (N,).
        turning: whether values are angles in degrees, which turn the short way round.

    Returns:
        (N,) values; angles go on beyond a full turn.
    """
    known = np.isfinite(values)
    times, values = time_s[known], values[known]
    found = np.full(at_s.shape, np.nan)
    if not len(times):
        return found
    after = np.clip(np.searchsorted(times, at_s), 0, len(times) - 1)
    before = np.clip(np.searchsorted(times, at_s, side="right") - 1, 0, len(times) - 1)
    with np.errstate(invalid="ignore"):
        inside = (at_s >= times[0]) & (at_s <= times[-1])
        inside &= times[after] - times[before] <= _max_gap_of(times, time_s)
    smooth = np.unwrap(values, period=360.0) if turning else values
    found[inside] = np.interp(at_s[inside], times, smooth)
    return found


def find_zone(name: str) -> tzinfo:
    """A time zone by name.

    Raises:
        NavigationError: there is none of that name.
    """
    try:
        return UTC if name == "UTC" else ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        raise NavigationError(
            f"--time-zone {name!r} is not known; give a name such as Europe/Oslo or UTC"
        ) from None


def utc_date(text: str, zone: tzinfo = UTC) -> datetime:
    """The moment of an ISO 8601 date; one that names no zone is of `zone`.

    Raises:
        ValueError: it is not a date.
    """
    date = datetime.fromisoformat(text)
    try:
        return (date.replace(tzinfo=zone) if date.tzinfo is None else date).astimezone(UTC)
    except OverflowError:  # in the years 1 and 9999
        raise ValueError(f"{text} is not within the years 1 to 9999 in UTC") from None


def read_navigation(
    path: Path, zone: tzinfo, needed: Sequence[str] = POSITION, *, is_growing: bool = False
) -> NavigationLog:
    """Read a navigation CSV: `time_s` or `time_utc`, what is needed, and any other of `COLUMNS`.

    A row without a finite time or a needed value, or whose time does not follow the row before, is
    left out with a warning that names its line; of any other value only the value is left out.

    Args:
        path: the file.
        zone: of dates that name none.
        needed: columns without which a row is of no use; with none, any one value is enough.
        is_growing: the file is being written: leave out its last row, which may not be whole.

    Raises:
        NavigationError: the file cannot be read, lacks a column, or holds no usable row.
    """
    header, rows = stream_csv(path, needed)
    if is_growing:
        rows = (row for row, _ in itertools.pairwise(rows))
    clocks = [name for name in ("time_s", "time_utc") if name in header]
    if not clocks:
        raise NavigationError(
            f"{path}: no column time_s or time_utc; it has {as_line(', '.join(header))}"
        )
    others = [name for name in COLUMNS if name in header and name not in needed]
    names = [*needed, *others]
    if not set(names) & set(READINGS):
        raise NavigationError(f"{path}: none of the columns {', '.join(READINGS)}")
    start_utc: datetime | None = None
    times, table = array("d"), array("d")
    faults: dict[str, list[int]] = {}
    for line, row in rows:
        try:
            if clocks[0] == "time_utc":
                date = _date(row["time_utc"], zone)
                start_utc = start_utc or date
                time = (date - start_utc).total_seconds()
            else:
                time = _number(row, "time_s")
            values = [_number(row, name) for name in needed]
        except ValueError as error:
            faults.setdefault(str(error), []).append(line)
            continue
        if times and time <= times[-1]:
            faults.setdefault("time does not follow that of the row before", []).append(line)
            continue
        for name in others:
            try:
                values.append(_number(row, name) if row[name] else math.nan)
            except ValueError as error:
                values.append(math.nan)
                faults.setdefault(f"{error} (that value only)", []).append(line)
        times.append(time)
        table.extend(values)
    if faults:
        texts = [
            f"line {lines[0]}: {fault}" if len(lines) == 1
            else f"{len(lines)} lines from {lines[0]} on: {fault}"
            for fault, lines in faults.items()
        ]  # fmt: skip
        more = f" and {len(texts) - _NAMED} more" if len(texts) > _NAMED else ""
        warn(f"{path}: left out {'; '.join(texts[:_NAMED])}{more}")
    cells = np.asarray(table).reshape(len(times), len(names))
    columns = {name: cells[:, i] for i, name in enumerate(names)}
    if not any(np.isfinite(columns[name]).any() for name in READINGS if name in columns):
        what = "a position" if needed else "a reading"
        raise NavigationError(f"{path}: no row with a time and {what}")
    return NavigationLog(time_s=np.asarray(times), columns=columns, start_utc=start_utc)


def _number(row: Mapping[str, str], name: str) -> float:
    cell = row[name]
    try:
        value = parse_number(cell)
    except ValueError:
        raise ValueError(f"{name} is {cell!r}, not a number") from None
    if not math.isfinite(value):
        raise ValueError(f"{name} is {value}")
    low, high = _RANGES.get(name, (-math.inf, math.inf))
    if not low <= value <= high:
        raise ValueError(f"{name} is {value}, not within {low} to {high}")
    return value


def _date(cell: str, zone: tzinfo) -> datetime:
    try:
        return utc_date(cell, zone)
    except ValueError:
        raise ValueError(f"time_utc is {cell!r}, not a date such as 2024-05-01T12:00:00Z") from None


def warn_of_gaps(images: Sequence[str], time_s: Array, found: Array, log: NavigationLog) -> None:
    """Say which pictures got no position, and why."""
    lost = [i for i, value in enumerate(found) if not np.isfinite(value)]
    if not lost:
        return
    names = ", ".join(images[i] for i in lost[:_NAMED])
    more = f" and {len(lost) - _NAMED} more" if len(lost) > _NAMED else ""
    known = [time_s[i] for i in lost if np.isfinite(time_s[i])]
    when = f"; their times are {min(known):.1f} to {max(known):.1f} s" if known else ""
    warn(
        f"{len(lost)} pictures get no navigation, without a time, beyond the log "
        f"({log.time_s[0]:.1f} to {log.time_s[-1]:.1f} s) or in a gap over "
        f"{log.max_gap_s:.1f} s{when}: {names}{more}"
    )
