"""The figure of a predicted survey: heights over the area, and what dominates."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from alice_survey.kit.figure import (
    check_figure_path,
    colour_bar,
    figure_style,
    map_axes,
    new_figure,
    save_figure,
)
from missions.values.plan_file import Plan
from reconstruct.precision.predict import Precision

_MM = 1e3


def draw_precision(
    path: Path, plan: Plan, found: Precision, without: Mapping[str, Precision]
) -> None:
    """Draw the sigma of heights under the lines, and sigmas with one kind of error left out.

    Raises:
        ConfigError: the figure cannot be written.
    """
    check_figure_path(path)
    sheet = new_figure(4.6)
    with figure_style():
        left, right = sheet.subplots(1, 2, width_ratios=[3, 2])
        low = found.cells_ne.min(axis=0)
        rows, columns = np.rint((found.cells_ne - low) / found.cell_m).astype(int).T
        grid = np.full((rows.max() + 1, columns.max() + 1), np.nan)
        grid[rows, columns] = _MM * found.heights_m
        south, west = low - found.cell_m / 2
        extent = (west, west + found.cell_m * grid.shape[1], south,
                  south + found.cell_m * grid.shape[0])  # fmt: skip
        image = left.imshow(grid, origin="lower", extent=extent, cmap="viridis")
        for line in plan.lines:
            left.plot(*line.stations_ne.T[::-1], color="white", lw=0.6, alpha=0.7)
        colour_bar(image, left, "sigma of heights, mm")
        left.grid(False)
        map_axes(left)
        shown = {"all errors": found, **{f"without {name}": p for name, p in without.items()}}
        worst = [_MM * float(np.nanmax(p.bend_m)) for p in shown.values()]
        heights = [_MM * p.heights_rms_m for p in shown.values()]
        at = np.arange(len(shown))
        right.barh(at - 0.2, worst, 0.38, label="bend")
        right.barh(at + 0.2, heights, 0.38, label="heights")
        right.set_yticks(at, list(shown))
        right.invert_yaxis()
        right.set_xlabel("sigma, mm")
        right.legend()
    save_figure(sheet, path)
