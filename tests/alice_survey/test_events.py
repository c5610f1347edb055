"""Event and log files: whole lines, only ever added to."""

import json
import logging
import os
import re
from pathlib import Path

import pytest

from alice_survey.core.errors import WorkspaceError
from alice_survey.core.run.events import EventFile, LogFile, duration

TIME = "2023-11-14T22:13:20.250Z"


def write(file: logging.Handler, event: str, **known: object) -> dict[str, object]:
    """Have a file take an event down."""
    made = {"time_utc": TIME, "event": event, **known}
    level = {"warning": logging.WARNING, "error": logging.ERROR}.get(event, logging.INFO)
    file.handle(
        logging.makeLogRecord(
            {"levelno": level, "event": made, "levelname": logging.getLevelName(level)}
        )
    )
    return made


def write_step(file: logging.Handler, event: str, **known: object) -> dict[str, object]:
    return write(file, event, stage="dense", step="match", **known)


def test_a_line_holds_an_event(tmp_path: Path) -> None:
    file = EventFile(tmp_path / "new" / "events.jsonl")
    written = [
        write_step(file, "step_progress", done=3, total=9, elapsed_s=1.235, remaining_s=2.5),
        write(file, "warning", message="böse\nzwei"),
    ]
    lines = (tmp_path / "new" / "events.jsonl").read_text().splitlines()
    assert [json.loads(line) for line in lines] == written


def test_each_event_is_there_at_once(tmp_path: Path) -> None:
    file = EventFile(tmp_path / "e")
    for count in range(1, 4):
        write_step(file, "step_progress", done=count)
        assert len((tmp_path / "e").read_bytes().splitlines()) == count


@pytest.mark.parametrize("kind", [EventFile, LogFile])
def test_files_are_added_to(tmp_path: Path, kind: type[EventFile] | type[LogFile]) -> None:
    path = tmp_path / "file"
    path.write_text("whole\ncut by a full di")
    for text in ("one", "two"):
        file = kind(path)
        write(file, "note", message=text)
        file.close()
    lines = path.read_text().splitlines()
    assert lines[:2] == ["whole", "cut by a full di"]
    assert ["one" in lines[2], "two" in lines[3], len(lines)] == [True, True, 4]


@pytest.mark.parametrize("kind", [EventFile, LogFile])
def test_a_file_that_cannot_be_written_is_a_known_fault(
    tmp_path: Path, kind: type[EventFile] | type[LogFile]
) -> None:
    (tmp_path / "taken").write_text("a file")
    for path in (tmp_path, tmp_path / "taken" / "log"):
        with pytest.raises(WorkspaceError, match=path.name):
            kind(path)


def test_a_pipe_is_written_to_as_well(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        file = EventFile(pipe)
        write_step(file, "step_started")
        assert json.loads(os.read(reader, 1000))["step"] == "match"
        file.close()
    finally:
        os.close(reader)


def test_a_log_has_times_levels_and_the_lines_of_a_fault(tmp_path: Path) -> None:
    log = LogFile(tmp_path / "log")
    write(log, "stage_started", stage="dense", message="dense (3 of 5)")
    write_step(log, "step_finished", done=9, elapsed_s=4.04, complete=True)
    write(log, "warning", message="thin")
    fault = "Traceback:\n  File x\nValueError: y\n"
    write(log, "error", message="ValueError: y", traceback=fault)
    lines = (tmp_path / "log").read_text().splitlines()
    assert lines == [
        "2023-11-14T22:13:20.250Z INFO stage dense (3 of 5)",
        "2023-11-14T22:13:20.250Z INFO dense: match: 9 done in 4.0 s",
        "2023-11-14T22:13:20.250Z WARNING thin",
        "2023-11-14T22:13:20.250Z ERROR ValueError: y",
        "    Traceback:",
        "      File x",
        "    ValueError: y",
    ]


def test_a_log_says_how_far_a_step_is_every_half_minute(tmp_path: Path) -> None:
    log = LogFile(tmp_path / "log")
    for second in range(100):
        write_step(log, "step_progress", step_number=1, done=second, elapsed_s=second)
    counts = re.findall(r"match (\d+) after", (tmp_path / "log").read_text())
    assert counts == ["30", "60", "90"]


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.4, "0 s"), (59.4, "59 s"), (59.6, "1 min 00 s"), (3599.0, "59 min 59 s"),
     (3600.0, "1 h 00 min"), (90_000.0, "25 h 00 min")],
)  # fmt: skip
def test_lengths_of_time_in_words(seconds: float, words: str) -> None:
    assert duration(seconds) == words
