"""When and where pictures were taken: by EXIF, by a video, by a navigation log."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime, tzinfo
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.errors import ImageError, NavigationError, warn
from alice_survey.core.frames import Array
from alice_survey.core.manifest import ImageRecord
from missions.logs.navigation_csv import READINGS, NavigationLog, warn_of_gaps
from reconstruct.pictures.files import named, to_utc
from reconstruct.pictures.incoming import Incoming

_EXIF_SIGMA_M = (3.0, 6.0)
"""Horizontal and vertical sigma of the GPS in a picture's EXIF, which states none."""
_LOGGED_LEVEL = "sea surface, as in the navigation log"
_ABOVE_M = 0.5
"""Depths are on the wrong side of the surface beyond waves and the zero of a sensor."""


def checked_level(name: str | None, navigation: Path | None) -> str:
    """What to call the level of logged depths; files that state it give it one line."""
    if name is None:
        return _LOGGED_LEVEL
    if navigation is None:
        raise NavigationError(
            f"--vertical-datum {name!r} names the level that a navigation log's depths count from: "
            "give --navigation too"
        )
    if not name.strip() or not name.isprintable():
        raise NavigationError(
            f"--vertical-datum {name!r} is not a name of one line, such as 'NN2000'"
        )
    return name.strip()


def readings_of(records: Sequence[ImageRecord]) -> Counter[str]:
    """How many pictures navigation measured what of."""
    return Counter(name for r in records for name, known in r.readings.items() if known)


def placed(
    entries: Sequence[Incoming],
    records: Sequence[ImageRecord],
    log: NavigationLog | None,
    logged_level: str,
    clock_offset_s: float,
    zone: tzinfo,
    notes: list[str],
) -> tuple[list[ImageRecord], dict[str, float] | None, str]:
    """Give records their times and positions; also the datum and the level of depths."""
    times, from_first = _times(entries, log, clock_offset_s, zone)
    records = [replace(r, time_s=float(t)) for r, t in zip(records, times, strict=True)]
    if log is not None:
        if not np.isfinite(times).any():
            raise ImageError(_without_times(entries))
        if from_first:
            notes.append(f"picture times count from {from_first}, plus the clock offset")
        records = _with_navigation(records, times, log)
        level = logged_level
        if level == _LOGGED_LEVEL:
            _warn_of_heights(records)
    else:
        records = _with_gps(records, entries)
        level = f"{_gps_of(entries)} altitude"
    counted = readings_of(records)
    if not counted:
        if log is not None:
            raise ImageError(
                f"no picture was taken while navigation was logged: pictures at "
                f"{np.nanmin(times):.1f} to {np.nanmax(times):.1f} s, log at {log.time_s[0]:.1f} "
                f"to {log.time_s[-1]:.1f} s; check --clock-offset and --time-zone"
            )
        notes.append("no positions: no CRS, and unscaled unless a rig or a known length scales it")
        return list(records), None, "none"
    if log is None:
        notes.append(f"positions from {_gps_of(entries)}, of unknown accuracy")
    complete = {name for name, count in counted.items() if count == len(records)}
    if complete != set(records[0].readings):
        counts = ", ".join(f"{name} of {counted[name]}" for name in records[0].readings)
        notes.append(f"navigation of {len(records)} pictures: {counts}")
    first = next((r for r in records if r.has_horizontal), None)
    if first is None:
        return list(records), None, level
    datum = {"latitude_deg": first.latitude_deg, "longitude_deg": first.longitude_deg}
    return list(records), datum, level


def _warn_of_heights(records: Sequence[ImageRecord]) -> None:
    """Say when depths look like heights."""
    depths = np.array([r.depth_m for r in records if r.readings["depth"]])
    if len(depths) and np.median(depths) < -_ABOVE_M:
        warn(
            f"most pictures are above the sea surface, by {-np.median(depths):.1f} m: depth_m is "
            "positive down; --vertical-datum names another level that depths count from"
        )


def _gps_of(entries: Sequence[Incoming]) -> str:
    return "the video's GPS" if entries[0].recording else "EXIF GPS"


def _without_times(entries: Sequence[Incoming]) -> str:
    recordings = list(dict.fromkeys(e.recording for e in entries if e.recording))
    if recordings:
        return (
            f"{named(recordings)} do not say when they began, so navigation cannot be tied: import "
            "each into a workspace of its own with --clock-offset, then 'join' them"
        )
    return (
        "no picture carries a time (EXIF DateTimeOriginal), so navigation cannot be tied: give "
        "their times with --triggers"
    )


def _times(
    entries: Sequence[Incoming], log: NavigationLog | None, clock_offset_s: float, zone: tzinfo
) -> tuple[Array, str]:
    """Seconds of every picture on the clock of navigation (else since the first), NaN if unknown.

    Also where they count from if the clocks of pictures and log have no dates in common.
    """
    dates = [
        None if e.facts.time_local is None else to_utc(e.facts.time_local, zone) for e in entries
    ]
    known = [date for date in dates if date is not None]
    log_start = None if log is None else log.start_utc
    if all(e.video_time_s is not None for e in entries) and not (log_start and known):
        times = np.array([e.video_time_s for e in entries], dtype=np.float64)
        return times + clock_offset_s, "" if log is None else "the start of the first recording"
    if not known:
        return np.full(len(entries), np.nan), ""
    start: datetime = min(known) if log_start is None else log_start
    seconds = [np.nan if d is None else (d - start).total_seconds() for d in dates]
    from_first = "the first picture" if log is not None and log_start is None else ""
    return np.array(seconds) + clock_offset_s, from_first


def _with_navigation(
    records: Sequence[ImageRecord], times: Array, log: NavigationLog
) -> list[ImageRecord]:
    found = log.at(times)
    has_reading = np.any([np.isfinite(found[name]) for name in READINGS if name in found], axis=0)
    warn_of_gaps([r.image for r in records], times, np.where(has_reading, 1.0, np.nan), log)
    placed = []
    for i, record in enumerate(records):
        values: dict[str, Any] = {name: float(column[i]) for name, column in found.items()}
        placed.append(replace(record, **values) if has_reading[i] else record)
    return placed


def _with_gps(records: Sequence[ImageRecord], entries: Sequence[Incoming]) -> list[ImageRecord]:
    placed, lost = [], []
    for record, entry in zip(records, entries, strict=True):
        facts = entry.facts
        place = (facts.latitude_deg, facts.longitude_deg, facts.altitude_m)
        if any(value is None for value in place):
            lost.append(record.image)
        if all(value is None for value in place):
            placed.append(record)
            continue
        latitude, longitude, altitude = (np.nan if v is None else float(v) for v in place)
        placed.append(
            replace(
                record,
                latitude_deg=latitude,
                longitude_deg=longitude,
                depth_m=-altitude,
                sigma_horizontal_m=_EXIF_SIGMA_M[0],
                sigma_depth_m=_EXIF_SIGMA_M[1],
            )
        )
    if lost and len(lost) < len(records) and not entries[0].recording:
        warn(f"{len(lost)} pictures have no complete GPS in EXIF: {named(lost)}")
    return placed
