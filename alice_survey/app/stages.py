"""The list of stages: run, status, report, studio and documentation read it."""

from pathlib import Path

import missions.stages
import reconstruct.stages
from alice_survey.core.artefacts import StageRecord, read_stage, stage_command
from alice_survey.core.errors import WorkspaceError
from alice_survey.core.records import ReportRecord
from alice_survey.core.stages import StageSpec, Summary
from camera_calib.stages import CALIBRATE

LOOSE_FOLDERS = ("quality", "reference", "against")
"""Folders that commands write next to those of the stages, and that a report shows."""


def spec(name: str) -> StageSpec:
    """The stage of a name, or of a folder.

    Raises:
        WorkspaceError: there is none.
    """
    for stage in STAGES:
        if name in (stage.name, stage.folder):
            return stage
    raise WorkspaceError(f"there is no stage {name!r}: the stages are {', '.join(names())}")


def names(*commands: str) -> list[str]:
    """Names of the stages that some commands run, in order; of all stages without one."""
    return [stage.name for stage in STAGES if not commands or stage.command in commands]


def finished_stages(workspace: Path) -> dict[str, StageRecord]:
    """Records of all finished stages, by their folders."""
    found = {stage.folder: read_stage(workspace / stage.folder) for stage in STAGES}
    return {folder: record for folder, record in found.items() if record is not None}


def table() -> str:
    """All stages as a Markdown table, for the documentation."""
    rows = [
        f"| `{stage.name}` | `{stage.folder}/` | `{stage.command}` | {stage.about} | "
        f"{', '.join(f'`{name}`' for name in stage.needs)} | "
        f"{'; '.join(f'`{path}` ({what})' for path, what in stage.products.items())} |"
        for stage in STAGES
    ]
    head = "| stage | folder | made by | what it does | needs | products |"
    return "\n".join([head, "|---|---|---|---|---|---|", *rows])


def _report_inputs(workspace: Path) -> list[Path]:
    if not finished_stages(workspace):
        ways = (repr(stage_command(name, workspace)) for name in ("plan", "import-images"))
        raise WorkspaceError(f"{workspace} holds nothing to report on: run {' or '.join(ways)}")
    read = [workspace / "survey.toml"]
    read += [workspace / stage.folder / path for stage in STAGES for path in stage.reported]
    read += [f for name in LOOSE_FOLDERS for f in sorted((workspace / name).rglob("*.json"))]
    read += sorted((workspace / "quality").glob("*.csv"))
    return [path for path in read if path.exists()]


def _report_summary(folder: Path) -> Summary:
    found = ReportRecord.read(folder / "report.json")
    answers = "\n".join(f"  {question}: {text}" for question, text in found.summary.items())
    return f"{folder / 'report.html'} and {folder / 'report.pdf'}\n{answers}", found.to_json()


REPORT = StageSpec(
    name="report",
    folder="report",
    command="report",
    about="a page and a PDF of what the workspace holds",
    version=17,
    work="alice_survey.app.report.run:run_report",
    uses=("mosaic", "mesh", "evaluate"),
    inputs=_report_inputs,
    summary=_report_summary,
    products={"report.html": "one page that needs no network", "report.pdf": "the same to print"},
)


STAGES: tuple[StageSpec, ...] = (
    *missions.stages.STAGES,
    CALIBRATE,
    *reconstruct.stages.STAGES,
    REPORT,
)
"""All stages, in the order in which they run."""
