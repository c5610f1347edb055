"""The tab Model in Chromium: measured by clicks and by keys, on the map and on the mesh."""

import csv
import io
import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from alice_survey.core.artefacts import write_json
from tests.alice_survey.app.report.tiny import SLOPE, plane_of, tiny_workspace
from tests.alice_survey.app.studio.client import move_map
from tests.alice_survey.app.studio.journey_page import opened_page
from tests.alice_survey.kit.browser import Heard, is_accessible
from tests.alice_survey.kit.sketch import sketch_mesh

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("chromium")]
MAP = "#map-canvas"
RISE = math.hypot(1.0, SLOPE)


def with_mesh(folder: Path) -> Path:
    """The tiny workspace, and a mesh about the middle of its surface."""
    workspace = tiny_workspace(folder)
    mesh = workspace / "mesh"
    mesh.mkdir()
    sketch_mesh(mesh).glb.rename(mesh / "mesh.glb")
    parts = trimesh.load_scene(mesh / "mesh.glb").geometry.values()
    about = {"area": 12.0, "textured_share": 1.0, "offset_east_north_up": [0.4, 0.6, -10.0]}
    write_json(mesh / "mesh.json", {"triangles": sum(len(p.faces) for p in parts), **about})
    Image.new("RGB", (40, 30)).save(mesh / "mesh.png")
    write_json(mesh / "stage.json", {"stage": "mesh"})
    return workspace


@contextmanager
def opened(folder: Path, width: int = 1280) -> Iterator[tuple[Any, Heard]]:
    """The tab in a browser."""
    with opened_page(folder, "#model", viewport={"width": width, "height": 900}) as found:
        found[0].wait_for_selector("#panel-model:visible")
        yield found


def at(page: Any, east: float, north: float) -> dict[str, float]:
    """Pixel of the map that shows a place."""
    view = page.locator(MAP)
    box = view.bounding_box()
    zoom, e, n = (float(view.get_attribute(f"data-{name}")) for name in ("zoom", "east", "north"))
    return {
        "x": box["width"] / 2 + (east - e) * 2**zoom,
        "y": box["height"] / 2 - (north - n) * 2**zoom,
    }


def click(page: Any, *places: tuple[float, float]) -> None:
    for place in places:
        page.locator(MAP).click(position=at(page, *place))
        page.wait_for_timeout(60)


def kept(page: Any) -> list[dict[str, Any]]:
    text = page.evaluate(
        "Object.entries(sessionStorage).find(([key]) => key.startsWith('alice-survey measures'))[1]"
    )
    return json.loads(text)


def named(measure: dict[str, Any]) -> dict[str, Any]:
    return {one["name"]: one for one in measure["figures"]}


def measured(page: Any, count: int) -> list[dict[str, Any]]:
    page.wait_for_selector(f"tr[data-measure] >> nth={count - 1}", timeout=60_000)
    return kept(page)


def test_lengths_areas_and_exports(tmp_path: Path) -> None:
    with opened(with_mesh(tmp_path / "reef")) as (page, _):
        page.locator(MAP).hover(position=at(page, 0.4, 0.6))
        page.locator(".under", has_text="Sigma").wait_for(timeout=60_000)
        page.locator(".under", has_text="−9.").wait_for(timeout=60_000)

        page.get_by_role("button", name="Length", exact=True).click()
        click(page, (0.2, 0.5), (0.6, 0.5))
        (length,) = measured(page, 1)
        true = math.dist(*length["places"])
        assert true == pytest.approx(0.4, abs=0.01)
        assert named(length)["length"]["value"] == pytest.approx(true * RISE, rel=1e-3)
        page.wait_for_selector(".model .profile-chart path.of")

        page.get_by_role("button", name="Volume", exact=True).click()
        page.get_by_label("Height of the volume's plane, m").fill("-10")
        click(page, (0.3, 0.3), (0.7, 0.3), (0.7, 0.8), (0.3, 0.8))
        page.get_by_role("button", name="Finish", exact=True).click()
        volume = measured(page, 2)[1]
        assert named(volume)["volume"]["value"] == pytest.approx(0.2 * 0.5 * SLOPE, rel=0.05)
        assert named(volume)["aspect"]["value"] == pytest.approx(270.0, abs=1.0)

        page.get_by_label("Name of Length 1").fill("coral =1")
        page.keyboard.press("Tab")
        assert kept(page)[0]["name"] == "coral =1"
        with page.expect_download() as found:
            page.get_by_role("button", name="Export CSV").click()
        rows = list(csv.DictReader(io.StringIO(Path(found.value.path()).read_text())))
        assert {row["name"] for row in rows} == {"coral =1", "Volume 1"}

        page.reload()
        page.wait_for_selector("tr[data-measure] >> nth=1")
        page.get_by_role("button", name="Delete coral =1").click()
        assert [one["name"] for one in kept(page)] == ["Volume 1"]


def test_all_of_it_by_keyboard(tmp_path: Path) -> None:
    with opened(with_mesh(tmp_path / "reef"), 400) as (page, _):
        page.locator(MAP).focus()
        page.keyboard.press("p")
        for key in ("ArrowRight", "ArrowUp", "ArrowLeft"):
            page.keyboard.press("Enter")
            move_map(page, key)
        page.keyboard.press("Enter")
        page.keyboard.press("Backspace")
        page.keyboard.press("f")
        (line,) = measured(page, 1)
        assert len(line["places"]) == 3
        page.keyboard.press("r")
        page.keyboard.press("Escape")
        assert page.locator(MAP).get_attribute("data-tool") is None
        page.keyboard.press("l")
        page.keyboard.press("Enter")
        page.keyboard.press("Enter")  # the same place is no length
        page.wait_for_selector("#status.warn")
        assert len(kept(page)) == 1
        page.get_by_text("In 3D", exact=True).click()
        page.wait_for_selector(".mesh[data-ready]", timeout=60_000)
        page.get_by_text("Files", exact=True).click()
        is_accessible(page)


LIFT = 0.05
"""Height of the finest tiles over the coarse one, so that a pick tells which it hit."""


MIDDLE = np.array([0.4, 0.6, -10.0])
"""Of the mesh."""
EAST, NORTH, UP = np.eye(3)
WALL = plane_of("wall", origin_enu=(0.0, 1.0, -10.5))


def with_tiles(folder: Path) -> Path:
    """The workspace with a mesh and tiles: a coarse one, a link, and two finest ones."""
    workspace = with_mesh(folder)
    tiles = workspace / "mesh" / "tiles"
    tiles.mkdir()
    coarse = (workspace / "mesh" / "mesh.glb").read_bytes()
    (tiles / "top.glb").write_bytes(coarse)
    boxes = []
    for side, name in ((-1, "west"), (1, "east")):
        (sheet,) = trimesh.load_scene(io.BytesIO(coarse), file_type="glb").geometry.values()
        sheet.update_faces(sheet.triangles_center[:, 0] * side > 0)
        sheet.apply_translation([0.0, LIFT, 0.0])
        (tiles / f"{name}.glb").write_bytes(sheet.export(file_type="glb"))
        box = {"box": [side, 0, 0.05, 1.04, 0, 0, 0, 1.6, 0, 0, 0, 0.3]}
        content = {"uri": f"{name}.glb"}
        boxes.append({"boundingVolume": box, "geometricError": 0.0, "content": content})
    whole = {"box": [0, 0, 0.02, 2.1, 0, 0, 0, 1.6, 0, 0, 0, 0.3]}
    link = {"boundingVolume": whole, "geometricError": 0.0, "content": {"uri": "west.json"}}
    inner = {"asset": {"version": "1.1"}, "geometricError": 0.0, "root": boxes[0]}
    write_json(tiles / "west.json", inner)
    root = {"boundingVolume": whole, "geometricError": 0.5, "refine": "REPLACE"}
    root |= {"content": {"uri": "top.glb"}, "children": [link, boxes[1]]}
    write_json(tiles / "tileset.json", {"asset": {"version": "1.1"}, "root": root})
    return workspace


def picked_off(page: Any, folder: Path, number: int, lift: float) -> float:
    """Pick two places on the mesh by mouse and keys: how far off the triangles of the file."""
    import open3d as o3d

    canvas = page.locator("#mesh-canvas")
    box = canvas.bounding_box()
    canvas.click(position={"x": box["width"] * 0.42, "y": box["height"] * 0.5})
    page.get_by_text("click another place").wait_for()
    canvas.focus()
    page.keyboard.press("Enter")
    length = measured(page, number)[-1]
    apart = math.dist(*length["places"])
    assert named(length)["length"]["value"] == pytest.approx(apart, rel=1e-6) and apart > 1e-3
    mesh = trimesh.load_scene(folder / "mesh" / "mesh.glb").to_mesh()
    scene = o3d.t.geometry.RaycastingScene()
    lifted = (mesh.vertices + np.array([0.0, lift, 0.0])).astype(np.float32)
    scene.add_triangles(lifted, mesh.faces.astype(np.uint32))
    points = np.array([[e - 0.4, u + 10.0, 0.6 - n] for e, n, u in length["places"]])
    return float(scene.compute_distance(points.astype(np.float32)).numpy().max())


def test_tiles_are_drawn_as_the_view_needs_them_and_picked(tmp_path: Path) -> None:
    folder = with_tiles(tmp_path / "reef")
    with opened(folder) as (page, heard):
        page.get_by_text("In 3D", exact=True).click()
        page.wait_for_selector(".mesh[data-ready]", timeout=60_000)
        canvas = page.locator("#mesh-canvas")

        def loaded() -> set[str]:
            return {url.split("/")[-1] for url in heard.requests if "/mesh/tiles/" in url}

        page.wait_for_selector("#mesh-canvas[data-parts='2'][data-coming='0']", timeout=60_000)
        assert loaded() == {"tileset.json", "top.glb", "west.json", "west.glb", "east.glb"}
        canvas.focus()
        for _ in range(16):
            page.keyboard.press("-")
        page.wait_for_selector("#mesh-canvas[data-parts='1'][data-coming='0']", timeout=60_000)
        page.keyboard.press("0")
        page.wait_for_selector("#mesh-canvas[data-parts='2'][data-coming='0']", timeout=60_000)
        shot = np.asarray(Image.open(io.BytesIO(canvas.screenshot())).convert("RGB"), float)
        assert 0.1 < (np.abs(shot - [243, 246, 248]).max(axis=2) > 30).mean() < 0.95
        assert picked_off(page, folder, 1, LIFT) < 1e-4
        page.get_by_role("button", name="Larger, over the map").click()
        assert canvas.bounding_box()["width"] > 800
        is_accessible(page)


def test_damaged_tiles_of_a_wall(tmp_path: Path) -> None:
    """Their parent stands for them, a line says what is not drawn; picks are of the wall's axes."""
    workspace = with_tiles(tmp_path / "reef")
    west = workspace / "mesh" / "tiles" / "west.glb"
    west.write_bytes(west.read_bytes()[:-2000])
    write_json(workspace / "dense" / "plane.json", WALL)
    with opened(workspace) as (page, _):
        page.get_by_text("In 3D", exact=True).click()
        page.wait_for_selector(".mesh[data-ready]", timeout=60_000)
        canvas, status = page.locator("#mesh-canvas"), page.locator("#status.error")
        page.wait_for_selector("#mesh-canvas[data-parts='1'][data-coming='0']", timeout=60_000)
        assert status.inner_text() == (
            "A part is not drawn: mesh/tiles/west.glb is cut off: delete it and run its stage again"
        )
        canvas.focus()
        page.keyboard.press("Enter")
        box = canvas.bounding_box()
        canvas.click(position={"x": box["width"] * 0.4, "y": box["height"] * 0.5})
        (length,) = measured(page, 1)
        for right, up, out in length["places"]:
            place = np.array(WALL["origin_enu"]) + right * EAST + up * UP - out * NORTH
            assert np.abs(place - MIDDLE).max() < 1.6
