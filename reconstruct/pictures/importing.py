"""Real pictures into a workspace: checked, named, timed and placed; the stage `images/`."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from alice_survey.base.artefacts import Stage, run_stage
from alice_survey.base.errors import (
    CalibrationError,
    ImageError,
    WorkspaceError,
    warn,
)
from alice_survey.base.executor import SERIAL, Executor
from alice_survey.base.manifest import ImageRecord, read_manifest, write_manifest
from alice_survey.base.records import PicturesRecord
from camera_calib.calibrate.picture_sets import pair_pictures
from camera_calib.freedom import part_of_rig
from camera_calib.rig import read_rig, write_rig
from missions.logs.navigation_csv import (
    find_zone,
    read_navigation,
)
from reconstruct.pictures.files import (
    PictureFolder,
    kind_of,
    look_into,
)
from reconstruct.pictures.incoming import (
    check_entries,
    copy_all,
    find_entries,
    mask_of,
    named_apart,
    record_of,
)
from reconstruct.pictures.video_frames import take_frames
from reconstruct.pictures.when_where import checked_level, placed, readings_of

_MONO = "camera"
_FRAMES = "frames of the video"
_UNDECODABLE = "cannot be decoded"


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
    logged_level = checked_level(vertical_datum, navigation)
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
            entries = take_frames(video, every_s, partial, mono)
        else:
            for each in folders_read:
                for line in each.warnings():
                    warn(line)
            entries = find_entries(stations, executor)
        check_entries(entries, known_rig)
        entries = named_apart(entries)
        entries = [replace(e, mask=mask_of(e, masks, bool(cameras))) for e in entries]
        if video is None:
            notes += copy_all(entries, partial, executor)
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
        readings=readings_of(records),
        left_out=dict(left_out),
    )


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
