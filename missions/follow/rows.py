"""Rows of navigation as they come: what one is, its order in time, and packets as text.

A row holds seconds and then `READINGS`: latitude, longitude, depth, roll, pitch, heading, altitude,
NaN where it is not known. Altitudes are of the left port's glass, all else of the body's origin, as
in a navigation CSV.
"""

import json
import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from alice_survey.core.frames import Array, Datum
from missions.logs.dive import finite_number
from missions.logs.navigation_csv import READINGS, RowParser, find_zone

ROW = ("time_s", *READINGS)
"""Columns of a row."""
TIME, LATITUDE, LONGITUDE, DEPTH, ROLL, PITCH, HEADING, ALTITUDE = range(len(ROW))
MAX_BREAK_S = 3600.0
"""After a longer break a log goes on as another one: no pictures are expected in between."""
_SURE = 10
"""So many rows one after the other that go back, or far ahead, are another clock, and not late."""
_SHORT = {"roll": "roll_deg", "pitch": "pitch_deg", "heading": "heading_deg",
          "latitude": "latitude_deg", "longitude": "longitude_deg"}  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class Piece:
    """Rows that came at once."""

    rows: Array
    """(N, 8) of `ROW`."""
    starts: bool = False
    """Whether another log begins here: the file was replaced, or the clock set."""


class NavigationSource(Protocol):
    """Something that navigation comes from."""

    name: str
    """What it is, in words."""
    left_out: Counter[str]
    """What could not be used, by reason."""

    def poll(self, wall_s: float) -> list[Piece]:
        """What has come since the last call, at a time of this machine's steady clock.

        Raises:
            NavigationError: nothing more can come.
        """
        ...

    def close(self) -> None:
        """Let go of files and sockets."""
        ...


class SteadyTimes:
    """Lets rows pass whose times increase; finds clocks that were set and logs that began again."""

    def __init__(self, left_out: Counter[str]) -> None:
        """Nothing has come yet.

        Args:
            left_out: counts what is left out, by reason; is added to.
        """
        self.left_out = left_out
        self._last_s: float | None = None
        self._aside: list[Array] = []

    def passed(self, piece: Piece) -> list[Piece]:
        """The rows of a piece in order; what begins again is a piece of its own."""
        rows = piece.rows
        times = rows[:, TIME]
        good = np.isfinite(times)
        if not good.all():
            self.left_out["the time is not a number"] += int((~good).sum())
            rows, times = rows[good], times[good]
        if piece.starts:
            self._drop_aside()
            self._last_s = None
        if not len(rows):
            return [Piece(rows=rows, starts=True)] if piece.starts else []
        steps = np.diff(times, prepend=times[0] - 1.0 if self._last_s is None else self._last_s)
        if np.all((steps > 0) & (steps <= MAX_BREAK_S)):
            self._drop_aside()
            self._last_s = float(times[-1])
            return [Piece(rows=rows, starts=piece.starts)]
        return self._one_by_one(rows, piece.starts)

    def _one_by_one(self, rows: Array, starts: bool) -> list[Piece]:
        pieces: list[tuple[bool, list[Array]]] = [(starts, [])]
        for row in rows:
            time = float(row[TIME])
            step = 1.0 if self._last_s is None else time - self._last_s
            if 0.0 < step <= MAX_BREAK_S:
                self._drop_aside()
                pieces[-1][1].append(row)
                self._last_s = time
            elif step == 0.0:
                self.left_out["a time that came already"] += 1
            else:
                if self._aside and time <= self._aside[-1][TIME]:
                    self._drop_aside()
                self._aside.append(row)
                if len(self._aside) == _SURE:
                    self.left_out["(times the clock was set)"] += 1
                    pieces.append((True, self._aside))
                    self._last_s, self._aside = time, []
        return [
            Piece(rows=np.array(kept).reshape(-1, len(ROW)), starts=new)
            for new, kept in pieces
            if kept or new
        ]

    def _drop_aside(self) -> None:
        if self._aside:
            self.left_out["late, or a time that jumps"] += len(self._aside)
            self._aside = []


class Reordered:
    """Holds rows back for a moment, so that those that overtook one another are in order again."""

    def __init__(self, window_s: float, left_out: Counter[str]) -> None:
        """Nothing has come yet.

        Args:
            window_s: how long a row is waited for, on its own clock and on this machine's.
            left_out: counts what is left out, by reason; is added to.
        """
        self._window_s, self.left_out = window_s, left_out
        self._held: dict[float, tuple[float, Array]] = {}

    def passed(self, rows: list[Array], wall_s: float) -> Array:
        """Rows, (N, 8), whose turn it is.

        Args:
            rows: (8,) each, that came now.
            wall_s: time of this machine's steady clock.
        """
        for row in rows:
            time = float(row[TIME])
            if time in self._held:
                self.left_out["a time that came already"] += 1
            else:
                self._held[time] = (wall_s, row)
        if not self._held:
            return np.empty((0, len(ROW)))
        # Far behind what was sent is no late row, but another clock: it is waited for the same way.
        newest_s = max(self._held)
        due = sorted(
            time
            for time, (came_s, _) in self._held.items()
            if time <= newest_s - self._window_s or wall_s - came_s >= self._window_s
        )
        sent = [self._held.pop(time)[1] for time in due]
        return np.array(sent).reshape(-1, len(ROW))


def row_of_text(text: str, datum: Datum) -> Array:
    """A packet of one line as a row, (8,).

    It is a JSON object with `time_s`, `latitude_deg` and `longitude_deg` (or `north_m` and `east_m`
    from the plan's datum), and any of `depth_m`, `altitude_m`, `roll_deg`, `pitch_deg`,
    `heading_deg`; the unit may be left out of angles. Or the same values as numbers between commas,
    in the order of `ROW`, empty where one is not known; and that as a sentence of NMEA 0183,
    `$NAME,...*hh` with its checksum.

    Args:
        text: the line.
        datum: of the plan.

    Raises:
        ValueError: it is none of these; the message says why.
    """
    text = text.strip()
    if text.startswith("{"):
        return _of_json(text, datum)
    if text.startswith(("$", "!")):
        body, star, sum_text = text[1:].partition("*")
        found = 0
        for letter in body.encode():
            found ^= letter
        if star and sum_text.strip().upper() != f"{found:02X}":
            raise ValueError("a sentence with a wrong checksum")
        text = body.partition(",")[2]
    cells = [cell.strip() for cell in text.split(",")]
    if not 3 <= len(cells) <= len(ROW):
        raise ValueError("neither JSON nor 3 to 8 numbers between commas")
    return _row(dict(zip(ROW, cells, strict=False)))


def _of_json(text: str, datum: Datum) -> Array:
    try:
        data: dict[str, Any] = json.loads(text)  # it begins with a brace
    except (ValueError, RecursionError):
        raise ValueError("JSON that is cut or wrong") from None
    named = {_SHORT.get(name, name): value for name, value in data.items()}
    values = {name: finite_number(named[name]) for name in named if name in ROW}
    if "latitude_deg" not in values and "north_m" in named:
        ne = [finite_number(named.get(name)) for name in ("north_m", "east_m")]
        if all(map(math.isfinite, ne)) and max(map(abs, ne)) < 1e5:
            place = datum.geodetic_from_ned(np.array([[*ne, 0.0]]))[0]
            values |= {"latitude_deg": float(place[0]), "longitude_deg": float(place[1])}
    return _row({name: "" if math.isnan(v) else repr(v) for name, v in values.items()})


_PARSER = RowParser(ROW, find_zone("UTC"), (), "a packet")


def _row(cells: Mapping[str, str]) -> Array:
    """A row of cells that are parsed as those of a navigation CSV."""
    time, values, wrong = _PARSER.parse({name: cells.get(name, "") for name in ROW})
    if wrong:
        raise ValueError(wrong[0])
    row = np.array([time, *values])
    if not np.isfinite(row[[LATITUDE, LONGITUDE]]).all():
        raise ValueError("no position")
    return row
