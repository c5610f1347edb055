"""Logs of autopilots as logged dives: ArduSub's (DataFlash .BIN, telemetry .tlog) and PX4's (.ulg).

pymavlink (the extra `mavlink`) and pyulog read them. What they are given is checked here first, and
what they print or raise on a damaged log ends in one line. For each quantity of a dive there is a
table of messages that hold it, and the best one that the log has is used.

Which messages hold what: ardupilot.org/sub, "Onboard Message Log Messages";
mavlink.io/en/messages/common.html; docs.px4.io, "uORB Message Reference". ArduSub puts its home at
the water's surface (ArduSub/commands.cpp, set_home_to_current_location), so that heights above home
are minus the depth; its barometer is zeroed at the surface. Quaternions of PX4's `vehicle_attitude`
are of the FRD body in NED, with w first; `eph` is the root of the summed variances of north and
east.
"""

import contextlib
import io
import math
import os
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.contents import one_line, ordinary_file
from alice_survey.core.errors import NavigationError, extra, file_faults, warn
from alice_survey.core.frames import Array, Datum
from missions.logs.dive import ROLES, LoggedDive, Signal, angles_of, clean_signal, usable_positions
from missions.logs.navigation_csv import DATED_AFTER_S

MAX_LOG_BYTES = 4_000_000_000
MAGIC = b"ULog\x01\x12\x35"
"""How a log of PX4 begins."""
_DATAFLASH = b"\xa3\x95\x80"
_MAX_DEPTH, _MAX_FIELDS = 8, 4096
_MAX_READS = 8
"""Times that a log of PX4 may be read over."""
_INSTANCE = ("C", "I", "Instance", "id")
"""Fields that identify one of several cores or sensors."""
RECORDED, SYSTEM, COMPONENT = "recorded_s", "system", "component"
"""Columns of a tlog: time of the ground station, seconds since 1970, and who has sent it."""
_NOISE = "bytes that are not a message, or of one that is cut off"
_TEXTS = "anNZ"
"""Field types of text in a DataFlash log."""
_GPS_EPOCH_S = 315964800.0
"""6 January 1980 in seconds since 1970."""
_WEEK_S = 604800.0
_LEAPS = ((1167264018.0, 18.0), (1119744017.0, 17.0), (1025136016.0, 16.0), (0.0, 15.0))
"""GPS seconds from which GPS led UTC by this many seconds (IERS Bulletin C: 1 January 2017,
1 July 2015, 1 July 2012)."""
_FIX_3D = 3
"""Least type of a GPS fix with a place."""
_DOWN = 25
"""ROTATION_PITCH_270: a range finder that looks down."""
_GOOD = 4
"""RangeFinder status: in range."""
_QUALITY = {
    "RFND": ("Quality", -1, 90), "DISTANCE_SENSOR": ("signal_quality", 0, 90),
    "distance_sensor": ("signal_quality", -1, 1),
}  # fmt: skip
"""By message: its field of a quality in per cent, what stands for unknown (a 0 alone: where others
are stated it is one, too), and the least of use: ArduSub's RNGFND_SQ_MIN, and PX4's."""
_SUBMARINE = 12
_NO_VEHICLES = {0, 5, 6, 18, 26, 27, 30}
"""MAV_TYPE (mavlink.io/en/messages/minimal.html) of generic parts, antenna trackers, ground
stations, companion computers, gimbals, ADS-B, cameras."""
_REBOOT_S = 1.0
"""A clock since boot that goes back by more has been started again."""

Mask = NDArray[np.bool_]


class LackError(Exception):
    """A log lacks what a reader needs; the text says what."""


class LogTable(dict[str, Array]):
    """All messages of one name: (N,) columns by field."""

    def __missing__(self, name: str) -> Array:
        raise LackError(f"it lacks {name}")

    def rows(self, keep: Mask | NDArray[np.intp]) -> "LogTable":
        """The rows that a mask, (N,), marks, or those of some numbers."""
        return LogTable({name: column[keep] for name, column in self.items()})

    def stack(self, *names: str) -> Array:
        """Columns side by side, (N, k)."""
        return np.stack([self[name] for name in names], axis=1)


Tables = Mapping[str, LogTable]
Reader = Callable[[LogTable, Tables], tuple[Array, Array]]
"""Takes the table of a message, and all tables, to times and values; raises `LackError`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MessageLog:
    """What a log holds."""

    path: Path
    tables: dict[str, LogTable]
    """By message, of those that are needed."""
    present: Sequence[str]
    """Names of all messages."""
    lost: Counter[str]
    """What could not be read or used; is added to."""


@dataclass(frozen=True)
class Source:
    """One way to get a quantity."""

    message: str
    read: Reader
    note: str = ""
    """What to know of it when it is used."""
    sigma: Reader | None = None
    """What the vehicle states of its error, where it does."""


_SIGMA_COLUMNS = {"navigation": "sigma_horizontal_m", "depth": "sigma_depth_m"}


def take(
    *fields: str, scale: float = 1.0, where: Callable[[LogTable], Mask] | None = None
) -> Reader:
    """Read fields of a message, times a factor, in the rows that `where` marks."""

    def read(table: LogTable, _: Tables) -> tuple[Array, Array]:
        table = table if where is None else table.rows(where(table))
        return table["time_s"], table.stack(*fields) * scale

    return read


def dive_from(
    log: MessageLog,
    sources: Mapping[str, tuple[Source, ...]],
    requested: Mapping[str, str],
    **about: Any,
) -> LoggedDive:
    """A dive of the best source that is there for each role.

    Args:
        log: with a column `time_s` in every table.
        sources: of each role, the best first.
        requested: the message to use for a role, `NAME` or `NAME[instance]`.
        about: other fields of `LoggedDive`.

    Raises:
        NavigationError: there is no source, or not the requested one.
    """
    found: dict[str, Signal | None] = {}
    sigmas, notes = {}, []
    for role, some in sources.items():
        found[role], note, sigma = _signal(log, role, some, requested.get(role, ""))
        notes += [note] if note else []
        if sigma is not None:
            sigmas[_SIGMA_COLUMNS[role]] = sigma
    if not any(found[role] for role in ROLES):
        names = ", ".join(dict.fromkeys(s.message for role in ROLES for s in sources[role]))
        raise NavigationError(f"{log.path}: none of {names}; it has {', '.join(log.present)}")
    return LoggedDive(
        position=usable_positions(found["navigation"], log.lost),
        depth=found["depth"],
        attitude=found["attitude"],
        altitude=found["altitude"],
        altitude_slant=True,
        sigmas=sigmas,
        velocity_ned=found["velocity"],
        rates=found["rates"],
        pwm=found["pwm"],
        lost=log.lost,
        notes=tuple(dict.fromkeys(notes)),
        **about,
    )


def _signal(
    log: MessageLog, role: str, sources: Sequence[Source], requested: str
) -> tuple[Signal | None, str, Signal | None]:
    """The best source that the log holds, or the requested one, its note and its sigmas."""
    name, _, instance = requested.removesuffix("]").partition("[")
    known = [source.message for source in sources]
    if name and name not in known:
        raise NavigationError(f"{log.path}: {role} can come from {', '.join(known)}, not {name}")
    reason = f"the log has {', '.join(log.present)}"
    for source in sources:
        message = source.message
        if message not in log.tables or (name and message != name):
            continue
        field, unknown, minimum = _QUALITY.get(message, ("", -1, 0))
        try:
            table, others = _one_instance(message, log.tables[message], instance)
            quality = table.get(field, np.full(len(table["time_s"]), -1.0))
            poor = (quality >= 0) & (quality < minimum) & ((quality != unknown) | quality.any())
            if poor.any():
                log.lost[f"{message}: of a {field} below {minimum:g} %"] += int(poor.sum())
                table = table.rows(~poor)
            found = clean_signal(message, *source.read(table, log.tables), log.lost)
        except LackError as error:
            reason = str(error)
            continue
        if found is None:
            reason = "none of its rows can be used"
            if poor.any():  # another message would repeat them without their quality
                break
            continue
        sigma = None
        if source.sigma is not None:
            with contextlib.suppress(LackError):
                at_s, stated = source.sigma(table, log.tables)
                positive = np.where(stated > 0, stated, np.nan)
                sigma = clean_signal(message, at_s, positive, Counter())
        return found, f"{source.note}{others}".strip("; "), sigma
    if name:
        raise NavigationError(f"{log.path}: {requested} gives no {role}: {reason}")
    return None, "", None


def _one_instance(message: str, table: LogTable, requested: str) -> tuple[LogTable, str]:
    """The rows of one core or sensor, and a note on the others.

    Cores and GPS receivers count from the one that is used. Which barometer is the depth sensor
    is not identified by its number, so that one of several must be requested.
    """
    field = next((name for name in _INSTANCE if name in table), None)
    if field is None:
        return table, ""
    numbers = np.unique(table[field][np.isfinite(table[field])]).astype(int).tolist()
    names = ", ".join(map(str, numbers))
    if requested:
        if not requested.isdigit() or int(requested) not in numbers:
            raise LackError(f"{message} has {names}")
        return table.rows(table[field] == int(requested)), ""
    if len(numbers) < 2 or message.upper() in ("RFND", "DISTANCE_SENSOR"):
        return table, ""
    if message == "BARO":
        raise LackError(f"it has {names}: choose the depth sensor, as in depth=BARO[{numbers[-1]}]")
    note = f"; {message} {numbers[0]} of {names} is used"
    return table.rows(table[field] == numbers[0]), note


def _from_ardusub_origin(table: LogTable, tables: Tables) -> tuple[Array, Array]:
    """Latitude and longitude of north and east from the filter's origin (message ORGN, type 0)."""
    ned, origin = table.stack("PN", "PE", "PD"), tables.get("ORGN", LogTable(Type=np.empty(0)))
    rows = np.flatnonzero(origin["Type"] == 0)
    if not len(rows):
        raise LackError(
            "it counts from the filter's origin, and the log holds none (ORGN): give it by --datum "
            "LATITUDE LONGITUDE"
        )
    datum = Datum(*(float(origin[name][rows[-1]]) for name in ("Lat", "Lng")))
    return table["time_s"], datum.geodetic_from_ned(ned)[:, :2]


def _from_px4_origin(table: LogTable, _: Tables) -> tuple[Array, Array]:
    """Latitude and longitude of north and east from the filter's origin, which may be set again."""
    table = table.rows(
        (table["xy_valid"] > 0)
        & (table["xy_global"] > 0)
        & np.isfinite(table.stack("x", "y", "ref_lat", "ref_lon")).all(axis=1)
    )
    ne0 = np.column_stack([table.stack("x", "y"), np.zeros(len(table["x"]))])
    places = np.full((len(ne0), 2), np.nan)
    origins, of = np.unique(table.stack("ref_lat", "ref_lon"), axis=0, return_inverse=True)
    for number, (latitude, longitude) in enumerate(origins.tolist()):
        if abs(latitude) < 90 and abs(longitude) <= 360:
            rows = of.ravel() == number
            places[rows] = Datum(latitude, longitude).geodetic_from_ned(ne0[rows])[:, :2]
    return table["time_s"], places


def _px4_attitude(table: LogTable, _: Tables) -> tuple[Array, Array]:
    return table["time_s"], angles_of(table.stack(*(f"q[{i}]" for i in (1, 2, 3, 0))))


def _place(latitude: str, longitude: str, fix: str, scale: float = 1.0) -> Reader:
    """Positions of a GPS receiver while it has a fix."""
    return take(latitude, longitude, scale=scale, where=lambda t: t[fix] >= _FIX_3D)


def _velocity_holds(table: LogTable) -> Mask:
    """Rows of PX4 whose flags say that velocities hold."""
    return np.asarray(np.min(table.stack("v_xy_valid", "v_z_valid"), axis=1) > 0)


def _sees_down(table: LogTable) -> Mask:
    """Rows of a range finder that looks down and is in range."""
    good: Mask = table["Stat"] == _GOOD
    return good & (table["Orient"] == _DOWN) if "Orient" in table else good


def _hears_bottom(table: LogTable) -> Mask:
    """Rows of a distance sensor that looks down and is within what it measures."""
    distance = table["current_distance"]
    good: Mask = (
        (table["orientation"] == _DOWN)
        & (distance >= table["min_distance"])
        & (distance < table["max_distance"])
    )
    return good


_AT_SURFACE = "positions are GPS: they hold at the surface only"
_BACKUP = "positions are those of the backup attitude filter"
_DEGREES = float(np.rad2deg(1.0))
_BIN: Mapping[str, tuple[Source, ...]] = {
    "navigation": (
        Source("POS", take("Lat", "Lng")),
        Source("XKF1", _from_ardusub_origin),
        Source("NKF1", _from_ardusub_origin),
        Source("AHR2", take("Lat", "Lng"), _BACKUP),
        Source("GPS", _place("Lat", "Lng", "Status"), _AT_SURFACE),
    ),
    "depth": (
        Source("POS", take("RelHomeAlt", scale=-1.0)),
        Source("CTUN", take("BAlt", scale=-1.0)),
        Source("XKF1", take("PD")),
        Source("NKF1", take("PD")),
        Source("BARO", take("Alt", scale=-1.0)),
    ),
    "attitude": tuple(
        Source(message, take("Roll", "Pitch", "Yaw")) for message in ("ATT", "XKF1", "NKF1", "AHR2")
    ),
    "altitude": (Source("RFND", take("Dist", where=_sees_down)),),
    "velocity": tuple(Source(message, take("VN", "VE", "VD")) for message in ("XKF1", "NKF1")),
    "rates": (Source("RATE", take("R", "P", "Y", scale=float(np.deg2rad(1.0)))),),
    "pwm": (Source("RCOU", take(*(f"C{i}" for i in range(1, 9)))),),
}
"""Sources of each role, the best first; degrees, metres, m/s, rad/s."""
_TLOG: Mapping[str, tuple[Source, ...]] = {
    "navigation": (
        Source("GLOBAL_POSITION_INT", take("lat", "lon", scale=1e-7)),
        Source("GPS_RAW_INT", _place("lat", "lon", "fix_type", 1e-7), _AT_SURFACE),
    ),
    "depth": (
        Source("GLOBAL_POSITION_INT", take("relative_alt", scale=-1e-3)),
        Source("VFR_HUD", take("alt", scale=-1.0)),
    ),
    "attitude": (Source("ATTITUDE", take("roll", "pitch", "yaw", scale=_DEGREES)),),
    "altitude": (
        Source("DISTANCE_SENSOR", take("current_distance", scale=1e-2, where=_hears_bottom)),
        Source("RANGEFINDER", take("distance", where=lambda t: t["distance"] != 0.0)),
    ),
    "velocity": (Source("GLOBAL_POSITION_INT", take("vx", "vy", "vz", scale=1e-2)),),
    "rates": (Source("ATTITUDE", take("rollspeed", "pitchspeed", "yawspeed")),),
    "pwm": (Source("SERVO_OUTPUT_RAW", take(*(f"servo{i}_raw" for i in range(1, 9)))),),
}
_RECEIVERS = ("sensor_gps", "vehicle_gps_position")
"""GPS of PX4 by the names of new and of old versions."""
_LOCAL = "vehicle_local_position"
_LEVEL_SIGMA = take("eph", scale=math.sqrt(0.5))
_ULG: Mapping[str, tuple[Source, ...]] = {
    "navigation": (
        Source("vehicle_global_position", take("lat", "lon"), sigma=_LEVEL_SIGMA),
        Source(_LOCAL, _from_px4_origin, sigma=_LEVEL_SIGMA),
        *(
            Source(name, _place(*fields, "fix_type", scale), _AT_SURFACE)
            for name in _RECEIVERS
            for fields, scale in ((("latitude_deg", "longitude_deg"), 1.0), (("lat", "lon"), 1e-7))
        ),
    ),
    "depth": (
        Source(
            _LOCAL,
            take("z", where=lambda t: t["z_valid"] > 0),
            "depths count from where the vehicle's filter was started: --tide takes off its height "
            "above the water, if that was not the surface",
            take("epv"),
        ),
    ),
    "attitude": (Source("vehicle_attitude", _px4_attitude),),
    "altitude": (Source("distance_sensor", take("current_distance", where=_hears_bottom)),),
    "velocity": (Source(_LOCAL, take("vx", "vy", "vz", where=_velocity_holds)),),
    "rates": (Source("vehicle_angular_velocity", take(*(f"xyz[{i}]" for i in range(3)))),),
    "pwm": (Source("actuator_outputs", take(*(f"output[{i}]" for i in range(8)))),),
}


def _messages_of(sources: Mapping[str, tuple[Source, ...]], *others: str) -> set[str]:
    return {source.message for some in sources.values() for source in some} | {*others}


def read_ardusub_bin(
    path: Path, requested: Mapping[str, str], datum: Datum | None = None
) -> LoggedDive:
    """Read an on-board log of ArduSub.

    Args:
        path: a .BIN.
        requested: the message to use for each role (`dive.ROLES`), `NAME` or `NAME[instance]`.
        datum: the filter's origin instead of the log's ORGN.

    Raises:
        NavigationError: it is not such a log, or lacks what navigation needs.
    """
    log = read_dataflash(path, _messages_of(_BIN, "GPS", "ORGN", "PARM"))
    offset_s = _ardusub_offset(log.tables)
    timed = _add_times(log.tables, "TimeUS", offset_s)
    if datum is not None:
        values = {"Type": 0.0, "Lat": datum.latitude_deg, "Lng": datum.longitude_deg}
        timed["ORGN"] = LogTable({name: np.array([value]) for name, value in values.items()})
    return dive_from(
        replace(log, tables=timed), _BIN, requested,
        kind="an on-board log of ArduSub",
        clock=_clock(offset_s),
        dated=offset_s is not None,
        declination_in_log=_declination(log.tables.get("PARM", LogTable())),
    )  # fmt: skip


def read_ardusub_tlog(path: Path, requested: Mapping[str, str]) -> LoggedDive:
    """Read a ground station's log; arguments and errors as of `read_ardusub_bin`."""
    log = read_tlog(path, _messages_of(_TLOG, "HEARTBEAT"))
    beats = log.tables.pop("HEARTBEAT", None)
    vehicle = _vehicle(log)
    if beats is not None:
        _warn_of_other_kinds(path, beats, vehicle)
    recorded = np.concatenate([table[RECORDED] for table in log.tables.values()])
    for name, table in log.tables.items():
        is_own = table[SYSTEM] == vehicle
        if not is_own.all():
            others = int((~is_own).sum())
            log.lost[f"{name}: messages of another system than {vehicle:.0f}"] += others
        own = log.tables[name] = table.rows(is_own)
        own["time_s"] = _tlog_times(own)
    return dive_from(
        log, _TLOG, requested,
        kind="a ground station's log of ArduSub",
        clock="the ground station's clock",
        dated=bool(np.median(recorded) > DATED_AFTER_S),
    )  # fmt: skip


def read_px4_ulog(path: Path, requested: Mapping[str, str]) -> LoggedDive:
    """Read an on-board log of PX4; arguments and errors as of `read_ardusub_bin`."""
    log = read_ulog(path, _messages_of(_ULG))
    offset_s = _px4_offset(log.tables)
    return dive_from(
        replace(log, tables=_add_times(log.tables, "timestamp", offset_s)), _ULG, requested,
        kind="an on-board log of PX4",
        clock=_clock(offset_s),
        dated=offset_s is not None,
    )  # fmt: skip


def _add_times(tables: Tables, field: str, offset_s: float | None) -> dict[str, LogTable]:
    """Those tables that have a field of microseconds, with `time_s`."""
    return {
        name: LogTable(table, time_s=table[field] * 1e-6 + (offset_s or 0.0))
        for name, table in tables.items()
        if field in table
    }


def _clock(offset_s: float | None) -> str:
    return "the vehicle's clock " + ("since boot" if offset_s is None else "set by GPS")


def _ardusub_offset(tables: Tables) -> float | None:
    """What makes UTC of seconds since boot: the median over all GPS fixes; None without one."""
    try:
        gps = tables.get("GPS", LogTable())
        fixed = gps.rows((gps["Status"] >= _FIX_3D) & (gps["GWk"] > 0))
        seconds, boot_us = fixed["GWk"] * _WEEK_S + fixed["GMS"] * 1e-3, fixed["TimeUS"]
    except LackError:
        return None
    if not len(seconds):
        return None
    starts, ahead = np.array(_LEAPS).T
    leap = ahead[np.argmax(seconds[:, None] >= starts, axis=1)]
    utc = _GPS_EPOCH_S + seconds - leap
    return float(np.median(utc - boot_us * 1e-6))


def _px4_offset(tables: Tables) -> float | None:
    """The same of PX4."""
    for name in _RECEIVERS:
        table = tables.get(name, LogTable())
        with contextlib.suppress(LackError):
            good = (table["fix_type"] >= _FIX_3D) & (table["time_utc_usec"] > 0)
            if good.any():
                apart = table["time_utc_usec"][good] - table["timestamp"][good]
                return float(np.median(apart)) * 1e-6
    return None


def _declination(parameters: LogTable) -> str:
    """What the vehicle added to its compass, in words."""
    if not {"Name", "Value"} <= parameters.keys():
        return ""
    values = dict(zip(parameters["Name"].tolist(), parameters["Value"].tolist(), strict=True))
    if values.get("COMPASS_AUTODEC", 0.0) > 0:
        return "itself (COMPASS_AUTODEC)"
    declination = math.degrees(values.get("COMPASS_DEC", 0.0))
    return f"of {declination:.2f} degrees (COMPASS_DEC)" if declination else ""


def _vehicle(log: MessageLog) -> float:
    """The system that reports its place most."""
    names = ("GLOBAL_POSITION_INT", "GPS_RAW_INT", "ATTITUDE", *sorted(log.tables))
    name = next((name for name in names if name in log.tables), None)
    if name is None:
        raise NavigationError(
            f"{log.path}: no message of a vehicle; it has {', '.join(log.present)}"
        )
    systems, counts = np.unique(log.tables[name][SYSTEM], return_counts=True)
    return float(systems[np.argmax(counts)])


def _warn_of_other_kinds(path: Path, beats: LogTable, vehicle: float) -> None:
    """Warn where the vehicle calls itself something else than a submarine."""
    kinds = set(beats["type"][beats[SYSTEM] == vehicle].astype(int).tolist())
    own = sorted(kinds - _NO_VEHICLES)
    if own and _SUBMARINE not in own:
        from pymavlink.dialects.v20.ardupilotmega import enums

        names = [getattr(enums["MAV_TYPE"].get(kind), "name", f"MAV_TYPE {kind}") for kind in own]
        warn(
            f"{path}: the log is of a vehicle of {' and '.join(names)}, not of a submarine: depths "
            "are minus its heights"
        )


def _tlog_times(table: LogTable) -> Array:
    """Times by the ground station's clock, without the jitter of the link where that can be known.

    A message that carries the vehicle's time since boot has that, plus what the quickest message
    of one boot took; the others have the time of their recording.
    """
    recorded: Array = table[RECORDED]
    # Components of one system may count from separate boots.
    if "time_boot_ms" not in table or len(np.unique(table[COMPONENT])) > 1:
        return recorded
    boot = table["time_boot_ms"] * 1e-3
    session = np.cumsum(np.diff(boot, prepend=boot[:1]) < -_REBOOT_S)
    times = np.empty_like(recorded)
    for number in np.unique(session):
        rows = session == number
        times[rows] = boot[rows] + np.min(recorded[rows] - boot[rows])
    return times


def read_dataflash(path: Path, needed: Collection[str]) -> MessageLog:
    """Read the messages of some names of an on-board log of ArduSub.

    Raises:
        NavigationError: it is not such a log, or cannot be read.
    """
    if _DATAFLASH not in first_bytes(path, 4096):
        raise NavigationError(
            f"{path}: no DataFlash log: its first bytes hold no FMT message (was it cut at the "
            "start?)"
        )
    rows: dict[str, list[Any]] = {}
    lost: Counter[str] = Counter()
    with _read_by("pymavlink", path):
        from pymavlink.DFReader import DFReader_binary

        class Log(DFReader_binary):  # type: ignore[misc]
            """A log without an index, which ends at the first damage, and without a clock."""

            def init_arrays(self, progress_callback: Any = None) -> None:
                self.name_to_id: dict[str, int] = {}
                self.id_to_name: dict[int, str] = {}

            init_arrays_fast = init_arrays

            def init_clock(self) -> None:
                pass

        with Log(str(path)) as log:
            noise = log.data_len
            for message in _messages(log, lost):
                noise -= message.fmt.len
                kept = rows.setdefault(message.get_type(), [])
                if message.get_type() in needed:
                    kept.append(message)
            if noise > 0:
                lost[_NOISE] += noise
            tables = {
                name: _dataflash_table(name, messages, lost)
                for name, messages in rows.items()
                if messages
            }
    return MessageLog(path=path, tables=tables, present=sorted(rows), lost=lost)


def _messages(log: Any, lost: Counter[str]) -> Iterator[Any]:
    """Messages of a log of pymavlink, past those that it cannot read."""
    while True:
        before = log.offset
        try:
            message = log.recv_msg()
        except (ValueError, TypeError, AttributeError, LookupError):
            if log.offset <= before:
                return
            lost["messages that cannot be read"] += 1
            continue
        if message is None:
            return
        yield message


def _dataflash_table(name: str, messages: Sequence[Any], lost: Counter[str]) -> LogTable:
    def number(message: Any, field: str) -> float:
        try:
            return float(getattr(message, field))
        except (ValueError, TypeError, OverflowError):
            lost[f"{name}: {field} is not a number"] += 1
            return math.nan

    form = messages[0].fmt
    table = LogTable()
    for key, kind in zip(form.columns, form.msg_fmts, strict=False):
        if any(key not in message.fmt.colhash for message in messages):
            continue
        if kind not in (*_TEXTS, "M"):
            table[key] = np.array([number(message, key) for message in messages])
        elif key == "Name":  # of parameters
            table[key] = np.array([str(getattr(message, key)) for message in messages])
    return table


def read_tlog(path: Path, needed: Collection[str]) -> MessageLog:
    """Read the messages of some names of a ground station's log.

    Returns:
        Tables with the columns `RECORDED`, `SYSTEM` and `COMPONENT`.

    Raises:
        NavigationError: the file cannot be read, or holds no MAVLink packet.
    """
    first_bytes(path, 0)
    rows: dict[str, list[list[float]]] = {}
    fields: dict[str, list[str]] = {}
    present: set[str] = set()
    lost: Counter[str] = Counter()
    with _read_by("pymavlink", path):
        from pymavlink import mavutil
        from pymavlink.dialects.v20 import ardupilotmega as dialect

        log = mavutil.mavlogfile(str(path))
        log.mav, log.first_byte = dialect.MAVLink(None), False  # it reads version 1 too
        log.mav.robust_parsing = True
        with contextlib.closing(log):
            while (message := log.recv_msg()) is not None:
                name = message.get_type()
                if name == "BAD_DATA":
                    lost[_NOISE] += len(message.data)
                    continue
                present.add(name)
                if name not in needed:
                    continue
                if name not in fields:
                    scalars = (f for f in message.get_fieldnames()
                               if isinstance(getattr(message, f), int | float))  # fmt: skip
                    fields[name] = list(scalars)
                rows.setdefault(name, []).append(
                    [message._timestamp, message.get_srcSystem(), message.get_srcComponent(),
                     *(getattr(message, f) for f in fields[name])]
                )  # fmt: skip
    if not present:
        raise NavigationError(f"{path}: no telemetry log: it holds no MAVLink packet")
    tables = {
        name: LogTable(zip((RECORDED, SYSTEM, COMPONENT, *fields[name]),
                           np.array(table, dtype=np.float64).T, strict=True))
        for name, table in rows.items()
    }  # fmt: skip
    return MessageLog(path=path, tables=tables, present=sorted(present), lost=lost)


def read_ulog(path: Path, needed: Collection[str]) -> MessageLog:
    """Read the messages of some names; those of several sensors have a column `Instance`.

    Raises:
        NavigationError: it is not a log of PX4, or cannot be read.
    """
    if not first_bytes(path, len(MAGIC)).startswith(MAGIC):
        raise NavigationError(f"{path}: no log of PX4: it does not begin with ULog")
    lost: Counter[str] = Counter()
    with _read_by("pyulog", path):
        from pyulog import ULog

        head = ULog(_Bounded(path.read_bytes()), None, parse_header_only=True)
        forms = {name: form.fields for name, form in head.message_formats.items()}
        for name in forms:
            if _field_count(name, forms) > _MAX_FIELDS:
                raise NavigationError(f"{path}: message {name} has over {_MAX_FIELDS} fields")
        log = ULog(_Bounded(path.read_bytes()), None)
        if log.dropouts:
            lost["pauses of the recording"] += len(log.dropouts)
        if log.file_corruption:
            lost["(the log is damaged: messages are left out)"] += 1
    parts: dict[str, list[dict[str, Array]]] = {}
    for topic in log.data_list:
        if topic.name in needed:
            columns = {n: np.asarray(v, dtype=np.float64) for n, v in topic.data.items()}
            columns["Instance"] = np.full(len(columns["timestamp"]), float(topic.multi_id))
            parts.setdefault(topic.name, []).append(columns)
    return MessageLog(
        path=path,
        tables={name: _join(own) for name, own in parts.items()},
        present=sorted({topic.name for topic in log.data_list}),
        lost=lost,
    )


class _Bounded(io.BytesIO):
    """Bytes that are read a few times at most: pyulog goes back where they are damaged."""

    def __init__(self, data: bytes) -> None:
        super().__init__(data)
        self._reads_left = _MAX_READS * (len(data) + 1024)

    def read(self, size: int | None = -1, /) -> bytes:
        found = super().read(size)
        self._reads_left -= len(found) + 1
        if self._reads_left < 0:
            raise EOFError("it is damaged")
        return found


def _field_count(
    name: str, forms: Mapping[str, Sequence[tuple[str, int, str]]], depth: int = 0
) -> int:
    """How many numbers a message holds, up to a few more than are allowed."""
    if depth > _MAX_DEPTH:
        return _MAX_FIELDS + 1
    total = 0
    for kind, count, _ in forms.get(name, ()):
        total += max(count, 1) * (_field_count(kind, forms, depth + 1) if kind in forms else 1)
        if total > _MAX_FIELDS:
            return total
    return total


def _join(parts: list[dict[str, Array]]) -> LogTable:
    """One table of the messages of several sensors, by time."""
    columns = {
        field: np.concatenate([part[field] for part in parts])
        for field in parts[0]
        if all(field in part for part in parts)
    }
    return LogTable(columns).rows(np.argsort(columns["timestamp"], kind="stable"))


def first_bytes(path: Path, count: int) -> bytes:
    """The first bytes of a log.

    Raises:
        NavigationError: it cannot be read, or is too large for one.
    """
    with file_faults(path, NavigationError), ordinary_file(path, None).open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        start = file.read(count)
    if size > MAX_LOG_BYTES:
        raise NavigationError(f"{path}: is larger than {MAX_LOG_BYTES // 10**9} GB: cut it")
    return start


@contextlib.contextmanager
def _read_by(library: str, path: Path) -> Iterator[None]:
    """Silence a library that reads a log, and turn what it raises into one line.

    Raises:
        NavigationError: it has raised something; the message says what.
    """
    with (
        open(os.devnull, "w") as nowhere,  # noqa: PTH123  it is no path
        contextlib.redirect_stdout(nowhere),
        contextlib.redirect_stderr(nowhere),
    ):
        try:
            yield
        except (NavigationError, MemoryError):
            raise
        except ImportError:
            raise NavigationError(
                f"{path}: {library} is needed to read it: {extra('mavlink')}"
            ) from None
        except Exception as error:  # damaged logs raise all kinds
            raise NavigationError(
                f"{path}: cannot be read by {library}: {one_line(error)}"
            ) from None
