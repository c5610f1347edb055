"""Where the pictures of a dive were taken: from its navigation log and the times of its triggers.

Logs are of the body's origin, and so is what `import-log` writes; the cameras' lever arm is in the
rig. What cannot be used is left out and reported, never silently filled in.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.artefacts import read_csv
from alice_survey.core.contents import as_line, is_unknown, parse_number
from alice_survey.core.errors import NavigationError, warn
from alice_survey.core.frames import Array, rotation_from_attitude
from alice_survey.core.trajectory import read_track
from camera_calib.rig import Rig
from missions.coverage.stations import MAX_ALTITUDES, Stations
from missions.logs.navigation_csv import (
    POSITION,
    READINGS,
    NavigationLog,
    find_zone,
    read_navigation,
    utc_date,
)
from missions.values.navigation import TRIGGER_LOG
from missions.values.plan_file import Plan

_ALIKE_RAD = math.radians(45.0)
"""A vehicle that crabs or yaws by less than this still flies its line (inferred: half way to a line
across)."""
MIN_RUN = 3
"""Pictures that make a straight run outside of the plan."""
_RUN_STEPS = 3.0
"""Pictures of a run are no more steps apart."""

_MAX_TRIGGERS = 1_000_000
"""More than a month of pictures every 3 s: times or intervals beyond are wrong."""
_ELSEWHERE_M = 100.0
"""A log that stays farther from the area than this belongs to another place."""


@dataclass(frozen=True, kw_only=True)
class Triggers:
    """When pictures were taken, on the clock of the log."""

    source: str
    time_s: Array
    """(T,) increasing."""
    line: NDArray[np.intp] | None
    """(T,) line of the plan; None where it is not known."""


@dataclass(frozen=True, kw_only=True)
class DiveRecord:
    """The stations of a dive, and what was left out."""

    source: str
    triggers: str
    stations: Stations
    triggered: int
    left_out: dict[str, int]
    """How many triggers, by reason."""
    on_way: int
    """Triggers high above the sea floor before the first and after the last picture on a line: on
    the way down and up, where none was to be taken."""
    notes: tuple[str, ...]
    """What was assumed."""
    gaps: tuple[tuple[float, float], ...]
    """Start and length of gaps in the log, seconds."""

    def to_json(self) -> dict[str, Any]:
        """All fields but the stations."""
        return {
            "log": self.source,
            "triggers": self.triggers,
            "triggered": self.triggered,
            "stations": len(self.stations),
            "left_out": self.left_out,
            "on_way": self.on_way,
            "notes": list(self.notes),
            "gaps": [{"start_s": start, "length_s": length} for start, length in self.gaps],
        }


def read_dive_record(
    log: Path, plan: Plan, rig: Rig, *, triggers: Path | None = None
) -> DiveRecord:
    """Where the pictures of a dive were taken.

    Args:
        log: a navigation CSV (docs/formats.md), or a folder that `fly` wrote: then its true track.
        plan: what was to be flown.
        rig: the cameras.
        triggers: CSV with `time_s` of each station's pictures, and `line` where it is known.

    Raises:
        NavigationError: the log or the triggers cannot be used, or are of another place or time.
    """
    if log.is_dir():
        return _record_of_flight(log, plan, rig, triggers)
    nav = _rows_with_positions(log, read_navigation(log, find_zone("UTC"), ()))
    if triggers is not None:
        return _record_of(log, nav, read_triggers(triggers, nav), plan, rig)
    return record_of_log(log, nav, plan, rig)


def read_growing_log(path: Path) -> NavigationLog:
    """The rows with positions of a log that is being written: its last row may not be whole.

    Raises:
        NavigationError: as `read_dive_record`.
    """
    return _rows_with_positions(path, read_navigation(path, find_zone("UTC"), (), is_growing=True))


def record_of_log(path: Path, nav: NavigationLog, plan: Plan, rig: Rig) -> DiveRecord:
    """Where the pictures of a dive were taken, at the plan's interval from the log's start on.

    Args:
        path: of the log, for what is reported.
        nav: its rows with positions.
        plan: what was to be flown.
        rig: the cameras.

    Raises:
        NavigationError: the log spans too long, or is of another place.
    """
    start_s, end_s, interval_s = float(nav.time_s[0]), float(nav.time_s[-1]), plan.interval_s
    if not end_s - start_s <= _MAX_TRIGGERS * interval_s:
        raise NavigationError(
            f"{path}: spans {end_s - start_s:.3g} s, over {_MAX_TRIGGERS} pictures every "
            f"{interval_s:.3g} s: check its times, or give the triggers"
        )
    count = math.ceil((end_s - start_s) / interval_s) + 1
    time_s = start_s + interval_s * np.arange(count, dtype=np.float64)
    when = Triggers(
        source=f"the plan's interval, {interval_s:.3g} s, from the start of the log",
        time_s=time_s[time_s < end_s],
        line=None,
    )
    return _record_of(path, nav, when, plan, rig)


def _rows_with_positions(path: Path, nav: NavigationLog) -> NavigationLog:
    """The rows with positions of a log that spans some time.

    Raises:
        NavigationError: it holds no positions, or has one row.
    """
    nothing = np.full(len(nav.time_s), np.nan)
    located = np.isfinite(sum(nav.columns.get(name, nothing) for name in POSITION[:2]))
    if not located.any():
        raise NavigationError(
            f"{path}: no row with a latitude and a longitude: without positions a log does not say "
            "where a dive was; 'alice-survey reconstruct' needs none"
        )
    nav = NavigationLog(
        time_s=nav.time_s[located],
        columns={name: column[located] for name, column in nav.columns.items()},
        start_utc=nav.start_utc,
    )
    if len(nav.time_s) < 2:
        raise NavigationError(
            f"{path}: fewer than 2 rows in order of time: give a log whose time increases"
        )
    return nav


def read_triggers(path: Path, nav: NavigationLog) -> Triggers:
    """Times of pictures: `time_s` on the clock of the log, or `time_utc` if the log is dated.

    Raises:
        NavigationError: it cannot be read, or a time is none or does not follow the one before.
    """
    names, rows = read_csv(path, known=TRIGGER_LOG)
    dated = "time_s" not in names
    if dated and "time_utc" not in names:
        raise NavigationError(
            f"{path}: no column time_s or time_utc; it has {as_line(', '.join(names))}"
        )
    start = nav.start_utc if dated else None
    if dated and start is None:
        raise NavigationError(f"{path} has dates and the log has none: give time_s")
    times, lines = [], []
    for number, row in rows:
        try:
            if start is not None:
                times.append((utc_date(row["time_utc"]) - start).total_seconds())
            else:
                times.append(parse_number(row["time_s"]))
            lines.append(_line_number(row["line"]) if "line" in names else -1)
        except ValueError as error:
            raise NavigationError(f"{path} line {number}: {as_line(str(error))}") from None
        if not math.isfinite(times[-1]) or (len(times) > 1 and times[-1] <= times[-2]):
            raise NavigationError(
                f"{path} line {number}: time {times[-1]:g} s does not follow the one before"
            )
    if not times:
        raise NavigationError(f"{path}: holds no trigger")
    return Triggers(
        source=str(path),
        time_s=np.array(times),
        line=np.array(lines, dtype=np.intp) if "line" in names else None,
    )


def _line_number(cell: str) -> int:
    number = int(cell)
    if abs(number) > _MAX_TRIGGERS or is_unknown(number):
        raise ValueError(f"line is {cell:.60}")
    return number


def _record_of_flight(folder: Path, plan: Plan, rig: Rig, triggers: Path | None) -> DiveRecord:
    """The true stations of a simulated flight; the altitude is what its DVL measured."""
    nav = _rows_with_positions(
        folder / "navigation.csv", read_navigation(folder / "navigation.csv", find_zone("UTC"), ())
    )
    when = read_triggers(triggers or folder / "triggers.csv", nav)
    truth = folder / "truth" / "track.csv"
    if not truth.is_file():
        return _record_of(folder / "navigation.csv", nav, when, plan, rig)
    track = read_track(truth)
    positions, rotation = track.ned_from_body.translation, track.ned_from_body.rotation
    angles = np.rad2deg(rotation.as_euler("ZYX"))[:, ::-1]
    geodetic = plan.datum.geodetic_from_ned(positions)
    altitude = nav.at(track.time_s).get("altitude_m", np.full(len(positions), np.nan))
    columns = dict(
        zip(
            ("latitude_deg", "longitude_deg", "depth_m", "roll_deg", "pitch_deg", "heading_deg"),
            [*geodetic[:, :2].T, positions[:, 2], *angles.T],
            strict=True,
        )
    )
    true = NavigationLog(
        time_s=track.time_s, columns=columns | {"altitude_m": altitude}, start_utc=nav.start_utc
    )
    return _record_of(truth, true, when, plan, rig)


def _record_of(
    path: Path, nav: NavigationLog, triggers: Triggers, plan: Plan, rig: Rig
) -> DiveRecord:
    """Stations of a log at the times of its triggers."""
    at = nav.at(triggers.time_s)
    left_out: dict[str, int] = {}
    beyond = (triggers.time_s < nav.time_s[0]) | (triggers.time_s > nav.time_s[-1])
    lost = ~np.isfinite(at["latitude_deg"] + at["longitude_deg"])
    _count(left_out, f"beyond the log ({nav.span(nav.time_s)})", beyond)
    _count(left_out, f"in a gap of the log over {nav.max_gap_s:.1f} s", lost & ~beyond)
    nothing = np.full(len(lost), np.nan)
    at = {"depth_m": nothing, "altitude_m": nothing} | at
    range_unknown = ~lost & np.isnan(at["depth_m"]) & np.isnan(at["altitude_m"])
    _count(left_out, "without a depth or an altitude", range_unknown)
    kept = np.flatnonzero(~(lost | range_unknown))
    if range_unknown.any() and not len(kept):
        raise NavigationError(
            f"{path}: neither depth_m nor altitude_m at any of {int(range_unknown.sum())} triggers "
            "with a position: how far away the sea floor was is not known"
        )
    if not len(kept):
        raise NavigationError(
            f"{path}: the log has no position at any of {len(triggers.time_s)} triggers "
            f"({nav.span(triggers.time_s)}; the log is of {nav.span(nav.time_s)}): check the clocks"
        )
    at = {name: values[kept] for name, values in at.items()}
    time_s = triggers.time_s[kept]
    attitude, notes = _attitudes(nav, at, time_s, plan)
    glass_ned = glass_places(at, attitude, plan, rig)
    no_altitude = ~np.isfinite(at["altitude_m"])
    above_m = plan.seafloor_depth_m - glass_ned[:, 2]
    if no_altitude.any():
        notes.append(
            f"{no_altitude.sum()} of {len(kept)} stations have no altitude: it is taken from their "
            f"depth and a sea floor at {plan.seafloor_depth_m:g} m"
        )
    stations = Stations(
        glass_ne=glass_ned[:, :2],
        altitude_m=np.where(no_altitude, above_m, at["altitude_m"]),
        attitude_rad=attitude,
        line=np.full(len(kept), -1) if triggers.line is None else triggers.line[kept],
        time_s=time_s,
    )
    _check_place(path, plan, at)
    max_m = MAX_ALTITUDES * plan.altitude_m
    high, below = stations.altitude_m > max_m, stations.altitude_m <= 0
    stations = stations.some(~(high | below))
    if triggers.line is None:
        stations = replace(stations, line=assign_lines(stations, plan))
    on_line_s = time_s[~(high | below)][stations.line >= 0]
    first_s, last_s = (on_line_s[0], on_line_s[-1]) if len(on_line_s) else (-np.inf, np.inf)
    on_way = high & ((time_s < first_s) | (time_s > last_s))
    _count(left_out, "at or below the sea floor, by their altitude", below)
    _count(left_out, f"higher than {max_m:.2g} m above the sea floor", high & ~on_way)
    steps = np.diff(nav.time_s)
    long = np.flatnonzero(steps > nav.max_gap_s)
    gaps = [(float(nav.time_s[i]), float(steps[i])) for i in long]
    # What was left out or assumed is in the caller's report.
    if gaps:
        first = ", ".join(f"{length_s:.1f} s from {at_s:.1f} s" for at_s, length_s in gaps[:9])
        warn(f"{path}: gaps of {first}")
    return DiveRecord(
        source=str(path),
        triggers=triggers.source,
        stations=stations,
        triggered=len(triggers.time_s),
        left_out=left_out,
        on_way=int(on_way.sum()),
        notes=tuple(notes),
        gaps=tuple(gaps),
    )


def _attitudes(
    nav: NavigationLog, at: Mapping[str, Array], time_s: Array, plan: Plan
) -> tuple[Array, list[str]]:
    """Roll, pitch, heading, (S, 3) radians; level, and along the track, where they are unknown.

    Args:
        nav: the log.
        at: its columns at the stations, (S,) each.
        time_s: (S,) of the stations.
        plan: what was to be flown.

    Returns:
        The attitude, and what was assumed, in words.
    """
    nothing = np.full(len(time_s), np.nan)
    degrees = np.column_stack([at.get(name, nothing) for name in READINGS[3:6]])
    no_tilt, no_heading = ~np.isfinite(degrees[:, :2]).all(axis=1), ~np.isfinite(degrees[:, 2])
    degrees[no_tilt, :2] = 0.0
    notes = []
    if no_tilt.any():
        notes.append(f"{no_tilt.sum()} stations have no roll and pitch: taken as level")
    if no_heading.any():
        notes.append(
            f"{no_heading.sum()} stations have no heading: taken as the course, without crab"
        )
        # Made good over the time between two pictures.
        half_s = plan.interval_s / 2
        places = [nav.columns[name] for name in POSITION[:2]]
        ned = plan.datum.ned_from_geodetic(np.column_stack([*places, np.zeros(len(nav.time_s))]))
        north_m, east_m = (
            np.interp(time_s + half_s, nav.time_s, axis)
            - np.interp(time_s - half_s, nav.time_s, axis)
            for axis in ned[:, :2].T
        )
        degrees[no_heading, 2] = np.rad2deg(np.arctan2(east_m, north_m))[no_heading]
    return np.deg2rad(degrees), notes


def glass_places(at: Mapping[str, Array], attitude: Array, plan: Plan, rig: Rig) -> Array:
    """North, east and depth, (S, 3), of the left port's glass at logged places of the body."""
    body_ned = plan.datum.ned_from_geodetic(np.nan_to_num([at[name] for name in POSITION]).T)
    lever = rig.body_from_cam(rig.reference).apply(rig.cameras[rig.reference].front_cam)
    glass_ned: Array = body_ned + rotation_from_attitude(*attitude.T).apply(lever)
    glass_ned[:, 2] = at["depth_m"] + (glass_ned[:, 2] - body_ned[:, 2])
    return glass_ned


def _check_place(path: Path, plan: Plan, at: Mapping[str, Array]) -> None:
    """Refuse a log of another place.

    Raises:
        NavigationError: it never comes near the area; the message says how far off it is.
    """
    import shapely

    places = np.column_stack([at["latitude_deg"], at["longitude_deg"], 0.0 * at["latitude_deg"]])
    away_m, turned_m = (
        shapely.distance(shapely.points(ned[:, :2]), plan.area.survey).min()
        for ned in map(plan.datum.ned_from_geodetic, (places, places[:, [1, 0, 2]]))
    )
    if away_m > _ELSEWHERE_M:
        advice = "give the log of this survey, or its plan"
        if turned_m <= _ELSEWHERE_M:
            advice = "are its latitudes and longitudes exchanged?"
        raise NavigationError(
            f"{path}: the log, from {places[0, 0]:.5f}, {places[0, 1]:.5f} on, is "
            f"{away_m / 1e3:.3g} km from the area of {plan.name!r} at "
            f"{plan.datum.latitude_deg:.5f}, {plan.datum.longitude_deg:.5f} at its nearest: "
            f"{advice}"
        )


def _count(left_out: dict[str, int], reason: str, which: NDArray[np.bool_]) -> None:
    if which.any():
        left_out[reason] = int(which.sum())


def assign_lines(stations: Stations, plan: Plan) -> NDArray[np.intp]:
    """The line of each station, (S,).

    A station belongs to the plan's line that it is nearest to, if it is within half a spacing of
    it, beyond its ends by no more than a step, and along it either way. A closing line goes back
    along another: its own are the pictures in its direction after the line before it. Of what is
    left, runs of three pictures or more on one course without a pause count as separate lines,
    numbered on from the plan's; the rest is -1: seen, but on no line.
    """
    line = _planned_lines(stations, plan)
    runs = _runs(line, stations, _RUN_STEPS * plan.station_spacing_m)
    long = [run for run in runs if len(run) >= MIN_RUN]
    for number, run in enumerate(long, len(plan.lines)):
        line[run] = number
    return line


def _planned_lines(stations: Stations, plan: Plan) -> NDArray[np.intp]:
    """The plan's line of each station, (S,), as of `assign_lines`; -1 of none."""
    line = np.full(len(stations), -1, dtype=np.intp)
    nearest_m = np.full(len(stations), plan.line_spacing_m / 2 + 1e-9)
    heading = stations.attitude_rad[:, 2]
    step_m = plan.station_spacing_m
    number = np.arange(len(stations))
    moved = np.diff(stations.glass_ne, axis=0, prepend=stations.glass_ne[:1])
    for index, planned in enumerate(plan.lines):
        ahead = np.array([math.cos(planned.heading_rad), math.sin(planned.heading_rad)])
        along, across = planned.offsets_m(stations.glass_ne).T
        across = np.abs(across)
        here = (along >= -step_m) & (along <= planned.length_m + step_m)
        here &= np.abs(np.cos(heading - planned.heading_rad)) >= math.cos(_ALIKE_RAD)
        before = number[line == index - 1]
        if planned.kind == "closing" and len(before):
            goes_back = (number > np.median(before)) & (moved @ ahead > 0.0)
            here &= goes_back & (across < plan.line_spacing_m / 2)
        else:
            here &= across < nearest_m
        line[here] = index
        nearest_m[here] = across[here]
    return line


def _runs(line: NDArray[np.intp], stations: Stations, max_m: float) -> list[list[int]]:
    """Consecutive stations of no line, near one another and on one heading."""
    places: Array = stations.glass_ne
    heading = stations.attitude_rad[:, 2]
    runs: list[list[int]] = []
    for i in np.flatnonzero(line < 0).tolist():
        last = runs[-1] if runs else None
        if (
            last is not None
            and last[-1] == i - 1
            and math.dist(places[i], places[i - 1]) <= max_m
            and math.cos(heading[i] - heading[last[0]]) >= math.cos(_ALIKE_RAD)
        ):
            last.append(i)
        else:
            runs.append([i])
    return runs
