"""What the tab of the model asks for, on a tilted plane with a hole."""

import csv
import io
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from alice_survey.app.studio.server import Server
from alice_survey.core.artefacts import write_json
from alice_survey.core.frames import Datum
from tests.alice_survey.app.report.tiny import CELL_M, SIGMA_M, SLOPE, plane_of, tiny_workspace
from tests.alice_survey.app.studio.client import Reply, ask, call, refused, serving

RISE = math.hypot(1.0, SLOPE)
LINE = [[0.2, 0.6], [0.6, 0.6]]


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with serving(tiny_workspace(tmp_path_factory.mktemp("model"))) as started:
        yield started


def sent(server: Server, name: str, **asked: Any) -> Reply:
    return call(server, f"/api/model/{name}", asked, token=None)


def measured(server: Server, **asked: Any) -> Any:
    reply = sent(server, "measure", **asked)
    assert reply.status == 200, reply.text
    return reply.json


def named(answer: Any) -> dict[str, Any]:
    return {one["name"]: one for one in answer["figures"]}


def test_a_place_has_the_value_of_every_raster(server: Server) -> None:
    answer = ask(server, "/api/model/value?east=0.305&north=0.605").json
    found = {row["title"]: row for row in answer["values"]}
    assert found["Height"]["value"] == pytest.approx(SLOPE * 0.305 - 10.0, abs=1e-5)
    assert found["Sigma of height"]["value"] == pytest.approx(1e3 * SIGMA_M)
    assert found["Sigma of height"]["unit"] == "mm"
    assert len(found["Mosaic"]["value"]) == 3
    nothing = ask(server, "/api/model/value?east=5&north=0.6").json
    assert nothing["values"] == []
    assert ask(server, "/api/model/value?east=x&north=0.6").status == 400


def test_a_line_a_polygon_and_points_are_measured(server: Server) -> None:
    line = named(measured(server, kind="line", places=LINE))
    assert line["length"]["value"] == pytest.approx(0.4 * RISE, rel=1e-5)
    assert line["height_difference"]["value"] == pytest.approx(0.4 * SLOPE, abs=1e-5)
    assert 0.5 * SIGMA_M < line["height_difference"]["sigma"] < 2 * SIGMA_M
    corners = [[0.3, 0.3], [0.7, 0.3], [0.7, 0.8], [0.3, 0.8]]
    area = named(measured(server, kind="polygon", places=corners, base=-10.0))
    assert area["rugosity"]["value"] == pytest.approx(RISE, rel=1e-4)
    assert area["volume"]["value"] == pytest.approx(0.2 * 0.5 * SLOPE, rel=1e-4)
    assert area["aspect"]["value"] == pytest.approx(270.0, abs=0.1)
    assert "volume" not in named(measured(server, kind="polygon", places=corners))
    rim = named(measured(server, kind="polygon", places=corners, base="rim"))
    assert abs(rim["volume"]["value"]) < 1e-6
    up = [[0.2, 0.6, SLOPE * 0.2 - 10.0], [0.6, 0.6, SLOPE * 0.6 - 10.0]]
    points = measured(server, kind="points", places=up)
    assert named(points)["length"]["value"] == pytest.approx(line["length"]["value"], rel=1e-5)
    assert not points["notes"]
    up[1][2] += 0.3
    assert measured(server, kind="points", places=up)["notes"]


def test_what_cannot_be_measured_is_one_line(server: Server) -> None:
    for asked in (
        {"kind": "line", "places": [[0.2, 0.6], [9.0, 0.6]]},
        {"kind": "line", "places": [[0.2, 0.6]]},
        {"kind": "line", "places": [[0.2, 0.6, 1.0], [0.3, 0.6, 1.0]]},
        {"kind": "points", "places": [[0.2, 0.6], [0.3, 0.6]]},
        {"kind": "polygon", "places": [[0.2, 0.2], [0.4, 0.4], [0.4, 0.2], [0.2, 0.4]]},
        {"kind": "circle", "places": [[0.2, 0.6], [0.3, 0.6]]},
        {"kind": "line", "places": [[0.2, None], [0.3, 0.6]]},
    ):
        refused(call(server, "/api/model/measure", asked, token=None))


def test_a_profile_follows_the_plane_and_says_where_nothing_is_known(server: Server) -> None:
    reply = call(server, "/api/model/profile", {"places": [[0.1, 0.1], [0.7, 0.1]]}, token=None)
    found = reply.json
    places = np.array(found["places"])
    heights = np.array([math.nan if h is None else h for h in found["height"]])
    known = np.isfinite(heights)
    assert 0.6 < known.mean() < 0.95  # the hole
    np.testing.assert_allclose(heights[known], SLOPE * places[known, 0] - 10.0, atol=1e-5)
    sigma = np.array([math.nan if s is None else s for s in found["sigma"]])[known]
    assert np.all((sigma > 0.4 * SIGMA_M) & (sigma < 1.01 * SIGMA_M))
    assert found["corners"] == [0.0, pytest.approx(0.6)]
    assert np.diff(found["along"]).max() <= CELL_M * (1 + 1e-9)


def test_measures_are_exported_with_names_that_no_spreadsheet_runs(server: Server) -> None:
    answer = measured(server, kind="polygon", places=[[0.3, 0.3], [0.3, 0.8], [0.7, 0.3]])
    measure = {"name": "=1+1", "kind": "polygon", "places": [[0.3, 0.3], [0.3, 0.8], [0.7, 0.3]],
               "figures": answer["figures"], "notes": ["a note"]}  # fmt: skip
    reply = call(server, "/api/model/export", {"form": "csv", "measures": [measure]}, token=None)
    assert reply.headers["content-type"].startswith("text/csv")
    rows = list(csv.DictReader(io.StringIO(reply.text)))
    assert len(rows) == len(answer["figures"])
    assert {row["name"] for row in rows} == {"'=1+1"}
    by_title = {row["figure"]: row for row in rows}
    for one in answer["figures"]:
        assert float(by_title[one["title"]]["value"]) == pytest.approx(one["value"], rel=1e-6)
        assert float(by_title[one["title"]]["sigma"]) == pytest.approx(one["sigma"], rel=1e-6)
    assert rows[0]["places"] == "POLYGON ((0.3 0.3, 0.3 0.8, 0.7 0.3, 0.3 0.3))"
    reply = sent(server, "export", form="geojson", measures=[measure])
    (feature,) = json.loads(reply.text)["features"]
    ring = np.array(feature["geometry"]["coordinates"][0])
    datum = Datum(32.8, 34.9, 0.0)
    ned = datum.ned_from_geodetic(np.column_stack([ring[:, 1::-1], np.zeros(len(ring))]))
    corners = {tuple(corner) for corner in ned[:, :2].round(3).tolist()}
    assert corners == {(0.3, 0.3), (0.3, 0.7), (0.8, 0.3)}
    north, east = ned[:, 0], ned[:, 1]
    assert (east[:-1] * north[1:] - east[1:] * north[:-1]).sum() > 0  # as RFC 7946 turns it
    assert feature["properties"]["rugosity"] == pytest.approx(RISE, rel=1e-4)
    for wrong in ({"form": "xls", "measures": [measure]}, {"form": "csv", "measures": []}):
        assert call(server, "/api/model/export", wrong, token=None).status == 400


def test_a_model_without_scale_is_in_its_own_units(tmp_path: Path) -> None:
    with serving(tiny_workspace(tmp_path, scaled=False, placed=False)) as server:
        assert ask(server, "/api/state").json["unit"] == "unit"
        line = named(measured(server, kind="line", places=LINE))
        assert line["length"]["unit"] == "model units"
        assert line["length"]["value"] == pytest.approx(0.4 * RISE, rel=1e-5)
        measure = {"name": "a", "kind": "line", "places": LINE,
                   "figures": list(line.values())}  # fmt: skip
        found = sent(server, "export", form="geojson", measures=[measure]).json
        assert "not longitude" in found["coordinates"]
        assert found["features"][0]["geometry"]["coordinates"] == LINE


def test_a_plane_that_is_not_level_has_its_own_axes(tmp_path: Path) -> None:
    folder = tiny_workspace(tmp_path)
    write_json(folder / "dense" / "plane.json", plane_of("wall"))
    with serving(folder) as server:
        assert ask(server, "/api/state").json["axes"] == ["right", "up"]
        line = named(measured(server, kind="line", places=LINE))
        assert line["length"]["value"] == pytest.approx(0.4 * RISE, rel=1e-5)


def test_no_link_leads_out_of_the_workspace(tmp_path: Path) -> None:
    folder = tiny_workspace(tmp_path / "reef")
    sigma = folder / "dense" / "sigma.tif"
    sigma.rename(tmp_path / "elsewhere.tif")
    sigma.symlink_to(tmp_path / "elsewhere.tif")
    with serving(folder) as server:
        assert "sigma.tif" in refused(sent(server, "measure", kind="line", places=LINE))


def test_without_a_surface_nothing_is_here(tmp_path: Path) -> None:
    with serving(tmp_path) as server:
        assert sent(server, "profile", places=LINE).status == 404
        assert ask(server, "/api/model/mesh").status == 404
