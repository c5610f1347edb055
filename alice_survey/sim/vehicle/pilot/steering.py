"""Steering modes: to a depth, to a heading, along a path, to a place and stay there.

Each commands velocities and accelerations of the inner loops (`PilotState.demand`). Parts that go
together are called in the order heave, yaw, surge, sway: surge and sway of the followed point
depend on the commanded yaw.

The inner loops lead from target velocities and accelerations to a wrench.

Feedback commands an acceleration; inertia, Coriolis forces and drag convert it to forces (computed
torque: T. I. Fossen, Handbook of Marine Craft Hydrodynamics and Motion Control, 2011), at the
target motion over ground. The current is not known, so that what it adds to drag is left to the
integrals.

Stops: coming to rest at a corner, turning on the spot, and stepping aside.

The vehicle follows a reference: a place that moves along the leg, or a heading that turns. A ramp
of bounded speed and acceleration goes ahead of it; its acceleration is fed forward, and the
reference is the response of lagging thrusters, v' = (ramp's v - v) / lag, so that a vehicle as
modelled follows without an error. Over a whole leg the reference goes as far as the ramp,
and by lag times v farther where it begins at a speed v. The place is held by surge and sway, the
heading by yaw (PIDs on place, steering.py). A vehicle without sway holds only the part of the place
that is along its heading, and drifts with the current across it. The reference waits for a vehicle
that falls behind.
"""

import math
from typing import NamedTuple

from alice_survey.core.compiled import kernel
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.dynamics import add_coriolis, add_damping
from alice_survey.sim.vehicle.fins import add_fins
from alice_survey.sim.vehicle.pilot import gains as g
from alice_survey.sim.vehicle.pilot import memory as slot
from alice_survey.sim.vehicle.pilot.gains import Gains
from alice_survey.sim.vehicle.pilot.memory import PilotState, restart_watch
from alice_survey.sim.vehicle.pilot.path import place_at
from alice_survey.sim.vehicle.pilot.settings import MAX_PITCH_RAD, Guidance, Tick
from alice_survey.sim.vehicle.rotations import wrap_angle


@kernel
def clamp(value: float, maximum: float) -> float:
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
        error: target place minus place.
        speed: measured.
        feed: speed of the target place.
        total: k_I times the integral of the error, a speed.
        maximum: bound of the proportional part, a speed.

    Returns:
        The speed that drag is to be expected at, and the acceleration.
    """
    row = gains.axes[axis]
    inner = row[g.INNER]
    steady = feed + clamp(row[g.PLACE] / inner * error, maximum)
    derivative = (row[g.RATE] / inner - 1.0) * (feed - speed)
    return steady, inner * (steady + total + derivative - speed)


@kernel
def place_sum_step(gains: Gains, axis: int, error: float, full: float, dt_s: float) -> float:
    """Increment of k_I times the integral of a place error in a tick; 0 while the force is cut.

    Args:
        gains: gains of all axes.
        axis: row of gains.
        error: target place minus place.
        full: +1 or -1 where the force is cut at its greatest or least, else 0.
        dt_s: the tick.
    """
    if full * error > 0.0:
        return 0.0
    return float(gains.axes[axis, g.INTEGRAL] / gains.axes[axis, g.INNER] * error * dt_s)


@kernel
def sum_bound(gains: Gains, axis: int) -> float:
    """Integral, as a speed, beyond which it alone would exceed the available force."""
    row = gains.axes[axis]
    if row[g.INNER] == 0.0:
        return 0.0
    return float(max(-row[g.MIN_FORCE], row[g.MAX_FORCE]) / (row[g.MASS] * row[g.INNER]))


@kernel
def write_wrench(
    estimate: Array, dt_s: float, gains: Gains, pilot: PilotState, wrench: Array
) -> None:
    """Turn the demand into a wrench, and note where it is cut.

    Moments that hold roll level and pitch as demanded, where thrusters or fins can, are a PID and
    computed torque: what the motion and the centre of gravity do at level attitude. What gravity
    rights by itself comes on top.

    Args:
        estimate: (14,) of the navigation.
        dt_s: the tick.
        gains: the vehicle.
        pilot: its demand is read, and the notes are written into it.
        wrench: (6,) N and N m is written.
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
        minimum, maximum = gains.axes[axis, g.MIN_FORCE], gains.axes[axis, g.MAX_FORCE]
        demand[slot.FULL_SURGE + axis] = (
            1.0 if asked > maximum else (-1.0 if asked < minimum else 0.0)
        )
        wrench[i] = min(max(asked, minimum), maximum)
    for axis in (g.ROLL, g.PITCH):
        row = gains.axes[axis]
        if row[g.MASS] == 0.0:
            continue
        i = 3 if axis == g.ROLL else 4
        angle = estimate[vector.ROLL] if axis == g.ROLL else estimate[vector.PITCH]
        rate = estimate[vector.P] if axis == g.ROLL else estimate[vector.Q]
        if axis == g.PITCH:
            angle -= pilot.demand[slot.REF_PITCH]
            rate -= pilot.demand[slot.REF_PITCH_RATE]
        place = slot.ROLL_SUM if axis == g.ROLL else slot.PITCH_SUM
        total = pilot.memory[place]
        asked = -row[g.MASS] * (row[g.PLACE] * angle + row[g.RATE] * rate + total) - pilot.force[i]
        for other in range(g.STEERED):
            k = other if other < 3 else 5
            asked += body.mass[i, k] * pilot.demand[slot.ACC_SURGE + other]
        asked += body.weight_n * (-body.cg[1] if axis == g.ROLL else body.cg[0])
        wrench[i] = min(max(asked, row[g.MIN_FORCE]), row[g.MAX_FORCE])
        if (asked - wrench[i]) * angle >= 0.0:  # not cut, or on the way back
            step = row[g.INTEGRAL] * angle * dt_s
            pilot.memory[place] = clamp(
                total + step, max(-row[g.MIN_FORCE], row[g.MAX_FORCE]) / row[g.MASS]
            )


DEPTH_KEPT_M = 0.2
HEADING_KEPT_RAD = g.KEPT_RAD
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
    sy, cy = (math.sin(estimate[vector.HEADING]), math.cos(estimate[vector.HEADING]))
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
    innovation = clamp(heard - memory[slot.FLOOR], _MAX_INNOVATION_M)
    memory[slot.FLOOR] += dt_s * (memory[slot.FLOOR_SLOPE] + 2.0 * rate * innovation)
    memory[slot.FLOOR_SLOPE] += dt_s * rate * rate * innovation


@kernel
def sink_to(depth_m: float, feed_mps: float, tick: Tick) -> None:
    """Command the heave, or the pitch, that takes the origin to a depth, which moves at a speed."""
    dt_s, estimate, path, guidance, gains, pilot = tick
    memory, demand = pilot.memory, pilot.demand
    pilot.report[slot.TARGET_DEPTH] = depth_m
    if guidance.under_way.circle_m > 0.0:
        off, ahead = estimate[vector.DEPTH] - depth_m, guidance.under_way.dive_ahead_m
        bent = off / ahead + memory[slot.HEAVE_SUM] - feed_mps / path.speed_mps
        kept = min(max(bent, -MAX_PITCH_RAD), MAX_PITCH_RAD)
        demand[slot.REF_PITCH] = guidance.under_way.level_rad + kept
        demand[slot.REF_PITCH_RATE] = 0.0
        if kept == bent:
            demand[slot.REF_PITCH_RATE] = (pilot.point[slot.SINK_SPEED] - feed_mps) / ahead
        if abs(off) < DEPTH_KEPT_M:
            learned = g.INTEGRAL_SHARE * path.speed_mps / (ahead * ahead) * off * dt_s
            total = memory[slot.HEAVE_SUM] + learned
            memory[slot.HEAVE_SUM] = min(max(total, -0.5 * MAX_PITCH_RAD), 0.5 * MAX_PITCH_RAD)
        return
    error, maximum = depth_m - estimate[vector.DEPTH], gains.axes[g.HEAVE, g.FASTEST]
    demand[slot.REF_HEAVE], demand[slot.ACC_HEAVE] = place_demand(
        gains,
        g.HEAVE,
        error,
        pilot.point[slot.SINK_SPEED],
        clamp(feed_mps, 0.5 * maximum),
        memory[slot.HEAVE_SUM],
        maximum,
    )
    if abs(error) < DEPTH_KEPT_M or abs(pilot.point[slot.SINK_SPEED]) < _AT_REST * maximum:
        near = clamp(error, DEPTH_KEPT_M)
        step = place_sum_step(gains, g.HEAVE, near, demand[slot.FULL_HEAVE], dt_s)
        memory[slot.HEAVE_SUM] = clamp(memory[slot.HEAVE_SUM] + step, sum_bound(gains, g.HEAVE))


@kernel
def head_for(heading: float, feed: float, quicken: float, tick: Tick) -> float:
    """Command the yaw that takes the heading to a target one.

    Args:
        heading: target.
        feed: its rate.
        quicken: the rate of that.
        tick: what is read, and the pilot that is written.

    Returns:
        Target minus present heading, within -pi and pi.
    """
    dt_s, estimate, _path, _guidance, gains, pilot = tick
    memory, demand = pilot.memory, pilot.demand
    error, maximum = wrap_angle(heading - estimate[vector.HEADING]), gains.axes[g.YAW, g.FASTEST]
    demand[slot.REF_YAW], accelerate = place_demand(
        gains, g.YAW, error, pilot.point[slot.TURN_SPEED], feed, memory[slot.YAW_SUM], maximum
    )
    demand[slot.ACC_YAW] = accelerate + quicken
    off = abs(pilot.point[slot.TURN_SPEED] - feed)
    if abs(error) < HEADING_KEPT_RAD or off < _AT_REST * maximum:
        near = clamp(error, HEADING_KEPT_RAD)
        step = place_sum_step(gains, g.YAW, near, demand[slot.FULL_YAW], dt_s)
        memory[slot.YAW_SUM] = clamp(memory[slot.YAW_SUM] + step, sum_bound(gains, g.YAW))
    pilot.report[slot.TARGET_HEADING] = heading
    return error


@kernel
def surge_at(speed: float, tick: Tick) -> None:
    """Command a surge of the followed point over ground, as far as the sea floor permits.

    A PI on speed whose proportional part sees a share of the target speed (gains.py).
    """
    dt_s, _estimate, _path, guidance, gains, pilot = tick
    memory, demand, row = pilot.memory, pilot.demand, gains.axes[g.SURGE]
    speed *= memory[slot.PACE]
    now = pilot.point[slot.SURGE_SPEED]
    if demand[slot.FULL_SURGE] * (speed - now) <= 0.0:
        step = row[g.PLACE] / row[g.RATE] * (speed - now) * dt_s
        memory[slot.SURGE_SUM] = clamp(memory[slot.SURGE_SUM] + step, sum_bound(gains, g.SURGE))
    demand[slot.ACC_SURGE] = row[g.RATE] * (row[g.WEIGHT] * speed - now + memory[slot.SURGE_SUM])
    demand[slot.REF_SURGE] = speed + demand[slot.REF_YAW] * guidance.point_body_m[1]
    pilot.report[slot.TARGET_SURGE] = speed


@kernel
def sway_by(offset: float, feed: float, tick: Tick) -> None:
    """Command the sway that removes an offset of the followed point to starboard.

    The integral is kept as a vector in NED and turned into the body (Fossen 2011, section 12.2,
    does so for positioning): what holds against a current is still right after a turn.
    """
    dt_s, estimate, _path, guidance, gains, pilot = tick
    memory, demand, heading = pilot.memory, pilot.demand, estimate[vector.HEADING]
    s, c = math.sin(heading), math.cos(heading)
    total = c * memory[slot.SWAY_SUM_E] - s * memory[slot.SWAY_SUM_N]
    steady, accelerate = place_demand(
        gains,
        g.SWAY,
        -offset,
        pilot.point[slot.SWAY_SPEED],
        feed,
        total,
        gains.axes[g.SWAY, g.FASTEST],
    )
    lever = guidance.point_body_m[0]
    demand[slot.REF_SWAY] = steady - lever * demand[slot.REF_YAW]
    demand[slot.ACC_SWAY] = accelerate - lever * demand[slot.ACC_YAW]
    pilot.report[slot.TARGET_SWAY] = steady
    if abs(offset) < guidance.far_m:
        step = place_sum_step(gains, g.SWAY, -offset, demand[slot.FULL_SWAY], dt_s)
        north, east = memory[slot.SWAY_SUM_N] - s * step, memory[slot.SWAY_SUM_E] + c * step
        bound = sum_bound(gains, g.SWAY)
        cut = min(1.0, bound / max(math.hypot(north, east), 1e-9))
        memory[slot.SWAY_SUM_N], memory[slot.SWAY_SUM_E] = cut * north, cut * east


STOP_M = 0.1
"""A stop ends when the place is kept this well (without sway: along the heading) ..."""
STOP_RAD = math.radians(3.0)
"""... its heading this well ..."""
STOP_MPS = 0.05
STOP_RAD_S = math.radians(2.0)
"""... and at these speeds (all inferred: as well as lines are kept)."""
_WIDEN_S = 5.0
"""The tolerances grow by their own size in this time: swell and gusts are not waited for."""
_BEHIND_M = 0.3
_BEHIND_RAD = math.radians(20.0)
"""Lag beyond which the reference slows down; it waits at twice of it."""
_TINY = 1e-12


@kernel
def start_standing(at: float, speed: float, pilot: PilotState) -> None:
    """Let a reference begin at a place or heading, at a speed."""
    memory = pilot.memory
    memory[slot.STANDING], memory[slot.WAITED_S] = 1.0, 0.0
    memory[slot.REF], memory[slot.REF_SPEED] = at, speed
    memory[slot.RAMP], memory[slot.RAMP_SPEED] = at, speed


@kernel
def ramp(
    at: float, speed: float, goal: float, maximum: float, acceleration: float, dt_s: float
) -> tuple[float, float, float]:
    """Move a reference towards its goal for a tick, so that it can still stop there.

    Args:
        at: its place, at or before the goal.
        speed: its speed, not negative.
        goal: place to stop at.
        maximum: greatest speed.
        acceleration: greatest, either way.
        dt_s: the tick.

    Returns:
        Place and speed after the tick, and the acceleration, which is bounded too.
    """
    left = goal - at
    # Braking from here with the greatest acceleration takes all that is left.
    stopping = math.sqrt(2.0 * acceleration * max(left, 0.0))
    # Down no faster than it may, but for the law of stopping, which decides.
    target = max(min(speed + acceleration * dt_s, maximum), speed - acceleration * dt_s)
    target = min(target, stopping)
    step = target * dt_s
    if step >= left - _TINY:
        return goal, 0.0, clamp(-speed / dt_s, acceleration)
    return at + step, target, clamp((target - speed) / dt_s, acceleration)


class StopReference(NamedTuple):
    """Reference of the followed point and the heading in a tick, with their rates."""

    north_m: float
    east_m: float
    course_rad: float
    """The place moves on this course."""
    speed_mps: float
    quicken_mps2: float
    heading_rad: float
    turn_rad_s: float
    quicken_rad_s2: float
    along_m: float
    """Distance from the leg's start."""
    over: bool
    """Whether it is at the leg's end."""


@kernel
def _move_on(
    goal: float, maximum: float, acceleration: float, lag_s: float, dt_s: float, pilot: PilotState
) -> float:
    """Move ramp and reference on by a tick.

    Returns:
        The acceleration to feed forward.
    """
    memory = pilot.memory
    memory[slot.RAMP], memory[slot.RAMP_SPEED], quicken = ramp(
        memory[slot.RAMP], memory[slot.RAMP_SPEED], goal, maximum, acceleration, dt_s
    )
    speed = memory[slot.REF_SPEED]
    speed += min(dt_s / lag_s, 1.0) * (memory[slot.RAMP_SPEED] - speed)
    memory[slot.REF_SPEED] = speed
    memory[slot.REF] = min(memory[slot.REF] + speed * dt_s, goal)
    return quicken


@kernel
def stand(leg: int, tick: Tick) -> bool:
    """Brake, turn on the spot or step aside for a tick.

    Args:
        leg: that is flown.
        tick: what is read, and the pilot that is written.

    Returns:
        Whether the stop is over: the reference is at its end and the vehicle with it, at rest.
    """
    dt_s, estimate, path, guidance, gains, pilot = tick
    memory, report, point = pilot.memory, pilot.report, pilot.point
    if path.turn_rad[leg] != 0.0:
        sense, goal = math.copysign(1.0, path.turn_rad[leg]), abs(path.turn_rad[leg])
        n, e, start, _ = place_at(path, leg, 0.0)
        behind = abs(wrap_angle(start + sense * memory[slot.REF] - estimate[vector.HEADING]))
        # A reference goes slower from this far ahead of the vehicle on, and waits at twice that.
        maximum = guidance.turn_in_place_rad_s * min(max(2.0 - behind / _BEHIND_RAD, 0.0), 1.0)
        lag_s = gains.axes[g.YAW, g.LAG]
        quicken = sense * _move_on(goal, maximum, guidance.turn_in_place_rad_s2, lag_s, dt_s, pilot)
        heading, rate = start + sense * memory[slot.REF], sense * memory[slot.REF_SPEED]
        over = goal - memory[slot.REF] < 0.5 * STOP_RAD and memory[slot.RAMP] >= goal
        target = StopReference(n, e, heading, 0.0, 0.0, heading, rate, quicken, 0.0, over)
    else:
        side, goal = path.side_rad[leg], path.length_m[leg]
        n, e, course, _ = place_at(path, leg, memory[slot.REF])
        dn, de = n - point[slot.POINT_NORTH], e - point[slot.POINT_EAST]
        behind = math.cos(course) * dn + math.sin(course) * de
        maximum = path.speed_mps if side == 0.0 else guidance.step_mps
        maximum *= memory[slot.PACE] * min(max(2.0 - behind / _BEHIND_M, 0.0), 1.0)
        acceleration = guidance.stop_mps2 if side == 0.0 else guidance.step_mps2
        lag_s = gains.axes[g.SURGE if side == 0.0 else g.SWAY, g.LAG]
        quicken = _move_on(goal, maximum, acceleration, lag_s, dt_s, pilot)
        along, speed = memory[slot.REF], memory[slot.REF_SPEED]
        n, e, course, curvature = place_at(path, leg, along)
        over = goal - along < 0.5 * STOP_M and memory[slot.RAMP] >= goal
        target = StopReference(
            n, e, course, speed, quicken, course + side, curvature * speed, 0.0, along, over
        )
    error = head_for(target.heading_rad, target.turn_rad_s, target.quicken_rad_s2, tick)
    ahead, abeam = keep_place(target, tick)

    by_sway = guidance.sway > 0.0
    report[slot.BY_SWAY] = 1.0 if by_sway else 0.0
    report[slot.LEG], report[slot.ALONG], report[slot.LINE] = leg, target.along_m, path.line[leg]
    report[slot.PATH_HEADING] = target.course_rad
    dn, de = point[slot.POINT_NORTH] - target.north_m, point[slot.POINT_EAST] - target.east_m
    report[slot.CROSS] = de * math.cos(target.course_rad) - dn * math.sin(target.course_rad)
    if not target.over:
        return False
    memory[slot.WAITED_S] += dt_s
    wide = 1.0 + memory[slot.WAITED_S] / _WIDEN_S
    off, moves = abs(ahead), abs(point[slot.SURGE_SPEED])
    if by_sway:
        off, moves = math.hypot(ahead, abeam), math.hypot(moves, point[slot.SWAY_SPEED])
    return bool(
        off < STOP_M * wide
        and moves < STOP_MPS * wide
        and abs(error) < STOP_RAD * wide
        and abs(point[slot.TURN_SPEED]) < STOP_RAD_S * wide
    )


@kernel
def keep_place(target: StopReference, tick: Tick) -> tuple[float, float]:
    """Command the surge and sway that keep the followed point at the place of a reference.

    The integral of surge is kept as a vector in NED, as that of sway is (steering.py).

    Returns:
        Distance of the place ahead and to starboard of the followed point.
    """
    dt_s, estimate, path, guidance, gains, pilot = tick
    memory, demand, now = pilot.memory, pilot.demand, estimate[vector.HEADING]
    s, c = math.sin(now), math.cos(now)
    dn = target.north_m - pilot.point[slot.POINT_NORTH]
    de = target.east_m - pilot.point[slot.POINT_EAST]
    ahead, abeam = c * dn + s * de, c * de - s * dn
    cosine, sine = math.cos(target.course_rad - now), math.sin(target.course_rad - now)
    pulled, lever = memory[slot.PACE] * ahead, guidance.point_body_m[1]
    total = c * memory[slot.PLACE_SUM_N] + s * memory[slot.PLACE_SUM_E]
    steady, accelerate = place_demand(
        gains,
        g.SURGE,
        pulled,
        pilot.point[slot.SURGE_SPEED],
        target.speed_mps * cosine,
        total,
        path.speed_mps,
    )
    demand[slot.REF_SURGE] = steady + lever * demand[slot.REF_YAW]
    demand[slot.ACC_SURGE] = (
        accelerate + target.quicken_mps2 * cosine + lever * demand[slot.ACC_YAW]
    )
    pilot.report[slot.TARGET_SURGE] = steady
    near = clamp(pulled, STOP_M)
    step = place_sum_step(gains, g.SURGE, near, demand[slot.FULL_SURGE], dt_s)
    north, east = memory[slot.PLACE_SUM_N] + c * step, memory[slot.PLACE_SUM_E] + s * step
    cut = min(1.0, sum_bound(gains, g.SURGE) / max(math.hypot(north, east), 1e-9))
    memory[slot.PLACE_SUM_N], memory[slot.PLACE_SUM_E] = cut * north, cut * east
    if guidance.sway > 0.0:
        sway_by(-abeam, target.speed_mps * sine, tick)
        demand[slot.ACC_SWAY] += target.quicken_mps2 * sine
    return ahead, abeam
