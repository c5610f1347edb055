"""The command that flies a plan with a vehicle outside this program, or is that vehicle."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from alice_survey.app.cli.options import (
    WORK,
    AsJson,
    SurveyFile,
    Workspace,
    examples,
    print_result,
)

app = typer.Typer()


@app.command(
    epilog=examples(
        "pilot -w reef",
        "pilot -w reef --odometry /auv/odom --altitude /auv/altimeter --record dive.csv",
        "pilot -w reef --sim-time",
        "pilot -w reef --mavlink udpin:127.0.0.1:14550",
        "pilot -w reef --simulated --rate 0 --track truth.csv",
    )
)
def pilot(
    workspace: Workspace = WORK,
    survey: SurveyFile = None,
    mavlink: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS", help="Fly ArduSub over MAVLink, such as udpin:127.0.0.1:14550."
        ),
    ] = None,
    odometry: Annotated[
        str, typer.Option(metavar="TOPIC", help="Topic of nav_msgs/Odometry from the plan's datum.")
    ] = "navigation/odometry",
    altitude: Annotated[
        str, typer.Option(metavar="TOPIC", help="Topic of sensor_msgs/Range of the altimeter.")
    ] = "altimeter",
    altimeter: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            metavar="X Y Z",
            help="Place of the altimeter: forward, right, down, m; that of the DVL if not given.",
        ),
    ] = None,
    sim_time: Annotated[
        bool,
        typer.Option("--sim-time", help="Tick by the clock of a simulator."),
    ] = False,
    on_loss: Annotated[
        Literal["surface", "drift"],
        typer.Option(help="Push up, or leave thrusters off, when odometry is lost for good."),
    ] = "surface",
    grace: Annotated[
        float,
        typer.Option(
            min=0, max=600, metavar="SECONDS", help="Wait this long before it is lost for good."
        ),
    ] = 5.0,
    odometry_age: Annotated[
        float,
        typer.Option(min=0.05, max=5, metavar="SECONDS", help="Refuse odometry older than this."),
    ] = 0.5,
    record: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write what was flown by and commanded as CSV."),
    ] = None,
    simulated: Annotated[
        bool, typer.Option("--simulated", help="Be the vehicle instead, for any pilot over ROS 2.")
    ] = False,
    takes: Annotated[
        Literal["thrusters", "wrench"],
        typer.Option(help="Commands that the simulated vehicle follows."),
    ] = "thrusters",
    rate: Annotated[
        float,
        typer.Option(
            min=0,
            max=1000,
            help="Speed of the simulated vehicle, times real time; 0 waits for each command.",
        ),
    ] = 1.0,
    track: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the simulated true track as CSV.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Fly the plan with a vehicle outside this program, or be that vehicle in simulation.

    Flies as the pilot of the simulation does. As a ROS 2 node it takes odometry and altitude and
    gives wrench and thruster speeds; over MAVLink it gives velocities and headings to ArduSub in
    GUIDED. It ends at the surface, with exit code 1 unless the mission was complete. With
    --simulated it is the other side: dynamics, sea and sensors of the vehicle as a ROS 2 node on a
    simulated clock.
    """
    from alice_survey.app.pipeline import settings

    if simulated:
        from missions.live.run import simulate_report

        survey_settings = settings(workspace, survey, needed=True)
        result = simulate_report(workspace, survey_settings, takes=takes, rate=rate, track=track)
        print_result(*result, as_json)
        return
    from missions.live.loop import LinkLimits
    from missions.live.mavlink_pilot import pilot_over_mavlink
    from missions.live.mission import LiveMission
    from missions.live.ros_pilot import Topics, pilot_over_ros
    from missions.live.run import pilot_report

    def fly(mission: LiveMission) -> None:
        if mavlink is not None:
            pilot_over_mavlink(mission, mavlink, sim_time=sim_time)
        else:
            topics = Topics(odometry=odometry, altitude=altitude)
            pilot_over_ros(mission, topics, sim_time=sim_time)

    limits = LinkLimits(on_loss=on_loss, grace_s=grace, odometry_s=odometry_age)
    text, data = pilot_report(
        workspace, settings(workspace, survey, needed=True), limits, fly,
        altimeter_body_m=altimeter, record=record,
    )  # fmt: skip
    print_result(text, data, as_json)
    raise typer.Exit(0 if data["complete"] else 1)


@app.command(
    hidden=True, context_settings={"allow_extra_args": True, "ignore_unknown_options": True}
)
def simulate(context: typer.Context) -> None:
    """Run 'pilot --simulated' under its former name."""
    from alice_survey.core.errors import note

    note("'simulate' is now 'pilot --simulated', and is gone in the next version")
    assert context.parent is not None  # noqa: S101  it is a command of the program
    command = context.parent.command.get_command(context, "pilot")  # type: ignore[attr-defined]
    given = [argument for argument in context.args if argument != "--ros"]
    command.main([*given, "--simulated"], context.info_name, standalone_mode=False)
