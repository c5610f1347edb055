"""Commands that show a survey: the report, and the server for what is too large for one page."""

from typing import Annotated

import typer

from alice_survey.cli.options import (
    CONTEXT,
    WORK,
    AsJson,
    SurveyFile,
    Threads,
    Workspace,
    examples,
    executor_of,
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
    next; map, mesh, errors, calibration, settings. It shows what the workspace holds so far.
    """
    from alice_survey.survey import run

    print_result(*run(["report"], workspace, survey, None, executor_of(threads)), as_json)


@app.command("view", hidden=True)
@app.command(
    epilog=examples(
        "studio -w reef",
        "studio -w reef --port 8000 --no-browser",
        "studio -w reef --log nav.csv",
    )
)
def studio(
    workspace: Workspace = WORK,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="To listen on; 0 for any that is free.")
    ] = 0,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")
    ] = True,
    log: Annotated[
        str | None,
        typer.Option(
            metavar="LOG",
            help="Dive to follow: growing navigation CSV, udp[:PORT], mavlink:URL, ros[:TOPIC].",
        ),
    ] = None,
) -> None:
    """Show a survey in a browser, however large.

    Serves map, mesh and files of a workspace to this machine alone, at full resolution, until
    Ctrl-C. A GIS can open its rasters by their addresses.
    """
    from alice_survey.studio.server import run_studio

    run_studio(workspace, port, browser=browser, show=typer.echo, log=log)
