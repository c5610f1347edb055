"""A dive followed in the browser while a process writes its log, and its hole closed."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from axe_playwright_python.sync_playwright import Axe

from tests.alice_survey.kit.browser import Heard, chromium
from tests.alice_survey.studio.client import ask, serving
from tests.alice_survey.studio.test_follow import GAP, LINE_S, PLAN, ROWS, workspace_of
from tests.missions.follow.dives import rows_along, text_of

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("chromium")]
WRITER = """
import sys, time
log, part, pause = sys.argv[1], sys.argv[2], float(sys.argv[3])
data = open(part, "rb").read()
with open(log, "ab", buffering=0) as out:
    for first in range(0, len(data), 1500):  # in the middle of lines
        out.write(data[first:first + 1500])
        time.sleep(pause)
"""


HOLES_LEFT = """() => {
    const text = document.querySelector("[data-figure=holes]").firstChild.textContent;
    return text === "none" || parseFloat(text) < 0.15;
}"""


def written(log: Path, rows: Any, pause_s: float) -> subprocess.Popen[bytes]:
    """Start a process that appends rows to a log."""
    part = log.with_suffix(".part")
    text = text_of(rows)
    part.write_bytes(text.split(b"\n", 1)[1] if log.exists() else text)
    return subprocess.Popen([sys.executable, "-c", WRITER, str(log), str(part), str(pause_s)])


def figure(page: Any, name: str) -> str:
    return str(page.inner_text(f'[data-figure="{name}"]')).split("\n")[0]


def violations(page: Any) -> list[str]:
    found = Axe().run(page).response["violations"]
    return [f"{one['id']}: {one['nodes'][0]['html'][:200]}" for one in found]


def opaque(page: Any) -> int:
    """Pixels of the coverage on the map that are of a colour."""
    return int(
        page.evaluate("""async () => {
        let total = 0;
        for (const img of document.querySelectorAll("img.follow-block")) {
            await img.decode();
            const canvas = document.createElement("canvas");
            canvas.width = img.naturalWidth; canvas.height = img.naturalHeight;
            const draw = canvas.getContext("2d");
            draw.drawImage(img, 0, 0);
            const {data} = draw.getImageData(0, 0, canvas.width, canvas.height);
            for (let i = 3; i < data.length; i += 4) total += data[i] > 100;
        }
        return total;
    }""")
    )


@pytest.mark.parametrize(("width", "height"), [(1280, 900), (400, 850)])
def test_a_dive_is_followed_and_its_hole_closed(tmp_path: Path, width: int, height: int) -> None:
    folder = workspace_of(tmp_path / "reef")
    log = folder / "nav.csv"
    kept = ROWS[~GAP]
    until_s = 100.0 + 3.5 * (LINE_S + 5.0)
    heard = Heard()
    with serving(folder, log=str(log)) as server, chromium() as browser:
        page = browser.new_page(
            viewport={"width": width, "height": height}, reduced_motion="reduce",
            accept_downloads=True,
        )  # fmt: skip
        heard.listen(page)
        page.goto(server.address + "#follow")
        page.wait_for_selector("#panel-follow .now:has-text('first position')", timeout=60_000)

        writer = written(log, kept[kept[:, 0] < until_s], 0.5)
        page.wait_for_selector("#panel-follow .now:has-text('On line 1')", timeout=60_000)
        page.wait_for_selector("img.follow-block", timeout=60_000)
        early = opaque(page)
        page.wait_for_selector("#panel-follow .now:has-text('On line 4')", timeout=60_000)
        assert writer.wait(30) == 0
        assert opaque(page) > 1.5 * early > 0
        page.wait_for_function(
            "() => parseFloat(document.querySelector('[data-figure=holes]').textContent) > 2"
        )
        assert figure(page, "lines") == f"{len(PLAN.lines) - 3} of {len(PLAN.lines)}"
        page.wait_for_selector("#panel-follow p:has-text('for 2.')", timeout=90_000)
        assert violations(page) == []
        page.screenshot(path=str(tmp_path / f"hole-{width}.png"), full_page=width < 700)
        # Nothing comes any more.
        page.wait_for_selector("#panel-follow .now.bad:has-text('No news for')", timeout=60_000)
        page.screenshot(path=str(tmp_path / f"silent-{width}.png"), full_page=width < 700)
        assert violations(page) == []

        offered = json.loads(ask(server, "/api/follow/proposal").text)["proposal"]
        with page.expect_download() as waiting:
            page.click("#panel-follow button.primary")
        assert waiting.value.suggested_filename == "holes.zip"
        page.wait_for_function(HOLES_LEFT)
        # The rest of the plan, and then the lines accepted.
        rest = kept[kept[:, 0] >= until_s]
        again = rows_along(offered["route_ne"], PLAN, float(rest[-1, 0]) + 0.5)
        writer = written(log, np.concatenate([rest, again]), 0.1)
        page.wait_for_selector("#panel-follow .now:has-text('On line')", timeout=60_000)
        assert writer.wait(60) == 0
        page.wait_for_function(
            "() => document.querySelector('[data-figure=lines]').textContent.startsWith('0 ')",
            timeout=60_000,
        )
        assert float(figure(page, "overlap").split()[0]) > 99.0
        assert page.evaluate(HOLES_LEFT)
        page.screenshot(path=str(tmp_path / f"closed-{width}.png"), full_page=width < 700)
        assert violations(page) == []
        # A finished log is flown again, for training.
        page.click("#panel-follow summary:has-text('Choose a log')")
        page.click("#panel-follow button:has-text('Stop')")
        page.wait_for_selector("#panel-follow .now:has-text('No dive is followed')")
        page.screenshot(path=str(tmp_path / f"choose-{width}.png"), full_page=width < 700)
        assert violations(page) == []
        page.select_option("#panel-follow select >> nth=-1", "50")
        page.click("#panel-follow button:has-text('Replay it')")
        page.wait_for_selector("#panel-follow .now:has-text('On line 2')", timeout=60_000)
        overflow = page.evaluate("document.documentElement.scrollWidth - innerWidth")
        assert overflow <= 0
    assert heard.complaints == []
