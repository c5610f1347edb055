"""Steady flight of vehicles that fins steer: trim, the tightest turn, the lowest speed.

Such a vehicle holds its depth by the lift of a hull that is pitched, and turns by that of one that
drifts: at a speed u and a rate of turn r pitch, drift v and the fins' angles are those at which
heave, pitch, sway and yaw balance (weight, buoyancy, damping, body lift, Coriolis forces and fins:
the laws of `dynamics` and `fins`). Roll is left to the low centre of gravity.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.dynamics import add_coriolis, add_damping, add_weight
from alice_survey.sim.vehicle.fins import MAX_RAD, add_fins, write_fin_matrix
from alice_survey.sim.vehicle.vehicle import Vehicle

MAX_DRIFT_RAD = math.radians(10.0)
"""Greatest angle of the hull to the flow in steady flight, up to about which the laws of body lift
hold (Hoerner 1975, chapter 19)."""
_SPEEDS_MPS = (0.05, 10.0)
_WIDEST_M = 1000.0
_BALANCED = 1e-6
"""Residual forces, N and N m, of a steady flight over those of the fins."""


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


def keeps(vehicle: Vehicle, speed_mps: float, turn_rad_s: float = 0.0) -> FinFlight | None:
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

    def unbalanced(unknown: Array) -> Array:
        left: Array = forces(unknown)[[1, 2, 4, 5]]
        return left

    found = root(
        unbalanced,
        np.array([0.0, -0.3 * turn_rad_s / max(speed_mps, 1e-9), 0.0, 0.0]),
    )
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


def held(vehicle: Vehicle, speed_mps: float, turn_rad_s: float, share: float) -> FinFlight | None:
    """Steady level flight with a share of the fins' angles and the hull along the flow, or None."""
    flight = keeps(vehicle, speed_mps, turn_rad_s)
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
        return all(held(vehicle, speed_mps, rate, share) is not None for rate in rates)

    wide, tight = _WIDEST_M, _WIDEST_M
    if not turns(wide):
        raise VehicleError(too_slow(vehicle, speed_mps, share))
    while tight > 0.1 and turns(tight / 1.2):
        tight /= 1.2
    wide, tight = tight, tight / 1.2
    while wide - tight > 1e-3:
        middle = 0.5 * (wide + tight)
        wide, tight = (middle, tight) if turns(middle) else (wide, middle)
    return wide


@lru_cache(maxsize=64)
def min_speed_mps(vehicle: Vehicle, share: float) -> float:
    """Lowest speed at which fins and hull carry a vehicle's buoyancy or weight level.

    Args:
        vehicle: with fins.
        share: of the fins' greatest angles that may be used.

    Raises:
        VehicleError: there is none.
    """
    speeds = np.geomspace(*_SPEEDS_MPS, 60).tolist()
    flies = [held(vehicle, speed, 0.0, share) is not None for speed in speeds]
    if not any(flies):
        raise VehicleError(
            f"the fins of {vehicle.name} hold it level at no speed: check their places, areas and "
            "shafts, and weight and buoyancy"
        )
    first = flies.index(True)
    if first == 0:
        return float(speeds[0])
    low, high = speeds[first - 1], speeds[first]
    while high - low > 1e-4:
        middle = 0.5 * (low + high)
        flies_there = held(vehicle, middle, 0.0, share) is not None
        low, high = (low, middle) if flies_there else (middle, high)
    return float(high)


def too_slow(vehicle: Vehicle, speed_mps: float, share: float) -> str:
    """What is wrong with a speed, in words."""
    minimum = math.ceil(100.0 * min_speed_mps(vehicle, share)) / 100.0
    net_n = (vehicle.rigid_body.buoyancy_kg - vehicle.rigid_body.dry_kg) * 9.80665
    return (
        f"{vehicle.name} is held level by its fins from {minimum:.2f} m/s through the water on, "
        f"not at {speed_mps:.2f} (it is {abs(net_n):.1f} N {'light' if net_n > 0 else 'heavy'}): "
        "raise the speed, or trim it closer to neutral"
    )
