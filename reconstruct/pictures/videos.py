"""Videos as recordings, chapters in order, and their frames as pictures of a workspace.

Frames are taken by how far the picture moved on, and the sharpest of these. Motion from frame to
frame is a similarity fitted to tracked corners. It is exact for a camera that looks straight at a
flat floor, and near enough elsewhere to say how much two frames share.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta, tzinfo
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.errors import ImageError, note, warn
from alice_survey.core.executor import progress
from alice_survey.core.frames import Array
from reconstruct.pictures.files import VIDEO, PictureFacts, natural_key, safe_name, to_utc
from reconstruct.pictures.incoming import Incoming
from reconstruct.pictures.quality import sharpness
from reconstruct.pictures.telemetry import Mp4Facts, read_mp4

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

    @property
    def duration_s(self) -> float:
        """From its start to the end of its last file."""
        return self.files[-1].start_s + self.files[-1].duration_s

    def place_at(self, time_s: float) -> tuple[float, float, float] | None:
        """Latitude, longitude and altitude at a time of the recording, if its GPS had a fix."""
        for file in self.files:
            fixes = file.facts.fixes
            if fixes is not None and (place := fixes.at(time_s - file.start_s)):
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
    first, last = min(files), max(files)
    lost = [str(c) for c in range(0 if family == "GP" else 1, last) if c not in files]
    if lost:
        warn(
            f"chapters {', '.join(lost)} of the recording are missing: its times count from the "
            f"start of {files[first].path.name}, and run on as if each missing one after it were "
            f"as long as {longest.path.name}, {longest.duration_s:.1f} s"
        )


def _check_sizes(files: Sequence[VideoFile]) -> None:
    first = files[0]
    for file in files:
        if (file.width_px, file.height_px) != (first.width_px, first.height_px):
            raise ImageError(
                f"{file.path} has {file.width_px} x {file.height_px} pixels, but {first.path.name} "
                f"of the same recording {first.width_px} x {first.height_px}: import them apart"
            )


def open_video(path: Path) -> cv2.VideoCapture:
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
    capture = open_video(path)
    try:
        rate, count = frame_rate(capture), frame_count(capture)
        width = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        height = int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
    finally:
        capture.release()
    return VideoFile(
        path=path, width_px=width, height_px=height, duration_s=count / rate if rate else 0.0,
        facts=read_mp4(path),
    )  # fmt: skip


def _began(files: Sequence[VideoFile]) -> tuple[datetime | None, str]:
    """When a recording began, and by what: GPS, else the container of its first file."""
    for file in files:
        start = None if file.facts.fixes is None else file.facts.fixes.start_utc()
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


Grey = NDArray[np.uint8]

_SMALL_PX = 320
"""Longer side of the pictures in which motion is measured."""
_NEAR, _FAR = 0.75, 1.25
"""Window of the next frame, by the requested advance."""
_AT_START = 0.25
"""The first frame is the sharpest until the picture moved by this part of the advance ..."""
_START_S = 1.0
"""... or for so long."""
_PATIENCE_S = 0.5
"""For how long a frame may be looked for that shows what was seen before."""
_DARK = 12.0
"""Mean grey level below which a frame is black."""
_CORNERS, _MIN_CORNERS, _MIN_TRACKED = 300, 20, 12
_TRACKED_SHARE, _INLIER_SHARE = 0.25, 0.5
"""Least share of corners that are tracked there and back, and of these that agree."""
_BACK_PX = 0.5
_INLIER_PX, _INLIER_OF_MOTION = 1.5, 0.25
"""How far a corner may be from the common motion: relief moves near ground more than far."""
_MIN_LIKENESS = 0.3
"""Correlation of two frames over each other: noise can be tracked too."""
_DETAIL_PX = (2.0, 8.0)
_MAX_ZOOM = 2.0
"""Change of size from one frame to the next beyond which their motion is not believed."""
_CROP_PX = (640, 480)
"""Middle of a frame in which its sharpness is measured: all of it would take too long."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """One frame of a recording."""

    time_s: float
    """Since the start of the recording."""
    pixels: NDArray[np.uint8]
    """(H, W, 3) BGR."""


@dataclass(kw_only=True)
class FrameCounts:
    """What a choice met with."""

    seen: int = 0
    dark: int = 0
    """Black frames."""
    unfollowed: int = 0
    """Frames that show nothing of those before and after."""
    breaks_s: list[float] = field(default_factory=list)
    """When the picture changed at once: cuts, and turns too fast to follow."""


@dataclass(kw_only=True, eq=False)
class _SharpFrame:
    """A frame that may be taken."""

    frame: Frame
    sharpness: float = 0.0
    moved: Array = field(default_factory=lambda: np.eye(3))
    """(3, 3) from its pixels to those of the frame now, in the small picture."""


class OverlapChooser:
    """Take frames so that neighbours overlap by about a share; holds three frames at most.

    The next frame is the sharpest of those that moved on from the last by 0.75 to 1.25 of the
    requested advance, `1 - overlap`. While nothing moves, none is taken. Where the picture changes
    at once, the choice begins again.
    """

    def __init__(self, overlap: float, counts: FrameCounts) -> None:
        """Choose for an overlap of neighbours, between 0 and 1; count what it meets with."""
        self.counts = counts
        self._advance = 1.0 - overlap
        self._small: Grey | None = None
        self._size = (0, 0)
        self._moved = np.eye(3)
        self._best: _SharpFrame | None = None
        self._before: _SharpFrame | None = None
        self._starting = True
        self._followed = 0
        self._start_s = self._last_s = 0.0

    def take(self, frame: Frame) -> Iterator[Frame]:
        """Frames that are certain to be taken once this one is known, in order."""
        self.counts.seen += 1
        small = small_grey(frame.pixels)
        if small.mean() < _DARK:
            self.counts.dark += 1
            return
        if self._small is None:
            self._begin(frame, small)
            return
        step = motion(self._small, small)
        if step is None:
            if frame.time_s - self._last_s < _PATIENCE_S:
                self.counts.unfollowed += 1
                return
            yield from self.rest()
            if self._followed > 1:
                self.counts.breaks_s.append(frame.time_s)
            self._begin(frame, small)
            return
        self._followed += 1
        self._small, self._last_s = small, frame.time_s
        self._moved = step @ self._moved
        for one in (self._best, self._before):
            if one is not None:
                one.moved = step @ one.moved
        yield from self._weigh(frame)

    def rest(self) -> Iterator[Frame]:
        """The frame that would come next, if there is one, when nothing follows."""
        if self._followed < 2:  # alone: it shows what no other frame shows
            self.counts.unfollowed += self._followed
            return
        last = self._best
        if (
            last is None
            and self._before is not None
            and self._motion_since() > _AT_START * self._advance
        ):
            last = self._before
        self._best = self._before = None
        if last is not None:
            yield last.frame

    def _begin(self, frame: Frame, small: Grey) -> None:
        self._small, self._moved = small, np.eye(3)
        self._size = (small.shape[1], small.shape[0])
        self._starting, self._followed = True, 1
        self._start_s = self._last_s = frame.time_s
        self._before = None
        self._best = _SharpFrame(frame=frame, sharpness=_sharpness(frame.pixels))

    def _motion_since(self) -> float:
        """Share of the picture that the last taken frame does not show."""
        return 1.0 - overlap_share(self._moved, self._size)

    def _weigh(self, frame: Frame) -> Iterator[Frame]:
        gone = self._motion_since()
        near, far = _NEAR * self._advance, _FAR * self._advance
        if self._starting:
            near, far = 0.0, _AT_START * self._advance
        late = self._starting and frame.time_s - self._start_s > _START_S
        if gone > far or late:
            # With none in the window, the frame before it overlaps more: the picture moves fast.
            chosen = self._best or self._before or _SharpFrame(frame=frame)
            self._moved, self._best, self._before = chosen.moved, None, None
            self._starting = False
            yield chosen.frame
            if chosen.frame is not frame:
                yield from self._weigh(frame)
            return
        if gone < near:
            self._before = _SharpFrame(frame=frame)
            return
        sharp = _sharpness(frame.pixels)
        if self._best is None or sharp > self._best.sharpness:
            self._best = _SharpFrame(frame=frame, sharpness=sharp)


def small_grey(pixels: NDArray[np.uint8]) -> Grey:
    """The small grey picture in which motion is measured."""
    grey = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
    factor = _SMALL_PX / max(grey.shape)
    if factor >= 1.0:
        return np.asarray(grey, np.uint8)
    small = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8)


def _sharpness(pixels: NDArray[np.uint8]) -> float:
    """Sharpness of the middle of a frame, as the check of a survey's pictures measures it."""
    height, width = pixels.shape[:2]
    w, h = min(width, _CROP_PX[0]), min(height, _CROP_PX[1])
    x, y = (width - w) // 2, (height - h) // 2
    return sharpness(pixels[y : y + h, x : x + w])


def motion(before: Grey, after: Grey) -> Array | None:
    """The similarity from the pixels of one picture to those of the next.

    Corners are tracked by optical flow (Lucas and Kanade 1981) there and back; where that fails, it
    starts again from the shift that phase correlation finds (Kuglin and Hines 1975).

    Args:
        before: (H, W) grey.
        after: of the same size.

    Returns:
        (3, 3), or None where they have too little in common.
    """
    corners = cv2.goodFeaturesToTrack(before, _CORNERS, 0.01, 7)
    if corners is None or len(corners) < _MIN_CORNERS:
        return None
    found = _similarity(before, after, corners, np.zeros(2))
    if found is not None:
        return found
    window = cv2.createHanningWindow((before.shape[1], before.shape[0]), cv2.CV_32F)
    shift, _ = cv2.phaseCorrelate(before.astype(np.float32), after.astype(np.float32), window)
    return _similarity(before, after, corners, np.array(shift))


def _similarity(before: Grey, after: Grey, corners: Array, shift: Array) -> Array | None:
    start = np.float32(corners + shift)
    flow = {"winSize": (21, 21), "maxLevel": 4, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
    there, seen, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, start.copy(), **flow)
    back, kept, _ = cv2.calcOpticalFlowPyrLK(
        after, before, there, np.float32(there - shift), **flow
    )
    away = np.linalg.norm((back - corners).reshape(-1, 2), axis=1)
    good = (seen.ravel() == 1) & (kept.ravel() == 1) & (away < _BACK_PX)
    if good.sum() < max(_MIN_TRACKED, _TRACKED_SHARE * len(corners)):
        return None
    lengths = np.linalg.norm((there - corners)[good].reshape(-1, 2), axis=1)
    near_px = max(_INLIER_PX, _INLIER_OF_MOTION * float(np.median(lengths)))
    found, inliers = cv2.estimateAffinePartial2D(
        corners[good], there[good], method=cv2.RANSAC, ransacReprojThreshold=near_px,
        confidence=0.999,
    )  # fmt: skip
    if found is None or inliers.sum() < _INLIER_SHARE * good.sum():
        return None
    zoom = float(np.hypot(found[0, 0], found[1, 0]))
    if not 1.0 / _MAX_ZOOM < zoom < _MAX_ZOOM:
        return None
    if likeness(before, after, found) < _MIN_LIKENESS:
        return None
    return np.vstack([found, [0.0, 0.0, 1.0]])


def likeness(before: Grey, after: Grey, moved: Array) -> float:
    """Correlation of the detail of two pictures where they overlap; near 0 for noise.

    Args:
        before: (H, W) grey.
        after: of the same size.
        moved: (2, 3) from the pixels of the one to those of the other.
    """
    size = (after.shape[1], after.shape[0])
    there = cv2.warpAffine(_detail(before), moved, size)
    inside = cv2.warpAffine(np.ones(before.shape, np.uint8), moved, size) > 0
    if inside.sum() < _MIN_TRACKED:
        return 0.0
    one, other = there[inside], _detail(after)[inside]
    scale = float(np.sqrt(np.mean(one**2) * np.mean(other**2)))
    return float(np.mean(one * other)) / scale if scale > 0 else 0.0


def _detail(grey: Grey) -> NDArray[np.float32]:
    """Detail of some pixels, without noise and uneven light."""
    levels = grey.astype(np.float32)
    fine, coarse = (cv2.GaussianBlur(levels, (0, 0), sigma) for sigma in _DETAIL_PX)
    return np.asarray(fine - coarse, np.float32)


def overlap_share(moved: Array, size: tuple[int, int]) -> float:
    """Share that two frames have in common, of the one that shows more.

    Args:
        moved: (3, 3) similarity from the pixels of the one to those of the other.
        size: width and height of both.
    """
    width, height = size
    frame = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float64)
    other = frame @ moved[:2, :2].T + moved[:2, 2]
    if not np.isfinite(other).all():
        return 0.0
    area, _ = cv2.intersectConvexConvex(np.float32(frame), np.float32(other))
    larger = width * height * max(1.0, float(np.linalg.det(moved[:2, :2])))
    return float(np.clip(area / larger, 0.0, 1.0))


DEFAULT_OVERLAP = 0.7
"""Of neighbouring frames."""
_MAX_HZ = 15.0
"""Frames a second that are looked at."""
_TOUCH_S = 1e-6


@dataclass(frozen=True, kw_only=True)
class _Grabbed:
    """A frame that is decoded only on request."""

    time_s: float
    retrieve: Callable[[], NDArray[Any] | None]


def take_frames(
    recordings: Sequence[Recording],
    cameras: Sequence[str],
    folder: Path,
    overlap: float,
    every_s: float | None,
) -> list[Incoming]:
    """Write the frames that are taken of each recording as PNG.

    Args:
        recordings: in order.
        cameras: that took each of them.
        folder: of the stage.
        overlap: of neighbouring frames, where no interval is given.
        every_s: fixed interval in seconds.

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
        counts = FrameCounts()
        if every_s is None:
            frames = _by_overlap(grabbed, overlap, counts)
        else:
            frames = _by_interval(grabbed, every_s)
        for taken, frame in enumerate(frames):
            image = f"{safe_name(camera)}/{name}_{taken:06d}.png"
            _write(folder / image, frame.pixels)
            entries.append(_entry(recording, camera, frame, image, len(entries)))
        _report_counts(recording, counts)
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
        capture = open_video(file.path)
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


def _report_counts(recording: Recording, counts: FrameCounts) -> None:
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
