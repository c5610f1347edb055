"""What a person knows of a site: `control.csv`, and where pictures show it: `picks.csv`.

`control.csv`, one row each, columns in any order, those not needed left out or empty; a row whose
first cell starts with `#` and a space is a comment, in both files:

- `kind`: `point` (known coordinates), `bar` (known distance of two points) or `marker` (known side
  of a coded marker).
- `name`: of the point or bar; the number of a marker.
- `use`: `control` places the model, `check` only scores it.
- a point's place, one of: `latitude_deg, longitude_deg`; `north_m, east_m` of the survey's datum;
  `easting_m, northing_m, epsg`. With it `depth_m` below the datum's level, or `height_m` above the
  WGS 84 ellipsoid. `sigma_m` (north and east each), `sigma_vertical_m` (as `sigma_m` if empty).
- a bar's `from`, `to` (points), `length_m`, `sigma_m`.
- a marker's `length_m` (side of the black square) and `sigma_m`.

Points are picked in `picks.csv`: `image, point, x, y` in pixels of the picture as taken, counted
from 0 at the middle of the first pixel as viewers show them, and `sigma_px` (0.5 if empty). Where
`matched_to` names a picture, the pick was not made by eye: the neighbourhood of the pick in that
picture was found again, and `sigma_px` says how well, relative to it. A coded marker `7` has the
corners `7.0` to `7.3`, clockwise from its own upper left, and `7` is its middle.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from alice_survey.core.artefacts import read_csv
from alice_survey.core.errors import WorkspaceError
from alice_survey.core.frames import Array, Datum
from alice_survey.core.stages import CONTROL_FILES

CONTROL_FILE, PICKS_FILE, MARKERS_FILE = CONTROL_FILES
PICK_SIGMA_PX = 0.5
Use = Literal["control", "check"]


@dataclass(frozen=True, kw_only=True)
class KnownPoint:
    """A point whose place is known, in the coordinates of the row; NaN what was not given."""

    name: str
    use: Use
    latitude_deg: float
    longitude_deg: float
    north_m: float
    east_m: float
    depth_m: float
    height_m: float
    sigma_m: float
    sigma_vertical_m: float

    @property
    def geodetic(self) -> bool:
        """Whether it says where on Earth it is."""
        return not math.isnan(self.latitude_deg)

    def ned(self, datum: Datum | None) -> Array:
        """(3,) place in the local frame of a datum.

        Raises:
            WorkspaceError: its kind of coordinates needs a datum, and there is none.
        """
        if datum is None:
            if self.geodetic or math.isnan(self.depth_m):
                raise WorkspaceError(
                    f"{CONTROL_FILE}: point {self.name} needs a datum: give north_m, east_m and "
                    "depth_m"
                )
            return np.array([self.north_m, self.east_m, self.depth_m])
        depth = self.depth_m if math.isnan(self.height_m) else datum.height_m - self.height_m
        if self.geodetic:
            place = np.array([[self.latitude_deg, self.longitude_deg, depth]])
            return np.asarray(datum.ned_from_geodetic(place)[0])
        return np.array([self.north_m, self.east_m, depth])


@dataclass(frozen=True, kw_only=True)
class KnownLength:
    """A distance between points, or the side of a marker (`ends` None)."""

    name: str
    use: Use
    ends: tuple[str, str] | None
    length_m: float
    sigma_m: float


@dataclass(frozen=True, kw_only=True)
class Control:
    """All that is known of a site."""

    points: tuple[KnownPoint, ...] = ()
    lengths: tuple[KnownLength, ...] = ()

    def datum(self) -> Datum | None:
        """A datum in the middle of the points that say where on Earth they are; None without."""
        places = [(p.latitude_deg, p.longitude_deg) for p in self.points if p.geodetic]
        if not places:
            return None
        latitude, longitude = np.mean(places, axis=0)
        return Datum(float(latitude), float(longitude))


@dataclass(frozen=True, kw_only=True)
class Pick:
    """A point in one picture; pixels of the picture as taken, from the first one's outer corner."""

    image: str
    point: str
    x_px: float
    y_px: float
    sigma_px: float
    """Of one coordinate; of a matched pick, relative to the pick that it was matched to."""
    matched_to: str = ""
    """Picture whose pick of the point was found again in this one; empty of a pick by itself."""


def read_control(path: Path) -> Control:
    """Read `control.csv`; the module says what it holds.

    Raises:
        WorkspaceError: it cannot be read, or a row is wrong; the message names the line.
    """
    points, lengths = [], []
    for line, row in read_csv(path, ("kind", "name", "use"), fault=WorkspaceError)[1]:
        if _is_comment(row):
            continue
        kind, name, use = row["kind"], row["name"], row["use"]
        if use not in ("control", "check"):
            raise WorkspaceError(f"{path} line {line}: use is {use!r}, not control or check")
        if not name:
            raise WorkspaceError(f"{path} line {line}: a name is missing")
        which: Use = "control" if use == "control" else "check"
        sigma = _positive(path, line, row, "sigma_m")
        if kind == "point":
            points.append(_point(path, line, row, name, which, sigma))
        elif kind in ("bar", "marker"):
            ends = (row.get("from", ""), row.get("to", "")) if kind == "bar" else None
            if ends is not None and (not all(ends) or ends[0] == ends[1]):
                raise WorkspaceError(f"{path} line {line}: a bar needs two points, from and to")
            length = _positive(path, line, row, "length_m")
            lengths.append(
                KnownLength(name=name, use=which, ends=ends, length_m=length, sigma_m=sigma)
            )
        else:
            raise WorkspaceError(f"{path} line {line}: kind is {kind!r}, not point, bar or marker")
    names = [p.name for p in points]
    if len(set(names)) < len(names):
        double = next(n for n in names if names.count(n) > 1)
        raise WorkspaceError(f"{path}: point {double} is there twice")
    return Control(points=tuple(points), lengths=tuple(lengths))


def read_picks(path: Path) -> list[Pick]:
    """Read `picks.csv` or `markers.csv`; rows without x and y are left out.

    Raises:
        WorkspaceError: it cannot be read, or a row is wrong.
    """
    picks = []
    for line, row in read_csv(path, ("image", "point", "x", "y"), fault=WorkspaceError)[1]:
        if _is_comment(row) or (not row["x"] and not row["y"]):
            continue
        x, y = _number(path, line, row, "x"), _number(path, line, row, "y")
        sigma = _number(path, line, row, "sigma_px")
        if math.isnan(x + y) or sigma <= 0:
            raise WorkspaceError(f"{path} line {line}: x, y and sigma_px must be numbers")
        picks.append(
            Pick(
                image=row["image"],
                point=row["point"],
                x_px=x + 0.5,
                y_px=y + 0.5,
                sigma_px=PICK_SIGMA_PX if math.isnan(sigma) else sigma,
                matched_to=row.get("matched_to", ""),
            )
        )
    return picks


def _is_comment(row: dict[str, str]) -> bool:
    return next(iter(row.values()), "").startswith("# ")


def _point(
    path: Path, line: int, row: dict[str, str], name: str, use: Use, sigma: float
) -> KnownPoint:
    keys = ("latitude_deg", "longitude_deg", "north_m", "east_m", "easting_m", "northing_m",
            "epsg", "depth_m", "height_m", "sigma_vertical_m")  # fmt: skip
    at = {key: _number(path, line, row, key) for key in keys}
    known = [
        not math.isnan(at[a] + at[b])
        for a, b in (
            ("latitude_deg", "longitude_deg"),
            ("north_m", "east_m"),
            ("easting_m", "northing_m"),
        )
    ]
    if sum(known) != 1:
        raise WorkspaceError(
            f"{path} line {line}: point {name} needs either latitude_deg and longitude_deg, or "
            "north_m and east_m, or easting_m, northing_m and epsg"
        )
    if math.isnan(at["depth_m"]) == math.isnan(at["height_m"]):
        raise WorkspaceError(f"{path} line {line}: point {name} needs either depth_m or height_m")
    latitude, longitude = at["latitude_deg"], at["longitude_deg"]
    if known[2]:
        longitude, latitude = _unproject(path, line, at["epsg"], at["easting_m"], at["northing_m"])
    if known[0] and not (abs(latitude) <= 90 and abs(longitude) <= 360):
        raise WorkspaceError(f"{path} line {line}: {latitude}, {longitude} is not a place on Earth")
    vertical = at["sigma_vertical_m"]
    if vertical <= 0:
        raise WorkspaceError(f"{path} line {line}: sigma_vertical_m must be more than 0")
    return KnownPoint(
        name=name,
        use=use,
        latitude_deg=latitude,
        longitude_deg=longitude,
        north_m=at["north_m"],
        east_m=at["east_m"],
        depth_m=at["depth_m"],
        height_m=at["height_m"],
        sigma_m=sigma,
        sigma_vertical_m=sigma if math.isnan(vertical) else vertical,
    )


def _unproject(path: Path, line: int, epsg: float, x: float, y: float) -> tuple[float, float]:
    from pyproj import Transformer
    from pyproj.exceptions import CRSError, ProjError

    try:
        code = int(epsg)
        place = Transformer.from_crs(code, 4326, always_xy=True).transform(x, y, errcheck=True)
    except (ValueError, CRSError, ProjError) as error:
        raise WorkspaceError(f"{path} line {line}: epsg {epsg}: {error}") from None
    return float(place[0]), float(place[1])


def _number(path: Path, line: int, row: dict[str, str], key: str) -> float:
    cell = row.get(key, "")
    try:
        value = float(cell) if cell else math.nan
    except ValueError:
        raise WorkspaceError(f"{path} line {line}: {key} is {cell!r}, not a number") from None
    if math.isinf(value) or (cell and math.isnan(value)):
        raise WorkspaceError(f"{path} line {line}: {key} is {cell!r}, not a number")
    return value


def _positive(path: Path, line: int, row: dict[str, str], key: str) -> float:
    value = _number(path, line, row, key)
    if not value > 0:
        raise WorkspaceError(f"{path} line {line}: {key} must be more than 0")
    return value
