"""Steady motion: thruster speeds and power that keep a velocity.

The laws are those of `dynamics`, `propulsion` and `allocation`, called at many velocities: what a
planner counts on is what the simulator flies. The vehicle is level; what rolls and pitches it is
left to its weight, as in allocation. Surge, sway, heave and yaw are balanced exactly, the torque of
propellers and the drag of jets included. A vehicle that fins steer is not level: its pitch and
drift are those of `fin_flight`, and its thrusters give what that takes ahead.

Such a vehicle holds its depth by the lift of a hull that is pitched, and turns by that of one that
drifts: at a speed u and a rate of turn r pitch, drift v and the fins' angles are those at which
heave, pitch, sway and yaw balance (weight, buoyancy, damping, body lift, Coriolis forces and fins:
the laws of `dynamics` and `fins`). Roll is left to the low centre of gravity.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from alice_survey.core.compiled import kernel
from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.allocation import AXIS_WEIGHTS, Allocation, allocate, new_allocation
from alice_survey.sim.vehicle.dynamics import add_coriolis, add_damping, add_weight
from alice_survey.sim.vehicle.fins import MAX_RAD, add_fins, write_fin_matrix
from alice_survey.sim.vehicle.propulsion import MAX_RPS, add_thrust, electrical_power
from alice_survey.sim.vehicle.vehicle import Vehicle

MAX_DRIFT_RAD = math.radians(10.0)
"""Greatest angle of the hull to the flow in steady flight, up to about which the laws of body lift
hold (Hoerner 1975, chapter 19)."""
_SPEEDS_MPS = (0.05, 10.0)
_WIDEST_M = 1000.0
_BALANCED = 1e-6
"""Residual forces, N and N m, of a steady flight over those of the fins."""


def bisect(holds: Callable[[float], bool], yes: float, no: float, tolerance: float) -> float:
    """Where something ceases to hold, between a value for which it does and one for which not.

    Returns:
        The last value found for which it holds.
    """
    while abs(yes - no) > tolerance:
        middle = 0.5 * (yes + no)
        yes, no = (middle, no) if holds(middle) else (yes, middle)
    return yes


@dataclass(frozen=True, kw_only=True, eq=False)
class FinFlight:
    """Level flight that fins keep."""

    nu: Array
    """(6,) velocity relative to the water."""
    pitch_rad: float
    angles_rad: Array
    """(m,) of the fins."""
    force_x_n: float
    """Force ahead that thrusters must give."""
    load: float
    """The most turned fin's angle over its greatest."""

    @property
    def drift_rad(self) -> float:
        """Angle of the hull to the flow."""
        return math.atan2(math.hypot(self.nu[1], self.nu[2]), self.nu[0])


def balance_fins(vehicle: Vehicle, speed_mps: float, turn_rad_s: float = 0.0) -> FinFlight | None:
    """Steady level flight at a surge and a rate of turn; None where nothing balances."""
    from scipy.optimize import root

    body, _, fins = vehicle.plant
    drives = len(vehicle.fins)
    cruise, matrix = np.zeros(6), np.zeros((6, drives))
    cruise[0] = speed_mps
    write_fin_matrix(fins, cruise, matrix, 0)
    if np.linalg.matrix_rank(matrix[4:]) < 2:
        return None
    mix = np.linalg.pinv(matrix[3:])[:, 1:]  # angles by moments of pitch and yaw

    def state(unknown: Array) -> tuple[Array, Array, float]:
        pitch, drift, *moments = unknown
        nu = np.array([
            speed_mps, speed_mps * drift, speed_mps * math.tan(pitch),
            -turn_rad_s * math.sin(pitch), 0.0, turn_rad_s * math.cos(pitch),
        ])  # fmt: skip
        return nu, np.clip(mix @ moments, -math.pi / 2, math.pi / 2), pitch

    def forces(unknown: Array) -> Array:
        nu, angles, pitch = state(unknown)
        force = np.zeros(6)
        add_damping(body, nu, force)
        add_coriolis(body, nu, force)
        add_fins(fins, angles, nu, force)
        add_weight(body, -math.sin(pitch), 0.0, math.cos(pitch), force)
        return force

    def imbalance(unknown: Array) -> Array:
        return forces(unknown)[[1, 2, 4, 5]]

    found = root(imbalance, np.array([0.0, -0.3 * turn_rad_s / max(speed_mps, 1e-9), 0.0, 0.0]))
    if np.abs(found.fun).max() > _BALANCED * (1.0 + np.abs(matrix).max()):
        return None
    nu, angles, pitch = state(found.x)
    return FinFlight(
        nu=nu,
        pitch_rad=float(pitch),
        angles_rad=angles,
        force_x_n=-float(forces(found.x)[0]),
        load=float(np.max(np.abs(angles) / fins.drives[:, MAX_RAD])),
    )


def fin_flight(
    vehicle: Vehicle, speed_mps: float, turn_rad_s: float, share: float
) -> FinFlight | None:
    """Steady level flight with a share of the fins' angles and the hull along the flow, or None."""
    flight = balance_fins(vehicle, speed_mps, turn_rad_s)
    if flight is None or flight.load > share or flight.drift_rad > MAX_DRIFT_RAD:
        return None
    return flight


@lru_cache(maxsize=64)
def min_radius_m(vehicle: Vehicle, speed_mps: float, share: float) -> float:
    """Radius of the tightest turn that fins hold at a speed, in both senses.

    Args:
        vehicle: with fins.
        speed_mps: surge.
        share: of the fins' greatest angles that may be used.

    Raises:
        VehicleError: it does not even fly straight.
    """

    def turns(radius_m: float) -> bool:
        rates = (speed_mps / radius_m, -speed_mps / radius_m)
        return all(fin_flight(vehicle, speed_mps, rate, share) is not None for rate in rates)

    tight = _WIDEST_M
    if not turns(tight):
        raise VehicleError(too_slow(vehicle, speed_mps, share))
    while tight > 0.1 and turns(tight / 1.2):
        tight /= 1.2
    return bisect(turns, tight, tight / 1.2, 1e-3)


@lru_cache(maxsize=64)
def min_speed_mps(vehicle: Vehicle, share: float) -> float:
    """Lowest speed at which fins and hull carry a vehicle's buoyancy or weight level.

    Args:
        vehicle: with fins.
        share: of the fins' greatest angles that may be used.

    Raises:
        VehicleError: there is none.
    """

    def flies(speed: float) -> bool:
        return fin_flight(vehicle, speed, 0.0, share) is not None

    speeds = np.geomspace(*_SPEEDS_MPS, 60).tolist()
    first = next((k for k, speed in enumerate(speeds) if flies(speed)), None)
    if first is None:
        raise VehicleError(
            f"the fins of {vehicle.name} hold it level at no speed: check their places, areas and "
            "shafts, and weight and buoyancy"
        )
    return bisect(flies, speeds[first], speeds[max(first - 1, 0)], 1e-4)


def too_slow(vehicle: Vehicle, speed_mps: float, share: float) -> str:
    """What is wrong with a speed, in words."""
    minimum = math.ceil(100.0 * min_speed_mps(vehicle, share)) / 100.0
    net_n = (vehicle.rigid_body.buoyancy_kg - vehicle.rigid_body.dry_kg) * 9.80665
    return (
        f"{vehicle.name} is held level by its fins from {minimum:.2f} m/s through the water on, "
        f"not at {speed_mps:.2f} (it is {abs(net_n):.1f} N {'light' if net_n > 0 else 'heavy'}): "
        "raise the speed, or trim it closer to neutral"
    )


BALANCED = (0, 1, 2, 5)
"""Surge, sway, heave and yaw."""
_ROUNDS = 60
_TOLERANCE_N = 1e-9
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
        requested, axes = _fin_force_ahead(vehicle, nu, share), np.eye(6)[0]
    else:
        water = np.zeros((len(nu), 6))
        for motion, force in zip(nu, water, strict=True):
            add_damping(body, motion, force)
            add_coriolis(body, motion, force)
        requested = -water
        requested[:, 2] -= body.weight_n - body.buoyancy_n
        if nu_rate is not None:
            requested += nu_rate @ body.mass
        axes = AXIS_WEIGHTS * np.any(np.abs(matrix) > 1e-12, axis=1)
    n = len(vehicle.thrusters)
    allocation = new_allocation(vehicle, np.full(n, share), exact=True, axes=axes)
    rps, power_w, made = np.zeros((len(nu), n)), np.zeros((len(nu), n)), np.zeros((len(nu), 6))
    _keep(allocation, requested, nu, np.zeros(6), made, rps, power_w)
    balanced = np.flatnonzero(axes) if slips or vehicle.fins else list(BALANCED)
    off = np.abs(requested - made)[:, balanced].max(axis=1)
    lost = ~(off <= 1e3 * _TOLERANCE_N)
    load = (rps / propulsion.table[:, MAX_RPS]) ** 2
    return SteadyFlight(
        rps=np.where(lost[:, None], np.nan, rps),
        power_w=np.where(lost, np.nan, power_w.sum(axis=1)),
        load=np.where(lost, np.nan, load.max(axis=1)),
    )


def top_speed_mps(vehicle: Vehicle) -> float:
    """Highest surge that thrusters keep in still water, level; 0 where there is none."""
    nu = np.zeros((200, 6))
    nu[:, 0] = np.geomspace(*_SPEEDS_MPS, len(nu))
    kept = np.isfinite(steady_flight(vehicle, nu).power_w)
    return float(nu[kept, 0].max(initial=0.0))


def _fin_force_ahead(vehicle: Vehicle, nu: Array, share: float) -> Array:
    """Force ahead, (N, 6), that keeps a vehicle with fins at surges and rates of turn.

    NaN where they do not fly level, or more is asked than surge and turn.
    """
    requested = np.zeros((len(nu), 6))
    known: dict[tuple[float, float], float] = {}
    for row, (u, v, w, _, _, r) in zip(requested, np.round(nu, 3).tolist(), strict=True):
        if u <= 0.0 or v != 0.0 or w != 0.0:
            row[0] = np.nan
            continue
        if (u, abs(r)) not in known:
            flight = fin_flight(vehicle, u, abs(r), share)
            known[u, abs(r)] = np.nan if flight is None else flight.force_x_n
        row[0] = known[u, abs(r)]
    return requested


@kernel
def _keep(
    allocation: Allocation,
    requested: Array,
    nu: Array,
    target: Array,
    made: Array,
    rps: Array,
    power_w: Array,
) -> None:
    """Find thruster speeds whose wrench, jets and torques included, is the one requested.

    The wrench that is allocated is corrected by what was missed until nothing is; a row whose
    allocation cannot be met is left with what it makes.

    Args:
        allocation: to n thrusters.
        requested: (N, 6)
        nu: (N, 6)
        target: (6,) room.
        made: (N, 6) wrench, is written.
        rps: (N, n) is written.
        power_w: (N, n) is written.
    """
    propulsion, matrix, axes = allocation.propulsion, allocation.matrix, allocation.axes
    for k in range(nu.shape[0]):
        for axis in range(6):
            target[axis] = requested[k, axis]
        for _ in range(_ROUNDS):
            allocate(target, nu[k], allocation)
            for i in range(rps.shape[1]):
                rps[k, i] = allocation.command[i]
            made[k, :] = 0.0
            add_thrust(propulsion, rps[k], nu[k], made[k])
            worst, beyond = 0.0, False
            for axis in range(6):
                if axes[axis] > 0.0:
                    allocated = 0.0
                    for i in range(rps.shape[1]):
                        allocated += matrix[axis, i] * allocation.thrust[i]
                    slack = _TOLERANCE_N * (1.0 + abs(target[axis]))
                    beyond = beyond or abs(allocated - target[axis]) > slack
                    residual = requested[k, axis] - made[k, axis]
                    worst = max(worst, abs(residual))
                    target[axis] += residual
            if beyond or worst <= _TOLERANCE_N:
                break
        electrical_power(propulsion, rps[k], nu[k], power_w[k])
