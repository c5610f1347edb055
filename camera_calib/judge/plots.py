"""Figures of a calibration report, as PNG files: its fit, its uncertainty, its tests, coverage."""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from alice_survey.core.frames import Array
from alice_survey.kit.figure import (
    BAND,
    INK,
    INKS,
    SOFT,
    Axes,
    BoundaryNorm,
    Circle,
    LinearSegmentedColormap,
    MaxNLocator,
    Rectangle,
    Sheet,
    colour_bar,
    figure_style,
    new_figure,
    plain_name,
    png_of,
)
from camera_calib.judge.fit_quality import COVERED_REACH, TILTED_DEG, Profile
from camera_calib.judge.judgement import Judgement, short_label

_SEQUENTIAL = LinearSegmentedColormap.from_list(
    "depth", ["#f4f9fb", "#bcdcea", "#6fb1d1", "#2f7fb0", "#15507f", "#0b2545"]
)
_DIVERGING = LinearSegmentedColormap.from_list(
    "opposed", ["#a63c1f", "#e39b7b", "#fbfbfb", "#86b7d6", "#14548a"]
)
_WIDTH_IN = 10.4
_MAX_LABELS = 45
_WIDE = 5.0
"""Ratio of largest to least value from which levels are logarithmic."""
_FINE, _COARSE, _DECADES = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0), (1.0, 2.0, 5.0), (1.0, 3.0)
_MAX_LEVELS = 11
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
    """Residuals against radius and angle of incidence: rms above, mean outward part below."""

    def draw(figure: Sheet) -> None:
        grid = _axes_grid(figure, 2, 2)
        for c, (name, camera) in enumerate(judged.cameras.items()):
            for column, found in enumerate((camera.by_radius, camera.by_incidence)):
                _draw_profile(grid[0][column], grid[1][column], found, c, name)
        noise = judged.calibration.noise_px
        for column, label in enumerate(
            (
                "radius from the principal point (px)",
                "angle to the port's normal outside (deg)",
            )
        ):
            grid[0][column].axhline(noise, color=INK, lw=1.0, ls="--", label="noise")
            _finish_profile(grid[0][column], grid[1][column], label, noise)

    return _png(5.6, draw)


def plot_histogram(judged: Judgement) -> bytes:
    """Residuals in units of their pictures' noise against the normal distribution."""

    def draw(figure: Sheet) -> None:
        sigma_px = judged.calibration.sigma_px[..., None, None]
        edges = np.linspace(-6, 6, 61)
        middle = (edges[1:] + edges[:-1]) / 2
        normal = np.exp(-0.5 * middle**2) / np.sqrt(2 * np.pi)
        row = _axes_grid(figure, len(judged.cameras))[0]
        for c, axes, _ in _by_camera(row, judged, "density"):
            every = judged.calibration.residuals_px[:, c] / sigma_px[:, c]
            values = every[np.isfinite(every)]
            inside = values[np.abs(values) < edges[-1]]
            axes.hist(
                inside,
                edges,
                weights=np.full(len(inside), 1 / (len(values) * (edges[1] - edges[0]))),
                color=_colour(c),
                alpha=0.75,
                log=True,
            )
            axes.plot(middle, normal, color=INK, lw=1.4, label="normal law")
            beyond = float((np.abs(values) > 3).mean())
            axes.set(
                xlabel=f"residual / noise;  {beyond:.2%} beyond 3 (normal law: 0.27%)",
                ylim=(1e-5, 1),
                xlim=(-6, 6),
            )
            axes.legend(loc="upper right")

    return _png(3.2, draw)


def plot_correlation(judged: Judgement) -> bytes:
    """The correlation matrix as a heat map."""
    covariance = judged.calibration.rig.covariance
    if covariance is None:
        raise ValueError("a judged rig has a covariance")
    names, count = covariance.parameters, len(covariance.parameters)

    def draw(figure: Sheet) -> None:
        axes = figure.subplots()
        matrix = covariance.correlation
        image = axes.imshow(matrix, vmin=-1, vmax=1, cmap=_DIVERGING, interpolation="nearest")
        labels = [plain_name(_label(name)) for name in names]
        size = 8.0 if count <= 34 else 6.0
        axes.set_xticks(range(count), labels, rotation=90, fontsize=size)
        axes.set_yticks(range(count), labels, fontsize=size)
        axes.grid(visible=False)
        owners = [name.rpartition(".")[0] for name in names]
        for i in range(1, count):
            if owners[i] != owners[i - 1]:
                axes.axhline(i - 0.5, color=INK, lw=0.9)
                axes.axvline(i - 0.5, color=INK, lw=0.9)
        for i in range(count):
            for j in range(count):
                if i != j and abs(matrix[i, j]) >= 0.5:
                    strong = abs(matrix[i, j]) > 0.75
                    axes.text(
                        j,
                        i,
                        f"{100 * matrix[i, j]:.0f}",
                        ha="center",
                        va="center",
                        fontsize=size - 2.2,
                        color="white" if strong else INK,
                    )
        label = "correlation (printed in hundredths where 0.5 or more)"
        colour_bar(image, axes, label, shrink=0.6)

    side = min(max(5.0, 0.27 * count + 2.2), 13.0)
    return _png(side - 0.7, draw, side + 0.6)


def _label(name: str) -> str:
    """`left.fx_px` as `left fx`."""
    owner, _, field = name.rpartition(".")
    return f"{_short(owner, 12)} {short_label(field)}"


def plot_projection(judged: Judgement) -> bytes:
    """Projection uncertainty over the frames at the working range, plain and compensated."""

    def draw(figure: Sheet) -> None:
        grid = _axes_grid(figure, len(judged.cameras), 2)
        for row, (kind, field) in enumerate(
            (("best pose taken", "compensated_px"), ("camera held still", "plain_px"))
        ):
            maps = [getattr(camera.sigma, field) for camera in judged.cameras.values()]
            levels = _shared_levels(maps)
            for c, axes, name in _by_camera(grid[row], judged):
                image = _draw_map(axes, judged, name, maps[c], levels)
                axes.set_title(f"{plain_name(name)}: {kind}", color=_colour(c))
            _level_bar(image, grid[row], levels, "sigma (px)")

    return _png(_frame_height(judged, 2), draw)


def plot_ranges(judged: Judgement) -> bytes:
    """Uncertainty against distance: projection, and its effect on stereo."""
    stereo = judged.stereo

    def draw(figure: Sheet) -> None:
        panels = _axes_grid(figure, 2 if stereo else 1)[0]
        axes = panels[0]
        for c, (name, camera) in enumerate(judged.cameras.items()):
            at = [r.range_m for r in camera.by_range]
            tone, label = _colour(c), plain_name(name)
            best = [r.compensated_median_px for r in camera.by_range]
            worst = [r.compensated_worst_px for r in camera.by_range]
            still = [r.plain_median_px for r in camera.by_range]
            axes.plot(at, best, "o-", color=tone, ms=4, label=f"{label}, best pose: median")
            axes.plot(at, worst, "--", color=tone, lw=1.2, label=f"{label}, best pose: worst")
            axes.plot(at, still, ":", color=tone, lw=1.6, label=f"{label}, held still: median")
        ranges = np.concatenate([c.spread.range_m for c in judged.cameras.values()])
        axes.axvspan(ranges.min(), ranges.max(), color=BAND, zorder=0, label="views")
        axes.set(xlabel="distance (m)", ylabel="sigma of a projection (px)")
        axes.set_title("Projection")
        _log_axes(axes)
        _legend_below(axes)
        if stereo:
            _draw_stereo(panels[1], judged)

    return _png(5.0, draw)


def _draw_stereo(axes: Axes, judged: Judgement) -> None:
    at = np.array([s.range_m for s in judged.stereo])

    def line(values: Sequence[float], style: str, tone: str, label: str) -> None:
        axes.plot(at, 1e3 * np.array(values), style, color=tone, ms=4, label=label)

    line([s.noise_m[2] for s in judged.stereo], ":", SOFT, "distance of a point, its noise alone")
    line([s.worst_point_m for s in judged.stereo], "--", INKS[3], "distance, worst in overlap")
    line([s.point_m[2] for s in judged.stereo], "o-", INKS[3], "distance, middle of overlap")
    per_m = [s.length_sigma_m / s.length_m if s.length_m > 0 else np.nan for s in judged.stereo]
    line(per_m, "s-", INKS[2], "length across, per metre")
    axes.set(xlabel="distance (m)", ylabel="sigma (mm)")
    axes.set_title("Stereo")
    _log_axes(axes)
    _legend_below(axes)


def _legend_below(axes: Axes) -> None:
    axes.legend(ncols=2, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.14))


def _log_axes(axes: Axes) -> None:
    axes.set(xscale="log", yscale="log")
    ticks = [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000]
    low, high = axes.get_xlim()
    shown = [t for t in ticks if low <= t <= high]
    axes.set_xticks(shown, [f"{t:g}" for t in shown])
    axes.minorticks_off()
    low, high = axes.get_ylim()
    wide = [t for t in (1e-4, 1e-3, *ticks, 1e4) if low <= t <= high]
    axes.set_yticks(wide, [f"{t:g}" for t in wide])
    axes.set_xlim(*axes.get_xlim())


def plot_stereo_map(judged: Judgement) -> bytes:
    """Uncertainty of triangulated distance over the overlap."""
    found = judged.stereo_map
    if found is None:
        raise ValueError("one camera has no stereo")

    def draw(figure: Sheet) -> None:
        x, y = found.points_rig[:, 0], found.points_rig[:, 1]
        for axes, values, title in zip(
            _axes_grid(figure, 2)[0],
            (found.shape_m, found.depth_m),
            ("distance, after the best rigid motion (shape)", "distance from the rig"),
            strict=True,
        ):
            levels = _shared_levels([1e3 * values])
            image = axes.tricontourf(x, y, 1e3 * values, **_banded(levels))
            _level_bar(image, axes, levels, "sigma (mm)")
            axes.set(aspect="equal", xlabel="right (m)", ylabel="down (m)", title=title)
            axes.invert_yaxis()
            axes.grid(visible=False)

    return _png(4.0, draw)


def plot_halves(judged: Judgement) -> bytes:
    """Difference of projections of calibrations from either half of the views."""
    found = {name: c.halves for name, c in judged.cameras.items() if c.halves is not None}

    def draw(figure: Sheet) -> None:
        grid = _axes_grid(figure, len(found))
        maps = [np.linalg.norm(h.difference_px, axis=-1) for h in found.values()]
        levels = _shared_levels(maps)
        for c, (axes, (name, halves), values) in enumerate(
            zip(grid[0], found.items(), maps, strict=True)
        ):
            image = _draw_map(axes, judged, name, values, levels)
            step = (slice(1, None, 3), slice(1, None, 3))
            places, arrows = halves.pixels[step], halves.difference_px[step]
            longest = float(np.nanquantile(np.concatenate([m.ravel() for m in maps]), 0.9))
            arrows = arrows / np.maximum(
                1.0, np.linalg.norm(arrows, axis=-1, keepdims=True) / longest
            )
            axes.quiver(
                places[..., 0],
                places[..., 1],
                arrows[..., 0],
                arrows[..., 1],
                angles="xy",
                color=INKS[1],
                width=0.004,
                scale=11 * longest,
            )
            axes.set_title(
                f"{plain_name(name)}: {halves.rms_px:.3f} px rms "
                f"({halves.expected_rms_px:.3f} expected)",
                color=_colour(c),
            )
            axes.set_ylabel("y (px)" if c == 0 else "")
        _level_bar(image, grid[0], levels, "difference (px)")

    return _png(_frame_height(judged), draw)


def plot_hold_out(judged: Judgement) -> bytes:
    """Rms of each view, those used and those held out."""
    held, score = judged.held, judged.hold_out
    if held is None or score is None:
        raise ValueError("no views were held out")
    used = held.used
    order = {view.name: i for i, view in enumerate(judged.calibration.views)}

    def draw(figure: Sheet) -> None:
        axes = figure.subplots()
        for values, names, tone, marker, label in (
            (used.residuals_px, [v.name for v in used.views], SOFT, "o", "used"),
            (held.residuals_px, [v.name for v in held.views], INKS[1], "D", "held out"),
        ):
            rms = np.sqrt(np.nanmean((values**2).sum(axis=-1), axis=(1, 2)))
            at = [order[name] for name in names]
            axes.vlines(at, 0, rms, color=tone, lw=1.2)
            axes.plot(at, rms, marker, color=tone, ms=6, label=label)
        axes.axhline(score.used_rms_px, color=SOFT, lw=1.0, label="used, all")
        axes.axhline(score.rms_px, color=INKS[1], lw=1.0, label="held out, all")
        axes.axhline(score.expected_px, color=INK, lw=1.1, ls="--", label="held out, expected")
        _label_views(axes, list(order))
        axes.set(xlabel="view", ylabel="rms of residuals (px)", xlim=(-0.7, len(order) - 0.3))
        axes.set_ylim(0, axes.get_ylim()[1] * 1.2)
        axes.grid(visible=False, axis="x")
        axes.legend(ncols=5, loc="upper right")

    return _png(3.1, draw)


def plot_lengths(judged: Judgement) -> bytes:
    """Errors of triangulated lengths: of each view against its distance, and their histogram."""
    found = [
        (lengths, name, tone, marker)
        for lengths, name, tone, marker in (
            (judged.lengths, "used", INKS[0], "o"),
            (judged.held_lengths, "held out", INKS[1], "D"),
        )
        if lengths is not None and len(lengths.true_m)
    ]

    def draw(figure: Sheet) -> None:
        left, right = _axes_grid(figure, 2)[0]
        for lengths, name, tone, marker in found:
            views, scales, _ = lengths.scales()
            range_m = [lengths.range_m[lengths.view == v].mean() for v in views]
            left.plot(range_m, 1e6 * scales, marker, color=tone, ms=5.5, label=f"{name} views")
            scaled = ((lengths.error_m - lengths.bias_m) / lengths.sigma_m)[lengths.long]
            right.hist(
                np.clip(scaled, -5, 5),
                np.linspace(-5, 5, 41),
                density=True,
                histtype="step" if name != "used" else "stepfilled",
                alpha=1.0 if name != "used" else 0.45,
                lw=1.6,
                color=tone,
                label=f"{name} views",
            )
        left.axhline(0, color=INK, lw=1.0, ls="--")
        left.set(xlabel="distance of the view (m)", ylabel="scale error of long lengths (ppm)")
        left.set_xlim(0, left.get_xlim()[1])
        left.legend()
        at = np.linspace(-5, 5, 201)
        right.plot(at, np.exp(-0.5 * at**2) / np.sqrt(2 * np.pi), color=INK, label="normal law")
        right.set(xlabel="error of a long length / sigma by noise", ylabel="density", xlim=(-5, 5))
        right.legend()

    return _png(3.6, draw)


def plot_homographies(judged: Judgement) -> bytes:
    """Residuals of homographies against the radius: rms and mean outward part."""
    found = {n: c.homography for n, c in judged.cameras.items() if c.homography is not None}

    def draw(figure: Sheet) -> None:
        above, below = _axes_grid(figure, 2)[0]
        for name, test in found.items():
            index = list(judged.cameras).index(name)
            _draw_profile(above, below, test.profile, index, name)
            above.plot(
                test.profile.centres,
                test.profile.expected_px,
                "--",
                color=_colour(index),
                lw=1.0,
                label=f"{plain_name(name)}, expected",
            )
        inner = max(test.inner_px for test in found.values())
        _finish_profile(above, below, "radius from the principal point (px)", inner)
        above.set_xlabel("radius from the principal point (px)")

    return _png(3.5, draw)


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


def plot_spread(judged: Judgement) -> bytes:
    """Poses of the target: tilts about both axes, and tilt against distance."""

    def draw(figure: Sheet) -> None:
        left, right = _axes_grid(figure, 2)[0]
        for c, (name, camera) in enumerate(judged.cameras.items()):
            held = camera.spread
            style: dict[str, Any] = {
                "color": _colour(c),
                "ms": 4.5 + 3.0 * c,
                "mfc": _colour(c) if c == 0 else "none",
                "mew": 1.3,
                "label": plain_name(name),
            }
            left.plot(*held.tilt_xy_deg.T, "o", **style)
            right.plot(held.range_m, np.linalg.norm(held.tilt_xy_deg, axis=1), "o", **style)
        reach = max(30.0, 1.1 * max(_reach(c.spread.tilt_xy_deg) for c in judged.cameras.values()))
        left.axhline(0, color=SOFT, lw=0.8)
        left.axvline(0, color=SOFT, lw=0.8)
        left.add_patch(Circle((0, 0), TILTED_DEG, color=BAND, zorder=0))
        left.set(
            xlim=(-reach, reach),
            ylim=(-reach, reach),
            aspect="equal",
            xlabel="tilt about the camera's x axis (deg)",
            ylabel="tilt about its y axis (deg)",
        )
        right.axhspan(0, TILTED_DEG, color=BAND, zorder=0)
        right.set(xlabel="distance (m)", ylabel="tilt (deg)")
        right.set_xlim(0, right.get_xlim()[1])
        right.set_ylim(0, right.get_ylim()[1])
        right.legend(loc="lower left")

    return _png(4.2, draw)


def _reach(values: Array) -> float:
    return float(np.abs(values).max())


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


def _finish_profile(above: Axes, below: Axes, label: str, noise: float) -> None:
    """Limits, labels and the zero line of a pair of profile axes."""
    above.set(ylabel="rms of one coordinate (px)")
    above.set_ylim(0, max(above.get_ylim()[1], 1.6 * noise))
    below.axhline(0, color=INK, lw=1.0, ls="--")
    reach = max(np.abs(below.get_ylim()).max(), 0.5 * noise)
    below.set(ylim=(-reach, reach), xlabel=label, ylabel="mean part outward (px)")
    above.legend(loc="lower left", ncols=3)


def _shared_levels(maps: Sequence[Array]) -> Array:
    """About ten round levels for maps together: evenly spaced, or by factors where values differ.

    Factors show the middle of a frame as well as its corners, where an uncertainty may be a hundred
    times larger.
    """
    known = np.concatenate([values[np.isfinite(values)] for values in maps])
    known = known[known > 0]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    if not len(known) or high < _WIDE * low:
        even = MaxNLocator(9).tick_values(low, max(high, low + 1e-9))
        return np.asarray(even, dtype=np.float64)
    low = max(low, float(np.quantile(known, 0.02)))
    for steps in (_FINE, _COARSE, _DECADES):
        decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
        series = np.array([step * 10.0**d for d in decades for step in steps])
        first = max(int(np.searchsorted(series, low, side="right")) - 1, 0)
        levels = series[first : int(np.searchsorted(series, high)) + 1]
        if len(levels) <= _MAX_LEVELS:
            break
    return np.asarray(levels, dtype=np.float64)


def _banded(levels: Array) -> dict[str, Any]:
    """Arguments of a filled contour whose bands have evenly spaced colours."""
    return {
        "levels": levels,
        "cmap": _SEQUENTIAL,
        "norm": BoundaryNorm(levels.tolist(), _SEQUENTIAL.N),
        "extend": "min",
    }


def _level_bar(image: Any, axes: Axes | list[Axes], levels: Array, text: str) -> None:
    """A colour bar that names every level."""
    bar = colour_bar(image, axes, text, spacing="uniform")
    bar.set_ticks(levels.tolist(), labels=[f"{level:.4g}" for level in levels])
    bar.minorticks_off()


def _draw_map(axes: Axes, judged: Judgement, name: str, values: Array, levels: Array) -> Any:
    """A filled map over a frame, with contour lines that carry their numbers."""
    pixels = judged.cameras[name].map_pixels
    x, y = pixels[0, :, 0], pixels[:, 0, 1]
    shown = np.ma.masked_invalid(values)
    image = axes.contourf(x, y, shown, **_banded(levels))
    lines = axes.contour(x, y, shown, levels=levels[1:-1], colors="white", linewidths=0.7)
    middle = float(levels[len(levels) // 2])
    for label in axes.clabel(lines, levels[1:-1:2], fmt="%g", fontsize=7.5):
        label.set_color("white" if float(label.get_text()) >= middle else INK)
    axes.set_facecolor("#d9d9d9")
    _draw_frame(axes, judged, name)
    return image


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
