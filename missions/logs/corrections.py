"""From what a vehicle logged to what a survey needs: clock, declination, tide, lever arms."""

import math
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from alice_survey.base.contents import shown
from alice_survey.base.errors import NavigationError
from alice_survey.base.frames import Array, Datum, rotation_from_attitude
from missions.logs.dive import DATED_AFTER_S, LoggedDive, Signal
from missions.logs.navigation_csv import csv_rows, utc_date
from missions.values.navigation import COLUMNS

_LONGEST_S = 1e9


@dataclass(frozen=True, kw_only=True)
class Corrections:
    """What to change of a log."""

    declination_deg: float = 0.0
    """Declination of the magnetic field, positive to the east: added to the heading."""
    tide: "float | Signal" = 0.0
    """Height of the water above the level that depths are to count from, metres; or (N, 1) of it
    on the clock of the log after `clock_offset_s`."""
    clock_offset_s: float = 0.0
    """Offset added to the times of the log."""
    lever_body_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Place on the body (FRD, from its origin) that the logged position and depth are of."""
    altitude_offset_m: float = 0.0
    """Offset added to altitudes: the height of the left port's glass above the sensor."""

    def __post_init__(self) -> None:
        numbers = [self.declination_deg, self.clock_offset_s, self.altitude_offset_m]
        numbers += [*self.lever_body_m]
        numbers += [self.tide] if isinstance(self.tide, float | int) else []
        if not all(math.isfinite(number) for number in numbers):
            raise NavigationError("declination, tide, offsets and lever arm need finite numbers")
        if abs(self.clock_offset_s) > _LONGEST_S:
            raise NavigationError(f"--clock-offset {self.clock_offset_s:g} s is more than 30 years")
        if abs(self.declination_deg) > 180:
            raise NavigationError(
                f"a declination of {self.declination_deg:g} degrees: give -180 to 180"
            )


def navigation_table(dive: LoggedDive, corrections: Corrections) -> tuple[Array, dict[str, Array]]:
    """Times, (N,), and the columns of the navigation CSV, (N,) each, at the positions' times.

    What is not known is NaN. Everything else than the position is interpolated onto its times, but
    not across gaps. Depth is from the level that the tide counts from.

    Raises:
        NavigationError: the lever arm needs an attitude that the log lacks, or the tide does not
            cover the dive.
    """
    logged_s = dive.position.time_s
    time_s = logged_s + corrections.clock_offset_s
    nothing = np.full((len(time_s), 1), np.nan)
    depth = nothing if dive.depth is None else dive.depth.at(logged_s)
    angles = np.full((len(time_s), 3), np.nan)
    if dive.attitude is not None:
        angles = dive.attitude.at(logged_s, turning=True)
        angles[:, 2] += corrections.declination_deg
    altitude = nothing if dive.altitude is None else dive.altitude.at(logged_s)
    if dive.altitude_slant:
        # The range along the body's down axis, seen upright: cos(roll) cos(pitch) is the axis' down
        # component (Fossen 2011, 2.18). Without an attitude it is not known.
        altitude = altitude * np.cos(np.deg2rad(angles[:, :2])).prod(axis=1, keepdims=True)
    place = _at_origin(dive, np.hstack([dive.position.values, depth]), angles, corrections)
    values = [
        place[:, 0],
        place[:, 1],
        place[:, 2] - _tide_at(time_s, corrections.tide),
        (angles[:, 0] + 180.0) % 360.0 - 180.0,
        angles[:, 1],
        angles[:, 2] % 360.0,
        altitude[:, 0] + corrections.altitude_offset_m,
    ]
    columns = dict(zip(COLUMNS, values, strict=False))
    for name in COLUMNS[len(values) :]:
        signal = dive.sigmas.get(name)
        columns[name] = nothing[:, 0] if signal is None else signal.at(logged_s)[:, 0]
    return time_s, columns


def _at_origin(
    dive: LoggedDive, place: Array, angles_deg: Array, corrections: Corrections
) -> Array:
    """Latitude, longitude and depth, (N, 3), of the body's origin."""
    lever = np.array(corrections.lever_body_m)
    if not lever.any():
        return place
    if dive.attitude is None:
        raise NavigationError("a lever arm needs an attitude, and the log has none")
    moved = np.full_like(place, np.nan)
    good = np.isfinite(place).all(axis=1) & np.isfinite(angles_deg).all(axis=1)
    if good.any():
        datum = Datum(*(float(value) for value in place[good][0, :2]))
        rotation = rotation_from_attitude(*np.deg2rad(angles_deg[good]).T)
        ned = datum.ned_from_geodetic(place[good]) - rotation.apply(lever)
        moved[good] = datum.geodetic_from_ned(ned)
    return moved


def _tide_at(time_s: Array, tide: "float | Signal") -> Array:
    if not isinstance(tide, Signal):
        return np.full(time_s.shape, float(tide))
    first, last = tide.time_s[0], tide.time_s[-1]
    if time_s[0] < first or time_s[-1] > last:
        raise NavigationError(
            f"{tide.source}: tides from {moment(first)} to {moment(last)} do not cover the dive, "
            f"{moment(float(time_s[0]))} to {moment(float(time_s[-1]))}"
        )
    heights: Array = np.interp(time_s, tide.time_s, tide.values[:, 0])
    return heights


def read_tide(text: str, *, dated: bool) -> "float | Signal":
    """A tide as typed: metres, or a CSV with `time_utc` (or `time_s`) and `height_m`.

    Args:
        text: a number, or a path.
        dated: whether the log's times are UTC: then the CSV's must be, too.

    Raises:
        NavigationError: it is neither, or the file cannot be used.
    """
    try:
        return float(text)
    except ValueError:
        path = Path(text)
    column = "time_utc" if dated else "time_s"
    try:
        names, rows = csv_rows(path)
    except NavigationError as error:
        raise NavigationError(f"--tide is neither metres nor a CSV: {error}") from None
    for name in (column, "height_m"):
        if name not in names:
            raise NavigationError(
                f"{path}: column {name} is missing; it has {shown(', '.join(names))}"
                + ("" if dated else " (the log's times have no date)")
            )
    times, heights = [], []
    for line, row in rows:
        try:
            cell = (row[column] or "").strip()
            times.append(utc_date(cell).timestamp() if dated else float(cell))
            heights.append(float(row["height_m"] or ""))
        except ValueError:
            raise NavigationError(
                f"{path} line {line}: {row[column]!r}, {row['height_m']!r}: not a time and a height"
            ) from None
    if not times or not np.all(np.isfinite([*times, *heights])):
        raise NavigationError(f"{path}: holds no tides, or heights that are not numbers")
    if not np.all(np.diff(times) > 0):
        raise NavigationError(f"{path}: the times must increase")
    return Signal(source=text, time_s=np.array(times), values=np.array(heights)[:, None])


def moment(time_s: float) -> str:
    """A time as people read it: a date where it is one."""
    if time_s < DATED_AFTER_S:
        return f"{time_s:.1f} s"
    return datetime.fromtimestamp(time_s, UTC).strftime("%Y-%m-%d %H:%M:%S")
