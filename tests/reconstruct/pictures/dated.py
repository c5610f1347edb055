"""Small pictures with dates and places, and a navigation log of the same dive."""

from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
from PIL import Image

from reconstruct.pictures.importing import ImportRecord, Preview

BEGAN = datetime(2024, 7, 1, 12, 0, 0)


def take(
    path: Path, second: int, *, model: str = "", place: float | None = None, px: int = 64
) -> Path:
    """A picture of noise that EXIF dates and places."""
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    exif[0x0110] = model
    taken = BEGAN + timedelta(seconds=second)
    exif.get_ifd(0x8769)[0x9003] = f"{taken:%Y:%m:%d %H:%M:%S}"
    if place is not None:
        exif.get_ifd(0x8825).update(
            {1: "N", 2: (43.0, 0.0, place), 3: "E", 4: (5.0, 0.0, 0.0), 5: b"\1", 6: 10.0}
        )
    pixels = np.random.default_rng(second).integers(0, 256, (48, px, 3), np.uint8)
    Image.fromarray(pixels).save(path, exif=exif, quality=90)
    return path


def navigation(path: Path, seconds: int, start: datetime = BEGAN) -> Path:
    rows = ["time_utc,latitude_deg,longitude_deg,depth_m"]
    rows += [
        f"{start + timedelta(seconds=s):%Y-%m-%dT%H:%M:%SZ},43,5,{s / 10}" for s in range(seconds)
    ]
    path.write_text("\n".join(rows))
    return path


def counts(found: ImportRecord | Preview) -> dict[str, int]:
    """Pictures by camera."""
    return {name: row.pictures for name, row in found.cameras.items()}


def reasons(found: ImportRecord) -> dict[str, int]:
    """How many files were left out, by reason."""
    return {reason: len(names) for reason, names in found.left_out.items()}
