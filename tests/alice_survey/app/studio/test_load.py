"""Strangers on this machine, and pages that ask for too much: nobody else waits for them."""

import socket
import threading
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from alice_survey.app.studio import server as studio_server
from alice_survey.app.studio.endpoints.base import Call, Endpoint, Studio
from alice_survey.app.studio.server import Server
from tests.alice_survey.app.report.tiny import tiny_workspace
from tests.alice_survey.app.studio.client import Reply, ask, refused, serving
from tests.engines import until

WITHOUT = {"Cookie": ""}
began: list[str] = []
"""Requests that compute."""


@pytest.fixture(scope="module")
def go_on() -> threading.Event:
    return threading.Event()


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory, go_on: threading.Event) -> Iterator[Server]:
    """With `/api/test/compute`, which goes on when it is let."""
    every = studio_server.all_endpoints

    def endpoints(studio: Studio) -> list[Endpoint]:
        def compute(request: Call) -> dict[str, str]:
            began.append(request.query["n"])
            go_on.wait(60)
            return dict(request.query)

        return [*every(studio), Endpoint(path="/api/test/compute", answer=compute, computes=True)]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(studio_server, "all_endpoints", endpoints)
        folder = tiny_workspace(tmp_path_factory.mktemp("studio"))
        (folder / "dense" / "big.bin").write_bytes(bytes(8 << 20))
        with serving(folder) as started:
            yield started


@pytest.mark.parametrize(
    "path",
    ["/api/state", "/api/map", "/api/events", "/api/plan", "/files/survey.toml", "/mesh.glb",
     "/files/dense/dem.tif", "/tiles/dem/0/0/0.webp", "/api/none", "/none"],
)  # fmt: skip
def test_who_has_no_token_sees_nothing(server: Server, path: str) -> None:
    name, token = f"studio-{server.port}", server.studio.token
    for cookie in ("", f"{name}=a", f"{name}={token[1:]}", f"studio-1={token}"):
        reply = ask(server, path, {"Cookie": cookie, "X-Studio-Token": "a"})
        assert "address with its token" in refused(reply, 403)
        assert str(server.studio.workspace.folder) not in reply.text
    if path != "/api/events":
        assert ask(server, path, WITHOUT | {"X-Studio-Token": token}).status != 403
        assert ask(server, path).status != 403


def test_the_address_with_the_token_gives_the_cookie(server: Server) -> None:
    given = ask(server, f"/?token={server.studio.token}", WITHOUT).headers["set-cookie"]
    assert given.startswith(f"studio-{server.port}={server.studio.token};")
    assert {"httponly", "samesite=strict", "path=/"} <= set(given.lower().split("; "))
    for path in ("/", "/?token=", "/?token=wrong"):
        page = ask(server, path, WITHOUT)
        assert page.status == 200 and "set-cookie" not in page.headers
    assert ask(server, "/app/core.js", WITHOUT).status == 200


def test_computing_waits_in_a_queue_of_its_own(server: Server, go_on: threading.Event) -> None:
    """Two compute, sixteen wait, of one page only the newest; nobody else waits."""
    go_on.clear()
    began.clear()

    def compute(n: int, page: str = "") -> Reply:
        return ask(server, f"/api/test/compute?n={n}", {"X-Studio-Newest-Of": page})

    with ThreadPoolExecutor(64) as pool:
        working = [pool.submit(compute, n) for n in range(2)]
        until(lambda: len(began) == 2)
        ones = []
        for n in range(2, 6):
            ones.append(pool.submit(compute, n, f"one {n}"))
            until(lambda: sum(one.done() for one in ones) == len(ones) - 1)
        assert compute(4, "one 4").status == 409, "it was asked before the one that waits"
        others = [pool.submit(compute, n) for n in range(6, 46)]
        until(lambda: sum(one.done() for one in others) >= 25)
        assert ask(server, "/files/dense/dem.tif").status == 200
        assert ask(server, "/api/state").status == 200
        go_on.set()
        statuses = Counter(one.result().status for one in others)
        assert [one.result().status for one in working] == [200, 200]
    assert statuses == {200: 15, 503: 25}
    assert sorted(one.result().status for one in ones) == [200, 409, 409, 409]
    assert ones[-1].result().json == {"n": "5"}
    assert compute(46, "one").status == 200


def connect(server: Server, path: str) -> socket.socket:
    connection = socket.create_connection(("127.0.0.1", server.port), timeout=30)
    cookie = f"Cookie: studio-{server.port}={server.studio.token}"
    connection.sendall(
        f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\n{cookie}\r\n\r\n".encode()
    )
    return connection


def descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def test_streams_are_counted_when_they_are_accepted(server: Server) -> None:
    before = descriptors()
    opened = [connect(server, "/api/events") for _ in range(130)]
    starts = Counter(one.recv(12) for one in opened)
    assert starts == {b"HTTP/1.1 200": 100, b"HTTP/1.1 503": 30}
    for one in opened:
        one.close()
    until(lambda: not server.studio.events.listening)
    for _ in range(30):  # gone before the stream begins
        connect(server, "/api/events").close()
    until(lambda: not server.studio.events.listening)
    until(lambda: descriptors() <= before + 2)


@pytest.mark.parametrize("taken", [0, 1000])
def test_reads_that_are_broken_off_leave_no_file_open(server: Server, taken: int) -> None:
    before = descriptors()
    for _ in range(200):
        reading = connect(server, "/files/dense/big.bin")
        if taken:
            reading.recv(taken)
        reading.close()
    until(lambda: descriptors() <= before + 2, within_s=20.0)


@pytest.mark.parametrize("value", ["1e18", "-1e18", "1e308"])
@pytest.mark.parametrize("path", ["profile", "measure"])
def test_places_beyond_the_earth_are_refused(server: Server, path: str, value: str) -> None:
    places = f"[[0, 0], [{value}, 1], [1, 1]]".encode()
    body = b'{"places": %b, "kind": "polygon"}' % places if path == "measure" else (
        b'{"places": %b}' % places)  # fmt: skip
    headers = {"Content-Type": "application/json"}
    refused(ask(server, f"/api/model/{path}", headers, method="POST", body=body))


def test_wrong_requests_are_no_lines_on_the_terminal(
    server: Server, capfd: pytest.CaptureFixture[str]
) -> None:
    for text in (b"\x16\x03\x01 no request\r\n\r\n",
                 b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: Upgrade\r\n"
                 b"Upgrade: websocket\r\n\r\n"):  # fmt: skip
        with socket.create_connection(("127.0.0.1", server.port), timeout=30) as connection:
            connection.sendall(text)
            connection.recv(100)
    assert capfd.readouterr() == ("", "")
