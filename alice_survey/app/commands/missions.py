"""Commands that plan dives, and commands on vehicles that fly them."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import typer

from alice_survey.app.commands.base import (
    OUTPUT,
    WORK,
    ReportCommand,
    Result,
    SurveyCommand,
    ThreadsCommand,
    WorkspaceCommand,
    argument,
    option,
)
from missions.exports.registry import format_names

if TYPE_CHECKING:
    from missions.live.mission import LiveMission


class PlanCommand(SurveyCommand):
    """Plan lines and camera settings.

    They image the whole area at the overlap requested. Writes the plan with its certificate, maps,
    and missions that vehicles load; prints the main settings, and with --all every one with the
    equation and the limit behind it, as plan/settings.txt holds them.
    """

    name = "plan"
    examples = (
        "plan -w reef",
        "plan -w reef --all",
        "plan -w reef -s other.toml --json",
        "plan -w reef --vehicle bluerov2_heavy",
    )
    title = "Plan the survey"
    offered = ("vehicle",)
    every_setting: bool = option(False, "Print every setting with its equation and limit.", "--all")
    vehicle: str | None = option(None, "A known vehicle, or its TOML file.", metavar="NAME|FILE")

    def run(self) -> Result:
        """Run the stage, and predict what the next ones take."""
        from alice_survey.app.pipeline import plan_report

        return plan_report(
            self.workspace, self.survey,
            every_setting=self.every_setting, vehicle=self.vehicle, say=self.say,
        )  # fmt: skip


class SolveCommand(SurveyCommand):
    """Find altitude and lens for a resolution on the sea floor.

    For each lens the altitude and what follows: swath, lines, exposure, light and time.
    """

    name = "plan solve"
    examples = (
        "plan solve -w reef --resolution 0.5",
        "plan solve -w reef --resolution 0.5 --lens 12.5 --lens 25 --json",
    )
    resolution: float = option(..., "Size of a pixel on the sea floor, mm.", ge=1e-3, le=1e3)
    lens: list[float] | None = option(None, "Focal lengths at hand, mm.")

    def run(self) -> Result:
        """Solve for altitude and lens."""
        from missions.exposure.settings import ImagingSetup
        from missions.plan.solve import solve_report

        config = self.settings()
        setup = ImagingSetup(
            plan=config.plan, camera=config.camera, water=config.water, imaging=config.imaging
        )
        depth_m = config.area.seafloor_depth_m
        return solve_report(setup, depth_m, self.resolution, self.lens or (12.5, 25.0))


class PrecisionCommand(SurveyCommand):
    """Predict how well the survey will be known.

    Sigmas of bend, scale, heights and stations from the plan's stations, the calibration and the
    navigation, what dominates them, and what measures bring for a minute of dive.
    """

    name = "plan precision"
    examples = ("plan precision -w reef", "plan precision -w reef --no-measures --json")
    measures: bool = option(
        True, "Also plan more cross lines, overlap and more, and rank them.",
        "--measures/--no-measures",
    )  # fmt: skip

    def run(self) -> Result:
        """Compute the covariances."""
        from reconstruct.precision.run import precision_report

        return precision_report(self.workspace, self.settings(), measures=self.measures)


class GainCommand(ReportCommand):
    """Find the gain to set.

    From control pictures of a short dive before the survey, as the paper does it.
    """

    name = "plan gain"
    examples = ("plan gain control", "plan gain 'control/*.png' --present 12 --linear --json")
    pictures: str = argument(..., "Folder or 'pattern'.", "PICTURES")
    present: float | None = option(None, "Gain they were taken at, dB.")
    linear: bool = option(False, "Grey values are linear, not sRGB.")

    def run(self) -> Result:
        """Read their grey values."""
        from missions.exposure.gain import gain_report

        return gain_report(self.pictures, present_gain_db=self.present, linear=self.linear)


class CheckCommand(SurveyCommand, ThreadsCommand):
    """Check what a dive has seen.

    Lists the holes in coverage and overlap, draws them, and writes a plan that flies them again.
    """

    name = "plan check"
    examples = (
        "plan check -w reef",
        "plan check navigation.csv -w reef",
        "plan check navigation.csv --triggers triggers.csv -w reef -o checked",
    )
    title = "Check what a dive has seen"
    offered = ("log", "triggers", "threads")
    log: Path | None = argument(
        None, "Navigation CSV of a dive; the simulated flight's if not given.", "LOG"
    )
    triggers: Path | None = option(
        None, "CSV with the times of the pictures; the plan's interval if not given.",
        metavar="FILE",
    )  # fmt: skip
    output: Path | None = OUTPUT

    def run(self) -> Result:
        """Certify the dive."""
        from missions.fly.check import check_report

        return check_report(
            self.workspace, self.settings(), self.log, triggers=self.triggers, out=self.output,
            executor=self.executor(),
        )  # fmt: skip


class FollowCommand(SurveyCommand):
    """Follow a dive while it is flown.

    Shows what it has seen, holes behind the vehicle, time and energy left, and a plan that flies
    the holes again. The studio shows the same on a map ('studio --log').
    """

    name = "plan follow"
    examples = (
        "plan follow nav.csv -w reef --every 5",
        "plan follow nav.csv -w reef --every 5 --json -o holes",
    )
    log: str = argument(..., "Navigation CSV that the vehicle's software appends to.", "LOG")
    every: float | None = option(
        None, "Show the state again every so many seconds.", ge=0.2, le=3600
    )
    dive: int | None = option(None, "Which dive of the plan; found if not given.", ge=1)
    output: Path | None = option(
        None, "Folder for a plan over the holes, with its exports.", "-o", "--output",
        metavar="DIR",
    )  # fmt: skip

    def run(self) -> None:
        """Show one state, or one after the other; as JSON a line for each."""
        from missions.follow.dive import follow_report

        states = follow_report(
            self.workspace, self.settings(), self.log, every_s=self.every, dive=self.dive,
            out=self.output,
        )  # fmt: skip
        for text, data in states:
            if self.as_json and self.every is not None:
                typer.echo(json.dumps(data))
            else:
                self.show(text, data)


class RevisitCommand(SurveyCommand, ThreadsCommand):
    """Plan another dive over what the model lacks.

    Lists the weak places of a reconstructed survey with their causes, draws them, and writes a
    plan that flies them again, with what it is predicted to cure.
    """

    name = "plan revisit"
    examples = ("plan revisit -w reef", "plan revisit -w reef --sigma 5 --json")
    title = "Plan a dive over weak places"
    offered = ("sigma", "threads")
    sigma: float | None = option(
        None, "Sigma of heights to reach, mm; of a pair matched to 1 px if not given.", ge=1e-3
    )
    output: Path | None = OUTPUT

    def run(self) -> Result:
        """Find the places and plan."""
        from reconstruct.revisit.run import revisit_report

        return revisit_report(
            self.workspace, self.settings(), self.executor(), sigma_mm=self.sigma,
            out=self.output,
        )  # fmt: skip


class ExportCommand(WorkspaceCommand, ReportCommand):
    """Write a plan in files that vehicles and planners load."""

    name = "plan export"
    examples = (
        "plan export -w reef --format cola2 --format wpl -o to_vehicle",
        "plan export -w reef --map -o map.pdf",
    )
    title = "Write the plan for vehicles"
    offered = ("formats",)
    formats: list[str] | None = option(
        None, f"{', '.join(format_names())}; all if none. ArduSub takes wpl and qgc.", "--format"
    )
    camera_on: str | None = option(None, "COLA2's service that starts pictures.")
    camera_off: str | None = option(None, "COLA2's service that stops them.")
    map: bool = option(False, "Draw the map alone, into the .pdf, .svg or .png that -o names.")
    output: Path | None = OUTPUT

    def run(self) -> Result:
        """Write them."""
        plan = self.workspace / "plan" / "plan.json"
        if self.map:
            from alice_survey.app.pipeline import settings
            from missions.plan.map import map_report

            config = settings(self.workspace, None, needed=False)
            file = self.output or plan.with_name("map.pdf")
            return map_report(plan, file, config.camera, config.water, config.area, config.sea)
        from missions.exports.write import export_report

        return export_report(
            plan, self.formats, self.output,
            camera_on=self.camera_on, camera_off=self.camera_off,
        )  # fmt: skip


class CoefficientsCommand(ReportCommand):
    """Show coefficients computed from shape, next to the paper's.

    Every row of the paper's three tables of added mass, damping and lift.
    """

    name = "vehicle coefficients"
    examples = ("vehicle coefficients",)

    def run(self) -> Result:
        """Compute and compare them."""
        from alice_survey.sim.vehicle.coefficients import coefficients_report

        return coefficients_report()


class CompareCommand(SurveyCommand, ThreadsCommand):
    """Fly a survey by both configurations in the same sea, or by any vehicles.

    SPARUS II steering by line of sight, and ALICE holding its lines by sway: cross-track error,
    roll, speed and energy next to the paper's section VIII. Other vehicles are steered by sway if
    they can sway. Without a current: across the lines, along them, none, and none with swell.
    """

    name = "vehicle compare"
    examples = (
        "vehicle compare -w reef --current 0.1@90 --current 0.05@0 -o compared",
        "vehicle compare -w reef --vehicle bluerov2_heavy --vehicle own.toml",
    )
    current: list[str] | None = option(
        None, "Current to fly in, m/s and degrees.", metavar="SPEED@DIRECTION"
    )
    vehicle: list[str] | None = option(
        None, "Vehicle to compare; default: the paper's two.", metavar="NAME|FILE"
    )
    seed: int | None = option(None, "Seed of the first flight.", metavar="SEED", ge=0)
    flights: int = option(5, "Flights of each vehicle.", metavar="COUNT", ge=1, le=1000)
    out: Path | None = option(None, "Directory to write.", "-o", "--out", metavar="DIR")

    def run(self) -> Result:
        """Fly them."""
        from missions.fly.compare import compare_report

        return compare_report(
            self.settings(needed=self.workspace != WORK), self.out or self.workspace / "compare",
            currents=self.current or (), seed=self.seed, flights=self.flights,
            executor=self.executor(), vehicles=self.vehicle or (),
        )  # fmt: skip


class IdentifyCommand(ReportCommand):
    """Identify coefficients from logs of motion.

    Damping, added mass, body lift, a constant current and more, each with its sigma; and how well
    they predict another log.
    """

    name = "vehicle identify"
    advanced = "held method columns given window prior"
    examples = (
        "vehicle identify surge.csv turns.csv --free X_uu,Y_vv,N_rr,N_rdot,current -o found",
        "vehicle identify dive.csv --validate second.csv --bollard pull.csv --method two-step",
        "vehicle identify run1.csv run2.csv --columns columns.toml --vehicle rov.toml "
        "--given p,q --window 5 --free X_u,X_uu,N_r,N_rr,gain_X,gain_N --validate run3.csv",
        "vehicle identify --validate dive.csv --coefficients found/coefficients.json",
    )
    logs: list[Path] | None = argument(None, "Logs to fit (docs/vehicle-logs.md).", "LOG...")
    vehicle: str | None = option(
        None, "Known vehicle or its TOML file; default: alice.", metavar="NAME|FILE"
    )
    coefficients: str | None = option(
        None, "Set of coefficients to start from.", metavar="NAME|FILE"
    )
    validation: Path | None = option(
        None, "Log to predict; by the known vehicle if none is fitted.", "--validate",
        metavar="LOG",
    )  # fmt: skip
    bollard: Path | None = option(None, "CSV: thruster, rpm, force_n.", metavar="FILE")
    free: str | None = option(
        None, "Parameters to fit: X_uu,Y_vdot,N_r,Y_uv,current,buoyancy,trim,bias,gain.",
        metavar="NAMES",
    )  # fmt: skip
    held: list[str] | None = option(
        None, "Value to hold, as current_north_mps=0.1.", metavar="NAME=VALUE"
    )
    method: str = option("joint", "Method: joint, or two-step as in the paper.", metavar="METHOD")
    columns: Path | None = option(
        None, "TOML file that explains the logs' columns.", metavar="FILE"
    )
    given: str | None = option(None, "Rates, of p,q,r, to take from the log.", metavar="RATES")
    window: float | None = option(
        None, "Longest stretch to simulate in one go.", metavar="SECONDS", ge=0.1
    )
    prior: str | None = option(
        None, "Relative sigma of the values that the fit starts from, or none.",
        metavar="SIGMA",
    )  # fmt: skip
    out: Path = option(Path("identified"), "Directory to write.", "-o", "--out", metavar="DIR")

    def run(self) -> Result:
        """Fit and validate."""
        from alice_survey.core.config import DEFAULT_VEHICLE
        from alice_survey.sim.vehicle.identification.output_error import read_prior
        from alice_survey.sim.vehicle.identification.report import IdentifyOptions, identify_report

        options = IdentifyOptions(
            vehicle=self.vehicle or DEFAULT_VEHICLE, coefficients=self.coefficients,
            validate=self.validation, bollard=self.bollard,
            free=tuple((self.free or "").split(",")) if self.free else (),
            held=tuple(self.held or ()), method=self.method, columns=self.columns,
            given=tuple(self.given.split(",")) if self.given else (), window_s=self.window,
            prior=read_prior(self.prior or ""),
        )  # fmt: skip
        return identify_report(self.logs or [], self.out, options)


class PilotCommand(SurveyCommand):
    """Fly the plan with a vehicle outside this program, or be that vehicle in simulation.

    Flies as the pilot of the simulation does. As a ROS 2 node it takes odometry and altitude and
    gives wrench and thruster speeds; over MAVLink it gives velocities and headings to ArduSub in
    GUIDED. It ends at the surface, with exit code 3 unless the mission was complete. With
    --simulated it is the other side: dynamics, sea and sensors of the vehicle as a ROS 2 node on a
    simulated clock.
    """

    name = "pilot"
    advanced = "frame body_frame altimeter grace odometry_age edited takes rate track"
    examples = (
        "pilot -w reef",
        "pilot -w reef --odometry /auv/odom --altitude /auv/altimeter --record dive.csv",
        "pilot -w reef --sim-time",
        "pilot -w reef --mavlink udpin:127.0.0.1:14550",
        "pilot -w reef --simulated --rate 0 --track truth.csv",
    )
    mavlink: str | None = option(
        None, "Fly ArduSub over MAVLink, such as udpin:127.0.0.1:14550.", metavar="ADDRESS"
    )
    odometry: str = option(
        "navigation/odometry", "Topic of nav_msgs/Odometry from the plan's datum.",
        metavar="TOPIC",
    )  # fmt: skip
    frame: str = option("map", "Frame of its poses: east, north, up.", metavar="FRAME")
    body_frame: str = option(
        "base_link", "Frame of its velocities: forward, left, up; without the vehicle's name.",
        metavar="FRAME",
    )  # fmt: skip
    altitude: str = option(
        "altimeter", "Topic of sensor_msgs/Range of the altimeter.", metavar="TOPIC"
    )
    altimeter: tuple[float, float, float] | None = option(
        None, "Place of the altimeter: forward, right, down, m; that of the DVL if not given.",
        metavar="X Y Z",
    )  # fmt: skip
    sim_time: bool = option(False, "Tick by the clock of a simulator.")
    on_loss: Literal["surface", "drift"] = option(
        "surface", "Push up, or leave thrusters off, when odometry is lost for good."
    )
    grace: float = option(
        5.0, "Wait this long before it is lost for good.", metavar="SECONDS", ge=0, le=600
    )
    odometry_age: float = option(
        0.5, "Refuse odometry older than this.", metavar="SECONDS", ge=0.05, le=5
    )
    record: Path | None = option(
        None, "Write what was flown by and commanded as CSV.", metavar="FILE"
    )
    edited: bool = option(False, "Fly the plan though it was edited since it was planned.")
    simulated: bool = option(False, "Be the vehicle instead, for any pilot over ROS 2.")
    takes: Literal["thrusters", "wrench"] = option(
        "thrusters", "Commands that the simulated vehicle follows."
    )
    rate: float = option(
        1.0, "Speed of the simulated vehicle, times real time; 0 waits for each command.",
        ge=0, le=1000,
    )  # fmt: skip
    track: Path | None = option(None, "Write the simulated true track as CSV.", metavar="FILE")

    def run(self) -> Result:
        """Be the one or the other side."""
        from missions.fly.simulation import flight_settings

        settings = flight_settings(self.settings(needed=True))
        if self.simulated:
            from missions.live.ros import simulate_report

            return simulate_report(
                self.workspace, settings, takes=self.takes, rate=self.rate, track=self.track
            )
        from missions.live.mission import LinkLimits, pilot_report

        limits = LinkLimits(on_loss=self.on_loss, grace_s=self.grace, odometry_s=self.odometry_age)
        return pilot_report(
            self.workspace, settings, limits, self._fly, altimeter_body_m=self.altimeter,
            record=self.record, edited=self.edited,
        )  # fmt: skip

    def _fly(self, mission: "LiveMission") -> None:
        from missions.live.mavlink_pilot import pilot_over_mavlink
        from missions.live.ros import Topics, pilot_over_ros

        if self.mavlink is not None:
            pilot_over_mavlink(mission, self.mavlink, sim_time=self.sim_time)
        else:
            topics = Topics(
                odometry=self.odometry, altitude=self.altitude, frame=self.frame,
                body_frame=self.body_frame,
            )  # fmt: skip
            pilot_over_ros(mission, topics, sim_time=self.sim_time)

    def is_passed(self, data: Any) -> bool:
        """Whether the mission was complete."""
        return self.simulated or bool(data["complete"])
