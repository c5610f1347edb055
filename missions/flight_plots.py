"""Pictures of a flight: plan, true track and navigation, and how far each is from the other."""

import math
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Polygon as Outline

from alice_survey.frames import Array, attitude_from_rotation
from missions.navigation import NavigationLog
from missions.plan_file import Plan
from missions.track import Flight

_PLAN, _TRUE, _NAV, _AREA, _BAND = "#95a5a6", "#1b4f72", "#ca6f1e", "#c8553d", "#eaf2f8"
_DRAWN = 20_000
"""Most points of a curve."""


def draw_flight(path: Path, plan: Plan, flight: Flight, log: NavigationLog) -> None:
    """Draw a map of plan, true track and navigation beside strips of the errors."""
    figure = Figure(figsize=(13, 7.5), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(4, 2, width_ratios=(1.25, 1))
    chart = figure.add_subplot(grid[:, 0])
    strips = [figure.add_subplot(grid[0, 1])]
    strips += [figure.add_subplot(grid[i, 1], sharex=strips[0]) for i in (1, 2, 3)]
    _draw_chart(chart, plan, flight, log)
    _draw_strips(strips, plan, flight, log)
    figure.savefig(path, dpi=120, metadata={"Software": None})


def line_errors(plan: Plan, flight: Flight) -> tuple[Array, Array]:
    """How far the left port's glass is off its line, at each moment of the flight.

    Returns:
        Cross-track error, (T,) metres to starboard, and heading error, (T,) radians; NaN between
        lines.
    """
    time_s = flight.truth.time_s
    cross, heading = np.full(len(time_s), np.nan), np.full(len(time_s), np.nan)
    headings = attitude_from_rotation(flight.truth.ned_from_body.rotation)[:, 2]
    lines = np.asarray(flight.trigger_line)
    for index, line in enumerate(plan.lines):
        times = flight.trigger_s[lines == index]
        on_line = (time_s >= times[0]) & (time_s <= times[-1])
        off = flight.glass_ned[on_line, :2] - np.array(line.start_ne_m)
        angle = line.heading_rad
        cross[on_line] = off @ np.array([-math.sin(angle), math.cos(angle)])
        heading[on_line] = np.angle(np.exp(1j * (headings[on_line] - angle)))
    return cross, heading


def _draw_chart(axes: Axes, plan: Plan, flight: Flight, log: NavigationLog) -> None:
    axes.set_aspect("equal")
    axes.set_facecolor("#fbfcfc")
    axes.grid(color="#e5e8e8", lw=0.6)
    axes.set_axisbelow(True)
    corners = [(east, north) for north, east in plan.area_ne_m]
    axes.add_patch(Outline(corners, fill=False, edgecolor=_AREA, lw=1.6, ls="--", label="area"))
    for index, line in enumerate(plan.lines):
        (north, east), (north_1, east_1) = line.start_ne_m, line.end_ne_m
        label = "planned lines" if index == 0 else None
        axes.plot([east, east_1], [north, north_1], color=_PLAN, lw=3.2, alpha=0.7, label=label)
    some = _thin(len(flight.truth.time_s))
    true = flight.truth.ned_from_body.translation[some]
    glass, nav = flight.glass_ned[some], log.position_ned[some]
    axes.plot(glass[:, 1], glass[:, 0], color=_TRUE, lw=1.1, label="true track of the left port")
    axes.plot(true[:, 1], true[:, 0], color=_TRUE, lw=0.8, ls=":", label="true track of the body")
    axes.plot(nav[:, 1], nav[:, 0], color=_NAV, lw=0.9, label="navigation (body)")
    places = np.column_stack(
        [np.interp(flight.trigger_s, flight.truth.time_s, axis) for axis in flight.glass_ned.T]
    )
    axes.scatter(places[:, 1], places[:, 0], s=7, color="black", lw=0, zorder=5, label="pictures")
    axes.set_xlabel("east, m")
    axes.set_ylabel("north, m")
    axes.set_title(f"{plan.name}: the flight", loc="left", fontsize=12, weight="bold")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.08), ncol=3, frameon=False, fontsize=8)


def _draw_strips(strips: list[Axes], plan: Plan, flight: Flight, log: NavigationLog) -> None:
    time_s = flight.truth.time_s
    some = _thin(len(time_s))
    t = time_s[some]
    cross, heading = line_errors(plan, flight)
    attitude = np.rad2deg(attitude_from_rotation(flight.truth.ned_from_body.rotation))
    off = log.position_ned - flight.truth.ned_from_body.translation
    for axes in strips:
        for index in range(len(plan.lines)):
            times = flight.trigger_s[np.asarray(flight.trigger_line) == index]
            axes.axvspan(times[0], times[-1], color=_BAND, lw=0)
        axes.axhline(0, color="#7f8c8d", lw=0.6)
        axes.grid(axis="y", color="#e5e8e8", lw=0.5)
        axes.margins(x=0.01)
    strips[0].plot(t, cross[some] * 100, color=_TRUE, lw=0.9)
    strips[0].set_ylabel("cross-track, cm")
    strips[0].set_title(
        f"on lines (shaded): cross-track {_rms(cross) * 100:.1f} cm rms, heading "
        f"{math.degrees(_rms(heading)):.1f}° rms",
        loc="left",
        fontsize=9,
    )
    strips[1].plot(t, attitude[some, 0], color="#884ea0", lw=0.9, label="roll")
    strips[1].plot(t, attitude[some, 1], color="#229954", lw=0.9, label="pitch")
    strips[1].plot(t, np.rad2deg(heading[some]), color=_TRUE, lw=0.9, label="heading error")
    strips[1].set_ylabel("attitude, deg")
    strips[2].plot(t, log.altitude_m[some], color=_NAV, lw=0.5, label="navigation")
    strips[2].axhline(plan.altitude_m, color=_PLAN, lw=1.5, label="planned")
    strips[2].set_ylabel("altitude, m")
    spread = 0.15 + 4 * float(log.altitude_m.std())
    strips[2].set_ylim(plan.altitude_m - spread, plan.altitude_m + spread)
    strips[3].plot(t, off[some, 0], color=_TRUE, lw=1.0, label="north")
    strips[3].plot(t, off[some, 1], color=_NAV, lw=1.0, label="east")
    sigma = log.sigma_horizontal_m[some]
    strips[3].fill_between(t, -sigma, sigma, color=_NAV, alpha=0.15, lw=0, label="logged sigma")
    strips[3].set_ylabel("navigation error, m")
    strips[3].set_xlabel("time, s")
    for axes in strips[1:]:
        axes.legend(
            loc="lower right", bbox_to_anchor=(1.0, 0.97), ncol=3, fontsize=7.5, frameon=False
        )


def _rms(values: Array) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def _thin(count: int) -> slice:
    return slice(None, None, max(1, count // _DRAWN))
