"""Steady motion: what thrusters must do, and the power they take, to keep a velocity.

The same equations as in `dynamics` and `propulsion`, for many velocities at once in numpy, without
compiled code: a planner asks for a few hundred of them and then no more. The vehicle is level; what
rolls and pitches it is left to its weight, as in allocation. Surge, sway, heave and yaw are
balanced exactly, the torque of propellers and the drag of jets included.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from alice_survey.base.frames import Array
from alice_survey.vehicle.dynamics import Body
from alice_survey.vehicle.propulsion import (
    ADVANCE,
    ARM,
    AXIS,
    DISTRUST,
    DRAG,
    FORWARD,
    HAND,
    IDLE,
    JET_AREA,
    JET_CENTRE,
    JET_LOSS,
    KEPT,
    MOST,
    REVERSE,
    TORQUE_ADVANCE,
    TORQUE_FORWARD,
    TORQUE_REVERSE,
    WATTS,
)
from alice_survey.vehicle.vehicle import Vehicle

BALANCED = (0, 1, 2, 5)
"""Surge, sway, heave and yaw."""
_ROUNDS = 60
_MISS_N = 1e-9
"""A wrench that is missed by no more, N and N m, is met."""
_RANK = 1e-9
"""Of the greatest: what is smaller is rounding."""
_FAINT_N = 1e-12
"""A jet weaker than this is none."""
_MOST_EXPONENT = 9.0
"""As in `allocation.preference`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SteadyFlight:
    """Thrusters and power at N velocities; a row is NaN where the thrusters cannot keep it."""

    rps: Array
    """(N, n) speed of each thruster."""
    power_w: Array
    """(N,) electrical, of all thrusters."""
    load: Array
    """(N,) the hardest worked thruster's square of speed by the greatest it can turn at: 1 at its
    limit."""


def steady_flight(
    vehicle: Vehicle,
    nu: Array,
    nu_rate: Array | None = None,
    *,
    share: float = 1.0,
    slips: bool = False,
) -> SteadyFlight:
    """What keeps a level vehicle at velocities relative to the water.

    Thrusts are those of least effort, as the pilot allocates them.

    Args:
        vehicle: what moves.
        nu: (N, 6) velocity relative to the water, in the body.
        nu_rate: (N, 6) its rate of change, as when the vehicle turns in a current; 0 if not given.
        share: of each thruster's greatest speed squared that may be used.
        slips: leave out what no thruster can balance, instead of giving NaN: a vehicle without sway
            that turns is pushed sideways, and goes.
    """
    plant = vehicle.plant
    table = plant.propulsion.table
    wanted = -water_force(plant.body, nu)
    wanted[:, 2] -= plant.body.weight_n - plant.body.buoyancy_n
    if nu_rate is not None:
        wanted += nu_rate @ plant.body.mass
    configuration = vehicle.configuration_matrix
    asked = [axis for axis in BALANCED if np.any(np.abs(configuration[axis]) > 1e-12)]
    target, spent = wanted[:, asked].copy(), np.zeros(len(nu), dtype=bool)
    matrix = configuration[asked]
    inverse, spare = _inverse(matrix, preference(table, nu[:, 0]))
    lower, upper = limits(table, nu, share)
    rps = np.zeros((len(nu), len(table)))
    for _ in range(_ROUNDS):
        thrust = _least_thrust(matrix, inverse, spare, target, lower, upper)
        spent = np.any(np.isnan(thrust), axis=1)
        rps = speeds_of(table, np.where(spent[:, None], 0.0, thrust), nu)
        miss = (wanted - thruster_wrench(table, rps, nu))[:, asked]
        miss[spent] = 0.0
        if np.abs(miss).max(initial=0.0) <= _MISS_N:
            break
        target = target + miss
    balanced = asked if slips else list(BALANCED)
    off = np.abs(wanted - thruster_wrench(table, rps, nu))[:, balanced].max(axis=1)
    lost = spent | (off > 1e3 * _MISS_N)
    power, load = power_of(table, rps, nu).sum(axis=1), (rps / table[:, MOST]) ** 2
    return SteadyFlight(
        rps=np.where(lost[:, None], np.nan, rps),
        power_w=np.where(lost, np.nan, power),
        load=np.where(lost, np.nan, load.max(axis=1)),
    )


def drag_power(body: Body, nu: Array) -> Array:
    """Power, (N,) W, that the water takes from a body at velocities (N, 6) relative to it."""
    power: Array = -np.sum(nu * _damping(body, nu), axis=1)
    return power


def water_force(body: Body, nu: Array) -> Array:
    """Damping, body lift and Coriolis force, (N, 6), at velocities (N, 6): as in `dynamics`."""
    momentum = nu @ body.mass
    force = _damping(body, nu)
    force[:, :3] -= np.cross(nu[:, 3:], momentum[:, :3])
    force[:, 3:] -= np.cross(nu[:, :3], momentum[:, :3]) + np.cross(nu[:, 3:], momentum[:, 3:])
    return force


def _damping(body: Body, nu: Array) -> Array:
    force: Array = nu @ body.linear.T + (nu * np.abs(nu)) @ body.quadratic.T
    u, v, w = nu[:, 0], nu[:, 1], nu[:, 2]
    force[:, 1] += body.lift[0] * np.abs(u) * v
    force[:, 2] += body.lift[1] * np.abs(u) * w
    force[:, 4] += body.lift[2] * u * w
    force[:, 5] += body.lift[3] * u * v
    return force


def preference(table: Array, surge_mps: Array) -> Array:
    """Weights of thrusters, (N, n), at surge speeds (N,): as in `allocation.preference`."""
    weights: Array = np.exp(
        np.minimum(table[:, DISTRUST] * surge_mps[:, None] ** 2, _MOST_EXPONENT)
    )
    return weights


def thruster_wrench(table: Array, rps: Array, nu: Array) -> Array:
    """Force and moment, (N, 6), of thrusters at speeds (N, n): as `propulsion.add_thrust`."""
    t, u = table, nu[:, :1]
    along, size = _inflow(t, nu), np.abs(rps)
    ahead = rps > 0.0
    whole = size * (np.where(ahead, t[:, FORWARD], t[:, REVERSE]) * rps - t[:, ADVANCE] * along)
    torque = np.where(ahead, t[:, TORQUE_FORWARD], t[:, TORQUE_REVERSE]) * rps
    torque = -t[:, HAND] * size * (torque - t[:, TORQUE_ADVANCE] * along)
    strength = np.maximum(np.abs(whole), _FAINT_N)
    bent = whole * np.exp(-t[:, JET_LOSS] * u**2 / strength)
    moment = np.copysign(t[:, JET_CENTRE], u) * (whole - bent)
    ratio = np.abs(u) * np.sqrt(t[:, JET_AREA] / strength)
    jet = t[:, DRAG] * np.exp(-t[:, DRAG + 1] * ratio)
    jet = jet + t[:, DRAG + 2] * np.exp(-t[:, DRAG + 3] * ratio)
    thrust = t[:, KEPT] * bent
    axes, arms = t[:, AXIS : AXIS + 3], t[:, ARM : ARM + 3]
    wrench = np.hstack([thrust @ axes, thrust @ arms + torque @ axes])
    wrench[:, 0] -= jet.sum(axis=1) * (u * np.abs(u))[:, 0]
    wrench[:, 4] -= moment @ axes[:, 2]
    wrench[:, 5] += moment @ axes[:, 1]
    return wrench


def speeds_of(table: Array, thrust: Array, nu: Array) -> Array:
    """Speeds, (N, n), that give thrusts (N, n): as `propulsion.speeds_for`."""
    from scipy.special import lambertw

    t = table
    size = np.abs(thrust) / t[:, KEPT]
    asked = size >= 1e-12
    size = np.where(asked, size, 1.0)
    loss: Any = t[:, JET_LOSS] * nu[:, :1] ** 2 / size
    size = size * np.exp(np.asarray(lambertw(loss)).real)
    ahead = thrust > 0.0
    gain = np.where(ahead, t[:, FORWARD], t[:, REVERSE])
    half = 0.5 * np.where(ahead, 1.0, -1.0) * t[:, ADVANCE] * _inflow(t, nu)
    root = np.sqrt(half**2 + gain * size)
    speed = np.where(half > 0.0, (half + root) / gain, size / (root - np.minimum(half, 0.0)))
    speeds: Array = np.where(asked, np.where(ahead, speed, -speed), 0.0)
    return speeds


def power_of(table: Array, rps: Array, nu: Array) -> Array:
    """Electrical power, (N, n) W, at speeds (N, n): as `propulsion.electrical_power`."""
    t = table
    gain = np.where(rps > 0.0, t[:, TORQUE_FORWARD], t[:, TORQUE_REVERSE])
    torque = np.abs(rps) * (gain * rps - t[:, TORQUE_ADVANCE] * _inflow(t, nu))
    power: Array = t[:, IDLE] + t[:, WATTS] * np.maximum(2.0 * np.pi * rps * torque, 0.0)
    return power


def limits(table: Array, nu: Array, share: float = 1.0) -> tuple[Array, Array]:
    """Least and greatest thrust, (N, n), at a share of the greatest speed squared."""
    ends = []
    for sense in (-1.0, 1.0):
        rps = np.broadcast_to(sense * np.sqrt(share) * table[:, MOST], (len(nu), len(table)))
        gain = table[:, FORWARD] if sense > 0 else table[:, REVERSE]
        thrust = np.abs(rps) * (gain * rps - table[:, ADVANCE] * _inflow(table, nu))
        strength = np.maximum(np.abs(thrust), _FAINT_N)
        thrust = thrust * np.exp(-table[:, JET_LOSS] * nu[:, :1] ** 2 / strength)
        ends.append(table[:, KEPT] * thrust)
    return np.minimum(ends[0], 0.0), np.maximum(ends[1], 0.0)


def _inflow(table: Array, nu: Array) -> Array:
    """Speed of the body through the water along each thruster's axis where it sits, (N, n)."""
    inflow: Array = nu[:, :3] @ table[:, AXIS : AXIS + 3].T + nu[:, 3:] @ table[:, ARM : ARM + 3].T
    return inflow


def _inverse(matrix: Array, weights: Array) -> tuple[Array, Array]:
    """What gives the thrust of least weighted square for a wrench, and what thrust makes none.

    Args:
        matrix: (m, n) wrench per thrust.
        weights: (N, n) of thrust squared.

    Returns:
        (N, n, m) thrust per wrench, and (k, n) thrusts that make no wrench.
    """
    _, singular, rows = np.linalg.svd(matrix)
    rank = int(np.sum(singular > _RANK * singular[0])) if singular.size else 0
    scale = 1.0 / np.sqrt(weights)
    inverse: Array = scale[:, :, None] * np.linalg.pinv(matrix * scale[:, None, :], rcond=_RANK)
    return inverse, rows[rank:]


def _least_thrust(
    matrix: Array, inverse: Array, spare: Array, wrench: Array, lower: Array, upper: Array
) -> Array:
    """Thrust of least weighted square that makes a wrench within its bounds.

    One thruster more than axes leaves a line of solutions: the least is on it where the bounds cut
    it off. With none to spare there is one solution.

    Args:
        matrix: (m, n) wrench per thrust.
        inverse: as from `_inverse`.
        spare: likewise.
        wrench: (N, m)
        lower: (N, n)
        upper: (N, n)

    Returns:
        (N, n), NaN where no thrust within the bounds makes the wrench.
    """
    thrust: Array = np.einsum("knm,km->kn", inverse, wrench)
    made = np.all(np.abs(thrust @ matrix.T - wrench) <= _RANK * (1.0 + np.abs(wrench)), axis=1)
    if len(spare) == 1:
        way = spare[0]
        moves = np.abs(way) > _RANK
        ends = np.stack([(lower - thrust)[:, moves], (upper - thrust)[:, moves]]) / way[moves]
        least, most = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)
        step = np.clip(0.0, least, np.maximum(most, least))
        thrust = thrust + step[:, None] * way
    slack = _RANK * (1.0 + np.abs(upper) + np.abs(lower))
    within = np.all((thrust >= lower - slack) & (thrust <= upper + slack), axis=1)
    return np.where((made & within)[:, None], thrust, np.nan)
