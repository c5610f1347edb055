"""Commands that show a survey: the report, and the server for what is too large for one page."""

import typer

from alice_survey.cli_options import (
    CONTEXT,
    WORK,
    AsJson,
    SurveyFile,
    Threads,
    Workspace,
    examples,
    print_result,
)

app = typer.Typer(context_settings=CONTEXT, rich_markup_mode=None)


@app.command(epilog=examples("report -w reef", "report -w reef --json"))
def report(
    workspace: Workspace = WORK,
    survey: SurveyFile = None,
    threads: Threads = None,
    as_json: AsJson = False,
) -> None:
    """Write the report of a survey.

    One page that needs no network, and the same as PDF: what was mapped, how well, what to do
    next; map, mesh, errors, calibration, settings. It tells what the workspace holds so far.
    """
    from alice_survey.survey import run

    print_result(*run(["report"], workspace, survey, None, threads), as_json)
