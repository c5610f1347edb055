"""Thrusters and allocation a second time: slow, obvious, from the named values of each thruster."""

import itertools
import math
from collections.abc import Sequence

import numpy as np
from scipy.optimize import lsq_linear

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.propulsion import Thruster


def inflow_mps(thruster: Thruster, nu: Array) -> float:
    """Speed of the body through the water along the axis at the propeller."""
    local = nu[:3] + np.cross(nu[3:], thruster.position_body_m)
    return float(np.dot(local, thruster.direction_body))


def _law(
    thruster: Thruster, density: float, n: float, nu: Array, ends: tuple[float, float], slope: float
) -> float:
    """rho n^2 D^4 K(J), the textbook form, with K falling linearly in J from its end at rest."""
    if n == 0:
        return 0.0
    d = thruster.diameter_m
    advance = (1 - thruster.wake_fraction) * inflow_mps(thruster, nu) / (n * d)
    at_rest = ends[0] if n > 0 else -ends[1]
    # Astern J changes its sign with n, and the loss with |n| stays a loss of forward thrust.
    return density * n**2 * d**4 * (at_rest - math.copysign(1, n) * slope * advance)


def open_thrust_n(thruster: Thruster, density: float, n: float, nu: Array) -> float:
    """T_0 = rho n^2 D^4 K_T(J)."""
    ends = thruster.kt_forward, thruster.kt_reverse
    return _law(thruster, density, n, nu, ends, thruster.advance_slope)


def torque_nm(thruster: Thruster, density: float, n: float, nu: Array) -> float:
    """Q = rho n^2 D^5 K_Q(J) on the propeller, along its axis."""
    ends = thruster.kq_forward, thruster.kq_reverse
    return thruster.diameter_m * _law(thruster, density, n, nu, ends, thruster.torque_slope)


def jet_speed_mps(thruster: Thruster, density: float, thrust_n: float) -> float:
    """u_j = sqrt(|T_0| / (rho A))."""
    return math.sqrt(abs(thrust_n) / (density * math.pi * thruster.diameter_m**2 / 4))


def net_thrust_n(thruster: Thruster, density: float, n: float, nu: Array) -> float:
    """T = (1 - t) T_0 exp(-C (u / u_j)^2)."""
    whole = open_thrust_n(thruster, density, n, nu)
    if whole == 0:
        return 0.0
    ratio = nu[0] / jet_speed_mps(thruster, density, whole)
    return (1 - thruster.thrust_deduction) * whole * math.exp(-thruster.jet_loss * ratio**2)


def wrench(
    thrusters: Sequence[Thruster], density: float, displaced_kg: float, rps: Array, nu: Array
) -> Array:
    """(6,) of all thrusters, by cross products."""
    total = np.zeros(6)
    for t, n in zip(thrusters, rps, strict=True):
        direction, place = np.array(t.direction_body), np.array(t.position_body_m)
        whole, net = open_thrust_n(t, density, n, nu), net_thrust_n(t, density, n, nu)
        total[:3] += net * direction
        total[3:] += np.cross(place, net * direction)
        total[3:] -= t.handedness * torque_nm(t, density, n, nu) * direction
        if whole == 0 or nu[0] == 0:
            continue
        a, b, c, d = t.jet_drag
        ratio = abs(nu[0]) / jet_speed_mps(t, density, whole)
        coefficient = a * math.exp(-b * ratio) + c * math.exp(-d * ratio)
        volume = displaced_kg / density
        total[0] -= 0.5 * density * volume ** (2 / 3) * coefficient * nu[0] * abs(nu[0])
    return total


def min_miss(matrix: Array, wanted: Array, lower: Array, upper: Array, axes: Array) -> Array:
    """The best weighted wrench within the bounds, by scipy's BVLS; rows of weight 0 left out."""
    asked, free = axes > 0, upper > lower
    a, b = (axes[:, None] * matrix)[asked], (axes * wanted)[asked]
    held = a[:, ~free] @ lower[~free]
    if not free.any():
        return np.asarray(held)
    found = lsq_linear(
        a[:, free], b - held, (lower[free], upper[free]), method="bvls", tol=1e-14, max_iter=200
    )
    return np.asarray(a[:, free] @ found.x + held)


def redistributed(
    matrix: Array, wanted: Array, lower: Array, upper: Array, axes: Array, weights: Array
) -> Array:
    """The redistributed pseudo-inverse in numpy, as the paper writes it."""
    asked = axes > 0
    whole, tau = (axes[:, None] * matrix)[asked], (axes * wanted)[asked]
    b, c, w_inverse = whole.copy(), np.zeros(len(weights)), np.diag(1 / weights)
    held = upper <= lower
    c[held] = -lower[held]
    b[:, held] = 0.0
    while True:
        gram = b @ w_inverse @ b.T
        gram += 1e-9 * np.trace(gram) / len(gram) * np.eye(len(gram))
        f = -c if held.all() else -c + w_inverse @ b.T @ np.linalg.solve(gram, tau + whole @ c)
        over = ((f > upper) | (f < lower)) & ~held
        if not over.any():
            return np.asarray(f)
        c[over] = -np.clip(f, lower, upper)[over]
        b[:, over] = 0.0
        held |= over


def best_thrust(
    matrix: Array, wanted: Array, lower: Array, upper: Array, axes: Array, weights: Array
) -> Array:
    """Least miss, then least weighted thrust, by trying every set of thrusters at their bounds."""
    asked, scale = axes > 0, 1 / np.sqrt(weights)
    a, b = (axes[:, None] * matrix)[asked] * scale, (axes * wanted)[asked]
    low, high = lower / scale, upper / scale
    candidates = []
    for pattern in itertools.product((0, 1, 2), repeat=len(scale)):
        state = np.array(pattern)
        x = np.where(state == 1, low, np.where(state == 2, high, 0.0))
        free = state == 0
        if free.any():
            x[free] = np.linalg.pinv(a[:, free], rcond=1e-10) @ (b - a @ x)
        if np.all(x >= low - 1e-9) and np.all(x <= high + 1e-9):
            candidates.append(x)
    misses = np.array([np.linalg.norm(a @ x - b) for x in candidates])
    good = [x for x, miss in zip(candidates, misses, strict=True) if miss < misses.min() + 1e-8]
    return np.asarray(min(good, key=lambda x: float(np.linalg.norm(x))) * scale)
