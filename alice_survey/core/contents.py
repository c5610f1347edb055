"""Read files that this program wrote, and that a user or a disk may have changed since."""

import contextlib
import errno
import lzma
import re
import stat
import struct
import tomllib
import zipfile
import zlib
from collections.abc import Collection, Iterator, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree as ET
from xml.parsers import expat

from alice_survey.core.errors import WorkspaceError, why

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from pydantic import ValidationError

_SHOWN = 200
Location = str | PathLike[str]
"""A file or a folder: a path, or a `Survey`, which stands for its workspace."""

MAX_TEXT = 512 << 20
"""Bytes of a text that is read whole."""


def ordinary_file(path: Path, maximum: int | None = MAX_TEXT) -> Path:
    """A path that may be opened and read: all files from outside are opened through this.

    A pipe is waited on for ever, and a device has no end.

    Args:
        path: of the file; it may be a link.
        maximum: bytes; None for a kind that is read in parts.

    Raises:
        OSError: it is no file, is larger, or is missing.
    """
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "it is no ordinary file", str(path))
    if maximum is not None and status.st_size > maximum:
        text = f"it is larger than {maximum >> 20} MiB, which no file of its kind should be"
        raise OSError(errno.EINVAL, text, str(path))
    return path


_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf|infinity)", re.I | re.A)


def parse_number(text: str) -> float:
    """The number that a text is, as tables write numbers; Python takes `3_2` for 32.

    Raises:
        ValueError: it is none.
    """
    if _NUMBER.fullmatch(text.strip()) is None:
        raise ValueError(f"{as_line(text)!r} is not a number")
    return float(text)


UNKNOWN = (-9999.0, -99999.0, -32767.0, -32768.0, 1e6)
"""Numbers that stand for "not known" in tables, rasters and logs; so do those beyond `BEYOND`."""
BEYOND = 1e30


def is_unknown(value: float) -> bool:
    """Whether a number stands for "not known"."""
    return not abs(value) < BEYOND or value in UNKNOWN


def where_unknown(values: "NDArray[np.float64]") -> "NDArray[np.bool_]":
    """`is_unknown` of numbers, (...)."""
    import numpy as np

    return ~(np.abs(values) < BEYOND) | np.isin(values, UNKNOWN)


def is_nowhere(latitude_deg: float | None, longitude_deg: float | None) -> bool:
    """Whether a place is that of a receiver without a fix."""
    return latitude_deg == 0.0 == longitude_deg


def parse_toml(text: str) -> dict[str, Any]:
    """The table of a TOML text.

    Raises:
        ValueError: it is not TOML, or has a name of a hundred parts, for which the parser takes
            memory with the square of their number.
        RecursionError: it is nested too deep.
    """
    if re.search(r"(?:[\w-]+[ \t]*\.[ \t]*){100}", text):
        raise ValueError("a name has a hundred parts")
    return tomllib.loads(text)


@contextlib.contextmanager
def taken_from(path: Path) -> Iterator[None]:
    """Within this block values are read from the contents of a file.

    Raises:
        WorkspaceError: a value is missing or of another type.
    """
    try:
        yield
    except KeyError as error:
        raise WorkspaceError(
            f"{path}: lacks {one_line(error)}; it was changed: delete it and run again"
        ) from None
    except (TypeError, ValueError, IndexError, AttributeError, ArithmeticError) as error:
        raise WorkspaceError(
            f"{path}: is not as it was written ({one_line(error)}): delete it and run again"
        ) from None


def read_arrays(
    path: Path, *names: str, optional: Sequence[str] = ()
) -> "dict[str, NDArray[np.generic]]":
    """Arrays of an `.npz` file; of optional ones those that are there.

    Raises:
        WorkspaceError: it is missing or damaged, or lacks one.
    """
    import numpy as np

    try:
        with np.load(path) as data:
            there = [name for name in optional if name in data]
            return {name: data[name] for name in (*names, *there)}
    except OSError as error:
        raise WorkspaceError(f"{path}: cannot be read: {why(error)}") from None
    except (KeyError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise WorkspaceError(
            f"{path}: is damaged ({one_line(error)}): delete it and run again"
        ) from None


def one_line(error: BaseException) -> str:
    """Message of an exception, on one printable line; its type where the message is empty."""
    return as_line(str(error)) or type(error).__name__


def in_workspace(path: Location, within: str) -> Path:
    """A file or folder itself, or of a workspace what lies in this place."""
    path, inner = Path(path), Path(path) / within
    return inner if path.is_dir() and (inner.suffix or inner.exists()) else path


def first_fault(error: "ValidationError", whole: str = "", known: Collection[str] = ()) -> str:
    """The first value that a model refuses, and why, on one line; what is missing comes last.

    Args:
        error: of pydantic.
        whole: what the values are called together, where none of them is named.
        known: names that values may have.
    """
    faults = error.errors(include_url=False)
    first = min(faults, key=lambda fault: fault["type"] == "missing")
    where = ".".join(map(str, first["loc"])) or whole
    text = as_line(first["msg"].removeprefix("Value error, "))
    if known and first["type"] == "extra_forbidden" and len(first["loc"]) == 1:
        text += nearest(where, known)
    return f"{where}: {text}" if where else text


def as_line(text: str) -> str:
    """External text made safe for a message: one line, printable, of limited length."""
    plain = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return plain if len(plain) <= _SHOWN else f"{plain[: _SHOWN - 3]}..."


def nearest(name: str, known: Collection[str]) -> str:
    """The end of a message on a name that is not known: the closest of those that are, or all."""
    import difflib

    close = difflib.get_close_matches(name, known, n=1)
    return f"; did you mean {close[0]}?" if close else f"; known are {', '.join(known)}"


_MAX_MEMBERS = 1000


def refuse_declarations(text: str) -> None:
    """Refuse a text with a document type or entities.

    Raises:
        ValueError: it declares one.
    """
    if re.search(r"<!\s*(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        raise ValueError("declares a DOCTYPE or ENTITY, which is refused")


def xml_root(text: str) -> ET.Element:
    """The root of an XML document without a document type.

    Raises:
        ValueError: it declares one, or is not valid XML.
    """
    refuse_declarations(text)
    try:
        return ET.fromstring(text)  # noqa: S314  without a document type
    except ET.ParseError as error:
        raise ValueError(f"not valid XML: {error}") from None


def xml_names(content: bytes) -> list[str]:
    """Names of the elements of XML in any encoding, in order, without prefixes of namespaces.

    Raises:
        ValueError: it declares a document type, or is not valid XML; the message names the line.
    """
    parser = expat.ParserCreate()
    names: list[str] = []

    def start(name: str, _: dict[str, str]) -> None:
        names.append(name.rpartition(":")[2])

    def refuse(*_: object) -> None:
        raise ValueError(
            f"line {parser.CurrentLineNumber}: declares a DOCTYPE or ENTITY, which is refused"
        )

    parser.StartElementHandler = start
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(content, True)
    except (expat.ExpatError, LookupError) as error:  # an encoding unknown to Python
        raise ValueError(f"not valid XML: {error}") from None
    return names


@contextlib.contextmanager
def opened_archive(path: Path, max_bytes: int) -> Iterator[zipfile.ZipFile]:
    """A zip archive of bounded content.

    Raises:
        ValueError: it is not one, or states more or larger files than are unpacked.
    """
    try:
        archive = zipfile.ZipFile(path)
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
        raise ValueError("not a zip archive, or a broken one") from None
    with archive:
        members = archive.infolist()
        total = sum(member.file_size for member in members)
        if total > max_bytes or len(members) > _MAX_MEMBERS:
            raise ValueError(
                f"{len(members)} files of {total / 1e6:.0f} MB in it; at most {_MAX_MEMBERS} of "
                f"{max_bytes / 1e6:.0f} MB are unpacked"
            )
        yield archive


def archive_member(archive: zipfile.ZipFile, name: str) -> bytes:
    """A file of an archive; no more than the size it states, which was checked.

    Raises:
        ValueError: it cannot be unpacked.
    """
    try:
        return archive.read(name)
    except (
        zipfile.BadZipFile, zlib.error, lzma.LZMAError, OSError, EOFError, RuntimeError, ValueError,
        KeyError, struct.error, MemoryError,
    ):  # fmt: skip
        raise ValueError(
            f"{name!r} in it is broken, encrypted or packed in an unknown way"
        ) from None
