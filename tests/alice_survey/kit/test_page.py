"""The report's page as text: strict, whole, and the same for the same report."""

import base64
import hashlib
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest

from alice_survey.kit.document import Report
from alice_survey.kit.map import map_extent
from alice_survey.kit.page import render_html
from tests.alice_survey.kit.sketch import RUDE, sketch_report

ROOT = Path(__file__).parents[3]
ROOM = ROOT / "alice_survey" / "kit"


class Elements(HTMLParser):
    """Tags with their attributes, and the text within scripts and styles."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.inline: list[tuple[str, dict[str, str | None], str]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))
        if tag in ("script", "style"):
            self.inline.append((tag, dict(attrs), ""))

    def handle_data(self, data: str) -> None:
        if self.found and self.found[-1][0] in ("script", "style") and self.cdata_elem:
            tag, attributes, text = self.inline[-1]
            self.inline[-1] = (tag, attributes, text + data)


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Report:
    return sketch_report(tmp_path_factory.mktemp("sketch"), side=600)


@pytest.fixture(scope="module")
def text(report: Report) -> str:
    return render_html(report)


def test_same_report_same_page(report: Report, text: str) -> None:
    assert render_html(report) == text


def test_texts_are_escaped(text: str) -> None:
    elements = Elements(text)
    assert RUDE not in text
    assert "&lt;img src=x onerror=" in text
    assert not [tag for tag, attributes in elements.found if attributes.get("src") == "x"]
    held = next(t for _, a, t in elements.inline if a.get("id") == "map-data")
    assert "<" not in held
    points = next(a for a in json.loads(held)["layers"] if a["name"] == "points")
    assert points["texts"][1] == f"Point B {RUDE}"


def test_nothing_is_loaded_from_elsewhere(text: str) -> None:
    for tag, attributes in Elements(text).found:
        assert "style" not in attributes, tag
        assert not [name for name in attributes if name.startswith("on")], tag
        for name in ("src", "href"):
            value = attributes.get(name)
            assert value is None or value.startswith(("data:image/", "data:,", "#")), (tag, value)


def test_policy_names_each_script_and_style(text: str) -> None:
    elements = Elements(text)
    policy = next(
        str(attributes["content"])
        for tag, attributes in elements.found
        if attributes.get("http-equiv") == "Content-Security-Policy"
    )
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert "http:" not in policy and "https:" not in policy
    runs = [t for tag, a, t in elements.inline if tag == "style" or "type" not in a]
    assert len(runs) == 2 + 5
    for held in runs:
        digest = base64.b64encode(hashlib.sha256(held.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in policy


def test_a_report_without_scenes_runs_nothing(report: Report) -> None:
    plain = replace(
        report, map=None, mesh=None, sections=[s for s in report.sections if s.scene is None]
    )
    text = render_html(plain)
    assert "script-src 'none'" in text
    assert "<script" not in text
    assert len(text) < 200_000


def test_every_tile_lies_in_its_text(report: Report, text: str) -> None:
    assert report.map is not None
    mosaic = report.map.layers[0]
    held = {a.get("id"): t for _, a, t in Elements(text).inline}
    about = json.loads(held["map-data"])["layers"][0]
    assert about["tiles"].keys() == mosaic.tiles.keys()
    for name, (at, length) in about["tiles"].items():
        packed = base64.b64decode(held[about["block"]][at : at + length], validate=True)
        assert packed == mosaic.tiles[name]


def test_extent_of_the_map(report: Report) -> None:
    assert report.map is not None
    # The mosaic goes from -2.2 m to 0.2 m east; footprints reach farther, but are not shown.
    assert map_extent(report.map) == pytest.approx((-2.2, -1.8, 2.0, 2.1))


def test_committed_libraries_are_those_of_the_lock() -> None:
    lock = json.loads((ROOM / "web" / "package-lock.json").read_text())["packages"]
    wanted = json.loads((ROOM / "web" / "package.json").read_text())["dependencies"]
    licences = (ROOM / "web" / "LICENCES").read_text()
    for file, name in (
        ("vendor_map.js", "leaflet"),
        ("vendor_map.css", "leaflet"),
        ("vendor_mesh.js", "three"),
    ):
        version = lock[f"node_modules/{name}"]["version"]
        assert wanted[name] == version
        assert (ROOM / "web" / file).read_text().startswith(f"/*! {name} {version} (")
        assert f"{name} {version}\n" in licences
        assert re.search(r"Copyright", (ROOM / "web" / file).read_text()[:400])
