"""What the studio starts is what the command line takes."""

from pathlib import Path
from typing import Any

import pytest
import typer.main

from alice_survey.app.cli.main import app
from alice_survey.app.stages import STAGES
from alice_survey.app.studio.jobs import OFFERED, command_of
from alice_survey.core.errors import ConfigError


@pytest.mark.parametrize("name", OFFERED)
def test_the_command_line_takes_what_is_written(name: str, tmp_path: Path) -> None:
    folder = tmp_path / "-odd; $(name)"
    folder.mkdir()
    examples: dict[str, Any] = {
        "folders": [str(folder)], "camera": [f"bow={folder}", f"port={folder}"],
        "video": [str(folder)], "threads": 2, "scale": 4, "points": ["-1,0,0 1,0,0"], "length": 0.5,
        "plane": ["level", "wall=facing 180"], "crs": "EPSG:32636", "export": "undistorted",
        "vehicle": "alice", "controller": "sway", "dive": 1, "overlap": 0.7, "every": 2.0,
        "recursive": True, "clock_offset": -1.5, "time_zone": "Europe/Oslo",
        "vertical_datum": "-NN 2000", "dictionary": "DICT_5X5_250", "sigma": 5.0,
        "formats": ["wpl", "cola2"], "split": "left-right", "replace": True,
    }  # fmt: skip
    given = {field: examples.get(field, str(folder)) for field in OFFERED[name].offered}
    command_of(name, {}, tmp_path)  # nothing is required
    command = command_of(name, given, tmp_path)
    words = command.words()
    assert words[: len(name.split())] == name.split()
    parser: Any = typer.main.get_command(app)
    for word in name.split():
        parser = parser.commands[word]
    parsed = parser.make_context(name, words[len(name.split()) :])
    for field in command.model_fields_set:
        assert parsed.params[field] == getattr(command, field), field


def test_every_stage_has_a_command_that_makes_it() -> None:
    made = {stage for name, one in OFFERED.items() if name != "run" for stage in one.stages()}
    assert made == {stage.name for stage in STAGES}
    for stage in STAGES:
        assert stage.name in OFFERED[stage.command].stages()


@pytest.mark.parametrize(
    ("given", "part"),
    [
        ({"threads": 0}, "threads"),
        ({"folders": ["relative"]}, "whole path"),
        ({"folders": ["/none/at/all"]}, "no such"),
        ({"time_zone": "a\nb"}, "printable"),
        ({"log_file": ["events.jsonl"]}, "log_file"),
        ({"workspace": "other"}, "workspace"),
    ],
)
def test_a_wrong_value_is_named_in_one_line(
    given: dict[str, Any], part: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError) as fault:
        command_of("import-images", given, tmp_path)
    assert part in str(fault.value) and "\n" not in str(fault.value)
