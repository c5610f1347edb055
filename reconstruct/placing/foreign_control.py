"""Control points of other programs into a workspace: `control.csv` and `picks.csv`.

A format is a pair of functions in `_READERS`: whether a text is of it, and its reader.

- Metashape and PhotoScan export markers as XML (File > Export > Export Markers). A chunk lists
  `cameras` (labels by number), `markers` with `reference` coordinates (x, y, z, their accuracies;
  unticked ones are check points), `scalebars` between two of them with a `reference` distance, and
  by frame the `location` of each marker in pictures, in pixels from the outer corner of the first
  one. Locations that no person pinned are predictions of the program, and are not used. A
  scale bar that does not name its markers by their numbers has their labels in its own, `A_B`.
- OpenDroneMap's `gcp_list.txt` names the coordinate system in its first line (`EPSG:32615`, a PROJ
  string or `WGS84 UTM 16N`); each other line is a pick: `x y z im_x im_y picture [name]`, separated
  by blanks. Picks of one name, or where there are no names of one place, are one point.
"""

import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Literal
from xml.etree import ElementTree as ET

from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError, ProjError

from alice_survey.core.artefacts import need_stage, write_csv
from alice_survey.core.contents import as_line, one_line
from alice_survey.core.errors import WorkspaceError, warn, why
from alice_survey.core.manifest import read_manifest
from alice_survey.core.untrusted import xml_root
from reconstruct.pictures.files import safe_name
from reconstruct.placing.control_points import CONTROL_FILE, PICK_SIGMA_PX, PICKS_FILE, Use

Place = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class ForeignPoint:
    """A point of known place."""

    name: str
    place: Place
    """Latitude and longitude (degrees), or north and east (metres); then height, positive up."""
    geodetic: bool
    use: Use = "control"
    sigma_m: float | None = None
    """Of north and of east; None where the file states none."""
    sigma_vertical_m: float | None = None

    def with_sigmas(
        self, sigma_m: float | None, sigma_vertical_m: float | None
    ) -> "ForeignPoint | None":
        """With the given sigmas where it has none of its own; None if one is missing then."""
        level = self.sigma_m or sigma_m
        vertical = self.sigma_vertical_m or sigma_vertical_m or level
        if level is None or vertical is None:
            return None
        return replace(self, sigma_m=level, sigma_vertical_m=vertical)


@dataclass(frozen=True, kw_only=True)
class ForeignPick:
    """A point in one picture; pixels from the outer corner of the first one."""

    picture: str
    """Name of the picture's file, with or without folder and suffix."""
    point: str
    x_px: float
    y_px: float
    sigma_px: float = PICK_SIGMA_PX


@dataclass(frozen=True, kw_only=True)
class ForeignBar:
    """A known distance of two points."""

    name: str
    ends: tuple[str, str]
    length_m: float
    use: Use = "control"
    sigma_m: float | None = None


@dataclass(frozen=True, kw_only=True)
class ForeignControl:
    """All that a file holds."""

    points: tuple[ForeignPoint, ...]
    picks: tuple[ForeignPick, ...]
    bars: tuple[ForeignBar, ...] = ()
    notes: tuple[str, ...] = ()
    """What else it holds that is not used."""


class Coordinates:
    """Coordinates of a file, from the name of their system."""

    def __init__(self, system: str) -> None:
        """`system` is what pyproj takes (EPSG code, PROJ string, WKT).

        Raises:
            ValueError: it is no coordinate system.
        """
        try:
            self._crs = CRS.from_user_input(system)
        except CRSError:
            raise ValueError(f"{as_line(system)!r} is no coordinate system that is known") from None
        self.geodetic = not self._crs.is_engineering
        """Whether it says where on Earth a point is; else it is a local grid, metres."""
        self._to_wgs84 = (
            Transformer.from_crs(self._crs.to_2d(), 4326, always_xy=True) if self.geodetic else None
        )

    def place(self, x: float, y: float, height: float) -> Place:
        """Latitude, longitude and height; of a local grid north, east and height.

        Args:
            x: easting or longitude.
            y: northing or latitude.
            height: kept as it is.

        Raises:
            ValueError: they are beyond the system.
        """
        if self._to_wgs84 is None:
            return y, x, height
        try:
            longitude, latitude = self._to_wgs84.transform(x, y, errcheck=True)
        except ProjError:
            raise ValueError(f"{x}, {y} is not a place in {as_line(self._crs.name)}") from None
        return float(latitude), float(longitude), height


_ACCURACIES = ("accuracy_markers", "accuracy_projections", "accuracy_scalebars")
"""Settings of a chunk: sigma of markers' coordinates (m), of their places in pictures (px) and of
scale bars (m)."""


def is_markers(text: str) -> bool:
    """Whether a text is such an XML."""
    return text.lstrip().startswith("<") and "<markers" in text


def read_markers(text: str) -> ForeignControl:
    """Read it.

    Raises:
        ValueError: it is not valid, or lacks something.
    """
    top = xml_root(text)
    chunks = [top] if top.tag == "chunk" else list(top.iter("chunk"))
    chunks = [chunk for chunk in chunks if chunk.find("markers") is not None]
    if len(chunks) != 1:
        raise ValueError(f"{len(chunks)} chunks have markers: export the markers of one")
    (chunk,) = chunks
    settings = {
        str(item.get("name")): item.get("value") for item in chunk.findall("settings/property")
    }
    sigma_m, sigma_px, sigma_bar_m = (_sigma(settings.get(name), name) for name in _ACCURACIES)
    cameras = {camera.get("id"): str(camera.get("label")) for camera in chunk.iter("camera")}
    labels: dict[str | None, str] = {}
    points = []
    placed = chunk.findall("markers/marker/reference[@x]")
    bars_only = not placed and chunk.find("scalebars/scalebar") is not None
    coordinates = None if bars_only else _coordinates(chunk)
    for marker in chunk.findall("markers/marker"):
        name = (marker.get("label") or f"marker {marker.get('id')}").strip()
        labels[marker.get("id")] = name
        reference = marker.find("reference")
        if reference is not None and coordinates is not None:
            points.append(_point(name, reference, coordinates, sigma_m))
    picks = []
    for marker in chunk.findall("frames/frame/markers/marker"):
        for location in marker.findall("location"):
            if location.get("pinned", "true").lower() not in ("true", "1"):
                continue
            picture = cameras.get(location.get("camera_id"))
            point = labels.get(marker.get("marker_id"))
            if picture is None or point is None:
                raise ValueError(
                    f"a location names camera {location.get('camera_id')} and marker "
                    f"{marker.get('marker_id')}, which it does not list"
                )
            x, y = (_number(location, axis, point) for axis in "xy")
            picks.append(
                ForeignPick(
                    picture=picture, point=point, x_px=x, y_px=y, sigma_px=sigma_px or PICK_SIGMA_PX
                )
            )
    bars, lost = [], []
    for number, item in enumerate(chunk.findall("scalebars/scalebar")):
        bar = _bar(item, labels, sigma_bar_m)
        if bar is None:
            lost.append(item.get("label") or f"number {number}")
        else:
            bars.append(bar)
    notes = (f"scale bars without a distance or two markers are left out: {', '.join(lost)}",)
    return ForeignControl(
        points=tuple(points), picks=tuple(picks), bars=tuple(bars), notes=notes if lost else ()
    )


def _bar(
    item: ET.Element, labels: Mapping[str | None, str], sigma_m: float | None
) -> ForeignBar | None:
    """A scale bar; None where it has no distance, or does not lie between two known markers."""
    reference = item.find("reference")
    if reference is None or reference.get("distance") is None:
        return None
    name = (item.get("label") or f"bar {item.get('id')}").strip()
    numbers = [
        value
        for part in item.iter()
        for key, value in sorted(part.attrib.items())
        if "marker" in key or (key == "id" and part.tag == "marker")
    ]
    ends = [labels[number] for number in numbers if number in labels]
    if not numbers:
        cuts = [k for k, letter in enumerate(name) if letter == "_"]
        known = set(labels.values())
        pairs = [(name[:k], name[k + 1 :]) for k in cuts]
        ends = next(([*pair] for pair in pairs if known.issuperset(pair)), [])
    if len(ends) != 2 or ends[0] == ends[1]:
        return None
    length_m = _number(reference, "distance", name)
    if length_m <= 0:
        raise ValueError(f"distance of {as_line(name)} is {length_m}: it must be more than 0")
    own = _sigma(reference.get("accuracy"), f"accuracy of {name}")
    return ForeignBar(
        name=name,
        ends=(ends[0], ends[1]),
        length_m=length_m,
        use="control" if _ticked(reference) else "check",
        sigma_m=own if own is not None else sigma_m,
    )


def _coordinates(chunk: ET.Element) -> Coordinates:
    """The system of the markers: their own, or the chunk's."""
    for tag in ("markers_reference", "reference"):
        text = (chunk.findtext(tag) or "").strip()
        if text:
            return Coordinates(text)
    raise ValueError("names no coordinate system: set one in Metashape's reference pane and export")


def _point(
    name: str, reference: ET.Element, coordinates: Coordinates, sigma_m: float | None
) -> ForeignPoint:
    if any(reference.get(axis) is None for axis in "xyz"):
        return ForeignPoint(name=name, place=(math.nan,) * 3, geodetic=coordinates.geodetic)
    x, y, z = (_number(reference, axis, name) for axis in "xyz")
    own = {axis: _sigma(reference.get(axis), f"{axis} of {name}") for axis in ("sx", "sy", "sz")}
    level = [own[axis] for axis in ("sx", "sy")]
    return ForeignPoint(
        name=name,
        place=coordinates.place(x, y, z),
        geodetic=coordinates.geodetic,
        use="control" if _ticked(reference) else "check",
        sigma_m=max((s for s in level if s is not None), default=sigma_m),
        sigma_vertical_m=own["sz"] if own["sz"] is not None else sigma_m,
    )


def _ticked(reference: ET.Element) -> bool:
    return reference.get("enabled", "true").lower() in ("true", "1")


def _number(element: ET.Element, key: str, name: str) -> float:
    return _finite(element.get(key, ""), f"{key} of {name}")


def _sigma(text: str | None, name: str) -> float | None:
    """A positive number, or None where nothing is stated."""
    if text is None or not text.strip():
        return None
    value = _finite(text, name)
    if value <= 0:
        raise ValueError(f"{as_line(name)} is {value}: it must be more than 0")
    return value


def _finite(text: str, name: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{as_line(name)} is {as_line(text)!r}, not a number")
    return value


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
            raise ValueError(f"line {number}: {as_line(line)!r} has no five numbers") from None
        if not all(map(math.isfinite, (x, y, column, row))):
            raise ValueError(f"line {number}: {as_line(line)!r} has a number that is not finite")
        if len(fields) > _MIN_FIELDS:
            name = fields[_MIN_FIELDS]
        else:
            name = names.setdefault((x, y, z), f"P{len(names) + 1}")
        point = ForeignPoint(
            name=name, place=coordinates.place(x, y, z), geodetic=coordinates.geodetic
        )
        first = points.setdefault(name, point)
        if first.place != point.place and not math.isnan(z):
            raise ValueError(f"line {number}: point {as_line(name)} has another place than before")
        picks.append(ForeignPick(picture=fields[5], point=name, x_px=column, y_px=row))
    return ForeignControl(points=tuple(points.values()), picks=tuple(picks))


def _system(line: str) -> str:
    """The name of a coordinate system as pyproj takes it."""
    utm = _UTM.match(line)
    if utm is None:
        return line
    south = utm[2].upper() == "S"
    return f"EPSG:{(32700 if south else 32600) + int(utm[1])}"


Heights = Literal["level", "ellipsoid"]

_READERS: tuple[tuple[Callable[[str], bool], Callable[[str], ForeignControl]], ...] = (
    (is_markers, read_markers),
    (is_gcp_list, read_gcp_list),
)
_MAX_BYTES = 200_000_000
_CONTROL_HEADER = (
    "kind", "name", "use", "latitude_deg", "longitude_deg", "north_m", "east_m", "depth_m",
    "height_m", "sigma_m", "sigma_vertical_m", "from", "to", "length_m",
)  # fmt: skip
_SHOWN_NAMES = 4


@dataclass(frozen=True, kw_only=True)
class ImportedControl:
    """What a workspace got."""

    points: int
    bars: int
    checks: int
    """Points and bars that only score the model."""
    picks: int
    pictures: int
    """Pictures in which points are picked."""

    def __str__(self) -> str:
        """One line."""
        held = f" ({self.checks} of them to check by)" if self.checks else ""
        bars = f", {self.bars} scale bar{'s' * (self.bars > 1)}" if self.bars else ""
        return f"{self.points} points{bars}{held}, {self.picks} picks in {self.pictures} pictures"


def import_control(
    workspace: Path,
    path: Path,
    *,
    sigma_m: float | None = None,
    sigma_vertical_m: float | None = None,
    heights: Heights = "level",
    overwrite: bool = False,
) -> ImportedControl:
    """Write `control.csv` and `picks.csv` from ODM's `gcp_list.txt` or Metashape's markers.

    Args:
        workspace: folder with finished `images/`.
        path: the file.
        sigma_m: standard deviation of north and of east where the file states none.
        sigma_vertical_m: of heights; as `sigma_m` when None.
        heights: what the file's heights count from: `level`, up from the level that depths of the
            survey count from, or `ellipsoid`, that of WGS 84.
        overwrite: replace files that are there.

    Raises:
        WorkspaceError: the file cannot be read or is of no known format, a point's sigma is not
            known, no picture of it is in the workspace, or a file would be replaced.
    """
    images = need_stage(workspace, "images", "import-images")
    targets = [workspace / CONTROL_FILE, workspace / PICKS_FILE]
    there = [target for target in targets if target.exists()]
    if there and not overwrite:
        raise WorkspaceError(f"{there[0]} is there: move it away, or give --overwrite")
    found = read_foreign(path)
    if heights == "ellipsoid" and not all(point.geodetic for point in found.points):
        raise WorkspaceError(f"{path}: is of a local grid, which has no ellipsoid: --heights level")
    points = _usable(path, found, sigma_m, sigma_vertical_m)
    bars = _bars(path, found, sigma_m)
    names = [record.image for record in read_manifest(images / "manifest.csv")]
    requested = {point.name for point in points} | {end for bar in bars for end in bar.ends}
    rows, lost = _picks(found, requested, names)
    if not rows:
        raise WorkspaceError(
            f"{path}: none of its {len(found.picks)} picks is in a picture of {images}: "
            f"{_some(lost)}"
            if lost
            else f"{path}: no point of known place is picked in a picture"
        )
    if lost:
        warn(
            f"{path}: {_some(lost)}: not in {images}, or there more than once; picks in them are "
            "left out"
        )
    for target, header, lines in (
        (
            targets[0],
            _CONTROL_HEADER,
            [*(_control_row(point, heights) for point in points), *map(_bar_row, bars)],
        ),
        (targets[1], ("image", "point", "x", "y", "sigma_px"), rows),
    ):
        write_csv(target, header, lines)
    for note in found.notes:
        warn(f"{path}: {note}")
    return ImportedControl(
        points=len(points),
        bars=len(bars),
        checks=[*(p.use for p in points), *(bar.use for bar in bars)].count("check"),
        picks=len(rows),
        pictures=len({row[0] for row in rows}),
    )


def read_foreign(path: Path) -> ForeignControl:
    """Read a file of any known format.

    Raises:
        WorkspaceError: it cannot be read or is of none.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise WorkspaceError(f"{path}: is larger than {_MAX_BYTES // 1_000_000} MB")
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise WorkspaceError(f"{path}: cannot be read: {why(error)}") from None
    for fits, reader in _READERS:
        if fits(text):
            try:
                found = reader(text)
            except (ValueError, OverflowError) as error:
                raise WorkspaceError(f"{path}: {one_line(error)}") from None
            double = [n for n, k in Counter(p.name for p in found.points).items() if k > 1]
            if double:
                raise WorkspaceError(f"{path}: point {as_line(double[0])} is there twice")
            return found
    raise WorkspaceError(
        f"{path}: neither a gcp_list.txt of ODM (its first line names the coordinate system) nor "
        "markers that Metashape exported as XML"
    )


def _usable(
    path: Path,
    foreign: ForeignControl,
    sigma_m: float | None,
    sigma_vertical_m: float | None,
) -> list[ForeignPoint]:
    """Points of known place, with sigmas; the others are named, unless bars end there."""
    placed = [point for point in foreign.points if all(map(math.isfinite, point.place))]
    ends = {end for bar in foreign.bars for end in bar.ends}
    left = [p.name for p in foreign.points if p not in placed and p.name not in ends]
    if left:
        warn(f"{path}: points without a whole place are left out: {_some(left)}")
    if not placed and not foreign.bars:
        raise WorkspaceError(f"{path}: no point has a place")
    found = []
    for point in placed:
        known = point.with_sigmas(sigma_m, sigma_vertical_m)
        if known is None:
            raise WorkspaceError(
                f"{path}: has no accuracy of point {as_line(point.name)}: give --sigma, in metres"
            )
        found.append(known)
    return found


def _bars(path: Path, foreign: ForeignControl, sigma_m: float | None) -> list[ForeignBar]:
    """Bars with sigmas."""
    bars = [bar if bar.sigma_m else replace(bar, sigma_m=sigma_m) for bar in foreign.bars]
    unknown = [bar.name for bar in bars if bar.sigma_m is None]
    if unknown:
        raise WorkspaceError(
            f"{path}: has no accuracy of scale bar {as_line(unknown[0])}: give --sigma, in metres"
        )
    return bars


def _picks(
    found: ForeignControl, requested: set[str], names: Sequence[str]
) -> tuple[list[tuple[str, str, float, float, float]], list[str]]:
    """Rows of `picks.csv`, and pictures of the file that the workspace lacks or has twice."""
    by_stem: dict[str, list[str]] = {}
    for name in names:
        by_stem.setdefault(PurePosixPath(name).stem.lower(), []).append(name)
    rows, lost = [], []
    for pick in found.picks:
        image = _image(pick.picture, by_stem)
        if image is None:
            lost.append(pick.picture)
        elif pick.point in requested:
            # Files count from the outer corner of the first pixel, `picks.csv` from its middle.
            rows.append((image, pick.point, pick.x_px - 0.5, pick.y_px - 0.5, pick.sigma_px))
    return rows, list(dict.fromkeys(lost))


def _image(picture: str, by_stem: dict[str, list[str]]) -> str | None:
    """The one picture of the workspace that has a file's name, which may have a folder."""
    parts = PurePosixPath(picture.replace("\\", "/"))
    # A label may lack the suffix and have dots of its own.
    for stem in dict.fromkeys((parts.stem, parts.name)):
        some = by_stem.get(safe_name(stem).lower(), [])
        if len(some) > 1:
            some = [n for n in some if PurePosixPath(n).parent.name == parts.parent.name]
        if len(some) == 1:
            return some[0]
    return None


def _control_row(point: ForeignPoint, heights: Heights) -> tuple[object, ...]:
    first, second, height = point.place
    geodetic = (first, second, None, None) if point.geodetic else (None, None, first, second)
    vertical = (-height, None) if heights == "level" else (None, height)
    return (
        "point", point.name, point.use, *geodetic, *vertical, point.sigma_m, point.sigma_vertical_m,
        *[None] * 3,
    )  # fmt: skip


def _bar_row(bar: ForeignBar) -> tuple[object, ...]:
    return ("bar", bar.name, bar.use, *[None] * 6, bar.sigma_m, None, *bar.ends, bar.length_m)


def _some(names: Sequence[str]) -> str:
    text = ", ".join(as_line(name) for name in names[:_SHOWN_NAMES])
    return text + (f" and {len(names) - _SHOWN_NAMES} more" if len(names) > _SHOWN_NAMES else "")
