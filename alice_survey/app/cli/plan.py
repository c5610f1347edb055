"""The `plan` commands: plan a survey, and what goes with it before and after a dive."""

import json
from pathlib import Path
from typing import Annotated

import typer

from alice_survey.app.cli.options import (
    CONTEXT,
    WORK,
    AsJson,
    SurveyFile,
    Threads,
    Workspace,
    examples,
    executor_of,
    print_result,
)
from missions.exports.registry import format_names

app = typer.Typer(
    invoke_without_command=True,
    context_settings=CONTEXT,
    rich_markup_mode=None,
    epilog=examples(
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
    ),
)


@app.callback()
def plan(
    context: typer.Context,
    workspace: Workspace = WORK,
    survey: SurveyFile = None,
    every_setting: Annotated[
        bool,
        typer.Option("--all", help="Print every setting with its equation, source and limit."),
    ] = False,
    vehicle: Annotated[
        str | None, typer.Option(metavar="NAME|FILE", help="A known vehicle, or its TOML file.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Plan lines and camera settings.

    They image the whole area at the overlap requested. Writes the plan with its certificate, maps,
    and missions that vehicles load; prints the main settings, and with --all every one with the
    equation and the limit behind it, as plan/settings.txt holds them.
    """
    if context.invoked_subcommand is None:
        from alice_survey.app.pipeline import plan_report

        print_result(
            *plan_report(workspace, survey, every_setting=every_setting, vehicle=vehicle), as_json
        )


@app.command(
    epilog=examples(
        "plan solve -w reef --resolution 0.5",
        "plan solve -w reef --dive 3600",
        "plan solve -w reef --rate 0.25 --lens 12.5 --lens 25 --json",
        "plan solve -w reef --bend 5mm",
    )
)
def solve(
    workspace: Workspace = WORK,
    survey: SurveyFile = None,
    resolution: Annotated[
        float | None, typer.Option(min=1e-3, max=1e3, help="Size of a pixel on the sea floor, mm.")
    ] = None,
    dive: Annotated[float | None, typer.Option(min=1, max=1e6, help="Length of a dive, s.")] = None,
    rate: Annotated[
        float | None, typer.Option(min=1e-3, max=1e4, help="Fixed frame rate, Hz.")
    ] = None,
    lens: Annotated[list[float] | None, typer.Option(help="Focal lengths at hand, mm.")] = None,
    bend: Annotated[
        str | None,
        typer.Option(help="Sigma of the model's bend (5mm, 0.5cm, or mm): the measures it takes."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Find settings from what is given.

    Altitude and lens for a resolution, the area that fits a dive, the speed for a frame rate, or
    the cross lines, closing line and overlaps that keep a model from bending.
    """
    from alice_survey.app.pipeline import settings
    from alice_survey.core.errors import ConfigError
    from missions.plan.solve import solve_report

    config = settings(workspace, survey, needed=False)
    if bend is not None:
        from reconstruct.precision.run import bend_report, length_m

        if not resolution is dive is rate is None:
            raise ConfigError("--bend goes alone: solve for the rest first, and set it")
        print_result(*bend_report(workspace, config, length_m(bend)), as_json)
        return
    print_result(
        *solve_report(
            config,
            resolution_mm=resolution,
            dive_s=dive,
            rate_hz=rate,
            lenses=lens or (12.5, 25.0),
        ),
        as_json,
    )


@app.command(
    epilog=examples(
        "plan precision -w reef", "plan precision -w reef --plot precision.png --no-measures --json"
    )
)
def precision(
    workspace: Workspace = WORK,
    survey: SurveyFile = None,
    measures: Annotated[
        bool, typer.Option(help="Also plan more cross lines, overlap and more, and rank them.")
    ] = True,
    plot: Annotated[Path | None, typer.Option(help="PNG, PDF or SVG to draw.")] = None,
    as_json: AsJson = False,
) -> None:
    """Predict how well the survey will be known.

    Sigmas of bend, scale, heights and stations from the plan's stations, the calibration and the
    navigation, what dominates them, and what measures bring for a minute of dive.
    """
    from alice_survey.app.pipeline import settings
    from reconstruct.precision.run import precision_report

    config = settings(workspace, survey, needed=False)
    print_result(*precision_report(workspace, config, measures=measures, plot=plot), as_json)


@app.command(
    epilog=examples("plan gain control", "plan gain 'control/*.png' --present 12 --linear --json")
)
def gain(
    pictures: Annotated[str, typer.Argument(metavar="PICTURES", help="Folder or 'pattern'.")],
    present: Annotated[float | None, typer.Option(help="Gain they were taken at, dB.")] = None,
    linear: Annotated[
        bool, typer.Option("--linear", help="Grey values are linear, not sRGB.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Find the gain to set.

    From control pictures of a short dive before the survey, as the paper does it.
    """
    from missions.exposure.gain import gain_report

    print_result(*gain_report(pictures, present_gain_db=present, linear=linear), as_json)


@app.command(
    epilog=examples(
        "plan check -w reef",
        "plan check navigation.csv -w reef",
        "plan check navigation.csv --triggers triggers.csv -w reef -o checked",
    )
)
def check(
    log: Annotated[
        Path | None,
        typer.Argument(
            metavar="LOG", help="Navigation CSV of a dive; the simulated flight's if not given."
        ),
    ] = None,
    workspace: Workspace = WORK,
    survey: SurveyFile = None,
    triggers: Annotated[
        Path | None,
        typer.Option(help="CSV with the times of the pictures; the plan's interval if not given."),
    ] = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Folder to write.")] = None,
    threads: Threads = None,
    as_json: AsJson = False,
) -> None:
    """Check what a dive has seen.

    Lists the holes in coverage and overlap, draws them, and writes a plan that flies them again.
    """
    from alice_survey.app.pipeline import settings
    from missions.fly.check import check_report

    config = settings(workspace, survey, needed=False)
    print_result(
        *check_report(
            workspace, config, log,
            triggers=triggers, out=output, executor=executor_of(threads),
        ),
        as_json,
    )  # fmt: skip


@app.command(
    epilog=examples(
        "plan follow nav.csv -w reef",
        "plan follow nav.csv -w reef --every 5",
        "plan follow nav.csv -w reef --every 5 --json -o holes",
    )
)
def follow(
    log: Annotated[
        str,
        typer.Argument(
            metavar="LOG", help="Navigation CSV that the vehicle's software appends to."
        ),
    ],
    workspace: Workspace = WORK,
    survey: SurveyFile = None,
    every: Annotated[
        float | None,
        typer.Option(min=0.2, max=3600, help="Show the state again every so many seconds."),
    ] = None,
    dive: Annotated[
        int | None, typer.Option(min=1, help="Which dive of the plan; found if not given.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Folder for a plan over the holes, with its exports."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Follow a dive while it is flown.

    Shows what it has seen, holes behind the vehicle, time and energy left, and a plan that flies
    the holes again. The studio shows the same on a map ('studio --log').
    """
    from alice_survey.app.pipeline import settings
    from missions.follow.dive import follow_report

    config = settings(workspace, survey, needed=False)
    for text, data in follow_report(workspace, config, log, every_s=every, dive=dive, out=output):
        if as_json and every is not None:
            typer.echo(json.dumps(data))  # a line for each state
        else:
            print_result(text, data, as_json)


@app.command(epilog=examples("plan revisit -w reef", "plan revisit -w reef --sigma 5 --json"))
def revisit(
    workspace: Workspace = WORK,
    survey: SurveyFile = None,
    sigma: Annotated[
        float | None,
        typer.Option(
            min=1e-3, help="Sigma of heights to reach, mm; of a pair matched to 1 px if not given."
        ),
    ] = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Folder to write.")] = None,
    threads: Threads = None,
    as_json: AsJson = False,
) -> None:
    """Plan another dive over what the model lacks.

    Lists the weak places of a reconstructed survey with their causes, draws them, and writes a
    plan that flies them again, with what it is predicted to cure.
    """
    from alice_survey.app.pipeline import settings
    from reconstruct.revisit.run import revisit_report

    config = settings(workspace, survey, needed=False)
    print_result(
        *revisit_report(workspace, config, executor_of(threads), sigma_mm=sigma, out=output),
        as_json,
    )


@app.command(
    epilog=examples(
        "plan export -w reef", "plan export -w reef --format cola2 --format wpl -o to_vehicle"
    )
)
def export(
    workspace: Workspace = WORK,
    formats: Annotated[
        list[str] | None,
        typer.Option(
            "--format",
            help=f"{', '.join(format_names())}; all if none.",
        ),
    ] = None,
    camera_on: Annotated[
        str | None, typer.Option(help="COLA2's service that starts pictures.")
    ] = None,
    camera_off: Annotated[str | None, typer.Option(help="COLA2's service that stops them.")] = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Folder to write.")] = None,
    as_json: AsJson = False,
) -> None:
    """Write a plan in files that vehicles and planners load."""
    from missions.exports.write import export_report

    print_result(
        *export_report(
            workspace / "plan" / "plan.json",
            formats,
            output,
            camera_on=camera_on,
            camera_off=camera_off,
        ),
        as_json,
    )


@app.command(name="map", epilog=examples("plan map -w reef -o map.pdf"))
def draw_map(
    output: Annotated[Path, typer.Option("-o", "--output", help="A .pdf, .svg or .png file.")],
    workspace: Workspace = WORK,
    survey: SurveyFile = None,
    as_json: AsJson = False,
) -> None:
    """Draw the map of a plan for print.

    Area, zones, lines, footprints, how many pictures see each place, current, bathymetry.
    """
    from alice_survey.app.pipeline import settings
    from missions.plan.map import map_report

    config = settings(workspace, survey, needed=False)
    print_result(*map_report(workspace / "plan" / "plan.json", config, output), as_json)


@app.command(epilog=examples("plan current -w reef"))
def current(
    workspace: Workspace = WORK,
    survey: SurveyFile = None,
    as_json: AsJson = False,
) -> None:
    """Show what the current costs.

    Headings of lines that take least and most power, and how far the battery reaches.
    """
    from alice_survey.app.pipeline import settings
    from missions.plan.trade import current_report

    config = settings(workspace, survey, needed=False)
    print_result(*current_report(config), as_json)
