"""Commands on vehicles: coefficients, comparison, identification, and flying one by a link."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from alice_survey.app.commands.base import (
    WORK,
    ReportCommand,
    Result,
    SurveyCommand,
    ThreadsCommand,
    argument,
    option,
)

if TYPE_CHECKING:
    from missions.live.mission import LiveMission


class CoefficientsCommand(ReportCommand):
    """Show coefficients computed from shape, next to the paper's.

    Every row of the paper's three tables of added mass, damping and lift.
    """

    name = "vehicle coefficients"
    examples = (
        "vehicle coefficients",
        "vehicle coefficients --plot coefficients.png",
    )
    plot: Path | None = option(None, "Figure to draw.", metavar="FILE")

    def run(self) -> Result:
        """Compute and compare them."""
        from alice_survey.sim.vehicle.paper_tables import coefficients_report

        return coefficients_report(self.plot)


class CompareCommand(SurveyCommand, ThreadsCommand):
    """Fly a survey by both configurations in the same sea, or by any vehicles.

    SPARUS II steering by line of sight, and ALICE holding its lines by sway: cross-track error,
    roll, speed and energy next to the paper's section VIII. Other vehicles are steered by sway if
    they can sway. Without a current: across the lines, along them, and none.
    """

    name = "vehicle compare"
    examples = (
        "vehicle compare",
        "vehicle compare -w reef --current 0.1@90 --current 0.05@0 -o compared",
        "vehicle compare --current 0@0 --swell 0.5@6 --flights 3",
        "vehicle compare -w reef --vehicle bluerov2_heavy --vehicle own.toml",
    )
    current: list[str] | None = option(
        None, "Current to fly in, m/s and degrees.", metavar="SPEED@DIRECTION"
    )
    swell: str | None = option(
        None, "Swell across the lines, metres and seconds.", metavar="HEIGHT@PERIOD"
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
            currents=self.current or (), swell=self.swell, seed=self.seed, flights=self.flights,
            executor=self.executor(), vehicles=self.vehicle or (),
        )  # fmt: skip


class IdentifyCommand(ReportCommand):
    """Identify coefficients from logs of motion.

    Damping, added mass, body lift, a constant current and more, each with its sigma; and how well
    they predict another log.
    """

    name = "vehicle identify"
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
        None, "Relative sigmas of the start: damping=0.5,added_mass=0.3; a number; none.",
        metavar="SIGMAS",
    )  # fmt: skip
    out: Path = option(Path("identified"), "Directory to write.", "-o", "--out", metavar="DIR")

    def run(self) -> Result:
        """Fit and validate."""
        from alice_survey.core.config import DEFAULT_VEHICLE
        from alice_survey.sim.vehicle.identification.output_error import read_prior
        from alice_survey.sim.vehicle.identification.report import (
            IdentifyOptions,
            identify_report,
        )

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
    GUIDED. It ends at the surface, with exit code 1 unless the mission was complete. With
    --simulated it is the other side: dynamics, sea and sensors of the vehicle as a ROS 2 node on a
    simulated clock.
    """

    name = "pilot"
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
        config = self.settings(needed=True)
        if self.simulated:
            from missions.live.mission import simulate_report

            return simulate_report(
                self.workspace, config, takes=self.takes, rate=self.rate, track=self.track
            )
        from missions.live.loop import LinkLimits
        from missions.live.mission import pilot_report

        limits = LinkLimits(on_loss=self.on_loss, grace_s=self.grace, odometry_s=self.odometry_age)
        return pilot_report(
            self.workspace, config, limits, self._fly, altimeter_body_m=self.altimeter,
            record=self.record,
        )  # fmt: skip

    def _fly(self, mission: "LiveMission") -> None:
        from missions.live.mavlink_pilot import pilot_over_mavlink
        from missions.live.ros_pilot import Topics, pilot_over_ros

        if self.mavlink is not None:
            pilot_over_mavlink(mission, self.mavlink, sim_time=self.sim_time)
        else:
            topics = Topics(odometry=self.odometry, altitude=self.altitude)
            pilot_over_ros(mission, topics, sim_time=self.sim_time)

    def is_passed(self, data: Any) -> bool:
        """Whether the mission was complete."""
        return self.simulated or bool(data["complete"])
