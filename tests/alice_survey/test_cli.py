"""The command line: quick, with examples everywhere, one line for a known fault."""

import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from alice_survey.app.cli.main import app, main
from alice_survey.app.pipeline import init_survey
from alice_survey.app.stages import names
from alice_survey.core.config import CameraConfig, SurveyConfig, WaterConfig, load_config
from camera_calib.rig import design_rig, write_rig
from tests.missions.flown_plans import plan_of, walk

COMMANDS = (
    "init", "fov", "target", "plan", "fly", "image", "calibrate", "import-images", "reconstruct",
    "scale", "evaluate", "run", "demo", "status", "camera", "vehicle", "import-control",
    "import-log", "measure", "control", "quality", "mosaic-tiles", "report", "studio", "view",
    "join", "pilot", "simulate",
)  # fmt: skip


def fails(
    arguments: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> str:
    """Run a command that must end in exit code 1 with one line; returns the line."""
    monkeypatch.setattr(sys, "argv", ["alice-survey", *arguments])
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 1
    shown = capsys.readouterr().err.strip()
    assert shown.startswith("error: ")
    assert len(shown.splitlines()) == 1
    return shown


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


@pytest.mark.parametrize("path", list(leaves(get_command(app))), ids=" ".join)
def test_every_command_explains_itself_with_examples(path: tuple[str, ...]) -> None:
    shown = CliRunner().invoke(app, [*path, "--help"])
    assert shown.exit_code == 0
    examples = re.findall(rf"^ +alice-survey ({' '.join(path)}.*)$", shown.output, re.MULTILINE)
    assert examples
    parser: Any = get_command(app)
    for name in path:
        parser = parser.commands[name]
    for example in examples:
        parser.make_context(path[-1], shlex.split(example)[len(path) :])  # it parses


def examples_of(*path: str) -> list[list[str]]:
    shown = CliRunner().invoke(app, [*path, "--help"])
    found = re.findall(rf"^ +alice-survey ({' '.join(path)}.*)$", shown.output, re.MULTILINE)
    return [shlex.split(example) for example in found]


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


def test_all_commands_are_known() -> None:
    assert set(get_command(app).commands) == set(COMMANDS)  # type: ignore[attr-defined]


def test_module_runs_as_the_command() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "alice_survey", "fov", "--validate", "--json"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert [row["passed"] for row in json.loads(done.stdout)["table"]] == [True] * 6


def test_the_template_states_every_default(tmp_path: Path) -> None:
    """survey.toml as written is the default survey, but for the paper's stated line spacing."""
    path = init_survey(tmp_path)
    written = load_config(path)
    default = SurveyConfig()
    assert written.model_copy(update={"plan": default.plan}) == default
    assert written.plan.line_spacing_m == 1.0
    assert written.plan.model_copy(update={"line_spacing_m": None}) == default.plan
    text = path.read_text()
    for section, field in SurveyConfig.model_fields.items():
        keys = getattr(field.annotation, "model_fields", {section: None})
        for key in keys:
            assert re.search(rf"^(# )?{key} = ", text, re.MULTILINE), f"{section}.{key}"


def test_init_never_overwrites(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "survey.toml").write_text("# mine")
    shown = fails(["init", str(tmp_path)], capsys, monkeypatch)
    assert "survey.toml" in shown
    assert (tmp_path / "survey.toml").read_text() == "# mine"


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["target", "chessboard 9x6 25mm", "-o", "FILE/b.pdf"], "FILE"),
        (["target", "chessboard 9x6 25mm", "-o", "FOLDER/d.pdf"], "d.pdf"),
        (["fov", "--rig", "FOLDER"], "FOLDER"),
    ],
)
def test_what_the_file_system_refuses_is_one_line(
    arguments: list[str],
    named: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "FILE").write_text("a file")
    (tmp_path / "FOLDER" / "d.pdf").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    assert named in fails(arguments, capsys, monkeypatch)
    assert (tmp_path / "FILE").read_text() == "a file"


def test_stages_name_the_command_that_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert "init" in fails(["plan", "-w", "w"], capsys, monkeypatch)
    init_survey(tmp_path / "w")
    assert "'alice-survey plan'" in fails(["fly", "-w", "w"], capsys, monkeypatch)
    assert "'alice-survey image'" in fails(["calibrate", "-w", "w"], capsys, monkeypatch)
    assert "'alice-survey image'" in fails(["evaluate", "-w", "w"], capsys, monkeypatch)


@pytest.mark.parametrize(("where", "named"), [("reef", "../reef.geojson"), (".", "reef.geojson")])
def test_init_names_the_area_from_the_folder_of_the_settings(
    where: str, named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A survey and its area may be moved together."""
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    (here / "reef.geojson").write_text("{}")
    path = init_survey(Path(where), area=Path("reef.geojson"))
    assert f'file = "{named}"' in path.read_text()
    moved = here.rename(tmp_path / "moved")
    file = load_config(moved / where / "survey.toml").area.file
    assert file is not None
    assert file.samefile(moved / "reef.geojson")


def test_reconstruct_in_a_folder_of_pictures_names_the_command_that_takes_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert "'alice-survey import-images" in fails(["reconstruct", "-w", "w"], capsys, monkeypatch)
    assert not (tmp_path / "w" / ".lock").exists()


def test_a_plane_that_cannot_be_read_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    init_survey(tmp_path)
    command = ["reconstruct", "-w", str(tmp_path), "--plane", "level", "--plane"]
    said = fails([*command, "wall=north"], capsys, monkeypatch)
    assert "NAME=facing DEGREES" in said
    said = fails([*command, "level"], capsys, monkeypatch)
    assert "two planes are named 'level'" in said


@pytest.mark.parametrize(
    ("words", "line", "template"),
    [
        (["reconstruct", "--plane", "wall=facing 180"], 'planes = ["wall=facing 180"]', "# planes"),
        (["image", "--scale", "4"], "scale = 4", "scale"),
    ],
)
def test_a_setting_of_the_command_line_holds_for_one_run(
    words: list[str],
    line: str,
    template: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = init_survey(tmp_path)
    monkeypatch.setattr(sys, "argv", ["alice-survey", *words, "-w", str(tmp_path)])
    with pytest.raises(SystemExit):
        main()  # there are no pictures, and there is no flight
    assert line in capsys.readouterr().err
    text = re.sub(rf"^{template} = \S+", line, path.read_text(), flags=re.MULTILINE)
    path.write_text(text)
    with pytest.raises(SystemExit):
        main()
    assert "for this run" not in capsys.readouterr().err


def test_status_names_the_next_command(tmp_path: Path) -> None:
    init_survey(tmp_path)
    shown = CliRunner().invoke(app, ["status", "-w", str(tmp_path), "--json"])
    data = json.loads(shown.output)
    assert data["stages"] == dict.fromkeys(names(), "missing")
    assert data["next"] == f"alice-survey plan -w {tmp_path}"


@pytest.mark.parametrize(
    "option",
    [["--target", "chessboard 9x6 25mm"], ["-o", "x"], ["--start", "rig.json"], ["--water"]],
)
def test_calibrate_does_not_forget_options_when_pictures_are_missing(
    option: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = fails(["calibrate", *option], capsys, monkeypatch)
    assert "--left" in shown and "--pictures" in shown


def test_a_workspace_as_argument_is_the_same_as_by_option(tmp_path: Path) -> None:
    assert CliRunner().invoke(app, ["init", str(tmp_path / "reef")]).exit_code == 0
    by_argument = CliRunner().invoke(app, ["status", str(tmp_path / "reef"), "--json"])
    by_option = CliRunner().invoke(app, ["status", "-w", str(tmp_path / "reef"), "--json"])
    assert by_argument.exit_code == by_option.exit_code == 0
    assert by_argument.output == by_option.output
    both = CliRunner().invoke(app, ["status", str(tmp_path / "reef"), "-w", str(tmp_path / "bay")])
    assert both.exit_code == 2
    assert "bay" in both.output


def test_version_is_that_of_the_distribution() -> None:
    result = CliRunner().invoke(app, ["--version"])
    assert result.exit_code == 0
    assert result.output.split() == ["alice-survey", metadata.version("alice-survey")]


@pytest.mark.parametrize("side", ["left", "right"])
def test_half_of_a_stereo_rig_is_refused(
    side: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = ["import-images", f"--{side}", str(tmp_path), "-w", str(tmp_path / "w")]
    assert "--camera NAME=FOLDER" in fails(arguments, capsys, monkeypatch)


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


def test_a_plan_is_not_flown_without_ros(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One line says what to install, whatever is installed here."""
    plan = plan_of([walk((0.0, 0.0), 0.0, [("line", 4.0, 0)])])
    (tmp_path / "plan").mkdir()
    (tmp_path / "plan" / "plan.json").write_text(json.dumps(plan.to_json()))
    (tmp_path / "survey.toml").write_text("")
    monkeypatch.setitem(sys.modules, "rclpy", None)
    assert "alice-survey[ros]" in fails(["pilot", str(tmp_path)], capsys, monkeypatch)
    monkeypatch.setitem(sys.modules, "pymavlink", None)
    mavlink = ["pilot", str(tmp_path), "--mavlink", "udpin:127.0.0.1:14550"]
    assert "alice-survey[mavlink]" in fails(mavlink, capsys, monkeypatch)
