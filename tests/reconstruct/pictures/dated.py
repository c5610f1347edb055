"""Small pictures with tags of EXIF, and a navigation log of the same dive."""

from collections.abc import Iterable, Sequence
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from alice_survey.core.manifest import ImageRecord, read_manifest
from reconstruct.pictures.importing import ImportRecord, Preview

BEGAN = datetime(2024, 7, 1, 12, 0, 0)
TAGS = {"orientation": 0x112, "make": 0x10F, "model": 0x110}
DETAILS = {"serial": 0xA431, "taken": 0x9003, "fraction": 0x9291, "focal": 0xA405, "lens": 0x920A}


def noise(*seed: int, size: tuple[int, int] = (64, 48)) -> np.ndarray:
    """Pixels of a picture of some width and height."""
    return np.random.default_rng(seed).integers(0, 256, (size[1], size[0], 3), np.uint8)


def save(path: Path, pixels: np.ndarray, **tags: Any) -> Path:
    """Write a picture with tags by name; `gps` is latitude, longitude and altitude."""
    exif = Image.Exif()
    exif.update({TAGS[name]: value for name, value in tags.items() if name in TAGS})
    details = {DETAILS[name]: value for name, value in tags.items() if name in DETAILS}
    exif.get_ifd(0x8769).update(details)
    if (place := tags.get("gps")) is not None:
        latitude, longitude = (
            (int(abs(v)), int(abs(v) % 1 * 60), abs(v) * 60 % 1 * 60) for v in place[:2]
        )
        north, east, high = (v >= 0 for v in place)
        exif.get_ifd(0x8825).update({
            1: "SN"[north], 2: latitude, 3: "WE"[east], 4: longitude, 5: bytes([not high]),
            6: abs(place[2]),
        })  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    more: dict[str, Any] = {"quality": 98, "subsampling": 0} if path.suffix == ".jpg" else {}
    Image.fromarray(pixels).save(path, exif=exif, **more)
    return path


def date(second: float, began: datetime = BEGAN) -> str:
    """As EXIF has it."""
    return f"{began + timedelta(seconds=second):%Y:%m:%d %H:%M:%S}"


def take(
    path: Path, second: int, *, model: str = "", place: float | None = None, px: int = 64
) -> Path:
    """A picture of noise that EXIF dates and places."""
    gps = None if place is None else (43.0 + place / 3600, 5.0, -10.0)
    return save(path, noise(second, size=(px, 48)), model=model, taken=date(second), gps=gps)


def table(path: Path, header: str, rows: Iterable[Sequence[object]]) -> Path:
    """A CSV."""
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


def navigation(path: Path, seconds: int, start: datetime = BEGAN) -> Path:
    rows = [
        (f"{start + timedelta(seconds=s):%Y-%m-%dT%H:%M:%SZ}", 43, 5, s / 10)
        for s in range(seconds)
    ]
    return table(path, "time_utc,latitude_deg,longitude_deg,depth_m", rows)


def rows_of(workspace: Path) -> list[ImageRecord]:
    """What an import wrote."""
    return read_manifest(workspace / "images" / "manifest.csv")


def counts(found: ImportRecord | Preview) -> dict[str, int]:
    """Pictures by camera."""
    return {name: row.pictures for name, row in found.cameras.items()}


def reasons(found: ImportRecord) -> dict[str, int]:
    """How many files were left out, by reason."""
    return {reason: len(names) for reason, names in found.left_out.items()}
