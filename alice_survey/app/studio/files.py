"""Files of a workspace as answers: their types, their policies, and parts of them."""

import os
import re
from collections.abc import Iterator
from email.utils import formatdate
from pathlib import Path, PurePath
from typing import BinaryIO

from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse

from alice_survey.app.studio.paths import token_of

POLICY = "Content-Security-Policy"
REVALIDATE = "no-cache"
_RANGE = re.compile(r"bytes=(?:([0-9]{1,18})-([0-9]{0,18})|-([0-9]{1,18}))")
_CHUNK = 1 << 20
INERT = "default-src 'none'; sandbox"
_CLOSED_PAGE = (
    "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; "
    "script-src 'unsafe-inline'; base-uri 'none'; form-action 'none'; sandbox allow-scripts"
)
"""Policy of self-contained pages: they run, but reach neither a network nor this server."""
_TEXT = "text/plain; charset=utf-8"
PAGE = "text/html; charset=utf-8"
_TYPES = {
    ".bin": "application/octet-stream", ".csv": "text/csv; charset=utf-8",
    ".geojson": "application/geo+json", ".glb": "model/gltf-binary",
    ".gpkg": "application/geopackage+sqlite3", ".html": PAGE,
    ".jpeg": "image/jpeg", ".jpg": "image/jpeg", ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8", ".json": "application/json",
    ".kml": "application/vnd.google-earth.kml+xml",
    ".kmz": "application/vnd.google-earth.kmz", ".laz": "application/vnd.laszip",
    ".md": _TEXT, ".mtl": "model/mtl", ".obj": "model/obj", ".pdf": "application/pdf",
    ".png": "image/png", ".svg": "image/svg+xml", ".tif": "image/tiff", ".tiff": "image/tiff",
    ".toml": _TEXT, ".tum": _TEXT, ".txt": _TEXT, ".webp": "image/webp", ".xml": "text/xml",
}  # fmt: skip


def content_type(name: str) -> str:
    """Content type of a file, by the end of its name."""
    return _TYPES.get(PurePath(name).suffix.lower(), "application/octet-stream")


def policy_of(name: str) -> str:
    """Content security policy of a file in a browser."""
    return _CLOSED_PAGE if content_type(name) == PAGE else INERT


def requested_bytes(headers: Headers, size: int, tag: str) -> tuple[int, int, int]:
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


def opened(request: Request, path: Path) -> Response:
    """A file, or a part of it; what replaces it meanwhile does not change the answer."""
    file = path.open("rb")
    status = os.fstat(file.fileno())
    tag, size = f'"{token_of(status)}"', status.st_size
    code, first, count = 200, 0, size
    if request.method == "GET":  # ranges have no meaning for HEAD
        code, first, count = requested_bytes(request.headers, size, tag)
    headers = {
        "Accept-Ranges": "bytes",
        "Cache-Control": REVALIDATE,
        "Content-Length": str(count),
        "ETag": tag,
        "Last-Modified": formatdate(int(status.st_mtime), usegmt=True),
        POLICY: policy_of(path.name),
    }
    if code == 206:
        headers["Content-Range"] = f"bytes {first}-{first + count - 1}/{size}"
    elif code == 416:
        headers["Content-Range"] = f"bytes */{size}"
    elif code == 304:
        del headers["Content-Length"]
    return StreamingResponse(_chunks(file, first, count), code, headers, content_type(path.name))


def _chunks(file: BinaryIO, first: int, count: int) -> Iterator[bytes]:
    with file:
        file.seek(first)
        while count and (chunk := file.read(min(_CHUNK, count))):
            yield chunk
            count -= len(chunk)
