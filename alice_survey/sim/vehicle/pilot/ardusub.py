"""How ArduSub's AUTO mode follows a mission: AC_WPNav and AC_PosControl's laws.

After the public sources of ArduPilot (`ArduSub/mode_auto.cpp`, `commands_logic.cpp`, `config.h`,
`libraries/AC_WPNav`, `AC_AttitudeControl/AC_PosControl`; Sub-4.5).

- A target moves along the straight from the way-point before to this one, at `WPNAV_SPEED` with
  `WPNAV_ACCEL` and `WPNAV_JERK`, and comes to rest there: ArduSub never sets a next destination, so
  that no way-point is passed. Here it starts and stops with the constant acceleration that takes as
  long as that jerk does.
- Its time runs slower while the vehicle cannot keep up: at the share 0.05 + (v - PSC_POSXY_P e) / v
  wanted, through a low-pass of the time WPNAV_ACCEL / WPNAV_JERK.
- The vehicle holds on to the target by surge and sway. AC_PosControl's P on position and PID on
  velocity take our own gains of these axes, as a vehicle would be tuned; a steady current is met by
  the integral.
- The way-point is reached when the target is there and the vehicle within `WPNAV_RADIUS`, depth
  included; then the stay counts.
- Heading: `WP_YAW_BEHAVIOR` 4, ArduSub's default: the track's bearing, corrected towards the
  velocity that is wanted by at most `XTRACK_ANG_LIM`; or that of a `CONDITION_YAW`.
"""

import math
from typing import NamedTuple

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.compiled import kernel
from alice_survey.sim.vehicle.pilot import memory as slot
from alice_survey.sim.vehicle.pilot.gains import Gains
from alice_survey.sim.vehicle.pilot.memory import PilotState
from alice_survey.sim.vehicle.pilot.path import Path
from alice_survey.sim.vehicle.pilot.settings import Guidance
from alice_survey.sim.vehicle.pilot.standing import StopReference, keep_place, ramp
from alice_survey.sim.vehicle.pilot.steering import clamped, head_for
from alice_survey.sim.vehicle.pilot.steps import END_E, END_N, HEADING, HOLD_S, SPEED, TOLERANCE
from alice_survey.sim.vehicle.rotations import wrapped

MIN_SPEED_MPS = 0.2
"""WPNAV_SPEED_MIN: a slower speed is not taken."""
MIN_RADIUS_M = 0.05
"""WPNAV_RADIUS_MIN"""
_SPARE = 0.05
_SLOW = 0.1
"""Share of the greatest speed below which the heading is not corrected."""
_TINY_S = 1e-9

ARDUSUB_SETTINGS = 4


class ArduSubSettings(NamedTuple):
    """Parameters of ArduSub, with its defaults."""

    accel_mps2: float = 2.5
    """`WPNAV_ACCEL`, there in cm/s^2."""
    jerk_mps3: float = 1.0
    """`WPNAV_JERK`"""
    position_p: float = 1.0
    """`PSC_POSXY_P`"""
    xtrack_limit_rad: float = math.radians(45.0)
    """`XTRACK_ANG_LIM`, there in degrees."""


_ACCEL, _JERK, _POSITION_P, _XTRACK = range(ARDUSUB_SETTINGS)


@kernel
def to_waypoint(
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
    """Fly to a way-point for a tick; return whether it is done. Arguments as of `manoeuvre`."""
    memory, point, now = pilot.memory, pilot.point, estimate[vector.HEADING]
    dn, de = step[END_N] - memory[slot.FROM_N], step[END_E] - memory[slot.FROM_E]
    length = math.hypot(dn, de)
    course = math.atan2(de, dn) if length > 1e-6 else now
    s, c = math.sin(course), math.cos(course)
    speed = max(step[SPEED], MIN_SPEED_MPS)
    acceleration = min(settings[_ACCEL], 0.5 * math.sqrt(speed * settings[_JERK]))
    _set_pace(c, s, now, dt_s, settings, pilot)
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
        wanted_n = moves * c + settings[_POSITION_P] * off_n
        wanted_e = moves * s + settings[_POSITION_P] * off_e
        if length > 1e-6 and math.hypot(wanted_n, wanted_e) >= _SLOW * speed:
            error = wrapped(math.atan2(wanted_e, wanted_n) - course)
            heading += clamped(error, settings[_XTRACK])
    head_for(heading, 0.0, 0.0, estimate, dt_s, gains, pilot)
    wanted = StopReference(north, east, course, moves, quicken, heading, 0.0, 0.0, at, False)
    keep_place(wanted, dt_s, estimate, path, guidance, gains, pilot)
    pilot.report[slot.BY_SWAY] = 1.0

    away = math.hypot(step[END_N] - point[slot.POINT_NORTH], step[END_E] - point[slot.POINT_EAST])
    radius = max(step[TOLERANCE], MIN_RADIUS_M)
    if memory[slot.KEEPS] == 0.0 and (at < length or math.hypot(away, heave_m) > radius):
        return False
    memory[slot.KEEPS] = 1.0
    memory[slot.HELD_S] += dt_s
    return bool(memory[slot.HELD_S] >= step[HOLD_S])


@kernel
def _set_pace(
    c: float, s: float, heading: float, dt_s: float, settings: Array, pilot: PilotState
) -> None:
    """Set how fast the target's time runs.

    Args:
        c: cosine of the course.
        s: its sine.
        heading: of the vehicle.
        dt_s: the tick.
        settings: of the law.
        pilot: its memory is written.
    """
    memory, point = pilot.memory, pilot.point
    wanted, pace = memory[slot.RAMP_SPEED], 1.0
    if wanted > 0.0:
        done = (point[slot.POINT_NORTH] - memory[slot.FROM_N]) * c
        done += (point[slot.POINT_EAST] - memory[slot.FROM_E]) * s
        cosine = c * math.cos(heading) + s * math.sin(heading)
        sine = s * math.cos(heading) - c * math.sin(heading)
        speed = point[slot.SURGE_SPEED] * cosine + point[slot.SWAY_SPEED] * sine
        behind = settings[_POSITION_P] * (memory[slot.RAMP] - done)
        pace = min(max(_SPARE + (speed - behind) / wanted, 0.0), 1.0)
    time_s = settings[_ACCEL] / settings[_JERK]
    memory[slot.TRACK_PACE] += (pace - memory[slot.TRACK_PACE]) * min(dt_s / time_s, 1.0)
