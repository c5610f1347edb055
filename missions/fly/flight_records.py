"""A flight as logs that other tools read, and as summary figures."""

import math
from dataclasses import asdict
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.config import VehicleConfig
from alice_survey.core.frames import Array, rotation_from_attitude
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.log import VehicleLog, vehicle_log
from alice_survey.sim.vehicle.navigation import tick as navigation
from alice_survey.sim.vehicle.pilot.memory import FOLLOW, PHASE
from alice_survey.sim.vehicle.simulator import Flown
from camera_calib.rig import Rig
from missions.coverage.certificate import certificate
from missions.coverage.stations import plan_pattern, stations_of_flight
from missions.fly.flight_route import stations_of_dives
from missions.logs.ros_builder import BagRecord
from missions.values.flight import Flight, rms

_RANGES = ("range_1_m", "range_2_m", "range_3_m", "range_4_m")
_RPM = 60.0
_BAG_EVERY = 2
"""Ticks: 10 Hz is what viewers need."""


def true_log(flight: Flight) -> VehicleLog:
    """How the vehicle truly moved, and what its thrusters and fins did."""
    flown = flight.flown
    return vehicle_log(
        flown.time_s,
        source="truth",
        position_ned=flown.truth[:, :3],
        quaternion_xyzw=flown.truth[:, 3:7],
        velocity_body=true_velocity(flown)[:, :3],
        rates_body=flown.truth[:, 10:13],
        rpm=rpm_of(flown),
        others=_fin_columns(flight),
    )


def believed_log(flight: Flight) -> VehicleLog:
    """What the vehicle's own computer knows of its motion, thrusters and fins."""
    flown, log = flight.flown, flight.log
    believed = believed_velocity(flown)
    return vehicle_log(
        flown.time_s,
        source="navigation",
        position_ned=log.position_ned,
        quaternion_xyzw=rotation_from_attitude(*log.attitude_rad.T).as_quat(),
        velocity_body=believed[:, :3],
        rates_body=believed[:, 3:],
        altitude_m=log.altitude_m,
        rpm=rpm_of(flown),
        others=_fin_columns(flight),
    )


def _fin_columns(flight: Flight) -> dict[str, Array]:
    """Angles of the fins, (T,) degrees each."""
    angles = np.rad2deg(flight.flown.fin_rad).T
    fins = flight.vehicle.fins
    return {f"fin_{fin.name}_deg": angle for fin, angle in zip(fins, angles, strict=True)}


def bag_record(flight: Flight) -> BagRecord:
    """All that a bag holds of a flight, at half the rate of the simulation."""
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
    roll, pitch = np.abs(np.rad2deg(flight.attitude_rad[:, :2])).T
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
        "allowed_cross_track_m": flight.plan.allowed_offset_m,
        "on_lines": {
            "share_of_time": float(on_line.mean()),
            "cross_track_rms_m": _rms(cross[on_line]),
            "cross_track_worst_m": _worst(cross[on_line]),
            "believed_cross_track_rms_m": _rms(flight.believed_cross_track[on_line]),
            "heading_rms_deg": _rms(np.rad2deg(heading[on_line])),
            "roll_rms_deg": _rms(roll[on_line]),
            "roll_worst_deg": _worst(roll[on_line]),
            "pitch_rms_deg": _rms(pitch[on_line]),
            "speed_mean_mps": float(speed[on_line].mean()) if on_line.any() else None,
            "altitude_rms_m": _rms(flight.altitude_m[on_line] - plan.altitude_m),
            "altitude_least_m": float(flight.altitude_m[on_line].min()) if on_line.any() else None,
            "believed_altitude_rms_m": _rms(flight.log.altitude_m[on_line] - plan.altitude_m),
        },
        "in_turns": {
            "roll_rms_deg": _rms(roll[turning]),
            "roll_worst_deg": _worst(roll[turning]),
            "speed_worst_mps": _worst(speed[turning]),
            "off_route_rms_m": _rms(flight.route_error[turning]),
            "believed_off_route_rms_m": _rms(flight.believed_route_error[turning]),
        },
        "navigation_error_rms_m": _rms(np.linalg.norm(off[following, :2], axis=1)),
        "power_mean_w": float(flown.power_w.sum(axis=1).mean()),
        "energy_wh": dict(zip(flown.thrusters, energy_wh.tolist(), strict=True)),
        "coverage": _coverage(flight, rig),
    }


def _coverage(flight: Flight, rig: Rig) -> dict[str, float]:
    """What the pictures of the true track see of the whole area; `plan check` shows more."""
    if not len(flight.trigger_s):
        return {"covered_share": 0.0, "every_camera_share": 0.0, "share_at_overlap": 0.0}
    pattern = plan_pattern(flight.plan, rig)
    seen = certificate(flight.plan.area, rig, stations_of_flight(flight), pattern)
    return {
        "covered_share": seen.covered_share,
        "every_camera_share": seen.every_camera_share,
        "share_at_overlap": seen.share_at_overlap,
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
