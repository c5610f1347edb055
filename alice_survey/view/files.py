"""Files of a workspace as responses: their type, their policy, the bytes of a request."""

import re
from email.message import Message
from pathlib import PurePath

_TEXT = "text/plain; charset=utf-8"
_TYPES = {
    ".bin": "application/octet-stream", ".csv": "text/csv; charset=utf-8",
    ".geojson": "application/geo+json", ".glb": "model/gltf-binary",
    ".gpkg": "application/geopackage+sqlite3", ".html": "text/html; charset=utf-8",
    ".jpeg": "image/jpeg", ".jpg": "image/jpeg", ".json": "application/json",
    ".kml": "application/vnd.google-earth.kml+xml",
    ".kmz": "application/vnd.google-earth.kmz", ".laz": "application/vnd.laszip",
    ".md": _TEXT, ".mtl": "model/mtl", ".obj": "model/obj", ".pdf": "application/pdf",
    ".png": "image/png", ".svg": "image/svg+xml", ".tif": "image/tiff", ".tiff": "image/tiff",
    ".toml": _TEXT, ".tum": _TEXT, ".txt": _TEXT, ".webp": "image/webp", ".xml": "text/xml",
}  # fmt: skip
_INERT = "default-src 'none'; sandbox"
_CLOSED_PAGE = (
    "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; "
    "script-src 'unsafe-inline'; base-uri 'none'; form-action 'none'; sandbox allow-scripts"
)
"""Policy of self-contained pages: they run, but reach neither a network nor this server."""
_RANGE = re.compile(r"bytes=(?:([0-9]{1,18})-([0-9]{0,18})|-([0-9]{1,18}))")


def content_type(name: str) -> str:
    """Content type of a file, by the end of its name."""
    return _TYPES.get(PurePath(name).suffix.lower(), "application/octet-stream")


def policy_of(name: str) -> str:
    """Content security policy of a file in a browser."""
    return _CLOSED_PAGE if content_type(name).startswith("text/html") else _INERT


def requested_bytes(headers: Message, size: int, tag: str) -> tuple[int, int, int]:
    """Part of a file to send for a request (RFC 9110, sections 13 and 14).

    Of several ranges at once, or one that is of another version, the whole file is the answer, as
    the standard lets a server do.

    Args:
        headers: headers of the request.
        size: size of the file, bytes.
        tag: entity tag of its content.

    Returns:
        Status, first byte and number of bytes.
    """
    if tag in re.split(r"(?:\s*,\s*|^)(?:W/)?", headers.get("If-None-Match", "")):
        return 304, 0, 0
    found = _RANGE.fullmatch(headers.get("Range", ""))
    if found is None or headers.get("If-Range", tag) != tag:
        return 200, 0, size
    first, last, suffix = found.groups()
    if last and int(last) < int(first):
        return 200, 0, size  # no range by the standard's grammar
    start = int(first) if suffix is None else max(0, size - int(suffix))
    end = min(int(last) + 1, size) if last else size
    return (206, start, end - start) if start < end else (416, 0, 0)
