"""Fly a plan in simulation: true track, triggers, navigation log, vehicle log, bag and plots.

Pictures show how near the plan a flight came, and what the vehicle did for it.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.artefacts import write_csv
from alice_survey.core.config import VehicleConfig, WaterConfig
from alice_survey.core.errors import warn
from alice_survey.core.executor import Executor
from alice_survey.core.frames import Array, rotation_from_attitude
from alice_survey.core.records import FlightRecord
from alice_survey.core.trajectory import write_track
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.log import VehicleLog, write_vehicle_log
from alice_survey.sim.vehicle.navigation import tick as navigation
from alice_survey.sim.vehicle.pilot.memory import FOLLOW, PHASE
from alice_survey.sim.vehicle.simulator import Flown
from camera_calib.rig import Rig, design_rig
from missions.coverage.stations import stations_of_flight
from missions.fly.simulation import (
    FlightSettings,
    covered_shares,
    flight_noise,
    mission_of_settings,
    mission_summary,
    one_dive,
    simulate_mission,
    simulate_plan,
    stations_of_dives,
    true_floor,
    whole_route,
)
from missions.values.flight import Flight, rms
from missions.values.navigation import write_navigation
from missions.values.plan_file import Plan, read_plan

if TYPE_CHECKING:
    from alice_survey.kit.figure import Axes
    from missions.logs.ros_builder import BagRecord

MAX_HEADING_DEG = 10.0
"""A picture of 4 by 3 turned by so much covers a strip narrower by a tenth."""
TRIGGER_COLUMNS = ("station", "time_s", "line")


def run_fly(
    workspace: Path, folder: Path, executor: Executor, *, water: WaterConfig, **values: Any
) -> Callable[[], None]:
    """Write the figures of a flight.

    Args:
        workspace: that holds the plan.
        folder: to write.
        executor: not used: a flight is one task.
        water: of the survey.
        values: of `FlightSettings`.

    Returns:
        What writes triggers, navigation, vehicle logs, a bag, the truth and plots.
    """
    settings = FlightSettings(**values)
    vehicle = settings.vehicle
    plan = one_dive(read_plan(workspace / "plan" / "plan.json"), vehicle.dive)
    fly = simulate_plan if vehicle.mission_file is None else simulate_mission
    flight = fly(plan, settings, true_floor(plan, settings), flight_noise(settings.seed))
    _check_pictures(flight)
    rig = design_rig(settings.camera, water)
    summary = flight_summary(flight, vehicle, rig)
    if vehicle.mission_file is not None:
        summary["mission"] = mission_summary(mission_of_settings(plan, settings), flight, rig)
    FlightRecord.save(folder / "flight.json", summary)
    return partial(write_flight, folder, flight, plan)


def write_flight(folder: Path, flight: Flight, plan: Plan) -> None:
    """Write triggers, navigation, vehicle logs, a bag, the truth and plots of a flight."""
    from missions.logs.ros_builder import write_bag

    write_track(folder / "truth" / "track.csv", flight.truth)
    write_vehicle_log(folder / "truth" / "vehicle.csv", true_log(flight))
    rows = zip(flight.trigger_s.tolist(), flight.trigger_line, strict=True)
    write_csv(
        folder / "triggers.csv",
        TRIGGER_COLUMNS,
        ([station, f"{time_s:.6f}", line] for station, (time_s, line) in enumerate(rows)),
    )
    write_navigation(folder / "navigation.csv", flight.log, plan.datum)
    write_vehicle_log(folder / "vehicle.csv", believed_log(flight))
    write_bag(folder / "bag", bag_record(flight))
    draw_flight(folder / "track.png", flight)


def _check_pictures(flight: Flight) -> None:
    """Warn of stations that were missed or lie off their lines."""
    planned = stations_of_dives(flight.plan)
    for one in flight.flown.found:
        what = "turned, but gave no thrust" if one.turns else "did not turn as commanded"
        warn(
            f"{one.thruster} {what}, found after {one.time_s:.0f} s: from there "
            f"on {flight.vehicle.name} counted on {one.left:.0%} of its thrust"
        )
    heading = np.rad2deg(flight.line_errors[1])
    if np.isfinite(heading).any() and rms(heading) > MAX_HEADING_DEG:
        warn(
            f"on lines the heading was off by {rms(heading):.0f} deg rms, "
            f"{np.nanmax(np.abs(heading)):.0f} at most: pictures do not lie square to their lines"
        )
    if len(flight.trigger_s) < planned:
        warn(
            f"{len(flight.trigger_s)} of {planned} stations were reached: the mission "
            f"was {flight.ending}"
        )
    if flight.stations_off_line:
        warn(
            f"{flight.stations_off_line} of {len(flight.trigger_s)} pictures were taken more than "
            f"{flight.allowed_off_m.max():.2f} m off their lines, where neighbouring lines may "
            "leave gaps: choose more side_overlap, less current or another controller"
        )


_MAX_POINTS = 20_000
_SIGMAS = 2.0
"""The band of the navigation error: 95 % of the time within it."""


def draw_flight(path: Path, flight: Flight) -> None:
    """Draw a map of plan, true track and navigation next to strips of errors, rpm and power.

    The strips share their time, with the lines shaded.
    """
    from alice_survey.kit.figure import figure_style, save_figure

    with figure_style():
        save_figure(_flight_figure(flight), path, dpi=110)


def _flight_figure(flight: Flight) -> Any:
    from alice_survey.kit.figure import BAND, INKS, SOFT, new_figure

    cross, heading = flight.line_errors
    attitude = np.rad2deg(flight.attitude_rad)
    error = (flight.log.position_ned - flight.truth.ned_from_body.translation).T
    curves: dict[str, dict[str, Array]] = {
        "cross-track, m": {"true": cross, "believed": flight.believed_cross_track},
        "heading error, °": {"on lines": np.rad2deg(heading)},
        "attitude, °": {"roll": attitude[:, 0], "pitch": attitude[:, 1]},
        "altitude, m": {"measured": flight.log.altitude_m},
        "north error, m": {"believed minus true": error[0]},
        "east error, m": {"believed minus true": error[1]},
        "rpm": rpm_of(flight.flown),
        "power, W": {"all thrusters": flight.flown.power_w.sum(axis=1)},
    }
    figure = new_figure(11.0, 15)
    grid = figure.add_gridspec(len(curves), 2, width_ratios=(1, 1.15))
    chart, first = figure.add_subplot(grid[:, 0]), figure.add_subplot(grid[0, 1])
    rows = range(1, len(curves))
    strips = [first, *(figure.add_subplot(grid[i, 1], sharex=first) for i in rows)]
    some = slice(None, None, math.ceil(len(flight.line) / _MAX_POINTS))
    _draw_map(chart, flight, some)
    figure.suptitle(f"{flight.plan.name}: {flight.vehicle.name}, {flight.ending}")
    time_s = flight.truth.time_s
    following = flight.flown.report[:, PHASE] == FOLLOW
    for axes, (label, by_name) in zip(strips, curves.items(), strict=True):
        for (name, values), colour in zip(by_name.items(), itertools.cycle(INKS), strict=False):
            axes.plot(time_s[some], values[some], color=colour, label=name, lw=0.9)
        axes.set_ylabel(label)
        for begin, end in line_spans(flight):
            axes.axvspan(begin, end, color=BAND, lw=0, zorder=0)
        for edge in time_s[np.flatnonzero(np.diff(following))]:
            axes.axvline(edge, color=SOFT, lw=0.7, ls="--", zorder=1)
    altitude_m = flight.plan.altitude_m
    flown = flight.log.altitude_m[(flight.line >= 0) & np.isfinite(flight.log.altitude_m)]
    top_m = max(altitude_m + 0.5, float(flown.max(initial=0.0)))
    strips[3].set_ylim(altitude_m - 0.5, top_m)
    for axes, name in zip(strips[4:6], ("north", "east"), strict=True):
        band = _SIGMAS * _column(flight.flown, f"sigma_{name}_m")[some]
        axes.fill_between(
            time_s[some], -band, band, color=INKS[1], alpha=0.18, lw=0,
            label=f"±{_SIGMAS:g} logged sigmas",
        )  # fmt: skip
    if np.isfinite(cross).any():
        strips[0].set_title(
            f"{rms(cross):.3f} m rms on lines, heading {np.rad2deg(rms(heading)):.1f}°"
        )
    for axes in strips:
        axes.legend(loc="upper right", ncol=5, fontsize=7.5)
        axes.tick_params(labelbottom=axes is strips[-1])
    strips[-1].set_xlabel("time, s (lines shaded, survey between dashes)")
    return figure


def _draw_map(axes: "Axes", flight: Flight, some: slice) -> None:
    """Draw plan, area and both tracks."""
    from alice_survey.kit.figure import INKS, SOFT, LineCollection
    from missions.coverage.drawing import draw_polygons

    plan = flight.plan
    axes.set_aspect("equal")
    ends = [(line.start_ne_m[::-1], line.end_ne_m[::-1]) for line in plan.lines]
    axes.add_collection(LineCollection(ends, colors=SOFT, linewidths=3, alpha=0.5, label="lines"))
    route = whole_route(plan)
    planned = route.places(np.linspace(0.0, route.length_m, 4000))
    draw_polygons(axes, plan.area.survey, "area", edgecolor=INKS[3], lw=1.6, ls="--")
    draw_polygons(axes, plan.area.allowed, "allowed", edgecolor=SOFT, lw=0.9, ls=":")
    draw_polygons(axes, plan.area.no_go, "no-go zone", edgecolor=INKS[3], hatch="xxx", alpha=0.5)
    for track, colour, width, label in (
        (planned, SOFT, 0.8, "planned route"),
        (flight.glass_ned[some], INKS[0], 1.0, "true track of the left port"),
        (flight.believed_glass_ned[some], INKS[1], 1.0, "believed track"),
    ):
        axes.plot(track[:, 1], track[:, 0], color=colour, lw=width, label=label)
    north, east = (
        np.interp(flight.trigger_s, flight.truth.time_s, axis) for axis in flight.glass_ned.T[:2]
    )
    axes.scatter(east, north, s=6, color="black", lw=0, zorder=5, label="pictures")
    axes.set_xlabel("east, m")
    axes.set_ylabel("north, m")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, 0.0), borderaxespad=4.5, ncol=3)


def line_spans(flight: Flight) -> list[tuple[float, float]]:
    """When each line was begun and left, seconds."""
    time_s = flight.truth.time_s
    return [(float(time_s[i]), float(time_s[j - 1])) for i, j in line_runs(flight.line)]


def line_runs(line: Array) -> list[tuple[int, int]]:
    """First tick on each line, and the one after the last, of (T,) lines, -1 between them."""
    edges = np.flatnonzero(np.diff(line, prepend=-1.0, append=-1.0) != 0).tolist()
    return [(i, j) for i, j in itertools.pairwise(edges) if line[i] >= 0]


_RANGES = ("range_1_m", "range_2_m", "range_3_m", "range_4_m")
_RPM = 60.0
_BAG_EVERY = 2
"""Ticks: 10 Hz is what viewers need."""


def true_log(flight: Flight) -> VehicleLog:
    """How the vehicle truly moved, and what its thrusters and fins did."""
    position, turn = flight.flown.truth[:, :3], flight.flown.truth[:, 3:7]
    return _log(flight, "truth", position, turn, true_velocity(flight.flown))


def believed_log(flight: Flight) -> VehicleLog:
    """What the vehicle's own computer knows of its motion, thrusters and fins."""
    log, velocity = flight.log, believed_velocity(flight.flown)
    turn = rotation_from_attitude(*log.attitude_rad.T).as_quat()
    known = _log(flight, "navigation", log.position_ned, turn, velocity)
    return replace(known, altitude_m=log.altitude_m)


def _log(flight: Flight, source: str, position: Array, turn: Array, velocity: Array) -> VehicleLog:
    angles = np.rad2deg(flight.flown.fin_rad).T
    fins = zip(flight.vehicle.fins, angles, strict=True)
    return VehicleLog(
        time_s=flight.flown.time_s,
        source=source,
        position_ned=position,
        quaternion_xyzw=turn,
        velocity_body=velocity[:, :3],
        rates_body=velocity[:, 3:],
        rpm=rpm_of(flight.flown),
        others={f"fin_{fin.name}_deg": angle for fin, angle in fins},
    )


def bag_record(flight: Flight) -> "BagRecord":
    """All that a bag holds of a flight, at half the rate of the simulation."""
    from missions.logs.ros_builder import BagRecord

    flown, log = flight.flown, flight.log
    ranges = np.column_stack([_column(flown, name) for name in _RANGES])
    heard = np.concatenate([[True], np.any(np.diff(ranges, axis=0) != 0, axis=1)])
    some = slice(None, None, _BAG_EVERY)
    return BagRecord(
        name=flight.vehicle.name,
        datum=flight.plan.datum,
        time_s=flown.time_s[some],
        truth=flight.truth.ned_from_body[some],
        truth_velocity=true_velocity(flown)[some],
        believed=RigidTransform.from_components(
            log.position_ned[some], rotation_from_attitude(*log.attitude_rad[some].T)
        ),
        believed_velocity=believed_velocity(flown)[some],
        sigma_horizontal_m=log.sigma_horizontal_m[some],
        sigma_depth_m=log.sigma_depth_m[some],
        sigma_attitude_rad=log.sigma_attitude_rad[some],
        sigma_heading_rad=log.sigma_heading_rad[some],
        altitude_m=log.altitude_m[some],
        thrusters=flown.thrusters,
        rpm=_RPM * flown.rps[some],
        power_w=flown.power_w[some],
        beam_time_s=flown.time_s[heard],
        beam_m=ranges[heard],
        notes={"ending": flight.ending},
    )


def flight_summary(flight: Flight, vehicle: VehicleConfig, rig: Rig) -> dict[str, Any]:
    """The figures of a flight: `flight.json`.

    Args:
        flight: what was flown.
        vehicle: its settings.
        rig: the cameras in the survey's water.
    """
    flown, plan = flight.flown, flight.plan
    cross, heading = flight.line_errors
    on_line = ~np.isnan(cross)
    following = flown.report[:, PHASE] == FOLLOW
    turning = following & ~on_line
    roll = np.abs(np.rad2deg(flight.attitude_rad[:, 0]))
    off = flight.log.position_ned - flight.truth.ned_from_body.translation
    speed = np.linalg.norm(true_velocity(flown)[:, :2], axis=1)
    energy_wh = flown.energy_j / 3600.0
    return {
        "vehicle": flight.vehicle.name,
        "controller": vehicle.controller,
        "coefficients": vehicle.coefficients,
        "allocation": vehicle.allocation,
        "thruster_health": {
            thruster.name: vehicle.impaired.get(thruster.name, 1.0)
            for thruster in flight.vehicle.thrusters
        },
        "failures_found": [asdict(one) for one in flown.found],
        "ending": flight.ending,
        "duration_s": float(flown.time_s[-1]),
        "stations": len(flight.trigger_s),
        "stations_planned": stations_of_dives(plan),
        "dives": len(plan.dives),
        "stations_off_line": flight.stations_off_line,
        "allowed_cross_track_m": float(flight.allowed_off_m.max()),
        "min_clearance_m": flight.clearance_m,
        "outside_allowed": {
            "share_of_time": float(np.mean(flight.outside_m > 0.0)),
            "worst_m": float(flight.outside_m.max()),
            "allowed_m": flight.allowed_outside_m,
        },
        "on_lines": {
            "share_of_time": float(on_line.mean()),
            "cross_track_rms_m": _rms(cross[on_line]),
            "cross_track_worst_m": _worst(cross[on_line]),
            "believed_cross_track_rms_m": _rms(flight.believed_cross_track[on_line]),
            "heading_rms_deg": _rms(np.rad2deg(heading[on_line])),
            "roll_rms_deg": _rms(roll[on_line]),
            "roll_worst_deg": _worst(roll[on_line]),
            "speed_mean_mps": float(speed[on_line].mean()) if on_line.any() else None,
            "altitude_rms_m": _rms(flight.altitude_m[on_line] - plan.altitude_m),
            "altitude_least_m": float(flight.altitude_m[on_line].min()) if on_line.any() else None,
        },
        "in_turns": {
            "roll_rms_deg": _rms(roll[turning]),
            "roll_worst_deg": _worst(roll[turning]),
            "off_route_rms_m": _rms(flight.route_error[turning]),
            "believed_off_route_rms_m": _rms(flight.believed_route_error[turning]),
        },
        "navigation_error_rms_m": _rms(np.linalg.norm(off[following, :2], axis=1)),
        "energy_wh": dict(zip(flown.thrusters, energy_wh.tolist(), strict=True)),
        "coverage": covered_shares(plan, rig, stations_of_flight(flight)),
    }


def true_velocity(flown: Flown) -> Array:
    """(T, 6) u, v, w over ground and p, q, r, of the body's origin in its own frame."""
    to_ned = Rotation.from_quat(flown.truth[:, 3:7])
    return np.column_stack([to_ned.inv().apply(flown.truth[:, 7:10]), flown.truth[:, 10:13]])


def believed_velocity(flown: Flown) -> Array:
    """(T, 6) as `true_velocity`, as navigation had it."""
    return flown.navigation[:, vector.U : vector.U + 6]


def rpm_of(flown: Flown) -> dict[str, Array]:
    """Speed of each thruster, (T,) revolutions per minute."""
    return dict(zip(flown.thrusters, (_RPM * flown.rps).T, strict=True))


def _column(flown: Flown, name: str) -> Array:
    return flown.navigation[:, navigation.LOG_COLUMNS.index(name)]


def _rms(values: Array) -> float | None:
    """Root mean square of what is known; None of nothing, which JSON can hold."""
    found = rms(values)
    return None if math.isnan(found) else found


def _worst(values: Array) -> float | None:
    known = np.abs(values[~np.isnan(values)])
    return float(known.max()) if len(known) else None
