"""State that the pilot keeps from tick to tick, and its report.

Conditions that abort a mission, and their reasons.
"""

import math
from typing import NamedTuple

import numpy as np

from alice_survey.core.compiled import columns, kernel
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.estimate_vector import ALTITUDE, CLEARANCE, DEPTH, PITCH

(
    PHASE, LEG, ALONG, CROSS, TARGET_HEADING, TARGET_SURGE, BY_SWAY, REASON, LINE, TARGET_DEPTH,
    TARGET_SWAY, AT_SURFACE, PATH_HEADING,
) = range(13)  # fmt: skip
"""Columns of a report: phase (below); leg; distance along it, m; how far the followed point is
to starboard of the path, m; target heading, rad; target surge over ground, m/s; 1 while the path is
held by sway, 0 while it is by heading; reason of an abort (below); survey line or -1; target
depth of the body's origin, m; target sway over ground, m/s; 1 at the surface after the mission or
an abort; heading of the path, rad. Phase, leg, distance, the steering mode and the reason are
also inputs of the pilot on the next tick."""
REPORT = 13

DIVE, APPROACH, FOLLOW, ASCEND, DONE, ABORT = columns(6)
"""Phases of the guidance."""

(
    FLOOR, FLOOR_SLOPE, FLOOR_KNOWN, SURGE_SUM, SWAY_SUM_N, SWAY_SUM_E, HEAVE_SUM, YAW_SUM,
    SETTLED_S, BEST, SINCE_BEST_S, RETURNS, LOST_S, LOW_S, PITCHED_S,
    UNSAFE_S, PACE, STANDING, REF, REF_SPEED, WAITED_S,
    PLACE_SUM_N, PLACE_SUM_E, RAMP, RAMP_SPEED, ROLL_SUM, PITCH_SUM,
    MEAN_N, MEAN_E, NEAR_S, LEAN_N, LEAN_E, SIGMA_M,
    STEP_S, FROM_N, FROM_E, TIMEOUT_S, KEEPS, HELD_S, TRACK_PACE,
) = range(40)  # fmt: skip
"""Places in the memory: the depth, m, that the origin's depth and the altitude add up to, smoothed,
its slope, m/s, and whether there is one; integrals of the inner loops as speeds, that of sway as a
vector in NED, that of heave as an angle where the vehicle dives by its pitch; the time that depth,
or place and heading, are kept; the watchdog's best value and its age; returns to the path; how long
bottom lock is lost, the altitude too low, the pitch too large, s; how long the clearance is less
than half of what is allowed, s; the share of the target surge that the sea floor leaves; 1 while
the vehicle follows a place that moves along the leg or a heading that turns on the spot
(steering.py), how far these have got, m or rad, and how fast; how long it waits at the leg's end,
s; the integral, as a speed, of keeping that place by surge, a vector in NED; the place or heading,
and its speed, that thrusters without lag would be at; the integrals of roll and pitch, as
accelerations; how far the followed point is from its goal on the mean of some time, m, and how long
that is little, s; the integral of the cross-track error of a vehicle that fins steer, as an angle,
a vector in NED; the greater standard deviation of the navigation's north and east, m;
of a mission's step (mission.py) the time since it began, where its way starts, how long it may
take, 1 while it keeps its end, for how long, and how fast the time of its moving target runs."""
MEMORY = 40

(
    REF_SURGE, REF_SWAY, REF_HEAVE, REF_YAW, ACC_SURGE, ACC_SWAY, ACC_HEAVE, ACC_YAW,
    FULL_SURGE, FULL_SWAY, FULL_HEAVE, FULL_YAW,
    REF_PITCH, REF_PITCH_RATE,
) = range(14)  # fmt: skip
"""Places in the demand on the inner loops: body velocity that feed-forward is for, m/s and rad/s;
target acceleration; +1 or -1 where the last wrench was cut at the greatest or least; and target
pitch, rad, with its rate, rad/s, which are 0 but for a vehicle that dives by its pitch."""
DEMAND = 14


(POINT_NORTH, POINT_EAST, SURGE_SPEED, SWAY_SPEED, SINK_SPEED, TURN_SPEED) = range(6)
"""Places in `point`: where the followed point is, m; its level speed ahead and to starboard over
ground, the origin's downwards, m/s; and the rate of the heading, rad/s."""


class PilotState(NamedTuple):
    """Arrays that `steer` writes."""

    memory: Array
    """(MEMORY,)"""
    report: Array
    """(REPORT,)"""
    demand: Array
    """(DEMAND,)"""
    point: Array
    """(6,)"""
    motion: Array
    """(6,) scratch."""
    force: Array
    """(6,) scratch."""


def new_pilot() -> PilotState:
    """A pilot at the start of a mission: about to dive."""
    memory = np.zeros(MEMORY)
    memory[BEST], memory[PACE] = -math.inf, 1.0
    report = np.zeros(REPORT)
    report[TARGET_HEADING] = math.nan
    report[LINE] = -1.0
    return PilotState(memory, report, np.zeros(DEMAND), np.zeros(6), np.zeros(6), np.zeros(6))


(
    NONE, TOO_LOW, TOO_STEEP, NO_BOTTOM, NO_DIVE, NO_APPROACH, NO_PROGRESS, LOST_PATH, TOO_DEEP,
    TOO_LONG, NO_NAVIGATION, TOUCHED, THRUSTER_LOST,
) = columns(13)  # fmt: skip

REASONS = {
    NONE: "not aborted",
    TOO_LOW: "the clearance stayed below the least that is allowed",
    TOO_STEEP: "the pitch stayed beyond the most that is allowed",
    NO_BOTTOM: "the DVL did not hear the bottom for longer than is allowed",
    NO_DIVE: "the dive came no nearer to the target altitude",
    NO_APPROACH: "the vehicle came no nearer to the start of the path",
    NO_PROGRESS: "the vehicle made no progress along the path",
    LOST_PATH: "the vehicle was carried off the path more often than it may return to it",
    TOO_DEEP: "the depth exceeded the most that is allowed",
    TOO_LONG: "the mission took longer than is allowed",
    NO_NAVIGATION: "the navigation gave no position",
    TOUCHED: "the hull touched the sea floor",
    THRUSTER_LOST: "a thruster failed without which it cannot fly a survey",
}
"""Meaning of the codes of `REASON` in a report."""

_WITHIN_S = 1.0
"""Time for which half the clearance or the pitch may be out of bounds: above a false echo and a
wave of pitch."""
_KEPT = 1.25
"""Over the least clearance: guidance rises to keep this; below it the vehicle goes slower, to
stand still at the least."""
_STOP_S = 3.0
"""Time after the loss of bottom lock to reduce the surge to zero. The lock is reported lost
two seconds after the last ping, so that the vehicle is at rest some five seconds after it."""
_STEP_M = 0.1
"""Least distance that counts as progress."""


class SafetyLimits(NamedTuple):
    """Bounds beyond which the vehicle aborts and surfaces."""

    min_altitude_m: float
    """Least clearance of all parts of the vehicle above the sea floor."""
    max_depth_m: float
    max_pitch_rad: float = math.radians(30.0)
    lost_bottom_s: float = 20.0
    stuck_s: float = 90.0
    """Longest time without progress of the dive, the approach or the survey."""
    max_returns: float = 3.0
    """Number of times that the vehicle may be carried off the path and return."""
    max_s: float = 86400.0
    """Longest duration of the mission up to the ascent."""
    climb_s: float = 10.0
    """How long the vehicle may take to climb back to the least altitude; below half of it there is
    no waiting."""
    blind_depth_m: float = math.inf
    """Depth of the dive without bottom lock; by default almost the greatest."""
    blind_sigma_m: float = 0.0
    """Without bottom lock the vehicle goes on at its depth while the navigation's horizontal sigma
    is no greater; 0: it stops, and aborts after `lost_bottom_s`."""


@kernel
def mind_floor(depth_m: float, estimate: Array, limits: SafetyLimits, pilot: PilotState) -> float:
    """Keep clear of the sea floor: slow down, and climb.

    The pace is 1 where the clearance is at least 1.25 times the least that is allowed and falls to
    0 at the least. Without bottom lock it falls to 0 in 3 s, but not on the dive, on which
    bottom lock may not have been found yet, nor where the vehicle is to go on blind.

    Args:
        depth_m: target, of the origin.
        estimate: (14,) of the navigation.
        limits: bounds.
        pilot: its memory's pace is written.

    Returns:
        A depth, no greater, with at least 1.25 times the least clearance.
    """
    memory, minimum = pilot.memory, limits.min_altitude_m
    clear = min(estimate[ALTITUDE], estimate[CLEARANCE])
    if not math.isfinite(clear):
        memory[PACE] = max(0.0, 1.0 - memory[LOST_S] / _STOP_S)
        if limits.blind_sigma_m > 0.0 and 0.0 <= memory[SIGMA_M] <= limits.blind_sigma_m:
            memory[PACE] = 1.0  # it knows well enough where it is
        return depth_m
    spare = clear - _KEPT * minimum
    memory[PACE] = min(max((clear / minimum - 1.0) / (_KEPT - 1.0), 0.0), 1.0)
    return float(min(depth_m, estimate[DEPTH] + spare))


@kernel
def watch(
    time_s: float,
    dt_s: float,
    estimate: Array,
    progress_m: float,
    limits: SafetyLimits,
    pilot: PilotState,
) -> int:
    """Check the safety of the vehicle for a tick.

    Args:
        time_s: since the start of the mission.
        dt_s: the tick.
        estimate: (14,) of the navigation.
        progress_m: quantity that should grow in the phase that the pilot reports.
        limits: bounds.
        pilot: its memory is written.

    Returns:
        NONE, or the reason to abort.
    """
    memory, phase = pilot.memory, pilot.report[PHASE]
    if phase != DIVE and phase != APPROACH and phase != FOLLOW:
        return NONE
    clear = min(estimate[ALTITUDE], estimate[CLEARANCE])
    heard = math.isfinite(clear)
    # On the way down the bottom may be out of reach; the watch on the dive's progress covers it.
    memory[LOST_S] = 0.0 if heard or phase == DIVE else memory[LOST_S] + dt_s
    # A missing altitude neither clears nor adds to the suspicion.
    if heard:
        minimum = limits.min_altitude_m
        memory[LOW_S] = memory[LOW_S] + dt_s if clear < minimum else 0.0
        memory[UNSAFE_S] = memory[UNSAFE_S] + dt_s if clear < 0.5 * minimum else 0.0
    steep = abs(estimate[PITCH]) > limits.max_pitch_rad
    memory[PITCHED_S] = memory[PITCHED_S] + dt_s if steep else 0.0
    if progress_m > memory[BEST] + _STEP_M:
        memory[BEST], memory[SINCE_BEST_S] = progress_m, 0.0
    else:
        memory[SINCE_BEST_S] += dt_s

    if memory[UNSAFE_S] > _WITHIN_S or memory[LOW_S] > limits.climb_s:
        return TOO_LOW
    if memory[PITCHED_S] > _WITHIN_S:
        return TOO_STEEP
    if estimate[DEPTH] > limits.max_depth_m:
        return TOO_DEEP
    blind = limits.blind_sigma_m > 0.0 and 0.0 <= memory[SIGMA_M] <= limits.blind_sigma_m
    if memory[LOST_S] > limits.lost_bottom_s and not blind:
        return NO_BOTTOM
    if memory[SINCE_BEST_S] > limits.stuck_s:
        if phase == DIVE:
            return NO_DIVE if memory[FLOOR_KNOWN] > 0.0 else NO_BOTTOM
        return NO_APPROACH if phase == APPROACH else NO_PROGRESS
    if time_s > limits.max_s:
        return TOO_LONG
    return NONE


@kernel
def restart_watch(pilot: PilotState) -> None:
    """Reset the progress of the phase that ends."""
    pilot.memory[BEST], pilot.memory[SINCE_BEST_S] = -math.inf, 0.0
