"""Videos as recordings, chapters in order, and their frames as pictures of a workspace.

Frames are taken by how far the picture moved on, and the sharpest of these. Motion from frame to
frame is a similarity fitted to tracked corners. It is exact for a camera that looks straight at a
flat floor, and near enough elsewhere to say how much two frames share.

The GPS in a GoPro's video says where and when it was: it has a fix above water only. Its keys
are those that https://github.com/gopro/gpmf-parser documents. Accelerometers are not read: their
axes differ from model to model, and a stabilised picture does not turn with its body.
"""

import os
import re
import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta, tzinfo
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.contents import ordinary_file
from alice_survey.core.errors import ImageError, file_faults, note, warn
from alice_survey.core.executor import progress
from alice_survey.core.frames import Array
from reconstruct.pictures.files import VIDEO, PictureFacts, natural_key, safe_name, to_utc
from reconstruct.pictures.incoming import Incoming
from reconstruct.pictures.quality import sharpness

_MIN_FIX = 3
"""A fix in three dimensions."""
_MAX_DOP = 5.0
"""Dilution of precision below which GoPro calls a fix good."""
_EPOCH_2000_S = datetime(2000, 1, 1, tzinfo=UTC).timestamp()
_FIX, _DOP, _UTC_MS, _GPS9 = (
    f"0x{key.hex().upper()}" for key in (b"GPSF", b"GPSP", b"GPSU", b"GPS9")
)
_GPS9_ROW = struct.Struct(">7i2H")
"""Latitude, longitude, altitude, speeds in 2D and 3D, days, seconds, dilution, fix."""
_HEAD = 8
"""Bytes of key, type and count before the rows."""
_MAX_FIX_AGE_S = 1.0
"""Time to a fix within which a picture has its place."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Fixes:
    """Good fixes of a GPS, (N,) each, by the time of the video."""

    time_s: Array
    """Seconds from the start of the video, increasing."""
    places: Array
    """(N, 3) latitude, longitude (degrees) and altitude (m)."""
    utc_s: Array
    """Seconds since 1970 of the fix itself; NaN where they are not stated."""

    def at(self, time_s: float) -> tuple[float, float, float] | None:
        """Latitude, longitude and altitude at a time; None where no fix is near."""
        if not len(self.time_s) or np.abs(self.time_s - time_s).min() > _MAX_FIX_AGE_S:
            return None
        latitude, longitude, altitude = (
            float(np.interp(time_s, self.time_s, values)) for values in self.places.T
        )
        return latitude, longitude, altitude

    def start_utc(self) -> datetime | None:
        """When the video began, by the median fix; None without any."""
        known = np.isfinite(self.utc_s)
        if not known.any():
            return None
        seconds = float(np.median(self.utc_s[known] - self.time_s[known]))
        return datetime.fromtimestamp(0, UTC) + timedelta(seconds=seconds)


def read_fixes(path: Path, duration_s: float) -> Fixes:
    """Good fixes of the telemetry of a video; what is damaged counts as none.

    Args:
        path: of the video.
        duration_s: of the video, over which its payloads of a second or so are spread evenly.
    """
    import telemetry_parser

    try:
        payloads = telemetry_parser.Parser(str(ordinary_file(path, None))).telemetry()
    except BaseException as error:  # what the library panics at is not an Exception
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        payloads = []
    rows = []
    for number, payload in enumerate(payloads):
        found = _rows(payload)
        start, step = number / len(payloads), 1 / (len(payloads) * max(len(found), 1))
        rows += [(duration_s * (start + k * step), *row) for k, row in enumerate(found.tolist())]
    fixes = np.array(rows, dtype=np.float64).reshape(-1, 7)
    good = (
        np.isfinite(fixes[:, :4]).all(axis=1)
        & (np.abs(fixes[:, 1]) <= 90)
        & (np.abs(fixes[:, 2]) <= 180)
        & fixes[:, 1:3].any(axis=1)  # not of 0, 0
        & (fixes[:, 5] >= _MIN_FIX)
        & (fixes[:, 6] < _MAX_DOP)
    )
    fixes = fixes[good]
    return Fixes(time_s=fixes[:, 0], places=fixes[:, 1:4], utc_s=fixes[:, 4])


def _rows(payload: dict[str, Any]) -> Array:
    """(N, 6) latitude, longitude, altitude, seconds since 1970, fix and dilution of a payload."""
    newer, older = payload.get("GPS9", {}), payload.get("GPS", {})
    with np.errstate(all="ignore"):
        try:
            if _GPS9 in newer:
                data = bytes(newer[_GPS9][_HEAD:])
                whole = data[: len(data) // _GPS9_ROW.size * _GPS9_ROW.size]
                values = np.array(list(_GPS9_ROW.iter_unpack(whole))) / newer["Scale"]
                utc_s = _EPOCH_2000_S + values[:, 5] * 86400.0 + values[:, 6]
                return np.column_stack([values[:, :3], utc_s, values[:, 8], values[:, 7]])
            values = np.array(older.get("Data", []), np.float64).reshape(-1, 5) / older["Scale"]
            about = np.full((len(values), 3), [np.nan, older[_FIX], older[_DOP] / 100.0])
            about[:1, 0] = older.get(_UTC_MS, np.nan) / 1e3  # of the first sample
            return np.column_stack([values[:, :3], about])
        except (KeyError, TypeError, ValueError, IndexError, struct.error):
            return np.zeros((0, 6))


_CHAPTER = re.compile(r"(?:(?P<kind>G[HLXP])(?P<chapter>\d\d)|GOPR)(?P<number>\d{4})", re.I)
"""Names of a GoPro's videos; until the HERO5 `GOPR0042`, `GP010042`, `GP020042` ..."""
_OLD = "GP"
_PREVIEW = ".lrv"
_CLOCK_NEVER_SET = timedelta(days=1)
"""A date so soon after a new year's midnight, of years before, is that of a clock without power."""
_STARTS_OF_CLOCKS = range(2000, 2020)
_MP4_EPOCH = datetime(1904, 1, 1, tzinfo=UTC)
_YEARS = range(2000, 2200)
"""Years in which a digital camera can have made a video."""
_MAX_INDEX = 64 << 20
"""Bytes of the index of a video: a day of it takes less."""
_MAX_BOXES = 4096


@dataclass(frozen=True, kw_only=True, eq=False)
class VideoFile:
    """One file of a recording."""

    path: Path
    size: tuple[int, int]
    """Width and height of its frames."""
    duration_s: float
    fixes: Fixes
    """Of the GPS in the video."""
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
        return self.files[0].size

    @property
    def duration_s(self) -> float:
        """From its start to the end of its last file."""
        return self.files[-1].start_s + self.files[-1].duration_s

    def place_at(self, time_s: float) -> tuple[float, float, float] | None:
        """Latitude, longitude and altitude at a time of the recording, if its GPS had a fix."""
        places = (file.fixes.at(time_s - file.start_s) for file in self.files)
        return next((place for place in places if place is not None), None)


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
    groups: dict[tuple[Path, str], dict[int, Path]] = {}
    for path in paths:
        named = _CHAPTER.fullmatch(path.stem)
        name, chapter = path.name, 0
        if named is not None:
            name = ((named["kind"] or _OLD) + named["number"]).upper()
            chapter = int(named["chapter"] or 0)
        chapters = groups.setdefault((path.parent, name), {})
        if chapters.setdefault(chapter, path) != path:
            raise ImageError(f"{path}: this chapter of its recording is given twice")
    found = [_recording(dict(sorted(chapters.items()))) for chapters in groups.values()]
    starts = [to_utc(r.start, zone) for r in found if r.start is not None]
    if len(found) == 1:
        return found
    if len(starts) < len(found):
        return [replace(r, start_s=np.nan) for r in found]
    placed = [
        replace(r, start_s=(start - min(starts)).total_seconds())
        for r, start in zip(found, starts, strict=True)
    ]
    return sorted(placed, key=lambda r: r.start_s)


def _recording(chapters: dict[int, Path]) -> Recording:
    """Chapters one after the other; one that is missing is taken for as long as the longest."""
    files = {chapter: _open(path) for chapter, path in chapters.items()}
    first = next(iter(files.values()))
    for file in files.values():
        if file.size != first.size:
            raise ImageError(
                f"{file.path} has {file.size[0]} x {file.size[1]} pixels, but {first.path.name} "
                f"of the same recording {first.size[0]} x {first.size[1]}: import them apart"
            )
    max_duration_s = max(file.duration_s for file in files.values())
    old = first.path.name.upper().startswith(("GOPR", _OLD))
    lost = [str(chapter) for chapter in range(0 if old else 1, max(files)) if chapter not in files]
    if lost:
        warn(
            f"chapters {', '.join(lost)} of the recording are missing: its times count from the "
            f"start of {first.path.name}, and run on as if each missing one after it lasted "
            f"{max_duration_s:.1f} s"
        )
    placed, start_s = [], 0.0
    for chapter in range(min(files), max(files) + 1):
        if chapter in files:
            placed.append(replace(files[chapter], start_s=start_s))
        start_s += files[chapter].duration_s if chapter in files else max_duration_s
    start, clock = _began(placed)
    return Recording(name=first.path.stem, files=tuple(placed), start=start, clock=clock)


def _began(files: Sequence[VideoFile]) -> tuple[datetime | None, str]:
    """When a recording began, and by what: GPS, else the container of its first file."""
    for file in files:
        start = file.fixes.start_utc()
        if start is not None:
            return start - timedelta(seconds=file.start_s), "GPS in the video"
    return video_start(files[0].path)


def video_start(path: Path) -> tuple[datetime | None, str]:
    """When a video began by the index of its MP4 (ISO/IEC 14496-12), and on which clock.

    A GoPro writes its local time as if it were UTC: then the time has no zone. None of other files
    and damaged ones, whose pictures OpenCV may read all the same.

    Raises:
        ImageError: the file cannot be read.
    """
    with file_faults(path, ImageError), ordinary_file(path, None).open("rb") as file:
        index = _index_of(file, file.seek(0, os.SEEK_END))
    at = index.find(b"mvhd") + 4
    form = ">Q" if index[at : at + 1] == b"\1" else ">I"
    if at < 4 or len(index) < at + 4 + struct.calcsize(form):
        return None, "unknown"
    (seconds,) = struct.unpack_from(form, index, at + 4)
    if seconds > 1 << 34 or (made := _MP4_EPOCH + timedelta(seconds=seconds)).year not in _YEARS:
        return None, "unknown"
    midnight = made.replace(month=1, day=1, hour=0, minute=0, second=0)
    if made - midnight < _CLOCK_NEVER_SET and made.year in _STARTS_OF_CLOCKS:
        warn(
            f"{path}: its date {made:%Y-%m-%d %H:%M:%S} is that of a clock that was never set: its "
            "time is taken as unknown"
        )
        return None, "unknown"
    if b"GoPro" in index:
        return made.replace(tzinfo=None), "the camera's local time, in the video"
    return made, "UTC in the video"


def _index_of(file: Any, total: int) -> bytes:
    """The content of the box `moov`; empty without one."""
    at = 0
    for _ in range(_MAX_BOXES):
        file.seek(at)
        head = file.read(16)
        if len(head) < 16:
            break
        size, kind = struct.unpack(">I4s", head[:8])
        begin = at + 8
        if size == 1:
            size, begin = struct.unpack(">Q", head[8:])[0], at + 16
        end = total if size == 0 else min(at + size, total)
        if kind == b"moov":
            file.seek(begin)
            return bytes(file.read(max(0, min(end - begin, _MAX_INDEX))))
        if end < begin:
            break
        at = end
    return b""


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


def _frame_rate(capture: cv2.VideoCapture) -> float:
    """Frames per second; 0 where the video does not say."""
    rate = capture.get(cv2.CAP_PROP_FPS)
    return float(rate) if np.isfinite(rate) and 0 < rate < 10_000 else 0.0


def _frame_count(capture: cv2.VideoCapture) -> int:
    """Number of frames; 0 where the video does not say."""
    return max(0, int(capture.get(cv2.CAP_PROP_FRAME_COUNT)))


def _open(path: Path) -> VideoFile:
    capture = open_video(path)
    try:
        rate, count = _frame_rate(capture), _frame_count(capture)
        size = (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
        width, height = (int(capture.get(side)) for side in size)
    finally:
        capture.release()
    duration_s = count / rate if rate else 0.0
    fixes = read_fixes(path, duration_s)
    return VideoFile(path=path, size=(width, height), duration_s=duration_s, fixes=fixes)


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
    right: NDArray[np.uint8] | None = None
    """Those of the right camera, where a frame holds both side by side."""


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


def choose_frames(frames: Iterable[Frame], overlap: float, counts: FrameCounts) -> Iterator[Frame]:
    """Take frames so that neighbours overlap by about a share; holds three frames at most.

    The next frame is the sharpest of those that moved on from the last by 0.75 to 1.25 of the
    requested advance, `1 - overlap`. While nothing moves, none is taken. Where the picture changes
    at once, the choice begins again.

    Args:
        frames: in order.
        overlap: of neighbours, between 0 and 1.
        counts: to which what the choice meets with is added.
    """
    shot: _Shot | None = None
    for frame in frames:
        counts.seen += 1
        small = small_grey(frame.pixels)
        if small.mean() < _DARK:
            counts.dark += 1
            continue
        step = None if shot is None else motion(shot.small, small)
        if shot is not None and step is not None:
            yield from shot.follow(frame, small, step)
            continue
        if shot is not None and frame.time_s - shot.last_s < _PATIENCE_S:
            counts.unfollowed += 1
            continue
        if shot is not None:
            yield from shot.rest(counts)
            if shot.followed > 1:
                counts.breaks_s.append(frame.time_s)
        shot = _Shot(frame, small, 1.0 - overlap)
    if shot is not None:
        yield from shot.rest(counts)


class _Shot:
    """Frames that follow one another without a break."""

    def __init__(self, frame: Frame, small: Grey, advance: float) -> None:
        self.small, self.last_s, self.followed = small, frame.time_s, 1
        self._start_s, self._advance = frame.time_s, advance
        self._moved, self._starting = np.eye(3), True
        self._best: _SharpFrame | None
        self._best = _SharpFrame(frame=frame, sharpness=_sharpness(frame.pixels))
        self._before: _SharpFrame | None = None

    def follow(self, frame: Frame, small: Grey, step: Array) -> Iterator[Frame]:
        """Frames that are certain to be taken once this one is known, in order."""
        self.followed += 1
        self.small, self.last_s = small, frame.time_s
        self._moved = step @ self._moved
        for one in (self._best, self._before):
            if one is not None:
                one.moved = step @ one.moved
        yield from self._weigh(frame)

    def rest(self, counts: FrameCounts) -> Iterator[Frame]:
        """The frame that would come next, if there is one, when nothing follows."""
        if self.followed < 2:  # alone: it shows what no other frame shows
            counts.unfollowed += self.followed
            return
        gone = self._motion_since() > _AT_START * self._advance
        last = self._best or (self._before if gone else None)
        if last is not None:
            yield last.frame

    def _motion_since(self) -> float:
        """Share of the picture that the last taken frame does not show."""
        height, width = self.small.shape
        return 1.0 - overlap_share(self._moved, (width, height))

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


def take_frames(
    recordings: Sequence[Recording],
    cameras: Sequence[str],
    folder: Path,
    overlap: float,
    every_s: float | None,
    *,
    split: bool = False,
) -> list[Incoming]:
    """Write the frames that are taken of each recording as PNG.

    Args:
        recordings: in order.
        cameras: that took each of them.
        folder: of the stage.
        overlap: of neighbouring frames, where no interval is given.
        every_s: fixed interval in seconds.
        split: frames hold pictures of a left and a right camera side by side.

    Returns:
        The frames, each moment a station of its own.

    Raises:
        ImageError: a frame cannot be written.
    """
    entries: list[Incoming] = []
    for number, (recording, camera) in enumerate(zip(recordings, cameras, strict=True)):
        name = safe_name(recording.name)
        if any(safe_name(other.name) == name for other in recordings[:number]):
            name = f"{name}_{number + 1}"
        counts = FrameCounts()
        if every_s is None:
            every = _frames(recording, (1.0 - 0.1) / _MAX_HZ, even=False, split=split)
            frames = choose_frames(every, overlap, counts)
        else:
            frames = _frames(recording, every_s, even=True, split=split)
        for taken, frame in enumerate(frames):
            station = entries[-1].station + 1 if entries else 0
            parts = {camera: frame.pixels} | ({} if frame.right is None else {"right": frame.right})
            for own, pixels in parts.items():
                image = f"{safe_name(own)}/{name}_{taken:06d}.png"
                (folder / image).parent.mkdir(parents=True, exist_ok=True)
                if not cv2.imwrite(str(folder / image), pixels):
                    raise ImageError(f"{folder / image}: cannot be written")
                entries.append(_entry(recording, own, frame, image, station))
        _report_counts(recording, counts)
    return entries


def _entry(recording: Recording, camera: str, frame: Frame, image: str, station: int) -> Incoming:
    source, start = recording.files[0].path, recording.start
    facts = PictureFacts(
        path=source, width_px=frame.pixels.shape[1], height_px=frame.pixels.shape[0],
        time_local=None if start is None else start + timedelta(seconds=frame.time_s),
    )  # fmt: skip
    if (place := recording.place_at(frame.time_s)) is not None:
        latitude, longitude, altitude = place
        facts = replace(facts, latitude_deg=latitude, longitude_deg=longitude, altitude_m=altitude)
    return Incoming(
        source=source.with_name(Path(image).name), camera=camera, station=station, facts=facts,
        image=image, video_time_s=recording.start_s + frame.time_s, recording=recording.name,
    )  # fmt: skip


def _frames(recording: Recording, step_s: float, *, even: bool, split: bool) -> Iterator[Frame]:
    """Frames of all chapters a step or more apart, or at every multiple of it where `even`."""
    due_s, taken = -np.inf, 0
    for file in recording.files:
        capture = open_video(file.path)
        try:
            total, rate = _frame_count(capture), _frame_rate(capture)
            label = f"frames of {file.path.name}"
            grabs = progress(iter(capture.grab, False), label, total or None)
            for count, _ in enumerate(grabs):
                time_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3
                if count and not time_s > 0 and rate:
                    time_s = count / rate
                time_s += file.start_s
                if time_s + _TOUCH_S < due_s:
                    continue
                good, pixels = capture.retrieve()
                if not good:
                    warn(f"the frame at {time_s:.2f} s is left out: it cannot be decoded")
                    continue
                taken += 1
                due_s = step_s * taken if even else time_s + step_s
                left, right = np.hsplit(pixels, 2) if split else (pixels, None)
                yield Frame(time_s=time_s, pixels=left, right=right)
        finally:
            capture.release()


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
