"""The page is safe, small and right; its script finds stations, alone and in Chromium."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyproj import CRS, Transformer

from alice_survey.core.config import SeaConfig
from alice_survey.core.frames import Datum
from alice_survey.kit.document import Link, PictureLayer, ShapeLayer
from missions.areas.bathymetry import Bathymetry
from missions.coverage.certificate import Certificate, certificate
from missions.coverage.stations import plan_pattern, stations_of_plan
from missions.exposure.settings_table import Setting
from missions.plan import page as page_module
from missions.plan.page import SCRIPTS, write_page
from missions.plan.page_map import counts_picture, geodetic_fit, plan_map
from missions.values.plan_file import Plan
from tests.alice_survey.kit.browser import Heard, chromium
from tests.alice_survey.kit.node import run_node
from tests.missions.exports.plans import RIG, line, plan_of, small_plan

NASTY = "<script>alert('a')</script>&\"<!--</title>"
ROW = Setting(
    group="camera", name="<i>exposure</i>", value=1.83, unit="ms", equation="t = p / v",
    source="paper & book", bound_by="blur", note='"<b>',
)  # fmt: skip


def seen_of(plan: Plan, cell_m: float | None = None) -> Certificate:
    pattern = plan_pattern(plan, RIG)
    return certificate(plan.area, RIG, stations_of_plan(plan), pattern, cell_m=cell_m)


def layers_of(
    plan: Plan, bathymetry: Bathymetry | None = None
) -> dict[str, PictureLayer | ShapeLayer]:
    sea = SeaConfig(current_mps=0.0)
    layers = plan_map(plan, RIG, seen_of(plan), bathymetry, sea).layers
    return {layer.name: layer for layer in layers}


def write(path: Path, plan: Plan, cell_m: float | None = None, **more: Any) -> None:
    """Write a page."""
    values: dict[str, Any] = {
        "bathymetry": None, "sea": SeaConfig(), "warnings": [], "links": [], **more,
    }  # fmt: skip
    write_page(path, plan, RIG, seen_of(plan, cell_m), [ROW], **values)


def test_texts_of_a_plan_are_escaped(tmp_path: Path) -> None:
    path = tmp_path / "plan.html"
    link = Link(text="b.xml", address='exports/a"b<c.xml', about=NASTY)
    write(path, small_plan(name=NASTY), warnings=[NASTY], links=[link])
    text = path.read_text(encoding="utf-8")
    assert NASTY not in text and ROW.name not in text
    assert "exports/a%22b%3Cc.xml" in text


def test_the_same_plan_gives_the_same_page_that_loads_nothing(tmp_path: Path) -> None:
    plan = small_plan()
    for name in ("a.html", "b.html"):
        write(tmp_path / name, plan)
    text = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert text == (tmp_path / "b.html").read_text(encoding="utf-8")
    assert "default-src 'none'; img-src data: blob:;" in text
    assert re.search(r"<(img|script|link)[^>]*(src|href)=.(?!data:)", text) is None
    assert all("innerHTML" not in script.read_text(encoding="utf-8") for script in SCRIPTS)


def test_pages_stay_small(tmp_path: Path) -> None:
    """The paper's mission, and 1,000 lines of 100 pictures."""
    paper = [line((0.0, i + 0.5), (15.0, i + 0.5)) for i in range(17)]
    large = [line((0.0, float(i)), (46.0, float(i)), step=0.4647) for i in range(1000)]
    for lines, maximum in ((paper, 260_000), (large, 500_000)):
        plan = plan_of(lines, [(0, len(lines) - 1)])
        write(tmp_path / "plan.html", plan, cell_m=0.25 if lines is large else None)
        assert 200_000 < (tmp_path / "plan.html").stat().st_size < maximum
    assert plan.stations == 100_000


def test_counts_in_the_picture_are_those_of_their_cells() -> None:
    plan = small_plan()
    seen = seen_of(plan)
    rgb, (north, west), pixel_m = counts_picture(seen)
    rows, columns = rgb.shape[:2]
    row, column = np.mgrid[:rows, :columns]
    places = np.stack([north - pixel_m * (row + 0.5), west + pixel_m * (column + 0.5)], axis=-1)
    cells = np.floor(seen.grid.cells_of(places)).astype(int)
    on = np.all((cells >= 0) & (cells < seen.grid.shape), axis=-1)
    at = (cells[on][:, 0], cells[on][:, 1])
    inside = seen.inside[at]
    assert (rgb[~on][:, 0] == 255).all()
    assert (rgb[on][~inside][:, 0] == 255).all()
    for channel, counts in enumerate((seen.pictures, seen.least_lines, seen.at_overlap)):
        assert (rgb[on][inside][:, channel] == counts[at][inside]).all()
    assert (rgb[..., 0] < 255).mean() > 0.9 * plan.area.survey.area / (rows * columns * pixel_m**2)


@pytest.mark.parametrize("latitude", [-78.0, 0.01, 32.8, 60.0])
def test_latitude_and_longitude_under_the_pointer(latitude: float) -> None:
    datum = Datum(latitude, 179.99)
    plan = plan_of([line((-800.0, 300.0), (700.0, 900.0), step=5.0)], [(0, 0)], datum=datum)
    n, e = np.random.default_rng(5).uniform(-1000.0, 1000.0, (2, 40))
    terms = np.stack([np.ones(40), n, e, n * n, n * e, e * e])
    read = [np.array(factors) @ terms for factors in geodetic_fit(plan, (-800, 300, 700, 900))]
    ned = datum.ned_from_geodetic(np.column_stack([*read, np.full(40, 13.0)]))
    # Near the pole, where meridians close in, more of the third order is left.
    worst = np.abs(ned[:, :2] - np.column_stack([n, e])).max()
    assert worst < (2e-4 if abs(latitude) < 65 else 2e-3)


def test_the_script_finds_lines_and_stations() -> None:
    plan = small_plan()
    ends = [
        {"n0": a.start_ne_m[0], "e0": a.start_ne_m[1], "n1": a.end_ne_m[0], "e1": a.end_ne_m[1],
         "stations": a.stations, "index": i} for i, a in enumerate(plan.lines)
    ]  # fmt: skip
    places = [[0.5, 0.9], [2.4, 3.05], [4.0, 2.2], [100.0, 3.0]]
    code = (
        f"const m=require({json.dumps(str(SCRIPTS[0]))});"
        f"console.log(JSON.stringify({json.dumps(places)}.map(([n,e])=>{{"
        f"const f=m.nearestStation({json.dumps(ends)},n,e,0.3);"
        "return [f&&f.line.index,f&&f.station,f&&m.stationAt(f.line,f.station)]})))"
    )
    stations = [entry.stations_ne for entry in plan.lines]
    for place, (index, station, where) in zip(places, run_node("-e", code), strict=True):
        apart = [np.linalg.norm(s - place, axis=1).min() for s in stations]
        if min(apart) > 1.0:
            assert index is None
            continue
        assert index == int(np.argmin(apart))
        assert station == int(np.linalg.norm(stations[index] - place, axis=1).argmin())
        np.testing.assert_allclose(where, stations[index][station], atol=1e-9)


@pytest.mark.xdist_group("chromium")
@pytest.mark.parametrize("size", [(1280, 900), (400, 800)])
def test_pointing_and_layers(size: tuple[int, int], tmp_path: Path) -> None:
    plan, path = small_plan(), tmp_path / "plan.html"
    write(path, plan)
    north, east = plan.lines[1].stations_ne[3].tolist()
    with chromium() as browser:
        page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        heard = Heard()
        heard.listen(page)
        page.goto(path.as_uri())
        page.wait_for_selector("#map[data-ready]", state="attached", timeout=60_000)
        box = page.locator("#map-canvas")
        box.scroll_into_view_if_needed()

        def point() -> None:
            frame = box.bounding_box()
            scale = 2 ** float(box.get_attribute("data-zoom"))
            x = (east - float(box.get_attribute("data-east"))) * scale
            y = (float(box.get_attribute("data-north")) - north) * scale
            page.mouse.move(frame["x"] + frame["width"] / 2 + x + 1,
                            frame["y"] + frame["height"] / 2 + y)  # fmt: skip

        point()
        tip = page.locator(".leaflet-tooltip")
        lines = tip.inner_text().split("\n")
        first = plan.lines[0].stations + 3
        assert lines[1:] == [
            f"Station {first}, 4 of {plan.lines[1].stations}",
            f"{north:.3f} m N, {east:.3f} m E",
        ]
        assert "heading 180.0" in lines[0]
        readout = page.locator("#map-readout")
        page.wait_for_function(
            "() => / pictures of /.test(document.getElementById('map-readout').textContent)"
        )
        latitude, longitude = plan.datum.geodetic_from_ned(np.array([[north, east, 13.0]]))[0, :2]
        assert f"{latitude:.5f}" in readout.inner_text()
        assert f"{longitude:.4f}" in readout.inner_text()

        page.get_by_label("survey lines").first.uncheck()  # of the first dive
        page.mouse.move(0, 0)
        box.scroll_into_view_if_needed()
        point()
        assert tip.count() == 0
        page.get_by_label("Footprints (left camera)").check()
        page.get_by_role("button", name="Zoom in").click()
        shown = {text.strip() for text in page.locator("#map .choice label").all_inner_texts()}
        assert {"Stations", "No-go zones", "Survey area", "1 cross line"} <= shown
        assert heard.complaints == []
        assert heard.requests[0] == path.as_uri()
        assert all(url.startswith("data:") for url in heard.requests[1:])
        page.close()


def test_a_plan_without_extras_has_no_layers_for_them() -> None:
    plan = plan_of([line((0.0, 0.0), (3.0, 0.0))], [(0, 0)])
    layers = layers_of(plan)
    assert layers["dive-1-survey"].title == "1 survey line"
    assert not {"contours", "current", "no_go"} & set(layers)


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
    )
    contours = layers_of(plan, bathymetry)["contours"]

    assert isinstance(contours, ShapeLayer)
    depths = [float(text.removesuffix(" m")) for text in contours.texts]
    # 10.2 m from south to north are 1.02 m of depth: steps of 0.2 m.
    assert np.allclose(np.diff(depths), 0.2)
    assert 5 <= len(depths) <= 6
    for depth, shape in zip(depths, contours.shapes, strict=True):
        points = np.array(shape)
        assert points[:, 1] == pytest.approx((depth - 15.0) / 0.1, abs=0.01)
        assert np.ptp(points[:, 0]) > 8.0


def test_all_of_the_area_is_only_what_is_all_of_it() -> None:
    """Of 200,000 cells one is not seen."""
    often = np.full((400, 500), 9)
    often[0, 0] = 0
    seen = replace(
        seen_of(small_plan()), inside=np.full(often.shape, True), pictures=often,
        least_pictures=often, least_lines=often, pairs=often,
    )  # fmt: skip
    values = [row[1] for row in page_module._coverage(seen).rows[:4]]
    assert values == ["99.999 %"] * 4
