"""HEIC, the pictures of phones, through a decoder that the user has installed.

`pillow-heif` is no dependency: its wheels hold libraries under the GPL.
"""

from collections.abc import Mapping
from functools import cache
from importlib import import_module
from typing import Any

HEIC = (".heic", ".heif", ".hif", ".avif")
_TURNS = {3: 2, 6: 1, 8: 3}
"""Quarter turns, counter-clockwise, that undo a decoder's, by the EXIF orientation it took off."""


@cache
def can_read_heic() -> bool:
    """Whether `pillow-heif` is installed; Pillow then knows its formats."""
    try:
        pillow_heif = import_module("pillow_heif")
    except ImportError:
        return False
    pillow_heif.register_heif_opener()
    return True


def stored_turns(info: Mapping[str, Any]) -> int:
    """Quarter turns, counter-clockwise, from a picture as decoded to its pixels as stored."""
    return _TURNS.get(info.get("original_orientation") or 1, 0)
