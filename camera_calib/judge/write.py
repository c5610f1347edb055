"""The calibration report: one HTML page that stands alone, and its numbers as JSON."""

import math
from collections.abc import Iterator
from pathlib import Path

from alice_survey.base.artefacts import atomic_path
from alice_survey.base.records import CalibrationReportRecord
from alice_survey.base.run import progress
from camera_calib.calibrate.result import Calibration
from camera_calib.judge.judgement import Judgement, judge
from camera_calib.judge.numbers import report_json
from camera_calib.judge.page import Section, page, with_sigma
from camera_calib.judge.sections_of_checks import (
    coverage_section,
    hold_out_section,
    homographies_section,
    lengths_section,
    rejections_section,
)
from camera_calib.judge.sections_of_fit import (
    correlations_section,
    parameters_section,
    residuals_section,
    uncertainty_section,
)
from camera_calib.judge.validation import HeldOut
from camera_calib.judge.verdicts import Verdict, verdicts


def write_report(
    folder: Path,
    calibration: Calibration,
    held_out: HeldOut | None,
    working_range_m: float | None = None,
) -> None:
    """Write `report.html` and `report.json` into a folder.

    Args:
        folder: is there already.
        calibration: with its rig's covariance.
        held_out: from `validation.hold_out`; None if no views could be held out.
        working_range_m: where the rig will work, for maps and stereo (see `judge`).

    Raises:
        CalibrationError: the rig has no covariance.
    """
    judged = judge(calibration, held_out, working_range_m)
    found = verdicts(judged)
    CalibrationReportRecord.save(folder / "report.json", report_json(judged, found))
    with atomic_path(folder / "report.html") as path:
        path.write_text(render(judged, found), encoding="utf-8")


@progress.step("draw the calibration's report")
def render(judged: Judgement, found: tuple[Verdict, ...]) -> str:
    """The page as text; the same judgement gives the same bytes."""
    calibration = judged.calibration
    cameras = " and ".join(judged.cameras) if len(judged.cameras) < 3 else f"{len(judged.cameras)}"
    warnings = [Verdict(level="look", text=text) for text in calibration.warnings]
    order = ("bad", "look", "good")
    lines = sorted([*warnings, *found], key=lambda verdict: order.index(verdict.level))
    return page(
        title="Camera calibration",
        subtitle=f"{calibration.rig.source}; cameras: {cameras}",
        facts=list(_facts(judged)),
        verdicts=[(verdict.level, verdict.text) for verdict in lines],
        sections=list(_sections(judged)),
    )


def _facts(judged: Judgement) -> Iterator[tuple[str, str]]:
    calibration = judged.calibration
    pictures, points = len(judged.pictures), sum(p.points for p in judged.pictures)
    yield "residuals", f"{calibration.rms_px:.3f} px rms"
    yield "noise of a coordinate", f"{calibration.noise_px:.3f} px"
    yield "views", f"{len(calibration.views)} ({pictures} pictures, {points} points)"
    for name, (length_m, sigma_m) in judged.baselines_m.items():
        label = "baseline" if len(judged.baselines_m) == 1 else f"baseline to {name}"
        yield label, f"{with_sigma(1e3 * length_m, 1e3 * sigma_m)} mm"
    if judged.hold_out is not None:
        yield "held-out views", f"{judged.hold_out.rms_px:.3f} px rms"
    at_work = judged.stereo_at_work
    if at_work is not None and math.isfinite(at_work.length_sigma_m):
        per_mille = 1e3 * at_work.length_sigma_m / at_work.length_m
        yield f"a length at {judged.working_range_m:.3g} m", f"+/- {per_mille:.2f} mm per metre"


def _sections(judged: Judgement) -> Iterator[Section]:
    yield parameters_section(judged)
    yield residuals_section(judged)
    yield correlations_section(judged)
    yield uncertainty_section(judged)
    yield hold_out_section(judged)
    if judged.lengths is not None:
        yield lengths_section(judged)
    yield homographies_section(judged)
    yield coverage_section(judged)
    yield rejections_section(judged)
