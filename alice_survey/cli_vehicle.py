"""The `vehicle` commands: its coefficients, how it compares, and what its logs tell of it."""

from pathlib import Path
from typing import Annotated

import typer

from alice_survey.cli_options import CONTEXT, AsJson, examples, print_result

app = typer.Typer(
    help="The vehicle: coefficients from geometry and from logs, and how its two forms compare.",
    no_args_is_help=True,
    context_settings=CONTEXT,
    rich_markup_mode=None,
)


@app.command(
    epilog=examples(
        "vehicle coefficients",
        "vehicle coefficients --csv coefficients.csv --plot coefficients.png",
        "vehicle coefficients --json",
    )
)
def coefficients(
    csv: Annotated[Path | None, typer.Option(help="CSV file to write.")] = None,
    plot: Annotated[Path | None, typer.Option(help="PNG, PDF or SVG to draw.")] = None,
    as_json: AsJson = False,
) -> None:
    """Compute coefficients from shape, beside the paper's.

    Every row of the paper's three tables of added mass, damping and lift, with the equation, and
    with the reason where its value does not follow from the vehicle's shape.
    """
    from alice_survey.vehicle.hydrodynamics.report import coefficients_report

    print_result(*coefficients_report(csv, plot), as_json)
