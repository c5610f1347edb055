"""A server in a thread, and requests as no browser would send them, byte by byte."""

import contextlib
import socket
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from http.client import HTTPResponse
from pathlib import Path

from alice_survey.studio.server import Server


@dataclass(frozen=True, kw_only=True)
class Reply:
    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def text(self) -> str:
        return self.body.decode()


@contextlib.contextmanager
def serving(folder: Path) -> Iterator[Server]:
    """A server that runs in a thread within this block."""
    server = Server(folder)
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
) -> Reply:
    """Send a request whose path is not touched.

    Args:
        server: to send it to.
        path: as it goes over the wire.
        headers: besides Host.
        method: any word.
        host: the server's own if empty; None for no such header.
    """
    port = server.port
    lines = [f"{method} {path} HTTP/1.1", "Connection: close"]
    if host is not None:
        lines.append(f"Host: {host or f'127.0.0.1:{port}'}")
    lines += [f"{name}: {text}" for name, text in (headers or {}).items()]
    with socket.create_connection(("127.0.0.1", port), timeout=20) as connection:
        connection.sendall("\r\n".join([*lines, "", ""]).encode("utf-8", "surrogateescape"))
        response = HTTPResponse(connection, method=method)
        response.begin()
        body = response.read()
        found = {name.lower(): text for name, text in response.getheaders()}
    return Reply(status=response.status, headers=found, body=body)
