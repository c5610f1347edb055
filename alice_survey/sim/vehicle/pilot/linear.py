"""Motion linearised about steady flight: slopes of forces, coupled pairs of motions, damping."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.dynamics import Body, coriolis_matrix
from alice_survey.sim.vehicle.fins import Fins, fin_slope, pack_fins

LATERAL, VERTICAL = (1, 5), (2, 4)
"""Degrees of freedom that a turn couples: sway and yaw, heave and pitch."""
NO_FINS = pack_fins((), 0.0)
_AT_REST_PER_S = 1e-9
"""Poles nearer to 0 do not move."""


def coupled_pair(
    body: Body, speed_mps: float, fins: Fins = NO_FINS, plane: tuple[int, int] = LATERAL
) -> tuple[Array, Array]:
    """Sway and yaw rate under way: (v, r)' = A (v, r) + b moment; or heave and pitch rate.

    Args:
        body: body of the vehicle.
        speed_mps: surge; without drift or turning.
        fins: of the vehicle, not turned.
        plane: `LATERAL` or `VERTICAL`.

    Returns:
        (2, 2) and (2,)
    """
    nu = np.array([speed_mps, 0.0, 0.0, 0.0, 0.0, 0.0])
    both = np.ix_(plane, plane)
    inverse = np.linalg.inv(body.mass[both])
    slope = linear_damping(body, nu) + linear_coriolis(body, nu)
    if len(fins.surfaces):
        slope = slope + fin_slope(fins, nu)
    pair: Array = -inverse @ slope[both]
    return pair, np.array(inverse[:, 1], np.float64)


def damping_ratio(loop: Array) -> float:
    """Least damping ratio of a state matrix's modes; negative if one grows."""
    return float(mode_damping(np.linalg.eigvals(loop)).min())


def mode_damping(poles: NDArray[Any]) -> Array:
    """Damping ratio of each pole; 1 of one at rest: a sway that no water damps is its own loop's.

    Args:
        poles: complex.
    """
    size = np.abs(poles)
    return np.where(size > _AT_REST_PER_S, -poles.real / np.maximum(size, _AT_REST_PER_S), 1.0)


def linear_damping(body: Body, nu: Array) -> Array:
    """(6, 6) slope of damping and body lift by velocity at a velocity (6,)."""
    quadratic = np.where(np.asarray(nu) > 0.0, body.quadratic, body.quadratic_back)
    slope = -(body.linear + 2.0 * quadratic * np.abs(nu))
    u, v, w = nu[0], nu[1], nu[2]
    y_uv, z_uw, m_uw, n_uv = body.lift
    slope[1, [0, 1]] -= y_uv * np.sign(u) * v, y_uv * abs(u)
    slope[2, [0, 2]] -= z_uw * np.sign(u) * w, z_uw * abs(u)
    slope[4, [0, 2]] -= m_uw * w, m_uw * u
    slope[5, [0, 1]] -= n_uv * v, n_uv * u
    result: Array = slope
    return result


def linear_coriolis(body: Body, nu: Array) -> Array:
    """(6, 6) slope of C(nu) nu by velocity at a velocity (6,).

    C(a) b is bilinear, so that the slope's column j is C(e_j) nu + C(nu) e_j.
    """
    slope = coriolis_matrix(body.mass, nu)
    columns = [coriolis_matrix(body.mass, unit) @ nu for unit in np.eye(6)]
    result: Array = slope + np.array(columns).T
    return result
