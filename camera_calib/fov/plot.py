"""One figure of what lenses see through a flat port: four panels."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from alice_survey.kit.figure import (
    INKS,
    Axes,
    check_figure_path,
    figure_style,
    new_figure,
    save_figure,
)
from camera_calib.fov.paper import PAPER_TABLE
from camera_calib.fov.table import FovChoices, FovRow

FovTable = Callable[[Sequence[float], FovChoices], list[FovRow]]
"""Rows of all lenses at altitudes, lenses outside."""

_STYLES = ("-", "--", ":", "-.")
_CURVE_POINTS = 30


@figure_style()
def draw_fov(
    path: Path,
    table: FovTable,
    altitudes_m: Sequence[float],
    choices: FovChoices,
    *,
    speeds_mps: Sequence[float],
    exposures_s: Sequence[float],
    allowed_px: float,
    paper: bool,
) -> None:
    """Draw footprint, pixel, depth of field and motion blur.

    Args:
        path: ends in .png, .svg or .pdf; the same input gives the same bytes.
        table: rows of all lenses at given altitudes.
        altitudes_m: altitudes of interest; the curves go some way beyond them.
        choices: circle of confusion and focus.
        speeds_mps: speeds of the blur curves.
        exposures_s: exposures of interest; marked.
        allowed_px: blur that is allowed; marked.
        paper: mark what the paper's table prints; its sensor is drawn.

    Raises:
        ConfigError: another suffix, or the file cannot be written.
    """
    check_figure_path(path)
    marked = _by_lens(table(altitudes_m, choices))
    low, high = 0.25 * min(altitudes_m), 1.5 * max(altitudes_m)
    curve = np.linspace(max(low, 0.01), high, _CURVE_POINTS).tolist()
    curves = _by_lens(table(curve, choices))
    soft = _by_lens(table(curve, replace(choices, coc_px=3 * choices.coc_px)))

    figure = new_figure(9.4, 10.4)
    panels = figure.subplots(2, 2)
    for axes, title, unit, series, printed in (
        (panels[0, 0], "Footprint", "m", (("horizontal_m", "wide"), ("vertical_m", "high")),
         ("horizontal", "vertical")),
        (panels[0, 1], "Pixel on the sea floor", "mm",
         (("pixel_centre_mm", "centre"), ("pixel_corner_mm", "corner")), ("pixel",)),
    ):  # fmt: skip
        _curves(axes, curves, marked, series)
        if paper:
            _paper(axes, printed, curves)
        axes.set_title(title)
        axes.set_ylabel(unit)
        axes.legend(fontsize=9)
    _depth_of_field(panels[1, 0], curves, soft, choices)
    _blur(panels[1, 1], marked, speeds_mps, exposures_s, allowed_px)
    first = next(iter(marked.values()))[0]
    figure.suptitle(
        f"Through a flat port: n {first.n_water:.4g}, {first.port} before the pupil",
        fontsize=13,
    )
    save_figure(figure, path, dpi=120)


def _by_lens(rows: Sequence[FovRow]) -> dict[float, list[FovRow]]:
    lenses: dict[float, list[FovRow]] = {}
    for row in rows:
        lenses.setdefault(round(row.lens_mm, 6), []).append(row)
    return lenses


def _colour(i: int) -> str:
    return INKS[i % len(INKS)]


def _values(rows: Sequence[FovRow], name: str) -> list[float]:
    return [getattr(row, name) for row in rows]


def _curves(
    axes: Axes,
    curves: dict[float, list[FovRow]],
    marked: dict[float, list[FovRow]],
    series: Sequence[tuple[str, str]],
) -> None:
    """Fields of all lenses against altitude, each with a style of line; the marked ones as dots.

    Args:
        axes: where to draw.
        curves: rows by lens, along the altitude.
        marked: rows by lens, at altitudes of interest.
        series: name of the field, and what it is called in the legend.
    """
    for i, (lens, rows) in enumerate(curves.items()):
        for (name, called), style in zip(series, _STYLES, strict=False):
            axes.plot(
                _values(rows, "altitude_m"), _values(rows, name), style, color=_colour(i),
                label=f"{lens:.4g} mm {called}".rstrip(),
            )  # fmt: skip
            axes.plot(
                _values(marked[lens], "altitude_m"), _values(marked[lens], name),
                "o", ms=4, color=_colour(i),
            )  # fmt: skip
    axes.set_xlabel("altitude of the outer glass, m")
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=0)


def _paper(axes: Axes, quantities: Sequence[str], lenses: Collection[float]) -> None:
    printed = [
        float(value)
        for lens, quantity, _, value in PAPER_TABLE
        if quantity in quantities and lens in lenses
    ]
    if printed:
        axes.plot(
            [2.0] * len(printed), printed, "x", ms=7, mew=1.6, color="black", label="paper",
            zorder=5,
        )  # fmt: skip


def _depth_of_field(
    axes: Axes,
    curves: dict[float, list[FovRow]],
    soft: dict[float, list[FovRow]],
    choices: FovChoices,
) -> None:
    altitude = _values(next(iter(curves.values())), "altitude_m")
    top = 2.0 * max(altitude)
    for i, (lens, rows) in enumerate(curves.items()):
        for band, style in ((soft[lens], "--"), (rows, "-")):
            near = _values(band, "near_altitude_m")
            far = np.minimum(_values(band, "far_altitude_m"), 2 * top)
            label = f"{lens:.4g} mm, {band[0].coc_px:g} px"
            axes.plot(altitude, near, style, color=_colour(i), lw=1.2, label=label)
            axes.plot(altitude, far, style, color=_colour(i), lw=1.2)
            if band is rows:
                axes.fill_between(altitude, near, far, color=_colour(i), alpha=0.22, lw=0)
    axes.plot(altitude, altitude, color="black", lw=0.9, ls=":", label="the sea floor")
    where = (
        "focused on the sea floor"
        if choices.focus_air_m is None
        else f"focused at {choices.focus_air_m:g} m in air"
    )
    f_number = next(iter(curves.values()))[0].f_number
    axes.set_title(f"Depth of field at the centre, F/{f_number:g},\n{where}")
    axes.set_xlabel("altitude of the outer glass, m")
    axes.set_ylabel("altitudes that are sharp, m")
    axes.set_xlim(0, max(altitude))
    axes.set_ylim(0, top)
    axes.legend(facecolor="white", edgecolor="none", framealpha=0.8, fontsize=9, loc="upper left")


def _blur(
    axes: Axes,
    marked: dict[float, list[FovRow]],
    speeds_mps: Sequence[float],
    exposures_s: Sequence[float],
    allowed_px: float,
) -> None:
    low, high = 0.2 * min(exposures_s), 5.0 * max(exposures_s)
    exposure = np.geomspace(low, high, 2)
    altitude = next(iter(marked.values()))[0].altitude_m
    for i, (lens, rows) in enumerate(marked.items()):
        pixel_m = rows[0].pixel_centre_mm * 1e-3
        for k, speed in enumerate(speeds_mps):
            axes.loglog(
                exposure * 1e3, speed * exposure / pixel_m, _STYLES[k % len(_STYLES)],
                color=_colour(i), label=f"{lens:.4g} mm, {speed:g} m/s",
            )  # fmt: skip
            axes.plot(
                np.asarray(exposures_s) * 1e3, speed * np.asarray(exposures_s) / pixel_m, "o",
                ms=4, color=_colour(i),
            )  # fmt: skip
    axes.axhline(allowed_px, color="black", lw=0.9, ls="--")
    axes.annotate(
        f"{allowed_px:g} px", (high * 1e3, allowed_px), ha="right", va="bottom", fontsize=9,
        xytext=(-2, 2), textcoords="offset points",
    )  # fmt: skip
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")
    axes.set_title(f"Motion blur at {altitude:g} m altitude")
    axes.set_xlabel("exposure, ms")
    axes.set_ylabel("px")
    axes.set_xlim(low * 1e3, high * 1e3)
    axes.legend(fontsize=9)
