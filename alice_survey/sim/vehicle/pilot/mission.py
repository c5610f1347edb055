"""Missions of way-points, followed by the law of another vehicle's software instead of our own.

A mission is flown step by step. The law of a step says where to head, how fast to go and when the
step is done; the inner loops beneath it are our own (gains.py), in the place of those that such a
vehicle is tuned with. Two laws are known:

- COLA2, of SPARUS II and its kin;
- ArduSub's AUTO mode.

Safety is our own, too: clearance, depth, pitch, bottom lock and progress are watched as on any
mission, and the altitude follows the smoothed sea floor.

How COLA2 follows a mission: its captain and its pilot's section, keep and anchor controllers.

After the public sources of Iqua Robotics' cola2_control (2020 to 2024): `captain`,
`controllers/section`, `holonomic_keep_position`, `anchor`, and the defaults of the pilot's
parameters, which have the names `~section/...` and `~anchor/...`.

- A goto is a section from where the vehicle is. A section heads for a point on the straight at the
  distance `delta` (T. I. Fossen, Handbook of Marine Craft Hydrodynamics and Motion Control, 2011,
  section 10.3.2, enclosure-based): at a cross-track error e the sine of the heading off the
  course is e / delta. There is no integral, and sway is not controlled. Within `delta` of the end
  it heads for the end itself; past the end it turns back to it.
- It is done within `tolerance_xy` of the end and within `tolerance_z` of the depth or altitude, or
  when the captain's time is up, which counts as done, too.
- A park with a yaw first goes to within 3 m, then holds place and heading with all axes that the
  vehicle has for its time; one without yaw anchors: the vehicle faces the place and keeps a radius
  off it.

How ArduSub's AUTO mode follows a mission: AC_WPNav and AC_PosControl's laws.

After the public sources of ArduPilot (`ArduSub/mode_auto.cpp`, `commands_logic.cpp`, `config.h`,
`libraries/AC_WPNav`, `AC_AttitudeControl/AC_PosControl`; Sub-4.5).

- A target moves along the straight from the way-point before to this one, at `WPNAV_SPEED` with
  `WPNAV_ACCEL` and `WPNAV_JERK`, and comes to rest there: ArduSub never sets a next destination, so
  that no way-point is passed. Here it starts and stops with the constant acceleration that takes as
  long as that jerk does.
- Its time runs slower while the vehicle cannot keep up: at the share 0.05 + (v - PSC_POSXY_P e) / v
  requested, through a low-pass of the time WPNAV_ACCEL / WPNAV_JERK.
- The vehicle holds on to the target by surge and sway. AC_PosControl's P on position and PID on
  velocity take our own gains of these axes, as a vehicle would be tuned; a steady current is met by
  the integral.
- The way-point is reached when the target is there and the vehicle within `WPNAV_RADIUS`, depth
  included; then the stay counts.
- Heading: `WP_YAW_BEHAVIOR` 4, ArduSub's default: the track's bearing, corrected towards the
  velocity that is requested by at most `XTRACK_ANG_LIM`; or that of a `CONDITION_YAW`.
"""

import math
from typing import NamedTuple

import numpy as np

from alice_survey.core.compiled import kernel
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.dynamics import add_coriolis, add_damping
from alice_survey.sim.vehicle.pilot import gains as g
from alice_survey.sim.vehicle.pilot import memory as slot
from alice_survey.sim.vehicle.pilot.gains import Gains
from alice_survey.sim.vehicle.pilot.memory import DIVE, FOLLOW, mind_floor, restart_watch
from alice_survey.sim.vehicle.pilot.settings import Tick
from alice_survey.sim.vehicle.pilot.steering import (
    StopReference,
    clamp,
    head_for,
    keep_place,
    ramp,
    sink_to,
    surge_at,
)
from alice_survey.sim.vehicle.rotations import wrap_angle
from alice_survey.sim.vehicle.steady import bisect

(
    KIND, START_N, START_E, END_N, END_E, HEADING, BY_DEPTH, BY_ALTITUDE, DEPTH, ALTITUDE, SPEED,
    TOLERANCE, HOLD_S, LINE,
) = range(14)  # fmt: skip
"""Columns of the steps of a mission: kind of manoeuvre; where a section starts and where the step
ends, m north and east; heading to hold, rad, NaN where it follows from the way; 1 where heave may
be by depth, by altitude (by both:
altitude as soon as there is one); target depth of the origin, m; target altitude of the point
whose altitude the navigation gives, m; speed, m/s; how near to its end it is done, m; how long to
stay there, s; the survey line on which pictures are taken meanwhile, or -1."""
COLUMNS = 14

GOTO, SECTION, KEEP, ANCHOR, FROM_END = 0, 1, 2, 3, 4
"""Kinds: from where the vehicle is; along a straight from its start; hold a place and a heading;
stay about a place, facing it; along the straight from where the step before ends."""

MIN_SPEED_MPS = 0.2
"""WPNAV_SPEED_MIN: a slower speed is not taken."""
MIN_RADIUS_M = 0.05
"""WPNAV_RADIUS_MIN"""
_SPARE = 0.05
_SLOW = 0.1
"""Share of the greatest speed below which the heading is not corrected."""
_TINY_S = 1e-9

# Parameters of ArduSub, at its defaults.
_ACCEL_MPS2 = 2.5
"""`WPNAV_ACCEL`, there in cm/s^2."""
_JERK_MPS3 = 1.0
"""`WPNAV_JERK`"""
_POSITION_P = 1.0
"""`PSC_POSXY_P`"""
_XTRACK_RAD = math.radians(45.0)
"""`XTRACK_ANG_LIM`, there in degrees."""


@kernel
def to_waypoint(step: Array, heave_m: float, tick: Tick) -> bool:
    """Fly to a way-point for a tick; return whether it is done. Arguments as of `manoeuvre`."""
    dt_s, estimate, pilot = tick.dt_s, tick.estimate, tick.pilot
    memory, point, now = pilot.memory, pilot.point, estimate[vector.HEADING]
    dn, de = step[END_N] - memory[slot.FROM_N], step[END_E] - memory[slot.FROM_E]
    length = math.hypot(dn, de)
    course = math.atan2(de, dn) if length > 1e-6 else now
    s, c = math.sin(course), math.cos(course)
    speed = max(step[SPEED], MIN_SPEED_MPS)
    acceleration = min(_ACCEL_MPS2, 0.5 * math.sqrt(speed * _JERK_MPS3))
    # How fast the target's time runs.
    moves, pace = memory[slot.RAMP_SPEED], 1.0
    if moves > 0.0:
        done = (point[slot.POINT_NORTH] - memory[slot.FROM_N]) * c
        done += (point[slot.POINT_EAST] - memory[slot.FROM_E]) * s
        cosine = c * math.cos(now) + s * math.sin(now)
        sine = s * math.cos(now) - c * math.sin(now)
        track_speed = point[slot.SURGE_SPEED] * cosine + point[slot.SWAY_SPEED] * sine
        behind = _POSITION_P * (memory[slot.RAMP] - done)
        pace = min(max(_SPARE + (track_speed - behind) / moves, 0.0), 1.0)
    time_s = _ACCEL_MPS2 / _JERK_MPS3
    memory[slot.TRACK_PACE] += (pace - memory[slot.TRACK_PACE]) * min(dt_s / time_s, 1.0)
    quicken, dt = 0.0, memory[slot.TRACK_PACE] * dt_s
    if dt > _TINY_S:
        memory[slot.RAMP], memory[slot.RAMP_SPEED], quicken = ramp(
            memory[slot.RAMP], memory[slot.RAMP_SPEED], length, speed, acceleration, dt
        )
    # As fast as its time runs: else a target that waits while it brakes would push for ever.
    quicken *= memory[slot.TRACK_PACE] * memory[slot.TRACK_PACE]
    at, moves = memory[slot.RAMP], memory[slot.RAMP_SPEED]
    north, east = memory[slot.FROM_N] + at * c, memory[slot.FROM_E] + at * s
    off_n, off_e = north - point[slot.POINT_NORTH], east - point[slot.POINT_EAST]

    heading = step[HEADING]
    if not math.isfinite(heading):
        heading = course
        target_n = moves * c + _POSITION_P * off_n
        target_e = moves * s + _POSITION_P * off_e
        if length > 1e-6 and math.hypot(target_n, target_e) >= _SLOW * speed:
            error = wrap_angle(math.atan2(target_e, target_n) - course)
            heading += clamp(error, _XTRACK_RAD)
    head_for(heading, 0.0, 0.0, tick)
    reference = StopReference(north, east, course, moves, quicken, heading, 0.0, 0.0, at, False)
    keep_place(reference, tick)
    pilot.report[slot.BY_SWAY] = 1.0

    away = math.hypot(step[END_N] - point[slot.POINT_NORTH], step[END_E] - point[slot.POINT_EAST])
    radius = max(step[TOLERANCE], MIN_RADIUS_M)
    if memory[slot.KEEPS] == 0.0 and (at < length or math.hypot(away, heave_m) > radius):
        return False
    memory[slot.KEEPS] = 1.0
    memory[slot.HELD_S] += dt_s
    return bool(memory[slot.HELD_S] >= step[HOLD_S])


PARK_APPROACH_M = 3.0
"""A park's approach is done this near (captain.cpp)."""
_DVL_RANGE_M, _HEAVE_MPS, _SPARE_S = 200.0, 0.3, 30.0
"""Of the captain's time: heave by altitude may go through the DVL's range."""
_YAW_FREE_RAD, _YAW_STOP_RAD = 0.3, 1.3
"""Heading error up to which the surge is whole, and from which on it is 0 (section.cpp)."""
_STOPS, _STRAIGHT = 0.8, 0.4
"""Shares of the tolerance within which a section stops the surge, and keeps the heading."""
_FASTEST_SLIP = 3.0
"""Times the speed of a mission that a hull surely does not slip sideways at."""
_ANCHOR_RAD = 0.5
"""Heading error beyond which an anchored vehicle does not surge."""


class Cola2Settings(NamedTuple):
    """Parameters of COLA2's pilot, with its defaults."""

    delta_m: float = 5.0
    """`~section/delta`: the look-ahead."""
    tolerance_z_m: float = 1.0
    """`~section/tolerance_z`"""
    distance_to_max_velocity_m: float = 5.0
    """`~section/distance_to_max_velocity`: nearer to an end it goes slower ..."""
    max_surge_mps: float = 0.5
    """`~section/max_surge_velocity`"""
    min_surge_mps: float = 0.2
    """`~section/min_surge_velocity`: ... down to this, or the mission's speed."""
    anchor_kp: float = 0.1
    """`~anchor/kp`"""
    anchor_radius_m: float = 1.0
    """`~anchor/radius`"""
    anchor_min_mps: float = -0.1
    """`~anchor/min_surge_velocity`"""
    anchor_max_mps: float = 0.3
    """`~anchor/max_surge_velocity`"""


def steady_drift(current_mps: float, speed_mps: float) -> float:
    """Sine of the heading that a section keeps off its course in a steady current across it.

    Nothing pushes the vehicle sideways, so the water carries it along across its hull: heading by
    an angle a off the course it moves at `speed_mps` along its axis, over ground, and at the
    current's cos(a) across it. On a straight speed sin(a) = current cos(a) cos(a), hence sin(a) =
    (sqrt(1 + 4 r^2) - 1) / (2 r) with r the ratio of current to speed. COLA2 then is delta sin(a)
    off the section, since e / delta is its sine, too. For small r this is delta tan(r).

    Args:
        current_mps: across the course.
        speed_mps: along the vehicle's axis, over ground.
    """
    ratio = abs(current_mps) / speed_mps
    return 2.0 * ratio / (math.sqrt(1.0 + 4.0 * ratio * ratio) + 1.0)


def circling_m(gains: Gains, speed_mps: float) -> float:
    """Radius at which a section's law circles its end for ever, if its tolerance is less.

    On a circle the end is abeam: the heading error a and the drift angle b of the hull, which slips
    outwards, make up a right angle. The surge is the share of the speed that a leaves, the yaw rate
    what the heading loop answers to a, and the slip is where the water's sideways forces balance.

    Args:
        gains: of the vehicle.
        speed_mps: that the mission states.
    """

    def within(error_rad: float) -> bool:
        surge, sway, _ = _circling(gains, speed_mps, error_rad)
        return error_rad + math.atan2(abs(sway), surge) <= 0.5 * math.pi

    surge, sway, turn = _circling(gains, speed_mps, bisect(within, 0.0, _YAW_STOP_RAD, 1e-6))
    return math.hypot(surge, sway) / turn


def turn_in_m(gains: Gains, speed_mps: float) -> float:
    """How far a vehicle goes on along its course while a section turns it by a right angle.

    The integral of the speed that a heading error leaves, times its sine, over the rate at which
    the error goes; the hull's slip is left out.

    Args:
        gains: of the vehicle.
        speed_mps: that the mission states.
    """
    errors = np.linspace(1e-6, 0.5 * math.pi, 1000)
    shares = np.clip((_YAW_STOP_RAD - errors) / (_YAW_STOP_RAD - _YAW_FREE_RAD), 0.0, 1.0)
    rates = np.array([yaw_rad_s(gains, float(error)) for error in errors])
    return float(np.trapezoid(speed_mps * shares * np.sin(errors) / rates, errors))


def yaw_rad_s(gains: Gains, error_rad: float) -> float:
    """Rate at which a vehicle turns at a heading error."""
    row = gains.axes[g.YAW]
    return float(min(row[g.PLACE] / row[g.RATE] * error_rad, row[g.FASTEST]))


def _circling(gains: Gains, speed_mps: float, error_rad: float) -> tuple[float, float, float]:
    """Surge, steady sway and yaw rate of a section's law at a heading error."""
    share = (_YAW_STOP_RAD - error_rad) / (_YAW_STOP_RAD - _YAW_FREE_RAD)
    surge, turn = speed_mps * min(max(share, 0.0), 1.0), yaw_rad_s(gains, error_rad)

    def outwards(sway: float) -> bool:
        motion, force = np.array([surge, sway, 0.0, 0.0, 0.0, turn]), np.zeros(6)
        add_damping(gains.body, motion, force)
        add_coriolis(gains.body, motion, force)
        return bool(force[1] > 0.0)

    return surge, bisect(outwards, -_FASTEST_SLIP * speed_mps, 0.0, 1e-6 * speed_mps), turn


@kernel
def timeout_s(step: Array, distance_m: float, heave_m: float, settings: Cola2Settings) -> float:
    """How long the captain lets a manoeuvre take.

    Args:
        step: its row.
        distance_m: to its end, seen from above.
        heave_m: to its depth.
        settings: of the law.
    """
    speed = max(min(step[SPEED], settings.max_surge_mps), 1e-3)
    heave = abs(heave_m) if step[BY_DEPTH] > 0.0 else 0.0
    heave += _DVL_RANGE_M if step[BY_ALTITUDE] > 0.0 else 0.0
    return float(2.0 * max(math.sqrt(2.0) * distance_m / speed, heave / _HEAVE_MPS) + _SPARE_S)


@kernel
def manoeuvre(step: Array, heave_m: float, settings: Cola2Settings, tick: Tick) -> bool:
    """Fly a goto, section or park for a tick; return whether it is done.

    Args:
        step: its row.
        heave_m: how much deeper the vehicle should be.
        settings: of the law.
        tick: what is read, and the pilot that is written.
    """
    dt_s, estimate, _path, guidance, gains, pilot = tick
    memory, point, heading = pilot.memory, pilot.point, estimate[vector.HEADING]
    parks = step[KIND] == KEEP or step[KIND] == ANCHOR
    if not parks or memory[slot.KEEPS] == 0.0:
        tolerance = PARK_APPROACH_M if parks else step[TOLERANCE]
        now, north, east = heading, point[slot.POINT_NORTH], point[slot.POINT_EAST]
        to_end = math.hypot(step[END_N] - north, step[END_E] - east)
        to_start = math.hypot(memory[slot.FROM_N] - north, memory[slot.FROM_E] - east)
        heading = aim(
            north, east, memory[slot.FROM_N], memory[slot.FROM_E], step[END_N], step[END_E],
            settings.delta_m,
        )  # fmt: skip
        speed = min(step[SPEED], settings.max_surge_mps)
        near = min(to_end, to_start) / max(settings.distance_to_max_velocity_m, 1e-9)
        if 0.0 < near < 1.0:
            speed -= (speed - min(settings.min_surge_mps, speed)) * (1.0 - near)
        if to_end < _STOPS * tolerance:
            speed = 0.0
        if to_end < _STRAIGHT * tolerance:
            heading = now
        off = abs(wrap_angle(heading - now))
        speed *= min(max((_YAW_STOP_RAD - off) / (_YAW_STOP_RAD - _YAW_FREE_RAD), 0.0), 1.0)
        head_for(heading, 0.0, 0.0, tick)
        surge_at(speed, tick)
        pilot.report[slot.BY_SWAY] = 0.0
        done = to_end < tolerance and abs(heave_m) < settings.tolerance_z_m
        done = done or memory[slot.STEP_S] > memory[slot.TIMEOUT_S]
        if done and parks:
            memory[slot.KEEPS] = 1.0
            unseen = (1.0 - gains.axes[g.SURGE, g.WEIGHT]) * point[slot.SURGE_SPEED]
            held = memory[slot.SURGE_SUM] - unseen
            memory[slot.PLACE_SUM_N], memory[slot.PLACE_SUM_E] = (
                held * math.cos(now),
                held * math.sin(now),
            )
        return bool(done and not parks)
    memory[slot.HELD_S] += dt_s
    if step[KIND] == KEEP:  # by surge and sway, or by surge alone without thrusters for it
        heading = step[HEADING]
        head_for(heading, 0.0, 0.0, tick)
        reference = StopReference(
            step[END_N], step[END_E], heading, 0.0, 0.0, heading, 0.0, 0.0, 0.0, True
        )
        keep_place(reference, tick)
        pilot.report[slot.BY_SWAY] = 1.0 if guidance.sway > 0.0 else 0.0
    else:  # face the place and keep a radius off it
        dn = step[END_N] - pilot.point[slot.POINT_NORTH]
        de = step[END_E] - pilot.point[slot.POINT_EAST]
        heading = math.atan2(de, dn)
        speed = settings.anchor_kp * (math.hypot(dn, de) - settings.anchor_radius_m)
        speed = min(max(speed, settings.anchor_min_mps), settings.anchor_max_mps)
        if abs(wrap_angle(heading - estimate[vector.HEADING])) > _ANCHOR_RAD:
            speed = 0.0
        head_for(heading, 0.0, 0.0, tick)
        surge_at(speed, tick)
        pilot.report[slot.BY_SWAY] = 0.0
    return bool(memory[slot.HELD_S] >= step[HOLD_S])


@kernel
def aim(
    north_m: float,
    east_m: float,
    from_n: float,
    from_e: float,
    end_n: float,
    end_e: float,
    delta_m: float,
) -> float:
    """Course from a place towards where a section wants the vehicle to head."""
    to_end = math.hypot(end_n - north_m, end_e - east_m)
    length = math.hypot(end_n - from_n, end_e - from_e)
    beta = math.atan2(end_e - from_e, end_n - from_n) if length > 1e-6 else 0.0
    s, c = math.sin(beta), math.cos(beta)
    along = (north_m - from_n) * c + (east_m - from_e) * s
    cross = (east_m - from_e) * c - (north_m - from_n) * s
    if along < -delta_m:
        return math.atan2(from_e - east_m, from_n - north_m)
    if along >= length:
        return math.atan2(end_e - east_m, end_n - north_m)
    ahead = length - along
    if delta_m <= to_end:
        ahead = math.sqrt(max(delta_m * delta_m - cross * cross, 0.0))
    return beta - math.atan2(cross, ahead)


NO_LAW, COLA2, ARDUSUB = 0, 1, 2


class PilotMission(NamedTuple):
    """Steps and the law that they are flown by; compiled code takes the arrays as they are."""

    law: int
    steps: Array
    """(M, COLUMNS), see above."""
    cola2: Cola2Settings = Cola2Settings()
    """Of that law."""


NO_MISSION = PilotMission(NO_LAW, np.zeros((0, COLUMNS)))
"""The path is followed by our own guidance."""


@kernel
def fly_mission(mission: PilotMission, tick: Tick) -> bool:
    """Fly a mission for a tick.

    Args:
        mission: steps and law.
        tick: what is read, and the pilot that is written.

    Returns:
        Whether it is over.
    """
    dt_s, estimate, _path, guidance, _gains, pilot = tick
    memory, report, point = pilot.memory, pilot.report, pilot.point
    leg = int(report[slot.LEG])
    step = mission.steps[leg]
    heave = step[BY_DEPTH] > 0.0 and (step[BY_ALTITUDE] == 0.0 or memory[slot.FLOOR_KNOWN] == 0.0)
    if heave:
        depth, slope = step[DEPTH], 0.0
    elif memory[slot.FLOOR_KNOWN] == 0.0:
        depth, slope = guidance.limits.blind_depth_m, 0.0
    else:
        depth, slope = memory[slot.FLOOR] - step[ALTITUDE], memory[slot.FLOOR_SLOPE]
    target = mind_floor(depth, estimate, guidance.limits, pilot)
    if memory[slot.STEP_S] == 0.0:
        north, east = point[slot.POINT_NORTH], point[slot.POINT_EAST]
        memory[slot.HELD_S] = memory[slot.KEEPS] = 0.0
        memory[slot.TRACK_PACE] = 1.0
        if step[KIND] == SECTION:
            memory[slot.FROM_N], memory[slot.FROM_E] = step[START_N], step[START_E]
        elif step[KIND] == FROM_END and leg > 0:
            before = mission.steps[leg - 1]
            memory[slot.FROM_N], memory[slot.FROM_E] = before[END_N], before[END_E]
        else:
            memory[slot.FROM_N], memory[slot.FROM_E] = north, east
        memory[slot.RAMP] = memory[slot.RAMP_SPEED] = memory[slot.REF] = memory[slot.REF_SPEED] = (
            0.0
        )
        memory[slot.TIMEOUT_S] = math.inf
        if mission.law == COLA2:
            memory[slot.TIMEOUT_S] = timeout_s(
                step,
                math.hypot(step[END_N] - north, step[END_E] - east),
                target - estimate[vector.DEPTH],
                mission.cola2,
            )
    memory[slot.STEP_S] += dt_s
    sink_to(target, slope, tick)
    last = leg + 1 == mission.steps.shape[0]
    # Until there is a floor a dive may take as long as it gets on.
    rises = heave and (leg == 0 or last)
    report[slot.PHASE] = DIVE if memory[slot.FLOOR_KNOWN] == 0.0 or rises else FOLLOW
    report[slot.LINE] = step[LINE]
    dn, de = step[END_N] - memory[slot.FROM_N], step[END_E] - memory[slot.FROM_E]
    course = math.atan2(de, dn) if math.hypot(dn, de) > 1e-6 else estimate[vector.HEADING]
    off_n, off_e = (
        point[slot.POINT_NORTH] - memory[slot.FROM_N],
        point[slot.POINT_EAST] - memory[slot.FROM_E],
    )
    report[slot.CROSS] = off_e * math.cos(course) - off_n * math.sin(course)
    report[slot.ALONG] = off_n * math.cos(course) + off_e * math.sin(course)
    report[slot.PATH_HEADING] = course

    away = target - estimate[vector.DEPTH]
    if mission.law == COLA2:
        done = manoeuvre(step, away, mission.cola2, tick)
    else:
        done = to_waypoint(step, away, tick)
    if heave and last and estimate[vector.DEPTH] < guidance.surface_m and step[DEPTH] == 0.0:
        done = True
    if not done:
        return False
    if last:
        return True
    report[slot.LEG] = leg + 1
    memory[slot.STEP_S] = 0.0
    restart_watch(pilot)
    return False
