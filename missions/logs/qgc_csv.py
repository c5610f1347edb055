"""QGroundControl's CSV of telemetry as a logged dive: one row a second by the PC's own clock."""

import csv
import math
from collections import Counter
from collections.abc import Mapping
from datetime import tzinfo
from pathlib import Path

import numpy as np

from alice_survey.core.contents import shown
from alice_survey.core.errors import NavigationError
from missions.logs.dive import LoggedDive, cleaned, usable_positions
from missions.logs.navigation_csv import READINGS, find_zone, utc_date

_TIME = "Timestamp"
_PLACE = ("gps.lat", "gps.lon")
_DEPTH = "altitudeRelative"
_ANGLES = ("roll", "pitch", "heading")
_ALTITUDES = ("distanceSensor.rotationPitch270", "apmSubInfo.rangefinderDistance")
"""The first has metres; of the second ArduSub's RANGEFINDER message, metres."""


def read_qgc_csv(path: Path, requested: Mapping[str, str], time_zone: str) -> LoggedDive:
    """Read a CSV that QGroundControl wrote ("Save CSV log of telemetry data").

    Rows of another number of cells than the header are left out: until a battery is found, QGC
    writes fewer columns (qgroundcontrol issue 11763).

    Args:
        path: the file.
        requested: which column to use for depth or altitude.
        time_zone: of the PC.

    Raises:
        NavigationError: it is not such a file.
    """
    wrong = [role for role in requested if role not in ("depth", "altitude")]
    if wrong:
        raise NavigationError(f"--topic {wrong[0]}: of a CSV only depth and altitude can be chosen")
    zone = find_zone(time_zone)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            header, *rows = [row for row in csv.reader(file) if row] or [[]]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise NavigationError(f"{path}: cannot be read: {error}") from None
    header = [name.strip() for name in header]
    if set(READINGS) & set(header) and _TIME not in header:
        raise NavigationError(
            f"{path}: a navigation CSV already: give it to import-images --navigation"
        )
    if _TIME not in header:
        raise NavigationError(f"{path}: not QGroundControl's CSV: column {_TIME} is missing")
    lost: Counter[str] = Counter()
    whole = [row for row in rows if len(row) == len(header)]
    if len(whole) < len(rows):
        lost["rows of another number of cells than the header"] += len(rows) - len(whole)
    columns = {name: [row[i].strip() for row in whole] for i, name in enumerate(header)}
    time_s = np.array([_seconds(cell, zone) for cell in columns[_TIME]])

    def numbers(*names: str) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        return np.array([[_number(cell) for cell in columns[name]] for name in names]).T

    def chosen(role: str, *usual: str) -> str | None:
        name = requested.get(role)
        if name is not None and name not in columns:
            raise NavigationError(f"{path}: no column {name}; it has {shown(', '.join(header))}")
        return name or next((column for column in usual if column in columns), None)

    depth, altitude = chosen("depth", _DEPTH), chosen("altitude", *_ALTITUDES)
    have_place, have_angles = (
        all(name in columns for name in names) for names in (_PLACE, _ANGLES)
    )
    place = cleaned("gps.lat, gps.lon", time_s, numbers(*_PLACE), lost) if have_place else None
    nothing: Counter[str] = Counter()
    heights = None if altitude is None else numbers(altitude)
    if heights is not None:
        heights = np.where(heights > 0, heights, np.nan)
    return LoggedDive(
        kind="a CSV of QGroundControl",
        clock=f"the PC's clock, {time_zone}",
        dated=True,
        position=usable_positions(place, lost),
        depth=None if depth is None else cleaned(depth, time_s, -numbers(depth), nothing),
        attitude=cleaned("roll, pitch, heading", time_s, numbers(*_ANGLES), nothing)
        if have_angles
        else None,
        altitude=None if heights is None else cleaned(str(altitude), time_s, heights, nothing),
        altitude_slant=True,
        lost=dict(lost),
        notes=("depth is minus the height above home, which ArduSub puts at the surface",),
    )


def _seconds(cell: str, zone: tzinfo) -> float:
    try:
        return utc_date(cell, zone).timestamp()
    except ValueError:
        return math.nan


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return math.nan
