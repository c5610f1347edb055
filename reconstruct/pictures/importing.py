"""Real pictures into a workspace: checked, named, timed and placed; the stage `images/`.

Before an import, `preview_import` says what it would find from headers alone, of all pictures or of
some spread evenly, so that folders of any size take seconds. What only decoding shows, such as
damaged files, the import finds.
"""

import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from types import MappingProxyType
from typing import ClassVar

import numpy as np

from alice_survey.core.artefacts import JsonRecord, Stage, run_stage
from alice_survey.core.errors import ImageError, WorkspaceError, heard, warn
from alice_survey.core.executor import SERIAL, Executor
from alice_survey.core.manifest import ImageRecord, read_manifest, write_manifest
from alice_survey.core.records import PicturesRecord
from camera_calib.freedom import part_of_rig
from camera_calib.rig import Rig, read_rig, write_rig
from missions.logs.navigation_csv import NavigationLog, find_zone, read_navigation
from reconstruct.pictures.bag_pictures import BagPictures, take_bag
from reconstruct.pictures.files import (
    ADVICE,
    VIDEO,
    PictureFacts,
    PictureFolder,
    kind_of,
    list_names,
    look_into,
    read_header,
    to_utc,
)
from reconstruct.pictures.incoming import (
    COPIES,
    MIRRORED,
    UNDECODABLE,
    Incoming,
    at_time,
    by_camera,
    camera_key,
    check_entries,
    checked_level,
    copy_all,
    find_entries,
    mask_of,
    named_apart,
    placed,
    readings_of,
    record_of,
)
from reconstruct.pictures.pairing import PairedPictures, pair_by_time
from reconstruct.pictures.videos import (
    DEFAULT_OVERLAP,
    MAX_OVERLAP,
    MIN_OVERLAP,
    FrameSettings,
    Recording,
    find_videos,
    read_recordings,
    take_frames,
)

_WHY = {
    UNDECODABLE: "copy them from the camera again",
    MIRRORED: "save them as they are seen, without an EXIF orientation",
    COPIES: "each file counts once",
    **ADVICE,
}
_NAMED = 3
FRAMES = "frames of videos"


class CameraRow(JsonRecord):
    """A camera that took pictures."""

    pictures: int
    width_px: int
    height_px: int
    device: str = ""

    def __str__(self) -> str:
        """Such as `34 of 5184 x 3888 pixels, GoPro HERO9 Black`."""
        text = f"{self.pictures} of {self.width_px} x {self.height_px} pixels"
        return f"{text}, {self.device}" if self.device else text


class RecordingRow(JsonRecord):
    """A recording whose frames were taken."""

    files: tuple[str, ...]
    frames: int
    duration_s: float
    start: str | None
    """ISO 8601; without a zone where it is the camera's local time."""
    clock: str

    def __str__(self) -> str:
        """Such as `12 frames of 60 s in 2 files, from 2024-07-01T12:00:00 (UTC in the video)`."""
        of = f" in {len(self.files)} files" if len(self.files) > 1 else ""
        began = "start unknown" if self.start is None else f"from {self.start} ({self.clock})"
        return f"{self.frames} frames of {self.duration_s:.0f} s{of}, {began}"


class ImportRecord(JsonRecord):
    """`images/imported.json`: cameras, kinds of files and recordings, and what was left out."""

    path: ClassVar = "images/imported.json"
    cameras: dict[str, CameraRow]
    kinds: dict[str, int]
    recordings: dict[str, RecordingRow]
    left_out: dict[str, tuple[str, ...]]
    """Names by reason, of files that were looked into."""

    def lines(self) -> list[str]:
        """A line for each camera that was recognised, each recording, and each reason."""
        rows = self.cameras.values()
        sizes = {(row.width_px, row.height_px) for row in rows}
        known = len(sizes) > 1 or any(row.device for row in rows)
        return [
            *(f"{name}: {row}" for name, row in self.cameras.items() if known),
            *(f"{name}: {row}" for name, row in self.recordings.items()),
            *(
                f"left out: {len(names)} {reason} ({list_names(names, _NAMED)}); {_WHY[reason]}"
                for reason, names in self.left_out.items()
            ),
        ]


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
    lines: Sequence[str] = ()
    """A line for each camera, recording and reason."""

    def __str__(self) -> str:
        """A line such as `68 pictures (68 PNG) of left and right, 0 with a position`; the lines."""
        total = sum(self.cameras.values())
        *others, last = self.cameras
        of = f" of {', '.join(others)} and {last}" if others else ""
        kinds = ", ".join(f"{count} {what}" for what, count in self.kinds.items())
        text = f"{total} pictures ({kinds}){of}, {self.positions} with a position"
        for name, count in self.readings.items():
            text += f", {count} with {name}" if count > self.positions else ""
        return "\n".join([text, *self.lines])


def import_record(
    entries: Sequence[Incoming],
    order: Sequence[str],
    recordings: Sequence[Recording],
    left_out: Mapping[str, Sequence[str]],
) -> ImportRecord:
    """Count what came in.

    Args:
        entries: pictures that were imported.
        order: names of cameras, first ones first.
        recordings: whose frames they are, if they are.
        left_out: names of pictures that were not imported, by reason.
    """
    counts = Counter(entry.camera for entry in entries)
    some = {entry.camera: entry.facts for entry in entries}
    frames = Counter(entry.recording for entry in entries)
    kinds = Counter(FRAMES if e.recording else kind_of(e.source) for e in entries)
    rows: dict[str, RecordingRow] = {}
    for recording in recordings:
        last = recording.files[-1]
        rows[recording.name] = RecordingRow(
            files=tuple(file.path.name for file in recording.files),
            frames=frames[recording.name],
            duration_s=last.start_s + last.duration_s,
            start=None if recording.start is None else recording.start.isoformat(" ", "seconds"),
            clock=recording.clock,
        )
    return ImportRecord(
        cameras={
            name: CameraRow(
                pictures=counts[name], width_px=some[name].width_px,
                height_px=some[name].height_px, device=some[name].device,
            )
            for name in dict.fromkeys([*order, *sorted(counts)])
            if counts[name]
        },
        kinds=dict(kinds),
        recordings=rows,
        left_out={reason: tuple(names) for reason, names in left_out.items()},
    )  # fmt: skip


def with_folders(record: ImportRecord, folders: Sequence[PictureFolder]) -> ImportRecord:
    """The record with what the folders hold now that is not imported."""
    found: dict[str, list[str]] = {reason: list(names) for reason, names in record.left_out.items()}
    for folder in folders:
        for reason, paths in folder.left_out.items():
            names = [str(path.relative_to(folder.folder)) for path in paths]
            found.setdefault(reason, []).extend(names)
    left_out = {reason: tuple(names) for reason, names in found.items()}
    return record.model_copy(update={"left_out": left_out})


def summary(
    workspace: Path, records: Sequence[ImageRecord], folders: Sequence[PictureFolder], *,
    changed: bool,
) -> ImportedPictures:  # fmt: skip
    """Counts of a finished import."""
    record = with_folders(ImportRecord.read(workspace / ImportRecord.path), folders)
    return ImportedPictures(
        changed=changed,
        cameras={name: row.pictures for name, row in record.cameras.items()},
        kinds=record.kinds,
        positions=sum(one.has_position for one in records),
        readings=readings_of(records),
        left_out={reason: len(names) for reason, names in record.left_out.items()},
        lines=record.lines(),
    )


_MAX_HEADERS = 300
_MAX_CAMERAS = 8
_ALIKE = 0.02
"""Folders of a rig's cameras hold equally many pictures, but for this share that one dropped."""


@dataclass(frozen=True, kw_only=True)
class PreviewedCamera:
    """A camera whose pictures were found."""

    name: str
    pictures: int
    """Their number; of headers that were looked at, scaled, where several cameras share folders."""
    width_px: int
    height_px: int
    """0 where only decoding can tell."""
    device: str


@dataclass(frozen=True, kw_only=True)
class Preview:
    """What an import would find."""

    cameras: tuple[PreviewedCamera, ...]
    pictures: int
    looked_at: int
    """How many headers were read."""
    kinds: Mapping[str, int]
    size_mb: float
    """On disk; a workspace holds a copy."""
    masks: int
    videos: int
    video_s: float
    first_utc: str | None
    last_utc: str | None
    """Times of the first and the last picture that states one, ISO 8601."""
    timed: int
    """Of those looked at."""
    with_gps: int
    navigation: str
    """What a navigation log holds and how many of the times fall into it; empty without one."""
    warnings: tuple[str, ...]


def preview_import(
    folders: Sequence[Path] = (),
    *,
    cameras: Mapping[str, Path] | None = None,
    videos: Sequence[Path] = (),
    recursive: bool = False,
    navigation: Path | None = None,
    clock_offset_s: float = 0.0,
    time_zone: str = "UTC",
    rig: Path | None = None,
) -> Preview:
    """Look at what `import_images` would take, with the same arguments.

    Raises:
        AliceError: the import would be refused: a folder without pictures, a log that cannot be
            read, a rig of other cameras.
    """
    zone = find_zone(time_zone)
    cameras = cameras or {}
    if not (folders or cameras or videos):
        raise ImageError("no folder is given: choose the one that holds the pictures")
    with heard() as warnings:
        known_rig = None if rig is None else read_rig(rig)
        log = None if navigation is None else read_navigation(navigation, zone, ())
        apart = [*folders, *cameras.values()]
        rigged = {
            name: look_into(path, apart, recursive=recursive) for name, path in cameras.items()
        }
        unnamed = [look_into(path, apart, recursive=recursive) for path in folders]
        recordings = read_recordings(find_videos(videos), zone) if videos else []
    every = [*rigged.values(), *unnamed]
    warnings += [line for each in every for line in each.warnings()]
    rows, facts = [], list[PictureFacts]()
    mono = "camera" if known_rig is None else known_rig.reference
    sides = {name: folder.pictures for name, folder in rigged.items()}
    if unnamed:
        sides[mono] = tuple(path for folder in unnamed for path in folder.pictures)
    for name, paths in sides.items():
        seen = _headers(paths)
        facts += seen
        rows += _rows(seen, len(paths), name, apart=bool(unnamed) and known_rig is None)
    _check_rig(rows, known_rig)
    warnings += _unreadable(facts)
    times = sorted(to_utc(one.time_local, zone) for one in facts if one.time_local is not None)
    lasting = {r.name: r.files[-1].start_s + r.files[-1].duration_s for r in recordings}
    spans = list(times)
    for recording in recordings:
        if recording.start is not None:
            start = to_utc(recording.start, zone)
            spans += [start, start + timedelta(seconds=lasting[recording.name])]
    pictures = [path for paths in sides.values() for path in paths]
    files = [*pictures, *(file.path for r in recordings for file in r.files)]
    return Preview(
        cameras=tuple(rows),
        pictures=len(pictures),
        looked_at=len(facts),
        kinds=dict(Counter(kind_of(path) for path in pictures)),
        size_mb=sum(path.stat().st_size for path in files) / 1e6,
        masks=sum(len(folder.masks) for folder in every),
        videos=len(recordings),
        video_s=sum(lasting.values()),
        first_utc=min(spans).isoformat(timespec="seconds") if spans else None,
        last_utc=max(spans).isoformat(timespec="seconds") if spans else None,
        timed=len(times),
        with_gps=sum(one.latitude_deg is not None for one in facts),
        navigation="" if log is None else _navigation(log, times, spans, clock_offset_s),
        warnings=tuple(warnings),
    )


def cameras_in(folder: Path) -> dict[str, Path]:
    """Folders inside one that look like those of a rig's cameras: equally many pictures in each.

    Returns:
        Folders by name, in order; empty where there are not 2 to 8 of them, where the folder
        holds pictures of its own, or where their numbers differ.
    """
    counts: dict[str, int] = {}
    try:
        inside = sorted(p for p in folder.iterdir() if not p.name.startswith("."))
        for path in inside:
            if path.is_file() and kind_of(path):
                return {}
            if path.is_dir() and not path.is_symlink():
                counts[path.name] = sum(1 for p in path.iterdir() if kind_of(p))
    except OSError as error:
        raise ImageError(f"{folder}: cannot be read: {error.strerror}") from None
    counts = {name: count for name, count in counts.items() if count}
    if not 2 <= len(counts) <= _MAX_CAMERAS:
        return {}
    maximum, minimum = max(counts.values()), min(counts.values())
    return {name: folder / name for name in counts} if maximum - minimum <= _ALIKE * maximum else {}


def _headers(paths: Sequence[Path]) -> list[PictureFacts]:
    """Headers of pictures, or of some of them, evenly spread, with the first and the last."""
    chosen = np.unique(np.linspace(0, len(paths) - 1, min(len(paths), _MAX_HEADERS)).round())
    return [read_header(paths[int(i)]) for i in chosen]


def _rows(
    facts: Sequence[PictureFacts], pictures: int, name: str, *, apart: bool
) -> list[PreviewedCamera]:
    """The cameras of some pictures; told apart by device and size if that is wanted."""
    counts = Counter(camera_key(one) for one in facts if not one.fault).most_common()
    if not apart:
        counts = counts[:1]
    total = sum(count for _, count in counts)
    return [
        PreviewedCamera(
            name=name if number == 1 else f"{name}-{number}",
            pictures=round(pictures * count / total), width_px=width, height_px=height,
            device=device,
        )
        for number, ((device, width, height), count) in enumerate(counts, 1)
    ]  # fmt: skip


def _check_rig(rows: Sequence[PreviewedCamera], rig: Rig | None) -> None:
    """Check that a rig is of these cameras, as far as headers show it."""
    if rig is None:
        return
    for row in rows:
        if row.name not in rig.cameras:
            raise ImageError(
                f"the rig has no camera {row.name!r}, only {', '.join(rig.cameras)}: call the "
                "folders as the rig does"
            )
        model = rig.cameras[row.name]
        if row.width_px and (row.width_px, row.height_px) != (model.width_px, model.height_px):
            raise ImageError(
                f"pictures of {row.name} have {row.width_px} x {row.height_px} pixels, but those "
                f"of the rig {model.width_px} x {model.height_px}: give the rig of these pictures, "
                "or none"
            )


def _unreadable(facts: Sequence[PictureFacts]) -> list[str]:
    faulty = [one.path.name for one in facts if one.fault]
    if not faulty:
        return []
    return [
        f"{len(faulty)} of {len(facts)} that were looked at cannot be read: {list_names(faulty, 3)}"
    ]


def _navigation(
    log: NavigationLog,
    times: Sequence[datetime],
    spans: Sequence[datetime],
    clock_offset_s: float,
) -> str:
    """What a log holds, and how many picture times fall into it."""
    known = [name for name, values in log.columns.items() if np.isfinite(values).any()]
    text = f"{len(log.time_s)} rows with {', '.join(known)}"
    if log.start_utc is None:
        return f"{text}, on a clock without dates: the first picture counts as second 0 of it"
    first, last = log.start_utc, log.start_utc + timedelta(seconds=float(log.time_s[-1]))
    text += f", {first:%Y-%m-%d %H:%M:%S} to {last:%H:%M:%S} UTC"
    if not spans:
        return f"{text}; the pictures state no times, so it cannot be tied to them"
    offset = timedelta(seconds=clock_offset_s)
    if max(spans) + offset < first or min(spans) + offset > last:
        raise ImageError(
            f"no picture was taken while navigation was logged: pictures from "
            f"{min(spans):%Y-%m-%d %H:%M:%S} to {max(spans):%H:%M:%S} UTC, log from "
            f"{first:%Y-%m-%d %H:%M:%S} to {last:%H:%M:%S}: check time zone and clock offset"
        )
    inside = sum(first <= time + offset <= last for time in times)
    return f"{text}; {inside} of {len(times)} picture times fall into it" if times else text


_MONO = "camera"
_SCRATCH = "bag"
"""Folder for pictures of a bag until they are checked."""


def import_images(
    workspace: Path,
    folders: Sequence[Path],
    *,
    cameras: Mapping[str, Path] = MappingProxyType({}),
    videos: Sequence[Path] = (),
    bag: Path | None = None,
    topics: Mapping[str, str] = MappingProxyType({}),
    overlap: float | None = None,
    every_s: float | None = None,
    recursive: bool = False,
    navigation: Path | None = None,
    clock_offset_s: float = 0.0,
    time_zone: str = "UTC",
    vertical_datum: str | None = None,
    rig: Path | None = None,
    masks: Path | None = None,
    triggers: Path | None = None,
    executor: Executor = SERIAL,
) -> ImportedPictures:
    """Write `images/` from pictures, of cameras on a rig or not, or from videos.

    A picture that cannot be decoded to its end, a copy of another and a mirror image are left out
    with a warning; the others of the station stay. Videos, folders inside and other files are left
    out with a warning for each kind. Pixels are those that are stored: an EXIF orientation does not
    turn them. Without a rig, pictures of one folder that EXIF or sizes show to be of several
    cameras are those of `camera`, `camera-2` and so on.

    Where each picture was taken comes from the navigation log, else from GPS in EXIF or in the
    video, else from nothing: then the model will have neither scale nor CRS.

    Args:
        workspace: folder of the survey.
        folders: folders of pictures that are taken one by one, in order; or videos.
        cameras: folder of each camera of a rig by its name, such as left and right; which pictures
            are of one moment, `pairing` says.
        videos: to take frames from, or folders of them; chapters of a GoPro are one recording.
        bag: a bag of ROS 1 or ROS 2 with pictures, which are paired by their times.
        topics: of the bag's pictures, by camera; empty for those of one or of a left and a right.
        overlap: of neighbouring frames; None for 0.7 unless there is an interval.
        every_s: seconds between frames of videos, instead of an overlap, or between moments of a
            bag.
        recursive: take pictures of folders inside too.
        navigation: CSV with time and any of position, depth, attitude and altitude (see
            `read_navigation`).
        clock_offset_s: what to add to the times of pictures to get those of navigation.
        time_zone: of dates that name none, in EXIF and navigation.
        vertical_datum: name of the level that the depths of navigation count from, such as that of
            the tide which `import-log` took off; None for the sea surface.
        rig: `rig.json` of the cameras; its lever arm says that navigation is of the body.
        masks: folder of masks (0 = leave out) with the stems of the pictures, or with a folder per
            camera; without it `NAME_mask.png` next to a picture is its mask.
        triggers: CSV with the time of every picture, see `pair_by_time`.
        executor: where tasks run.

    Returns:
        How many pictures of which kind there are now, and what was left out.

    Raises:
        ImageError: pictures are missing, a folder is given twice, or pictures do not pair, are of
            different sizes, or too few.
        NavigationError: the navigation log cannot be used, or a level is named without one.
        CalibrationError: the rig file is wrong or not that of the pictures.
    """
    videos = [*videos, *(f for f in folders if f.is_file() and f.suffix.lower() in VIDEO)]
    folders = [folder for folder in folders if folder not in videos]
    _check_sources(folders, cameras, videos, bag)
    if triggers is not None and not (folders or cameras):
        raise ImageError("--triggers is for folders of pictures: videos and bags have times")
    frames = _frame_settings(overlap, every_s, videos, bag)
    if not np.isfinite(clock_offset_s):
        raise ImageError(f"--clock-offset {clock_offset_s} is not a number of seconds")
    zone = find_zone(time_zone)
    logged_level = checked_level(vertical_datum, navigation)
    given = [
        *folders,
        *cameras.values(),
        *videos,
        *(p for p in (bag, navigation, rig, masks, triggers) if p is not None),
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
    found_videos = find_videos(videos)
    sides = _look_into(folders, cameras, mono, [*given, workspace], recursive)
    folders_read = [each for side in sides.values() for each in side]
    files = [file for each in folders_read for file in (*each.pictures, *each.masks)]
    stage = Stage(
        name="images",
        version=4,
        settings={
            "folders": len(folders),
            "stereo": bool(cameras),
            **({} if bag is None else {"topics": dict(topics)}),
            **({} if set(cameras) in (set(), {"left", "right"}) else {"cameras": list(cameras)}),
            "every_s": frames.every_s,
            "overlap": frames.overlap if videos else None,
            "videos": [path.name for path in found_videos],
            "recursive": recursive,
            "navigation": navigation is not None,
            "clock_offset_s": clock_offset_s,
            "time_zone": time_zone,
            "vertical_datum": vertical_datum,
            "rig": rig is not None,
            "masks": masks is not None,
            **({} if triggers is None else {"triggers": True}),
        },
        inputs=[
            *files,
            *found_videos,
            *(path for path in (bag, navigation, rig, masks, triggers) if path is not None),
        ],
    )

    def work(partial: Path) -> None:
        notes: list[str] = []
        log = None if navigation is None else read_navigation(navigation, zone, ())
        recordings: list[Recording] = []
        left_out: dict[str, list[str]] = {}
        if found_videos:
            recordings = read_recordings(found_videos, zone)
            names = [mono] * len(recordings) if known_rig else _cameras_of(recordings, mono)
            entries = take_frames(recordings, names, frames, partial)
        else:
            for each in folders_read:
                for line in each.warnings():
                    warn(line)
            found: BagPictures | PairedPictures
            if bag is None:
                paths = {name: [p for f in own for p in f.pictures] for name, own in sides.items()}
                found = pair_by_time(paths, triggers, zone)
            else:
                found = take_bag(bag, topics, mono, partial / _SCRATCH, every_s)
            entries, left_out = find_entries(found.stations, executor)
            entries = [
                at_time(entry, found.time_s[entry.source]) if found.time_s else entry
                for entry in entries
            ]
            if folders and known_rig is None:
                entries = by_camera(entries, mono)
        check_entries(entries, known_rig)
        entries = named_apart(entries)
        entries = [replace(e, mask=mask_of(e, masks, bool(cameras))) for e in entries]
        if not found_videos:
            notes += copy_all(entries, partial, executor)
            shutil.rmtree(partial / _SCRATCH, ignore_errors=True)
        records = [record_of(entry, partial) for entry in entries]
        records, datum, level = placed(
            entries, records, log, logged_level, clock_offset_s, zone, notes
        )
        records = sorted(records, key=lambda r: (r.station, r.camera))
        write_manifest(partial / "manifest.csv", records)
        if known_rig is not None:
            taken = {entry.camera for entry in entries}
            names = [name for name in known_rig.cameras if name in taken]
            write_rig(partial / "rig.json", part_of_rig(known_rig, names))
        record = import_record(entries, list(sides), recordings, left_out)
        record.write(partial / Path(ImportRecord.path).name)
        notes += with_folders(record, folders_read).lines()
        PicturesRecord.save(
            partial / "survey.json",
            {"source": "imported", "datum": datum, "vertical_datum": level, "notes": notes},
        )

    changed = run_stage(workspace, stage, work)
    records = read_manifest(workspace / "images" / "manifest.csv")
    return summary(workspace, records, folders_read, changed=changed)


def _look_into(
    folders: Sequence[Path],
    cameras: Mapping[str, Path],
    mono: str,
    apart: Sequence[Path],
    recursive: bool,
) -> dict[str, list[PictureFolder]]:
    """Contents of the folders of each camera; `mono` names the one camera of unnamed folders."""
    if cameras:
        return {
            name: [look_into(folder, apart, recursive=recursive)]
            for name, folder in cameras.items()
        }
    if not folders:
        return {}
    return {mono: [look_into(folder, apart, recursive=recursive) for folder in folders]}


def _cameras_of(recordings: Sequence[Recording], mono: str) -> list[str]:
    """Camera of each recording: those of one size are one; that of most seconds has the name."""
    seconds: Counter[tuple[int, int]] = Counter()
    for recording in recordings:
        seconds[recording.size] += round(sum(file.duration_s for file in recording.files) + 1)
    names = [mono, *(f"{mono}-{number}" for number in range(2, len(seconds) + 1))]
    by_size = {size: name for (size, _), name in zip(seconds.most_common(), names, strict=True)}
    return [by_size[recording.size] for recording in recordings]


def _check_sources(
    folders: Sequence[Path],
    cameras: Mapping[str, Path],
    videos: Sequence[Path],
    bag: Path | None,
) -> None:
    if sum([bool(folders), bool(cameras), bool(videos), bag is not None]) != 1:
        raise ImageError(
            "give folders of pictures, or --left and --right, or --camera for each camera, or "
            "--video, or --bag: one of them"
        )
    every = [*folders, *cameras.values()]
    places = [folder.resolve() for folder in every]
    twice = [folder for folder in every if places.count(folder.resolve()) > 1]
    if twice:
        raise ImageError(f"{twice[0]} is given twice")


def _frame_settings(
    overlap: float | None, every_s: float | None, videos: Sequence[Path], bag: Path | None
) -> FrameSettings:
    if not videos and (overlap is not None or (every_s is not None and bag is None)):
        raise ImageError("--overlap and --every choose frames of a video: give --video too")
    if overlap is not None and every_s is not None:
        raise ImageError("--overlap and --every exclude each other: give one of them")
    if every_s is not None and not every_s > 0:
        raise ImageError(f"--every {every_s}: seconds between frames must be more than 0")
    if overlap is not None and not MIN_OVERLAP <= overlap <= MAX_OVERLAP:
        raise ImageError(
            f"--overlap {overlap}: neighbouring frames share {MIN_OVERLAP} to {MAX_OVERLAP}"
        )
    return FrameSettings(overlap=DEFAULT_OVERLAP if overlap is None else overlap, every_s=every_s)
