"""The report's page in Chromium, on a desk and on a phone."""

import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from alice_survey.kit.document import Report
from alice_survey.kit.page import render_html
from tests.alice_survey.kit.browser import Heard, chromium, is_accessible
from tests.alice_survey.kit.sketch import RUDE, sketch_report

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("chromium")]
SIZES = {"desk": (1280, 900), "phone": (400, 800)}
MAP, MESH = "#map-canvas", "#mesh-canvas"
RESTS = "() => !document.querySelector('.leaflet-zoom-anim, .leaflet-pan-anim')"
A4_PX = round(180 / 25.4 * 96)
"""Between the margins of the printed page."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as started:
        yield started


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Report:
    return sketch_report(tmp_path_factory.mktemp("sketch"))


@pytest.fixture(scope="module")
def file(report: Report, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_text(render_html(report), encoding="utf-8")
    return path


@pytest.fixture(scope="module", params=SIZES)
def opened(browser: Any, file: Path, request: pytest.FixtureRequest) -> Iterator[tuple[Any, Heard]]:
    """The page at one size, its map and its mesh ready; tests share it and put it back."""
    width, height = SIZES[request.param]
    motion = "reduce" if request.param == "phone" else "no-preference"
    page = browser.new_page(viewport={"width": width, "height": height}, reduced_motion=motion)
    heard = Heard()
    heard.listen(page)
    page.goto(file.as_uri())
    page.wait_for_selector("#map[data-ready]", state="attached")
    page.locator("#mesh").scroll_into_view_if_needed()
    page.wait_for_selector("#mesh[data-ready]", state="attached")
    page.wait_for_selector(f"{MESH}[data-azimuth]", state="attached")
    page.home = data(page, MAP, "zoom")
    yield page, heard
    page.close()


@pytest.fixture
def page(opened: tuple[Any, Heard]) -> Any:
    """As just opened, but for what has the focus."""
    held = opened[0]
    held.get_by_role("button", name="Show all").click()
    held.get_by_role("button", name="Reset the view").click()
    held.evaluate("document.activeElement.blur()")
    held.wait_for_function(
        "([selector, home]) => Number(document.querySelector(selector).dataset.zoom) === home",
        arg=[MAP, held.home],
    )
    held.wait_for_function(RESTS)
    return held


def data(page: Any, selector: str, name: str) -> float:
    return float(page.locator(selector).get_attribute(f"data-{name}"))


def settled(page: Any, selector: str, name: str, before: float) -> float:
    """The value once it has changed."""
    page.wait_for_function(
        "([selector, name, before]) => "
        "Number(document.querySelector(selector).dataset[name]) !== before",
        arg=[selector, name, before],
    )
    page.wait_for_function(RESTS)
    return data(page, selector, name)


def picture_of(page: Any, selector: str) -> np.ndarray:
    page.wait_for_timeout(150)
    with Image.open(io.BytesIO(page.locator(selector).screenshot())) as shot:
        return np.asarray(shot.convert("RGB"), dtype=float)


def point_at(page: Any, selector: str) -> tuple[float, float]:
    """Bring it into view, with the pointer near its middle."""
    page.locator(selector).scroll_into_view_if_needed()
    box = page.locator(selector).bounding_box()
    x, y = box["x"] + 0.45 * box["width"], box["y"] + 0.55 * box["height"]
    page.mouse.move(x, y)
    return x, y


def drag(page: Any, selector: str, right: int, down: int) -> None:
    x, y = point_at(page, selector)
    page.mouse.down()
    page.mouse.move(x + right / 2, y + down / 2, steps=4)
    page.mouse.move(x + right, y + down, steps=4)
    page.wait_for_timeout(80)
    page.mouse.up()


def place_on_page(page: Any, east_m: float, north_m: float) -> tuple[float, float]:
    """Where a place on the map is on the screen, from what the map says of itself."""
    page.locator(MAP).scroll_into_view_if_needed()
    box = page.locator(MAP).bounding_box()
    px_per_m = 2 ** data(page, MAP, "zoom")
    x = box["x"] + box["width"] / 2 + (east_m - data(page, MAP, "east")) * px_per_m
    y = box["y"] + box["height"] / 2 - (north_m - data(page, MAP, "north")) * px_per_m
    return x, y


def test_map_pans(page: Any) -> None:
    east, north = data(page, MAP, "east"), data(page, MAP, "north")
    px_per_m = 2 ** data(page, MAP, "zoom")
    drag(page, MAP, -60, 40)
    assert settled(page, MAP, "east", east) == pytest.approx(east + 60 / px_per_m, abs=0.03)
    assert data(page, MAP, "north") == pytest.approx(north + 40 / px_per_m, abs=0.03)

    east = data(page, MAP, "east")
    page.locator(MAP).focus()
    page.keyboard.press("ArrowRight")
    assert settled(page, MAP, "east", east) > east
    north = data(page, MAP, "north")
    page.keyboard.press("ArrowUp")
    assert settled(page, MAP, "north", north) > north


def test_mosaic_zooms(page: Any) -> None:
    level, zoom = data(page, MAP, "level"), data(page, MAP, "zoom")
    point_at(page, MAP)
    page.locator(MAP).focus()
    page.mouse.wheel(0, -400)
    finer = settled(page, MAP, "zoom", zoom)
    assert finer > zoom
    page.keyboard.press("+")
    assert settled(page, MAP, "zoom", finer) > finer
    before = data(page, MAP, "zoom")
    page.keyboard.press("+")
    assert settled(page, MAP, "zoom", before) > before
    assert data(page, MAP, "level") > level
    tiles = page.evaluate(
        "[...document.querySelectorAll('#map-canvas img.leaflet-image-layer')]"
        ".map((tile) => [tile.complete && tile.naturalWidth, tile.classList.contains('crisp')])"
    )
    assert tiles
    assert all(width > 0 for width, _ in tiles)
    before = data(page, MAP, "zoom")
    page.get_by_role("button", name="Zoom out").click()
    assert settled(page, MAP, "zoom", before) == before - 1
    page.keyboard.press("Tab")


def test_place_under_the_pointer(page: Any) -> None:
    page.mouse.move(*place_on_page(page, 1.0, 0.5))
    east, north = (
        float(value.replace("−", "-"))
        for value in re.findall(r"[−\d.]+(?= m)", page.locator("#map-readout").inner_text())
    )
    assert (east, north) == pytest.approx((1.0, 0.5), abs=0.02)


def test_popups(page: Any) -> None:
    page.mouse.click(*place_on_page(page, 0.6, -0.533))
    popup = page.locator(".leaflet-popup-content")
    lines = popup.inner_text().split("\n")
    assert lines[0] == "Check points"
    assert lines[-1] == "Point A: 1.2 mm east, 0.4 mm north, 2.2 mm up"
    page.keyboard.press("Escape")
    popup.wait_for(state="detached")

    page.mouse.click(*place_on_page(page, -1.2, 1.0))
    assert RUDE in page.locator(".leaflet-popup-content").inner_text()
    assert page.locator(".leaflet-popup-content img").count() == 0
    page.keyboard.press("Escape")


def test_mesh_is_drawn_and_turns(page: Any) -> None:
    page.locator(MESH).scroll_into_view_if_needed()
    first = picture_of(page, MESH)
    assert first.std() > 15
    azimuth, above = data(page, MESH, "azimuth"), data(page, MESH, "above")
    drag(page, MESH, 80, 30)
    turned = settled(page, MESH, "azimuth", azimuth)
    assert data(page, MESH, "above") > above
    assert np.abs(picture_of(page, MESH) - first).mean() > 3

    page.locator(MESH).focus()
    page.keyboard.press("ArrowRight")
    assert settled(page, MESH, "azimuth", turned) == pytest.approx((turned - 7.5) % 360, abs=0.01)
    above = data(page, MESH, "above")
    page.keyboard.press("ArrowDown")
    assert settled(page, MESH, "above", above) == pytest.approx(above - 7.5, abs=0.01)
    distance = data(page, MESH, "distance")
    page.keyboard.press("+")
    assert settled(page, MESH, "distance", distance) == pytest.approx(distance / 1.2, rel=1e-4)


def test_no_fault_that_axe_finds(page: Any) -> None:
    page.mouse.click(*place_on_page(page, 0.6, -0.533))  # with a popup open
    is_accessible(page)
    page.keyboard.press("Escape")


def test_paper_shows_all(page: Any) -> None:
    size = page.viewport_size
    page.set_viewport_size({"width": A4_PX, "height": 1000})
    page.emulate_media(media="print")
    over, stills, moving = page.evaluate(
        """(width) => [[...document.querySelectorAll("body *")]
          .filter((e) => e.checkVisibility() && !e.closest("svg > *, .skip"))
          .filter((e) => e.getBoundingClientRect().right > width + 0.5
            || (getComputedStyle(e).overflowX !== "visible" && e.scrollWidth > e.clientWidth + 1))
          .map((e) => e.outerHTML.slice(0, 120)),
          [...document.querySelectorAll(".still img")]
          .map((e) => e.checkVisibility() && e.getBoundingClientRect().height),
          [...document.querySelectorAll(".live, nav")].some((e) => e.checkVisibility())]""",
        A4_PX,
    )
    page.emulate_media(media="screen")
    page.set_viewport_size(size)
    assert (over, moving, len(stills)) == ([], False, 2)
    assert min(stills) > 200


def test_no_complaint_and_no_network(opened: tuple[Any, Heard], file: Path) -> None:
    """Last of its size: after all that the tests above did."""
    page, heard = opened
    page.evaluate("scrollTo({top: document.body.scrollHeight, behavior: 'instant'})")
    page.wait_for_timeout(100)
    assert heard.complaints == []
    assert heard.requests[0] == file.as_uri()
    assert {url.partition(":")[0] for url in heard.requests[1:]} <= {"data", "blob"}


def test_without_webgl_a_still(browser: Any, file: Path) -> None:
    page = browser.new_page()
    page.add_init_script("HTMLCanvasElement.prototype.getContext = new Proxy("
        "HTMLCanvasElement.prototype.getContext, {apply: (f, self, args) => "
        "/webgl/.test(args[0]) ? null : Reflect.apply(f, self, args)});")  # fmt: skip
    heard = Heard()
    heard.listen(page)
    page.goto(file.as_uri())
    assert page.locator(".mesh .still img").is_visible()
    assert "no WebGL" in page.locator("#mesh-note").inner_text()
    assert not page.locator("#mesh").is_visible()
    assert heard.complaints == []
    page.close()
