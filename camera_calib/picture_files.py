"""Picture files: checked before they are decoded, and decoded within bounds."""

import struct
import warnings
import zlib
from pathlib import Path
from typing import Any

import cv2
from numpy.typing import NDArray

from alice_survey.base.errors import memory_shortage

MOST_PIXELS = 104_000_000
"""Most pixels of a picture: 0.8 GB of 4 channels and 16 bits. A small file can state any size."""
MOST_PIXELS_JPEG = 160_000_000
"""Most pixels of a JPEG, whose pixels take half as much or less."""
PILLOW_FAULTS = (
    OSError, SyntaxError, ValueError, TypeError, KeyError, IndexError, AttributeError,
    ArithmeticError, MemoryError, EOFError, RuntimeError, struct.error, zlib.error,
)  # fmt: skip
"""Errors that Pillow raises on damaged files, by format and version."""


def pixels_too_many(path: Path) -> int:
    """The most pixels that are decoded where a picture's header states more, else 0.

    Also 0 of a kind that Pillow does not know.
    """
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path) as image:
                most = MOST_PIXELS_JPEG if image.format == "JPEG" else MOST_PIXELS
                return most if image.width * image.height > most else 0
    except Image.DecompressionBombError:  # more than Pillow opens at all
        return MOST_PIXELS_JPEG
    except PILLOW_FAULTS:
        return 0


def read_pixels(path: Path, flags: int) -> NDArray[Any] | None:
    """A picture as OpenCV decodes it; None where it cannot, or of `pixels_too_many`.

    Raises:
        AliceError: there is no room for its pixels.
    """
    if pixels_too_many(path):
        return None
    # OpenCV's own warnings would stand next to the line that the caller makes of it.
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
    try:
        pixels: NDArray[Any] | None = cv2.imread(str(path), flags)
    except cv2.error as error:
        if error.code == cv2.Error.StsNoMem:
            raise memory_shortage(path) from None
        return None  # more pixels than OpenCV takes
    return pixels


def is_cut_short(path: Path) -> bool:
    """Whether a JPEG's data end before its picture does; OpenCV would fill the rest with grey.

    Coded data hold no markers (ITU T.81, B.1.1.5), so that the end of the image must be among what
    follows the last start of a scan.
    """
    if path.suffix.lower() not in (".jpg", ".jpeg") or not path.is_file():
        return False
    data = path.read_bytes()
    scan = data.rfind(b"\xff\xda")
    return data.startswith(b"\xff\xd8") and scan >= 0 and data.find(b"\xff\xd9", scan) < 0
