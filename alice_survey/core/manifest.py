"""The image manifest: all pictures with their camera, time and navigation.

Pictures enter a reconstruction through `images/manifest.csv` only, never by a file-name trick.
"""

import math
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import TypeAdapter, ValidationError

from alice_survey.core.artefacts import read_csv, write_csv
from alice_survey.core.errors import ImageError

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

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
    def has_horizontal(self) -> bool:
        """Whether latitude and longitude are known."""
        return not math.isnan(self.latitude_deg + self.longitude_deg)

    @property
    def readings(self) -> dict[str, bool]:
        """What navigation may measure of a picture, and whether it did."""
        return {
            "latitude and longitude": self.has_horizontal,
            "depth": not math.isnan(self.depth_m),
            "roll and pitch": not math.isnan(self.roll_deg + self.pitch_deg),
            "heading": not math.isnan(self.heading_deg),
            "altitude": not math.isnan(self.altitude_m),
        }

    @property
    def has_attitude(self) -> bool:
        """Whether roll, pitch and heading are known."""
        return not math.isnan(self.roll_deg + self.pitch_deg + self.heading_deg)

    @property
    def ned_from_body(self) -> "Rotation":
        """Attitude; only where `has_attitude`."""
        from alice_survey.core.frames import rotation_from_attitude  # so that status stays quick

        return rotation_from_attitude(
            *np.deg2rad([self.roll_deg, self.pitch_deg, self.heading_deg])
        )


_COLUMNS = tuple(field.name for field in fields(ImageRecord))
_RECORDS = TypeAdapter(list[ImageRecord])


def write_manifest(path: Path, records: Sequence[ImageRecord]) -> None:
    """Write the manifest; numbers keep all their digits."""
    write_csv(path, _COLUMNS, ([getattr(r, name) for name in _COLUMNS] for r in records))


def read_manifest(path: Path) -> list[ImageRecord]:
    """Read a manifest.

    Raises:
        ImageError: it is missing, lacks a column, holds a value that is not a number, names a
            picture twice, or a path that leaves its folder.
    """
    _, rows = read_csv(path, exact=True, fault=ImageError)
    try:
        records = _RECORDS.validate_python(
            [{name: cell for name, cell in row.items() if name and cell} for _, row in rows]
        )
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        row, name = first["loc"]
        raise ImageError(f"{path} line {rows[int(row)][0]}: {name}: {first['msg']}") from None
    for name, count in Counter(record.image for record in records).items():
        if count > 1:
            raise ImageError(f"{path}: picture {name} is named twice")
    for inside in {part for record in records for part in (record.image, record.mask)}:
        if Path(inside).is_absolute() or ".." in Path(inside).parts:
            raise ImageError(f"{path}: {inside!r} leaves its folder")
    return records


def stored_name(image: str, images: Collection[str]) -> str:
    """A picture's name in the manifest: as given, or of the one that differs in its case alone."""
    alike = [image] if image in images else [n for n in images if n.lower() == image.lower()]
    return alike[0] if len(alike) == 1 else image
