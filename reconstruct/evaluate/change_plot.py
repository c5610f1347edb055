"""A picture of what changed between two surveys."""

from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.base.frames import Array
from alice_survey.kit.figure import colour_bar, figure_style, map_axes, new_figure, save_figure
from reconstruct.evaluate.change import SIGNIFICANT, Change
from reconstruct.evaluate.elevation import Elevation
from reconstruct.raster import hillshade

_LONGEST = 1200
_LABELLED = 8


@figure_style()
def plot_change(path: Path, now: Elevation, change: Change) -> None:
    """Difference over the relief, places that changed, and the significance with its histogram."""
    step = max(1, max(now.height.shape) // _LONGEST)
    difference = 1e3 * change.difference[::step, ::step]
    ratio = change.significance[::step, ::step]
    shade = hillshade(now.height[::step, ::step], now.cell * step)
    rows, columns = now.height.shape
    extent = (now.west, now.west + columns * now.cell, now.north - rows * now.cell, now.north)
    known = np.isfinite(difference)
    limit = max(float(np.percentile(np.abs(difference[known]), 99.5)), 1e-6) if known.any() else 1.0
    figure = new_figure(5.2, 14)
    left, middle, right = figure.subplots(1, 3, width_ratios=[1.2, 1.2, 0.8])
    for axis, values, span, label, title in (
        (left, difference, limit, "mm", "Height now minus before"),
        (middle, ratio, 4.0, "standard deviations", "Significance"),
    ):
        axis.imshow(shade, extent=extent, cmap="gray", vmin=0, vmax=1.2)
        image = axis.imshow(
            values, extent=extent, cmap="RdBu_r", vmin=-span, vmax=span, alpha=_opacity(values),
            interpolation="nearest",
        )  # fmt: skip
        axis.grid(visible=False)
        axis.set_title(title)
        colour_bar(image, axis, label)
        map_axes(axis)
    changed = change.changed[::step, ::step]
    if changed.any():
        for axis in (left, middle):
            axis.contour(
                changed, levels=[0.5], colors="k", linewidths=0.8, extent=extent, origin="upper"
            )
    for region in change.regions[:_LABELLED]:
        left.annotate(
            f"{1e3 * region.volume_m3:+.2f}±{1e3 * region.sigma_m3:.2f} l",
            (region.east_m, region.north_m), ha="center", fontsize=7,
            bbox={"boxstyle": "round", "fc": "white", "alpha": 0.8, "lw": 0},
        )  # fmt: skip
    _histogram(right, change)
    save_figure(figure, path)


def _opacity(values: Array) -> Array:
    return np.where(np.isfinite(values), 0.75, 0.0)


def _histogram(axis: Any, change: Change) -> None:
    """Unchanged ground in standard deviations, and what chance would give."""
    stable = np.isfinite(change.difference) & ~change.changed
    ratio = change.significance[stable]
    edges = np.linspace(-6, 6, 97)
    axis.hist(np.clip(ratio, -6, 6), bins=edges, density=True, label="unchanged ground")
    axis.plot(edges, np.exp(-(edges**2) / 2) / np.sqrt(2 * np.pi), "k-", label="chance")
    for side in (-SIGNIFICANT, SIGNIFICANT):
        axis.axvline(side, color="0.5", linestyle=":")
    axis.set(xlabel="difference / sigma", ylabel="density", yscale="log", ylim=(1e-5, 2))
    axis.set_title(f"{np.mean(np.abs(ratio) > SIGNIFICANT):.1%} beyond {SIGNIFICANT} sigma")
    axis.legend(loc="upper right")
