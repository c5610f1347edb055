"""The page in Chromium: its map loads tiles from the server, zooms, and the mesh is drawn."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from rasterio.transform import Affine

from alice_survey.base.artefacts import write_json
from tests.alice_survey.kit.browser import Heard, chromium
from tests.alice_survey.kit.sketch import encoded, seafloor, sketch_mesh
from tests.alice_survey.report.tiny import tiny_workspace
from tests.alice_survey.studio.client import serving

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("chromium")]
MAP = "#map-canvas"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A workspace with a mosaic of four levels, and a mesh."""
    import rasterio

    workspace = tiny_workspace(tmp_path / "reef")
    floor = np.asarray(seafloor(2500, 2400))
    bands = np.concatenate([np.moveaxis(floor, 2, 0), np.full((1, 2400, 2500), 255, np.uint8)])
    with rasterio.open(
        workspace / "mosaic" / "mosaic.tif", "w", driver="GTiff", count=4, dtype="uint8",
        width=2500, height=2400, photometric="RGB", alpha="YES", tiled=True,
        transform=Affine(0.0005, 0, 0, 0, -0.0005, 1.2),
    ) as raster:  # fmt: skip
        raster.write(bands)
    mesh = workspace / "mesh"
    mesh.mkdir()
    sketch_mesh(mesh).glb.rename(mesh / "mesh.glb")
    triangles = sum(
        len(part.faces) for part in trimesh.load_scene(mesh / "mesh.glb").geometry.values()
    )
    about = {"area": 12.0, "textured_share": 1.0, "offset_east_north_up": [0.0, 0.0, 0.0]}
    write_json(mesh / "mesh.json", {"triangles": triangles, **about})
    (mesh / "mesh.png").write_bytes(encoded(Image.fromarray(floor[:300, :400]), "PNG"))
    write_json(mesh / "stage.json", {"stage": "mesh"})
    return workspace


PICTURES = f"{MAP} img.leaflet-image-layer"


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
        timeout=20_000,
    )
    return tiles(page)


def test_the_map_loads_tiles_and_zooms(folder: Path) -> None:
    with serving(folder) as server, chromium() as browser:
        page = browser.new_page(viewport={"width": 1280, "height": 900}, reduced_motion="reduce")
        heard = Heard()
        heard.listen(page)
        page.goto(server.url)
        page.wait_for_selector("#map[data-ready]", timeout=20_000)
        page.locator(MAP).scroll_into_view_if_needed()
        first = int(page.locator(MAP).get_attribute("data-level"))
        shown = all_loaded(page, first)
        assert shown and all(path.startswith("/tiles/mosaic/") for path, _ in shown)
        assert all(width > 0 for _, width in shown)

        page.locator(MAP).focus()
        for _ in range(3):
            page.keyboard.press("+")
            page.wait_for_timeout(250)
        assert int(page.locator(MAP).get_attribute("data-level")) == 3 > first
        assert all(width > 0 for _, width in all_loaded(page, 3))

        page.get_by_label("Height", exact=True).check()
        page.wait_for_function(
            "() => document.querySelector('img[src*=\"/tiles/height/\"]')?.naturalWidth > 0",
            timeout=20_000,
        )
        assert page.get_by_text("height, m").first.is_visible()
        for name in ("Mosaic", "Sigma of height", "Height") * 3:  # faster than tiles come
            page.get_by_label(name, exact=True).check()
        page.get_by_role("button", name="Show all").click()
        page.locator("#mesh").scroll_into_view_if_needed()
        page.wait_for_selector("#mesh[data-ready]", state="attached", timeout=20_000)
        assert page.locator("#mesh-canvas").is_visible()
        assert heard.complaints == []
        assert {url.split("/")[2] for url in heard.requests if url.startswith("http")} == {
            server.url.split("/")[2]
        }
        page.close()
