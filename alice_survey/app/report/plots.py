"""Plots of a report: readable in print and by the colour-blind, each with an explanation."""

from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any

import numpy as np
from rasterio.enums import Resampling

from alice_survey.app.report.colours import read_shrunk
from alice_survey.app.report.held import Held, number
from alice_survey.core.frames import Array
from alice_survey.kit.document import Figure
from alice_survey.kit.figure import INK, INKS, MARKS, SOFT, draw_figure, plain_name
from alice_survey.kit.words import digits, share
from camera_calib.mount import mount_line
from camera_calib.rig import Rig

_MAX_VALUES_PX = 4e6
_RAY_SHARE = 0.6
"""Length of a mount's rays over the size of what is drawn."""
_MIN_M = 0.3


def camera_sigmas(held: Held) -> Iterator[Figure]:
    """Stated sigmas of the cameras along the survey."""
    rows = [r for r in held.track if number(r, "sigma_north_m") > 0]
    if not rows:
        return
    station = np.array([number(row, "station") for row in rows])
    where = "in the survey" if held.frame.datum is None else "on the Earth"

    def paint(axes: Sequence[Any]) -> None:
        for axis, ink, mark in zip(("north", "east", "depth"), INKS, MARKS, strict=False):
            sigma = [1e2 * number(row, f"sigma_{axis}_m") for row in rows]
            axes[0].plot(station, sigma, mark, ms=3, color=ink, label=axis)
        axes[0].set(xlabel="station", ylabel=f"sigma {where}, cm", ylim=(0, None))
        axes[0].legend()

    yield draw_figure(
        paint, 2.9,
        title="How well each camera is placed",
        alt="Standard deviations of camera positions by station",
        shows="The model's own standard deviation of every camera, by station. What all cameras "
        "share is navigation's error of the whole survey.",
        good="No station stands out.",
        otherwise="A rise at the ends of lines asks for a line across them; a single station that "
        "stands out has too few points (see the next plot).",
    )  # fmt: skip


def pictures_used(held: Held) -> Iterator[Figure]:
    """Points and reprojection error of each picture."""
    rows = held.track
    if not rows:
        return
    points, error, station = (
        np.array([number(row, name) for row in rows])
        for name in ("points", "reprojection_px", "station")
    )
    camera = np.array([row["camera"] for row in rows])
    names = list(dict.fromkeys(camera.tolist()))
    inks = [INKS[i % len(INKS)] for i in range(len(names))]

    def paint(axes: Sequence[Any]) -> None:
        for i, (name, ink) in enumerate(zip(names, inks, strict=True)):
            own, mark = camera == name, MARKS[i % len(MARKS)]
            axes[0].plot(station[own], points[own], mark, ms=3, color=ink, label=name)
        axes[0].set(xlabel="station", ylabel="points of the model", ylim=(0, None))
        axes[0].legend()
        axes[1].hist(
            [error[camera == name] for name in names], bins=30, color=inks, stacked=True,
            edgecolor="white", linewidth=0.4,
        )  # fmt: skip
        axes[1].set(xlabel="mean reprojection error, px", ylabel="pictures")

    yield draw_figure(
        paint, 2.6, columns=2,
        title="What each picture gives to the model",
        alt="Points by picture, and a histogram of reprojection errors",
        shows=f"Points that each picture shares with others (median {np.median(points):.0f}), and "
        f"their reprojection errors ({digits(float(np.median(error)), 2)} px median).",
        good="Hundreds of points everywhere, and errors well below one pixel.",
        otherwise="Few points: dark, blurred or without overlap; see the list of pictures. Large "
        "errors in all: the calibration does not fit.",
    )  # fmt: skip


def sigma_test(held: Held) -> Iterator[Figure]:
    """True errors of the heights over their stated sigmas."""
    errors, sigmas = (_raster(held, path) for path in ("evaluation/error.tif", "dense/sigma.tif"))
    if errors is None or sigmas is None or errors.shape != sigmas.shape:
        return
    ratio = errors[np.isfinite(errors) & (sigmas > 0)] / sigmas[np.isfinite(errors) & (sigmas > 0)]
    if not len(ratio):
        return

    def paint(axes: Sequence[Any]) -> None:
        grid = np.linspace(-4, 4, 161)
        axes[0].hist(ratio, bins=81, range=(-4, 4), density=True, color=INKS[0], label="found")
        normal = np.exp(-(grid**2) / 2) / np.sqrt(2 * np.pi)
        axes[0].plot(grid, normal, color=INKS[1], label="as stated")
        axes[0].set(xlabel="error over its stated sigma", ylabel="share", yticks=[])
        axes[0].legend()

    one, two = (share(float((np.abs(ratio) <= sigmas).mean())) for sigmas in (1, 2))
    yield draw_figure(
        paint, 2.3,
        title="Test of the stated sigmas",
        alt="Histogram of errors of heights over their stated sigmas, next to the normal curve",
        shows="The true errors of the heights in units of their stated sigmas: median "
        f"{float(np.median(ratio)):+.2f}; {one} lie within one sigma (68 % expected) and {two} "
        "within two (95 %).",
        good="The bars follow the line.",
        otherwise="Bars wider than the line: multiply the sigmas by the rms. A median off zero: "
        "neighbouring heights share an error, such as of one camera's position.",
    )  # fmt: skip


def overlap(held: Held) -> Iterator[Figure]:
    """How many stations see the cells."""
    values = _raster(held, "dense/stations.tif")
    values = None if values is None else values[values > 0]
    if values is None or not len(values):
        return
    maximum = int(np.percentile(values, 99.5))
    counts = np.bincount(np.minimum(values.astype(np.int64), maximum), minlength=maximum + 1)
    percent = 100 * counts / len(values)

    def paint(axes: Sequence[Any]) -> None:
        inks = [INKS[1] if n < 3 else INKS[0] for n in range(1, maximum + 1)]
        axes[0].bar(range(1, maximum + 1), percent[1:], color=inks)
        axes[0].set(xlabel="stations that see a point", ylabel="% of the surface")

    yield draw_figure(
        paint, 2.3,
        title="Overlap reached",
        alt="Share of the surface by the number of stations that see it",
        shows="Share of the surface by the number of stations that see it; "
        f"{percent[3:].sum():.1f} % is seen by three and more.",
        good="Hardly anything below three (orange), where heights do not check one another.",
        otherwise="Plan more forward or side overlap.",
    )  # fmt: skip


def mount(rig: Rig) -> Figure:
    """A rig with a known mount on its vehicle."""

    def paint(axes: Sequence[Any]) -> None:
        _paint_mount(axes[0], rig, [1, 0])
        _paint_mount(axes[1], rig, [0, 2])
        axes[0].set(title="from above", xlabel="right (m)", ylabel="forward (m)")
        axes[1].set(title="from starboard", xlabel="forward (m)", ylabel="down (m)")
        axes[1].invert_yaxis()
        axes[1].legend()

    return draw_figure(
        paint, 3.4, columns=2,
        title="How the cameras are mounted",
        alt="Cameras, their fields of view and the tops of their pictures on the vehicle",
        shows=f"Places and fields of view of the cameras: {mount_line(rig)}.",
        good="It looks as the vehicle does: bow, tops of the pictures, places of the cameras.",
        otherwise="Positions are off by the error of the lever, headings by that of the mount: "
        "state it with 'alice-survey camera convert --mount'.",
    )  # fmt: skip


def _paint_mount(axes: Any, rig: Rig, shown: list[int]) -> None:
    """Draw a rig's cameras by two axes of the vehicle (forward, right, down): across, and up."""
    poses = [rig.body_from_cam(name) for name in rig.cameras]
    places = [
        pose.apply(one.front_cam) for pose, one in zip(poses, rig.cameras.values(), strict=True)
    ]
    reach = _RAY_SHARE * max(float(np.abs(places).max()), _MIN_M)
    styles = product(MARKS, INKS)  # so that cameras of the same ink differ
    for (mark, ink), name, pose, place in zip(styles, rig.cameras, poses, places, strict=False):
        camera, at = rig.cameras[name], place[shown]
        size = np.array([camera.width_px, camera.height_px])
        corners = size * [[0, 0], [1, 0], [1, 1], [0, 1], [0.5, 0]]
        rays = reach * pose.rotation.apply(camera.unproject(corners)[1])
        *rim, top = (place + rays)[:, shown]
        axes.plot(*np.vstack([*rim, rim[0]]).T, color=ink, lw=1.0)
        for corner in rim:
            axes.plot(*np.stack([at, corner]).T, color=ink, lw=0.6)
        axes.plot(*at, mark, color=ink, ms=5, label=plain_name(name))
        axes.annotate("top", top, color=ink, ha="center", va="center", fontsize=8)
    axes.plot(0, 0, "+", color=INK, ms=11, mew=1.5)
    axes.annotate("navigation", (0, 0), xytext=(6, -12), textcoords="offset points", color=INK)
    bow = np.array([0.8 * reach, 0.0, 0.0])[shown]
    axes.annotate("", bow, (0, 0), arrowprops={"arrowstyle": "->", "color": SOFT})
    axes.annotate("bow", bow, xytext=(4, 4), textcoords="offset points", color=SOFT)
    axes.set_aspect("equal")


def _raster(held: Held, path: str) -> Array | None:
    """A raster, thinned so that the largest fits."""
    file = held.file(path)
    if file is None:
        return None
    (values,), _, _ = read_shrunk(file, [1], _MAX_VALUES_PX, Resampling.nearest)
    whole: Array = np.ma.getdata(values).astype(np.float64)
    return whole
