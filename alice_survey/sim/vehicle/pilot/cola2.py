"""How COLA2 follows a mission: its captain and its pilot's section, keep and anchor controllers.

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
"""

import math
from typing import NamedTuple

import numpy as np

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.compiled import kernel
from alice_survey.sim.vehicle.dynamics import add_coriolis, add_damping
from alice_survey.sim.vehicle.pilot import memory as slot
from alice_survey.sim.vehicle.pilot.gains import FASTEST, PLACE, RATE, SURGE, WEIGHT, YAW, Gains
from alice_survey.sim.vehicle.pilot.memory import PilotState
from alice_survey.sim.vehicle.pilot.path import Path
from alice_survey.sim.vehicle.pilot.settings import Guidance
from alice_survey.sim.vehicle.pilot.standing import StopReference, keep_place
from alice_survey.sim.vehicle.pilot.steering import head_for, surge_at
from alice_survey.sim.vehicle.pilot.steps import (
    ANCHOR,
    BY_ALTITUDE,
    BY_DEPTH,
    END_E,
    END_N,
    HEADING,
    HOLD_S,
    KEEP,
    KIND,
    SPEED,
    TOLERANCE,
)
from alice_survey.sim.vehicle.rotations import wrapped

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

COLA2_SETTINGS = 9


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


(
    _DELTA, _TOLERANCE_Z, _RAMP, _MAX_SURGE, _MIN_SURGE,
    _ANCHOR_KP, _ANCHOR_RADIUS, _ANCHOR_MIN, _ANCHOR_MAX,
) = range(COLA2_SETTINGS)  # fmt: skip


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
    low, high = 0.0, _YAW_STOP_RAD
    while high - low > 1e-6:
        middle = 0.5 * (low + high)
        surge, sway, _ = _circling(gains, speed_mps, middle)
        if middle + math.atan2(abs(sway), surge) > 0.5 * math.pi:
            high = middle
        else:
            low = middle
    surge, sway, turn = _circling(gains, speed_mps, low)
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
    row = gains.axes[YAW]
    return float(min(row[PLACE] / row[RATE] * error_rad, row[FASTEST]))


def _circling(gains: Gains, speed_mps: float, error_rad: float) -> tuple[float, float, float]:
    """Surge, steady sway and yaw rate of a section's law at a heading error."""
    share = (_YAW_STOP_RAD - error_rad) / (_YAW_STOP_RAD - _YAW_FREE_RAD)
    surge, turn = speed_mps * min(max(share, 0.0), 1.0), yaw_rad_s(gains, error_rad)
    low, high = -_FASTEST_SLIP * speed_mps, 0.0
    while high - low > 1e-6 * speed_mps:
        middle = 0.5 * (low + high)
        motion, force = np.array([surge, middle, 0.0, 0.0, 0.0, turn]), np.zeros(6)
        add_damping(gains.body, motion, force)
        add_coriolis(gains.body, motion, force)
        if force[1] > 0.0:
            low = middle
        else:
            high = middle
    return surge, 0.5 * (low + high), turn


@kernel
def timeout_s(step: Array, distance_m: float, heave_m: float, settings: Array) -> float:
    """How long the captain lets a manoeuvre take.

    Args:
        step: its row.
        distance_m: to its end, seen from above.
        heave_m: to its depth.
        settings: of the law.
    """
    speed = max(min(step[SPEED], settings[_MAX_SURGE]), 1e-3)
    heave = abs(heave_m) if step[BY_DEPTH] > 0.0 else 0.0
    heave += _DVL_RANGE_M if step[BY_ALTITUDE] > 0.0 else 0.0
    return float(2.0 * max(math.sqrt(2.0) * distance_m / speed, heave / _HEAVE_MPS) + _SPARE_S)


@kernel
def manoeuvre(
    step: Array,
    heave_m: float,
    dt_s: float,
    estimate: Array,
    path: Path,
    settings: Array,
    guidance: Guidance,
    gains: Gains,
    pilot: PilotState,
) -> bool:
    """Fly a goto, section or park for a tick; return whether it is done.

    Args:
        step: its row.
        heave_m: how much deeper the vehicle should be.
        dt_s: the tick.
        estimate: (14,) of the navigation.
        path: its greatest speed bounds how a place is kept.
        settings: of the law.
        guidance: settings of the pilot.
        gains: gains of the inner loops.
        pilot: is written.
    """
    memory = pilot.memory
    parks = step[KIND] == KEEP or step[KIND] == ANCHOR
    if not parks or memory[slot.KEEPS] == 0.0:
        tolerance = PARK_APPROACH_M if parks else step[TOLERANCE]
        done = _section(step, tolerance, heave_m, dt_s, estimate, settings, guidance, gains, pilot)
        done = done or memory[slot.STEP_S] > memory[slot.TIMEOUT_S]
        if done and parks:
            memory[slot.KEEPS] = 1.0
            heading, speed = estimate[vector.HEADING], pilot.point[slot.SURGE_SPEED]
            held = memory[slot.SURGE_SUM] - (1.0 - gains.axes[SURGE, WEIGHT]) * speed
            memory[slot.PLACE_SUM_N] = held * math.cos(heading)
            memory[slot.PLACE_SUM_E] = held * math.sin(heading)
        return bool(done and not parks)
    memory[slot.HELD_S] += dt_s
    if step[KIND] == KEEP:
        _keep(step, dt_s, estimate, path, guidance, gains, pilot)
    else:
        _anchor(step, dt_s, estimate, settings, guidance, gains, pilot)
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


@kernel
def _section(
    step: Array,
    tolerance_m: float,
    heave_m: float,
    dt_s: float,
    estimate: Array,
    settings: Array,
    guidance: Guidance,
    gains: Gains,
    pilot: PilotState,
) -> bool:
    """Follow a section for a tick; return whether its end is reached."""
    memory, point, now = pilot.memory, pilot.point, estimate[vector.HEADING]
    north, east = point[slot.POINT_NORTH], point[slot.POINT_EAST]
    to_end = math.hypot(step[END_N] - north, step[END_E] - east)
    to_start = math.hypot(memory[slot.FROM_N] - north, memory[slot.FROM_E] - east)
    heading = aim(
        north, east, memory[slot.FROM_N], memory[slot.FROM_E], step[END_N], step[END_E],
        settings[_DELTA],
    )  # fmt: skip
    speed = min(step[SPEED], settings[_MAX_SURGE])
    near = min(to_end, to_start) / max(settings[_RAMP], 1e-9)
    if 0.0 < near < 1.0:
        speed -= (speed - min(settings[_MIN_SURGE], speed)) * (1.0 - near)
    if to_end < _STOPS * tolerance_m:
        speed = 0.0
    if to_end < _STRAIGHT * tolerance_m:
        heading = now
    off = abs(wrapped(heading - now))
    speed *= min(max((_YAW_STOP_RAD - off) / (_YAW_STOP_RAD - _YAW_FREE_RAD), 0.0), 1.0)
    head_for(heading, 0.0, 0.0, estimate, dt_s, gains, pilot)
    surge_at(speed, dt_s, guidance, gains, pilot)
    pilot.report[slot.BY_SWAY] = 0.0
    return bool(to_end < tolerance_m and abs(heave_m) < settings[_TOLERANCE_Z])


@kernel
def _keep(
    step: Array,
    dt_s: float,
    estimate: Array,
    path: Path,
    guidance: Guidance,
    gains: Gains,
    pilot: PilotState,
) -> None:
    """Hold a place and a heading: by surge and sway, or by surge alone without thrusters for it."""
    heading = step[HEADING]
    head_for(heading, 0.0, 0.0, estimate, dt_s, gains, pilot)
    wanted = StopReference(
        step[END_N], step[END_E], heading, 0.0, 0.0, heading, 0.0, 0.0, 0.0, True
    )
    keep_place(wanted, dt_s, estimate, path, guidance, gains, pilot)
    pilot.report[slot.BY_SWAY] = 1.0 if guidance.sway > 0.0 else 0.0


@kernel
def _anchor(
    step: Array,
    dt_s: float,
    estimate: Array,
    settings: Array,
    guidance: Guidance,
    gains: Gains,
    pilot: PilotState,
) -> None:
    """Face a place and keep a radius off it."""
    dn = step[END_N] - pilot.point[slot.POINT_NORTH]
    de = step[END_E] - pilot.point[slot.POINT_EAST]
    heading = math.atan2(de, dn)
    speed = settings[_ANCHOR_KP] * (math.hypot(dn, de) - settings[_ANCHOR_RADIUS])
    speed = min(max(speed, settings[_ANCHOR_MIN]), settings[_ANCHOR_MAX])
    if abs(wrapped(heading - estimate[vector.HEADING])) > _ANCHOR_RAD:
        speed = 0.0
    head_for(heading, 0.0, 0.0, estimate, dt_s, gains, pilot)
    surge_at(speed, dt_s, guidance, gains, pilot)
    pilot.report[slot.BY_SWAY] = 0.0
