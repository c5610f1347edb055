"""Figures of a survey, each as a matplotlib `Figure` that a notebook shows and `savefig` writes."""

from typing import Any

import numpy as np

from alice_survey.app.api.arrays import Dem, Mosaic, Track, read_dem, read_mosaic, read_track
from alice_survey.core.contents import Location
from alice_survey.kit.document import EAST_NORTH, OWN_AXES
from alice_survey.kit.figure import (
    INK,
    INKS,
    Outline,
    PathPatch,
    Sheet,
    colour_bar,
    figure_style,
    map_axes,
    new_figure,
)
from missions.values.plan_file import Plan, read_plan

_HEIGHT_IN = 5.0


@figure_style()
def plot_plan(plan: Plan | Location) -> Sheet:
    """Draw the area, the survey lines and home of a plan, east to the right.

    Args:
        plan: the survey's plan, or its workspace.

    Example:
        >>> import alice_survey as alice
        >>> plan = alice.Survey.new("bay").plan()
        >>> alice.plot_plan(plan).savefig("plan.png")
    """
    plan = plan if isinstance(plan, Plan) else read_plan(plan)
    sheet, axes = _map()
    shape = Outline.make_compound_path(*(Outline(ring[:, ::-1]) for ring in plan.area.rings_ne))
    axes.add_patch(PathPatch(shape, facecolor="#dceaf3", edgecolor=INK))
    ends = np.array([(line.start_ne_m, line.end_ne_m) for line in plan.lines])
    axes.plot(ends[:, :, 1].T, ends[:, :, 0].T, color=INKS[0], linewidth=1.2)
    axes.plot(plan.home_ne_m[1], plan.home_ne_m[0], "o", color=INKS[1])
    axes.annotate("home", plan.home_ne_m[::-1], textcoords="offset points", xytext=(6, 4))
    axes.set_title(f"{plan.name}: {len(plan.lines)} lines, {plan.length_m:.0f} m")
    map_axes(axes)
    return sheet


@figure_style()
def plot_dem(dem: Dem | Location) -> Sheet:
    """Draw heights and their standard deviations next to each other.

    Args:
        dem: the surface, or its workspace.

    Example:
        >>> import alice_survey as alice
        >>> alice.plot_dem(alice.read_dem("small", max_cells=200)).savefig("dem.png")
    """
    dem = dem if isinstance(dem, Dem) else read_dem(dem)
    sheet = new_figure(_HEIGHT_IN)
    for axes, values, label in zip(
        sheet.subplots(1, 2),
        (dem.height, dem.sigma),
        (f"height, {dem.unit}", f"standard deviation, {dem.unit}"),
        strict=True,
    ):
        known = values[np.isfinite(values)]
        low, high = np.percentile(known, [1, 99]) if len(known) else (0.0, 1.0)
        image = axes.imshow(
            values, extent=dem.extent, vmin=low, vmax=high,
            cmap="viridis" if values is dem.height else "cividis",
        )  # fmt: skip
        colour_bar(image, axes, label)
        map_axes(axes, dem.unit, names=EAST_NORTH if dem.crs is not None else OWN_AXES)
    return sheet


@figure_style()
def plot_mosaic(mosaic: Mosaic | Location) -> Sheet:
    """Draw the mosaic with its coordinates and a scale bar.

    Args:
        mosaic: the survey's mosaic, or its workspace.

    Example:
        >>> import alice_survey as alice
        >>> alice.plot_mosaic(alice.read_mosaic("small", 200)).savefig("mosaic.png")
    """
    mosaic = mosaic if isinstance(mosaic, Mosaic) else read_mosaic(mosaic)
    sheet, axes = _map()
    axes.imshow(mosaic.rgba, extent=mosaic.extent)
    map_axes(axes, mosaic.unit, names=EAST_NORTH if mosaic.crs is not None else OWN_AXES)
    return sheet


@figure_style()
def plot_track(track: Track | Location) -> Sheet:
    """Draw where pictures were taken, coloured by the standard deviation of their position.

    Args:
        track: the survey's camera track, or its workspace.

    Example:
        >>> import alice_survey as alice
        >>> alice.plot_track(alice.read_track("small")).savefig("track.png")
    """
    track = track if isinstance(track, Track) else read_track(track)
    sheet, axes = _map()
    places = track.world_from_cam.translation
    sigma = track.sigma
    dots = axes.scatter(
        places[:, 1], places[:, 0], s=12, cmap="cividis",
        c=None if sigma is None else np.linalg.norm(sigma, axis=1),
    )  # fmt: skip
    if sigma is not None:
        colour_bar(dots, axes, f"standard deviation of the position, {track.frame.unit}")
    map_axes(axes, track.frame.unit, names=EAST_NORTH if track.frame.name == "ned" else OWN_AXES)
    return sheet


def _map() -> tuple[Sheet, Any]:
    sheet = new_figure(_HEIGHT_IN)
    return sheet, sheet.subplots()
