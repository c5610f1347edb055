"""ArduSub's logs as a logged dive: the on-board log (DataFlash) and the ground station's (tlog).

Which messages hold what: ardupilot.org/sub, "Onboard Message Log Messages", and
mavlink.io/en/messages/common.html. ArduSub puts its home at the water's surface
(ArduSub/commands.cpp, set_home_to_current_location), so that heights above home are minus the
depth; its barometer is zeroed at the surface.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from alice_survey.base.errors import NavigationError
from alice_survey.base.frames import Array, Datum
from missions.logs.dataflash import LogTable, Mask, read_dataflash
from missions.logs.dive import (
    DATED_AFTER_S,
    ROLES,
    LoggedDive,
    Signal,
    cleaned,
    usable_positions,
)
from missions.logs.tlog import COMPONENT, RECORDED, SYSTEM, read_tlog

_GPS_EPOCH_S = 315964800.0
"""6 January 1980 in seconds since 1970."""
_WEEK_S = 604800.0
_LEAPS = ((1167264018.0, 18.0), (1119744017.0, 17.0), (1025136016.0, 16.0), (0.0, 15.0))
"""GPS seconds from which GPS led UTC by this many seconds (IERS Bulletin C: 1 January 2017,
1 July 2015, 1 July 2012)."""
_FIX_3D = 3
_DOWN = 25
"""ROTATION_PITCH_270: a range finder that looks down."""
_GOOD = 4
"""RangeFinder status: in range."""
_INSTANCE = ("C", "I", "Instance", "id")
"""Fields that identify one of several cores or sensors."""
_REBOOT_S = 1.0
"""A clock since boot that goes back by more has been started again."""

_Tables = Mapping[str, LogTable]
_Reader = Callable[[LogTable, _Tables], tuple[Array, Array] | None]
"""Takes the table of a message, and all tables, to times and values; None where a field or another
table is missing."""


@dataclass(frozen=True)
class _Source:
    """One way to get a quantity."""

    message: str
    read: _Reader
    note: str = ""
    """What to know of it when it is used."""


@dataclass(frozen=True)
class _Keep:
    """Which rows of a message to use."""

    fields: tuple[str, ...]
    """What `rows` needs."""
    rows: Callable[[LogTable], Mask]


def _take(
    *fields: str, scale: float = 1.0, keep: _Keep | None = None, absent: float | None = None
) -> _Reader:
    """Read fields of a message, times a scale; `keep` marks rows to use, `absent` what is NaN."""

    def read(table: LogTable, _: _Tables) -> tuple[Array, Array] | None:
        if not table.has(*fields, *(keep.fields if keep is not None else ())):
            return None
        if keep is not None:
            table = table.rows(keep.rows(table))
        values = table.stacked(*fields)
        if absent is not None:
            values = np.where(values == absent, np.nan, values)
        return table.columns["time_s"], values * scale

    return read


def _from_origin(table: LogTable, tables: _Tables) -> tuple[Array, Array] | None:
    """Latitude and longitude of north and east from the filter's origin (message ORGN, type 0)."""
    origin = tables.get("ORGN")
    if origin is None or not table.has("PN", "PE", "PD") or not origin.has("Type", "Lat", "Lng"):
        return None
    rows = np.flatnonzero(origin.columns["Type"] == 0)
    if not len(rows):
        return None
    last = rows[-1]
    datum = Datum(float(origin.columns["Lat"][last]), float(origin.columns["Lng"][last]))
    ned = table.stacked("PN", "PE", "PD")
    return table.columns["time_s"], datum.geodetic_from_ned(ned)[:, :2]


def _has_fix(field: str) -> _Keep:
    return _Keep((field,), lambda table: table.columns[field] >= _FIX_3D)


def _sees_down(table: LogTable) -> Mask:
    """Rows of a range finder that looks down and is in range."""
    good: Mask = table.columns["Stat"] == _GOOD
    if "Orient" in table.columns:
        good &= table.columns["Orient"] == _DOWN
    return good


def _hears_bottom(table: LogTable) -> Mask:
    """Rows of DISTANCE_SENSOR that look down and are within what the sensor measures."""
    distance = table.columns["current_distance"]
    inside = (distance >= table.columns["min_distance"]) & (
        distance < table.columns["max_distance"]
    )
    good: Mask = inside & (table.columns["orientation"] == _DOWN)
    return good


_SURFACE = "positions are GPS: they hold at the surface only"
_BACKUP = "positions are those of the backup attitude filter"
_DEGREES = float(np.rad2deg(1.0))
_BIN: Mapping[str, tuple[_Source, ...]] = {
    "navigation": (
        _Source("POS", _take("Lat", "Lng")),
        _Source("XKF1", _from_origin),
        _Source("NKF1", _from_origin),
        _Source("AHR2", _take("Lat", "Lng"), _BACKUP),
        _Source("GPS", _take("Lat", "Lng", keep=_has_fix("Status")), _SURFACE),
    ),
    "depth": (
        _Source("POS", _take("RelHomeAlt", scale=-1.0)),
        _Source("CTUN", _take("BAlt", scale=-1.0)),
        _Source("XKF1", _take("PD")),
        _Source("NKF1", _take("PD")),
        _Source("BARO", _take("Alt", scale=-1.0)),
    ),
    "attitude": tuple(
        _Source(message, _take("Roll", "Pitch", "Yaw"))
        for message in ("ATT", "XKF1", "NKF1", "AHR2")
    ),
    "altitude": (_Source("RFND", _take("Dist", keep=_Keep(("Stat",), _sees_down))),),
    "velocity": tuple(_Source(message, _take("VN", "VE", "VD")) for message in ("XKF1", "NKF1")),
    "rates": (_Source("RATE", _take("R", "P", "Y", scale=float(np.deg2rad(1.0)))),),
    "pwm": (_Source("RCOU", _take(*(f"C{i}" for i in range(1, 9)))),),
}
"""Sources of each role, the best first; degrees, metres, m/s, rad/s."""
_TLOG: Mapping[str, tuple[_Source, ...]] = {
    "navigation": (
        _Source("GLOBAL_POSITION_INT", _take("lat", "lon", scale=1e-7)),
        _Source(
            "GPS_RAW_INT", _take("lat", "lon", scale=1e-7, keep=_has_fix("fix_type")), _SURFACE
        ),
    ),
    "depth": (
        _Source("GLOBAL_POSITION_INT", _take("relative_alt", scale=-1e-3)),
        _Source("VFR_HUD", _take("alt", scale=-1.0)),
    ),
    "attitude": (_Source("ATTITUDE", _take("roll", "pitch", "yaw", scale=_DEGREES)),),
    "altitude": (
        _Source(
            "DISTANCE_SENSOR",
            _take(
                "current_distance",
                scale=1e-2,
                keep=_Keep(("orientation", "min_distance", "max_distance"), _hears_bottom),
            ),
        ),
        _Source("RANGEFINDER", _take("distance", absent=0.0)),
    ),
    "velocity": (_Source("GLOBAL_POSITION_INT", _take("vx", "vy", "vz", scale=1e-2)),),
    "rates": (_Source("ATTITUDE", _take("rollspeed", "pitchspeed", "yawspeed")),),
    "pwm": (_Source("SERVO_OUTPUT_RAW", _take(*(f"servo{i}_raw" for i in range(1, 9)))),),
}


def read_ardusub_bin(path: Path, requested: Mapping[str, str]) -> LoggedDive:
    """Read an on-board log.

    Args:
        path: a .BIN or a text .log.
        requested: the message to use for each role (`dive.ROLES`), `NAME` or `NAME[instance]`.

    Raises:
        NavigationError: it is not such a log, or lacks what navigation needs.
    """
    lost: Counter[str] = Counter()
    wanted = {source.message for sources in _BIN.values() for source in sources}
    tables, present = read_dataflash(path, {*wanted, "GPS", "ORGN", "PARM"}, lost)
    offset_s, dated = _since_1970(tables)
    timed = {}
    for name, table in tables.items():
        if "TimeUS" in table.columns:
            time_s = table.columns["TimeUS"] * 1e-6 + offset_s
            timed[name] = _with_time(table, time_s)
        elif "TimeMS" in table.columns and name != "GPS":
            timed[name] = _with_time(table, table.columns["TimeMS"] * 1e-3 + offset_s)
    return _dive(
        path, _BIN, requested, timed, present, lost,
        kind="an on-board log of ArduSub",
        clock="the vehicle's clock, set by GPS" if dated else "the vehicle's clock since boot",
        dated=dated,
        declination_in_log_deg=_declination(tables.get("PARM")),
    )  # fmt: skip


def read_ardusub_tlog(path: Path, requested: Mapping[str, str]) -> LoggedDive:
    """Read a ground station's log; arguments and errors as of `read_ardusub_bin`."""
    lost: Counter[str] = Counter()
    wanted = {source.message for sources in _TLOG.values() for source in sources}
    tables, present = read_tlog(path, wanted, lost)
    vehicle = _vehicle(path, tables, present)
    offset: dict[str, LogTable] = {}
    for name, table in tables.items():
        own = table.rows(table.columns[SYSTEM] == vehicle)
        if len(own) < len(table):
            lost[f"{name}: messages of another system than {vehicle:.0f}"] += len(table) - len(own)
        if len(own):
            offset[name] = _with_time(own, _tlog_times(own))
    recorded = np.concatenate([table.columns[RECORDED] for table in tables.values()])
    return _dive(
        path, _TLOG, requested, offset, present, lost,
        kind="a ground station's log of ArduSub",
        clock="the ground station's clock",
        dated=bool(np.median(recorded) > DATED_AFTER_S),
        declination_in_log_deg=None,
    )  # fmt: skip


def _dive(
    path: Path,
    sources: Mapping[str, tuple[_Source, ...]],
    requested: Mapping[str, str],
    tables: _Tables,
    present: Sequence[str],
    lost: Counter[str],
    *,
    kind: str,
    clock: str,
    dated: bool,
    declination_in_log_deg: float | None,
) -> LoggedDive:
    notes: list[str] = []
    counted: set[str] = set()

    def signal(role: str) -> Signal | None:
        own: Counter[str] = Counter()
        found, note = _signal(path, role, sources[role], requested.get(role), tables, present, own)
        # What the times of a message cost is counted once, though it serves several roles.
        if found is not None and found.source not in counted:
            counted.add(found.source)
            lost.update(own)
        if note and note not in notes:
            notes.append(note)
        return found

    found = {role: signal(role) for role in sources}
    if not any(found[role] for role in ROLES):
        names = ", ".join(dict.fromkeys(s.message for role in ROLES for s in sources[role]))
        raise NavigationError(f"{path}: none of {names}; it has {', '.join(present)}")
    return LoggedDive(
        kind=kind,
        clock=clock,
        dated=dated,
        position=usable_positions(found["navigation"], lost),
        depth=found["depth"],
        attitude=found["attitude"],
        altitude=found["altitude"],
        altitude_slant=True,
        velocity_ned=found["velocity"],
        rates=found["rates"],
        pwm=found["pwm"],
        declination_in_log_deg=declination_in_log_deg,
        lost=dict(lost),
        notes=tuple(notes),
    )


def _signal(
    path: Path,
    role: str,
    sources: Sequence[_Source],
    requested: str | None,
    tables: _Tables,
    present: Sequence[str],
    lost: Counter[str],
) -> tuple[Signal | None, str]:
    """The best source that the log holds, or the requested one, and its note."""
    name, _, instance = (requested or "").removesuffix("]").partition("[")
    known = [source.message for source in sources]
    if name and name not in known:
        raise NavigationError(f"{path}: {role} can come from {', '.join(known)}, not {name}")
    for source in sources:
        if name and source.message != name:
            continue
        table = tables.get(source.message)
        if table is None:
            continue
        one, others = _one_instance(path, role, table, instance, bool(name))
        if one is None:
            continue
        read = source.read(one, tables)
        if read is None or not len(read[0]):
            continue
        found = cleaned(source.message, *read, lost)
        if found is not None:
            return found, f"{source.note}{others}".strip("; ")
    if name:
        raise NavigationError(f"{path}: {requested} gives no {role}; it has {', '.join(present)}")
    return None, ""


def _one_instance(
    path: Path, role: str, table: LogTable, requested: str, named: bool
) -> tuple[LogTable | None, str]:
    """The rows of one core or sensor, and a note on the others.

    Cores and GPS receivers count from the one that is used. Which barometer is the depth sensor
    is not identified by its number, so that one of several must be requested.
    """
    field = next((name for name in _INSTANCE if name in table.columns), None)
    if field is None:
        return table, ""
    known = table.columns[field][np.isfinite(table.columns[field])]
    numbers = np.unique(known).astype(int).tolist()
    if requested:
        if not requested.isdigit() or int(requested) not in numbers:
            raise NavigationError(
                f"{path}: {table.name} has {', '.join(map(str, numbers))}, not {requested}"
            )
        return table.rows(table.columns[field] == int(requested)), ""
    if len(numbers) < 2:
        return table, ""
    if table.name == "BARO":
        if not named:
            return None, ""
        raise NavigationError(
            f"{path}: BARO has {', '.join(map(str, numbers))}: choose the depth sensor with "
            f"--topic {role}=BARO[{numbers[-1]}]"
        )
    if table.name in ("RFND", "DISTANCE_SENSOR"):
        return table, ""
    note = f"; {table.name} {numbers[0]} of {', '.join(map(str, numbers))} is used"
    return table.rows(table.columns[field] == numbers[0]), note


def _with_time(table: LogTable, time_s: Array) -> LogTable:
    return replace(table, columns={**table.columns, "time_s": time_s})


def _since_1970(tables: _Tables) -> tuple[float, bool]:
    """What makes UTC of seconds since boot: the median over all GPS fixes; 0 without one."""
    gps = tables.get("GPS")
    if gps is None or not gps.has("TimeUS", "GMS", "GWk", "Status"):
        return 0.0, False
    fixed = gps.rows((gps.columns["Status"] >= _FIX_3D) & (gps.columns["GWk"] > 0))
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


def _vehicle(path: Path, tables: _Tables, present: Sequence[str]) -> float:
    """The system that reports its place most."""
    names = ("GLOBAL_POSITION_INT", "GPS_RAW_INT", "ATTITUDE", *sorted(tables))
    name = next((name for name in names if name in tables), None)
    if name is None:
        raise NavigationError(f"{path}: no message of a vehicle; it has {', '.join(present)}")
    systems, counts = np.unique(tables[name].columns[SYSTEM], return_counts=True)
    return float(systems[np.argmax(counts)])


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
