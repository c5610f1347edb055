"""Pictures of a flight: how near the plan it came, and what the vehicle did for it."""

import itertools
import math
import textwrap
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from alice_survey.core.frames import Array
from alice_survey.kit.figure import (
    Axes,
    LineCollection,
    Sheet,
    colour_bar,
    figure_style,
    new_figure,
    save_figure,
)
from alice_survey.sim.vehicle.navigation import tick as navigation
from alice_survey.sim.vehicle.pilot.memory import (
    ABORT,
    APPROACH,
    ASCEND,
    DIVE,
    FOLLOW,
    PHASE,
    WANTED_SURGE,
)
from alice_survey.sim.vehicle.simulator import Flown
from missions.coverage.drawing import draw_polygons
from missions.fly.flight_records import rpm_of, true_velocity
from missions.fly.flight_route import whole_route
from missions.values.flight import Flight, rms
from missions.values.plan_file import Plan

PLAN, TRUE, NAV, AREA, BAND = "#95a5a6", "#1b4f72", "#ca6f1e", "#c8553d", "#eaf2f8"
_ROLL, _PITCH = "#884ea0", "#229954"
_THRUSTERS = (
    "#1b4f72", "#ca6f1e", "#229954", "#884ea0", "#c0392b", "#7f8c8d", "#5dade2", "#b7950b",
)  # fmt: skip
_ALLOWED, _HOME = "#566573", "#27ae60"
_WAY_POINTS = 4000
_DRAWN = 20_000
"""Most points of a curve."""
_ROOM = 140
"""Characters that have room above a strip ..."""
_MARK = 6
"""... of which the mark of a curve takes so many."""
_BOLD = 1.25
"""Width of a character of a title."""
_LINE_PT = 11.0
_NAMED = 5
"""Most curves named in a row."""
_SPREAD_SIGMAS = 2.0
"""The band of the navigation error: 95 % of the time within it."""
_PHASES = {
    DIVE: "dive",
    APPROACH: "approach",
    FOLLOW: "survey",
    ASCEND: "ascent",
    ABORT: "abort",
}


@figure_style()
def draw_flight(path: Path, flight: Flight) -> None:
    """Draw a map of plan, true track and navigation next to strips of the errors."""
    figure, chart, strips = _sheet(6)
    _draw_plan(chart, flight.plan)
    some = thin(len(flight.line))
    following = flight.flown.report[some, PHASE] == FOLLOW
    true, believed = flight.glass_ned[some, :2], flight.believed_glass_ned[some, :2]
    for track, colour, label in (
        (true, TRUE, "true track of the left port"),
        (believed, NAV, "where navigation had it"),
    ):
        chart.plot(*_only(track, following), color=colour, lw=1.0, label=label)
        chart.plot(*_only(track, ~following), color=colour, lw=0.7, ls=":")
    places = np.column_stack(
        [np.interp(flight.trigger_s, flight.truth.time_s, axis) for axis in flight.glass_ned.T]
    )
    chart.scatter(places[:, 1], places[:, 0], s=6, color="black", lw=0, zorder=5, label="pictures")
    _end_chart(chart, f"{flight.plan.name}: the flight of {flight.vehicle.name}, {flight.ending}")

    cross, heading = flight.line_errors
    _draw_cross_track(strips[0], flight, cross)
    _draw_attitude(strips[1:3], flight, heading)
    _draw_altitude(strips[3], flight)
    _draw_navigation_error(strips[4:], flight)
    _end_strips(figure, strips, flight)
    save_figure(figure, path, dpi=120)


@figure_style()
def draw_vehicle(path: Path, flight: Flight) -> None:
    """Draw the track, coloured by speed, next to strips of speed, roll, thrusters and power."""
    craft = flight.vehicle
    main = [t.name for t in craft.thrusters if abs(t.direction_body[0]) > 0.5]
    lateral = [
        t.name for t in craft.thrusters if abs(t.direction_body[1]) > 0.5 and t.name not in main
    ]
    other = [t.name for t in craft.thrusters if t.name not in (*main, *lateral)]
    groups = [group for group in (main, lateral, other) if group]
    figure, chart, strips = _sheet(4 + len(groups) + bool(craft.fins))
    velocity = true_velocity(flight.flown)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    _draw_plan(chart, flight.plan)
    _draw_speeds(chart, flight, speed)
    _end_chart(chart, f"{flight.plan.name}: {flight.vehicle.name} over the plan")

    _draw_surge(strips[0], flight, velocity[:, 0], speed)
    _draw_roll(strips[1], flight)
    for axes, group in zip(strips[2:], groups, strict=False):
        _draw_thrusters(axes, flight, group)
    if craft.fins:
        _draw_fins(strips[-3], flight)
    _draw_power(strips[-2], flight)
    _draw_current(strips[-1], flight)
    _end_strips(figure, strips, flight)
    save_figure(figure, path, dpi=120)


def line_spans(flight: Flight) -> list[tuple[float, float]]:
    """When each line was begun and left, seconds."""
    on = np.concatenate([[-1.0], flight.line, [-1.0]])
    edges = np.flatnonzero(np.diff(on) != 0)
    time_s = flight.truth.time_s
    return [
        (float(time_s[first]), float(time_s[last - 1]))
        for first, last in itertools.pairwise(edges)
        if flight.line[first] >= 0
    ]


def true_current(flown: Flown) -> Array:
    """(T, 2) current at the vehicle towards north and east: over ground minus through the water."""
    through = Rotation.from_quat(flown.truth[:, 3:7]).apply(flown.state[:, 7:10])
    return np.asarray((flown.truth[:, 7:10] - through)[:, :2])


def thin(count: int) -> slice:
    """Every n-th of many points, so that a curve stays light."""
    return slice(None, None, max(1, math.ceil(count / _DRAWN)))


def draw_lines(axes: Axes, plan: Plan) -> None:
    """The planned lines of a map, and how a map of ours looks."""
    axes.set_aspect("equal")
    axes.set_facecolor("#fbfcfc")
    ends = [(line.start_ne_m[::-1], line.end_ne_m[::-1]) for line in plan.lines]
    axes.add_collection(
        LineCollection(ends, colors=PLAN, linewidths=3.2, alpha=0.7, label="planned lines")
    )
    axes.set_xlabel("east, m")
    axes.set_ylabel("north, m")


def _sheet(strips: int) -> tuple[Sheet, Axes, list[Axes]]:
    """A picture with a map and strips that share their time."""
    figure = new_figure(9.5, 15)
    grid = figure.add_gridspec(strips, 2, width_ratios=(1, 1.15))
    chart = figure.add_subplot(grid[:, 0])
    first = figure.add_subplot(grid[0, 1])
    return figure, chart, [
        first,
        *(figure.add_subplot(grid[i, 1], sharex=first) for i in range(1, strips)),
    ]  # fmt: skip


def _draw_plan(axes: Axes, plan: Plan) -> None:
    """Lines and ways, the survey area with its holes, where the vehicle may be, and home."""
    draw_lines(axes, plan)
    route = whole_route(plan)
    way = route.places(np.linspace(0.0, route.length_m, _WAY_POINTS))
    axes.plot(way[:, 1], way[:, 0], color=PLAN, lw=0.8, zorder=1, label="planned way")
    area = plan.area
    draw_polygons(axes, area.survey, "area", edgecolor=AREA, lw=1.6, ls="--")
    draw_polygons(axes, area.allowed, "may be within", edgecolor=_ALLOWED, lw=0.9, ls=":")
    draw_polygons(
        axes, area.no_go, "no-go zone", facecolor="#f5b7b1", edgecolor=AREA, hatch="xxx", alpha=0.5
    )
    north, east = plan.home_ne_m
    axes.plot(east, north, "D", ms=7, mfc=_HOME, mec="white", zorder=6, ls="", label="home")


def _end_chart(axes: Axes, title: str) -> None:
    axes.set_anchor("N")
    axes.set_title(textwrap.fill(title, 60), loc="left", fontsize=12, weight="bold")
    axes.legend(
        loc="upper center", bbox_to_anchor=(0.5, 0.0), borderaxespad=4.5, ncol=3,
        fontsize=8,
    )  # fmt: skip


def _end_strips(figure: Sheet, strips: list[Axes], flight: Flight) -> None:
    """Shade the lines, name the phases, and leave the times to the last strip."""
    spans = line_spans(flight)
    for axes in strips:
        for begin, end in spans:
            axes.axvspan(begin, end, color=BAND, lw=0, zorder=0)
        axes.grid(visible=False, axis="x")
        axes.margins(x=0.005)
        axes.tick_params(labelsize=8)
        axes.yaxis.label.set_size(8.5)
        axes.tick_params(labelbottom=axes is strips[-1])
    time_s = flight.truth.time_s
    strips[-1].set_xlabel("time, s (lines shaded)", fontsize=9)
    strips[0].set_xlim(-0.005 * time_s[-1], 1.005 * time_s[-1])
    phase = flight.flown.report[:, PHASE]
    begins = np.concatenate([[0], np.flatnonzero(np.diff(phase)) + 1])
    for axes in strips:
        for row in begins[1:]:
            axes.axvline(time_s[row], color="#aab7b8", lw=0.7, ls="--", zorder=1)
    ends = np.concatenate([begins[1:], [len(phase)]])
    for first, last in zip(begins, ends, strict=True):
        name = _PHASES.get(int(phase[first]))
        if name is not None and last - first > 0.04 * len(phase):
            middle = float(time_s[first] + time_s[last - 1]) / 2
            strips[-1].annotate(
                name, xy=(middle, 0.0), xycoords=("data", "axes fraction"), xytext=(0, 3),
                textcoords="offset points", ha="center", fontsize=7.5, color="#34495e",
            )  # fmt: skip
    figure.align_ylabels(strips)


def _legend(axes: Axes, title: str = "") -> None:
    """Names of the curves above a strip, to the right, and a title to the left, or above both."""
    names = axes.get_legend_handles_labels()[1]
    longest = max((len(name) for name in names), default=0) + _MARK
    columns = max(1, min(len(names), _NAMED, _ROOM // longest))
    width = _BOLD * len(title) + sum(len(name) + _MARK for name in names)
    fits = width <= _ROOM and len(names) <= _NAMED
    lines = 0 if fits else math.ceil(len(names) / columns)
    if names:
        axes.legend(
            loc="lower right", bbox_to_anchor=(1.0, 0.95), ncol=_NAMED if fits else columns,
            fontsize=7.5, borderaxespad=0.0, columnspacing=1.2, handlelength=1.6,
        )  # fmt: skip
    if title:
        axes.set_title(title, loc="left", fontsize=8.5, pad=3 + _LINE_PT * lines)


def _only(track: Array, rows: Array) -> tuple[Array, Array]:
    """East and north of some rows, with gaps where others are."""
    kept = np.where(rows[:, None], track, np.nan)
    return kept[:, 1], kept[:, 0]


def _plot(
    axes: Axes, flight: Flight, values: Array, colour: str, label: str | None = None, **style: float
) -> None:
    """A curve of values, (T,), over the time of the flight."""
    some = thin(len(values))
    axes.plot(flight.truth.time_s[some], values[some], color=colour, label=label, **style)


def _zero(axes: Axes, label: str) -> None:
    """A line at zero, and the name of what deviates from it."""
    axes.axhline(0, color="#7f8c8d", lw=0.6)
    axes.set_ylabel(label)


def _draw_cross_track(axes: Axes, flight: Flight, cross: Array) -> None:
    believed = flight.believed_cross_track
    _plot(axes, flight, cross, TRUE, "true", lw=1.0)
    _plot(axes, flight, believed, NAV, "believed", lw=0.9)
    _zero(axes, "cross-track, m")
    known = not np.isnan(cross).all()
    said = f"on lines {rms(cross):.3f} m rms true, {rms(believed):.3f} m believed"
    _legend(axes, said if known else "no line was reached")


def _draw_attitude(strips: list[Axes], flight: Flight, heading: Array) -> None:
    degrees, attitude = np.rad2deg(heading), np.rad2deg(flight.attitude_rad)
    _plot(strips[0], flight, degrees, TRUE, lw=0.9)
    _zero(strips[0], "heading error, °")
    if not np.isnan(heading).all():
        strips[0].set_title(f"on lines {rms(degrees):.2f}° rms", loc="left", fontsize=8.5, pad=3)
    _plot(strips[1], flight, attitude[:, 0], _ROLL, "roll", lw=0.8)
    _plot(strips[1], flight, attitude[:, 1], _PITCH, "pitch", lw=0.8)
    _zero(strips[1], "attitude, °")
    _legend(strips[1])


def _draw_altitude(axes: Axes, flight: Flight) -> None:
    following = flight.flown.report[:, PHASE] == FOLLOW
    altitude, wanted = flight.log.altitude_m, flight.plan.altitude_m
    _plot(axes, flight, altitude, NAV, "as measured", lw=0.7)
    axes.axhline(wanted, color=PLAN, lw=1.5, label="planned")
    axes.set_ylabel("altitude, m")
    off = np.abs(altitude[following] - wanted)
    known = off[~np.isnan(off)]
    spread = max(0.1, 1.2 * float(known.max())) if len(known) else 1.0
    axes.set_ylim(wanted - spread, wanted + spread)
    _legend(axes)


def _draw_navigation_error(strips: list[Axes], flight: Flight) -> None:
    some = thin(len(flight.line))
    off = flight.log.position_ned - flight.truth.ned_from_body.translation
    columns = navigation.LOG_COLUMNS
    for axis, (axes, name) in enumerate(zip(strips, ("north", "east"), strict=True)):
        band = _SPREAD_SIGMAS * flight.flown.navigation[some, columns.index(f"sigma_{name}_m")]
        axes.fill_between(
            flight.truth.time_s[some], -band, band, color=NAV, alpha=0.18, lw=0,
            label=f"±{_SPREAD_SIGMAS:g} logged sigmas",
        )  # fmt: skip
        _plot(axes, flight, off[:, axis], TRUE, "believed minus true", lw=1.0)
        _zero(axes, f"{name} error, m")
    _legend(strips[0], "navigation")


def _draw_speeds(axes: Axes, flight: Flight, speed: Array) -> None:
    some = thin(len(speed))
    points = flight.glass_ned[some, 1::-1]
    pieces = np.stack([points[:-1], points[1:]], axis=1)
    maximum = float(np.percentile(speed, 99.5))
    drawn = LineCollection(
        pieces,
        array=speed[some][:-1],
        cmap="viridis",
        linewidths=1.6,
        zorder=4,
        clim=(0.0, maximum),
    )
    axes.add_collection(drawn)
    axes.autoscale()
    label = "true speed over ground of the body's origin, m/s"
    colour_bar(drawn, axes, label, location="top", extend="max", shrink=0.7)


def _draw_surge(axes: Axes, flight: Flight, surge: Array, speed: Array) -> None:
    wanted = flight.flown.report[:, WANTED_SURGE]
    _plot(axes, flight, speed, "#aab7b8", "speed over ground", lw=0.8)
    _plot(axes, flight, surge, TRUE, "surge", lw=0.9)
    _plot(axes, flight, wanted, NAV, "wanted surge of the followed point", lw=0.9)
    axes.set_ylabel("speed, m/s")
    _legend(axes)


def _draw_roll(axes: Axes, flight: Flight) -> None:
    roll = np.rad2deg(flight.attitude_rad[:, 0])
    turning = (flight.flown.report[:, PHASE] == FOLLOW) & (flight.line < 0)
    in_turns = np.where(turning, roll, np.nan)
    _plot(axes, flight, roll, _ROLL, lw=0.7, alpha=0.45)
    _plot(axes, flight, in_turns, _ROLL, lw=1.0)
    _zero(axes, "roll, °")
    if turning.any():
        worst = float(np.abs(roll[turning]).max())
        title = f"between lines {rms(in_turns):.1f}° rms, {worst:.1f}° at most"
        axes.set_title(title, loc="left", fontsize=8.5, pad=3)


def _draw_thrusters(axes: Axes, flight: Flight, names: list[str]) -> None:
    """Speeds of some thrusters; their limits as dashes where these are near, else in words."""
    speeds = rpm_of(flight.flown)
    limits = {u.name: 60.0 * u.most_rps for u in flight.vehicle.thrusters}
    reached = max(float(np.abs(speeds[name]).max()) for name in names)
    for name in names:
        colour = _THRUSTERS[list(limits).index(name) % len(_THRUSTERS)]
        _plot(axes, flight, speeds[name], colour, name, lw=0.7, alpha=0.85)
    limit = min(limits[name] for name in names)
    _zero(axes, "rpm")
    for end in (-limit, limit):
        axes.axhline(end, color="#c0392b", lw=0.8, ls="--")
    maximum = 1.08 * limit if reached > 0.5 * limit else max(1.15 * reached, 0.05 * limit)
    axes.set_ylim(-maximum, maximum)
    _legend(axes, f"speed of thrusters, limits ±{limit:.0f}")


def _draw_fins(axes: Axes, flight: Flight) -> None:
    """Angles of the fins, and their limits."""
    fins, angles = flight.vehicle.fins, np.rad2deg(flight.flown.fin_rad)
    for fin, angle, colour in zip(fins, angles.T, itertools.cycle(_THRUSTERS), strict=False):
        _plot(axes, flight, angle, colour, fin.name, lw=0.7, alpha=0.85)
    limit = min(fin.most_angle_deg for fin in fins)
    _zero(axes, "fins, °")
    for end in (-limit, limit):
        axes.axhline(end, color="#c0392b", lw=0.8, ls="--")
    _legend(axes, f"angles of the fins, limits ±{limit:g}°")


def _draw_power(axes: Axes, flight: Flight) -> None:
    flown = flight.flown
    some = thin(len(flight.line))
    t = flight.truth.time_s[some]
    colours = [_THRUSTERS[i % len(_THRUSTERS)] for i in range(len(flown.thrusters))]
    # The strips above name the colours of many.
    names = flown.thrusters if len(flown.thrusters) <= _NAMED else ()
    axes.stackplot(t, flown.power_w[some].T, labels=names, colors=colours, alpha=0.75, lw=0)
    total = flown.power_w.sum(axis=1)
    # The jerk of the first seconds would flatten the rest.
    axes.set_ylim(0, max(1.0, 1.3 * float(np.percentile(total, 99.0))))
    axes.set_ylabel("power, W")
    energy = axes.twinx()
    steps = np.diff(flight.truth.time_s, prepend=0.0)
    energy.plot(t, (np.cumsum(total * steps) / 3600.0)[some], color="black", lw=1.2)
    energy.set_ylim(bottom=0)
    energy.grid(visible=False)
    energy.spines["right"].set_visible(True)
    energy.set_ylabel("energy, Wh", fontsize=8.5)
    energy.tick_params(labelsize=8)
    spent = float(flown.energy_j.sum()) / 3600.0
    said = f"electrical: {spent:.2f} Wh (line), {total.mean():.1f} W mean, {total.max():.0f} W peak"
    _legend(axes, said)


def _draw_current(axes: Axes, flight: Flight) -> None:
    current = true_current(flight.flown)
    for axis, (name, colour) in enumerate((("north", TRUE), ("east", NAV))):
        _plot(axes, flight, current[:, axis], colour, f"towards {name}", lw=1.0)
    _zero(axes, "current, m/s")
    _legend(axes)
