"""The loop of a survey, stage by stage or whole, and the optics it is planned with."""

from pathlib import Path
from typing import Any, Literal

import typer

from alice_survey.app.commands.base import (
    OUTPUT,
    SCALE,
    ClusterCommand,
    DeviceCommand,
    ReportCommand,
    Result,
    SurveyCommand,
    ThreadsCommand,
    WorkspaceCommand,
    argument,
    option,
)
from alice_survey.core.errors import PlanError, offer


class InitCommand(WorkspaceCommand):
    """Write a commented survey.toml.

    It holds the paper's mission: 15 x 17 m, lines 1 m apart, 2 m altitude, 0.2 m/s.
    """

    name = "init"
    examples = ("init reef --area reef.geojson", "init harbour --example caesarea")
    area: Path | None = option(
        None, "GeoJSON, KML, GPX, GeoPackage, shapefile, WKT or CSV of the area.", metavar="FILE"
    )
    example: Literal["demo", "caesarea"] | None = option(None, "A ready survey instead.")

    def run(self) -> None:
        """Write it."""
        from alice_survey.app.pipeline import init_survey
        from alice_survey.core.stages import is_imported

        template = f"{self.example or 'survey'}.toml"
        try:
            path = init_survey(self.workspace, template, self.area, say=typer.echo)
        except PlanError as fault:
            raise PlanError(
                f"{fault}; {offer('init', self.workspace)!r} begins without it"
            ) from None
        following = "reconstruct" if is_imported(self.workspace) else "plan"
        typer.echo(f"wrote {path}; next: {offer(following, '-w', self.workspace)}")


class FovCommand(ReportCommand):
    """Show field of view and resolution.

    Footprint, pixel, focus, depth of field, stereo and blur through the exact port. What is not
    given is taken from the survey, or else from the paper.
    """

    name = "fov"
    examples = (
        "fov",
        "fov --lens 12.5 --lens 25 --altitude 1.5 --altitude 2 --n-water 1.345 --json",
        "fov --speed 0.2 --speed 0.5 --exposure 1 --exposure 3",
        "fov --rig calibration/rig.json --altitude 2 --plot fov.png --csv fov.csv",
        "fov --validate",
    )
    lens: list[float] | None = option(None, "Focal length of a lens to show.", metavar="MM")
    altitude: list[float] | None = option(
        None, "Altitude of the port's outer glass.", metavar="METRES"
    )
    n_water: float | None = option(
        None, "Refractive index of the water.", metavar="INDEX", ge=1, le=1.4
    )
    speed: list[float] | None = option(None, "Speed over ground, for the blur.", metavar="M/S")
    exposure: list[float] | None = option(
        None, "Time of the shutter, or of the strobe if shorter.", metavar="MS"
    )
    rig: Path | None = option(None, "Show a calibrated rig.json instead.", metavar="FILE")
    camera: str | None = option(None, "Camera of the rig; its first if not given.")
    survey: Path | None = option(
        None, "Take camera, port, aperture, water and plan from this survey.toml.",
        "-s", "--survey", metavar="FILE",
    )  # fmt: skip
    validates: bool = option(
        False, "Check the paper's optics; exit with 3 if one is wrong.", "--validate"
    )
    plot: Path | None = option(None, "Draw the curves: .png, .svg or .pdf.", metavar="FILE")
    csv: Path | None = option(None, "Write the rows to a CSV file.", metavar="FILE")

    def run(self) -> Result:
        """Compute and write the tables."""
        from camera_calib.fov.display import FovOptions, fov_report, validation_report

        options = FovOptions(
            lens_mm=self.lens or (), altitude_m=self.altitude or (), speed_mps=self.speed or (),
            exposure_ms=self.exposure or (), survey=self.survey, rig=self.rig,
            rig_camera=self.camera, n_water=self.n_water, csv=self.csv, plot=self.plot,
        )  # fmt: skip
        return validation_report(options) if self.validates else fov_report(options)

    def is_passed(self, data: Any) -> bool:
        """Whether every claim of the paper that was checked holds."""
        return not self.validates or bool(data["passed"])


class FlyCommand(SurveyCommand):
    """Fly the plan, or a mission that was exported from it.

    The simulated vehicle with its controller, sensors and navigation filter, in a current. Writes
    the true track, the trigger times, the navigation log, the vehicle's log, and plots.
    """

    name = "fly"
    examples = (
        "fly -w reef",
        "fly -w reef --vehicle alice --controller sway --current 0.1@90",
        "fly -w before --vehicle sparus2 --controller los",
        "fly -w reef --fail stern --fail bow=0.5 --json",
        "fly -w reef --fail stern:propeller@600",
        "fly -w reef --dive 2",
        "fly -w reef --mission reef/plan/exports/mission_dive1.xml --current 0.1@90",
    )
    title = "Fly the plan"
    offered = ("vehicle", "controller", "dive")
    vehicle: str | None = option(None, "A known vehicle, or its TOML file.", metavar="NAME|FILE")
    controller: Literal["sway", "los"] | None = option(
        None, "Heading held on the line, or towards a point ahead on it."
    )
    current: str | None = option(None, "SPEED@DIRECTION it flows towards: m/s, degrees from north.")
    fail: list[str] | None = option(
        None, "A thruster that fails or is weak: stern, bow=0.5, stern@600 (s)."
    )
    dive: int | None = option(None, "Fly this dive of the plan; all when not given.", ge=1)
    mission: Path | None = option(
        None, "Fly this exported mission of the plan (COLA2, QGC WPL, QGroundControl).",
        metavar="FILE",
    )  # fmt: skip
    edited: bool = option(False, "Fly the mission though it was edited since it was exported.")

    def run(self) -> Result:
        """Run the stage with these changes."""
        from alice_survey.app.pipeline import run
        from alice_survey.core.config import parse_current

        current_mps, towards_deg = parse_current(self.current)
        changes: dict[str, dict[str, Any]] = {
            "sea": {"current_mps": current_mps, "current_towards_deg": towards_deg},
            "vehicle": {
                "name": self.vehicle, "controller": self.controller, "failures": self.fail,
                "dive": self.dive, "mission_file": self.mission,
            },
        }  # fmt: skip
        return run(
            ["fly"], self.workspace, self.survey, changes=changes, edited_mission=self.edited,
            say=lambda text, _: self.say(text),
        )  # fmt: skip


class ImageCommand(ClusterCommand):
    """Render the stereo pictures.

    Those of the flight and those of a board in a pool, for the calibration.
    """

    name = "image"
    examples = (
        "image -w reef --scale 4 --threads 2",
        "image -w reef --scheduler tcp://10.0.0.1:8786",
    )
    title = "Render the pictures"
    offered = ("scale", "threads")
    scale: int | None = SCALE

    def run(self) -> Result:
        """Run both stages."""
        from alice_survey.app.pipeline import run

        with self.started_executor() as executor:
            changes = {"imaging": {"scale": self.scale}}
            return run(self.stages(), self.workspace, self.survey, executor, changes)


class TargetCommand(ReportCommand):
    """Print a calibration target.

    A chessboard (inner corners, square), a ChArUco board (squares, square, marker) or a grid of
    AprilTags (tags, tag, gap over tag) at true scale, with its JSON file next to it.
    """

    name = "target"
    examples = (
        'target "charuco 12x9 40mm 30mm" -o board.pdf',
        'target "apriltag 6x6 70mm 0.3" -o grid.pdf --paper A1',
        'target "charuco 12x9 40mm 30mm DICT_5X5_250 legacy" -o old.pdf',
    )
    what: str = argument(..., "In words, as below, or a target's JSON file.", "TARGET")
    output: Path = option(..., "The PDF to write.", "-o", "--output", metavar="FILE")
    paper: str | None = option(None, "A4, A3, A2, A1, A0 or letter; as needed if not given.")

    def run(self) -> Result:
        """Draw it."""
        from camera_calib.targets.sheet import print_target

        return print_target(self.what, self.output, self.paper)


class CalibrateCommand(SurveyCommand, ThreadsCommand):
    """Calibrate cameras, in air or through their ports.

    From the pool of a survey, or from pictures of a target: chessboard, ChArUco or AprilTag grid.
    Writes the rig with its covariance, the residuals and a report.
    """

    name = "calibrate"
    advanced = "intrinsics n_glass n_water mount lever"
    examples = (
        "calibrate -w reef",
        "calibrate --left 'left*.jpg' --right 'right*.jpg' --target 'chessboard 9x6 25mm' -o air",
        "calibrate --pictures dry --target 'charuco 12x9 40mm 30mm' --lens rational -o one",
        "calibrate --camera bow=B --camera port=P --camera down=D --target board.json -o three",
        "calibrate --left L --right R --target board.json --water --start air/rig.json"
        " --glass 10 -o pool",
        "calibrate --camera bow=B --camera down=D --target board.json --water --start air/rig.json"
        " --port flat,bow=dome --dome-radius 80 --glass 6 -o wet",
    )
    title = "Calibrate the cameras"
    offered = ("threads",)
    left: str | None = option(None, "Folder or 'pattern' of pictures.")
    right: str | None = option(None, "Pictures of the right camera.")
    pictures: str | None = option(None, "Pictures of a single camera.")
    camera: list[str] | None = option(
        None, "NAME=FOLDER of a camera, for each of up to 8; the reference first."
    )
    target: str | None = option(None, "A target in words, or target.json.")
    target_shape: Literal["sheet", "flat"] = option(
        "sheet", "Found with the cameras: bends and stretch; flat: none."
    )
    output: Path | None = OUTPUT
    lens: str | None = option(
        None, "pinhole, k1, k2, opencv4, opencv5, rational, prism, full or fisheye, other ones of "
        "some cameras: opencv5,side=fisheye; auto, the default: opencv5 or fisheye.",
    )  # fmt: skip
    water: bool = option(False, "Under water through ports, or in air.", "--water/--air")
    start: Path | None = option(None, "rig.json calibrated in air.")
    intrinsics: Literal["held", "prior", "free"] | None = option(
        None, "Treatment of the intrinsics of --start; prior where it has sigmas."
    )
    port: str | None = option(
        None, "flat, dome or none, and other ones of some cameras: flat,side=dome; auto: the "
        "likeliest. That of --start, or flat.",
    )  # fmt: skip
    dome_radius: str | None = option(None, "Outer radius of a dome, mm, and others: 80,bow=60.")
    port_distance: str | None = option(None, "Pupil to glass, first value, mm: 20, or 20,tele=45.")
    glass: str | None = option(
        None, "Thickness of the port, mm: 6, or 6,bow=5. With a sigma, 6+-0.1, it and both "
        "indices are found too.",
    )  # fmt: skip
    n_glass: str | None = option(None, "Index of the glass, 1.52 if not given; or 1.52,bow=1.49.")
    n_water: str | None = option(None, "Index of the water, 1.34 if not given; or 1.34+-0.002.")
    mount: str | None = option(
        None, "On the vehicle: nadir-bow-up, forward+30 and others, or a file."
    )
    lever: tuple[float, float, float] | None = option(
        None, "First camera's glass: forward, right, down, m.", metavar="X Y Z"
    )

    def run(self) -> Result:
        """Calibrate from pictures where options say from which, else from the survey's pool."""
        from camera_calib.calibrate.from_pictures import calibrate_pictures
        from camera_calib.calibrate.options import CalibrateOptions

        stereo = {"left": self.left, "right": self.right, "camera": self.pictures}
        cameras = [f"{name}={place}" for name, place in stereo.items() if place]
        options = CalibrateOptions(
            cameras=(*cameras, *(self.camera or ())), target=self.target,
            target_shape=self.target_shape, output=self.output, lens=self.lens, water=self.water,
            start=self.start, known=self.intrinsics, port=self.port,
            dome_radius_mm=self.dome_radius, port_distance_mm=self.port_distance,
            glass_mm=self.glass, n_glass=self.n_glass, n_water=self.n_water, mount=self.mount,
            lever_m=self.lever,
        )  # fmt: skip
        if options != CalibrateOptions():
            return calibrate_pictures(options, self.executor())
        from alice_survey.app.pipeline import run

        return run(["calibrate"], self.workspace, self.survey, self.executor())


class RunCommand(DeviceCommand):
    """Do the whole loop.

    plan, fly, image, calibrate, reconstruct, evaluate, report: stages that are up to date are
    skipped.
    """

    name = "run"
    examples = ("run -w reef --scale 4", "run -w reef --cluster slurm.toml")
    title = "Make all that is left"
    offered = ("scale", "threads")
    scale: int | None = SCALE
    accept: bool = option(False, "Go on from what is not good enough, such as an early end.")

    @classmethod
    def stages(cls) -> list[str]:
        """All."""
        from alice_survey.app.stages import names

        return names()

    def run(self) -> Result:
        """Run all stages."""
        from alice_survey.app.pipeline import run

        with self.started_executor(self.device) as executor:
            changes = {"imaging": {"scale": self.scale}}
            return run(
                self.stages(), self.workspace, self.survey, executor, changes,
                stops=not self.accept,
            )  # fmt: skip


class DemoCommand(WorkspaceCommand, ThreadsCommand, ReportCommand):
    """Do the loop on a built-in survey.

    A few metres of sea floor with rocks and an amphora, at a quarter of the resolution.
    """

    name = "demo"
    examples = ("demo", "demo -w demo --threads 2")
    workspace: Path = option(
        Path("demo"), "Folder that holds the stages of one survey.", "-w", "--workspace"
    )

    def run(self) -> Result:
        """Run all stages on it."""
        from alice_survey.app.pipeline import run_demo

        return run_demo(self.workspace, self.executor())


class StatusCommand(SurveyCommand):
    """Show what a workspace holds.

    What is there, what is stale, what the next command is, and how much time, memory and disk the
    stages that are left will take.
    """

    name = "status"
    examples = (
        "status -w reef", "status -w reef --json", "status -w reef --verify",
        "status -w reef --workers 64",
    )  # fmt: skip
    workers: int | None = option(None, "Of a cluster that does what is left.", ge=1, le=100_000)
    verify: bool = option(False, "Read every file, and compare it with what was written.")

    def run(self) -> Result:
        """Compare the stages with their inputs."""
        from alice_survey.app.pipeline import status_report

        return status_report(self.workspace, self.survey, self.workers, verify=self.verify)


class ReportPageCommand(SurveyCommand, ThreadsCommand):
    """Write the report of a survey.

    One page that needs no network, and the same as PDF: what was mapped, how well, what to do
    next; map, mesh, errors, calibration, settings. It shows what the workspace holds so far.
    """

    name = "report"
    examples = ("report -w reef", "report -w reef --json")
    title = "Write the report"
    offered = ("threads",)

    def run(self) -> Result:
        """Run the stage."""
        from alice_survey.app.pipeline import run

        return run(["report"], self.workspace, self.survey, self.executor())
