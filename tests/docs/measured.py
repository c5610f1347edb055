"""The pages of *Measured*, made from `benchmarks/kept/measured`.

    python -m tests.docs.measured

A file holds a group: `title`, `about` and `sections`, each of which has a `title`, maybe a
`note`, and `rows` of `claim`, `value` and maybe `spread`. `machine`, `date` and `command` are the
section's, or the row's own. A value holds for the version of its date.
"""

import json
from pathlib import Path
from typing import Any

from tests.docs.pages import DOCS

KEPT = DOCS.parent / "benchmarks" / "kept" / "measured"
FOLDER = DOCS / "measured"
ORDER = (
    "first-minutes", "demo", "surveys", "scenes", "large", "clusters", "peers", "camera",
    "housings", "colour", "navigation", "vehicle", "planning", "studio", "reliability",
)  # fmt: skip
_HEAD = ["| claim | number (spread) | machine, date | command |", "|---|---|---|---|"]
_LONGEST_COMMAND = 60
_NOTICE = "<!-- made by `python -m tests.docs.measured` from benchmarks/kept/measured -->"
_INDEX = f"""# Measured
{_NOTICE}

Every figure with the machine, the date and the command that measured it. A figure holds for the
version of its date: later versions may differ. Where nothing else is said, a machine has two cores
of an AMD EPYC and no GPU; "busy" means that other programs used them at the time.
`python -m benchmarks --work W` runs all comparisons and tabulates them with their spread. A ditto
mark stands for the cell above.

| page | what |
|---|---|
"""
_LAST = "| [Other programs](other-programs.md) | Other programs on large surveys, quoted. |\n"


def group_of(name: str) -> dict[str, Any]:
    """What is kept of a group."""
    group: dict[str, Any] = json.loads((KEPT / f"{name}.json").read_text(encoding="utf-8"))
    return group


def page_of(name: str) -> str:
    """A group as a page in Markdown."""
    group, commands = group_of(name), list[str]()
    lines = [f"# {group['title']}", _NOTICE, "", group["about"]]
    for section in group["sections"]:
        lines += ["", f"## {section['title']}", *_HEAD]
        rows = [_cells(section | row, commands) for row in section["rows"]]
        for above, row in zip([[""] * 4, *rows], rows, strict=False):
            same = ['"' if i > 1 and row[i] == above[i] else row[i] for i in range(4)]
            lines.append(f"| {' | '.join(same)} |")
        lines += ["", section["note"]] if "note" in section else []
    if commands:
        lines += ["", "## Commands"]
        lines += [f"{i}. {_code(command)}" for i, command in enumerate(commands, 1)]
    return "\n".join(lines) + "\n"


def _cells(row: dict[str, str], commands: list[str]) -> list[str]:
    """The cells of a row; a long command goes to the list at the page's end."""
    number = row["value"] + (f" ({row['spread']})" if "spread" in row else "")
    command = row["command"]
    if len(command) > _LONGEST_COMMAND:
        if command not in commands:
            commands.append(command)
        shown = f"[{commands.index(command) + 1}](#commands)"
    else:
        shown = _code(command)
    return [row["claim"], number, f"{row['machine']}, {row['date']}", shown]


def _code(command: str) -> str:
    """A command as code; words that are partly code stand for themselves."""
    return command if "`" in command or not command else f"`{command}`"


def index() -> str:
    """The page that lists the others."""
    rows = [(name, group_of(name)) for name in ORDER]
    listed = "".join(f"| [{one['title']}]({name}.md) | {one['about']} |\n" for name, one in rows)
    return _INDEX + listed + _LAST


def all_pages() -> dict[Path, str]:
    """Every page that is made here, and its text."""
    return {FOLDER / "index.md": index(), **{FOLDER / f"{one}.md": page_of(one) for one in ORDER}}


if __name__ == "__main__":
    for path, text in all_pages().items():
        path.write_text(text, encoding="utf-8")
