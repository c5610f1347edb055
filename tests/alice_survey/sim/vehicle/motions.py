"""Vehicles and steps that the tests of the dynamics share."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from alice_survey.core.frames import Array, attitude_from_rotation
from alice_survey.sim.vehicle.coefficients import Coefficients
from alice_survey.sim.vehicle.dynamics import Body, derivative, initial_state, rk4_step, scratch_for
from alice_survey.sim.vehicle.propulsion import Thruster
from alice_survey.sim.vehicle.sea import Current, sheared_current
from alice_survey.sim.vehicle.vehicle import RigidBody, Vehicle, vehicle_from


def constant_current(speed_mps: float, towards_deg: float) -> Current:
    return sheared_current(np.zeros(1), np.array([[speed_mps, towards_deg]]))


NOTHING = np.zeros(6)
STILL = constant_current(0.0, 0.0)
SHEAR_AND_TIDE = Current(
    np.array([-10.0, 100.0]),
    np.array([-50.0, 100.0]),
    np.array([[[0.1, -0.05], [-0.2, 0.15]], [[-0.1, 0.1], [0.25, 0.05]]]),
)
U, V, W, P, Q, R = np.eye(6)
X, Y, Z, K, M, N = range(7, 13)
"""Places of the accelerations in the rates of a state."""


_PLAIN = (
    "name", "kind", "position_body_m", "direction_body", "diameter_m", "kt_forward", "kt_reverse",
    "kq_forward", "kq_reverse", "handedness", "most_rps", "dead_band_rps", "time_constant_s",
)  # fmt: skip


@cache
def alice(coefficients: str = "calibrated") -> Vehicle:
    """ALICE trimmed neutral, propellers in open water: nothing that hull or flow take from them."""
    full = vehicle_from("alice", coefficients)
    plain = tuple(
        Thruster(**{field: getattr(thruster, field) for field in _PLAIN})
        for thruster in full.thrusters
    )
    neutral = replace(full.rigid_body, buoyancy_kg=full.rigid_body.dry_kg)
    return replace(full, rigid_body=neutral, thrusters=plain)


def block(
    values: Mapping[str, float] | None = None,
    cg: tuple[float, float, float] = (0.0, 0.0, 0.0),
    dry_kg: float = 50.0,
    buoyancy_kg: float = 50.0,
    entrained_kg: float = 0.0,
) -> Vehicle:
    """A body without thrusters that couples no axes but by what is given."""
    return Vehicle(
        name="block",
        rigid_body=RigidBody(
            dry_kg=dry_kg,
            buoyancy_kg=buoyancy_kg,
            entrained_kg=entrained_kg,
            cg_body_m=cg,
            inertia_kg_m2=(1.0, 6.0, 7.0),
        ),
        coefficients=Coefficients(name="given", values=dict(values or {})),
        thrusters=(),
    )


def damping_matrix(body: Body, nu: Array) -> Array:
    """D(nu), (6, 6): linear and quadratic damping and body lift; D(nu) nu opposes motion."""
    u = nu[0]
    lift = np.zeros((6, 6))
    lift[1, 1], lift[2, 2] = body.lift[0] * abs(u), body.lift[1] * abs(u)
    lift[4, 2], lift[5, 1] = body.lift[2] * u, body.lift[3] * u
    quadratic = np.where(nu > 0.0, body.quadratic, body.quadratic_back)
    return -(body.linear + quadratic * np.abs(nu) + lift)


def drag_power(body: Body, nu: Array) -> Array:
    """Power, (N,) W, that the water takes from a body at velocities (N, 6) relative to it."""
    return np.array([motion @ damping_matrix(body, motion) @ motion for motion in nu])


def state_of(
    vehicle: Vehicle,
    nu: Array | None = None,
    attitude_rad: tuple[float, float, float] = (0.0, 0.0, 0.0),
    position_ned: tuple[float, float, float] = (0.0, 0.0, 5.0),
    rps: Array | None = None,
) -> Array:
    state = initial_state(np.array(position_ned), np.array(attitude_rad), vehicle.actuators)
    if nu is not None:
        state[7:13] = nu
    if rps is not None:
        state[13:] = rps
    return state


def rates(
    vehicle: Vehicle,
    state: Array,
    load: Array = NOTHING,
    current: Current = STILL,
    time_s: float = 0.0,
    command_rps: Array | None = None,
) -> Array:
    """Rate of change of a state."""
    count, out = vehicle.actuators, np.full_like(state, np.nan)
    command = np.zeros(count) if command_rps is None else command_rps
    scratch = scratch_for(count)
    derivative(time_s, state, command, load, vehicle.plant, current, scratch, out)
    return out


def advance(
    vehicle: Vehicle,
    state: Array,
    duration_s: float,
    step_s: float = 0.01,
    load: Array = NOTHING,
    current: Current = STILL,
    time_s: float = 0.0,
    command_rps: Array | None = None,
) -> Array:
    """States after each step, (steps + 1, 13 + n), the first included."""
    count = vehicle.actuators
    plant, scratch = vehicle.plant, scratch_for(count)
    command = np.zeros(count) if command_rps is None else command_rps
    steps = round(duration_s / step_s)
    states = np.tile(state, (steps + 1, 1))
    for i in range(steps):
        states[i + 1] = states[i]
        rk4_step(time_s + i * step_s, step_s, states[i + 1], command, load, plant, current, scratch)
    return states


def attitudes(states: Array) -> Array:
    """Roll, pitch, heading of states."""
    return attitude_from_rotation(Rotation.from_quat(states[..., 3:7]))


def rotations(states: Array) -> Rotation:
    """ned_from_body of states."""
    return Rotation.from_quat(states[..., 3:7])
