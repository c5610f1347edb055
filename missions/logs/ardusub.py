"""ArduSub's logs as a logged dive: the on-board log (DataFlash) and the ground station's (tlog).

pymavlink reads both (the extra `mavlink`).

Which messages hold what: ardupilot.org/sub, "Onboard Message Log Messages", and
mavlink.io/en/messages/common.html. ArduSub puts its home at the water's surface
(ArduSub/commands.cpp, set_home_to_current_location), so that heights above home are minus the
depth; its barometer is zeroed at the surface.
"""

import math
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.errors import NavigationError, warn
from alice_survey.core.frames import Array, Datum
from missions.logs.dive import DATED_AFTER_S, LoggedDive
from missions.logs.message_sources import (
    AT_SURFACE,
    DOWN,
    FIX_3D,
    HEARD_BY,
    Keep,
    LogTable,
    Mask,
    Source,
    Tables,
    dive_from,
    first_bytes,
    hears_bottom,
    read_by,
    take,
    with_time,
)

RECORDED, SYSTEM, COMPONENT = "recorded_s", "system", "component"
"""Columns of a tlog: time of the ground station, seconds since 1970, and who has sent it."""
_NOISE = "bytes that are not a message, or of one that is cut off"
_DATAFLASH = b"\xa3\x95\x80"
_TEXTS = "anNZ"
"""Field types of text."""

_GPS_EPOCH_S = 315964800.0
"""6 January 1980 in seconds since 1970."""
_WEEK_S = 604800.0
_LEAPS = ((1167264018.0, 18.0), (1119744017.0, 17.0), (1025136016.0, 16.0), (0.0, 15.0))
"""GPS seconds from which GPS led UTC by this many seconds (IERS Bulletin C: 1 January 2017,
1 July 2015, 1 July 2012)."""
_GOOD = 4
"""RangeFinder status: in range."""
_SUBMARINE = 12
_KINDS = {
    1: "an aeroplane", 2: "a quadrotor", 3: "a coaxial helicopter", 4: "a helicopter",
    10: "a ground vehicle", 11: "a boat", 13: "a hexarotor", 14: "an octorotor",
    **dict.fromkeys(range(19, 26), "an aeroplane that starts upright"),
}  # fmt: skip
"""What moves, by MAV_TYPE (mavlink.io/en/messages/minimal.html)."""
_NO_VEHICLES = {0, 5, 6, 18, 26, 27, 30}
"""Generic parts, antenna trackers, ground stations, companion computers, gimbals, ADS-B, cameras.
"""
_REBOOT_S = 1.0
"""A clock since boot that goes back by more has been started again."""


def _from_origin(table: LogTable, tables: Tables) -> tuple[Array, Array] | str:
    """Latitude and longitude of north and east from the filter's origin (message ORGN, type 0)."""
    if not table.has("PN", "PE", "PD"):
        return "it lacks PN, PE or PD"
    origin = tables.get("ORGN")
    rows = np.empty(0, np.intp)
    if origin is not None and origin.has("Type", "Lat", "Lng"):
        rows = np.flatnonzero(origin.columns["Type"] == 0)
    if origin is None or not len(rows):
        return (
            "it counts from the filter's origin, and the log holds none (ORGN): give it by --datum "
            "LATITUDE LONGITUDE"
        )
    last = rows[-1]
    datum = Datum(float(origin.columns["Lat"][last]), float(origin.columns["Lng"][last]))
    ned = table.stack("PN", "PE", "PD")
    return table.columns["time_s"], datum.geodetic_from_ned(ned)[:, :2]


def _has_fix(field: str) -> Keep:
    return Keep((field,), lambda table: table.columns[field] >= FIX_3D)


def _sees_down(table: LogTable) -> Mask:
    """Rows of a range finder that looks down and is in range."""
    good: Mask = table.columns["Stat"] == _GOOD
    if "Orient" in table.columns:
        good &= table.columns["Orient"] == DOWN
    return good


_BACKUP = "positions are those of the backup attitude filter"
_DEGREES = float(np.rad2deg(1.0))
_BIN: Mapping[str, tuple[Source, ...]] = {
    "navigation": (
        Source("POS", take("Lat", "Lng")),
        Source("XKF1", _from_origin),
        Source("NKF1", _from_origin),
        Source("AHR2", take("Lat", "Lng"), _BACKUP),
        Source("GPS", take("Lat", "Lng", keep=_has_fix("Status")), AT_SURFACE),
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
    "altitude": (Source("RFND", take("Dist", keep=Keep(("Stat",), _sees_down))),),
    "velocity": tuple(Source(message, take("VN", "VE", "VD")) for message in ("XKF1", "NKF1")),
    "rates": (Source("RATE", take("R", "P", "Y", scale=float(np.deg2rad(1.0)))),),
    "pwm": (Source("RCOU", take(*(f"C{i}" for i in range(1, 9)))),),
}
"""Sources of each role, the best first; degrees, metres, m/s, rad/s."""
_TLOG: Mapping[str, tuple[Source, ...]] = {
    "navigation": (
        Source("GLOBAL_POSITION_INT", take("lat", "lon", scale=1e-7)),
        Source(
            "GPS_RAW_INT", take("lat", "lon", scale=1e-7, keep=_has_fix("fix_type")), AT_SURFACE
        ),
    ),
    "depth": (
        Source("GLOBAL_POSITION_INT", take("relative_alt", scale=-1e-3)),
        Source("VFR_HUD", take("alt", scale=-1.0)),
    ),
    "attitude": (Source("ATTITUDE", take("roll", "pitch", "yaw", scale=_DEGREES)),),
    "altitude": (
        Source(
            "DISTANCE_SENSOR",
            take("current_distance", scale=1e-2, keep=Keep(HEARD_BY, hears_bottom)),
        ),
        Source("RANGEFINDER", take("distance", absent=0.0)),
    ),
    "velocity": (Source("GLOBAL_POSITION_INT", take("vx", "vy", "vz", scale=1e-2)),),
    "rates": (Source("ATTITUDE", take("rollspeed", "pitchspeed", "yawspeed")),),
    "pwm": (Source("SERVO_OUTPUT_RAW", take(*(f"servo{i}_raw" for i in range(1, 9)))),),
}


def read_ardusub_bin(
    path: Path, requested: Mapping[str, str], datum: Datum | None = None
) -> LoggedDive:
    """Read an on-board log.

    Args:
        path: a .BIN.
        requested: the message to use for each role (`dive.ROLES`), `NAME` or `NAME[instance]`.
        datum: the filter's origin instead of the log's ORGN.

    Raises:
        NavigationError: it is not such a log, or lacks what navigation needs.
    """
    lost: Counter[str] = Counter()
    needed = {source.message for sources in _BIN.values() for source in sources}
    tables, present = read_dataflash(path, {*needed, "GPS", "ORGN", "PARM"}, lost)
    offset_s, dated = _since_1970(tables)
    timed = {}
    for name, table in tables.items():
        if "TimeUS" in table.columns:
            time_s = table.columns["TimeUS"] * 1e-6 + offset_s
            timed[name] = with_time(table, time_s)
        elif "TimeMS" in table.columns and name != "GPS":
            timed[name] = with_time(table, table.columns["TimeMS"] * 1e-3 + offset_s)
    if datum is not None:
        values = {"Type": 0.0, "Lat": datum.latitude_deg, "Lng": datum.longitude_deg}
        columns = {name: np.array([value]) for name, value in values.items()}
        timed["ORGN"] = LogTable(name="ORGN", columns=columns, texts={})
    return dive_from(
        path, _BIN, requested, timed, present, lost,
        kind="an on-board log of ArduSub",
        clock="the vehicle's clock, set by GPS" if dated else "the vehicle's clock since boot",
        dated=dated,
        declination_in_log_deg=_declination(tables.get("PARM")),
    )  # fmt: skip


def read_ardusub_tlog(path: Path, requested: Mapping[str, str]) -> LoggedDive:
    """Read a ground station's log; arguments and errors as of `read_ardusub_bin`."""
    lost: Counter[str] = Counter()
    needed = {source.message for sources in _TLOG.values() for source in sources}
    tables, present = read_tlog(path, {*needed, "HEARTBEAT"}, lost)
    beats = tables.pop("HEARTBEAT", None)
    vehicle = _vehicle(path, tables, present)
    _warn_of_other_kinds(path, beats, vehicle)
    offset: dict[str, LogTable] = {}
    for name, table in tables.items():
        own = table.rows(table.columns[SYSTEM] == vehicle)
        if len(own) < len(table):
            lost[f"{name}: messages of another system than {vehicle:.0f}"] += len(table) - len(own)
        if len(own):
            offset[name] = with_time(own, _tlog_times(own))
    recorded = np.concatenate([table.columns[RECORDED] for table in tables.values()])
    return dive_from(
        path, _TLOG, requested, offset, present, lost,
        kind="a ground station's log of ArduSub",
        clock="the ground station's clock",
        dated=bool(np.median(recorded) > DATED_AFTER_S),
        declination_in_log_deg=None,
    )  # fmt: skip


def _since_1970(tables: Tables) -> tuple[float, bool]:
    """What makes UTC of seconds since boot: the median over all GPS fixes; 0 without one."""
    gps = tables.get("GPS")
    if gps is None or not gps.has("TimeUS", "GMS", "GWk", "Status"):
        return 0.0, False
    fixed = gps.rows((gps.columns["Status"] >= FIX_3D) & (gps.columns["GWk"] > 0))
    if not len(fixed):
        return 0.0, False
    seconds = fixed.columns["GWk"] * _WEEK_S + fixed.columns["GMS"] * 1e-3
    starts, ahead = np.array(_LEAPS).T
    leap = ahead[np.argmax(seconds[:, None] >= starts, axis=1)]
    utc = _GPS_EPOCH_S + seconds - leap
    return float(np.median(utc - fixed.columns["TimeUS"] * 1e-6)), True


def _declination(parameters: LogTable | None) -> float | None:
    """What the vehicle added to its compass, degrees; NaN where it took it from its own table."""
    if parameters is None or "Name" not in parameters.texts or "Value" not in parameters.columns:
        return None
    values = dict(zip(parameters.texts["Name"], parameters.columns["Value"], strict=True))
    if values.get("COMPASS_AUTODEC", 0.0) > 0:
        return float("nan")
    declination = values.get("COMPASS_DEC")
    return None if declination is None else float(np.rad2deg(declination))


def _vehicle(path: Path, tables: Tables, present: Sequence[str]) -> float:
    """The system that reports its place most."""
    names = ("GLOBAL_POSITION_INT", "GPS_RAW_INT", "ATTITUDE", *sorted(tables))
    name = next((name for name in names if name in tables), None)
    if name is None:
        raise NavigationError(f"{path}: no message of a vehicle; it has {', '.join(present)}")
    systems, counts = np.unique(tables[name].columns[SYSTEM], return_counts=True)
    return float(systems[np.argmax(counts)])


def _warn_of_other_kinds(path: Path, beats: LogTable | None, vehicle: float) -> None:
    """Warn where the vehicle calls itself something else than a submarine."""
    if beats is None or not beats.has("type"):
        return
    kinds = set(beats.columns["type"][beats.columns[SYSTEM] == vehicle].astype(int).tolist())
    own = sorted(kinds - _NO_VEHICLES)
    if own and _SUBMARINE not in own:
        names = " and ".join(_KINDS.get(kind, f"a vehicle of MAV_TYPE {kind}") for kind in own)
        warn(f"{path}: the log is of {names}, not of a submarine: depths are minus its heights")


def _tlog_times(table: LogTable) -> Array:
    """Times by the ground station's clock, without the jitter of the link where that can be known.

    A message that carries the vehicle's time since boot has that, plus what the quickest message
    of one boot took; the others have the time of their recording.
    """
    recorded: Array = table.columns[RECORDED]
    if "time_boot_ms" not in table.columns:
        return recorded
    boot = table.columns["time_boot_ms"] * 1e-3
    session = np.concatenate([[0], np.cumsum(np.diff(boot) < -_REBOOT_S)])
    # Components of one system may count from separate boots.
    if COMPONENT in table.columns:
        _, component = np.unique(table.columns[COMPONENT], return_inverse=True)
        if component.max() > 0:
            return recorded
    times = np.empty_like(recorded)
    for number in np.unique(session):
        rows = session == number
        times[rows] = boot[rows] + np.min(recorded[rows] - boot[rows])
    return times


def read_dataflash(
    path: Path, needed: Collection[str], lost: Counter[str]
) -> tuple[dict[str, LogTable], list[str]]:
    """Read the messages of some names of an on-board log.

    Args:
        path: a .BIN.
        needed: names of messages.
        lost: counts what cannot be read; is added to.

    Returns:
        Tables by name, and the names of all messages in the log.

    Raises:
        NavigationError: it is not such a log, or cannot be read.
    """
    if _DATAFLASH not in first_bytes(path, 4096):
        raise NavigationError(
            f"{path}: no DataFlash log: its first bytes hold no FMT message (was it cut at the "
            "start?)"
        )
    rows: dict[str, list[Any]] = {}
    with read_by("pymavlink", path):
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
            tables = _dataflash_tables(rows, lost)
    return tables, sorted(rows)


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


def _dataflash_tables(rows: Mapping[str, Sequence[Any]], lost: Counter[str]) -> dict[str, LogTable]:
    def number(message: Any, field: str) -> float:
        try:
            return float(getattr(message, field))
        except (ValueError, TypeError, OverflowError):
            lost[f"{message.get_type()}: {field} is not a number"] += 1
            return math.nan

    tables = {}
    for name, messages in rows.items():
        if not messages:
            continue
        form = messages[0].fmt
        columns: dict[str, Array] = {}
        texts: dict[str, list[str]] = {}
        for field, kind in zip(form.columns, form.msg_fmts, strict=False):
            own = [message for message in messages if field in message.fmt.colhash]
            if len(own) < len(messages):
                continue
            if kind in _TEXTS:
                texts[field] = [str(getattr(message, field)) for message in messages]
            elif kind != "M":
                columns[field] = np.array([number(message, field) for message in messages])
        tables[name] = LogTable(name=name, columns=columns, texts=texts)
    return tables


def read_tlog(
    path: Path, needed: Collection[str], lost: Counter[str]
) -> tuple[dict[str, LogTable], list[str]]:
    """Read the messages of some names of a ground station's log.

    Args:
        path: the file.
        needed: names of messages.
        lost: counts what cannot be read; is added to.

    Returns:
        Tables by name with the columns `RECORDED`, `SYSTEM` and `COMPONENT`, and the names of all
        messages in the log.

    Raises:
        NavigationError: the file cannot be read, or holds no MAVLink packet.
    """
    first_bytes(path, 0)
    rows: dict[str, list[list[float]]] = {}
    fields: dict[str, list[str]] = {}
    present: set[str] = set()
    with read_by("pymavlink", path):
        from pymavlink import mavutil
        from pymavlink.dialects.v20 import ardupilotmega as dialect

        log = mavutil.mavlogfile(str(path))
        log.mav, log.first_byte = dialect.MAVLink(None), False  # it reads version 1 too
        log.mav.robust_parsing = True
        try:
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
        finally:
            log.close()
    if not present:
        raise NavigationError(f"{path}: no telemetry log: it holds no MAVLink packet")
    tables = {}
    for name, table in rows.items():
        names = (RECORDED, SYSTEM, COMPONENT, *fields[name])
        cells = np.array(table, dtype=np.float64).T
        tables[name] = LogTable(name=name, columns=dict(zip(names, cells, strict=True)))
    return tables, sorted(present)
