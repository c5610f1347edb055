"""Files that describe a vehicle, and files of identified coefficients.

A vehicle file is TOML or JSON with the fields of `Vehicle`: `name`, `rigid_body` as `RigidBody`,
`coefficients` by SNAME name, `thrusters` as a list of `Thruster`, `density_kg_m3`. Of a thruster
only name, place and direction are needed where logs give thrusts; speeds need its diameter and k_t
too.
"""

import json
import tomllib
from collections.abc import Mapping
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.base.artefacts import write_json
from alice_survey.base.contents import one_line, shown
from alice_survey.base.errors import VehicleError, why
from alice_survey.vehicle.coefficients import FORCES, Coefficients
from alice_survey.vehicle.fleet import vehicle
from alice_survey.vehicle.propulsion import Thruster
from alice_survey.vehicle.vehicle import RigidBody, Vehicle

COEFFICIENTS_FORMAT = "alice-survey coefficients 1"
_THRUSTER_DEFAULTS: Mapping[str, Any] = {
    "kind": "open", "diameter_m": 1.0, "kt_forward": 1.0, "kt_reverse": 1.0, "kq_forward": 0.0,
    "kq_reverse": 0.0, "handedness": 1, "most_rps": 1e3, "dead_band_rps": 0.0,
    "time_constant_s": 0.1,
}  # fmt: skip
"""Defaults of a thruster in a file: its thrusts are given, its speeds have no meaning."""
_NEEDED_FOR_SPEEDS = ("diameter_m", "kt_forward", "kt_reverse", "time_constant_s")


def vehicle_from(name_or_file: str) -> Vehicle:
    """A vehicle known by name, or described by a TOML or JSON file.

    Raises:
        VehicleError: neither is known, or the file does not describe a vehicle.
    """
    path = Path(name_or_file)
    if path.suffix.lower() not in (".toml", ".json"):
        return vehicle(name_or_file)
    return vehicle_from_file(path)


def vehicle_from_file(path: Path) -> Vehicle:
    """Read a vehicle file.

    Raises:
        VehicleError: the file cannot be read, or lacks a field, has one that is not known or makes
            no sense.
    """
    table = _read(path)
    _known(path, "", table, {"name", "rigid_body", "coefficients", "thrusters", "density_kg_m3"})
    values = table.get("coefficients", {})
    if not isinstance(values, dict):
        raise VehicleError(f"{path}: coefficients are a table of names and values")
    name = str(table.get("name", path.stem))
    thrusters = table.get("thrusters", [])
    if not isinstance(thrusters, list):
        raise VehicleError(f"{path}: thrusters are a list of tables")
    body: RigidBody = _made(path, "rigid_body", RigidBody, table.get("rigid_body"), {})
    made = tuple(
        _made(path, f"thrusters[{i}]", Thruster, thruster, _THRUSTER_DEFAULTS)
        for i, thruster in enumerate(thrusters)
    )
    names = [thruster.name for thruster in made]
    if len(set(names)) < len(names):
        raise VehicleError(f"{path}: two thrusters have one name")
    coefficients = _coefficients(path, path.stem, values)
    density = _number(path, "density_kg_m3", table.get("density_kg_m3", 1025.0))
    return Vehicle(
        name=name, rigid_body=body, coefficients=coefficients, thrusters=made,
        density_kg_m3=density,
    )  # fmt: skip


def speeds_missing(path: Path) -> list[str]:
    """Thrusters of a vehicle file that do not define what their speeds mean, in words."""
    lacking = []
    for thruster in _read(path).get("thrusters", []):
        missing = [field for field in _NEEDED_FOR_SPEEDS if field not in thruster]
        if missing:
            lacking.append(f"{thruster.get('name')} ({', '.join(missing)})")
    return lacking


def write_coefficients(path: Path, coefficients: Coefficients, details: Mapping[str, Any]) -> None:
    """Write a set of coefficients with their metadata."""
    data = {
        "format": COEFFICIENTS_FORMAT,
        "name": coefficients.name,
        "values": dict(coefficients.values),
        **details,
    }
    write_json(path, data)


def coefficients_from_file(path: Path) -> Coefficients:
    """Read a set of coefficients that `vehicle identify` wrote, or a table of names and values.

    Raises:
        VehicleError: the file cannot be read or holds something else.
    """
    table = _read(path)
    values = table.get("values", table)
    if table.get("format", COEFFICIENTS_FORMAT) != COEFFICIENTS_FORMAT:
        raise VehicleError(f"{path}: format {table['format']!r} is not {COEFFICIENTS_FORMAT!r}")
    if not isinstance(values, dict) or not values:
        raise VehicleError(f"{path}: holds no coefficients")
    found = _coefficients(path, str(table.get("name", path.stem)), values)
    driving = np.flatnonzero(np.maximum(np.diag(found.linear), np.diag(found.quadratic)) > 0)
    if len(driving):
        axis = FORCES[driving[0]]
        raise VehicleError(
            f"{path}: the damping of {axis} is positive, which would drive the vehicle: damping is "
            "negative"
        )
    return found


def _coefficients(path: Path, name: str, values: Mapping[str, Any]) -> Coefficients:
    named = {str(key): _number(path, str(key), value) for key, value in values.items()}
    try:
        return Coefficients(name=name, values=named)
    except VehicleError as error:
        raise VehicleError(f"{path}: {shown(str(error))}") from None


def _read(path: Path) -> dict[str, Any]:
    try:
        text = path.read_text(encoding="utf-8")
        table = json.loads(text) if path.suffix.lower() == ".json" else tomllib.loads(text)
    except OSError as error:
        raise VehicleError(f"{path}: cannot be read: {why(error)}") from None
    except (ValueError, RecursionError) as error:
        raise VehicleError(f"{path}: cannot be read: {one_line(error)}") from None
    if not isinstance(table, dict):
        raise VehicleError(f"{path}: holds no table")
    return table


def _made(path: Path, place: str, kind: Any, table: object, defaults: Mapping[str, Any]) -> Any:
    """A value of a dataclass from a table of its fields."""
    if not isinstance(table, dict):
        raise VehicleError(f"{path}: {place} is missing or no table")
    names = {field.name: field for field in fields(kind)}
    _known(path, f"{place}.", table, set(names))
    values = {**defaults, **table}
    for name, field in names.items():
        if name not in values and field.default is MISSING:
            raise VehicleError(f"{path}: {place}.{name} is missing")
    made: dict[str, Any] = {}
    for name, value in values.items():
        where = f"{place}.{name}"
        if isinstance(value, list):
            made[name] = tuple(_number(path, where, part) for part in value)
        elif name in ("name", "kind"):
            made[name] = value
        else:
            made[name] = _number(path, where, value)
        if ("tuple" in str(names[name].type)) != isinstance(value, list | tuple):
            raise VehicleError(f"{path}: {where} is {value!r}")
    try:
        return kind(**made)
    except (TypeError, ValueError) as error:
        raise VehicleError(f"{path}: {place}: {error}") from None


def _known(path: Path, place: str, table: Mapping[str, Any], names: set[str]) -> None:
    strange = next((key for key in table if key not in names), None)
    if strange is not None:
        raise VehicleError(f"{path}: {place}{shown(strange)} is not known; known: {sorted(names)}")


def _number(path: Path, place: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise VehicleError(f"{path}: {place} is {value!r:.60}, not a number")
    try:
        return float(value)
    except OverflowError:
        raise VehicleError(f"{path}: {place} is too large") from None
