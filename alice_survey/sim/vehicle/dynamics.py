"""Equations of motion of a submerged vehicle in 6 degrees of freedom.

M nu' + C(nu) nu + D(nu) nu + g(eta) = tau (T. I. Fossen, Handbook of Marine Craft Hydrodynamics and
Motion Control, 2011), where nu is the velocity relative to the water, in the body frame.
The state is a vector: position in NED (3), attitude quaternion ned_from_body, xyzw (4), nu (6), the
speed of each thruster in revolutions per second, and the angle of each drive of fins, rad.
"""

from typing import NamedTuple

import numpy as np

from alice_survey.core.compiled import kernel
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.fins import LAG_RATE, MAX_RAD, MAX_RAD_S, Fins, add_fins
from alice_survey.sim.vehicle.propulsion import Propulsion, add_speed_rates, add_thrust
from alice_survey.sim.vehicle.rotations import matrix_rows
from alice_survey.sim.vehicle.sea import Current, current_at

STATE = 13
"""Length of the state without thrusters and fins."""
_DRAUGHT_M = 0.2
"""A body whose origin is so far above the surface is out of the water (inferred)."""


class Body(NamedTuple):
    """The rigid body and the water around it, as compiled code sees them."""

    mass: Array
    """(6, 6) M = M_RB + M_A, symmetric positive definite."""
    mass_inverse: Array
    in_current: Array
    """(6, 6) what holds the body back in a current. Columns 0 to 2: of M_RB, by the acceleration
    that the vehicle needs to keep up with a current which changes along its way. Columns 3 to 5:
    the same minus the displaced water, by the current's acceleration in time, whose pressure
    pushes the body as it would that water. Nothing but the low weight is left of these three in a
    neutral vehicle."""
    linear: Array
    """(6, 6) linear damping."""
    quadratic: Array
    """(6, 6) quadratic damping of motions that are positive."""
    lift: Array
    """(4,) Y_uv, Z_uw, M_uw, N_uv."""
    weight_n: float
    """Weight in air, without the water inside."""
    buoyancy_n: float
    cg: Array
    """(3,) lever of the weight, from the centre of buoyancy."""
    quadratic_back: Array
    """(6, 6) quadratic damping of motions that are negative."""


class Plant(NamedTuple):
    """All moving parts: body, n thrusters, and fins of m drives."""

    body: Body
    propulsion: Propulsion
    fins: Fins


class Scratch(NamedTuple):
    """Work arrays for intermediate results, so that a step allocates nothing."""

    stages: Array
    """(5, N) stages of the Runge-Kutta step."""
    force: Array
    """(6,)"""
    thrust: Array
    """(6,)"""
    water: Array
    """(6,) current and its slopes."""


def scratch_for(actuators: int) -> Scratch:
    """Work arrays for a vehicle with a number of thrusters and drives of fins."""
    return Scratch(np.zeros((5, STATE + actuators)), np.zeros(6), np.zeros(6), np.zeros(6))


def initial_state(position_ned: Array, attitude_rad: Array, actuators: int) -> Array:
    """A state at rest in the water, thrusters and fins as well.

    Args:
        position_ned: (3,) metres.
        attitude_rad: (3,) roll, pitch, heading.
        actuators: number of thrusters and drives of fins.
    """
    from alice_survey.core.frames import rotation_from_attitude

    state = np.zeros(STATE + actuators)
    state[:3] = position_ned
    state[3:7] = rotation_from_attitude(*attitude_rad).as_quat()
    return state


def coriolis_matrix(mass: Array, nu: Array) -> Array:
    """C(nu), (6, 6), of an inertia matrix by Kirchhoff's equations; skew to the last bit.

    It applies to both M_RB and M_A (Fossen 2011, theorem 3.2).
    """
    linear, angular = mass[:3] @ nu, mass[3:] @ nu
    result = np.zeros((6, 6))
    result[:3, 3:] = result[3:, :3] = -_skew(linear)
    result[3:, 3:] = -_skew(angular)
    return result


def _skew(a: Array) -> Array:
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


@kernel
def add_damping(body: Body, nu: Array, force: Array) -> None:
    """Add damping and body lift at a velocity (6,) to a force (6,).

    Lift acts by |u|, its moments by u: going astern the force still opposes the drift, and its
    centre moves to the other half of the hull.
    """
    for i in range(6):
        total = 0.0
        for j in range(6):
            square = body.quadratic[i, j] if nu[j] > 0.0 else body.quadratic_back[i, j]
            total += (body.linear[i, j] + square * abs(nu[j])) * nu[j]
        force[i] += total
    u, v, w = nu[0], nu[1], nu[2]
    force[1] += body.lift[0] * abs(u) * v
    force[2] += body.lift[1] * abs(u) * w
    force[4] += body.lift[2] * u * w
    force[5] += body.lift[3] * u * v


@kernel
def add_coriolis(body: Body, nu: Array, force: Array) -> None:
    """Add -C(nu) nu to a force (6,), from the momentum M nu.

    With M = M_RB + M_A and nu relative to the water this is exact in an irrotational current.
    """
    mass = body.mass
    a = b = c = d = e = f = 0.0
    for j in range(6):
        a += mass[0, j] * nu[j]
        b += mass[1, j] * nu[j]
        c += mass[2, j] * nu[j]
        d += mass[3, j] * nu[j]
        e += mass[4, j] * nu[j]
        f += mass[5, j] * nu[j]
    u, v, w, p, q, r = nu[0], nu[1], nu[2], nu[3], nu[4], nu[5]
    force[0] -= q * c - r * b
    force[1] -= r * a - p * c
    force[2] -= p * b - q * a
    force[3] -= v * c - w * b + q * f - r * e
    force[4] -= w * a - u * c + r * d - p * f
    force[5] -= u * b - v * a + p * e - q * d


@kernel
def add_weight(body: Body, r20: float, r21: float, r22: float, force: Array) -> None:
    """Add weight and buoyancy along the body's down, (r20, r21, r22), to a force (6,)."""
    net, weight = body.weight_n - body.buoyancy_n, body.weight_n
    gx, gy, gz = body.cg[0], body.cg[1], body.cg[2]
    force[0] += net * r20
    force[1] += net * r21
    force[2] += net * r22
    force[3] += weight * (gy * r22 - gz * r21)
    force[4] += weight * (gz * r20 - gx * r22)
    force[5] += weight * (gx * r21 - gy * r20)


def forces_over_time(
    body: Body, propulsion: Propulsion, nu: Array, down: Array, rps: Array
) -> tuple[Array, Array]:
    """Forces and moments of the hull, (T, 6), and of each thruster, (T, n, 6), over time.

    Args:
        body: the vehicle's.
        propulsion: n thrusters.
        nu: (T, 6) velocity through the water.
        down: (T, 3) the direction down in the body frame.
        rps: (T, n) speeds.

    Returns:
        Damping, inertial terms, weight and buoyancy; and thrusts.
    """
    hull, thrust = np.zeros((len(nu), 6)), np.zeros((*rps.shape, 6))
    _write_forces(body, propulsion, nu, down, rps, np.zeros(rps.shape[1]), hull, thrust)
    return hull, thrust


@kernel
def _write_forces(
    body: Body,
    propulsion: Propulsion,
    nu: Array,
    down: Array,
    rps: Array,
    alone: Array,
    hull: Array,
    thrust: Array,
) -> None:
    for k in range(nu.shape[0]):
        add_damping(body, nu[k], hull[k])
        add_coriolis(body, nu[k], hull[k])
        add_weight(body, down[k, 0], down[k, 1], down[k, 2], hull[k])
        for i in range(rps.shape[1]):
            alone[:] = 0.0
            alone[i] = rps[k, i]
            add_thrust(propulsion, alone, nu[k], thrust[k, i])


@kernel
def derivative(
    time_s: float,
    state: Array,
    command: Array,
    load: Array,
    plant: Plant,
    current: Current,
    scratch: Scratch,
    out: Array,
) -> None:
    """Rate of change of a state.

    Args:
        time_s: for the current.
        state: (13 + n + m,)
        command: (n + m,) commanded speeds of the thrusters, rev/s, and angles of the fins, rad.
        load: (6,) other forces and moments on the body, in its frame.
        plant: the vehicle.
        current: the water.
        scratch: work arrays.
        out: (13 + n + m,) is written.
    """
    body = plant.body
    nu, force, water = state[7:13], scratch.force, scratch.water
    x, y, z, s = state[3], state[4], state[5], state[6]
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = matrix_rows(x, y, z, s)
    current_at(current, time_s, state[2], water)

    u, v, w, p, q, r = nu[0], nu[1], nu[2], nu[3], nu[4], nu[5]
    out[0] = r00 * u + r01 * v + r02 * w + water[0]
    out[1] = r10 * u + r11 * v + r12 * w + water[1]
    out[2] = r20 * u + r21 * v + r22 * w
    out[3] = 0.5 * (s * p + y * r - z * q)
    out[4] = 0.5 * (s * q + z * p - x * r)
    out[5] = 0.5 * (s * r + x * q - y * p)
    out[6] = -0.5 * (x * p + y * q + z * r)

    for i in range(6):
        force[i] = load[i]
    fins_from = plant.propulsion.table.shape[0]
    add_thrust(plant.propulsion, state[13:], nu, force)
    add_fins(plant.fins, state[13 + fins_from :], nu, force)
    add_damping(body, nu, force)
    add_coriolis(body, nu, force)
    add_weight(body, r20, r21, r22, force)
    if state[2] < 0.0:
        # Above the surface the hull loses its buoyancy, and propellers their water.
        dry = min(-state[2] / _DRAUGHT_M, 1.0)
        scratch.thrust[:] = 0.0
        add_thrust(plant.propulsion, state[13:], nu, scratch.thrust)
        for i in range(6):
            force[i] -= dry * scratch.thrust[i]
        lost_n = dry * body.buoyancy_n
        force[0] += lost_n * r20
        force[1] += lost_n * r21
        force[2] += lost_n * r22
    # A current that changes along the way down, and in time.
    along_n, along_e = water[4] * out[2], water[5] * out[2]
    if along_n != 0.0 or along_e != 0.0 or water[2] != 0.0 or water[3] != 0.0:
        held = body.in_current
        ax, ay, az = (
            r00 * along_n + r10 * along_e,
            r01 * along_n + r11 * along_e,
            r02 * along_n + r12 * along_e,
        )
        tx, ty, tz = (
            r00 * water[2] + r10 * water[3],
            r01 * water[2] + r11 * water[3],
            r02 * water[2] + r12 * water[3],
        )
        for i in range(6):
            force[i] -= (
                held[i, 0] * ax + held[i, 1] * ay + held[i, 2] * az
                + held[i, 3] * tx + held[i, 4] * ty + held[i, 5] * tz
            )  # fmt: skip
    for i in range(6):
        total = 0.0
        for j in range(6):
            total += body.mass_inverse[i, j] * force[j]
        out[7 + i] = total
    add_speed_rates(plant.propulsion, state[13:], command, out[13:])
    # The fins lag too, with limits of angle and rate.
    drives = plant.fins.drives
    for j in range(drives.shape[0]):
        maximum, fastest, k = drives[j, MAX_RAD], drives[j, MAX_RAD_S], fins_from + j
        rate = (min(max(command[k], -maximum), maximum) - state[13 + k]) * drives[j, LAG_RATE]
        out[13 + k] = min(max(rate, -fastest), fastest)


@kernel
def rk4_step(
    time_s: float,
    step_s: float,
    state: Array,
    command: Array,
    load: Array,
    plant: Plant,
    current: Current,
    scratch: Scratch,
) -> None:
    """Advance a state (13 + n + m,), which is overwritten, by the classical Runge-Kutta method."""
    k, count = scratch.stages, state.shape[0]
    trial = k[4]
    derivative(time_s, state, command, load, plant, current, scratch, k[0])
    for i in range(count):
        trial[i] = state[i] + 0.5 * step_s * k[0, i]
    derivative(time_s + 0.5 * step_s, trial, command, load, plant, current, scratch, k[1])
    for i in range(count):
        trial[i] = state[i] + 0.5 * step_s * k[1, i]
    derivative(time_s + 0.5 * step_s, trial, command, load, plant, current, scratch, k[2])
    for i in range(count):
        trial[i] = state[i] + step_s * k[2, i]
    derivative(time_s + step_s, trial, command, load, plant, current, scratch, k[3])
    for i in range(count):
        state[i] += step_s / 6.0 * (k[0, i] + 2.0 * (k[1, i] + k[2, i]) + k[3, i])
    norm = 0.0
    for i in range(3, 7):
        norm += state[i] * state[i]
    norm = norm**0.5
    for i in range(3, 7):
        state[i] /= norm
