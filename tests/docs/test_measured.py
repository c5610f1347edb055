"""The pages of *Measured* are what is kept of the measurements, and what they name exists."""

import datetime as dt
import re

from tests.docs.measured import FOLDER, KEPT, ORDER, all_pages, group_of, page_of

ROOT = KEPT.parents[2]
MAX_CELL = 60


def test_pages_are_what_the_json_gives() -> None:
    assert sorted(ORDER) == sorted(path.stem for path in KEPT.glob("*.json"))
    for path, text in all_pages().items():
        assert path.read_text(encoding="utf-8") == text, path.name
    assert {*FOLDER.glob("*.md")} - {*all_pages()} == {FOLDER / "other-programs.md"}


def test_cells_are_short_and_rows_dated() -> None:
    for name in ORDER:
        for section in group_of(name)["sections"]:
            for row in section["rows"]:
                whole = section | row
                assert dt.date(2026, 11, 20) < dt.date.fromisoformat(whole["date"]), row
                assert set(row) <= {"claim", "value", "spread", "machine", "date", "command"}, row
        for line in page_of(name).splitlines():
            if line.startswith("|"):
                cells = line.strip("| ").replace("`", "").split(" | ")
                assert max(map(len, cells)) <= MAX_CELL, line


def test_what_commands_name_exists() -> None:
    commands = {
        (section | row)["command"]
        for name in ORDER for section in group_of(name)["sections"] for row in section["rows"]
    }  # fmt: skip
    for command in commands:
        for module in re.findall(r"python -m ([\w.]+)", command):
            path = ROOT / module.replace(".", "/")
            assert path.is_dir() or path.with_suffix(".py").is_file(), command
        for tests in re.findall(r"\btests/[\w/.]+", command):
            assert (ROOT / tests).exists(), command
