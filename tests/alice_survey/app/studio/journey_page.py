"""What a person does in the studio's page on the way from an empty folder to a survey."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.alice_survey.app.studio.client import FOLDED, serving
from tests.alice_survey.app.studio.picture_page import WAIT_MS, said
from tests.alice_survey.kit.browser import Heard, chromium, is_accessible

WIDE, NARROW = {"width": 1280, "height": 900}, {"width": 400, "height": 850}
LONG_MS = 800_000


@contextmanager
def begun_page(size: dict[str, int]) -> Iterator[tuple[Any, Heard]]:
    """A page of its own browser, and what it complains about."""
    with chromium() as browser:
        page = browser.new_page(viewport=size, reduced_motion="reduce", accept_downloads=True)
        page.set_default_timeout(WAIT_MS)
        heard = Heard()
        heard.listen(page)
        page.add_init_script(FOLDED)
        yield page, heard
        page.close()


@contextmanager
def opened_page(folder: Path, tab: str = "", **options: Any) -> Iterator[tuple[Any, Heard]]:
    """The studio's page of a workspace, which complains of nothing and asks no other server."""
    with serving(folder) as server, chromium() as browser:
        page = browser.new_page(**{"viewport": WIDE, "reduced_motion": "reduce"} | options)
        heard = Heard()
        heard.listen(page)
        if tab:  # else the list of layers is looked at
            page.add_init_script(FOLDED)
        page.goto(server.address + tab)
        page.wait_for_selector("body[data-ready]", timeout=60_000)
        yield page, heard
        assert heard.complaints == []
        asked = {url.split("/")[2] for url in heard.requests if url.startswith("http")}
        assert asked == {server.url.split("/")[2]}
        page.close()


def button(page: Any, name: str) -> Any:
    return page.get_by_role("button", name=name, exact=True)


def opened(page: Any, tab: str) -> None:
    page.get_by_role("tab", name=tab).click()


def made(page: Any, stage: str) -> None:
    """Wait until a stage is made."""
    page.wait_for_selector(f"[data-stage={stage}][data-state='up to date']", timeout=LONG_MS)


def survey_begun(page: Any, address: str, *, length_m: float, width_m: float) -> None:
    """Make a small survey in an empty folder; the Plan tab is open then."""
    page.goto(address)
    button(page, "Plan a survey").click()
    page.get_by_label("Depth of the sea floor, m").fill("12")
    page.get_by_label("A small one, to try the program").check()
    page.get_by_text("Size and camera").click()
    page.get_by_label("Length, m", exact=True).fill(f"{length_m}")
    page.get_by_label("Width, m", exact=True).fill(f"{width_m}")
    is_accessible(page)
    with page.expect_navigation():
        button(page, "Make the survey").click()
    page.wait_for_selector("#panel-plan[data-read]")


def survey_flown(page: Any) -> None:
    """Save the plan, and fly it."""
    button(page, "Save").click()
    said(page, "Saved")
    opened(page, "Run")
    made(page, "plan")
    page.get_by_label("Start: Fly the plan").click()
    made(page, "fly")
