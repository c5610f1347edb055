"""The four figures of a calibration report, as PNG files."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from alice_survey.core.frames import Array
from alice_survey.kit.figure import (
    INK,
    INKS,
    Axes,
    LinearSegmentedColormap,
    Rectangle,
    Sheet,
    colour_bar,
    figure_style,
    new_figure,
    plain_name,
    png_of,
)
from camera_calib.judge.fit_quality import COVERED_REACH, Profile
from camera_calib.judge.judgement import Judgement

_SEQUENTIAL = LinearSegmentedColormap.from_list(
    "depth", ["#f4f9fb", "#bcdcea", "#6fb1d1", "#2f7fb0", "#15507f", "#0b2545"]
)
_WIDTH_IN = 10.4
_MAX_LABELS = 45
_CELLS = 12
"""Cells across a frame, in which residuals are averaged."""
_MIN_IN_CELL = 6
_STRONG = 3.0
"""Mean length over noise of the mean from which an arrow is in colour: 1 % of cells by chance."""


def plot_pictures(judged: Judgement) -> bytes:
    """Rms of each picture, cameras next to each other, and against its distance."""
    views = [view.name for view in judged.calibration.views]
    cameras = list(judged.cameras)

    def draw(figure: Sheet) -> None:
        axes, right = figure.subplots(1, 2, width_ratios=[3.2, 1], sharey=True)
        width = 0.8 / len(cameras)
        for c, camera in enumerate(cameras):
            rms = {p.view: p.rms_px for p in judged.pictures if p.camera == camera}
            at = [i for i, view in enumerate(views) if view in rms]
            axes.bar(
                np.array(at) + (c - (len(cameras) - 1) / 2) * width,
                [rms[views[i]] for i in at],
                0.92 * width,
                color=_colour(c),
                label=plain_name(camera),
            )
            fits = [p for p in judged.pictures if p.camera == camera]
            right.plot(
                [p.range_m for p in fits], [p.rms_px for p in fits], "o", color=_colour(c), ms=4
            )
        noise = judged.calibration.noise_px * 2**0.5
        axes.axhline(noise, color=INK, lw=1.1, ls="--", label=f"noise alone ({noise:.3f} px)")
        right.axhline(noise, color=INK, lw=1.1, ls="--")
        right.set(xlabel="distance (m)")
        right.set_xlim(0, right.get_xlim()[1])
        _label_views(axes, views)
        axes.set(xlabel="view", ylabel="rms of residuals (px)", xlim=(-0.7, len(views) - 0.3))
        axes.grid(visible=False, axis="x")
        axes.margins(y=0.18)
        axes.legend(ncols=len(cameras) + 1, loc="upper right")

    return _png(3.4, draw)


def plot_vectors(judged: Judgement) -> bytes:
    """Residuals over the frame: each one thin, the mean of each cell bold."""

    def draw(figure: Sheet) -> None:
        for c, axes, name in _by_camera(_axes_grid(figure, len(judged.cameras))[0], judged):
            camera = judged.cameras[name]
            model = judged.calibration.rig.cameras[name]
            seen, noise = camera.seen, judged.calibration.noise_px
            px_per_px = 0.025 * model.width_px / noise
            axes.quiver(
                *seen.pixels.T,
                *(px_per_px * seen.residuals_px).T,
                angles="xy",
                scale_units="xy",
                scale=1,
                width=0.0011,
                color="#c3ced5",
                headwidth=0,
                headlength=0,
                headaxislength=0,
            )
            places, means, count = _cell_means(seen.pixels, seen.residuals_px, model.width_px)
            strong = np.linalg.norm(means, axis=1) > _STRONG * noise / np.sqrt(count)
            for chosen, tone in ((~strong, "#7d8f9a"), (strong, _colour(c))):
                axes.quiver(
                    *places[chosen].T,
                    *(4 * px_per_px * means[chosen]).T,
                    angles="xy",
                    scale_units="xy",
                    scale=1,
                    width=0.0045,
                    color=tone,
                    headwidth=3.6,
                    headlength=4,
                    headaxislength=3.6,
                )
            out = _rejected(judged, name)
            if len(out):
                axes.plot(*out.T, "x", color="#b3261e", ms=5, mew=1.2, label="rejected")
                axes.legend(loc="upper right", facecolor="white", frameon=True, framealpha=0.8)
            _draw_frame(axes, judged, name)
            axes.set_xlabel(
                f"x (px);  thin lines {px_per_px:.0f} times enlarged, arrows {4 * px_per_px:.0f}"
            )

    return _png(_frame_height(judged), draw)


def _rejected(judged: Judgement, camera: str) -> Array:
    pixels = judged.calibration.rejected
    if pixels is None:
        return np.zeros((0, 2))
    flat = pixels[:, list(judged.cameras).index(camera)].reshape(-1, 2)
    kept: Array = flat[np.isfinite(flat).all(axis=1)]
    return kept


def _cell_means(pixels: Array, residuals: Array, width_px: int) -> tuple[Array, Array, Array]:
    """Mean places and residuals, and counts, of a square grid's cells with enough points."""
    size = width_px / _CELLS
    cells, which, count = np.unique(
        np.floor(pixels / size).astype(int), axis=0, return_inverse=True, return_counts=True
    )
    totals = np.zeros((len(cells), 4))
    np.add.at(totals, which.ravel(), np.hstack([pixels, residuals]))
    means = (totals / count[:, None])[count >= _MIN_IN_CELL]
    return means[:, :2], means[:, 2:], count[count >= _MIN_IN_CELL].astype(np.float64)


def plot_profiles(judged: Judgement) -> bytes:
    """Residuals against the angle of incidence in water: rms, and mean outward part."""

    def draw(figure: Sheet) -> None:
        above, below = figure.subplots(1, 2)
        for c, (name, camera) in enumerate(judged.cameras.items()):
            _draw_profile(above, below, camera.by_incidence, c, name)
        noise = judged.calibration.noise_px
        above.axhline(noise, color=INK, lw=1.0, ls="--", label="noise")
        below.axhline(0, color=INK, lw=1.0, ls="--")
        above.set_ylim(0, max(above.get_ylim()[1], 1.6 * noise))
        reach = max(np.abs(below.get_ylim()).max(), 0.5 * noise)
        label = "angle to the port's normal outside (deg)"
        above.set(xlabel=label, ylabel="rms of one coordinate (px)")
        below.set(xlabel=label, ylabel="mean outward part (px)", ylim=(-reach, reach))
        above.legend(loc="lower left", ncols=3)

    return _png(3.4, draw)


def plot_coverage(judged: Judgement) -> bytes:
    """Number of points over each frame; red marks corners that none came near."""

    def draw(figure: Sheet) -> None:
        grid = _axes_grid(figure, len(judged.cameras))
        largest = max(int(c.coverage.counts.max()) for c in judged.cameras.values())
        for _, axes, name in _by_camera(grid[0], judged):
            camera = judged.cameras[name]
            model = judged.calibration.rig.cameras[name]
            size = (model.width_px, model.height_px)
            image = axes.imshow(
                np.ma.masked_equal(camera.coverage.counts, 0),
                extent=(0, size[0], size[1], 0),
                cmap=_SEQUENTIAL,
                vmin=0,
                vmax=largest,
                interpolation="nearest",
            )
            axes.set_facecolor("#f1ece6")
            axes.plot(*camera.seen.pixels.T, ".", ms=1.3, color=INK, alpha=0.45)
            for corner in camera.coverage.uncovered:
                _mark_corner(axes, corner, size)
            _draw_frame(axes, judged, name)
        colour_bar(image, grid[0], "points in a cell")

    return _png(_frame_height(judged), draw)


def _mark_corner(axes: Axes, corner: str, size: tuple[int, int]) -> None:
    """A red outline around the region in which a covered corner has a point."""
    wide, high = ((1 - COVERED_REACH) * side / 2 for side in size)
    x = 0.0 if "left" in corner else size[0] - wide
    y = 0.0 if "top" in corner else size[1] - high
    axes.add_patch(
        Rectangle((x, y), wide, high, fill=False, hatch="////", edgecolor="#b3261e", lw=1.5)
    )


def _png(height_in: float, draw: Callable[[Sheet], None], width_in: float = _WIDTH_IN) -> bytes:
    """Draw a figure and return its file; the bytes depend on the numbers only."""
    with figure_style():
        sheet = new_figure(height_in, width_in)
        draw(sheet)
        return png_of(sheet)


def _colour(index: int) -> str:
    """Colour of a camera by its place in the rig."""
    return INKS[index % len(INKS)]


def _axes_grid(figure: Sheet, count: int, rows: int = 1) -> list[list[Axes]]:
    """Axes by row and column."""
    grid = figure.subplots(rows, count, squeeze=False)
    return [list(row) for row in grid]


def _by_camera(
    row: Sequence[Axes], judged: Judgement, label: str = "y (px)"
) -> Iterator[tuple[int, Axes, str]]:
    """Number, titled axes and name of each camera; the first axes carry the label of y."""
    for c, (axes, name) in enumerate(zip(row, judged.cameras, strict=True)):
        axes.set_title(plain_name(name), color=_colour(c))
        axes.set_ylabel(label if c == 0 else "")
        yield c, axes, name


def _draw_frame(axes: Axes, judged: Judgement, camera: str) -> None:
    """The camera's frame, y down."""
    model = judged.calibration.rig.cameras[camera]
    axes.set(xlim=(0, model.width_px), ylim=(model.height_px, 0), aspect="equal")
    axes.grid(visible=False)
    axes.set_xlabel("x (px)")
    for spine in axes.spines.values():
        spine.set_visible(True)


def _frame_height(judged: Judgement, rows: int = 1) -> float:
    """Height of a figure with one column per camera."""
    shapes = [c.height_px / c.width_px for c in judged.calibration.rig.cameras.values()]
    wide = _WIDTH_IN / max(len(shapes), 1.35)
    return rows * (min(max(shapes) * wide * 0.82, 6.0) + 0.75)


def _short(name: str, maximum: int = 18) -> str:
    """The end of a long name."""
    return name if len(name) <= maximum else f"...{name[3 - maximum :]}"


def _draw_profile(above: Axes, below: Axes, found: Profile, index: int, name: str) -> None:
    """A camera's binned residuals, with twice the sigma of each bin as an error bar."""
    count = np.maximum(found.count, 1)
    style: dict[str, Any] = {
        "color": _colour(index),
        "marker": "o",
        "ms": 4,
        "lw": 1.3,
        "elinewidth": 1.0,
        "capsize": 2,
        "label": plain_name(name),
    }
    shift = 0.12 * (found.edges[1] - found.edges[0]) * index
    at = found.centres + shift
    above.errorbar(at, found.rms_px, found.expected_px / np.sqrt(count), **style)
    below.errorbar(at, found.outward_px, 2 * found.expected_px / np.sqrt(count), **style)
    above.set_xlim(0, found.edges[-1])
    below.set_xlim(0, found.edges[-1])


def _label_views(axes: Axes, names: list[str]) -> None:
    """Ticks with the names of views, as many as there is room for."""
    shown = range(0, len(names), -(-len(names) // _MAX_LABELS))
    long = max(len(name) for name in names) > 4
    axes.set_xticks(
        list(shown),
        [plain_name(_short(names[i])) for i in shown],
        rotation=60 if long else 0,
        ha="right" if long else "center",
        rotation_mode="anchor",
    )
