"""The `plan` commands: plan a survey, and what goes with it before and after a dive."""

import json
from pathlib import Path

import typer

from alice_survey.app.commands.base import (
    OUTPUT,
    ReportCommand,
    Result,
    SurveyCommand,
    ThreadsCommand,
    WorkspaceCommand,
    argument,
    option,
)
from missions.exports.registry import format_names


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
        "plan solve -w reef --resolution 0.5",
        "plan precision -w reef",
        "plan gain 'control/*.jpg'",
        "plan check navigation.csv -w reef",
        "plan follow nav.csv -w reef --every 5",
        "plan revisit -w reef",
        "plan export -w reef --format cola2 --format wpl",
    )
    title = "Plan the survey"
    offered = ("vehicle",)
    every_setting: bool = option(
        False, "Print every setting with its equation, source and limit.", "--all"
    )
    vehicle: str | None = option(None, "A known vehicle, or its TOML file.", metavar="NAME|FILE")

    def run(self) -> Result:
        """Run the stage, and predict what the next ones take."""
        from alice_survey.app.pipeline import plan_report

        return plan_report(
            self.workspace, self.survey, every_setting=self.every_setting, vehicle=self.vehicle
        )


class SolveCommand(SurveyCommand):
    """Find settings from what is given.

    Altitude and lens for a resolution, the area that fits a dive, the speed for a frame rate, or
    the cross lines, closing line and overlaps that keep a model from bending.
    """

    name = "plan solve"
    examples = (
        "plan solve -w reef --resolution 0.5",
        "plan solve -w reef --dive 3600",
        "plan solve -w reef --rate 0.25 --lens 12.5 --lens 25 --json",
        "plan solve -w reef --bend 5mm",
    )
    resolution: float | None = option(
        None, "Size of a pixel on the sea floor, mm.", ge=1e-3, le=1e3
    )
    dive: float | None = option(None, "Length of a dive, s.", ge=1, le=1e6)
    rate: float | None = option(None, "Fixed frame rate, Hz.", ge=1e-3, le=1e4)
    lens: list[float] | None = option(None, "Focal lengths at hand, mm.")
    bend: str | None = option(
        None, "Sigma of the model's bend (5mm, 0.5cm, or mm): the measures it takes."
    )

    def run(self) -> Result:
        """Solve for what is not given."""
        from alice_survey.core.errors import ConfigError
        from missions.plan.solve import solve_report

        config = self.settings()
        if self.bend is not None:
            from reconstruct.precision.run import bend_report, length_m

            if not self.resolution is self.dive is self.rate is None:
                raise ConfigError("--bend goes alone: solve for the rest first, and set it")
            return bend_report(self.workspace, config, length_m(self.bend))
        return solve_report(
            config, resolution_mm=self.resolution, dive_s=self.dive, rate_hz=self.rate,
            lenses=self.lens or (12.5, 25.0),
        )  # fmt: skip


class PrecisionCommand(SurveyCommand):
    """Predict how well the survey will be known.

    Sigmas of bend, scale, heights and stations from the plan's stations, the calibration and the
    navigation, what dominates them, and what measures bring for a minute of dive.
    """

    name = "plan precision"
    examples = (
        "plan precision -w reef",
        "plan precision -w reef --plot precision.png --no-measures --json",
    )
    measures: bool = option(
        True, "Also plan more cross lines, overlap and more, and rank them.",
        "--measures/--no-measures",
    )  # fmt: skip
    plot: Path | None = option(None, "PNG, PDF or SVG to draw.", metavar="FILE")

    def run(self) -> Result:
        """Compute the covariances."""
        from reconstruct.precision.run import precision_report

        return precision_report(
            self.workspace, self.settings(), measures=self.measures, plot=self.plot
        )


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
        "plan follow nav.csv -w reef",
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
        "plan export -w reef",
        "plan export -w reef --format cola2 --format wpl -o to_vehicle",
        "plan export -w reef --map -o map.pdf",
    )
    title = "Write the plan for vehicles"
    offered = ("formats",)
    formats: list[str] | None = option(
        None, f"{', '.join(format_names())}; all if none.", "--format"
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
