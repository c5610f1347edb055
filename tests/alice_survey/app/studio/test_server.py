"""What the server gives, and above all what it does not."""

import contextlib
import http.client
import os
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from urllib.parse import quote

import pytest
import rasterio
from hypothesis import example, given, settings
from hypothesis import strategies as st

from alice_survey.app.studio.server import Server
from alice_survey.core.artefacts import write_json
from tests.alice_survey.app.report.tiny import tiny_workspace
from tests.alice_survey.app.studio.client import Reply, ask, serving

SECRET = b"not of the workspace"
MOSAIC = "/files/mosaic/mosaic.tif"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A workspace, with a secret next to it, links to the secret, and files not to be shown."""
    around = tmp_path_factory.mktemp("around")
    (around / "secret.txt").write_bytes(SECRET)
    (around / "secrets").mkdir()
    (around / "secrets" / "a.txt").write_bytes(SECRET)
    workspace = tiny_workspace(around / "reef")
    (workspace / "private").mkdir()
    (workspace / "private" / "a.txt").write_bytes(SECRET)
    (workspace / "notes.txt").write_bytes(SECRET)
    (workspace / "survey.toml").write_text("name = 'tiny'\n")
    dense = workspace / "dense"
    (dense / "out.txt").symlink_to(around / "secret.txt")
    (dense / "out").symlink_to(around / "secrets")
    (dense / "inside.tif").symlink_to("dem.tif")
    (dense / ".hidden").write_bytes(SECRET)
    (dense / "empty.csv").touch()
    (dense / "a b%2e.txt").write_text("spaces")
    (dense / "<b>.html").write_text("<script>fetch('/files/survey.toml')</script>")
    os.mkfifo(dense / "pipe.txt")
    partial = workspace / "mesh.partial"
    partial.mkdir()
    (partial / "a.txt").write_bytes(SECRET)
    (workspace / "quality").symlink_to(around / "secrets")
    return workspace


@pytest.fixture(scope="module")
def server(folder: Path) -> Iterator[Server]:
    before = contents(folder.parent)
    with serving(folder) as started:
        yield started
    assert contents(folder.parent) == before  # it never writes


def contents(folder: Path) -> dict[str, int]:
    return {str(path): path.lstat().st_mtime_ns for path in sorted(folder.rglob("*"))}


@pytest.mark.parametrize(
    "path",
    [
        "/files/../secret.txt",
        "/files/dense/../../secret.txt",
        "/files/%2e%2e/secret.txt",
        "/files/dense/..%2f..%2fsecret.txt",
        "/files/..%5csecret.txt",
        "/files/dense\\..\\..\\secret.txt",
        "/files/{secret}",
        "/files//{secret}",
        "//{secret}",
        "/{secret}",
        "/files/dense/dem.tif/",
        "/files/dense/dem.tif/..",
        "/files/dense/dem.tif%00",
        "/files/dense/out.txt",
        "/files/dense/out/a.txt",
        "/files/dense/out/",
        "/files/dense/inside.tif",
        "/files/quality/a.txt",
        "/files/quality/",
        "/files/dense/.hidden",
        "/files/dense/pipe.txt",
        "/files/mesh.partial/a.txt",
        "/files/private/a.txt",
        "/files/private/",
        "/files/notes.txt",
        "/files/.lock",
        "/files/survey.toml/a",
        "/files/dense/" + 300 * "a",
        "/files/dense/" + 200 * "a/",
        "/files/dense/" + 30_000 * "a",
        "/files/",
        "/files/dense",
        "/files/dense/",
        "/files/dense/%zz",
        "/files/dense/%",
        "/files/dense/%0d%0aSet-Cookie:%20a=b",
        "/files?dense",
        "/tiles/../files/dense/dem.tif",
        "/tiles/mosaic/0/0/-1.webp",
        "/tiles/mosaic/0/0/0.png",
        "/tiles/mosaic/99/0/0.webp",
        "/tiles/mosaic/0/999999/0.webp",
        "/tiles/error/0/0/0.webp",
        "/mesh.glb",
        "/favicon.ico",
        "/" + 70_000 * "a",
    ],
)
def test_nothing_else_can_be_reached(server: Server, folder: Path, path: str) -> None:
    reply = ask(server, path.replace("{secret}", str(folder.parent / "secret.txt")))
    assert reply.status in (400, 404, 414) or (path == "/files?dense" and reply.status == 307)
    assert SECRET not in reply.body
    assert "set-cookie" not in reply.headers
    assert str(folder.parent).encode() not in reply.body
    assert "access-control-allow-origin" not in reply.headers


@given(st.text("./\\%~aden2fe05cC:;?\x00\x01é", max_size=40))
@settings(max_examples=60, deadline=None)
def test_no_path_gives_the_secret(server: Server, path: str) -> None:
    reply = ask(server, "/files/" + path.replace("\x01", "../").replace(" ", ""))
    assert SECRET not in reply.body
    assert reply.status in (200, 301, 400, 404)


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("", 200), ("localhost:{port}", 200), ("LOCALHOST:{port}", 200),
        ("127.0.0.1", 200), ("evil.example:{port}", 400), ("evil.example", 400),
        ("127.0.0.1.evil.example:{port}", 400), ("127.0.0.2:{port}", 400),
        ("127.0.0.1:{port}@evil.example", 400), (None, 400),
    ],
)  # fmt: skip
def test_only_for_its_own_name(server: Server, host: str | None, status: int) -> None:
    port = server.port
    named = None if host is None else host.format(port=port)
    for path in ("/files/survey.toml", "/tiles/mosaic/0/0/0.webp"):
        assert ask(server, path, host=named).status == status
    again = {"Host": "evil.example"}
    assert ask(server, "/files/survey.toml", again).status == 400  # two of them
    assert ask(server, "http://evil.example/files/survey.toml").status in (400, 404)


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "CONNECT", "get"])
def test_no_method_but_get_and_head(server: Server, method: str) -> None:
    reply = ask(server, "/files/survey.toml", method=method)
    assert reply.status == (415 if method == "POST" else 405)
    assert not any(name.startswith("access-control") for name in reply.headers)


@pytest.mark.parametrize(
    "request_text",
    [
        b"GET /files/survey.toml\r\n\r\n",
        b"GET /files/survey.toml HTTP/1.1\r\nHost: HOST\r\nContent-Length: 5\r\n\r\nGET /",
        b"GET / HTTP/1.1\r\nHost: HOST\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n",
    ],
)
def test_requests_out_of_form_get_nothing(server: Server, request_text: bytes) -> None:
    port = server.port
    with socket.create_connection(("127.0.0.1", port), timeout=40) as connection:
        connection.sendall(request_text.replace(b"HOST", f"127.0.0.1:{port}".encode()))
        answer = b""
        with contextlib.suppress(ConnectionResetError):  # it was closed before all was read
            while part := connection.recv(65536):
                answer += part
    assert b" 200 " not in answer.split(b"\r\n")[0]
    assert b"name = " not in answer
    assert answer.count(b"HTTP/1.1 ") <= 1  # what came as a body is not a second request
    assert ask(server, "/files/survey.toml").status == 200


def test_every_answer_is_locked_in(server: Server) -> None:
    for path in ("/", "/files/", "/files/survey.toml", "/tiles/mosaic/0/0/0.webp", "/none"):
        for method in ("GET", "HEAD"):
            headers = ask(server, path, method=method).headers
            policy = headers["content-security-policy"]
            assert policy.startswith("default-src 'none'; ")
            assert "frame-ancestors 'none'" in policy
            assert "unsafe" not in policy
            assert headers["x-content-type-options"] == "nosniff"
            assert headers["cross-origin-resource-policy"] == "same-origin"
            assert not any(name.startswith("access-control") for name in headers)
    page = ask(server, "/files/dense/%3Cb%3E.html")  # which could run scripts
    policy = page.headers["content-security-policy"]
    assert page.status == 200
    assert "sandbox allow-scripts" in policy and "allow-same-origin" not in policy
    assert "connect-src" not in policy and "default-src 'none'" in policy
    assert "http" not in policy and "'self'" not in policy


@pytest.mark.parametrize(
    ("name", "kind"),
    [("mosaic/mosaic.tif", "image/tiff"), ("plan/plan.json", "application/json"),
     ("sparse/track.csv", "text/csv; charset=utf-8"), ("survey.toml", "text/plain; charset=utf-8"),
     ("dense/a b%2e.txt", "text/plain; charset=utf-8")],
)  # fmt: skip
def test_kinds_of_files(server: Server, folder: Path, name: str, kind: str) -> None:
    reply = ask(server, f"/files/{quote(name)}")
    assert (reply.status, reply.headers["content-type"]) == (200, kind)
    assert reply.body == (folder / name).read_bytes()
    head = ask(server, f"/files/{quote(name)}", method="HEAD")
    assert (head.body, head.headers["content-length"]) == (b"", str(len(reply.body)))


@given(first=st.integers(0, 1_100_000), last=st.integers(0, 1_100_000), suffix=st.booleans())
@example(first=0, last=0, suffix=False)
@example(first=0, last=10**17, suffix=False)
@example(first=0, last=0, suffix=True)
@settings(max_examples=40, deadline=None)
def test_ranges_are_the_files_bytes(
    server: Server, folder: Path, first: int, last: int, suffix: bool
) -> None:
    content = (folder / "mosaic" / "mosaic.tif").read_bytes()
    text = f"bytes=-{first}" if suffix else f"bytes={first}-{last}"
    reply = ask(server, MOSAIC, {"Range": text})
    start, end = (max(0, len(content) - first), len(content)) if suffix else (first, last + 1)
    if not suffix and last < first:
        assert reply.status in (200, 400, 416)
    elif start >= min(end, len(content)):
        assert reply.status == 416
        assert reply.headers["content-range"] == f"bytes */{len(content)}"
        assert content[:9] not in reply.body
    else:
        end = min(end, len(content))
        assert reply.status == 206
        assert reply.headers["content-range"] == f"bytes {start}-{end - 1}/{len(content)}"
        assert reply.body == content[start:end]
        assert reply.headers["content-length"] == str(end - start)


def test_what_is_known_is_not_sent_again(server: Server) -> None:
    tag, part = ask(server, MOSAIC).headers["etag"], {"Range": "bytes=3-9"}
    for headers, status in (
        (part | {"If-Range": tag}, 206), (part | {"If-Range": '"other"'}, 200),
        ({"If-None-Match": f'"a", W/{tag}'}, 304), ({"If-None-Match": '"a"'}, 200),
    ):  # fmt: skip
        assert (headers, ask(server, MOSAIC, headers).status) == (headers, status)
    tile = ask(server, "/tiles/mosaic/0/0/0.webp")
    again = ask(server, "/tiles/mosaic/0/0/0.webp", {"If-None-Match": tile.headers["etag"]})
    assert (again.status, again.body) == (304, b"")


def test_a_gis_reads_the_mosaic_by_parts(server: Server, folder: Path) -> None:
    read = "raster.read(window=((100, 150), (200, 260))).tobytes().hex()"
    script = f"import sys, rasterio; raster = rasterio.open(sys.argv[1]); print({read})"
    address = f"/vsicurl/{server.url}files/mosaic/mosaic.tif?token={server.studio.token}"
    done = subprocess.run(
        [sys.executable, "-c", script, address],
        capture_output=True, text=True, check=True, timeout=30,
    )  # fmt: skip
    with rasterio.open(folder / "mosaic" / "mosaic.tif") as raster:
        own = raster.read(window=((100, 150), (200, 260)))
    assert bytes.fromhex(done.stdout) == own.tobytes()


def test_many_at_once(server: Server) -> None:
    paths = [
        "/tiles/mosaic/1/0/0.webp", "/tiles/mosaic/1/0/1.webp", "/tiles/dem/0/0/0.webp",
        "/tiles/sigma/0/0/0.webp", "/files/dense/dem.tif", "/none", "/", "/api/map",
    ]  # fmt: skip
    expected = {path: ask(server, path).body for path in paths}

    def faults(number: int) -> list[str]:
        found = []
        connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=30)
        for step in range(10):
            path = paths[(number + step) % len(paths)]
            connection.request("GET", path, headers={"X-Studio-Token": server.studio.token})
            if connection.getresponse().read() != expected[path]:
                found.append(path)
        connection.close()
        return found

    with ThreadPoolExecutor(12) as pool:
        assert list(pool.map(faults, range(12))) == 12 * [[]]


def redone(workspace: Path, made: Path) -> None:
    """As `run_stage` replaces a finished stage."""
    final, replaced = workspace / "dense", workspace / "dense.replaced"
    shutil.copytree(made, workspace / "dense.partial")
    final.rename(replaced)
    (workspace / "dense.partial").rename(final)
    shutil.rmtree(replaced)


def test_a_stage_made_again_while_it_is_served(tmp_path: Path) -> None:
    workspace = tiny_workspace(tmp_path / "reef")
    with rasterio.open(workspace / "dense" / "dem.tif", "r+") as raster:
        raster.write(raster.read() + 3.0)
    made = Path(shutil.copytree(workspace / "dense", tmp_path / "made"))
    stop = threading.Event()

    def work() -> None:
        while not stop.is_set():
            redone(workspace, made)

    worker = threading.Thread(target=work)
    with serving(workspace) as server:
        same = ask(server, "/tiles/dem/0/0/0.webp").body
        worker.start()
        replies: list[Reply] = []
        try:
            for _ in range(12):
                replies += [ask(server, path) for path in ("/tiles/dem/0/0/0.webp", "/api/map")]
        finally:
            stop.set()
            worker.join()
        assert {reply.status for reply in replies} <= {200, 404, 409}
        assert {reply.body for reply in replies[0::2] if reply.status == 200} <= {same}
        assert ask(server, "/api/map").status == 200


def test_an_old_page_has_to_be_loaded_again(tmp_path: Path) -> None:
    workspace = tiny_workspace(tmp_path)
    with serving(workspace) as server:
        before = address_of_tiles(ask(server, "/api/map").text)
        assert ask(server, before.replace("{}", "0/0/0")).status == 200
        with rasterio.open(workspace / "dense" / "dem.tif", "r+") as raster:
            raster.write(raster.read() + 3.0)
        stale = ask(server, before.replace("{}", "0/0/0"))
        assert stale.status == 409
        assert "load the page again" in stale.json["error"]
        after = address_of_tiles(ask(server, "/api/map").text)
        assert after != before
        assert ask(server, after.replace("{}", "0/0/0")).status == 200
        shutil.rmtree(workspace / "dense")
        assert ask(server, after.replace("{}", "0/0/0")).status == 404
        assert "/tiles/dem/" not in ask(server, "/api/map").text


def address_of_tiles(page: str) -> str:
    start = page.index("/tiles/dem/")
    return page[start : page.index('"', start)]


def test_damaged_files_are_reported_in_a_line(tmp_path: Path) -> None:
    workspace = tiny_workspace(tmp_path)
    whole = (workspace / "mosaic" / "mosaic.tif").read_bytes()
    (workspace / "mosaic" / "mosaic.tif").write_bytes(whole[: len(whole) // 2])
    (workspace / "dense" / "sigma.tif").write_text("no raster")
    (workspace / "dense" / "surface.json").write_text("{")
    with serving(workspace) as server:
        for path in ("/tiles/mosaic/1/0/1.webp", "/tiles/sigma/0/0/0.webp", "/api/map"):
            reply = ask(server, path)
            assert reply.status == 500
            assert len(reply.text.splitlines()) == 1
        assert ask(server, "/tiles/dem/0/0/0.webp").status == 200


def test_a_workspace_that_goes_away(tmp_path: Path) -> None:
    workspace = tiny_workspace(tmp_path / "reef")
    with serving(workspace) as server:
        assert ask(server, "/").status == 200
        workspace.rename(tmp_path / "gone")
        assert ask(server, "/files/dense/dem.tif").status == 404
        assert ask(server, "/tiles/dem/0/0/0.webp").status == 404
        (tmp_path / "gone").rename(workspace)
        write_json(workspace / "dense" / "stage.json", {"stage": "dense", "digest": "1"})
        assert ask(server, "/").status == 200


@pytest.fixture
def impatient(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    """A server whose deadlines are short, of a workspace with a large file."""
    monkeypatch.setattr("alice_survey.app.studio.server._ASK_S", 1.5)
    monkeypatch.setattr("alice_survey.app.studio.server._ANSWER_S", 1.5)
    workspace = tiny_workspace(tmp_path)
    with (workspace / "dense" / "large.bin").open("wb") as file:
        file.truncate(1 << 28)
    with serving(workspace) as started:
        yield started


def dripping(port: int, stop: threading.Event, ended: list[float]) -> None:
    """Send a request a byte at a time, until the connection is closed."""
    began_s = time.monotonic()
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port)) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\na: ")
        while not stop.is_set():
            connection.sendall(b"a")
            time.sleep(0.1)
        return
    ended.append(time.monotonic() - began_s)


def test_requests_that_drip_in_starve_nobody_and_are_closed(impatient: Server) -> None:
    stop, ended = threading.Event(), list[float]()
    clients = [
        threading.Thread(target=dripping, args=(impatient.port, stop, ended)) for _ in range(120)
    ]
    for client in clients:
        client.start()
    replies = [ask(impatient, "/files/dense/dem.tif").status for _ in range(20)]
    for client in clients:
        client.join(20)
    stop.set()
    assert replies == 20 * [200]
    assert len(ended) == len(clients)
    assert min(ended) > 1.0


def test_an_answer_that_is_not_taken_in_is_given_up(impatient: Server) -> None:
    with socket.create_connection(("127.0.0.1", impatient.port)) as connection:
        head = f"GET /files/dense/large.bin HTTP/1.1\r\nHost: 127.0.0.1:{impatient.port}\r\n\r\n"
        connection.sendall(head.encode())
        time.sleep(2.5)
        taken = 0
        with contextlib.suppress(ConnectionResetError):
            while part := connection.recv(1 << 20):
                taken += len(part)
    assert 0 < taken < 1 << 27
    assert ask(impatient, "/plan/none").status == 404
