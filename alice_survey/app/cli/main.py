"""The command line: each command parses, calls and prints; the work is elsewhere."""

import gc
import os
from pathlib import Path
from typing import Annotated, Literal

import typer

from alice_survey.app.cli.camera import app as camera_app
from alice_survey.app.cli.intake import app as import_app
from alice_survey.app.cli.live import app as live_app
from alice_survey.app.cli.options import (
    CONTEXT,
    WORK,
    AsJson,
    ClusterFile,
    Device,
    RigCamera,
    Scale,
    Scheduler,
    SurveyFile,
    Threads,
    Workspace,
    examples,
    executor_of,
    executor_on,
    print_result,
    with_sessions,
)
from alice_survey.app.cli.plan import app as plan_app
from alice_survey.app.cli.reconstruct import app as model_app
from alice_survey.app.cli.reconstruct import reconstruct_app
from alice_survey.app.cli.report import app as report_app
from alice_survey.app.cli.vehicle import app as vehicle_app
from alice_survey.core.errors import known_fault

app = typer.Typer(
    name="alice-survey",
    help="Plan, fly, image and reconstruct close-range underwater imaging surveys, and score them.",
    epilog="A first survey, planned, flown, pictured, reconstructed and scored: alice-survey demo",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings=CONTEXT,
    rich_markup_mode=None,
)
app.add_typer(plan_app, name="plan")
app.add_typer(import_app)
app.add_typer(live_app)
app.add_typer(reconstruct_app, name="reconstruct")
app.add_typer(model_app)
app.add_typer(report_app)
app.add_typer(camera_app, name="camera")
app.add_typer(vehicle_app, name="vehicle")


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"alice-survey {version('alice-survey')}")
        raise typer.Exit


@app.command(
    epilog=examples(
        "init reef",
        "init reef --area reef.geojson",
        "init harbour --example caesarea",
    )
)
def init(
    workspace: Workspace = WORK,
    area: Annotated[
        Path | None,
        typer.Option(help="GeoJSON, KML, KMZ, GeoPackage, shapefile, WKT or .plan of the area."),
    ] = None,
    example: Annotated[
        Literal["demo", "caesarea"] | None, typer.Option(help="A ready survey instead.")
    ] = None,
) -> None:
    """Write a commented survey.toml.

    It holds the paper's mission: 15 x 17 m, lines 1 m apart, 2 m altitude, 0.2 m/s.
    """
    from alice_survey.app.pipeline import init_survey

    path = init_survey(workspace, f"{example or 'survey'}.toml", area)
    typer.echo(f"wrote {path}; next: alice-survey plan -w {workspace}")


@app.command(
    epilog=examples(
        "fov",
        "fov --lens 12.5 --lens 25 --altitude 1.5 --altitude 2 --n-water 1.345 --json",
        "fov --speed 0.2 --speed 0.5 --exposure 1 --exposure 3",
        "fov --rig calibration/rig.json --altitude 2 --plot fov.png --csv fov.csv",
        "fov --validate",
    )
)
def fov(
    lens: Annotated[
        list[float] | None, typer.Option(metavar="MM", help="Focal length of a lens to show.")
    ] = None,
    altitude: Annotated[
        list[float] | None,
        typer.Option(metavar="METRES", help="Altitude of the port's outer glass."),
    ] = None,
    n_water: Annotated[
        float | None,
        typer.Option(min=1, max=1.4, metavar="INDEX", help="Refractive index of the water."),
    ] = None,
    speed: Annotated[
        list[float] | None, typer.Option(metavar="M/S", help="Speed over ground, for the blur.")
    ] = None,
    exposure: Annotated[
        list[float] | None,
        typer.Option(metavar="MS", help="Time of the shutter, or of the strobe if shorter."),
    ] = None,
    rig: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Show a calibrated rig.json instead.")
    ] = None,
    camera: RigCamera = None,
    survey: Annotated[
        Path | None,
        typer.Option(
            "-s",
            "--survey",
            metavar="FILE",
            help="Take camera, port, aperture, water and plan from this survey.toml.",
        ),
    ] = None,
    validate: Annotated[
        bool,
        typer.Option("--validate", help="Check the paper's optics; exit with 1 if one is wrong."),
    ] = False,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw the curves: .png, .svg or .pdf.")
    ] = None,
    csv: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the rows to a CSV file.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show field of view and resolution.

    Footprint, pixel, focus, depth of field, stereo and blur through the exact port. What is not
    given is taken from the survey, or else from the paper.
    """
    from alice_survey.app.cli.fov_tables import FovOptions, Output, fov_report, validation_report

    output = Output(csv=csv, plot=plot)
    options = FovOptions(
        lens_mm=lens or (), altitude_m=altitude or (), speed_mps=speed or (),
        exposure_ms=exposure or (), survey=survey, rig=rig, rig_camera=camera, n_water=n_water,
    )  # fmt: skip
    table, data, passed = (
        validation_report(options, output) if validate else fov_report(options, output)
    )
    print_result(table, data, as_json)
    raise typer.Exit(0 if passed else 1)


@app.command(
    epilog=examples(
        "fly -w reef",
        "fly -w reef --vehicle alice --controller sway --current 0.1@90",
        "fly -w before --vehicle sparus2 --controller los",
        "fly -w reef --fail stern --fail bow=0.5 --json",
        "fly -w reef --fail stern@600",
        "fly -w reef --fail stern:propeller@600",
        "fly -w reef --dive 2",
        "fly -w reef --mission reef/plan/exports/mission_dive1.xml --current 0.1@90",
    )
)
def fly(
    workspace: Workspace = WORK,
    survey: SurveyFile = None,
    vehicle: Annotated[
        str | None, typer.Option(metavar="NAME|FILE", help="A known vehicle, or its TOML file.")
    ] = None,
    controller: Annotated[
        Literal["sway", "los"] | None,
        typer.Option(help="Heading held on the line, or towards a point ahead on it."),
    ] = None,
    current: Annotated[
        str | None,
        typer.Option(help="SPEED@DIRECTION it flows towards: m/s, degrees from north."),
    ] = None,
    fail: Annotated[
        list[str] | None,
        typer.Option(help="A thruster that fails or is weak: stern, bow=0.5, stern@600 (s)."),
    ] = None,
    dive: Annotated[
        int | None, typer.Option(min=1, help="Fly this dive of the plan; all when not given.")
    ] = None,
    mission: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Fly this exported mission of the plan (COLA2, QGC WPL, QGroundControl).",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Fly the plan, or a mission that was exported from it.

    The simulated vehicle with its controller, sensors and navigation filter, in a current. Writes
    the true track, the trigger times, the navigation log, the vehicle's log, and plots.
    """
    from alice_survey.app.pipeline import FlightChanges, run

    changes = FlightChanges(
        vehicle=vehicle, controller=controller, current=current, failed=fail, dive=dive,
        mission=mission,
    )  # fmt: skip
    print_result(*run(["fly"], workspace, survey, flight=changes), as_json)


@app.command(
    epilog=examples(
        "image -w reef --scale 4 --threads 2", "image -w reef --scheduler tcp://10.0.0.1:8786"
    )
)
def image(
    workspace: Workspace = WORK,
    survey: SurveyFile = None,
    scale: Scale = None,
    threads: Threads = None,
    scheduler: Scheduler = None,
    cluster: ClusterFile = None,
    as_json: AsJson = False,
) -> None:
    """Render the stereo pictures.

    Those of the flight and those of a board in a pool, for the calibration.
    """
    from alice_survey.app.pipeline import run

    with executor_on(workspace, threads, scheduler, cluster) as executor:
        result = run(["pool", "image"], workspace, survey, scale, executor)
    print_result(*result, as_json)


@app.command(
    epilog=examples(
        'target "charuco 12x9 40mm 30mm" -o board.pdf',
        'target "chessboard 9x6 25mm" -o chess.svg --paper A4',
        'target "apriltag 6x6 70mm 0.3" -o grid.pdf --paper A1',
        'target "charuco 12x9 40mm 30mm DICT_5X5_250 legacy" -o old.png --dpi 600',
    )
)
def target(
    what: Annotated[
        str, typer.Argument(metavar="TARGET", help="In words, as below, or a target's JSON file.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="A .pdf, .svg or .png file.")],
    paper: Annotated[
        str | None, typer.Option(help="A4, A3, A2, A1, A0 or letter; as needed if not given.")
    ] = None,
    dpi: Annotated[float, typer.Option(min=50, max=2400, help="Resolution of a PNG.")] = 300.0,
    as_json: AsJson = False,
) -> None:
    """Print a calibration target.

    A chessboard (inner corners, square), a ChArUco board (squares, square, marker) or a grid of
    AprilTags (tags, tag, gap over tag) at true scale, with its JSON file next to it.
    """
    from camera_calib.targets.sheet import print_target

    print_result(*print_target(what, output, paper, dpi), as_json)


@app.command(
    epilog=examples(
        "calibrate -w reef",
        "calibrate --left 'left*.jpg' --right 'right*.jpg' --target 'chessboard 9x6 25mm' -o air",
        "calibrate --pictures dry --target 'charuco 12x9 40mm 30mm' --lens rational -o one",
        "calibrate --camera bow=B --camera port=P --camera down=D --target board.json -o three",
        "calibrate --left L --right R --own-clocks --target board.json -o air",
        "calibrate --left L --right R --target board.json --water --start air/rig.json"
        " --glass 10 -o pool",
        "calibrate --camera bow=B --camera down=D --target board.json --water --start air/rig.json"
        " --port flat,bow=dome --dome-radius 80 --glass 6 -o wet",
    )
)
def calibrate(
    workspace: Workspace = WORK,
    left: Annotated[str | None, typer.Option(help="Folder or 'pattern' of pictures.")] = None,
    right: Annotated[str | None, typer.Option(help="Pictures of the right camera.")] = None,
    pictures: Annotated[str | None, typer.Option(help="Pictures of a single camera.")] = None,
    camera: Annotated[
        list[str] | None,
        typer.Option(help="NAME=FOLDER of a camera, for each of up to 8; the reference first."),
    ] = None,
    own_clocks: Annotated[
        bool,
        typer.Option(
            "--own-clocks", help="No common trigger: find clock offsets from the target's motion."
        ),
    ] = False,
    target: Annotated[str | None, typer.Option(help="A target in words, or target.json.")] = None,
    target_shape: Annotated[
        Literal["sheet", "markers", "flat"],
        typer.Option(help="Found with the cameras: bends and stretch; markers' places too; none."),
    ] = "sheet",
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Folder to write.")] = None,
    lens: Annotated[
        str | None,
        typer.Option(
            help="pinhole, k1, k2, opencv4, opencv5, rational, prism, full or fisheye, and other "
            "ones of some cameras: opencv5,side=fisheye."
        ),
    ] = None,
    water: Annotated[
        bool, typer.Option("--water/--air", help="Under water through ports, or in air.")
    ] = False,
    start: Annotated[Path | None, typer.Option(help="rig.json calibrated in air.")] = None,
    intrinsics: Annotated[
        Literal["held", "prior", "free"] | None,
        typer.Option(help="Treatment of the intrinsics of --start; prior where it has sigmas."),
    ] = None,
    port: Annotated[
        str | None,
        typer.Option(
            help="flat, dome or none, and other ones of some cameras: flat,side=dome; auto: the "
            "likeliest. That of --start, or flat."
        ),
    ] = None,
    dome_radius: Annotated[
        str | None, typer.Option(help="Outer radius of a dome, mm, and others: 80,bow=60.")
    ] = None,
    port_distance: Annotated[
        str | None, typer.Option(help="Pupil to glass, first value, mm: 20, or 20,tele=45.")
    ] = None,
    glass: Annotated[
        str | None, typer.Option(help="Thickness of the port, mm: 6, or 6,bow=5.")
    ] = None,
    glass_sigma: Annotated[
        float | None, typer.Option(min=1e-4, help="Find the thickness too; known to this, mm.")
    ] = None,
    n_glass: Annotated[
        str | None, typer.Option(help="Its index, 1.52 if not given: 1.49, or 1.52,bow=1.49.")
    ] = None,
    n_glass_sigma: Annotated[
        float | None, typer.Option(min=1e-7, help="Find this index too; known to this.")
    ] = None,
    n_water: Annotated[
        float | None, typer.Option(min=1, max=1.4, help="Index of the water; 1.34 if not given.")
    ] = None,
    n_water_sigma: Annotated[
        float | None, typer.Option(min=1e-7, help="Find this index too; known to this.")
    ] = None,
    carry_to_n: Annotated[
        float | None,
        typer.Option(min=1, max=1.4, help="Also write the rig in water of this index."),
    ] = None,
    mount: Annotated[
        str | None,
        typer.Option(help="On the vehicle: nadir-bow-up, forward+30 and others, or a file."),
    ] = None,
    lever: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="X Y Z", help="First camera's glass: forward, right, down, m."),
    ] = None,
    survey: SurveyFile = None,
    threads: Threads = None,
    as_json: AsJson = False,
) -> None:
    """Calibrate cameras, in air or through their ports.

    From the pool of a survey, or from pictures of a target: chessboard, ChArUco or AprilTag grid.
    Writes the rig with its covariance, the residuals and a report.
    """
    from camera_calib.calibrate.from_pictures import calibrate_pictures
    from camera_calib.calibrate.options import CalibrateOptions

    options = CalibrateOptions(
        left=left, right=right, pictures=pictures, cameras=tuple(camera or ()),
        own_clocks=own_clocks, target=target, target_shape=target_shape, output=output, lens=lens,
        water=water, start=start, known=intrinsics, port=port, dome_radius_mm=dome_radius,
        port_distance_mm=port_distance, glass_mm=glass, glass_sigma_mm=glass_sigma, n_glass=n_glass,
        n_glass_sigma=n_glass_sigma, n_water=n_water, n_water_sigma=n_water_sigma,
        carry_to_n=carry_to_n, mount=mount, lever_m=lever,
    )  # fmt: skip
    if options != CalibrateOptions():
        result = calibrate_pictures(options, executor_of(threads))
    else:
        from alice_survey.app.pipeline import run

        result = run(["calibrate"], workspace, survey, None, executor_of(threads))
    print_result(*result, as_json)


@app.command(
    name="run", epilog=examples("run -w reef --scale 4", "run -w reef --cluster slurm.toml")
)
def run_all(
    workspace: Workspace = WORK,
    survey: SurveyFile = None,
    scale: Scale = None,
    threads: Threads = None,
    scheduler: Scheduler = None,
    cluster: ClusterFile = None,
    device: Device = "auto",
    as_json: AsJson = False,
) -> None:
    """Do the whole loop.

    plan, fly, image, calibrate, reconstruct, evaluate, report: stages that are up to date are
    skipped.
    """
    from alice_survey.app.pipeline import run
    from alice_survey.core.stages import names

    with executor_on(workspace, threads, scheduler, cluster, device) as executor:
        result = run(names(), workspace, survey, scale, executor)
    print_result(*result, as_json)


@app.command(epilog=examples("demo", "demo -w demo --threads 2"))
def demo(
    workspace: Workspace = Path("demo"), threads: Threads = None, as_json: AsJson = False
) -> None:
    """Do the loop on a built-in survey.

    A few metres of sea floor with rocks and an amphora, at a quarter of the resolution.
    """
    from alice_survey.app.pipeline import run_demo

    print_result(*run_demo(workspace, executor_of(threads)), as_json)


@app.command(
    epilog=examples("status -w reef", "status -w reef --json", "status -w reef --workers 64")
)
def status(
    workspace: Workspace = WORK,
    survey: SurveyFile = None,
    workers: Annotated[
        int | None,
        typer.Option(min=1, max=100_000, help="Of a cluster that does what is left."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show what a workspace holds.

    What is there, what is stale, what the next command is, and how much time, memory and disk the
    stages that are left will take.
    """
    from alice_survey.app.pipeline import status_report

    print_result(*status_report(workspace, survey, workers), as_json)


with_sessions(app)


@app.callback()
def front_door(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    """Plan, fly, image and reconstruct close-range underwater imaging surveys, and score them."""


def main() -> None:
    """Run the command line; a known fault is one line on standard error and exit code 1."""
    # Modules leave many objects that stay: looking through them again and again for garbage while
    # they are loaded takes a tenth of a command's start.
    gc.set_threshold(100_000)
    # Before numpy is loaded. Its threads wait for each other by spinning: products of small
    # matrices then cost several times the work, and rounding would depend on the number of cores.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        app()
    except Exception as error:  # libraries raise known faults as all kinds; bugs are raised again
        fault = known_fault(error)
        if fault is None:
            raise
        typer.echo(f"error: {fault}", err=True)
        raise SystemExit(1) from error
