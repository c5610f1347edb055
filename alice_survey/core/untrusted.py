"""What others may have put into a file to make a parser swell or read other files.

XML may declare entities that grow without bound or name files; an archive may unpack to far more
than it is. Both are refused here, for every format that is XML or an archive.
"""

import contextlib
import lzma
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree as ET
from xml.parsers import expat

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


def xml_root_name(content: bytes) -> str:
    """Name of the first element of XML in any encoding, without its namespace's prefix.

    Raises:
        ValueError: it declares a document type, or is not valid XML; the message names the line.
    """
    parser = expat.ParserCreate()
    roots: list[str] = []

    def start(name: str, _: dict[str, str]) -> None:
        if not roots:
            roots.append(name)

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
    return roots[0].rpartition(":")[2]


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
