"""Missions of way-points, followed by the law of another vehicle's software instead of our own.

A mission is flown step by step. The law of a step says where to head, how fast to go and when the
step is done; the inner loops beneath it are our own (gains.py), in the place of those that such a
vehicle is tuned with. Two laws are known:

- COLA2 (cola2.py), of SPARUS II and its kin;
- ArduSub's AUTO mode (ardusub.py).

Safety is our own, too: clearance, depth, pitch, bottom lock and progress are watched as on any
mission, and the altitude follows the smoothed sea floor.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.compiled import kernel
from alice_survey.sim.vehicle.pilot import memory as slot
from alice_survey.sim.vehicle.pilot.ardusub import ARDUSUB_SETTINGS, to_waypoint
from alice_survey.sim.vehicle.pilot.cola2 import COLA2_SETTINGS, manoeuvre, timeout_s
from alice_survey.sim.vehicle.pilot.gains import Gains
from alice_survey.sim.vehicle.pilot.memory import DIVE, FOLLOW, PilotState
from alice_survey.sim.vehicle.pilot.path import Path
from alice_survey.sim.vehicle.pilot.safety import mind_floor, restart_watch
from alice_survey.sim.vehicle.pilot.settings import Guidance
from alice_survey.sim.vehicle.pilot.steering import sink_to
from alice_survey.sim.vehicle.pilot.steps import (
    ALTITUDE,
    BY_ALTITUDE,
    BY_DEPTH,
    COLUMNS,
    DEPTH,
    END_E,
    END_N,
    FROM_END,
    KIND,
    LINE,
    SECTION,
    START_E,
    START_N,
)

NO_LAW, COLA2, ARDUSUB = 0, 1, 2
_STEP_M = 1000.0
"""Progress of a step that is done, above the length of any."""


class PilotMission(NamedTuple):
    """Steps and the law that they are flown by; compiled code takes the arrays as they are."""

    law: int
    steps: Array
    """(M, COLUMNS), see steps.py."""
    settings: Array
    """Of the law: `COLA2_SETTINGS` or `ARDUSUB_SETTINGS` values."""


_SETTINGS = max(COLA2_SETTINGS, ARDUSUB_SETTINGS)
NO_MISSION = PilotMission(NO_LAW, np.zeros((0, COLUMNS)), np.zeros(_SETTINGS))
"""The path is followed by our own guidance."""


def mission_of(law: int, steps: Array, settings: Sequence[float]) -> PilotMission:
    """A mission.

    Args:
        law: COLA2 or ARDUSUB.
        steps: (M, COLUMNS)
        settings: of the law.
    """
    padded = np.zeros(_SETTINGS)
    padded[: len(settings)] = settings
    return PilotMission(law, np.ascontiguousarray(steps, np.float64), padded)


@kernel
def mission_progress_m(estimate: Array, mission: PilotMission, pilot: PilotState) -> float:
    """Quantity that grows while a mission gets on: steps done, and the way left of this one."""
    leg = int(pilot.report[slot.LEG])
    step, point = mission.steps[leg], pilot.point
    left = math.hypot(step[END_N] - point[slot.POINT_NORTH], step[END_E] - point[slot.POINT_EAST])
    left += abs(pilot.report[slot.WANTED_DEPTH] - estimate[vector.DEPTH])
    return float(_STEP_M * leg - left + pilot.memory[slot.HELD_S])


@kernel
def fly_mission(
    dt_s: float,
    estimate: Array,
    path: Path,
    mission: PilotMission,
    guidance: Guidance,
    gains: Gains,
    pilot: PilotState,
) -> bool:
    """Fly a mission for a tick.

    Args:
        dt_s: the tick.
        estimate: (14,) of the navigation.
        path: its greatest speed bounds how a place is kept.
        mission: steps and law.
        guidance: settings of the pilot, whose followed point is the vehicle's reference point.
        gains: gains of the inner loops.
        pilot: is written.

    Returns:
        Whether it is over.
    """
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
        _begin(leg, target, estimate, mission, guidance, pilot)
    memory[slot.STEP_S] += dt_s
    sink_to(target, slope, dt_s, estimate, path, guidance, gains, pilot)
    # Until there is a floor a dive may take as long as it gets on.
    report[slot.PHASE] = DIVE if memory[slot.FLOOR_KNOWN] == 0.0 or heave else FOLLOW
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
        done = manoeuvre(step, away, dt_s, estimate, path, mission.settings, guidance, gains, pilot)
    else:
        done = to_waypoint(
            step, away, dt_s, estimate, path, mission.settings, guidance, gains, pilot
        )
    last = leg + 1 == mission.steps.shape[0]
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


@kernel
def _begin(
    leg: int,
    target_m: float,
    estimate: Array,
    mission: PilotMission,
    guidance: Guidance,
    pilot: PilotState,
) -> None:
    """Begin a step: where its way starts, and how long it may take."""
    memory, point, step = pilot.memory, pilot.point, mission.steps[leg]
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
    memory[slot.RAMP] = memory[slot.RAMP_SPEED] = memory[slot.REF] = memory[slot.REF_SPEED] = 0.0
    memory[slot.TIMEOUT_S] = math.inf
    if mission.law == COLA2:
        memory[slot.TIMEOUT_S] = timeout_s(
            step,
            math.hypot(step[END_N] - north, step[END_E] - east),
            target_m - estimate[vector.DEPTH],
            mission.settings,
        )
