"""A picture of how a survey differs from a reference."""

from pathlib import Path

import numpy as np

from alice_survey.base.frames import Array
from alice_survey.kit.figure import colour_bar, figure_style, map_axes, new_figure, save_figure
from reconstruct.evaluate.cloud_registration import CloudDistances

_CELLS = 320
"""Cells of the map along its longer side."""


@figure_style()
def plot_reference(path: Path, ours: CloudDistances, back: CloudDistances, pixel_m: float) -> None:
    """Map of the survey's signed distance from the reference, and both cumulative shares."""
    limit = max(float(np.percentile(np.abs(ours.signed_m), 95)), 1e-9)
    values, extent = mean_map(ours.points[:, :2], ours.signed_m, _CELLS)
    figure = new_figure(5.6, 13)
    plane, curve = figure.subplots(1, 2, width_ratios=[1.3, 1])
    plane.set_facecolor("0.85")
    image = plane.imshow(
        values, extent=extent, vmin=-limit, vmax=limit, cmap="RdBu_r", interpolation="nearest"
    )
    plane.grid(visible=False)
    plane.set_title("Survey minus reference")
    colour_bar(image, plane, "survey above reference (m)")
    map_axes(plane)
    for one, name in ((ours, "survey to reference"), (back, "reference to survey")):
        away = np.sort(np.abs(one.signed_m))[:: max(1, len(one.signed_m) // 2000)]
        curve.plot(away / pixel_m, np.linspace(0, 1, len(away)), label=name)
    curve.axvline(2, color="0.6", linestyle=":", label="2 ground pixels")
    curve.set(xlim=(0, max(6.0, 2 * limit / pixel_m)), ylim=(0, 1))
    curve.set(xlabel="distance (ground pixels)", ylabel="share of points below")
    curve.set_title(
        f"median {np.median(np.abs(ours.signed_m)):.3g} m, ground pixel {pixel_m:.3g} m"
    )
    curve.legend(loc="lower right")
    save_figure(figure, path)


def mean_map(
    places_en: Array, values: Array, cells: int
) -> tuple[Array, tuple[float, float, float, float]]:
    """Means of values at (N, 2) places on a grid, rows from north; and its extent for a plot."""
    low, high = places_en.min(axis=0), places_en.max(axis=0)
    side = max(float((high - low).max()) / cells, 1e-12)
    column = ((places_en[:, 0] - low[0]) / side).astype(np.int64)
    row = ((high[1] - places_en[:, 1]) / side).astype(np.int64)
    shape = (int(row.max()) + 1, int(column.max()) + 1)
    place = row * shape[1] + column
    count = np.bincount(place, minlength=shape[0] * shape[1])
    total = np.bincount(place, values, minlength=shape[0] * shape[1])
    mean = np.where(count > 0, total / np.maximum(count, 1), np.nan).reshape(shape)
    west, north = float(low[0]), float(high[1])
    return mean, (west, west + shape[1] * side, north - shape[0] * side, north)
