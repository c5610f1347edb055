"""Sections of a calibration report: parameters, residuals, correlations, uncertainty."""

import math

from camera_calib.judge import plots_of_fit as plots
from camera_calib.judge.fit_quality import GATE_SIGMAS
from camera_calib.judge.judgement import Judgement, Parameter
from camera_calib.judge.page import Figure, Section, Table, short_label, with_sigma

_MOST_PICTURES = 60
"""Rows of the table of pictures; those that fit best are left out beyond."""


def parameters_section(judged: Judgement) -> Section:
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


def residuals_section(judged: Judgement) -> Section:
    """Residuals by picture, place, radius, angle and size."""
    noise = judged.calibration.noise_px
    worst = sorted(judged.pictures, key=lambda p: -p.rms_px)[:_MOST_PICTURES]
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
            "A residual is where the model sees a point less where it was measured. Means and "
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
                alt="Histogram of residuals over noise beside the normal law, by camera",
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
                wide=True,
            )
        ],
    )


def correlations_section(judged: Judgement) -> Section:
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
                otherwise="A pair near 1 is not told apart by these views: its errors cancel "
                "where the views were, and return elsewhere. Nearer views, more tilts "
                "and turned targets part them; or hold one.",
            )
        ],
    )


def uncertainty_section(judged: Judgement) -> Section:
    """What the covariance means for pixels, points and lengths."""
    work = f"{judged.working_range_m:.3g} m"
    figures = [
        Figure(
            png=plots.plot_projection(judged),
            title=f"Projection at {work}",
            alt="Maps of the projection's standard deviation over each frame",
            shows="One sigma, in its worst direction, of where a point is projected, from the "
            "calibration alone. Above, the point is fixed to the targets seen, and the pose that "
            "fits best takes up what it can (mrcal's uncertainty): what surveys suffer whose poses "
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
                "beside what a point's own noise gives; noise averages out over many points, "
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
        title="Stereo: sigmas in mm, from the calibration alone unless said otherwise",
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
        wide=True,
    )
