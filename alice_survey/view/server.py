"""The server: allowed requests and their responses.

It listens on the loopback address and answers GET and HEAD alone. A request whose Host is not this
server by its address and port is refused, since a page of another site could otherwise reach it
through a name of its own (DNS rebinding). Nothing allows another site to read an answer.
"""

import os
import re
import socketserver
import sys
from collections.abc import Callable, Mapping
from email.message import Message
from email.utils import formatdate
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path, PurePath
from typing import Any, cast
from urllib.parse import quote

from alice_survey.base.errors import AliceError, WorkspaceError, known_fault, why
from alice_survey.base.run.interrupts import for_other_programs
from alice_survey.report.held import Held
from alice_survey.view.layers import FILES, ChangedError, Layers
from alice_survey.view.page import Page, listing
from alice_survey.view.paths import RefusedError, Workspace, names_of, token_of

ADDRESS = "127.0.0.1"
_IDLE_S = 20.0
"""Time after which a silent connection is closed."""
_TILE = re.compile(
    rf"/tiles/({'|'.join(FILES)})/([0-9]{{1,2}})/([0-9]{{1,6}})/([0-9]{{1,6}})\.webp"
)
_VERSION = re.compile(r"v=([0-9a-f-]{1,64})")
_CHANGED = "the survey was worked on meanwhile: load the page again"
_KEEP = "private, max-age=86400, immutable"
"""Cache policy of requests that state a version."""
_REVALIDATE = "no-cache"
_CHUNK = 1 << 20
_NOTHING = "default-src 'none'; sandbox"
_COMMON = {
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Frame-Options": "DENY",
}


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


class Server(ThreadingHTTPServer):
    """Serves one workspace until it is shut down."""

    daemon_threads = True
    block_on_close = False
    request_queue_size = 64

    def __init__(self, folder: Path, port: int = 0) -> None:
        """Listen.

        Args:
            folder: folder of the workspace.
            port: 0 for any that is free.

        Raises:
            WorkspaceError: the port is not available.
        """
        self.workspace = Workspace(folder)
        self.layers = Layers(self.workspace)
        self.page = Page(self.workspace, self.layers)
        try:
            super().__init__((ADDRESS, port), Handler)
        except OSError as error:
            raise WorkspaceError(
                f"port {port} of {ADDRESS}: {why(error)}: give another --port, or none"
            ) from None
        port = self.server_address[1]
        self.hosts = {f"{ADDRESS}:{port}", f"localhost:{port}"}
        if port == 80:
            self.hosts |= {ADDRESS, "localhost"}

    @property
    def url(self) -> str:
        """Where the survey's page is."""
        return f"http://{ADDRESS}:{self.server_address[1]}/"

    def server_bind(self) -> None:
        """Bind, without asking a name server who this machine is."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = ADDRESS, self.server_address[1]

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore a browser that disconnects; report a bug."""
        if not isinstance(sys.exception(), (ConnectionError, TimeoutError)):
            super().handle_error(request, client_address)

    def server_close(self) -> None:
        """Stop listening, and wait briefly for what is being read."""
        super().server_close()
        self.layers.close()


class _AnsweredError(Exception):
    """The response is a status and a line of text."""

    def __init__(self, status: HTTPStatus, text: str) -> None:
        super().__init__(text)
        self.status = status


class Handler(BaseHTTPRequestHandler):
    """Answers the requests of one connection."""

    protocol_version = "HTTP/1.1"
    timeout = _IDLE_S

    @property
    def _served(self) -> Server:
        return cast(Server, self.server)

    def version_string(self) -> str:
        """Name of the server, for this machine's users."""
        return "alice-survey"

    def parse_request(self) -> bool:
        """Read a request; a malformed one is answered here."""
        if not super().parse_request():
            return False
        try:
            self._check_request()
        except _AnsweredError as fault:
            self.close_connection = True
            self._send_line(fault.status, str(fault))
            return False
        return True

    def _check_request(self) -> None:
        hosts = self.headers.get_all("Host") or []
        if len(hosts) != 1:
            raise _AnsweredError(HTTPStatus.BAD_REQUEST, f"{len(hosts)} Host headers, 1 expected")
        if hosts[0].strip().lower() not in self._served.hosts:
            raise _AnsweredError(
                HTTPStatus.MISDIRECTED_REQUEST, f"this is {', '.join(sorted(self._served.hosts))}"
            )
        if self.command not in ("GET", "HEAD"):
            raise _AnsweredError(HTTPStatus.METHOD_NOT_ALLOWED, "GET and HEAD alone are answered")
        if "Transfer-Encoding" in self.headers or self.headers.get("Content-Length", "0") != "0":
            raise _AnsweredError(HTTPStatus.BAD_REQUEST, "a request with a body")
        if not self.path.startswith("/"):
            raise _AnsweredError(HTTPStatus.BAD_REQUEST, "a request for another server")

    def do_GET(self) -> None:
        """Answer with a content."""
        self._begun = False
        try:
            self._answer()
        except _AnsweredError as fault:
            self._send_line(fault.status, str(fault))
        except RefusedError as fault:
            self._send_line(HTTPStatus.BAD_REQUEST, str(fault))
        except ChangedError:
            self._send_line(HTTPStatus.CONFLICT, _CHANGED)
        except FileNotFoundError:
            self._send_line(HTTPStatus.NOT_FOUND, "nothing is here")
        except (ConnectionError, TimeoutError):
            raise
        except Exception as fault:  # a visitor gets an answer to any; bugs are raised again
            self.close_connection = True
            known = known_fault(fault)
            if not self._begun:
                self._send_line(HTTPStatus.INTERNAL_SERVER_ERROR, known or "a fault of the program")
            if known is None:
                raise

    do_HEAD = do_GET  # noqa: N815

    def _answer(self) -> None:
        path, _, query = self.path.partition("?")
        requested = _VERSION.fullmatch(query)
        token = requested.group(1) if requested else None
        tile = _TILE.fullmatch(path)
        if path == "/":
            self._send(*self._made_page(self.headers["Host"].strip()), "text/html; charset=utf-8")
        elif tile:
            name, level, x, y = tile.groups()
            content, found = self._served.layers.tile(name, int(level), int(x), int(y), token)
            self._send_versioned(content, f"{found}-{level}-{x}-{y}", "image/webp", token)
        elif path == "/mesh.glb":
            content, found = self._served.page.mesh(token)
            self._send_versioned(content, found, "model/gltf-binary", token)
        elif path == "/files":
            self._go_to("/files/")
        elif path.startswith("/files/"):
            self._send_file(path.removeprefix("/files/"))
        else:
            raise FileNotFoundError(path)

    def _made_page(self, host: str) -> tuple[bytes, str]:
        """The survey's page; a stage that is replaced meanwhile is not an error."""
        workspace = self._served.workspace
        before = workspace.state(())
        try:
            return self._served.page.survey(host)
        except (AliceError, FileNotFoundError):
            if workspace.state(()) == before:
                raise
            raise ChangedError from None

    def _send_file(self, path: str) -> None:
        workspace, names = self._served.workspace, names_of(path)
        if path == "" or path.endswith("/"):
            entries, more = workspace.listed(names)
            self._send(*listing(names, entries, more), "text/html; charset=utf-8")
            return
        if workspace.is_folder(names):
            self._go_to("/files/" + "/".join(quote(name) for name in names) + "/")
            return
        with workspace.file(names).open("rb") as file:
            status = os.fstat(file.fileno())
            tag, size = f'"{token_of(status)}"', status.st_size
            headers = {
                "Content-Type": content_type(names[-1]),
                "Accept-Ranges": "bytes",
                "ETag": tag,
                "Last-Modified": formatdate(int(status.st_mtime), usegmt=True),
            }
            code, first, count = 200, 0, size
            if self.command == "GET":  # ranges have no meaning for HEAD
                code, first, count = requested_bytes(self.headers, size, tag)
            if code == 206:
                headers["Content-Range"] = f"bytes {first}-{first + count - 1}/{size}"
            elif code == 416:
                headers["Content-Range"] = f"bytes */{size}"
            self._begin(code, policy_of(names[-1]), count, _REVALIDATE, headers)
            if self.command == "GET":
                file.seek(first)
                while count and (chunk := file.read(min(_CHUNK, count))):
                    self.wfile.write(chunk)
                    count -= len(chunk)
                self.close_connection |= count > 0  # it was cut short meanwhile

    def _send(self, content: bytes, policy: str, kind: str) -> None:
        """A page that is made for each request."""
        self._begin(200, policy, len(content), _REVALIDATE, {"Content-Type": kind})
        self._write(content)

    def _send_versioned(self, content: bytes, found: str, kind: str, requested: str | None) -> None:
        headers = {"Content-Type": kind, "ETag": f'"{found}"'}
        keep = _KEEP if requested is not None else _REVALIDATE
        if self.headers.get("If-None-Match") == headers["ETag"]:
            self._begin(304, _NOTHING, 0, keep, headers)
            return
        self._begin(200, _NOTHING, len(content), keep, headers)
        self._write(content)

    def _go_to(self, place: str) -> None:
        self._begin(HTTPStatus.MOVED_PERMANENTLY, _NOTHING, 0, _REVALIDATE, {"Location": place})

    def _send_line(self, status: HTTPStatus, text: str) -> None:
        """Answer with a line."""
        content = f"{text}\n".encode()
        headers = {"Content-Type": "text/plain; charset=utf-8"}
        if status == HTTPStatus.METHOD_NOT_ALLOWED:
            headers["Allow"] = "GET, HEAD"
        self._begin(status, _NOTHING, len(content), "no-store", headers)
        self._write(content)

    def _begin(
        self, status: int, policy: str, length: int, keep: str, headers: Mapping[str, str]
    ) -> None:
        self._begun = True
        self.send_response(status)
        policy += "; frame-ancestors 'none'"
        common = {**_COMMON, "Content-Security-Policy": policy, "Cache-Control": keep}
        if status != HTTPStatus.NOT_MODIFIED:
            common["Content-Length"] = str(length)
        if self.close_connection:
            common["Connection"] = "close"
        for name, text in (common | dict(headers)).items():
            self.send_header(name, text)
        self.end_headers()

    def _write(self, content: bytes) -> None:
        if self.command != "HEAD":
            self.wfile.write(content)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Answer a malformed request in the same format as all others."""
        self.close_connection = True
        self.command = self.command or "GET"
        self._send_line(HTTPStatus(code), message or explain or HTTPStatus(code).phrase)

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002
        """Do not log requests."""


def run_view(workspace: Path, port: int, *, browser: bool, show: Callable[[str], None]) -> None:
    """Serve a workspace; Ctrl-C ends it as it ends every command.

    Args:
        workspace: the workspace to show.
        port: to listen on; 0 for any that is free.
        browser: open one.
        show: prints a line.

    Raises:
        WorkspaceError: there is nothing to show, or the port is taken.
    """
    if not Held.of(workspace).stages:
        raise WorkspaceError(
            f"{workspace} holds nothing to show: run 'alice-survey plan' or 'import-images'"
        )
    server = Server(workspace, port)
    try:
        show(f"{workspace} is shown at {server.url} to this machine alone; Ctrl-C ends it")
        if browser:
            import webbrowser

            with for_other_programs():
                webbrowser.open(server.url)
        server.serve_forever()
    finally:
        server.server_close()
