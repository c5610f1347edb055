"""The commands that turn pictures into a model, measure in it, and score it."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from alice_survey.app.cli.options import (
    CONTEXT,
    WORK,
    AsJson,
    ClusterFile,
    Device,
    Scheduler,
    SurveyFile,
    Threads,
    Workspace,
    examples,
    executor_of,
    executor_on,
    print_result,
)
from alice_survey.core.errors import ConfigError

app = typer.Typer()
reconstruct_app = typer.Typer(
    invoke_without_command=True,
    context_settings=CONTEXT,
    rich_markup_mode=None,
    epilog=examples(
        "reconstruct -w reef",
        "reconstruct -w reef --threads 2 --json",
        "reconstruct -w reef --scheduler tcp://10.0.0.1:8786",
        "reconstruct -w quay --plane level --plane 'wall=facing 180'",
        "reconstruct -w reef --export undistorted",
        "reconstruct -w reef --crs EPSG:32636",
    ),
)


@reconstruct_app.callback()
def reconstruct(
    context: typer.Context,
    workspace: Workspace = WORK,
    survey: SurveyFile = None,
    plane: Annotated[
        list[str] | None,
        typer.Option(
            help="Plane of DEM and mosaic, any number: level, auto (the best one), or "
            "'NAME=facing DEGREES tilt DEGREES': where the surface faces, and its lean back."
        ),
    ] = None,
    export: Annotated[
        Literal["undistorted"] | None,
        typer.Option(
            help="Then write for other programs: pictures without refraction and distortion, with "
            "the COLMAP model and nerfstudio's transforms.json."
        ),
    ] = None,
    crs: Annotated[
        str | None,
        typer.Option(
            metavar="EPSG:N",
            help="Then write rasters, cloud, mesh and track in this projected system too.",
        ),
    ] = None,
    threads: Threads = None,
    scheduler: Scheduler = None,
    cluster: ClusterFile = None,
    device: Device = "auto",
    as_json: AsJson = False,
) -> None:
    """Turn pictures into a model.

    Camera track, DEM, point cloud, orthomosaic and textured mesh.
    """
    if context.invoked_subcommand is None:
        from alice_survey.app.pipeline import run
        from alice_survey.core.stages import names

        stages = names("calibrate", "reconstruct")
        with executor_on(workspace, threads, scheduler, cluster, device) as executor:
            text, values = run(stages, workspace, survey, None, executor, planes=plane)
            if export is not None:
                from reconstruct.export.undistorted import export_undistorted

                more, values[export] = export_undistorted(workspace, executor)
                text = f"{text}\n{more}"
        if crs is not None:
            from reconstruct.export.projected import export_projected

            more, values["crs"] = export_projected(workspace, crs)
            text = f"{text}\n{more}"
        print_result(text, values, as_json)


@reconstruct_app.command(hidden=True)
def pair(pictures: Annotated[list[Path], typer.Argument()], rig: Path = Path("rig.json")) -> None:
    """Say what to use instead."""
    raise ConfigError(
        "two pictures are a workspace now: run 'import-images --left FOLDER --right FOLDER "
        f"--rig {rig} -w NAME', 'reconstruct -w NAME' and 'measure -w NAME'"
    )


@app.command(
    epilog=examples(
        "measure reef --points 'left/000012.png:301,255 left/000012.png:640,270' --json",
        "measure reef --polygons colonies.gpkg --label species -o colonies.csv",
    )
)
def measure(
    points: Annotated[
        str | None,
        typer.Option(
            help="Two or more pixels: 'IMAGE:x,y', or 'IMAGE:x,y=IMAGE:x,y' where two pictures "
            "show the point."
        ),
    ] = None,
    polygons: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Measure the polygons of a file: GeoJSON, GeoPackage, shapefile or KML.",
        ),
    ] = None,
    label: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Attribute that holds the label of each polygon."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", metavar="FILE", help="Write polygons and figures: .csv or .geojson."
        ),
    ] = None,
    pick_sigma: Annotated[
        float, typer.Option(min=0, help="Sigma of a picked pixel, or of a polygon's corner, px.")
    ] = 0.0,
    workspace: Workspace = WORK,
    as_json: AsJson = False,
) -> None:
    """Measure between picked pixels, or within polygons.

    The distance of two points with its sigma; of more, their path and the area they enclose. Of
    polygons the area in plan and of the surface, the rugosity, and what each label covers.
    """
    if (points is None) == (polygons is None):
        raise ConfigError("measure takes either --points or --polygons")
    if polygons is not None:
        from reconstruct.measure.polygon_files import measure_polygon_file

        result = measure_polygon_file(
            workspace, polygons, label=label, pick_sigma_px=pick_sigma, output=output
        )
    else:
        from reconstruct.picking.measure import measure as measured

        result = measured(workspace, points or "", pick_sigma_px=pick_sigma)
    print_result(*result, as_json)


ScalePoints = Annotated[
    str | None,
    typer.Option(
        metavar="POINTS",
        help="Two points of a known distance: 'x,y,z x,y,z' in the model, or 'IMAGE:x,y IMAGE:x,y' "
        "in pictures.",
    ),
]
ScaleLength = Annotated[
    float | None,
    typer.Option(min=1e-6, metavar="METRES", help="Distance between the two points of --points."),
]


@app.command(
    epilog=examples(
        "control -w reef",
        "control -w reef --dictionary DICT_5X5_250",
        "control -w reef --points '0,0,0 1.2,0,0.1' --length 0.5",
        "control -w reef --points 'left/001.png:512,300 left/001.png:930,312' --length 0.5",
    )
)
def control(
    workspace: Workspace = WORK,
    dictionary: Annotated[
        str | None,
        typer.Option(
            metavar="NAME", help="Dictionary of the coded markers; without it all are tried (slow)."
        ),
    ] = None,
    points: ScalePoints = None,
    length: ScaleLength = None,
    threads: Threads = None,
    as_json: AsJson = False,
) -> None:
    """Find coded markers and prepare the picking of control points, or scale by a known length.

    Known points, bars and markers stand in WORKSPACE/control.csv; the next 'reconstruct' places
    and scales the model by those for control, and scores those for check. One length between two
    points of the model, given by --points and --length, scales a model without control.
    """
    from reconstruct.placing.control_command import scale_model, survey_control

    if points is None and length is None:
        result = survey_control(workspace, dictionary=dictionary, executor=executor_of(threads))
        print_result(*result, as_json)
        return
    if points is None or length is None:
        raise typer.BadParameter("--points and --length go together: give both, or neither")
    text = scale_model(workspace, points, length)
    print_result(text, {"text": text}, as_json)


@app.command(hidden=True)
def scale(points: ScalePoints, length: ScaleLength, workspace: Workspace = WORK) -> None:
    """Run 'control --points --length' under its former name."""
    typer.echo("scale is now: control --points POINTS --length METRES", err=True)
    control(workspace, points=points, length=length)


@app.command(epilog=examples("quality -w reef", "quality -w reef --json"))
def quality(workspace: Workspace = WORK, threads: Threads = None, as_json: AsJson = False) -> None:
    """Judge the pictures.

    Sharpness, exposure, turbidity and overlap of each; the bad ones by name, with the reason.
    """
    from reconstruct.pictures.quality import quality_report

    print_result(*quality_report(workspace, executor_of(threads)), as_json)


@app.command(
    epilog=examples(
        "evaluate -w reef",
        "evaluate -w reef --reference laser.laz",
        "evaluate -w reef --against last_year --json",
    )
)
def evaluate(
    workspace: Workspace = WORK,
    survey: SurveyFile = None,
    reference: Annotated[
        Path | None, typer.Option(help="A cloud (LAZ, LAS, PLY) or DEM (GeoTIFF) instead.")
    ] = None,
    free_scale: Annotated[
        bool | None,
        typer.Option("--free-scale/--hold-scale", help="Fit the scale to the reference too."),
    ] = None,
    against: Annotated[
        Path | None, typer.Option(help="Workspace of an earlier survey of the site.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder for these two.")
    ] = None,
    threads: Threads = None,
    as_json: AsJson = False,
) -> None:
    """Score a survey.

    A simulated one against its truth: camera track, surface, mosaic, mesh. A real one against
    a reference, or against an earlier survey: what has changed, with its significance and volume.
    """
    if reference is not None:
        from reconstruct.evaluate.reference import evaluate_reference

        result = evaluate_reference(workspace, reference, free_scale=free_scale, out=output)
    elif against is not None:
        from reconstruct.evaluate.against import evaluate_against

        result = evaluate_against(workspace, against, output)
    else:
        from alice_survey.app.pipeline import run

        result = run(["evaluate"], workspace, survey, None, executor_of(threads))
    print_result(*result, as_json)


@app.command(
    epilog=examples(
        "mosaic-tiles -w reef -o tiles", "mosaic-tiles -w reef -o tiles --side 32767 --kind tif"
    )
)
def mosaic_tiles(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder to write.")],
    workspace: Workspace = WORK,
    side: Annotated[int, typer.Option(min=256, max=32_767, help="Side of a tile, px.")] = 8192,
    overlap: Annotated[int, typer.Option(min=0, help="Overlap of neighbours, px.")] = 0,
    kind: Annotated[Literal["png", "jpg", "tif"], typer.Option(help="Format.")] = "png",
    scale_bar: Annotated[
        bool, typer.Option("--scale-bar", help="Draw one into every tile.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Cut the mosaic for annotation tools.

    Tiles that TagLab, BIIGLE and others take, each with a world file; tiles.csv lists their scale.
    """
    from reconstruct.mosaic.annotation import mosaic_tiles as cut

    result = cut(
        workspace, output, side_px=side, overlap_px=overlap, kind=kind, scale_bar=scale_bar
    )
    print_result(*result, as_json)
