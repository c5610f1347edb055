"""Event and log files: whole lines, only ever added to."""

import json
import logging
import os
from pathlib import Path

import pytest

from alice_survey.core.errors import WorkspaceError
from alice_survey.core.run.events import EventFile

TIME = "2023-11-14T22:13:20.250Z"


def write(file: logging.Handler, event: str, **known: object) -> dict[str, object]:
    """Have a file take an event down."""
    made = {"time_utc": TIME, "event": event, **known}
    file.handle(logging.makeLogRecord({"levelno": logging.INFO, "event": made}))
    return made


def test_a_line_holds_an_event_at_once(tmp_path: Path) -> None:
    file, written = EventFile(tmp_path / "new" / "events.jsonl"), []
    for count in range(1, 4):
        written.append(write(file, "step_progress", done=count, total=9, remaining_s=2.5))
        written.append(write(file, "warning", message="böse\nzwei"))
        lines = (tmp_path / "new" / "events.jsonl").read_text().splitlines()
        assert [json.loads(line) for line in lines] == written


def test_files_are_added_to(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("whole\ncut by a full di")
    for text in ("one", "two"):
        file = EventFile(path)
        write(file, "note", message=text)
        file.close()
    *before, one, two = path.read_text().splitlines()
    assert before == ["whole", "cut by a full di"]
    assert "one" in one and "two" in two


def test_a_file_that_cannot_be_written_is_a_known_fault(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file")
    for path in (tmp_path, tmp_path / "taken" / "log"):
        with pytest.raises(WorkspaceError, match=path.name):
            EventFile(path)


def test_a_pipe_is_written_to_as_well(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        file = EventFile(pipe)
        write(file, "step_started", step="match")
        assert json.loads(os.read(reader, 1000))["step"] == "match"
        file.close()
    finally:
        os.close(reader)
