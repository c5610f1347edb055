"""The Annotate tab's endpoints: what is put is there, for one writer; files come and go."""

import io
import json
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from alice_survey.app.studio.endpoints import annotate
from alice_survey.app.studio.server import Server
from tests.alice_survey.app.report.tiny import SLOPE, tiny_workspace
from tests.alice_survey.app.studio.client import ask, call, serving

LABELS = [
    {"id": "coral", "aphia_id": 1292, "colour": "#0072b2", "code": "C"},
    {"id": "sand", "aphia_id": None, "colour": "#e69f00", "code": "S"},
]


def square(name: str, side: float = 0.1, label: str = "coral") -> dict[str, Any]:
    corners = [[0.2, 0.3], [0.2 + side, 0.3], [0.2 + side, 0.3 + side], [0.2, 0.3 + side]]
    return {"id": name, "label": label, "shape": {"kind": "polygon", "points": corners},
            "image": None}  # fmt: skip


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    with serving(tiny_workspace(tmp_path / "reef")) as started:
        yield started


def measured(server: Server, query: str = "") -> dict[str, Any]:
    """Surfaces, asked for until all are there."""
    for _ in range(100):
        found: dict[str, Any] = ask(server, f"/api/annotations/surfaces{query}").json
        if found["done"] == found["total"]:
            return found
    raise AssertionError(found)


def change(server: Server, token: str, **values: Any) -> Any:
    return call(server, "/api/annotations/change", {"token": token, **values})


def test_what_is_put_is_there_and_a_second_page_does_not_overwrite_it(server: Server) -> None:
    empty = ask(server, "/api/annotations").json
    assert empty["token"] == "" and empty["annotations"] == [] and len(empty["colours"]) > 5
    first = change(server, "", labels=LABELS, put=[square("a")])
    assert first.status == 200
    late = change(server, "", put=[square("b")])
    assert late.status == 409 and "changed meanwhile" in late.json["error"]
    token = first.json["token"]
    second = change(server, token, put=[square("a", 0.2), square("b", label="sand")])
    found = ask(server, "/api/annotations").json
    assert [one["id"] for one in found["annotations"]] == ["a", "b"]
    assert found["annotations"][0]["shape"]["points"][1][0] == pytest.approx(0.4)
    third = change(server, second.json["token"], delete=["a"])
    assert third.status == 200
    assert [one["id"] for one in ask(server, "/api/annotations").json["annotations"]] == ["b"]


@pytest.mark.parametrize(
    "values",
    [
        {"put": [{**square("a"), "label": "unknown"}]},
        {"put": [{**square("a"), "id": "../x"}]},
        {"put": [{**square("a"), "shape": {"kind": "polygon", "points": [[0, 0], [1, 1]]}}]},
        {"put": [{**square("a"), "shape": {"kind": "blob", "points": [[0, 0]]}}]},
        {"labels": [*LABELS, LABELS[0]]},
        {"put": 3},
    ],
)
def test_a_wrong_change_is_one_line_and_changes_nothing(
    server: Server, values: dict[str, Any]
) -> None:
    token = change(server, "", labels=LABELS).json["token"]
    reply = change(server, token, **values)
    assert reply.status == 400 and len(reply.json["error"].splitlines()) == 1
    assert ask(server, "/api/annotations").json["token"] == token


def test_writes_need_the_token_of_the_studio(server: Server) -> None:
    for path in ("/api/annotations/change", "/api/annotations/import?format=coco&token="):
        assert call(server, path, {"token": ""}, token=None).status == 403


def test_areas_are_those_of_the_squares(server: Server) -> None:
    change(server, "", labels=LABELS, put=[square("a"), square("b", 0.3, "sand")])
    found = ask(server, "/api/annotations/table").json
    marks = {one["id"]: one for one in found["marks"]}
    assert marks["a"]["area"] == pytest.approx(0.01) and marks["b"]["area"] == pytest.approx(0.09)
    assert 0 < marks["a"]["sigma"] < marks["b"]["sigma"] < 0.01
    rows = {row["label"]: row for row in found["rows"]}
    assert rows["coral"]["count"] == 1
    assert rows["coral"]["cover"] == pytest.approx(0.01 / found["known"])
    by_quadrat = ask(server, "/api/annotations/table?quadrat=0.25").json["rows"]
    total = sum(row["area"] for row in by_quadrat if row["label"] == "coral")
    assert total == pytest.approx(0.01) and len({row["quadrat"] for row in by_quadrat}) > 1
    assert ask(server, "/api/annotations/table?quadrat=1e-6").status == 400


def test_surfaces_are_those_of_the_tilted_plane_and_follow_changes(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(annotate, "_TURN_S", 0.0)  # one for each request
    point = {**square("p"), "shape": {"kind": "point", "points": [[0.5, 0.5]]}}
    put = [square("a"), square("b", 0.3, "sand"), square("c", 0.2), point]
    token = change(server, "", labels=LABELS, put=put).json["token"]
    first = ask(server, "/api/annotations/surfaces").json
    assert (first["done"], first["total"]) == (1, 3) and "each" not in first
    found = measured(server)
    slant = np.sqrt(1 + SLOPE**2)
    surfaces = {one["id"]: one["surface"] for one in found["each"]}
    assert surfaces.pop("p") is None and list(surfaces) == ["a", "b", "c"]
    for name, area in (("a", 0.01), ("b", 0.09), ("c", 0.04)):
        assert surfaces[name] == pytest.approx(slant * area, rel=1e-3)
    rows = {row["label"]: row for row in found["rows"]}
    assert rows["coral"]["surface"] == pytest.approx(surfaces["a"] + surfaces["c"], abs=1e-8)
    assert rows["coral"]["rugosity"] == pytest.approx(slant, rel=1e-3)
    again = change(server, token, put=[square("c", 0.25)], delete=["a"])
    left = ask(server, "/api/annotations/surfaces").json  # what stayed is not measured again
    assert (left["done"], left["total"]) == (2, 2) and again.status == 200
    surfaces = {one["id"]: one["surface"] for one in left["each"]}
    assert surfaces["c"] == pytest.approx(slant * 0.0625, rel=1e-3)
    by_quadrat = measured(server, "?quadrat=0.25")["rows"]
    parts = [row["surface"] for row in by_quadrat if row["label"] == "sand" and row["area"]]
    assert len(parts) > 1 and sum(parts) == pytest.approx(surfaces["b"], rel=1e-6)


@pytest.mark.parametrize("name", ["taglab", "coco", "biigle", "geojson"])
def test_files_go_and_come_back(server: Server, name: str) -> None:
    assert ask(server, f"/api/annotations/export/{name}").status == 400  # nothing to write
    token = change(server, "", labels=LABELS, put=[square("a")]).json["token"]
    reply = ask(server, f"/api/annotations/export/{name}")
    assert reply.status == 200 and name in reply.headers["content-disposition"]
    if name == "geojson":
        assert len(reply.json["features"]) == 1
        return
    data = reply.body
    if name == "biigle":
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            assert sorted(archive.namelist()) == ["biigle.csv", "biigle_labels.csv"]
            data = archive.read("biigle.csv")
    path = f"/api/annotations/import?format={name}&token={token}"
    again = call(server, path, data)
    assert again.status == 200 and "1 were there already" in again.json["text"]
    gone = change(server, again.json["token"], delete=["a"]).json["token"]
    back = call(server, f"/api/annotations/import?format={name}&token={gone}", data)
    assert "1 annotations" in back.json["text"]
    (one,) = ask(server, "/api/annotations").json["annotations"]
    np.testing.assert_allclose(one["shape"]["points"], square("a")["shape"]["points"], atol=1e-9)


def test_a_file_of_no_tool_is_one_line(server: Server) -> None:
    for format_name, data in (("coco", b"{"), ("coco", b"[]"), ("taglab", b"{}"), ("none", b"{}"),
                              ("biigle", b"a,b\n1,2\n")):  # fmt: skip
        reply = call(server, f"/api/annotations/import?format={format_name}&token=", data)
        assert reply.status in (400, 500) and len(reply.json["error"].splitlines()) == 1


@pytest.mark.slow  # a whole survey is made first
def test_an_annotation_is_shown_in_the_pictures_that_see_it(
    small_survey: Path, tmp_path: Path
) -> None:
    import shutil

    folder = tmp_path / "survey"
    shutil.copytree(small_survey, folder)
    box = [[0.6, 0.7], [0.8, 0.7], [0.8, 0.9], [0.6, 0.9]]
    mark = square("a") | {"shape": {"kind": "polygon", "points": box}}
    with serving(folder) as server:
        change(server, "", labels=LABELS, put=[mark])
        found = ask(server, "/api/annotations/a/pictures").json
        assert len(found["pictures"]) > 2 and 0 < found["sigma"] < 0.01
        for shown in found["pictures"]:
            left, top, width, height = shown["crop"]
            ring = np.array(shown["rings"][0])
            inside = (ring >= [left, top]) & (ring <= [left + width, top + height])
            assert inside.all(axis=1).mean() >= 0.5 and 0 < shown["sigma_px"] < 3
        assert ask(server, "/api/annotations/nothing/pictures").status == 404
        (one,) = measured(server)["each"]
        asked = call(server, "/api/model/measure", {"kind": "polygon", "places": box}).json
        for name, figure in zip(("surface", "rugosity"), asked["figures"][1:3], strict=True):
            assert one[name] == pytest.approx(figure["value"], abs=1e-6)
            # how it was drawn counts as well
            assert figure["sigma"] < one[f"{name}_sigma"] < 0.05 * one[name]
        assert one["sigma"] < one["surface_sigma"] < 2 * one["sigma"]
        taken = found["pictures"][0]
        inner = {**mark, "id": "q", "image": taken["image"],
                 "shape": {"kind": "polygon", "points": taken["rings"][0]}}  # fmt: skip
        token = ask(server, "/api/annotations").json["token"]
        assert change(server, token, put=[inner]).status == 200
        first, second = measured(server)["each"]
        for name, off in (("area", 0.002), ("surface", 0.01), ("rugosity", 0.01)):
            assert second[name] == pytest.approx(first[name], rel=off)


def test_a_survey_without_a_mosaic_says_so(tmp_path: Path) -> None:
    with serving(tmp_path) as server:
        assert ask(server, "/api/annotations").json["annotations"] == []
        reply = ask(server, "/api/annotations/table")
        assert reply.status == 400 and "mosaic" in reply.json["error"]
        assert ask(server, "/api/annotations/surfaces").status == 400
    assert json.loads(reply.body)["error"]
