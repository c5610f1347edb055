"""The map of a plan: area, no-go zones, lines, footprints, overlap, current, bathymetry."""

import math
from pathlib import Path

import matplotlib as mpl
import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline
from matplotlib.transforms import Affine2D

from alice_survey.base.config import SeaConfig
from alice_survey.base.errors import PlanError
from alice_survey.base.frames import Array
from camera_calib.rig import Rig
from missions.areas.bathymetry import Bathymetry
from missions.coverage.certificate import Certificate
from missions.exports.geometry import footprint_outline, footprints_ne
from missions.values.plan_file import Plan

_AREA, _WAY, _NO_GO, _ALLOWED = "#c8553d", "#7f8c8d", "#b03a2e", "#566573"
_LINES = {"survey": "#1b4f72", "cross": "#6c3483", "closing": "#117a65", "fill": "#b9770e"}
_FOOTPRINT, _PAPER = "#2e86c1", "#fbfcfc"
_INK = "#17202a"
_MOST_ARROWS = 500
_MOST_FOOTPRINTS = 3000
"""Beyond, single footprints are no longer seen: the count of pictures shows what they cover."""
_ALLOWED_BEYOND = 0.3
"""Share of the map by which the allowed area may be larger than all else and is still shown whole.
"""
_LEAST_MAP_IN = 2.2
_PDF_DATE = {"CreationDate": None, "ModDate": None}
SUFFIXES = (".png", ".pdf", ".svg")


def draw_plan(
    path: Path,
    plan: Plan,
    rig: Rig,
    certificate: Certificate | None = None,
    bathymetry: Bathymetry | None = None,
    sea: SeaConfig | None = None,
) -> None:
    """Draw a plan, east to the right, north up, as PNG, PDF or SVG.

    Args:
        path: its suffix says what to write.
        plan: what to draw.
        rig: its first camera's footprints are drawn.
        certificate: how many pictures see each place.
        bathymetry: contours to draw.
        sea: its mean current near the sea floor is shown.

    Raises:
        PlanError: the suffix is not known.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise PlanError(f"{path}: maps are written as {', '.join(SUFFIXES)}: change the suffix")
    figure, axes = _sheet(plan)
    around = [np.asarray(shapely.get_coordinates(plan.area.survey))[:, ::-1]]
    if certificate is not None:
        _draw_counts(figure, axes, certificate)
    around.append(_draw_footprints(axes, plan, rig, faint=certificate is not None))
    _draw_area(axes, plan)
    around.append(_draw_route(axes, plan))
    points = np.vstack(around)
    _frame(axes, points, plan)
    _fit_sheet(figure, axes)
    _draw_lines(axes, plan)
    if bathymetry is not None:
        _draw_bathymetry(axes, bathymetry)
    _furniture(axes, points)
    if sea is not None and sea.current_mps > 0 and sea.current_file is None:
        _draw_current(axes, sea)
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncol=4, frameon=False, fontsize=8)
    figure.text(0.02, 0.985, plan.name, fontsize=13, weight="bold", va="top")
    figure.text(0.98, 0.985, _summary(plan), fontsize=8, color="#444444", va="top", ha="right")
    kind = path.suffix.lower()
    metadata = (
        {"Software": None} if kind == ".png" else _PDF_DATE if kind == ".pdf" else {"Date": None}
    )
    # Packing a PNG harder takes longer than all the rest of its writing.
    packing = {"pil_kwargs": {"compress_level": 2}} if kind == ".png" else {}
    with mpl.rc_context({"svg.hashsalt": plan.name}):  # names within an SVG are random otherwise
        figure.savefig(path, dpi=130, metadata=metadata, **packing)


def _summary(plan: Plan) -> str:
    dives = f"{len(plan.dives)} dives, " if len(plan.dives) > 1 else ""
    return (
        f"{plan.stations} stations every {plan.interval_s:.2f} s, {plan.length_m:.0f} m, {dives}"
        f"{plan.duration_s / 60:.0f} min at {plan.speed_mps:g} m/s, {plan.energy_wh:.0f} Wh\n"
        f"altitude {plan.altitude_m:g} m, overlap {plan.reached_forward_overlap:.0%} forward, "
        f"{plan.reached_side_overlap:.0%} side, lines {plan.line_spacing_m:.2f} m apart, "
        f"{plan.coverage:.1%} covered as asked"
    )


def _sheet(plan: Plan) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(8.5, 8.5), facecolor="white")
    FigureCanvasAgg(figure)
    # Places that are set: a layout engine would draw everything twice.
    axes = figure.add_axes((0.09, 0.145, 0.78, 0.785), anchor="N")
    axes.set_facecolor(_PAPER)
    axes.set_aspect("equal")
    axes.grid(color="#e5e8e8", lw=0.6)
    axes.set_axisbelow(True)
    datum = plan.datum
    axes.set_xlabel(f"east of {abs(datum.longitude_deg):.6f}° {'EW'[datum.longitude_deg < 0]}, m")
    axes.set_ylabel(f"north of {abs(datum.latitude_deg):.6f}° {'NS'[datum.latitude_deg < 0]}, m")
    return figure, axes


def _draw_counts(figure: Figure, axes: Axes, certificate: Certificate) -> None:
    """How many pictures see each place, in steps that the eye can tell apart."""
    grid = certificate.grid
    seen = np.ma.masked_array(certificate.pictures, ~certificate.inside)
    most = max(int(np.percentile(certificate.pictures[certificate.inside], 99.5)), 2)
    edges = np.unique(np.round(np.linspace(1, most + 1, min(most, 8) + 1)))
    # Rows of the grid count along its heading, columns to the right of it.
    turned = Affine2D().scale(grid.cell_m).rotate(-grid.heading_rad)
    turned = turned.translate(grid.origin_ne[1], grid.origin_ne[0])
    image = axes.imshow(
        seen,
        origin="lower",
        extent=(0, grid.columns, 0, grid.rows),
        transform=turned + axes.transData,
        cmap="GnBu",
        norm=BoundaryNorm([0, *edges], 256),
        alpha=0.75,
        interpolation="nearest",
        zorder=0.5,
    )
    bar = figure.colorbar(image, cax=figure.add_axes((0.895, 0.33, 0.022, 0.42)))
    bar.set_label("pictures of all cameras that see it", fontsize=8)
    bar.ax.tick_params(labelsize=8)


def _draw_footprints(axes: Axes, plan: Plan, rig: Rig, *, faint: bool) -> Array:
    """Footprints of the first camera; returns their points, east before north."""
    outline = footprint_outline(plan, rig)
    shapes = [shape[:, ::-1] for line in plan.lines for shape in footprints_ne(line, outline)]
    points: Array = np.vstack(shapes)
    if len(shapes) <= _MOST_FOOTPRINTS:
        axes.add_collection(
            PolyCollection(
                shapes,
                facecolors="none" if faint else _FOOTPRINT,
                edgecolors=_FOOTPRINT if faint else "none",
                linewidths=0.35,
                alpha=0.35 if faint else 0.16,
                zorder=1,
                label="footprints (left camera)",
            )
        )
    return points


def _draw_area(axes: Axes, plan: Plan) -> None:
    area = plan.area
    _patch(axes, area.survey, facecolor="none", edgecolor=_AREA, lw=2.0, zorder=6, label="area")
    _patch(
        axes, area.allowed, facecolor="none", edgecolor=_ALLOWED, lw=0.9, ls=":", zorder=2,
        label="the vehicle may be within",
    )  # fmt: skip
    _patch(
        axes, area.no_go, facecolor="#f5b7b1", edgecolor=_NO_GO, hatch="xxx", lw=1.0, alpha=0.55,
        zorder=5, label="no-go zone",
    )  # fmt: skip


def _patch(axes: Axes, shape: shapely.MultiPolygon, label: str, **style: object) -> None:
    rings = [
        np.asarray(ring.coords)[:, 1::-1]
        for polygon in shape.geoms
        for ring in (polygon.exterior, *polygon.interiors)
    ]
    if rings:
        outline = Outline.make_compound_path(*(Outline(ring, closed=True) for ring in rings))
        axes.add_patch(PathPatch(outline, label=label, **style))


def _draw_route(axes: Axes, plan: Plan) -> Array:
    """The ways of all dives; returns their points, east before north."""
    points = []
    for index, dive in enumerate(plan.dives):
        route = dive.route
        way = route.places(np.linspace(0.0, route.length_m, _points(route.length_m)))
        axes.plot(
            way[:, 1], way[:, 0], color=_WAY, lw=0.9, zorder=3,
            label="way between lines" if index == 0 else None,
        )  # fmt: skip
        points.append(way[:, ::-1])
    north, east = plan.home_ne_m
    axes.plot(east, north, "D", ms=9, mfc="#27ae60", mec="white", zorder=8, ls="", label="home")
    for index, dive in enumerate(plan.dives[1:], start=2):
        line = plan.lines[dive.first_line]
        axes.annotate(
            f"dive {index}", line.start_ne_m[::-1], fontsize=8, weight="bold", zorder=9,
            bbox={"boxstyle": "round,pad=0.2", "fc": "white", "ec": _WAY, "lw": 0.6},
        )  # fmt: skip
    return np.vstack(points)


def _draw_lines(axes: Axes, plan: Plan) -> None:
    size = 9.0 if plan.stations < 300 else 3.0 if plan.stations < 20_000 else 0.3
    # Lines and dots leave two thirds of the space between lines to what they cover.
    widest = max(plan.line_spacing_m * _points_per_metre(axes) / 3.0, 0.25)
    size = min(size, widest**2)
    for kind, colour in _LINES.items():
        lines = [line for line in plan.lines if line.kind == kind]
        if not lines:
            continue
        ends = [(line.start_ne_m[::-1], line.end_ne_m[::-1]) for line in lines]
        label = f"{len(ends)} {kind} line{'s' if len(ends) > 1 else ''}"
        axes.add_collection(
            LineCollection(ends, colors=colour, linewidths=min(1.6, widest), zorder=4, label=label)
        )
        places = np.vstack([line.stations_ne for line in lines])
        axes.scatter(places[:, 1], places[:, 0], s=size, color=colour, zorder=5, lw=0)
    if len(plan.lines) <= _MOST_ARROWS:
        axes.add_collection(PolyCollection(_arrows(plan), facecolors=_INK, zorder=6))


def _arrows(plan: Plan) -> list[Array]:
    """An arrow head at a third of each line, so that the direction of travel is seen."""
    north_0, east_0, north_1, east_1 = plan.area.survey.bounds
    size = 0.011 * max(north_1 - north_0, east_1 - east_0)
    # Of many lines each so-many-th, an odd number: neighbours fly opposite ways.
    apart = 2 * int(size / plan.line_spacing_m) + 1
    heads = []
    for index, line in enumerate(plan.lines):
        if line.kind == "survey" and index % apart:
            continue
        ahead = np.array([math.sin(line.heading_rad), math.cos(line.heading_rad)])
        right = np.array([ahead[1], -ahead[0]])
        tip = np.array(line.start_ne_m[::-1]) + ahead * (line.length_m / 3 + size)
        back = tip - 1.6 * size * ahead
        heads.append(np.array([tip, back + 0.6 * size * right, back - 0.6 * size * right]))
    return heads


def _draw_bathymetry(axes: Axes, bathymetry: Bathymetry) -> None:
    """Contours of depth over what the axes show."""
    (west, east), (south, north) = axes.get_xlim(), axes.get_ylim()
    easts, norths = np.linspace(west, east, 240), np.linspace(south, north, 240)
    grid = np.stack(np.meshgrid(norths, easts, indexing="ij"), axis=-1)
    depth = bathymetry.depth_at(grid.reshape(-1, 2)).reshape(grid.shape[:2])
    known = depth[np.isfinite(depth)]
    if len(known) and np.ptp(known) > 0.01:
        lines = axes.contour(easts, norths, depth, 10, colors="#5d6d7e", linewidths=0.6, zorder=1.5)
        axes.clabel(lines, fontsize=7, fmt="%g m")


def _draw_current(axes: Axes, sea: SeaConfig) -> None:
    """An arrow below the area that points where the current flows."""
    (west, east), (south, north) = axes.get_xlim(), axes.get_ylim()
    # In metres: in shares of the axes, which are seldom square, it would point elsewhere.
    size = max(east - west, north - south)
    towards = math.radians(sea.current_towards_deg)
    half = 0.035 * size * np.array([math.sin(towards), math.cos(towards)])
    middle = np.array([east - 0.06 * size, south + 0.05 * size])
    axes.annotate(
        "",
        xy=tuple((middle + half).tolist()),
        xytext=tuple((middle - half).tolist()),
        arrowprops={"arrowstyle": "-|>", "color": "#2471a3", "lw": 2.2, "mutation_scale": 15},
        zorder=9,
    )
    axes.text(
        middle[0] - 0.045 * size, middle[1], f"current\n{sea.current_mps:g} m/s", ha="right",
        va="center", fontsize=7.5, color="#1a5276", zorder=9,
        bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.7},
    )  # fmt: skip


def _frame(axes: Axes, points_xy: Array, plan: Plan) -> None:
    """Show all points, and the allowed area with them unless it is much larger."""
    low, high = points_xy.min(axis=0), points_xy.max(axis=0)
    south, west, north, east = plan.area.allowed.bounds
    beyond = max(low[0] - west, low[1] - south, east - high[0], north - high[1])
    if beyond < _ALLOWED_BEYOND * float(max(high - low)):
        low, high = np.minimum(low, [west, south]), np.maximum(high, [east, north])
    margin = 0.06 * float(max(high - low))
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[1] - 2.0 * margin, high[1] + margin)


def _fit_sheet(figure: Figure, axes: Axes) -> None:
    """Make the sheet as high as the map, so that a long area leaves no empty page."""
    (west, east), (south, north) = axes.get_xlim(), axes.get_ylim()
    width_in, height_in = figure.get_size_inches()
    left, bottom, width, height = axes.get_position(original=True).bounds
    below_in, above_in = bottom * height_in, (1.0 - bottom - height) * height_in
    map_in = width * width_in * (north - south) / (east - west)
    map_in = min(max(map_in, _LEAST_MAP_IN), height * height_in)
    sheet_in = below_in + map_in + above_in
    figure.set_size_inches(width_in, sheet_in)
    axes.set_position((left, below_in / sheet_in, width, map_in / sheet_in))
    for bar in figure.axes[1:]:
        x, _, bar_width, _ = bar.get_position(original=True).bounds
        bar.set_position(
            (x, (below_in + 0.15 * map_in) / sheet_in, bar_width, 0.7 * map_in / sheet_in)
        )


def _furniture(axes: Axes, points_xy: Array) -> None:
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


def _points_per_metre(axes: Axes) -> float:
    """Of the printed map; a point is 1/72 inch."""
    (west, east), (south, north) = axes.get_xlim(), axes.get_ylim()
    width_in, height_in = axes.get_figure().get_size_inches()
    box = axes.get_position(original=True)
    inches = min(box.width * width_in / (east - west), box.height * height_in / (north - south))
    return float(72.0 * inches)


def _points(length_m: float) -> int:
    return int(min(max(length_m / 0.02, 200), 200_000))
