"""Real pictures into a workspace: checked, named, timed and placed; the stage `images/`.

What folders, videos and logs hold is scanned once, before a picture is decoded (`scan_sources`).
`preview_import` counts it from headers alone, of all pictures or of some spread evenly, so that
folders of any size take seconds; the import goes on from it, and finds what only decoding shows,
such as damaged files.
"""

import os
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import timedelta, tzinfo
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import ClassVar

import numpy as np
from pydantic import Field

from alice_survey.core import artefacts
from alice_survey.core.errors import (
    CalibrationError,
    ImageError,
    PlanError,
    WorkspaceError,
    file_faults,
    keep_warnings,
)
from alice_survey.core.executor import SERIAL, Executor
from alice_survey.core.manifest import ImageRecord, read_manifest, write_manifest
from alice_survey.core.records import PicturesRecord
from alice_survey.kit import words
from camera_calib.freedom import part_of_rig
from camera_calib.rig import Rig, read_rig, write_rig
from missions.logs.navigation_csv import NavigationLog, find_zone, read_navigation
from missions.values.plan_file import Plan, read_plan
from reconstruct.pictures import files, incoming
from reconstruct.pictures.videos import (
    DEFAULT_OVERLAP,
    Recording,
    find_videos,
    read_recordings,
    take_frames,
)
from reconstruct.stages import rig_file

_NO_HEADER = "headers that cannot be read"
_ADVICE = {
    _NO_HEADER: "copy them from the camera again",
    incoming.UNDECODABLE: "copy them from the camera again",
    incoming.MIRRORED: "save them as they are seen, without an EXIF orientation",
    incoming.COPIES: "each file counts once",
    incoming.SHOTS: "of each the RAW is taken, else that of most pixels, else no JPEG",
    **files.ADVICE,
}
_NAMED = 3
FRAMES = "frames of videos"


class CameraRow(artefacts.JsonRecord):
    """A camera that took pictures."""

    pictures: int
    """Their number; of a preview, scaled from the headers where several share folders."""
    width_px: int
    height_px: int
    """0 where only decoding can tell."""
    device: str = ""

    def __str__(self) -> str:
        """Such as `34 of 5184 x 3888 pixels, GoPro HERO9 Black`."""
        text = f"{self.pictures} of {self.width_px} x {self.height_px} pixels"
        return f"{text}, {self.device}" if self.device else text


class RecordingRow(artefacts.JsonRecord):
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


class ImportRecord(artefacts.JsonRecord):
    """`images/imported.json`: what a workspace got, and what was left out."""

    path: ClassVar = "images/imported.json"
    cameras: dict[str, CameraRow]
    kinds: dict[str, int]
    """Pictures by kind of file."""
    recordings: dict[str, RecordingRow]
    left_out: dict[str, tuple[str, ...]]
    """Names by reason, of what folders hold and is not imported."""
    positions: int = 0
    """Number of pictures with a known position; of a preview, of the headers with GPS."""
    readings: dict[str, int] = Field(default_factory=dict)
    """Pictures by what navigation measured of them."""
    changed: bool = Field(False, exclude=True)
    """False when all was there already."""

    @property
    def omissions(self) -> list[str]:
        """A line for each reason: how many were left out, such as which, and what to do."""
        return [
            f"left out: {len(some)} {reason} ({files.list_names(some, _NAMED)}); {_ADVICE[reason]}"
            for reason, some in self.left_out.items()
        ]

    @property
    def lines(self) -> list[str]:
        """A line for each camera that was recognised, each recording, and each reason."""
        rows = self.cameras.values()
        sizes = {(row.width_px, row.height_px) for row in rows}
        known = len(sizes) > 1 or any(row.device for row in rows)
        return [
            *(f"{name}: {row}" for name, row in self.cameras.items() if known),
            *(f"{name}: {row}" for name, row in self.recordings.items()),
            *self.omissions,
        ]

    def __str__(self) -> str:
        """A line such as `68 pictures (68 PNG) of left and right, 0 with a position`; the lines."""
        total = sum(row.pictures for row in self.cameras.values())
        *others, last = self.cameras
        of = f" of {', '.join(others)} and {last}" if others else ""
        kinds = ", ".join(f"{count} {what}" for what, count in self.kinds.items())
        text = f"{words.count(total, 'picture')} ({kinds}){of}, {self.positions} with a position"
        for name, count in self.readings.items():
            text += f", {count} with {name}" if count > self.positions else ""
        return "\n".join([text, *self.lines])


class Preview(ImportRecord):
    """What an import would find."""

    pictures: int
    looked_at: int
    """How many headers were read."""
    size_mb: float
    """On disk; a workspace holds a copy."""
    videos: int
    video_s: float
    first_utc: str | None
    last_utc: str | None
    """Times of the first and the last picture that states one, ISO 8601."""
    navigation: str
    """What a navigation log holds and how many of the times fall into it; empty without one."""
    warnings: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class ImportScan:
    """What folders, videos and a log hold, before any picture is decoded."""

    folders: Mapping[str, Sequence[files.PictureFolder]]
    """By camera; folders without a name are those of `mono`."""
    videos: Sequence[Path]
    navigation: Path | None
    rig: Rig | None
    mono: str
    """Name of the camera of folders, videos and topics without one."""
    zone: tzinfo
    """Of dates that name none."""
    split: bool
    """Whether pictures and frames hold those of a left and a right camera side by side."""
    unnamed: bool
    """Whether the folders are of cameras that only their pictures tell apart."""

    @property
    def every_folder(self) -> list[files.PictureFolder]:
        """All folders."""
        return [folder for own in self.folders.values() for folder in own]

    @cached_property
    def shots(self) -> dict[Path, list[Path]]:
        """Other files of the same shot, by the one that is taken."""
        every = [[p for f in own for p in f.pictures] for own in self.folders.values()]
        return {first: others for own in every for first, *others in files.same_shots(own)}

    @cached_property
    def pictures(self) -> dict[str, list[Path]]:
        """Pictures by camera, one of each shot."""
        twice = {path for others in self.shots.values() for path in others}
        return {
            name: [p for f in own for p in f.pictures if p not in twice]
            for name, own in self.folders.items()
        }

    @cached_property
    def recordings(self) -> list[Recording]:
        """Recordings of the videos."""
        return read_recordings(self.videos, self.zone) if self.videos else []

    @cached_property
    def log(self) -> NavigationLog | None:
        """The navigation log."""
        if self.navigation is None:
            return None
        return read_navigation(self.navigation, self.zone, (), by_picture=True)

    def record(
        self,
        cameras: Mapping[str, CameraRow],
        kinds: Mapping[str, int],
        frames: Mapping[str, int],
        left_out: Mapping[str, Sequence[str]],
    ) -> ImportRecord:
        """What came in, and what did not: by its content, then by what folders hold besides."""
        lost = {reason: list(names) for reason, names in left_out.items() if names}
        for folder in self.every_folder:
            for reason, paths in folder.left_out.items():
                lost.setdefault(reason, []).extend(str(p.relative_to(folder.folder)) for p in paths)
        return ImportRecord(
            cameras=dict(cameras),
            kinds=dict(kinds),
            recordings={
                recording.name: RecordingRow(
                    files=tuple(file.path.name for file in recording.files),
                    frames=frames.get(recording.name, 0),
                    duration_s=recording.duration_s,
                    start=recording.start and recording.start.isoformat(" ", "seconds"),
                    clock=recording.clock,
                )
                for recording in self.recordings
            },
            left_out={reason: tuple(names) for reason, names in lost.items()},
        )


def scan_sources(
    folders: Sequence[Path],
    cameras: Mapping[str, Path],
    videos: Sequence[Path],
    *,
    bag: Path | None = None,
    recursive: bool = False,
    navigation: Path | None = None,
    time_zone: str = "UTC",
    rig: Path | None = None,
    apart: Sequence[Path] = (),
    split: bool = False,
) -> ImportScan:
    """List what an import would take; arguments as of `import_images`, `apart` as of `look_into`.

    Raises:
        ImageError: not one kind of source is given, one is given twice or holds nothing.
        NavigationError: the time zone is not known.
        CalibrationError: the rig cannot be read.
    """
    if sum([bool(folders), bool(cameras), bool(videos), bag is not None]) != 1:
        raise ImageError(
            "give folders of pictures, or --left and --right, or --camera for each camera, or "
            "--video, or --bag: one of them"
        )
    if split and (cameras or bag is not None):
        raise ImageError("--split cuts the pictures of folders or the frames of videos: give these")
    every = [*folders, *cameras.values()]
    places = [folder.resolve() for folder in every]
    twice = [folder for folder in every if places.count(folder.resolve()) > 1]
    if twice:
        raise ImageError(f"{twice[0]} is given twice")
    known_rig = None if rig is None else read_rig(rig)
    mono = "camera" if known_rig is None else known_rig.reference
    named = {name: [path] for name, path in cameras.items()}
    if folders:
        named = {mono: [*folders]}
    found = ImportScan(
        folders={
            name: [files.look_into(path, [*every, *apart], recursive=recursive) for path in paths]
            for name, paths in named.items()
        },
        videos=find_videos(videos),
        navigation=navigation,
        rig=known_rig,
        mono=mono,
        zone=find_zone(time_zone),
        split=split,
        unnamed=bool(folders) and known_rig is None and not split,
    )
    if split:
        taken = [path for own in found.pictures.values() for path in own]
        widths = {path.name: files.read_header(path).width_px for path in taken}
        widths |= {recording.name: recording.size[0] for recording in found.recordings}
        if odd := next((name for name, width in widths.items() if width % 2), ""):
            raise ImageError(f"{odd} is {widths[odd]} pixels wide, which are no two halves")
    return found


_MAX_HEADERS = 300
_MAX_CAMERAS = 8
_DROPPED_SHARE = 0.02
"""Folders of a rig's cameras hold equally many pictures, but for this share that one dropped."""


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
    split: bool = False,
) -> Preview:
    """Look at what `import_images` would take, with the same arguments.

    Raises:
        AliceError: the import would be refused: a folder without pictures, a log that cannot be
            read, a rig of other cameras.
    """
    with keep_warnings() as warnings:
        scan = scan_sources(
            folders, cameras or {}, videos, recursive=recursive, navigation=navigation,
            time_zone=time_zone, rig=rig, split=split,
        )  # fmt: skip
        log, recordings = scan.log, scan.recordings
    rows, facts = dict[str, CameraRow](), list[files.PictureFacts]()
    for name, paths in scan.pictures.items():
        # Some headers, evenly spread, with the first and the last.
        chosen = np.unique(np.linspace(0, len(paths) - 1, min(len(paths), _MAX_HEADERS)).round())
        seen = [files.read_header(paths[int(i)]) for i in chosen]
        facts += seen
        names = incoming.camera_names([one for one in seen if not one.fault], name)
        names = names if scan.unnamed else names[:1]
        total = sum(count for _, _, count in names)
        for camera, (device, width, height), count in names:
            sides = incoming.SIDES if split else (camera,)
            row = CameraRow(
                pictures=round(len(paths) * count / total), width_px=width // len(sides),
                height_px=height, device=device,
            )  # fmt: skip
            rows |= dict.fromkeys(sides, row)
    if scan.rig is not None:
        incoming.check_rig(
            {name: (row.width_px, row.height_px) for name, row in rows.items()}, scan.rig
        )
    times = [files.to_utc(one.time_local, scan.zone) for one in facts if one.time_local is not None]
    began = [(files.to_utc(r.start, scan.zone), r.duration_s) for r in recordings if r.start]
    spans = [*times, *(t for t, _ in began), *(t + timedelta(seconds=s) for t, s in began)]
    pictures = [path for paths in scan.pictures.values() for path in paths]
    every = [*pictures, *(file.path for r in recordings for file in r.files)]
    text = ""
    if log is not None:
        known = [name for name, values in log.columns.items() if np.isfinite(values).any()]
        text = f"{words.count(len(log.time_s), 'row')} with {', '.join(known)}"
        if log.row_of:
            text += ", by names of pictures"
        elif log.start_utc is not None:
            last = log.start_utc + timedelta(seconds=float(log.time_s[-1]))
            offset = timedelta(seconds=clock_offset_s)
            inside = sum(log.start_utc <= time + offset <= last for time in times)
            text += f", {log.span(log.time_s)}; {inside} of {len(times)} picture times fall into it"
    record = scan.record(
        rows, Counter(files.kind_of(path) for path in pictures), Counter(),
        {_NO_HEADER: [one.path.name for one in facts if one.fault],
         incoming.SHOTS: [p.name for others in scan.shots.values() for p in others]},
    )  # fmt: skip
    return Preview(
        **dict(record) | {
            "positions": sum(one.latitude_deg is not None for one in facts),
            "pictures": len(pictures),
            "looked_at": len(facts),
            "size_mb": sum(path.stat().st_size for path in every) / 1e6,
            "videos": len(recordings),
            "video_s": sum(r.duration_s for r in recordings),
            "first_utc": min(spans).isoformat(timespec="seconds") if spans else None,
            "last_utc": max(spans).isoformat(timespec="seconds") if spans else None,
            "navigation": text,
            "warnings": (*warnings, *record.omissions),
        }
    )  # fmt: skip


def cameras_in(folder: Path) -> dict[str, Path]:
    """Folders inside one that look like those of a rig's cameras: equally many pictures in each.

    Returns:
        Folders by name, in order; empty where there are not 2 to 8 of them, where the folder
        holds pictures of its own, or where their numbers differ.
    """
    with file_faults(folder, ImageError):
        inside = sorted(p for p in folder.iterdir() if not p.name.startswith("."))
        if any(path.is_file() and files.kind_of(path) for path in inside):
            return {}
        counts = {
            path.name: sum(1 for p in path.iterdir() if files.kind_of(p))
            for path in inside
            if path.is_dir() and not path.is_symlink()
        }
    counts = {name: count for name, count in counts.items() if count}
    if not 2 <= len(counts) <= _MAX_CAMERAS:
        return {}
    maximum, minimum = max(counts.values()), min(counts.values())
    equal = maximum - minimum <= _DROPPED_SHARE * maximum
    return {name: folder / name for name in counts} if equal else {}


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
    split: bool = False,
    overwrite: bool = False,
    executor: Executor = SERIAL,
) -> ImportRecord:
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
        masks: folder of masks (0 = leave out), see `with_masks`, or with a folder per camera;
            without it those next to pictures.
        triggers: CSV with the time of every picture, see `pair_by_time`.
        split: cut pictures and frames into those of the left and the right camera of a rig.
        overwrite: replace the pictures of an earlier import by others.
        executor: where tasks run.

    Returns:
        How many pictures of which kind there are now, and what was left out.

    Raises:
        ImageError: pictures are missing, a folder is given twice, or pictures do not pair, are of
            different sizes, or too few.
        NavigationError: the navigation log cannot be used, or a level is named without one.
        CalibrationError: the rig file is wrong or not that of the pictures.
    """
    videos = [*videos, *(f for f in folders if f.is_file() and f.suffix.lower() in files.VIDEO)]
    folders = [folder for folder in folders if folder not in videos]
    if triggers is not None and not (folders or cameras):
        raise ImageError("--triggers is for folders of pictures: videos and bags have times")
    if not videos and (overlap is not None or (every_s is not None and bag is None)):
        raise ImageError("--overlap and --every choose frames of a video: give --video too")
    if overlap is not None and every_s is not None:
        raise ImageError("--overlap and --every exclude each other: give one of them")
    if not np.isfinite(clock_offset_s):
        raise ImageError(f"--clock-offset {clock_offset_s} is not a number of seconds")
    level_name = incoming.level_of_log(vertical_datum, navigation)
    more = [path for path in (bag, navigation, rig, masks, triggers) if path is not None]
    given = [*folders, *cameras.values(), *videos, *more]
    _check_paths(workspace, given)
    scan = scan_sources(
        folders, cameras, videos, bag=bag, recursive=recursive, navigation=navigation,
        time_zone=time_zone, rig=rig, apart=[*given, workspace], split=split,
    )  # fmt: skip
    if not overwrite:
        taken = [path for folder in scan.every_folder for path in folder.pictures]
        taken += [*scan.videos, *([bag] if bag else [])]
        _refuse_others(workspace, taken, ", or 'import-images --replace'")
    frame_overlap = DEFAULT_OVERLAP if overlap is None else overlap
    stage = artefacts.Stage(
        name="images",
        version=7,
        command="import-images",
        settings={
            "folders": len(folders),
            "cameras": list(cameras),
            "topics": dict(topics),
            "every_s": every_s,
            "overlap": frame_overlap if videos else None,
            "recursive": recursive,
            "split": split,
            "clock_offset_s": clock_offset_s,
            "time_zone": time_zone,
            "vertical_datum": vertical_datum,
            "given": [one is not None for one in (bag, navigation, rig, masks, triggers)],
        },
        inputs=[
            *(file for each in scan.every_folder for file in (*each.pictures, *each.masks)),
            *scan.videos,
            *more,
        ],
    )

    def work(partial: Path) -> None:
        notes: list[str] = []
        left_out: dict[str, list[str]] = {}
        if scan.videos:
            one_camera = [incoming.SIDES[0] if split else scan.mono] * len(scan.recordings)
            one = split or scan.rig is not None
            names = one_camera if one else _cameras_by_size(scan.recordings, scan.mono)
            entries = take_frames(
                scan.recordings, names, partial, frame_overlap, every_s, split=split
            )
        else:
            if bag is None:
                paired = incoming.pair_by_time(scan.pictures, triggers, scan.zone)
            else:
                paired = incoming.take_bag(bag, topics, scan.mono, partial / _SCRATCH, every_s)
            entries, left_out = incoming.find_entries(paired, scan.shots, executor)
            if scan.unnamed:
                by_key = {
                    key: name
                    for name, key, _ in incoming.camera_names([e.facts for e in entries], scan.mono)
                }
                entries = [replace(entry, camera=by_key[entry.facts.key]) for entry in entries]
            if split:
                entries = [half for entry in entries for half in incoming.halves(entry)]
        incoming.check_entries(entries, scan.rig)
        entries = incoming.unique_names(entries)
        entries = incoming.with_masks(entries, masks, stereo=bool(cameras))
        if not scan.videos:
            notes += incoming.copy_all(entries, partial, executor)
            shutil.rmtree(partial / _SCRATCH, ignore_errors=True)
        records = [incoming.record_of(entry, partial) for entry in entries]
        records, datum, level = incoming.place_records(
            entries, records, scan.log, level_name, clock_offset_s, scan.zone, notes
        )
        write_manifest(
            partial / "manifest.csv", sorted(records, key=lambda r: (r.station, r.camera))
        )
        if scan.rig is not None:
            present = {entry.camera for entry in entries}
            names = [name for name in scan.rig.cameras if name in present]
            write_rig(partial / "rig.json", part_of_rig(scan.rig, names))
        counted = Counter(entry.camera for entry in entries)
        some = {entry.camera: entry.facts for entry in entries}
        record = scan.record(
            {
                name: CameraRow(
                    pictures=counted[name], width_px=some[name].width_px,
                    height_px=some[name].height_px, device=some[name].device,
                )
                for name in dict.fromkeys([*scan.folders, *sorted(counted)])
                if counted[name]
            },
            Counter(FRAMES if e.recording else files.kind_of(e.source) for e in entries),
            Counter(entry.recording for entry in entries),
            left_out,
        )  # fmt: skip
        record.write(partial / Path(ImportRecord.path).name)
        PicturesRecord(
            source="imported", datum=datum, vertical_datum=level, notes=(*notes, *record.lines)
        ).write(partial / "survey.json")

    changed = artefacts.run_stage(workspace, stage, work)
    records = read_manifest(workspace / "images" / "manifest.csv")
    return ImportRecord.read(workspace / ImportRecord.path).model_copy(
        update={
            "changed": changed,
            "positions": sum(one.has_position for one in records),
            "readings": dict(incoming.readings_of(records)),
        }
    )


def _cameras_by_size(recordings: Sequence[Recording], mono: str) -> list[str]:
    """Camera of each recording: those of one size are one; that of most seconds has the name."""
    seconds: Counter[tuple[int, int]] = Counter()
    for recording in recordings:
        seconds[recording.size] += round(sum(file.duration_s for file in recording.files) + 1)
    order = [size for size, _ in seconds.most_common()]
    numbers = [order.index(recording.size) for recording in recordings]
    return [f"{mono}-{number + 1}" if number else mono for number in numbers]


def _check_paths(workspace: Path, given: Sequence[Path]) -> None:
    """Check that what is given exists, and that a workspace may have these pictures."""
    images = workspace / "images"
    for path in given:
        if not path.exists():
            raise ImageError(f"{path}: no such file or folder")
        if path.resolve().is_relative_to(images.resolve()):
            raise WorkspaceError(f"{path} is inside {images}, which is written again")
    for simulated in (images / "truth", workspace / "pool" / "truth"):
        if simulated.exists():
            raise WorkspaceError(
                f"{workspace} holds a simulated survey, whose rig is not that of real pictures: "
                "choose another workspace with -w"
            )


def _refuse_others(workspace: Path, pictures: Sequence[Path], way_on: str) -> None:
    """Refuse to replace pictures that were imported by others, of which none was among them."""
    stage = artefacts.read_stage(workspace / "images")
    before = {} if stage is None else stage.inputs
    moved = {(Path(name).name, *entry[:2]) for name, entry in before.items()}
    for path in (f for p in pictures for f in (p.rglob("*") if p.is_dir() else [p])):
        now, known = path.lstat(), os.path.relpath(path, workspace) in before
        if known or (path.name, now.st_size, now.st_mtime_ns) in moved:
            return
    if before:
        raise WorkspaceError(
            f"{workspace} holds pictures such as {next(iter(before))}, which others would replace: "
            f"choose another workspace{way_on}"
        )


_APART_S = 86_400.0
"""Between the end of a dive and the start of the next: their clocks are their own, and errors of
navigation do not last from one to the other."""


def join_dives(workspace: Path, dives: Sequence[Path]) -> str:
    """Write `images/` with the pictures of several dives, and `plan/` with the lines of all.

    Settings are those of the first dive, and so are datum and area. Pictures of a dive lie in a
    folder of its own; stations count on from dive to dive.

    Args:
        workspace: to write; none of the dives.
        dives: workspaces with pictures, in the order of diving.

    Returns:
        What there is now, in words.

    Raises:
        WorkspaceError: there are fewer than two dives, one lacks pictures, or is the workspace.
        ImageError: depths of the dives count from different levels.
        CalibrationError: rigs of the dives differ.
        PlanError: plans of the dives have different datums.
    """
    places = [dive.resolve() for dive in dives]
    if len(set(places)) < 2 or len(set(places)) < len(places):
        raise WorkspaceError("give two dives or more, each once")
    if workspace.resolve() in places:
        raise WorkspaceError(f"{workspace} is one of the dives: choose another with -w")
    if (workspace / "images" / "truth").exists():
        raise WorkspaceError(f"{workspace} holds a simulated survey: choose another with -w")
    folders = [artefacts.need_stage(dive, "images", "import-images") for dive in dives]
    rig = _same_rig(dives)
    surveys = [PicturesRecord.read(folder / "survey.json") for folder in folders]
    rows = [read_manifest(folder / "manifest.csv") for folder in folders]
    levels = {
        survey.vertical_datum
        for survey, records in zip(surveys, rows, strict=True)
        if any(record.readings["depth"] for record in records)
    }
    if len(levels) > 1:
        raise ImageError(
            f"depths of the dives count from different levels ({', '.join(map(repr, levels))}): "
            "import them with one --vertical-datum"
        )
    inputs = [
        folder / name
        for folder, records in zip(folders, rows, strict=True)
        for name in ("manifest.csv", "survey.json", *(r.image for r in records))
    ]
    _refuse_others(workspace, inputs, "")
    stage = artefacts.Stage(
        name="images",
        version=2,
        command="join",
        settings={"joined": len(dives)},
        inputs=[*inputs, *([rig] if rig else [])],
    )

    def work(partial: Path) -> None:
        records: list[ImageRecord] = []
        for number, (folder, own) in enumerate(zip(folders, rows, strict=True), 1):
            for name in [name for r in own for name in (r.image, r.mask) if name]:
                target = partial / f"dive{number}" / name
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(folder / name, target)
            records += _append_dive(own, f"dive{number}", records)
        write_manifest(partial / "manifest.csv", records)
        if rig is not None:
            write_rig(partial / "rig.json", read_rig(rig))
        first = next((s for s in surveys if s.datum is not None), surveys[0])
        notes = tuple(dict.fromkeys(note for s in surveys for note in s.notes))
        level = next(iter(levels), first.vertical_datum)
        first.model_copy(
            update={"source": "imported", "notes": notes, "vertical_datum": level}
        ).write(partial / "survey.json")

    _join_plans(workspace, dives)
    artefacts.run_stage(workspace, stage, work)
    if (dives[0] / "survey.toml").is_file() and not (workspace / "survey.toml").exists():
        shutil.copyfile(dives[0] / "survey.toml", workspace / "survey.toml")
    counts = [len(records) for records in rows]
    return f"{' and '.join(map(str, counts))} pictures of {len(dives)} dives"


def _same_rig(dives: Sequence[Path]) -> Path | None:
    """The rig of the dives that have one."""
    files = [path for path in map(rig_file, dives) if path is not None]
    for path in files[1:]:
        if path.read_bytes() != files[0].read_bytes():
            raise CalibrationError(
                f"{files[0]} and {path} are not one rig: import the pictures of both dives with "
                "the same --rig"
            )
    return files[0] if files else None


def _append_dive(
    records: Sequence[ImageRecord], folder: str, before: Sequence[ImageRecord]
) -> list[ImageRecord]:
    """A dive's pictures in a folder, after those of earlier dives in stations and in time."""
    after = 1 + max((r.station for r in before), default=-1)
    late_s = np.nan_to_num(np.array([r.time_s for r in before]))
    start_s = np.nan_to_num(np.array([r.time_s for r in records]))
    shift_s = float(late_s.max() - start_s.min()) + _APART_S if before else 0.0
    return [
        replace(
            r,
            image=f"{folder}/{r.image}",
            mask=f"{folder}/{r.mask}" if r.mask else "",
            station=r.station + after,
            time_s=r.time_s + shift_s,
        )
        for r in records
    ]


def _join_plans(workspace: Path, dives: Sequence[Path]) -> None:
    """Write the plan of all lines over the first plan's area, where the dives were planned."""
    folders = [dive / "plan" for dive in dives if artefacts.read_stage(dive / "plan") is not None]
    if not folders or folders[0] != dives[0] / "plan":
        return
    plans = [read_plan(folder / "plan.json") for folder in folders]
    whole = plans[0]
    for plan in plans[1:]:
        if plan.datum != whole.datum:
            raise PlanError(
                f"plans {whole.name!r} and {plan.name!r} have different datums: join dives of one "
                "survey"
            )
        whole = _with_lines(whole, plan)
    stage = artefacts.Stage(
        name="plan",
        version=1,
        command="join",
        settings={"refly_of": whole.name},
        inputs=[folder / "plan.json" for folder in folders],
    )
    artefacts.run_stage(
        workspace, stage, lambda part: artefacts.write_json(part / "plan.json", whole.to_json())
    )


def _with_lines(first: Plan, second: Plan) -> Plan:
    return replace(
        first,
        lines=first.lines + second.lines,
        dives=(*first.dives, *(dive.shift_lines(len(first.lines)) for dive in second.dives)),
        line_depths_m=(),
        length_m=first.length_m + second.length_m,
        duration_s=first.duration_s + second.duration_s,
        energy_wh=first.energy_wh + second.energy_wh,
    )
