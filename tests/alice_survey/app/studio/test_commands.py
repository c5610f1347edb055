"""What the studio starts is what the command line takes."""

from pathlib import Path
from typing import Any

import pytest
import typer.main
from pydantic_core import PydanticUndefined

from alice_survey.app.cli.main import app
from alice_survey.app.studio.commands import COMMANDS, words_of
from alice_survey.core.errors import ConfigError
from alice_survey.core.stages import STAGES


def command_of(name: str) -> Any:
    found: Any = typer.main.get_command(app)
    for word in name.split():
        found = found.commands[word]
    return found


@pytest.mark.parametrize("name", COMMANDS)
def test_every_argument_is_one_of_the_command(name: str) -> None:
    parameters = command_of(name).params
    options = {option for parameter in parameters for option in parameter.opts}
    arguments = COMMANDS[name].arguments
    for field in arguments.model_fields:
        if field not in arguments.plain:
            assert f"--{arguments.called.get(field, field.replace('_', '-'))}" in options
    assert "--events" in options
    assert {p.name for p in parameters if p.param_type_name == "argument"} >= set(arguments.plain)


@pytest.mark.parametrize("name", COMMANDS)
def test_the_command_line_takes_what_is_written(name: str, tmp_path: Path) -> None:
    folder = tmp_path / "-odd; $(name)"
    folder.mkdir()
    examples: dict[str, Any] = {
        "folders": [folder], "cameras": {"bow": folder, "port": folder}, "videos": [folder],
        "log": folder, "navigation": folder, "rig": folder, "against": folder, "masks": folder,
        "reference": folder, "bag": folder, "triggers": folder, "threads": 2, "scale": 4,
        "points": "-1,0,0 1,0,0", "length": 0.5, "planes": ["level", "wall=facing 180"],
        "crs": "EPSG:32636", "export": "undistorted", "vehicle": "alice", "controller": "sway",
        "dive": 1, "overlap": 0.7, "every": 2.0, "recursive": True, "clock_offset": -1.5,
        "time_zone": "Europe/Oslo", "vertical_datum": "-NN 2000", "dictionary": "DICT_5X5_250",
        "sigma": 5.0, "formats": ["wpl", "cola2"], "declination": -3.4,
        "dead_reckon": True, "output": "navigation-2.csv",
    }  # fmt: skip
    fields = COMMANDS[name].arguments.model_fields
    given = {field: str(v) if isinstance(v := examples[field], Path) else v for field in fields}
    words = words_of(name, _plain(given), tmp_path)
    assert words[: len(name.split())] == name.split()
    parsed = command_of(name).make_context(
        name, words[len(name.split()) :], resilient_parsing=False
    )
    for field in fields:
        called = COMMANDS[name].arguments.called.get(field, field)
        value = {"folders": "folders", "format": "formats"}.get(called, called)
        found = parsed.params[value]
        expected = examples[field]
        if field == "output":
            expected = tmp_path / "navigation-2.csv"
        if isinstance(expected, dict):
            expected = [f"{key}={one}" for key, one in expected.items()]
        as_text = [str(one) for one in found] if isinstance(found, list | tuple) else str(found)
        wanted = [str(x) for x in expected] if isinstance(expected, list) else str(expected)
        assert as_text == wanted, field


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_plain(one) for one in value]
    return str(value) if isinstance(value, Path) else value


def test_every_stage_has_a_command_that_makes_it() -> None:
    made = {stage for name, one in COMMANDS.items() if name != "run" for stage in one.stages}
    assert made == {stage.name for stage in STAGES}
    for stage in STAGES:
        assert stage.name in COMMANDS[stage.command].stages


def test_nothing_is_required_but_what_a_command_cannot_do_without() -> None:
    needed = {
        (name, field)
        for name, one in COMMANDS.items()
        for field, about in one.arguments.model_fields.items()
        if about.default is PydanticUndefined
    }
    assert needed == {("import-log", "log")}


def test_a_wrong_value_is_named_in_one_line(tmp_path: Path) -> None:
    for given, part in (({"threads": 0}, "threads"), ({"folders": ["relative"]}, "whole path"),
                        ({"folders": [str(tmp_path / "none")]}, "no such")):  # fmt: skip
        with pytest.raises(ConfigError) as fault:
            words_of("import-images", given, tmp_path)
        assert part in str(fault.value) and "\n" not in str(fault.value)
