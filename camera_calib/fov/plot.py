"""One figure of what lenses see through a flat port: four panels."""

from collections.abc import Callable, Sequence
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
from camera_calib.fov.table import FovRow

FovTable = Callable[[Sequence[float], float], list[FovRow]]
"""Rows of all lenses at altitudes, for a blur circle that counts as sharp, px."""
_ByLens = dict[float, list[FovRow]]

_STYLES = ("-", "--", ":", "-.")
_CURVE_POINTS = 30
_COC_PX = 1.0, 3.0
_PANELS = (
    ("Footprint", "m", {"horizontal_m": "wide", "vertical_m": "high"}, ("horizontal", "vertical")),
    ("Pixel on the sea floor", "mm", {"pixel_centre_mm": "centre", "pixel_corner_mm": "corner"},
     ("pixel",)),
)  # fmt: skip
"""Title, unit, fields with their names in the legend, and the paper's quantities."""


@figure_style()
def draw_fov(
    path: Path,
    table: FovTable,
    altitudes_m: Sequence[float],
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
        speeds_mps: speeds of the blur curves.
        exposures_s: exposures of interest; marked.
        allowed_px: blur that is allowed; marked.
        paper: mark what the paper's table prints; its sensor is drawn.

    Raises:
        ConfigError: another suffix, or the file cannot be written.
    """
    check_figure_path(path)
    marked = _by_lens(table(altitudes_m, _COC_PX[0]))
    low, high = 0.25 * min(altitudes_m), 1.5 * max(altitudes_m)
    heights = np.linspace(max(low, 0.01), high, _CURVE_POINTS).tolist()
    sharp, soft = (_by_lens(table(heights, coc_px)) for coc_px in _COC_PX)

    figure = new_figure(9.4, 10.4)
    panels = figure.subplots(2, 2)
    for axes, (title, unit, fields, quantities) in zip(panels[0], _PANELS, strict=True):
        for i, (lens_mm, rows) in enumerate(sharp.items()):
            for style, (field, label) in zip(_STYLES, fields.items(), strict=False):
                axes.plot(heights, _values(rows, field), style, color=_colour(i),
                          label=f"{lens_mm:.4g} mm {label}")  # fmt: skip
                axes.plot(altitudes_m, _values(marked[lens_mm], field), "o", ms=4, color=_colour(i))
        printed = [
            float(value) for lens_mm, quantity, _, value in PAPER_TABLE
            if paper and quantity in quantities and lens_mm in sharp
        ]  # fmt: skip
        if printed:
            axes.plot([2.0] * len(printed), printed, "kx", ms=7, mew=1.6, label="paper", zorder=5)
        axes.set(title=title, ylabel=unit, xlabel="altitude of the outer glass, m")
        axes.set_xlim(left=0)
        axes.set_ylim(bottom=0)
        axes.legend(fontsize=9)
    _depth_of_field(panels[1, 0], sharp, soft)
    _blur(panels[1, 1], marked, speeds_mps, exposures_s, allowed_px)
    first = next(iter(marked.values()))[0]
    figure.suptitle(
        f"Through a flat port: n {first.n_water:.4g}, {first.port} before the pupil", fontsize=13
    )
    save_figure(figure, path, dpi=120)


def _by_lens(rows: Sequence[FovRow]) -> _ByLens:
    lenses: _ByLens = {}
    for row in rows:
        lenses.setdefault(round(row.lens_mm, 6), []).append(row)
    return lenses


def _colour(i: int) -> str:
    return INKS[i % len(INKS)]


def _values(rows: Sequence[FovRow], field: str) -> list[float]:
    return [getattr(row, field) for row in rows]


def _depth_of_field(axes: Axes, sharp: _ByLens, soft: _ByLens) -> None:
    first = next(iter(sharp.values()))
    altitude = _values(first, "altitude_m")
    top = 2.0 * max(altitude)
    for i, (lens_mm, rows) in enumerate(sharp.items()):
        for band, style in ((soft[lens_mm], "--"), (rows, "-")):
            near = _values(band, "near_altitude_m")
            far = np.minimum(_values(band, "far_altitude_m"), 2 * top)
            label = f"{lens_mm:.4g} mm, {band[0].coc_px:g} px"
            axes.plot(altitude, near, style, color=_colour(i), lw=1.2, label=label)
            axes.plot(altitude, far, style, color=_colour(i), lw=1.2)
            if band is rows:
                axes.fill_between(altitude, near, far, color=_colour(i), alpha=0.22, lw=0)
    axes.plot(altitude, altitude, color="black", lw=0.9, ls=":", label="the sea floor")
    axes.set_title(f"Depth of field at the centre, F/{first[0].f_number:g},\n"
                   "focused on the sea floor")  # fmt: skip
    axes.set(xlabel="altitude of the outer glass, m", ylabel="altitudes that are sharp, m")
    axes.set(xlim=(0, max(altitude)), ylim=(0, top))
    axes.legend(facecolor="white", edgecolor="none", framealpha=0.8, fontsize=9, loc="upper left")


def _blur(
    axes: Axes,
    marked: _ByLens,
    speeds_mps: Sequence[float],
    exposures_s: Sequence[float],
    allowed_px: float,
) -> None:
    ends_ms = 1e3 * np.array([0.2 * min(exposures_s), 5.0 * max(exposures_s)])
    at_ms = 1e3 * np.asarray(exposures_s)
    for i, (lens_mm, rows) in enumerate(marked.items()):
        for k, speed in enumerate(speeds_mps):
            per_ms = speed / rows[0].pixel_centre_mm
            axes.loglog(ends_ms, per_ms * ends_ms, _STYLES[k % len(_STYLES)], color=_colour(i),
                        label=f"{lens_mm:.4g} mm, {speed:g} m/s")  # fmt: skip
            axes.plot(at_ms, per_ms * at_ms, "o", ms=4, color=_colour(i))
    axes.axhline(allowed_px, color="black", lw=0.9, ls="--", label=f"{allowed_px:g} px")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")
    altitude = next(iter(marked.values()))[0].altitude_m
    axes.set(title=f"Motion blur at {altitude:g} m altitude", xlabel="exposure, ms", ylabel="px")
    axes.set_xlim(*ends_ms)
    axes.legend(fontsize=9)
