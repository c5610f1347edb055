"""The Compare tab's endpoints: another survey is looked at where a page with the token said."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import rasterio

from alice_survey.app.studio.server import Server
from reconstruct.evaluate.against import evaluate_against
from tests.alice_survey.app.report.tiny import tiny_workspace
from tests.alice_survey.app.studio.client import ask, call, serving


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    tiny_workspace(tmp_path / "before")
    (tmp_path / "empty").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "before")
    with serving(tiny_workspace(tmp_path / "now")) as started:
        yield started


def test_surveys_next_to_it_are_found_for_who_may_know(server: Server) -> None:
    assert call(server, "/api/compare/near", token=None).status == 403
    found = call(server, "/api/compare/near").json
    assert [one["name"] for one in found["surveys"]] == ["before"]


def test_another_survey_is_opened_and_its_tiles_are_served(server: Server, tmp_path: Path) -> None:
    assert call(server, "/api/compare/open", {"path": "before"}, token=None).status == 403
    opened = call(server, "/api/compare/open", {"path": str(tmp_path / "before")}).json
    assert opened["comparable"] and opened["note"] == ""
    assert {"mosaic", "height"} <= {layer["name"] for layer in opened["layers"]}
    own = {layer["name"]: layer for layer in ask(server, "/api/map").json["layers"]}
    for layer in opened["layers"]:
        tile = ask(server, layer["address"].replace("{}", "0/0/0"))
        assert (tile.status, tile.headers["content-type"]) == (200, "image/webp")
        assert layer["west"] == pytest.approx(own[layer["name"]]["west"], abs=1e-6)
        same = ask(server, own[layer["name"]]["address"].replace("{}", "0/0/0"))
        assert same.body == tile.body


def test_a_survey_about_another_datum_lies_where_it_is(server: Server, tmp_path: Path) -> None:
    datum = {"latitude_deg": 32.8 + 1e-4, "longitude_deg": 34.9, "height_m": 0.0}
    tiny_workspace(tmp_path / "north", frame={"datum": datum})
    at = {
        name: call(server, "/api/compare/open", {"path": name}).json["layers"][0]
        for name in ("before", "north")
    }
    assert at["north"]["north"] - at["before"]["north"] == pytest.approx(11.09, abs=0.01)
    assert at["north"]["west"] == pytest.approx(at["before"]["west"], abs=0.01)


@pytest.mark.parametrize(
    "path", ["empty", "nowhere", "/etc", "before/dense", "a\0b", "", "x" * 3000]
)
def test_a_folder_that_is_no_survey_is_refused(server: Server, path: str) -> None:
    reply = call(server, "/api/compare/open", {"path": path})
    assert reply.status == 400 and len(reply.json["error"].splitlines()) == 1


def test_nothing_else_of_the_other_folder_can_be_read(server: Server, tmp_path: Path) -> None:
    (tmp_path / "before" / "secret.txt").write_text("secret")
    height = tmp_path / "before" / "dense" / "dem.tif"
    opened = call(server, "/api/compare/open", {"path": "before"}).json
    base = f"/api/compare/{opened['id']}"
    for rest in ("/tiles/secret/0/0/0.webp", "/tiles/..%2fsecret/0/0/0.webp",
                 "/tiles/mosaic/0/0/x.webp", "/tiles/mosaic/0/0/999999.webp",
                 "/files/secret.txt"):  # fmt: skip
        assert ask(server, base + rest).status in (400, 404)
    assert ask(server, "/api/compare/0123/tiles/mosaic/0/0/0.webp").status == 409
    kept = height.rename(tmp_path / "elsewhere.tif")
    height.symlink_to(kept)  # a link leads out of the folder
    assert ask(server, base + "/tiles/height/0/0/0.webp").status == 404


@pytest.mark.slow  # a whole survey is made first
def test_what_has_changed_is_found_and_mapped(small_survey: Path, tmp_path: Path) -> None:
    import shutil

    for name in ("now", "before"):
        shutil.copytree(small_survey, tmp_path / name)
    with rasterio.open(tmp_path / "before" / "dense" / "dem.tif", "r+") as raster:
        height = raster.read(1)
        rows, columns = np.mgrid[: height.shape[0], : height.shape[1]]
        away2 = (rows - 200) ** 2 + (columns - 210) ** 2
        raster.write(height - (0.03 * np.exp(-away2 / (2 * 14.0**2))).astype(np.float32), 1)
        cell = raster.transform.a
        east, north = raster.xy(200, 210)
    litres = 1e3 * 0.03 * 2 * np.pi * (14.0 * cell) ** 2
    with serving(tmp_path / "now") as server:
        opened = call(server, "/api/compare/open", {"path": "before"}).json
        assert ask(server, "/api/compare/results").json["results"] == []
        evaluate_against(tmp_path / "now", Path(opened["path"]))
        (result,) = ask(server, "/api/compare/results").json["results"]
        assert result["gained"]["volume_l"] == pytest.approx(litres, rel=0.1)
        region = result["regions"][0]
        assert (region["east_m"], region["north_m"]) == pytest.approx((east, north), abs=0.05)
        ring = np.array(region["outlines"][0])
        assert np.linalg.norm(ring - [east, north], axis=1).max() < 1.0
        assert {layer["name"] for layer in result["layers"]} == {"difference", "significance"}
        for layer in result["layers"]:
            assert not layer["base"]
            assert ask(server, layer["address"].replace("{}", "0/0/0")).status == 200
        assert ask(server, "/api/compare/results/..%2fx/tiles/difference/0/0/0.webp").status == 404
