"""Commands on cameras behind flat ports: `alice-survey camera ...`."""

from pathlib import Path
from typing import Annotated

import typer

from alice_survey.app.cli.options import (
    CONTEXT,
    AsJson,
    examples,
    print_result,
)

app = typer.Typer(
    help="Look at, convert and judge camera models behind flat ports.",
    no_args_is_help=True,
    context_settings=CONTEXT,
    rich_markup_mode=None,
)

Temperature = Annotated[float, typer.Option(help="Temperature of the water, C.")]
Salinity = Annotated[float, typer.Option(help="Salinity of the water, psu; 0 is fresh.")]
Depth = Annotated[float, typer.Option(help="Depth below the surface, m.")]


@app.command(
    epilog=examples(
        "camera water --temperature 24 --salinity 39 --depth 15",
        "camera water --jerlov 3C --wavelength 450 --wavelength 520 --json",
    )
)
def water(
    temperature: Temperature = 20.0,
    salinity: Salinity = 35.0,
    depth: Depth = 10.0,
    jerlov: Annotated[str, typer.Option(help="Type: I, II, III; coastal 1C to 9C.")] = "II",
    wavelength: Annotated[
        list[float] | None, typer.Option(help="nm; red, green and blue when not given.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show index and attenuation of water."""
    from camera_calib.water import water_report

    print_result(*water_report(temperature, salinity, depth, jerlov, wavelength), as_json)


@app.command(
    epilog=examples(
        "camera convert rig.json cameras.xml",
        "camera convert rig.json model --to colmap --water 1.5 3 --drop-covariance",
        "camera convert rig.json model --to refractive --drop-covariance",
        "camera convert camchain.yaml rig.json --port-distance 20 --glass 10 --n-water 1.34",
        "camera convert gopro.json rig.json --dome-radius 60 --dome-centre 0 0 5 --n-water 1.34",
        "camera convert intrinsics.yml rig.json --extrinsics extrinsics.yml --image-size 640 480",
        "camera convert rig.json left.yaml --to ros --camera left --drop-port --drop-covariance",
    )
)
def convert(
    source: Annotated[Path, typer.Argument(metavar="IN", help="File, or folder of a model.")],
    target: Annotated[Path, typer.Argument(metavar="OUT", help="File, or folder.")],
    source_format: Annotated[
        str | None,
        typer.Option("--from", metavar="FORMAT", help="Found from the file if not given."),
    ] = None,
    target_format: Annotated[
        str | None,
        typer.Option(
            "--to",
            metavar="FORMAT",
            help="rig, opencv, colmap, refractive, kalibr, ros, metashape, mrcal.",
        ),
    ] = None,
    image_size: Annotated[
        tuple[int, int] | None,
        typer.Option(metavar="W H", help="Pixels, when IN states none; of a lens profile, others."),
    ] = None,
    extrinsics: Annotated[Path | None, typer.Option(help="OpenCV file of R and T.")] = None,
    unit_m: Annotated[float, typer.Option(help="Metres in one unit of IN's translations.")] = 1.0,
    camera: Annotated[str | None, typer.Option(help="Convert this camera alone.")] = None,
    lens: Annotated[
        str | None,
        typer.Option(
            help="fisheye or opencv: of an OpenCV file of 4 coefficients that does not say."
        ),
    ] = None,
    names: Annotated[str | None, typer.Option(help="New names, such as left,right.")] = None,
    port_distance: Annotated[
        float | None, typer.Option(min=0.0, help="Entrance pupil to inner glass, mm.")
    ] = None,
    dome_radius: Annotated[
        float | None, typer.Option(min=1.0, help="A dome's outer radius, mm.")
    ] = None,
    dome_centre: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="X Y Z", help="The dome's, from the pupil: right, down, forward, mm."),
    ] = None,
    glass: Annotated[float | None, typer.Option(min=0.0, help="Thickness, mm.")] = None,
    n_glass: Annotated[
        float | None, typer.Option(min=1.0, help="Index; if new 1.52, of a dome 1.49.")
    ] = None,
    n_water: Annotated[float | None, typer.Option(min=1.0, help="Index of the water.")] = None,
    water: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="NEAR FAR", help="m: fit cameras without port for these distances."),
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(
            help="To fit: OPENCV, FULL_OPENCV or OPENCV_FISHEYE; as the lens if not given."
        ),
    ] = None,
    drop_port: Annotated[bool, typer.Option("--drop-port", help="Cameras as in air.")] = False,
    drop_covariance: Annotated[
        bool, typer.Option("--drop-covariance", help="Leave it out where OUT cannot hold it.")
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace OUT.")] = False,
    as_json: AsJson = False,
) -> None:
    """Convert between tools.

    OpenCV, COLMAP, Refractive COLMAP, Kalibr, ROS, Metashape, mrcal, rig.json, and Gyroflow's lens
    profiles as starts; nothing is lost silently.
    """
    from camera_calib.formats.convert import Conversion
    from camera_calib.formats.convert import convert as work
    from camera_calib.formats.rigs import ReadOptions

    task = Conversion(
        source=source, target=target, source_format=source_format, target_format=target_format,
        reading=ReadOptions(
            image_size=image_size, extrinsics=extrinsics, metres_per_unit=unit_m, camera=camera,
            lens=lens,
        ),
        names=tuple(names.split(",")) if names else (), port_distance_mm=port_distance,
        dome_radius_mm=dome_radius, dome_centre_mm=dome_centre, glass_mm=glass, n_glass=n_glass,
        n_water=n_water, water=water, model=model, drop_port=drop_port,
        drop_covariance=drop_covariance, overwrite=overwrite,
    )  # fmt: skip
    print_result(*work(task), as_json)


@app.command(
    epilog=examples(
        "camera mount rig.json",
        "camera mount rig.json nadir-bow-up --lever 0.55 -0.05 0.08 -o rig.json --plot mount.png",
        "camera mount rig.json forward+30 -o mounted.json",
    )
)
def mount(
    rig: Annotated[Path, typer.Argument(metavar="RIG", help="rig.json.")],
    how: Annotated[
        str | None,
        typer.Argument(
            metavar="MOUNT",
            help="nadir-bow-up, -right, -down, -left; forward, aft, port, starboard; forward+30: "
            "30 degrees down; or a file of a pose or of another rig.",
        ),
    ] = None,
    lever: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="X Y Z", help="First camera's glass: forward, right, down, m."),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="rig.json to write; may be RIG itself.")
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace another file with --output.")
    ] = False,
    plot: Annotated[Path | None, typer.Option(help="PNG, SVG or PDF of the mount.")] = None,
    as_json: AsJson = False,
) -> None:
    """Show or state how a rig is mounted on its vehicle.

    The lever counts from the point whose position navigation states. Without a mount attitudes of
    navigation mean nothing for the pictures, until a survey finds it.
    """
    from camera_calib.mount import mount_report

    print_result(*mount_report(rig, how, lever, output, plot, overwrite=overwrite), as_json)


@app.command(
    epilog=examples("camera uncertainty rig.json", "camera uncertainty rig.json --range 2 --json")
)
def uncertainty(
    rig: Annotated[Path, typer.Argument(metavar="RIG", help="rig.json with its covariance.")],
    ranges: Annotated[
        list[float] | None, typer.Option("--range", help="Distances to look at, m.")
    ] = None,
    near: Annotated[float, typer.Option(help="Nearest of what poses are found from, m.")] = 1.0,
    far: Annotated[float, typer.Option(help="Farthest, m.")] = 3.0,
    noise: Annotated[float, typer.Option(min=0.0, help="Sigma of a coordinate, px.")] = 0.1,
    as_json: AsJson = False,
) -> None:
    """Show what a calibration's sigmas mean.

    For pixels over the frame, for triangulated points and for lengths, against distance.
    """
    from camera_calib.judge.uncertainty import uncertainty_report

    print_result(*uncertainty_report(rig, ranges, near, far, noise), as_json)
