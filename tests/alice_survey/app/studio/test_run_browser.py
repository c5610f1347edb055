"""The first start and the Run tab in Chromium: a job stopped, a map dropped, pictures imported."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from axe_playwright_python.sync_playwright import Axe

from alice_survey.app.studio.jobs import Jobs
from tests.alice_survey.app.report.tiny import tiny_workspace
from tests.alice_survey.app.studio.client import serving
from tests.alice_survey.app.studio.test_jobs import PROGRAM
from tests.alice_survey.app.studio.test_run_tab import AREA
from tests.alice_survey.kit.browser import Heard, chromium
from tests.reconstruct.pictures.dated import navigation, take
from tests.small_survey import settings_in

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("chromium")]
WIDE, NARROW = {"width": 1280, "height": 900}, {"width": 400, "height": 900}
LONG_MS = 90_000


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """One Chromium for all."""
    with chromium() as browser:
        yield browser


@pytest.fixture
def page(browser: Any) -> Iterator[Any]:
    """A page that complains about nothing but requests that were refused."""
    page = browser.new_page(viewport=WIDE, reduced_motion="reduce")
    heard = Heard()
    heard.listen(page)
    yield page
    assert [one for one in heard.complaints if "status of 400" not in one] == []
    page.close()


def is_accessible(page: Any) -> None:
    """No violations that axe knows, wide and narrow, and nothing wider than the screen."""
    for size in (NARROW, WIDE):
        page.set_viewport_size(size)
        found = Axe().run(page, options={"resultTypes": ["violations"]}).response["violations"]
        assert [(one["id"], one["nodes"][0]["target"]) for one in found] == []
        assert page.evaluate("document.documentElement.scrollWidth") <= size["width"]


def named(page: Any, name: str) -> Any:
    return page.get_by_role("button", name=name, exact=True)


def test_a_job_is_seen_again_and_stopped(page: Any, tmp_path: Path) -> None:
    with serving(settings_in(tmp_path / "reef")) as server:
        studio = server.studio
        vars(studio)["jobs"] = Jobs(
            studio.workspace.folder, studio.publish, [sys.executable, "-c", PROGRAM]
        )
        page.goto(server.address + "#run")
        page.get_by_label("Start: Plan the survey").click()
        page.get_by_text("of 600, about").wait_for()
        bar = page.get_by_role("progressbar")
        first = float(bar.get_attribute("value"))
        page.wait_for_function(
            "(first) => document.querySelector('.step progress').value > first", arg=first
        )
        assert page.get_by_role("button", name="Start: Plan the survey").is_disabled()
        is_accessible(page)
        page.reload()
        page.get_by_text("of 600, about").wait_for()
        named(page, "Stop").click()
        page.get_by_role("heading", name="Plan the survey: stopped").wait_for()
        named(page, "Go on").click()
        page.get_by_text("of 600, about").wait_for()
        named(page, "Stop").click()
        page.get_by_role("heading", name="Plan the survey: stopped").wait_for()
        is_accessible(page)


def test_a_map_file_is_the_area(page: Any, tmp_path: Path) -> None:
    with serving(tmp_path / "reef") as server:
        page.goto(server.address)
        named(page, "Plan a survey").click()
        file = {"name": "bay.geojson", "mimeType": "", "buffer": json.dumps(AREA).encode()}
        page.get_by_label("Or a map file").set_input_files(file)
        assert page.get_by_label("Latitude, degrees").is_disabled()
        with page.expect_navigation():
            named(page, "Make the survey").click()
        page.wait_for_selector("[data-ready]")
    assert json.loads((tmp_path / "reef" / "area.geojson").read_text()) == AREA


def test_pictures_are_looked_at_and_imported(page: Any, tmp_path: Path) -> None:
    for n in range(5):
        take(tmp_path / "dive" / "left" / f"{n}.jpg", n, model="Manta")
        take(tmp_path / "dive" / "right" / f"{n}.jpg", n, model="Manta", px=64)
        take(tmp_path / "dive" / "right" / f"{n}.jpg", 40 + n, model="Manta")
    log = navigation(tmp_path / "dive" / "left" / "nav.csv", 60)
    with serving(tmp_path / "w") as server:
        page.goto(server.address)
        named(page, "I have pictures").click()
        page.get_by_label("Folder of the pictures").fill(str(tmp_path / "dive"))
        named(page, "Look into it").click()
        page.get_by_text("Found: 10 pictures").wait_for()
        page.get_by_label("one camera, or several").check()
        page.get_by_text("camera 10 pictures of 64").wait_for()
        is_accessible(page)
        named(page, "left").click()
        page.get_by_text("Found: 5 pictures").wait_for()
        page.locator("#panel-run").get_by_label("Navigation").fill(str(tmp_path / "none.csv"))
        page.locator("#panel-run").get_by_label("Navigation").blur()
        page.locator(".found .error").wait_for()
        assert named(page, "Import them").is_disabled()
        page.locator("#panel-run").get_by_label("Navigation").fill(str(log))
        page.locator("#panel-run").get_by_label("Navigation").blur()
        page.get_by_text("5 of 5 picture times").wait_for()
        named(page, "Import them").click()
        page.get_by_role("heading", name="Import pictures: done").wait_for(timeout=LONG_MS)
        page.wait_for_selector("[data-stage=image][data-state='up to date']")
        assert named(page, "Reconstruct the sea floor").is_enabled()
        is_accessible(page)
    assert len(list((tmp_path / "w" / "images" / "camera").iterdir())) == 5


def test_a_fault_and_the_report(page: Any, tmp_path: Path) -> None:
    workspace = tiny_workspace(tmp_path)
    (workspace / "survey.toml").write_text('name = "tiny"\n')
    report = workspace / "report"
    report.mkdir(exist_ok=True)
    (report / "report.html").write_text("<title>T</title><h1>What was mapped</h1>")
    (report / "stage.json").write_text(json.dumps({"stage": "report", "took_s": 1.0}))
    with serving(workspace) as server:
        page.goto(server.address + "#run")
        with page.expect_popup() as report:
            page.get_by_role("link", name="Open the report").click()
        report.value.get_by_text("What was mapped").wait_for()
        page.evaluate(
            "(against) => import('/app/core.js').then(({send}) =>"
            " send('/api/run/start', {name: 'evaluate', arguments: {against}}))",
            str(workspace / "dense"),
        )
        page.get_by_role("heading", name="Score the survey: failed").wait_for(timeout=LONG_MS)
        line = page.locator("section[aria-label='Last run'] .error").inner_text()
        assert line and "Traceback" not in line
        assert named(page, "Try again").is_enabled()
        is_accessible(page)
        page.goto(server.url + "?#run")  # without the token nothing can be started
        page.evaluate("sessionStorage.clear()")
        page.reload()
        named(page, "Try again").wait_for()
        assert named(page, "Try again").is_disabled()
