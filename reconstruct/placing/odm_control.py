"""OpenDroneMap's `gcp_list.txt`.

The first line names the coordinate system (`EPSG:32615`, a PROJ string or `WGS84 UTM 16N`); each
other line is a pick: `x y z im_x im_y picture [name]`, apart by blanks. Picks of one name, or where
there are no names of one place, are one point.
"""

import math
import re

from alice_survey.core.contents import shown
from reconstruct.placing.foreign_control import (
    Coordinates,
    ForeignControl,
    ForeignPick,
    ForeignPoint,
)

_UTM = re.compile(r"WGS84\s+UTM\s+(\d{1,2})\s*([NS])", re.IGNORECASE)
_SYSTEM = re.compile(r"\s*(EPSG:|\+proj|WGS84\b)", re.IGNORECASE)
_MIN_FIELDS = 6


def is_gcp_list(text: str) -> bool:
    """Whether a text is such a list."""
    return _SYSTEM.match(text) is not None


def read_gcp_list(text: str) -> ForeignControl:
    """Read it.

    Raises:
        ValueError: a line is wrong.
    """
    lines = [
        (number, line.strip())
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    (_, system), *rows = lines
    coordinates = Coordinates(_system(system))
    points: dict[str, ForeignPoint] = {}
    names: dict[tuple[float, ...], str] = {}
    picks = []
    for number, line in rows:
        fields = line.split()
        if len(fields) < _MIN_FIELDS:
            raise ValueError(
                f"line {number}: {len(fields)} fields, not x y z im_x im_y picture [name]"
            )
        try:
            x, y, z, column, row = map(float, fields[:5])
        except ValueError:
            raise ValueError(f"line {number}: {shown(line)!r} has no five numbers") from None
        if not all(map(math.isfinite, (x, y, column, row))):
            raise ValueError(f"line {number}: {shown(line)!r} has a number that is not finite")
        if len(fields) > _MIN_FIELDS:
            name = fields[_MIN_FIELDS]
        else:
            name = names.setdefault((x, y, z), f"P{len(names) + 1}")
        point = ForeignPoint(
            name=name, place=coordinates.place(x, y, z), geodetic=coordinates.geodetic
        )
        first = points.setdefault(name, point)
        if first.place != point.place and not math.isnan(z):
            raise ValueError(f"line {number}: point {shown(name)} has another place than before")
        picks.append(ForeignPick(picture=fields[5], point=name, x_px=column, y_px=row))
    return ForeignControl(points=tuple(points.values()), picks=tuple(picks))


def _system(line: str) -> str:
    """The name of a coordinate system as pyproj takes it."""
    utm = _UTM.match(line)
    if utm is None:
        return line
    south = utm[2].upper() == "S"
    return f"EPSG:{(32700 if south else 32600) + int(utm[1])}"
