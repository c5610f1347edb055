"""Commands that bring in what real dives recorded: pictures and logs."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from alice_survey.app.cli.options import (
    WORK,
    AsJson,
    Threads,
    Workspace,
    examples,
    executor_of,
    print_result,
)

app = typer.Typer()


@app.command(
    name="import-images",
    epilog=examples(
        "import-images photos -w reef",
        "import-images --left cam1 --right cam2 -w reef",
        "import-images --left cam1 --right cam2 --triggers triggers.csv -w reef",
        "import-images --camera bow=B --camera port=P --camera down=D --rig rig.json -w reef",
        "import-images --bag dive.mcap --every 0.5 --rig rig.json --navigation dive.csv -w reef",
        "import-images photos --navigation dive.csv --clock-offset -1.5 --masks masks -w reef",
        "import-images photos --navigation dive.csv --vertical-datum NN2000 -w reef",
        "import-images phone cameras --recursive -w reef",
        "import-images --video GX010042.MP4 --video GX020042.MP4 --overlap 0.7 -w reef",
        "import-images --video CARD --navigation dive.csv --time-zone Europe/Oslo -w reef",
    ),
)
def import_images(
    folders: Annotated[
        list[Path] | None, typer.Argument(metavar="DIR...", help="Folders of pictures; videos.")
    ] = None,
    left: Annotated[Path | None, typer.Option(help="Pictures of the left camera.")] = None,
    right: Annotated[Path | None, typer.Option(help="Pictures of the right camera.")] = None,
    camera: Annotated[
        list[str] | None,
        typer.Option(help="NAME=FOLDER of a camera, for each of a rig; of a bag NAME=TOPIC."),
    ] = None,
    bag: Annotated[Path | None, typer.Option(help="ROS bag with pictures.")] = None,
    video: Annotated[
        list[Path] | None, typer.Option(help="Videos to take frames from, or a folder of them.")
    ] = None,
    overlap: Annotated[
        float | None,
        typer.Option(min=0.3, max=0.95, help="Of neighbouring frames; 0.7 without --every."),
    ] = None,
    every: Annotated[
        float | None, typer.Option(min=0.01, help="Seconds between frames, at a fixed step.")
    ] = None,
    recursive: Annotated[bool, typer.Option(help="Also take folders inside.")] = False,
    navigation: Annotated[Path | None, typer.Option(help="CSV: time, position, ...")] = None,
    clock_offset: Annotated[float, typer.Option(help="Seconds to add to picture times.")] = 0.0,
    time_zone: Annotated[str, typer.Option(help="Of times that name none.")] = "UTC",
    vertical_datum: Annotated[
        str | None, typer.Option(metavar="NAME", help="What the CSV's depths count from.")
    ] = None,
    rig: Annotated[Path | None, typer.Option(help="rig.json of the cameras.")] = None,
    masks: Annotated[Path | None, typer.Option(help="Folder of masks; black is left out.")] = None,
    triggers: Annotated[
        Path | None, typer.Option(help="CSV: image or number, time_s or time_utc; camera.")
    ] = None,
    workspace: Workspace = WORK,
    threads: Threads = None,
) -> None:
    """Bring in real pictures.

    Pictures of one camera, of several or of a rig of up to eight, or videos, with a navigation log,
    GPS from EXIF, or nothing at all.
    """
    from alice_survey.app.pipeline import only_one
    from alice_survey.core.errors import ImageError
    from camera_calib.picture_files import places_of_cameras
    from reconstruct.pictures.importing import import_images as work

    if (left is None) != (right is None):
        raise ImageError(
            "--left and --right go together; of one camera give the folder, or --camera NAME=FOLDER"
        )
    pair = {name: side for name, side in (("left", left), ("right", right)) if side is not None}
    named = places_of_cameras(camera or ())
    folders_of = {} if bag is not None else {name: Path(place) for name, place in named.items()}
    with only_one(workspace):
        found = work(
            workspace, folders or [], cameras=pair | folders_of, bag=bag,
            topics={} if bag is None else named, videos=video or (), overlap=overlap,
            every_s=every, recursive=recursive,
            navigation=navigation, clock_offset_s=clock_offset, time_zone=time_zone,
            vertical_datum=vertical_datum, rig=rig, masks=masks, triggers=triggers,
            executor=executor_of(threads),
        )  # fmt: skip
    typer.echo(f"{found}\nin {workspace / 'images'}; next: alice-survey reconstruct -w {workspace}")


@app.command(epilog=examples("join reef reef/revisit/dive -w both", "join day1 day2 day3 -w reef"))
def join(
    dives: Annotated[list[Path], typer.Argument(metavar="DIVE...", help="Their workspaces.")],
    workspace: Workspace = WORK,
) -> None:
    """Bring the pictures of several dives together.

    One workspace whose 'reconstruct' makes one model of all. The dives share one rig.
    """
    from reconstruct.pictures.joining import join_dives

    found = join_dives(workspace, dives)
    typer.echo(f"{found}\nin {workspace / 'images'}; next: alice-survey reconstruct -w {workspace}")


@app.command(
    name="import-control",
    epilog=examples(
        "import-control gcp_list.txt --sigma 0.02 -w reef",
        "import-control markers.xml -w reef --overwrite",
    ),
)
def import_control(
    file: Annotated[Path, typer.Argument(help="ODM's gcp_list.txt, or Metashape's markers XML.")],
    sigma: Annotated[
        float | None, typer.Option(min=1e-6, help="m; of points whose accuracy is not stated.")
    ] = None,
    sigma_vertical: Annotated[
        float | None, typer.Option(min=1e-6, help="m; of heights; as --sigma if not given.")
    ] = None,
    heights: Annotated[
        Literal["level", "ellipsoid"],
        typer.Option(help="They count from the level of the survey's depths, or from WGS 84's."),
    ] = "level",
    workspace: Workspace = WORK,
    overwrite: Annotated[bool, typer.Option(help="Replace files that are there.")] = False,
) -> None:
    """Bring in ground control points of another program.

    Writes control.csv and picks.csv of the workspace, by which the next 'reconstruct' places the
    model.
    """
    from reconstruct.placing.foreign_control import import_control as work

    found = work(
        workspace, file, sigma_m=sigma, sigma_vertical_m=sigma_vertical, heights=heights,
        overwrite=overwrite,
    )  # fmt: skip
    typer.echo(f"{found}\nin {workspace}; next: alice-survey reconstruct -w {workspace}")


@app.command(
    name="import-log",
    epilog=examples(
        "import-log sparus2.bag -o navigation.csv",
        "import-log 00000042.BIN --declination 3.4 --tide tides.csv -o navigation.csv",
        "import-log dive.tlog --topic depth=VFR_HUD --vehicle-log vehicle.csv -o navigation.csv",
        "import-log dvl.bag --dead-reckon --start-at 43.05 5.92 10 -o navigation.csv",
        "import-log dvl.json --dead-reckon --start-at 43.05 5.92 10 -o navigation.csv",
    ),
)
def import_log(
    log: Annotated[
        Path, typer.Argument(help="ROS bag, log of ArduSub or PX4, or JSON of a Water Linked DVL.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="CSV to write.")],
    declination: Annotated[
        float, typer.Option(help="Add this declination to headings, degrees; east is positive.")
    ] = 0.0,
    tide: Annotated[
        str, typer.Option(help="Height of the water above the level of depths: metres, or a CSV.")
    ] = "0",
    topic: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ROLE=NAME",
            help="Use this topic or message for navigation, depth, attitude, altitude or velocity.",
        ),
    ] = None,
    datum: Annotated[
        tuple[float, float] | None,
        typer.Option(
            metavar="LATITUDE LONGITUDE", help="Origin of the odometry of a bag, or of XKF1."
        ),
    ] = None,
    lever_arm: Annotated[
        tuple[float, float, float],
        typer.Option(metavar="X Y Z", help="Place on the body that the logged position is of, m."),
    ] = (0.0, 0.0, 0.0),
    altitude_offset: Annotated[
        float, typer.Option(metavar="METRES", help="Add this to altitudes.")
    ] = 0.0,
    vehicle_log: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write a vehicle log too.")
    ] = None,
    dead_reckon: Annotated[
        bool,
        typer.Option("--dead-reckon", help="Compute positions from velocities, tied to fixes."),
    ] = False,
    start_at: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            metavar="LATITUDE LONGITUDE SIGMA", help="Place of the first velocity and its sigma, m."
        ),
    ] = None,
    heading_sigma: Annotated[
        float, typer.Option(help="Constant error of headings in dead reckoning, degrees.")
    ] = 1.0,
    flip_velocity: Annotated[
        bool, typer.Option("--flip-velocity", help="Turn the velocities of a DVL round.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Turn a vehicle's own log into the navigation CSV of import-images.

    ROS 1 and ROS 2 bags (COLA2 and common messages), ArduSub's DataFlash and telemetry logs, PX4's
    .ulg, and JSON of Water Linked's DVLs.
    """
    from missions.logs.dead_reckoning import TrackErrors
    from missions.logs.import_log import ImportOptions
    from missions.logs.import_log import import_log as work

    options = ImportOptions(
        declination_deg=declination, tide=tide, topics=topic or (), datum_deg=datum,
        lever_body_m=lever_arm, altitude_offset_m=altitude_offset, vehicle_log=vehicle_log,
        start_at=start_at, flip_velocity=flip_velocity,
        dead_reckon=TrackErrors(heading_deg=heading_sigma) if dead_reckon else None,
    )  # fmt: skip
    print_result(*work(log, output, options), as_json)
