"""One list of stages: what it declares, what reads it, and workspaces of version 0.1.0."""

import ast
import json
import subprocess
import sys
import zipfile
from dataclasses import replace
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from alice_survey.app import stages
from alice_survey.app.cli.main import app
from alice_survey.app.pipeline import run, workspace_status
from alice_survey.app.report.held import Held
from alice_survey.app.report.sections import sections
from alice_survey.app.report.verdicts import verdicts
from alice_survey.app.stages import STAGES, spec
from alice_survey.core import records
from alice_survey.core.artefacts import JsonRecord, read_stage
from alice_survey.core.config import SurveyConfig, load_config
from alice_survey.core.errors import WorkspaceError, keep_warnings
from alice_survey.core.executor import SERIAL, Executor
from alice_survey.core.stages import StageSpec, files_of, settings_of
from tests.refusals import refused

OLD = Path(__file__).parent / "workspace_0_1_0.zip"
"""Made with version 0.1.0: records and small files as it wrote them, others cut short."""
KEPT = ["plan", "fly", "pool", "image", "calibrate"]
"""Stages whose settings and files are those of then."""


@pytest.fixture
def old(tmp_path: Path) -> Path:
    with zipfile.ZipFile(OLD) as archive:
        archive.extractall(tmp_path / "old")
    return tmp_path / "old"


@pytest.fixture
def as_then(old: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stages whose code has changed nothing since: only files and settings decide."""
    unchanged = [replace(stage, version=version_of(old, stage.folder)) for stage in STAGES]
    monkeypatch.setattr(stages, "STAGES", tuple(unchanged))


def version_of(workspace: Path, folder: str) -> int:
    record = read_stage(workspace / folder)
    assert record is not None
    return record.version


def test_a_workspace_of_version_0_1_0_states_what_has_changed_since(old: Path) -> None:
    before = {path: path.read_bytes() for path in old.rglob("*") if path.is_file()}
    _, found = workspace_status(old, None)
    assert found["stages"]["plan"] == (
        f"stale (made by version 3 of the stage, now {spec('plan').version})"
    )
    assert found["next"] == f"alice-survey plan -w {old}"
    assert {path: path.read_bytes() for path in old.rglob("*") if path.is_file()} == before


@pytest.mark.usefixtures("as_then")
def test_settings_and_files_of_version_0_1_0_are_those_of_today(old: Path) -> None:
    """But for the mapping: the last adjustment has left it, learned features have come to it."""
    text, found = workspace_status(old, None)
    states = found["stages"]
    assert {states[name] for name in KEPT} == {"up to date"}, text
    assert states["mapping"] == "stale (changed: refine_port and 2 more)"
    _, found = run(KEPT, old, None)  # and nothing is done again
    assert [name for name, part in found.items() if part["done"]] == []
    assert found["fly"]["stations"] == 58


@pytest.mark.parametrize(
    ("change", "stale", "why"),
    [
        (("survey.toml", "relief_m = 0.35", "relief_m = 0.45"), "fly", "seafloor.relief_m"),
        (("pool/board.json", "{", "{ "), "calibrate", "pool/board.json"),
        (("calibration/stage.json", '"version": 3', '"version": 2'), None, ""),
    ],
)
@pytest.mark.usefixtures("as_then")
def test_what_changed_in_an_old_workspace_is_named(
    old: Path, change: tuple[str, str, str], stale: str | None, why: str
) -> None:
    path = old / change[0]
    assert change[1] in path.read_text()
    path.write_text(path.read_text().replace(change[1], change[2]))
    states = workspace_status(old, None)[1]["stages"]
    if stale is None:  # what decides is the digest
        assert {states[name] for name in KEPT} == {"up to date"}
        return
    assert states["plan"] == "up to date"
    assert states[stale].startswith("stale (changed: ")
    assert why in states[stale]
    assert states["report"].startswith("stale")


@pytest.mark.usefixtures("as_then")
def test_a_raised_version_makes_a_stage_and_those_after_it_stale(
    old: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    raised = (
        replace(stage, version=4) if stage.name == "image" else stage for stage in stages.STAGES
    )
    monkeypatch.setattr(stages, "STAGES", tuple(raised))
    states = workspace_status(old, None)[1]["stages"]
    assert states["pool"] == "up to date"
    before = version_of(old, "images")
    assert states["image"] == f"stale (made by version {before} of the stage, now 4)"
    assert states["mapping"] == states["evaluate"] == "stale (image is stale)"


def test_a_report_reads_what_version_0_1_0_wrote(old: Path) -> None:
    (old / "dense" / "dem.tif").unlink()  # they are cut short
    (old / "mosaic" / "mosaic.tif").unlink()
    (old / "plan" / "map.png").unlink()
    held = Held.of(old)
    assert held.registration is not None
    assert (held.registration.registered, held.simulated, held.name) == (116, True, "demo")
    assert len(verdicts(held)) > 5
    found = list(sections(held, has_map=False, has_mesh=True))
    assert {"mesh", "truth", "camera", "mission"} <= {section.name for section in found}
    assert len(found[-1].tables[0].rows) == len(STAGES) - 1


_WORKS = {"numba", "shapely"}
_READS = {"cv2", "pycolmap", "rasterio"}
_DRAWS = {"matplotlib", "open3d", "pandas", "rosbags", "scipy.signal", "scipy.stats", "trimesh"}


@pytest.mark.parametrize(
    ("command", "heavy"),
    [
        (["status"], _WORKS | _READS | _DRAWS | {"scipy"}),
        pytest.param(
            ["plan"],
            _READS | _DRAWS | {"scipy.optimize", "scipy.interpolate"},
            marks=pytest.mark.slow,
        ),
        pytest.param(["fly"], _READS | _DRAWS, marks=pytest.mark.slow),
        pytest.param(
            ["studio", "--no-browser"], _DRAWS | {"scipy.optimize"}, marks=pytest.mark.slow
        ),
    ],
)
def test_a_result_is_printed_before_what_it_does_not_need_is_loaded(
    command: list[str], heavy: set[str], old: Path
) -> None:
    code = (
        "import os, sys, typer\n"
        "def echo(text, err=False):\n"
        f"    os.write(1, repr((text, {heavy} & set(sys.modules))).encode())\n"
        "    os._exit(0)\n"
        "typer.echo = echo\n"
        "from alice_survey.app.cli.main import main\n"
        "main()"
    )
    if command == ["fly"]:
        run(["plan"], old, None)
    done = subprocess.run(
        [sys.executable, "-c", code, *command, "-w", str(old)], capture_output=True, text=True
    )
    text, loaded = ast.literal_eval(done.stdout)
    assert not loaded and str(old) in text, done.stderr


def is_kept(written: Any, again: Any) -> bool:
    if isinstance(written, dict):
        return all(is_kept(value, again[key]) for key, value in written.items())
    return bool(written == again)


def records_of(base: type[JsonRecord]) -> list[type[JsonRecord]]:
    own = (kind for kind in base.__subclasses__() if kind.__module__.startswith("alice_survey."))
    return [kind for kind in own if kind.path]


@pytest.mark.parametrize("kind", records_of(JsonRecord), ids=lambda kind: kind.__name__)
def test_a_record_keeps_all_that_version_0_1_0_wrote(kind: type[JsonRecord], old: Path) -> None:
    path = old / kind.path
    if not path.is_file():
        assert kind in {
            records.ControlRecord, records.ScaleRecord, records.ReferenceRecord,
            records.ChangeRecord, records.PlaneRecord, records.PortRecord,
        }  # fmt: skip
        return
    written = json.loads(path.read_text())
    kind.read(path).write(path)
    again = json.loads(path.read_text())
    assert is_kept(written, again)


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"points": "many"}', "\x00"])
def test_a_damaged_record_is_one_line_that_names_it(text: str, tmp_path: Path) -> None:
    path = tmp_path / "cloud.json"
    path.write_text(text)
    with refused(WorkspaceError, path):
        records.CloudRecord.read(path)


@pytest.mark.parametrize("stage", STAGES, ids=lambda stage: stage.name)
def test_a_stage_declares_what_there_is(stage: StageSpec) -> None:
    module, function = stage.work.split(":")
    taken = [name.rpartition(".")[2] for name in stage.takes]
    work = signature(getattr(import_module(module), function))
    assert list(work.parameters)[:3] == ["workspace", "folder", "executor"]
    work.bind(Path(), Path(), SERIAL, **dict.fromkeys(taken))
    earlier = [one.name for one in STAGES[: STAGES.index(stage)]]
    assert set(stage.needs) | set(stage.uses) <= set(earlier)
    json.dumps(settings_of(stage.settings, SurveyConfig()))
    assert files_of(stage.setting_files, SurveyConfig()) == []
    commands = CliRunner().invoke(app, [stage.command, "--help"])
    assert commands.exit_code == 0


def test_settings_that_are_not_named_leave_a_stage_as_it_is(old: Path) -> None:
    config = load_config(old / "survey.toml")
    other = config.model_copy(update={"name": "other", "seed": 77})
    same = [
        stage.name
        for stage in STAGES
        if settings_of(stage.settings, config) == settings_of(stage.settings, other)
    ]
    assert same == ["calibrate", "placing", "dense", "mosaic", "mesh", "report"]


# A stage, added here alone.


def count_lines(workspace: Path, folder: Path, executor: Executor, *, seed: int) -> None:
    lines = (workspace / "notes.txt").read_text().splitlines()
    (folder / "lines.txt").write_text(str(len(lines) * seed))


TOY = StageSpec(
    name="toy",
    folder="toys",
    command="run",
    about="counts the lines of a note",
    version=1,
    work=f"{__name__}:count_lines",
    takes=("seed",),
    settings={"seed": "seed"},
    inputs=lambda workspace: [workspace / "notes.txt"],
    summary=lambda folder: (f"{(folder / 'lines.txt').read_text()} lines", {}),
    products={"lines.txt": "how many lines there are"},
    reported=("lines.txt",),
)


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, __name__, sys.modules[__name__])
    monkeypatch.setattr(stages, "STAGES", (*STAGES[:-1], TOY, STAGES[-1]))


def test_a_stage_added_in_one_file_is_run_shown_reported_and_documented(
    toy: None, tmp_path: Path
) -> None:
    (tmp_path / "notes.txt").write_text("one\ntwo\n")
    (tmp_path / "survey.toml").write_text("seed = 3\n")

    def state() -> Any:
        return workspace_status(tmp_path, None)[1]["stages"]["toy"]

    assert state() == "missing"
    text, found = run(["toy"], tmp_path, None)
    assert (text, found["toy"]["done"]) == ("toy: 6 lines", True)
    assert state() == "up to date"
    assert run(["toy"], tmp_path, None)[1]["toy"]["done"] is False
    held = Held.of(tmp_path)
    *_, last = sections(held, has_map=False, has_mesh=False)
    tables = {table.title: table.rows for table in last.tables}
    assert [row[0] for row in tables["Stages"]] == ["toys"]
    assert list(tables["Files"]) == [("toys/lines.txt", "how many lines there are")]
    assert tmp_path / "toys" / "lines.txt" in spec("report").inputs(tmp_path)
    assert "| `toy` | `toys/` | `run` | counts the lines of a note |" in stages.table()
    assert stages.names("run") == ["toy"]
    (tmp_path / "survey.toml").write_text("seed = 4\n")
    assert state() == "stale (changed: seed)"
    (tmp_path / "survey.toml").write_text("seed = 3\n")
    (tmp_path / "notes.txt").write_text("one\n")
    assert state() == "stale (changed: notes.txt)"
    (tmp_path / "notes.txt").unlink()
    assert state().startswith("stale (")
    record = read_stage(tmp_path / "toys")
    assert record is not None
    assert (record.stage, record.version, record.settings) == ("toys", 1, {"seed": 3})


@pytest.mark.slow
def test_a_plan_made_for_a_vehicle_is_not_stale_when_that_flies(tmp_path: Path) -> None:
    (tmp_path / "survey.toml").write_text(
        "[area]\nlength_m = 1.0\nwidth_m = 1.2\nseafloor_depth_m = 5.0\n"
        "[plan]\ncross_lines = 0\nclosing_line = false\n[seafloor]\ngrid_m = 0.05\n"
    )
    for_sparus = {"vehicle": {"name": "sparus2", "controller": "los"}}
    with keep_warnings() as planning:
        run(["plan"], tmp_path, None, changes=for_sparus)
    with keep_warnings() as flying:
        run(["fly"], tmp_path, None, changes=for_sparus)
    assert not any("stale" in text for text in [*planning, *flying])
    with keep_warnings() as others:
        run(["fly"], tmp_path, None)
    assert sum("the plan is stale (changed: vehicle.name" in text for text in others) == 1
