"""What an import would find, before it is made: cameras, counts, times, places; nothing is written.

Headers alone are read, of all pictures or of some spread evenly, so that folders of any size are
looked into within seconds. What only decoding shows, such as damaged files, the import finds.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

from alice_survey.core.errors import ImageError, heard
from camera_calib.rig import Rig, read_rig
from missions.logs.navigation_csv import NavigationLog, find_zone, read_navigation
from reconstruct.pictures.files import (
    PictureFacts,
    kind_of,
    look_into,
    named,
    read_header,
    to_utc,
)
from reconstruct.pictures.incoming import camera_key
from reconstruct.pictures.recordings import find_videos, read_recordings

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
    return [f"{len(faulty)} of {len(facts)} that were looked at cannot be read: {named(faulty, 3)}"]


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
