"""The endpoints of the Run tab and of the first start, over the wire."""

import base64
import json
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from alice_survey.app.stages import STAGES
from alice_survey.app.studio.endpoints import start as start_page
from alice_survey.app.studio.endpoints.start import Folders
from alice_survey.app.studio.jobs import Jobs
from alice_survey.app.studio.server import Server
from alice_survey.core.config import load_config
from tests.alice_survey.app.studio.client import Reply, ask, call, refused, serving
from tests.alice_survey.app.studio.test_jobs import PROGRAM
from tests.engines import until
from tests.reconstruct.pictures.dated import navigation, take
from tests.small_survey import settings_in

AREA = {
    "type": "Feature", "properties": {},
    "geometry": {"type": "Polygon", "coordinates": [
        [[5.92, 43.05], [5.9202, 43.05], [5.9202, 43.0501], [5.92, 43.0501], [5.92, 43.05]]
    ]},
}  # fmt: skip


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    """A studio of a folder that does not exist yet, whose commands are those of `test_jobs`."""
    with serving(tmp_path / "reef") as server:
        studio = server.studio
        vars(studio)["jobs"] = Jobs(
            studio.workspace.folder, studio.publish, [sys.executable, "-c", PROGRAM]
        )
        yield server


def run_state(server: Server) -> Any:
    reply = ask(server, "/api/run")
    assert reply.status == 200
    return reply.json


def ended(server: Server) -> Any:
    until(lambda: run_state(server)["job"] is None, 120.0)
    return run_state(server)["last"]


def started(server: Server, name: str, **arguments: Any) -> Reply:
    return call(server, "/api/run/start", {"name": name, "arguments": arguments})


def test_a_job_from_its_start_to_its_end(server: Server) -> None:
    assert run_state(server)["job"] is run_state(server)["last"] is None
    reply = started(server, "plan")
    assert (reply.status, reply.json["job"]["name"]) == (200, "plan")
    assert reply.json["job"]["command"].startswith("alice-survey plan --workspace=")
    refused = started(server, "fly")
    assert refused.status == 409 and "alice-survey plan" in refused.json["error"]
    until(lambda: ask(server, "/api/run/log?job=1").json["total"] > 2)
    log = ask(server, "/api/run/log?job=1&after=1").json
    assert log["lines"][0]["text"].endswith("plan")
    assert call(server, "/api/run/stop").json == {"stopping": True}
    assert ended(server)["state"] == "stopped"
    assert call(server, "/api/run/stop").json == {"stopping": False}
    assert run_state(server)["last"]["exit_code"] == 130


def test_a_fault_shows_its_line_and_the_way_on(server: Server) -> None:
    started(server, "fly")
    last = ended(server)
    assert (last["state"], last["line"]) == (
        "failed", "no plan: run 'alice-survey plan -w reef' first",
    )  # fmt: skip
    assert [(way["name"], way["title"]) for way in last["ways"]] == [("plan", "Plan the survey")]


@pytest.mark.parametrize(
    "path", ["run/start", "run/stop", "start/folders", "start/preview", "start/survey"]
)
def test_nothing_without_the_token(server: Server, tmp_path: Path, path: str) -> None:
    for token in (None, "wrong"):
        assert call(server, f"/api/{path}", {"name": "plan"}, token=token).status == 403
    assert ask(server, f"/api/{path}").status in (404, 405)
    assert not (tmp_path / "reef").exists()


@pytest.mark.parametrize(
    "body",
    [
        {"name": "rm"}, {"name": "plan --help"}, {"name": "plan", "arguments": {"survey": "/x"}},
        {"name": "plan", "arguments": ["-w", "/"]}, {"name": "plan", "program": "/bin/sh"},
        {"name": "import-images", "arguments": {"folders": ["--help"]}}, {}, [],
    ],
)  # fmt: skip
def test_what_is_not_of_the_list_is_refused(server: Server, body: Any) -> None:
    refused(call(server, "/api/run/start", body))
    assert run_state(server)["last"] is None


def test_the_stages_of_a_survey_and_what_they_need(server: Server, tmp_path: Path) -> None:
    found = run_state(server)
    assert found["new"] and found["disk"]["free_gb"] > 0 and not found["stages"]
    settings_in(tmp_path / "reef")
    found = run_state(server)
    assert not found["new"] and found["fault"] is None
    assert [one["name"] for one in found["stages"]] == [stage.name for stage in STAGES]
    assert {one["state"] for one in found["stages"]} == {"missing"}
    commands = {one["name"]: one for one in found["commands"]}
    assert commands["run"]["after"] == commands["plan"]["after"] == []
    assert commands["fly"]["after"] == ["plan"] and "image" in commands["reconstruct"]["after"]
    assert "import-images" not in commands
    (tmp_path / "reef" / "survey.toml").write_text("[area]\nlength_m = -1\n")
    fault = run_state(server)["fault"]
    assert fault is not None and "length_m" in fault and "\n" not in fault


def test_a_survey_is_begun_from_its_place_and_depth(server: Server, tmp_path: Path) -> None:
    values = {
        "name": "Reef 2", "latitude_deg": 43.05, "longitude_deg": 5.92, "seafloor_depth_m": 22.5,
        "length_m": 8.0, "width_m": 6.0, "focal_mm": 25.0,
    }  # fmt: skip
    wrong = [
        values | {"latitude_deg": 99}, values | {"longitude_deg": None},
        values | {"name": "a\nb = 1"}, values | {"seafloor_depth_m": -3}, values | {"camera": 1},
    ]  # fmt: skip
    for one in wrong:
        refused(call(server, "/api/start/survey", one))
        assert not (tmp_path / "reef" / "survey.toml").exists()
    assert call(server, "/api/start/survey", values).status == 200
    made = load_config(tmp_path / "reef" / "survey.toml")
    own = {"name": made.name, "focal_mm": made.camera.focal_mm}
    assert vars(made.area) | own | values == vars(made.area) | own
    assert (made.imaging.scale, made.reconstruct.max_features) == (1, 8000)
    assert call(server, "/api/start/survey", values).status == 409  # there is one now
    assert load_config(tmp_path / "reef" / "survey.toml") == made


def test_a_survey_is_begun_from_a_file_that_was_chosen(server: Server, tmp_path: Path) -> None:
    def chosen(name: str, content: bytes, damage: str = "") -> Reply:
        area = {"name": name, "base64": damage + base64.b64encode(content).decode()}
        return call(
            server, "/api/start/survey", {"name": "Reef", "seafloor_depth_m": 9, "area": area}
        )

    good = json.dumps(AREA).encode()
    for name, content in (
        ("reef.geojson", b"{}"), ("reef.geojson", b""), ("reef.exe", good), ("reef", good),
        ("reef.shp", good), ("reef.kml", good),
    ):  # fmt: skip
        assert chosen(name, content).status == 400
        assert {path.name for path in (tmp_path / "reef").glob("*")} <= {".lock", ".studio"}
    assert "choose it again" in chosen("reef.geojson", good, damage="?*").json["error"]
    assert chosen("../../My reef.GeoJSON", good).status == 200
    made = load_config(tmp_path / "reef" / "survey.toml")
    assert made.area.file == tmp_path / "reef" / "area.geojson"
    assert made.area.file.read_bytes() == good and made.area.datum_given == []
    assert made.area.seafloor_depth_m == 9


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A home with a dive in it."""
    home = tmp_path / "home"
    for n in range(4):
        take(home / "dive" / "left" / f"{n}.jpg", n)
        take(home / "dive" / "right" / f"{n}.jpg", 50 + n)
    navigation(home / "dive" / "nav.csv", 60)
    monkeypatch.setattr(start_page, "Folders", lambda: Folders(home))
    return home


def test_a_preview_tells_a_rig_from_one_camera(home: Path, server: Server) -> None:
    dive = str(home / "dive")
    rig = call(server, "/api/start/preview", {"folders": [dive]}).json
    assert list(rig["rig_folders"]) == ["left", "right"]
    assert {n: one["pictures"] for n, one in rig["cameras"].items()} == {"left": 4, "right": 4}
    one = call(server, "/api/start/preview", {"folders": [dive], "recursive": True}).json
    assert one["rig_folders"] == {} and [c["pictures"] for c in one["cameras"].values()] == [8]
    log = str(home / "dive" / "nav.csv")
    tied = call(server, "/api/start/preview", {"folders": [dive + "/left"], "navigation": log}).json
    assert "4 of 4 picture times" in tied["navigation"]
    for wrong in ({"folders": [str(home)]}, {"folders": ["left"]}, {"folders": [dive], "rig": log}):
        refused(call(server, "/api/start/preview", wrong))


@pytest.mark.slow
def test_pictures_are_imported_as_a_job(home: Path, tmp_path: Path) -> None:
    folder = str(home / "dive" / "left")
    with serving(tmp_path / "w") as server:
        began = started(server, "import-images", folders=[folder])
        assert began.status == 200, began.text
        last = ended(server)
        assert last["state"] == "done" and last["line"].startswith("4 pictures (4 JPEG)")
        found = run_state(server)
        assert found["imported"] and not found["new"]
        names = [one["name"] for one in found["commands"]]
        assert names == ["reconstruct", "report"]


@pytest.mark.slow
def test_a_failed_import_may_be_begun_again(home: Path, tmp_path: Path) -> None:
    (home / "one").mkdir()
    shutil.copy(home / "dive" / "left" / "0.jpg", home / "one")
    with serving(tmp_path / "w") as server:
        for _ in range(2):
            assert started(server, "import-images", folders=[str(home / "one")]).status == 200
            last = ended(server)
            assert last["state"] == "failed" and "1 usable picture" in last["line"]
            assert run_state(server)["new"]
        again = started(server, "import-images", folders=[str(home / "dive" / "left")])
        assert again.status == 200 and ended(server)["state"] == "done"
    assert not (tmp_path / "w" / "survey.toml").exists()
