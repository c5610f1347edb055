"""Pictures on their way into a workspace: checked, named, masked, copied, timed and located."""

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, tzinfo
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from alice_survey.core.errors import ImageError, NavigationError, warn
from alice_survey.core.executor import Executor
from alice_survey.core.frames import Array
from alice_survey.core.manifest import ImageRecord
from camera_calib.rig import Rig
from missions.logs.dive import DATED_AFTER_S
from missions.logs.navigation_csv import READINGS, NavigationLog, warn_of_gaps
from reconstruct.pictures.files import (
    PictureFacts,
    bits_used,
    copy_picture,
    inspect,
    list_names,
    safe_name,
    target_suffix,
    to_utc,
)
from reconstruct.pictures.undistorted import read_mask

UNDECODABLE = "cannot be decoded"
MIRRORED = "mirror images"
COPIES = "copies of others"


@dataclass(frozen=True, kw_only=True)
class Incoming:
    """One picture to import."""

    source: Path
    camera: str
    station: int
    facts: PictureFacts
    image: str = ""
    mask: Path | None = None
    video_time_s: float | None = None
    """Of a frame, since the start of the first recording; NaN where that is unknown."""
    recording: str = ""
    """Name of the recording that a frame is of."""


def find_entries(
    stations: Sequence[Mapping[str, Path]], executor: Executor
) -> tuple[list[Incoming], dict[str, list[str]]]:
    """Pictures of all stations that can be used; the others are named in warnings.

    Returns:
        Those that can be used, and names of the others by reason.
    """
    listed = [
        (camera, station, path)
        for station, paths in enumerate(stations)
        for camera, path in paths.items()
    ]
    copies = same_bytes([path for _, _, path in listed])
    owners = {path: camera for camera, _, path in listed}
    for copy, first in copies.items():
        if owners[copy] != owners[first]:
            raise ImageError(
                f"{owners[first]} and {owners[copy]} have the same picture, {first} and {copy}: "
                "give each camera the pictures that it took"
            )
    listed = [one for one in listed if one[2] not in copies]
    facts = executor.map(inspect, [path for _, _, path in listed], label="checking pictures")
    entries = []
    left_out: dict[str, list[str]] = {}
    for copy, first in copies.items():
        warn(f"{copy} is left out: it is the same file as {first}")
        left_out.setdefault(COPIES, []).append(copy.name)
    for (camera, station, path), known in zip(listed, facts, strict=True):
        if known.fault:
            warn(f"{path} is left out: {known.fault}")
            reason = MIRRORED if known.width_px else UNDECODABLE
            left_out.setdefault(reason, []).append(path.name)
            continue
        entries.append(Incoming(source=path, camera=camera, station=station, facts=known))
    return entries, left_out


def same_bytes(paths: Sequence[Path]) -> dict[Path, Path]:
    """Files that are copies, each with the one of the shortest name of those of the same bytes."""
    sizes = {path: path.stat().st_size if path.is_file() else 0 for path in paths}
    often = Counter(sizes.values())
    first: dict[bytes, Path] = {}
    copies = {}
    for path in sorted(paths, key=lambda p: len(p.name)):
        if sizes[path] == 0 or often[sizes[path]] == 1:
            continue
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").digest()
        other = first.setdefault(digest, path)
        if other != path:
            copies[path] = other
    return copies


def with_time(entry: Incoming, time_s: float) -> Incoming:
    """A picture with the time of its message: a date, or seconds of a clock without dates."""
    if time_s < DATED_AFTER_S:
        return replace(entry, video_time_s=time_s)
    date = datetime.fromtimestamp(time_s, UTC)
    return replace(entry, facts=replace(entry.facts, time_local=date))


def camera_names(
    facts: Sequence[PictureFacts], name: str
) -> list[tuple[str, tuple[str, int, int], int]]:
    """Name, key and pictures of the cameras, as far as EXIF and sizes distinguish them.

    The camera of most pictures has the name that is given; the next ones a number more.
    """
    counts = Counter(one.key for one in facts).most_common()
    return [
        (name if number == 1 else f"{name}-{number}", key, count)
        for number, (key, count) in enumerate(counts, 1)
    ]


def check_entries(entries: Sequence[Incoming], rig: Rig | None) -> None:
    """Check that pictures are enough, of one size by camera, and of the size that the rig says."""
    first = {entry.camera: entry for entry in reversed(entries)}
    if len({entry.station for entry in entries}) < 2 and (rig is None or len(first) < 2):
        count = len(entries)
        raise ImageError(
            f"{count} usable picture{'s' * (count != 1)}: a model needs pictures from 2 or more "
            "places that overlap, or a stereo pair with its rig"
        )
    for entry in entries:
        facts, one = entry.facts, first[entry.camera].facts
        if (facts.width_px, facts.height_px) != (one.width_px, one.height_px):
            raise ImageError(
                f"{entry.source} has {facts.width_px} x {facts.height_px} pixels, but "
                f"{one.path.name} of the same camera has {one.width_px} x {one.height_px}: import "
                "pictures of one size only"
            )
    if rig is not None:
        check_rig({n: (e.facts.width_px, e.facts.height_px) for n, e in first.items()}, rig)


def check_rig(sizes: Mapping[str, tuple[int, int]], rig: Rig) -> None:
    """Check that a rig is of these cameras, by their widths and heights (0 where unknown)."""
    for name, (width, height) in sizes.items():
        if name not in rig.cameras:
            raise ImageError(
                f"the rig has no camera {name!r}, only {', '.join(rig.cameras)}: call the folders "
                "as the rig does"
            )
        model = rig.cameras[name]
        if width and (width, height) != (model.width_px, model.height_px):
            others = ", ".join(other for other in rig.cameras if other != name)
            raise ImageError(
                f"pictures of {name} have {width} x {height} pixels, but the rig's camera {name} "
                f"has {model.width_px} x {model.height_px}"
                + (f": --camera NAME=FOLDER says if {others} took them" if others else "")
            )


def unique_names(entries: Sequence[Incoming]) -> list[Incoming]:
    """Names below `images/`: the camera's folder and a safe, unique form of the file's own name."""
    taken: set[str] = set()
    named = []
    for entry in entries:
        if entry.image:
            named.append(entry)
            continue
        stem = safe_name(entry.source.stem)
        suffix = target_suffix(entry.source, _bits(entries, entry.camera))
        image, copy = f"{safe_name(entry.camera)}/{stem}{suffix}", 1
        while image.lower() in taken:
            copy += 1
            image = f"{safe_name(entry.camera)}/{stem}_{copy}{suffix}"
        taken.add(image.lower())
        named.append(replace(entry, image=image))
    return named


def _bits(entries: Sequence[Incoming], camera: str) -> int:
    return bits_used(max(e.facts.highest for e in entries if e.camera == camera))


def mask_of(entry: Incoming, masks: Path | None, stereo: bool) -> Path | None:
    """The mask of a picture, in the folder of masks or next to it; None where it has none."""
    stem = entry.source.stem
    names = [f"{stem}.png", f"{stem}_mask.png", f"{stem}.jpg", f"{stem}.tif"]
    if masks is None:
        places = [entry.source.with_name(f"{stem}_mask.png")]
    else:
        places = [masks / entry.camera / name for name in names]
        if not stereo:
            places += [masks / name for name in names]
    found = next((path for path in places if path.is_file()), None)
    if found is not None:
        read_mask(found, (entry.facts.width_px, entry.facts.height_px))
    return found


def copy_all(entries: Sequence[Incoming], partial: Path, executor: Executor) -> list[str]:
    """Copy pictures to where their names say; what was lost in it, as notes."""
    bits = {camera: _bits(entries, camera) for camera in {e.camera for e in entries}}
    tasks = [(entry.source, partial / entry.image, bits[entry.camera]) for entry in entries]
    for _ in executor.map(_copy, tasks, label="copying pictures"):
        pass
    return [
        f"pictures of camera {camera} held {count} bits; the upper 8 were kept"
        for camera, count in sorted(bits.items())
        if count > 8
    ]


def _copy(task: tuple[Path, Path, int]) -> None:
    copy_picture(*task)


def record_of(entry: Incoming, partial: Path) -> ImageRecord:
    """Row of the manifest; writes the mask of the picture."""
    mask = ""
    if entry.mask is not None:
        mask = f"masks/{Path(entry.image).with_suffix('.png').as_posix()}"
        usable = read_mask(entry.mask, (entry.facts.width_px, entry.facts.height_px))
        (partial / mask).parent.mkdir(parents=True, exist_ok=True)
        if not cv2.imwrite(str(partial / mask), usable.astype(np.uint8) * 255):
            raise ImageError(f"{partial / mask}: cannot be written")
    return ImageRecord(image=entry.image, camera=entry.camera, station=entry.station, mask=mask)


_EXIF_SIGMA_M = (3.0, 6.0)
"""Horizontal and vertical sigma of the GPS in a picture's EXIF, which states none."""
_LOGGED_LEVEL = "sea surface, as in the navigation log"
_ABOVE_M = 0.5
"""Depths are on the wrong side of the surface beyond waves and the zero of a sensor."""


def level_of_log(name: str | None, navigation: Path | None) -> str:
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


def place_records(
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
            f"{list_names(recordings)} do not say when they began, so navigation cannot be tied: "
            "import each into a workspace of its own with --clock-offset, then 'join' them"
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
        warn(f"{len(lost)} pictures have no complete GPS in EXIF: {list_names(lost)}")
    return placed
