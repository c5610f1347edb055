import json
import re
from html import unescape
from pathlib import Path

import pytest
from PIL import Image
from pypdf import PdfReader

from alice_survey.app.report.held import Held
from alice_survey.app.report.sections import _planes
from alice_survey.app.stages import spec
from alice_survey.core.artefacts import write_json
from alice_survey.core.config import SurveyConfig
from alice_survey.core.executor import SERIAL
from tests.alice_survey.app.report.tiny import plane_of, tiny_workspace


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    workspace = tiny_workspace(tmp_path_factory.mktemp("tiny"))
    assert spec("report").make(workspace, SurveyConfig(), SERIAL)
    return workspace


def words(text: str) -> str:
    return re.sub(r"[\s\u00ad\u200b]+", "", text)


def test_page_and_pdf_say_the_same(workspace: Path) -> None:
    page = (workspace / "report" / "report.html").read_text(encoding="utf-8")
    said = json.loads((workspace / "report" / "report.json").read_text())
    reader = PdfReader(workspace / "report" / "report.pdf")
    printed = words("".join(sheet.extract_text() for sheet in reader.pages))
    shown = words(unescape(re.sub(r"<[^>]*>", " ", page)))
    sentences = [*said["summary"].values(), *(verdict["text"] for verdict in said["verdicts"])]
    assert len(sentences) > 5
    for sentence in sentences:
        assert words(sentence) in shown, sentence
        assert words(sentence) in printed, sentence
    cells = re.findall(r"<(?:td|th|h2|h3)[^>]*>(.*?)</(?:td|th|h2|h3)>", page, re.DOTALL)
    texts = {words(unescape(re.sub(r"<[^>]*>", "", cell))) for cell in cells}
    assert len(texts) > 30
    missing = {cell for cell in texts if cell not in printed}
    assert missing <= {"Contents", "Verdicts", "Keyfigures"}, missing


def test_the_same_workspace_gives_the_same_bytes(workspace: Path) -> None:
    folder = workspace / "report"
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    (folder / "stage.json").unlink()
    assert spec("report").make(workspace, SurveyConfig(), SERIAL)
    for name in ("report.html", "report.pdf", "report.json"):
        assert (folder / name).read_bytes() == before[name], name


def test_a_report_is_made_again_only_when_something_has_changed(workspace: Path) -> None:
    assert not spec("report").make(workspace, SurveyConfig(), SERIAL)
    path = workspace / "sparse" / "registration.json"
    text = path.read_text()
    path.write_text(text.replace('"total": 4', '"total": 5'))
    assert spec("report").make(workspace, SurveyConfig(), SERIAL)
    assert "4 of 5" in (workspace / "report" / "report.html").read_text()
    path.write_text(text)
    assert spec("report").make(workspace, SurveyConfig(), SERIAL)


@pytest.mark.parametrize(("scaled", "unit"), [(False, "unit"), (True, "m")])
def test_a_model_without_a_place_is_reported(tmp_path: Path, scaled: bool, unit: str) -> None:
    workspace = tiny_workspace(tmp_path, scaled=scaled, placed=False)
    (workspace / "plan" / "stage.json").unlink()
    assert spec("report").make(workspace, SurveyConfig(), SERIAL)
    data = json.loads((workspace / "report" / "report.json").read_text())
    assert data["unit"] == unit
    page = (workspace / "report" / "report.html").read_text(encoding="utf-8")
    assert f"{unit}² of surface" in page
    shown = json.loads(re.findall(r'id="map-data">(.*?)</script>', page)[0])
    cameras = next(layer for layer in shown["layers"] if layer["name"] == "cameras")
    # As in its rasters, a model's own y goes to the right and its x up.
    assert cameras["shapes"][0] == [[0.4, 0.3]]
    assert shown["axes"] == ["y", "x"]


def test_a_survey_of_a_wall_alone_is_reported_on_its_own_axes(tmp_path: Path) -> None:
    workspace = tiny_workspace(tmp_path)
    write_json(workspace / "dense" / "plane.json", plane_of("wall", "0"))
    assert spec("report").make(workspace, SurveyConfig(), SERIAL)
    page = (workspace / "report" / "report.html").read_text(encoding="utf-8")
    shown = json.loads(re.findall(r'id="map-data">(.*?)</script>', page)[0])
    names = {layer["name"] for layer in shown["layers"]}
    assert names.isdisjoint({"cameras", "footprints", "plan"})
    assert shown["axes"] == ["right", "up"]
    assert "sea floor" not in page.lower()
    data = json.loads((workspace / "report" / "report.json").read_text())
    assert data["surface"]["covered"] is None


def test_that_no_picture_looks_at_a_plane_is_known_from_a_mosaic_alone(tmp_path: Path) -> None:
    folder = tiny_workspace(tmp_path) / "dense" / "planes" / "wall"
    write_json(folder / "plane.json", plane_of("wall"))
    Image.new("L", (9, 9)).save(folder / "dem.png")
    surface = "Surface over the plane: facing 180 deg, tilt 0 deg."
    for more in (" No picture looks at it.", ""):
        assert [one.shows for one in _planes(Held.of(tmp_path))] == [surface + more]
        (tmp_path / "mosaic" / "stage.json").unlink(missing_ok=True)


def test_a_plan_alone_is_reported(tmp_path: Path) -> None:
    workspace = tiny_workspace(tmp_path)
    for stage in ("images", "mapping", "sparse", "dense", "mosaic"):
        (workspace / stage / "stage.json").unlink()
    assert spec("report").make(workspace, SurveyConfig(), SERIAL)
    said = json.loads((workspace / "report" / "report.json").read_text())["summary"]
    assert "1 line" in said["What was mapped"]
