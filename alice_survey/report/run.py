"""The stage `report`: `report.html`, `report.pdf` and `report.json` of whatever is there."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from alice_survey.base.artefacts import STAGE_FILE, atomic_path
from alice_survey.base.config import SurveyConfig
from alice_survey.base.records import ReportRecord
from alice_survey.base.run import progress
from alice_survey.kit.document import PictureLayer, Report, ShapeLayer, SurveyMap
from alice_survey.kit.map_figure import with_stills
from alice_survey.kit.page import render_html
from alice_survey.report import reproduce
from alice_survey.report.figures import Figures
from alice_survey.report.held import Held
from alice_survey.report.mesh_copy import mesh_copy
from alice_survey.report.pdf import write_pdf
from alice_survey.report.rasters import picture_layers
from alice_survey.report.sections import sections
from alice_survey.report.shapes import shape_layers
from alice_survey.report.summary import facts, summary
from alice_survey.report.verdicts import verdicts


def run_report(workspace: Path, config: SurveyConfig, threads: int, folder: Path) -> None:
    """Write the report of what the workspace holds."""
    report, data = build_report(Held.of(workspace), folder)
    with atomic_path(folder / "report.html") as path:
        path.write_text(render_html(report), encoding="utf-8")
    with atomic_path(folder / "report.pdf") as path:
        write_pdf(report, path)
    ReportRecord.save(folder / "report.json", data)
    if report.mesh is not None:
        report.mesh.glb.unlink()


def build_report(held: Held, folder: Path) -> tuple[Report, dict[str, Any]]:
    """The report, and the same numbers for programs.

    Args:
        held: the workspace.
        folder: for the mesh's light copy.
    """
    figures = Figures(held=held)
    found = verdicts(figures)
    said, known = summary(figures, found), facts(figures)
    with progress.step("draw the maps"):
        layers: list[PictureLayer | ShapeLayer] = [*picture_layers(held), *shape_layers(held)]
        chart = None
        if layers:
            chart = with_stills(SurveyMap(layers=layers, unit=held.unit, origin=origin_of(held)))
    mesh = mesh_copy(held, folder / "mesh.glb")
    parts = list(sections(figures, has_map=chart is not None, has_mesh=mesh is not None))
    parts.append(reproduce.section(figures))
    report = Report(
        title=held.name,
        subtitle=_subtitle(held),
        summary=said,
        facts=known,
        verdicts=found,
        sections=parts,
        map=chart,
        mesh=mesh,
    )
    return report, _data(figures, found, said, known)


def _subtitle(held: Held) -> str:
    kind = "simulated survey" if held.simulated else "survey"
    newest = max((held.workspace / n / STAGE_FILE).stat().st_mtime for n in held.stages)
    when = datetime.fromtimestamp(newest, UTC).strftime("%Y-%m-%d %H:%M UTC")
    datum = held.frame.datum
    place = ""
    if datum is not None:
        place = f"{datum.latitude_deg:.5f}, {datum.longitude_deg:.5f} (WGS 84); "
    return f"{kind}; {place}last worked on {when}"


def origin_of(held: Held) -> str:
    """Where a map of it counts from, in words."""
    datum = held.frame.datum
    if datum is not None and held.frame.name == "ned":
        return (
            f"metres east and north of {datum.latitude_deg:.7f}, {datum.longitude_deg:.7f} (WGS 84)"
        )
    return "the model's own axes"


def _data(figures: Figures, found: Any, said: Any, known: Any) -> dict[str, Any]:
    surface = figures.surface
    return {
        "format": "alice-survey report",
        "version": 1,
        "name": figures.held.name,
        "unit": figures.held.unit,
        "summary": dict(said),
        "facts": dict(known),
        "verdicts": [vars(verdict) for verdict in found],
        "surface": None if surface is None else _finite(vars(surface)),
        "stages": {
            name: {"version": stage.version, "digest": stage.digest, "took_s": stage.took_s}
            for name, stage in figures.held.stages.items()
        },
    }


def _finite(values: dict[str, float]) -> dict[str, float | None]:
    return {name: value if value == value else None for name, value in values.items()}
