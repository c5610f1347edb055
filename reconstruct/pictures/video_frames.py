"""Frames of videos as pictures of a workspace."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import cv2
from numpy.typing import NDArray

from alice_survey.core.errors import ImageError, note, warn
from alice_survey.core.executor import progress
from reconstruct.pictures.files import PictureFacts, safe_name
from reconstruct.pictures.frame_choice import Frame, FrameCounts, OverlapChooser
from reconstruct.pictures.incoming import Incoming
from reconstruct.pictures.recordings import Recording, frame_count, frame_rate, opened

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
        grabbed = _grabbed(recording)
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


def _grabbed(recording: Recording) -> Iterator[_Grabbed]:
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
