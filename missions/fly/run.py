"""Fly a plan in simulation: true track, triggers, navigation log, vehicle log, bag and plots.

Pictures show how near the plan a flight came, and what the vehicle did for it.
"""

import itertools
import math
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from alice_survey.core.artefacts import write_csv
from alice_survey.core.config import SurveyConfig
from alice_survey.core.errors import VehicleError, warn
from alice_survey.core.executor import Executor, progress
from alice_survey.core.frames import Array
from alice_survey.core.records import FlightRecord
from alice_survey.core.trajectory import write_track
from alice_survey.kit.figure import (
    BAND,
    INKS,
    SOFT,
    Axes,
    LineCollection,
    Sheet,
    figure_style,
    new_figure,
    save_figure,
)
from alice_survey.sim.seafloor.terrain import survey_terrain
from alice_survey.sim.vehicle.log import write_vehicle_log
from alice_survey.sim.vehicle.navigation.tick import LOG_COLUMNS
from alice_survey.sim.vehicle.pilot.memory import FOLLOW, PHASE
from alice_survey.sim.vehicle.sea import FloorGrid
from alice_survey.sim.vehicle.simulator import Flown
from camera_calib.rig import design_rig
from missions.coverage.drawing import draw_polygons
from missions.fly.flight_records import (
    bag_record,
    believed_log,
    flight_summary,
    rpm_of,
    true_log,
    true_velocity,
)
from missions.fly.flight_route import one_dive, stations_of_dives, whole_route
from missions.fly.mission_flight import mission_of_settings, mission_summary, simulate_mission
from missions.fly.simulation import flight_settings, floor_grid, simulate_plan
from missions.logs.ros_builder import write_bag
from missions.values.flight import Flight, rms
from missions.values.navigation import write_navigation
from missions.values.plan_file import Plan, read_plan

_SEED_STREAM = 20
MAX_HEADING_DEG = 10.0
"""A picture of 4 by 3 turned by so much covers a strip narrower by a tenth."""
TRIGGER_COLUMNS = ("station", "time_s", "line")


def run_fly(workspace: Path, folder: Path, executor: Executor, *, survey: SurveyConfig) -> None:
    """Write triggers, navigation, vehicle logs, a bag, the truth and plots.

    Raises:
        VehicleError: the vehicle took no picture at all; the message says why.
    """
    for _ in progress(_steps(folder, workspace / "plan" / "plan.json", survey), "flight files", 5):
        pass


def _steps(folder: Path, plan_path: Path, survey: SurveyConfig) -> Iterator[str]:
    """Write the files of a flight, and say after each step what is done."""
    plan = one_dive(read_plan(plan_path), survey.vehicle.dive)
    floor = true_floor(plan, survey)
    yield "sea floor"
    settings = flight_settings(survey)
    fly = simulate_plan if survey.vehicle.mission_file is None else simulate_mission
    flight = fly(plan, settings, floor, flight_noise(survey.seed))
    _check_pictures(
        flight, stations_of_dives(flight.plan), "swell" if survey.sea.swell_m > 0.0 else "current"
    )
    yield "flight"
    write_track(folder / "truth" / "track.csv", flight.truth)
    write_vehicle_log(folder / "truth" / "vehicle.csv", true_log(flight))
    yield "truth"
    _write_triggers(folder / "triggers.csv", flight)
    write_navigation(folder / "navigation.csv", flight.log, plan.datum)
    write_vehicle_log(folder / "vehicle.csv", believed_log(flight))
    write_bag(folder / "bag", bag_record(flight))
    yield "logs"
    rig = design_rig(survey.camera, survey.water)
    summary = flight_summary(flight, survey.vehicle, rig)
    if survey.vehicle.mission_file is not None:
        summary["mission"] = mission_summary(mission_of_settings(plan, settings), flight, rig)
    FlightRecord.save(folder / "flight.json", summary)
    draw_flight(folder / "track.png", flight)
    draw_vehicle(folder / "vehicle.png", flight)
    yield "plots"


def true_floor(plan: Plan, survey: SurveyConfig) -> FloorGrid:
    """The simulated sea floor below a plan."""
    return floor_grid(
        survey_terrain(
            survey.seafloor,
            plan.area.allowed_corners_ne,
            margin_m=survey.plan.altitude_m,
            depth_m=survey.area.seafloor_depth_m,
            seed=survey.seed,
        )
    )


def flight_noise(seed: int) -> np.random.Generator:
    """Source of all noise of a survey's flight."""
    return np.random.default_rng([seed, _SEED_STREAM])


def _check_pictures(flight: Flight, planned: int, sea: str) -> None:
    """Warn of stations that were missed or lie off their lines.

    Args:
        flight: to judge.
        planned: stations.
        sea: what may have carried the vehicle off.

    Raises:
        VehicleError: no picture was taken.
    """
    if not len(flight.trigger_s):
        raise VehicleError(
            f"{flight.vehicle.name} reached no line of the plan ({flight.ending} after "
            f"{flight.truth.time_s[-1]:.0f} s): change the {sea}, the thrusters or the plan"
        )
    for one in flight.flown.found:
        what = "turned, but gave no thrust" if one.turns else "did not turn as commanded"
        warn(
            f"{one.thruster} {what}, found after {one.time_s:.0f} s: from there "
            f"on {flight.vehicle.name} counted on {one.left:.0%} of its thrust"
        )
    _warn_of_heading(flight)
    if len(flight.trigger_s) < planned:
        warn(
            f"{len(flight.trigger_s)} of {planned} stations were reached: the mission "
            f"was {flight.ending}"
        )
    if flight.stations_off_line:
        warn(
            f"{flight.stations_off_line} of {len(flight.trigger_s)} pictures were taken more than "
            f"{flight.plan.allowed_offset_m:.2f} m off their lines, where neighbouring lines may "
            "leave gaps: choose more side_overlap, less current or another controller"
        )


def _warn_of_heading(flight: Flight) -> None:
    """Warn where pictures are turned so far that they leave the strip of their line."""
    heading = np.rad2deg(flight.line_errors[1])
    if np.isfinite(heading).any() and rms(heading) > MAX_HEADING_DEG:
        warn(
            f"on lines the heading was off by {rms(heading):.0f} deg rms, "
            f"{np.nanmax(np.abs(heading)):.0f} at most: pictures do not lie square to their lines"
        )


def _write_triggers(path: Path, flight: Flight) -> None:
    rows = zip(flight.trigger_s.tolist(), flight.trigger_line, strict=True)
    write_csv(
        path,
        TRIGGER_COLUMNS,
        ([station, f"{time_s:.6f}", line] for station, (time_s, line) in enumerate(rows)),
    )


TRUE, NAV = INKS[:2]
_MAX_POINTS = 20_000
_SIGMAS = 2.0
"""The band of the navigation error: 95 % of the time within it."""


@figure_style()
def draw_flight(path: Path, flight: Flight) -> None:
    """Draw a map of plan, true track and navigation next to strips of the errors."""
    cross, heading = (values[_every_nth(flight)] for values in flight.line_errors)
    attitude = np.rad2deg(flight.attitude_rad)
    figure, strips = _sheet(flight, 6)
    for axes, label, curves in zip(
        strips,
        ("cross-track, m", "heading error, °", "attitude, °", "altitude, m", "north error, m",
         "east error, m"),
        (
            [("true", flight.line_errors[0]), ("believed", flight.believed_cross_track)],
            [("on lines", np.rad2deg(flight.line_errors[1]))],
            [("roll", attitude[:, 0]), ("pitch", attitude[:, 1])],
            [("measured", flight.log.altitude_m)],
            _navigation_error(flight, 0),
            _navigation_error(flight, 1),
        ),
        strict=True,
    ):  # fmt: skip
        _draw_curves(axes, flight, label, curves)
    altitude_m = flight.plan.altitude_m
    strips[3].set_ylim(altitude_m - 0.5, altitude_m + 0.5)
    for axes, name in zip(strips[4:], ("north", "east"), strict=True):
        column = flight.flown.navigation[_every_nth(flight), LOG_COLUMNS.index(f"sigma_{name}_m")]
        axes.fill_between(
            flight.truth.time_s[_every_nth(flight)], -_SIGMAS * column, _SIGMAS * column, color=NAV,
            alpha=0.18, lw=0, label=f"±{_SIGMAS:g} logged sigmas",
        )  # fmt: skip
    strips[0].set_title(f"{rms(cross):.3f} m rms on lines, heading {np.rad2deg(rms(heading)):.1f}°")
    _save(figure, strips, path)


@figure_style()
def draw_vehicle(path: Path, flight: Flight) -> None:
    """Draw the track next to strips of speed, roll, thrusters, fins, power and current."""
    flown, current = flight.flown, true_current(flight.flown)
    velocity, energy_wh = true_velocity(flown), np.cumsum(flown.power_w.sum(axis=1))
    energy_wh *= float(np.diff(flown.time_s, prepend=0.0).max()) / 3600.0
    strips_of = {
        "speed, m/s": [("over ground", np.hypot(velocity[:, 0], velocity[:, 1])),
                       ("surge", velocity[:, 0])],
        "roll, °": [("roll", np.rad2deg(flight.attitude_rad[:, 0]))],
        "rpm": list(rpm_of(flown).items()),
        "fins, °": [
            (fin.name, angle)
            for fin, angle in zip(flight.vehicle.fins, np.rad2deg(flown.fin_rad).T, strict=True)
        ],
        "power, W": [("all thrusters", flown.power_w.sum(axis=1))],
        "energy, Wh": [("electrical", energy_wh)],
        "current, m/s": [("north", current[:, 0]), ("east", current[:, 1])],
    }  # fmt: skip
    strips_of = {label: curves for label, curves in strips_of.items() if curves}
    figure, strips = _sheet(flight, len(strips_of))
    for axes, (label, curves) in zip(strips, strips_of.items(), strict=True):
        _draw_curves(axes, flight, label, curves)
    _save(figure, strips, path)


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


def draw_plan(axes: Axes, plan: Plan) -> None:
    """Draw the lines and the route of a plan on a map, its area, and where it may be flown."""
    axes.set_aspect("equal")
    ends = [(line.start_ne_m[::-1], line.end_ne_m[::-1]) for line in plan.lines]
    axes.add_collection(LineCollection(ends, colors=SOFT, linewidths=3, alpha=0.5, label="lines"))
    route = whole_route(plan)
    places = route.places(np.linspace(0.0, route.length_m, 4000))
    axes.plot(places[:, 1], places[:, 0], color=SOFT, lw=0.8, zorder=1, label="planned route")
    draw_polygons(axes, plan.area.survey, "area", edgecolor=INKS[3], lw=1.6, ls="--")
    draw_polygons(axes, plan.area.allowed, "allowed", edgecolor=SOFT, lw=0.9, ls=":")
    draw_polygons(axes, plan.area.no_go, "no-go zone", edgecolor=INKS[3], hatch="xxx", alpha=0.5)
    axes.set_xlabel("east, m")
    axes.set_ylabel("north, m")


def _sheet(flight: Flight, count: int) -> tuple[Sheet, list[Axes]]:
    """A map of the flight over its plan, and strips that share their time, lines shaded."""
    figure = new_figure(9.5, 15)
    grid = figure.add_gridspec(count, 2, width_ratios=(1, 1.15))
    chart, first = figure.add_subplot(grid[:, 0]), figure.add_subplot(grid[0, 1])
    strips = [first, *(figure.add_subplot(grid[i, 1], sharex=first) for i in range(1, count))]
    draw_plan(chart, flight.plan)
    some = _every_nth(flight)
    for track, colour, label in (
        (flight.glass_ned, TRUE, "true track of the left port"),
        (flight.believed_glass_ned, NAV, "believed track"),
    ):
        chart.plot(track[some, 1], track[some, 0], color=colour, lw=1.0, label=label)
    north, east = (
        np.interp(flight.trigger_s, flight.truth.time_s, axis) for axis in flight.glass_ned.T[:2]
    )
    chart.scatter(east, north, s=6, color="black", lw=0, zorder=5, label="pictures")
    chart.legend(loc="upper center", bbox_to_anchor=(0.5, 0.0), borderaxespad=4.5, ncol=3)
    figure.suptitle(f"{flight.plan.name}: {flight.vehicle.name}, {flight.ending}")
    following = flight.flown.report[:, PHASE] == FOLLOW
    edges = flight.truth.time_s[np.flatnonzero(np.diff(following))]
    for axes in strips:
        for begin, end in line_spans(flight):
            axes.axvspan(begin, end, color=BAND, lw=0, zorder=0)
        for edge in edges:
            axes.axvline(edge, color=SOFT, lw=0.7, ls="--", zorder=1)
    return figure, strips


def _navigation_error(flight: Flight, axis: int) -> list[tuple[str, Array]]:
    error = flight.log.position_ned - flight.truth.ned_from_body.translation
    return [("believed minus true", error[:, axis])]


def _every_nth(flight: Flight) -> slice:
    """Every n-th tick, so that a curve stays light."""
    return slice(None, None, max(1, math.ceil(len(flight.line) / _MAX_POINTS)))


def _draw_curves(
    axes: Axes, flight: Flight, label: str, curves: Iterable[tuple[str, Array]]
) -> None:
    some = _every_nth(flight)
    colours = itertools.cycle(INKS)
    for (name, values), colour in zip(curves, colours, strict=False):
        axes.plot(flight.truth.time_s[some], values[some], color=colour, label=name, lw=0.9)
    axes.set_ylabel(label)


def _save(figure: Sheet, strips: list[Axes], path: Path) -> None:
    for axes in strips:
        axes.legend(loc="upper right", ncol=4, fontsize=7.5)
        axes.tick_params(labelbottom=axes is strips[-1])
    strips[-1].set_xlabel("time, s (lines shaded, survey between dashes)")
    save_figure(figure, path, dpi=110)
