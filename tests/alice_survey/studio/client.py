"""A server in a thread, and requests as no browser would send them, byte by byte."""

import contextlib
import json
import socket
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from http.client import HTTPResponse
from pathlib import Path
from typing import Any

from alice_survey.studio.server import Server

FOLDED = "sessionStorage.setItem('alice-survey layers', 'closed')"
"""Script of a page that keeps the list of layers from what is clicked on the map."""


@dataclass(frozen=True, kw_only=True)
class Reply:
    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def text(self) -> str:
        return self.body.decode()

    @property
    def json(self) -> Any:
        return json.loads(self.body)


@contextlib.contextmanager
def serving(folder: Path, **options: Any) -> Iterator[Server]:
    """A server that runs in a thread within this block; options are the server's."""
    server = Server(folder, **options)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        thread.join()
        server.close()


def ask(
    server: Server,
    path: str,
    headers: dict[str, str] | None = None,
    *,
    method: str = "GET",
    host: str | None = "",
    body: bytes = b"",
) -> Reply:
    """Send a request whose path is not touched.

    Args:
        server: to send it to.
        path: as it goes over the wire.
        headers: besides Host.
        method: any word.
        host: the server's own if empty; None for no such header.
        body: sent with its length where there is one.
    """
    port = server.port
    lines = [f"{method} {path} HTTP/1.1", "Connection: close"]
    if host is not None:
        lines.append(f"Host: {host or f'127.0.0.1:{port}'}")
    lines += [f"{name}: {text}" for name, text in (headers or {}).items()]
    if body:
        lines.append(f"Content-Length: {len(body)}")
    head = "\r\n".join([*lines, "", ""]).encode("utf-8", "surrogateescape")
    with socket.create_connection(("127.0.0.1", port), timeout=60) as connection:
        connection.sendall(head + body)
        response = HTTPResponse(connection, method=method)
        response.begin()
        body = response.read()
        found = {name.lower(): text for name, text in response.getheaders()}
    return Reply(status=response.status, headers=found, body=body)


def call(server: Server, path: str, body: Any = None, *, token: str | None = "") -> Reply:
    """Send a POST as the studio's page does.

    Args:
        server: to send it to.
        path: of the endpoint, with its query.
        body: JSON values, or bytes as they are.
        token: the server's own if empty; None for no such header.
    """
    raw = isinstance(body, bytes)
    content = body if raw else json.dumps({} if body is None else body).encode()
    headers = {"Content-Type": "application/octet-stream" if raw else "application/json"}
    if token is not None:
        headers["X-Studio-Token"] = token or server.studio.token
    return ask(server, path, headers, method="POST", body=content)
