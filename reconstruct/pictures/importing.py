"""Real pictures into a workspace: checked, named, timed and placed; the stage `images/`."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, tzinfo
from pathlib import Path
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np

from alice_survey.base.artefacts import Stage, run_stage
from alice_survey.base.errors import (
    CalibrationError,
    ImageError,
    NavigationError,
    WorkspaceError,
    warn,
)
from alice_survey.base.executor import SERIAL, Executor, progress
from alice_survey.base.frames import Array
from alice_survey.base.manifest import ImageRecord, read_manifest, write_manifest
from alice_survey.base.records import PicturesRecord
from camera_calib.calibrate.picture_sets import pair_pictures
from camera_calib.freedom import part_of_rig
from camera_calib.rig import Rig, read_rig, write_rig
from missions.logs.navigation_csv import (
    READINGS,
    NavigationLog,
    find_zone,
    read_navigation,
    warn_of_gaps,
)
from reconstruct.pictures.files import (
    PictureFacts,
    PictureFolder,
    bits_used,
    copy_picture,
    inspect,
    kind_of,
    look_into,
    named,
    safe_name,
    target_suffix,
    to_utc,
)
from reconstruct.pictures.undistorted import read_mask

_MONO = "camera"
_FRAMES = "frames of the video"
_UNDECODABLE = "cannot be decoded"
_EXIF_SIGMA_M = (3.0, 6.0)
"""Horizontal and vertical sigma of the GPS in a picture's EXIF, which states none."""
_LOGGED_LEVEL = "sea surface, as in the navigation log"
_ABOVE_M = 0.5
"""Depths are on the wrong side of the surface beyond waves and the zero of a sensor."""


@dataclass(frozen=True, kw_only=True)
class ImportedPictures:
    """What a workspace got, and what was left out."""

    changed: bool
    """False when all was there already."""
    cameras: Mapping[str, int]
    """Pictures by camera."""
    kinds: Mapping[str, int]
    """Pictures by kind of file."""
    positions: int
    """Number of pictures with a known position."""
    readings: Mapping[str, int]
    """Pictures by what navigation measured of them."""
    left_out: Mapping[str, int]
    """Files that were not imported, by reason."""

    def __str__(self) -> str:
        """One line, such as `68 pictures (68 PNG) of left and right, 0 with a position`."""
        total = sum(self.cameras.values())
        *others, last = self.cameras
        of = f" of {', '.join(others)} and {last}" if others else ""
        text = f"{total} pictures ({_counted(self.kinds)}){of}"
        text += f", {self.positions} with a position"
        for name, count in self.readings.items():
            text += f", {count} with {name}" if count > self.positions else ""
        return text + (f"; left out: {_counted(self.left_out)}" if self.left_out else "")


@dataclass(frozen=True, kw_only=True)
class _Incoming:
    """One picture to import."""

    source: Path
    camera: str
    station: int
    facts: PictureFacts
    image: str = ""
    mask: Path | None = None
    video_time_s: float | None = None


def import_images(
    workspace: Path,
    folders: Sequence[Path],
    *,
    cameras: Mapping[str, Path] = MappingProxyType({}),
    video: Path | None = None,
    every_s: float = 1.0,
    navigation: Path | None = None,
    clock_offset_s: float = 0.0,
    time_zone: str = "UTC",
    vertical_datum: str | None = None,
    rig: Path | None = None,
    masks: Path | None = None,
    executor: Executor = SERIAL,
) -> ImportedPictures:
    """Write `images/` from pictures of one camera, of cameras on a rig, or from a video.

    A picture that cannot be decoded to its end is left out with a warning; the others of its
    station stay. HEIC, videos, folders inside and other files are left out with a warning
    for each kind. Where each picture was taken comes from the navigation log, else from
    GPS in EXIF, else from nothing: then the model will have neither scale nor CRS.

    Args:
        workspace: folder of the survey.
        folders: folders of one camera's pictures, in order.
        cameras: folder of each camera of a rig by its name, such as left and right; the pictures of
            one moment are those of one place in the order of names or, where a camera lacks some,
            of one number in them.
        video: a video to take frames from.
        every_s: seconds between frames.
        navigation: CSV with time and any of position, depth, attitude and altitude (see
            `read_navigation`).
        clock_offset_s: what to add to the times of pictures to get those of navigation.
        time_zone: of dates that name none, in EXIF and navigation.
        vertical_datum: name of the level that the depths of navigation count from, such as that of
            the tide which `import-log` took off; None for the sea surface.
        rig: `rig.json` of the cameras; its lever arm says that navigation is of the body.
        masks: folder of masks (0 = leave out) with the stems of the pictures, or with a folder per
            camera; without it `NAME_mask.png` next to a picture is its mask.
        executor: where tasks run.

    Returns:
        How many pictures of which kind there are now, and what was left out.

    Raises:
        ImageError: pictures are missing, a folder is given twice, or pictures do not pair, are of
            different sizes, or too few.
        NavigationError: the navigation log cannot be used, or a level is named without one.
        CalibrationError: the rig file is wrong or not that of the pictures.
    """
    _check_sources(folders, cameras, video, every_s)
    if not np.isfinite(clock_offset_s):
        raise ImageError(f"--clock-offset {clock_offset_s} is not a number of seconds")
    zone = find_zone(time_zone)
    logged_level = _checked_level(vertical_datum, navigation)
    given = [
        *folders,
        *cameras.values(),
        *(p for p in (video, navigation, rig, masks) if p is not None),
    ]
    for path in given:
        if not path.exists():
            raise ImageError(f"{path}: no such file or folder")
    for path in given:
        if path.resolve().is_relative_to((workspace / "images").resolve()):
            raise WorkspaceError(f"{path} is inside {workspace / 'images'}, which is written again")
    for simulated in (workspace / "images" / "truth", workspace / "pool" / "truth"):
        if simulated.exists():
            raise WorkspaceError(
                f"{workspace} holds a simulated survey, whose rig is not that of real pictures: "
                "choose another workspace with -w"
            )
    known_rig = None if rig is None else read_rig(rig)
    mono = _MONO if known_rig is None else known_rig.reference
    sides = _look_into(folders, cameras, mono, [*given, workspace])
    stations = _stations(sides)
    folders_read = [each for side in sides.values() for each in side]
    files = [file for each in folders_read for file in (*each.pictures, *each.masks)]
    stage = Stage(
        name="images",
        version=2,
        settings={
            "folders": len(folders),
            "stereo": bool(cameras),
            **({} if set(cameras) in (set(), {"left", "right"}) else {"cameras": list(cameras)}),
            "every_s": every_s if video is not None else None,
            "navigation": navigation is not None,
            "clock_offset_s": clock_offset_s,
            "time_zone": time_zone,
            "vertical_datum": vertical_datum,
            "rig": rig is not None,
            "masks": masks is not None,
        },
        inputs=[*files, *(path for path in given if path not in (*folders, *cameras.values()))],
    )

    def work(partial: Path) -> None:
        notes: list[str] = []
        log = None if navigation is None else read_navigation(navigation, zone, ())
        if video is not None:
            entries = _take_frames(video, every_s, partial, mono)
        else:
            for each in folders_read:
                for line in each.warnings():
                    warn(line)
            entries = _find_entries(stations, executor)
        _check_entries(entries, known_rig)
        entries = _named(entries)
        entries = [replace(e, mask=_mask_of(e, masks, bool(cameras))) for e in entries]
        if video is None:
            notes += _copy_all(entries, partial, executor)
        records = [_record(entry, partial) for entry in entries]
        records, datum, level = _place(
            entries, records, log, logged_level, clock_offset_s, zone, notes
        )
        records = sorted(records, key=lambda r: (r.station, r.camera))
        write_manifest(partial / "manifest.csv", records)
        if known_rig is not None:
            taken = {entry.camera for entry in entries}
            names = [name for name in known_rig.cameras if name in taken]
            write_rig(partial / "rig.json", part_of_rig(known_rig, names))
        PicturesRecord.save(
            partial / "survey.json",
            {"source": "imported", "datum": datum, "vertical_datum": level, "notes": notes},
        )

    changed = run_stage(workspace, stage, work)
    records = read_manifest(workspace / "images" / "manifest.csv")
    return _imported(records, sides, stations, changed=changed)


def _imported(
    records: Sequence[ImageRecord],
    sides: Mapping[str, Sequence[PictureFolder]],
    stations: Sequence[Mapping[str, Path]],
    *,
    changed: bool,
) -> ImportedPictures:
    """Counts by the manifest, whose stations number the pictures that were found."""
    left_out: Counter[str] = Counter()
    kinds = Counter({_FRAMES: len(records)})
    if stations:
        kinds = Counter(kind_of(stations[r.station][r.camera]) for r in records)
        left_out += Counter({_UNDECODABLE: sum(map(len, stations)) - len(records)})
        for one in (one for folders in sides.values() for one in folders):
            left_out += Counter({reason: len(paths) for reason, paths in one.left_out.items()})
    counts = Counter(record.camera for record in records)
    return ImportedPictures(
        changed=changed,
        cameras={name: counts[name] for name in (*sides, *counts) if counts[name]},
        kinds=dict(kinds),
        positions=sum(record.has_position for record in records),
        readings=_readings_of(records),
        left_out=dict(left_out),
    )


def _readings_of(records: Sequence[ImageRecord]) -> Counter[str]:
    """How many pictures navigation measured what of."""
    return Counter(name for r in records for name, known in r.readings.items() if known)


def _counted(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {what}" for what, count in counts.items())


def _look_into(
    folders: Sequence[Path], cameras: Mapping[str, Path], mono: str, apart: Sequence[Path]
) -> dict[str, list[PictureFolder]]:
    """Contents of the folders of each camera; `mono` names the one camera of unnamed folders."""
    if cameras:
        return {name: [look_into(folder, apart)] for name, folder in cameras.items()}
    return {mono: [look_into(folder, apart) for folder in folders]} if folders else {}


def _stations(sides: Mapping[str, Sequence[PictureFolder]]) -> list[Mapping[str, Path]]:
    """Pictures of every moment, by camera."""
    found = {side: [p for one in folders for p in one.pictures] for side, folders in sides.items()}
    if len({len(paths) for paths in found.values()}) <= 1:
        return [dict(zip(found, paths, strict=True)) for paths in zip(*found.values(), strict=True)]
    try:
        return [moment.paths for moment in pair_pictures(found)]
    except CalibrationError as error:
        raise ImageError(str(error)) from None


def _check_sources(
    folders: Sequence[Path], cameras: Mapping[str, Path], video: Path | None, every_s: float
) -> None:
    if sum([bool(folders), bool(cameras), video is not None]) != 1:
        raise ImageError(
            "give folders of pictures, or --left and --right, or --camera for each camera, or "
            "--video: one of them"
        )
    if not every_s > 0:
        raise ImageError(f"--every {every_s}: seconds between frames must be more than 0")
    every = [*folders, *cameras.values()]
    places = [folder.resolve() for folder in every]
    twice = [folder for folder in every if places.count(folder.resolve()) > 1]
    if twice:
        raise ImageError(f"{twice[0]} is given twice")


def _checked_level(name: str | None, navigation: Path | None) -> str:
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


def _find_entries(stations: Sequence[Mapping[str, Path]], executor: Executor) -> list[_Incoming]:
    listed = [
        (camera, station, path)
        for station, paths in enumerate(stations)
        for camera, path in paths.items()
    ]
    facts = executor.map(inspect, [path for _, _, path in listed], label="checking pictures")
    entries = []
    for (camera, station, path), known in zip(listed, facts, strict=True):
        if known.fault:
            warn(f"{path} is left out: {known.fault}")
            continue
        entries.append(_Incoming(source=path, camera=camera, station=station, facts=known))
    return entries


def _check_entries(entries: Sequence[_Incoming], rig: Rig | None) -> None:
    if len({entry.station for entry in entries}) < 2:
        count = len(entries)
        raise ImageError(
            f"{count} usable picture{'s' * (count != 1)}: a model needs pictures from 2 or more "
            "places that overlap"
        )
    for camera in dict.fromkeys(entry.camera for entry in entries):
        own = [e for e in entries if e.camera == camera]
        first = own[0].facts
        for entry in own:
            facts = entry.facts
            if (facts.width_px, facts.height_px) != (first.width_px, first.height_px):
                raise ImageError(
                    f"{entry.source} has {facts.width_px} x {facts.height_px} pixels, but "
                    f"{own[0].source.name} of the same camera has {first.width_px} x "
                    f"{first.height_px}: import pictures of one size only"
                )
        if rig is None:
            continue
        if camera not in rig.cameras:
            raise ImageError(f"the rig has no camera {camera!r}, only {', '.join(rig.cameras)}")
        model = rig.cameras[camera]
        if (model.width_px, model.height_px) != (first.width_px, first.height_px):
            others = ", ".join(name for name in rig.cameras if name != camera)
            raise ImageError(
                f"{own[0].source} has {first.width_px} x {first.height_px} pixels, but the rig's "
                f"camera {camera} has {model.width_px} x {model.height_px}"
                + (f": --camera NAME=FOLDER says if {others} took them" if others else "")
            )


def _named(entries: Sequence[_Incoming]) -> list[_Incoming]:
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


def _bits(entries: Sequence[_Incoming], camera: str) -> int:
    return bits_used(max(e.facts.highest for e in entries if e.camera == camera))


def _mask_of(entry: _Incoming, masks: Path | None, stereo: bool) -> Path | None:
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


def _copy_all(entries: Sequence[_Incoming], partial: Path, executor: Executor) -> list[str]:
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


def _take_frames(video: Path, every_s: float, partial: Path, camera: str) -> list[_Incoming]:
    """Write a frame at a fixed interval in seconds as PNG."""
    capture = cv2.VideoCapture(str(video))
    if not capture.isOpened():
        raise ImageError(f"{video}: not a video that can be read")
    entries: list[_Incoming] = []
    try:
        total = max(0, int(capture.get(cv2.CAP_PROP_FRAME_COUNT)))
        rate = capture.get(cv2.CAP_PROP_FPS)
        rate = rate if np.isfinite(rate) and rate > 0 else 0.0
        count = 0
        for _ in progress(iter(capture.grab, False), "video frames", total or None):
            time_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3
            if count and not time_s > 0 and rate:
                time_s = count / rate
            count += 1
            if time_s + 1e-6 < len(entries) * every_s:
                continue
            good, pixels = capture.retrieve()
            if not good:
                warn(f"{video}: the frame at {time_s:.2f} s is left out: it cannot be decoded")
                continue
            image = f"{safe_name(camera)}/{safe_name(video.stem)}_{len(entries):06d}.png"
            (partial / image).parent.mkdir(parents=True, exist_ok=True)
            if not cv2.imwrite(str(partial / image), pixels):
                raise ImageError(f"{partial / image}: cannot be written")
            facts = PictureFacts(path=video, width_px=pixels.shape[1], height_px=pixels.shape[0])
            entries.append(
                _Incoming(
                    source=video.with_name(Path(image).name),
                    camera=camera,
                    station=len(entries),
                    facts=facts,
                    image=image,
                    video_time_s=time_s,
                )
            )
    finally:
        capture.release()
    return entries


def _record(entry: _Incoming, partial: Path) -> ImageRecord:
    mask = ""
    if entry.mask is not None:
        mask = f"masks/{Path(entry.image).with_suffix('.png').as_posix()}"
        usable = read_mask(entry.mask, (entry.facts.width_px, entry.facts.height_px))
        (partial / mask).parent.mkdir(parents=True, exist_ok=True)
        if not cv2.imwrite(str(partial / mask), usable.astype(np.uint8) * 255):
            raise ImageError(f"{partial / mask}: cannot be written")
    return ImageRecord(image=entry.image, camera=entry.camera, station=entry.station, mask=mask)


def _place(
    entries: Sequence[_Incoming],
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
            raise ImageError(
                "no picture carries a time (EXIF DateTimeOriginal), so navigation cannot be tied"
            )
        if from_first:
            notes.append("picture times count from the first picture, plus the clock offset")
        records = _with_navigation(records, times, log)
        level = logged_level
        if level == _LOGGED_LEVEL:
            _warn_of_heights(records)
    else:
        records = _with_gps(records, entries)
        level = "EXIF GPS altitude"
    counted = _readings_of(records)
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
        notes.append("positions from EXIF GPS, of unknown accuracy")
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


def _times(
    entries: Sequence[_Incoming], log: NavigationLog | None, clock_offset_s: float, zone: tzinfo
) -> tuple[Array, bool]:
    """Seconds of every picture on the clock of navigation (else since the first), NaN if unknown.

    Also whether they count from the first picture though there is a log (which then has no dates).
    """
    if all(e.video_time_s is not None for e in entries):
        times = np.array([e.video_time_s for e in entries], dtype=np.float64)
        return times + clock_offset_s, False
    dates = [
        None if e.facts.time_local is None else to_utc(e.facts.time_local, zone) for e in entries
    ]
    known = [date for date in dates if date is not None]
    if not known:
        return np.full(len(entries), np.nan), False
    start: datetime = min(known)
    from_first = log is not None and log.start_utc is None
    if log is not None and log.start_utc is not None:
        start = log.start_utc
    seconds = [np.nan if d is None else (d - start).total_seconds() for d in dates]
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


def _with_gps(records: Sequence[ImageRecord], entries: Sequence[_Incoming]) -> list[ImageRecord]:
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
    if lost and len(lost) < len(records):
        warn(f"{len(lost)} pictures have no complete GPS in EXIF: {named(lost)}")
    return placed
