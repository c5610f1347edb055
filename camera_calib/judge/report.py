"""The calibration report: one self-contained HTML page, and its numbers as JSON."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from alice_survey.core.artefacts import atomic_path, json_values
from alice_survey.core.records import CalibrationReportRecord
from alice_survey.core.run import progress
from alice_survey.kit.document import Figure, Report, Section, Table, Verdict, worst_first
from alice_survey.kit.page import render_html
from alice_survey.kit.words import with_sigma
from camera_calib.calibration import Calibration
from camera_calib.judge import plots
from camera_calib.judge.fit_quality import GATE_SIGMAS
from camera_calib.judge.judgement import CameraJudgement, Judgement, Parameter, judge, short_label
from camera_calib.judge.validation import HeldOut, LengthErrors
from camera_calib.judge.verdicts import verdicts

_FORMAT = {"format": "alice-survey calibration report", "version": 1}


def write_report(
    folder: Path,
    calibration: Calibration,
    held_out: HeldOut | None,
) -> None:
    """Write `report.html` and `report.json` into a folder.

    Args:
        folder: an existing folder.
        calibration: with its rig's covariance.
        held_out: from `validation.hold_out`; None if no views could be held out.

    Raises:
        CalibrationError: the rig has no covariance.
    """
    judged = judge(calibration, held_out)
    found = verdicts(judged)
    CalibrationReportRecord.save(folder / "report.json", report_json(judged, found))
    with atomic_path(folder / "report.html") as path:
        path.write_text(render(judged, found), encoding="utf-8")


def report_json(judged: Judgement, found: Sequence[Verdict]) -> dict[str, Any]:
    """All numbers as JSON values; what is not known is null."""
    calibration = judged.calibration
    data: dict[str, Any] = json_values(
        {
            **_FORMAT,
            "source": calibration.rig.source,
            "views": len(calibration.views),
            "rms_px": calibration.rms_px,
            "noise_px": calibration.noise_px,
            "working_range_m": judged.working_range_m,
            "warnings": calibration.warnings,
            "verdicts": [{"level": v.level, "text": v.text} for v in found],
            "rejections": calibration.rejections,
            "parameters": judged.parameters,
            "baselines_m": judged.baselines_m,
            "target_frame": _target_numbers(judged),
            "pictures": judged.pictures,
            "cameras": {name: _camera_numbers(c) for name, c in judged.cameras.items()},
            "stereo": judged.stereo,
            "lengths": _length_numbers(judged.lengths),
            "held_out": judged.hold_out,
            "halves": judged.halves
            and {
                "chi2": judged.halves.chi2,
                "parameters": judged.halves.parameters,
                "p_value": judged.halves.p_value,
            },
            "held_out_lengths": _length_numbers(judged.held_lengths),
        }
    )
    return data


def _camera_numbers(camera: CameraJudgement) -> dict[str, Any]:
    test, halves, coverage = camera.homography, camera.halves, camera.coverage
    return {
        "coverage": {
            "counts": coverage.counts,
            "empty_share": coverage.empty_share,
            "corner_reach": coverage.corner_reach,
            "uncovered": coverage.uncovered,
        },
        "residuals_by_radius": camera.by_radius,
        "residuals_by_incidence_deg": camera.by_incidence,
        "projection_sigma": camera.by_range,
        "homography": test
        and {
            "views": test.views,
            "inner_px": test.inner_px,
            "outer_px": test.outer_px,
            "outer_from_px": test.outer_from_px,
            "by_radius": test.profile,
        },
        "halves": halves and {"rms_px": halves.rms_px, "expected_px": halves.expected_rms_px},
    }


def _target_numbers(judged: Judgement) -> dict[str, Any] | None:
    frame = judged.target_frame
    if frame is None:
        return None
    return {
        "returning_px": frame.returning_px,
        "p_value": frame.p_value,
        "in_plane_m": frame.in_plane_m,
        "likely": frame.cause if frame.returns else None,
    }


def _length_numbers(lengths: LengthErrors | None) -> dict[str, Any] | None:
    if lengths is None:
        return None
    scale, sigma = lengths.scale_ppm()
    found: dict[str, Any] = {"scale_ppm": scale, "scale_sigma_ppm": sigma}
    for key, long in (("long", True), ("neighbours", False)):
        rms, expected = lengths.rms_m(long)
        count = int((lengths.long == long).sum())
        found[key] = {"count": count, "rms_m": rms, "expected_m": expected}
    return found


@progress.step("draw the calibration's report")
def render(judged: Judgement, found: tuple[Verdict, ...]) -> str:
    """The page as text; the same judgement gives the same bytes."""
    calibration = judged.calibration
    cameras = " and ".join(judged.cameras) if len(judged.cameras) < 3 else f"{len(judged.cameras)}"
    warnings = [Verdict(level="look", text=text) for text in calibration.warnings]
    report = Report(
        title="Camera calibration",
        subtitle=f"{calibration.rig.source}; cameras: {cameras}",
        facts=list(_facts(judged)),
        verdicts=worst_first([*warnings, *found]),
        sections=list(_sections(judged)),
    )
    return render_html(report)


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
    yield Section(
        title="Parameters",
        text=(
            "Values with one standard deviation, from the covariance of the adjustment. Errors of "
            "correlated parameters cancel where the views were: the verdict on projection states "
            "what remains. Parameters that are fixed at 0 are not listed; all numbers are in "
            "report.json.",
        ),
        tables=[_parameter_table(judged)],
    )
    yield Section(title="Residuals", figures=list(_residual_figures(judged)))
    yield Section(title="Coverage", figures=[_coverage_figure(judged)])
    rejections = [
        f"View {r.view}, {r.camera}: {f'{r.points} points' if r.points else 'whole picture'}, "
        f"{r.reason}."
        for r in judged.calibration.rejections
    ]
    if rejections:
        yield Section(title="Rejected", text=rejections)


def _parameter_table(judged: Judgement) -> Table:
    rows = [_parameter_row(p) for p in judged.parameters if p.sigma is not None or p.value != 0.0]
    return Table(
        title="Cameras and target",
        header=("parameter", "value", "unit", "known from", "correlates most with"),
        rows=[*rows, *_target_rows(judged.calibration)],
    )


def _parameter_row(parameter: Parameter) -> tuple[str, ...]:
    owner, _, field = parameter.name.rpartition(".")
    name, unit = f"{owner} {short_label(field)}", parameter.unit
    if parameter.sigma is None:
        return name, f"{parameter.value:.6g}", unit, "fixed", ""
    known = "views, prior" if parameter.prior else "views"
    other = f"{parameter.most_alike} ({parameter.correlation:+.2f})" if parameter.most_alike else ""
    return name, with_sigma(parameter.value, parameter.sigma), unit, known, other


def _target_rows(calibration: Calibration) -> Iterator[tuple[str, ...]]:
    """The target's shape as it was adjusted with the cameras."""
    for name in calibration.shape.parameters:
        scale, unit = (1e3, "mm") if name.endswith("_m") else (1e2, "%")
        value, sigma = calibration.shape.known(name)
        label = f"target {short_label(name.rpartition('.')[2])}"
        yield label, with_sigma(scale * value, scale * sigma), unit, "views, prior", ""


def _residual_figures(judged: Judgement) -> Iterator[Figure]:
    yield Figure(
        png=plots.plot_pictures(judged),
        title="By picture",
        alt="Bars: rms of the residuals of every picture, cameras side by side",
        shows="Rms length of the residuals of each picture; right, against its distance.",
        good="All bars near the dashed line, which is what noise alone gives.",
        otherwise="Inspect pictures that stand out for blur, motion or a bent target. Worse near "
        "the camera: the port's model.",
    )
    yield Figure(
        png=plots.plot_vectors(judged),
        title="Over the frame",
        alt="Arrows over each frame: residuals of all points and their means by cell",
        shows="Thin lines: residuals, model minus measurement. Arrows: means by cell, coloured "
        "where longer than chance allows (1 cell in 100).",
        good="Random directions, few coloured arrows.",
        otherwise="Swirls or stars are errors of the model: try another lens model, or free the "
        "port's parameters.",
    )
    yield Figure(
        png=plots.plot_profiles(judged),
        title="Against the angle",
        alt="Lines: rms and mean outward part of residuals against the angle to the port's normal",
        shows="Rms of one coordinate, and mean part away from the centre with two sigmas of "
        f"chance; outliers (over {GATE_SIGMAS:g} times the noise) are left out.",
        good="Flat at the dashed lines.",
        otherwise="A trend is an error of the port's distance, glass or index, or of the lens.",
    )


def _coverage_figure(judged: Judgement) -> Figure:
    return Figure(
        png=plots.plot_coverage(judged),
        title="Where points fell",
        alt="Counts of points by cell of each frame; corners without points hatched",
        shows="Points seen by cell. Hatched corners have none: distortion is extrapolated there.",
        good="All cells filled, corners too.",
        otherwise="Hold the target in the empty parts, partly out of the frame if it can be read "
        "so (ChArUco, AprilTags).",
    )
