"""Where pictures were taken, row by row of a navigation log: what `read_dive_record` finds at once.

Pictures are those of the plan's interval from the first row with a position on. Each value at a
picture is interpolated as soon as a row behind it has come; nothing before the last row is looked
at again, so that of the log itself one value a column is held. Whether rows are too far apart to
interpolate between depends on the log's own median interval: where that changes what was decided,
all pictures are decided on again, which the caller is informed of.
"""

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.frames import Array
from camera_calib.rig import Rig
from missions.coverage.dive_record import (
    ALIKE_RAD,
    MIN_RUN,
    RUN_STEPS,
    altitude_of,
    attitude_of,
    glass_places,
    plan_triggers,
    planned_lines,
    too_high,
)
from missions.coverage.stations import Stations
from missions.follow.rows import LATITUDE, LONGITUDE, TIME
from missions.logs.navigation_csv import (
    FEW,
    READINGS,
    TURNING,
    gap_of_interval_s,
    within_turn,
)
from missions.values.plan_file import Plan

_COURSE = ("latitude_deg", "longitude_deg")
_HEADING = READINGS.index("heading_deg")
_MS = 1000.0
_MAX_MS = 60_000
"""Intervals are counted up to a minute: a median beyond is no log to interpolate in."""


class _Intervals:
    """Whole milliseconds between rows, and their median."""

    def __init__(self) -> None:
        self._counts: Counter[int] = Counter()
        self._last_s: float | None = None
        self.known = 0
        """Rows so far."""

    def add(self, time_s: Array) -> None:
        if len(time_s):
            before = time_s[0] if self._last_s is None else self._last_s
            steps = np.rint(np.diff(time_s, prepend=before) * _MS)
            steps = steps[1:] if self._last_s is None else steps
            self._counts.update(np.minimum(steps, _MAX_MS).astype(int).tolist())
            self._last_s = float(time_s[-1])
            self.known += len(time_s)

    def longest_gap_s(self) -> float:
        """As `navigation_csv.longest_gap_s`."""
        total = self._counts.total()
        if not total:
            return gap_of_interval_s(0.0)
        middle, passed = [], 0
        wanted = ((total - 1) // 2, total // 2)
        for step in sorted(self._counts):
            passed += self._counts[step]
            middle += [step] * sum(passed > w >= passed - self._counts[step] for w in wanted)
            if passed > wanted[1]:
                break
        return gap_of_interval_s((middle[0] + middle[1]) / 2 / _MS)


class _Column:
    """Values of one column at the pictures, each between the two known ones round it."""

    def __init__(self, name: str, offset_s: float = 0.0) -> None:
        """No values yet.

        Args:
            name: of `READINGS`.
            offset_s: how long after each picture.
        """
        self.name, self.offset_s = name, offset_s
        self.intervals = _Intervals()
        self.filled = 0
        """Pictures that are decided: those before the latest known value."""
        self.values, self.gaps_s = np.empty(0), np.empty(0)
        """(n,) value, and seconds between the known ones round it; infinite before the first."""
        self._last: tuple[float, float] | None = None

    @property
    def latest(self) -> float:
        """The latest known value; NaN before the first."""
        return math.nan if self._last is None else self._last[1]

    def add(self, time_s: Array, values: Array, pictures_s: Array) -> None:
        """Take rows, and decide on the pictures before the last known one.

        Args:
            time_s: (N,) of rows.
            values: (N,) of rows; NaN is not known.
            pictures_s: (P,) of all pictures.
        """
        known = np.isfinite(values)
        times, values = time_s[known], values[known]
        if not len(times):
            return
        self.intervals.add(times)
        if self._last is not None:
            times, values = np.append(self._last[0], times), np.append(self._last[1], values)
        self._last = (float(times[-1]), float(values[-1]))
        at_s = pictures_s[self.filled :] + self.offset_s
        at_s = at_s[: int(np.searchsorted(at_s, times[-1], side="right"))]
        after = np.clip(np.searchsorted(times, at_s), 0, len(times) - 1)
        before = np.clip(np.searchsorted(times, at_s, side="right") - 1, 0, len(times) - 1)
        smooth = np.unwrap(values, period=360.0) if self.name in TURNING else values
        gaps = np.where(at_s < times[0], np.inf, times[after] - times[before])
        self._grow(self.filled + len(at_s))
        here = slice(self.filled, self.filled + len(at_s))
        self.values[here] = within_turn(self.name, np.interp(at_s, times, smooth))
        self.gaps_s[here] = gaps
        self.filled += len(at_s)

    def _grow(self, count: int) -> None:
        if count > len(self.values):
            more = np.full(max(256, count) + len(self.values) // 2, np.nan)
            self.values = np.concatenate([self.values, more])
            self.gaps_s = np.concatenate([self.gaps_s, np.full(len(more), np.inf)])

    def part(self, first: int, last: int) -> tuple[Array, Array]:
        """Values and gaps of pictures; unknown those that are not decided."""
        self._grow(last)
        return self.values[first:last], self.gaps_s[first:last]


@dataclass
class _PictureRun:
    """The run of pictures outside of the plan's lines that goes on now (`assign_lines`)."""

    held: list[int] = field(default_factory=list)
    """Pictures of it that have no line yet, by their number among those that count."""
    length: int = 0
    number: int = -1
    heading_rad: float = 0.0
    place_ne: tuple[float, float] = (0.0, 0.0)


@dataclass
class Tally:
    """What became of the pictures of a log."""

    triggered: int = 0
    lost: int = 0
    """In gaps of the log."""
    no_range: int = 0
    """Without a depth or an altitude."""
    high: int = 0
    """Too high above the sea floor, on the way down and up included."""
    below: int = 0
    """At or below the sea floor, by their altitude."""


class PictureTrack:
    """The stations of a dive, from rows of its navigation as they come."""

    def __init__(self, plan: Plan, rig: Rig) -> None:
        """No rows yet."""
        self.plan, self.rig = plan, rig
        self.tally = Tally()
        self._before: list[Stations] = []
        self._runs = 0
        self._run = _PictureRun()
        self._begin()

    def _begin(self) -> None:
        half_s = self.plan.interval_s / 2
        self._columns = [_Column(name) for name in READINGS]
        self._course = [_Column(name, side * half_s) for side in (-1, 1) for name in _COURSE]
        self._rows = _Intervals()
        self._start_s: float | None = None
        self._pictures_s = np.empty(0)
        self._count = 0
        self._latest_s = -math.inf
        self._decided = 0
        self._used = np.empty((0, len(READINGS)), bool)
        self._limits_before_s = np.empty(0)
        self._restart_state = (self._runs, replace(self._run, held=[]), replace(self.tally))
        self._own: list[Stations] = []
        self._held: list[Stations] = []

    def begin_again(self) -> Stations:
        """Another log begins: decide on what is left of this one, and return it."""
        left = self._emitted(self._decided, self._count, final=True)
        self._before += [*self._own, left]
        self._begin()
        return left

    @property
    def longest_gap_s(self) -> float:
        """Seconds between rows beyond which nothing is interpolated, by now."""
        return self._rows.longest_gap_s()

    def add(self, rows: Array) -> tuple[Stations, bool]:
        """Take rows that follow those before.

        Args:
            rows: (N, 8) of `ROW`, times increasing.

        Returns:
            The stations that are new, in the order of time. And whether they are not new, but all
            of the dive, since those before were decided on again.
        """
        located = np.isfinite(rows[:, LATITUDE] + rows[:, LONGITUDE])
        rows = rows[located]
        if not len(rows):
            return self._emitted(self._decided, self._decided), False
        time_s = rows[:, TIME]
        self._start_s = float(time_s[0]) if self._start_s is None else self._start_s
        self._latest_s = float(time_s[-1])
        self._rows.add(time_s)
        self._foresee(self._start_s)
        pictures_s = self._pictures_s
        self._count = int(np.searchsorted(pictures_s, self._latest_s))
        before = [column.filled for column in self._columns]
        for index, column in enumerate(self._columns, 1):
            column.add(time_s, rows[:, index], pictures_s)
        for column in self._course:
            column.add(time_s, rows[:, 1 + READINGS.index(column.name)], pictures_s)
        again = self._changed(before)
        if again:
            self._runs, run, tally = self._restart_state
            self._run, self.tally = replace(run, held=[]), replace(tally)
            self._decided, self._own, self._held = 0, [], []
        first, self._decided = self._decided, self._ripe()
        new = self._emitted(first, self._decided)
        self._own.append(new)
        if not again:
            return new, False
        return _all([*self._before, *self._own]), True

    def rest(self) -> Stations:
        """The stations that are not certain yet, as they would be if the log ended here."""
        kept = self._runs, replace(self._run, held=list(self._run.held)), replace(self.tally)
        held, used = list(self._held), self._used
        try:
            return self._emitted(self._decided, self._count, final=True)
        finally:
            self._runs, self._run, self.tally = kept
            self._held, self._used = held, used

    def _foresee(self, start_s: float) -> None:
        """Have the times of pictures up to more than one ahead: courses need what is before it."""
        ahead_s = self._latest_s + 2 * self.plan.interval_s
        if not len(self._pictures_s) or self._pictures_s[-1] < ahead_s:
            until_s = max(ahead_s, start_s + 1.5 * (self._latest_s - start_s))
            more = plan_triggers(
                start_s, until_s, self.plan.interval_s, first=len(self._pictures_s)
            )
            self._pictures_s = np.concatenate([self._pictures_s, more])

    def _limits_s(self) -> Array:
        """(7,) seconds between known values beyond which nothing is interpolated."""
        rows_s = self._rows.longest_gap_s()
        return np.array(
            [
                column.intervals.longest_gap_s() if column.intervals.known > FEW else rows_s
                for column in self._columns
            ]
        )

    def _usable(self, first: int, last: int) -> tuple[Array, NDArray[np.bool_]]:
        """Values, (n, 7), of pictures, and whether each may be used."""
        parts = [column.part(first, last) for column in self._columns]
        values = np.stack([part[0] for part in parts], axis=1)
        gaps = np.stack([part[1] for part in parts], axis=1)
        usable: NDArray[np.bool_] = gaps <= self._limits_s()
        return values, usable

    def _changed(self, before: list[int]) -> bool:
        """Whether something that was decided on would be decided in another way by now.

        Args:
            before: how many pictures each column had decided before the latest rows.
        """
        limits_s = self._limits_s()
        late = any(
            count < min(column.filled, self._decided)
            for count, column in zip(before, self._columns, strict=True)
        )
        same = np.array_equal(limits_s, self._limits_before_s) and not late
        self._limits_before_s = limits_s
        if same:
            return False
        _, usable = self._usable(0, self._decided)
        return not np.array_equal(usable, self._used[: self._decided])

    def _ripe(self) -> int:
        """How many pictures, from the first on, have all the values they will get."""
        waiting = self._pictures_s[self._decided : self._count]
        ripe = np.ones(len(waiting), bool)
        number = np.arange(self._decided, self._count)
        for column, limit_s in zip(self._columns, self._limits_s(), strict=True):
            if column.intervals.known:
                ripe &= (number < column.filled) | (self._latest_s > waiting + limit_s)
        _, usable = self._usable(self._decided, self._count)
        ripe &= (number < self._course[-1].filled) | usable[:, _HEADING]
        return self._decided + (len(ripe) if ripe.all() else int(np.argmin(ripe)))

    def _emitted(self, first: int, last: int, *, final: bool = False) -> Stations:
        """The stations of some pictures, after those before.

        Args:
            first: picture.
            last: picture, exclusive.
            final: whether none follow, so that those of a run that is too short are none.
        """
        stations = self._stations(first, last)
        lines = planned_lines(stations, self.plan)
        found: list[Stations] = [*self._held]
        self._held = []
        for station in _each(replace(stations, line=lines)):
            found.append(station)
            self._follow_run(station, found)
        held = self._run.held
        if final:
            self._run = _PictureRun()
        elif held:
            self._held = found[len(found) - len(held) :]
            found = found[: len(found) - len(held)]
            self._run.held = list(range(len(held)))
        return _all(found)

    def _follow_run(self, station: Stations, found: list[Stations]) -> None:
        """Number the run that a station goes on with, once it is long enough."""
        place, heading = station.glass_ne[0], float(station.attitude_rad[0, 2])
        run = self._run
        if station.line[0] >= 0:
            self._run = _PictureRun()
            return
        goes_on = (
            run.length > 0
            and math.dist(place, run.place_ne) <= RUN_STEPS * self.plan.station_spacing_m
            and math.cos(heading - run.heading_rad) >= math.cos(ALIKE_RAD)
        )
        if not goes_on:
            run = self._run = _PictureRun(heading_rad=heading)
        run.length += 1
        run.place_ne = (float(place[0]), float(place[1]))
        run.held.append(len(found) - 1)
        if run.length >= MIN_RUN:
            if run.number < 0:
                run.number = len(self.plan.lines) + self._runs
                self._runs += 1
            for index in run.held:
                found[index] = replace(found[index], line=np.array([run.number]))
            run.held = []

    def _stations(self, first: int, last: int) -> Stations:
        """Stations of pictures, without lines."""
        values, usable = self._usable(first, last)
        if last > len(self._used):
            more = np.zeros((max(256, last), len(READINGS)), bool)
            self._used = np.concatenate([self._used, more])
        self._used[first:last] = usable
        at = {name: np.where(usable[:, i], values[:, i], np.nan) for i, name in enumerate(READINGS)}
        located = np.isfinite(at["latitude_deg"] + at["longitude_deg"])
        ranged = np.isfinite(at["depth_m"]) | np.isfinite(at["altitude_m"])
        kept = np.flatnonzero(located & ranged)
        at = {name: column[kept] for name, column in at.items()}
        numbers = first + kept
        attitude, _ = attitude_of(at, lambda unknown: self._courses(numbers[unknown]))
        glass = glass_places(at, attitude, self.plan, self.rig)
        altitude, _ = altitude_of(at, glass[:, 2], self.plan)
        high, below = too_high(altitude, self.plan), altitude <= 0
        tally = self.tally
        tally.triggered += last - first
        tally.lost += int((~located).sum())
        tally.no_range += int((located & ~ranged).sum())
        tally.high += int(high.sum())
        tally.below += int(below.sum())
        return Stations(
            glass_ne=glass[:, :2],
            altitude_m=altitude,
            attitude_rad=attitude,
            line=np.full(len(kept), -1, dtype=np.intp),
            time_s=self._pictures_s[numbers],
        ).some(~(high | below))

    def _courses(self, numbers: NDArray[np.intp]) -> Array:
        """Courses made good at pictures, radians."""
        last = int(numbers[-1]) + 1
        places = []
        for column in self._course:
            values, _ = column.part(0, last)
            # Beyond the log its last place stands for what follows.
            places.append(np.where(np.arange(last) < column.filled, values, column.latest)[numbers])
        ends = [
            self.plan.datum.ned_from_geodetic(np.column_stack([*pair, np.zeros(len(numbers))]))
            for pair in (places[:2], places[2:])
        ]
        moved = ends[1] - ends[0]
        course: Array = np.arctan2(moved[:, 1], moved[:, 0])
        return course


def _each(stations: Stations) -> Iterator[Stations]:
    for i in range(len(stations)):
        yield stations.some(np.array([i]))


def _all(parts: list[Stations]) -> Stations:
    """All stations in order, with their times."""
    parts = [part for part in parts if len(part)]
    if not parts:
        return Stations(
            glass_ne=np.empty((0, 2)), altitude_m=np.empty(0), attitude_rad=np.empty((0, 3)),
            line=np.empty(0, np.intp), time_s=np.empty(0),
        )  # fmt: skip
    times = [part.time_s for part in parts if part.time_s is not None]
    return Stations(
        glass_ne=np.concatenate([part.glass_ne for part in parts]),
        altitude_m=np.concatenate([part.altitude_m for part in parts]),
        attitude_rad=np.concatenate([part.attitude_rad for part in parts]),
        line=np.concatenate([part.line for part in parts]),
        time_s=np.concatenate(times),
    )
