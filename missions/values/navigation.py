"""The vehicle's own estimate of where it was: the navigation log of a flight."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from alice_survey.core.artefacts import write_csv
from alice_survey.core.frames import Array, Datum

COLUMNS = (
    "latitude_deg", "longitude_deg", "depth_m", "roll_deg", "pitch_deg", "heading_deg",
    "altitude_m", "sigma_horizontal_m", "sigma_depth_m", "sigma_attitude_deg", "sigma_heading_deg",
    "sigma_altitude_m",
)  # fmt: skip
"""Columns of a navigation CSV, after the time."""
TRIGGER_LOG = ("time_s", "time_utc", "image", "number", "camera", "station", "line")
"""Columns of tables that say when pictures were taken."""
_DECIMALS = (10, 10, 5, 6, 6, 6, 5, 6, 6, 6, 6, 6)
"""Decimals of `COLUMNS`; positions to 0.01 mm."""


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
    """Write `navigation.csv` of a flight; positions in latitude and longitude."""
    geodetic = datum.geodetic_from_ned(log.position_ned)
    roll, pitch, heading = np.rad2deg(log.attitude_rad).T
    columns = (
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
    )
    times = [f"{time_s:.6f}" for time_s in log.time_s.tolist()]
    write_navigation_rows(path, times, dict(zip(COLUMNS, columns, strict=True)))


def write_navigation_rows(
    path: Path, times: Sequence[str], columns: Mapping[str, Array], time_column: str = "time_s"
) -> None:
    """Write a navigation CSV.

    Args:
        path: file to write.
        times: (N,) as text.
        columns: `COLUMNS`, (N,) each; NaN becomes an empty cell.
        time_column: `time_s`, or `time_utc` where times are dates.
    """
    texts = [
        ["" if math.isnan(value) else f"{value:.{decimals}f}" for value in columns[name].tolist()]
        for name, decimals in zip(COLUMNS, _DECIMALS, strict=True)
    ]
    write_csv(path, (time_column, *COLUMNS), zip(times, *texts, strict=True))
