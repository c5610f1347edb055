"""Whole journeys through the studio, from an empty folder to a result."""

import csv
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from axe_playwright_python.sync_playwright import Axe
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tests.alice_survey.kit.browser import Heard, chromium
from tests.alice_survey.studio.client import FOLDED, serving
from tests.alice_survey.studio.test_model_browser import click, kept
from tests.alice_survey.studio.test_model_browser import named as figures
from tests.alice_survey.studio.test_pictures_browser import moved_to, said
from tests.alice_survey.studio.test_plan_browser import PlanPage
from tests.docs import given_divers as dive

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("chromium")]
WIDE, NARROW = {"width": 1280, "height": 900}, {"width": 400, "height": 850}
LONG_MS = 400_000
WAIT_MS = 60_000


@pytest.fixture
def journey(request: pytest.FixtureRequest) -> Iterator[tuple[Any, Heard]]:
    """A page, 1280 px wide unless a test says otherwise, and what it complains about."""
    size = getattr(request, "param", WIDE)
    with chromium() as browser:
        page = browser.new_page(viewport=size, reduced_motion="reduce")
        page.set_default_timeout(WAIT_MS)
        heard = Heard()
        heard.listen(page)
        page.add_init_script(FOLDED)
        yield page, heard
        page.close()


def button(page: Any, name: str) -> Any:
    return page.get_by_role("button", name=name, exact=True)


def made(page: Any, stage: str) -> None:
    """Wait until a stage is made."""
    page.wait_for_selector(f"[data-stage={stage}][data-state='up to date']", timeout=LONG_MS)


def is_accessible(page: Any) -> None:
    """No violations that axe knows, and nothing wider than the screen."""
    found = Axe().run(page, options={"resultTypes": ["violations"]}).response["violations"]
    assert [(one["id"], one["nodes"][0]["target"]) for one in found] == []
    width = page.viewport_size["width"]
    assert page.evaluate("document.documentElement.scrollWidth") <= width


@pytest.mark.parametrize("journey", [WIDE, NARROW], indirect=True, ids=["1280", "400"])
def test_a_survey_is_drawn_saved_and_flown(journey: tuple[Any, Heard], tmp_path: Path) -> None:
    page, heard = journey
    reef = tmp_path / "reef"
    with serving(reef) as server:
        page.goto(server.address)
        button(page, "Plan a survey").click()
        page.get_by_label("Latitude, degrees").fill("43.05")
        page.get_by_label("Longitude, degrees").fill("5.92")
        page.get_by_label("Depth of the sea floor, m").fill("12")
        with page.expect_navigation():
            button(page, "Make the survey").click()
        page.wait_for_selector("#panel-plan[data-read]", timeout=WAIT_MS)
        plan = PlanPage(page=page, heard=heard)
        plan.page.wait_for_timeout(500)
        page.get_by_role("button", name=re.compile("^Delete")).first.click()
        page.wait_for_timeout(500)
        plan.draw("Survey area", ((2.0, 2.0), (2.0, 5.0), (4.5, 5.0), (4.5, 2.0)))
        is_accessible(page)
        button(page, "Save").click()
        page.wait_for_function(
            "() => document.getElementById('status').textContent.startsWith('Saved')",
            timeout=WAIT_MS,
        )
        page.get_by_role("tab", name="Run").click()
        made(page, "plan")
        page.get_by_label("Start: Fly the plan").click()
        made(page, "fly")
        is_accessible(page)
        assert heard.complaints == []
    with (reef / "flight" / "triggers.csv").open(newline="") as rows:
        assert len(list(csv.DictReader(rows))) > 10


Point = NDArray[np.float64]


def pose(frame: int) -> tuple[Point, Rotation]:
    """Where a frame of the dive was taken."""
    angles = [6 * np.sin(frame / 5), 7 * np.cos(frame / 7), 4 * np.sin(frame / 9)]
    return dive._path()[frame], Rotation.from_euler("xyz", angles, degrees=True)


def floor(x: float, y: float) -> Point:
    """A point of the floor."""
    return np.array([x, y, -float(dive._relief_m(np.array(x), np.array(y)))])


def seen(frame: int, point: Point) -> Point:
    """Pixel at which a frame shows a point, as viewers count."""
    place, turn = pose(frame)
    ray = turn.inv().apply(point - place)
    middle = np.array([dive.WIDTH / 2, dive.HEIGHT / 2])
    return middle + dive.FOCAL_PX * ray[:2] / ray[2] - 0.5


def card(folder: Path) -> list[int]:
    """A diver's pictures without any calibration; the frames that they are."""
    rng = np.random.default_rng(7)
    side = round(dive._SIDE_M * dive._SHEET_PX_M)
    sheet = dive.grains(rng, (side, side))
    frames = list(range(0, len(dive._path()), 2))
    folder.mkdir()
    for frame in frames:
        place, turn = pose(frame)
        cv2.imwrite(str(folder / f"P{frame:04d}.png"), dive._seen(sheet, place, turn))
    return frames


def pick(page: Any, name: str, frames: list[int], point: Point, images: list[str]) -> None:
    """Pick a point of the floor in the picture that shows it nearest its middle, and save it."""
    half = np.array([dive.WIDTH, dive.HEIGHT]) / 2
    at = min(frames, key=lambda frame: float(np.abs(seen(frame, point) - half).max()))
    image, (x, y) = images[frames.index(at)], seen(at, point)
    page.get_by_text("Start from a picture").click()
    page.get_by_label("Find").fill(image)
    button(page, image).click()
    view = page.locator(".picture-view[data-ready]").first
    view.wait_for(timeout=WAIT_MS)
    box = view.bounding_box()
    scale = min(box["width"] / dive.WIDTH, box["height"] / dive.HEIGHT)
    off = (np.array([x, y]) + 0.5 - half) * scale
    view.click(position={"x": box["width"] / 2 + off[0], "y": box["height"] / 2 + off[1]})
    page.wait_for_function(
        "() => document.querySelectorAll('.picture-view[data-ready]').length > 3", timeout=WAIT_MS
    )
    page.get_by_text("Start from a picture").click()
    moved_to(page, view, x, y)
    page.get_by_label("Sigma of a pick by eye, px").fill("0.05")
    page.keyboard.press("Tab")
    view.focus()
    page.keyboard.press("Shift+ArrowLeft")
    page.keyboard.press("Shift+ArrowRight")
    button(page, "Find it in all others").click()
    said(page, "Found in")
    page.get_by_label("Name of the point").fill(name)
    button(page, "Save the point").click()
    said(page, f"Saved {name}")
    button(page, "Back to the map").click()


def test_a_divers_folder_becomes_a_scaled_model_with_a_measured_coral(
    journey: tuple[Any, Heard], tmp_path: Path
) -> None:
    page, heard = journey
    frames = card(tmp_path / "card")
    workspace = tmp_path / "dive"
    bar = [floor(0.5, 0.2), floor(1.7, 0.9)]
    coral = [floor(0.8, 0.9), floor(1.5, 0.3)]
    with serving(workspace) as server:
        page.goto(server.address)
        button(page, "I have pictures").click()
        page.get_by_label("Folder of the pictures").fill(str(tmp_path / "card"))
        button(page, "Look into it").click()
        page.get_by_text(f"Found: {len(frames)} pictures").wait_for()
        button(page, "Import them").click()
        page.get_by_role("heading", name="Import pictures: done").wait_for(timeout=LONG_MS)
        button(page, "Reconstruct the sea floor").click()
        made(page, "mesh")

        with (workspace / "images" / "manifest.csv").open(newline="") as rows:
            images = sorted(row["image"] for row in csv.DictReader(rows))
        page.get_by_role("tab", name="Pictures").click()
        for number, point in enumerate((*bar, *coral)):
            pick(page, f"end {number}", frames, point, images)
        for number in range(2):
            page.get_by_label(f"end {number}", exact=True).check()
        true = float(np.linalg.norm(bar[1] - bar[0]))
        page.get_by_label("Its true length, m").fill(f"{true:.6f}")
        button(page, "Set the scale").click()
        page.locator("#status", has_text="reconstruct").wait_for()
        assert (workspace / "scale.json").is_file()
        page.get_by_role("tab", name="Run").click()
        page.wait_for_selector("[data-stage=placing]:not([data-state='up to date'])")
        button(page, "Reconstruct the sea floor").click()
        made(page, "mesh")

        page.set_viewport_size(NARROW)
        page.reload()
        page.get_by_role("tab", name="Pictures").click()
        true = float(np.linalg.norm(coral[1] - coral[0]))
        for size in (NARROW, WIDE):
            page.set_viewport_size(size)
            for number in (2, 3):
                page.get_by_label(f"end {number}", exact=True).check()
            page.wait_for_selector("[data-value]", timeout=WAIT_MS)
            is_accessible(page)
        shown = page.locator("[data-value]")
        off = float(shown.get_attribute("data-value")) - true
        assert abs(off) < 4.0 * float(shown.get_attribute("data-sigma"))
        assert abs(off) < 0.01 * true

        page.get_by_role("tab", name="Model").click()
        for number, size in enumerate((NARROW, WIDE), start=1):
            page.set_viewport_size(size)
            measured_coral(page, number)
            is_accessible(page)
        assert heard.complaints == []


def measured_coral(page: Any, number: int) -> None:
    """Measure a triangle in the middle of the map, and look at its figures."""
    page.wait_for_timeout(1500)
    box = page.locator("#map-canvas")
    box.scroll_into_view_if_needed()
    east, north = (float(box.get_attribute(f"data-{axis}")) for axis in ("east", "north"))
    corners = [(east - 0.2, north - 0.15), (east + 0.2, north - 0.15), (east, north + 0.2)]
    button(page, "Area").click()
    click(page, *corners)
    button(page, "Finish").click()
    page.wait_for_selector(f"tr[data-measure='{number}']")
    measure = kept(page)[-1]
    places = np.array(measure["places"])
    (a, b), (c, d) = places[1:] - places[0]
    plan = 0.5 * abs(a * d - b * c)
    found = figures(measure)
    assert found["plan_area"]["value"] == pytest.approx(plan, rel=0.01)
    assert found["plan_area"]["value"] < found["surface_area"]["value"] < 2.0 * plan
    assert 0 < found["surface_area"]["sigma"] < 0.1 * plan
