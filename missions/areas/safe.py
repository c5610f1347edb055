"""Files of shapes from others, looked at before GDAL opens them: size, kind, names, entities."""

import contextlib
import json
import re
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

from alice_survey.core.config import SHAPEFILE_SIDES, sides_of
from alice_survey.core.contents import archive_member, opened_archive, xml_root_name
from alice_survey.core.errors import PlanError

MAX_BYTES = 100_000_000
"""Size limit of a file, and of all that is unpacked from an archive."""
MAX_CORNERS = 200_000
_GEOJSON = frozenset(
    {
        "FeatureCollection", "Feature", "GeometryCollection", "Polygon", "MultiPolygon",
        "LineString", "MultiLineString", "Point", "MultiPoint",
    }
)  # fmt: skip
_STARTS = {".gpkg": b"SQLite format 3\x00", ".shp": b"\x00\x00\x27\x0a"}
DRIVERS = {
    ".geojson": "GeoJSON", ".json": "GeoJSON", ".kml": "KML", ".kmz": "KML", ".gpkg": "GPKG",
    ".shp": "ESRI Shapefile", ".zip": "ESRI Shapefile",
}  # fmt: skip
"""GDAL's drivers by the ending of a file."""


def read_bytes(path: Path) -> bytes:
    """The content of a file of bounded size.

    Raises:
        PlanError: it is missing, not a file, too large or unreadable.
    """
    check_file(path)
    try:
        return path.read_bytes()
    except OSError as error:
        raise PlanError(f"area: {path}: cannot be read: {error.strerror}") from None


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


def read_json(path: Path) -> Any:
    """The JSON value in a file.

    Raises:
        PlanError: it is not JSON, the message names the line; or holds too many corners.
    """

    def no_number(text: str) -> float:
        raise PlanError(f"area: {path}: it holds {text}: coordinates must be numbers")

    content = read_bytes(path)
    brackets = content.count(b"[")  # one for each corner, and some
    if brackets > 2 * MAX_CORNERS:
        raise PlanError(f"area: {path}: about {brackets} corners; at most {MAX_CORNERS}")
    try:
        return json.loads(content, parse_constant=no_number)
    except json.JSONDecodeError as error:
        raise PlanError(f"area: {path}: not JSON, line {error.lineno}: {error.msg}") from None
    except (ValueError, RecursionError):  # not text, or a number of thousands of digits
        raise PlanError(f"area: {path}: not JSON that can be read") from None


def read_geojson(path: Path) -> dict[str, Any]:
    """The GeoJSON object in a file; its geometries are not looked at.

    Raises:
        PlanError: it is not GeoJSON.
    """
    data = read_json(path)
    kind = data.get("type") if isinstance(data, dict) else None
    if not (isinstance(data, dict) and isinstance(kind, str) and kind in _GEOJSON):
        raise PlanError(f"area: {path}: not GeoJSON: its type is {kind!r}")
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
            if DRIVERS[suffix] == "KML":
                root = xml_root_name(read_bytes(files[0]))
                if root != "kml":
                    raise ValueError(f"not KML: its first element is {root!r}")
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
