"""The Annotate and Compare tabs in Chromium, by pointer and by keyboard."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
import rasterio
from axe_playwright_python.sync_playwright import Axe

from tests.alice_survey.app.report.tiny import tiny_workspace
from tests.alice_survey.app.studio.client import (
    FOLDED,
    ask,
    looks_at,
    move_map,
    serving,
    still,
    until,
)
from tests.alice_survey.kit.browser import Heard, chromium

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("chromium")]
MAP = "#map-canvas"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tiny_workspace(tmp_path / "reef")


def opened(browser: Any, server: Any, tab: str, width: int = 1280) -> tuple[Any, Heard]:
    page = browser.new_page(
        viewport={"width": width, "height": 900}, reduced_motion="reduce", accept_downloads=True
    )
    page.set_default_timeout(60_000)
    heard = Heard()
    heard.listen(page)
    page.add_init_script(FOLDED)
    page.goto(server.address)
    page.wait_for_selector("body[data-ready]")
    page.get_by_role("tab", name=tab, exact=True).click()
    still(lambda: looks_at(page))
    return page, heard


def add_label(page: Any, name: str) -> None:
    if not page.get_by_label("Name", exact=True).is_visible():
        page.get_by_text("Add a label", exact=True).click()
    page.get_by_label("Name", exact=True).fill(name)
    page.get_by_role("button", name="Add the label").click()
    page.get_by_role("radio", name=name).wait_for()


def click(page: Any, x: float, y: float) -> None:
    box = page.locator(MAP).bounding_box()
    page.mouse.click(box["x"] + box["width"] * x, box["y"] + box["height"] * y)


Stored = list[dict[str, Any]]


def stored(folder: Path, holds: Callable[[Stored], object] = bool) -> Stored:
    """The annotations in the file, once what is expected of them holds: pages show them before."""
    file = folder / "annotations.json"

    def found() -> Stored | None:
        annotations: Stored = json.loads(file.read_text())["annotations"] if file.is_file() else []
        return annotations if holds(annotations) else None

    return until(found)


def other_than(one: dict[str, Any]) -> Callable[[Stored], bool]:
    return lambda found: found[0]["shape"] != one["shape"]


def same_as(one: dict[str, Any]) -> Callable[[Stored], bool]:
    return lambda found: found[0]["shape"] == one["shape"]


def accessible(page: Any) -> None:
    found = Axe().run(page)
    assert found.violations_count == 0, found.generate_report()


def test_a_polygon_is_drawn_edited_taken_back_and_exported(folder: Path) -> None:
    with serving(folder) as server, chromium() as browser:
        page, heard = opened(browser, server, "Annotate")
        add_label(page, "Porifera > Axinella")
        page.get_by_role("button", name="Polygon", exact=True).click()
        for x, y in ((0.4, 0.4), (0.6, 0.4), (0.6, 0.6), (0.4, 0.6)):
            click(page, x, y)
        page.get_by_role("button", name="Finish", exact=True).click()
        page.get_by_text("1 annotation", exact=True).wait_for()
        page.get_by_role("button", name="Polygon", exact=True).click()  # puts the tool down
        (one,) = stored(folder)
        assert one["label"] == "Porifera > Axinella" and len(one["shape"]["points"]) == 4

        page.get_by_role("row", name="Rugosity").first.wait_for()  # all is measured
        vertex = page.get_by_role("button", name="Corner 1 of 4")
        vertex.focus()
        page.keyboard.press("Shift+ArrowLeft")
        (moved,) = stored(folder, other_than(one))
        pixel = 2.0 ** -float(page.locator(MAP).get_attribute("data-zoom"))
        shift = one["shape"]["points"][0][0] - moved["shape"]["points"][0][0]
        assert pixel / 2.5 < shift < 1.01 * max(pixel, 0.001)
        assert moved["shape"]["points"][1:] == one["shape"]["points"][1:]
        page.get_by_role("button", name="Undo", exact=True).click()
        stored(folder, same_as(one))

        page.get_by_text("Files of other tools").click()
        with page.expect_download() as downloading:
            page.get_by_role("button", name="COCO").click()
        coco = json.loads(Path(downloading.value.path()).read_text())
        assert coco["categories"][0]["name"] == "Axinella"
        assert coco["annotations"][0]["area"] == pytest.approx(
            shoelace(one["shape"]["points"]) / 0.002**2, rel=1e-6
        )
        page.get_by_role("button", name="Delete", exact=True).click()
        page.get_by_text("Nothing is annotated yet.").wait_for()
        page.get_by_label("Tool", exact=True).select_option("coco")
        page.locator("#panel-annotate").get_by_label("File", exact=True).set_input_files(
            downloading.value.path()
        )
        page.get_by_role("button", name="Import").click()
        page.get_by_text("1 annotations and 0 labels added").wait_for()
        np.testing.assert_allclose(
            stored(folder)[0]["shape"]["points"], one["shape"]["points"], atol=1e-9
        )
        accessible(page)
        assert heard.complaints == []
        page.close()


def shoelace(points: list[list[float]]) -> float:
    pairs = zip(points, points[1:] + points[:1], strict=True)
    return 0.5 * abs(sum(a[0] * b[1] - b[0] * a[1] for a, b in pairs))


def test_points_are_set_by_the_keyboard_alone_at_400_px(folder: Path) -> None:
    with serving(folder) as server, chromium() as browser:
        page, heard = opened(browser, server, "Annotate", 400)
        add_label(page, "Sepia")
        page.get_by_role("button", name="Point", exact=True).focus()
        page.keyboard.press("Enter")
        page.locator(MAP).focus()
        page.keyboard.press("Enter")
        page.get_by_text("1 annotation", exact=True).wait_for()
        for _ in range(3):
            move_map(page, "ArrowRight")
        page.keyboard.press("Enter")
        page.get_by_text("2 annotations").wait_for()
        page.keyboard.press("Escape")
        first, second = (
            one["shape"]["points"][0] for one in stored(folder, lambda found: len(found) > 1)
        )
        assert second[0] - first[0] > 0.05
        assert second[1] == pytest.approx(first[1], abs=0.1)
        assert page.evaluate("document.documentElement.scrollWidth") <= 400
        accessible(page)
        assert heard.complaints == []
        page.close()


@pytest.mark.parametrize("width", [1280, 400])
def test_a_colony_is_drawn_in_a_picture(width: int, small_survey: Path, tmp_path: Path) -> None:
    """Clicks beside the middle of a view, four of the screen's pixels to one of the picture's."""
    folder = tmp_path / "survey"
    shutil.copytree(small_survey, folder)
    clicked = np.array([[0, 0], [80, 0], [40, 60]])
    with serving(folder) as server, chromium() as browser:
        page, heard = opened(browser, server, "Annotate", width)
        add_label(page, "Porites")
        file = folder / "annotations.json"
        until(lambda: file.is_file() and "Porites" in file.read_text())
        before = file.read_bytes()
        page.get_by_text("Draw in pictures", exact=True).click()
        with page.expect_request("**/api/pictures/seeing?*") as asking:
            page.get_by_role("button", name="Show the pictures of the map's middle").click()
        asked = parse_qs(urlsplit(asking.value.url).query)
        north, east = (float(asked[axis][0]) for axis in "ne")
        view = page.locator(".picture-view[data-ready]").first
        view.wait_for()
        box = still(view.bounding_box)
        middle = np.array([box["width"], box["height"]]) / 2
        for right, down in clicked:
            view.click(position={"x": middle[0] + right, "y": middle[1] + down})
            page.wait_for_timeout(350)
        page.keyboard.press("Enter")  # once more the middle, and not
        page.keyboard.press("Backspace")
        accessible(page)
        page.screenshot(path=str(tmp_path / f"drawn-{width}.png"))
        page.keyboard.press("f")
        page.locator("#status", has_text="Polygon drawn in").wait_for()
        page.get_by_role("button", name="Back to the map").first.click()
        page.get_by_role("row", name="Rugosity").first.wait_for()
        (one,) = stored(folder)
        seen = ask(server, f"/api/pictures/seeing?n={north}&e={east}&count=1").json["pictures"][0]
        assert one["image"] == seen["name"]
        points = np.array(one["shape"]["points"])
        np.testing.assert_allclose(points - points[0], clicked / 4.0, atol=0.15)
        expected = np.array([seen["x"], seen["y"]]) + 0.5
        np.testing.assert_allclose(points[0], expected, atol=0.3)
        (mark,) = ask(server, "/api/annotations/table").json["marks"]
        corner = np.array(mark["shape"]["points"])[0]
        np.testing.assert_allclose(corner, [east, north], atol=0.5 / seen["resolution"])
        area = 0.5 * 20 * 15 / seen["resolution"] ** 2
        assert mark["area"] == pytest.approx(area, rel=0.15)
        assert 0 < mark["sigma"] < 0.2 * area
        (figures,) = ask(server, "/api/annotations/surfaces").json["each"]
        # of a floor that is nearly level here: 1, less or more by noise
        assert 1.0 - 4 * figures["rugosity_sigma"] < figures["rugosity"] < 1.2
        assert 0 < figures["rugosity_sigma"] < 0.02 and figures["image"] == one["image"]
        assert figures["surface"] == pytest.approx(figures["rugosity"] * mark["area"], rel=0.02)
        assert 0 < figures["surface_sigma"] < 0.2 * area
        page.screenshot(path=str(tmp_path / f"kept-{width}.png"))
        drawn = file.read_bytes()

        page.get_by_role("button", name="Edit in its picture").click()
        corner = page.get_by_role("button", name="Corner 2 of 3")
        corner.wait_for()
        corner.focus()
        page.keyboard.press("ArrowRight")
        (moved,) = stored(folder, other_than(one))
        shift = np.array(moved["shape"]["points"]) - points
        assert 0.1 < shift[1, 0] <= 8.0 and np.abs(shift).sum() == pytest.approx(shift[1, 0])
        page.wait_for_timeout(1200)  # edits of one corner in quick succession are undone as one
        spot = corner.bounding_box()
        page.mouse.move(spot["x"] + 13, spot["y"] + 13)
        page.mouse.down()
        page.mouse.move(spot["x"] + 33, spot["y"] + 33, steps=4)
        page.mouse.up()
        (dragged,) = stored(folder, other_than(moved))
        shift = np.array(dragged["shape"]["points"]) - np.array(moved["shape"]["points"])
        np.testing.assert_allclose(shift[[0, 2]], 0.0)
        assert shift[1, 0] == pytest.approx(shift[1, 1], abs=0.1) and 1.0 < shift[1, 0] < 10.0
        accessible(page)
        page.screenshot(path=str(tmp_path / f"edited-{width}.png"))
        for _ in range(2):
            page.keyboard.press("Control+z")
        until(lambda: file.read_bytes() == drawn)
        corner.focus()
        page.keyboard.press("Escape")  # to the picture
        page.keyboard.press("Escape")  # to the map
        assert page.evaluate("document.activeElement.id") == "map-canvas"
        page.get_by_role("button", name="Undo", exact=True).click()
        page.get_by_text("Nothing is annotated yet.").wait_for()
        until(lambda: file.read_bytes() == before)

        page.locator("#panel-annotate").get_by_label("Shape", exact=True).select_option("point")
        page.get_by_role("button", name="Show the pictures of the map's middle").click()
        view.wait_for()
        still(view.bounding_box)
        with rasterio.open(folder / "dense" / "dem.tif", "r+") as raster:
            raster.write(np.full(raster.shape, np.nan, np.float32), 1)
        view.focus()
        page.keyboard.press("Enter")  # a point in a picture that meets no surface any more
        page.locator("#status", has_text="no known surface").wait_for()
        assert stored(folder)[0]["shape"]["kind"] == "point"
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        accessible(page)
        assert heard.complaints == []
        page.close()


def test_a_second_page_follows_the_first(folder: Path) -> None:
    with serving(folder) as server, chromium() as browser:
        first, _ = opened(browser, server, "Annotate")
        second, heard = opened(browser, server, "Annotate")
        add_label(first, "Sepia")
        second.get_by_role("radio", name="Sepia").wait_for()
        assert heard.complaints == []
        first.close()
        second.close()


@pytest.mark.parametrize("width", [1280, 400])
def test_a_survey_is_compared_with_a_copy_of_itself(folder: Path, width: int) -> None:
    shutil.copytree(folder, folder.parent / "copy")
    with serving(folder) as server, chromium() as browser:
        page, heard = opened(browser, server, "Compare", width)
        page.get_by_label("Next to this one").select_option(label="copy")
        page.get_by_role("button", name="Open", exact=True).click()
        pane = page.locator(".leaflet-compare-pane")
        pane.locator("img").first.wait_for(state="attached")
        swipe = page.get_by_label("Where the two meet, %")
        swipe.focus()
        clips = [pane.evaluate("e => e.style.clip")]
        for _ in range(5):
            page.keyboard.press("ArrowLeft")
        clips.append(pane.evaluate("e => e.style.clip"))
        assert swipe.input_value() == "45" and clips[0] != clips[1]
        left = [float(clip.split(",")[3].removesuffix("px)")) for clip in clips]
        wide = page.locator(MAP).bounding_box()["width"]
        assert left[0] - left[1] == pytest.approx(0.05 * wide, abs=1.5)

        page.get_by_role("radio", name="Side by side").check()
        other = page.get_by_role("application", name="moves with the other")
        other.locator("img").first.wait_for(state="attached")
        assert page.locator(MAP).bounding_box()["width"] == pytest.approx(wide / 2, abs=3)
        accessible(page)
        page.get_by_role("radio", name="This survey alone").check()
        assert page.locator(MAP).bounding_box()["width"] == pytest.approx(wide, abs=1)
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        accessible(page)
        assert heard.complaints == []
        page.close()
