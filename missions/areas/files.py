"""Areas in files: of GIS, of GPS receivers, well-known text, lists of corners.

GDAL, through pyogrio, reads most of them; it is loaded only when a file is read, after a look at
its size, kind, names and entities. Heights are left out.
"""

import contextlib
import itertools
import json
import re
import tempfile
import warnings
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from alice_survey.core.artefacts import stream_csv
from alice_survey.core.config import SHAPEFILE_SIDES, sides_of
from alice_survey.core.contents import (
    archive_member,
    as_line,
    is_nowhere,
    is_unknown,
    one_line,
    opened_archive,
    parse_number,
    xml_names,
)
from alice_survey.core.errors import PlanError, file_faults, warn
from alice_survey.kit.words import count
from missions.areas.crs import LOCAL, geographic_shapes, parse_crs, usable_crs
from missions.areas.raw import RawShapes, closed_as_polygons, from_geometries, from_rings
from missions.logs.navigation_csv import USUAL_NAMES, bare_name

Role = Literal["survey", "no_go", "allowed"]
_DEEPEST = 20
_SRID = re.compile(r"\s*SRID\s*=\s*(\d+)\s*;", re.IGNORECASE)
MAX_BYTES = 100_000_000
"""Size limit of a file, and of all that is unpacked from an archive."""
MAX_CORNERS = 200_000
_STARTS = {".gpkg": b"SQLite format 3\x00", ".shp": b"\x00\x00\x27\x0a"}
DRIVERS = {
    ".geojson": "GeoJSON", ".json": "GeoJSON", ".kml": "KML", ".kmz": "KML", ".gpkg": "GPKG",
    ".shp": "ESRI Shapefile", ".zip": "ESRI Shapefile", ".gpx": "GPX",
}  # fmt: skip
"""GDAL's drivers by the ending of a file."""
SUFFIXES = (*DRIVERS, ".csv", ".poly", ".wkt")
_CORNERS: Sequence[tuple[str | None, *tuple[str, ...]]] = (
    ("EPSG:4326", USUAL_NAMES["latitude_deg"], USUAL_NAMES["longitude_deg"]),
    (None, "north northing northings y n", "east easting eastings x e"),
)
"""Coordinate systems, and the names of the columns of corners in them, y before x."""
_XML = ("KML", "GPX")
_PARTS = ("LinearRing", "LineString", "Point", "Track", "trkseg", "rte", "wpt")
_PLACES = ("coordinates", "coord", "trkpt", "rtept")
"""Elements of KML and GPX that are a ring, a line or a point, and those with their places."""
_NEXT_RING = re.compile(rb"(</LinearRing>\s*)(<LinearRing)")
_RING_APART = rb"\1</innerBoundaryIs><innerBoundaryIs>\2"
"""ArcGIS writes several rings into one inner boundary, of which GDAL reads the last."""
_GEOJSON_LEVELS = {"MultiPoint": 1, "MultiLineString": 1, "Polygon": 1, "MultiPolygon": 2}
"""How deep in its coordinates the rings, lines and points of a geometry are."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Layer:
    name: str
    shapes: RawShapes
    """Shapes in the file's own coordinates, y (north) before x (east)."""
    crs: str | None


def read_area_file(
    path: Path, layer: str | None, crs: str | None, *, role: Role = "survey"
) -> RawShapes:
    """Read the shapes of a file.

    Args:
        path: a file of one of the kinds in `SUFFIXES`, recognised by its suffix.
        layer: which of its layers, where several hold shapes.
        crs: coordinate system for a file that states none; `local` for metres east and north of
            the datum.
        role: what the shapes are for.

    Returns:
        Shapes in latitude and longitude (WGS 84), or north and east where the system is `local`.

    Raises:
        PlanError: it cannot be read, is of another kind, states no coordinate system while crs is
            None, holds several layers while layer is None, or coordinates that cannot be.
    """
    suffix = path.suffix.lower()
    check_file(path)
    if suffix not in SUFFIXES:
        raise PlanError(
            f"area: {path}: {suffix or 'no ending'!r} files are not read; those that are: "
            f"{', '.join(SUFFIXES)}"
        )
    if suffix in DRIVERS:
        chosen = _choose(path, _layers(path), layer, role)
    elif layer is not None:
        raise PlanError(f"area: {path}: it has no layers: leave out layer")
    elif suffix == ".wkt":
        return read_wkt(path.name, _read_text(path), crs)
    else:
        chosen = _read_corners(path)
    found = _in_wgs84(path, chosen, crs, role)
    return closed_as_polygons(found) if suffix == ".gpx" else found  # it has no polygons


def _read_text(path: Path) -> str:
    try:
        return read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise PlanError(f"area: {path}: it is not text") from None


def _read_corners(path: Path) -> _Layer:
    """The polygon whose corners, in order, are the rows of a CSV or of Mission Planner's `.poly`.

    Raises:
        PlanError: a row holds no corner; the message names its line.
    """
    if path.suffix.lower() == ".csv":
        header, rows = stream_csv(path, fault=PlanError)
    else:
        lines = enumerate(_read_text(path).splitlines(), 1)
        cells = [(n, text.split()) for n, text in lines if text.strip() and text[0] != "#"]
        header = ["lat", "lon"]
        rows = ((n, dict(zip(header, row, strict=False))) for n, row in cells)
    bare = {bare_name(one): one for one in reversed(header)}
    known = [
        (crs, [bare[name] for one in axes for name in [n for n in one.split() if n in bare][:1]])
        for crs, *axes in _CORNERS
    ]
    crs, used = max(known, key=lambda pair: len(pair[1]))
    if len(used) != 2:
        raise PlanError(
            f"area: {path}: no columns latitude_deg and longitude_deg, or north and east; it has "
            f"{as_line(', '.join(header))}"
        )
    lost = [one for one in header if one and one not in used]
    if lost:
        warn(f"area: {path}: not read: columns {as_line(', '.join(lost))}")
    ring = []
    for line, row in rows:
        try:
            corner = [parse_number(row.get(name, "")) for name in used]
        except ValueError as error:
            raise PlanError(f"area: {path} line {line}: {error}") from None
        if any(map(is_unknown, corner)) or (crs is not None and is_nowhere(*corner)):
            raise PlanError(f"area: {path} line {line}: {corner} stands for an unknown place")
        ring.append(corner)
    if not ring:
        raise PlanError(f"area: {path}: holds no corner")
    _refuse_corners(path.name, len(ring))
    return _Layer(name="", shapes=from_rings(path.name, [ring], geographic=False), crs=crs)


def read_wkt(origin: str, text: str, crs: str | None) -> RawShapes:
    """Shapes of well-known text: x before y, as everybody writes it.

    Args:
        origin: what messages call it.
        text: a polygon, line, or several; `SRID=32636;` may come before it.
        crs: system of its coordinates; None or `local`: metres east and north of the datum.

    Raises:
        PlanError: it is not well-known text, or crs is unknown or contradicts the SRID.
    """
    match = _SRID.match(text)
    if match:
        text = text[match.end() :]
        stated = f"EPSG:{match.group(1)}"
        if parse_crs(stated) != parse_crs(stated if crs is None else crs):
            raise PlanError(f"area: {origin}: it says SRID={match.group(1)} and crs is {crs}")
        crs = stated
    if _depth(text) > _DEEPEST:
        raise PlanError(f"area: {origin}: not well-known text: it nests over {_DEEPEST} brackets")
    try:
        geometry = _geometry(shapely.from_wkt, text.strip(), origin)
    except shapely.errors.ShapelyError as error:
        what = as_line(str(error)) or "it cannot be read"
        raise PlanError(
            f"area: {origin}: not well-known text such as POLYGON ((0 0, 30 0, 30 20, 0 0)): {what}"
        ) from None
    shapes = from_geometries(origin, [geometry])
    _refuse_corners(shapes.origin, len(shapes.coordinates))
    if shapes.is_empty:
        raise PlanError(f"area: {origin}: it is empty")
    if crs is None or crs == LOCAL:
        return shapes
    return geographic_shapes(shapes, parse_crs(crs))


def _depth(text: str) -> int:
    """How many brackets are open at once; GEOS recurses for each, and ends the program."""
    deepest = depth = 0
    for bracket in re.findall(r"[()]", text):
        depth += 1 if bracket == "(" else -1
        deepest = max(deepest, depth)
    return deepest


def _geometry(read: Callable[..., Any], content: str | bytes, where: str) -> BaseGeometry:
    """A geometry that shapely reads, if need be by closing its rings.

    Raises:
        ShapelyError: it cannot be read.
    """
    geometry: BaseGeometry | None
    try:
        with np.errstate(invalid="ignore"):  # NaN is reported with its corner later
            geometry = read(content)
    except shapely.errors.ShapelyError:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            geometry = read(content, on_invalid="fix")
        if geometry is None:
            raise
        warn(f"area: {where}: a ring that is not closed is closed")
    return geometry


def _layers(path: Path) -> list[_Layer]:
    """All layers of a file that GDAL reads, after a look at what it is."""
    with gis_files(path) as files:
        read = [layer for file in files for layer in gdal_layers(file, path, [])]
    layers = [
        _Layer(name=n, shapes=_shapes(wkb, path.name, len(read) > 1, n), crs=about["crs"])
        for n, about, wkb, _ in read
    ]
    if DRIVERS[path.suffix.lower()] != "GeoJSON" or read_geojson(path).get("crs") is not None:
        return layers
    # RFC 7946 makes it WGS 84, yet older writers left out other systems: the numbers show which.
    return [
        _Layer(name=found.name, shapes=found.shapes, crs=found.crs if _degrees(found) else None)
        for found in layers
    ]


def _degrees(layer: _Layer) -> bool:
    if layer.shapes.is_empty:
        return True
    lat, lon = layer.shapes.coordinates.T
    return bool((np.abs(lat) <= 360.0).all() and (np.abs(lon) <= 360.0).all())


def gdal_layers(
    file: Path, shown: Path, columns: Sequence[str] | None = None
) -> list[tuple[str, Any, Any, Any]]:
    """The layers with geometry of a file.

    Args:
        file: as `gis_files` has it.
        shown: as the user knows it.
        columns: attributes to read; None: all.

    Returns:
        Name, description, shapes as WKB and columns of each.

    Raises:
        PlanError: it cannot be read, or rings, lines or points of it are lost.
    """
    import pyogrio
    import pyogrio.raw
    from pyogrio.errors import DataLayerError, DataSourceError

    driver, layers = DRIVERS[file.suffix], []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            for i, (name, kind) in enumerate(pyogrio.list_layers(file).tolist()):
                if kind is None or (driver == "GPX" and name.endswith("_points")):
                    continue
                info = pyogrio.read_info(file, layer=i)
                if info["driver"].removeprefix("LIB") != driver:
                    raise PlanError(f"area: {shown}: not {driver} but {info['driver']}")
                read = pyogrio.raw.read(file, layer=i, columns=columns, force_2d=True)
                layers.append((str(name), read[0], read[2], read[3]))
        # pyogrio lets names that are not UTF-8 through, and trips over a damaged coordinate system.
        except (
            DataSourceError, DataLayerError, UnicodeDecodeError, UnboundLocalError, ValueError,
            MemoryError,
        ) as error:  # fmt: skip
            text = one_line(error).replace(str(file), shown.name).replace(f"{file.parent}/", "")
            # Drivers are named by the suffix here, and options of GDAL cannot be set.
            text = re.split(r"; It might help|\. Set SHAPE_RESTORE_SHX", text)[0]
            raise PlanError(f"area: {shown}: cannot be read: {text}") from None
    for text in dict.fromkeys(str(w.message).splitlines()[0] for w in caught):
        if not text.startswith("Non closed ring"):  # reported with its feature
            warn(f"area: {shown.name}: {text}")
    held = _parts_in(file)
    wkb = np.concatenate([[], *(layer[2] for layer in layers)])
    read = from_geometries(shown.name, shapely.from_wkb(wkb, on_invalid="fix")).parts
    if held not in (None, read):
        raise PlanError(
            f"area: {shown}: it holds {held} rings, lines and points, of which {read} can be "
            "read: write it again with a GIS"
        )
    return layers


def _parts_in(file: Path) -> int | None:
    """Rings, lines and points in a text, of which GDAL passes over some; None for others."""
    kind = DRIVERS[file.suffix]
    if kind == "GeoJSON":
        return _parts_of_geojson(read_geojson(file))
    return _parts_of_xml(file.read_bytes()) if kind in _XML else None


def _parts_of_xml(content: bytes) -> int:
    names = [name for name in xml_names(content) if name in (*_PARTS, *_PLACES)]
    pairs = itertools.pairwise([*names, ""])
    return sum(a == "wpt" or (a in _PARTS and b in _PLACES) for a, b in pairs)


def _parts_of_geojson(data: Any) -> int:
    waiting, found = [data], 0
    while waiting:
        one = waiting.pop()
        if isinstance(one, list):
            waiting += one
        if not isinstance(one, dict):  # a feature without a place
            continue
        waiting += [one.get(key) for key in ("features", "geometry", "geometries")]
        parts = [one.get("coordinates", [])]
        for _ in range(_GEOJSON_LEVELS.get(str(one.get("type")), 0)):
            parts = [part for some in parts for part in (some if isinstance(some, list) else [0])]
        found += sum(part != [] for part in parts)
    return found


def _shapes(wkb: Sequence[bytes | None], file: str, several: bool, layer: str) -> RawShapes:
    origin = f"{file}, layer {layer}" if several else file
    geometries = []
    for i, blob in enumerate(wkb, 1):
        if blob is None:
            continue
        where = f"{origin}: feature {i}"
        try:
            geometries.append(_geometry(shapely.from_wkb, blob, where))
        except shapely.errors.ShapelyError as error:
            raise PlanError(f"area: {where}: {str(error).strip().splitlines()[0]}") from None
    shapes = from_geometries(origin, geometries)
    _refuse_corners(shapes.origin, len(shapes.coordinates))
    return shapes


def _refuse_corners(origin: str, number: int) -> None:
    if number > MAX_CORNERS:
        raise PlanError(
            f"area: {origin}: {number} corners; at most {MAX_CORNERS}: simplify it, or cut "
            "out the part to survey"
        )


def _choose(path: Path, layers: list[_Layer], layer: str | None, role: Role) -> _Layer:
    """The layer that is requested, or the only one with usable shapes.

    Raises:
        PlanError: there is none, or there are several to choose from.
    """
    if layer is not None:
        found = [one for one in layers if one.name == layer]
        if not found:
            names = ", ".join(repr(one.name) for one in layers) or "none"
            raise PlanError(f"area: {path}: no layer {layer!r}; there are {names}: set layer")
        if len(found) > 1:
            raise PlanError(f"area: {path}: {len(found)} layers are named {layer!r}: rename one")
        return found[0]
    usable = [
        one
        for one in layers
        if one.shapes.polygons or one.shapes.lines or (role == "no_go" and len(one.shapes.points))
    ]
    if not usable:
        points = sum(len(one.shapes.points) for one in layers)
        held = f"{count(points, 'point')} only" if points else "no shapes"
        raise PlanError(f"area: {path}: it holds {held}; an area needs a polygon or a line")
    others = [one.name for one in layers if one not in usable and not one.shapes.is_empty]
    if others:
        warn(f"area: {path}: not used: points of the layers {', '.join(map(repr, others))}")
    if len(usable) > 1:
        names = ", ".join(repr(one.name) for one in usable)
        cure = "set layer to one of them" if role == "survey" else "save one as a file of its own"
        raise PlanError(f"area: {path}: shapes in the layers {names}: {cure}")
    return usable[0]


def _in_wgs84(path: Path, layer: _Layer, crs: str | None, role: Role) -> RawShapes:
    """The shapes of a layer in WGS 84, by the file's own system or, without one, by `crs`."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        own = None if layer.crs is None else CRS.from_user_input(layer.crs)
    except CRSError as error:
        raise PlanError(
            f"area: {path}: its coordinate system cannot be read: {one_line(error)}"
        ) from None
    if crs == LOCAL and (own is None or not _is_map(own)):
        return layer.shapes
    if own is None or (crs is not None and not _is_map(own)):
        if crs is None:
            raise PlanError(
                f"area: {path}: it does not say its coordinate system: set crs, such as "
                f"EPSG:32636, or {LOCAL!r} for metres east and north of the datum"
            )
        return geographic_shapes(layer.shapes, parse_crs(crs))
    if crs is not None and role == "survey" and (crs == LOCAL or parse_crs(crs) != own):
        warn(f"area: {path}: crs = {crs} is not used: the file is in {own.name}")
    return geographic_shapes(layer.shapes, usable_crs(own, path.name))


def _is_map(crs: Any) -> bool:
    flat = crs.to_2d()
    return bool(flat.is_geographic or flat.is_projected)


def read_bytes(path: Path) -> bytes:
    """The content of a file of bounded size.

    Raises:
        PlanError: it is missing, not a file, too large or unreadable.
    """
    check_file(path)
    with file_faults(path, PlanError):
        return path.read_bytes()


def check_file(path: Path, *, may_be_empty: bool = False) -> None:
    """Refuse what is not a file of bounded size: pipes, for example, would be waited on for ever.

    Raises:
        PlanError: with the size and the limit.
    """
    if not path.exists():
        raise PlanError(f"area: {path}: no such file")
    if not path.is_file():
        raise PlanError(f"area: {path} is not a file")
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise PlanError(
            f"area: {path}: {size / 1e6:.0f} MB; at most {MAX_BYTES / 1e6:.0f} MB: cut out the "
            "part to survey"
        )
    if size == 0 and not may_be_empty:
        raise PlanError(f"area: {path}: it is empty")


def read_geojson(path: Path) -> dict[str, Any]:
    """The JSON object in a file, whose kind and geometries GDAL looks at.

    Raises:
        PlanError: it is not a JSON object, the message names the line; or holds too many corners.
    """

    def no_number(text: str) -> float:
        raise PlanError(f"area: {path}: it holds {text}: coordinates must be numbers")

    content = read_bytes(path)
    brackets = content.count(b"[")  # one for each corner, and some
    if brackets > 2 * MAX_CORNERS:
        raise PlanError(f"area: {path}: about {brackets} corners; at most {MAX_CORNERS}")
    try:
        data = json.loads(content, parse_constant=no_number)
    except json.JSONDecodeError as error:
        raise PlanError(f"area: {path}: not JSON, line {error.lineno}: {error.msg}") from None
    except (ValueError, RecursionError):  # not text, or a number of thousands of digits
        raise PlanError(f"area: {path}: not JSON that can be read") from None
    if not isinstance(data, dict):
        raise PlanError(f"area: {path}: not GeoJSON: it holds no object")
    return data


@contextlib.contextmanager
def gis_files(path: Path) -> Iterator[list[Path]]:
    """What GDAL may open of a file: of bounded size, and what its name says.

    The files lie under names of our own in a folder of their own: GDAL and pyogrio take a `!` or
    `.zip` in a path for a way into an archive, and a name in an archive may lead out of the folder.

    Args:
        path: with an ending of `DRIVERS`.

    Raises:
        PlanError: it is not what its name says.
    """
    suffix = path.suffix.lower()
    check_file(path)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        try:
            if suffix in (".zip", ".kmz"):
                with opened_archive(path, MAX_BYTES) as archive:
                    unpack = _unpacked_kml if suffix == ".kmz" else _unpacked_shapefiles
                    files = unpack(archive, folder)
            else:
                files = [_link(path, suffix, folder)]
            kind = DRIVERS[suffix]
            if kind in _XML:
                content = read_bytes(files[0])
                root = xml_names(content)[0]
                if root != kind.lower():
                    raise ValueError(f"not {kind}: its first element is {root!r}")
                files[0].unlink()
                files[0].write_bytes(_NEXT_RING.sub(_RING_APART, content))
        except ValueError as error:
            raise PlanError(f"area: {path}: {error}") from None
        yield files


def _link(path: Path, suffix: str, folder: Path) -> Path:
    """A link to a file, and to its side files, after a look at how it begins."""
    start = _STARTS.get(suffix, b"")
    with path.open("rb") as file:
        if file.read(len(start)) != start:
            raise ValueError(f"not a {DRIVERS[suffix]} file: wrong file signature")
    if DRIVERS[suffix] == "GeoJSON":
        read_geojson(path)
    sides = sides_of(path) if suffix == ".shp" else []
    stem = re.sub(r"\W", "_", path.stem)
    for side in (path, *sides):
        check_file(side, may_be_empty=True)
        link = folder / (stem + side.suffix.lower())
        if not link.exists():
            link.symlink_to(side.resolve())
    return folder / (stem + suffix)


def _unpacked_kml(archive: zipfile.ZipFile, folder: Path) -> list[Path]:
    """The KML of a KMZ: its `doc.kml`, else the only one in it."""
    names = [m.filename for m in archive.infolist() if _suffix(m.filename) == ".kml"]
    main = [name for name in names if PurePosixPath(name).name.lower() == "doc.kml"][:1]
    chosen = main or names
    if len(chosen) != 1:
        raise ValueError(f"{len(names)} KML files in it; a KMZ has one, or a doc.kml")
    (folder / "doc.kml").write_bytes(archive_member(archive, chosen[0]))
    return [folder / "doc.kml"]


def _unpacked_shapefiles(archive: zipfile.ZipFile, folder: Path) -> list[Path]:
    """The shapefiles in a zip, with their side files."""
    members = {m.filename for m in archive.infolist()}
    shapes = sorted(name for name in members if _suffix(name) == ".shp")
    shapes = [name for name in shapes if not name.startswith("__MACOSX/")]
    stems = [PurePosixPath(name.replace("\\", "/")).stem for name in shapes]
    if not shapes:
        raise ValueError("there is no .shp in it")
    if len(set(stems)) < len(stems):
        raise ValueError("two shapefiles in it have one name: leave one out")
    files = []
    lower = {name.lower(): name for name in members}
    for i, name in enumerate(shapes):
        sides = [lower.get((name[:-4] + side).lower()) for side in SHAPEFILE_SIDES]
        for member in [name, *(side for side in sides if side is not None)]:
            target = folder / str(i) / (stems[i] + _suffix(member))
            target.parent.mkdir(exist_ok=True)
            target.write_bytes(archive_member(archive, member))
        files.append(folder / str(i) / (stems[i] + ".shp"))
    return files


def _suffix(name: str) -> str:
    return PurePosixPath(name).suffix.lower()
