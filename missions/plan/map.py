"""The map of a plan as a figure: area, no-go zones, lines, footprints, overlap, current, depth."""

from pathlib import Path

import numpy as np

from alice_survey.core.config import AreaConfig, CameraConfig, SeaConfig, WaterConfig
from alice_survey.core.frames import Array
from alice_survey.kit.figure import (
    INK,
    Axes,
    LineCollection,
    PolyCollection,
    Sheet,
    check_figure_path,
    figure_style,
    save_figure,
)
from alice_survey.kit.words import count, share
from camera_calib.rig import Rig, design_rig
from missions.areas.bathymetry import Bathymetry
from missions.coverage.certificate import Certificate, certificate
from missions.coverage.drawing import draw_counts, draw_polygons, finish_map, map_sheet
from missions.coverage.stations import plan_pattern, stations_of_plan
from missions.exports.geometry import footprint_outline, footprints_ne, route_ne
from missions.plan.planner import area_bathymetry
from missions.values.line import LINE_KINDS
from missions.values.plan_file import Plan, read_plan

COLOURS = {
    "survey": "#1b4f72", "cross": "#6c3483", "closing": "#117a65", "fill": "#b9770e",
    "tie": "#c0392b",
    "area": "#c8553d", "allowed": "#566573", "no_go": "#b03a2e", "way": "#7f8c8d",
    "footprint": "#2e86c1", "contour": "#5d6d7e", "missed": "#d35400",
    "home": "#1e8449",
}  # fmt: skip
"""Colours of all maps of a plan."""
_ARROWS = 60
_ROOM_PT = 200.0
"""Sum of the widths of all lines, points: about a third of a map's side."""
_MAX_FOOTPRINTS = 3000
"""Most footprints drawn one by one; beyond, the count of pictures shows what they cover."""
_ALLOWED_BEYOND = 0.3
"""Share of the map by which the allowed area may be larger than all else and is still shown whole.
"""


def map_report(
    plan_path: Path,
    out: Path,
    camera: CameraConfig,
    water: WaterConfig,
    area: AreaConfig,
    sea: SeaConfig,
) -> tuple[str, dict[str, str]]:
    """Draw the map of a finished plan again, as PNG, PDF or SVG after the suffix.

    Args:
        plan_path: `plan.json`.
        out: file to write.
        camera: of the survey.
        water: of the survey.
        area: names the bathymetry.
        sea: its current.

    Raises:
        PlanError: the file holds no plan.
        ConfigError: the suffix is not known.
    """
    check_figure_path(out)
    plan = read_plan(plan_path)
    rig = design_rig(camera, water)
    bathymetry = area_bathymetry(area, plan.area, plan.altitude_m)
    floor_m = None
    if bathymetry is not None:
        floor_m = bathymetry.depth_at(np.vstack([line.stations_ne for line in plan.lines]))
    stations = stations_of_plan(plan, floor_m)
    seen = certificate(plan.area, rig, stations, plan_pattern(plan, rig))
    out.parent.mkdir(parents=True, exist_ok=True)
    save_figure(plan_figure(plan, rig, seen, bathymetry, sea), out)
    return f"map of {plan.name} in {out}", {"plan": plan.name, "file": str(out)}


@figure_style()
def plan_figure(
    plan: Plan, rig: Rig, certificate: Certificate, bathymetry: Bathymetry | None, sea: SeaConfig
) -> Sheet:
    """Draw a plan, east to the right, north up.

    Args:
        plan: what to draw.
        rig: its first camera's footprints are drawn.
        certificate: how many pictures see each place.
        bathymetry: contours to draw, or None.
        sea: its mean current near the sea floor is shown.
    """
    outline = footprint_outline(plan, rig)
    shapes = [shape for line in plan.lines for shape in footprints_ne(line, outline)]
    ways = [route_ne(dive.route) for dive in plan.dives]
    figure, axes = map_sheet(
        _bounds(np.vstack([plan.area.corners_ne[:, :2], *shapes, *ways]), plan)
    )
    draw_counts(axes, certificate, opacity=0.6)
    if len(shapes) <= _MAX_FOOTPRINTS:
        _draw_footprints(axes, shapes, rig)
    _draw_area(axes, plan)
    _draw_route(axes, plan, ways)
    _draw_lines(axes, plan)
    if bathymetry is not None:
        _draw_bathymetry(axes, bathymetry)
    finish_map(figure, axes, plan.datum, plan.name, _summary(plan, sea))
    return figure


def _summary(plan: Plan, sea: SeaConfig) -> str:
    current = ""
    if sea.current_mps > 0 and sea.current_file is None:
        current = f", current {sea.current_mps:g} m/s towards {sea.current_towards_deg:03.0f} deg"
    stations, dives = count(plan.stations, "station"), count(len(plan.dives), "dive")
    return (
        f"{stations} every {plan.interval_s:.2f} s, {plan.length_m:.0f} m, {dives}, "
        f"{plan.duration_s / 60:.0f} min at {plan.speed_mps:g} m/s, {plan.energy_wh:.0f} Wh\n"
        f"altitude {plan.altitude_m:g} m, overlap {plan.reached_forward_overlap:.0%} forward, "
        f"{plan.reached_side_overlap:.0%} side, lines {plan.line_spacing_m:.2f} m apart, "
        f"{share(plan.coverage)} covered as requested{current}"
    )


def _bounds(points_ne: Array, plan: Plan) -> tuple[float, float, float, float]:
    """South, west, north and east of all points, and of the allowed area unless it is much larger.

    Below them is room for the scale.
    """
    shown, allowed = np.array([points_ne.min(axis=0), points_ne.max(axis=0)]), plan.area.allowed
    both = np.vstack([shown, np.reshape(allowed.bounds, (2, 2))])
    both = np.array([both.min(axis=0), both.max(axis=0)])
    if np.abs(both - shown).max() < _ALLOWED_BEYOND * np.ptp(shown, axis=0).max():
        shown = both
    margin = 0.06 * float(np.ptp(shown, axis=0).max())
    (south, west), (north, east) = shown.tolist()
    return south - 2.0 * margin, west - margin, north + margin, east + margin


def _draw_footprints(axes: Axes, shapes: list[Array], rig: Rig) -> None:
    axes.add_collection(
        PolyCollection(
            [shape[:, ::-1] for shape in shapes],
            facecolors="none",
            edgecolors=COLOURS["footprint"],
            linewidths=0.35,
            alpha=0.35,
            zorder=1,
            label=f"footprints ({rig.reference} camera)",
        )
    )


def _draw_area(axes: Axes, plan: Plan) -> None:
    area = plan.area
    draw_polygons(axes, area.survey, "area", edgecolor=COLOURS["area"], lw=2.0, zorder=6)
    draw_polygons(
        axes, area.allowed, "the vehicle may be within", edgecolor=COLOURS["allowed"], lw=0.9,
        ls=":", zorder=2,
    )  # fmt: skip
    draw_polygons(
        axes, area.no_go, "no-go zone", facecolor="#f5b7b1", edgecolor=COLOURS["no_go"],
        hatch="xxx", lw=1.0, alpha=0.55, zorder=5,
    )  # fmt: skip


def _draw_route(axes: Axes, plan: Plan, ways: list[Array]) -> None:
    for index, way in enumerate(ways):
        label = "" if index else "way between lines"
        axes.plot(way[:, 1], way[:, 0], color=COLOURS["way"], lw=0.9, zorder=3, label=label or None)
    north, east = zip(*plan.homes_ne_m, strict=True)
    axes.plot(
        east, north, "D", ms=9, mfc=COLOURS["home"], mec="white", zorder=8, ls="", label="home"
    )
    for number, dive in enumerate(plan.dives[1:], start=2):
        line = plan.lines[dive.first_line]
        axes.annotate(
            f"dive {number}", line.start_ne_m[::-1], fontsize=8, weight="bold", zorder=9,
            bbox={"boxstyle": "round,pad=0.2", "fc": "white", "ec": COLOURS["way"], "lw": 0.6},
        )  # fmt: skip


def _draw_lines(axes: Axes, plan: Plan) -> None:
    # Lines and dots leave room between them to what they cover.
    width = min(1.6, _ROOM_PT / len(plan.lines))
    for kind in LINE_KINDS:
        lines = [line for line in plan.lines if line.kind == kind]
        if not lines:
            continue
        colour, ends = COLOURS[kind], [(a.start_ne_m[::-1], a.end_ne_m[::-1]) for a in lines]
        label = f"{len(ends)} {kind} line{'s' if len(ends) > 1 else ''}"
        axes.add_collection(
            LineCollection(ends, colors=colour, linewidths=width, zorder=4, label=label)
        )
        places = np.vstack([line.stations_ne for line in lines])
        axes.scatter(places[:, 1], places[:, 0], s=4.0 * width**2, color=colour, zorder=5, lw=0)
    (north, east), (ahead_n, ahead_e) = (pair.T for pair in _arrows(plan))
    axes.quiver(
        east, north, ahead_e, ahead_n, color=INK, pivot="mid", scale=60, width=0.003,
        headlength=4, headaxislength=4, zorder=6,
    )  # fmt: skip


def _arrows(plan: Plan) -> tuple[Array, Array]:
    """Places (N, 2) at a third of lines and their ways, so that the direction of travel is seen."""
    # Of many lines every n-th, an odd number: neighbours fly opposite ways.
    apart = 2 * int(len(plan.lines) / _ARROWS / 2) + 1
    shown = [
        line for n, line in enumerate(plan.lines)
        if line.length_m > 0 and (line.kind != "survey" or n % apart == 0)
    ]  # fmt: skip
    ends = np.array([(line.start_ne_m, line.end_ne_m) for line in shown])
    ways = ends[:, 1] - ends[:, 0]
    return ends[:, 0] + ways / 3, ways / np.linalg.norm(ways, axis=1)[:, None]


def _draw_bathymetry(axes: Axes, bathymetry: Bathymetry) -> None:
    """Contours of depth over what the axes show."""
    (west, east), (south, north) = axes.get_xlim(), axes.get_ylim()
    easts, norths = np.linspace(west, east, 240), np.linspace(south, north, 240)
    grid = np.stack(np.meshgrid(norths, easts, indexing="ij"), axis=-1)
    depth = bathymetry.depth_at(grid.reshape(-1, 2)).reshape(grid.shape[:2])
    known = depth[np.isfinite(depth)]
    if len(known) and np.ptp(known) > 0.01:
        colour = COLOURS["contour"]
        lines = axes.contour(easts, norths, depth, 10, colors=colour, linewidths=0.6, zorder=1.5)
        axes.clabel(lines, fontsize=7, fmt="%g m")
