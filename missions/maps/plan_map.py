"""The map of a plan."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Polygon as Outline

from camera_calib.rig import Rig
from missions.coverage.footprints import footprint_outline, footprints_ne
from missions.plan_file import Plan

_AREA, _SURVEY, _CROSS, _WAY = "#c8553d", "#1b4f72", "#6c3483", "#7f8c8d"
_FOOTPRINT, _PAPER = "#5dade2", "#fbfcfc"


def draw_plan(path: Path, plan: Plan, rig: Rig) -> None:
    """Draw area, lines, footprints and the way, east to the right, north up."""
    figure, axes = _sheet(plan)
    outline = footprint_outline(plan, rig)
    footprints = [shape[:, ::-1] for line in plan.lines for shape in footprints_ne(line, outline)]
    alpha = 0.16 if len(footprints) < 2000 else 0.06
    axes.add_collection(
        PolyCollection(footprints, facecolors=_FOOTPRINT, edgecolors="none", alpha=alpha, zorder=1)
    )
    _draw_area(axes, plan)
    route = plan.dives[0].route
    way = route.places(np.linspace(0.0, route.length_m, _points(route.length_m)))
    axes.plot(way[:, 1], way[:, 0], color=_WAY, lw=0.9, zorder=3, label="way between lines")
    for kind, colour in (("survey", _SURVEY), ("cross", _CROSS)):
        lines = [line for line in plan.lines if line.kind == kind]
        ends = [(line.start_ne_m[::-1], line.end_ne_m[::-1]) for line in lines]
        if ends:
            label = f"{len(ends)} {kind} line{'s' if len(ends) > 1 else ''}"
            axes.add_collection(
                LineCollection(ends, colors=colour, linewidths=1.6, zorder=4, label=label)
            )
            places = np.vstack([line.stations_ne for line in lines])
            size = 9.0 if len(footprints) < 300 else 3.0
            axes.scatter(places[:, 1], places[:, 0], s=size, color=colour, zorder=5, lw=0)
    for line in plan.lines:
        _arrow(axes, line.start_ne_m, line.heading_rad, line.length_m)
    start = way[0]
    axes.plot(start[1], start[0], "o", ms=9, mfc="#27ae60", mec="white", zorder=7, label="start")
    axes.plot(way[-1, 1], way[-1, 0], "s", ms=8, mfc="#c0392b", mec="white", zorder=7, label="end")
    handles, labels = axes.get_legend_handles_labels()
    footprint = Outline([(0, 0)], facecolor=_FOOTPRINT, alpha=0.5)
    figure.legend(
        [*handles, footprint],
        [*labels, "footprints (left camera)"],
        loc="lower center",
        ncol=4,
        frameon=False,
        fontsize=8,
    )
    around = np.vstack([way[:, ::-1], *footprints])
    _frame(axes, around)
    _furniture(axes, around)
    axes.set_title(plan.name, loc="left", fontsize=13, weight="bold")
    axes.set_title(_summary(plan), loc="right", fontsize=8, color="#444444")
    _save(figure, path)


def _summary(plan: Plan) -> str:
    minutes = plan.duration_s / 60
    return (
        f"{plan.stations} stations every {plan.interval_s:.2f} s, {plan.length_m:.0f} m, "
        f"{minutes:.0f} min at {plan.speed_mps:g} m/s\n"
        f"altitude {plan.altitude_m:g} m, overlap {plan.forward_overlap:.0%} forward, "
        f"{plan.side_overlap:.0%} side, lines {plan.line_spacing_m:.2f} m apart"
    )


def _sheet(plan: Plan) -> tuple[Figure, Axes]:
    layout = ConstrainedLayoutEngine(rect=(0, 0.07, 1, 0.9))
    figure = Figure(figsize=(8.5, 8.5), facecolor="white", layout=layout)
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set_facecolor(_PAPER)
    axes.set_aspect("equal")
    axes.grid(color="#e5e8e8", lw=0.6)
    axes.set_axisbelow(True)
    datum = plan.datum
    axes.set_xlabel(f"east of {abs(datum.longitude_deg):.6f}° {'EW'[datum.longitude_deg < 0]}, m")
    axes.set_ylabel(f"north of {abs(datum.latitude_deg):.6f}° {'NS'[datum.latitude_deg < 0]}, m")
    return figure, axes


def _draw_area(axes: Axes, plan: Plan) -> None:
    for index, ring in enumerate(plan.area.rings_ne):
        label = "area" if index == 0 else None
        axes.add_patch(
            Outline(
                ring[:, ::-1], fill=False, edgecolor=_AREA, lw=2, ls="--", zorder=6, label=label
            )
        )


def _arrow(axes: Axes, start_ne: tuple[float, float], heading_rad: float, length_m: float) -> None:
    """An arrow head at a third of a line, so that the direction of travel is seen."""
    ahead = np.array([math.sin(heading_rad), math.cos(heading_rad)])
    tip = np.array(start_ne[::-1]) + ahead * length_m * 0.36
    axes.annotate(
        "",
        xy=(float(tip[0]), float(tip[1])),
        xytext=tuple((tip - 0.01 * length_m * ahead).tolist()),
        arrowprops={"arrowstyle": "-|>", "color": "#17202a", "lw": 0.0, "mutation_scale": 11},
        zorder=6,
    )


def _frame(axes: Axes, points_xy: Any) -> None:
    low, high = points_xy.min(axis=0), points_xy.max(axis=0)
    margin = 0.06 * float(max(high - low))
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[1] - 2.0 * margin, high[1] + margin)


def _furniture(axes: Axes, points_xy: Any) -> None:
    """A north arrow and a scale bar."""
    size = float(max(points_xy.max(axis=0) - points_xy.min(axis=0)))
    bar = _round_length(size / 5)
    left, bottom = axes.get_xlim()[0] + 0.04 * size, axes.get_ylim()[0] + 0.045 * size
    axes.plot([left, left + bar], [bottom, bottom], color="black", lw=3, solid_capstyle="butt")
    axes.text(left + bar / 2, bottom + 0.012 * size, f"{bar:g} m", ha="center", fontsize=9)
    axes.annotate(
        "N",
        xy=(0.955, 0.985),
        xytext=(0.955, 0.90),
        xycoords="axes fraction",
        ha="center",
        va="center",
        fontsize=11,
        weight="bold",
        arrowprops={"arrowstyle": "-|>", "color": "black", "lw": 1.6},
        zorder=9,
    )


def _round_length(length_m: float) -> float:
    """1, 2 or 5 times a power of ten, not above a length."""
    power = 10.0 ** math.floor(math.log10(length_m))
    return float(max(step * power for step in (1, 2, 5) if step * power <= length_m))


def _points(length_m: float) -> int:
    return int(min(max(length_m / 0.02, 200), 200_000))


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, dpi=130, metadata={"Software": None})
