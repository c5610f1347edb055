"""Thrusters: thrust, torque, lag, losses by hull and flow, and power.

A thruster's state is its rotational speed n in revolutions per second, signed: positive pushes the
vehicle along the thruster's direction. One law holds for all of them, in all four quadrants:

    T_0 = rho D^4 k_t n |n| - rho D^3 a |n| u_a     open water: k_t falls by a per advance ratio J
    T   = (1 - t) T_0 exp(-C (u / u_j)^2)           with u_j = sqrt(|T_0| / (rho A))
    Q   = rho D^5 k_q n |n| - rho D^4 b |n| u_a     and k_q by b

The first and the third are the paper's with the fall of k_t = k_t0 - a J put in, which gives the
bilinear form of T. I. Fossen, Handbook of Marine Craft Hydrodynamics and Motion Control, 2011;
u_a = (1 - w) times the speed of the water along the thruster's axis where it sits
(going astern or turning included). The second holds the paper's thrust deduction t and its
deflection of tunnel jets by the surge u (A. R. Palmer, PhD thesis, University of Southampton,
2009; the paper prints sqrt(T_0 / (rho A)), which has no root astern). The moment of the deflected
jet, whose arm no source gives, is left out. A propeller at rest makes neither thrust nor torque:
its drag is the hull's.

A jet that leaves the hull also drags on it,

    X = -1/2 rho V^(2/3) C_d(|u| / u_j) u |u|

(paper, by Tanakitkorn et al., Mechatronics 41, 2017). C_d is a sum of two falling exponentials as
in the simulator of that group's vehicle Delphin2 (see `Thruster.jet_drag`). It goes to nothing,
with all its slopes, as the thruster stops (u_j -> 0): "while the thruster runs" needs no switch.
"""

import math
from collections.abc import Sequence
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import ConfigDict, Field, NonNegativeFloat, PositiveFloat
from pydantic.dataclasses import dataclass

from alice_survey.core.compiled import kernel
from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array

FILE_PART = ConfigDict(extra="forbid", allow_inf_nan=False)
"""Of the parts of a vehicle file."""
_Drag = NonNegativeFloat


@dataclass(frozen=True, kw_only=True, config=FILE_PART)
class Thruster:
    """One thruster and its mounting on the hull.

    Raises:
        ValidationError: a number is not physical.
        VehicleError: numbers do not go together.
    """

    name: str
    kind: Literal["open", "tunnel"]
    position_body_m: tuple[float, float, float]
    direction_body: tuple[float, float, float]
    """Unit vector along which positive thrust pushes the vehicle."""
    diameter_m: PositiveFloat
    kt_forward: PositiveFloat
    """k_t at rest in the water, at positive speed; the three below in the same way."""
    kt_reverse: PositiveFloat
    kq_forward: NonNegativeFloat
    kq_reverse: NonNegativeFloat
    handedness: Literal[-1, 1]
    """+1: at positive speed the propeller turns by the right hand about `direction_body`; its
    reaction on the body is then about minus that axis."""
    most_rps: PositiveFloat
    dead_band_rps: NonNegativeFloat
    """Below this commanded speed the propeller stands still."""
    time_constant_s: PositiveFloat
    advance_slope: NonNegativeFloat = 0.0
    """Loss of k_t per advance ratio J = u_a / (n D)."""
    torque_slope: NonNegativeFloat = 0.0
    """Loss of k_q per advance ratio."""
    wake_fraction: Annotated[float, Field(gt=-1, lt=1)] = 0.0
    """u_a = (1 - w) u; propellers behind the hull (paper, w_T)."""
    thrust_deduction: Annotated[float, Field(gt=-1, lt=1)] = 0.0
    """Share of the thrust that suction on the hull takes away (paper, t)."""
    jet_loss: NonNegativeFloat = 0.0
    """C of the tunnel's jet deflection, T = T_0 exp(-C (u / u_j)^2)."""
    jet_drag: tuple[_Drag, _Drag, _Drag, _Drag] = (0.0, 0.0, 0.0, 0.0)
    """(a, b, c, d) of the jet's drag by displaced volume to the power 2/3,
    C_d = a exp(-b |u| / u_j) + c exp(-d |u| / u_j)."""
    efficiency: Annotated[float, Field(gt=0, le=1)] = 0.7
    """Shaft power over electrical power, of motor and driver."""
    idle_w: NonNegativeFloat = 0.0
    """Electrical power of its driver at rest."""

    def __post_init__(self) -> None:
        if not self.dead_band_rps < self.most_rps:
            raise VehicleError(
                f"dead_band_rps {self.dead_band_rps} of thruster {self.name!r} is not below its "
                f"most_rps {self.most_rps}"
            )
        length = math.hypot(*self.direction_body)
        if not abs(length - 1.0) < 1e-6:
            raise VehicleError(
                f"the direction {self.direction_body} of thruster {self.name!r} has length "
                f"{length:.6g}: give a unit vector"
            )
        if self.kind == "open" and (self.jet_loss or any(self.jet_drag)):
            raise VehicleError(
                f"thruster {self.name!r} is open but has jet_loss or jet_drag: they are of tunnels"
            )
        for way, kt, kq in (
            ("forward", self.kt_forward, self.kq_forward),
            ("reverse", self.kt_reverse, self.kq_reverse),
        ):
            minimum = _min_torque(kt)
            if 0 < kq < minimum:
                raise VehicleError(
                    f"k_q {kq:g} of thruster {self.name!r} {way} is less than {minimum:.4g}: with "
                    f"k_t {kt:g} it would take less power than the jet carries away"
                )


def _min_torque(kt: float) -> float:
    """The least k_q that momentum theory allows at k_t in water at rest.

    The jet of a thruster in a duct or tunnel leaves at the full area and carries
    T^1.5 / (2 sqrt(rho A)); an open propeller's contracts and carries sqrt(2) times that (Carlton,
    Marine Propellers and Propulsion, chapter 8). The lower bound holds for both.
    """
    return float(kt**1.5) / (2.0 * math.pi * math.sqrt(math.pi))


# Columns of `Propulsion.table`.
AXIS, ARM = 0, 3
"""Three columns each: direction, and moment about the body's origin, per newton of thrust."""
FORWARD, REVERSE, ADVANCE = 6, 7, 8
"""rho D^4 k_t, N per (rev/s)^2, both ways; (1 - w) rho D^3 a, N per (rev/s)(m/s)."""
KEPT = 9
"""1 - t."""
TORQUE_FORWARD, TORQUE_REVERSE, TORQUE_ADVANCE = 10, 11, 12
"""As FORWARD to ADVANCE, N m."""
HAND = 13
JET_LOSS = 14
"""C rho A, N per (m/s)^2; 0 of a thruster without a jet."""
JET_AREA = 15
"""rho A, kg/m."""
DRAG = 16
"""Four columns: 1/2 rho V^(2/3) times a, then b; and times c, then d."""
MAX_RPS, DEAD_BAND, RATE = 20, 21, 22
"""rev/s, rev/s, 1/s."""
WATTS, IDLE = 23, 24
"""Electrical watts per watt on the shaft; W."""
DISTRUST = 25
"""(m/s)^-2: see `allocation.preference_weights`."""
COLUMNS = 26

_STILL_RPS = 1e-9
"""A propeller slower than this stands; its lag would lead it through the smallest numbers."""
_REFERENCE_SHARE = 0.03
"""Share of the bollard thrust: the jet against which surge is measured in DISTRUST. ALICE's
laterals give 1.5 N of 49 N each to hold it against 0.1 m/s across (Y_vv 322, 3.2 N)."""


class Propulsion(NamedTuple):
    """Thrusters for compiled code.

    One array, since each costs a kernel 56 bytes.
    """

    table: Array
    """(n, COLUMNS), a row a thruster; the constants above name its columns."""


def turned_speeds(
    time_s: Array, command_rps: Array, thruster: Thruster, start_rps: float = 0.0
) -> Array:
    """Speeds, (T,) rev/s, of a sound thruster that follows commands by its lag.

    Args:
        time_s: (T,) increasing.
        command_rps: (T,) each holds until the next.
        thruster: whose limits, dead band and time constant.
        start_rps: speed at the first time.
    """
    target = np.clip(command_rps, -thruster.most_rps, thruster.most_rps)
    target = np.where(np.abs(target) < thruster.dead_band_rps, 0.0, target)
    kept = np.exp(-np.diff(time_s) / thruster.time_constant_s).tolist()
    speeds, speed = [start_rps], start_rps
    for asked, share in zip(target[:-1].tolist(), kept, strict=True):
        speed = asked + (speed - asked) * share
        speeds.append(speed)
    return np.array(speeds)


def pack(thrusters: Sequence[Thruster], density: float, displaced_kg: float) -> Propulsion:
    """Thrusters for compiled code, in water of a density, kg/m^3, on a hull of a displacement."""
    volume = (displaced_kg / density) ** (2.0 / 3.0)
    table = np.zeros((len(thrusters), COLUMNS))
    for row, t in zip(table, thrusters, strict=True):
        d, area = t.diameter_m, density * math.pi * t.diameter_m**2 / 4
        inflow = 1.0 - t.wake_fraction
        row[AXIS:ARM] = t.direction_body
        row[ARM:FORWARD] = np.cross(t.position_body_m, t.direction_body)
        row[[FORWARD, REVERSE]] = density * d**4 * np.array([t.kt_forward, t.kt_reverse])
        row[ADVANCE] = inflow * density * d**3 * t.advance_slope
        row[KEPT] = 1.0 - t.thrust_deduction
        row[[TORQUE_FORWARD, TORQUE_REVERSE]] = (
            density * d**5 * np.array([t.kq_forward, t.kq_reverse])
        )
        row[TORQUE_ADVANCE] = inflow * density * d**4 * t.torque_slope
        row[HAND] = t.handedness
        row[JET_LOSS], row[JET_AREA] = t.jet_loss * area, area
        row[DRAG : DRAG + 4] = np.array(t.jet_drag) * [
            0.5 * density * volume, 1.0, 0.5 * density * volume, 1.0,
        ]  # fmt: skip
        row[[MAX_RPS, DEAD_BAND, RATE]] = t.most_rps, t.dead_band_rps, 1.0 / t.time_constant_s
        row[WATTS], row[IDLE] = 1.0 / t.efficiency, t.idle_w
        row[DISTRUST] = 2.0 * row[JET_LOSS] / (_REFERENCE_SHARE * row[FORWARD] * t.most_rps**2)
    return Propulsion(table)


def with_health(propulsion: Propulsion, health: Array) -> Propulsion:
    """The same thrusters at reduced greatest speeds.

    Args:
        propulsion: n thrusters.
        health: (n,) share of its greatest speed squared that each still reaches: 1 sound, 0 failed.

    Raises:
        VehicleError: a share is not between 0 and 1.
    """
    if health.shape != propulsion.table.shape[:1] or not np.all((health >= 0) & (health <= 1)):
        raise VehicleError(
            f"health {health} is not a share, 0 to 1, of each of {len(propulsion.table)} thrusters"
        )
    table = propulsion.table.copy()
    table[:, MAX_RPS] *= np.sqrt(health)
    return Propulsion(table)


def without_thrust(propulsion: Propulsion, shares: Array) -> Propulsion:
    """The same thrusters, turning as before, with shares, (n,), of their thrust and torque."""
    table = propulsion.table.copy()
    table[:, [FORWARD, REVERSE, ADVANCE, TORQUE_FORWARD, TORQUE_REVERSE, TORQUE_ADVANCE]] *= shares[
        :, None
    ]
    return Propulsion(table)


@kernel
def _inflow(t: Array, i: int, nu: Array) -> float:
    """Speed of the body through the water along a thruster's axis, where it sits."""
    return float(
        t[i, AXIS] * nu[0]
        + t[i, AXIS + 1] * nu[1]
        + t[i, AXIS + 2] * nu[2]
        + t[i, ARM] * nu[3]
        + t[i, ARM + 1] * nu[4]
        + t[i, ARM + 2] * nu[5]
    )


@kernel
def add_thrust(propulsion: Propulsion, rps: Array, nu: Array, force: Array) -> None:
    """Add the wrench of all thrusters, with jet drag and torque, to a force (6,).

    Args:
        propulsion: n thrusters.
        rps: (n,) speeds.
        nu: (6,) velocity relative to the water.
        force: (6,) is added to.
    """
    t = propulsion.table
    u = nu[0]
    for i in range(t.shape[0]):
        n = rps[i]
        size = abs(n)
        if size < _STILL_RPS:
            continue
        along = _inflow(t, i, nu)
        if n > 0.0:
            thrust, torque = t[i, FORWARD] * n, t[i, TORQUE_FORWARD] * n
        else:
            thrust, torque = t[i, REVERSE] * n, t[i, TORQUE_REVERSE] * n
        thrust = size * (thrust - t[i, ADVANCE] * along)
        torque = -t[i, HAND] * size * (torque - t[i, TORQUE_ADVANCE] * along)
        x, y, z = t[i, AXIS], t[i, AXIS + 1], t[i, AXIS + 2]
        strength = abs(thrust)
        if u != 0.0 and t[i, JET_LOSS] > 0.0 and strength > 0.0:
            thrust *= math.exp(-t[i, JET_LOSS] * u * u / strength)
        thrust *= t[i, KEPT]
        if u != 0.0 and t[i, DRAG] + t[i, DRAG + 2] > 0.0 and strength > 0.0:
            ratio = abs(u) * math.sqrt(t[i, JET_AREA] / strength)
            force[0] -= (
                t[i, DRAG] * math.exp(-t[i, DRAG + 1] * ratio)
                + t[i, DRAG + 2] * math.exp(-t[i, DRAG + 3] * ratio)
            ) * (u * abs(u))
        force[0] += thrust * x
        force[1] += thrust * y
        force[2] += thrust * z
        force[3] += thrust * t[i, ARM] + torque * x
        force[4] += thrust * t[i, ARM + 1] + torque * y
        force[5] += thrust * t[i, ARM + 2] + torque * z


@kernel
def add_speed_rates(propulsion: Propulsion, rps: Array, command_rps: Array, out: Array) -> None:
    """Write the rate of change, (n,), of thruster speeds: a first-order lag to the command."""
    t = propulsion.table
    for i in range(t.shape[0]):
        asked = command_rps[i]
        if abs(asked) < t[i, DEAD_BAND]:
            asked = 0.0
        maximum = t[i, MAX_RPS]
        out[i] = (min(max(asked, -maximum), maximum) - rps[i]) * t[i, RATE]


@kernel
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
    t = propulsion.table
    for i in range(t.shape[0]):
        maximum = t[i, MAX_RPS] * math.sqrt(health[i])
        for ahead in range(2):  # the law of `add_thrust`
            n = maximum if ahead else -maximum
            gain = t[i, FORWARD] if n > 0.0 else t[i, REVERSE]
            thrust = abs(n) * (gain * n - t[i, ADVANCE] * _inflow(t, i, nu))
            if thrust != 0.0:
                thrust *= math.exp(-t[i, JET_LOSS] * nu[0] * nu[0] / abs(thrust))
            if ahead:
                upper[i] = max(t[i, KEPT] * thrust, 0.0)
            else:
                lower[i] = min(t[i, KEPT] * thrust, 0.0)


@kernel
def speeds_for(propulsion: Propulsion, thrust: Array, nu: Array, command_rps: Array) -> None:
    """Write the speeds, (n,) rev/s, that give thrusts (n,) N at a velocity: `add_thrust` undone.

    The propeller turns the way it must push, and stands still where no thrust is requested. With
    T = T_0 exp(-k / |T_0|) the thrust before the jet's loss is T_0 = T exp(W(k / |T|)), W Lambert's
    function, and the speed is the positive root of a quadratic.
    """
    t = propulsion.table
    for i in range(t.shape[0]):
        size = abs(thrust[i]) / t[i, KEPT]
        if size < 1e-12:
            command_rps[i] = 0.0
            continue
        loss = t[i, JET_LOSS] * nu[0] * nu[0]
        if loss > 0.0:
            # W is the root y >= 0 of y exp(y) = z. The first guess is within 2 % (R. Iacono and J.
            # P. Boyd, Adv. Comput. Math. 43, 2017); their iteration converges quadratically.
            root = z = loss / size
            if z >= 1e-8:
                root = math.log1p(z)
                root *= 1.0 - math.log1p(root) / (2.0 + root)
                for _ in range(4):
                    root *= (1.0 + math.log(z / root)) / (1.0 + root)
            size *= math.exp(root)
        ahead = thrust[i] > 0.0
        gain = t[i, FORWARD] if ahead else t[i, REVERSE]
        slope = t[i, ADVANCE] * _inflow(t, i, nu)
        half = 0.5 * (slope if ahead else -slope)
        root = math.sqrt(half * half + gain * size)
        # The form without a difference of like numbers.
        speed = (half + root) / gain if half > 0.0 else size / (root - half)
        command_rps[i] = speed if ahead else -speed


@kernel
def electrical_power(propulsion: Propulsion, rps: Array, nu: Array, out: Array) -> None:
    """Write the electrical power, (n,) W, of each thruster.

    A propeller that the water drives recovers no power.

    Args:
        propulsion: n thrusters.
        rps: (n,) speeds.
        nu: (6,) velocity relative to the water.
        out: (n,) is written.
    """
    t = propulsion.table
    for i in range(t.shape[0]):
        n = rps[i]
        gain = t[i, TORQUE_FORWARD] if n > 0.0 else t[i, TORQUE_REVERSE]
        torque = abs(n) * (gain * n - t[i, TORQUE_ADVANCE] * _inflow(t, i, nu))
        out[i] = t[i, IDLE] + t[i, WATTS] * max(2.0 * math.pi * n * torque, 0.0)
