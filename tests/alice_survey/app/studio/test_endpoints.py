"""What changes files, or takes a body: from this server's own page, with the token, in bounds."""

import json
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel

from alice_survey.app.studio import server as studio_server
from alice_survey.app.studio.endpoints.base import Call, Content, Endpoint, Studio
from alice_survey.app.studio.server import Server
from alice_survey.core.artefacts import StaleError
from alice_survey.core.errors import AliceError, WorkspaceError
from tests.alice_survey.app.report.tiny import tiny_workspace
from tests.alice_survey.app.studio.client import ask, call, refused, serving


class Sum(BaseModel):
    terms: list[float]


def endpoints(studio: Studio) -> list[Endpoint]:
    """Endpoints that say what they were asked."""
    written = studio.workspace.folder / "dense" / "written.txt"

    def write(request: Call) -> dict[str, Any]:
        with studio.only_writer():
            written.write_bytes(request.body)
            time.sleep(float(request.query.get("wait", 0)))
        studio.publish("written", {"size": len(request.body), "none": float("nan")})
        return {"size": len(request.body)}

    def fail(request: Call) -> None:
        kinds = {"stale": StaleError("it changed"), "alice": AliceError("one line"),
                 "workspace": WorkspaceError("damaged"), "bug": RuntimeError("a bug")}  # fmt: skip
        raise kinds[request.path["kind"]]

    return [
        Endpoint(path="/api/test/write", answer=write, method="POST", writes=True, max_bytes=1000),
        Endpoint(path="/api/test/sum", method="POST",
                 answer=lambda asked: {"sum": sum(asked.read(Sum).terms), "nan": float("nan")}),
        Endpoint(path="/api/test/{kind}/fails", answer=fail),
        Endpoint(path="/api/test/file", answer=lambda _: Content(
            data=b"abc", kind="text/csv", name="a b\r\nX: 1\".csv")),
    ]  # fmt: skip


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(studio_server, "all_endpoints", endpoints)
        with serving(tiny_workspace(tmp_path_factory.mktemp("studio"))) as started:
            yield started


def written(server: Server) -> bytes:
    path = server.studio.workspace.folder / "dense" / "written.txt"
    return path.read_bytes() if path.exists() else b""


def test_a_write_needs_the_token(server: Server) -> None:
    assert call(server, "/api/test/write", b"first").json == {"size": 5}
    for token in (None, "a", server.studio.token[:-1], server.studio.token + "a", "é"):
        reply = call(server, "/api/test/write", b"second", token=token)
        assert (reply.status, "token" in reply.json["error"]) == (403, True)
    assert written(server) == b"first"
    assert server.studio.token not in ask(server, "/").text
    assert len(server.studio.token) >= 32


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Origin": "http://evil.example"}, 403), ({"Origin": "null"}, 403),
        ({"Origin": "http://127.0.0.1:1"}, 403), ({"Content-Type": "text/plain"}, 415),
        ({"Content-Type": "application/x-www-form-urlencoded"}, 415),
        ({"Content-Type": "multipart/form-data; boundary=a"}, 415),
        ({"Transfer-Encoding": "chunked"}, 411),
    ],
)  # fmt: skip
def test_no_form_of_another_page_is_taken(
    server: Server, headers: dict[str, str], status: int
) -> None:
    full = {"Content-Type": "application/json", "X-Studio-Token": server.studio.token} | headers
    before = written(server)
    chunked = "Transfer-Encoding" in headers
    body = b"" if chunked else b'{"terms": [1]}'
    assert ask(server, "/api/test/write", full, method="POST", body=body).status == status
    assert written(server) == before
    own = full | {"Content-Type": "application/json", "Origin": f"http://127.0.0.1:{server.port}"}
    own.pop("Transfer-Encoding", None)
    reply = ask(server, "/api/test/sum", own, method="POST", body=b'{"terms": [1, 2]}')
    assert reply.json == {"sum": 3, "nan": None}


def test_bodies_are_bounded_and_checked(server: Server) -> None:
    before = written(server)
    assert call(server, "/api/test/write", 1001 * b"a").status == 413
    assert written(server) == before
    for body in (b"", b"{", b"[]", b'{"terms": ["a"]}', b'{"terms": 1}', b"\xff"):
        reply = call(server, "/api/test/sum", body)
        assert reply.status in (400, 411)
        assert len(reply.text.splitlines()) == 1
    assert "terms.1" in refused(call(server, "/api/test/sum", {"terms": [1, "a"]}))


def test_a_body_that_drips_in_is_given_up(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(studio_server, "_BODY_S", 0.5)
    before = written(server)
    head = (
        f"POST /api/test/write HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\nContent-Length: 900\r\n"
        f"Content-Type: application/json\r\nX-Studio-Token: {server.studio.token}\r\n\r\n"
    )
    with socket.create_connection(("127.0.0.1", server.port), timeout=20) as connection:
        connection.sendall(head.encode() + b"abc")
        assert b" 408 " in connection.recv(65536).split(b"\r\n")[0]
    assert written(server) == before


def test_faults_are_one_line_and_files_are_named_safely(server: Server) -> None:
    for kind, status, text in (
        ("stale", 409, "it changed"), ("alice", 400, "one line"), ("workspace", 500, "damaged"),
    ):  # fmt: skip
        reply = ask(server, f"/api/test/{kind}/fails")
        assert (reply.status, reply.json) == (status, {"error": text})
    headers = ask(server, "/api/test/file").headers
    assert headers["content-disposition"] == (
        "attachment; filename*=UTF-8''a%20b%0D%0AX%3A%201%22.csv"
    )
    assert "x" not in headers


def test_only_one_writes_at_a_time(server: Server) -> None:
    slow = threading.Thread(target=call, args=(server, "/api/test/write?wait=1.5", b"slow"))
    slow.start()
    time.sleep(0.5)
    reply = call(server, "/api/test/write", b"quick")
    slow.join()
    assert "another command" in refused(reply, 500)
    assert written(server) == b"slow"


def test_every_page_hears_an_event(server: Server) -> None:
    with (
        socket.create_connection(("127.0.0.1", server.port), timeout=20) as first,
        socket.create_connection(("127.0.0.1", server.port), timeout=20) as second,
    ):
        for page in (first, second):
            page.sendall(events_asked(server))
            assert b"text/event-stream" in read_to(page, b"retry: 1000")
        call(server, "/api/test/write", b"abcd")
        for page in (first, second):
            heard = read_to(page, b"\n\n").decode()
            data = heard.split("data: ")[1].split("\n")[0]
            assert json.loads(data) == {"size": 4, "none": None}


def events_asked(server: Server) -> bytes:
    lines = ("GET /api/events HTTP/1.1", f"Host: 127.0.0.1:{server.port}",
             f"X-Studio-Token: {server.studio.token}", "", "")  # fmt: skip
    return "\r\n".join(lines).encode()


def read_to(page: socket.socket, text: bytes) -> bytes:
    heard = b""
    while text not in heard:
        part = page.recv(65536)
        assert part, "the stream has ended"
        heard += part
    return heard


def test_a_server_ends_with_pages_open(tmp_path: Path) -> None:
    with serving(tiny_workspace(tmp_path)) as started:
        page = socket.create_connection(("127.0.0.1", started.port), timeout=20)
        page.sendall(events_asked(started))
        read_to(page, b"retry: 1000")
        began_s = time.monotonic()
    assert time.monotonic() - began_s < 30  # it does not wait for a stream that never ends
    page.close()
