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

Rows of both files are put in, replaced and taken out; rows that are not meant, comments, columns of
the user's own and their order are kept byte by byte. A change states the token of the content that
it is made to, so that of two writers the second is told; a change that would leave a file that
cannot be read is refused.

Picked points are found in space through the exact lenses of their cameras. Picks that were matched
to another one err together with it: what a person meant is as far from the mark in the first
picture as the hand was unsteady, and all that was found again is off the same way. The noise of the
matches alone says how well they agree; the covariance of the point holds both (see
`covariance_of_picks`).
"""

import csv
import io
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.core.artefacts import (
    check_token,
    content_of,
    content_token,
    read_csv,
    replace_file,
    write_csv,
)
from alice_survey.core.contents import as_line, is_nowhere, is_unknown, parse_number
from alice_survey.core.errors import WorkspaceError, file_faults, warn
from alice_survey.core.frames import Array, Datum, degrees_from
from camera_calib.approximation.pinhole_warp import PinholeWarp
from camera_calib.triangulate import nearest_to_rays
from reconstruct.stages import CONTROL_FILES

CONTROL_FILE, PICKS_FILE, MARKERS_FILE = CONTROL_FILES
PICK_SIGMA_PX = 0.5
Use = Literal["control", "check"]


@dataclass(frozen=True, kw_only=True)
class KnownPoint:
    """A point whose place is known, in the coordinates of the row; NaN what was not given."""

    name: str
    use: Use = "control"
    latitude_deg: float = math.nan
    longitude_deg: float = math.nan
    north_m: float = math.nan
    east_m: float = math.nan
    depth_m: float = math.nan
    height_m: float = math.nan
    sigma_m: float = math.nan
    sigma_vertical_m: float = math.nan

    @property
    def place(self) -> tuple[float, float, float]:
        """Latitude and longitude, or north and east; then height or depth."""
        level = (self.latitude_deg, self.longitude_deg)
        vertical = self.depth_m if math.isnan(self.height_m) else self.height_m
        return (*(level if self.geodetic else (self.north_m, self.east_m)), vertical)

    @property
    def unknown(self) -> bool:
        """Whether a number of the place is missing, or stands for unknown."""
        nowhere = is_nowhere(self.latitude_deg, self.longitude_deg)
        return nowhere or any(map(is_unknown, self.place))

    @property
    def geodetic(self) -> bool:
        """Whether it says where on Earth it is."""
        return not math.isnan(self.latitude_deg)

    def place_ned(self, datum: Datum | None) -> Array:
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
    for row, fault in _rows(path, ("kind", "name", "use"), (*_KNOWN_COLUMNS, *_GRID)):
        with fault:
            known = _read_known(row)
        if isinstance(known, KnownPoint):
            points.append(known)
        else:
            lengths.append(known)
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
    for row, fault in _rows(path, ("image", "point", "x", "y"), PICKS_HEADER):
        if not row["x"] and not row["y"]:
            continue
        with fault:
            x, y, sigma = (read_number(row.get(n, ""), n) for n in ("x", "y", "sigma_px"))
            if math.isnan(x + y) or sigma <= 0:
                raise ValueError("x, y and sigma_px must be numbers")
        picks.append(Pick(
            image=row["image"], point=row["point"], x_px=x + 0.5, y_px=y + 0.5,
            sigma_px=PICK_SIGMA_PX if math.isnan(sigma) else sigma,
            matched_to=row.get("matched_to", ""),
        ))  # fmt: skip
    return picks


def _rows(
    path: Path, required: Sequence[str], known: Sequence[str]
) -> Iterator[tuple[dict[str, str], AbstractContextManager[None]]]:
    """Rows that are not comments, each with a context in which a fault names its line."""
    for line, row in read_csv(path, required, known=known, fault=WorkspaceError)[1]:
        if not next(iter(row.values()), "").startswith("# "):
            yield row, _fault_of(f"{path} line {line}")


@contextmanager
def _fault_of(place: str) -> Iterator[None]:
    try:
        yield
    except ValueError as error:
        raise WorkspaceError(f"{place}: {error}") from None


def _read_known(row: dict[str, str]) -> KnownPoint | KnownLength:
    """What a row of `control.csv` says.

    Raises:
        ValueError: it is wrong.
    """
    kind, name = row["kind"], row["name"]
    if row["use"] not in ("control", "check"):
        raise ValueError(f"use is {row['use']!r}, not control or check")
    if not name:
        raise ValueError("a name is missing")
    use: Use = "control" if row["use"] == "control" else "check"
    sigma = _positive(row, "sigma_m")
    if kind == "point":
        return _point(row, name, use, sigma)
    if kind not in ("bar", "marker"):
        raise ValueError(f"kind is {kind!r}, not point, bar or marker")
    ends = (row.get("from", ""), row.get("to", "")) if kind == "bar" else None
    if ends is not None and (not all(ends) or ends[0] == ends[1]):
        raise ValueError("a bar needs two points, from and to")
    length = _positive(row, "length_m")
    return KnownLength(name=name, use=use, ends=ends, length_m=length, sigma_m=sigma)


_POINT_COLUMNS = (
    "latitude_deg", "longitude_deg", "north_m", "east_m", "depth_m", "height_m", "sigma_m",
    "sigma_vertical_m",
)  # fmt: skip
_GRID = ("easting_m", "northing_m", "epsg")
_KNOWN_COLUMNS = ("kind", "name", "use", *_POINT_COLUMNS, "from", "to", "length_m")


def write_control(path: Path, points: Sequence[KnownPoint], lengths: Sequence[KnownLength]) -> None:
    """Write a new `control.csv` of points and bars."""
    rows: list[Sequence[object]] = [
        ("point", p.name, p.use, *(getattr(p, name) for name in _POINT_COLUMNS), *[None] * 3)
        for p in points
    ]
    rows += [
        ("bar", b.name, b.use, *[None] * 6, b.sigma_m, None, *(b.ends or ()), b.length_m)
        for b in lengths
    ]
    write_csv(path, _KNOWN_COLUMNS, rows)


def write_picks(path: Path, picks: Sequence[Pick]) -> None:
    """Write a new `picks.csv`, whose pixels count from the middle of the first."""
    rows = [(p.image, p.point, p.x_px - 0.5, p.y_px - 0.5, p.sigma_px) for p in picks]
    write_csv(path, ("image", "point", "x", "y", "sigma_px"), rows)


def _point(row: dict[str, str], name: str, use: Use, sigma: float) -> KnownPoint:
    at = {key: read_number(row.get(key, ""), key) for key in _POINT_COLUMNS}
    easting, northing, epsg = (read_number(row.get(key, ""), key) for key in _GRID)
    places = (
        (at["latitude_deg"], at["longitude_deg"]), (at["north_m"], at["east_m"]),
        (easting, northing),
    )  # fmt: skip
    known = [not math.isnan(sum(place)) for place in places]
    if sum(known) != 1:
        raise ValueError(
            f"point {name} needs either latitude_deg and longitude_deg, or north_m and east_m, or "
            "easting_m, northing_m and epsg"
        )
    if math.isnan(at["depth_m"]) == math.isnan(at["height_m"]):
        raise ValueError(f"point {name} needs either depth_m or height_m")
    if known[2]:
        place = coordinates(f"EPSG:{epsg:g}")(easting, northing)
        at["latitude_deg"], at["longitude_deg"] = place.latitude_deg, place.longitude_deg
    if known[0] and not (abs(at["latitude_deg"]) <= 90 and abs(at["longitude_deg"]) <= 360):
        raise ValueError(f"{places[0][0]}, {places[0][1]} is not a place on Earth")
    if at["sigma_vertical_m"] <= 0:
        raise ValueError("sigma_vertical_m must be more than 0")
    if math.isnan(at["sigma_vertical_m"]):
        at["sigma_vertical_m"] = sigma
    point = KnownPoint(name=name, use=use, **at)
    if point.unknown:
        raise ValueError(f"the place {point.place} of point {name} holds what stands for unknown")
    return point


PlaceOf = Callable[[float, float], KnownPoint]
"""A nameless point from x (easting or longitude) and y in the coordinates of a file."""


@lru_cache(maxsize=8)
def coordinates(system: str) -> PlaceOf:
    """Coordinates of a file from the name of their system, as `degrees_from` takes it.

    The first place outside of where the system is used is named in a warning.

    Raises:
        ValueError: it is no coordinate system; of a place, that it is beyond it.
    """
    degrees = degrees_from(system)
    if degrees is None:  # a local grid, metres
        return lambda x, y: KnownPoint(name="", north_m=y, east_m=x)

    def place(x: float, y: float) -> KnownPoint:
        latitude, longitude = degrees(x, y)
        return KnownPoint(name="", latitude_deg=latitude, longitude_deg=longitude)

    return place


def read_number(text: str, name: str) -> float:
    """A finite number; NaN of an empty text.

    Raises:
        ValueError: it is none.
    """
    if not text.strip():
        return math.nan
    with suppress(ValueError):
        if math.isfinite(value := parse_number(text)):
            return value
    raise ValueError(f"{as_line(name)} is {as_line(text)!r}, not a number")


def read_positive(text: str, name: str) -> float:
    """A number above 0; NaN of an empty text.

    Raises:
        ValueError: it is none.
    """
    value = read_number(text, name)
    if value <= 0:
        raise ValueError(f"{as_line(name)} is {value}: it must be more than 0")
    return value


def _positive(row: dict[str, str], key: str) -> float:
    value = read_positive(row.get(key, ""), key)
    if math.isnan(value):
        raise ValueError(f"{key} must be more than 0")
    return value


PICKS_HEADER = ("image", "point", "x", "y", "sigma_px", "matched_to")
CONTROL_HEADER = (
    "kind", "name", "use", "north_m", "east_m", "depth_m", "from", "to", "length_m", "sigma_m",
    "sigma_vertical_m",
)  # fmt: skip
_MAX_BYTES = 64 << 20
"""Bytes of a table that is read whole."""


def table_token(path: Path) -> str:
    """Token of a table's content; empty where there is no file."""
    return content_token(content_of(path, _MAX_BYTES))


def save_picks(path: Path, token: str, picks: Sequence[Pick], points: Collection[str]) -> str:
    """Replace all picks of some points.

    Args:
        path: `picks.csv`.
        token: of the content that the picks were made to.
        picks: of these points.
        points: names.

    Returns:
        Token of the new content.

    Raises:
        StaleError: the file has changed.
        WorkspaceError: it cannot be read or written, or a pick is not one.
    """
    twice = {(p.image, p.point) for p in picks if p.point not in points}
    if twice or len({(p.image, p.point) for p in picks}) < len(picks):
        raise WorkspaceError("picks: one is of another point, or a picture shows a point twice")
    rows = {
        (p.image, p.point): {
            "image": p.image, "point": p.point, "x": f"{p.x_px - 0.5:.4f}",
            "y": f"{p.y_px - 0.5:.4f}", "sigma_px": f"{p.sigma_px:.4f}",
            "matched_to": p.matched_to,
        }
        for p in picks
    }  # fmt: skip

    def meant(row: Mapping[str, str]) -> bool:
        return row.get("point", "") in points and bool(row.get("x") or row.get("y"))

    return _save(path, token, PICKS_HEADER, ("image", "point"), rows, meant, read_picks)


def save_control(
    path: Path, token: str, rows: Sequence[Mapping[str, str]], names: Collection[tuple[str, str]]
) -> str:
    """Replace the rows of some points, bars or markers.

    Args:
        path: `control.csv`.
        token: of the content that the rows were made to.
        rows: cells by column; see `reconstruct.placing.control_points`.
        names: kind and name of each row to replace; one that `rows` lacks is taken out.

    Returns:
        Token of the new content.

    Raises:
        StaleError: the file has changed.
        WorkspaceError: it cannot be read or written, or a row is wrong.
    """
    keyed = {(row.get("kind", ""), row.get("name", "")): row for row in rows}
    if len(keyed) < len(rows):
        raise WorkspaceError("control: a name is there twice")
    meant = {*names, *keyed}
    return _save(
        path, token, CONTROL_HEADER, ("kind", "name"), keyed,
        lambda row: (row.get("kind", ""), row.get("name", "")) in meant, read_control,
    )  # fmt: skip


def _save(
    path: Path,
    token: str,
    header: Sequence[str],
    key: tuple[str, str],
    rows: Mapping[tuple[str, str], Mapping[str, str]],
    meant: Callable[[Mapping[str, str]], bool],
    read: Callable[[Path], Any],
) -> str:
    now = content_of(path, _MAX_BYTES)
    check_token(path.name, now, token)
    before = now or b""
    if before:
        read(path)  # a file that is wrong is the user's to mend, with the line named
    mark, records, end = _records(path, before)
    names = [cell.strip() for cell in records[0][1]] if records else []
    requested = {name for row in rows.values() for name, cell in row.items() if cell}
    more = [name for name in header if name not in names and (not names or name in requested)]
    more += sorted(requested - {*names, *more})
    first = [text.rstrip("\r\n") for text, _ in records[:1]]
    lines = [mark + (",".join([*filter(None, first), *more]) + end if more else records[0][0])]
    left = dict(rows)
    names = [*names, *more]
    for text, values in records[1:]:
        cells = dict(zip(names, map(str.strip, values), strict=False))
        new = left.pop((cells.get(key[0], ""), cells.get(key[1], "")), None)
        if new is not None:
            lines.append(_line({**cells, **new}, names, end))
        elif not meant(cells):
            lines.append(text if text.endswith(("\n", "\r")) else text + end)
    lines += [_line(row, names, end) for row in left.values()]
    return replace_file(path, "".join(lines).encode("utf-8"), read)


def _line(cells: Mapping[str, str], names: Sequence[str], end: str) -> str:
    for cell in cells.values():
        if any(ord(character) < 32 for character in cell):
            raise WorkspaceError(f"{cell!r}: a cell holds a character that cannot be printed")
    text = io.StringIO()
    csv.writer(text, lineterminator="").writerow([cells.get(name, "") for name in names])
    return text.getvalue() + end


def _records(path: Path, content: bytes) -> tuple[str, list[tuple[str, list[str]]], str]:
    """The byte order mark, the records with the header first, and how lines end.

    A record is its text as it stands in the file, with the end of its line, and its cells.
    """
    with file_faults(path, WorkspaceError):
        text = content.decode("utf-8")
        mark = "\ufeff" if text.startswith("\ufeff") else ""
        lines = io.StringIO(text.removeprefix(mark), newline="").readlines()
        reader, records, at = csv.reader(lines, skipinitialspace=True), [], 0
        for cells in reader:
            records.append(("".join(lines[at : reader.line_num]), cells))
            at = reader.line_num
    return mark, records, "\r\n" if records and records[0][0].endswith("\r\n") else "\n"


_ROBUST_PX = 1.0
_WRONG_SIGMAS = 5.0
_WRONG_PX = 2.0
"""A pick further off than both is left out where three or more remain."""
_TRIED = 6
_COARSE = 3.0
"""How many of their sigmas picks of most points must be off to count as coarser than stated."""
_MIN_POINTS = 3
"""Points that say how coarse picks are."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RegisteredPicture:
    """A registered picture: its camera, and where its pinhole stands in the model."""

    warp: PinholeWarp
    model_from_pinhole: RigidTransform

    def project(self, point: Array) -> Array:
        """Pixels (..., 2) of the picture as taken that show points (..., 3) of the model."""
        turn, place = self._stands
        return self.warp.camera.project((point - place) @ turn)

    def ray(self, pixel: Array) -> tuple[Array, Array]:
        """Starts and unit directions, (..., 3), in the model, of pixels (..., 2) as taken."""
        start, way = self.warp.camera.unproject(pixel)
        turn, place = self._stands
        return start @ turn.T + place, way @ turn.T

    @cached_property
    def _stands(self) -> tuple[Array, Array]:
        """Rotation (3, 3) `model_from_cam`, and where the entrance pupil is, (3,)."""
        pose = self.model_from_cam
        return pose.rotation.as_matrix(), np.asarray(pose.translation)

    @property
    def model_from_cam(self) -> RigidTransform:
        """The camera's own frame, whose origin is the entrance pupil, in the model."""
        return self.model_from_pinhole * self.warp.pinhole_from_cam


@dataclass(frozen=True, kw_only=True, eq=False)
class TriangulatedPoint:
    """A point found from picks."""

    name: str
    model: Array
    """(3,) place in the model."""
    covariance: Array
    """(3, 3) covariance by the picks; larger where they disagree."""
    views: int
    left_out: tuple[str, ...]
    """Pictures whose picks are off the common point."""
    rms_px: float


def triangulate_picks(
    picks: Sequence[Pick], cameras: Mapping[str, RegisteredPicture]
) -> tuple[dict[str, TriangulatedPoint], dict[str, str]]:
    """Find every picked point that two or more registered pictures show.

    Returns:
        Spots by name, with the middles of markers whose four corners were found; and why other
        points were not found, by name.
    """
    by_name: dict[str, list[Pick]] = {}
    for pick in picks:
        if pick.image in cameras:
            by_name.setdefault(pick.point, []).append(pick)
    by_name = _with_real_sigmas(by_name, cameras)
    found, lost = {}, {}
    for name in sorted({pick.point for pick in picks}):
        seen = by_name.get(name, [])
        if len({p.image for p in seen}) < 2:
            lost[name] = f"picked in {len(seen)} pictures of the model; two or more are needed"
            continue
        found_point = _triangulate(name, seen, cameras)
        if isinstance(found_point, str):
            lost[name] = found_point
        else:
            found[name] = found_point
    for name in sorted({n.rsplit(".", 1)[0] for n in found if "." in n} - set(found)):
        corners = [found.get(f"{name}.{k}") for k in range(4)]
        whole = [c for c in corners if c is not None]
        if len(whole) == 4:
            found[name] = TriangulatedPoint(
                name=name,
                model=np.mean([c.model for c in whole], axis=0),
                covariance=np.sum([c.covariance for c in whole], axis=0) / 16.0,
                views=min(c.views for c in whole),
                left_out=(),
                rms_px=float(np.sqrt(np.mean([c.rms_px**2 for c in whole]))),
            )
    return found, lost


def _with_real_sigmas(
    by_name: Mapping[str, list[Pick]], cameras: Mapping[str, RegisteredPicture]
) -> dict[str, list[Pick]]:
    """Picks whose sigmas are what those of most points miss by, where that is far more."""
    sizes = []
    for some in by_name.values():
        start = _nearest(some, cameras) if len({p.image for p in some}) > 1 else ""
        if isinstance(start, str):
            continue
        off = _fit(start, some, cameras)[0] / np.array([[p.sigma_px] for p in some])
        if np.isfinite(off).all():
            sizes.append(float(np.sqrt(np.sum(off**2) / (2 * len(some) - 3))))
    factor = float(np.median(sizes)) if len(sizes) >= _MIN_POINTS else 1.0
    if factor <= _COARSE:
        return dict(by_name)
    usual = float(np.median([p.sigma_px for some in by_name.values() for p in some]))
    warn(
        f"picks of most of {len(sizes)} points are {factor:.2g} times as far off as their sigma of "
        f"{usual:.2g} px: they count with a sigma of {factor * usual:.2g} px"
    )
    return {
        name: [replace(p, sigma_px=factor * p.sigma_px) for p in some]
        for name, some in by_name.items()
    }


def _triangulate(
    name: str, picks: list[Pick], cameras: Mapping[str, RegisteredPicture]
) -> TriangulatedPoint | str:
    """The point that fits the picks best, or why there is none."""
    start = _nearest(picks, cameras)
    if isinstance(start, str):
        return start
    kept = list(picks)
    while True:
        off, point, jacobian = _fit(start, kept, cameras)
        if not np.isfinite(off).all():
            return "a picture that it was picked in cannot see it"
        worst = _worst(off, kept)
        if worst <= 1.0:
            break
        if len(kept) < 4:
            miss_px = float(np.linalg.norm(off, axis=1).max())
            return f"its picks are {miss_px:.1f} px off one common point"
        kept = _without_one(point, kept, off, cameras)
    miss_px = np.linalg.norm(off, axis=1)
    sigma = np.repeat(own_sigmas(kept), 2)
    chi = float(((off.ravel() / sigma) ** 2).sum()) / (2 * len(kept) - 3)
    gain = gain_of(jacobian, sigma)
    covariance = gain @ covariance_of_picks(kept, jacobian, max(1.0, chi)) @ gain.T
    names = {p.image for p in kept}
    return TriangulatedPoint(
        name=name,
        model=point,
        covariance=covariance,
        views=len(kept),
        left_out=tuple(p.image for p in picks if p.image not in names),
        rms_px=float(np.sqrt((miss_px**2).mean())),
    )


def own_sigmas(picks: Sequence[Pick]) -> Array:
    """(N,) noise of one coordinate of each pick apart from what picks share, px.

    A match errs by the noise of both pictures, which is half its variance in either: with the first
    picture's half the pick that others were matched to takes part.
    """
    of: dict[str, list[float]] = {}
    for pick in picks:
        if pick.matched_to:
            of.setdefault(pick.matched_to, []).append(pick.sigma_px / np.sqrt(2.0))
    return np.array(
        [
            pick.sigma_px / np.sqrt(2.0) if pick.matched_to
            else float(np.median(of[pick.image])) if pick.image in of
            else pick.sigma_px
            for pick in picks
        ]
    )  # fmt: skip


def gain_of(jacobian: Array, sigma: Array) -> Array:
    """(3, 2 N) how the point moves with pixels of these sigmas (2 N,) and slopes (2 N, 3)."""
    weighted = jacobian / (sigma**2)[:, None]
    return np.asarray(np.linalg.solve(jacobian.T @ weighted, weighted.T), np.float64)


def covariance_of_picks(picks: Sequence[Pick], jacobian: Array, factor: float = 1.0) -> Array:
    """(2 N, 2 N) covariance of the pixels of picks of one point, as readings of what was meant.

    Matched picks follow the error of the mark in their first picture and the noise of the patch
    around it, along the surface, which is taken as square to the mean direction of the pictures.

    Args:
        picks: of the point.
        jacobian: (2 N, 3) slopes of their pixels by the point.
        factor: by which the variances of own noise are larger than stated.
    """
    own, slopes = own_sigmas(picks), jacobian.reshape(-1, 2, 3)
    found: Array = np.diag(np.repeat(factor * own**2, 2)).astype(np.float64)
    along = np.linalg.svd(jacobian)[2][:2].T
    in_plane = slopes @ along
    row = {pick.image: n for n, pick in enumerate(picks)}
    for image in sorted({pick.matched_to for pick in picks} - {""}):
        matched = [n for n, pick in enumerate(picks) if pick.matched_to == image]
        first = row.get(image, matched[0])
        marked = picks[first].sigma_px if image in row else PICK_SIGMA_PX
        follow = in_plane[matched] @ np.linalg.inv(in_plane[first])
        noise = factor * float(np.median(own[matched])) ** 2
        rows = [2 * n + k for n in matched for k in range(2)]
        together = follow.reshape(-1, 2) @ follow.reshape(-1, 2).T
        found[np.ix_(rows, rows)] += (marked**2 + noise) * together
        if image in row:
            at = [2 * first, 2 * first + 1]
            found[np.ix_(at, at)] = marked**2 * np.eye(2)
            found[np.ix_(rows, at)] = marked**2 * follow.reshape(-1, 2)
            found[np.ix_(at, rows)] = found[np.ix_(rows, at)].T
    return found


def residuals(
    point: Array, picks: Sequence[Pick], cameras: Mapping[str, RegisteredPicture]
) -> Array:
    """(N, 2) pixels at which pictures see a point minus where it was picked."""
    return np.stack([cameras[p.image].project(point) - [p.x_px, p.y_px] for p in picks])


def _worst(off: Array, picks: Sequence[Pick]) -> float:
    """The largest miss, over what a right pick may miss by."""
    limit = np.array([max(_WRONG_PX, _WRONG_SIGMAS * p.sigma_px) for p in picks])
    return float((np.linalg.norm(off, axis=1) / limit).max())


def _without_one(
    point: Array, picks: list[Pick], off: Array, cameras: Mapping[str, RegisteredPicture]
) -> list[Pick]:
    """Leave out the pick without which the others agree best; among many, the worst.

    Among few, a wrong pick draws the point to itself and lets a right one look worse.
    """
    order = np.argsort(-np.linalg.norm(off, axis=1), kind="stable")[:_TRIED]
    choices = [[p for k, p in enumerate(picks) if k != out] for out in order]
    offsets = [_worst(_fit(point, choice, cameras)[0], choice) for choice in choices]
    return choices[int(np.argmin(offsets))]


def _nearest(picks: Sequence[Pick], cameras: Mapping[str, RegisteredPicture]) -> Array | str:
    """The point nearest to all rays, (3,)."""
    rays = [cameras[p.image].ray(np.array([p.x_px, p.y_px])) for p in picks]
    starts, ways = np.stack([r[0] for r in rays]), np.stack([r[1] for r in rays])
    if not np.isfinite(starts + ways).all():
        return "a pick is beyond the reach of its lens"
    found: Array = nearest_to_rays(starts[:, None], ways[:, None])[0]
    return found if np.isfinite(found).all() else "the pictures see it from one direction only"


def _fit(
    start: Array, picks: Sequence[Pick], cameras: Mapping[str, RegisteredPicture]
) -> tuple[Array, Array, Array]:
    """Misses (N, 2) px of the best point, the point (3,), and their derivatives (2 N, 3)."""
    own = own_sigmas(picks)
    usual = float(np.median(own))
    from scipy.optimize import least_squares

    near_px = max(_ROBUST_PX, 2.0 * usual)
    weight = np.repeat(usual / own, 2)
    unit = float(np.linalg.norm(start - cameras[picks[0].image].model_from_pinhole.translation))

    def offsets(x: Array, weight: Array | float = 1.0) -> Array:
        off = residuals(start + unit * x, picks, cameras)
        return np.asarray(weight * np.nan_to_num(off.ravel(), nan=1e6))

    found = least_squares(
        offsets, np.zeros(3), loss="soft_l1", f_scale=near_px, xtol=1e-12, ftol=1e-12,
        gtol=1e-12, jac="3-point", args=(weight,),
    )  # fmt: skip
    jacobian = np.empty((2 * len(picks), 3))
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-6
        jacobian[:, axis] = (offsets(found.x + step) - offsets(found.x - step)) / (2e-6 * unit)
    off = offsets(found.x).reshape(-1, 2)
    return np.where(np.abs(off) >= 1e6, np.nan, off), start + unit * found.x, jacobian
