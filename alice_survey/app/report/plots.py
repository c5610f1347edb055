"""Plots of a report: readable in print and by the colour-blind, each with an explanation."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from rasterio.enums import Resampling

from alice_survey.app.report.colours import read_shrunk
from alice_survey.app.report.figures import Figures
from alice_survey.app.report.held import Held, number
from alice_survey.core.frames import Array
from alice_survey.kit.document import Figure
from alice_survey.kit.figure import INKS, MARKS, colour_bar, drawn
from alice_survey.kit.words import digits, length, share
from camera_calib.judge.mount_figure import paint_mount
from camera_calib.mount import mount_line
from camera_calib.rig import Rig


def camera_sigmas(figures: Figures) -> Figure | None:
    """Stated sigmas of the cameras along the survey, and their true errors where known."""
    rows = [r for r in figures.held.track if number(r, "sigma_north_m") > 0]
    if not rows:
        return None
    order = np.array([number(row, "station") for row in rows])
    where = "in the survey" if figures.held.frame.datum is None else "on the Earth"
    misses = {r["image"]: r for r in figures.held.rows("evaluation/cameras.csv")}

    def paint(axes: Sequence[Any]) -> None:
        for axis, ink, mark in zip(("north", "east", "depth"), INKS, MARKS, strict=False):
            sigma = [1e2 * number(row, f"sigma_{axis}_m") for row in rows]
            axes[0].plot(order, sigma, mark, ms=3, color=ink, label=axis)
        axes[0].set(xlabel="station", ylabel=f"sigma {where}, cm", ylim=(0, None))
        axes[0].legend()
        if misses:
            for axis, ink, mark in zip(("north", "east", "down"), INKS, MARKS, strict=False):
                known = [(o, misses[r["image"]]) for o, r in zip(order, rows, strict=True)
                         if r["image"] in misses]  # fmt: skip
                axes[1].plot(
                    [o for o, _ in known],
                    [1e3 * number(row, f"{axis}_error_m") for _, row in known],
                    mark, ms=3, color=ink, label=axis,
                )  # fmt: skip
            axes[1].set(xlabel="station", ylabel="error within the survey, mm")
            axes[1].legend()

    return drawn(
        paint, 2.9, columns=2 if misses else 1,
        title="How well each camera is placed",
        alt="Standard deviations of camera positions by station"
        + (", and their errors against the truth" if misses else ""),
        shows="The model's own standard deviation of every camera, by station. What all cameras "
        "share is navigation's error of the whole survey."
        + (" Right: errors after one rigid alignment: what bends the model." if misses else ""),
        good="No station stands out; errors scatter about zero without a trend.",
        otherwise="A rise at the ends of lines asks for a line across them; a single station that "
        "stands out has too few points (see the next plot).",
    )  # fmt: skip


def pictures_used(figures: Figures) -> Figure | None:
    """Points and reprojection error of each picture."""
    rows = figures.held.track
    if not rows:
        return None
    points = np.array([number(row, "points") for row in rows])
    error = np.array([number(row, "reprojection_px") for row in rows])

    station = np.array([number(row, "station") for row in rows])
    camera = np.array([row["camera"] for row in rows])
    names = list(dict.fromkeys(camera.tolist()))
    inks = [INKS[i % len(INKS)] for i in range(len(names))]

    def paint(axes: Sequence[Any]) -> None:
        for i, (name, ink) in enumerate(zip(names, inks, strict=True)):
            own = camera == name
            mark = MARKS[i % len(MARKS)]
            axes[0].plot(station[own], points[own], mark, ms=3, color=ink, label=name)
        axes[0].set(xlabel="station", ylabel="points of the model", ylim=(0, None))
        if len(names) > 1:
            axes[0].legend()
        axes[1].hist(
            [error[camera == name] for name in names], bins=30, color=inks, stacked=True,
            edgecolor="white", linewidth=0.4,
        )  # fmt: skip
        axes[1].set(xlabel="mean reprojection error, px", ylabel="pictures")

    return drawn(
        paint,
        2.6,
        columns=2,
        title="What each picture gives to the model",
        alt="Points by picture, and a histogram of reprojection errors",
        shows=f"Points that each picture shares with others (median {np.median(points):.0f}), and "
        f"how far they miss ({digits(float(np.median(error)), 2)} px median).",
        good="Hundreds of points everywhere, and errors well below one pixel.",
        otherwise="Few points: dark, blurred or without overlap; see the list of pictures. Large "
        "errors in all: the calibration does not fit.",
    )


def heights(figures: Figures) -> Figure | None:
    """Stated sigmas of the heights."""
    values = sampled(figures.held, "dense/sigma.tif")
    if values is None or not len(values):
        return None
    unit = figures.held.unit
    factor, label = (1e3, "mm") if unit == "m" else (1.0, unit)

    def paint(axes: Sequence[Any]) -> None:
        shown = factor * values
        maximum = float(np.percentile(shown, 99))
        axes[0].hist(shown, bins=60, range=(0, maximum), color=INKS[0])
        axes[0].axvline(float(np.median(shown)), color=INKS[1], label="median")
        axes[0].set(xlabel=f"stated sigma of a height, {label}", ylabel="cells", yticks=[])
        axes[0].legend()

    return drawn(
        paint,
        2.3,
        title="How well heights are known",
        alt="Histogram of the standard deviations of heights",
        shows="The survey's own estimate for its heights, cell by cell: matching, geometry, and "
        f"the cameras' own uncertainty. The median is {length(float(np.median(values)), unit)}.",
        good="The median is below the mosaic's pixel.",
        otherwise="See the map of sigmas for where: low overlap, steep rocks, dark places.",
    )


def sigma_test(figures: Figures) -> Figure | None:
    """True errors of the heights over their stated sigmas; None where no truth is known."""
    errors = paired(figures.held, "evaluation/error.tif", "dense/sigma.tif")
    if errors is None:
        return None
    ratio = errors[0] / errors[1]

    def paint(axes: Sequence[Any]) -> None:
        grid = np.linspace(-4, 4, 161)
        axes[0].hist(ratio, bins=81, range=(-4, 4), density=True, color=INKS[0], label="found")
        normal = np.exp(-(grid**2) / 2) / np.sqrt(2 * np.pi)
        axes[0].plot(grid, normal, color=INKS[1], label="as stated")
        axes[0].set(xlabel="error over its stated sigma", ylabel="share", yticks=[])
        axes[0].legend()

    return drawn(
        paint,
        2.3,
        title="Test of the stated sigmas",
        alt="Histogram of errors of heights over their stated sigmas, next to the normal curve",
        shows="The true errors of the heights in units of their stated sigmas. "
        f"{ratio_words(ratio)}",
        good="The bars follow the line, with a median of 0 and 1 rms.",
        otherwise="Bars wider than the line: multiply the sigmas by the rms. A median off zero: "
        "neighbouring heights share an error, such as of one camera's position.",
    )


_MAX_SHIFT, _MIN_SPREAD, _MAX_SPREAD = 0.25, 0.8, 1.25


def ratio_words(ratio: Array) -> str:
    """How errors over their stated sigmas compare with a standard normal distribution.

    Args:
        ratio: (N,) errors over sigmas.
    """
    middle = float(np.median(ratio))
    spread = 1.4826 * float(np.median(np.abs(ratio - middle)))
    found = []
    if abs(middle) > _MAX_SHIFT:
        found.append(f"shifted by {middle:+.2f} sigma")
    if not _MIN_SPREAD <= spread <= _MAX_SPREAD:
        than = "wider" if spread > 1 else "narrower"
        found.append(f"{than} than stated ({spread:.2f} sigma, one expected)")
    within = [share(float((np.abs(ratio) <= sigmas).mean())) for sigmas in (1, 2)]
    return (
        f"They are {' and '.join(found) if found else 'as stated'}: median {middle:+.2f}, "
        f"{float(np.sqrt((ratio**2).mean())):.2f} rms; {within[0]} lie within one sigma (68 % "
        f"expected) and {within[1]} within two (95 %)."
    )


def seen_by(figures: Figures) -> Figure | None:
    """How many stations see the cells."""
    values = sampled(figures.held, "dense/stations.tif", counts=True)
    if values is None or not len(values):
        return None
    maximum = int(np.percentile(values, 99.5))
    counts = np.bincount(np.minimum(values.astype(np.int64), maximum), minlength=maximum + 1)
    percent = 100 * counts / len(values)

    def paint(axes: Sequence[Any]) -> None:
        inks = [INKS[1] if n < 3 else INKS[0] for n in range(1, maximum + 1)]
        axes[0].bar(range(1, maximum + 1), percent[1:], color=inks)
        axes[0].set(xlabel="stations that see a spot", ylabel="% of the surface")

    return drawn(
        paint,
        2.3,
        title="Overlap reached",
        alt="Share of the surface by the number of stations that see it",
        shows=f"Share of the surface by the number of stations that see it; "
        f"{percent[3:].sum():.1f} % is seen by three and more.",
        good="Hardly anything below three (orange), where heights do not check one another.",
        otherwise="Plan more forward or side overlap.",
    )


def stage_times(figures: Figures) -> Figure | None:
    """Time and memory of the stages."""
    stages = figures.held.stages
    if not stages:
        return None
    names = list(stages)[::-1]
    took = [stages[name].took_s for name in names]
    peaks = [stages[name].peak_mib or np.nan for name in names]
    known = bool(np.isfinite(peaks).any())

    def paint(axes: Sequence[Any]) -> None:
        axes[0].barh(names, took, color=INKS[0])
        axes[0].set(xlabel="time, s")
        if known:
            axes[1].barh(names, np.nan_to_num(peaks), color=INKS[2])
            axes[1].set(xlabel="largest memory, MiB", yticklabels=[])

    return drawn(
        paint,
        0.9 + 0.24 * len(stages),
        columns=2 if known else 1,
        title="Time and memory",
        alt="Time and memory of every stage",
        shows="What each step took on this machine.",
    )


def mount(rig: Rig) -> Figure:
    """A rig with a known mount on its vehicle."""

    def paint(axes: Sequence[Any]) -> None:
        paint_mount(axes[0], axes[1], rig)
        axes[1].legend()

    return drawn(
        paint,
        3.4,
        columns=2,
        title="How the cameras are mounted",
        alt="Cameras, their fields of view and the tops of their pictures on the vehicle",
        shows=f"Places and fields of view of the cameras: {mount_line(rig)}.",
        good="It looks as the vehicle does: bow, tops of the pictures, places of the cameras.",
        otherwise="Positions are off by the error of the lever, headings by that of the mount: "
        "state it with 'alice-survey camera mount'.",
    )


def correlations(names: Sequence[str], matrix: Array) -> Figure:
    """Correlations of the rig's parameters."""

    def paint(axes: Sequence[Any]) -> None:
        picture = axes[0].imshow(matrix, cmap="PuOr", vmin=-1, vmax=1)
        axes[0].set_xticks(range(len(names)), names, rotation=90, fontsize=6)
        axes[0].set_yticks(range(len(names)), names, fontsize=6)
        axes[0].grid(visible=False)
        colour_bar(picture, axes[0], "correlation")

    pairs = np.abs(np.triu(matrix, 1))
    i, j = (int(n) for n in np.unravel_index(int(pairs.argmax()), pairs.shape))
    return drawn(
        paint,
        5.6,
        title="Which parameters go together",
        alt="Matrix of correlations of the rig's parameters",
        shows=f"Correlations of what was estimated; the strongest is {matrix[i, j]:+.3f}, of "
        f"{names[i]} with {names[j]}.",
        good="Pale off the diagonal.",
        otherwise="Dark pairs are known together, not one by one: no harm to the surface, but do "
        "not read their values alone.",
    )


_SAMPLES = 400_000


def sampled(held: Held, path: str, *, counts: bool = False) -> Array | None:
    """Known values of a raster, evenly thinned; None where there is no raster."""
    found = _read(held, path)
    if found is None:
        return None
    values = found.ravel()
    values = values[values > 0] if counts else values[np.isfinite(values)]
    thinned: Array = values[:: max(1, len(values) // _SAMPLES)]
    return thinned


def paired(held: Held, first: str, second: str) -> tuple[Array, Array] | None:
    """Values of two rasters where both are known, thinned the same way."""
    a, b = _read(held, first), _read(held, second)
    if a is None or b is None or a.shape != b.shape:
        return None
    known = np.flatnonzero(np.isfinite(a).ravel() & (b > 0).ravel())
    known = known[:: max(1, len(known) // _SAMPLES)]
    return (a.ravel()[known], b.ravel()[known]) if len(known) else None


def _read(held: Held, path: str) -> Array | None:
    """A raster, thinned so that the largest fits."""
    file = held.file(path)
    if file is None:
        return None
    (values,), _, _ = read_shrunk(file, [1], 4e6, Resampling.nearest)
    whole: Array = np.ma.getdata(values).astype(np.float64)
    return whole
