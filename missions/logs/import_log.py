"""`import-log`: a vehicle's own log becomes the navigation CSV that `import-images` reads."""

import itertools
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.artefacts import read_csv
from alice_survey.core.contents import is_unknown, parse_number
from alice_survey.core.errors import NavigationError, warn
from alice_survey.core.frames import Array, Datum
from alice_survey.kit.words import count
from missions.logs.autopilot_logs import (
    MAGIC,
    first_bytes,
    read_ardusub_bin,
    read_ardusub_tlog,
    read_px4_ulog,
)
from missions.logs.dead_reckoning import TrackErrors, with_dead_reckoning
from missions.logs.dive import ROLES, LoggedDive, Signal, of_known, rotation_of
from missions.logs.navigation_csv import DATED_AFTER_S, READINGS, max_gap_s, utc_date
from missions.logs.ros_bag import is_bag, read_ros_bag
from missions.logs.waterlinked import is_waterlinked, read_waterlinked
from missions.values.navigation import COLUMNS, write_navigation_rows

_NAMED = 8
_NOT_READ = {
    ".csv": "a CSV is not a vehicle's log: give a navigation CSV to import-images --navigation; of "
    "QGroundControl import the .tlog",
    ".log": "text logs of ArduSub are not read: give the .BIN that the text was made of",
    ".pd0": "PD0 is no longer read: export velocities and ranges as a navigation CSV",
}
_MAX_OUT_OF_WATER_M = 2.0
"""A vehicle on deck, or a barometer that is off, seldom is higher."""
_MICRO = 1e6


@dataclass(frozen=True, kw_only=True)
class ImportOptions:
    """Options of `import-log`."""

    declination_deg: float = 0.0
    """Declination added to headings; east is positive."""
    tide: str = "0"
    """Height of the water above the level that depths are to count from: metres, or a CSV."""
    topics: Sequence[str] = ()
    """`ROLE=NAME`, roles as in `dive.ROLES`: which topic or message to use."""
    datum_deg: tuple[float, float] | None = None
    """Latitude and longitude of the origin that a bag's odometry, or the filter of an on-board log,
    counts from."""
    lever_body_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Place on the body (FRD) that the logged position is of."""
    altitude_offset_m: float = 0.0
    """Offset added to altitudes."""
    vehicle_log: Path | None = None
    """Vehicle log to write, too."""
    dead_reckon: TrackErrors | None = None
    """How velocities err: positions are those of velocities and attitudes between fixes."""
    flip_velocity: bool = False
    """Turn velocities over ground round: those of a DVL whose file states the other sign."""
    start_at: tuple[float, float, float] | None = None
    """Latitude, longitude and its sigma in metres of the first velocity, for dead reckoning."""

    def __post_init__(self) -> None:
        if self.start_at is not None:
            latitude, longitude, sigma = self.start_at
            if self.dead_reckon is None:
                raise NavigationError("--start-at is where dead reckoning starts: give it too")
            if not (abs(latitude) <= 85 and abs(longitude) <= 360 and 0 < sigma < math.inf):
                raise NavigationError(
                    f"--start-at {latitude:g} {longitude:g} {sigma:g}: give latitude, longitude "
                    "(degrees) and a sigma above 0 (metres)"
                )


def import_log(
    path: Path, out: Path, options: ImportOptions | None = None
) -> tuple[str, dict[str, Any]]:
    """Write the navigation CSV of a log.

    Times are dates (`time_utc`) where the log has them, else `time_s` as logged. What is left out
    is counted, by reason, in warnings and in the result.

    Args:
        path: a bag of ROS 1 or 2, ArduSub's .BIN or .tlog, PX4's .ulg, or reports of a DVL.
        out: CSV to write.
        options: what to change, and what to choose.

    Returns:
        A report as text, and as JSON values.

    Raises:
        NavigationError: the log cannot be read, holds nothing of use, or an option does not fit
            it.
    """
    options = options or ImportOptions()
    written = [file for file in (out, options.vehicle_log) if file is not None]
    for file in written:
        if file.resolve() == path.resolve() or written.count(file) > 1:
            raise NavigationError(f"{file} would be written over: choose another name")
    dive = read_dive(path, options)
    if options.flip_velocity:
        flipped: dict[str, Any] = {
            name: replace(signal, values=-signal.values)
            for name in ("velocity_ned", "velocity_body")
            if (signal := getattr(dive, name)) is not None
        }
        if not flipped:
            raise NavigationError(f"{path}: holds no velocity that --flip-velocity could turn")
        dive = replace(dive, **flipped)
    dive = dead_reckon(path, dive, options)
    tide = read_tide(options.tide, dated=dive.dated)
    if dive.declination_in_log and options.declination_deg:
        warn(f"the vehicle added a declination {dive.declination_in_log}: yours comes on top")
    columns = navigation_table(dive, dive.row_times, options, tide)
    useful = np.any([np.isfinite(columns[name]) for name in READINGS], axis=0)
    lost = Counter(dict(dive.lost))
    if not useful.any():
        reasons = [f"{count} times {reason}" for reason, count in sorted(lost.items())]
        if dive.altitude is not None and dive.altitude_slant:
            reasons.append(f"ranges of {dive.altitude.source} are of use with an attitude only")
        text = f"{path}: no row holds a position, depth, attitude or altitude"
        raise NavigationError("; ".join([text, *reasons]))
    if not useful.all():
        lost["rows without any reading"] += int((~useful).sum())
    time_s = dive.row_times[useful]
    columns = {name: column[useful] for name, column in columns.items()}
    dry = columns["depth_m"] < -_MAX_OUT_OF_WATER_M
    if dry.any():
        warn(
            f"{path}: {int(dry.sum())} of {len(dry)} rows lie above the water, by "
            f"{-np.nanmin(columns['depth_m']):.1f} m at most: check the log's zero of depth, its "
            "vehicle, and the tide"
        )
    try:
        texts = [_date(t) if dive.dated else f"{t:.6f}" for t in time_s.tolist()]
        write_navigation_rows(out, texts, columns, "time_utc" if dive.dated else "time_s")
        if options.vehicle_log is not None:
            _write_vehicle_log(options.vehicle_log, dive, time_s, options)
    except OSError as error:
        raise NavigationError(f"{error.filename}: cannot be written: {error.strerror}") from None
    tidal = isinstance(tide, Signal) or tide != 0.0
    return _report(path, out, dive, time_s, columns, lost, tidal=tidal)


def dead_reckon(path: Path, dive: LoggedDive, options: ImportOptions) -> LoggedDive:
    """The dive with positions of its velocities, where the options ask for that.

    Raises:
        NavigationError: the log lacks what dead reckoning needs.
    """
    if options.dead_reckon is None:
        return dive
    try:
        return with_dead_reckoning(
            dive, options.dead_reckon, options.start_at, options.declination_deg
        )
    except NavigationError as error:
        raise NavigationError(f"{path}: {error}") from None


def read_dive(path: Path, options: ImportOptions) -> LoggedDive:
    """Read a log of any format that is known, recognised by its name and content.

    Raises:
        NavigationError: it is missing, of no known format, or cannot be used.
    """
    chosen = _roles(options.topics)
    suffix = path.suffix.lower()
    datum = None if options.datum_deg is None else Datum(*options.datum_deg)
    if suffix not in ("", ".bag", ".mcap", ".db3", ".bin") and datum is not None:
        raise NavigationError(
            "--datum is for the odometry of a bag of ROS and for ArduSub's .BIN: leave it out"
        )
    if path.is_dir() or is_bag(path):
        return read_ros_bag(path, chosen, datum)
    if is_waterlinked(path):
        if chosen:
            raise NavigationError(
                f"--topic {next(iter(chosen))}: reports of a DVL have nothing to choose from"
            )
        return read_waterlinked(path)
    if suffix in (".ulg", ".ulog") or first_bytes(path, len(MAGIC)) == MAGIC:
        return read_px4_ulog(path, chosen)
    if suffix == ".bin":
        return read_ardusub_bin(path, chosen, datum)
    if suffix == ".tlog":
        return read_ardusub_tlog(path, chosen)
    suffix = ".pd0" if first_bytes(path, 2) == b"\x7f\x7f" else suffix  # also .ENR, .ENX, .STA
    if suffix in _NOT_READ:
        raise NavigationError(f"{path}: {_NOT_READ[suffix]}")
    raise NavigationError(
        f"{path}: not a known log: a ROS bag (.bag, .mcap, .db3 or a folder), ArduSub's .BIN "
        "or .tlog, PX4's .ulg, or JSON reports of a Water Linked DVL"
    )


def _date(time_s: float) -> str:
    micro = round(time_s * _MICRO)
    date = datetime.fromtimestamp(micro // 1_000_000, UTC).replace(microsecond=micro % 1_000_000)
    return date.isoformat(timespec="microseconds").replace("+00:00", "Z")


def _roles(topics: Sequence[str]) -> dict[str, str]:
    chosen: dict[str, str] = {}
    for text in topics:
        role, mark, name = text.partition("=")
        if not mark or role not in ROLES or not name:
            raise NavigationError(
                f"--topic {text!r}: give ROLE=NAME with a role of {', '.join(ROLES)}"
            )
        if role in chosen:
            raise NavigationError(f"--topic {role} is given twice")
        chosen[role] = name
    return chosen


def navigation_table(
    dive: LoggedDive, time_s: Array, options: ImportOptions, tide: float | Signal
) -> dict[str, Array]:
    """The columns of the navigation CSV, (N,) each.

    What is not known is NaN. Readings are interpolated onto the rows, but not across gaps. Depth
    is from the level that the tide counts from.

    Args:
        dive: as logged.
        time_s: (N,) times of rows.
        options: what to correct.
        tide: height of the water above the level that depths are to count from, metres; or (N, 1)
            of it on the clock of the log.

    Raises:
        NavigationError: the lever arm needs an attitude that the log lacks, or the tide does not
            cover the dive.
    """

    def at_rows(signal: Signal | None, count: int, *, turning: bool = False) -> Array:
        if signal is None:
            return np.full((len(time_s), count), np.nan)
        return signal.at(time_s, turning=turning)

    angles = at_rows(dive.attitude, 3, turning=True)
    angles[:, 2] += options.declination_deg
    altitude = at_rows(dive.altitude, 1)
    if dive.altitude_slant:
        # The range along the body's down axis, seen upright: cos(roll) cos(pitch) is the axis' down
        # component (Fossen 2011, 2.18). Without an attitude it is not known.
        altitude = altitude * np.cos(np.deg2rad(angles[:, :2])).prod(axis=1, keepdims=True)
    place = np.hstack([at_rows(dive.position, 2, turning=True), at_rows(dive.depth, 1)])
    place = _at_origin(dive, place, angles, options.lever_body_m)
    values = [
        place[:, 0],
        (place[:, 1] + 180.0) % 360.0 - 180.0,
        place[:, 2] - _tide_at(time_s, tide),
        (angles[:, 0] + 180.0) % 360.0 - 180.0,
        angles[:, 1],
        angles[:, 2] % 360.0,
        altitude[:, 0] + options.altitude_offset_m,
    ]
    columns = dict(zip(COLUMNS, values, strict=False))
    for name in COLUMNS[len(values) :]:
        columns[name] = at_rows(dive.sigmas.get(name), 1)[:, 0]
    return columns


def _at_origin(
    dive: LoggedDive, place: Array, angles_deg: Array, lever_body_m: tuple[float, float, float]
) -> Array:
    """Latitude, longitude and depth, (N, 3), of the body's origin."""
    lever = np.array(lever_body_m)
    if not lever.any():
        return place
    if dive.attitude is None:
        raise NavigationError("a lever arm needs an attitude, and the log has none")
    arms = of_known(angles_deg, 3, lambda angles: rotation_of(angles).apply(lever))

    def move(row: Array) -> Array:
        datum = Datum(float(row[0, 0]), float(row[0, 1]))
        return datum.geodetic_from_ned(datum.ned_from_geodetic(row[:, :3]) - row[:, 3:])[:, :2]

    # Positions hold where the depth is not known too.
    at_depth = np.hstack([place[:, :2], np.nan_to_num(place[:, 2:]), arms])
    return np.column_stack([of_known(at_depth, 2, move), place[:, 2] - arms[:, 2]])


def _write_vehicle_log(path: Path, dive: LoggedDive, at_s: Array, options: ImportOptions) -> None:
    """The vehicle log (docs/vehicle-logs.md) at the rows' times, (N,) as logged, from the first."""
    from alice_survey.sim.vehicle.log import VehicleLog, write_vehicle_log

    # Depths of the log, not of the chart: a vehicle's log knows of no tide.
    columns = navigation_table(dive, at_s, options, 0.0)
    place, angles = (
        np.stack([columns[name] for name in names], axis=1) for names in (COLUMNS[:3], COLUMNS[3:6])
    )
    position = of_known(place, 3, lambda row: Datum(*map(float, row[0, :2])).ned_from_geodetic(row))
    quaternion = of_known(angles, 4, lambda row: rotation_of(row).as_quat(canonical=True))
    velocity = np.empty(0) if dive.velocity_body is None else dive.velocity_body.at(at_s)
    if dive.velocity_body is None and dive.velocity_ned is not None:
        velocity = of_known(
            np.hstack([angles, dive.velocity_ned.at(at_s)]), 3,
            lambda row: rotation_of(row[:, :3]).inv().apply(row[:, 3:]),
        )  # fmt: skip
    rpm = {} if dive.rpm is None else dict(zip(dive.thrusters, dive.rpm.at(at_s).T, strict=True))
    others = {}
    if dive.pwm is not None:
        others = {f"pwm_{i}_us": column for i, column in enumerate(dive.pwm.at(at_s).T, 1)}
    log = VehicleLog(
        time_s=np.round(at_s - at_s[0], 6),
        source=str(path),
        position_ned=position,
        quaternion_xyzw=quaternion,
        velocity_body=velocity,
        rates_body=np.empty(0) if dive.rates is None else dive.rates.at(at_s),
        altitude_m=columns["altitude_m"],
        rpm=rpm,
        others=others,
    )
    write_vehicle_log(path, log)


def _report(
    path: Path,
    out: Path,
    dive: LoggedDive,
    time_s: Array,
    columns: Mapping[str, Array],
    lost: Counter[str],
    *,
    tidal: bool,
) -> tuple[str, dict[str, Any]]:
    """What was read, from where, and what is missing; warns of what was left out and of gaps."""
    filled = {name: int(np.isfinite(column).sum()) for name, column in columns.items()}
    leading = next(name for name in READINGS if filled[name])
    known_s = time_s[np.isfinite(columns[leading])]
    max_s = max_gap_s(known_s)
    gaps = [(a, b - a) for a, b in itertools.pairwise(known_s.tolist()) if b - a > max_s]
    if lost:
        warn(f"{path}: left out: " + "; ".join(f"{n} {why}" for why, n in sorted(lost.items())))
    if gaps:
        spans = ", ".join(f"{length:.1f} s from {_moment(at)}" for at, length in gaps[:_NAMED])
        more = f" and {len(gaps) - _NAMED} more" if len(gaps) > _NAMED else ""
        warn(f"{path}: {len(gaps)} gaps in {leading}: {spans}{more}")
    signals = {role: getattr(dive, role) for role in ("position", "depth", "attitude", "altitude")}
    named = {role: signal.source for role, signal in signals.items() if signal is not None}
    data: dict[str, Any] = {
        "log": str(path),
        "kind": dive.kind,
        "clock": dive.clock,
        "dated": dive.dated,
        "out": str(out),
        "rows": len(time_s),
        "start": _date(float(time_s[0])) if dive.dated else float(time_s[0]),
        "duration_s": round(float(time_s[-1] - time_s[0]), 6),
        "sources": named,
        "depths_from": "level of the tide" if tidal else "sea surface",
        "filled": filled,
        "left_out": dict(sorted(lost.items())),
        "gaps": [{"start_s": round(a, 6), "length_s": round(b, 6)} for a, b in gaps],
        "notes": list(dive.notes),
    }
    notes = [f"{role} from {source}" for role, source in named.items()]
    if not all(filled.values()):
        notes.append("not known: " + ", ".join(name for name, n in filled.items() if not n))
    notes += dive.notes
    if tidal:
        notes.append(
            "depths count from the level that --tide refers to: give import-images its name by "
            "--vertical-datum"
        )
    if not dive.dated:
        notes.append("the log has no dates: pictures are tied to it by --clock-offset alone")
    head = f"{path}: {dive.kind}, {dive.clock}\n{out}: {count(len(time_s), 'row')} from "
    head += f"{_moment(float(time_s[0]))}, {data['duration_s']:.1f} s"
    return "\n  ".join([head, *notes]), data


def _tide_at(time_s: Array, tide: float | Signal) -> Array:
    """Heights, (N,) metres, of a tide at times.

    Raises:
        NavigationError: it does not cover them.
    """
    if not isinstance(tide, Signal):
        return np.full(time_s.shape, float(tide))
    first, last = tide.time_s[0], tide.time_s[-1]
    if time_s[0] < first or time_s[-1] > last:
        raise NavigationError(
            f"{tide.source}: tides from {_moment(first)} to {_moment(last)} do not cover the "
            f"dive, {_moment(float(time_s[0]))} to {_moment(float(time_s[-1]))}"
        )
    return np.interp(time_s, tide.time_s, tide.values[:, 0])


def read_tide(text: str, *, dated: bool) -> float | Signal:
    """A tide as typed: metres, or a CSV with `time_utc` (or `time_s`) and `height_m`.

    Args:
        text: a number, or a path.
        dated: whether the log's times are UTC: then the CSV's must be, too.

    Raises:
        NavigationError: it is neither, or the file cannot be used.
    """
    with suppress(ValueError):
        if math.isfinite(metres := parse_number(text)):
            return metres
    column = "time_utc" if dated else "time_s"
    try:
        known = ("time_s", "time_utc", "height_m")
        rows = read_csv(Path(text), (column, "height_m"), known=known)[1]
    except NavigationError as error:
        undated = "" if dated else " (the log's times have no date)"
        raise NavigationError(
            f"--tide is neither metres nor a CSV of tides: {error}{undated}"
        ) from None
    table: list[tuple[float, float]] = []
    for line, row in rows:
        cell, height = row[column], row["height_m"]
        try:
            time_s = utc_date(cell).timestamp() if dated else parse_number(cell)
            table.append((time_s, parse_number(height)))
        except ValueError:
            raise NavigationError(
                f"{text} line {line}: {cell!r}, {height!r}: not a time and a height"
            ) from None
        before_s = table[-2][0] if table[:-1] else -math.inf
        if is_unknown(table[-1][1]) or not before_s < time_s < math.inf:
            raise NavigationError(f"{text} line {line}: needs heights at times that increase")
    if not table:
        raise NavigationError(f"{text}: holds no tides")
    times, heights = np.array(table).T
    return Signal(source=text, time_s=times, values=heights[:, None])


def _moment(time_s: float) -> str:
    """A time as people read it: a date where it is one."""
    if time_s < DATED_AFTER_S:
        return f"{time_s:.1f} s"
    return datetime.fromtimestamp(time_s, UTC).strftime("%Y-%m-%d %H:%M:%S")
