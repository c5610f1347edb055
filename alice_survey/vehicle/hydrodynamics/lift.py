"""Body lift of a slender hull at a small angle (Hoerner and Borst 1975; paper, section V.C)."""

import math
from typing import NamedTuple


class BodyLift(NamedTuple):
    """Coefficients of force and moment by u v and u w, kg/m and kg."""

    y_uv: float
    z_uw: float
    m_uw: float
    n_uv: float


def lift_slope(length_m: float, diameter_m: float) -> float:
    """C_L by angle, 1/rad, on d^2: 0.003 (180 / pi) l / d."""
    return 0.003 * (180.0 / math.pi) * length_m / diameter_m


def centre_of_pressure(nose_x_m: float, length_m: float) -> float:
    """x_cp = x_n - 0.65 l, metres."""
    return nose_x_m - 0.65 * length_m


def body_lift(length_m: float, diameter_m: float, nose_x_m: float, density: float) -> BodyLift:
    """Lift of the hull.

    Y_uv = Z_uw = -1/2 rho d^2 C_L. A force at x gives M = -x Z and N = x Y, so that
    M_uw = -x_cp Z_uw. As printed: M_uw = Z_uw x_cp; the tables have the right sign.
    """
    force = -0.5 * density * diameter_m**2 * lift_slope(length_m, diameter_m)
    x = centre_of_pressure(nose_x_m, length_m)
    return BodyLift(force, force, -x * force, x * force)
