"""The studio's shell in Chromium: its map loads tiles and zooms, layers are chosen, tabs turn."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from alice_survey.app.pipeline import init_survey
from tests.alice_survey.app.report.tiny import tiny_workspace, write_raster
from tests.alice_survey.app.studio.journey_page import opened_page
from tests.alice_survey.kit.browser import is_accessible
from tests.alice_survey.kit.sketch import seafloor

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("chromium")]
MAP = "#map-canvas"
PICTURES = f"{MAP} img.leaflet-image-layer"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A workspace with a mosaic of four levels."""
    workspace = tiny_workspace(tmp_path / "reef")
    floor = np.moveaxis(np.asarray(seafloor(2500, 2400)), 2, 0)
    bands = np.concatenate([floor, np.full((1, 2400, 2500), 255, np.uint8)])
    options = {"photometric": "RGB", "alpha": "YES", "tiled": True}
    write_raster(workspace / "mosaic" / "mosaic.tif", bands, 0.0005, (0.0, 1.2), **options)
    return workspace


def tiles(page: Any) -> list[tuple[str, int]]:
    """Addresses and widths of the pictures on the map."""
    found = page.evaluate(
        f"[...document.querySelectorAll('{PICTURES}')]"
        ".map((tile) => [new URL(tile.src).pathname, tile.complete ? tile.naturalWidth : 0])"
    )
    return [(path, width) for path, width in found]


def all_loaded(page: Any, level: int) -> list[tuple[str, int]]:
    page.wait_for_function(
        """([pictures, level]) => {
          const tiles = [...document.querySelectorAll(pictures)];
          return tiles.length > 0 && tiles.every((tile) => tile.complete
            && new URL(tile.src).pathname.split("/")[3] === String(level));
        }""",
        arg=[PICTURES, level],
        timeout=60_000,
    )
    return tiles(page)


def test_the_map_loads_tiles_and_zooms(folder: Path) -> None:
    with opened_page(folder) as (page, _):
        assert "token" not in page.url
        first = int(page.locator(MAP).get_attribute("data-level"))
        shown = all_loaded(page, first)
        assert shown and all(path.startswith("/tiles/mosaic/") for path, _ in shown)
        assert all(width > 0 for _, width in shown)

        page.locator(MAP).focus()
        for _ in range(3):
            page.keyboard.press("+")
            page.wait_for_timeout(250)
        page.wait_for_selector(f"{MAP}[data-level='3']")
        assert first < 3
        assert all(width > 0 for _, width in all_loaded(page, 3))

        page.get_by_label("Height", exact=True).check()
        page.wait_for_function(
            "() => document.querySelector('img[src*=\"/tiles/dem/\"]')?.naturalWidth > 0",
            timeout=60_000,
        )
        assert page.get_by_text("height, m").first.is_visible()
        for name in ("Mosaic", "Sigma of height", "Height") * 3:  # faster than tiles come
            page.get_by_label(name, exact=True).check()
        page.get_by_role("button", name="Show all").click()


def test_a_model_is_shown_whole_again_after_a_larger_plan(folder: Path) -> None:
    init_survey(folder)
    with opened_page(folder) as (page, _):
        before = float(page.locator(MAP).get_attribute("data-zoom"))
        zooms = []
        for _again in range(2):
            page.get_by_role("tab", name="Plan", exact=True).click()
            page.wait_for_selector("#panel-plan[data-plans]", timeout=60_000)
            zooms.append(float(page.locator(MAP).get_attribute("data-zoom")))
            page.get_by_role("tab", name="Model", exact=True).click()
            assert float(page.locator(MAP).get_attribute("data-zoom")) == before
        assert zooms[0] == zooms[1] < before - 2.0


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (400, "light"), (1280, "dark")])
def test_every_tab_is_accessible(folder: Path, width: int, scheme: str) -> None:
    size = {"width": width, "height": 900}
    with opened_page(folder, viewport=size, color_scheme=scheme) as (page, _):
        names = page.locator("#tabs [role=tab]").all_inner_texts()
        for name in names:
            page.get_by_role("tab", name=name, exact=True).click()
            page.wait_for_timeout(300)
            assert page.locator("[role=tabpanel]:visible").count() == 1
            is_accessible(page)
        page.locator("#tabs [role=tab]").first.focus()
        for name in names[1:]:
            page.keyboard.press("ArrowRight")
            assert page.locator("[role=tab][aria-selected=true]").inner_text() == name
