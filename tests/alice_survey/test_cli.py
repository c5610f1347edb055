"""The command line: quick, with examples everywhere, one line for a known fault."""

import ast
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from PIL import Image
from typer.main import get_command
from typer.testing import CliRunner

from alice_survey.app.cli.main import GROUPS, app, main
from alice_survey.app.commands import COMMANDS
from alice_survey.app.pipeline import init_survey, run
from alice_survey.app.stages import names
from alice_survey.core.config import CameraConfig, WaterConfig, load_config
from alice_survey.core.errors import (
    AliceError,
    ConfigError,
    ImageError,
    PlanError,
    WorkspaceError,
    extra,
    offer,
)
from camera_calib.rig import design_rig, write_rig
from tests.alice_survey.app.report.tiny import tiny_workspace


def test_help_loads_nothing_heavy() -> None:
    """`--help` answers at once because numeric packages are not even imported."""
    code = (
        "import sys; from alice_survey.app.cli.main import app\n"
        "try: app(['--help'])\n"
        "except SystemExit: pass\n"
        "heavy = {'numpy', 'scipy', 'cv2', 'pycolmap', 'open3d', 'matplotlib'}\n"
        "sys.exit(', '.join(heavy & set(sys.modules)) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "import-images" in done.stdout


def leaves(command: Any, *path: str) -> Iterator[tuple[str, ...]]:
    """Names of all commands, those of groups below their group."""
    if not hasattr(command, "commands"):
        yield path
        return
    for name, below in command.commands.items():
        if not below.hidden:  # another name of a command
            yield from leaves(below, *path, name)


def test_each_command_stands_below_one_heading_and_the_ways_to_begin_parse() -> None:
    parser: Any = get_command(app)
    shown = [name for names in GROUPS.values() for name in names.split()]
    assert sorted(shown) == sorted({path[0] for path in leaves(parser)})
    ways = examples_of()
    assert len(ways) == 3
    for name, *arguments in ways:
        parser.commands[name].make_context(name, arguments)


@pytest.mark.parametrize("path", list(leaves(get_command(app))), ids=" ".join)
def test_every_command_explains_itself_with_examples(path: tuple[str, ...]) -> None:
    examples = examples_of(*path)
    assert examples
    parser: Any = get_command(app)
    for name in path:
        parser = parser.commands[name]
    for example in examples:
        parser.make_context(path[-1], example[len(path) :])  # it parses


def test_what_few_need_comes_last_in_help() -> None:
    for kind in COMMANDS:
        rare = set(kind.advanced.split())
        assert rare <= kind.model_fields.keys(), kind.name
        shown = CliRunner().invoke(app, [*kind.name.split(), "--help"]).output
        first, _, last = shown.partition("\nAdvanced:\n")
        for name in rare | {"quiet", "log_file"}:
            row = f"  {kind.option_name(name)} "
            assert row not in first
            assert row in last or f", {row.strip()} " in last


def examples_of(*path: str) -> list[list[str]]:
    shown = CliRunner().invoke(app, [*path, "--help"])
    found = re.findall(rf"^ +alice-survey ({' '.join(path)}.*)$", shown.output, re.MULTILINE)
    return [shlex.split(example, comments=True) for example in found]


@pytest.mark.parametrize("command", ["target", "fov", "init"])
def test_the_examples_of_help_work(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those that need nothing but the command."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "calibration").mkdir()
    write_rig(tmp_path / "calibration" / "rig.json", design_rig(CameraConfig(), WaterConfig()))
    area = {"type": "Polygon", "coordinates": [[[35, 32], [35.0002, 32], [35, 32.0002], [35, 32]]]}
    (tmp_path / "reef.geojson").write_text(json.dumps(area))
    for i, example in enumerate(examples_of(command)):
        (tmp_path / f"{i}").mkdir()
        words = [f"{i}/reef" if word == "reef" else word for word in example]
        done = CliRunner().invoke(app, words, catch_exceptions=False)
        assert done.exit_code == 0, (example, done.output)


def test_module_runs_as_the_command() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "alice_survey", "fov", "--validate", "--json"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert [row["passed"] for row in json.loads(done.stdout)["table"]] == [True] * 6


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["target", "chessboard 9x6 25mm", "-o", "FILE/b.pdf"], "FILE"),
        (["target", "chessboard 9x6 25mm", "-o", "FOLDER/d.pdf"], "d.pdf"),
        (["fov", "--rig", "FOLDER"], "FOLDER"),
        (["init", "FOLDER"], "survey.toml"),
        (["plan", "-w", "w"], "init"),
        (["reconstruct", "-w", "w"], "'alice-survey import-images"),
        (["calibrate", "--target", "chessboard 9x6 25mm"], "--pictures"),
        (["import-images", "--left", "FOLDER", "-w", "w"], "--camera NAME=FOLDER"),
    ],
)
def test_a_refusal_is_one_line_that_names_what_is_wrong(
    arguments: list[str],
    named: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "FOLDER" / "d.pdf").mkdir(parents=True)
    files = (tmp_path / "FILE", tmp_path / "FOLDER" / "survey.toml")
    for file in files:
        file.write_text("# mine")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["alice-survey", *arguments])
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 1
    (shown,) = capsys.readouterr().err.strip().splitlines()
    assert shown.startswith("error: ") and named in shown
    assert [file.read_text() for file in files] == ["# mine"] * 2


SQUARE = """{"type": "Polygon", "coordinates": [[
[34.955, 32.8236], [34.9553, 32.8236], [34.9553, 32.8238], [34.955, 32.8238], [34.955, 32.8236]]]}
"""


def test_init_looks_at_the_area_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dive").mkdir()
    for name, content in (("a.jpg", b"\xff\xd8"), ("b.kml", b"\xff\xd8"), ("c.csv", b"")):
        (tmp_path / name).write_bytes(content)
    for area in ("a.jpg", "b.kml", "c.csv", "dive", "none.kml"):
        done = CliRunner().invoke(app, ["init", "reef", "--area", area])
        assert isinstance(done.exception, PlanError)
        assert area in str(done.exception) and "\n" not in str(done.exception)
        assert not (tmp_path / "reef").exists()
    (tmp_path / "reef.geojson").write_text(SQUARE)
    shown = CliRunner().invoke(app, ["init", "reef", "--area", "reef.geojson"]).output
    assert re.findall(r"[\d.]+", shown.splitlines()[0]) == ["32.82", "34.96", "623", "2"]


def offered(text: str) -> list[str]:
    """Commands that a text offers."""
    quoted = [found[2] for found in re.finditer(r"(['\"])(alice-survey .+?)\1(?!\w)", text)]
    return quoted + re.findall(r"next: (alice-survey .+)", text)


def parse(line: str) -> None:
    """Let click read a command as a shell would hand it over; what it requires may lack."""
    program, *words = shlex.split(line)
    assert program == "alice-survey"
    command: Any = get_command(app)
    path = []
    while words and words[0] in getattr(command, "commands", {}):
        path.append(words.pop(0))
        command = command.commands[path[-1]]
    assert path, line
    context = command.make_context(path[-1], [], resilient_parsing=True)
    rest = command.make_parser(context).parse_args(words)[1]
    assert not (hasattr(command, "commands") and rest), line


def test_commands_that_are_offered_work_where_names_hold_spaces(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)

    def said(*words: str) -> str:
        done = CliRunner().invoke(app, list(words))
        return done.output + (str(done.exception) if done.exception else "")

    (tmp_path / "pictures of it").mkdir()
    for n in range(2):
        Image.new("RGB", (64, 48), (n, 9, 9)).save(tmp_path / "pictures of it" / f"{n}.png")
    begin = offered(said("status", "-w", "my dive"))
    assert begin == ["alice-survey init 'my dive'"]
    ways = offered(said("report", "-w", "my dive")) + offered(said("plan", "-w", "my dive"))
    (tmp_path / "int" / "images.partial").mkdir(parents=True)
    again = offered(said("status", "-w", "int"))
    assert [shlex.split(one)[1] for one in again] == ["import-images"]  # and not `init`
    after = offered(said(*shlex.split(begin[0])[1:]))
    assert after == ["alice-survey plan -w 'my dive'"]
    empty = offered(said("status", "my dive")) + offered(said("mosaic-tiles", "-w", "my dive"))
    real = offered(said("import-images", "pictures of it", "-w", "its dive"))
    assert real == ["alice-survey reconstruct -w 'its dive'"]
    for line in (*ways, *again, *after, *empty, *real):
        parse(line)
    assert min(map(len, (ways, empty))) >= 2


def test_a_run_that_fails_at_once_leaves_no_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photos").mkdir()
    Image.new("RGB", (64, 48)).save(tmp_path / "photos" / "0.png")
    for line in (
        "import-images none -w dive", "reconstruct none -o dive", "quality -w dive",
        "reconstruct photos -o dive --crs none", "import-images photos --rig none.json -w dive",
        "import-images photos --navigation none.csv -w dive",
    ):  # fmt: skip
        done = CliRunner().invoke(app, line.split())
        assert isinstance(done.exception, AliceError), line
        assert not (tmp_path / "dive").exists(), line
        assert "none" in str(done.exception) or offered(str(done.exception))


def test_every_command_that_the_packages_name_is_one() -> None:
    """What users are told to type; paths that are known go through `offer`."""
    found = []
    places = [Path(name) for name in ("alice_survey", "camera_calib", "missions", "reconstruct")]
    for file in (file for place in places for file in place.rglob("*.py")):
        text = file.read_text()
        for node in ast.walk(ast.parse(text if re.search(r"alice-survey|offer\(", text) else "")):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                assert not re.search(r"alice-survey(\[| [a-z -]+-w $)", node.value), file
                found += re.findall(r"'(alice-survey [a-z][^'{]*)'", node.value)
            elif isinstance(node, ast.Call) and getattr(node.func, "id", "") == "offer":
                command, *words = (getattr(word, "value", "X") for word in node.args)
                found += [offer(command, *words)] if command != "X" else []
    assert len(found) > 20
    for line in found:
        parse(line)


@pytest.mark.parametrize("name", ["studio", "cluster", "gpu", "mavlink", "ros"])
def test_extras_are_installed_from_where_they_are(name: str) -> None:
    """The package itself is not on PyPI."""
    wanted = tomllib.loads(Path("pyproject.toml").read_text())["project"]["optional-dependencies"]
    pip, install, *needed = shlex.split(extra(name))
    assert [pip, install] == ["pip", "install"]
    assert {Requirement(one).name for one in needed} == {Requirement(w).name for w in wanted[name]}


def test_a_file_is_no_workspace_and_no_folder_of_pictures(tmp_path: Path) -> None:
    Image.new("RGB", (64, 48)).save(file := tmp_path / "p.jpg")
    for words in (["status"], ["reconstruct"], ["quality"]):
        assert CliRunner().invoke(app, [*words, "-w", str(file)]).exit_code == 2
    done = CliRunner().invoke(app, ["import-images", str(file), "-w", str(tmp_path / "w")])
    assert isinstance(done.exception, ImageError)
    assert not (tmp_path / "w" / "images").exists()


@pytest.mark.parametrize(("where", "named"), [("reef", "../reef.geojson"), (".", "reef.geojson")])
def test_init_names_the_area_from_the_folder_of_the_settings(
    where: str, named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A survey and its area may be moved together."""
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    (here / "reef.geojson").write_text(SQUARE)
    path = init_survey(Path(where), area=Path("reef.geojson"))
    assert f'file = "{named}"' in path.read_text()
    moved = here.rename(tmp_path / "moved")
    file = load_config(moved / where / "survey.toml").area.file
    assert file is not None
    assert file.samefile(moved / "reef.geojson")


def test_status_names_the_next_command(tmp_path: Path) -> None:
    init_survey(tmp_path)
    shown = CliRunner().invoke(app, ["status", "-w", str(tmp_path), "--json"])
    data = json.loads(shown.output)
    assert data["stages"] == dict.fromkeys(names(), "missing")
    assert data["next"] == f"alice-survey plan -w {tmp_path}"


def test_a_workspace_as_argument_is_the_same_as_by_option(tmp_path: Path) -> None:
    assert CliRunner().invoke(app, ["init", str(tmp_path / "reef")]).exit_code == 0
    planned = CliRunner().invoke(app, ["plan", str(tmp_path / "reef"), "-s", "none.toml"])
    assert "none.toml" in str(planned.exception)  # it came as far as that
    by_argument = CliRunner().invoke(app, ["status", str(tmp_path / "reef"), "--json"])
    by_option = CliRunner().invoke(app, ["status", "-w", str(tmp_path / "reef"), "--json"])
    assert by_argument.exit_code == by_option.exit_code == 0
    assert by_argument.output == by_option.output
    both = CliRunner().invoke(app, ["status", str(tmp_path / "reef"), "-w", str(tmp_path / "bay")])
    assert both.exit_code == 2
    assert "bay" in both.output


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="threads are counted in /proc")
def test_products_of_matrices_are_computed_on_one_core() -> None:
    """Else their rounding, and much time spent on waiting, would depend on the number of cores."""
    code = """
import os
from alice_survey.app.cli import main as cli

def app(arguments):
    import numpy as np

    matrix = np.ones((600, 600))
    print((matrix @ matrix)[0, 0], len(os.listdir("/proc/self/task")))

cli.app = app
cli.main()
"""
    environment = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["600.0", "1"]


def test_pictures_become_a_report_in_one_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stages stand in; a second call goes on, and other pictures are refused."""
    for name, value in (("a", 90), ("b", 110)):
        (tmp_path / name).mkdir()
        for k in (0, 1):
            Image.new("L", (64, 48), value + k).save(tmp_path / name / f"{k}.png")
    ran: list[tuple[str, Path]] = []

    def made(stages: list[str], workspace: Path, *_: Any) -> tuple[str, dict[str, Any]]:
        ran.extend((stage, workspace) for stage in stages)
        return "text", {}

    monkeypatch.setattr("alice_survey.app.pipeline.run", made)
    dive = tmp_path / "dive"
    for _ in range(2):
        done = CliRunner().invoke(app, ["reconstruct", str(tmp_path / "a"), "-o", str(dive)])
        assert done.exit_code == 0, done.output
        assert ran == [(n, dive) for n in (*names("calibrate", "reconstruct"), "report")]
        assert (dive / "images").is_dir() and not list((tmp_path / "a").glob("*/"))
        ran.clear()
    monkeypatch.undo()
    refused = CliRunner().invoke(app, ["reconstruct", str(tmp_path / "a")])
    assert f"reconstruct {tmp_path / 'a'} -o" in str(refused.exception)
    monkeypatch.setattr("alice_survey.app.pipeline.run", made)
    for folder, fault in ((tmp_path / "b", WorkspaceError), (dive, ConfigError)):
        refused = CliRunner().invoke(app, ["reconstruct", str(folder), "-o", str(dive)])
        assert isinstance(refused.exception, fault) and not ran
    shutil.copytree(dive / "images", dive / "report")
    done = CliRunner().invoke(app, ["reconstruct", "-w", str(dive)])
    assert f"alice-survey report -w {dive}" in done.output.splitlines()[-1]


def test_control_is_read_before_the_pictures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What it warns of, its stage reports."""
    (tmp_path / "control.csv").write_text("kind,name,use,colour\npoint,A,perhaps,red\n")
    with pytest.raises(WorkspaceError, match="line 2"):
        run(["mapping", "placing"], tiny_workspace(tmp_path), None)
    assert "colour" not in capsys.readouterr().err
