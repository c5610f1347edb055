"""Errors of approximations as a table, JSON values and a plot."""

from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.config import SurveyConfig, load_config
from alice_survey.core.errors import CalibrationError, ConfigError
from alice_survey.core.text_table import text_table
from alice_survey.kit.figure import (
    INKS,
    LogNorm,
    check_figure_path,
    colour_bar,
    figure_style,
    new_figure,
    save_figure,
)
from camera_calib.approximation.residual import Residual, approximations, residual
from camera_calib.camera import Camera
from camera_calib.rig import design_rig, read_rig

_STYLES = ("-", "-", "--", "--", ":")


def residual_report(
    near_m: float,
    far_m: float,
    *,
    survey: Path | None = None,
    rig: Path | None = None,
    camera: str | None = None,
    working_range_m: float | None = None,
    plot: Path | None = None,
) -> tuple[str, dict[str, Any]]:
    """Errors of each approximation of a camera, as text and as JSON values.

    Args:
        near_m: nearest distance from the entrance pupil along the axis.
        far_m: farthest.
        survey: `survey.toml` with the design; the paper's design when neither this nor a rig.
        rig: `rig.json` of calibrated cameras.
        camera: one of them; the first when not given.
        working_range_m: where warped pictures are exact; the harmonic mean when not given.
        plot: a PNG, PDF or SVG to draw.

    Raises:
        CalibrationError: the rig lacks the camera, or a part of the frame sees nothing.
        ConfigError: the interval or the plot's name is wrong, or both survey and rig are given.
    """
    if survey is not None and rig is not None:
        raise ConfigError("give a survey's design or a rig, not both")
    if plot is not None:
        check_figure_path(plot)
    if rig is not None:
        origin, cameras = str(rig), read_rig(rig).cameras
    else:
        config = SurveyConfig() if survey is None else load_config(survey)
        origin, cameras = "design", design_rig(config.camera, config.water).cameras
    name = next(iter(cameras)) if camera is None else camera
    if name not in cameras:
        raise CalibrationError(f"{origin}: no camera {name!r}; it has {', '.join(cameras)}")
    found = approximations(cameras[name], near_m, far_m, working_range_m=working_range_m)
    title = f"{name} camera of {origin}: {_port(cameras[name])}; {near_m:g} to {far_m:g} m"
    if plot is not None:
        draw_residuals(cameras[name], found, title, plot)
    data = {
        "camera": name,
        "origin": origin,
        "near_m": near_m,
        "far_m": far_m,
        "approximations": [one.to_json() for one in found],
    }
    return "\n".join([title, residual_table(found)]), data


def residual_table(found: list[Residual]) -> str:
    """One row for each approximation."""
    rows = [
        (
            one.stand_in.name,
            "-" if one.stand_in.warped_at_m is None else f"{one.stand_in.warped_at_m:.3f} m",
            f"{one.stand_in.centre_m[2] * 1e3:+.2f} mm",
            f"{np.rad2deg(one.stand_in.approx_from_cam.magnitude()):.3f} deg",
            f"{one.rms_px:.3f} px",
            f"{one.max_px:.2f} px",
            f"{one.rms_by_distance_px[0]:.3f} px",
            f"{one.rms_by_distance_px[-1]:.3f} px",
        )
        for one in found
    ]
    header = ("camera", "exact at", "centre z", "turn", "rms", "max", "rms near", "rms far")
    note = (
        "rms over the frame's area and nine distances, max with the corners; centre: along the "
        "axis from the entrance pupil"
    )
    return "\n".join([text_table(header, rows), note])


@figure_style()
def draw_residuals(camera: Camera, found: list[Residual], title: str, path: Path) -> None:
    """Maps over the frame on one scale, and the rms against distance.

    Raises:
        ConfigError: the file cannot be written.
    """
    figure = new_figure(6.8, 3.0 * len(found))
    figure.suptitle(title, fontsize=11)
    upper, lower = figure.subfigures(2, 1, height_ratios=(1.0, 1.15))
    axes = upper.subplots(1, len(found), squeeze=False)[0]
    maps = [residual(camera, one.stand_in, one.distances_m, grid=61) for one in found]
    high = max(float(one.map_px.max()) for one in maps)
    low = max(min(one.rms_px for one in found) / 3, 1e-5 * high)
    norm = LogNorm(low, high, clip=True)
    for one, fine, axis in zip(found, maps, axes, strict=True):
        x, y = fine.pixels[0, :, 0], fine.pixels[:, 0, 1]
        shown = axis.pcolormesh(
            x, y, np.maximum(fine.map_px, low),
            norm=norm, cmap="viridis", shading="gouraud", rasterized=True,
        )  # fmt: skip
        axis.set(aspect="equal", xlim=(x[0], x[-1]), ylim=(y[-1], y[0]), xticks=[], yticks=[])
        axis.set_title(
            f"{one.stand_in.name}\nrms {one.rms_px:.3g} px, max {one.max_px:.3g} px", fontsize=9
        )
    colour_bar(shown, list(axes), "rms over distances, px")
    plain = lower.subplots(1, 1)
    distances = np.linspace(found[0].distances_m[0], found[0].distances_m[-1], 101)
    for one, colour, style in zip(found, INKS, _STYLES, strict=False):
        curve = residual(camera, one.stand_in, distances).rms_by_distance_px
        exact = one.stand_in.warped_at_m
        label = one.stand_in.name + ("" if exact is None else f" at {exact:.2f} m")
        plain.plot(distances, curve, style, color=colour, label=label, linewidth=1.8)
    plain.set(
        xlabel="distance from the entrance pupil, m",
        ylabel="rms over the frame, px",
        yscale="log",
        xlim=(distances[0], distances[-1]),
        ylim=(low / 3, 1.3 * high),
    )
    plain.legend(fontsize=9, loc="center left", bbox_to_anchor=(1.0, 0.5))
    save_figure(figure, path)


def _port(camera: Camera) -> str:
    tilt = np.rad2deg(np.arccos(min(1.0, camera.port.axis_cam[2])))
    return f"{camera.port.words}, tilt {tilt:.2f} deg, n_water {camera.n_water:.4f}"
