"""Figures of a calibration report: residuals, correlations, uncertainty. All return PNG files."""

from collections.abc import Sequence

import numpy as np

from alice_survey.base.frames import Array
from alice_survey.kit.figure import BAND, INK, INKS, SOFT, Axes, Sheet, colour_bar, plain_name
from camera_calib.judge.figure import (
    DIVERGING,
    axes_grid,
    banded,
    colour,
    draw_frame,
    draw_map,
    draw_profile,
    finish_profile,
    frame_height,
    label_views,
    level_bar,
    png,
    shared_levels,
    short,
)
from camera_calib.judge.judgement import Judgement, short_label

_CELLS = 12
"""Cells across a frame, in which residuals are averaged."""
_FEWEST_IN_CELL = 6
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
                color=colour(c),
                label=plain_name(camera),
            )
            fits = [p for p in judged.pictures if p.camera == camera]
            right.plot(
                [p.range_m for p in fits], [p.rms_px for p in fits], "o", color=colour(c), ms=4
            )
        noise = judged.calibration.noise_px * 2**0.5
        axes.axhline(noise, color=INK, lw=1.1, ls="--", label=f"noise alone ({noise:.3f} px)")
        right.axhline(noise, color=INK, lw=1.1, ls="--")
        right.set(xlabel="distance (m)")
        right.set_xlim(0, right.get_xlim()[1])
        label_views(axes, views)
        axes.set(xlabel="view", ylabel="rms of residuals (px)", xlim=(-0.7, len(views) - 0.3))
        axes.grid(visible=False, axis="x")
        axes.margins(y=0.18)
        axes.legend(ncols=len(cameras) + 1, loc="upper right")

    return png(3.4, draw)


def plot_vectors(judged: Judgement) -> bytes:
    """Residuals over the frame: each one thin, the mean of each cell bold."""

    def draw(figure: Sheet) -> None:
        for c, (axes, (name, camera)) in enumerate(
            zip(axes_grid(figure, len(judged.cameras))[0], judged.cameras.items(), strict=True)
        ):
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
            for chosen, tone in ((~strong, "#7d8f9a"), (strong, colour(c))):
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
            axes.set_title(plain_name(name), color=colour(c))
            draw_frame(axes, judged, name)
            axes.set_xlabel(
                f"x (px);  thin lines {px_per_px:.0f} times enlarged, arrows {4 * px_per_px:.0f}"
            )
            axes.set_ylabel("y (px)" if c == 0 else "")

    return png(frame_height(judged), draw)


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
    means = (totals / count[:, None])[count >= _FEWEST_IN_CELL]
    return means[:, :2], means[:, 2:], count[count >= _FEWEST_IN_CELL].astype(np.float64)


def plot_profiles(judged: Judgement) -> bytes:
    """Residuals against radius and angle of incidence: rms above, mean outward part below."""

    def draw(figure: Sheet) -> None:
        grid = axes_grid(figure, 2, 2)
        for c, (name, camera) in enumerate(judged.cameras.items()):
            for column, found in enumerate((camera.profiles.radius, camera.profiles.incidence)):
                draw_profile(grid[0][column], grid[1][column], found, c, name)
        noise = judged.calibration.noise_px
        for column, label in enumerate(
            (
                "radius from the principal point (px)",
                "angle to the port's normal outside (deg)",
            )
        ):
            grid[0][column].axhline(noise, color=INK, lw=1.0, ls="--", label="noise")
            finish_profile(grid[0][column], grid[1][column], label, noise)

    return png(5.6, draw)


def plot_histogram(judged: Judgement) -> bytes:
    """Residuals in units of their pictures' noise against the normal distribution."""

    def draw(figure: Sheet) -> None:
        sigma_px = judged.calibration.sigma_px[..., None, None]
        edges = np.linspace(-6, 6, 61)
        middle = (edges[1:] + edges[:-1]) / 2
        normal = np.exp(-0.5 * middle**2) / np.sqrt(2 * np.pi)
        for c, (axes, name) in enumerate(
            zip(axes_grid(figure, len(judged.cameras))[0], judged.cameras, strict=True)
        ):
            every = judged.calibration.residuals_px[:, c] / sigma_px[:, c]
            values = every[np.isfinite(every)]
            inside = values[np.abs(values) < edges[-1]]
            axes.hist(
                inside,
                edges,
                weights=np.full(len(inside), 1 / (len(values) * (edges[1] - edges[0]))),
                color=colour(c),
                alpha=0.75,
                log=True,
            )
            axes.plot(middle, normal, color=INK, lw=1.4, label="normal law")
            beyond = float((np.abs(values) > 3).mean())
            axes.set_title(plain_name(name), color=colour(c))
            axes.set(
                xlabel=f"residual / noise;  {beyond:.2%} beyond 3 (normal law: 0.27%)",
                ylim=(1e-5, 1),
                xlim=(-6, 6),
            )
            axes.set_ylabel("density" if c == 0 else "")
            axes.legend(loc="upper right")

    return png(3.2, draw)


def plot_correlation(judged: Judgement) -> bytes:
    """The correlation matrix as a heat map."""
    covariance = judged.calibration.rig.covariance
    if covariance is None:
        raise ValueError("a judged rig has a covariance")
    names, count = covariance.parameters, len(covariance.parameters)

    def draw(figure: Sheet) -> None:
        axes = figure.subplots()
        matrix = covariance.correlation
        image = axes.imshow(matrix, vmin=-1, vmax=1, cmap=DIVERGING, interpolation="nearest")
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
    return png(side - 0.7, draw, side + 0.6)


def _label(name: str) -> str:
    """`left.fx_px` as `left fx`."""
    owner, _, field = name.rpartition(".")
    return f"{short(owner, 12)} {short_label(field)}"


def plot_projection(judged: Judgement) -> bytes:
    """Projection uncertainty over the frames at the working range, plain and compensated."""

    def draw(figure: Sheet) -> None:
        grid = axes_grid(figure, len(judged.cameras), 2)
        for row, (kind, field) in enumerate(
            (("best pose taken", "compensated_px"), ("camera held still", "plain_px"))
        ):
            maps = [getattr(camera.sigma, field) for camera in judged.cameras.values()]
            levels = shared_levels(maps)
            for c, (axes, name, values) in enumerate(
                zip(grid[row], judged.cameras, maps, strict=True)
            ):
                image = draw_map(axes, judged, name, values, levels)
                axes.set_title(f"{plain_name(name)}: {kind}", color=colour(c))
                axes.set_ylabel("y (px)" if c == 0 else "")
            level_bar(image, grid[row], levels, "sigma (px)")

    return png(frame_height(judged, 2), draw)


def plot_ranges(judged: Judgement) -> bytes:
    """Uncertainty against distance: projection, and its effect on stereo."""
    stereo = judged.stereo

    def draw(figure: Sheet) -> None:
        panels = axes_grid(figure, 2 if stereo else 1)[0]
        axes = panels[0]
        for c, (name, camera) in enumerate(judged.cameras.items()):
            at = [r.range_m for r in camera.by_range]
            tone, label = colour(c), plain_name(name)
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

    return png(5.0, draw)


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
            axes_grid(figure, 2)[0],
            (found.shape_m, found.depth_m),
            ("distance, after the best rigid motion (shape)", "distance from the rig"),
            strict=True,
        ):
            levels = shared_levels([1e3 * values])
            image = axes.tricontourf(x, y, 1e3 * values, **banded(levels))
            level_bar(image, axes, levels, "sigma (mm)")
            axes.set(aspect="equal", xlabel="right (m)", ylabel="down (m)", title=title)
            axes.invert_yaxis()
            axes.grid(visible=False)

    return png(4.0, draw)
