"""Files that describe a vehicle, and files of identified coefficients.

A vehicle file is TOML or JSON with the fields of `Vehicle`: `name`, `rigid_body` as `RigidBody`,
`coefficients` by SNAME name, `thrusters` as a list of `Thruster`, `fins` as a list of `Fin`, `hull`
as `Hull`, `density_kg_m3`, `depth_rating_m`, `battery_wh`, `hotel_w`. Of a thruster only name,
place and direction are needed where logs give thrusts; speeds need its diameter and k_t too.

Instead of a hull, `geometry` names a shape of shapes.toml with its hull and the water inside; and
`coefficient_sets`, instead of coefficients, those of such a vehicle: the paper's tables, and
`computed` from the shape.
"""

import json
import tomllib
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import BeforeValidator, Field, TypeAdapter, ValidationError

from alice_survey.core.artefacts import write_json
from alice_survey.core.config import VEHICLE_FILES, Config
from alice_survey.core.contents import as_line, one_line
from alice_survey.core.errors import VehicleError, why
from alice_survey.sim.vehicle.coefficients import FORCES, Coefficients
from alice_survey.sim.vehicle.fins import Fin
from alice_survey.sim.vehicle.paper_tables import CALIBRATED, CFD, COMPUTED, ESTIMATED, SHAPES
from alice_survey.sim.vehicle.propulsion import Thruster
from alice_survey.sim.vehicle.vehicle import POINT, Hull, RigidBody, Vehicle

_Kind = TypeVar("_Kind")
COEFFICIENTS_FORMAT = "alice-survey coefficients 1"
_DENSITY = 1025.0
"""Of sea water, kg/m^3."""
_THRUSTER_DEFAULTS: Mapping[str, Any] = {
    "kind": "open", "diameter_m": 1.0, "kt_forward": 1.0, "kt_reverse": 1.0, "kq_forward": 0.0,
    "kq_reverse": 0.0, "handedness": 1, "most_rps": 1e3, "dead_band_rps": 0.0,
    "time_constant_s": 0.1,
}  # fmt: skip
"""Defaults of a thruster in a file: its thrusts are given, its speeds have no meaning."""
_DESCRIBED = {
    path.stem: path for path in sorted((Path(__file__).parent / "fleet_files").glob("*.toml"))
}
"""Files of the vehicles that are known by name."""
PAPER_SETS = {"estimated": ESTIMATED, "cfd": CFD, "calibrated": CALIBRATED}
OWN_SET = "calibrated"
"""Stands for a vehicle's own coefficients where none are named."""
SETS = (*PAPER_SETS, "computed")
"""Names of the sets of coefficients of vehicles of a geometry."""
_MERIT = 0.07 / 0.4566**1.5
"""k_q over k_t^1.5 of a Wageningen B propeller with three blades, blade area ratio 0.718, pitch 1,
in water at rest (k_t 0.4566, k_q 0.0700; T. I. Fossen's MSS toolbox, remus100): 0.227. Where no
torque of a propeller is known: inferred to be as good as that one, both ways. Momentum theory asks
for 0.090 at least; Stonefish's k_q of 0.01 for a k_t of 0.698 is 0.017."""
_MAX_FAULTS = 3
"""Faults of a file that one message names."""
_NEEDED_FOR_SPEEDS = ("diameter_m", "kt_forward", "kt_reverse", "time_constant_s")
_NEEDED_TO_FLY = (*_NEEDED_FOR_SPEEDS, "most_rps")


def usual_kq(kt: float) -> float:
    """k_q of a propeller of this k_t that is as good as the one above."""
    return float(_MERIT * kt**1.5)


def _with_defaults(table: object) -> object:
    if not isinstance(table, dict):
        return table
    found = {**_THRUSTER_DEFAULTS, **table}
    if "diameter_m" in table:  # else thrusts are given, and torques are not known
        for way in ("forward", "reverse"):
            kt = table.get(f"kt_{way}")
            if isinstance(kt, int | float) and kt > 0 and f"kq_{way}" not in table:
                found[f"kq_{way}"] = usual_kq(kt)
    return found


class _VehicleFile(Config):
    """Contents of a vehicle file."""

    name: str | None = None
    geometry: str | None = None
    rigid_body: RigidBody
    coefficients: dict[str, float] = Field(default_factory=dict)
    coefficient_sets: tuple[Literal["estimated", "cfd", "calibrated", "computed"], ...] = ()
    thrusters: tuple[Annotated[Thruster, BeforeValidator(_with_defaults)], ...] = ()
    fins: tuple[Fin, ...] = ()
    hull: Hull = POINT
    density_kg_m3: float = _DENSITY
    depth_rating_m: float | None = Field(None, gt=0, le=12_000)
    battery_wh: float | None = Field(None, gt=0)
    hotel_w: float | None = Field(None, ge=0)


def vehicle_from(name_or_file: str, coefficients: str = OWN_SET) -> Vehicle:
    """A vehicle known by name, or described by a TOML or JSON file.

    Args:
        name_or_file: of the vehicle.
        coefficients: the set of a vehicle known by name; a file has one of its own.

    Raises:
        VehicleError: neither is known, the file does not describe a vehicle, or another set than
            its own is named.
    """
    path = Path(name_or_file)
    if path.suffix.lower() in VEHICLE_FILES:
        return vehicle_from_file(path, coefficients)
    if name_or_file in _DESCRIBED:
        return vehicle_from_file(_DESCRIBED[name_or_file], coefficients)
    known = ", ".join(_DESCRIBED)
    raise VehicleError(f"vehicle {name_or_file!r} is not known; known: {known}, or a TOML file")


def known_vehicles() -> list[str]:
    """Names of the vehicles that are known."""
    return list(_DESCRIBED)


def vehicle_from_file(path: Path, coefficients: str = OWN_SET) -> Vehicle:
    """Read a vehicle file.

    Args:
        path: TOML or JSON.
        coefficients: one of the file's sets.

    Raises:
        VehicleError: the file cannot be read, or lacks a field, has one that is not known or makes
            no sense, or has no such set.
    """
    return _vehicle_of(path, _text_of(path), coefficients)


@lru_cache(maxsize=32)
def _vehicle_of(path: Path, text: str, coefficients: str) -> Vehicle:
    """The vehicle of a file's text; kept, as it is asked for often."""
    found = parse_table(path, _VehicleFile, _with_shape(_table_of(path, text)))
    for what, parts in (("thrusters", found.thrusters), ("fins", found.fins)):
        names = [part.name for part in parts]
        if len(set(names)) < len(names):
            raise VehicleError(f"{path}: two {what} have one name")
    return Vehicle(
        name=found.name or path.stem,
        rigid_body=found.rigid_body,
        coefficients=_choose_set(path, found, coefficients),
        thrusters=found.thrusters,
        fins=found.fins,
        hull=found.hull,
        density_kg_m3=found.density_kg_m3,
        depth_rating_m=found.depth_rating_m,
        battery_wh=found.battery_wh,
        hotel_w=found.hotel_w,
    )


def _with_shape(table: dict[str, Any]) -> dict[str, Any]:
    """The contents of a file with the hull and the water inside that follow from its geometry."""
    named, body = table.get("geometry"), table.get("rigid_body")
    if named is None:
        return table
    shape = SHAPES.get(str(named))
    if shape is None:
        raise VehicleError(
            f"geometry {as_line(str(named))!r} is not known; known: {', '.join(SHAPES)}: leave "
            "it out, and give [hull] and [coefficients]"
        )
    if not isinstance(body, dict):
        return table  # whose faults are named elsewhere
    return {"hull": shape["hull"], **table, "rigid_body": {**shape["rigid_body"], **body}}


def _choose_set(path: Path, found: _VehicleFile, name: str) -> Coefficients:
    """Coefficients of a file: its own, or one of its sets."""
    if not found.coefficient_sets:
        if name != OWN_SET:
            raise VehicleError(
                f"{found.name or path.stem} has its own coefficients, not {name!r}: leave these "
                "out, or name a file of others"
            )
        return _coefficients(path, path.stem, found.coefficients)
    sets: tuple[str, ...] = found.coefficient_sets
    chosen = name if name in sets else (sets[0] if name == OWN_SET else None)
    if chosen is None:
        raise VehicleError(f"coefficients {name!r} are not known; known: {', '.join(sets)}")
    if chosen in PAPER_SETS:
        return PAPER_SETS[chosen]
    if found.geometry is None:
        raise VehicleError(f"{path}: coefficients are {chosen} from a shape: name its geometry")
    return COMPUTED[found.geometry]


def vehicle_to_fly(name_or_file: str, coefficients: str = OWN_SET) -> Vehicle:
    """A vehicle as `vehicle_from`, of which all is known that flying takes.

    Raises:
        VehicleError: as there; or a file leaves out what its thrusters can.
    """
    vehicle, path = vehicle_from(name_or_file, coefficients), Path(name_or_file)
    if path.suffix.lower() in VEHICLE_FILES:
        lacking = speeds_missing(path, _NEEDED_TO_FLY)
        if lacking or not vehicle.thrusters:
            what = f"of thrusters {'; '.join(lacking)}" if lacking else "thrusters"
            raise VehicleError(f"{path}: to be flown it needs {what}")
    return vehicle


def speeds_missing(path: Path, needed: Sequence[str] = _NEEDED_FOR_SPEEDS) -> list[str]:
    """Thrusters of a vehicle file that do not define what their speeds mean, in words."""
    lacking = []
    for thruster in read_table(path).get("thrusters", []):
        missing = [field for field in needed if field not in thruster]
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
    table = read_table(path)
    values = table.get("values", table)
    if table.get("format", COEFFICIENTS_FORMAT) != COEFFICIENTS_FORMAT:
        raise VehicleError(f"{path}: format {table['format']!r} is not {COEFFICIENTS_FORMAT!r}")
    values = parse_table(path, dict[str, float], values)
    if not values:
        raise VehicleError(f"{path}: holds no coefficients")
    found = _coefficients(path, str(table.get("name", path.stem)), values)
    ways = (found.linear, found.quadratic, found.quadratic_back)
    driving = np.flatnonzero(np.max([np.diag(way) for way in ways], axis=0) > 0)
    if len(driving):
        axis = FORCES[driving[0]]
        raise VehicleError(
            f"{path}: the damping of {axis} is positive, which would drive the vehicle: damping is "
            "negative"
        )
    return found


def _coefficients(path: Path, name: str, values: Mapping[str, float]) -> Coefficients:
    try:
        return Coefficients(name=name, values=values)
    except VehicleError as error:
        raise VehicleError(f"{path}: {as_line(str(error))}") from None


def read_table(path: Path) -> dict[str, Any]:
    """Read a TOML file, or a JSON file by its suffix.

    Raises:
        VehicleError: the file cannot be read or holds no table.
    """
    return _table_of(path, _text_of(path))


def _text_of(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise VehicleError(f"{path}: cannot be read: {why(error)}") from None
    except ValueError as error:
        raise VehicleError(f"{path}: cannot be read: {one_line(error)}") from None


def _table_of(path: Path, text: str) -> dict[str, Any]:
    try:
        table = json.loads(text) if path.suffix.lower() == ".json" else tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise VehicleError(f"{path}: cannot be read: {one_line(error)}") from None
    if not isinstance(table, dict):
        raise VehicleError(f"{path}: holds no table")
    return table


def parse_table(path: Path, kind: type[_Kind], table: object) -> _Kind:
    """The value of a kind that a table read from a file holds.

    Raises:
        VehicleError: a field is missing, is not known, or has a wrong value.
    """
    try:
        return TypeAdapter(kind).validate_python(table)
    except ValidationError as error:
        faults = [
            f"{as_line('.'.join(map(str, fault['loc']))) or 'the table'}: {fault['msg']}"
            for fault in error.errors()[:_MAX_FAULTS]
        ]
        raise VehicleError(f"{path}: {'; '.join(faults)}") from None
