"""Logs in foreign columns and frames: a TOML file, `ColumnMap`, defines their meaning."""

from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial.transform import Rotation

from alice_survey.core.config import Config
from alice_survey.core.contents import shown
from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array, rotation_from_attitude
from alice_survey.sim.vehicle.files import read_table, validated
from alice_survey.sim.vehicle.log import (
    TIME,
    VehicleLog,
    log_of_columns,
    read_number_columns,
    unit_lengths,
)

Three = tuple[str, str, str]
_FLU = np.array([1.0, -1.0, -1.0])
"""Forward-left-up to forward-right-down, and back."""
_NED_FROM_ENU = Rotation.from_matrix([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_NEUTRAL_US = 1500.0
"""Pulse at which a thruster that turns both ways stands still."""
_FLU_FROM_FRD = Rotation.from_matrix(np.diag(_FLU))


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
    found = validated(path, ColumnMap, read_table(path))
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

    def one(name: str) -> Array:
        if name not in table:
            raise VehicleError(f"{path}: column {shown(name)} is missing")
        return table[name]

    rows = len(next(iter(table.values())))
    time_s: NDArray[np.floating]
    if columns.time is not None:
        time_s = one(columns.time) * columns.time_unit_s
        time_s = time_s - time_s[0]
    else:
        time_s = np.arange(rows) * (columns.time_step_s or 1.0)
    flip = _FLU if columns.body == "flu" else np.ones(3)
    named: dict[str, Array] = {TIME: np.asarray(time_s, np.float64)}

    def add(names: str, values: Array) -> None:
        named.update(zip(names.split(), values.T, strict=True))

    def many(names: tuple[str, ...]) -> Array:
        return np.stack([one(name) for name in names], axis=1)

    if columns.position is not None:
        position = many(columns.position)
        if columns.world == "enu":
            position = np.stack([position[:, 1], position[:, 0], -position[:, 2]], axis=1)
        add("north_m east_m depth_m", position)
    if columns.quaternion_xyzw is not None:
        add("quat_x quat_y quat_z quat_w", _turned(many(columns.quaternion_xyzw), columns, path))
    elif columns.angles_deg is not None:
        angles = np.deg2rad(many(columns.angles_deg))
        known = np.all(np.isfinite(angles), axis=1)
        quaternions = np.full((rows, 4), np.nan)
        quaternions[known] = rotation_from_attitude(*angles[known].T).as_quat()
        add("quat_x quat_y quat_z quat_w", quaternions)
    if columns.velocity is not None:
        add("u_mps v_mps w_mps", many(columns.velocity) * flip)
    if columns.rates is not None:
        add("p_rad_s q_rad_s r_rad_s", many(columns.rates) * flip)
    if columns.altitude is not None:
        named["altitude_m"] = one(columns.altitude)
    if columns.wrench is not None:
        add("X_n Y_n Z_n K_nm M_nm N_nm", many(columns.wrench) * np.tile(flip, 2))
    named |= {f"rpm_{name}": one(column) for name, column in columns.rpm.items()}
    named |= {f"thrust_{name}_n": one(column) for name, column in columns.thrust.items()}
    for name, column in columns.pulses.items():
        pulses = one(column.removeprefix("-"))
        pulses = 2.0 * _NEUTRAL_US - pulses if column.startswith("-") else pulses
        named[f"thrust_{name}_n"] = _thrust(pulses, columns, f"{path}: column {shown(column)}")
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


def _turned(quaternions: Array, columns: ColumnMap, path: Path) -> Array:
    """Quaternions of ned_from_frd, (T, 4); NaN stays."""
    known = np.isfinite(unit_lengths(quaternions, str(path)))
    turned = np.full(quaternions.shape, np.nan)
    if known.any():
        rotation = Rotation.from_quat(quaternions[known])
        if columns.world == "enu":
            rotation = _NED_FROM_ENU * rotation
        if columns.body == "flu":
            rotation = rotation * _FLU_FROM_FRD
        turned[known] = rotation.as_quat()
    return turned
