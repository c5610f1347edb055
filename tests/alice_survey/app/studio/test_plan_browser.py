"""The Plan tab in Chromium: a survey is drawn, re-planned, undone, saved and kept from others."""

import io
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from pyproj import Transformer

from alice_survey.core.config import SurveyConfig, load_config
from missions.plan.preview import preview
from tests.alice_survey.app.studio.client import FOLDED, serving
from tests.alice_survey.kit.browser import Heard, chromium, is_accessible

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("chromium")]
AREA = ((2.0, 2.0), (12.0, 2.0), (14.0, 12.0), (3.0, 14.0))


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    preview(SurveyConfig())  # kernels are compiled before a page waits for them
    with chromium() as started:
        yield started


@dataclass
class PlanPage:
    """A page of the studio on its Plan tab, and what a person does there."""

    page: Any
    heard: Heard
    asked: list[Any] = field(default_factory=list)
    """Changes and shapes of each plan that was asked for."""

    def settled(self, after: int = -1) -> int:
        """Wait until a plan later than one is shown and none is on its way; count the plans."""
        self.page.wait_for_function(
            "(after) => Number(document.querySelector('#panel-plan')?.dataset.plans || -1) > after"
            " && !document.querySelector('main[data-planning]')",
            arg=after,
            timeout=60_000,
        )
        return self.plans

    @property
    def plans(self) -> int:
        return int(self.page.locator("#panel-plan").get_attribute("data-plans") or -1)

    def at(self, north: float, east: float) -> tuple[float, float]:
        """Where a place is on the screen."""
        canvas = self.page.locator("#map-canvas")
        canvas.scroll_into_view_if_needed()
        box, scale = canvas.bounding_box(), 2 ** float(canvas.get_attribute("data-zoom"))
        right = (east - float(canvas.get_attribute("data-east"))) * scale
        up = (north - float(canvas.get_attribute("data-north"))) * scale
        return box["x"] + box["width"] / 2 + right, box["y"] + box["height"] / 2 - up

    def draw(self, kind: str, corners: tuple[tuple[float, float], ...]) -> None:
        before = self.plans
        self.page.get_by_role("button", name=kind, exact=True).click()
        for corner in (*corners, corners[0]):
            self.page.mouse.click(*self.at(*corner))
            self.page.wait_for_timeout(350)  # two clicks are no double click
        self.settled(before)

    def corner(self, number: int) -> Any:
        return self.page.locator(".vertex.corner").nth(number)

    def drag(self, handle: Any, right: float, down: float) -> None:
        before = self.plans
        box = handle.bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        self.page.mouse.move(x, y)
        self.page.mouse.down()
        self.page.mouse.move(x + right, y + down, steps=5)
        self.page.mouse.up()
        self.settled(before)

    def press(self, key: str) -> None:
        before = self.plans
        self.page.keyboard.press(key)
        self.settled(before)

    def altitude(self) -> float:
        return float(self.page.get_by_role("spinbutton", name="Altitude").input_value())


def opened(browser: Any, address: str, width: int = 1280) -> PlanPage:
    page = browser.new_page(viewport={"width": width, "height": 800}, reduced_motion="reduce")
    page.set_default_timeout(15_000)
    heard = Heard()
    heard.listen(page)
    plan = PlanPage(page=page, heard=heard)
    page.on("request", lambda request: request.url.endswith("/plan/preview")
            and plan.asked.append(request.post_data_json))  # fmt: skip
    page.add_init_script(FOLDED)
    page.goto(f"{address}#plan")
    page.wait_for_selector("#panel-plan[data-read]")
    return plan


def test_a_survey_is_drawn_changed_and_saved(browser: Any, tmp_path: Path) -> None:
    folder = tmp_path / "reef"
    folder.mkdir()
    with serving(folder) as server:
        plan = opened(browser, server.address, 400)
        page = plan.page
        plan.draw("Survey area", AREA)
        assert page.locator(".plan-list li").count() == 1  # in place of the default rectangle
        assert plan.corner(3).is_visible()
        drawn = plan.asked[-1]

        plan.drag(plan.corner(2), -20, 15)
        assert plan.asked[-1] != drawn
        plan.press("Control+z")
        assert plan.asked[-1] == drawn
        plan.press("Control+Shift+Z")
        assert plan.asked[-1] != drawn
        plan.press("Control+z")

        plan.drag(page.locator(".vertex.middle").first, -10, 0)
        assert page.locator(".vertex.corner").count() == 5
        plan.press("Delete")
        assert page.locator(".vertex.corner").count() == 4
        plan.corner(1).focus()
        plan.press("ArrowUp")
        plan.press("Control+z")
        for _ in range(2):  # what was removed, and what was inserted
            plan.press("Control+z")
        assert plan.asked[-1] == drawn

        before = plan.altitude()
        page.get_by_role("slider", name="Altitude").focus()
        for _ in range(3):
            page.keyboard.press("ArrowRight")
        plan.settled(plan.plans - 1)
        page.wait_for_timeout(400)
        plan.settled()
        raised = plan.altitude()
        assert before < raised < before + 1.0
        assert plan.asked[-1]["changes"]["plan"]["altitude_m"] == raised

        _suggestion(plan)
        _zone_by_keyboard(plan)
        is_accessible(page)
        _save(plan)
        assert {"plan.json", "map.png"} <= {path.name for path in (folder / "plan").iterdir()}
        config = load_config(folder / "survey.toml")
        assert config.plan.altitude_m == plan.altitude()
        assert "As in survey.toml" in page.locator(".plan-top .note").inner_text()
        assert plan.heard.complaints == []
        page.close()


def test_a_base_map_lies_where_pyproj_puts_it(browser: Any, tmp_path: Path) -> None:
    tile = io.BytesIO()
    Image.new("RGB", (256, 256), (30, 160, 90)).save(tile, "PNG")
    with serving(tmp_path) as server:
        plan = opened(browser, server.address)
        page = plan.page
        page.route("https://tiles.example/**", lambda route: route.fulfill(body=tile.getvalue(),
                   content_type="image/png"))  # fmt: skip
        page.get_by_text("Layers", exact=True).click()
        address = page.get_by_label("Address of its tiles")
        address.fill("https://tiles.example/{z}/{x}/{y}.png")
        address.press("Tab")
        tiles = "[...document.querySelectorAll('.leaflet-under-pane img')]"
        page.wait_for_function(
            f"() => {tiles}.length && {tiles}.every((one) => one.complete)", timeout=60_000
        )
        canvas, box, found = page.evaluate(  # at one time: a plan that comes moves the map
            "() => [document.getElementById('map-canvas')].map((one) => [{...one.dataset},"
            f" one.getBoundingClientRect(), {tiles}.map("
            "(tile) => [tile.src, tile.getBoundingClientRect()])])[0]"
        )
        middle = np.array([float(canvas["east"]), float(canvas["north"])])
        on_screen = np.array([box["x"] + box["width"] / 2, box["y"] + box["height"] / 2])
        area = SurveyConfig().area
        local = f"+proj=aeqd +lat_0={area.latitude_deg} +lon_0={area.longitude_deg} +ellps=WGS84"
        to_local = Transformer.from_crs("EPSG:3857", local, always_xy=True)
        for source, shown in found:
            z, x, y = map(int, source.removesuffix(".png").split("/")[-3:])
            side = 2 * np.pi * 6378137 / 2**z
            corner = to_local.transform(x * side - np.pi * 6378137, np.pi * 6378137 - y * side)
            away = (np.array(corner) - middle) * 2 ** float(canvas["zoom"]) * [1, -1]
            assert on_screen + away == pytest.approx([shown["x"], shown["y"]], abs=1.5)
        assert 4 <= len(found) < 200
        address.fill("")
        address.press("Tab")
        assert page.locator(".leaflet-under-pane img").count() == 0
        is_accessible(page)
        assert plan.heard.complaints == []
        page.close()


def _suggestion(plan: PlanPage) -> None:
    """A speed that thrusters do not allow is refused, and the suggested one leads to a plan."""
    page, before = plan.page, plan.plans
    box = page.get_by_role("spinbutton", name="Speed").first
    box.fill("3")
    box.press("Tab")
    plan.settled(before)
    assert page.get_by_text("No plan:").first.is_visible()
    before = plan.plans
    page.locator(".plan-ways button").click()
    plan.settled(before)
    assert not page.locator(".plan-ways button").is_visible()
    assert 1 <= plan.asked[-1]["changes"]["plan"]["speed_mps"] < 3


def _zone_by_keyboard(plan: PlanPage) -> None:
    page, before = plan.page, plan.plans
    shapes = page.locator(".plan-list li").count()
    page.get_by_role("button", name="No-go zone", exact=True).focus()
    page.keyboard.press("Enter")
    canvas = page.locator("#map-canvas")
    for key, axis in (("ArrowRight", "east"), ("ArrowUp", "north"), ("ArrowLeft", "east")):
        page.keyboard.press("Enter")
        stood = canvas.get_attribute(f"data-{axis}")
        page.keyboard.press(key)
        page.wait_for_function(
            "([axis, stood]) => document.getElementById('map-canvas').dataset[axis] !== stood"
            " && !document.querySelector('.leaflet-pan-anim')",
            arg=[axis, stood],
        )
    page.keyboard.press("f")
    plan.settled(before)
    assert page.locator(".plan-list li").count() == shapes + 1
    assert canvas.get_attribute("data-tool") is None


def _save(plan: PlanPage) -> None:
    plan.page.get_by_role("button", name="Save", exact=True).click()
    plan.page.wait_for_function(
        "() => document.getElementById('status').textContent.startsWith('Saved')", timeout=60_000
    )


def test_two_pages_do_not_overwrite_each_other(browser: Any, tmp_path: Path) -> None:
    with serving(tmp_path) as server:
        one, other = opened(browser, server.address), opened(browser, server.address)
        other.draw("Survey area", AREA)
        speed = other.page.get_by_role("spinbutton", name="Speed").first
        before = other.plans
        speed.fill("0.25")
        speed.press("Tab")
        other.settled(before)
        one.draw("Survey area", AREA)
        _save(one)
        theirs = (tmp_path / "survey.toml").read_text(encoding="utf-8")

        other.page.get_by_role("button", name="Save", exact=True).click()
        refused = other.page.get_by_role("dialog")
        refused.wait_for()
        assert (tmp_path / "survey.toml").read_text(encoding="utf-8") == theirs
        is_accessible(other.page)
        before = other.plans
        refused.get_by_role("button", name="Keep mine on top of theirs").click()
        other.settled(before)
        assert other.asked[-1]["changes"]["plan"]["speed_mps"] == 0.25
        _save(other)
        both = load_config(tmp_path / "survey.toml")
        assert both.plan.speed_mps == 0.25
        assert "speed_mps = 0.25" not in theirs

        assert [text for text in other.heard.complaints if "409" not in text] == []
        assert one.heard.complaints == []
        _leaving_is_asked(one)


def _leaving_is_asked(plan: PlanPage) -> None:
    before = plan.plans
    slider = plan.page.get_by_role("slider", name="Altitude")
    slider.focus()
    plan.page.keyboard.press("ArrowRight")
    plan.settled(before)
    asked: list[str] = []
    plan.page.on("dialog", lambda dialog: (asked.append(dialog.type), dialog.accept()))
    plan.page.reload()
    assert asked == ["beforeunload"]
