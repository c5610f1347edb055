"""A dive from an empty folder on, followed while its log grows, and its hole closed."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from alice_survey.core.frames import Array
from missions.values.plan_file import read_plan
from tests.alice_survey.app.studio import journey_page
from tests.alice_survey.app.studio.client import ask, serving
from tests.alice_survey.kit.browser import is_accessible
from tests.missions.follow.dives import rows_along, text_of

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("chromium")]


@dataclass(frozen=True)
class SimulatedDive:
    """What a simulated dive has logged, but for a stretch of its second line."""

    rows: Array
    on_lines: list[Array]
    """Times of the pictures of each line."""

    @classmethod
    def read(cls, workspace: Path) -> "SimulatedDive":
        flight = workspace / "flight"
        rows = np.loadtxt(flight / "navigation.csv", delimiter=",", skiprows=1, usecols=range(8))
        triggers = np.loadtxt(flight / "triggers.csv", delimiter=",", skiprows=1)
        lines = range(int(triggers[:, 2].max()) + 1)
        on_lines = [triggers[triggers[:, 2] == line, 1] for line in lines]
        lost = np.quantile(on_lines[1], [0.1, 0.9])
        is_lost = (rows[:, 0] > lost[0]) & (rows[:, 0] < lost[1])
        return cls(rows[~is_lost][::5], on_lines)

    def between(self, begin_s: float, end_s: float) -> Array:
        return self.rows[(self.rows[:, 0] >= begin_s) & (self.rows[:, 0] < end_s)]


def phase(page: Any, words: str) -> None:
    """Wait until the page says that the vehicle does this."""
    page.wait_for_selector(f"#panel-follow .now:has-text('{words}')")


def figure(page: Any, name: str) -> str:
    return str(page.inner_text(f'[data-figure="{name}"]')).split("\n")[0]


def figure_is(page: Any, name: str, start: str) -> None:
    """Wait until a figure begins with these words."""
    page.wait_for_function(
        "([name, start]) => document.querySelector(`[data-figure=${name}]`)"
        ".textContent.startsWith(start)",
        arg=[name, start],
    )


def opaque(page: Any) -> int:
    """Pixels of the coverage on the map that are of a colour."""
    return int(
        page.evaluate("""async () => {
        let total = 0;
        for (const img of document.querySelectorAll("img.follow-coverage")) {
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


@pytest.mark.parametrize("size", [journey_page.WIDE], ids=["1280"])
def test_a_dive_is_followed_and_its_hole_closed(tmp_path: Path, size: dict[str, int]) -> None:
    reef = tmp_path / "reef"
    with serving(reef) as server, journey_page.begun_page(size) as (page, heard):
        journey_page.survey_begun(page, server.address, length_m=3.0, width_m=3.0)
        journey_page.survey_flown(page)
        plan = read_plan(reef / "plan" / "plan.json")
        dive = SimulatedDive.read(reef)
        first_s, third_s = (float(np.mean(dive.on_lines[line])) for line in (0, 2))
        end_s = float(dive.on_lines[-1].max()) + 3.0
        log = reef / "nav.csv"

        def come(*rows: Array) -> None:
            text = text_of(np.concatenate(rows)).split(b"\n", 1)[1]
            for part in (text[:-20], text[-20:]):  # in the middle of a line
                with log.open("ab") as file:
                    file.write(part)

        journey_page.opened(page, "Follow")
        logs = page.get_by_label("Navigation CSV of this workspace")
        logs.wait_for()
        log.write_bytes(text_of(dive.rows[:1]))  # it comes while the page is open
        logs.focus()
        logs.select_option("nav.csv")
        journey_page.button(page, "Follow it").click()
        come(dive.between(0.01, first_s))
        phase(page, "On line 1")
        page.wait_for_selector("img.follow-coverage")
        early = opaque(page)
        come(dive.between(first_s, third_s))
        phase(page, "On line 3")
        page.wait_for_function(
            "() => parseFloat(document.querySelector('[data-figure=holes]').textContent) > 0.4"
        )
        assert float(figure(page, "holes").split()[0]) < 1.2
        assert opaque(page) > 1.5 * early > 0
        assert figure(page, "lines") == f"{len(plan.lines) - 2} of {len(plan.lines)}"
        page.wait_for_selector("#panel-follow button.primary:enabled")
        is_accessible(page, tmp_path / "hole.png")
        # Nothing comes for a while.
        page.wait_for_selector("#panel-follow .now.bad:has-text('No news for')")
        is_accessible(page, tmp_path / "silent.png")

        offered = json.loads(ask(server, "/api/follow/state").text)["proposal"]
        with page.expect_download() as waiting:
            journey_page.button(page, "Download missions").click()
        assert waiting.value.suggested_filename == "holes.zip"
        # The rest of the plan, and then the lines over the hole.
        come(dive.between(third_s, end_s), rows_along(offered["route_ne"], plan, end_s + 0.5))
        figure_is(page, "lines", "0 of")
        page.wait_for_function(
            "() => /^(none|0.0 m²)/.test(document.querySelector('[data-figure=holes]').textContent)"
        )
        assert float(figure(page, "overlap").split()[0]) > 99.0
        is_accessible(page, tmp_path / "closed.png")
        page.get_by_text("Choose a log", exact=True).click()
        journey_page.button(page, "Stop").click()
        phase(page, "No dive is followed")
        assert heard.complaints == []
