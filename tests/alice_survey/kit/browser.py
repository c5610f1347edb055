"""A Chromium that runs without a screen, and what it had to say about a page."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

ARGUMENTS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""As root in a container, and with WebGL drawn by the processor."""


@contextmanager
def chromium() -> Iterator[Any]:
    """A browser; without one the test is skipped, never in CI."""
    names = ("chromium", "chromium-browser", "google-chrome")
    path = next(filter(None, map(shutil.which, names)), None)
    if path is None:
        if os.environ.get("CI"):
            pytest.fail("CI needs chromium to open the report's page")
        pytest.skip("no chromium here")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=path, args=list(ARGUMENTS))
        yield browser
        browser.close()


@dataclass
class Heard:
    """What a page requested and complained about, in its order."""

    complaints: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def listen(self, page: Any) -> None:
        page.on("console", lambda message: self._console(message.type, message.text))
        page.on("pageerror", lambda fault: self.complaints.append(f"fault: {fault}"))
        page.on("request", lambda request: self.requests.append(request.url))

    def _console(self, kind: str, text: str) -> None:
        if kind in ("error", "warning"):
            self.complaints.append(f"{kind}: {text}")


def is_accessible(page: Any, shot: Path | None = None, sizes: tuple[Any, ...] = ()) -> None:
    """No violations that axe knows, and nothing wider than the screen; a picture of the page.

    Args:
        page: as it is, or at `sizes`, the last of which stays.
        shot: PNG to write, with the width in its name.
        sizes: of the viewport.
    """
    from axe_playwright_python.sync_playwright import Axe

    for size in sizes or (page.viewport_size,):
        if size != page.viewport_size:
            page.set_viewport_size(size)
        found = Axe().run(page, options={"resultTypes": ["violations"]}).response["violations"]
        assert [(one["id"], one["nodes"][0]["html"][:160]) for one in found] == []
        assert page.evaluate("document.documentElement.scrollWidth") <= size["width"]
        if shot is not None:
            path = shot.with_name(f"{shot.stem}-{size['width']}.png")
            page.screenshot(path=str(path), full_page=size["width"] < 700)
