"""Picture files: checked before they are decoded, and decoded within bounds."""

import contextlib
import re
import struct
import warnings
import zlib
from collections.abc import Iterator, Sequence
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.contents import one_line, ordinary_file
from alice_survey.core.errors import ImageError, memory_shortage

MAX_PIXELS = 104_000_000
"""Most pixels of a picture: 0.8 GB of 4 channels and 16 bits. A small file can state any size."""
MAX_PIXELS_JPEG = 160_000_000
"""Most pixels of a JPEG, whose pixels take half as much or less."""
KINDS = {
    "PNG": (".png",), "JPEG": (".jpg", ".jpeg", ".jfif"), "TIFF": (".tif", ".tiff"),
    "BMP": (".bmp",), "PNM": (".pgm", ".ppm"), "WebP": (".webp",), "JPEG 2000": (".jp2",),
}  # fmt: skip
"""Pictures that are read, RAW of cameras apart, by the ends of their names."""
PILLOW_FAULTS = (
    OSError, SyntaxError, ValueError, TypeError, KeyError, IndexError, AttributeError,
    ArithmeticError, MemoryError, EOFError, RuntimeError, struct.error, zlib.error,
)  # fmt: skip
"""Errors that Pillow raises on damaged files, by format and version."""
_YEARS = range(1970, 2200)
"""Years in which a digital camera can have taken a picture."""
_EXIF, _DATE, _SUBSECOND, _OFFSET = 0x8769, 0x9003, 0x9291, 0x9011
_ORIENTATION, _SHORT = 0x0112, 3


_NAME = re.compile(r"[A-Za-z0-9_-]+")
_MAX_CAMERAS = 8


def places_of_cameras(texts: Sequence[str]) -> dict[str, str]:
    """Folder or pattern by camera, from values of `--camera`: NAME=FOLDER.

    Raises:
        ImageError: one is not of this form, a name is given twice, or there are too many.
    """
    places: dict[str, str] = {}
    for text in texts:
        name, is_there, place = text.partition("=")
        if not (is_there and place and _NAME.fullmatch(name)):
            raise ImageError(
                f"--camera {text}: write NAME=FOLDER, a name of letters, digits, - and _ first"
            )
        if name in places:
            raise ImageError(f"--camera {text}: two cameras are called {name}")
        places[name] = place
    if len(places) > _MAX_CAMERAS:
        raise ImageError(f"{len(places)} cameras are given, {_MAX_CAMERAS} at most")
    return places


@contextlib.contextmanager
def opened_picture(path: Path) -> Iterator[Any]:
    """A picture opened by Pillow, without its warnings.

    Raises:
        ImageError: it is damaged, or of a kind that Pillow does not know.
    """
    from PIL import Image

    try:
        with warnings.catch_warnings(), Image.open(ordinary_file(path, None)) as image:
            warnings.simplefilter("ignore")
            yield image
    except (*PILLOW_FAULTS, Image.DecompressionBombError) as error:
        raise ImageError(f"corrupt: {one_line(error)}".replace(str(path), path.name)) from None


_MAX_BYTES = 4 << 30
"""Bytes of a picture that is read whole."""


def pixels_too_many(path: Path) -> int:
    """The most pixels that are decoded where a picture's header states more, else 0.

    Also 0 of a kind that Pillow does not know.
    """
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(ordinary_file(path, None)) as image:
                maximum = MAX_PIXELS_JPEG if image.format == "JPEG" else MAX_PIXELS
                return maximum if image.width * image.height > maximum else 0
    except Image.DecompressionBombError:  # more than Pillow opens at all
        return MAX_PIXELS_JPEG
    except PILLOW_FAULTS:
        return 0


def without_orientation(data: bytes) -> bytes:
    """A JPEG or TIFF whose tag of orientation says that pixels are to be shown as stored.

    Everything else stays as it is, byte by byte; a file without that tag, or of another kind, too.
    """
    place = _place_of_orientation(data)
    if place is None:
        return data
    at, order = place
    return data[:at] + struct.pack(f"{order}H", 1) + data[at + 2 :]


def _place_of_orientation(data: bytes) -> tuple[int, str] | None:
    """Where the value of the tag stands, and in which order of bytes; None without it."""
    start = 0
    if data.startswith(b"\xff\xd8"):
        found = _start_of_exif(data)
        if found is None:
            return None
        start = found
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(data[start : start + 4])
    if order is None or start + 8 > len(data):
        return None
    table = start + struct.unpack_from(f"{order}I", data, start + 4)[0]
    if table + 2 > len(data):
        return None
    for entry in range(struct.unpack_from(f"{order}H", data, table)[0]):
        at = table + 2 + 12 * entry
        if at + 12 > len(data):
            return None
        if struct.unpack_from(f"{order}HHI", data, at) == (_ORIENTATION, _SHORT, 1):
            return at + 8, order
    return None


def _start_of_exif(data: bytes) -> int | None:
    """Where the tags of a JPEG's EXIF start, by its segments (ITU T.81, B.1.1)."""
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        size = struct.unpack_from(">H", data, at + 2)[0]
        if data[at + 1] == 0xE1 and data[at + 4 : at + 10] == b"Exif\0\0":
            return at + 10
        at += 2 + max(size, 2)
    return None


def read_pixels(path: Path, flags: int) -> NDArray[Any] | None:
    """A picture as OpenCV decodes it; None where it cannot, or of `pixels_too_many`.

    OpenCV turns a TIFF, or fails on it, even where it is to ignore the orientation: so that tag is
    taken off before.

    Raises:
        AliceError: there is no room for its pixels.
    """
    if pixels_too_many(path):
        return None
    # OpenCV's own warnings would stand next to the line that the caller makes of it.
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
    try:
        if path.suffix.lower() in KINDS["TIFF"] and flags & cv2.IMREAD_IGNORE_ORIENTATION:
            data = without_orientation(ordinary_file(path, _MAX_BYTES).read_bytes())
            pixels: NDArray[Any] | None = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        else:
            pixels = cv2.imread(str(ordinary_file(path, None)), flags)
    except OSError:
        return None
    except cv2.error as error:
        if error.code == cv2.Error.StsNoMem:
            raise memory_shortage(path) from None
        return None  # more pixels than OpenCV takes
    return pixels


def exif_time(exif: Any) -> datetime | None:
    """When a picture was taken, with fractions of a second and the zone where EXIF has them."""
    details = exif.get_ifd(_EXIF)
    text = details.get(_DATE) or exif.get(_DATE)
    try:
        time = datetime.strptime(str(text).strip("\0 "), "%Y:%m:%d %H:%M:%S")
    except ValueError:
        return None
    if time.year not in _YEARS:
        return None
    digits = re.match(r"\d+", str(details.get(_SUBSECOND, "")))
    if digits:
        time += timedelta(seconds=float(f"0.{digits[0]}"))
    with contextlib.suppress(ValueError):
        zone = datetime.strptime(str(details.get(_OFFSET, "")).strip("\0 "), "%z")
        time = time.replace(tzinfo=zone.tzinfo)
    return time


def time_taken(path: Path) -> datetime | None:
    """The time in a picture's EXIF, with or without a zone; None where it has none."""
    try:
        with opened_picture(path) as image:
            return exif_time(image.getexif())
    except ImageError:
        return None


def is_cut_short(path: Path) -> bool:
    """Whether a JPEG's data end before its picture does; OpenCV would fill the rest with grey.

    Coded data hold no markers (ITU T.81, B.1.1.5), so that the end of the image must be among what
    follows the last start of a scan.
    """
    if path.suffix.lower() not in (".jpg", ".jpeg") or not path.is_file():
        return False
    data = ordinary_file(path, None).read_bytes()
    scan = data.rfind(b"\xff\xda")
    return data.startswith(b"\xff\xd8") and scan >= 0 and data.find(b"\xff\xd9", scan) < 0
