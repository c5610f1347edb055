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
from camera_calib.calibration import Calibration, CornerNoise
from camera_calib.judge import plots
from camera_calib.judge.fit_quality import GATE_SIGMAS, TILTED_DEG
from camera_calib.judge.judgement import CameraJudgement, Judgement, Parameter, judge, short_label
from camera_calib.judge.validation import HeldOut, LengthErrors
from camera_calib.judge.verdicts import verdicts

_FORMAT = {"format": "alice-survey calibration report", "version": 1}
_MAX_PICTURES = 60
"""Rows of the table of pictures; those that fit best are left out beyond."""


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
    yield _parameters_section(judged)
    if judged.calibration.spread is not None:
        yield _target_section(judged.calibration, judged.calibration.spread.noise)
    yield _residuals_section(judged)
    yield _correlations_section(judged)
    yield _uncertainty_section(judged)
    yield _hold_out_section(judged)
    if judged.lengths is not None:
        yield _lengths_section(judged)
    yield _homographies_section(judged)
    yield _coverage_section(judged)
    yield _rejections_section(judged)


def _parameters_section(judged: Judgement) -> Section:
    """All parameters with their sigmas, camera by camera."""
    tables = []
    for name in judged.cameras:
        rows = [p for p in judged.parameters if p.name.rpartition(".")[0] == name]
        shown = [p for p in rows if p.sigma is not None or p.value != 0.0]
        tables.append(
            Table(
                title=name,
                header=("parameter", "value", "unit", "known from", "goes most with"),
                rows=[_parameter_row(p) for p in shown],
            )
        )
    return Section(
        title="Parameters",
        text=(
            "What was found, with one standard deviation. Lengths of the port and the rig are in "
            "mm; normal x and y are the port's tilt about the camera's y and x axes, rx to rz the "
            "rotation of a camera from the rig's frame as a rotation vector, its sigma a small "
            "turn about the camera's own axes. Parameters that are held and 0 are not listed.",
            "Large sigmas are no harm by themselves where errors cancel (see correlations); what "
            "counts is the projection uncertainty below.",
        ),
        tables=tables,
    )


def _parameter_row(parameter: Parameter) -> tuple[str, ...]:
    label = short_label(parameter.name.rpartition(".")[2])
    known = "views, prior" if parameter.prior else "views"
    if parameter.sigma is None:
        return label, f"{parameter.value:.6g}", parameter.unit, "held", ""
    alike = f"{parameter.most_alike} ({parameter.correlation:+.2f})" if parameter.most_alike else ""
    return label, with_sigma(parameter.value, parameter.sigma), parameter.unit, known, alike


def _target_section(calibration: Calibration, noise: CornerNoise) -> Section:
    """The target's shape, and what the noise of its corners is made of."""
    shape, rows = calibration.shape, []
    for name, prior in zip(shape.parameters, shape.prior_sigmas.tolist(), strict=True):
        scale, unit = (1e3, "mm") if name.endswith("_m") else (1e2, "%")
        value, sigma = shape.known(name)
        known = with_sigma(scale * value, scale * sigma)
        rows.append((short_label(name.rpartition(".")[2]), known, unit, f"{scale * prior:.2g}"))
    tables = [
        Table(
            title="Departure from the drawing",
            header=("mode", "value", "unit", "sigma before"),
            rows=rows,
        )
    ]
    return Section(
        title="Target",
        text=(
            "The target's shape is found with the cameras: bow x and y are the depth of its middle "
            "behind the ends of its width and height, twist of its corners; bend 30 to 04 are "
            "ripples by their degree over width and height; stretch is the length of x over that "
            "of y, shear what its right angle lacks. Sigmas of the cameras include those of the "
            "shape.",
            f"Of the noise's variance {noise.together_share:.0%} goes together between corners of "
            f"a picture or view, and corners lie {1e3 * noise.place_sigmas_m[0]:.3f} mm (one "
            "sigma, each axis) off their places in the target's plane. All sigmas include that; "
            "counted as independent, errors would look smaller than they are.",
        ),
        tables=tables if rows else [],
    )


def _residuals_section(judged: Judgement) -> Section:
    """Residuals by picture, place, radius, angle and size."""
    noise = judged.calibration.noise_px
    worst = sorted(judged.pictures, key=lambda p: -p.rms_px)[:_MAX_PICTURES]
    shown = {(p.view, p.camera) for p in worst}
    rows = [
        (
            p.view,
            p.camera,
            f"{p.points}",
            f"{p.rms_px:.3f}",
            f"{p.worst_px:.2f}",
            f"{p.outliers or ''}",
            f"{p.range_m:.2f}",
            f"{p.tilt_deg:.0f}",
        )
        for p in judged.pictures
        if (p.view, p.camera) in shown
    ]
    left_out = len(judged.pictures) - len(rows)
    rest = f"; the {left_out} that fit best are left out" if left_out else ""
    return Section(
        title="Residuals",
        text=(
            "A residual is where the model sees a point minus where it was measured. Means and "
            f"profiles leave out outliers (longer than {GATE_SIGMAS:g} times the noise, of "
            f"{noise:.3f} px unless a picture has its own); bars and histogram do not.",
        ),
        figures=[
            Figure(
                png=plots.plot_pictures(judged),
                title="By picture",
                alt="Bars: rms of the residuals of every picture, cameras side by side",
                shows="Rms length of the residuals of each picture; right, against its distance.",
                good="All bars near the dashed line, which is what noise alone gives.",
                otherwise="Look at pictures that stand out: blur, motion between the cameras' "
                "exposures, a wrong or bent target. Worse near the camera: the port's model.",
            ),
            Figure(
                png=plots.plot_vectors(judged),
                title="Over the frame",
                alt="Arrows over each frame: residuals of all points and their means by cell",
                shows="Thin lines: all residuals. Arrows: means by cell, coloured where longer "
                "than chance allows (1 cell in 100).",
                good="Directions at random, few coloured arrows, and those without order.",
                otherwise="Swirls, stars or one-sided fields are errors of the model: another "
                "lens model, or the port's parameters set free.",
            ),
            Figure(
                png=plots.plot_profiles(judged),
                title="Against radius and angle",
                alt="Lines: rms and mean outward part of residuals against radius and angle",
                shows="Rms of one coordinate (above) and mean part away from the centre (below), "
                "with two sigmas of chance as bars, against the radius and against the "
                "angle of the ray outside to the port's normal.",
                good="Flat at the dashed lines.",
                otherwise="A trend with the radius speaks of lens distortion, one with the angle "
                "that starts at the port's normal of the port's distance, glass or index.",
            ),
            Figure(
                png=plots.plot_histogram(judged),
                title="Against the normal law",
                alt="Histogram of residuals over noise against the normal law, by camera",
                shows="Both coordinates of all residuals over the noise; logarithmic.",
                good="The bars follow the curve.",
                otherwise="Fat tails are badly found corners (robust weights bear some); a "
                "narrow peak on a broad foot is two kinds of pictures.",
            ),
        ],
        tables=[
            Table(
                title=f"Pictures{rest}",
                header=("view", "camera", "points", "rms px", "worst px", "outliers", "m", "deg"),
                rows=rows,
            )
        ],
    )


def _correlations_section(judged: Judgement) -> Section:
    """The correlation matrix."""
    return Section(
        title="Correlations",
        figures=[
            Figure(
                png=plots.plot_correlation(judged),
                title="Correlation of the parameters",
                alt="Heat map of the correlation matrix of all calibrated parameters",
                shows="How far errors of two parameters go together (blue) or against each other "
                "(red).",
                good="Pale outside of the diagonal. Some pairs always go together: fx with fy, "
                "the centre with p1, p2 and the port's tilt, k1 to k3.",
                otherwise="These views cannot separate a pair near 1: its errors cancel "
                "where the views were, and return elsewhere. Nearer views, more tilts "
                "and turned targets part them; or hold one.",
            )
        ],
    )


def _uncertainty_section(judged: Judgement) -> Section:
    """Effect of the covariance on pixels, points and lengths."""
    work = f"{judged.working_range_m:.3g} m"
    figures = [
        Figure(
            png=plots.plot_projection(judged),
            title=f"Projection at {work}",
            alt="Maps of the projection's standard deviation over each frame",
            shows="One sigma, in its worst direction, of where a point is projected, from the "
            "calibration alone. Above, the point is fixed to the targets seen, and the pose that "
            "fits best takes up what it can: what surveys suffer whose poses "
            "come from the pictures. Below, the point is fixed to the camera.",
            good="Above: less than the noise of a point over most of the frame.",
            otherwise="Dark corners need points there; dark everywhere needs more views.",
        ),
        Figure(
            png=plots.plot_ranges(judged),
            title="Against distance",
            alt="Lines: projection uncertainty, and stereo uncertainty, against distance",
            shows="The same over distance, median and worst of the frame; the grey band is where "
            "the views were. "
            + (
                "Right: a triangulated point's distance and lengths, from the calibration alone, "
                "next to what a point's own noise gives; noise averages out over many points, "
                "calibration errors do not."
                if judged.stereo
                else ""
            ),
            good="Low where the rig will work.",
            otherwise="Take views at the distances where the rig works; sigmas grow beyond.",
        ),
    ]
    if judged.stereo_map is not None and len(judged.stereo_map.points_rig) > 3:
        figures.append(
            Figure(
                png=plots.plot_stereo_map(judged),
                title=f"Stereo at {work}",
                alt="Maps of the standard deviation of triangulated distance over the overlap",
                shows="One sigma of triangulated distance over the cameras' overlap, from the "
                "calibration alone. Left, after the rigid motion that leaves least: "
                "what bends or tilts the shape of a flat floor.",
                good="Left: well below the relief to be measured.",
                otherwise="More views with points near the edges of both frames.",
            )
        )
    return Section(
        title="Uncertainty",
        text=("All sigmas are propagated from the full covariance by analytic slopes.",),
        figures=figures,
        tables=[_stereo_table(judged)] if judged.stereo else [],
    )


def _stereo_table(judged: Judgement) -> Table:
    def mm(value_m: float) -> str:
        return f"{1e3 * value_m:.3g}" if math.isfinite(value_m) else "no overlap"

    rows = [
        (
            f"{s.range_m:.3g}",
            *(mm(v) for v in s.point_m),
            mm(s.worst_shape_m),
            mm(s.noise_m[2]),
            f"{s.length_m:.2f}" if math.isfinite(s.length_m) else "",
            mm(s.length_sigma_m),
        )
        for s in judged.stereo
    ]
    return Table(
        title="Stereo: sigmas in mm, from the calibration alone unless stated otherwise",
        header=(
            "distance m",
            "point right",
            "down",
            "forward",
            "shape, worst",
            "forward, noise alone",
            "length m",
            "its sigma",
        ),
        rows=rows,
    )


def _hold_out_section(judged: Judgement) -> Section:
    """Views that took no part, and calibrations from halves of the views."""
    score = judged.hold_out
    if score is None:
        return Section(
            title="Hold-out test",
            text=("Not done: too few views to leave some out and calibrate from the rest.",),
        )
    figures = [
        Figure(
            png=plots.plot_hold_out(judged),
            title="Views that took no part",
            alt="Lollipops: rms of views used and of views held out",
            shows="The rig is calibrated again without the diamonds, whose poses are then found "
            f"with the rig held. They fit to {score.rms_px:.3f} px rms, {score.expected_px:.3f} px "
            "is what noise and covariance promise.",
            good="Held out near the dashed line, and near the used ones.",
            otherwise="Clearly above: the model fits the views it was given and not the camera. "
            "Free fewer parameters, or take more and more varied views.",
        )
    ]
    if any(camera.halves is not None for camera in judged.cameras.values()):
        figures.append(
            Figure(
                png=plots.plot_halves(judged),
                title="Two halves of the views",
                alt="Maps and arrows: difference of projection between two calibrations",
                shows="Two calibrations, from every other view each: how far apart they project "
                f"at {judged.working_range_m:.3g} m, after the best pose between them.",
                good="No more than about twice the expected rms in the titles."
                + (
                    ""
                    if judged.halves is None
                    else f" All parameters together differ by chi2 {judged.halves.chi2:.1f} for "
                    f"{judged.halves.parameters} (p = {judged.halves.p_value:.2g}); below 0.01 is "
                    "rarely chance."
                ),
                otherwise="Much more: the sigmas are too small, as the model is wrong or the "
                "target moved; do not trust the maps above.",
            )
        )
    return Section(title="Hold-out test", figures=figures)


def _lengths_section(judged: Judgement) -> Section:
    """Lengths on the target, triangulated."""
    rows = []
    for lengths, which in ((judged.lengths, "used"), (judged.held_lengths, "held out")):
        if lengths is None or not len(lengths.true_m):
            continue
        scale, scale_sigma = lengths.scale_ppm()
        for long, kind in ((True, "long"), (False, "neighbours")):
            rms, expected = lengths.rms_m(long)
            at = lengths.long == long
            scaled = f"{scale:+.0f} +/- {scale_sigma:.0f}" if long and scale == scale else ""
            size = f"{1e3 * lengths.true_m[at].min():.0f} to {1e3 * lengths.true_m[at].max():.0f}"
            rows.append(
                (
                    which,
                    kind,
                    f"{at.sum()}",
                    size,
                    f"{1e3 * rms:.3f}",
                    f"{1e3 * expected:.3f}",
                    scaled,
                )
            )
    figures = []
    if rows:
        figures.append(
            Figure(
                png=plots.plot_lengths(judged),
                title="Lengths on the target",
                alt="Scale error of each view against distance, and histogram of length errors",
                shows="Points seen by two cameras are triangulated, view by view, and their "
                "distances compared with the target's: scale error of the long ones (left), and "
                "all errors of long ones over what noise gives (right).",
                good="Scatter about zero without a trend, and bars under the curve.",
                otherwise="An offset is a wrong target size or baseline; a trend with distance a "
                "wrong rotation between the cameras, port or focal length.",
            )
        )
    return Section(
        title="Lengths",
        text=(
            "The target gives the scale of the rig, so used views prove little of scale as such; "
            "held-out views, and the trend with distance, are independent.",
        ),
        figures=figures,
        tables=[
            Table(
                title="Length errors",
                header=("views", "lengths", "count", "mm", "rms mm", "by noise mm", "scale ppm"),
                rows=rows,
            )
        ],
    )


def _homographies_section(judged: Judgement) -> Section:
    """Residuals of homographies."""
    if all(camera.homography is None for camera in judged.cameras.values()):
        return Section(
            title="Homographies",
            text=("Not done: the target is not flat, or no view has enough points.",),
        )
    return Section(
        title="Homographies",
        text=(
            "A test that needs no truth: with lens and port undone, each picture of a flat target "
            "is a plane seen by a pinhole, so a homography fits it to the noise. A flat port has "
            "no single centre; each ray is followed to the target's own distance before the "
            "pinhole looks.",
        ),
        figures=[
            Figure(
                png=plots.plot_homographies(judged),
                title="What homographies leave",
                alt="Lines: rms and mean outward part of homography residuals against radius",
                shows="Residuals of one homography per picture, against the radius.",
                good="On the dashed lines, which are the inner points' level carried outwards.",
                otherwise="A rise or a bow towards the edge is an error of the lens or port model "
                "that poses cannot hide; also a bent target, which then bows all alike.",
            )
        ],
    )


def _coverage_section(judged: Judgement) -> Section:
    """Distribution of points, and poses of the target."""
    rows = []
    for name, camera in judged.cameras.items():
        views, reach = camera.spread, camera.coverage.corner_reach
        rows.append(
            (
                name,
                *(f"{100 * r:.0f}%" for r in reach.values()),
                f"{camera.coverage.empty_share:.0%}",
                f"{views.range_m.min():.2f} to {views.range_m.max():.2f}",
            )
        )
    bare = [
        f"{name}: no points near the {', '.join(c.coverage.uncovered)} of the frame."
        for name, c in judged.cameras.items()
        if c.coverage.uncovered
    ]
    return Section(
        title="Coverage",
        text=bare or ["Points come near all corners of all frames."],
        figures=[
            Figure(
                png=plots.plot_coverage(judged),
                title="Where points fell",
                alt="Counts of points by cell of each frame; corners without points hatched",
                shows="Points seen by cell. In hatched corners there are none: distortion is "
                "guessed there.",
                good="All cells filled, corners too.",
                otherwise="Hold the target so that it fills the empty parts, partly out of the "
                "frame if it can be read so (ChArUco, AprilTags).",
            ),
            Figure(
                png=plots.plot_spread(judged),
                title="How the target was held",
                alt="Scatter: tilts of the target, and tilt against distance",
                shows=f"Tilts about both axes of the camera; the shade is below {TILTED_DEG:g} "
                "degrees.",
                good="Points in all four quarters beyond the shade, at near and far distances.",
                otherwise="Tilt the target both ways, and take near and far views: they part focal "
                "length, port distance and centre.",
            ),
        ],
        tables=[
            Table(
                title="How far towards each corner points were seen; empty cells; distances m",
                header=(
                    "camera",
                    "top left",
                    "top right",
                    "bottom left",
                    "bottom right",
                    "empty",
                    "distances",
                ),
                rows=rows,
            )
        ],
    )


def _rejections_section(judged: Judgement) -> Section:
    """Pictures and points left out, and why."""
    rows = [
        (r.view, r.camera, f"{r.points}" if r.points else "whole picture", r.reason)
        for r in judged.calibration.rejections
    ]
    return Section(
        title="Rejected",
        text=("Pictures, and corners of them, that took no part.",)
        if rows
        else ("No picture and no corner was rejected.",),
        tables=[Table(title="Rejections", header=("view", "camera", "points", "why"), rows=rows)]
        if rows
        else [],
    )
