"""When a mission is broken off, and why."""

import math
from typing import NamedTuple

from alice_survey.frames import Array
from alice_survey.vehicle.compiled import kernel
from alice_survey.vehicle.pilot.memory import (
    BEST,
    FLOOR_KNOWN,
    LOST_S,
    LOW_S,
    PHASE,
    PITCHED_S,
    SINCE_BEST_S,
    PilotState,
)
from alice_survey.vehicle.signals import (
    ALTITUDE,
    APPROACH,
    DEPTH,
    DIVE,
    ESTIMATE,
    FOLLOW,
    PITCH,
)

(
    NONE, TOO_LOW, TOO_STEEP, NO_BOTTOM, NO_DIVE, NO_APPROACH, NO_PROGRESS, LOST_PATH, TOO_DEEP,
    TOO_LONG, NO_NAVIGATION,
) = range(11)  # fmt: skip

REASONS = {
    NONE: "not aborted",
    TOO_LOW: "the altitude stayed below the least that is allowed",
    TOO_STEEP: "the pitch stayed beyond the most that is allowed",
    NO_BOTTOM: "the DVL did not hear the bottom for longer than is allowed",
    NO_DIVE: "the dive came no nearer to the wanted altitude",
    NO_APPROACH: "the vehicle came no nearer to the start of the path",
    NO_PROGRESS: "the vehicle made no progress along the path",
    LOST_PATH: "the vehicle was carried off the path more often than it may return to it",
    TOO_DEEP: "the depth exceeded the most that is allowed",
    TOO_LONG: "the mission took longer than is allowed",
    NO_NAVIGATION: "the navigation gave no position",
}
"""What the codes of `REASON` in a report mean."""

_WITHIN_S = 1.0
"""How long altitude or pitch may be out of bounds: outliast a false echo and a wave of pitch."""
_STEP_M = 0.1
"""Less than this is no progress."""


class Limits(NamedTuple):
    """Bounds beyond which the vehicle gives up and comes to the surface."""

    least_altitude_m: float
    most_depth_m: float
    most_pitch_rad: float = math.radians(30.0)
    lost_bottom_s: float = 20.0
    stuck_s: float = 90.0
    """Without progress of the dive, the approach or the survey."""
    most_returns: float = 3.0
    """How often the vehicle may be carried off the path and come back."""
    longest_s: float = 86400.0
    """Of the whole mission up to the ascent."""


@kernel
def navigates(estimate: Array) -> bool:
    """Whether the navigation gives all it must: everything but the altitude."""
    total = 0.0
    for i in range(ESTIMATE):
        if i != ALTITUDE:
            total += estimate[i]
    return math.isfinite(total)


@kernel
def watch(
    time_s: float,
    dt_s: float,
    estimate: Array,
    progress_m: float,
    limits: Limits,
    pilot: PilotState,
) -> int:
    """Look after the vehicle for a tick.

    Args:
        time_s: since the start of the mission.
        dt_s: the tick.
        estimate: (13,) of the navigation.
        progress_m: what should grow in the phase that the pilot reports.
        limits: bounds.
        pilot: its memory is written.

    Returns:
        NONE, or the reason to abort.
    """
    memory, phase = pilot.memory, pilot.report[PHASE]
    if phase != DIVE and phase != APPROACH and phase != FOLLOW:
        return NONE
    altitude = estimate[ALTITUDE]
    heard = math.isfinite(altitude)
    # On the way down the bottom may be out of reach; the watch on the dive's progress covers it.
    memory[LOST_S] = 0.0 if heard or phase == DIVE else memory[LOST_S] + dt_s
    # An altitude that is not heard neither clears nor adds to the suspicion.
    if heard:
        low = altitude < limits.least_altitude_m
        memory[LOW_S] = memory[LOW_S] + dt_s if low else 0.0
    steep = abs(estimate[PITCH]) > limits.most_pitch_rad
    memory[PITCHED_S] = memory[PITCHED_S] + dt_s if steep else 0.0
    if progress_m > memory[BEST] + _STEP_M:
        memory[BEST], memory[SINCE_BEST_S] = progress_m, 0.0
    else:
        memory[SINCE_BEST_S] += dt_s

    if memory[LOW_S] > _WITHIN_S:
        return TOO_LOW
    if memory[PITCHED_S] > _WITHIN_S:
        return TOO_STEEP
    if estimate[DEPTH] > limits.most_depth_m:
        return TOO_DEEP
    if memory[LOST_S] > limits.lost_bottom_s:
        return NO_BOTTOM
    if memory[SINCE_BEST_S] > limits.stuck_s:
        if phase == DIVE:
            return NO_DIVE if memory[FLOOR_KNOWN] > 0.0 else NO_BOTTOM
        return NO_APPROACH if phase == APPROACH else NO_PROGRESS
    if time_s > limits.longest_s:
        return TOO_LONG
    return NONE


@kernel
def restart_watch(pilot: PilotState) -> None:
    """Forget the progress of the phase that ends."""
    pilot.memory[BEST], pilot.memory[SINCE_BEST_S] = -math.inf, 0.0
