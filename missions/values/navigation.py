"""The vehicle's own estimate of where it was: the navigation log of a flight."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from alice_survey.base.artefacts import write_csv
from alice_survey.base.frames import Array, Datum

NAVIGATION_COLUMNS = (
    "time_s", "latitude_deg", "longitude_deg", "depth_m", "roll_deg", "pitch_deg", "heading_deg",
    "altitude_m", "sigma_horizontal_m", "sigma_depth_m", "sigma_attitude_deg", "sigma_heading_deg",
    "sigma_altitude_m",
)  # fmt: skip
_DECIMALS = (6, 10, 10, 5, 6, 6, 6, 5, 6, 6, 6, 6, 6)


@dataclass(frozen=True, kw_only=True, eq=False)
class BelievedNavigation:
    """Estimated position and attitude of the body origin, and altitude of the left port's glass.

    All (T,) but `position_ned` and `attitude_rad`, (T, 3).
    """

    time_s: Array
    position_ned: Array
    attitude_rad: Array
    """Roll, pitch, heading."""
    altitude_m: Array
    """Altitude; NaN while the DVL has no bottom lock."""
    sigma_horizontal_m: Array
    """Sigma of north and of east each."""
    sigma_depth_m: Array
    sigma_attitude_rad: Array
    """Sigma of roll and of pitch each."""
    sigma_heading_rad: Array
    sigma_altitude_m: Array


def write_navigation(path: Path, log: BelievedNavigation, datum: Datum) -> None:
    """Write `navigation.csv`; positions in latitude and longitude to 0.01 mm; NaN as nothing."""
    geodetic = datum.geodetic_from_ned(log.position_ned)
    roll, pitch, heading = np.rad2deg(log.attitude_rad).T
    table = np.column_stack(
        [
            log.time_s,
            geodetic[:, 0],
            geodetic[:, 1],
            log.position_ned[:, 2],
            roll,
            pitch,
            heading % 360.0,
            log.altitude_m,
            log.sigma_horizontal_m,
            log.sigma_depth_m,
            np.rad2deg(log.sigma_attitude_rad),
            np.rad2deg(log.sigma_heading_rad),
            log.sigma_altitude_m,
        ]
    )
    write_csv(path, NAVIGATION_COLUMNS, (_texts(row) for row in table.tolist()))


def _texts(row: list[float]) -> list[str]:
    pairs = zip(row, _DECIMALS, strict=True)
    return ["" if math.isnan(value) else f"{value:.{decimals}f}" for value, decimals in pairs]
