"""Slow twins of the hydrodynamics: integrals over infinity, conformal maps, brute force."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import quad

Array = NDArray[np.float64]


def lamb_constants(length_m: float, diameter_m: float) -> tuple[float, float]:
    """alpha_0 along the axis and beta_0 across, of a prolate spheroid, by Lamb's own integrals."""
    a, b = length_m / 2.0, diameter_m / 2.0

    def along(s: float) -> float:
        return 1.0 / ((a * a + s) ** 1.5 * (b * b + s))

    def across(s: float) -> float:
        return 1.0 / ((a * a + s) ** 0.5 * (b * b + s) ** 2)

    pieces = [(0.0, b * b), (b * b, a * a + b * b), (a * a + b * b, math.inf)]

    def whole(f: Callable[[float], float]) -> float:
        return a * b * b * sum(quad(f, *piece, epsabs=0, epsrel=1e-11)[0] for piece in pieces)

    return whole(along), whole(across)


def finned_circle(radius: float, span: float, density: float) -> tuple[float, float]:
    """Added mass across the fins and added inertia in roll of a circle with two fins, per metre.

    The section's outside is mapped to that of a circle. There a stream function that equals
    sum a_n cos(n t) on the edge has the kinetic energy rho pi / 2 sum n a_n^2.
    """
    count = 1 << 16
    angle = (np.arange(count) + 0.5) * 2.0 * np.pi / count
    reach = span + radius**2 / span  # of the flat plate that Joukowski's map makes of the section
    plate = reach * np.cos(angle)
    on_fin = np.abs(plate) > 2.0 * radius
    fin = (np.abs(plate) + np.sqrt(np.maximum(plate**2 - 4.0 * radius**2, 0.0))) / 2.0
    across = np.where(on_fin, np.sign(plate) * fin, plate / 2.0)
    squared = np.where(on_fin, fin**2, radius**2)

    def energy(edge: Array) -> float:
        amplitude = np.abs(np.fft.rfft(edge)) * 2.0 / count
        return float(density * np.pi * np.sum(np.arange(len(amplitude)) * amplitude**2))

    return energy(across), energy(squared / 2.0)


def wrench(point: Array, force: Array) -> Array:
    """Force and moment about the origin."""
    x, y, z = point
    fx, fy, fz = force
    return np.array([fx, fy, fz, y * fz - z * fy, z * fx - x * fz, x * fy - y * fx])


def velocity(point: Array, nu: Array) -> Array:
    """Of a point of a body that moves with nu."""
    x, y, z = point
    u, v, w, p, q, r = nu
    return np.array([u + q * z - r * y, v + r * x - p * z, w + p * y - q * x])


def reaction(points: Array, direction: Array, amounts: Array, nu: Array, power: int) -> Array:
    """Wrench, (6,), of the water on elements that resist motion along a direction.

    Args:
        points: (N, 3)
        direction: (3,)
        amounts: (N,) mass (power 1, nu an acceleration) or drag (power 2).
        nu: (6,)
        power: 1 or 2.
    """
    total = np.zeros(6)
    for point, amount in zip(points, amounts, strict=True):
        speed = float(velocity(point, nu) @ direction)
        total += wrench(point, -amount * speed * abs(speed) ** (power - 1) * direction)
    return total
