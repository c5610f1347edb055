"""Parts that several figures of a calibration report share."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from alice_survey.base.frames import Array
from alice_survey.kit.figure import (
    INK,
    INKS,
    Axes,
    BoundaryNorm,
    LinearSegmentedColormap,
    MaxNLocator,
    Sheet,
    colour_bar,
    figure_style,
    new_figure,
    plain_name,
    png_of,
)
from camera_calib.judge.fit_quality import Profile
from camera_calib.judge.judgement import Judgement

SEQUENTIAL = LinearSegmentedColormap.from_list(
    "depth", ["#f4f9fb", "#bcdcea", "#6fb1d1", "#2f7fb0", "#15507f", "#0b2545"]
)
DIVERGING = LinearSegmentedColormap.from_list(
    "opposed", ["#a63c1f", "#e39b7b", "#fbfbfb", "#86b7d6", "#14548a"]
)
WIDTH_IN = 10.4
_MOST_LABELS = 45
_WIDE = 5.0
"""Ratio of largest to least value from which levels are logarithmic."""
_FINE, _COARSE, _DECADES = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0), (1.0, 2.0, 5.0), (1.0, 3.0)
_MOST_LEVELS = 11


def png(height_in: float, draw: Callable[[Sheet], None], width_in: float = WIDTH_IN) -> bytes:
    """Draw a figure and return its file; the bytes depend on the numbers only."""
    with figure_style():
        sheet = new_figure(height_in, width_in)
        draw(sheet)
        return png_of(sheet)


def colour(index: int) -> str:
    """Colour of a camera by its place in the rig."""
    return INKS[index % len(INKS)]


def axes_grid(figure: Sheet, count: int, rows: int = 1) -> list[list[Axes]]:
    """Axes by row and column."""
    grid = figure.subplots(rows, count, squeeze=False)
    return [list(row) for row in grid]


def draw_frame(axes: Axes, judged: Judgement, camera: str) -> None:
    """The camera's frame, y down."""
    model = judged.calibration.rig.cameras[camera]
    axes.set(xlim=(0, model.width_px), ylim=(model.height_px, 0), aspect="equal")
    axes.grid(visible=False)
    axes.set_xlabel("x (px)")
    for spine in axes.spines.values():
        spine.set_visible(True)


def frame_height(judged: Judgement, rows: int = 1) -> float:
    """Height of a figure with one column per camera."""
    shapes = [c.height_px / c.width_px for c in judged.calibration.rig.cameras.values()]
    wide = WIDTH_IN / max(len(shapes), 1.35)
    return rows * (min(max(shapes) * wide * 0.82, 6.0) + 0.75)


def short(name: str, most: int = 18) -> str:
    """The end of a long name."""
    return name if len(name) <= most else f"...{name[3 - most :]}"


def draw_profile(above: Axes, below: Axes, found: Profile, index: int, name: str) -> None:
    """A camera's binned residuals, with twice the sigma of each bin as an error bar."""
    count = np.maximum(found.count, 1)
    style: dict[str, Any] = {
        "color": colour(index),
        "marker": "o",
        "ms": 4,
        "lw": 1.3,
        "elinewidth": 1.0,
        "capsize": 2,
        "label": plain_name(name),
    }
    shift = 0.12 * (found.edges[1] - found.edges[0]) * index
    at = found.centres + shift
    above.errorbar(at, found.rms_px, found.expected_px / np.sqrt(count), **style)
    below.errorbar(at, found.outward_px, 2 * found.expected_px / np.sqrt(count), **style)
    above.set_xlim(0, found.edges[-1])
    below.set_xlim(0, found.edges[-1])


def finish_profile(above: Axes, below: Axes, label: str, noise: float) -> None:
    """Limits, labels and the zero line of a pair of profile axes."""
    above.set(ylabel="rms of one coordinate (px)")
    above.set_ylim(0, max(above.get_ylim()[1], 1.6 * noise))
    below.axhline(0, color=INK, lw=1.0, ls="--")
    reach = max(np.abs(below.get_ylim()).max(), 0.5 * noise)
    below.set(ylim=(-reach, reach), xlabel=label, ylabel="mean part outward (px)")
    above.legend(loc="lower left", ncols=3)


def shared_levels(maps: Sequence[Array]) -> Array:
    """About ten round levels for maps together: evenly spaced, or by factors where values differ.

    Factors show the middle of a frame as well as its corners, where an uncertainty may be a hundred
    times larger.
    """
    known = np.concatenate([values[np.isfinite(values)] for values in maps])
    known = known[known > 0]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    if not len(known) or high < _WIDE * low:
        even = MaxNLocator(9).tick_values(low, max(high, low + 1e-9))
        return np.asarray(even, dtype=np.float64)
    low = max(low, float(np.quantile(known, 0.02)))
    for steps in (_FINE, _COARSE, _DECADES):
        decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
        series = np.array([step * 10.0**d for d in decades for step in steps])
        first = max(int(np.searchsorted(series, low, side="right")) - 1, 0)
        levels = series[first : int(np.searchsorted(series, high)) + 1]
        if len(levels) <= _MOST_LEVELS:
            break
    return np.asarray(levels, dtype=np.float64)


def banded(levels: Array) -> dict[str, Any]:
    """Arguments of a filled contour whose bands have evenly spaced colours."""
    return {
        "levels": levels,
        "cmap": SEQUENTIAL,
        "norm": BoundaryNorm(levels.tolist(), SEQUENTIAL.N),
        "extend": "min",
    }


def level_bar(image: Any, axes: Axes | list[Axes], levels: Array, text: str) -> None:
    """A colour bar that names every level."""
    bar = colour_bar(image, axes, text, spacing="uniform")
    bar.set_ticks(levels.tolist(), labels=[f"{level:.4g}" for level in levels])
    bar.minorticks_off()


def draw_map(axes: Axes, judged: Judgement, name: str, values: Array, levels: Array) -> Any:
    """A filled map over a frame, with contour lines that carry their numbers."""
    pixels = judged.cameras[name].map_pixels
    x, y = pixels[0, :, 0], pixels[:, 0, 1]
    shown = np.ma.masked_invalid(values)
    image = axes.contourf(x, y, shown, **banded(levels))
    lines = axes.contour(x, y, shown, levels=levels[1:-1], colors="white", linewidths=0.7)
    middle = float(levels[len(levels) // 2])
    for label in axes.clabel(lines, levels[1:-1:2], fmt="%g", fontsize=7.5):
        label.set_color("white" if float(label.get_text()) >= middle else INK)
    axes.set_facecolor("#d9d9d9")
    draw_frame(axes, judged, name)
    return image


def label_views(axes: Axes, names: list[str]) -> None:
    """Ticks with the names of views, as many as there is room for."""
    shown = range(0, len(names), -(-len(names) // _MOST_LABELS))
    long = max(len(name) for name in names) > 4
    axes.set_xticks(
        list(shown),
        [plain_name(short(names[i])) for i in shown],
        rotation=60 if long else 0,
        ha="right" if long else "center",
        rotation_mode="anchor",
    )
