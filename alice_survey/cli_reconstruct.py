"""The commands that turn pictures into a model, measure in it, and score it."""

from typing import Annotated

import typer

from alice_survey.cli_options import (
    CONTEXT,
    WORK,
    AsJson,
    SurveyFile,
    Threads,
    Workspace,
    examples,
    print_result,
)

app = typer.Typer()
reconstruct_app = typer.Typer(
    invoke_without_command=True,
    context_settings=CONTEXT,
    rich_markup_mode=None,
    epilog=examples(
        "reconstruct -w reef",
        "reconstruct -w reef --threads 2 --json",
        "reconstruct pair left.png right.png --rig rig.json -o stingray",
    ),
)


@reconstruct_app.callback()
def reconstruct(
    context: typer.Context,
    workspace: Workspace = WORK,
    survey: SurveyFile = None,
    threads: Threads = None,
    as_json: AsJson = False,
) -> None:
    """Turn pictures into a model.

    Camera track, DEM, point cloud, orthomosaic and textured mesh.
    """
    if context.invoked_subcommand is None:
        from alice_survey.survey import RECONSTRUCT, run

        print_result(*run(RECONSTRUCT, workspace, survey, None, threads), as_json)


@app.command(
    epilog=examples(
        "scale -w reef --points '0,0,0 1.2,0,0.1' --length 0.5",
        "scale -w reef --points 'left/001.png:512,300 left/001.png:930,312' --length 0.5",
    )
)
def scale(
    points: Annotated[
        str,
        typer.Option(
            help="Two points: 'x,y,z x,y,z', or spots in pictures, 'IMAGE:x,y IMAGE:x,y'."
        ),
    ],
    length: Annotated[float, typer.Option(min=1e-6, help="Their true distance, m.")],
    workspace: Workspace = WORK,
) -> None:
    """Scale a model by a known length."""
    from reconstruct.sparse.scale import scale_model

    typer.echo(scale_model(workspace, points, length))


@app.command(epilog=examples("evaluate -w reef", "evaluate -w reef --json"))
def evaluate(
    workspace: Workspace = WORK,
    survey: SurveyFile = None,
    threads: Threads = None,
    as_json: AsJson = False,
) -> None:
    """Score a simulated survey.

    Camera track, surface and mosaic against the truth.
    """
    from alice_survey.survey import run

    print_result(*run(["report"], workspace, survey, None, threads), as_json)
