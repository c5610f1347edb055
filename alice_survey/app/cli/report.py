"""Commands that show a survey: the report, and the server for what is too large for one page."""

from typing import Annotated

import typer

from alice_survey.app.cli.options import (
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
    from alice_survey.app.pipeline import run

    print_result(*run(["report"], workspace, survey, None, executor_of(threads)), as_json)


@app.command("view", hidden=True)
@app.command(
    epilog=examples(
        "studio -w reef",
        "studio -w reef --log nav.csv",
        "studio -w reef --port 8000 --no-browser",
    )
)
def studio(
    workspace: Workspace = WORK,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="To listen on; 0 for any that is free.")
    ] = 0,
    background: Annotated[
        str | None,
        typer.Option(
            metavar="URL", help="Tiles of a web map under it, with {z}, {x} and {y}: network."
        ),
    ] = None,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")
    ] = True,
    log: Annotated[
        str | None,
        typer.Option(
            metavar="LOG",
            help="Navigation CSV of a dive to follow, which grows.",
        ),
    ] = None,
) -> None:
    """Plan, run, look at and measure a survey in a browser.

    Serves one page for a workspace to this machine alone, until Ctrl-C: draw the area and watch
    the plan, start the stages, look at rasters and mesh at full resolution, measure. A GIS can open
    its rasters by their addresses.
    """
    from alice_survey.app.studio.server import run_studio

    run_studio(workspace, port, browser=browser, show=typer.echo, log=log, background=background)
