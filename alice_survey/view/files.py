"""Files of a workspace as responses: their type, their policy, their bytes."""

import os
import socket
from pathlib import PurePath

from alice_survey.view.paths import OpenedFile

_CHUNK = 1 << 20
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


def content_type(name: str) -> str:
    """Content type of a file, by the end of its name."""
    return _TYPES.get(PurePath(name).suffix.lower(), "application/octet-stream")


def policy_of(name: str) -> str:
    """Content security policy of a file in a browser."""
    return _CLOSED_PAGE if content_type(name).startswith("text/html") else _INERT


def send_part(connection: socket.socket, file: OpenedFile, first: int, count: int) -> int:
    """Send bytes of a file.

    Returns:
        How many were there to send.

    Raises:
        OSError: the other side went away or takes nothing.
    """
    sent = 0
    while sent < count:
        chunk = os.pread(file.descriptor, min(_CHUNK, count - sent), first + sent)
        if not chunk:
            break
        connection.sendall(chunk)
        sent += len(chunk)
    return sent
