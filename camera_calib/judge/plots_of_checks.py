"""Figures of a calibration report: its tests, and what the views cover. All return PNG files."""

from typing import Any

import numpy as np

from alice_survey.base.frames import Array
from alice_survey.kit.figure import (
    BAND,
    INK,
    INKS,
    SOFT,
    Axes,
    Circle,
    Rectangle,
    Sheet,
    colour_bar,
    plain_name,
)
from camera_calib.judge.figure import (
    SEQUENTIAL,
    axes_grid,
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
)
from camera_calib.judge.fit_quality import COVERED_REACH, TILTED_DEG
from camera_calib.judge.judgement import Judgement


def plot_halves(judged: Judgement) -> bytes:
    """Difference of projections of calibrations from either half of the views."""
    found = {name: c.halves for name, c in judged.cameras.items() if c.halves is not None}

    def draw(figure: Sheet) -> None:
        grid = axes_grid(figure, len(found))
        maps = [np.linalg.norm(h.difference_px, axis=-1) for h in found.values()]
        levels = shared_levels(maps)
        for c, (axes, (name, halves), values) in enumerate(
            zip(grid[0], found.items(), maps, strict=True)
        ):
            image = draw_map(axes, judged, name, values, levels)
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
                color=colour(c),
            )
            axes.set_ylabel("y (px)" if c == 0 else "")
        level_bar(image, grid[0], levels, "difference (px)")

    return png(frame_height(judged), draw)


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
        label_views(axes, list(order))
        axes.set(xlabel="view", ylabel="rms of residuals (px)", xlim=(-0.7, len(order) - 0.3))
        axes.set_ylim(0, axes.get_ylim()[1] * 1.2)
        axes.grid(visible=False, axis="x")
        axes.legend(ncols=5, loc="upper right")

    return png(3.1, draw)


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
        left, right = axes_grid(figure, 2)[0]
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

    return png(3.6, draw)


def plot_homographies(judged: Judgement) -> bytes:
    """Residuals of homographies against the radius: rms and mean outward part."""
    found = {n: c.homography for n, c in judged.cameras.items() if c.homography is not None}

    def draw(figure: Sheet) -> None:
        above, below = axes_grid(figure, 2)[0]
        for name, test in found.items():
            index = list(judged.cameras).index(name)
            draw_profile(above, below, test.profile, index, name)
            above.plot(
                test.profile.centres,
                test.profile.expected_px,
                "--",
                color=colour(index),
                lw=1.0,
                label=f"{plain_name(name)}, expected",
            )
        inner = max(test.inner_px for test in found.values())
        finish_profile(above, below, "radius from the principal point (px)", inner)
        above.set_xlabel("radius from the principal point (px)")

    return png(3.5, draw)


def plot_coverage(judged: Judgement) -> bytes:
    """Number of points over each frame; red marks corners that none came near."""

    def draw(figure: Sheet) -> None:
        grid = axes_grid(figure, len(judged.cameras))
        largest = max(int(c.coverage.counts.max()) for c in judged.cameras.values())
        for c, (axes, (name, camera)) in enumerate(
            zip(grid[0], judged.cameras.items(), strict=True)
        ):
            model = judged.calibration.rig.cameras[name]
            size = (model.width_px, model.height_px)
            image = axes.imshow(
                np.ma.masked_equal(camera.coverage.counts, 0),
                extent=(0, size[0], size[1], 0),
                cmap=SEQUENTIAL,
                vmin=0,
                vmax=largest,
                interpolation="nearest",
            )
            axes.set_facecolor("#f1ece6")
            axes.plot(*camera.seen.pixels.T, ".", ms=1.3, color=INK, alpha=0.45)
            for corner in camera.coverage.uncovered:
                _mark_corner(axes, corner, size)
            axes.set_title(plain_name(name), color=colour(c))
            draw_frame(axes, judged, name)
            axes.set_ylabel("y (px)" if c == 0 else "")
        colour_bar(image, grid[0], "points in a cell")

    return png(frame_height(judged), draw)


def _mark_corner(axes: Axes, corner: str, size: tuple[int, int]) -> None:
    """A red outline around the region in which a covered corner has a point."""
    wide, high = ((1 - COVERED_REACH) * side / 2 for side in size)
    x = 0.0 if "left" in corner else size[0] - wide
    y = 0.0 if "top" in corner else size[1] - high
    axes.add_patch(
        Rectangle((x, y), wide, high, fill=False, hatch="////", edgecolor="#b3261e", lw=1.5)
    )


def plot_spread(judged: Judgement) -> bytes:
    """Poses of the target: tilts, and distance against turn."""

    def draw(figure: Sheet) -> None:
        left, right = axes_grid(figure, 2)[0]
        for c, (name, camera) in enumerate(judged.cameras.items()):
            held = camera.spread
            style: dict[str, Any] = {
                "color": colour(c),
                "ms": 4.5 + 3.0 * c,
                "mfc": colour(c) if c == 0 else "none",
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

    return png(4.2, draw)


def _reach(values: Array) -> float:
    return float(np.abs(values).max())
