"""The pictures tab in Chromium: a spot picked, found again, saved, measured and made control."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from axe_playwright_python.sync_playwright import Axe

from reconstruct.placing.control_file import read_control, read_picks
from tests.alice_survey.kit.browser import Heard, chromium
from tests.alice_survey.studio.client import FOLDED, serving
from tests.alice_survey.studio.test_pictures import Truth

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("chromium")]
WAIT_MS = 60_000


def said(page: Any, start: str) -> None:
    page.wait_for_function(
        "(start) => document.getElementById('status').textContent.startsWith(start)",
        arg=start, timeout=WAIT_MS,
    )  # fmt: skip


def opened(page: Any, server: Any, image: str, x: float, y: float) -> Any:
    """The view of a picture from the list, its pixel in the middle of the first of all views."""
    page.get_by_text("Start from a picture").click()
    page.get_by_label("Find").fill(image)
    page.get_by_role("button", name=image, exact=True).click()
    view = page.locator(".picture-view[data-ready]").first
    view.wait_for(timeout=WAIT_MS)
    box, wide = view.bounding_box(), 564
    scale = box["width"] / wide  # the whole picture is in the view
    view.click(position={
        "x": box["width"] / 2 + (x - wide / 2) * scale,
        "y": box["height"] / 2 + (y - 225.5) * scale,
    })  # fmt: skip
    page.wait_for_function(
        "() => document.querySelectorAll('.picture-view[data-ready]').length > 4", timeout=WAIT_MS
    )
    page.get_by_text("Start from a picture").click()
    return view


def moved_to(page: Any, view: Any, x: float, y: float) -> tuple[float, float]:
    """Move a pick by the keys to a tenth of a pixel of where it is meant."""
    view.focus()
    for axis, (less, more) in (("x", ("ArrowLeft", "ArrowRight")), ("y", ("ArrowUp", "ArrowDown"))):
        off = {"x": x, "y": y}[axis] - float(view.get_attribute(f"data-{axis}"))
        key = more if off > 0 else less
        for _ in range(int(abs(off))):
            page.keyboard.press(key)
        for _ in range(round(10 * (abs(off) % 1))):
            page.keyboard.press(f"Shift+{key}")
    return float(view.get_attribute("data-x")), float(view.get_attribute("data-y"))


def test_points_are_picked_measured_and_made_control(small_survey: Path, tmp_path: Path) -> None:
    workspace = tmp_path / "survey"
    shutil.copytree(small_survey, workspace)
    truth, rng = Truth(workspace), np.random.default_rng(21)
    places = [p for p in truth.places(rng, 12) if truth.nearest(p) is not None]
    places = sorted(places, key=lambda p: float(np.abs(p[:2] - [0.6, 0.45]).max()))[:3]
    with serving(workspace) as server, chromium() as browser:
        page = browser.new_page(viewport={"width": 1280, "height": 900}, reduced_motion="reduce")
        heard = Heard()
        heard.listen(page)
        page.add_init_script(FOLDED)
        page.goto(f"{server.url.split('?')[0]}?token={server.studio.token}#pictures")
        page.wait_for_selector("body[data-ready]", timeout=WAIT_MS)
        marked = []
        for number, place in enumerate(places):
            found = truth.nearest(place)
            assert found is not None
            image, pixel = found
            view = opened(page, server, image, *(pixel - 0.5))
            marked.append((image, *moved_to(page, view, *(pixel - 0.5))))
            np.testing.assert_allclose(marked[-1][1:], pixel - 0.5, atol=0.06)
            page.get_by_label("Sigma of a pick by eye, px").fill("0.05")
            page.keyboard.press("Tab")
            view.focus()
            page.keyboard.press("Shift+ArrowLeft")
            page.keyboard.press("Shift+ArrowRight")
            page.get_by_role("button", name="Find it in all others").click()
            said(page, "Found in")
            page.get_by_text("found, sigma").nth(2).wait_for(timeout=WAIT_MS)
            page.get_by_label("Name of the point").fill(f"spot {number}")
            page.get_by_role("button", name="Save the point").click()
            said(page, "Saved spot")
            page.get_by_role("button", name="Back to the map").click()
        stored = read_picks(workspace / "picks.csv")
        for number, (image, x, y) in enumerate(marked):
            mine = [p for p in stored if p.point == f"spot {number}"]
            assert len(mine) > 3
            hand = next(p for p in mine if not p.matched_to)
            assert (hand.image, hand.sigma_px) == (image, 0.05)
            np.testing.assert_allclose([hand.x_px - 0.5, hand.y_px - 0.5], [x, y], atol=1e-3)
            assert {p.matched_to for p in mine} == {"", image}

        for pair in ((0, 1), (1, 2), (0, 2)):
            for number in range(3):
                page.get_by_label(f"spot {number}", exact=True).uncheck()
            for number in pair:
                page.get_by_label(f"spot {number}", exact=True).check()
            page.wait_for_function(
                "(words) => document.querySelector('[data-value]')?.textContent.includes(words)",
                arg=f"spot {pair[0]} to spot {pair[1]}", timeout=WAIT_MS,
            )  # fmt: skip
            shown = page.locator("[data-value]")
            true = np.linalg.norm(places[pair[0]] - places[pair[1]])
            off = float(shown.get_attribute("data-value")) - true
            assert abs(off) < 4.0 * float(shown.get_attribute("data-sigma")) < 0.004

        page.get_by_text("Add a known point or length").click()
        for label, value in (("North, m", "0.5"), ("East, m", "0.4"), ("Depth, m", "12")):
            page.get_by_label(label).fill(value)
        page.get_by_role("button", name="Save to control.csv").click()
        said(page, "Saved to control.csv")
        known = read_control(workspace / "control.csv").points[0]
        assert (known.name, known.north_m, known.use) == ("spot 0", 0.5, "control")
        far_off = page.locator("#panel-pictures").get_by_text("sigmas")  # in words too
        assert far_off.count() == 1
        assert page.locator("#status.error").count() == 0
        assert Axe().run(page).response["violations"] == []
        page.get_by_role("button", name="Open spot 1").click()
        page.wait_for_selector(".picture-view[data-ready]", timeout=WAIT_MS)
        assert Axe().run(page).response["violations"] == []
        page.set_viewport_size({"width": 400, "height": 800})
        page.wait_for_timeout(300)
        assert page.evaluate("document.documentElement.scrollWidth") <= 400
        assert Axe().run(page).response["violations"] == []
        page.set_viewport_size({"width": 1280, "height": 900})
        page.get_by_role("button", name="Delete spot 2").click()
        said(page, "Took spot 2")
        assert {p.point for p in read_picks(workspace / "picks.csv")} == {"spot 0", "spot 1"}
        assert heard.complaints == []
        page.close()
