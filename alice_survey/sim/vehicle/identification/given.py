"""What the commands `vehicle identify` and `vehicle replay` are given: vehicle, logs and values."""

from collections.abc import Sequence
from pathlib import Path

from alice_survey.core.errors import VehicleError
from alice_survey.sim.vehicle.files import coefficients_from_file, vehicle_from
from alice_survey.sim.vehicle.identification.foreign import read_column_map, read_foreign_log
from alice_survey.sim.vehicle.log import VehicleLog, read_vehicle_log
from alice_survey.sim.vehicle.vehicle import Vehicle


def given_vehicle(name: str, coefficients: str | None) -> Vehicle:
    """A vehicle by its name or file, with a set of coefficients by its name or file."""
    if coefficients is None or not Path(coefficients).suffix:
        return vehicle_from(name) if coefficients is None else vehicle_from(name, coefficients)
    return vehicle_from(name).with_coefficients(coefficients_from_file(Path(coefficients)))


def given_log(path: Path, columns: Path | None) -> VehicleLog:
    """A log in the documented columns, or in those that a map gives a meaning."""
    if columns is None:
        return read_vehicle_log(path)
    return read_foreign_log(path, read_column_map(columns))


def given_values(pairs: Sequence[str]) -> dict[str, float]:
    """Numbers by name.

    Raises:
        VehicleError: a pair is not `NAME=VALUE`.
    """
    values = {}
    for pair in pairs:
        name, _, value = pair.partition("=")
        try:
            values[name.strip()] = float(value)
        except ValueError:
            raise VehicleError(f"{pair!r} is not NAME=VALUE") from None
    return values
