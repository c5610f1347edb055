"""The tab Plan: drafts planned and saved as the command line would, and nothing lost."""

import io
import json
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from alice_survey.app.pipeline import run, template_text
from alice_survey.app.studio.server import Server
from alice_survey.core.artefacts import read_json
from alice_survey.core.errors import collected_by
from alice_survey.core.executor import local_executor
from tests.alice_survey.app.studio.client import ask, call, refused, serving

SQUARE = [[0, 0], [6, 0], [6, 5], [0, 5]]
DRAWN = {
    "survey": [{"outer": SQUARE, "holes": [[[2, 2], [2.5, 2], [2.5, 2.5]]]}],
    "no_go": [{"outer": [[4, 3], [4.5, 3], [4.5, 3.5]]}],
}
EDITS: dict[str, dict[str, Any]] = {
    "settings": {
        "changes": {"plan": {"altitude_m": 2.25, "cross_lines": 2, "line_spacing_m": None}}
    },
    "drawn": {"shapes": DRAWN, "changes": {"plan": {"speed_mps": 0.25}}},
    "corridor": {"shapes": {"corridors": [[[0, 0], [6, 2], [9, 9]]]},
                 "changes": {"area": {"corridor_width_m": 3}, "vehicle": {"name": "sparus2"}}},
}  # fmt: skip


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    """A survey of 6 x 5 m that is not planned yet."""
    text = template_text().replace("length_m = 15.0", "length_m = 6.0")
    (tmp_path / "reef").mkdir()
    (tmp_path / "reef" / "survey.toml").write_text(text.replace("width_m = 17.0", "width_m = 5.0"))
    return tmp_path / "reef"


@pytest.fixture
def server(workspace: Path) -> Iterator[Server]:
    with serving(workspace) as found:
        yield found


def get(server: Server) -> Any:
    reply = ask(server, "/api/plan")
    assert reply.status == 200, reply.text
    return reply.json


def post(server: Server, name: str, body: Any, **options: Any) -> Any:
    reply = call(server, f"/api/plan/{name}", body, **options)
    assert reply.status == 200, reply.text
    return reply.json


def files_of(folder: Path) -> dict[str, bytes]:
    """All files of a stage but its record."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in ("stage.json", ".lock")
    }


def assert_planned_as_by_command(workspace: Path, elsewhere: Path) -> None:
    """The plan is byte by byte the one of the command line on a copy of the saved settings."""
    elsewhere.mkdir()
    for file in workspace.glob("*.*"):
        if file.is_file() and not file.name.startswith("."):
            shutil.copy(file, elsewhere)
    with collected_by(lambda *_: None):
        run(["plan"], elsewhere, None, executor=local_executor(1))
    assert files_of(workspace / "plan") == files_of(elsewhere / "plan")
    one, other = (read_json(folder / "plan" / "stage.json") for folder in (workspace, elsewhere))
    assert (one["version"], one["settings"]) == (other["version"], other["settings"])
    digests = [
        {name: (size, digest) for name, (size, _, digest) in record["inputs"].items()}
        for record in (one, other)
    ]
    assert digests[0] == digests[1]


@pytest.mark.parametrize(
    "edit", [pytest.param(e, marks=pytest.mark.slow if e != "corridor" else ()) for e in EDITS]
)
def test_a_saved_plan_is_the_command_lines(
    workspace: Path, server: Server, tmp_path: Path, edit: str
) -> None:
    before = (workspace / "survey.toml").read_bytes()
    shown = post(server, "preview", EDITS[edit])
    assert shown["ok"], shown
    assert (workspace / "survey.toml").read_bytes() == before
    assert not (workspace / "plan").exists()

    saved = post(server, "save", {**EDITS[edit], "token": get(server)["token"]})
    assert (workspace / "survey.toml").read_bytes() != before
    assert saved["saved"] | {"cpu_s": 0} == shown | {"cpu_s": 0}
    assert_planned_as_by_command(workspace, tmp_path / "copy")
    plan = read_json(workspace / "plan" / "plan.json")
    assert shown["totals"]["duration_s"] == plan["duration_s"]
    now = get(server)
    assert (now["token"], now["stage"]) == (saved["token"], "up to date")
    again = post(server, "preview", {"shapes": now["shapes"]})
    assert again | {"cpu_s": 0} == shown | {"cpu_s": 0}


@pytest.mark.slow
def test_a_new_survey_starts_from_the_commented_settings(tmp_path: Path) -> None:
    with serving(tmp_path) as server:
        found = get(server)
        assert (found["token"], found["saved"], found["stage"]) == ("", None, "missing")
        assert not any(found["shapes"].values())
        assert found["settings"]["plan"]["altitude_m"] == 2.0
        assert not (tmp_path / "survey.toml").exists()
        body = {"shapes": {"survey": [{"outer": SQUARE}]}, "token": ""}
        assert post(server, "preview", body)["ok"]
        saved = post(server, "save", body)
        assert saved["saved"]["ok"] and saved["token"]
        assert call(server, "/api/plan/save", body).status == 409
    text = (tmp_path / "survey.toml").read_text()
    new = [line for line in text.splitlines() if line not in template_text().splitlines()]
    assert new == ["polygon_ne_m = [[0.0, 0.0], [6.0, 0.0], [6.0, 5.0], [0.0, 5.0]]"]
    assert_planned_as_by_command(tmp_path, tmp_path.with_name("copy"))


def test_the_second_of_two_writers_is_refused(workspace: Path, server: Server) -> None:
    token = get(server)["token"]
    post(server, "save", {"changes": {"plan": {"altitude_m": 2.5}}, "token": token})
    kept = files_of(workspace)
    for body in ({"changes": {"plan": {"altitude_m": 1.5}}, "token": token}, {}, {"token": ""}):
        reply = call(server, "/api/plan/save", body)
        assert reply.status == 409 and "changed meanwhile" in reply.json["error"]
    assert call(server, "/api/plan/save", {"token": token}, token=None).status == 403
    assert files_of(workspace) == kept
    (workspace / "survey.toml").write_text("[plan]\naltitude_m = 1.75\n")  # by hand
    assert get(server)["settings"]["plan"]["altitude_m"] == 1.75
    assert get(server)["saved"]["totals"]["altitude_m"] == 1.75


def test_what_cannot_be_planned_is_saved_and_said(workspace: Path, server: Server) -> None:
    body = {"changes": {"area": {"seafloor_depth_m": 1.5}}, "token": get(server)["token"]}
    saved = post(server, "save", body)
    assert not saved["saved"]["ok"] and "altitude_m" in saved["saved"]["error"]
    assert "\nseafloor_depth_m = 1.5 " in (workspace / "survey.toml").read_text()
    assert not (workspace / "plan").exists()
    assert get(server)["saved"] | {"cpu_s": 0} == saved["saved"] | {"cpu_s": 0}


def test_a_conflict_comes_with_a_change_that_solves_it(server: Server) -> None:
    changes = {"plan": {"forward_overlap": 0.95, "speed_mps": 1.2}}
    found = post(server, "preview", {"changes": changes})
    assert not found["ok"]
    changes["plan"] |= found["suggestion"]["plan"]
    assert post(server, "preview", {"changes": changes})["ok"]


@pytest.mark.parametrize(
    ("body", "status"),
    [
        (b"\xff\xfe", 400), (b"[1]", 400), (b"[" * 100_000, 400),
        ({"changes": {"plan": [1]}}, 400), ({"shape": {}}, 400),
        ({"shapes": {"survey": [{"outer": [[0, 0]]}]}}, 400),
        ({"shapes": {"survey": [{"outer": [[0, "a"], [1, 1], [2, 2]]}]}}, 400),
        ({"changes": {"plan": {"altitude_m": "high"}}}, 200),
        ({"changes": {"plan": {"altitude": 3}}}, 200),
        ({"changes": {"nothing": {"a": 1}}}, 200),
        ({"changes": {"area": {"file": "../../etc/passwd.wkt"}}}, 200),
        ({"changes": {"plan": {"home_ne_m": [None, 1]}}}, 200),
        ({"changes": {"area": {"layer": "\ud800"}}}, 400),
        ({"changes": {"plan": {"altitude_m": 10**400}}}, 200),
        ({"shapes": {"survey": []}}, 200),
        ({"shapes": {"survey": [{"outer": [[0, 0], [1e300, 0], [0, 1e300]]}]}}, 400),
        ({"shapes": {"survey": [{"outer": [[0, 0], [0, 0], [0, 0]]}]}}, 200),
    ],
)  # fmt: skip
def test_malformed_requests_are_one_line(
    workspace: Path, server: Server, body: Any, status: int
) -> None:
    before = files_of(workspace)
    for name in ("preview", "save"):
        reply = call(server, f"/api/plan/{name}", body)
        assert reply.status in (status, 400, 409), reply.text
        if name == "preview":
            assert reply.status == status
        if "survey_toml" not in reply.json:
            assert reply.json["error"] and len(reply.json["error"].splitlines()) == 1
    assert files_of(workspace) == before


def test_settings_that_cannot_be_read_are_said(workspace: Path, server: Server) -> None:
    (workspace / "survey.toml").write_text("[plan\n")
    found = get(server)
    assert "not valid TOML" in found["error"] and found["saved"] is None
    (workspace / "survey.toml").write_text('[area]\nfile = "gone.kml"\n')
    found = get(server)
    assert "gone.kml" in found["error"] and not found["saved"]["ok"]
    drawn = post(server, "preview", {"shapes": {"survey": [{"outer": SQUARE}]}})
    assert drawn["ok"]


def test_dropped_files_become_shapes(server: Server) -> None:
    ring = [[34.9553, 32.8236], [34.9554, 32.8236], [34.9554, 32.8237], [34.9553, 32.8236]]
    text = json.dumps({"type": "Polygon", "coordinates": [ring]}).encode()
    found = post(server, "import?name=reef.geojson", text)
    ((outer),) = [polygon["outer"] for polygon in found["survey"]]
    assert (
        len(outer) == 3 and outer[0] == [0.0, 0.0] and outer[1][1] == pytest.approx(9.36, abs=0.01)
    )
    assert post(server, "preview", {"shapes": found})["ok"]
    zone = post(server, "import?name=reef.geojson&role=no_go", text)
    assert zone["no_go"] == found["survey"] and zone["survey"] == []
    for name, body in (("reef.kml", b"no"), ("reef.exe", text), ("", text), ("a.wkt", b"POINT (")):
        assert "dropped" not in refused(call(server, f"/api/plan/import?name={name}", body))


def test_exports_of_the_plan(workspace: Path, server: Server) -> None:
    assert ask(server, "/api/plan/export?format=wpl").status == 404
    changes = {"plan": {"dive_s": 400.0}}
    saved = post(server, "save", {"changes": changes, "token": get(server)["token"]})
    assert saved["saved"]["totals"]["dives"] == 2
    packed = ask(server, "/api/plan/export?format=wpl")
    names = [f"mission_dive{dive}.waypoints" for dive in (1, 2)]
    with zipfile.ZipFile(io.BytesIO(packed.body)) as archive:
        assert archive.namelist() == names
        for name in names:
            assert archive.read(name) == (workspace / "plan" / "exports" / name).read_bytes()
    one = ask(server, "/api/plan/export?format=kml")
    assert one.body == (workspace / "plan" / "exports" / "plan.kml").read_bytes()
    assert "plan.kml" in one.headers["content-disposition"]
    assert ask(server, "/api/plan/export?format=../plan").status == 400
