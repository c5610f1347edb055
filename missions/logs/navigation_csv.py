"""A navigation log of a real dive, and what it gives at the time of each picture."""

import contextlib
import difflib
import itertools
import math
import re
from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta, tzinfo
from pathlib import Path
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np

from alice_survey.core.artefacts import stream_csv
from alice_survey.core.contents import as_line, is_nowhere, is_unknown, parse_number
from alice_survey.core.errors import NavigationError, note, warn
from alice_survey.core.frames import SYSTEM, Array, degrees_from
from alice_survey.kit.words import count
from missions.values.navigation import COLUMNS

_DAY_FIRST = re.compile(r"^(?=..\.|1[3-9]|[23]\d)(\d\d)[./-](\d\d)[./-](\d{4})\b")
"""Dates between dots are day.month.year (DIN 5008), and others whose first number is no month."""
POSITION, READINGS = COLUMNS[:3], COLUMNS[:7]
"""What a navigation log can measure; the other columns are sigmas."""
IMAGE, HEIGHT = "image", "height_m"
"""Columns of tables by picture: its name, and the height above the vertical datum."""
_DAY, _SINCE = "date", "time of the dive"
"""Columns of dive computers: the day of a time of day, and minutes from that time on."""
TURNING = ("roll_deg", "pitch_deg", "heading_deg", "longitude_deg")
"""Columns of angles that turn the short way round."""
_RANGES = {
    "latitude_deg": (-85.0, 85.0), "longitude_deg": (-180.0, 180.0), "depth_m": (-100.0, 11_000.0),
    "altitude_m": (-10.0, 11_000.0), "heading_deg": (-360.0, 720.0), "roll_deg": (-360.0, 360.0),
    "pitch_deg": (-360.0, 360.0),
}  # fmt: skip
USUAL_NAMES: Mapping[str, str] = {
    "latitude_deg": "latitude lat y/latitude gps_latitude gpslatitude",
    "longitude_deg": "longitude lon long lng x/longitude gps_longitude gpslongitude",
    "depth_m": "depth dep water_depth vehicle_depth sample_depth",
    "heading_deg": "heading yaw hdg compass_heading",
    "roll_deg": "roll", "pitch_deg": "pitch",
    "altitude_m": "altitude alt height_above_bottom range_to_bottom dvl_altitude",
    "time_utc": "timestamp utc datetime date_time date/time time utc_time utc_t",
    "time_s": "unix_time epoch unixtime",
    IMAGE: "label filename file_name file image_name image_filename picture photo key sourcefile",
    HEIGHT: "z/altitude",
    _DAY: "date utc_d", _SINCE: "sample_time",
}  # fmt: skip
"""Names that other programs give to columns, without units, in lower case."""
DATED_AFTER_S, _DATED_BEFORE_S = 1e8, 1e11
"""Seconds between these (March 1973, 5138) count from 1970; others are of a simulation's or a
processor's own clock."""
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
    row_of: Mapping[str, int] = field(default_factory=dict)
    """Rows by the names of pictures, where the log has them; then `time_s` is in any order, and NaN
    where it has no times."""

    @property
    def max_gap_s(self) -> float:
        """Seconds between rows beyond which nothing is interpolated."""
        return max_gap_s(self.time_s)

    def span(self, time_s: Array) -> str:
        """First and last of some times: dates where the log has dates, else seconds of its clock.

        NaN are not counted.
        """
        ends = float(np.nanmin(time_s)), float(np.nanmax(time_s))
        with contextlib.suppress(OverflowError):  # beyond the years 1 to 9999
            if self.start_utc is not None:
                dates = [self.start_utc + timedelta(seconds=end) for end in ends]
                return f"{' to '.join(f'{date:%Y-%m-%d %H:%M:%S}' for date in dates)} UTC"
        return f"{ends[0]:.1f} to {ends[1]:.1f} s"

    def at(self, time_s: Array) -> dict[str, Array]:
        """All columns at other times, (N,) each.

        NaN before the first and after the last row, in gaps, and where a time is NaN. Angles turn
        the short way round.
        """
        return {name: self._at(name, values, time_s) for name, values in self.columns.items()}

    def of_pictures(self, images: Sequence[str]) -> tuple[Array, dict[str, Array]]:
        """Times and columns, (N,) each, of pictures by name; NaN for those it does not name."""
        keys = [next((k for k in keys_of(name) if k in self.row_of), "") for name in images]
        rows = np.array([self.row_of.get(key, -1) for key in keys])
        cells = {"": self.time_s, **self.columns}
        found = {name: np.where(rows < 0, np.nan, column[rows]) for name, column in cells.items()}
        return found.pop(""), {n: _within_turn(n, values) for n, values in found.items()}

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
    """The moment of an ISO 8601 date, or of day.month.year; one that names no zone is of `zone`.

    Raises:
        ValueError: it is not a date.
    """
    date = datetime.fromisoformat(_DAY_FIRST.sub(r"\3-\2-\1", text.strip()))
    try:
        return (date.replace(tzinfo=zone) if date.tzinfo is None else date).astimezone(UTC)
    except OverflowError:  # in the years 1 and 9999
        raise ValueError(f"{text} is not within the years 1 to 9999 in UTC") from None


def keys_of(image: str) -> list[str]:
    """What names a picture in a table: its path without suffix, in lower case, then its ends."""
    parts = Path(image.strip().replace("\\", "/")).with_suffix("").as_posix().lower().split("/")
    return ["/".join(parts[i:]) for i in range(len(parts))]


def _usual_columns(path: Path, header: Sequence[str], *, by_picture: bool) -> dict[str, str]:
    """Names in a header by the names that they have here; a warning names what is not read.

    Own names come first; then a column is that of the first usual name which it has.
    """
    own = (*COLUMNS, "time_s", "time_utc", IMAGE)
    found = {name: name for name in own if name in header}
    bare = {name: bare_name(name) for name in header}
    others = {bare[name]: name for name in reversed(bare) if name not in found}
    for name, usual in USUAL_NAMES.items():
        for one in usual.split():
            if name not in found and one in others:
                found[name] = others.pop(one)
    if "depth_m" in found:
        found.pop(HEIGHT, None)
    elif found.get("altitude_m", "altitude_m") != "altitude_m":
        del found["altitude_m"]  # above the floor, or above the sea?
    if not by_picture:
        found.pop(IMAGE, None)
    if "time_s" in found:
        found = {key: name for key, name in found.items() if key not in ("time_utc", _DAY, _SINCE)}
    elif _DAY in found:
        found.setdefault("time_utc", found[_DAY])
    lost = [one for one in bare if one and one not in found.values()]
    if lost:
        names = [name for name in (*own, *USUAL_NAMES) if name not in found]
        near = (difflib.get_close_matches(bare[one], names, 1) for one in lost[:100])
        meant = dict.fromkeys(name for some in near for name in some)
        if {"east", "north", "easting", "northing"} & set(bare.values()):
            meant |= dict.fromkeys(("latitude_deg", "longitude_deg"))
        hint = f"; did you mean {', '.join(meant)}?" if meant else ""
        if any(re.search(r"[_ (\[](ft|feet|fsw)\b", one, re.IGNORECASE) for one in lost):
            hint = ": lengths are read in metres: convert feet"
        warn(f"{path}: not read: columns {as_line(', '.join(lost))}{hint}")
    return found


def bare_name(name: str) -> str:
    """A column's name without case, unit and marks; whole where the unit is another than ours."""
    if re.search(r"[(\[]\s*(ft|feet|fsw|[cmk]m|rad|ms)\b", name, re.IGNORECASE):
        return name.lower()
    name = re.sub(r"[(\[].*|^(pose|gps|nav)\.", "", name.lower()).strip("# ")
    return re.sub(r"_(degrees|deg|m)$", "", re.sub(r"[\s-]+", "_", name))


Rows = Iterator[tuple[int, dict[str, str]]]
_ODM = (
    IMAGE, "longitude_deg", "latitude_deg", "z/altitude", "heading_deg", "pitch_deg", "roll_deg",
    "sigma_horizontal_m", "sigma_depth_m", "what follows",
)  # fmt: skip


def _rows_of_odm(path: Path, system: str, rows: Rows) -> tuple[list[str], Rows]:
    """Columns and rows of OpenDroneMap's `geo.txt`, whose header is its coordinate system.

    Its rows are `image x y [z] [yaw pitch roll] [accuracies of x and y, of z] [...]`; angles and
    accuracies of 0 are unknown.
    """
    try:
        degrees = degrees_from(system)
    except ValueError as error:
        raise NavigationError(f"{path}: {error}") from None
    if degrees is None:
        raise NavigationError(f"{path}: is of a local grid: latitudes and longitudes are needed")
    split = [(line, row[system].split()) for line, row in rows]
    split = [(line, cells) for line, cells in split if cells and not cells[0].startswith("#")]
    longest = max((len(cells) for _, cells in split), default=0)
    known = next((count for count in (9, 7) if longest >= count), 4)
    names = [*_ODM[:known], *(_ODM[-1:] if longest > known else ())]

    def table() -> Rows:
        for line, cells in split:
            row = dict(itertools.zip_longest(names, cells[: len(names)], fillvalue=""))
            x, y = row["longitude_deg"], row["latitude_deg"]
            try:
                at = parse_number(x), parse_number(y)
                place: tuple[object, ...] = at if is_nowhere(*at) else degrees(*at)
            except ValueError:  # the reader names it
                place = f"{x}, {y}", ""
            row["latitude_deg"], row["longitude_deg"] = map(str, place)
            unknown = [name for name in names[7:9] if not row[name].strip("0.")]
            if not any(row[name].strip("0.") for name in names[4:7]):
                unknown += names[4:7]
            yield line, row | dict.fromkeys(unknown, "")

    return names, table()


def read_navigation(
    path: Path,
    zone: tzinfo,
    needed: Sequence[str] = POSITION,
    *,
    is_growing: bool = False,
    by_picture: bool = False,
) -> NavigationLog:
    """Read a navigation CSV: `time_s` or `time_utc`, what is needed, and any other of `COLUMNS`.

    Usual names of other programs serve too, and so does OpenDroneMap's `geo.txt`. A row without a
    finite time or a needed value, or whose time does not follow the row before, is left out with a
    warning that names its line; of any other value only the value is left out. What stands for
    "unknown" is no value.

    Args:
        path: the file.
        zone: of dates that name none.
        needed: columns without which a row is of no use; with none, any one value is enough.
        is_growing: the file is being written: leave out its last row, which may not be whole.
        by_picture: a column `image` may take the place of times, or say whose times they are.

    Raises:
        NavigationError: the file cannot be read, lacks a column, or holds no usable row.
    """
    header, rows = stream_csv(path)
    if SYSTEM.match(header[0]) and len(header) == 1:
        header, rows = _rows_of_odm(path, header[0], rows)
    if is_growing:
        rows = (row for row, _ in itertools.pairwise(rows))
    at = _usual_columns(path, header, by_picture=by_picture)
    named = IMAGE in at
    clocks = [name for name in ("time_s", "time_utc", _SINCE) if name in at]
    lacks = [name for name in needed if name not in at]
    if not clocks and not named:
        lacks = ["time_s or time_utc" + (" or image" if by_picture else "")]
    if lacks:
        raise NavigationError(
            f"{path}: no column {lacks[0]}; of these and {', '.join(READINGS)}, or their usual "
            f"names, it has {as_line(', '.join(header))}"
        )
    others = [name for name in (*COLUMNS, HEIGHT) if name in at and name not in needed]
    names = [*needed, *others]
    if not set(names) & {*READINGS, HEIGHT}:
        raise NavigationError(f"{path}: none of the columns {', '.join(READINGS)}")
    start_utc, first = None, ""
    times, table, row_of = array("d"), array("d"), dict[str, int]()
    faults: dict[str, list[int]] = {}
    for line, row in rows:
        try:
            time = _time_of_row(row, at, clocks[0], zone) if clocks else math.nan
            if isinstance(time, datetime):
                first = row[at[clocks[0]]] if start_utc is None else first
                start_utc = start_utc or time
                time = (time - start_utc).total_seconds()
            values = [_number(row[at[name]], name) for name in needed]
        except ValueError as error:
            faults.setdefault(str(error), []).append(line)
            continue
        if times and not named and time <= times[-1]:
            faults.setdefault("time does not follow that of the row before", []).append(line)
            continue
        for name in others:
            try:
                values.append(_number(row[at[name]], name) if row[at[name]] else math.nan)
            except ValueError as error:
                values.append(math.nan)
                faults.setdefault(f"{error} (that value only)", []).append(line)
        place = [names.index(name) for name in POSITION[:2] if name in names]
        if len(place) == 2 and is_nowhere(*(values[i] for i in place)):
            faults.setdefault("latitude and longitude are 0, 0: no fix", []).append(line)
            if needed:
                continue
            values[place[0]] = values[place[1]] = math.nan
        if named and row_of.setdefault(keys_of(row[at[IMAGE]])[0], len(times)) != len(times):
            raise NavigationError(f"{path} line {line}: a second row of {row[at[IMAGE]]}")
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
    if re.fullmatch(r"[^:]+:[^Z+-]+", first) and not is_growing:
        note(f"{path}: times name no zone: {first} is taken as {start_utc:%Y-%m-%d %H:%M:%S} UTC")
    cells = np.asarray(table).reshape(len(times), len(names))
    columns = {name: cells[:, i] for i, name in enumerate(names)}
    if HEIGHT in columns:
        columns["depth_m"] = -columns.pop(HEIGHT)
    elif np.fmax.reduce(columns.get("depth_m", np.zeros(1)), initial=np.nan) < 0:
        warn(f"{path}: all depths are negative: depths are positive down")
    if not any(np.isfinite(columns[name]).any() for name in READINGS if name in columns):
        what = "a position" if needed else "a reading"
        raise NavigationError(f"{path}: no row with a time and {what}")
    return NavigationLog(
        time_s=np.asarray(times), columns=columns, start_utc=start_utc, row_of=row_of
    )


def _number(cell: str, name: str) -> float:
    try:
        value = parse_number(cell)
    except ValueError:
        raise ValueError(f"{name} is {cell!r}, not a number") from None
    if is_unknown(value):
        raise ValueError(f"{name} is {value:g}, which stands for unknown")
    low, high = _RANGES.get(name, (-math.inf, math.inf))
    if not low <= value <= high:
        raise ValueError(f"{name} is {value}, not within {low} to {high}")
    return value


def _time_of_row(
    row: Mapping[str, str], at: Mapping[str, str], clock: str, zone: tzinfo
) -> datetime | float:
    """The time of a row; of a dive computer by a day, a time of day and minutes from then on."""
    cell, since_s = row[at[clock]], 0.0
    if _SINCE in at:
        since_s, *parts = map(parse_number, row[at[_SINCE]].split(":"))
        for part in parts or [0.0]:  # minutes, or minutes and seconds, or hours before them
            since_s = 60.0 * since_s + part
    if clock == _SINCE:
        return since_s
    if _DAY in at and re.match(r"\d{1,2}:", cell):
        cell = f"{row[at[_DAY]].replace('/', '-')} {cell}"
    time = _time(cell, clock, zone)
    return time + timedelta(seconds=since_s) if isinstance(time, datetime) else time + since_s


def _time(cell: str, clock: str, zone: tzinfo) -> datetime | float:
    """A time of a row: a date, also from seconds since 1970, or seconds of another clock."""
    try:
        time_s = parse_number(cell)
    except ValueError:
        try:
            return utc_date(cell, zone)
        except ValueError:
            kind = "a number" if clock == "time_s" else "a date such as 2024-05-01T12:00:00Z"
            raise ValueError(f"{clock} is {cell!r}, not {kind}") from None
    if not math.isfinite(time_s):
        raise ValueError(f"{clock} is {time_s}")
    dated = DATED_AFTER_S < time_s < _DATED_BEFORE_S
    return datetime.fromtimestamp(time_s, UTC) if dated else time_s


def warn_of_gaps(images: Sequence[str], time_s: Array, found: Array, log: NavigationLog) -> None:
    """Say which pictures got no position, and why."""
    lost = [i for i, value in enumerate(found) if not np.isfinite(value)]
    if not lost:
        return
    names = ", ".join(images[i] for i in lost[:_NAMED])
    more = f" and {len(lost) - _NAMED} more" if len(lost) > _NAMED else ""
    known = time_s[lost][np.isfinite(time_s[lost])]
    when = f"; their times are {log.span(known)}" if len(known) else ""
    warn(
        f"{count(len(lost), 'picture')} without navigation, without a time, beyond the log "
        f"({log.span(log.time_s)}) or in a gap over {log.max_gap_s:.1f} s{when}: {names}{more}"
    )
