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
    typer.Option(metavar="NAME|FILE", help="Known vehicle or its TOML file; default: alice."),
]
CoefficientSet = Annotated[
    str | None, typer.Option(metavar="NAME|FILE", help="Set of coefficients to start from.")
]
Held = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME=VALUE", help="Value to hold, as current_north_mps=0.1."),
]
Columns = Annotated[
    Path | None, typer.Option(metavar="FILE", help="TOML file that explains the logs' columns.")
]
Given = Annotated[
    str | None, typer.Option(metavar="RATES", help="Rates, of p,q,r, to take from the log.")
]
HoldInput = Annotated[
    bool, typer.Option("--hold-input", help="Hold each input until the next row.")
]
Output = Annotated[Path, typer.Option("-o", "--out", metavar="DIR", help="Directory to write.")]
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
    )
)
def coefficients(
    csv: Annotated[Path | None, typer.Option(metavar="FILE", help="CSV file to write.")] = None,
    plot: Annotated[Path | None, typer.Option(metavar="FILE", help="Figure to draw.")] = None,
    as_json: AsJson = False,
) -> None:
    """Show coefficients computed from shape, next to the paper's.

    Every row of the paper's three tables of added mass, damping and lift.
    """
    from alice_survey.sim.vehicle.paper_tables import coefficients_report

    print_result(*coefficients_report(csv, plot), as_json)


@app.command(
    epilog=examples(
        "vehicle compare",
        "vehicle compare -w reef --current 0.1@90 --current 0.05@0 -o compared",
        "vehicle compare --current 0@0 --swell 0.5@6 --flights 3",
        "vehicle compare -w reef --vehicle bluerov2_heavy --vehicle own.toml",
    )
)
def compare(
    workspace: Workspace = WORK,
    survey: SurveyFile = None,
    current: Annotated[
        list[str] | None,
        typer.Option(metavar="SPEED@DIRECTION", help="Current to fly in, m/s and degrees."),
    ] = None,
    swell: Annotated[
        str | None,
        typer.Option(metavar="HEIGHT@PERIOD", help="Swell across the lines, metres and seconds."),
    ] = None,
    vehicle: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME|FILE", help="Vehicle to compare; default: the paper's two."),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, metavar="SEED", help="Seed of the first flight.")
    ] = None,
    flights: Annotated[
        int, typer.Option(min=1, max=1000, metavar="COUNT", help="Flights of each vehicle.")
    ] = 5,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="DIR", help="Directory to write.")
    ] = None,
    threads: Threads = None,
    as_json: AsJson = False,
) -> None:
    """Fly a survey by both configurations in the same sea, or by any vehicles.

    SPARUS II steering by line of sight, and ALICE holding its lines by sway: cross-track error,
    roll, speed and energy next to the paper's section VIII. Other vehicles are steered by sway if
    they can sway. Without a current: across the lines, along them, and none.
    """
    from alice_survey.app.pipeline import settings
    from missions.fly.compare import compare_report

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
        "vehicle identify --validate dive.csv --coefficients found/coefficients.json",
    )
)
def identify(
    logs: Annotated[
        list[Path] | None,
        typer.Argument(metavar="LOG...", help="Logs to fit (docs/vehicle-logs.md)."),
    ] = None,
    vehicle: VehicleName = None,
    coefficients: CoefficientSet = None,
    validate: Annotated[
        Path | None,
        typer.Option(metavar="LOG", help="Log to predict; by the known vehicle if none is fitted."),
    ] = None,
    bollard: Annotated[
        Path | None, typer.Option(metavar="FILE", help="CSV: thruster, rpm, force_n.")
    ] = None,
    free: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES",
            help="Parameters to fit: X_uu,Y_vdot,N_r,Y_uv,current,buoyancy,trim,bias,gain.",
        ),
    ] = None,
    held: Held = None,
    method: Annotated[
        str, typer.Option(metavar="METHOD", help="Method: joint, or two-step as in the paper.")
    ] = "joint",
    columns: Columns = None,
    given: Given = None,
    window: Annotated[
        float | None,
        typer.Option(min=0.1, metavar="SECONDS", help="Longest stretch to simulate in one go."),
    ] = None,
    hold_input: HoldInput = False,
    prior: Annotated[
        str | None,
        typer.Option(
            metavar="SIGMAS",
            help="Relative sigmas of the start: damping=0.5,added_mass=0.3; a number; none.",
        ),
    ] = None,
    out: Output = Path("identified"),
    as_json: AsJson = False,
) -> None:
    """Identify coefficients from logs of motion.

    Damping, added mass, body lift, a constant current and more, each with its sigma; and how well
    they predict another log.
    """
    from alice_survey.core.config import DEFAULT_VEHICLE
    from alice_survey.sim.vehicle.identification.output_error import read_prior
    from alice_survey.sim.vehicle.identification.report import IdentifyOptions, identify_report

    options = IdentifyOptions(
        vehicle=vehicle or DEFAULT_VEHICLE, coefficients=coefficients, validate=validate,
        bollard=bollard,
        free=tuple((free or "").split(",")) if free else (), held=tuple(held or ()),
        method=method, columns=columns, given=tuple(given.split(",")) if given else (),
        window_s=window, hold_input=hold_input, prior=read_prior(prior or ""),
    )  # fmt: skip
    print_result(*identify_report(logs or [], out, options), as_json)


@app.command(hidden=True)
def replay(
    log: Annotated[Path, typer.Argument(metavar="LOG")],
    vehicle: VehicleName = None,
    coefficients: CoefficientSet = None,
    held: Held = None,
    columns: Columns = None,
    given: Given = None,
    hold_input: HoldInput = False,
    out: Output = Path("replayed"),
    as_json: AsJson = False,
) -> None:
    """Use `vehicle identify --validate LOG`."""
    typer.echo("vehicle replay is now: vehicle identify --validate LOG", err=True)
    identify(
        None, vehicle, coefficients, validate=log, held=held, columns=columns, given=given,
        hold_input=hold_input, out=out, as_json=as_json,
    )  # fmt: skip
