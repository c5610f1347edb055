"""Files from others are looked at before any library opens them: size, kind, names, entities."""

import contextlib
import json
import lzma
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any
from xml.parsers import expat

from alice_survey.core.config import SHAPEFILE_SIDES
from alice_survey.core.errors import PlanError

MAX_BYTES = 100_000_000
"""Size limit of a file, and of all that is unpacked from an archive."""
_MAX_MEMBERS = 1000
_GEOJSON = frozenset(
    {
        "FeatureCollection", "Feature", "GeometryCollection", "Polygon", "MultiPolygon",
        "LineString", "MultiLineString", "Point", "MultiPoint",
    }
)  # fmt: skip


def read_bytes(path: Path) -> bytes:
    """The content of a file of bounded size.

    Raises:
        PlanError: it is missing, no file, too large or unreadable.
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
        PlanError: it is not JSON; the message names the line.
    """

    def no_number(text: str) -> float:
        raise PlanError(f"area: {path}: it holds {text}: coordinates must be numbers")

    try:
        return json.loads(read_bytes(path), parse_constant=no_number)
    except json.JSONDecodeError as error:
        raise PlanError(f"area: {path}: no JSON, line {error.lineno}: {error.msg}") from None
    except (ValueError, RecursionError):  # no text, or a number of thousands of digits
        raise PlanError(f"area: {path}: no JSON that can be read") from None


def read_geojson(path: Path) -> dict[str, Any]:
    """The GeoJSON object in a file; its geometries are not looked at.

    Raises:
        PlanError: it is not GeoJSON.
    """
    data = read_json(path)
    kind = data.get("type") if isinstance(data, dict) else None
    if not (isinstance(data, dict) and isinstance(kind, str) and kind in _GEOJSON):
        raise PlanError(f"area: {path}: no GeoJSON: its type is {kind!r}")
    return data


def check_start(path: Path, start: bytes, kind: str) -> None:
    """Refuse a file that does not begin as its kind does: it would be opened as something else.

    Raises:
        PlanError: it begins otherwise.
    """
    check_file(path)
    with path.open("rb") as file:
        if file.read(len(start)) != start:
            raise PlanError(f"area: {path}: no {kind}: it begins otherwise")


def check_kml(content: bytes, origin: str) -> None:
    """Refuse XML that is not KML, or that could name other files or swell (DOCTYPE, entities).

    Raises:
        PlanError: with the line.
    """
    parser = expat.ParserCreate()
    roots: list[str] = []

    def start(name: str, _: dict[str, str]) -> None:
        if not roots:
            roots.append(name)

    def doctype(*_: object) -> None:
        raise PlanError(
            f"area: {origin}: line {parser.CurrentLineNumber}: a KML with a DOCTYPE is not read, "
            "it could name other files: remove it"
        )

    parser.StartElementHandler = start
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(content, True)
    except (expat.ExpatError, LookupError, ValueError) as error:  # an encoding unknown to Python
        raise PlanError(f"area: {origin}: no KML, {error}") from None
    if roots[0].rpartition(":")[2] != "kml":
        raise PlanError(f"area: {origin}: no KML: its first element is {roots[0]!r}")


@contextlib.contextmanager
def unpacked_kmz(path: Path) -> Iterator[Path]:
    """The KML of a KMZ: its `doc.kml`, else the only one in it.

    Raises:
        PlanError: it is not an archive, holds no KML, or would be too large.
    """
    with _archive(path) as archive:
        names = [m.filename for m in archive.infolist() if _suffix(m.filename) == ".kml"]
        main = [name for name in names if PurePosixPath(name).name.lower() == "doc.kml"][:1]
        chosen = main or names
        if len(chosen) != 1:
            raise PlanError(
                f"area: {path}: {len(names)} KML files in it; a KMZ has one, or a doc.kml"
            )
        content = _member(archive, chosen[0], path)
    with tempfile.TemporaryDirectory() as folder:
        # A name of our own: none in the archive can lead out of the folder.
        file = Path(folder) / "doc.kml"
        file.write_bytes(content)
        yield file


@contextlib.contextmanager
def unpacked_shapefiles(path: Path) -> Iterator[list[Path]]:
    """The shapefiles in a zip, with their side files, in one folder.

    Raises:
        PlanError: it is not an archive, holds no shapefile or two of one name, or is too large.
    """
    with _archive(path) as archive, tempfile.TemporaryDirectory() as folder:
        members = {m.filename for m in archive.infolist()}
        shapes = sorted(name for name in members if _suffix(name) == ".shp")
        shapes = [name for name in shapes if not name.startswith("__MACOSX/")]
        stems = [PurePosixPath(name.replace("\\", "/")).stem for name in shapes]
        if not shapes:
            raise PlanError(f"area: {path}: there is no .shp in it")
        if len(set(stems)) < len(stems):
            raise PlanError(f"area: {path}: two shapefiles in it have one name: leave one out")
        files = []
        lower = {name.lower(): name for name in members}
        for i, name in enumerate(shapes):
            sides = [lower.get((name[:-4] + side).lower()) for side in SHAPEFILE_SIDES]
            for member in [name, *(side for side in sides if side is not None)]:
                target = Path(folder) / str(i) / (stems[i] + _suffix(member))
                target.parent.mkdir(exist_ok=True)
                target.write_bytes(_member(archive, member, path))
            files.append(Path(folder) / str(i) / (stems[i] + ".shp"))
        yield files


@contextlib.contextmanager
def _archive(path: Path) -> Iterator[zipfile.ZipFile]:
    check_file(path)
    try:
        archive = zipfile.ZipFile(path)
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
        raise PlanError(f"area: {path}: no zip archive, or a broken one") from None
    with archive:
        members = archive.infolist()
        total = sum(member.file_size for member in members)
        if total > MAX_BYTES or len(members) > _MAX_MEMBERS:
            raise PlanError(
                f"area: {path}: {len(members)} files of {total / 1e6:.0f} MB in it; at most "
                f"{_MAX_MEMBERS} of {MAX_BYTES / 1e6:.0f} MB are unpacked"
            )
        yield archive


def _member(archive: zipfile.ZipFile, name: str, path: Path) -> bytes:
    """A file of an archive; no more than the size it states, which was checked."""
    try:
        return archive.read(name)
    except (
        zipfile.BadZipFile, zlib.error, lzma.LZMAError, OSError, EOFError, RuntimeError, ValueError,
        KeyError, struct.error, MemoryError,
    ):  # fmt: skip
        raise PlanError(
            f"area: {path}: {name!r} in it is broken, encrypted or packed in an unknown way"
        ) from None


def _suffix(name: str) -> str:
    return PurePosixPath(name).suffix.lower()
