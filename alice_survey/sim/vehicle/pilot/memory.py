"""State that the pilot keeps from tick to tick, and its report."""

import math
from typing import NamedTuple

import numpy as np

from alice_survey.core.compiled import columns
from alice_survey.core.frames import Array

(
    PHASE, LEG, ALONG, CROSS, TARGET_HEADING, TARGET_SURGE, BY_SWAY, REASON, LINE, TARGET_DEPTH,
    TARGET_SWAY, AT_SURFACE, PATH_HEADING,
) = range(13)  # fmt: skip
"""Columns of a report: phase (below); leg; distance along it, m; how far the followed point is
to starboard of the path, m; target heading, rad; target surge over ground, m/s; 1 while the path is
held by sway, 0 while it is by heading; reason of an abort (safety.py); survey line or -1; target
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
(standing.py), how far these have got, m or rad, and how fast; how long it waits at the leg's end,
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
