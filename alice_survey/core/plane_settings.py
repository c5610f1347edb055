"""Planes that DEM and mosaic are projected on, as a person names them: `reconstruct.planes`."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

LEVEL, AUTO = "level", "auto"
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,29}")
_NUMBER = r"[+-]?\d+(?:\.\d+)?"
_FACING = re.compile(rf"facing\s+({_NUMBER})(?:\s+tilt\s+({_NUMBER}))?")
_FORMS = "give level, auto, or NAME=facing DEGREES [tilt DEGREES], as wall=facing 180"


@dataclass(frozen=True, kw_only=True)
class WantedPlane:
    """A plane to project on."""

    name: str
    """Name, also of its folder."""
    facing_deg: float | None = None
    """Compass direction that the surface faces; None of `level` and `auto`."""
    tilt_deg: float = 0.0
    """Of the surface from the vertical: 90 lies and faces up, a negative one overhangs."""


def parse_plane(text: str) -> WantedPlane:
    """Read `level`, `auto`, or `NAME=facing DEGREES [tilt DEGREES]`.

    Raises:
        ValueError: it is not of that form, in words for the person who wrote it.
    """
    name, equals, how = (part.strip() for part in text.partition("="))
    if not equals:
        if name not in (LEVEL, AUTO):
            raise ValueError(f"plane {text!r}: {_FORMS}")
        return WantedPlane(name=name)
    if not _NAME.fullmatch(name):
        raise ValueError(
            f"plane {text!r}: a name is a letter and up to 29 letters, digits, _ and -, since it "
            "is a folder's too"
        )
    if name.lower() in (LEVEL, AUTO):
        raise ValueError(f"plane {text!r}: {name.lower()!r} has its own meaning: name it otherwise")
    found = _FACING.fullmatch(how)
    if found is None:
        raise ValueError(f"plane {text!r}: {_FORMS}")
    facing, tilt = float(found[1]), float(found[2] or 0.0)
    if not 0.0 <= facing <= 360.0:
        raise ValueError(f"plane {text!r}: facing is a compass direction, 0 to 360 degrees")
    if not -90.0 <= tilt <= 90.0:
        raise ValueError(f"plane {text!r}: tilt is -90 (overhanging) to 90 degrees (lying)")
    return WantedPlane(name=name, facing_deg=facing, tilt_deg=tilt)


def parse_planes(texts: Sequence[str]) -> tuple[WantedPlane, ...]:
    """Read planes, of which no two have the same name.

    Raises:
        ValueError: one is wrong, there is none, or a name is there twice.
    """
    planes = tuple(parse_plane(text) for text in texts)
    if not planes:
        raise ValueError(f"no plane: {_FORMS}")
    names = [plane.name.lower() for plane in planes]  # some file systems ignore the case
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ValueError(f"two planes are named {twice!r}: give each its own name")
    return planes
