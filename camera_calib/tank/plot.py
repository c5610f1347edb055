"""One figure of a tank: its points from two sides, and how far the rays miss each other."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from alice_survey.base.frames import Array
from camera_calib.tank.adjust import Tank
from camera_calib.tank.files import Detections
from camera_calib.triangulate import Triangulation

_COLOURS = ("#1b4f72", "#c8553d", "#1e8449", "#6c3483", "#b7950b", "#566573")
_MOST_THINGS = 6
_AXES = "xyz"
_BEYOND = 0.15
"""How much of the tank's size is shown around it."""


def draw_tank(path: Path, tank: Tank, detections: Detections, found: Triangulation) -> None:
    """Draw the points seen along two axes of the world, and histograms of their errors.

    Args:
        path: ends in .png; the same input gives the same bytes.
        tank: the cameras.
        detections: what they saw.
        found: where that is.
    """
    corners = [camera.reference.points_world for camera in tank.cameras]
    everything = np.concatenate(corners)
    low, high = everything.min(axis=0), everything.max(axis=0)
    figure = Figure(figsize=(13.0, 9.0), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(2, 2)
    for axes in panels.flat:
        axes.grid(visible=True, color="#d5d8dc", lw=0.6)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    pairs = _two_views(high - low)
    for axes, (across, up) in zip(panels[:, 0], pairs, strict=True):
        _points(axes, found.points_world, detections.ids, across, up)
        _outlines(axes, tank, across, up)
        margin = _BEYOND * float((high - low).max())
        axes.set_xlim(1e3 * (low[across] - margin), 1e3 * (high[across] + margin))
        axes.set_ylim(1e3 * (low[up] - margin), 1e3 * (high[up] + margin))
        axes.set_aspect("equal")
        axes.set_xlabel(f"{_AXES[across]}, mm")
        axes.set_ylabel(f"{_AXES[up]}, mm")
        axes.set_title(f"points along {_AXES[3 - across - up]}", loc="left", fontsize=11)
    panels[0, 0].legend(loc="lower center", ncols=4, fontsize=8, markerscale=4, framealpha=0.9)
    names = [camera.name for camera in tank.cameras]
    _histogram(panels[0, 1], found)
    _directions(panels[1, 1], names, found.residuals_px)
    solved = int(np.isfinite(found.points_world).all(axis=1).sum())
    figure.suptitle(f"{solved} points in the water, {len(names)} cameras", fontsize=13)
    figure.savefig(path, dpi=110, metadata={"Software": None})


def _two_views(extent: Array) -> list[tuple[int, int]]:
    """The world's widest axis against each of the others."""
    widest = int(np.argmax(extent))
    return [(widest, other) for other in range(3) if other != widest]


def _points(axes: Axes, points: Array, ids: NDArray[np.int64], across: int, up: int) -> None:
    things = np.unique(ids)
    for i, thing in enumerate(things[:_MOST_THINGS]):
        chosen = points[ids == thing]
        label, colour = f"id {thing}", _COLOURS[i]
        axes.plot(1e3 * chosen[:, across], 1e3 * chosen[:, up], ".", ms=1.5, c=colour, label=label)
    rest = points[~np.isin(ids, things[:_MOST_THINGS])]
    if len(rest):
        label = f"{len(things) - _MOST_THINGS} more"
        axes.plot(1e3 * rest[:, across], 1e3 * rest[:, up], ".", ms=1.5, c="#95a5a6", label=label)


def _outlines(axes: Axes, tank: Tank, across: int, up: int) -> None:
    for i, camera in enumerate(tank.cameras):
        ring = 1e3 * _ordered(camera.reference.points_world, camera.plane.normal_world)
        closed = np.concatenate([ring, ring[:1]])
        axes.plot(
            closed[:, across],
            closed[:, up],
            c="#17202a",
            ls=("-", "--", ":", "-.")[i % 4],
            lw=1.3,
            label=f"interface of {camera.name}",
        )


def _ordered(points: Array, normal: Array) -> Array:
    """Points of a plane in the order of their direction from its middle."""
    offsets = points - points.mean(axis=0)
    first = offsets[0] / np.linalg.norm(offsets[0])
    second = np.cross(normal, first)
    ordered: Array = points[np.argsort(np.arctan2(offsets @ second, offsets @ first))]
    return ordered


def _histogram(axes: Axes, found: Triangulation) -> None:
    """Of the summed errors, on a scale of ratios since few are very large."""
    sums = [
        np.linalg.norm(residuals, axis=-1).sum(axis=0)
        for residuals in (found.nearest_residuals_px, found.residuals_px)
    ]
    sums = [values[np.isfinite(values) & (values > 0)] for values in sums]
    whole = np.concatenate(sums)
    bins = np.geomspace(max(whole.min(), 1e-2), max(whole.max(), 1.0), 60)
    names = ("midpoint of the rays", "least squares")
    styles = (("#c8553d", "--"), ("#1b4f72", "-"))
    for values, name, (colour, style) in zip(sums, names, styles, strict=True):
        middle = float(np.median(values))
        label = f"{name}: median {middle:.2f} px"
        axes.hist(values, bins, histtype="step", color=colour, ls=style, lw=1.5, label=label)
        axes.axvline(middle, color=colour, ls=style, lw=0.9)
    axes.set_xscale("log")
    axes.set_xlabel("sum of the cameras' reprojection errors, px")
    axes.set_ylabel("detections")
    axes.legend(loc="upper left", fontsize=8, framealpha=0.9)
    axes.set_title("how far the rays miss each other", loc="left", fontsize=11)


def _directions(axes: Axes, names: Sequence[str], residuals_px: Array) -> None:
    """Residuals in the picture: which way a camera's rays miss."""
    finite = np.abs(residuals_px[np.isfinite(residuals_px)])
    reach = float(np.percentile(finite, 97.0))
    for i, name in enumerate(names):
        x, y = residuals_px[i].T
        colour = _COLOURS[i % len(_COLOURS)]
        axes.plot(x, y, ".", ms=1.5, c=colour, alpha=0.5, label=name)
    axes.set_xlim(-reach, reach)
    axes.set_ylim(reach, -reach)
    axes.set_aspect("equal")
    axes.set_xlabel("right, px")
    axes.set_ylabel("down, px")
    axes.legend(loc="upper right", fontsize=8, markerscale=4, framealpha=0.9)
    axes.set_title("residuals, projected less measured", loc="left", fontsize=11)
