"""Pictures of a score, of the distance from a reference, and of the change between two surveys."""

from pathlib import Path
from typing import Any

import numpy as np
from shapely.geometry import MultiPolygon

from alice_survey.core.frames import Array
from alice_survey.core.run import progress
from alice_survey.kit.figure import (
    Axes,
    colour_bar,
    even_limit,
    figure_style,
    map_axes,
    new_figure,
    save_figure,
)
from missions.values.plan_file import Plan
from reconstruct.evaluate.cameras import CameraScore
from reconstruct.evaluate.change import SIGNIFICANT, Change
from reconstruct.evaluate.cloud_registration import CloudDistances
from reconstruct.evaluate.elevation import Elevation
from reconstruct.evaluate.figures import mean_grid
from reconstruct.evaluate.surface import SurfaceScore
from reconstruct.raster import hillshade

_WIDTH_IN = 11.0
_CELLS = 320
"""Cells of the map along its longer side."""
_LONGEST = 1200
_LABELLED = 8


@progress.step("draw the track's errors")
@figure_style()
def plot_track(path: Path, plan: Plan, cameras: CameraScore) -> None:
    """Planned lines, camera positions coloured by error, and the error of each picture."""
    places, length_mm = cameras.positions_ned, 1e3 * np.linalg.norm(cameras.misses_m, axis=1)
    south, west, north, east = plan.area.survey.bounds
    figure = new_figure(_height_in(east - west, north - south), _WIDTH_IN)
    plane, strips = figure.subplots(1, 2, width_ratios=[1, 1.2])
    for line in plan.lines:
        (n0, e0), (n1, e1) = line.start_ne_m, line.end_ne_m
        plane.plot([e0, e1], [n0, n1], color="0.75", linewidth=3, zorder=1)
    _draw_area(plane, plan.area.survey)
    dots = plane.scatter(places[:, 1], places[:, 0], c=length_mm, s=14, cmap="viridis", zorder=2)
    colour_bar(dots, plane, "position error (mm)")
    plane.set_title("Camera positions over the plan")
    map_axes(plane)
    for axis, name in enumerate(("north", "east", "down")):
        strips.plot(1e3 * cameras.misses_m[:, axis], ".", markersize=4, label=name)
    strips.axhline(0, color="0.6", linewidth=0.8)
    strips.set(xlabel="picture", ylabel="error (mm)")
    strips.set_title(f"Error after a rigid alignment: {1e3 * cameras.rms_m:.2f} mm rms")
    strips.legend(loc="upper right")
    save_figure(figure, path)


@progress.step("draw the errors")
@figure_style()
def plot_errors(path: Path, surface: SurfaceScore, area: MultiPolygon) -> None:
    """Map and histogram of height errors of the surface."""
    figures = surface.to_json()
    limit = max(5.0, 3 * figures["height_median_mm"], figures["height_95_mm"])
    shown = even_limit(1e3 * surface.map_m)
    west, east, south, north = surface.extent_m
    figure = new_figure(_height_in(east - west, north - south), _WIDTH_IN)
    plane, bars = figure.subplots(1, 2, width_ratios=[1.3, 1])
    image = plane.imshow(
        1e3 * surface.map_m,
        extent=(west, east, south, north),
        vmin=-shown,
        vmax=shown,
        cmap="PuOr",
        interpolation="nearest",
    )
    _draw_area(plane, area)
    colour_bar(image, plane, "height error (mm)")
    plane.set_title("Surface minus truth")
    plane.grid(visible=False)
    map_axes(plane)
    plane.set_facecolor("0.85")
    bars.hist(1e3 * surface.height_m, bins=np.linspace(-4 * limit, 4 * limit, 161), log=True)
    bars.set(xlabel="height error (mm)", ylabel="cells")
    bars.set_title(
        f"rms {figures['height_rms_mm']:.2f} mm in height, {figures['distance_rms_mm']:.2f} mm "
        f"in distance;\n{surface.completeness:.1%} complete",
        fontsize=9,
    )
    save_figure(figure, path)


@progress.step("draw the summary")
@figure_style()
def plot_sheet(
    path: Path,
    workspace: Path,
    cameras: CameraScore,
    surface: SurfaceScore,
    area: MultiPolygon,
) -> None:
    """The picture nearest to the middle of the area, surface, mosaic and error on one sheet."""
    middle = area.representative_point()
    away = np.linalg.norm(cameras.positions_ned[:, :2] - [middle.x, middle.y], axis=1)
    pictures = [
        ("A picture", workspace / "images" / cameras.names[int(away.argmin())]),
        ("Surface", workspace / "dense" / "dem.png"),
        ("Mosaic", workspace / "mosaic" / "mosaic.png"),
    ]
    figure = new_figure(10, 12)
    panels = figure.subplots(2, 2).ravel()
    for panel, (title, file) in zip(panels, pictures, strict=False):
        panel.set_title(title)
        panel.axis("off")
        panel.imshow(_read(file))
    west, east, south, north = surface.extent_m
    panels[3].set_title("Surface minus truth")
    panels[3].grid(visible=False)
    error_mm = 1e3 * surface.map_m
    shown = even_limit(error_mm)
    image = panels[3].imshow(
        error_mm, extent=(west, east, south, north), vmin=-shown, vmax=shown, cmap="PuOr"
    )
    colour_bar(image, panels[3], "height error (mm)")
    map_axes(panels[3])
    save_figure(figure, path)


def _height_in(width_m: float, height_m: float) -> float:
    """Height of a figure with a map next to something else: higher where the map is."""
    return 5.5 * min(max(0.9 * height_m / width_m, 1.0), 1.7)


def _draw_area(axes: Axes, area: MultiPolygon) -> None:
    """Edges of the survey area, holes too."""
    for part in area.geoms:
        for ring in (part.exterior, *part.interiors):
            north, east = np.asarray(ring.coords)[:, :2].T
            axes.plot(east, north, "k--", linewidth=1)


def _read(path: Path) -> Any:
    import cv2

    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    order = cv2.COLOR_BGRA2RGBA if picture.shape[2] == 4 else cv2.COLOR_BGR2RGB
    return cv2.cvtColor(picture, order)


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
    side = max(float(np.ptp(places_en, axis=0).max()) / cells, 1e-12)
    mean, west, north = mean_grid(places_en, values, side)
    rows, columns = mean.shape
    return mean, (west, west + columns * side, north - rows * side, north)


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
            values, extent=extent, cmap="RdBu_r", vmin=-span, vmax=span,
            alpha=np.where(np.isfinite(values), 0.75, 0.0), interpolation="nearest",
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


def _histogram(axis: Axes, change: Change) -> None:
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
