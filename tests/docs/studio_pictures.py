"""Make the pictures of `docs/studio.md` again, from a reconstructed workspace.

    python -m tests.docs.studio_pictures WORKSPACE

The workspace is copied first: nothing in it changes.
"""

import argparse
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from tests.alice_survey.app.studio.client import serving
from tests.alice_survey.app.studio.journey_page import begun_page, button
from tests.alice_survey.app.studio.test_follow_browser import SimulatedDive
from tests.alice_survey.app.studio.test_model_browser import click
from tests.alice_survey.kit.browser import chromium
from tests.docs.pages import DOCS
from tests.missions.follow.dives import text_of

WIDE, NARROW = {"width": 1280, "height": 800}, {"width": 400, "height": 800}
WAIT_MS = 60_000


def main() -> None:
    """Serve a copy of a workspace, and photograph its tabs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("workspace", type=Path)
    workspace = parser.parse_args().workspace
    out = DOCS / "studio"
    out.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        copy = Path(shutil.copytree(workspace, Path(scratch) / "reef"))
        dive = SimulatedDive.read(copy)
        until_s = float(np.mean(dive.on_lines[2]))
        (copy / "nav.csv").write_bytes(text_of(dive.between(0.0, until_s)))
        with serving(copy) as server, chromium() as browser:
            page = browser.new_page(viewport=WIDE, reduced_motion="reduce")
            page.set_default_timeout(WAIT_MS)
            page.goto(server.address)
            page.wait_for_selector("body[data-ready]")
            before = {"model": measure, "pictures": open_pictures, "follow": follow}
            for name in ("follow", "model", "pictures", "run", "plan"):
                page.locator(f"#tab-{name}").click()
                page.wait_for_timeout(4000)
                before.get(name, lambda _: None)(page)
                photograph(page, out / f"{name}.jpg")
            page = browser.new_page(viewport=NARROW, reduced_motion="reduce")
            page.goto(f"{server.address}#plan")
            page.wait_for_selector("#panel-plan[data-read]", timeout=WAIT_MS)
            page.wait_for_timeout(3000)
            photograph(page, out / "narrow.jpg")
        with serving(Path(scratch) / "bay") as server, begun_page(WIDE) as (page, _):
            page.goto(server.address)
            button(page, "Plan a survey").click()
            photograph(page, out / "begin.jpg")


def measure(page: Any) -> None:
    """A profile over the middle of the map, and an area beside it."""
    box = page.locator("#map-canvas")
    east, north = (float(box.get_attribute(f"data-{axis}")) for axis in ("east", "north"))
    pixel = 1 / 2 ** float(box.get_attribute("data-zoom"))
    east, size = east - 110 * pixel, 130 * pixel  # the list of layers takes the right of the map
    page.get_by_role("button", name="Area", exact=True).click()
    corners = ((-1, -1), (0.2, -1.3), (0.6, 0.1), (-0.5, 0.5))
    click(page, *((east + size * e, north + size * n) for e, n in corners))
    page.get_by_role("button", name="Finish", exact=True).click()
    page.wait_for_selector("tr[data-measure]")
    page.get_by_role("button", name="Profile", exact=True).click()
    click(page, (east - 0.8 * size, north + 0.9 * size), (east + 0.9 * size, north + 0.6 * size))
    page.get_by_role("button", name="Finish", exact=True).click()
    page.wait_for_selector(".model .profile-chart:not([hidden])")
    page.locator(".model .profile-chart").scroll_into_view_if_needed()
    page.wait_for_timeout(1000)


def open_pictures(page: Any) -> None:
    """The pictures that see the middle of the map."""
    page.get_by_role("button", name="Choose on the map").click()
    page.locator("#map-canvas").focus()
    page.keyboard.press("Enter")
    page.locator(".picture-view[data-ready]").nth(3).wait_for(timeout=WAIT_MS)
    page.wait_for_timeout(1500)


def follow(page: Any) -> None:
    """A dive that has lost a stretch of its second line, with lines that close the hole."""
    page.get_by_label("Navigation CSV of this workspace").select_option("nav.csv")
    button(page, "Follow it").click()
    page.wait_for_selector("#panel-follow button.primary:enabled", timeout=WAIT_MS)
    page.wait_for_timeout(1500)


def photograph(page: Any, path: Path) -> None:
    """What the page shows now."""
    page.screenshot(path=str(path), type="jpeg", quality=72)


if __name__ == "__main__":
    main()
