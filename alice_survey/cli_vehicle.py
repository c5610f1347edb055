"""The `vehicle` commands: its coefficients, how it compares, and what its logs tell of it."""

import typer

from alice_survey.cli_options import CONTEXT

app = typer.Typer(
    help="The vehicle: coefficients from geometry and from logs, and how its two forms compare.",
    no_args_is_help=True,
    context_settings=CONTEXT,
    rich_markup_mode=None,
)
