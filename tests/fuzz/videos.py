"""Videos of cameras: the index of an MP4, telemetry in it, and tags of pictures."""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from PIL import Image

from tests.fuzz.target import Target
from tests.reconstruct.pictures import gopro

_WHEN = datetime(2024, 7, 1, 12, tzinfo=UTC)
_PLACES = [(60.0, 5.0, 1.0)] * 3


def _film(folder: Path, payload: bytes) -> None:
    """A short film of a GoPro."""
    frames = [np.full((16, 16, 3), level, np.uint8) for level in range(3)]
    gopro.film(folder / "GX010042.MP4", frames, 1.0, created=_WHEN, payloads=[payload] * 3)


def read_video(path: Path) -> object:
    """As `import-images` does next to the decoder of its frames."""
    from reconstruct.pictures.telemetry import read_fixes
    from reconstruct.pictures.videos import video_start

    fixes = read_fixes(path, 3.0)
    return video_start(path), fixes.start_utc(), fixes.at(0.5)


def _turned(folder: Path, name: str) -> None:
    exif = Image.Exif()
    exif[0x112] = 6
    Image.new("RGB", (16, 16)).save(folder / name, exif=exif)


def take_orientation_off(path: Path) -> object:
    from camera_calib.picture_files import without_orientation

    return without_orientation(path.read_bytes())


TARGETS = (
    Target(
        "MP4 with GPS5", "binary", "GX010042.MP4",
        lambda folder: _film(folder, gopro.gps5(_PLACES, _WHEN)), read_video, examples=60,
    ),
    Target(
        "MP4 with GPS9", "binary", "GX010042.MP4",
        lambda folder: _film(folder, gopro.gps9(_PLACES, _WHEN)), read_video, examples=60,
    ),
    Target(
        "JPEG with an orientation", "binary", "a.jpg", lambda folder: _turned(folder, "a.jpg"),
        take_orientation_off,
    ),
    Target(
        "TIFF with an orientation", "binary", "a.tif", lambda folder: _turned(folder, "a.tif"),
        take_orientation_off,
    ),
)  # fmt: skip
