"""The commands about annotations: in from other tools, out to them, and what labels cover."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from alice_survey.app.cli.options import (
    CONTEXT,
    WORK,
    AsJson,
    Workspace,
    examples,
    print_result,
)

app = typer.Typer(
    context_settings=CONTEXT,
    rich_markup_mode=None,
    no_args_is_help=True,
    help="Annotations on the mosaic and in pictures.\n\n"
    "From TagLab, BIIGLE and COCO and back, and what each label covers.",
)
Tiles = Annotated[
    Path | None,
    typer.Option(help="Folder of 'mosaic-tiles', where its tiles are annotated."),
]


@app.command(
    name="import",
    epilog=examples(
        "annotations import reef.json -w reef --format taglab",
        "annotations import report.csv -w reef --format biigle --tiles tiles",
        "annotations import species.csv -w reef --format biigle",
    ),
)
def import_(
    file: Annotated[Path, typer.Argument(help="Of the tool.")],
    kind: Annotated[Literal["taglab", "biigle", "coco"], typer.Option("--format")],
    workspace: Workspace = WORK,
    tiles: Tiles = None,
    as_json: AsJson = False,
) -> None:
    """Add annotations of a tool to those of a workspace.

    A TagLab project, a BIIGLE report or label tree (CSV), a COCO file. What is there already, by
    label, shape and place, is not added twice.
    """
    from reconstruct.annotations.transfer import import_file

    print_result(*import_file(workspace, file, kind, tiles=tiles), as_json)


@app.command(
    epilog=examples(
        "annotations export -w reef --format coco -o reef.json",
        "annotations export -w reef --format biigle --tiles tiles -o report.csv",
    )
)
def export(
    kind: Annotated[Literal["taglab", "biigle", "coco", "geojson"], typer.Option("--format")],
    output: Annotated[Path, typer.Option("-o", "--output", help="File to write.")],
    workspace: Workspace = WORK,
    tiles: Tiles = None,
    as_json: AsJson = False,
) -> None:
    """Write the annotations of a workspace for a tool, or for a GIS."""
    from reconstruct.annotations.transfer import export_file

    print_result(*export_file(workspace, output, kind, tiles=tiles), as_json)


@app.command(
    epilog=examples(
        "annotations table -w reef",
        "annotations table -w reef --quadrat 1 --csv cover.csv",
        "annotations table -w reef --each --csv colonies.csv",
    )
)
def table(
    workspace: Workspace = WORK,
    quadrat: Annotated[
        float | None, typer.Option(min=1e-6, help="Side of squares, m; all at once if not given.")
    ] = None,
    pick_sigma: Annotated[
        float, typer.Option(min=0, help="Sigma of a vertex, pixels of mosaic or picture.")
    ] = 0.5,
    each: Annotated[bool, typer.Option("--each", help="List annotations, not labels.")] = False,
    csv: Annotated[Path | None, typer.Option(help="Write the rows as CSV.")] = None,
    as_json: AsJson = False,
) -> None:
    """Show what labels cover.

    Count, area in plan, share of the known ground, area of the surface and rugosity of each label,
    with sigmas; or the same of each annotation. Annotations in pictures are projected onto the
    mosaic.
    """
    from reconstruct.annotations.table import table as measured

    result = measured(workspace, side=quadrat, sigma_px=pick_sigma, each=each, csv_file=csv)
    print_result(*result, as_json)
