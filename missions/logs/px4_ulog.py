"""PX4's on-board log (.ulg) as a logged dive.

pyulog reads it. What the messages hold: docs.px4.io, "uORB Message Reference". Quaternions of
`vehicle_attitude` are of the FRD body in NED, with w first; `eph` is the root of the summed
variances of north and east.
"""

import io
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from alice_survey.core.errors import NavigationError
from alice_survey.core.frames import Array, Datum, attitude_from_rotation
from missions.logs.dive import LoggedDive, Signal, clean_signal
from missions.logs.message_sources import (
    AT_SURFACE,
    FIX_3D,
    HEARD_BY,
    Keep,
    LogTable,
    Source,
    Tables,
    dive_from,
    first_bytes,
    hears_bottom,
    read_by,
    take,
    with_time,
)

MAGIC = b"ULog\x01\x12\x35"
_HEADER = 16
_MAX_DEPTH, _MAX_FIELDS = 8, 4096
_MAX_READS = 8
"""Times that a log may be read over."""
_GPS = ("sensor_gps", "vehicle_gps_position")
"""Receivers by the names of new and of old versions."""
_LOCAL, _GLOBAL = "vehicle_local_position", "vehicle_global_position"


def _valid(*fields: str) -> Keep:
    return Keep(
        fields, lambda table: np.all([table.columns[field] > 0 for field in fields], axis=0)
    )


def _from_origin(table: LogTable, _: Tables) -> tuple[Array, Array] | str:
    """Latitude and longitude of north and east from the filter's origin, which may be set again."""
    if not table.has("x", "y", "xy_valid", "xy_global", "ref_lat", "ref_lon"):
        return "it lacks x, y or the filter's origin (xy_global, ref_lat, ref_lon)"
    table = table.rows(
        (table.columns["xy_valid"] > 0)
        & (table.columns["xy_global"] > 0)
        & np.isfinite(table.stack("x", "y", "ref_lat", "ref_lon")).all(axis=1)
    )
    places = np.full((len(table), 2), np.nan)
    ne0 = np.column_stack([table.stack("x", "y"), np.zeros(len(table))])
    origins, of = np.unique(table.stack("ref_lat", "ref_lon"), axis=0, return_inverse=True)
    for number, (latitude, longitude) in enumerate(origins.tolist()):
        if abs(latitude) < 90 and abs(longitude) <= 360:
            rows = of.ravel() == number
            places[rows] = Datum(latitude, longitude).geodetic_from_ned(ne0[rows])[:, :2]
    return table.columns["time_s"], places


def _attitude(table: LogTable, _: Tables) -> tuple[Array, Array] | str:
    if not table.has(*(f"q[{i}]" for i in range(4))):
        return "it lacks q"
    quaternion = table.stack(*(f"q[{i}]" for i in (1, 2, 3, 0)))
    known = np.abs(np.linalg.norm(quaternion, axis=1) - 1.0) < 0.05
    angles = np.full((len(table), 3), np.nan)
    if known.any():
        turns = Rotation.from_quat(quaternion[known])
        angles[known] = np.rad2deg(attitude_from_rotation(turns))
    return table.columns["time_s"], angles


_BOTTOM = Keep(  # a quality of 0 is invalid, one of -1 not known
    HEARD_BY, lambda table: hears_bottom(table) & (table.columns.get("signal_quality", 1) != 0)
)
_FIX = Keep(("fix_type",), lambda table: table.columns["fix_type"] >= FIX_3D)
_SOURCES: Mapping[str, tuple[Source, ...]] = {
    "navigation": (
        Source(_GLOBAL, take("lat", "lon")),
        Source(_LOCAL, _from_origin),
        Source(_GPS[0], take("latitude_deg", "longitude_deg", keep=_FIX), AT_SURFACE),
        Source(_GPS[0], take("lat", "lon", scale=1e-7, keep=_FIX), AT_SURFACE),
        Source(_GPS[1], take("latitude_deg", "longitude_deg", keep=_FIX), AT_SURFACE),
        Source(_GPS[1], take("lat", "lon", scale=1e-7, keep=_FIX), AT_SURFACE),
    ),
    "depth": (
        Source(
            _LOCAL,
            take("z", keep=_valid("z_valid")),
            "depths count from where the vehicle's filter was started: --tide takes off its height "
            "above the water, if that was not the surface",
        ),
    ),
    "attitude": (Source("vehicle_attitude", _attitude),),
    "altitude": (Source("distance_sensor", take("current_distance", keep=_BOTTOM)),),
    "velocity": (Source(_LOCAL, take("vx", "vy", "vz", keep=_valid("v_xy_valid", "v_z_valid"))),),
    "rates": (Source("vehicle_angular_velocity", take(*(f"xyz[{i}]" for i in range(3)))),),
    "pwm": (Source("actuator_outputs", take(*(f"output[{i}]" for i in range(8)))),),
}
"""Sources of each role, the best first; degrees, metres, m/s, rad/s."""


def is_ulog(path: Path) -> bool:
    """Whether a file begins as such a log."""
    try:
        with path.open("rb") as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError:
        return False


def read_px4_ulog(path: Path, requested: Mapping[str, str]) -> LoggedDive:
    """Read a log.

    Args:
        path: a .ulg.
        requested: the message to use for each role (`dive.ROLES`), `NAME` or `NAME[instance]`.

    Raises:
        NavigationError: it is not such a log, or lacks what navigation needs.
    """
    lost: Counter[str] = Counter()
    needed = {source.message for sources in _SOURCES.values() for source in sources}
    tables, present = read_ulog(path, needed, lost)
    offset_s = _since_1970(tables)
    timed = {
        name: with_time(table, table.columns["timestamp"] * 1e-6 + (offset_s or 0.0))
        for name, table in tables.items()
        if "timestamp" in table.columns
    }
    dive = dive_from(
        path, _SOURCES, requested, timed, present, lost,
        kind="an on-board log of PX4",
        clock="the vehicle's clock since boot" if offset_s is None else "its clock, set by GPS",
        dated=offset_s is not None,
        declination_in_log_deg=None,
    )  # fmt: skip
    return replace(dive, sigmas=_sigmas(dive, timed))


def _since_1970(tables: Tables) -> float | None:
    """What makes UTC of seconds since boot: the median over all fixes; None without one."""
    for name in _GPS:
        table = tables.get(name)
        if table is None or not table.has("timestamp", "time_utc_usec", "fix_type"):
            continue
        good = (table.columns["fix_type"] >= FIX_3D) & (table.columns["time_utc_usec"] > 0)
        if good.any():
            apart = table.columns["time_utc_usec"][good] - table.columns["timestamp"][good]
            return float(np.median(apart)) * 1e-6
    return None


def _sigmas(dive: LoggedDive, tables: Tables) -> dict[str, Signal]:
    """Sigmas that the filter states of its own positions and depths."""
    found = {}
    for column, signal, field, share in (
        ("sigma_horizontal_m", dive.position, "eph", np.sqrt(0.5)),
        ("sigma_depth_m", dive.depth, "epv", 1.0),
    ):
        if signal is None or signal.source not in (_LOCAL, _GLOBAL):
            continue
        table = tables[signal.source]
        if field not in table.columns:
            continue
        stated = table.columns[field]
        values = share * np.where(stated > 0, stated, np.nan)
        sigma = clean_signal(signal.source, table.columns["time_s"], values, Counter())
        if sigma is not None:
            found[column] = sigma
    return found


def read_ulog(
    path: Path, needed: Collection[str], lost: Counter[str]
) -> tuple[dict[str, LogTable], list[str]]:
    """Read the messages of some names; those of several sensors have a column `Instance`.

    Args:
        path: a .ulg.
        needed: names of messages.
        lost: counts what cannot be read; is added to.

    Returns:
        Tables by name, and the names of all messages in the log.

    Raises:
        NavigationError: it is not such a log, or cannot be read.
    """
    if not first_bytes(path, _HEADER).startswith(MAGIC):
        raise NavigationError(f"{path}: no log of PX4: it does not begin with ULog")
    with read_by("pyulog", path):
        from pyulog import ULog

        data = _Bounded(path.read_bytes())
        log = ULog(data, None, parse_header_only=True)
        forms = {name: form.fields for name, form in log.message_formats.items()}
        for name in forms:
            if _field_count(name, forms) > _MAX_FIELDS:
                raise NavigationError(f"{path}: message {name} has over {_MAX_FIELDS} fields")
        log = ULog(_Bounded(path.read_bytes()), None)
        if log.dropouts:
            lost["pauses of the recording"] += len(log.dropouts)
        if log.file_corruption:
            lost["(the log is damaged: messages are left out)"] += 1
    parts: dict[str, list[LogTable]] = {}
    for topic in log.data_list:
        if topic.name in needed:
            columns = {n: np.asarray(v, dtype=np.float64) for n, v in topic.data.items()}
            columns["Instance"] = np.full(len(columns["timestamp"]), float(topic.multi_id))
            parts.setdefault(topic.name, []).append(LogTable(name=topic.name, columns=columns))
    present = sorted({topic.name for topic in log.data_list})
    return {name: _join_tables(own) for name, own in parts.items()}, present


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


def _join_tables(parts: list[LogTable]) -> LogTable:
    if len(parts) == 1:
        return parts[0]
    shared = [field for field in parts[0].columns if all(part.has(field) for part in parts)]
    columns = {field: np.concatenate([p.columns[field] for p in parts]) for field in shared}
    order = np.argsort(columns.get("timestamp", columns["Instance"]), kind="stable")
    columns = {field: column[order] for field, column in columns.items()}
    return LogTable(name=parts[0].name, columns=columns)
