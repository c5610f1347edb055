"""Commands that fly a plan with a vehicle outside this program, or offer it a simulated one."""

import math
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
    )
)
def pilot(
    workspace: Workspace = WORK,
    survey: SurveyFile = None,
    mavlink: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="ArduSub, such as udpin:127.0.0.1:14550, not ROS 2."),
    ] = None,
    odometry: Annotated[
        str, typer.Option(metavar="TOPIC", help="nav_msgs/Odometry from the plan's datum.")
    ] = "navigation/odometry",
    altitude: Annotated[
        str, typer.Option(metavar="TOPIC", help="sensor_msgs/Range of the altimeter.")
    ] = "altimeter",
    altimeter: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="X Y Z", help="Its place: forward, right, down, m; else the DVL's."),
    ] = None,
    sim_time: Annotated[
        bool,
        typer.Option("--sim-time", help="Tick by the simulator's clock."),
    ] = False,
    on_loss: Annotated[
        Literal["surface", "drift"],
        typer.Option(help="When odometry is lost for good: push up, or leave thrusters off."),
    ] = "surface",
    grace: Annotated[
        float, typer.Option(min=0, max=600, help="s without thrust until it is lost for good.")
    ] = 5.0,
    odometry_age: Annotated[
        float, typer.Option(min=0.05, max=5, help="s; older odometry is not flown by.")
    ] = 0.5,
    record: Annotated[
        Path | None, typer.Option(help="CSV of what was flown by and commanded.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Fly the plan with a vehicle outside this program.

    By the pilot of the simulation. A ROS 2 node: odometry and altitude in, wrench and thruster
    speeds out; or over MAVLink velocities and headings for ArduSub in GUIDED. Ends at the surface;
    exit code 1 unless the mission was complete.
    """
    from alice_survey.app.pipeline import settings
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
    epilog=examples(
        "simulate --ros -w reef",
        "simulate --ros -w reef --rate 10 --takes wrench",
        "simulate --ros -w reef --rate 0 --track truth.csv",
    )
)
def simulate(
    workspace: Workspace = WORK,
    survey: SurveyFile = None,
    ros: Annotated[bool, typer.Option("--ros", help="As a ROS 2 node.")] = False,
    takes: Annotated[
        Literal["thrusters", "wrench"], typer.Option(help="Commands that are followed.")
    ] = "thrusters",
    rate: Annotated[
        float,
        typer.Option(min=0, max=1000, help="Times real time; 0: wait for each tick's command."),
    ] = 1.0,
    longest: Annotated[
        float | None, typer.Option(min=0.05, help="Simulated s after which it ends.")
    ] = None,
    patience: Annotated[
        float, typer.Option(min=1, help="s to wait for a command at rate 0.")
    ] = 600.0,
    track: Annotated[Path | None, typer.Option(help="CSV of the true track.")] = None,
    as_json: AsJson = False,
) -> None:
    """Simulate the vehicle for a pilot outside this program.

    Its dynamics, sea and sensors as a ROS 2 node on a simulated clock: thruster speeds or a wrench
    in; odometry, truth, altimeter, DVL, IMU and thruster speeds out. 'alice-survey fly' flies the
    whole plan instead.
    """
    from alice_survey.app.pipeline import settings
    from missions.live.ros_vehicle import Pace
    from missions.live.run import simulate_report

    if not ros:
        raise typer.BadParameter("give --ros: there is no other way to reach the vehicle yet")
    pace = Pace(
        rate=rate, max_s=math.inf if longest is None else longest, patience_s=patience
    )  # fmt: skip
    result = simulate_report(
        workspace, settings(workspace, survey, needed=True), takes=takes, pace=pace, track=track
    )
    print_result(*result, as_json)
