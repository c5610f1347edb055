"""A server in a thread, and requests as no browser would send them, byte by byte."""

import contextlib
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from http.client import HTTPResponse
from pathlib import Path
from typing import Any, TypeVar

from alice_survey.app.studio.server import Server
from tests.engines import until

T = TypeVar("T")

FOLDED = "sessionStorage.setItem('alice-survey layers', 'closed')"
"""Script of a page that keeps the list of layers from what is clicked on the map."""


def still(look: Callable[[], T], during_s: float = 0.4) -> T:
    """The first thing seen that stays the same for a while."""
    found, since_s = look(), time.monotonic()

    def same() -> bool:
        nonlocal found, since_s
        now = look()
        if now != found:
            found, since_s = now, time.monotonic()
        return time.monotonic() > since_s + during_s

    until(same)
    return found


def looks_at(page: Any) -> list[str]:
    """East and north of the middle of a page's map, and its zoom."""
    canvas = page.locator("#map-canvas")
    return [canvas.get_attribute(f"data-{name}") for name in ("east", "north", "zoom")]


def move_map(page: Any, key: str) -> None:
    """Press a key that moves the map, and wait for its end."""
    before = looks_at(page)
    page.keyboard.press(key)
    until(lambda: looks_at(page) != before)
    still(lambda: looks_at(page))


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


def refused(reply: Reply, status: int = 400) -> str:
    """The one line that says why a request was refused."""
    assert reply.status == status, reply.text
    line = str(reply.json["error"])
    assert "\n" not in line.strip()
    return line


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
        headers: besides Host and the cookie of the page; empty ones are not sent.
        method: any word.
        host: the server's own if empty; None for no such header.
        body: sent with its length where there is one.
    """
    port = server.port
    lines = [f"{method} {path} HTTP/1.1", "Connection: close"]
    if host is not None:
        lines.append(f"Host: {host or f'127.0.0.1:{port}'}")
    headers = {"Cookie": f"studio-{port}={server.studio.token}", **(headers or {})}
    lines += [f"{name}: {text}" for name, text in headers.items() if text]
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
