"""Stops: coming to rest at a corner, turning on the spot, and stepping aside.

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

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.compiled import kernel
from alice_survey.sim.vehicle.pilot import memory as slot
from alice_survey.sim.vehicle.pilot.gains import LAG, SURGE, SWAY, WEIGHT, YAW, Gains
from alice_survey.sim.vehicle.pilot.memory import PilotState
from alice_survey.sim.vehicle.pilot.path import Path, place_at
from alice_survey.sim.vehicle.pilot.safety import restart_watch
from alice_survey.sim.vehicle.pilot.settings import Guidance
from alice_survey.sim.vehicle.pilot.steering import (
    clamped,
    head_for,
    place_demand,
    place_sum_step,
    sum_bound,
    sway_by,
)
from alice_survey.sim.vehicle.rotations import wrapped

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
def stands(path: Path, leg: int) -> bool:
    """Whether a leg is a turn on the spot or a sway step."""
    return bool(path.turn_rad[leg] != 0.0 or path.side_rad[leg] != 0.0)


@kernel
def must_brake(
    path: Path, guidance: Guidance, gains: Gains, pilot: PilotState, leg: int, along_m: float
) -> bool:
    """Whether a vehicle that goes ahead must begin to brake for the stop at its leg's end."""
    if path.stop[leg] == 0.0:
        return False
    speed = max(pilot.point[slot.SURGE_SPEED], 0.0)
    braking = speed * speed / (2.0 * guidance.stop_mps2) + speed * gains.axes[SURGE, LAG]
    return bool(path.length_m[leg] - along_m <= braking)


@kernel
def brake(
    speed_mps: float, along_m: float, heading_rad: float, gains: Gains, pilot: PilotState
) -> None:
    """Begin to brake: the reference starts where the vehicle is, as fast as it is.

    The integral of the speed loop holds the share of the speed that its proportional part does not
    see (gains.py), and what the current takes; only this is wanted of the place's.
    """
    memory = pilot.memory
    held = memory[slot.SURGE_SUM] - (1.0 - gains.axes[SURGE, WEIGHT]) * speed_mps
    memory[slot.PLACE_SUM_N] = held * math.cos(heading_rad)
    memory[slot.PLACE_SUM_E] = held * math.sin(heading_rad)
    start_standing(along_m, speed_mps, pilot)
    memory[slot.RAMP] += gains.axes[SURGE, LAG] * speed_mps


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
    wanted = max(min(speed + acceleration * dt_s, maximum), speed - acceleration * dt_s)
    wanted = min(wanted, stopping)
    step = wanted * dt_s
    if step >= left - _TINY:
        return goal, 0.0, clamped(-speed / dt_s, acceleration)
    return at + step, wanted, clamped((wanted - speed) / dt_s, acceleration)


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
def _turning(
    leg: int,
    dt_s: float,
    estimate: Array,
    path: Path,
    guidance: Guidance,
    gains: Gains,
    pilot: PilotState,
) -> StopReference:
    """Move the heading of a turn on the spot on by a tick."""
    memory, sense = pilot.memory, math.copysign(1.0, path.turn_rad[leg])
    n, e, start, _ = place_at(path, leg, 0.0)
    behind = abs(wrapped(start + sense * memory[slot.REF] - estimate[vector.HEADING]))
    maximum = guidance.spot_rad_s * _patience(behind / _BEHIND_RAD)
    goal = abs(path.turn_rad[leg])
    lag_s = gains.axes[YAW, LAG]
    quicken = sense * _move_on(goal, maximum, guidance.spot_rad_s2, lag_s, dt_s, pilot)
    heading, rate = start + sense * memory[slot.REF], sense * memory[slot.REF_SPEED]
    over = goal - memory[slot.REF] < 0.5 * STOP_RAD and memory[slot.RAMP] >= goal
    return StopReference(n, e, heading, 0.0, 0.0, heading, rate, quicken, 0.0, over)


@kernel
def _moving(
    leg: int, dt_s: float, path: Path, guidance: Guidance, gains: Gains, pilot: PilotState
) -> StopReference:
    """Move the place on by a tick, ahead into a stop or aside."""
    memory, point, side = pilot.memory, pilot.point, path.side_rad[leg]
    n, e, course, _ = place_at(path, leg, memory[slot.REF])
    dn, de = n - point[slot.POINT_NORTH], e - point[slot.POINT_EAST]
    behind = math.cos(course) * dn + math.sin(course) * de
    maximum = path.speed_mps if side == 0.0 else guidance.step_mps
    maximum *= memory[slot.PACE] * _patience(behind / _BEHIND_M)
    acceleration = guidance.stop_mps2 if side == 0.0 else guidance.step_mps2
    lag_s = gains.axes[SURGE if side == 0.0 else SWAY, LAG]
    goal = path.length_m[leg]
    quicken = _move_on(goal, maximum, acceleration, lag_s, dt_s, pilot)
    along, speed = memory[slot.REF], memory[slot.REF_SPEED]
    n, e, course, curvature = place_at(path, leg, along)
    over = goal - along < 0.5 * STOP_M and memory[slot.RAMP] >= goal
    return StopReference(
        n, e, course, speed, quicken, course + side, curvature * speed, 0.0, along, over
    )


@kernel
def _patience(behind: float) -> float:
    """Share of a reference's speed: 1 while the vehicle is near, 0 from twice that on."""
    return min(max(2.0 - behind, 0.0), 1.0)


@kernel
def stand(
    leg: int,
    dt_s: float,
    estimate: Array,
    path: Path,
    guidance: Guidance,
    gains: Gains,
    pilot: PilotState,
) -> bool:
    """Brake, turn on the spot or step aside for a tick.

    Args:
        leg: that is flown.
        dt_s: the tick.
        estimate: (14,) of the navigation.
        path: legs.
        guidance: settings.
        gains: gains of the inner loops.
        pilot: is written.

    Returns:
        Whether the stop is over: the reference is at its end and the vehicle with it, at rest.
    """
    memory, report, point = pilot.memory, pilot.report, pilot.point
    if path.turn_rad[leg] != 0.0:
        wanted = _turning(leg, dt_s, estimate, path, guidance, gains, pilot)
    else:
        wanted = _moving(leg, dt_s, path, guidance, gains, pilot)
    error = head_for(
        wanted.heading_rad, wanted.turn_rad_s, wanted.quicken_rad_s2, estimate, dt_s, gains, pilot
    )
    ahead, abeam = keep_place(wanted, dt_s, estimate, path, guidance, gains, pilot)

    by_sway = guidance.sway > 0.0
    report[slot.BY_SWAY] = 1.0 if by_sway else 0.0
    report[slot.LEG], report[slot.ALONG], report[slot.LINE] = leg, wanted.along_m, path.line[leg]
    report[slot.PATH_HEADING] = wanted.course_rad
    dn, de = point[slot.POINT_NORTH] - wanted.north_m, point[slot.POINT_EAST] - wanted.east_m
    report[slot.CROSS] = de * math.cos(wanted.course_rad) - dn * math.sin(wanted.course_rad)
    if not wanted.over:
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
def keep_place(
    wanted: StopReference,
    dt_s: float,
    estimate: Array,
    path: Path,
    guidance: Guidance,
    gains: Gains,
    pilot: PilotState,
) -> tuple[float, float]:
    """Command the surge and sway that keep the followed point at the place of a reference.

    The integral of surge is kept as a vector in NED, as that of sway is (steering.py).

    Returns:
        Distance of the place ahead and to starboard of the followed point.
    """
    memory, demand, now = pilot.memory, pilot.demand, estimate[vector.HEADING]
    s, c = math.sin(now), math.cos(now)
    dn = wanted.north_m - pilot.point[slot.POINT_NORTH]
    de = wanted.east_m - pilot.point[slot.POINT_EAST]
    ahead, abeam = c * dn + s * de, c * de - s * dn
    cosine, sine = math.cos(wanted.course_rad - now), math.sin(wanted.course_rad - now)
    pulled, lever = memory[slot.PACE] * ahead, guidance.point_body_m[1]
    total = c * memory[slot.PLACE_SUM_N] + s * memory[slot.PLACE_SUM_E]
    steady, accelerate = place_demand(
        gains,
        SURGE,
        pulled,
        pilot.point[slot.SURGE_SPEED],
        wanted.speed_mps * cosine,
        total,
        path.speed_mps,
    )
    demand[slot.REF_SURGE] = steady + lever * demand[slot.REF_YAW]
    demand[slot.ACC_SURGE] = (
        accelerate + wanted.quicken_mps2 * cosine + lever * demand[slot.ACC_YAW]
    )
    pilot.report[slot.WANTED_SURGE] = steady
    near = clamped(pulled, STOP_M)
    step = place_sum_step(gains, SURGE, near, demand[slot.FULL_SURGE], dt_s)
    north, east = memory[slot.PLACE_SUM_N] + c * step, memory[slot.PLACE_SUM_E] + s * step
    cut = min(1.0, sum_bound(gains, SURGE) / max(math.hypot(north, east), 1e-9))
    memory[slot.PLACE_SUM_N], memory[slot.PLACE_SUM_E] = cut * north, cut * east
    if guidance.sway > 0.0:
        sway_by(-abeam, wanted.speed_mps * sine, estimate, dt_s, guidance, gains, pilot)
        demand[slot.ACC_SWAY] += wanted.quicken_mps2 * sine
    return ahead, abeam


@kernel
def leave_stop(path: Path, heading_rad: float, pilot: PilotState) -> bool:
    """Go on to the next leg.

    Returns:
        Whether there is none: the path is over.
    """
    memory, report = pilot.memory, pilot.report
    following = int(report[slot.LEG]) + 1
    if following == path.length_m.shape[0]:
        return True
    report[slot.LEG], report[slot.ALONG] = following, 0.0
    start_standing(0.0, 0.0, pilot)
    if not stands(path, following):
        memory[slot.STANDING] = 0.0
        north, east = memory[slot.PLACE_SUM_N], memory[slot.PLACE_SUM_E]
        memory[slot.SURGE_SUM] = north * math.cos(heading_rad) + east * math.sin(heading_rad)
    restart_watch(pilot)
    return False
