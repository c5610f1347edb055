"""A web map's tiles under the survey: where they lie by pyproj, and what they open the page to."""

import functools
import http.server
import io
import json
import shutil
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from PIL import Image
from pyproj import Transformer

import alice_survey.app.studio
from alice_survey.app.studio.app import server_of
from alice_survey.core.errors import WorkspaceError
from tests.alice_survey.app.report.tiny import tiny_workspace
from tests.alice_survey.app.studio.client import ask, serving
from tests.alice_survey.kit.browser import Heard, chromium

WEB = Path(alice_survey.app.studio.__file__).parent / "web"


@pytest.mark.skipif(shutil.which("node") is None, reason="no node here")
@pytest.mark.parametrize("datum", [(32.823, 34.955), (-33.9, 151.3), (69.2, -10.4), (0.0, 0.0)])
def test_tiles_lie_where_pyproj_puts_them(datum: tuple[float, float]) -> None:
    to_mercator = Transformer.from_crs("EPSG:4326", "EPSG:3857", always_xy=True)
    local = f"+proj=aeqd +lat_0={datum[0]} +lon_0={datum[1]} +ellps=WGS84"
    to_local = Transformer.from_crs("EPSG:3857", local, always_xy=True)
    half = 20037508.342789244
    for z in (13, 17, 19):
        side = 2 * half / 2**z
        east, north = to_mercator.transform(datum[1], datum[0])
        x, y = int((east + half) // side), int((half - north) // side)
        script = (
            f"import {{boundsOf}} from {json.dumps((WEB / 'background.js').as_uri())};"
            f"console.log(JSON.stringify(boundsOf({json.dumps(datum)}, {z}, {x}, {y})))"
        )
        done = subprocess.run(
            ["node", "--input-type=module", "-e", script],
            capture_output=True, text=True, check=True, timeout=60,
        )  # fmt: skip
        found = json.loads(done.stdout)
        for (n, e), (column, row) in zip(found, ((x, y + 1), (x + 1, y)), strict=True):
            expected = to_local.transform(column * side - half, half - row * side)
            # The tangent plane and the equidistant map part by d^3 / 6 R^2: 0.3 mm at 4 km.
            assert (e, n) == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize(
    "address",
    [
        "https://a.example/{z}/{x}.png", "ftp://a.example/{z}/{x}/{y}.png", "a.example/{z}/{x}/{y}",
        "https://a.example/{z}/{x}/{y}.png;script-src *", "https://a b/{z}/{x}/{y}",
        "https://a.example/{z}/{x}/{y}/{q}", "https://'unsafe-inline'/{z}/{x}/{y}",
    ],
)  # fmt: skip
def test_addresses_that_are_none(address: str) -> None:
    with pytest.raises(WorkspaceError, match="--background"):
        server_of(address)


def test_the_page_may_load_from_that_server_alone(tmp_path: Path) -> None:
    workspace = tiny_workspace(tmp_path)
    address = "https://tiles.example.org:8443/a/{z}/{x}/{y}.png?key=1"
    with serving(workspace, background=address) as server:
        policy = ask(server, "/").headers["content-security-policy"]
        assert "img-src 'self' data: blob: https://tiles.example.org:8443;" in policy
        assert ask(server, "/api/state").json["background"] == address
    with serving(workspace) as server:
        assert "http" not in ask(server, "/").headers["content-security-policy"]


class _Tiles(http.server.BaseHTTPRequestHandler):
    def __init__(self, asked: list[str], *arguments: object) -> None:
        self.asked = asked
        super().__init__(*arguments)  # type: ignore[arg-type]

    def do_GET(self) -> None:
        self.asked.append(self.path)
        buffer = io.BytesIO()
        Image.new("RGB", (256, 256), (30, 160, 90)).save(buffer, "PNG")
        self.send_response(200)
        self.send_header("Content-Type", "image/png")
        self.end_headers()
        self.wfile.write(buffer.getvalue())

    def log_message(self, *_: object) -> None:
        """Say nothing."""


@pytest.fixture
def tiles() -> Iterator[tuple[str, list[str]]]:
    """The address of a server of tiles, and what it was asked."""
    asked: list[str] = []
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(_Tiles, asked))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_address[1]}/{{z}}/{{x}}/{{y}}.png", asked
    server.shutdown()
    server.server_close()
    thread.join()


@pytest.mark.slow
@pytest.mark.xdist_group("chromium")
def test_tiles_are_shown_and_taken_away(tmp_path: Path, tiles: tuple[str, list[str]]) -> None:
    address, asked = tiles
    workspace = tiny_workspace(tmp_path)
    with serving(workspace, background=address) as server, chromium() as browser:
        page = browser.new_page(viewport={"width": 1000, "height": 700}, reduced_motion="reduce")
        heard = Heard()
        heard.listen(page)
        page.goto(server.address)
        page.wait_for_selector("body[data-ready]", timeout=60_000)
        under = ".leaflet-under-pane img"
        page.wait_for_function(
            f"[...document.querySelectorAll('{under}')].some((tile) => tile.naturalWidth === 256)",
            timeout=60_000,
        )
        box = page.locator("#map-canvas").bounding_box()
        covered = page.evaluate(
            f"[...document.querySelectorAll('{under}')].map((tile) => tile.getBoundingClientRect())"
            ".map(({left, right, top, bottom}) => [left, right, top, bottom])"
        )
        assert min(left for left, *_ in covered) <= box["x"]
        assert max(right for _, right, *_ in covered) >= box["x"] + box["width"]
        page.locator("#layers summary").click()
        page.get_by_label("Map of 127.0.0.1").uncheck()
        assert page.locator(under).count() == 0
        assert heard.complaints == []
        page.close()
    assert asked and all(path.split("/")[1] == "19" for path in asked)
