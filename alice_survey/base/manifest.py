"""The image manifest: all pictures with their camera, time and navigation.

Pictures enter a reconstruction through `images/manifest.csv` only, never by a file-name trick.
"""

import csv
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from alice_survey.base.artefacts import write_csv
from alice_survey.base.errors import ImageError

NAN = math.nan


@dataclass(frozen=True, kw_only=True)
class ImageRecord:
    """One picture: a row of the manifest. Unknown values are NaN (an empty cell)."""

    image: str
    """Path below the folder of the manifest, with forward slashes."""
    camera: str
    """Name of the camera: `left`, `right`, or what the rig file calls it."""
    station: int
    """Pictures of one station were exposed at the same moment."""
    mask: str = ""
    """Path of a mask below the folder of the manifest (0 = leave out), or empty."""
    time_s: float = NAN
    """Seconds since mission start."""
    latitude_deg: float = NAN
    longitude_deg: float = NAN
    """Position of the body's origin (of the camera itself where no rig is known)."""
    depth_m: float = NAN
    """Depth of the same point below the datum's reference level; negative above it."""
    roll_deg: float = NAN
    pitch_deg: float = NAN
    heading_deg: float = NAN
    altitude_m: float = NAN
    """Height of the left port's outer glass above the sea floor."""
    sigma_horizontal_m: float = NAN
    """Standard deviation of north and of east."""
    sigma_depth_m: float = NAN
    sigma_attitude_deg: float = NAN
    sigma_heading_deg: float = NAN
    sigma_altitude_m: float = NAN

    @property
    def has_position(self) -> bool:
        """Whether latitude, longitude and depth are known."""
        return not math.isnan(self.latitude_deg + self.longitude_deg + self.depth_m)

    @property
    def has_attitude(self) -> bool:
        """Whether roll, pitch and heading are known."""
        return not math.isnan(self.roll_deg + self.pitch_deg + self.heading_deg)


_GREATEST = 1e15
"""Largest number: integers up to here are exact, and no quantity needs more."""
_TEXT = ("image", "camera", "mask")
_COLUMNS = tuple(field.name for field in fields(ImageRecord))


def write_manifest(path: Path, records: Sequence[ImageRecord]) -> None:
    """Write the manifest; numbers keep all their digits."""
    write_csv(path, _COLUMNS, ([getattr(r, name) for name in _COLUMNS] for r in records))


def read_manifest(path: Path) -> list[ImageRecord]:
    """Read a manifest.

    Raises:
        ImageError: it is missing, lacks a column, holds a value that is not a number, names a
            picture twice, or a path that leaves its folder.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            missing = {"image", "camera", "station"} - set(reader.fieldnames or [])
            if missing:
                raise ImageError(f"{path}: column {min(missing)} is missing")
            records = [_record(path, line, row) for line, row in enumerate(reader, 2)]
    except OSError as error:
        raise ImageError(f"{path}: cannot be read: {error.strerror}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise ImageError(f"{path}: no CSV text in UTF-8: {error}") from None
    for name, count in Counter(record.image for record in records).items():
        if count > 1:
            raise ImageError(f"{path}: picture {name} is named twice")
    return records


def _record(path: Path, line: int, row: dict[str, str]) -> ImageRecord:
    values: dict[str, str | float | int] = {}
    for name in _COLUMNS:
        cell = row.get(name) or ""
        if name in _TEXT:
            values[name] = cell
            continue
        try:
            values[name] = int(cell) if name == "station" else float(cell) if cell else NAN
            too_large = abs(float(values[name])) > _GREATEST
        except (ValueError, OverflowError):
            raise ImageError(f"{path} line {line}: {name} is {cell!r:.60}, not a number") from None
        if too_large:
            raise ImageError(f"{path} line {line}: {name} is {cell!r:.60}: too large")
    for name in ("image", "mask"):
        inside = Path(str(values[name]))
        if inside.is_absolute() or ".." in inside.parts:
            raise ImageError(f"{path} line {line}: {name} {values[name]!r} leaves its folder")
        if not str(values[name]).isprintable():
            raise ImageError(f"{path} line {line}: {name} {values[name]!r} is not a file name")
    return ImageRecord(**values)  # type: ignore[arg-type]
