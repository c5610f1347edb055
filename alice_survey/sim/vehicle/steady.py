"""Steady motion: thruster speeds and power that keep a velocity.

The laws are those of `dynamics`, `propulsion` and `allocation`, called at many velocities: what a
planner counts on is what the simulator flies. The vehicle is level; what rolls and pitches it is
left to its weight, as in allocation. Surge, sway, heave and yaw are balanced exactly, the torque of
propellers and the drag of jets included. A vehicle that fins steer is not level: its pitch and
drift are those of `under_way`, and its thrusters give what that takes ahead.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.allocation import (
    AXIS_WEIGHTS,
    AllocationScratch,
    allocate_exact,
    allocation_scratch,
    preference_weights,
)
from alice_survey.sim.vehicle.compiled import kernel
from alice_survey.sim.vehicle.dynamics import Body, add_coriolis, add_damping
from alice_survey.sim.vehicle.propulsion import (
    MOST,
    Propulsion,
    add_thrust,
    electrical_power,
    speeds_for,
    thrust_limits,
)
from alice_survey.sim.vehicle.under_way import held
from alice_survey.sim.vehicle.vehicle import Vehicle

BALANCED = (0, 1, 2, 5)
"""Surge, sway, heave and yaw."""
_ROUNDS = 60
_MISS_N = 1e-9
"""Tolerance, N and N m, within which a wrench is met."""


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


class _Room(NamedTuple):
    """Work arrays for one velocity."""

    lower: Array
    upper: Array
    weights: Array
    thrust: Array
    target: Array
    allocation: AllocationScratch


def steady_flight(
    vehicle: Vehicle,
    nu: Array,
    nu_rate: Array | None = None,
    *,
    share: float = 1.0,
    slips: bool = False,
) -> SteadyFlight:
    """Thrusters and power that keep a level vehicle at velocities relative to the water.

    Thrusts are those of least effort, as the pilot allocates them.

    Args:
        vehicle: the vehicle.
        nu: (N, 6) velocity relative to the water, in the body.
        nu_rate: (N, 6) its rate of change, as when the vehicle turns in a current; 0 if not given.
        share: share of each thruster's greatest speed squared that may be used.
        slips: leave out what no thruster can balance, instead of giving NaN: a vehicle without sway
            that turns is pushed sideways, and goes.
    """
    body, propulsion, _ = vehicle.plant
    nu = np.ascontiguousarray(nu, dtype=np.float64)
    matrix = np.ascontiguousarray(vehicle.configuration_matrix)
    if vehicle.fins:
        wanted, axes = _wanted_of_fins(vehicle, nu, share), np.eye(6)[0]
    else:
        water = np.zeros((len(nu), 6))
        _add_water(body, nu, water)
        wanted = -water
        wanted[:, 2] -= body.weight_n - body.buoyancy_n
        if nu_rate is not None:
            wanted += nu_rate @ body.mass
        axes = AXIS_WEIGHTS * np.any(np.abs(matrix) > 1e-12, axis=1)
    n = len(vehicle.thrusters)
    room = _Room(
        lower=np.zeros(n), upper=np.zeros(n), weights=np.zeros(n), thrust=np.zeros(n),
        target=np.zeros(6), allocation=allocation_scratch(n),
    )  # fmt: skip
    rps, power_w, made = np.zeros((len(nu), n)), np.zeros((len(nu), n)), np.zeros((len(nu), 6))
    _keep(propulsion, matrix, axes, np.full(n, share), wanted, nu, room, made, rps, power_w)
    balanced = np.flatnonzero(axes) if slips or vehicle.fins else list(BALANCED)
    off = np.abs(wanted - made)[:, balanced].max(axis=1)
    lost = ~(off <= 1e3 * _MISS_N)
    load = (rps / propulsion.table[:, MOST]) ** 2
    return SteadyFlight(
        rps=np.where(lost[:, None], np.nan, rps),
        power_w=np.where(lost, np.nan, power_w.sum(axis=1)),
        load=np.where(lost, np.nan, load.max(axis=1)),
    )


def _wanted_of_fins(vehicle: Vehicle, nu: Array, share: float) -> Array:
    """Force ahead, (N, 6), that keeps a vehicle with fins at surges and rates of turn.

    NaN where they do not fly level, or more is asked than surge and turn.
    """
    wanted = np.zeros((len(nu), 6))
    known: dict[tuple[float, float], float] = {}
    for row, (u, v, w, _, _, r) in zip(wanted, np.round(nu, 3).tolist(), strict=True):
        if u <= 0.0 or v != 0.0 or w != 0.0:
            row[0] = np.nan
            continue
        if (u, abs(r)) not in known:
            flight = held(vehicle, u, abs(r), share)
            known[u, abs(r)] = np.nan if flight is None else flight.force_x_n
        row[0] = known[u, abs(r)]
    return wanted


def drag_power(body: Body, nu: Array) -> Array:
    """Power, (N,) W, that the water takes from a body at velocities (N, 6) relative to it."""
    nu = np.ascontiguousarray(nu, dtype=np.float64)
    force = np.zeros_like(nu)
    _add_drag(body, nu, force)
    power: Array = -np.sum(nu * force, axis=1)
    return power


@kernel
def _add_drag(body: Body, nu: Array, force: Array) -> None:
    """Add damping and body lift at velocities (N, 6) to forces (N, 6)."""
    for k in range(nu.shape[0]):
        add_damping(body, nu[k], force[k])


@kernel
def _add_water(body: Body, nu: Array, force: Array) -> None:
    """Add damping, body lift and Coriolis force at velocities (N, 6) to forces (N, 6)."""
    for k in range(nu.shape[0]):
        add_damping(body, nu[k], force[k])
        add_coriolis(body, nu[k], force[k])


@kernel
def _keep(
    propulsion: Propulsion,
    matrix: Array,
    axes: Array,
    share: Array,
    wanted: Array,
    nu: Array,
    room: _Room,
    made: Array,
    rps: Array,
    power_w: Array,
) -> None:
    """Find thruster speeds whose wrench, jets and torques included, is the one wanted.

    The wrench that is allocated is corrected by what was missed until nothing is; a row whose
    allocation cannot be met is left with what it makes.

    Args:
        propulsion: n thrusters.
        matrix: (6, n) wrench per thrust.
        axes: (6,) weights of the axes, 0 of one that no thruster has.
        share: (n,) of each thruster's greatest speed squared.
        wanted: (N, 6)
        nu: (N, 6)
        room: work arrays for one velocity.
        made: (N, 6) wrench, is written.
        rps: (N, n) is written.
        power_w: (N, n) is written.
    """
    n = matrix.shape[1]
    for k in range(nu.shape[0]):
        thrust_limits(propulsion, share, nu[k], room.lower, room.upper)
        preference_weights(propulsion, nu[k, 0], room.weights)
        for axis in range(6):
            room.target[axis] = wanted[k, axis]
        for _ in range(_ROUNDS):
            allocate_exact(
                matrix, room.target, room.lower, room.upper, axes, room.weights, room.thrust,
                room.allocation,
            )  # fmt: skip
            speeds_for(propulsion, room.thrust, nu[k], rps[k])
            for axis in range(6):
                made[k, axis] = 0.0
            add_thrust(propulsion, rps[k], nu[k], made[k])
            worst = 0.0
            beyond = False
            for axis in range(6):
                if axes[axis] > 0.0:
                    allocated = 0.0
                    for i in range(n):
                        allocated += matrix[axis, i] * room.thrust[i]
                    slack = _MISS_N * (1.0 + abs(room.target[axis]))
                    beyond = beyond or abs(allocated - room.target[axis]) > slack
                    miss = wanted[k, axis] - made[k, axis]
                    worst = max(worst, abs(miss))
                    room.target[axis] += miss
            if beyond or worst <= _MISS_N:
                break
        electrical_power(propulsion, rps[k], nu[k], power_w[k])
