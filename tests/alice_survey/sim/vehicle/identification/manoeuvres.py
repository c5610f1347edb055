"""Logs of ALICE on manoeuvres rich enough to identify its coefficients, with sensor noise."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.dynamics import initial_state, rk4_step, scratch_for
from alice_survey.sim.vehicle.log import VehicleLog
from alice_survey.sim.vehicle.sea import Current
from alice_survey.sim.vehicle.vehicle import Vehicle, vehicle_from

ROW_S, STEP_S = 0.05, 0.01
NAMES = ("starboard", "port", "vertical", "bow", "stern")


@dataclass(frozen=True, kw_only=True)
class Noise:
    """Standard deviations; DVL at 5 Hz, IMU and attitude in every row."""

    velocity_mps: float = 0.01
    rates_rad_s: float = 0.002
    attitude_rad: float = 0.003


def survey_like(time_s: float) -> Array:
    """Requested thruster speeds, rev/s: surge steps, zigzags, sway, heave and all at once."""
    t = time_s % 120.0
    zig = 1.0 if (t // 6.0) % 2 == 0 else -1.0
    sway = (0.0, 30.0, -35.0, 20.0)[int(t // 7.0) % 4]
    heave = (0.0, 18.0, -25.0, 0.0, -15.0, 25.0)[int(t // 5.0) % 6]
    surge = (18.0, 30.0, 10.0, -20.0, 38.0)[int(t // 12.0) % 5]
    turn = (4.0, 9.0, 0.0)[int(t // 15.0) % 3] * zig
    yaw = (12.0, 0.0, -22.0)[int(t // 9.0) % 3]
    return np.array([surge - turn, surge + turn, heave, sway + yaw, sway - yaw])


def hidden(values: Mapping[str, float]) -> Vehicle:
    """ALICE with other coefficients than it is known by."""
    known = vehicle_from("alice")
    return known.with_coefficients(known.coefficients.with_values("hidden", values))


def fly(
    truth: Vehicle,
    *,
    duration_s: float = 120.0,
    current: tuple[float, float] = (0.0, 0.0),
    asked: Callable[[float], Array] = survey_like,
    push: Callable[[], Array] | None = None,
    attitude_rad: tuple[float, float, float] = (0.0, 0.0, 0.7),
) -> VehicleLog:
    """A log without noise.

    Args:
        truth: what flies.
        duration_s: how long.
        current: m/s towards north and east.
        asked: requested speeds by time, rev/s.
        push: gives the force and moment, (6,), that the log does not show, for each row.
        attitude_rad: to begin with.
    """
    count = len(truth.thrusters)
    water, scratch = Current(np.zeros(1), np.zeros(1), np.array([[current]])), scratch_for(count)
    state = initial_state(np.array([0.0, 0.0, 5.0]), np.array(attitude_rad), count)
    rows = round(duration_s / ROW_S)
    states = np.empty((rows, len(state)))
    load = np.zeros(6)
    for row in range(rows):
        states[row] = state
        if push is not None:
            load = push()
        for i in range(round(ROW_S / STEP_S)):
            now = row * ROW_S + i * STEP_S
            rk4_step(now, STEP_S, state, asked(now), load, truth.plant, water, scratch)
    ned_from_body = Rotation.from_quat(states[:, 3:7])
    drift = ned_from_body.inv().apply(np.array([*current, 0.0]))
    return VehicleLog(
        time_s=np.arange(rows, dtype=float) * ROW_S,
        source="simulated",
        position_ned=states[:, :3],
        quaternion_xyzw=states[:, 3:7],
        velocity_body=states[:, 7:10] + drift,
        rates_body=states[:, 10:13],
        rpm={t.name: 60.0 * states[:, 13 + i] for i, t in enumerate(truth.thrusters)},
    )


def measured(log: VehicleLog, rng: np.random.Generator, noise: Noise | None = None) -> VehicleLog:
    """The log as sensors would measure it."""
    sigma, rows = noise or Noise(), len(log.time_s)
    turns = Rotation.from_rotvec(rng.normal(0, sigma.attitude_rad, (rows, 3)))
    velocity = log.velocity_body + rng.normal(0, sigma.velocity_mps, (rows, 3))
    velocity[np.arange(rows) % 4 != 0] = np.nan
    return VehicleLog(
        time_s=log.time_s,
        source=log.source,
        quaternion_xyzw=(Rotation.from_quat(log.quaternion_xyzw) * turns).as_quat(),
        velocity_body=velocity,
        rates_body=log.rates_body + rng.normal(0, sigma.rates_rad_s, (rows, 3)),
        rpm=log.rpm,
    )
