"""Frames of videos as pictures of a workspace."""

from pathlib import Path

import cv2
import numpy as np

from alice_survey.base.errors import ImageError, warn
from alice_survey.base.executor import progress
from reconstruct.pictures.files import PictureFacts, safe_name
from reconstruct.pictures.incoming import Incoming


def take_frames(video: Path, every_s: float, partial: Path, camera: str) -> list[Incoming]:
    """Write a frame at a fixed interval in seconds as PNG."""
    capture = cv2.VideoCapture(str(video))
    if not capture.isOpened():
        raise ImageError(f"{video}: not a video that can be read")
    entries: list[Incoming] = []
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
                Incoming(
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
