"""Conditions that abort a mission, and their reasons."""

import math
from typing import NamedTuple

from alice_survey.core.compiled import kernel
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.estimate_vector import ALTITUDE, CLEARANCE, DEPTH, PITCH
from alice_survey.sim.vehicle.pilot import memory as slot
from alice_survey.sim.vehicle.pilot.memory import PilotState

(
    NONE, TOO_LOW, TOO_STEEP, NO_BOTTOM, NO_DIVE, NO_APPROACH, NO_PROGRESS, LOST_PATH, TOO_DEEP,
    TOO_LONG, NO_NAVIGATION, TOUCHED, THRUSTER_LOST,
) = range(13)  # fmt: skip

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
        memory[slot.PACE] = max(0.0, 1.0 - memory[slot.LOST_S] / _STOP_S)
        if limits.blind_sigma_m > 0.0 and 0.0 <= memory[slot.SIGMA_M] <= limits.blind_sigma_m:
            memory[slot.PACE] = 1.0  # it knows well enough where it is
        return depth_m
    spare = clear - _KEPT * minimum
    memory[slot.PACE] = min(max((clear / minimum - 1.0) / (_KEPT - 1.0), 0.0), 1.0)
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
    memory, phase = pilot.memory, pilot.report[slot.PHASE]
    if phase != slot.DIVE and phase != slot.APPROACH and phase != slot.FOLLOW:
        return NONE
    clear = min(estimate[ALTITUDE], estimate[CLEARANCE])
    heard = math.isfinite(clear)
    # On the way down the bottom may be out of reach; the watch on the dive's progress covers it.
    memory[slot.LOST_S] = 0.0 if heard or phase == slot.DIVE else memory[slot.LOST_S] + dt_s
    # A missing altitude neither clears nor adds to the suspicion.
    if heard:
        minimum = limits.min_altitude_m
        memory[slot.LOW_S] = memory[slot.LOW_S] + dt_s if clear < minimum else 0.0
        memory[slot.UNSAFE_S] = memory[slot.UNSAFE_S] + dt_s if clear < 0.5 * minimum else 0.0
    steep = abs(estimate[PITCH]) > limits.max_pitch_rad
    memory[slot.PITCHED_S] = memory[slot.PITCHED_S] + dt_s if steep else 0.0
    if progress_m > memory[slot.BEST] + _STEP_M:
        memory[slot.BEST], memory[slot.SINCE_BEST_S] = progress_m, 0.0
    else:
        memory[slot.SINCE_BEST_S] += dt_s

    if memory[slot.UNSAFE_S] > _WITHIN_S or memory[slot.LOW_S] > limits.climb_s:
        return TOO_LOW
    if memory[slot.PITCHED_S] > _WITHIN_S:
        return TOO_STEEP
    if estimate[DEPTH] > limits.max_depth_m:
        return TOO_DEEP
    blind = limits.blind_sigma_m > 0.0 and 0.0 <= memory[slot.SIGMA_M] <= limits.blind_sigma_m
    if memory[slot.LOST_S] > limits.lost_bottom_s and not blind:
        return NO_BOTTOM
    if memory[slot.SINCE_BEST_S] > limits.stuck_s:
        if phase == slot.DIVE:
            return NO_DIVE if memory[slot.FLOOR_KNOWN] > 0.0 else NO_BOTTOM
        return NO_APPROACH if phase == slot.APPROACH else NO_PROGRESS
    if time_s > limits.max_s:
        return TOO_LONG
    return NONE


@kernel
def restart_watch(pilot: PilotState) -> None:
    """Reset the progress of the phase that ends."""
    pilot.memory[slot.BEST], pilot.memory[slot.SINCE_BEST_S] = -math.inf, 0.0
