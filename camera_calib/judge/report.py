"""The calibration report: one self-contained page with four figures, and its numbers as JSON."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.artefacts import atomic_path, json_values
from alice_survey.core.frames import Array
from alice_survey.core.records import CalibrationReportRecord
from alice_survey.core.run import progress
from alice_survey.kit.document import Figure, Report, Section, Table, Verdict, worst_first
from alice_survey.kit.figure import (
    INK,
    INKS,
    Axes,
    LinearSegmentedColormap,
    Sheet,
    colour_bar,
    figure_style,
    new_figure,
    plain_name,
    png_of,
)
from alice_survey.kit.page import render_html
from alice_survey.kit.words import with_sigma
from camera_calib.calibration import Calibration
from camera_calib.judge.judgement import Judgement, judge, verdicts
from camera_calib.judge.residuals import GATE_SIGMAS
from camera_calib.judge.uncertainty import parameter_cells
from camera_calib.judge.validation import HeldOut, LengthErrors

_FORMAT = {"format": "alice-survey calibration report", "version": 1}
_SEQUENTIAL = LinearSegmentedColormap.from_list(
    "depth", ["#f4f9fb", "#bcdcea", "#6fb1d1", "#2f7fb0", "#15507f", "#0b2545"]
)
_WIDTH_IN = 10.4
_MAX_LABELS = 45
_CELLS = 12
"""Cells across a frame, in which residuals are averaged."""
_MIN_IN_CELL = 6
_STRONG = 3.0
"""Mean length over noise of the mean from which an arrow is in colour: 1 % of cells by chance."""


@progress.step("draw the calibration's report")
def write_report(folder: Path, calibration: Calibration, held_out: HeldOut | None) -> None:
    """Write `report.html` and `report.json` into a folder; unknown numbers are null.

    Args:
        folder: an existing folder.
        calibration: with its rig's covariance.
        held_out: from `validation.hold_out`; None if no views could be held out.

    Raises:
        CalibrationError: the rig has no covariance.
    """
    judged = judge(calibration, held_out)
    found, source = verdicts(judged), calibration.rig.source
    data = {
        **_FORMAT,
        "source": source,
        "views": len(calibration.views),
        "rms_px": calibration.rms_px,
        "noise_px": calibration.noise_px,
        "working_range_m": judged.working_range_m,
        "warnings": calibration.warnings,
        "verdicts": [{"level": v.level, "text": v.text} for v in found],
        "rejections": calibration.rejections,
        "parameters": judged.parameters,
        "baselines_m": judged.baselines_m,
        "pictures": judged.pictures,
        "cameras": {
            name: {"coverage": camera.coverage, "homography": camera.homography}
            for name, camera in judged.cameras.items()
        },
        "stereo": judged.stereo,
        "lengths": _length_numbers(judged.lengths),
        "held_out": judged.hold_out,
        "halves": judged.halves,
    }
    CalibrationReportRecord.save(folder / "report.json", json_values(data))
    cameras = " and ".join(judged.cameras) if len(judged.cameras) < 3 else f"{len(judged.cameras)}"
    warnings = [Verdict(level="look", text=text) for text in calibration.warnings]
    report = Report(
        title="Camera calibration",
        subtitle=f"{source}; cameras: {cameras}",
        facts=list(_facts(judged)),
        verdicts=worst_first([*warnings, *found]),
        sections=list(_sections(judged)),
    )
    with atomic_path(folder / "report.html") as path:
        path.write_text(render_html(report), encoding="utf-8")


def _length_numbers(lengths: LengthErrors | None) -> dict[str, Any] | None:
    if lengths is None:
        return None
    (scale, _), (rms, expected) = lengths.scale_ppm(), lengths.rms_m()
    long = {"count": len(lengths.view), "rms_m": rms, "expected_m": expected}
    return {"scale_ppm": scale, "long": long}


def _facts(judged: Judgement) -> Iterator[tuple[str, str]]:
    calibration = judged.calibration
    pictures, points = len(judged.pictures), sum(p.points for p in judged.pictures)
    yield "residuals", f"{calibration.rms_px:.3f} px rms"
    yield "noise of a coordinate", f"{calibration.noise_px:.3f} px"
    yield "views", f"{len(calibration.views)} ({pictures} pictures, {points} points)"
    for name, (length_m, sigma_m) in judged.baselines_m.items():
        label = "baseline" if len(judged.baselines_m) == 1 else f"baseline to {name}"
        yield label, f"{with_sigma(1e3 * length_m, 1e3 * sigma_m)} mm"


def _sections(judged: Judgement) -> Iterator[Section]:
    shown = [one for one in judged.parameters if one.sigma is not None or one.value != 0.0]
    yield Section(
        title="Parameters",
        text=(
            "Values with one standard deviation, from the covariance of the adjustment. Errors of "
            "correlated parameters cancel where the views were: the verdict on projection states "
            "what remains. Parameters that are fixed at 0 are not listed; all numbers are in "
            "report.json.",
        ),
        tables=[
            Table(
                title="Cameras and target",
                header=("parameter", "value", "unit", "correlates most with"),
                rows=[tuple(row.values()) for row in parameter_cells(shown)],
            )
        ],
    )
    yield Section(title="Residuals", figures=_residual_figures(judged))
    yield Section(
        title="Coverage",
        figures=[
            Figure(
                png=_plot_coverage(judged),
                title="Where points fell",
                alt="Counts of points by cell of each frame",
                shows="Points seen by cell. In corners without any, distortion is extrapolated.",
                good="All cells filled, corners too.",
                otherwise="Hold the target in the empty parts, partly out of the frame if it can "
                "be read so (ChArUco, AprilTags).",
            )
        ],
    )
    rejections = [
        f"View {r.view}, {r.camera}: {f'{r.points} points' if r.points else 'whole picture'}, "
        f"{r.reason}."
        for r in judged.calibration.rejections
    ]
    if rejections:
        yield Section(title="Rejected", text=rejections)


def _residual_figures(judged: Judgement) -> list[Figure]:
    return [
        Figure(
            png=_plot_pictures(judged),
            title="By picture",
            alt="Bars: rms of the residuals of every picture, cameras side by side",
            shows="Rms length of the residuals of each picture; right, against its distance.",
            good="All bars near the dashed line, which is what noise alone gives.",
            otherwise="Inspect pictures that stand out for blur, motion or a bent target. Worse "
            "near the camera: the port's model.",
        ),
        Figure(
            png=_plot_vectors(judged),
            title="Over the frame",
            alt="Arrows over each frame: residuals of all points and their means by cell",
            shows="Thin lines: residuals, model minus measurement. Arrows: means by cell, coloured "
            "where longer than chance allows (1 cell in 100).",
            good="Random directions, few coloured arrows.",
            otherwise="Swirls or stars are errors of the model: try another lens model, or free "
            "the port's parameters.",
        ),
        Figure(
            png=_plot_profiles(judged),
            title="Against the angle",
            alt="Lines: rms and mean outward part of residuals against the angle to the port's "
            "normal",
            shows="Rms of one coordinate, and mean part away from the centre with two sigmas of "
            f"chance; outliers (over {GATE_SIGMAS:g} times the noise) are left out.",
            good="Flat at the dashed lines.",
            otherwise="A trend is an error of the port's distance, glass or index, or of the lens.",
        ),
    ]


@figure_style()
def _plot_pictures(judged: Judgement) -> bytes:
    """Rms of each picture, cameras next to each other, and against its distance."""
    views = [view.name for view in judged.calibration.views]
    count = len(judged.cameras)
    figure = new_figure(3.4, _WIDTH_IN)
    axes, right = figure.subplots(1, 2, width_ratios=[3.2, 1], sharey=True)
    for c, camera in enumerate(judged.cameras):
        fits = [p for p in judged.pictures if p.camera == camera]
        at = np.array([views.index(p.view) for p in fits]) + 0.8 * (c - (count - 1) / 2) / count
        rms = [p.rms_px for p in fits]
        axes.bar(at, rms, 0.73 / count, color=_colour(c), label=plain_name(camera))
        right.plot([p.range_m for p in fits], rms, "o", color=_colour(c), ms=4)
    noise = judged.calibration.noise_px * 2**0.5
    axes.axhline(noise, color=INK, lw=1.1, ls="--", label=f"noise alone ({noise:.3f} px)")
    right.axhline(noise, color=INK, lw=1.1, ls="--")
    right.set(xlabel="distance (m)")
    right.set_xlim(0, right.get_xlim()[1])
    shown = range(0, len(views), -(-len(views) // _MAX_LABELS))
    axes.set_xticks(list(shown), [plain_name(views[i][-18:]) for i in shown])
    if max(map(len, views)) > 4:
        axes.tick_params(axis="x", labelrotation=90)
    axes.set(xlabel="view", ylabel="rms of residuals (px)", xlim=(-0.7, len(views) - 0.3))
    axes.grid(visible=False, axis="x")
    axes.margins(y=0.18)
    axes.legend(ncols=count + 1, loc="upper right")
    return png_of(figure)


@figure_style()
def _plot_vectors(judged: Judgement) -> bytes:
    """Residuals over the frame: each one thin, the mean of each cell bold."""
    figure, grid = _frames(judged)
    noise = judged.calibration.noise_px
    style: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1}
    bare = {"headwidth": 0, "headlength": 0, "headaxislength": 0}
    for c, (axes, (name, camera)) in enumerate(zip(grid, judged.cameras.items(), strict=True)):
        seen, width_px = camera.seen, judged.calibration.rig.cameras[name].width_px
        per_px = 0.025 * width_px / noise
        lines = per_px * seen.residuals_px
        axes.quiver(*seen.pixels.T, *lines.T, **style, **bare, width=0.0011, color="#c3ced5")
        places, means, count = _cell_means(seen.pixels, seen.residuals_px, width_px)
        strong = np.linalg.norm(means, axis=1) > _STRONG * noise / np.sqrt(count)
        for chosen, tone in ((~strong, "#7d8f9a"), (strong, _colour(c))):
            arrows = 4 * per_px * means[chosen]
            axes.quiver(
                *places[chosen].T, *arrows.T, **style, width=0.0045, color=tone,
                headwidth=3.6, headlength=4, headaxislength=3.6,
            )  # fmt: skip
        if judged.calibration.rejected is not None:
            out = judged.calibration.rejected[:, c].reshape(-1, 2)
            axes.plot(*out.T, "x", color="#b3261e", ms=5, mew=1.2, label="rejected")
            axes.legend(loc="upper right", facecolor="white", frameon=True, framealpha=0.8)
        axes.set_xlabel(f"x (px);  thin lines {per_px:.0f} times enlarged, arrows {4 * per_px:.0f}")
    return png_of(figure)


def _cell_means(pixels: Array, residuals: Array, width_px: int) -> tuple[Array, Array, Array]:
    """Mean places and residuals, and counts, of a square grid's cells with enough points."""
    cells, which, count = np.unique(
        np.floor(pixels * _CELLS / width_px).astype(int),
        axis=0,
        return_inverse=True,
        return_counts=True,
    )
    totals = np.zeros((len(cells), 4))
    np.add.at(totals, which.ravel(), np.hstack([pixels, residuals]))
    means = (totals / count[:, None])[count >= _MIN_IN_CELL]
    return means[:, :2], means[:, 2:], count[count >= _MIN_IN_CELL].astype(np.float64)


@figure_style()
def _plot_profiles(judged: Judgement) -> bytes:
    """Residuals against the angle of incidence in water: rms, and mean outward part."""
    figure = new_figure(3.4, _WIDTH_IN)
    above, below = figure.subplots(1, 2)
    for c, (name, camera) in enumerate(judged.cameras.items()):
        found = camera.by_incidence
        chance = found.expected_px / np.sqrt(np.maximum(found.count, 1))
        at = found.centres + 0.12 * found.edges[1] * c  # so that error bars do not hide each other
        style: dict[str, Any] = {"color": _colour(c), "marker": "o", "ms": 4, "capsize": 2}
        above.errorbar(at, found.rms_px, chance, **style, label=plain_name(name))
        below.errorbar(at, found.outward_px, 2 * chance, **style)
    noise = judged.calibration.noise_px
    above.axhline(noise, color=INK, lw=1.0, ls="--", label="noise")
    below.axhline(0, color=INK, lw=1.0, ls="--")
    reach = max(np.abs(below.get_ylim()).max(), 0.5 * noise)
    label = "angle to the port's normal outside (deg)"
    above.set(xlabel=label, ylabel="rms of one coordinate (px)")
    above.set_ylim(0, max(above.get_ylim()[1], 1.6 * noise))
    below.set(xlabel=label, ylabel="mean outward part (px)", ylim=(-reach, reach))
    above.legend(loc="lower left", ncols=3)
    return png_of(figure)


@figure_style()
def _plot_coverage(judged: Judgement) -> bytes:
    """Number of points over each frame."""
    figure, grid = _frames(judged)
    largest = max(int(c.coverage.max()) for c in judged.cameras.values())
    for axes, (name, camera) in zip(grid, judged.cameras.items(), strict=True):
        model = judged.calibration.rig.cameras[name]
        image = axes.imshow(
            np.ma.masked_equal(camera.coverage, 0),
            extent=(0, model.width_px, model.height_px, 0),
            cmap=_SEQUENTIAL,
            vmin=0,
            vmax=largest,
            interpolation="nearest",
        )
        axes.set_facecolor("#f1ece6")
        axes.plot(*camera.seen.pixels.T, ".", ms=1.3, color=INK, alpha=0.45)
    colour_bar(image, grid, "points in a cell")
    return png_of(figure)


def _frames(judged: Judgement) -> tuple[Sheet, list[Axes]]:
    """A figure with the frames of all cameras next to each other, y down."""
    cameras = judged.calibration.rig.cameras
    wide = _WIDTH_IN / max(len(cameras), 1.35)
    tallest = max(camera.height_px / camera.width_px for camera in cameras.values())
    figure = new_figure(min(tallest * wide * 0.82, 6.0) + 0.75, _WIDTH_IN)
    grid = list(figure.subplots(1, len(cameras), squeeze=False)[0])
    for c, (axes, (name, model)) in enumerate(zip(grid, cameras.items(), strict=True)):
        axes.set_title(plain_name(name), color=_colour(c))
        axes.set(xlim=(0, model.width_px), ylim=(model.height_px, 0), aspect="equal")
        axes.set(xlabel="x (px)", ylabel="" if c else "y (px)")
        axes.grid(visible=False)
        for spine in axes.spines.values():
            spine.set_visible(True)
    return figure, grid


def _colour(index: int) -> str:
    """Colour of a camera by its place in the rig."""
    return INKS[index % len(INKS)]
