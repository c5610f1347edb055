"""Real pictures into a workspace: checked, named, timed and placed; the stage `images/`."""

import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from alice_survey.core.artefacts import Stage, run_stage
from alice_survey.core.errors import (
    ImageError,
    WorkspaceError,
    warn,
)
from alice_survey.core.executor import SERIAL, Executor
from alice_survey.core.manifest import read_manifest, write_manifest
from alice_survey.core.records import PicturesRecord
from camera_calib.freedom import part_of_rig
from camera_calib.rig import read_rig, write_rig
from missions.logs.navigation_csv import find_zone, read_navigation
from reconstruct.pictures.bag_pictures import BagPictures, take_bag
from reconstruct.pictures.files import VIDEO, PictureFolder, look_into
from reconstruct.pictures.incoming import (
    at_time,
    by_camera,
    check_entries,
    copy_all,
    find_entries,
    mask_of,
    named_apart,
    record_of,
)
from reconstruct.pictures.pairing import PairedPictures, pair_by_time
from reconstruct.pictures.recordings import Recording, find_videos, read_recordings
from reconstruct.pictures.summary import (
    ImportedPictures,
    ImportRecord,
    import_record,
    summary,
    with_folders,
)
from reconstruct.pictures.video_frames import (
    DEFAULT_OVERLAP,
    MAX_OVERLAP,
    MIN_OVERLAP,
    FrameSettings,
    take_frames,
)
from reconstruct.pictures.when_where import checked_level, placed

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
