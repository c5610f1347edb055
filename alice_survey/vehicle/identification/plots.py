"""Plots of an identification: measured and simulated motion."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from alice_survey.base.frames import Array
from alice_survey.kit.figure import Axes, figure_style, new_figure, save_figure
from alice_survey.vehicle.identification.validation import MotionValidation

Places = NDArray[np.intp]
_MEASURED, _MODEL, _CONSTANT = "#95a5a6", "#1b4f72", "#ca6f1e"
_NAMES = ("u, m/s", "v, m/s", "w, m/s", "p, deg/s", "q, deg/s", "r, deg/s")
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


def _limit(strip: Axes, values: Array, least: float) -> None:
    """Limits that include nearly all values: diverging ones leave the strip."""
    known = values[np.isfinite(values)]
    if not len(known):
        return
    low, high = np.percentile(known, [0.2, 99.8])
    middle, half = 0.5 * (low + high), max(0.6 * (high - low), least)
    strip.set_ylim(middle - half, middle + half)
