"""Tides: how high the water stood above the level that depths are to count from."""

import math
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from alice_survey.core.artefacts import read_csv
from alice_survey.core.contents import shown
from alice_survey.core.errors import NavigationError
from alice_survey.core.frames import Array
from missions.logs.dive import DATED_AFTER_S, Signal
from missions.logs.navigation_csv import utc_date


def tide_at(time_s: Array, tide: float | Signal) -> Array:
    """Heights, (N,) metres, of a tide at times.

    Raises:
        NavigationError: it does not cover them.
    """
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


def read_tide(text: str, *, dated: bool) -> float | Signal:
    """A tide as typed: metres, or a CSV with `time_utc` (or `time_s`) and `height_m`.

    Args:
        text: a number, or a path.
        dated: whether the log's times are UTC: then the CSV's must be, too.

    Raises:
        NavigationError: it is neither, or the file cannot be used.
    """
    try:
        metres = float(text)
    except ValueError:
        path = Path(text)
    else:
        if not math.isfinite(metres):
            raise NavigationError(f"--tide {text}: give a finite number")
        return metres
    column = "time_utc" if dated else "time_s"
    try:
        names, rows = read_csv(path)
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
            cell = row[column]
            times.append(utc_date(cell).timestamp() if dated else float(cell))
            heights.append(float(row["height_m"]))
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
