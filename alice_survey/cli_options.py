"""Options and habits that all commands share."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

CONTEXT = {"help_option_names": ["-h", "--help"]}

Workspace = Annotated[
    Path, typer.Option("-w", "--workspace", help="Folder that holds the stages of one survey.")
]
SurveyFile = Annotated[
    Path | None,
    typer.Option(
        "-s", "--survey", help="Settings; WORKSPACE/survey.toml, then ./survey.toml, if not given."
    ),
]
Threads = Annotated[
    int | None, typer.Option(min=1, max=256, help="Cores to use; all when not given.")
]
Scale = Annotated[
    int | None,
    typer.Option(min=1, max=16, help="Divide the resolution of rendered pictures by this."),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print machine-readable JSON.")]
WORK = Path("work")


def examples(*lines: str) -> str:
    """An epilog that keeps its lines (the first character tells the formatter not to wrap)."""
    return "\b\nExamples:\n" + "\n".join(f"  alice-survey {line}" for line in lines)


def print_result(table: str, data: Any, as_json: bool) -> None:
    """Print a command's result as text, or as JSON when asked."""
    typer.echo(json.dumps(data, indent=2) if as_json else table)
