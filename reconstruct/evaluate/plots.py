"""Pictures of a score: track and camera errors, the error of the surface, one sheet of all."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from shapely.geometry import MultiPolygon

from alice_survey.base.run import progress
from alice_survey.kit.figure import (
    Axes,
    colour_bar,
    even_limit,
    figure_style,
    map_axes,
    new_figure,
    save_figure,
)
from missions.values.plan_file import read_plan

if TYPE_CHECKING:
    from reconstruct.evaluate.cameras import CameraScore
    from reconstruct.evaluate.surface import SurfaceScore

_WIDTH_IN = 11.0


@progress.step("draw the track's errors")
@figure_style()
def plot_track(path: Path, plan_file: Path, cameras: "CameraScore") -> None:
    """Planned lines, camera positions coloured by error, and the error of each picture."""
    plan = read_plan(plan_file)
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
def plot_errors(path: Path, surface: "SurfaceScore", area: MultiPolygon) -> None:
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
    cameras: "CameraScore",
    surface: "SurfaceScore",
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
