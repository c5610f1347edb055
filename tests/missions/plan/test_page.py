"""The page is strict, small and right; its script runs under node against a stand-in browser."""

import base64
import hashlib
import io
import json
import os
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from pyproj import CRS, Transformer

from alice_survey.base.config import SeaConfig
from alice_survey.base.frames import Datum
from missions.areas.bathymetry import Bathymetry
from missions.coverage.certificate import Certificate, certificate
from missions.coverage.stations import plan_pattern, stations_of_plan
from missions.exposure.settings_table import Setting
from missions.plan import page as page_module
from missions.plan.page import Link, page_script, write_page
from missions.plan.page_data import page_data
from missions.values.plan_file import Plan
from tests.missions.exports.plans import RIG, line, plan_of, small_plan

HERE = Path(__file__).parent
SCRIPT = Path(page_module.__file__).with_name("page_plan.js")
"""The part that needs no browser."""
NASTY = "<script>alert('a')</script>&\"<!--</title>"
ROW = Setting(
    group="camera", name="<i>exposure</i>", value=1.83, unit="ms", equation="t = p / v",
    source="paper & book", bound_by="blur", note='"<b>',
)  # fmt: skip


class Strict(HTMLParser):
    """Collects elements; every one but the void ones must be closed in order."""

    VOID = frozenset({"meta", "input", "br", "path"})

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: dict[str, list[str]] = {}

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open:
            self.texts.setdefault(self.open[-1], []).append(data)


def parsed(path: Path) -> Strict:
    reader = Strict()
    reader.feed(path.read_text(encoding="utf-8"))
    reader.close()
    assert reader.open == []
    return reader


def seen_of(plan: Plan, cell_m: float | None = None) -> Certificate:
    pattern = plan_pattern(plan, RIG)
    return certificate(plan.area, RIG, stations_of_plan(plan), pattern, cell_m=cell_m)


def run_node(*arguments: str) -> Any:
    node = shutil.which("node")
    if node is None:
        if os.environ.get("CI"):
            pytest.fail("CI needs node to run the page's script")
        pytest.skip("no node here")
    done = subprocess.run([node, *arguments], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def drive(folder: Path, data: dict[str, Any], actions: list[Any]) -> Any:
    file = folder / "data.json"
    file.write_text(json.dumps(data))
    script = folder / "page.js"
    script.write_text(page_script())
    return run_node(str(HERE / "page_driver.js"), str(script), str(file), json.dumps(actions))


def test_nothing_in_a_plan_can_become_markup_or_script(tmp_path: Path) -> None:
    path = tmp_path / "plan.html"
    link = Link(href='exports/a"b<c.xml', about=NASTY)
    write_page(
        path, small_plan(name=NASTY), RIG, None, [ROW], warnings=[NASTY], links=[link]
    )  # fmt: skip
    page = parsed(path)

    scripts = [attributes for tag, attributes in page.elements if tag == "script"]
    assert scripts == [{"type": "application/json", "id": "data"}, {}]
    assert page.texts["h1"] == [NASTY]
    assert page.texts["title"] == [f"{NASTY}: survey plan"]
    assert NASTY in page.texts["li"]
    assert "i" not in page.texts
    assert {"<i>exposure</i>", "blur"} < set(page.texts["td"])
    (anchor,) = [attributes for tag, attributes in page.elements if tag == "a"]
    assert anchor == {"href": "exports/a%22b%3Cc.xml"}


def test_the_page_loads_nothing_and_its_policy_says_so(tmp_path: Path) -> None:
    path = tmp_path / "plan.html"
    plan = small_plan()
    write_page(path, plan, RIG, seen_of(plan), [ROW], sea=SeaConfig())
    page, text = parsed(path), path.read_text(encoding="utf-8")

    metas = [attributes for tag, attributes in page.elements if tag == "meta"]
    (policy,) = [m["content"] for m in metas if m.get("http-equiv") == "Content-Security-Policy"]
    assert policy is not None
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    assert rules["default-src"] == "'none'"
    assert rules["img-src"] == "data:"
    for tag, rule in (("style", "style-src"), ("script", "script-src")):
        inline = re.findall(rf"<{tag}>(.*?)</{tag}>", text, re.DOTALL)
        assert len(inline) == 1
        digest = base64.b64encode(hashlib.sha256(inline[0].encode()).digest()).decode()
        assert rules[rule] == f"'sha256-{digest}'"
    for _, attributes in page.elements:
        assert not {"src", "srcset", "style", "onclick", "onload"} & set(attributes)
    assert "http://" not in text
    assert "https://" not in text
    assert "url(" not in text
    assert "innerHTML" not in page_script()
    assert "eval(" not in page_script()


def test_the_same_plan_gives_the_same_page(tmp_path: Path) -> None:
    plan = small_plan()
    for name in ("a.html", "b.html"):
        write_page(tmp_path / name, plan, RIG, seen_of(plan), [ROW])
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


def test_pages_stay_small(tmp_path: Path) -> None:
    """The paper's mission, and 1,000 lines of 100 pictures."""
    paper = [line((0.0, i + 0.5), (15.0, i + 0.5)) for i in range(17)]
    large = [line((0.0, float(i)), (46.0, float(i)), step=0.4647) for i in range(1000)]
    for lines, most in ((paper, 100_000), (large, 300_000)):
        plan = plan_of(lines, [(0, len(lines) - 1)])
        seen = seen_of(plan, cell_m=0.25 if lines is large else None)
        write_page(tmp_path / "plan.html", plan, RIG, seen)
        assert 30_000 < (tmp_path / "plan.html").stat().st_size < most
    assert plan.stations == 100_000


def test_counts_in_the_picture_are_the_worst_of_their_cells() -> None:
    plan = small_plan()
    seen = seen_of(plan)
    data = page_data(plan, RIG, seen, None, None)["coverage"]
    raw = base64.b64decode(data["png"].partition(",")[2])
    with Image.open(io.BytesIO(raw)) as image:
        rgb = np.asarray(image)
    assert rgb.shape == (data["rows"], data["columns"], 3)
    for row, column in ((0, 0), (10, 17), (data["rows"] - 1, data["columns"] - 1)):
        block = round(data["cell"] / seen.grid.cell_m)
        part = (slice(row * block, (row + 1) * block), slice(column * block, (column + 1) * block))
        inside = seen.inside[part]
        if inside.any():
            assert rgb[row, column, 0] == seen.pictures[part][inside].min()
            assert rgb[row, column, 1] == seen.least_lines[part][inside].min()
            assert rgb[row, column, 2] == seen.at_overlap[part][inside].all()
        else:
            assert rgb[row, column, 0] == 255
    # The hole of the area is beyond it.
    middle = seen.grid.cells_of(np.array([2.15, 1.5])) * seen.grid.cell_m / data["cell"]
    assert rgb[int(middle[0]), int(middle[1]), 0] == 255
    assert (rgb[..., 0] < 255).mean() > 0.9


@pytest.mark.parametrize("latitude", [-78.0, 0.01, 32.8, 60.0])
def test_latitude_and_longitude_under_the_pointer(latitude: float) -> None:
    datum = Datum(latitude, 179.99)
    plan = plan_of([line((-800.0, 300.0), (700.0, 900.0), step=5.0)], [(0, 0)], datum=datum)
    geo = page_data(plan, RIG, None, None, None)["geo"]
    rng = np.random.default_rng(5)
    places = rng.uniform(-1000.0, 1000.0, (40, 2))
    code = (
        f"const m=require({json.dumps(str(SCRIPT))});"
        f"console.log(JSON.stringify({json.dumps(places.tolist())}.map(([n,e])=>"
        f"m.geodetic({json.dumps(geo)},n,e))))"
    )
    read = np.array(run_node("-e", code))
    ned = datum.ned_from_geodetic(np.column_stack([read, np.full(len(read), 13.0)]))
    worst = np.abs(ned[:, :2] - places).max()
    # Near the pole, where meridians close in, more of the third order is left.
    assert worst < (2e-4 if abs(latitude) < 65 else 2e-3)


def test_the_script_finds_lines_stations_and_cells() -> None:
    plan = small_plan()
    seen = seen_of(plan)
    data = page_data(plan, RIG, seen, None, None)
    places = [[0.5, 0.9], [2.4, 3.05], [4.0, 2.2], [100.0, 3.0]]
    code = (
        f"const m=require({json.dumps(str(SCRIPT))});const d=m.unpack({json.dumps(data)});"
        f"console.log(JSON.stringify({json.dumps(places)}.map(([n,e])=>{{"
        "const f=m.nearest(d.lines,n,e,0.3);const c=m.cellOf(d.coverage,n,e);"
        "return [f&&f.index,f&&f.station,f&&m.stationAt(f.line,f.station),c]})))"
    )
    found = run_node("-e", code)
    stations = [entry.stations_ne for entry in plan.lines]
    for place, (index, station, where, cell) in zip(places, found, strict=True):
        apart = [np.linalg.norm(s - place, axis=1).min() for s in stations]
        if min(apart) > 1.0:
            assert (index, cell) == (None, None)
            continue
        assert index == int(np.argmin(apart))
        nearest = int(np.argmin(np.linalg.norm(stations[index] - place, axis=1)))
        assert station == nearest
        np.testing.assert_allclose(where, stations[index][nearest], atol=1e-3)
        wanted = np.floor(seen.grid.cells_of(np.array(place)) * seen.grid.cell_m
                          / data["coverage"]["cell"])  # fmt: skip
        assert cell == wanted.astype(int).tolist()


def test_pointing_zooming_measuring_and_layers(tmp_path: Path) -> None:
    plan = small_plan()
    data = page_data(plan, RIG, seen_of(plan), None, SeaConfig())
    north_0, east_0, north_1, east_1 = data["extent"]
    scale = min((900 - 130) / (east_1 - east_0), (700 - 120) / (north_1 - north_0))
    middle_n, middle_e = (north_0 + north_1) / 2 - 18 / scale, (east_0 + east_1) / 2

    def at(north: float, east: float) -> dict[str, float]:
        return {
            "clientX": 450 + (east - middle_e) * scale,
            "clientY": 350 - (north - middle_n) * scale,
        }

    place = plan.lines[1].stations_ne[3]
    over = at(float(place[0]), float(place[1]))
    a, b = at(0.0, 0.0), at(3.0, 4.0)
    actions = [
        ["map", "pointermove", over],
        ["map", "wheel", {**over, "deltaY": -400, "deltaMode": 0}],
        ["map", "pointermove", over],
        ["fit", "click", {}],
        ["layer:4 survey lines", "change", {}],
        ["map", "pointermove", over],
        ["layer:4 survey lines", "change", {}],
        ["layer:dive 1", "change", {}],
        ["map", "pointermove", over],
        ["measure", "click", {}],
        ["map", "pointerdown", a], ["map", "pointerup", a],
        ["map", "pointerdown", b], ["map", "pointerup", b],
        ["map", "keydown", {"key": "Escape"}],
        ["map", "keydown", {"key": "ArrowLeft"}],
        ["layer:footprints (left camera)", "change", {}],
        ["window", "beforeprint", {}],
        ["map", "pointerleave", {}],
    ]  # fmt: skip
    done = drive(tmp_path, data, actions)
    tips = [report["tip"] for report in done["reports"]]

    wanted = ["Line 1 (survey, dive 1): 4.60 m, heading 180.0°", "Station 14, 4 of 11"]
    assert tips[0].split("\n")[:2] == wanted
    assert tips[0].split("\n")[2] == f"{place[0]:.3f} m N, {place[1]:.3f} m E"
    lat, lon = plan.datum.geodetic_from_ned(np.array([[*place, 13.0]]))[0, :2]
    assert tips[0].split("\n")[3] == f"{lat:.7f}° N  {lon:.7f}° E"
    # Zooming keeps what is under the pointer.
    assert tips[2] == tips[0]
    # A hidden layer or dive is not found.
    assert tips[5] is None
    assert tips[8] is None
    assert "measured 5.00 m" in done["reports"][13]["read"]
    assert "measure" not in done["reports"][14]["read"]
    # Footprints of the second dive, whose lines hold 31 stations, and stations and more.
    assert done["reports"][16]["calls"]["fill"] > 31
    assert done["reports"][18]["read"] == "Move the pointer over the map."
    assert {"stations", "no-go zones", "current", "dive 2", "1 cross line"} < set(done["layers"])


def test_a_plan_without_extras_has_no_layers_for_them(tmp_path: Path) -> None:
    plan = plan_of([line((0.0, 0.0), (3.0, 0.0))], [(0, 0)])
    layers = drive(tmp_path, page_data(plan, RIG, None, None, None), [])["layers"]
    assert "1 survey line" in layers
    for name in ("depth", "current", "no-go zones", "dive 1", "less than the overlap asked for"):
        assert name not in layers


def test_contours_of_a_plane_are_straight_and_where_they_should_be() -> None:
    """Depths on a raster in UTM, 0.1 m deeper with every metre north."""
    plan = small_plan()
    epsg = CRS.from_epsg(plan.datum.utm_epsg)
    to_utm = Transformer.from_crs("EPSG:4326", epsg, always_xy=True)
    x, y = to_utm.transform(plan.datum.longitude_deg, plan.datum.latitude_deg)
    cells = 60
    columns, rows = np.meshgrid(np.arange(cells) + 0.5, np.arange(cells) + 0.5)
    place_x, place_y = x - 30 + columns, y + 30 - rows
    lon, lat = to_utm.transform(place_x, place_y, direction="INVERSE")
    geodetic = np.column_stack([lat.ravel(), lon.ravel(), np.full(cells**2, 15.0)])
    north = plan.datum.ned_from_geodetic(geodetic)[:, 0]
    bathymetry = Bathymetry(
        name="plane",
        datum=plan.datum,
        crs=epsg.to_wkt(),
        from_pixel=(1.0, 0.0, x - 30, 0.0, -1.0, y + 30),
        depth_m=(15.0 + 0.1 * north).reshape(cells, cells),
        vertical_datum="none",
        reading="depths",
    )
    data = page_data(plan, RIG, None, bathymetry, None)

    depths = [contour["depth"] for contour in data["contours"]]
    # 10.2 m from south to north are 1.02 m of depth: steps of 0.2 m.
    assert np.allclose(np.diff(depths), 0.2)
    assert 5 <= len(depths) <= 6
    for contour in data["contours"]:
        (path,) = contour["paths"]
        points = np.array(path).reshape(-1, 2) / 1000
        assert points[:, 0] == pytest.approx((contour["depth"] - 15.0) / 0.1, abs=0.01)
        assert np.ptp(points[:, 1]) == pytest.approx(data["extent"][3] - data["extent"][1], abs=0.1)


def test_a_level_floor_has_no_contours_and_a_still_sea_no_arrow() -> None:
    data = page_data(small_plan(), RIG, None, None, SeaConfig(current_mps=0.0))
    assert data["contours"] == []
    assert data["current"] is None
