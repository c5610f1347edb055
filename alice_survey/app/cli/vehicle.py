"""The `vehicle` commands: coefficients, comparison, and identification from logs."""

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

VehicleName = Annotated[
    str | None,
    typer.Option(help="A known vehicle, or a TOML or JSON file; alice if not given."),
]
app = typer.Typer(
    help="The vehicle: coefficients from geometry and from logs, and how its two forms compare.",
    no_args_is_help=True,
    context_settings=CONTEXT,
    rich_markup_mode=None,
)


@app.command(
    epilog=examples(
        "vehicle coefficients",
        "vehicle coefficients --csv coefficients.csv --plot coefficients.png",
        "vehicle coefficients --json",
    )
)
def coefficients(
    csv: Annotated[Path | None, typer.Option(help="CSV file to write.")] = None,
    plot: Annotated[Path | None, typer.Option(help="PNG, PDF or SVG to draw.")] = None,
    as_json: AsJson = False,
) -> None:
    """Compute coefficients from shape, next to the paper's.

    Every row of the paper's three tables of added mass, damping and lift, with the equation.
    """
    from alice_survey.sim.vehicle.hydrodynamics.report import coefficients_report

    print_result(*coefficients_report(csv, plot), as_json)


@app.command(
    epilog=examples(
        "vehicle compare",
        "vehicle compare -w reef --current 0.1@90 --current 0.05@0 -o compared",
        "vehicle compare -s survey.toml --seed 7 --flights 3 --json",
        "vehicle compare --current 0@0 --swell 0.5@6",
        "vehicle compare -w reef --vehicle bluerov2_heavy --vehicle own.toml",
    )
)
def compare(
    workspace: Workspace = WORK,
    survey: SurveyFile = None,
    current: Annotated[
        list[str] | None,
        typer.Option(help="SPEED@DIRECTION; across the lines, along, and none if not given."),
    ] = None,
    swell: Annotated[
        str | None, typer.Option(help="HEIGHT@PERIOD of waves across the lines: m, s.")
    ] = None,
    vehicle: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME|FILE", help="One to compare; the paper's two if not given."),
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Of the first flight.")] = None,
    flights: Annotated[int, typer.Option(min=1, max=1000, help="Of each, in each current.")] = 5,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Folder; WORKSPACE/compare if not given.")
    ] = None,
    threads: Threads = None,
    as_json: AsJson = False,
) -> None:
    """Fly a survey by both configurations in the same sea, or by any vehicles.

    SPARUS II steering by line of sight, and ALICE holding its lines by sway: cross-track error,
    roll, speed and energy next to the paper's section VIII. Other vehicles are steered by sway if
    they can sway.
    """
    from alice_survey.app.pipeline import settings
    from missions.fly.compare_report import compare_report

    config = settings(workspace, survey, needed=workspace != WORK)
    text, data = compare_report(
        config, out or workspace / "compare", currents=current or (), swell=swell, seed=seed,
        flights=flights, executor=executor_of(threads), vehicles=vehicle or (),
    )  # fmt: skip
    print_result(text, data, as_json)


@app.command(
    epilog=examples(
        "vehicle identify surge.csv turns.csv --free X_uu,Y_vv,N_rr,N_rdot,current -o found",
        "vehicle identify dive.csv --validate second.csv --bollard pull.csv --method two-step",
        "vehicle identify run1.csv run2.csv --columns columns.toml --vehicle rov.toml "
        "--given p,q --window 5 --free X_u,X_uu,N_r,N_rr,gain_X,gain_N --validate run3.csv",
    )
)
def identify(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="docs/vehicle-logs.md")],
    vehicle: VehicleName = None,
    coefficients: Annotated[
        str | None, typer.Option(help="Set or file to start from; the vehicle's if not given.")
    ] = None,
    validate: Annotated[Path | None, typer.Option(help="Log to predict.")] = None,
    bollard: Annotated[Path | None, typer.Option(help="CSV: thruster, rpm, force_n.")] = None,
    free: Annotated[
        str | None,
        typer.Option(help="Such as X_uu,Y_vdot,N_r,Y_uv; current, buoyancy, trim, bias, gain."),
    ] = None,
    held: Annotated[
        list[str] | None, typer.Option(metavar="NAME=VALUE", help="As current_north_mps=0.1.")
    ] = None,
    method: Annotated[str, typer.Option(help="joint, or two-step as in the paper.")] = "joint",
    columns: Annotated[Path | None, typer.Option(help="TOML: what other columns mean.")] = None,
    given: Annotated[
        str | None, typer.Option(help="Rates, of p,q,r, that follow the log, not the forces.")
    ] = None,
    window: Annotated[
        float | None, typer.Option(min=0.1, help="s simulated in one go; all if not given.")
    ] = None,
    hold_input: Annotated[
        bool, typer.Option("--hold-input", help="Inputs stay until the next row.")
    ] = False,
    prior: Annotated[
        str | None,
        typer.Option(
            metavar="SIGMAS",
            help="Relative, about the start: damping=0.5,added_mass=0.3,...; a number; none.",
        ),
    ] = None,
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder to write.")] = Path("identified"),
    as_json: AsJson = False,
) -> None:
    """Identify coefficients from logs of motion.

    Damping, added mass, body lift, a constant current and more, each with its sigma; and how well
    they predict another log.
    """
    from alice_survey.core.config import DEFAULT_VEHICLE
    from alice_survey.sim.vehicle.identification.prior import read_prior
    from alice_survey.sim.vehicle.identification.report import IdentifyOptions, identify_report

    options = IdentifyOptions(
        vehicle=vehicle or DEFAULT_VEHICLE, coefficients=coefficients, validate=validate,
        bollard=bollard,
        free=tuple((free or "").split(",")) if free else (), held=tuple(held or ()),
        method=method, columns=columns, given=tuple(given.split(",")) if given else (),
        window_s=window, hold_input=hold_input, prior=read_prior(prior or ""),
    )  # fmt: skip
    print_result(*identify_report(logs, out, options), as_json)


@app.command(
    epilog=examples(
        "vehicle replay reef/flight/vehicle.csv",
        "vehicle replay dive.csv --vehicle own.toml --coefficients found/coefficients.json",
        "vehicle replay run1.csv --columns columns.toml --vehicle rov.toml --given p,q --reset 60",
    )
)
def replay(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="docs/vehicle-logs.md")],
    vehicle: VehicleName = None,
    coefficients: Annotated[
        str | None, typer.Option(help="Set or file, as of identify; the vehicle's if not given.")
    ] = None,
    held: Annotated[
        list[str] | None, typer.Option(metavar="NAME=VALUE", help="As current_north_mps=0.1.")
    ] = None,
    columns: Annotated[Path | None, typer.Option(help="TOML: what other columns mean.")] = None,
    given: Annotated[
        str | None, typer.Option(help="Rates, of p,q,r, that follow the log, not the forces.")
    ] = None,
    commanded: Annotated[
        bool, typer.Option("--commanded", help="Speeds are commands: add the thrusters' lag.")
    ] = False,
    reset: Annotated[
        float | None, typer.Option(min=0.5, help="s between starts from the log; none if not set.")
    ] = None,
    hold_input: Annotated[
        bool, typer.Option("--hold-input", help="Inputs stay until the next row.")
    ] = False,
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder to write.")] = Path("replayed"),
    as_json: AsJson = False,
) -> None:
    """Run a whole log through the model, open loop.

    Velocities, rates, attitude and place that the model makes of the log's thruster speeds, thrusts
    or forces, next to what was measured: errors of each axis, and how fast they grow.
    """
    from alice_survey.core.config import DEFAULT_VEHICLE
    from alice_survey.sim.vehicle.identification.replay import ReplayOptions, replay_report

    options = ReplayOptions(
        vehicle=vehicle or DEFAULT_VEHICLE, coefficients=coefficients, held=tuple(held or ()),
        columns=columns,
        given=tuple(given.split(",")) if given else (), commanded=commanded, reset_s=reset,
        hold_input=hold_input,
    )  # fmt: skip
    print_result(*replay_report(log, out, options), as_json)
