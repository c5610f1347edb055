"""The stage `report`: `report.html`, `report.pdf` and `report.json` of whatever is there."""

from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from alice_survey.app.report.held import Held
from alice_survey.app.report.mesh_copy import mesh_copy
from alice_survey.app.report.rasters import picture_layers
from alice_survey.app.report.shapes import shape_layers
from alice_survey.app.report.verdicts import facts, summary, verdicts
from alice_survey.core.artefacts import STAGE_FILE, atomic_path, json_values
from alice_survey.core.executor import Executor
from alice_survey.core.records import ReportRecord
from alice_survey.core.run import progress
from alice_survey.kit.document import OWN_AXES, PictureLayer, Report, ShapeLayer, SurveyMap


def run_report(workspace: Path, folder: Path, executor: Executor) -> None:
    """Write the report of what the workspace holds."""
    from alice_survey.kit.page import render_html
    from alice_survey.kit.paper import render_pdf

    held = Held.of(workspace)
    report, data = build_report(held, folder)
    with progress.step("write the page"), atomic_path(folder / "report.html") as path:
        path.write_text(render_html(report), encoding="utf-8")
    with progress.step("write the PDF"), atomic_path(folder / "report.pdf") as path:
        path.write_bytes(render_pdf(report, last_worked_on(held)))
    ReportRecord.save(folder / "report.json", data)
    if report.mesh is not None:
        report.mesh.glb.unlink()


def build_report(held: Held, folder: Path) -> tuple[Report, dict[str, Any]]:
    """The report, and the same numbers for programs.

    Args:
        held: the workspace.
        folder: for the mesh's light copy.
    """
    from alice_survey.app.report.sections import sections  # here, as the studio uses this module
    from alice_survey.kit.paper import with_stills

    found = verdicts(held)
    said, known = summary(held, found), facts(held)
    with progress.step("draw the maps"):
        layers: list[PictureLayer | ShapeLayer] = [*picture_layers(held), *shape_layers(held)]
        chart = with_stills(survey_map(held, layers)) if layers else None
    mesh = mesh_copy(held, folder / "mesh.glb")
    parts = list(sections(held, has_map=chart is not None, has_mesh=mesh is not None))
    kind = "simulated survey" if held.simulated else "survey"
    worked, datum = last_worked_on(held), held.frame.datum
    place = "" if datum is None else (
        f"{datum.latitude_deg:.5f}, {datum.longitude_deg:.5f} (WGS 84)"
    )  # fmt: skip
    program = f"alice-survey {version('alice-survey')}"
    report = Report(
        title=held.name,
        subtitle="; ".join(
            filter(None, (kind, place, f"last worked on {worked:%Y-%m-%d %H:%M UTC}"))
        ),
        summary=said,
        facts=known,
        verdicts=found,
        sections=parts,
        map=chart,
        mesh=mesh,
        citation=[
            ("Software", f"{program}; versions of its libraries are in the last section"),
            ("Cite as", f"{held.name}, survey report, {program}, {worked:%Y-%m-%d}"),
        ],
    )
    return report, _data(held, found, said, known)


def last_worked_on(held: Held) -> datetime:
    """When the newest of its stages was finished."""
    newest = max((held.workspace / n / STAGE_FILE).stat().st_mtime for n in held.stages)
    return datetime.fromtimestamp(newest, UTC)


def survey_map(held: Held, layers: Sequence[PictureLayer | ShapeLayer]) -> SurveyMap:
    """The map of a workspace, with some layers."""
    datum = held.frame.datum
    if held.plane is not None:
        origin = f"the plane {held.plane.name}, {held.plane.about}: right and up in it"
        return SurveyMap(layers=layers, unit=held.unit, origin=origin, axes=("right", "up"))
    if datum is None or held.frame.name != "ned":
        return SurveyMap(
            layers=layers, unit=held.unit, origin="the model's own axes", axes=OWN_AXES
        )
    place = f"{datum.latitude_deg:.7f}, {datum.longitude_deg:.7f} (WGS 84)"
    return SurveyMap(layers=layers, unit=held.unit, origin=f"metres east and north of {place}")


def _data(held: Held, found: Any, said: Any, known: Any) -> dict[str, Any]:
    return {
        "format": "alice-survey report",
        "version": 1,
        "name": held.name,
        "unit": held.unit,
        "summary": dict(said),
        "facts": dict(known),
        "verdicts": [vars(verdict) for verdict in found],
        "surface": json_values(held.surface),
        "stages": {
            name: {"version": stage.version, "digest": stage.digest, "took_s": stage.took_s}
            for name, stage in held.stages.items()
        },
    }
