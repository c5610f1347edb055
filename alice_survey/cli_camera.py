"""Commands on cameras behind flat ports: `alice-survey camera ...`."""

from pathlib import Path
from typing import Annotated

import typer

from alice_survey.cli_options import CONTEXT, AsJson, Threads, examples, print_result

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


@app.command(
    epilog=examples(
        "camera undisperse images/left/*.png --rig rig.json --range 2 -o corrected/left",
        "camera undisperse dive/*.jpg --rig rig.json --range 1.5 -o out --glass pmma --salinity 39",
    )
)
def undisperse(
    pictures: Annotated[list[Path], typer.Argument(metavar="PICTURE...", help="In colour.")],
    rig: Annotated[Path, typer.Option(help="rig.json; its indices hold for green.")],
    folder: Annotated[Path, typer.Option("-o", "--out", help="Folder for the corrected ones.")],
    distance: Annotated[float, typer.Option("--range", min=0.0, help="To the scene, m.")],
    camera: Annotated[str | None, typer.Option(help="Whose; the rig's first if none.")] = None,
    temperature: Annotated[float, typer.Option(help="Of the water, C.")] = 20.0,
    salinity: Annotated[float, typer.Option(help="psu; 0 is fresh.")] = 35.0,
    depth: Annotated[float, typer.Option(help="Below the surface, m.")] = 10.0,
    glass: Annotated[
        str, typer.Option(help="Port: bk7, fused-silica, sapphire, pmma, polycarbonate.")
    ] = "bk7",
    wavelength: Annotated[
        list[float] | None, typer.Option(help="nm, thrice: of red, green and blue.")
    ] = None,
    threads: Threads = None,
    as_json: AsJson = False,
) -> None:
    """Warp red and blue onto green.

    A flat port shows each colour at its own scale: some pixels apart at the edge of the frame.
    """
    from alice_survey.executor import default_threads
    from camera_calib.undisperse import undisperse_files

    text, data = undisperse_files(
        pictures, folder, rig=rig, camera=camera, range_m=distance, temperature_c=temperature,
        salinity_psu=salinity, depth_m=depth, glass=glass, wavelengths_nm=wavelength,
        threads=threads or default_threads(),
    )  # fmt: skip
    print_result(text, data, as_json)


@app.command(
    epilog=examples(
        "camera residual --near 1.5 --far 2.5",
        "camera residual --near 1 --far 3 --rig rig.json --camera left --plot residual.png",
    )
)
def residual(
    near: Annotated[float, typer.Option(help="Nearest distance, m.")],
    far: Annotated[float, typer.Option(help="Farthest distance, m.")],
    survey: Annotated[Path | None, typer.Option("-s", "--survey", help="Its design.")] = None,
    rig: Annotated[Path | None, typer.Option(help="rig.json; instead of a design.")] = None,
    camera: Annotated[str | None, typer.Option(help="The rig's first if none.")] = None,
    exact_at: Annotated[float | None, typer.Option(help="Range of the warp, m.")] = None,
    plot: Annotated[Path | None, typer.Option(help="PNG, PDF or SVG to draw.")] = None,
    as_json: AsJson = False,
) -> None:
    """Tell what approximations cost.

    Pixels that pinholes after a warp, and COLMAP's cameras without one, are wrong by through this
    port. Distances are from the entrance pupil along the axis.
    """
    from camera_calib.residual_report import residual_report

    text, data = residual_report(
        near, far, survey=survey, rig=rig, camera=camera, working_range_m=exact_at, plot=plot
    )
    print_result(text, data, as_json)
