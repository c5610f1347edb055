"""Figures of identification: measured and simulated motion over time."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.frames import Array
from alice_survey.kit.figure import Axes, figure_style, new_figure, save_figure
from alice_survey.sim.vehicle.identification.validation import MotionValidation

Places = NDArray[np.intp]
_MEASURED, _MODEL, _CONSTANT = "#95a5a6", "#1b4f72", "#ca6f1e"
_NAMES = ("u, m/s", "v, m/s", "w, m/s", "p, deg/s", "q, deg/s", "r, deg/s")
_MARKED = 40
"""Most starts that are marked."""
_DRAWN = 8000
"""Most points of a curve."""
_LEAST = 0.02
"""Least height of a strip, m/s; in degrees per second, 100 times that."""


@figure_style()
def draw_motion(path: Path, title: str, found: MotionValidation) -> None:
    """Draw measured and simulated velocities and rates over time, with the fit of each.

    Args:
        path: PNG, PDF or SVG.
        title: title of the plot.
        found: what to draw.
    """
    figure = new_figure(8.5, 13)
    axes = figure.subplots(3, 2, sharex=True)
    units = np.array([1.0] * 3 + [180.0 / np.pi] * 3)
    fits, constant_fits = found.fit_percent, found.constant_fit_percent
    time_s, gaps = _with_gaps(found.time_s)
    for k in range(6):
        strip = axes[k % 3, k // 3]
        measured, model, constant = (
            _series(table[:, k] * units[k], gaps)
            for table in (found.measured, found.simulated, found.constant)
        )
        some = slice(None, None, max(len(time_s) // _DRAWN, 1))
        if np.isfinite(fits[k]):
            strip.plot(time_s[some], constant[some], color=_CONSTANT, lw=0.8, alpha=0.8)
        strip.plot(time_s[some], measured[some], ".", color=_MEASURED, ms=2.5)
        strip.plot(time_s[some], model[some], color=_MODEL, lw=1.1)
        strip.set_ylabel(_NAMES[k])
        fit = "follows the log"
        if np.isfinite(fits[k]):
            fit = f"fit: model {fits[k]:.0f} %, constant {constant_fits[k]:.0f} %"
        strip.set_title(fit, fontsize=9)
        _limit(strip, np.concatenate([measured, model]), _LEAST if k < 3 else 100 * _LEAST)
    for strip in axes[2]:
        strip.set_xlabel("time, s")
    figure.suptitle(title, x=0.01, ha="left", fontsize=12, weight="bold")
    handles = [
        figure.axes[0].plot([], [], ".", color=_MEASURED, label="measured")[0],
        figure.axes[0].plot([], [], color=_MODEL, label="model")[0],
        figure.axes[0].plot([], [], color=_CONSTANT, label="constant velocity")[0],
    ]
    figure.legend(handles=handles, loc="outside upper right", ncol=3, fontsize=9)
    save_figure(figure, path, dpi=110)


@figure_style()
def draw_replay(
    path: Path,
    title: str,
    time_s: Array,
    measured: Array,
    simulated: Array,
    starts: Sequence[int],
    names: Sequence[str],
) -> None:
    """Draw measured and simulated motion of a whole log, three axes a column.

    Args:
        path: PNG, PDF or SVG.
        title: title of the plot.
        time_s: (T,)
        measured: (T, K) dots; an axis that nothing measured shows the simulation alone.
        simulated: (T, K) a line, broken where it starts from what is measured.
        starts: those rows.
        names: (K,) labels of the axes.
    """
    columns = len(names) // 3
    figure = new_figure(8.5, 4.6 * columns)
    axes = figure.subplots(3, columns, sharex=True)
    some = slice(None, None, max(len(time_s) // _DRAWN, 1))
    broken = simulated.copy()
    # A line that joined two starts would show motion that nobody simulated.
    broken[[row - 1 for row in starts[1:]]] = np.nan
    turning = [name.split(",")[0] in ("roll", "heading") for name in names]
    for k, name in enumerate(names):
        strip = axes[k % 3, k // 3]
        model, truth = broken[:, k], measured[:, k]
        if turning[k]:
            model, truth = _unbroken(model), _unbroken(truth)
        strip.plot(time_s[some], truth[some], ".", color=_MEASURED, ms=2.5)
        strip.plot(time_s[some], model[some], color=_MODEL, lw=1.0)
        for row in starts if len(starts) <= _MARKED else ():
            strip.axvline(time_s[row], color=_CONSTANT, lw=0.8, alpha=0.6)
        strip.set_ylabel(name)
    for strip in axes[2]:
        strip.set_xlabel("time, s")
    figure.suptitle(title, x=0.01, ha="left", fontsize=12, weight="bold")
    handles = [
        axes[0, 0].plot([], [], ".", color=_MEASURED, label="measured")[0],
        axes[0, 0].plot([], [], color=_MODEL, label="model, open loop")[0],
        axes[0, 0].plot([], [], color=_CONSTANT, label="start from the measured")[0],
    ]
    figure.legend(handles=handles, loc="outside upper right", ncol=3, fontsize=9)
    save_figure(figure, path, dpi=110)


def _unbroken(angles_deg: Array) -> Array:
    """Angles, (T,), with NaN where they jump from one end of the circle to the other."""
    shown = angles_deg.copy()
    shown[1:][np.abs(np.diff(angles_deg)) > 180.0] = np.nan
    return shown


def _with_gaps(time_s: Array) -> tuple[Array, Places]:
    """Times with one more where curves should break, and the places of those.

    Logs follow one another, each from where the last ended.
    """
    steps = np.diff(time_s)
    time_s = time_s.copy()
    for place in np.flatnonzero(steps <= 0) + 1:
        time_s[place:] += time_s[place - 1] - time_s[place]
    usual = np.median(steps) if len(steps) else 1.0
    gaps = np.flatnonzero((steps > 10 * usual) | (steps <= 0)) + 1
    longer: Array = np.insert(time_s, gaps, time_s[gaps])
    return longer, gaps


def _series(values: Array, gaps: Places) -> Array:
    broken: Array = np.insert(values, gaps, np.nan)
    return broken


def _limit(strip: Axes, values: Array, minimum: float) -> None:
    """Limits that include nearly all values: diverging ones leave the strip."""
    known = values[np.isfinite(values)]
    if not len(known):
        return
    low, high = np.percentile(known, [0.2, 99.8])
    middle, half = 0.5 * (low + high), max(0.6 * (high - low), minimum)
    strip.set_ylim(middle - half, middle + half)
