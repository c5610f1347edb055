"""The inner loops: from wanted velocities and accelerations to a wrench.

Feedback commands an acceleration; inertia, Coriolis forces and drag convert it to forces (computed
torque: T. I. Fossen, Handbook of Marine Craft Hydrodynamics and Motion Control, 2011), at the
wanted motion over ground. The current is not known, so that what it adds to drag is left to the
integrals.
"""

from alice_survey.base.frames import Array
from alice_survey.vehicle.compiled import kernel
from alice_survey.vehicle.dynamics import add_coriolis, add_damping
from alice_survey.vehicle.pilot.gains import (
    INNER,
    INTEGRAL,
    LEAST,
    MASS,
    MOST,
    PLACE,
    RATE,
    WEIGHT,
    Gains,
)
from alice_survey.vehicle.pilot.memory import ACC_SURGE, FULL_SURGE, REF_SURGE, PilotState


@kernel
def clamped(value: float, most: float) -> float:
    """The value within -most and most."""
    return min(max(value, -most), most)


@kernel
def place_demand(
    gains: Gains, axis: int, error: float, speed: float, feed: float, total: float, most: float
) -> tuple[float, float]:
    """A PID on place that commands a speed, and a proportional loop on that speed.

    v_req = feed + k_P e + k_I integral(e) + k_D de/dt, a = inner (v_req - v), with de/dt = feed -
    v (paper, eq. los_sway_control, of the error of the vehicle and with de/dt for its dv/dt).

    Args:
        gains: gains of all axes.
        axis: row of gains.
        error: wanted place less place.
        speed: measured.
        feed: speed of the wanted place.
        total: k_I times the integral of the error, a speed.
        most: bound of the proportional part, a speed.

    Returns:
        The speed that drag is to be expected at, and the acceleration.
    """
    row = gains.axes[axis]
    inner = row[INNER]
    steady = feed + clamped(row[PLACE] / inner * error, most)
    derivative = (row[RATE] / inner - 1.0) * (feed - speed)
    return steady, inner * (steady + total + derivative - speed)


@kernel
def place_sum_step(gains: Gains, axis: int, error: float, full: float, dt_s: float) -> float:
    """Increment of k_I times the integral of a place error in a tick; 0 while the force is cut.

    Args:
        gains: gains of all axes.
        axis: row of gains.
        error: wanted place less place.
        full: +1 or -1 where the force is cut at its greatest or least, else 0.
        dt_s: the tick.
    """
    if full * error > 0.0:
        return 0.0
    return float(gains.axes[axis, INTEGRAL] / gains.axes[axis, INNER] * error * dt_s)


@kernel
def sum_bound(gains: Gains, axis: int) -> float:
    """Integral, as a speed, beyond which it alone would exceed the available force."""
    row = gains.axes[axis]
    if row[INNER] == 0.0:
        return 0.0
    return float(max(-row[LEAST], row[MOST]) / (row[MASS] * row[INNER]))


@kernel
def speed_demand(
    gains: Gains, axis: int, wanted: float, speed: float, full: float, total: float, dt_s: float
) -> tuple[float, float]:
    """A PI on speed whose proportional part sees a share of the wanted speed (gains.py).

    Args:
        gains: gains of all axes.
        axis: row of gains.
        wanted: speed.
        speed: measured.
        full: +1 or -1 where the force is cut at its greatest or least, else 0.
        total: the integral part, as a speed.
        dt_s: the tick.

    Returns:
        The acceleration, and the new integral.
    """
    row, error = gains.axes[axis], wanted - speed
    if full * error <= 0.0:
        step = row[PLACE] / row[RATE] * error * dt_s
        total = clamped(total + step, sum_bound(gains, axis))
    return row[RATE] * (row[WEIGHT] * wanted - speed + total), total


@kernel
def write_wrench(gains: Gains, pilot: PilotState, wrench: Array) -> None:
    """Turn the demand into a wrench, and note where it is cut.

    Args:
        gains: the vehicle.
        pilot: its demand is read, and the notes are written into it.
        wrench: (6,) N and N m is written. Roll and pitch are not controlled.
    """
    body, demand, motion, force = gains.body, pilot.demand, pilot.motion, pilot.force
    for i in range(6):
        motion[i] = force[i] = wrench[i] = 0.0
    for axis in range(4):
        motion[axis if axis < 3 else 5] = demand[REF_SURGE + axis]
    add_damping(body, motion, force)
    add_coriolis(body, motion, force)
    for axis in range(4):
        i = axis if axis < 3 else 5
        asked = -force[i]
        for other in range(4):
            asked += body.mass[i, other if other < 3 else 5] * demand[ACC_SURGE + other]
        if i == 2:
            asked -= body.weight_n - body.buoyancy_n
        least, most = gains.axes[axis, LEAST], gains.axes[axis, MOST]
        demand[FULL_SURGE + axis] = 1.0 if asked > most else (-1.0 if asked < least else 0.0)
        wrench[i] = min(max(asked, least), most)
