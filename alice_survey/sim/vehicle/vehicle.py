"""A vehicle as a value: rigid body, coefficients and thrusters, and derived matrices.

Files that describe a vehicle, and files of identified coefficients.

A vehicle file is TOML or JSON with the fields of `Vehicle`: `name`, `rigid_body` as `RigidBody`,
`coefficients` by SNAME name, `thrusters` as a list of `Thruster`, `fins` as a list of `Fin`, `hull`
as `Hull`, `density_kg_m3`, `depth_rating_m`, `battery_wh`, `hotel_w`. Of a thruster only name,
place and direction are needed where logs give thrusts; speeds need its diameter and k_t too.

Instead of a hull, `geometry` names a shape of shapes.toml with its hull and the water inside; and
`coefficient_sets`, instead of coefficients, those of such a vehicle: the paper's tables, and
`computed` from the shape.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import BeforeValidator, Field, TypeAdapter, ValidationError

from alice_survey.core.artefacts import write_json
from alice_survey.core.config import VEHICLE_FILES, Config
from alice_survey.core.contents import as_line, first_fault, one_line, ordinary_file, parse_toml
from alice_survey.core.errors import VehicleError, file_faults
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.coefficients import (
    CALIBRATED,
    CFD,
    COMPUTED,
    ESTIMATED,
    FORCES,
    MOTIONS,
    SHAPES,
    Coefficients,
    kind_of,
)
from alice_survey.sim.vehicle.dynamics import Body, Plant
from alice_survey.sim.vehicle.fins import Fin, pack_fins
from alice_survey.sim.vehicle.propulsion import FILE_PART, Thruster, pack
from alice_survey.sim.vehicle.sea import GRAVITY


@dataclass(frozen=True, kw_only=True)
class Hull:
    """The reach of a hull; metres in the body, from the centre of buoyancy.

    What hangs below it, DVL and ports, is placed by a survey's settings.
    """

    __pydantic_config__ = FILE_PART

    profile_body_m: tuple[tuple[float, float, float], ...]
    """Points in the plane of symmetry, from the nose along the keel to the tail, between which the
    lower side of the hull runs straight or inside."""
    half_breadth_m: float
    """Half width to the outer edge of attachments on either side."""

    @property
    def nose_m(self) -> float:
        """Extent ahead of the origin."""
        return max(point[0] for point in self.profile_body_m)

    @property
    def tail_m(self) -> float:
        """Extent astern of the origin."""
        return -min(point[0] for point in self.profile_body_m)

    @cached_property
    def points_body_m(self) -> Array:
        """(P, 3) the profile, for compiled code."""
        return np.array(self.profile_body_m, dtype=np.float64)


POINT = Hull(profile_body_m=((0.0, 0.0, 0.0),), half_breadth_m=0.0)
"""Hull of a vehicle whose shape is not given."""


@dataclass(frozen=True, kw_only=True)
class RigidBody:
    """Mass and its distribution; lengths from the centre of buoyancy, the body's origin."""

    __pydantic_config__ = FILE_PART

    dry_kg: float
    """Mass in air, drained."""
    buoyancy_kg: float
    """Mass of the water that the drained vehicle displaces."""
    entrained_kg: float
    """Water inside the hull that moves along; its weight is carried by its own buoyancy."""
    cg_body_m: tuple[float, float, float]
    """Centre of gravity of the drained vehicle."""
    inertia_kg_m2: tuple[float, float, float]
    """Inertia of the drained vehicle about its centre of gravity, roll, pitch, yaw."""
    entrained_cg_body_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    entrained_inertia_kg_m2: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """About its own centre of gravity."""

    @cached_property
    def mass_matrix(self) -> Array:
        """M_RB, (6, 6), about the origin (Fossen 2011, 3.44), with the water inside."""
        total = np.zeros((6, 6))
        for mass, cg, inertia in (
            (self.dry_kg, self.cg_body_m, self.inertia_kg_m2),
            (self.entrained_kg, self.entrained_cg_body_m, self.entrained_inertia_kg_m2),
        ):
            s = _cross_matrix(cg)
            total[:3, :3] += mass * np.eye(3)
            total[:3, 3:] -= mass * s
            total[3:, :3] += mass * s
            total[3:, 3:] += np.diag(inertia) - mass * s @ s
        return total

    @cached_property
    def displaced(self) -> Array:
        """(6, 3) momentum, about the origin, of the displaced water by its velocity."""
        inside = self.entrained_kg
        return np.vstack([
            (self.buoyancy_kg + inside) * np.eye(3),
            inside * _cross_matrix(self.entrained_cg_body_m),
        ])  # fmt: skip


def _cross_matrix(a: tuple[float, float, float]) -> Array:
    x, y, z = a
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


@dataclass(frozen=True, kw_only=True, eq=False)
class Vehicle:
    """All inputs of the equations of motion of a vehicle."""

    name: str
    rigid_body: RigidBody
    coefficients: Coefficients
    thrusters: tuple[Thruster, ...]
    fins: tuple[Fin, ...] = ()
    """Drives of fins: one or more surfaces each, that turn together."""
    hull: Hull = POINT
    """Extent of the hull; its origin alone for a vehicle that is not flown."""
    density_kg_m3: float = 1025.0
    depth_rating_m: float | None = None
    battery_wh: float | None = None
    hotel_w: float | None = None
    """Everything but thrusters and strobes."""

    @cached_property
    def mass(self) -> Array:
        """M = M_RB + M_A, (6, 6).

        Raises:
            VehicleError: it is not positive definite.
        """
        mass: Array = self.rigid_body.mass_matrix + self.coefficients.added_mass
        minimum = float(np.linalg.eigvalsh(mass)[0])
        if minimum <= 0:
            raise VehicleError(
                f"the inertia matrix of {self.name} with {self.coefficients.name!r} coefficients "
                f"has the eigenvalue {minimum:.3g}: an added mass has the wrong sign"
            )
        return mass

    @cached_property
    def plant(self) -> Plant:
        """For compiled code."""
        rigid, kinds = self.rigid_body, self.coefficients
        displaced_kg = rigid.buoyancy_kg + rigid.entrained_kg
        inertia = rigid.mass_matrix[:, :3]
        body = Body(
            mass=np.ascontiguousarray(self.mass),
            mass_inverse=np.ascontiguousarray(np.linalg.inv(self.mass)),
            in_current=np.ascontiguousarray(np.hstack([inertia, inertia - rigid.displaced])),
            linear=kinds.linear,
            quadratic=kinds.quadratic,
            quadratic_back=kinds.quadratic_back,
            lift=kinds.lift,
            weight_n=rigid.dry_kg * GRAVITY,
            buoyancy_n=rigid.buoyancy_kg * GRAVITY,
            cg=np.array(rigid.cg_body_m),
        )
        return Plant(
            body,
            pack(self.thrusters, self.density_kg_m3, displaced_kg),
            pack_fins(self.fins, self.density_kg_m3),
        )

    @property
    def actuators(self) -> int:
        """Number of thrusters and drives of fins."""
        return len(self.thrusters) + len(self.fins)

    @cached_property
    def configuration_matrix(self) -> Array:
        """B, (6, n): wrench = B thrust; the arms, and the torque of propellers at forward speed."""
        columns = []
        for thruster in self.thrusters:
            direction = np.array(thruster.direction_body)
            moment = np.cross(thruster.position_body_m, direction)
            kept = thruster.kt_forward * (1.0 - thruster.thrust_deduction)
            reaction = thruster.diameter_m * thruster.kq_forward / kept
            columns.append([*direction, *(moment - thruster.handedness * reaction * direction)])
        return np.array(columns, np.float64).reshape(-1, 6).T

    def with_coefficients(self, coefficients: Coefficients) -> "Vehicle":
        """The same vehicle with another set."""
        return replace(self, coefficients=coefficients)

    def health_of(self, left: Mapping[str, float]) -> Array:
        """Share of its greatest speed squared that each thruster has left, (n,).

        Args:
            left: by thruster, 0 failed to 1 intact; intact when not named.

        Raises:
            VehicleError: a thruster is not known.
        """
        names = [thruster.name for thruster in self.thrusters]
        for name in left:
            if name not in names:
                raise VehicleError(
                    f"{self.name} has no thruster {name!r}; it has {', '.join(names)}"
                )
        return np.array([left.get(name, 1.0) for name in names])

    def without(self, thrusters: Sequence[str]) -> "Vehicle":
        """The same vehicle with some thrusters taken off."""
        return self.weaken(dict.fromkeys(thrusters, 0.0))

    def weaken(self, left: Mapping[str, float]) -> "Vehicle":
        """The same vehicle with weaker thrusters, and without those that have failed.

        Args:
            left: as in `health_of`.

        Raises:
            VehicleError: a thruster is not known.
        """
        pairs = zip(self.thrusters, self.health_of(left).tolist(), strict=True)
        kept = tuple(
            replace(t, most_rps=t.most_rps * share**0.5) for t, share in pairs if share > 0
        )
        return replace(self, thrusters=kept)


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
_MERIT = 0.07 / 0.4566**1.5
"""k_q over k_t^1.5 of a Wageningen B propeller with three blades, blade area ratio 0.718, pitch 1,
in water at rest (k_t 0.4566, k_q 0.0700; T. I. Fossen's MSS toolbox, remus100): 0.227. Where no
torque of a propeller is known: inferred to be as good as that one, both ways. Momentum theory asks
for 0.090 at least; Stonefish's k_q of 0.01 for a k_t of 0.698 is 0.017."""
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


_OF_VEHICLE = [one.name for one in fields(Vehicle)]


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
    own = {name: getattr(found, name) for name in _VehicleFile.model_fields if name in _OF_VEHICLE}
    own |= {"name": found.name or path.stem}
    vehicle = Vehicle(**own | {"coefficients": _choose_set(path, found, coefficients)})
    _check_body(path, vehicle)
    return vehicle


def _check_body(path: Path, vehicle: Vehicle) -> None:
    """Refuse a body that is wider spread than its hull, or that nothing holds upright.

    Of masses between two ends those at the ends have the greatest inertia (Popoviciu); the hull is
    no taller than it is long.
    """
    body, hull = vehicle.rigid_body, vehicle.hull
    reach_m = np.hypot(hull.nose_m + hull.tail_m, 2.0 * hull.half_breadth_m) / 2.0
    max_kg_m2 = body.dry_kg * reach_m**2
    if 0.0 < max_kg_m2 < max(body.inertia_kg_m2):
        raise VehicleError(
            f"{path}: rigid_body.inertia_kg_m2 is {max(body.inertia_kg_m2):g}: {body.dry_kg:g} kg "
            f"within the hull have at most {max_kg_m2:.3g}"
        )
    arms = [np.cross(each.position_body_m, each.direction_body) for each in vehicle.thrusters]
    is_level = np.any(np.array(arms).reshape(-1, 3), axis=0)[:2].all()
    if body.cg_body_m[2] < 0.0 and not is_level:
        raise VehicleError(
            f"{path}: rigid_body.cg_body_m is {-body.cg_body_m[2]:g} m above the centre of "
            "buoyancy: it turns over, as no thrusters hold it level; give 0 or more, down"
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
    return _coefficients(path, str(table.get("name", path.stem)), values)


def _coefficients(path: Path, name: str, values: Mapping[str, float]) -> Coefficients:
    try:
        found = Coefficients(name=name, values=values)
    except VehicleError as error:
        raise VehicleError(f"{path}: {as_line(str(error))}") from None
    for key, value in values.items():
        damps = kind_of(key) not in ("dot", "lift")
        if damps and value > 0 and FORCES.index(key[0]) == MOTIONS.index(key[2]):
            raise VehicleError(f"{path}: {key} is {value:g}: damping is negative, else it drives")
    return found


def read_table(path: Path) -> dict[str, Any]:
    """Read a TOML file, or a JSON file by its suffix.

    Raises:
        VehicleError: the file cannot be read or holds no table.
    """
    return _table_of(path, _text_of(path))


def _text_of(path: Path) -> str:
    with file_faults(path, VehicleError):
        return ordinary_file(path).read_text(encoding="utf-8")


def _table_of(path: Path, text: str) -> dict[str, Any]:
    try:
        table = json.loads(text) if path.suffix.lower() == ".json" else parse_toml(text)
    except (ValueError, RecursionError) as error:
        raise VehicleError(f"{path}: cannot be read: {one_line(error)}") from None
    if not isinstance(table, dict):
        raise VehicleError(f"{path}: holds no table")
    return table


def parse_table(path: Path | str, kind: type[_Kind], table: object) -> _Kind:
    """The value of a kind that a table read from a file holds.

    Raises:
        VehicleError: a field is missing, is not known, or has a wrong value.
    """
    try:
        return TypeAdapter(kind).validate_python(table)
    except ValidationError as error:
        fault = first_fault(error, "the table", getattr(kind, "model_fields", ()))
        raise VehicleError(f"{path}: {fault}") from None
