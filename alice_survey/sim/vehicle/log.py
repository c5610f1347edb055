"""The vehicle log, one CSV: motion of a vehicle and its thrusters.

docs/vehicle-logs.md describes each column. Every field but the time may be missing, in whole or in
single rows: NaN means not measured.

Logs in foreign columns and frames: a TOML file, `ColumnMap`, defines their meaning.
"""

import csv
import itertools
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from alice_survey.core.artefacts import write_csv
from alice_survey.core.config import Config
from alice_survey.core.contents import as_line, ordinary_file, parse_number
from alice_survey.core.errors import VehicleError, file_faults, warn
from alice_survey.core.frames import Array, attitude_from_rotation, rotation_from_attitude
from alice_survey.sim.vehicle.vehicle import parse_table, read_table

TIME = "time_s"
POSITION = ("north_m", "east_m", "depth_m")
ANGLES = ("roll_deg", "pitch_deg", "heading_deg")
QUATERNION = ("quat_x", "quat_y", "quat_z", "quat_w")
VELOCITY = ("u_mps", "v_mps", "w_mps")
RATES = ("p_rad_s", "q_rad_s", "r_rad_s")
ALTITUDE = "altitude_m"
WRENCH = ("X_n", "Y_n", "Z_n", "K_nm", "M_nm", "N_nm")
_KNOWN = (TIME, *POSITION, *ANGLES, *QUATERNION, *VELOCITY, *RATES, ALTITUDE, *WRENCH)
_RPM, _THRUST = re.compile(r"rpm_(.+)", re.DOTALL), re.compile(r"thrust_(.+)_n", re.DOTALL)
_WIDTHS = {
    "position_ned": (3,), "quaternion_xyzw": (4,), "velocity_body": (3,), "rates_body": (3,),
    "altitude_m": (), "wrench": (6,),
}  # fmt: skip
_UNIT = 0.05
"""Tolerance of a quaternion's length: more is not rounding of a written attitude."""
_GAP_STEPS = 10
"""A gap is longer than this many median steps."""


def _nothing() -> Array:
    return np.empty(0)


@dataclass(frozen=True, kw_only=True, eq=False)
class VehicleLog:
    """Motion and input of a vehicle at times; NaN in what is not given."""

    source: str = "log"
    """Source, for messages."""
    time_s: Array
    """(T,) strictly increasing."""
    position_ned: Array = field(default_factory=_nothing)
    """(T, 3) position of the body's origin, metres."""
    quaternion_xyzw: Array = field(default_factory=_nothing)
    """(T, 4) quaternions of ned_from_body, of unit length."""
    velocity_body: Array = field(default_factory=_nothing)
    """(T, 3) velocity over ground, m/s."""
    rates_body: Array = field(default_factory=_nothing)
    """(T, 3) body rates, rad/s."""
    altitude_m: Array = field(default_factory=_nothing)
    """(T,) height above the sea floor."""
    rpm: Mapping[str, Array] = field(default_factory=dict)
    """By thruster: (T,) speed in revolutions per minute, positive pushes along its direction."""
    thrust_n: Mapping[str, Array] = field(default_factory=dict)
    """By thruster: (T,) net force on the vehicle along its direction."""
    wrench: Array = field(default_factory=_nothing)
    """(T, 6) force, N, and moment about the body's origin, N m, of all thrusters."""
    others: Mapping[str, Array] = field(default_factory=dict)
    """Columns that have no meaning here, carried along: (T,) each."""

    def __post_init__(self) -> None:
        count = len(self.time_s)
        for name, width in _WIDTHS.items():
            if not len(getattr(self, name)):
                object.__setattr__(self, name, np.full((count, *width), np.nan))
            if (shape := getattr(self, name).shape) != (count, *width):
                raise ValueError(f"{name} has the shape {shape} at {count} times")
        for series in (*self.rpm.values(), *self.thrust_n.values()):
            if series.shape != (count,):
                raise ValueError(f"a series of shape {series.shape} at {count} times")
        if not np.all(np.diff(self.time_s) > 0):
            raise ValueError("time_s must increase strictly")

    @property
    def attitude_rad(self) -> Array:
        """(T, 3) roll, pitch, heading in (-pi, pi]; NaN rows where it was not measured."""
        return attitude_of(self.quaternion_xyzw)


def attitude_of(quaternion_xyzw: Array) -> Array:
    """Roll, pitch and heading, (T, 3) rad, of quaternions (T, 4) of ned_from_body; NaN stays."""
    known = np.all(np.isfinite(quaternion_xyzw), axis=1)
    angles = np.full((len(quaternion_xyzw), 3), np.nan)
    if known.any():
        angles[known] = attitude_from_rotation(Rotation.from_quat(quaternion_xyzw[known]))
    return angles


def write_vehicle_log(path: Path, log: VehicleLog) -> None:
    """Write a log as CSV, to 9 decimals; columns that hold nothing are left out."""
    columns: dict[str, Array] = {TIME: log.time_s}
    for names, table in (
        (POSITION, log.position_ned), (ANGLES, np.rad2deg(log.attitude_rad)),
        (VELOCITY, log.velocity_body), (RATES, log.rates_body),
        ((ALTITUDE,), log.altitude_m[:, None]), (WRENCH, log.wrench),
    ):  # fmt: skip
        if np.any(np.isfinite(table)):
            columns |= dict(zip(names, table.T, strict=True))
    columns |= {f"rpm_{name}": value for name, value in log.rpm.items()}
    columns |= {f"thrust_{name}_n": value for name, value in log.thrust_n.items()}
    columns |= log.others
    table = np.column_stack(list(columns.values()))
    rows = (["" if math.isnan(value) else f"{value:.9f}" for value in row] for row in table)
    write_csv(path, tuple(columns), rows)


def read_vehicle_log(path: Path) -> VehicleLog:
    """Read a log; warn of values that were fixed or left out.

    Rows of one time are merged: the later value is kept where both rows have one.

    Raises:
        VehicleError: the file cannot be read, has no rows or no time column, holds a value that is
            not a number, a time that is missing or goes back, an attitude given twice or in part,
            or an invalid quaternion.
    """
    return log_of_columns(read_number_columns(path), str(path))


def log_of_columns(columns: Mapping[str, Array], source: str) -> VehicleLog:
    """A log of named columns, (T,) each, as in the CSV; see `read_vehicle_log`."""
    if TIME not in columns:
        raise VehicleError(f"{source}: column {TIME} is missing")
    merged = _in_time(dict(columns), source)
    count = len(merged[TIME])

    def table(names: Sequence[str]) -> Array:
        nothing = np.full(count, np.nan)
        return np.stack([merged.get(name, nothing) for name in names], axis=1)

    used = {*_KNOWN, *(name for name in merged if _RPM.fullmatch(name) or _THRUST.fullmatch(name))}
    return VehicleLog(
        source=source, time_s=merged[TIME], position_ned=table(POSITION),
        quaternion_xyzw=_quaternions(merged, source), velocity_body=table(VELOCITY),
        rates_body=table(RATES), altitude_m=table((ALTITUDE,))[:, 0],
        rpm=_by_thruster(merged, _RPM), thrust_n=_by_thruster(merged, _THRUST),
        wrench=table(WRENCH),
        others={name: value for name, value in merged.items() if name not in used},
    )  # fmt: skip


def _by_thruster(columns: Mapping[str, Array], pattern: re.Pattern[str]) -> dict[str, Array]:
    return {
        found[1]: value for name, value in columns.items() if (found := pattern.fullmatch(name))
    }


def max_step_s(time_s: Array) -> float:
    """The longest step between times, (T,), that is not a gap; 0 of one time."""
    steps = np.diff(time_s)
    return _GAP_STEPS * float(np.median(steps)) if len(steps) else 0.0


def segments(log: VehicleLog) -> list[slice]:
    """Cut a log where its times have gaps; together the stretches hold every row."""
    gaps = np.flatnonzero(np.diff(log.time_s) > max_step_s(log.time_s))
    cuts = [0, *(gaps + 1).tolist(), len(log.time_s)]
    return [slice(a, b) for a, b in itertools.pairwise(cuts)]


def read_number_columns(path: Path) -> dict[str, Array]:
    """Read a CSV file of numbers; empty fields and `nan` are NaN, columns of text are left out.

    Raises:
        VehicleError: the file cannot be read, is not a table, has no rows, or a column of numbers
            holds something else in a line.
    """
    with (
        file_faults(path, VehicleError),
        ordinary_file(path).open(newline="", encoding="utf-8-sig") as file,
    ):
        reader = csv.reader(file)
        names = [name.strip() for name in next(reader, [])]
        rows = [(reader.line_num, row) for row in reader if row]
    if not rows:
        raise VehicleError(f"{path}: has no rows")
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise VehicleError(f"{path}: two columns are named {twice!r:.60}")
    for line, row in rows:
        if len(row) != len(names):
            raise VehicleError(f"{path} line {line}: {len(row)} fields under {len(names)} names")
    columns, text = {}, []
    for i, name in enumerate(names):
        values = [_value(row[i]) for _, row in rows]
        bad = next((j for j, value in enumerate(values) if value is None), None)
        if bad is None:
            columns[name] = np.array(values, dtype=np.float64)
        elif (
            name in _KNOWN
            or _RPM.fullmatch(name)
            or _THRUST.fullmatch(name)
            or any(v is not None and math.isfinite(v) for v in values)
        ):
            line, row = rows[bad]
            raise VehicleError(
                f"{path} line {line}: {as_line(name)} is {row[i]!r:.60}, not a finite number"
            )
        else:
            text.append(name)
    if not columns:
        raise VehicleError(f"{path}: holds no column of numbers")
    if text:
        warn(f"{path}: columns of text are left out: {as_line(', '.join(text))}")
    return columns


def _value(text: str) -> float | None:
    """A number, NaN for an empty field, None for anything else."""
    stripped = text.strip()
    if not stripped:
        return math.nan
    try:
        value = parse_number(stripped)
    except ValueError:
        return None
    return None if math.isinf(value) else value


def _in_time(columns: dict[str, Array], source: str) -> dict[str, Array]:
    """The columns with one row a time."""
    time_s = columns[TIME]
    unknown = np.flatnonzero(~np.isfinite(time_s))
    if len(unknown):
        raise VehicleError(f"{source} row {unknown[0] + 1}: {TIME} is missing")
    steps = np.diff(time_s)
    back = np.flatnonzero(steps < 0)
    if len(back):
        i = back[0]
        raise VehicleError(
            f"{source} row {i + 2}: {TIME} goes back from {time_s[i]:g} to {time_s[i + 1]:g}: sort "
            "the rows, or cut the file where the clock was set"
        )
    again = np.flatnonzero(steps == 0)
    if not len(again):
        return columns
    warn(
        f"{source}: {len(again)} rows repeat a time, the first is row {again[0] + 2}: merged, a "
        "later value stands where both hold one"
    )
    times, place = np.unique(time_s, return_inverse=True)
    merged = {name: np.full(len(times), np.nan) for name in columns}
    for name, values in columns.items():
        known = np.isfinite(values)
        merged[name][place[known]] = values[known]
    return merged


def _quaternions(columns: Mapping[str, Array], source: str) -> Array:
    """Attitudes, (T, 4), from angles or quaternions; NaN where not every part is known."""
    given = [n for n in (ANGLES, QUATERNION) if any(name in columns for name in n)]
    quaternions = np.full((len(columns[TIME]), 4), np.nan)
    if not given:
        return quaternions
    if len(given) == 2:
        raise VehicleError(f"{source}: attitude is given twice, as angles and as quaternions")
    missing = next((name for name in given[0] if name not in columns), None)
    if missing is not None:
        raise VehicleError(f"{source}: attitude lacks the column {missing}")
    values = np.stack([columns[name] for name in given[0]], axis=1)
    known = np.all(np.isfinite(values), axis=1)
    if not known.any():
        return quaternions
    if given[0] is ANGLES:
        quaternions[known] = rotation_from_attitude(*np.deg2rad(values[known].T)).as_quat()
        return quaternions
    length = np.linalg.norm(values, axis=1)
    wrong = np.flatnonzero(np.abs(length - 1) > _UNIT)
    if len(wrong):
        raise VehicleError(
            f"{source} row {wrong[0] + 1}: the quaternion has the length {length[wrong[0]]:.4g}, "
            "not 1"
        )
    quaternions[known] = (values / length[:, None])[known]
    return quaternions


Three = tuple[str, str, str]
_FLU = np.array([1.0, -1.0, -1.0])
"""Forward-left-up to forward-right-down, and back."""
_NEUTRAL_US = 1500.0
"""Pulse at which a thruster that turns both ways stands still."""


class ColumnMap(Config):
    """Meaning of a log's columns."""

    time: str | None = None
    time_step_s: float | None = Field(None, gt=0)
    """Interval between rows that have no time."""
    time_unit_s: float = Field(1.0, gt=0)
    """Seconds in one unit of the time column."""
    body: Literal["frd", "flu"] = "frd"
    """Axes of vectors in the body."""
    world: Literal["ned", "enu"] = "ned"
    """Axes of positions and attitudes; in enu z points upwards."""
    position: Three | None = None
    quaternion_xyzw: tuple[str, str, str, str] | None = None
    """Quaternion columns of world_from_body."""
    angles_deg: Three | None = None
    """Roll, pitch, heading instead; for frd in ned only."""
    velocity: Three | None = None
    """Velocity over ground, in the body's axes, m/s."""
    rates: Three | None = None
    """Rates about the body's axes, rad/s."""
    altitude: str | None = None
    wrench: tuple[str, str, str, str, str, str] | None = None
    """Forces, N, and moments, N m, in the body's axes."""
    rpm: dict[str, str] = Field(default_factory=dict)
    """Thruster to column."""
    thrust: dict[str, str] = Field(default_factory=dict)
    """Thruster to column, N."""
    pulses: dict[str, str] = Field(default_factory=dict)
    """Thruster to column of its pulses, microseconds; a minus before one that is reversed, whose
    pulses are mirrored about 1500."""
    thrust_of_pulse: tuple[tuple[float, float], ...] = ()
    """Pulse, microseconds, and thrust, N, of a thruster that is not reversed, as its maker measured
    them; straight in between."""


def read_column_map(path: Path) -> ColumnMap:
    """Read the meaning of a log's columns.

    Raises:
        VehicleError: the file cannot be read or has an unknown key or value.
    """
    found = parse_table(path, ColumnMap, read_table(path))
    if (found.time is None) == (found.time_step_s is None):
        raise VehicleError(f"{path}: give time, or time_step_s where the rows have no time")
    if found.angles_deg is not None and (found.body, found.world) != ("frd", "ned"):
        raise VehicleError(f"{path}: angles_deg are of frd in ned; give quaternion_xyzw")
    curve = [pulse for pulse, _ in found.thrust_of_pulse]
    if bool(found.pulses) != (len(curve) > 1) or sorted(set(curve)) != curve:
        raise VehicleError(
            f"{path}: pulses need thrust_of_pulse, two or more pairs of a pulse and a thrust whose "
            "pulses increase"
        )
    return found


def read_foreign_log(path: Path, columns: ColumnMap) -> VehicleLog:
    """Read a log whose columns and frames a map gives.

    Raises:
        VehicleError: a column is missing, or what `read_vehicle_log` raises.
    """
    table = read_number_columns(path)
    unread = dict.fromkeys(table)

    def one(name: str) -> Array:
        if name not in table:
            raise VehicleError(f"{path}: column {as_line(name)} is missing")
        unread.pop(name, None)
        return table[name]

    if columns.time is not None:
        time_s = one(columns.time) * columns.time_unit_s
        time_s = time_s - time_s[0]
    else:
        rows = len(next(iter(table.values())))
        time_s = np.arange(rows, dtype=np.float64) * (columns.time_step_s or 1.0)
    flip = _FLU if columns.body == "flu" else np.ones(3)
    named: dict[str, Array] = {TIME: time_s}

    def add(ours: Sequence[str], names: Sequence[str], scale: Array | float = 1.0) -> None:
        values = scale * np.stack([one(name) for name in names], axis=1)
        named.update(zip(ours, values.T, strict=True))

    if columns.position is not None:
        add(POSITION, columns.position)
        if columns.world == "enu":
            north, east = named["east_m"], named["north_m"]
            named |= {"north_m": north, "east_m": east, "depth_m": -named["depth_m"]}
    if columns.quaternion_xyzw is not None:
        add(QUATERNION, columns.quaternion_xyzw)
        named |= _turn_axes(named, columns)
    elif columns.angles_deg is not None:
        add(ANGLES, columns.angles_deg)
    if columns.velocity is not None:
        add(VELOCITY, columns.velocity, flip)
    if columns.rates is not None:
        add(RATES, columns.rates, flip)
    if columns.altitude is not None:
        named[ALTITUDE] = one(columns.altitude)
    if columns.wrench is not None:
        add(WRENCH, columns.wrench, np.tile(flip, 2))
    named |= {f"rpm_{name}": one(column) for name, column in columns.rpm.items()}
    named |= {f"thrust_{name}_n": one(column) for name, column in columns.thrust.items()}
    for name, column in columns.pulses.items():
        pulses = one(column.removeprefix("-"))
        pulses = 2.0 * _NEUTRAL_US - pulses if column.startswith("-") else pulses
        named[f"thrust_{name}_n"] = _thrust(pulses, columns, f"{path}: column {as_line(column)}")
    if unread:
        warn(f"{path}: not read: columns {as_line(', '.join(unread))}")
    return log_of_columns(named, str(path))


def _thrust(pulses: Array, columns: ColumnMap, source: str) -> Array:
    """Thrust, (T,) N, at pulses, (T,) microseconds; 0 means that none is sent; NaN stays."""
    curve = np.array(columns.thrust_of_pulse)
    sent = np.where(pulses == 0.0, np.nan, pulses)
    beyond = (sent < curve[0, 0]) | (sent > curve[-1, 0])
    if beyond.any():
        raise VehicleError(
            f"{source} has a pulse of {sent[beyond][0]:g}; thrust_of_pulse knows {curve[0, 0]:g} "
            f"to {curve[-1, 0]:g}"
        )
    thrust: Array = np.interp(sent, *curve.T)
    return np.where(pulses == 0.0, 0.0, thrust)


def _turn_axes(named: Mapping[str, Array], columns: ColumnMap) -> dict[str, Array]:
    """Quaternion columns, (T,) each, of ned_from_frd; of the same length, and NaN stays."""
    x, y, z, w = (named[name] for name in QUATERNION)
    half = math.sqrt(0.5)
    if columns.world == "enu":  # half a turn about (1, 1, 0)
        x, y, z, w = half * (z + w), half * (w - z), half * (y - x), -half * (x + y)
    if columns.body == "flu":  # half a turn about x, first
        x, y, z, w = w, z, -y, -x
    return dict(zip(QUATERNION, (x, y, z, w), strict=True))
