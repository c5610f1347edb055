"""The first start and the Run tab in Chromium: a job stopped, a map dropped, pictures imported."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from alice_survey.app.studio.jobs import Jobs
from tests.alice_survey.app.report.tiny import tiny_workspace
from tests.alice_survey.app.studio.client import serving
from tests.alice_survey.app.studio.journey_page import NARROW, WIDE, begun_page, button
from tests.alice_survey.app.studio.test_jobs import PROGRAM
from tests.alice_survey.kit.browser import is_accessible
from tests.small_survey import settings_in

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("chromium")]
LONG_MS = 90_000


@pytest.fixture
def page() -> Iterator[Any]:
    """A page that complains about nothing but requests that were refused."""
    with begun_page(WIDE) as (page, heard):
        yield page
        assert [one for one in heard.complaints if "status of 400" not in one] == []


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
        is_accessible(page, sizes=(NARROW, WIDE))
        page.reload()
        page.get_by_text("of 600, about").wait_for()
        button(page, "Stop").click()
        page.get_by_role("heading", name="Plan the survey: stopped").wait_for()
        button(page, "Go on").click()
        page.get_by_text("of 600, about").wait_for()
        button(page, "Stop").click()
        page.get_by_role("heading", name="Plan the survey: stopped").wait_for()
        is_accessible(page, sizes=(NARROW, WIDE))


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
        assert button(page, "Try again").is_enabled()
        is_accessible(page, sizes=(NARROW, WIDE))
        page.goto(server.url + "?#run")  # without the token nothing can be started
        page.evaluate("sessionStorage.clear()")
        page.reload()
        button(page, "Try again").wait_for()
        assert button(page, "Try again").is_disabled()
