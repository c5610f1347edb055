"""Steering modes: to a depth, to a heading, along a path, to a place and stay there.

Each commands velocities and accelerations of the inner loops (`PilotState.demand`). Parts that go
together are called in the order heave, yaw, surge, sway: surge and sway of the followed point
depend on the commanded yaw.

The inner loops lead from wanted velocities and accelerations to a wrench.

Feedback commands an acceleration; inertia, Coriolis forces and drag convert it to forces (computed
torque: T. I. Fossen, Handbook of Marine Craft Hydrodynamics and Motion Control, 2011), at the
wanted motion over ground. The current is not known, so that what it adds to drag is left to the
integrals.
"""

import math

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.compiled import kernel
from alice_survey.sim.vehicle.dynamics import add_coriolis, add_damping
from alice_survey.sim.vehicle.fins import add_fins
from alice_survey.sim.vehicle.pilot import memory as slot
from alice_survey.sim.vehicle.pilot.diving import fly_to_depth
from alice_survey.sim.vehicle.pilot.gains import (
    FASTEST,
    HEAVE,
    INNER,
    INTEGRAL,
    KEPT_RAD,
    LEAST,
    MASS,
    MOST,
    PITCH,
    PLACE,
    RATE,
    ROLL,
    STEERED,
    SURGE,
    SWAY,
    WEIGHT,
    YAW,
    Gains,
)
from alice_survey.sim.vehicle.pilot.memory import PilotState
from alice_survey.sim.vehicle.pilot.path import Path
from alice_survey.sim.vehicle.pilot.safety import restart_watch
from alice_survey.sim.vehicle.pilot.settings import Guidance
from alice_survey.sim.vehicle.rotations import wrapped


@kernel
def clamped(value: float, maximum: float) -> float:
    """The value within -most and most."""
    return min(max(value, -maximum), maximum)


@kernel
def place_demand(
    gains: Gains, axis: int, error: float, speed: float, feed: float, total: float, maximum: float
) -> tuple[float, float]:
    """A PID on place that commands a speed, and a proportional loop on that speed.

    v_req = feed + k_P e + k_I integral(e) + k_D de/dt, a = inner (v_req - v), with de/dt = feed -
    v (paper, eq. los_sway_control, of the error of the vehicle and with de/dt for its dv/dt).

    Args:
        gains: gains of all axes.
        axis: row of gains.
        error: wanted place minus place.
        speed: measured.
        feed: speed of the wanted place.
        total: k_I times the integral of the error, a speed.
        maximum: bound of the proportional part, a speed.

    Returns:
        The speed that drag is to be expected at, and the acceleration.
    """
    row = gains.axes[axis]
    inner = row[INNER]
    steady = feed + clamped(row[PLACE] / inner * error, maximum)
    derivative = (row[RATE] / inner - 1.0) * (feed - speed)
    return steady, inner * (steady + total + derivative - speed)


@kernel
def place_sum_step(gains: Gains, axis: int, error: float, full: float, dt_s: float) -> float:
    """Increment of k_I times the integral of a place error in a tick; 0 while the force is cut.

    Args:
        gains: gains of all axes.
        axis: row of gains.
        error: wanted place minus place.
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
        wrench: (6,) N and N m is written; of roll and pitch see `hold_level`.
    """
    body, demand, motion, force = gains.body, pilot.demand, pilot.motion, pilot.force
    for i in range(6):
        motion[i] = force[i] = wrench[i] = 0.0
    for axis in range(4):
        motion[axis if axis < 3 else 5] = demand[slot.REF_SURGE + axis]
    add_damping(body, motion, force)
    add_coriolis(body, motion, force)
    add_fins(gains.fins, gains.straight, motion, force)
    for axis in range(4):
        i = axis if axis < 3 else 5
        asked = -force[i]
        for other in range(4):
            asked += body.mass[i, other if other < 3 else 5] * demand[slot.ACC_SURGE + other]
        if i == 2:
            asked -= body.weight_n - body.buoyancy_n
        minimum, maximum = gains.axes[axis, LEAST], gains.axes[axis, MOST]
        demand[slot.FULL_SURGE + axis] = (
            1.0 if asked > maximum else (-1.0 if asked < minimum else 0.0)
        )
        wrench[i] = min(max(asked, minimum), maximum)


@kernel
def hold_level(
    estimate: Array, dt_s: float, gains: Gains, pilot: PilotState, wrench: Array
) -> None:
    """Add the moments that hold roll level and pitch as wanted, where thrusters or fins can.

    PID and computed torque.

    The computed part is what the wanted motion and the centre of gravity do at level attitude,
    which is why `write_wrench` comes first. What gravity rights by itself comes on top.
    """
    body = gains.body
    for axis in (ROLL, PITCH):
        row = gains.axes[axis]
        if row[MASS] == 0.0:
            continue
        i = 3 if axis == ROLL else 4
        angle = estimate[vector.ROLL] if axis == ROLL else estimate[vector.PITCH]
        rate = estimate[vector.P] if axis == ROLL else estimate[vector.Q]
        if axis == PITCH:
            angle -= pilot.demand[slot.REF_PITCH]
            rate -= pilot.demand[slot.REF_PITCH_RATE]
        place = slot.ROLL_SUM if axis == ROLL else slot.PITCH_SUM
        total = pilot.memory[place]
        asked = -row[MASS] * (row[PLACE] * angle + row[RATE] * rate + total) - pilot.force[i]
        for other in range(STEERED):
            k = other if other < 3 else 5
            asked += body.mass[i, k] * pilot.demand[slot.ACC_SURGE + other]
        asked += body.weight_n * (-body.cg[1] if axis == ROLL else body.cg[0])
        wrench[i] = min(max(asked, row[LEAST]), row[MOST])
        if (asked - wrench[i]) * angle >= 0.0:  # not cut, or on the way back
            step = row[INTEGRAL] * angle * dt_s
            pilot.memory[place] = clamped(total + step, max(-row[LEAST], row[MOST]) / row[MASS])


DEPTH_KEPT_M = 0.2
HEADING_KEPT_RAD = KEPT_RAD
"""Tolerances within which a depth or heading counts as kept."""
_AT_REST = 0.1
"""Below this share of the greatest speed an axis is not on its way. Integrals learn while a depth
or heading is kept, or stays wrong, but no faster than at the edge of being kept; on the way to a
new one they would only wind up."""
_MAX_INNOVATION_M = 1.0
"""A greater step of the sea floor is followed at this rate only: it may be a false echo, and a
ledge is not to be dived from at once."""
_RISE_ON_S = 5.0
"""Without bottom lock the floor is assumed to rise for this long at full speed: about as long as
the vehicle goes on until it is at rest (inferred)."""


@kernel
def write_point(estimate: Array, guidance: Guidance, pilot: PilotState) -> None:
    """Write where the followed point is and how it moves into the pilot's `point`."""
    p, point = guidance.point_body_m, pilot.point
    sr, cr = math.sin(estimate[vector.ROLL]), math.cos(estimate[vector.ROLL])
    sp, cp = math.sin(estimate[vector.PITCH]), math.cos(estimate[vector.PITCH])
    sy, cy = (
        math.sin(estimate[vector.HEADING]),
        math.cos(estimate[vector.HEADING]),
    )
    ahead = cp * p[0] + sp * (sr * p[1] + cr * p[2])
    abeam = cr * p[1] - sr * p[2]
    u, v, w = estimate[vector.U], estimate[vector.V], estimate[vector.W]
    turn = (sr * estimate[vector.Q] + cr * estimate[vector.R]) / cp
    # Roll and pitch rates are left out: nothing here can answer them.
    point[slot.POINT_NORTH] = estimate[vector.NORTH] + cy * ahead - sy * abeam
    point[slot.POINT_EAST] = estimate[vector.EAST] + sy * ahead + cy * abeam
    point[slot.SURGE_SPEED] = cp * u + sp * (sr * v + cr * w) - turn * abeam
    point[slot.SWAY_SPEED] = cr * v - sr * w + turn * ahead
    point[slot.SINK_SPEED] = -sp * u + cp * (sr * v + cr * w)
    point[slot.TURN_SPEED] = turn


@kernel
def hear_floor(estimate: Array, dt_s: float, guidance: Guidance, pilot: PilotState) -> None:
    """Smooth the depth that the origin's depth and the altitude add up to, and its slope.

    A critically damped second-order tracker: it follows a constant slope without lag. Without
    bottom lock a floor that rose goes on rising, ever more slowly as the vehicle comes to a stop;
    the depth of one that fell is held.
    """
    memory, rate = pilot.memory, guidance.floor_rate_rad_s
    heard = estimate[vector.DEPTH] + estimate[vector.ALTITUDE]
    if not math.isfinite(heard):
        memory[slot.FLOOR_SLOPE] = min(memory[slot.FLOOR_SLOPE], 0.0) * (1.0 - dt_s / _RISE_ON_S)
        memory[slot.FLOOR] += dt_s * memory[slot.FLOOR_SLOPE]
        return
    if memory[slot.FLOOR_KNOWN] == 0.0:
        memory[slot.FLOOR_KNOWN], memory[slot.FLOOR] = 1.0, heard
        restart_watch(pilot)
        return
    innovation = clamped(heard - memory[slot.FLOOR], _MAX_INNOVATION_M)
    memory[slot.FLOOR] += dt_s * (memory[slot.FLOOR_SLOPE] + 2.0 * rate * innovation)
    memory[slot.FLOOR_SLOPE] += dt_s * rate * rate * innovation


@kernel
def sink_to(
    depth_m: float,
    feed_mps: float,
    dt_s: float,
    estimate: Array,
    path: Path,
    guidance: Guidance,
    gains: Gains,
    pilot: PilotState,
) -> None:
    """Command the heave, or the pitch, that takes the origin to a depth, which moves at a speed."""
    if guidance.under_way.circle_m > 0.0:
        fly_to_depth(depth_m, feed_mps, path.speed_mps, estimate, dt_s, guidance.under_way, pilot)
        return
    memory, demand = pilot.memory, pilot.demand
    error, maximum = depth_m - estimate[vector.DEPTH], gains.axes[HEAVE, FASTEST]
    demand[slot.REF_HEAVE], demand[slot.ACC_HEAVE] = place_demand(
        gains,
        HEAVE,
        error,
        pilot.point[slot.SINK_SPEED],
        clamped(feed_mps, 0.5 * maximum),
        memory[slot.HEAVE_SUM],
        maximum,
    )
    if abs(error) < DEPTH_KEPT_M or abs(pilot.point[slot.SINK_SPEED]) < _AT_REST * maximum:
        near = clamped(error, DEPTH_KEPT_M)
        step = place_sum_step(gains, HEAVE, near, demand[slot.FULL_HEAVE], dt_s)
        memory[slot.HEAVE_SUM] = clamped(memory[slot.HEAVE_SUM] + step, sum_bound(gains, HEAVE))
    pilot.report[slot.WANTED_DEPTH] = depth_m


@kernel
def head_for(
    heading: float,
    feed: float,
    quicken: float,
    estimate: Array,
    dt_s: float,
    gains: Gains,
    pilot: PilotState,
) -> float:
    """Command the yaw that takes the heading to a wanted one.

    Args:
        heading: wanted.
        feed: its rate.
        quicken: the rate of that.
        estimate: (13,)
        dt_s: the tick.
        gains: gains of the inner loops.
        pilot: is written.

    Returns:
        Wanted minus present heading, within -pi and pi.
    """
    memory, demand = pilot.memory, pilot.demand
    error, maximum = wrapped(heading - estimate[vector.HEADING]), gains.axes[YAW, FASTEST]
    demand[slot.REF_YAW], accelerate = place_demand(
        gains, YAW, error, pilot.point[slot.TURN_SPEED], feed, memory[slot.YAW_SUM], maximum
    )
    demand[slot.ACC_YAW] = accelerate + quicken
    off = abs(pilot.point[slot.TURN_SPEED] - feed)
    if abs(error) < HEADING_KEPT_RAD or off < _AT_REST * maximum:
        near = clamped(error, HEADING_KEPT_RAD)
        step = place_sum_step(gains, YAW, near, demand[slot.FULL_YAW], dt_s)
        memory[slot.YAW_SUM] = clamped(memory[slot.YAW_SUM] + step, sum_bound(gains, YAW))
    pilot.report[slot.WANTED_HEADING] = heading
    return error


@kernel
def surge_at(
    speed: float, dt_s: float, guidance: Guidance, gains: Gains, pilot: PilotState
) -> None:
    """Command a surge of the followed point over ground, as far as the sea floor permits."""
    memory, demand = pilot.memory, pilot.demand
    speed *= memory[slot.PACE]
    now = pilot.point[slot.SURGE_SPEED]
    demand[slot.ACC_SURGE], memory[slot.SURGE_SUM] = speed_demand(
        gains, SURGE, speed, now, demand[slot.FULL_SURGE], memory[slot.SURGE_SUM], dt_s
    )
    demand[slot.REF_SURGE] = speed + demand[slot.REF_YAW] * guidance.point_body_m[1]
    pilot.report[slot.WANTED_SURGE] = speed


@kernel
def sway_by(
    offset: float,
    feed: float,
    estimate: Array,
    dt_s: float,
    guidance: Guidance,
    gains: Gains,
    pilot: PilotState,
) -> None:
    """Command the sway that removes an offset of the followed point to starboard.

    The integral is kept as a vector in NED and turned into the body (Fossen 2011, section 12.2,
    does so for positioning): what holds against a current is still right after a turn.
    """
    memory, demand, heading = pilot.memory, pilot.demand, estimate[vector.HEADING]
    s, c = math.sin(heading), math.cos(heading)
    total = c * memory[slot.SWAY_SUM_E] - s * memory[slot.SWAY_SUM_N]
    steady, accelerate = place_demand(
        gains,
        SWAY,
        -offset,
        pilot.point[slot.SWAY_SPEED],
        feed,
        total,
        gains.axes[SWAY, FASTEST],
    )
    lever = guidance.point_body_m[0]
    demand[slot.REF_SWAY] = steady - lever * demand[slot.REF_YAW]
    demand[slot.ACC_SWAY] = accelerate - lever * demand[slot.ACC_YAW]
    pilot.report[slot.WANTED_SWAY] = steady
    if abs(offset) < guidance.far_m:
        step = place_sum_step(gains, SWAY, -offset, demand[slot.FULL_SWAY], dt_s)
        north, east = memory[slot.SWAY_SUM_N] - s * step, memory[slot.SWAY_SUM_E] + c * step
        bound = sum_bound(gains, SWAY)
        cut = min(1.0, bound / max(math.hypot(north, east), 1e-9))
        memory[slot.SWAY_SUM_N], memory[slot.SWAY_SUM_E] = cut * north, cut * east
