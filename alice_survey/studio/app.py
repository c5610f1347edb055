"""Which requests the studio allows, and its answers to them.

It answers GET and HEAD alone. A request whose Host is not this server by its address and port is
refused, since a page of another site could otherwise reach it through a name of its own (DNS
rebinding). Nothing allows another site to read an answer.
"""

import itertools
import os
import re
from collections.abc import Iterator
from email.utils import formatdate
from pathlib import Path, PurePath
from typing import BinaryIO
from urllib.parse import quote

from starlette.applications import Starlette
from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.responses import PlainTextResponse, RedirectResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from alice_survey.base.errors import AliceError, known_fault
from alice_survey.studio.layers import FILES, ChangedError, Layers
from alice_survey.studio.page import Page, listing
from alice_survey.studio.paths import RefusedError, Workspace, names_of, token_of

_TILE = re.compile(
    rf"/tiles/({'|'.join(FILES)})/([0-9]{{1,2}})/([0-9]{{1,6}})/([0-9]{{1,6}})\.webp"
)
_VERSION = re.compile(r"v=([0-9a-f-]{1,64})")
_RANGE = re.compile(r"bytes=(?:([0-9]{1,18})-([0-9]{0,18})|-([0-9]{1,18}))")
_CHANGED = "the survey was worked on meanwhile: load the page again"
_KEEP = "private, max-age=86400, immutable"
"""Cache policy of requests that state a version."""
_REVALIDATE = "no-cache"
_CHUNK = 1 << 20
_LONGEST_HEAD = 32 << 10
_ALLOWED = ("GET", "HEAD")
_COMMON = {
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Frame-Options": "DENY",
}
_POLICY = "Content-Security-Policy"
_INERT = "default-src 'none'; sandbox"
_CLOSED_PAGE = (
    "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; "
    "script-src 'unsafe-inline'; base-uri 'none'; form-action 'none'; sandbox allow-scripts"
)
"""Policy of self-contained pages: they run, but reach neither a network nor this server."""
_TEXT = "text/plain; charset=utf-8"
_PAGE = "text/html; charset=utf-8"
_TYPES = {
    ".bin": "application/octet-stream", ".csv": "text/csv; charset=utf-8",
    ".geojson": "application/geo+json", ".glb": "model/gltf-binary",
    ".gpkg": "application/geopackage+sqlite3", ".html": _PAGE,
    ".jpeg": "image/jpeg", ".jpg": "image/jpeg", ".json": "application/json",
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
    return _CLOSED_PAGE if content_type(name) == _PAGE else _INERT


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


def application(workspace: Workspace, layers: Layers, hosts: frozenset[str]) -> ASGIApp:
    """The studio of a workspace.

    Args:
        workspace: to show.
        layers: of its rasters.
        hosts: names and ports that it is asked by, lower case.
    """
    answers = _Answers(workspace, layers)
    return _Guard(Starlette(routes=[Route("/{path:path}", answers.answer)]), hosts)


class _Guard:
    """Refuses what is not a request to this server, and locks every answer in."""

    def __init__(self, app: ASGIApp, hosts: frozenset[str]) -> None:
        self._app, self._hosts = app, hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""

        async def locked(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, text in _COMMON.items():
                    headers[name] = text
                headers[_POLICY] = f"{headers.get(_POLICY, _INERT)}; frame-ancestors 'none'"
                headers.setdefault("Cache-Control", "no-store")
            await send(message)

        refused = self._refused(scope)
        await (refused or self._app)(scope, receive, locked)

    def _refused(self, scope: Scope) -> Response | None:
        headers = Headers(scope=scope)
        hosts = headers.getlist("Host")
        if scope["http_version"] not in ("1.0", "1.1"):
            return _line(505, "HTTP 1.1 alone is spoken")
        if sum(map(len, itertools.chain(*scope["headers"]))) > _LONGEST_HEAD:
            return _line(431, f"more than {_LONGEST_HEAD} bytes of headers", Connection="close")
        if len(hosts) != 1:
            return _line(400, f"{len(hosts)} Host headers, 1 expected")
        if hosts[0].strip().lower() not in self._hosts:
            return _line(421, f"this is {', '.join(sorted(self._hosts))}")
        if scope["method"] not in _ALLOWED:
            return _line(405, "GET and HEAD alone are answered", Allow=", ".join(_ALLOWED))
        if "Transfer-Encoding" in headers or headers.get("Content-Length", "0") != "0":
            return _line(400, "a request with a body", Connection="close")
        if not scope["raw_path"].startswith(b"/"):
            return _line(400, "a request for another server")
        return None


def _line(status: int, text: str, **headers: str) -> Response:
    return PlainTextResponse(f"{text}\n", status, headers)


class _Answers:
    """The studio's answers to requests that are allowed."""

    def __init__(self, workspace: Workspace, layers: Layers) -> None:
        self._workspace, self._layers = workspace, layers
        self._page = Page(workspace, layers)

    def answer(self, request: Request) -> Response:
        """Answer a request; runs in a thread of its own."""
        try:
            return self._answer(request)
        except RefusedError as fault:
            return _line(400, str(fault))
        except ChangedError:
            return _line(409, _CHANGED)
        except FileNotFoundError:
            return _line(404, "nothing is here")
        except (
            Exception
        ) as fault:  # libraries raise known faults as all kinds; bugs are raised again
            known = known_fault(fault)
            if known is None:
                raise
            return _line(500, known)

    def _answer(self, request: Request) -> Response:
        path = request.scope["raw_path"].decode("latin-1")
        requested = _VERSION.fullmatch(request.url.query)
        token = requested.group(1) if requested else None
        tile = _TILE.fullmatch(path)
        if path == "/":
            content, policy = self._made_page(request.headers["Host"].strip())
            return _made(content, policy)
        if tile:
            name, level, x, y = tile.groups()
            content, found = self._layers.tile(name, int(level), int(x), int(y), token)
            tag = f"{found}-{level}-{x}-{y}"
            return _versioned(request, content, tag, "image/webp", token)
        if path == "/mesh.glb":
            content, found = self._page.mesh(token)
            return _versioned(request, content, found, "model/gltf-binary", token)
        if path == "/files":
            return RedirectResponse("/files/", 301)
        if path.startswith("/files/"):
            return self._file(request, path.removeprefix("/files/"))
        raise FileNotFoundError(path)

    def _made_page(self, host: str) -> tuple[bytes, str]:
        """The survey's page; a stage that is replaced meanwhile is not an error."""
        before = self._workspace.state(())
        try:
            return self._page.survey(host)
        except (AliceError, FileNotFoundError):
            if self._workspace.state(()) == before:
                raise
            raise ChangedError from None

    def _file(self, request: Request, path: str) -> Response:
        names = names_of(path)
        if path == "" or path.endswith("/"):
            entries, more = self._workspace.listed(names)
            return _made(*listing(names, entries, more))
        if self._workspace.is_folder(names):
            return RedirectResponse("/files/" + "/".join(map(quote, names)) + "/", 301)
        return _opened(request, self._workspace.file(names))


def _opened(request: Request, path: Path) -> Response:
    """A file, or a part of it; what replaces it meanwhile does not change the answer."""
    file = path.open("rb")
    status = os.fstat(file.fileno())
    tag, size = f'"{token_of(status)}"', status.st_size
    code, first, count = 200, 0, size
    if request.method == "GET":  # ranges have no meaning for HEAD
        code, first, count = requested_bytes(request.headers, size, tag)
    headers = {
        "Accept-Ranges": "bytes",
        "Cache-Control": _REVALIDATE,
        "Content-Length": str(count),
        "ETag": tag,
        "Last-Modified": formatdate(int(status.st_mtime), usegmt=True),
        _POLICY: policy_of(path.name),
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


def _made(content: bytes, policy: str) -> Response:
    """A page that is made for each request."""
    return Response(content, headers={"Cache-Control": _REVALIDATE, _POLICY: policy},
                    media_type=_PAGE)  # fmt: skip


def _versioned(
    request: Request, content: bytes, found: str, kind: str, requested: str | None
) -> Response:
    keep = _REVALIDATE if requested is None else _KEEP
    headers = {"ETag": f'"{found}"', "Cache-Control": keep}
    if request.headers.get("If-None-Match") == headers["ETag"]:
        return Response(status_code=304, headers=headers)
    return Response(content, headers=headers, media_type=kind)
