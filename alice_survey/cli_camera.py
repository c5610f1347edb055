"""Commands on cameras behind flat ports: `alice-survey camera ...`."""

import typer

from alice_survey.cli_options import CONTEXT

app = typer.Typer(
    help="Look at, convert and judge camera models behind flat ports.",
    no_args_is_help=True,
    context_settings=CONTEXT,
    rich_markup_mode=None,
)
