"""Commands on cameras behind flat ports: `alice-survey camera ...`."""

from typing import Annotated

import typer

from alice_survey.cli_options import CONTEXT, AsJson, examples, print_result

app = typer.Typer(
    help="Look at, convert and judge camera models behind flat ports.",
    no_args_is_help=True,
    context_settings=CONTEXT,
    rich_markup_mode=None,
)


@app.command(
    epilog=examples(
        "camera water --temperature 24 --salinity 39 --depth 15",
        "camera water --jerlov 3C --wavelength 450 --wavelength 520 --json",
    )
)
def water(
    temperature: Annotated[float, typer.Option(help="Of the water, C.")] = 20.0,
    salinity: Annotated[float, typer.Option(help="psu; 0 is fresh.")] = 35.0,
    depth: Annotated[float, typer.Option(help="Below the surface, m.")] = 10.0,
    jerlov: Annotated[str, typer.Option(help="Type: I, II, III; coastal 1C to 9C.")] = "II",
    wavelength: Annotated[
        list[float] | None, typer.Option(help="nm; red, green and blue when not given.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Tell index and attenuation of water."""
    from camera_calib.water import water_report

    print_result(*water_report(temperature, salinity, depth, jerlov, wavelength), as_json)
