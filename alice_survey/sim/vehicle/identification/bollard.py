"""Thrust coefficients from a bollard pull: speeds, and the force of the moored vehicle.

The CSV has the columns `thruster`, `rpm` and `force_n`. Force and speed have one sign: positive
pushes the vehicle along the thruster's direction. Thrusters that pulled together at one speed are
joined by `+`, as in `port+starboard`, and share their coefficients.

The force is net of what the vehicle's model takes off at rest, such as thrust deduction.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.artefacts import read_csv
from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.propulsion import add_thrust
from alice_survey.sim.vehicle.vehicle import Vehicle


@dataclass(frozen=True, kw_only=True)
class Pull:
    """One reading."""

    thrusters: tuple[str, ...]
    rpm: float
    force_n: float


@dataclass(frozen=True, kw_only=True)
class ThrustCoefficient:
    """k_t of one way of one or several thrusters."""

    thrusters: tuple[str, ...]
    way: str
    """`forward` or `reverse`."""
    model: float
    """k_t before the calibration."""
    identified: float
    sigma: float
    """Standard deviation; NaN for a single reading."""
    readings: int

    @property
    def factor(self) -> float:
        """Ratio of identified to model value."""
        return self.identified / self.model


def read_pulls(path: Path) -> list[Pull]:
    """Read a bollard pull.

    Raises:
        VehicleError: the file cannot be read, lacks a column, has no rows, or holds a value that is
            not a number, or a force against its speed.
    """
    _, rows = read_csv(path, ("thruster", "rpm", "force_n"), fault=VehicleError)
    pulls = [_pull(path, line, row) for line, row in rows]
    if not pulls:
        raise VehicleError(f"{path}: has no rows")
    return pulls


def fit_pulls(pulls: Sequence[Pull], vehicle: Vehicle) -> list[ThrustCoefficient]:
    """k_t by least squares, forward and reverse, of every thruster that pulled.

    Raises:
        VehicleError: the vehicle has no such thruster, or one pulled alone and with others.
    """
    by_name = {thruster.name: thruster for thruster in vehicle.thrusters}
    groups = sorted({pull.thrusters for pull in pulls})
    seen: set[str] = set()
    found = []
    for group in groups:
        for name in group:
            if name not in by_name:
                raise VehicleError(f"{vehicle.name} has no thruster {name!r} that could pull")
            if name in seen:
                raise VehicleError(f"{name} pulled alone and with others: keep one kind of reading")
            seen.add(name)
        for way, sign in (("forward", 1.0), ("reverse", -1.0)):
            rows = [pull for pull in pulls if pull.thrusters == group and sign * pull.rpm > 0]
            if not rows:
                continue
            unit = np.array([_unit_force(vehicle, group, pull.rpm / 60.0) for pull in rows])
            force = np.array([pull.force_n for pull in rows])
            square = float(unit @ unit)
            value = float(unit @ force) / square
            rest = force - value * unit
            free = len(rows) - 1
            sigma = float(np.sqrt(rest @ rest / free / square)) if free else float("nan")
            models = [getattr(by_name[name], f"kt_{way}") for name in group]
            found.append(
                ThrustCoefficient(
                    thrusters=group,
                    way=way,
                    model=float(np.mean(models)),
                    identified=value,
                    sigma=sigma,
                    readings=len(rows),
                )
            )
    return found


def with_thrust(vehicle: Vehicle, found: Sequence[ThrustCoefficient]) -> Vehicle:
    """The vehicle with other k_t; k_q follows k_t^1.5, the figure of merit stays."""
    changed = []
    for thruster in vehicle.thrusters:
        values: dict[str, Any] = {}
        for one in found:
            if thruster.name in one.thrusters:
                ratio = one.identified / float(getattr(thruster, f"kt_{one.way}"))
                values[f"kt_{one.way}"] = one.identified
                values[f"kq_{one.way}"] = float(getattr(thruster, f"kq_{one.way}")) * ratio**1.5
        changed.append(replace(thruster, **values))
    return replace(vehicle, thrusters=tuple(changed))


def _unit_force(vehicle: Vehicle, group: tuple[str, ...], rps: float) -> float:
    """Force along their directions, N, of thrusters with k_t = 1 at rest in the water."""
    probe = replace(
        vehicle,
        thrusters=tuple(
            replace(t, kt_forward=1.0, kt_reverse=1.0, kq_forward=0.0, kq_reverse=0.0)
            for t in vehicle.thrusters
        ),
    )
    total = 0.0
    for i, thruster in enumerate(probe.thrusters):
        if thruster.name not in group:
            continue
        speeds, force = np.zeros(len(probe.thrusters)), np.zeros(6)
        speeds[i] = rps
        add_thrust(probe.plant.propulsion, speeds, np.zeros(6), force)
        direction: Array = np.array(thruster.direction_body)
        total += float(force[:3] @ direction)
    return total


def _pull(path: Path, line: int, row: dict[str, str]) -> Pull:
    values = []
    for name in ("rpm", "force_n"):
        try:
            value = float(row[name])
        except ValueError:
            value = float("nan")
        if not np.isfinite(value):
            raise VehicleError(f"{path} line {line}: {name} is {row[name]!r}, not a finite number")
        values.append(value)
    names = tuple(part.strip() for part in row["thruster"].split("+"))
    if not all(names):
        raise VehicleError(f"{path} line {line}: thruster is missing")
    rpm, force = values
    if rpm == 0 or rpm * force < 0:
        raise VehicleError(
            f"{path} line {line}: {force:g} N at {rpm:g} rpm: force and speed must have one sign"
        )
    return Pull(thrusters=names, rpm=rpm, force_n=force)
