"""Guidance of vehicles that fins steer: depth by pitch, and circles in place of hovering.

In the vertical plane the vehicle heads for a point ahead on the wanted depth, as `los` does in the
horizontal one: its pitch is that of level flight plus the depth's error by a look-ahead distance,
plus an integral for what level flight takes that is not modelled. It cannot stop: it dives, waits
and surfaces on a circle that touches the way in to its path, at the survey's speed.
"""

import math
from typing import NamedTuple

import numpy as np

from alice_survey.core.frames import Array
from alice_survey.sim.vehicle import estimate_vector as vector
from alice_survey.sim.vehicle.compiled import kernel
from alice_survey.sim.vehicle.pilot import memory as slot
from alice_survey.sim.vehicle.pilot.gains import (
    INTEGRAL_SHARE,
    LAG,
    PITCH,
    PLACE,
    RATE,
    Gains,
    heading_loop,
)
from alice_survey.sim.vehicle.pilot.linear import (
    VERTICAL,
)
from alice_survey.sim.vehicle.pilot.memory import PilotState

MAX_PITCH_RAD = math.radians(20.0)
"""Greatest commanded pitch besides that of level flight: two thirds of what ends a mission."""
_DEPTH_KEPT_M = 0.2
"""Within it the integral learns."""


class UnderWay(NamedTuple):
    """How a vehicle that cannot hover flies."""

    circle_m: float
    """Radius of the circle that it waits on; 0 of a vehicle that hovers."""
    side: float
    """+1: the circle is flown to starboard; -1: to port."""
    dive_ahead_m: float
    """Look-ahead in the vertical plane."""
    level_rad: float
    """Pitch of level flight."""


HOVERS = UnderWay(0.0, 1.0, 1.0, 0.0)
"""Of a vehicle that can stay where it is."""


def dive_loop(gains: Gains, speed_mps: float, look_ahead_m: float) -> Array:
    """State matrix of keeping a depth by pitch.

    States: integral of the pitch's error; pitch; heave, m/s; pitch rate; pitch acceleration that
    the lagging fins give; depth, m; integral of depth as a pitch.

    Args:
        gains: gains of the vehicle.
        speed_mps: surge.
        look_ahead_m: look-ahead of the guidance.

    Returns:
        (7, 7)
    """
    row = gains.axes[PITCH]
    loop = np.zeros((7, 7))
    loop[:5, :5] = heading_loop(gains.body, speed_mps, row, gains.fins, VERTICAL)
    sink = np.array([0.0, -speed_mps, 1.0, 0.0, 0.0, 0.0, 0.0])
    learns = INTEGRAL_SHARE * speed_mps / look_ahead_m**2
    loop[5], loop[6, 5] = sink, learns
    # Wanted pitch depth / look-ahead + integral, and its rate, without that of the integral.
    wanted, rate = np.zeros(7), sink / look_ahead_m
    wanted[5], wanted[6] = 1.0 / look_ahead_m, 1.0
    loop[0] -= wanted
    loop[4] += (row[PLACE] * wanted + row[RATE] * rate) / row[LAG]
    return loop


@kernel
def fly_to_depth(
    depth_m: float,
    feed_mps: float,
    speed_mps: float,
    estimate: Array,
    dt_s: float,
    under_way: UnderWay,
    pilot: PilotState,
) -> None:
    """Command the pitch that takes the origin to a depth, which itself moves at a speed.

    Args:
        depth_m: wanted.
        feed_mps: rate of that, downwards.
        speed_mps: of the survey.
        estimate: (14,) of the navigation.
        dt_s: the tick.
        under_way: settings.
        pilot: its demand and memory are written.
    """
    memory, demand = pilot.memory, pilot.demand
    off, ahead = estimate[vector.DEPTH] - depth_m, under_way.dive_ahead_m
    bent = off / ahead + memory[slot.HEAVE_SUM] - feed_mps / speed_mps
    kept = min(max(bent, -MAX_PITCH_RAD), MAX_PITCH_RAD)
    demand[slot.REF_PITCH] = under_way.level_rad + kept
    demand[slot.REF_PITCH_RATE] = 0.0
    if kept == bent:
        demand[slot.REF_PITCH_RATE] = (pilot.point[slot.SINK_SPEED] - feed_mps) / ahead
    if abs(off) < _DEPTH_KEPT_M:
        total = memory[slot.HEAVE_SUM] + INTEGRAL_SHARE * speed_mps / (ahead * ahead) * off * dt_s
        memory[slot.HEAVE_SUM] = min(max(total, -0.5 * MAX_PITCH_RAD), 0.5 * MAX_PITCH_RAD)
    pilot.report[slot.WANTED_DEPTH] = depth_m


@kernel
def circle_course(
    goal_n: float,
    goal_e: float,
    heading: float,
    look_ahead_m: float,
    under_way: UnderWay,
    point: Array,
) -> tuple[float, float]:
    """Course that leads onto the circle through a goal, tangent to a heading there, and round it.

    Args:
        goal_n: north of the goal.
        goal_e: east of it.
        heading: at the goal.
        look_ahead_m: look-ahead in the horizontal plane.
        under_way: settings.
        point: of the pilot.

    Returns:
        The course, rad, and its rate by distance, 1/m.
    """
    side, radius = under_way.side, under_way.circle_m
    dn = point[slot.POINT_NORTH] - (goal_n - side * radius * math.sin(heading))
    de = point[slot.POINT_EAST] - (goal_e + side * radius * math.cos(heading))
    away = math.hypot(dn, de)
    tangent = math.atan2(de, dn) + side * 0.5 * math.pi
    return tangent + side * math.atan2(away - radius, look_ahead_m), side / max(away, radius)
