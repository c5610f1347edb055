"""Thrusters: thrust, torque, lag, what the hull and the flow take from them, and their power.

A thruster's state is its rotational speed in revolutions per second, signed: positive pushes the
vehicle along the thruster's direction. Open-water thrust and torque are those of the paper,
T = rho D^4 k_t n |n| and Q = rho D^5 k_q n |n|.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numba import njit

from alice_survey.frames import Array


@dataclass(frozen=True, kw_only=True)
class Thruster:
    """One thruster and how it sits on the hull."""

    name: str
    kind: Literal["open", "tunnel"]
    position_body_m: tuple[float, float, float]
    direction_body: tuple[float, float, float]
    """Unit vector along which positive thrust pushes the vehicle."""
    diameter_m: float
    kt_forward: float
    kt_reverse: float
    kq_forward: float
    kq_reverse: float
    handedness: Literal[-1, 1]
    """+1: at positive speed the propeller turns by the right hand about `direction_body`; its
    reaction on the body is then about minus that axis."""
    most_rps: float
    dead_band_rps: float
    """Below this commanded speed the propeller stands still."""
    time_constant_s: float
    advance_slope: float = 0.0
    """Loss of k_t per advance ratio J = u_a / (n D); open thrusters."""
    wake_fraction: float = 0.0
    """u_a = (1 - w) u; open thrusters behind the hull (paper, w_T)."""
    thrust_deduction: float = 0.0
    """Share of the thrust that suction on the hull takes away (paper, t)."""
    jet_loss: float = 0.0
    """C of the tunnel's jet deflection, T = T_0 exp(-C (u / u_j)^2)."""
    jet_drag: float = 0.0
    """C_d of the tunnel's jet by displaced volume to the power 2/3, while the thruster runs."""
    efficiency: float = 0.7
    """Shaft power over electrical power."""
    idle_w: float = 0.0
    """Electrical power of its driver at rest."""


class Propulsion(NamedTuple):
    """Thrusters as compiled code sees them: one entry or row a thruster."""

    position: Array
    direction: Array
    tunnel: Array
    """1 of a tunnel thruster, else 0."""
    thrust_forward: Array
    """N per (rev/s)^2."""
    thrust_reverse: Array
    torque_forward: Array
    """N m per (rev/s)^2."""
    torque_reverse: Array
    handedness: Array
    most_rps: Array
    dead_band_rps: Array
    time_constant_s: Array
    advance_slope: Array
    """N per (rev/s)(m/s): rho D^3 times the loss of k_t per J."""
    wake: Array
    deduction: Array
    jet_area: Array
    """rho A of the tunnel, kg/m."""
    jet_loss: Array
    jet_drag: Array
    """N per (m/s)^2."""
    efficiency: Array
    idle_w: Array


def pack(thrusters: Sequence[Thruster], density: float, displaced_kg: float) -> Propulsion:
    """Thrusters for compiled code, in water of a density, kg/m^3, on a hull of a displacement."""

    def column(value: Sequence[object]) -> Array:
        return np.array(value, dtype=np.float64)

    volume = (displaced_kg / density) ** (2.0 / 3.0)
    return Propulsion(
        position=column([t.position_body_m for t in thrusters]).reshape(-1, 3),
        direction=column([t.direction_body for t in thrusters]).reshape(-1, 3),
        tunnel=column([float(t.kind == "tunnel") for t in thrusters]),
        thrust_forward=column([density * t.diameter_m**4 * t.kt_forward for t in thrusters]),
        thrust_reverse=column([density * t.diameter_m**4 * t.kt_reverse for t in thrusters]),
        torque_forward=column([density * t.diameter_m**5 * t.kq_forward for t in thrusters]),
        torque_reverse=column([density * t.diameter_m**5 * t.kq_reverse for t in thrusters]),
        handedness=column([t.handedness for t in thrusters]),
        most_rps=column([t.most_rps for t in thrusters]),
        dead_band_rps=column([t.dead_band_rps for t in thrusters]),
        time_constant_s=column([t.time_constant_s for t in thrusters]),
        advance_slope=column([density * t.diameter_m**3 * t.advance_slope for t in thrusters]),
        wake=column([t.wake_fraction for t in thrusters]),
        deduction=column([t.thrust_deduction for t in thrusters]),
        jet_area=column([density * math.pi * t.diameter_m**2 / 4 for t in thrusters]),
        jet_loss=column([t.jet_loss for t in thrusters]),
        jet_drag=column([0.5 * density * volume * t.jet_drag for t in thrusters]),
        efficiency=column([t.efficiency for t in thrusters]),
        idle_w=column([t.idle_w for t in thrusters]),
    )


@njit(cache=True)  # type: ignore[untyped-decorator]
def add_thrust(propulsion: Propulsion, rps: Array, nu: Array, force: Array) -> None:
    """Add the wrench of all thrusters, with jet drag and torque, to a force (6,).

    Args:
        propulsion: n thrusters.
        rps: (n,) speeds.
        nu: (6,) velocity relative to the water.
        force: (6,) is added to.
    """
    for i in range(rps.shape[0]):
        n = rps[i]
        thrust = (
            (propulsion.thrust_forward[i] if n > 0 else propulsion.thrust_reverse[i]) * n * abs(n)
        )
        d, p = propulsion.direction[i], propulsion.position[i]
        fx, fy, fz = thrust * d[0], thrust * d[1], thrust * d[2]
        force[0] += fx
        force[1] += fy
        force[2] += fz
        force[3] += p[1] * fz - p[2] * fy
        force[4] += p[2] * fx - p[0] * fz
        force[5] += p[0] * fy - p[1] * fx


@njit(cache=True)  # type: ignore[untyped-decorator]
def add_speed_rates(propulsion: Propulsion, rps: Array, command_rps: Array, out: Array) -> None:
    """Write the rate of change, (n,), of thruster speeds: a first-order lag to what is asked."""
    for i in range(rps.shape[0]):
        asked = command_rps[i]
        if abs(asked) < propulsion.dead_band_rps[i]:
            asked = 0.0
        most = propulsion.most_rps[i]
        asked = min(max(asked, -most), most)
        out[i] = (asked - rps[i]) / propulsion.time_constant_s[i]


@njit(cache=True)  # type: ignore[untyped-decorator]
def thrust_limits(
    propulsion: Propulsion, health: Array, nu: Array, lower: Array, upper: Array
) -> None:
    """Write the least and greatest thrust, (n,) N, that each thruster gives at a velocity.

    Args:
        propulsion: n thrusters.
        health: (n,) share of its greatest speed squared that each still reaches: 1 sound, 0 failed.
        nu: (6,) velocity relative to the water as far as it is known.
        lower: (n,) is written, not positive.
        upper: (n,) is written, not negative.
    """
    for i in range(lower.shape[0]):
        square = health[i] * propulsion.most_rps[i] ** 2
        lower[i], upper[i] = (
            -propulsion.thrust_reverse[i] * square,
            propulsion.thrust_forward[i] * square,
        )


@njit(cache=True)  # type: ignore[untyped-decorator]
def speeds_for(propulsion: Propulsion, thrust: Array, nu: Array, command_rps: Array) -> None:
    """Write the speeds, (n,) rev/s, that give thrusts (n,) N at a velocity: `add_thrust` undone."""
    for i in range(thrust.shape[0]):
        gain = propulsion.thrust_forward[i] if thrust[i] > 0 else propulsion.thrust_reverse[i]
        command_rps[i] = math.copysign(math.sqrt(abs(thrust[i]) / gain), thrust[i])


@njit(cache=True)  # type: ignore[untyped-decorator]
def electrical_power(propulsion: Propulsion, rps: Array, out: Array) -> None:
    """Write the electrical power, (n,) W, of each thruster at speeds (n,)."""
    for i in range(rps.shape[0]):
        n = abs(rps[i])
        torque = propulsion.torque_forward[i] if rps[i] > 0 else propulsion.torque_reverse[i]
        shaft = 2.0 * math.pi * torque * n * n * n
        out[i] = propulsion.idle_w[i] + shaft / propulsion.efficiency[i]
