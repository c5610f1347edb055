"""Videos as recordings, chapters in order, and their frames as pictures of a workspace."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta, tzinfo
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.errors import ImageError, note, warn
from alice_survey.core.executor import progress
from reconstruct.pictures.files import VIDEO, PictureFacts, natural_key, safe_name, to_utc
from reconstruct.pictures.frame_choice import Frame, FrameCounts, OverlapChooser
from reconstruct.pictures.incoming import Incoming
from reconstruct.pictures.telemetry import Fixes, Mp4Facts, read_fixes, read_mp4

_CHAPTER = re.compile(r"(?P<kind>G[HLX])(?P<chapter>\d\d)(?P<number>\d{4})", re.I)
_OLD_FIRST = re.compile(r"GOPR(?P<number>\d{4})", re.I)
_OLD_CHAPTER = re.compile(r"GP(?P<chapter>\d\d)(?P<number>\d{4})", re.I)
_PREVIEW = ".lrv"
_CLOCK_NEVER_SET = timedelta(days=1)
"""A date so soon after a new year's midnight, of years before, is that of a clock without power."""
_STARTS_OF_CLOCKS = range(2000, 2020)


@dataclass(frozen=True, kw_only=True, eq=False)
class VideoFile:
    """One file of a recording."""

    path: Path
    width_px: int
    height_px: int
    duration_s: float
    facts: Mp4Facts
    fixes: Fixes | None
    start_s: float = 0.0
    """Since the start of the recording."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """A video, or chapters of one that follow one another."""

    name: str
    files: tuple[VideoFile, ...]
    start: datetime | None
    """When it began; without a zone where the camera wrote its local time; None if unknown."""
    clock: str
    """Source of that time, in words."""
    start_s: float = 0.0
    """Since the start of the first recording; NaN where that is unknown."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of its frames."""
        return self.files[0].width_px, self.files[0].height_px

    def place_at(self, time_s: float) -> tuple[float, float, float] | None:
        """Latitude, longitude and altitude at a time of the recording, if its GPS had a fix."""
        for file in self.files:
            if file.fixes is not None and (place := file.fixes.at(time_s - file.start_s)):
                return place
        return None


def find_videos(places: Sequence[Path]) -> list[Path]:
    """Videos that are given, and those in folders that are given; previews of cameras are not.

    Raises:
        ImageError: a folder holds none, or a video is given twice.
    """
    found: list[Path] = []
    for place in places:
        if not place.is_dir():
            found.append(place)
            continue
        inside = sorted(place.iterdir(), key=lambda p: natural_key(p.name))
        videos = [
            p for p in inside if p.suffix.lower() in VIDEO and p.suffix.lower() != _PREVIEW
            and not p.name.startswith(".")
        ]  # fmt: skip
        if not videos:
            raise ImageError(f"{place}: holds no videos")
        found += videos
    real = [path.resolve() for path in found]
    twice = [path for path in found if real.count(path.resolve()) > 1]
    if twice:
        raise ImageError(f"{twice[0]} is given twice")
    return found


def read_recordings(paths: Sequence[Path], zone: tzinfo) -> list[Recording]:
    """Recordings of some videos, in the order in which they began where all say when.

    Args:
        paths: of videos; chapters in any order.
        zone: of dates that name none.

    Raises:
        ImageError: a file is no video that can be read, or chapters are of different sizes.
    """
    groups: dict[tuple[Path, str, int], list[tuple[int, Path]]] = {}
    for position, path in enumerate(paths):
        family, number, chapter = _chapter_of(path) or ("", position, 0)
        groups.setdefault((path.parent, family, number), []).append((chapter, path))
    found = [_recording(family, sorted(group)) for (_, family, _), group in groups.items()]
    if len(found) == 1:
        return found
    starts = [to_utc(r.start, zone) for r in found if r.start is not None]
    if len(starts) < len(found):
        return [replace(r, start_s=np.nan) for r in found]
    first = min(starts)
    placed = [
        replace(r, start_s=(start - first).total_seconds())
        for r, start in zip(found, starts, strict=True)
    ]
    return sorted(placed, key=lambda r: r.start_s)


def _chapter_of(path: Path) -> tuple[str, int, int] | None:
    """Family, number and chapter of a GoPro's name; None of any other."""
    if named := _CHAPTER.fullmatch(path.stem):
        return named["kind"].upper(), int(named["number"]), int(named["chapter"])
    if named := _OLD_FIRST.fullmatch(path.stem):
        return "GP", int(named["number"]), 0
    if named := _OLD_CHAPTER.fullmatch(path.stem):
        return "GP", int(named["number"]), int(named["chapter"])
    return None


def _name_of_chapter(family: str, number: int, chapter: int) -> str:
    if family == "GP" and chapter == 0:
        return f"GOPR{number:04d}"
    return f"{family}{chapter:02d}{number:04d}"


def _recording(family: str, chapters: Sequence[tuple[int, Path]]) -> Recording:
    """Chapters one after the other; one that is missing is taken for as long as the longest."""
    files = {chapter: _open(path) for chapter, path in chapters}
    if len(files) < len(chapters):
        names = ", ".join(path.name for _, path in chapters)
        raise ImageError(f"{names}: chapters of one recording are given twice")
    first, last = min(files), max(files)
    _check_sizes(list(files.values()))
    longest = max(files.values(), key=lambda file: file.duration_s)
    if family:
        _warn_of_missing(family, files, longest)
    placed, start_s = [], 0.0
    for chapter in range(first, last + 1):
        file = files.get(chapter)
        if file is not None:
            placed.append(replace(file, start_s=start_s))
        start_s += longest.duration_s if file is None else file.duration_s
    start, clock = _began(placed)
    return Recording(name=placed[0].path.stem, files=tuple(placed), start=start, clock=clock)


def _warn_of_missing(family: str, files: Mapping[int, VideoFile], longest: VideoFile) -> None:
    begin = 0 if family == "GP" else 1
    first, last = min(files), max(files)
    number = int(files[first].path.stem[-4:])
    suffix = files[first].path.suffix
    lost = [c for c in range(begin, last) if c not in files]
    before = [_name_of_chapter(family, number, c) + suffix for c in lost if c < first]
    between = [_name_of_chapter(family, number, c) + suffix for c in lost if c > first]
    if before:
        warn(
            f"{', '.join(before)} of the recording is missing: its times count from the start of "
            f"{files[first].path.name}"
        )
    if between:
        warn(
            f"{', '.join(between)} of the recording is missing: times run on as if each were as "
            f"long as {longest.path.name}, {longest.duration_s:.1f} s"
        )


def _check_sizes(files: Sequence[VideoFile]) -> None:
    first = files[0]
    for file in files:
        if (file.width_px, file.height_px) != (first.width_px, first.height_px):
            raise ImageError(
                f"{file.path} has {file.width_px} x {file.height_px} pixels, but {first.path.name} "
                f"of the same recording {first.width_px} x {first.height_px}: import them apart"
            )


def opened(path: Path) -> cv2.VideoCapture:
    """A video whose frames come as they are stored, not turned as its player would.

    Raises:
        ImageError: it is no video that can be read.
    """
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        raise ImageError(f"{path}: not a video that can be read")
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    return capture


def frame_rate(capture: cv2.VideoCapture) -> float:
    """Frames per second; 0 where the video does not say."""
    rate = capture.get(cv2.CAP_PROP_FPS)
    return float(rate) if np.isfinite(rate) and 0 < rate < 10_000 else 0.0


def frame_count(capture: cv2.VideoCapture) -> int:
    """Number of frames; 0 where the video does not say."""
    return max(0, int(capture.get(cv2.CAP_PROP_FRAME_COUNT)))


def _open(path: Path) -> VideoFile:
    capture = opened(path)
    try:
        rate, count = frame_rate(capture), frame_count(capture)
        width = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        height = int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
    finally:
        capture.release()
    facts = read_mp4(path)
    fixes = None if facts.telemetry is None else read_fixes(path, facts.telemetry)
    return VideoFile(
        path=path, width_px=width, height_px=height, duration_s=count / rate if rate else 0.0,
        facts=facts, fixes=fixes,
    )  # fmt: skip


def _began(files: Sequence[VideoFile]) -> tuple[datetime | None, str]:
    """When a recording began, and by what: GPS, else the container of its first file."""
    for file in files:
        start = None if file.fixes is None else file.fixes.start_utc()
        if start is not None:
            return start - timedelta(seconds=file.start_s), "GPS in the video"
    created, is_gopro = files[0].facts.created, files[0].facts.is_gopro
    if created is None:
        return None, "unknown"
    midnight = datetime(created.year, 1, 1, tzinfo=UTC)
    if created - midnight < _CLOCK_NEVER_SET and created.year in _STARTS_OF_CLOCKS:
        warn(
            f"{files[0].path}: its date {created:%Y-%m-%d %H:%M:%S} is that of a clock that was "
            "never set: its time is taken as unknown"
        )
        return None, "unknown"
    if is_gopro:
        return created.replace(tzinfo=None), "the camera's local time, in the video"
    return created, "UTC in the video"


MIN_OVERLAP, DEFAULT_OVERLAP, MAX_OVERLAP = 0.3, 0.7, 0.95
"""Of neighbouring frames. Below the least they hardly match; above the most, they hardly differ."""
_MAX_HZ = 15.0
"""Frames a second that are looked at."""
_TOUCH_S = 1e-6


@dataclass(frozen=True, kw_only=True)
class FrameSettings:
    """Which frames of a video to take."""

    overlap: float = DEFAULT_OVERLAP
    """Of neighbours, where no interval is given."""
    every_s: float | None = None
    """Fixed interval in seconds."""


@dataclass(frozen=True, kw_only=True)
class _Grabbed:
    """A frame that is decoded only on request."""

    time_s: float
    retrieve: Callable[[], NDArray[Any] | None]


def take_frames(
    recordings: Sequence[Recording], cameras: Sequence[str], settings: FrameSettings, folder: Path
) -> list[Incoming]:
    """Write the frames that are taken of each recording as PNG.

    Args:
        recordings: in order.
        cameras: that took each of them.
        settings: which frames to take.
        folder: of the stage.

    Returns:
        The frames, each a station of its own.

    Raises:
        ImageError: a frame cannot be written.
    """
    entries: list[Incoming] = []
    for number, (recording, camera) in enumerate(zip(recordings, cameras, strict=True)):
        name = safe_name(recording.name)
        if any(safe_name(other.name) == name for other in recordings[:number]):
            name = f"{name}_{number + 1}"
        grabbed = _grab_frames(recording)
        if settings.every_s is None:
            counts = FrameCounts()
            frames = _by_overlap(grabbed, settings.overlap, counts)
        else:
            frames = _by_interval(grabbed, settings.every_s)
        for taken, frame in enumerate(frames):
            image = f"{safe_name(camera)}/{name}_{taken:06d}.png"
            _write(folder / image, frame.pixels)
            entries.append(_entry(recording, camera, frame, image, len(entries)))
        if settings.every_s is None:
            _say(recording, counts)
    return entries


def _write(path: Path, pixels: NDArray[Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), pixels):
        raise ImageError(f"{path}: cannot be written")


def _entry(recording: Recording, camera: str, frame: Frame, image: str, station: int) -> Incoming:
    place = recording.place_at(frame.time_s)
    taken: datetime | None = None
    if recording.start is not None:
        taken = recording.start + timedelta(seconds=frame.time_s)
    facts = PictureFacts(
        path=recording.files[0].path, width_px=frame.pixels.shape[1],
        height_px=frame.pixels.shape[0], time_local=taken,
    )  # fmt: skip
    if place is not None:
        latitude, longitude, altitude = place
        facts = replace(facts, latitude_deg=latitude, longitude_deg=longitude, altitude_m=altitude)
    return Incoming(
        source=recording.files[0].path.with_name(Path(image).name), camera=camera,
        station=station, facts=facts, image=image,
        video_time_s=recording.start_s + frame.time_s, recording=recording.name,
    )  # fmt: skip


def _grab_frames(recording: Recording) -> Iterator[_Grabbed]:
    """Frames of all chapters, at times since the start of the recording."""
    for file in recording.files:
        capture = opened(file.path)
        try:
            total, rate = frame_count(capture), frame_rate(capture)
            label = f"frames of {file.path.name}"
            grabs = progress(iter(capture.grab, False), label, total or None)
            for count, _ in enumerate(grabs):
                time_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3
                if count and not time_s > 0 and rate:
                    time_s = count / rate
                yield _Grabbed(time_s=file.start_s + time_s, retrieve=partial(_pixels, capture))
        finally:
            capture.release()


def _pixels(capture: cv2.VideoCapture) -> NDArray[Any] | None:
    good, pixels = capture.retrieve()
    return pixels if good else None


def _by_interval(grabbed: Iterator[_Grabbed], every_s: float) -> Iterator[Frame]:
    taken = 0
    for one in grabbed:
        if one.time_s + _TOUCH_S < taken * every_s:
            continue
        pixels = one.retrieve()
        if pixels is None:
            warn(f"the frame at {one.time_s:.2f} s is left out: it cannot be decoded")
            continue
        taken += 1
        yield Frame(time_s=one.time_s, pixels=pixels)


def _by_overlap(
    grabbed: Iterator[_Grabbed], overlap: float, counts: FrameCounts
) -> Iterator[Frame]:
    chooser = OverlapChooser(overlap, counts)
    last_s = -1.0
    for one in grabbed:
        if one.time_s - last_s < (1.0 - 0.1) / _MAX_HZ:
            continue
        last_s = one.time_s
        pixels = one.retrieve()
        if pixels is not None:
            yield from chooser.take(Frame(time_s=one.time_s, pixels=pixels))
    yield from chooser.rest()


def _say(recording: Recording, counts: FrameCounts) -> None:
    """Report what the choice of frames met with."""
    if counts.dark:
        note(f"{recording.name}: {counts.dark} black frames are left out")
    if counts.unfollowed:
        warn(
            f"{recording.name}: {counts.unfollowed} of {counts.seen} frames show nothing of those "
            "before and after them (open water, bubbles, a turn too fast): they are left out; "
            "--every SECONDS takes frames all the same"
        )
    if counts.breaks_s:
        times = ", ".join(f"{t:.1f}" for t in counts.breaks_s[:5])
        more = ", ..." if len(counts.breaks_s) > 5 else ""
        warn(
            f"{recording.name}: the picture changes at once at {times}{more} s: frames before and "
            "after may not overlap"
        )
